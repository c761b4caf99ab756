"""The picture of a boundary of stability: load over key, with the names of the regions.

A boundary is a curve of instabilities in the plane of a key of the case and a load. Regions are the
parts of the plane beside it ("stable", "snaps", "buckles", "bistable"). A map has a boundary for
each value of a second key (`second`). Rows are those of boundary.csv: key, load, kind, mode, and
the number of other unstable directions. At a crossing another mode comes first, and takes over the
boundary. The arms are the two folds that begin at a cusp.
"""

from collections.abc import Mapping, Sequence
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from magshell_fenicsx.output.pictures.lines import smooth
from magshell_fenicsx.quantities.mode_labels import WAVES
from magshell_fenicsx.quantities.registry import amplitude, quantity, shown_quantity
from magshell_fenicsx.studies.figures import add_legend, saved_figure
from magshell_fenicsx.studies.naming import key_label

MARKS = {"cusp": "o", "turn": "s", "meeting": "D", "crossing": "X"}
WORDS = {
    "cusp": "cusp",
    "turn": "turning point",
    "meeting": "second mode neutral",
    "crossing": "another mode comes first",
}
LEGEND: Mapping[str, Any] = {
    "frameon": False,
    "fontsize": 8,
    "loc": "upper left",
    "bbox_to_anchor": (1.0, 1.0),
}
# over the range of the key: in a narrower region only its mode is written; names whose middles are
# nearer are in two rows, of which each has its distance from the limit of the axis, over the axis
NARROW, NEAR, ROWS = 0.25, 0.2, (0.05, 0.12)
MIN_CONTOURED, LEVELS = 3, 8  # values of the second key, and levels of contours
Row = Mapping[str, Any]


def draw_boundary(rows: Sequence[Row], content: Mapping[str, Any], file: Path) -> None:
    """Draw the boundary, dashed where other modes are unstable already, and name what it divides.

    Parameters
    ----------
    rows, content
        Rows of boundary.csv, and the content of boundary.json.
    file
        Name of the picture file.
    """
    rows, label = _in_units(rows, content["load"])
    with saved_figure(file, 6.4, 4.4) as figure:
        plot = figure.subplots()
        # the boundary has a corner where two bifurcations cross: each mode has a smooth line
        mode_parts = [part for _, part in _by_mode(rows)]
        for smooth_part in mode_parts:
            _dashed_line(plot, smooth_part)
        plot.margins(y=0.3 if len(mode_parts) > 1 else None)
        _marks(plot, "load", rows)
        for x, y, region_name in _regions(rows, content, plot.get_ylim()):
            plot.annotate(region_name, (x, y), ha="center", va="center", color="0.35")
        _shade_between_folds(plot, rows)
        plot.set(
            xlabel=key_label(content["key"], content["unit"]), ylabel=label, title=_title(content)
        )
        add_legend(plot)


def _shade_between_folds(plot: Any, rows: Sequence[Row]) -> None:
    """Shade the region between the two folds that begin at a cusp, if there is one."""
    arms = _arms(rows)
    if arms:
        first_arm, second_arm = arms
        # along one arm and back along the other, for x and for y
        x, y = (
            np.concatenate([along, back[::-1]])
            for along, back in zip(_smoothed(first_arm), _smoothed(second_arm), strict=True)
        )
        plot.fill(x, y, color="C0", alpha=0.12, linewidth=0)


def _dashed_line(plot: Any, rows: Sequence[Row]) -> None:
    """Draw the boundary of one mode, dashed where other modes are unstable."""
    # intervals between neighbouring points, dashed if an end has other unstable modes
    intervals_by_style = groupby(
        pairwise(rows), key=lambda ends: bool(ends[0]["unstable"] or ends[1]["unstable"])
    )
    # one line joins the neighbouring intervals of one style
    for unstable, group in intervals_by_style:
        intervals = [*group]
        first_end, _ = intervals[0]
        line = [first_end, *(second_end for _, second_end in intervals)]
        _line(plot, line, color="C0", linestyle="--" if unstable else "-")


