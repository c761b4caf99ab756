"""design.png: the results over the evaluations, the remanence, and the fields that vary."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.studies.design.between import Between
from magshell_fenicsx.studies.design.variables import Variables

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

    panels = 1 + (vary.controls is not None) + len(vary.fields)
    figure = Figure(figsize=(4.6 * panels, 3.8), dpi=160, layout="constrained")
    history, *others = figure.subplots(1, panels, squeeze=False)[0]
    number = np.array([row["evaluation"] for row in rows])
    for result in results:
        values = np.array([np.nan if row[result] is None else row[result] for row in rows], dtype=float)
        name = _name(result)
        (line,) = history.plot(number, values, "-", linewidth=0.8, label=name)
        best = np.array([row["best"] for row in rows], dtype=bool)
        history.plot(number[best], values[best], "o", markersize=3, color=line.get_color())
        if result == "shape":
            history.set_yscale("log")
    history.set(xlabel="evaluation (dots: the best so far)")
    if len(results) == 1:
        history.set_ylabel(name)
    else:
        history.legend(frameon=False, fontsize=8)
    if vary.controls is not None:
        places, vectors = vary.controls.places, vary.vectors(x)
        names = (r"\rho", "z") if vary.controls.around else ("x", "y", "z")
        widest = np.argsort(-np.ptp(places, axis=0), kind="stable")[:2]
        first, second = (0, len(names) - 1) if vary.planar else sorted(int(i) for i in widest)
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


def _name(result: str) -> str:
    """A result in words or symbols.

    Examples
    --------
    >>> _name("tip_fz"), _name("omega2_1"), _name("hertz_2"), _name("knockdown")
    ('tip $f_z$', '$\\\\omega_{1}^2 \\\\rho R^2/E$', 'frequency 2 (Hz)', 'knockdown')
    """
    if result == "shape":
        return "mean square distance over $R^2$"
    if found := re.fullmatch(r"omega2_(\d+)", result):
        return rf"$\omega_{{{found[1]}}}^2 \rho R^2/E$"
    if found := re.fullmatch(r"hertz_(\d+)", result):
        return f"frequency {found[1]} (Hz)"
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
