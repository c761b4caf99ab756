"""design.png: results over the evaluations, the wanted shape, the remanence and varying fields.

A design varies p variables (`vary`) that stand for numbers of the case, the remanence (vectors at
control points) and scalar fields at control points. Rows are those of design.csv, one for each
evaluation. A target is a map from undeformed to wanted places. Places are over R. On a meridian
they are (rho, z).
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.vtu import read_point
from magshell_fenicsx.output.pictures.picture import edge_lines, spread_points
from magshell_fenicsx.output.pictures.scales import number_format
from magshell_fenicsx.quantities.registry import amplitude, endings, quantity
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS
from magshell_fenicsx.studies.design.blocks import ControlPointField
from magshell_fenicsx.studies.design.variables import Variables
from magshell_fenicsx.studies.figures import (
    PANEL_HEIGHT,
    PANEL_WIDTH,
    add_legend,
    lengths_along_line,
    saved_figure,
)
from magshell_fenicsx.studies.naming import result_words, split_unit

Array = NDArray[np.float64]

TITLES = {
    "thickness": "thickness over $h$",
    "curvature": r"natural curvature $\kappa R$",
    "deviation": "deviation $w_0/h$",
}
ARROW = 0.12  # the longest vector over the shell's extent
MIN_ARROW_DISTANCE = 0.07  # over the shell's extent, of the feet of arrows
HISTORY_STYLES = ("-", (0, (4, 2)), (0, (2, 2)), (0, (1, 2)))  # of the lines of several results
IN_PLANE = 1e-6  # over R
MARGINS = (-0.03, 0.03)  # beyond the bounds


@dataclass(frozen=True)
class ReachedShape:
    """The shape that a run has reached, along the middle of the shell (y = 0), over R.

    Attributes
    ----------
    target
        (n, 3) wanted places; None if no shape is wanted.
    points, undeformed
        (n, 3) reached and undeformed places.
    edges
        (m, 3) lines of the undeformed shell's edges, with nan between them.
    """

    target: Array | None
    points: Array
    undeformed: Array
    edges: Array


def reached_shape(folder: Path, target: Callable[[Array], Array] | None) -> ReachedShape | None:
    """Return the shape at the last stored point of a run; None if no point is stored.

    It has the nodes of the shell nearest to the plane y = 0, in the order of x.

    Parameters
    ----------
    folder
        Folder of the run, with the subfolder fields/.
    target
        Map from undeformed places (n, 3) over R to wanted places; None without.
    """
    numbers = sorted(
        int(file.stem.removeprefix("point_")) for file in (folder / "fields").glob("point_*.vtu")
    )
    if not numbers:
        return None
    surface, _ = read_point(folder / "fields", numbers[-1])
    distance_from_plane = np.abs(surface.r0[:, 1])
    # the nodes nearest to the plane y = 0, by rising x
    points_in_plane = np.flatnonzero(distance_from_plane <= distance_from_plane.min() + IN_PLANE)
    points_in_plane = points_in_plane[np.argsort(surface.r0[points_in_plane, 0], kind="stable")]
    undeformed = surface.r0[points_in_plane]
    return ReachedShape(
        target=target(undeformed) if target else None,
        points=(surface.r0 + surface.u)[points_in_plane],
        undeformed=undeformed,
        edges=edge_lines(replace(surface, u=0 * surface.u)),
    )


def draw_design(
    rows: Sequence[dict[str, Any]],
    results: Sequence[str],
    vary: Variables,
    x: Array,
    file: Path,
    target_values: Mapping[str, float] | None = None,
    shape: ReachedShape | None = None,
) -> None:
    """Draw the history of the results, the reached shape, the remanence and the fields of a design.

    Parameters
    ----------
    rows
        Rows of design.csv.
    results
        Names of the results that are drawn.
    vary, x
        The design variables, and their best values (p,).
    file
        Name of the picture file.
    target_values
        Result -> the wanted value.
    shape
        The reached shape; None if it is not known.
    """
    units = dict.fromkeys(map(_unit, results))  # each once, in order: an axis for each
    # panels of the results, the wanted shape, the remanence and each field
    panels = (
        1
        + (shape is not None and shape.target is not None)
        + (vary.controls is not None)
        + len(vary.fields)
    )
    height = max(PANEL_HEIGHT, 1.7 * len(units))
    with saved_figure(file, PANEL_WIDTH * panels, height, dpi=160) as figure:
        grid = figure.add_gridspec(len(units), panels)
        previous_axes: Any = None
        for i, unit in enumerate(units):
            previous_axes = figure.add_subplot(grid[i, 0], sharex=previous_axes)
            _draw_history(
                previous_axes,
                rows,
                [result for result in results if _unit(result) == unit],
                unit,
                target_values or {},
            )
            previous_axes.tick_params(labelbottom=i == len(units) - 1)
        previous_axes.set_xlabel("evaluation (line: the best so far)")
        previous_axes.xaxis.get_major_locator().set_params(integer=True)
        further_axes = [figure.add_subplot(grid[:, i]) for i in range(1, panels)]
        if shape is not None and shape.target is not None:
            _draw_shape(further_axes.pop(0), shape, shape.target)
        if vary.controls and vary.remanence:
            _draw_remanence(further_axes[0], vary, x, shape)
        # the last panels are those of the fields
        for axes, field in zip(
            further_axes[len(further_axes) - len(vary.fields) :], vary.fields, strict=True
        ):
            _draw_field(axes, field, field.values(x[vary.blocks[field.name]]))


def _draw_history(
    axes: Any,
    rows: Sequence[dict[str, Any]],
    results: Sequence[str],
    unit: str,
    target_values: Mapping[str, float],
) -> None:
    """Draw results of one unit over the evaluations.

    All tried values are faint dots; the best so far is a line.

    Parameters
    ----------
    rows
        Rows of design.csv.
    results
        Names of the results of this unit.
    target_values
        Result -> the wanted value, a dotted line.
    """
    # numbers of the evaluations, and whether each was the best so far
    number = np.array([row["evaluation"] for row in rows], dtype=int)
    best = np.array([row["best"] for row in rows], dtype=bool)
    axes.xaxis.get_major_locator().set_params(integer=True)
    for i, result in enumerate(results):
        values = np.array(
            [np.nan if row[result] is None else row[result] for row in rows], dtype=float
        )
        # the first line is solid and wider, so that lines that lie on each other are all seen
        colour, line_style = f"C{i}", HISTORY_STYLES[i % len(HISTORY_STYLES)]
        axes.plot(number, values, "o", color=colour, markersize=4, alpha=0.4, markeredgewidth=0)
        # the line of the best goes on to the last evaluation
        evaluation_numbers = np.append(number[best], number[-1:] if best.any() else [])
        best_values = np.append(values[best], values[best][-1:])
        axes.plot(
            evaluation_numbers,
            best_values,
            linestyle=line_style,
            drawstyle="steps-post",
            color=colour,
            linewidth=1.2 if i or len(results) == 1 else 2.0,
            label=result_words(result),
        )
        if result in target_values:
            axes.axhline(target_values[result], color=colour, linestyle=":", linewidth=1)
        if result == "shape":
            axes.set_yscale("log")
    if axes.get_yscale() == "linear":
        axes.yaxis.set_major_formatter(number_format())
    # the name of a single result is at the axis; of several the legend has the names. A scale that
    # is no unit, such as "h", is not written
    unit_text = unit if unit in {"Hz", *endings().values()} else ""
    if len(results) == 1:
        axes.set_ylabel(result_words(results[0]) + (f"  ({unit_text})" if unit_text else ""))
    else:
        axes.set_ylabel(unit_text or _common([result_words(result) for result in results]))
    if len(results) > 1:
        add_legend(axes)


def _common(words: Sequence[str]) -> str:
    """Return the common words of results of several points, which stand before the points' names.

    Examples
    --------
    >>> _common(["$f_z$ of east", "$f_z$ of west"]), _common(["mass", "knockdown"])
    ('$f_z$', 'results')
    """
    # what stands before " of "; "" if there is no " of "
    first_words = {text.rpartition(" of ")[0] for text in words}
    if len(first_words) != 1:
        return "results"
    return first_words.pop() or "results"


def _draw_shape(axes: Any, shape: ReachedShape, target_points: Array) -> None:
    """Draw the wanted and the reached shape from the side, z over x."""
    axes.plot(*shape.undeformed[:, ::2].T, "--", color="0.6", linewidth=0.8, label="undeformed")
    axes.plot(*target_points[:, ::2].T, color="C1", linewidth=3.5, alpha=0.5, label="wanted")
    axes.plot(*shape.points[:, ::2].T, color="C0", linewidth=1.3, label="reached")
    axes.set(xlabel="$x/R$", ylabel="$z/R$", title="along the middle, $y = 0$")
    axes.set_aspect("equal", adjustable="datalim")
    add_legend(axes)


def _draw_remanence(axes: Any, vary: Variables, x: Array, shape: ReachedShape | None) -> None:
    """Draw the vectors of the remanence at their places on the undeformed shell, with its edges.

    They are drawn in the plane in which the points extend most.

    Parameters
    ----------
    x
        Design variables (p,).
    shape
        Has the edges of the shell; None: no edges.
    """
    assert vary.controls
    places, vectors = vary.controls.places, vary.vectors(x)
    names = (r"\rho", "z") if vary.controls.is_axisymmetric else ("x", "y", "z")
    widest = np.argsort(-np.ptp(places, axis=0), kind="stable")[:2]
    planar = vary.remanence is not None and vary.remanence.planar
    # components on both axes of the picture; planar vectors lie in the plane of x (or rho) and z
    first, second = (0, len(names) - 1) if planar else sorted(int(i) for i in widest)
    horizontal, up = places[:, first], places[:, second]
    # points along a meridian or a strip are joined by a line
    line_style = "-" if vary.controls.is_axisymmetric or not places[:, 1:].any() else ""
    axes.plot(horizontal, up, line_style + ".", color="0.6", markersize=3, linewidth=1)
    if shape is not None and not vary.controls.is_axisymmetric:
        axes.plot(*shape.edges[:, [first, second]].T, color="0.6", linewidth=0.8)
    # arrows as long as a part of the shell's extent, drawn in the units of the places. Where points
    # are dense, on a surface, some have no arrow
    longest = float(np.hypot(vectors[:, first], vectors[:, second]).max()) or 1.0
    extent = float(np.ptp(places, axis=0).max())
    arrow_scale = ARROW * extent / longest
    right, vertical = arrow_scale * vectors[:, first], arrow_scale * vectors[:, second]
    min_distance = 0.0 if line_style else MIN_ARROW_DISTANCE * extent
    points_with_arrows = spread_points(places, min_distance) if min_distance else slice(None)
    axes.quiver(
        horizontal[points_with_arrows],
        up[points_with_arrows],
        right[points_with_arrows],
        vertical[points_with_arrows],
        color="C3",
        width=0.006,
        angles="xy",
        scale_units="xy",
        scale=1,
    )
    axes.update_datalim(np.column_stack([horizontal + right, up + vertical]))  # tips of arrows
    axes.set(xlabel=f"${names[first]}/R$", ylabel=f"${names[second]}/R$")
    axes.set_title(r"remanence over $|B^\mathrm{r}|$, undeformed")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    axes.autoscale_view()


def _unit(result: str) -> str:
    """Return the unit of a result; results with the same unit may share an axis.

    Examples
    --------
    >>> [_unit(name) for name in ("buckling_pressure_Pa", "tip_uz_mm", "w_mm")]
    ['Pa', 'mm', 'mm']
    >>> [_unit(name) for name in ("knockdown", "w_over_h", "hertz_2")]
    ['load', 'h', 'Hz']
    """
    if matched := re.fullmatch(r"(omega2|hertz)_\d+", result):
        return {"omega2": "omega2", "hertz": "Hz"}[matched[1]]
    if result_and_unit := split_unit(result):
        return result_and_unit[1]
    # dimensionless results: what they are scaled with stands for a unit
    own_units = {
        "critical_field": quantity(amplitude(FOLDS["critical_field"]).column).scale,
        "barrier": quantity("energy").scale,
        "shape": "shape",
    }
    return own_units.get(result) or quantity(result).scale


def _draw_field(axes: Any, field: ControlPointField, values: Array) -> None:
    """Draw a scalar field at its control points.

    Along a meridian or strip it is a line for each component, else colours seen from above.

    Parameters
    ----------
    values
        (n, components) values at the control points.
    """
    places, title = field.controls.places, TITLES[field.name]
    arc_length = lengths_along_line(places)
    if arc_length is not None:  # a meridian, or a strip along x
        # only a curvature has two components, 11 and 22, which the legend names
        for number, (line, marker) in enumerate(zip(values.T, ("o-", "s--"), strict=False), 1):
            axes.plot(
                arc_length,
                line,
                marker,
                markersize=3,
                linewidth=1,
                label=rf"$\kappa_{{{number}{number}}}$",
            )
        axes.set(
            xlabel="arc length over $R$",
            ylabel=title,
            ylim=[v + w for v, w in zip(field.bounds, MARGINS, strict=True)],
        )
        if values.shape[1] > 1:
            add_legend(axes)
    else:
        points = axes.scatter(
            *places[:, :2].T, c=values[:, 0], vmin=field.bounds[0], vmax=field.bounds[1], s=14
        )
        axes.figure.colorbar(points, ax=axes, label=title)
        axes.set(xlabel="$x/R$", ylabel="$y/R$", aspect="equal")