def draw_map(rows: Sequence[Row], content: Mapping[str, Any], file: Path) -> None:
    """Draw the boundaries over their own key, a line for each value of the second key.

    A second panel has cusps and other special points in the plane of both keys.

    Parameters
    ----------
    rows, content
        Rows of boundary.csv, and the content of map.json.
    file
        Name of the picture file.
    """
    from matplotlib import colormaps
    from matplotlib.colors import Normalize

    rows, label = _in_units(rows, content["load"])
    # at some second values another load may lead to the instability
    rows_of_other_loads = [row for row in rows if row["amplitude"] != content["load"]]
    values_without_boundary = sorted(set(content["values"]) - {row["second"] for row in rows})
    # the second panel, if there is something to show in it
    has_special_rows = bool(rows_of_other_loads) or any(row["kind"] in MARKS for row in rows)
    with_plane = has_special_rows or bool(values_without_boundary)
    names = [
        key_label(key, unit) for key, unit in zip(content["keys"], content["units"], strict=True)
    ]
    with saved_figure(file, 10.2 if with_plane else 6.4, 4.4) as figure:
        plots = figure.subplots(1, 1 + with_plane, squeeze=False)
        plot, plane = plots[0, 0], plots[0, -1]
        # a line for each second value, coloured by the value, unless another load leads there
        shade = Normalize(min(content["values"]), max(content["values"]))
        for value in sorted({row["second"] for row in rows}, reverse=True):
            line = [row for row in rows if row["second"] == value]
            if line[0] not in rows_of_other_loads:
                text = f"{value:g}".replace("-", "−")
                colour = colormaps["viridis"](0.9 * shade(value))
                _line(plot, line, color=colour, marked=True, label=text)
        _marks(plot, "load", [row for row in rows if row not in rows_of_other_loads])
        plot.set(xlabel=names[0], ylabel=label, title=_title(content))
        plot.legend(**LEGEND, title=names[1], title_fontsize=8)
        if with_plane:
            _plane(plane, rows, content, values_without_boundary)
            title = f"{quantity(amplitude(content['load']).column).words} at the instability"
            plane.set(xlabel=names[0], ylabel=names[1], title=title)
            plane.legend(**LEGEND)


def _in_units(rows: Sequence[Row], load: str) -> tuple[list[Row], str]:
    """Return rows whose load is in the case's units if they have it, and the label of its axis."""
    # the column of the load in units if the rows have it, else the one without
    column_names = {name for row in rows for name in row}
    load_quantity = shown_quantity(amplitude(load).column, column_names)
    rows_in_units: list[Row] = [
        {**row, "load": row.get(load_quantity.name, row["load"])} for row in rows
    ]
    return rows_in_units, load_quantity.label


def _plane(
    plane: Any, rows: Sequence[Row], content: Mapping[str, Any], empty: Sequence[float]
) -> None:
    """Draw the load of the instability in the plane of both keys.

    Contours join points of equal load, where three second values or more have a boundary; of fewer
    each has a line. Other lines are second values at which another load leads to the instability,
    dotted ones those without an instability.

    Parameters
    ----------
    plane
        Axes of the picture.
    empty
        Values of the second key without a boundary.
    """
    load_words = set[str]()
    has_contours = _load_contours(plane, rows, content)

    def draw(x: Sequence[float], value: float, words: str, **style: Any) -> None:
        """Draw a line at a value of the second key; each text is in the legend once."""
        plane.plot(
            [min(x), max(x)], [value] * 2, label="" if words in load_words else words, **style
        )
        load_words.add(words)

    for value, group in groupby(rows, key=lambda row: float(row["second"])):
        line = [*group]
        load_quantity = quantity(amplitude(line[0]["amplitude"]).column).words
        # another colour where another load leads to the instability
        is_main_load = line[0]["amplitude"] == content["load"]
        if is_main_load and has_contours:
            plane.plot([row["key"] for row in line], [value] * len(line), ".", color="0.5", ms=2)
            continue
        colour = "C0" if is_main_load else "C1"
        draw([row["key"] for row in line], value, f"by the {load_quantity}", color=colour, lw=2)
    for value in empty:
        draw(content["range"], value, "nowhere", color="0.5", ls=":")
    _marks(plane, "second", rows)


