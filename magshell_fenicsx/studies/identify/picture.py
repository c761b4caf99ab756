"""The pictures of an identification: data and predictions with their bands, and the parameters.

A place is the load or displacement at which a result was measured. A measured shape is a set of
points with their displacements. A programme is another history that is predicted with the fit. The
band of a value has it with 95 % probability; a measured value has a wider one than the curve, by
the noise. `plot` is always matplotlib's axes.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.studies.figures import (
    PANEL_HEIGHT,
    PANEL_WIDTH,
    add_legend,
    lengths_along_line,
    saved_figure,
)
from magshell_fenicsx.studies.identify.data import OF_POINTS
from magshell_fenicsx.studies.naming import key_words, result_label, split_unit

Row = Mapping[str, Any]
Array = NDArray[np.float64]
POINT = re.compile(rf"{OF_POINTS}\d+")
AXES = {"bx": "x", "by": "y", "bz": "z", "b_rho": r"\rho", "b_z": "z"}


def draw_identified(
    content: Mapping[str, Any], curves: Mapping[str, Sequence[tuple[float, float]]], file: Path
) -> None:
    """Draw the data with their fit, a measured shape, a remanence field, and the parameters.

    Each column of the data, each component of the field, the shape and the parameters have a panel.

    Parameters
    ----------
    content
        As in identify.json.
    curves
        Result -> places and values along the path.
    file
        Name of the picture file.
    """
    # functions that draw a panel each, called with its axes
    panels = list[Callable[[Any], None]]()
    rows, shape, field = content["rows"], content["shape"], content["remanence"]
    shape_rows = [row for row in rows if row["result"].startswith(OF_POINTS)]
    # a shape in one direction only is drawn as data
    if len({row["column"] for row in shape_rows}) > 1:
        panels.append(partial(_shape, rows=shape_rows, shape=shape))
        rows = [row for row in rows if not row["result"].startswith(OF_POINTS)]
    sorted_rows = sorted(rows, key=lambda row: str(row["column"]))
    # a panel for each column of the data
    for _, column_rows in groupby(sorted_rows, key=lambda row: str(row["column"])):
        column = list(column_rows)
        # a result of a measured point has the name of its column instead
        result = column[0]["result"].partition(OF_POINTS)[0] or column[0]["column"]
        panels.append(
            partial(
                _data, result=result, rows=column, curve=curves.get(result, ()), content=content
            )
        )
    if field:
        panels += [partial(_field, field=field, number=i) for i in range(len(field["components"]))]
    if content["parameters"]:
        panels.append(partial(_parameters, parameters=content["parameters"]))
    with saved_figure(file, PANEL_WIDTH * len(panels), PANEL_HEIGHT) as figure:
        plots = figure.subplots(1, len(panels), squeeze=False)[0]
        for plot, panel in zip(plots, panels, strict=True):
            panel(plot)


def _shape(plot: Any, rows: Sequence[Row], shape: Mapping[str, Sequence[float]]) -> None:
    """Draw measured and fitted places of a shape, in the two directions in which most of them move.

    Parameters
    ----------
    rows
        Rows of identify.csv for the displacements of the shape.
    shape
        Name of a point -> its undeformed coordinates (x, y, z).
    """
    # column of a displacement ("ux") -> the largest one; the two largest span the picture
    largest_by_axis = dict[str, float]()
    for row in rows:
        largest_by_axis[row["column"]] = max(
            largest_by_axis.get(row["column"], 0.0), abs(row["measured"])
        )
    plane_axes = sorted(sorted(largest_by_axis, key=lambda name: -largest_by_axis[name])[:2])
    has_labels = False
    # one shape for each state of the shell; the legend names the first one alone
    states = groupby(sorted(rows, key=_state_of), key=_state_of)
    rows_of_states = [(state, [*rows_of_state]) for state, rows_of_state in states]
    for state, rows_of_shape in rows_of_states:
        rows_by_point = _rows_by_point(rows_of_shape)
        rows_of_axes = [rows_by_point.get(axis, {}) for axis in plane_axes]
        # the points that have both displacements
        common_points = set(shape).intersection(*rows_of_axes)
        points = [name for name in shape if name in common_points]
        # undeformed coordinates of the points along both axes
        coordinates = [_coordinates(shape, points, axis) for axis in plane_axes]
        for kind, style, colour in (("predicted", "-", "C0"), ("measured", ".", "C1")):
            u = [_displacements(rows_of_axis, points, kind) for rows_of_axis in rows_of_axes]
            label = "" if has_labels else "fitted" if kind == "predicted" else kind
            point_style = style if _in_line(coordinates) else "."
            plot.plot(
                *(np.array(coordinates) + np.array(u)),
                point_style,
                color=colour,
                label=label,
                zorder=4,
                lw=1.2,
            )
        has_labels = True
        if len(rows_of_states) > 1:  # the last one of the drawn curves is that of the measurement
            _name_end(plot, np.array(coordinates) + np.array(u), _state_words(state))
    # the undeformed places, once
    plot.plot(
        *coordinates,
        "--" if _in_line(coordinates) else ".",
        color="0.6",
        lw=0.8,
        label="undeformed",
        zorder=1,
    )
    unit = split_unit(rows[0]["result"])
    labels = [f"${axis[1]}$" + (f"  ({unit[1]})" if unit else "") for axis in plane_axes]
    plot.set(xlabel=labels[0], ylabel=labels[1])
    plot.set_aspect("equal", adjustable="datalim")
    plot.locator_params(nbins=5)
    add_legend(plot)


def _name_end(plot: Any, curve: Array, words: str) -> None:
    """Write words at the last point of a curve (2, n): to its right, or above it if it ends low.

    A curve that ends in the upper half of what is drawn so far leaves room to its right.
    """
    (x, y), (_, (low, high)) = curve[:, -1], (plot.get_xlim(), plot.get_ylim())
    is_high = y > (low + high) / 2
    plot.annotate(
        words.replace(" of ", "\nof "),
        (x, y),
        (6, 0) if is_high else (0, 14),
        textcoords="offset points",
        ha="left" if is_high else "right",
        va="top" if is_high else "bottom",
        fontsize=8,
    )


def _coordinates(
    shape: Mapping[str, Sequence[float]], points: Sequence[str], axis: str
) -> list[float]:
    """Return the undeformed coordinates of points along the axis of a displacement such as "ux"."""
    return [shape[name]["xyz".index(axis[1])] for name in points]


def _displacements(rows: Mapping[str, Row], points: Sequence[str], kind: str) -> list[float]:
    """Return the displacements of points, of the kind "measured" or "predicted"."""
    return [rows[name][kind] for name in points]


def _rows_by_point(rows: Iterable[Row]) -> dict[str, dict[str, Row]]:
    """Return column of a displacement ("ux") -> name of a point -> its row."""
    rows_by_point = dict[str, dict[str, Row]]()
    for row in rows:
        # the name of the point stands before the displacement: "measured_3_ux_mm"
        point_match = POINT.match(row["result"])
        assert point_match
        rows_by_point.setdefault(str(row["column"]), {})[point_match[0]] = row
    return rows_by_point


def _state_of(row: Row) -> tuple[str, str]:
    """Return settings and place of a row, which say at which state of the shell it is."""
    return str(row["settings"]), str(row["at"])


def _state_words(state: tuple[str, str]) -> str:
    """Return the settings and the place of a state in words."""
    settings, place = state
    words = []
    for setting in settings.split("; "):
        key, _, value = setting.partition("=")
        words.append(f"{key_words(key)} = {value}" if value else key)
    return ", ".join(text for text in (*words, "" if place == "end" else place) if text)


def _in_line(coordinates: Sequence[Sequence[float]]) -> bool:
    """Return whether points may be joined by a line in their order.

    They may if they lie on a line along an axis, and the other coordinate never falls.

    Parameters
    ----------
    coordinates
        Two coordinates of the points, each (n,).
    """
    return any(np.ptp(v) == 0 for v in coordinates) and all(
        (np.diff(v) >= 0).all() for v in coordinates
    )


def _field(plot: Any, field: Row, number: int) -> None:
    """Draw a component of the remanence field, with its band over the arc length of a line.

    On a surface it is drawn by colours; the area of a point shows its standard deviation.

    Parameters
    ----------
    field
        `remanence` of identify.json.
    number
        Index of the component.
    """
    flux_scale, places = field["over"], np.array(field["places"])
    value, deviation, low, high, mean = (
        flux_scale["value"] * np.array(field[name])[:, number]
        for name in ("value", "deviation", "low", "high", "mean")
    )
    symbol = rf"$B^\mathrm{{r}}_{{{AXES[field['components'][number]]}}}$"
    label = (
        f"{symbol}  ({flux_scale['unit']})"
        if flux_scale["unit"]
        else rf"{symbol} over $|B^\mathrm{{r}}|$"
    )
    arc_length = lengths_along_line(places)
    if arc_length is not None:  # a meridian, or a strip along x
        half_width = 1.96 * flux_scale["value"] * field["prior"]["deviation"]  # 95 %
        plot.fill_between(
            arc_length, mean - half_width, mean + half_width, color="0.9", lw=0, label="prior, 95 %"
        )
        plot.fill_between(arc_length, low, high, color="C0", alpha=0.3, lw=0, label="95 %")
        plot.plot(arc_length, value, "o-", color="C0", ms=3, lw=1.2, label="fitted")
        margin = 0.3 * float(np.ptp([low, high]))
        plot.set(
            xlabel="arc length over $R$",
            ylabel=label,
            ylim=(low.min() - margin, high.max() + margin),
        )
        add_legend(plot)
        return
    # the two directions in which the points extend most
    first, second = sorted(int(i) for i in np.argsort(-np.ptp(places, axis=0), kind="stable")[:2])
    points = plot.scatter(
        places[:, first], places[:, second], c=value, s=10 + 240 * deviation / deviation.max()
    )
    plot.figure.colorbar(points, ax=plot, label=label)
    title = f"standard deviation: area, to {deviation.max():.3g} {flux_scale['unit']}".rstrip()
    plot.set(
        xlabel=f"${'xyz'[first]}/R$", ylabel=f"${'xyz'[second]}/R$", aspect="equal", title=title
    )


def _data(
    plot: Any, result: str, rows: Sequence[Row], curve: Sequence[tuple[float, float]], content: Row
) -> None:
    """Draw a column of the data over its places, with the fit and 95 % bands.

    Parameters
    ----------
    rows
        Rows of identify.csv for the column.
    curve
        Places and values along the path at the fit; empty if there are none.
    content
        The content of identify.json, whose `places` names the column of the places.
    """
    has_places = all(row["at"] != "end" for row in rows)
    rows = sorted(rows, key=lambda row: (row["settings"], row["at"])) if has_places else rows
    x = np.array([row["at"] for row in rows]) if has_places else np.arange(1.0, len(rows) + 1)
    # values of several cases do not lie on one curve: they are drawn with error bars
    on_one_curve = len({row["settings"] for row in rows}) == 1 and has_places

    def get(name: str) -> Array:
        """Return a column of the rows."""
        return np.array([row[name] for row in rows])

    if on_one_curve:  # bands, the wider one for measured values
        plot.fill_between(
            x,
            get("low_measured"),
            get("high_measured"),
            color="C0",
            alpha=0.12,
            lw=0,
            label="95 %, data",
        )
        plot.fill_between(
            x, get("low"), get("high"), color="C0", alpha=0.35, lw=0, label="95 %, curve"
        )
        # the computed path within the data, and the predictions on it
        fitted_curve = [(a, b) for a, b in curve if min(x) <= a <= max(x)]
        fitted_curve = sorted([*fitted_curve, *zip(x, get("predicted"), strict=True)])
        plot.plot(*zip(*fitted_curve, strict=True), color="C0", lw=1.2, label="fitted")
    else:
        error_bars = [
            get("predicted") - get("low_measured"),
            get("high_measured") - get("predicted"),
        ]
        plot.errorbar(x, get("predicted"), error_bars, fmt="_", color="C0", label="fitted, 95 %")
    plot.plot(x, get("measured"), ".", color="C1", label="measured", zorder=5)
    plot.set(
        xlabel=result_label(content["places"]) if has_places else "number",
        ylabel=result_label(result),
    )
    add_legend(plot)


def _parameters(plot: Any, parameters: Mapping[str, Row]) -> None:
    """Draw 95 % bands of the parameters, relative to the fit: the prior in grey, data in blue.

    Parameters
    ----------
    parameters
        Key -> its value, band and prior, as in identify.json.
    """
    widest = 0.0  # the largest distance of the end of a band from the fit, over the value
    for i, parameter in enumerate(parameters.values()):
        size = abs(parameter["value"]) or 1.0
        prior = parameter["prior"]
        if prior:
            # middle of the prior's band, less the fit: both over the size of the value
            middle = prior["mean"] / size - np.sign(parameter["value"])
            half_width = 1.96 * prior["deviation"] / size  # 95 %
            plot.barh(
                i, 200 * half_width, left=100 * (middle - half_width), height=0.5, color="0.85"
            )
            widest = max(widest, abs(middle) + half_width)
        low, high = ((parameter[name] - parameter["value"]) / size for name in ("low", "high"))
        plot.barh(i, 100 * (high - low), left=100 * low, height=0.25, color="C0")
        widest = max(widest, high)
    names = [
        f"{key_words(key, p['unit'])}\n{p['value']:.4g} {p['unit']}".rstrip()
        for key, p in parameters.items()
    ]
    plot.set_yticks(range(len(names)), names, fontsize=8)
    plot.set(
        xlabel="95 % bands in %:\ndata (blue), prior (grey)", xlim=(-120 * widest, 120 * widest)
    )
    plot.axvline(0.0, color="0.4", lw=0.6)


def draw_programme(rows: Sequence[Row], name: str, place: str, file: Path) -> None:
    """Draw the prediction of another history with its bands and data; a panel for each column.

    Parameters
    ----------
    rows
        Rows of identify_NAME.csv: step, place, result, predicted and measured value, ends of bands.
    name
        Name of the programme, the title.
    place
        The column of the places.
    file
        Name of the picture file.
    """
    columns = list(dict.fromkeys(row["result"] for row in rows))
    with saved_figure(file, PANEL_WIDTH * len(columns), PANEL_HEIGHT) as figure:
        plots = figure.subplots(1, len(columns), squeeze=False)[0]
        for plot, column in zip(plots, columns, strict=True):
            # labels that the legend shall have, each once
            labels = {"95 %, data", "95 %, curve", "predicted", "measured"}
            result_rows = [row for row in rows if row["result"] == column]
            for _, of_step in groupby(result_rows, key=lambda row: int(row["step"])):
                rows_of_step = sorted(of_step, key=lambda row: float(row[place]))
                _programme_of_step(plot, rows_of_step, place, labels)
            plot.set(xlabel=result_label(place), ylabel=result_label(column))
            add_legend(plot)
        figure.suptitle(name.replace("_", " "))


def _programme_of_step(plot: Any, rows: Sequence[Row], place: str, labels: set[str]) -> None:
    """Draw prediction, bands and data of one column in one step.

    Parameters
    ----------
    rows
        Rows of the table of one result and step, sorted by place.
    place
        The column of the places.
    labels
        Labels that are not in the legend yet; those that are drawn are removed.
    """

    def label(text: str) -> str:
        """Return the text if the legend does not have it yet, else ""."""
        is_new = text in labels
        labels.discard(text)
        return text if is_new else ""

    def get(column: str) -> Array:
        """Return a column of the rows; nan where it is empty."""
        return np.array([np.nan if row[column] == "" else row[column] for row in rows], dtype=float)

    x = get(place)
    # columns of both ends of a band, its opacity and its label
    bands = (
        ("low_measured", "high_measured", 0.12, "95 %, data"),
        ("low", "high", 0.35, "95 %, curve"),
    )
    for low, high, alpha, text in bands:
        plot.fill_between(x, get(low), get(high), color="C0", alpha=alpha, lw=0, label=label(text))
    plot.plot(x, get("predicted"), color="C0", lw=1.2, label=label("predicted"))
    if np.isfinite(get("measured")).any():
        plot.plot(x, get("measured"), ".", color="C1", ms=4, zorder=5, label=label("measured"))
