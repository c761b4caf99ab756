"""design.png: the results over the evaluations, the remanence, and the fields that vary."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.quantities.registry import endings, quantity
from magshell_fenicsx.studies.design_blocks import Between
from magshell_fenicsx.studies.design_variables import Variables

Array = NDArray[np.float64]

TITLES = {
    "thickness": "thickness over $h$",
    "curvature": r"natural curvature $\kappa R$",
    "deviation": "deviation $w_0/h$",
}
MARGINS = (-0.03, 0.03)  # beyond the bounds


def draw_design(rows: Sequence[dict[str, Any]], results: Sequence[str], vary: Variables, x: Array, file: Path) -> None:
    """Write the picture."""
    from matplotlib.figure import Figure

    units = dict.fromkeys(map(_unit, results))
    panels = 1 + (vary.controls is not None) + len(vary.fields)
    figure = Figure(figsize=(4.6 * panels, max(3.8, 2.2 * len(units))), dpi=160, layout="constrained")
    grid = figure.add_gridspec(len(units), panels)
    above: Any = None
    for i, unit in enumerate(units):
        above = figure.add_subplot(grid[i, 0], sharex=above)
        _draw_history(above, rows, [result for result in results if _unit(result) == unit], unit)
        above.tick_params(labelbottom=i == len(units) - 1)
    above.set_xlabel("evaluation (dots: the best so far)")
    others = [figure.add_subplot(grid[:, i]) for i in range(1, panels)]
    if vary.controls and vary.remanence:
        places, vectors = vary.controls.places, vary.vectors(x)
        names = (r"\rho", "z") if vary.controls.around else ("x", "y", "z")
        widest = np.argsort(-np.ptp(places, axis=0), kind="stable")[:2]
        first, second = (0, len(names) - 1) if vary.remanence.planar else sorted(int(i) for i in widest)
        others[0].plot(places[:, first], places[:, second], ".", color="0.6", markersize=3)
        others[0].quiver(
            places[:, first], places[:, second], vectors[:, first], vectors[:, second], color="C3", width=0.006
        )
        title = r"remanence over $|B^\mathrm{r}|$, undeformed"
        others[0].set(xlabel=f"${names[first]}/R$", ylabel=f"${names[second]}/R$", title=title)
        others[0].set_aspect("equal", adjustable="datalim")
        others[0].margins(0.2)
    for axes, field in zip(others[len(others) - len(vary.fields) :], vary.fields, strict=True):
        _draw_field(axes, field, field.values(x[vary.blocks[field.name]]))
    figure.savefig(file)


def _draw_history(axes: Any, rows: Sequence[dict[str, Any]], results: Sequence[str], unit: str) -> None:
    """Results of one unit over the evaluations."""
    number, best = (
        np.array([row[key] for row in rows], dtype=kind) for key, kind in (("evaluation", int), ("best", bool))
    )
    for result in results:
        values = np.array([np.nan if row[result] is None else row[result] for row in rows], dtype=float)
        (line,) = axes.plot(number, values, "-", linewidth=0.8, label=_name(result))
        axes.plot(number[best], values[best], "o", markersize=3, color=line.get_color())
        if result == "shape":
            axes.set_yscale("log")
    shown = unit if unit in {"Hz", *endings().values()} else ""
    axes.set_ylabel(_name(results[0]) + (f"  ({shown})" if shown else "") if len(results) == 1 else shown)
    if len(results) > 1:
        axes.legend(frameon=False, fontsize=8)


def _unit(result: str) -> str:
    """The unit of a result: equal where one axis may show both.

    Examples
    --------
    >>> [_unit(name) for name in ("buckling_pressure_Pa", "tip_uz_mm", "w_mm", "knockdown", "w_over_h", "hertz_2")]
    ['Pa', 'mm', 'mm', 'load', 'h', 'Hz']
    """
    if found := re.fullmatch(r"(omega2|hertz)_\d+", result):
        return {"omega2": "omega2", "hertz": "Hz"}[found[1]]
    if given := _in_units(result):
        return given[1]
    own = {"critical_field": quantity("lambda_m").scale, "barrier": quantity("energy").scale, "shape": "shape"}
    return own.get(result) or quantity(result).scale


def _in_units(result: str) -> tuple[str, str] | None:
    """The name of a result in a unit without its ending, and the unit; the longest ending first: N_m before m."""
    units = endings()
    for ending in sorted(units, key=len, reverse=True):
        if result.endswith(f"_{ending}"):
            return result.removesuffix(f"_{ending}"), units[ending]
    return None


def _name(result: str) -> str:
    """A result in words or symbols, without its unit.

    Examples
    --------
    >>> _name("tip_fz"), _name("omega2_1"), _name("hertz_2"), _name("knockdown"), _name("tip_uz_mm")
    ('tip $f_z$', '$\\\\omega_{1}^2 \\\\rho R^2/E$', 'frequency 2', 'knockdown', 'tip $u_z$')
    """
    if result == "shape":
        return "mean square distance over $R^2$"
    if found := re.fullmatch(r"omega2_(\d+)", result):
        return rf"$\omega_{{{found[1]}}}^2 \rho R^2/E$"
    if found := re.fullmatch(r"hertz_(\d+)", result):
        return f"frequency {found[1]}"
    result = given[0] if (given := _in_units(result)) else result
    if found := re.fullmatch(r"(.+)_([fu])([xyz])", result):
        return f"{found[1].replace('_', ' ')} ${found[2]}_{found[3]}$"
    return result.replace("_", " ")


def _draw_field(axes: Any, field: Between, values: Array) -> None:
    """The values at the points: along a meridian or a strip as lines, else as colours from above."""
    places, title = field.controls.places, TITLES[field.name]
    if field.controls.around or not places[:, 1:].any():
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
        for number, (line, marker) in enumerate(zip(values.T, ("o-", "s--"), strict=False), 1):
            axes.plot(along, line, marker, markersize=3, linewidth=1, label=rf"$\kappa_{{{number}{number}}}$")
        axes.set(
            xlabel="arc length over $R$", ylabel=title, ylim=[v + w for v, w in zip(field.bounds, MARGINS, strict=True)]
        )
        if values.shape[1] > 1:
            axes.legend(frameon=False, fontsize=8)
    else:
        shown = axes.scatter(*places[:, :2].T, c=values[:, 0], vmin=field.bounds[0], vmax=field.bounds[1], s=14)
        axes.figure.colorbar(shown, ax=axes, label=title)
        axes.set(xlabel="$x/R$", ylabel="$y/R$", aspect="equal")