def _load_contours(plane: Any, rows: Sequence[Row], content: Mapping[str, Any]) -> bool:
    """Draw contours of the load over both keys; return whether there are enough points for them."""
    from matplotlib.tri import Triangulation

    points = [row for row in rows if row["amplitude"] == content["load"]]
    x, y, load = (
        np.array([row[name] for row in points], float) for name in ("key", "second", "load")
    )
    if len(set(y)) < MIN_CONTOURED or not np.ptp(x) or not np.ptp(load):
        return False
    # triangles between points, in axes of equal extents
    triangles = Triangulation(x / np.ptp(x), y / np.ptp(y)).triangles
    filled = plane.tricontourf(x, y, triangles, load, levels=LEVELS, cmap="viridis", alpha=0.6)
    lines = plane.tricontour(
        x, y, triangles, load, levels=filled.levels, colors="0.2", linewidths=0.8
    )
    plane.clabel(lines, fontsize=8)
    return True


def _marks(plot: Any, upwards: str, rows: Sequence[Row]) -> None:
    """Draw marks at cusps, turning points and second modes.

    Parameters
    ----------
    upwards
        Column of the vertical axis.
    """
    for kind, mark in MARKS.items():
        places = [(row["key"], row[upwards]) for row in rows if row["kind"] == kind]
        if places:
            plot.plot(*zip(*places, strict=True), mark, color="C3", label=WORDS[kind], zorder=5)


def _line(plot: Any, rows: Sequence[Row], marked: bool = False, **style: Any) -> None:
    """Draw a smooth line through the points of a boundary, if wanted with a dot at each point."""
    x, y = _smoothed(
        [(row["key"], row["load"]) for row in rows], [row["kind"] in MARKS for row in rows]
    )
    plot.plot(x, y, **style)
    if marked:
        plot.plot(
            *zip(*[(row["key"], row["load"]) for row in rows], strict=True),
            ".",
            ms=4,
            color=style["color"],
        )


def _smoothed(places: Sequence[tuple[float, float]], located: Sequence[bool] = ()) -> Any:
    """Return x and y of a smooth curve through places (x, y).

    Parameters
    ----------
    located
        Whether each place is a special point, such as a cusp; a curve that turns there turns
        exactly at it.
    """
    x, y = zip(*places, strict=True)
    return smooth(x, y, located)


def _title(content: Mapping[str, Any]) -> str:
    """Return the settings of the case."""
    return ", ".join(content.get("settings", ()))


def _arms(
    rows: Sequence[Row],
) -> tuple[list[tuple[float, float]], list[tuple[float, float]]] | None:
    """Return the two folds that begin at the first cusp, each as places (key, load).

    None if there is no cusp.
    """
    cusp_number = next((i for i, row in enumerate(rows) if row["kind"] == "cusp"), None)
    if cusp_number is None:
        return None
    # from the cusp back to the first row, and on to the last one
    return _places(rows[cusp_number::-1]), _places(rows[cusp_number:])


def _places(rows: Sequence[Row]) -> list[tuple[float, float]]:
    """Return the places (key, load) of rows."""
    return [(row["key"], row["load"]) for row in rows]


def _regions(
    rows: Sequence[Row], content: Mapping[str, Any], limits: tuple[float, float]
) -> list[tuple[Any, ...]]:
    """Return the regions beside a boundary, each as key, load and name.

    Beyond a boundary of several modes each mode has its own region. A bifurcation after other
    instabilities divides nothing that is stable, so it is left out.

    Parameters
    ----------
    limits
        Lower and upper limit of the load's axis.
    """
    rows = [row for row in rows if not row["unstable"]] or rows
    mode_parts, all_regions = _by_mode(rows), _regions_of_mode(rows, content, limits)
    if len(mode_parts) < 2:
        return all_regions
    # the stable regions of the whole boundary, and the region beyond each mode's part of it
    extent = np.ptp([row["key"] for row in rows])
    regions = [(x, y, words) for x, y, words in all_regions if words == "stable"]
    last_x, row_number = -np.inf, 0
    for mode, part in mode_parts:
        kind = next(
            (row["kind"] for row in part if row["kind"] in ("fold", "bifurcation")), content["kind"]
        )
        regions_of_part = _regions_of_mode(part, {**content, "kind": kind, "mode": mode}, limits)
        if not regions_of_part:
            continue
        x, y, words = regions_of_part[0]  # the first one is beyond the boundary
        width = np.ptp([row["key"] for row in part]) / extent
        # near to the limit of the axis no name lies on the boundary; neighbours that are narrow
        # are in two rows
        outer, inner = limits if y < 0 else limits[::-1]
        is_near = abs(x - last_x) < NEAR * extent
        row_number = 1 - row_number if is_near else 0
        last_x = x
        y = outer + (ROWS[row_number]) * (inner - outer)
        regions.append((x, y, mode if width < NARROW and mode else words))
    return regions


def _regions_of_mode(
    rows: Sequence[Row], content: Mapping[str, Any], limits: tuple[float, float]
) -> list[tuple[Any, ...]]:
    """Return the regions beside a boundary of one mode, each as key, load and name.

    They are above and below the middle of the boundary, and between its arms. The first one is
    beyond the boundary: on its side away from load zero.

    Parameters
    ----------
    limits
        Lower and upper limit of the load's axis.
    """
    instability_words = (
        "snaps" if content["kind"] == "fold" else f"buckles {_mode(content['mode'])}".rstrip()
    )
    x = float(np.mean([min(row["key"] for row in rows), max(row["key"] for row in rows)]))
    # loads of the boundary at the middle of its range of keys, several if it turns back; linear
    # between neighbouring rows
    loads_at_middle = sorted(
        row["load"]
        + (x - row["key"]) / (next_row["key"] - row["key"]) * (next_row["load"] - row["load"])
        for row, next_row in pairwise(rows)
        if (row["key"] - x) * (next_row["key"] - x) <= 0 and row["key"] != next_row["key"]
    )
    if not loads_at_middle:
        return []
    # limits of the axis: the outer one is away from load zero, which is up for positive loads and
    # down for negative ones
    least_load, largest_load = loads_at_middle[0], loads_at_middle[-1]
    if np.mean(loads_at_middle) > 0:
        inner, outer = limits
        innermost_load, outermost_load = least_load, largest_load
    else:
        outer, inner = limits
        outermost_load, innermost_load = least_load, largest_load
    regions = [
        (x, (outermost_load + outer) / 2, instability_words),
        (x, (innermost_load + inner) / 2, "stable"),
    ]
    if len(loads_at_middle) > 1:
        middle_words = "bistable" if content["kind"] == "fold" else instability_words
        regions.append((x, (least_load + largest_load) / 2, middle_words))
        # beyond the second bifurcation the shell is stable again
        if content["kind"] != "fold":
            regions[0] = (x, (outermost_load + outer) / 2, "stable")
    return regions


def _by_mode(rows: Sequence[Row]) -> list[tuple[str, list[Row]]]:
    """Return the modes along the boundary, each with its rows and the crossings at their ends."""
    crossing_numbers = [i for i, row in enumerate(rows) if row["kind"] == "crossing"]
    parts = list[tuple[str, list[Row]]]()
    # a crossing belongs to the parts on both sides
    for begin, end in pairwise([0, *crossing_numbers, len(rows) - 1]):
        row_group = [*rows[begin : end + 1]]
        # the mode of a part is that of its first row that is no crossing
        mode = next((row["mode"] for row in row_group if row["kind"] != "crossing"), None)
        if mode is not None:  # a part of crossings alone has no mode
            parts.append((mode, row_group))
    return parts


def _mode(mode: str) -> str:
    """Return the words "with m = ..." for a mode of waves around a meridian, else ""."""
    return f"with {mode}" if mode.startswith(WAVES) else ""
