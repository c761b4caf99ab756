"""The interactive part of a report: the deformed shell to turn, a slider along the path, the curve.

All data are in the page: the rows of path.csv as JSON, the shells as small integers, compressed.

- A row is one point of the path, by column; its label is "fold" or "bifurcation" at an instability,
  "solution" for what a search found.
- The headline is the row that a run is about, such as its last point or its first instability.
- A frame is a row whose shell the page can show.
- A step of the curve (`CurveStep`) has the rows of one load step. It consists of lines, one for
  each branch (`Line`), whose segments are alternately stable and unstable.
- A tessellation divides curved cells into flat triangles; a part of its points is kept as the
  vertices of the page.
- Arrays are stored as integers in one block of bytes (`_Packed`); elsewhere the data have the
  location of an array in this block: a dictionary with its first byte, size and type.
- A quantity knows name, words, symbol and unit of a column; its `sign` is that with which an axis
  shows the column.
- h and R are thickness and reference length; places are over R.
"""

import base64
import importlib.util
import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import SHELL, Surface, on_nodes_of
from magshell_fenicsx.output.fields.tessellation import Tessellation, tessellate
from magshell_fenicsx.output.fields.vtu import point_file, read_point
from magshell_fenicsx.output.pictures.colours import WITH_SIGN, couple, field_at, sizes_at
from magshell_fenicsx.output.pictures.lines import (
    SEGMENTS_PER_INTERVAL,
    CurveStep,
    Line,
    axes_for,
    curve_coordinates,
    curve_steps,
    curve_title,
    is_unstable,
    line_coordinates,
    load_axis,
    with_point_name,
)
from magshell_fenicsx.output.pictures.rendering import near_outlines, near_solids, run_camera
from magshell_fenicsx.output.pictures.scales import DISTANCE, SIGNED, colour_map, from_zero
from magshell_fenicsx.output.store.stored_results import (
    headline,
    load_at_factor_one,
    pole_of,
    sizes_in,
    style_of,
)
from magshell_fenicsx.output.store.table import LOCATED, SOLUTION, Row, read_rows, varying_columns
from magshell_fenicsx.platform.disk_cache import load_cached, save_cached
from magshell_fenicsx.quantities.fields import FIELDS, in_case_unit_along_path
from magshell_fenicsx.quantities.quantity import CaseSizes, Quantity
from magshell_fenicsx.quantities.registry import LOAD_FACTOR, amplitude, quantity, shown_quantity
from magshell_fenicsx.shape.drawn_bodies import Solid

Array = NDArray[np.float64]
SAME_PLACE_TOLERANCE = 1e-7  # over R: distance of places that are one vertex
MAX_TRIANGLES = 8000  # of a mesh with curved cells
COLOUR_STOPS = 33  # of a colour map
EXACT_SIZE = 1e-5  # over R: edge of cubes up to which their numbers are compared exactly
GROWTH_OF_CUBES = 1.3  # of the edge, while there are too many vertices
MIN_RANGE = 1e-12  # of a field; smaller ones are constant


@dataclass(frozen=True)
class SimplifiedSurface:
    """Vertices that stand for a surface, and triangles between them.

    Attributes
    ----------
    tessellation
        Flat triangles of the surface.
    vertices
        (n,) numbers of those points of the tessellation that are kept as vertices.
    triangles
        (m, 3) positions in `vertices`.
    """

    tessellation: Tessellation
    vertices: NDArray[np.int64]
    triangles: NDArray[np.int64]

    @property
    def count(self) -> int:
        """Number of vertices."""
        return len(self.vertices)

    def at_vertices(self, values: Array) -> Array:
        """Return values (k, ...) of the surface's nodes, interpolated at the vertices, (n, ...)."""
        return self.tessellation.at_points(values)[self.vertices]


def simplify(surface: Surface, max_vertices: int) -> SimplifiedSurface:
    """Return a surface with at most about `max_vertices` vertices.

    If it has more, the vertices within a small cube are merged. The cubes grow until few enough
    remain.
    """
    tessellation = tessellate(surface, MAX_TRIANGLES)
    r, edge = tessellation.at_points(surface.r0), SAME_PLACE_TOLERANCE
    # first only points of one place, where cells meet, become one
    vertices, triangles = _merge_vertices(r, tessellation.triangles, edge)
    # edge of cubes over R: a first guess, which grows in the loop
    edge = 0.5 * float(np.ptp(r, axis=0).max()) / np.sqrt(max_vertices)
    while len(vertices) > max_vertices:
        vertices, triangles = _merge_vertices(r, tessellation.triangles, edge)
        edge *= GROWTH_OF_CUBES
    # outward vectors at the triangles, and normals of the flat triangles; both have any length
    outwards = tessellation.at_points(surface.n0)[vertices][triangles].sum(axis=1)
    corners = r[vertices][triangles]
    first_side, second_side = np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 0)
    normals = np.cross(first_side, second_side)
    # the triangles of the mirror image of a half shell are turned around, to have their outer side
    # up like the others
    is_inverted = np.einsum("ij,ij->i", normals, outwards) < 0
    triangles[is_inverted] = triangles[is_inverted][:, ::-1]
    return SimplifiedSurface(tessellation, vertices, triangles)


def _merge_vertices(
    r: Array, triangles: NDArray[np.int32], edge: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Merge the points within each cube of an edge, and return what remains.

    Parameters
    ----------
    r
        (n, 3) points over R.
    triangles
        (m, 3) numbers of points.
    edge
        Edge of the cubes, over R.

    Returns
    -------
    vertices
        Numbers of the points that remain, one for each cube.
    triangles
        (k, 3) positions in `vertices`, of the triangles whose corners remain distinct.
    """
    cubes = np.rint((r - r.min(axis=0)) / edge).astype(np.int64)
    # the cube of each point as one value. If cubes are large, their three numbers are so small that
    # they fit side by side into one integer, which is fast
    if edge > EXACT_SIZE:
        key = (cubes[:, 0] * (1 << 42)) ^ (cubes[:, 1] * (1 << 21)) ^ cubes[:, 2]
    else:
        key = _rows_as_values(cubes)
    # the first point of each cube remains
    _, vertices, vertex_of_point = np.unique(key, return_index=True, return_inverse=True)
    corners = vertex_of_point[triangles]
    is_proper = (
        (corners[:, 0] != corners[:, 1])
        & (corners[:, 1] != corners[:, 2])
        & (corners[:, 2] != corners[:, 0])
    )
    return vertices, corners[is_proper]


def _rows_as_values(cubes: NDArray[np.int64]) -> NDArray[np.void]:
    """Return rows (n, 3) as an array (n,) of single values, which numpy can compare at once."""
    return np.ascontiguousarray(cubes).view([("", cubes.dtype)] * 3).ravel()


MAX_FRAMES, MIN_FRAMES = 24, 6
MAX_VALUES = 110_000  # vertices times frames
COMPRESSION_LEVEL = 3  # of zlib: a tenth larger than by default, in half of the time
SCRIPT = "interactive.js"


@dataclass(frozen=True)
class InteractivePart:
    """Data for the script of a report's page.

    Attributes
    ----------
    about
        JSON: rows, columns, frames, fields, limits, and where each array begins in `data`.
    data
        Base64 of the compressed block of bytes with all arrays.
    library, script
        Plotly, compressed and in base64; the script of this package.
    """

    about: Markup
    data: str
    library: str
    script: Markup


def interactive(folder: Path, case: Mapping[str, Any]) -> InteractivePart | None:
    """Return the data of the interactive report of a run's folder.

    Parameters
    ----------
    folder
        Folder of the run, with path.csv and fields.
    case
        The case, as in summary.json.

    Returns
    -------
    None if fewer than two points have fields, or Plotly is not installed.
    """
    fields = folder / "fields"
    all_rows = read_rows(folder / "path.csv")
    rows = [row for row in all_rows if (fields / point_file(int(row["point"]))).exists()]
    if len(rows) < 2 or (library := plotly()) is None:
        return None
    last_row = next(row for row in reversed(rows) if row["label"] != SOLUTION)
    headline_row = headline(case, rows)
    surface, shell_data = read_point(fields, int(headline_row["point"]))
    # vertices times frames are limited: at least MIN_FRAMES, more of a small mesh
    mesh = simplify(surface, MAX_VALUES // MIN_FRAMES)
    frames = chosen_frames(rows, min(MAX_FRAMES, MAX_VALUES // mesh.count))
    # the shells of all frames, on the nodes of the headline's shell, and the sizes of units there
    surfaces_on_nodes, sizes, case_sizes = list[Surface](), list[CaseSizes](), sizes_in(folder)
    for row in frames:
        deformed, _ = read_point(fields, int(row["point"]))
        surfaces_on_nodes.append(on_nodes_of(deformed, surface))
        sizes.append(sizes_at(case_sizes, deformed, field_at(row)))
    number_type = np.uint16 if mesh.count < 2**16 else np.uint32
    arrays = _Packed()
    content: dict[str, Any] = {
        **_path(rows, last_row, pole_of(case), load_at_factor_one(case, case_sizes), arrays),
        # numbers of the rows that are frames, and the frame with which the page opens
        "frames": [rows.index(row) for row in frames],
        "opens": frames.index(headline_row) if headline_row in frames else len(frames) - 1,
        "h": shell_data.h,
        "camera": run_camera(surface, style_of(case)).direction.tolist(),
        # arrays are put into `arrays`; the content has their locations
        "r0": arrays.add(mesh.at_vertices(surface.r0), np.uint16),
        "triangles": arrays.raw(mesh.triangles.astype(number_type)),
        "u": [arrays.add(mesh.at_vertices(shell.u), np.int16) for shell in surfaces_on_nodes],
        "lines": [_lines(shell) for shell in surfaces_on_nodes],
        "solids": [_solids(shell, arrays) for shell in surfaces_on_nodes],
        "fields": _fields(surfaces_on_nodes, sizes, mesh, shell_data.h, arrays),
    }
    text = json.dumps(content).replace("<", "\\u003c")  # nothing in it can end the script
    script = Path(__file__).with_name(SCRIPT).read_text(encoding="utf-8")
    return InteractivePart(Markup(text), arrays.content, library, Markup(script))


def _lines(shell: Surface) -> list[Any]:
    """Return the outlines (n, 3) of bodies and sources near a shell, as lists for JSON."""
    return [np.round(line, 4).tolist() for line in near_outlines(shell)]


def _solids(shell: Surface, arrays: "_Packed") -> list[dict[str, Any]]:
    """Return the bodies and magnets near a shell for the page, as `_solid` does for each."""
    return [_solid(solid, arrays) for solid in near_solids(shell)]


def _solid(solid: Solid, arrays: "_Packed") -> dict[str, Any]:
    """Return a body or a magnet for the page: name, corners, faces and signs of its poles.

    Corners and faces are put into `arrays`; the result has their locations there.
    """
    poles = [] if solid.poles is None else np.sign(solid.poles).tolist()
    triangles = arrays.raw(solid.triangles.astype(np.uint16))
    return {
        "name": solid.name,
        "r": arrays.add(solid.points, np.uint16),
        "triangles": triangles,
        "poles": poles,
    }


def chosen_frames(rows: Sequence[Row], max_rows: int) -> list[Row]:
    """Return about `max_rows` rows of a path at most, to be shown as frames.

    The first row, the last row, instabilities and solutions are among them. Between them the shape
    changes by about equal amounts: a snap has as many frames as the slow part before it.
    """
    # at most half of the frames are instabilities and solutions
    marked_rows = [row for row in rows if row["label"] in (*LOCATED, SOLUTION)][: max_rows // 2]
    ordinary_rows = [row for row in rows if row not in marked_rows]
    ordinary_count = min(len(ordinary_rows), max(max_rows - len(marked_rows), 2))
    change = _change_of_shape(ordinary_rows)
    equal_changes = np.linspace(0, change[-1], ordinary_count)
    # for each of these amounts the row that is nearest to it
    frame_numbers = {int(np.abs(change - value).argmin()) for value in equal_changes}
    frame_numbers |= {0, len(ordinary_rows) - 1}
    # several amounts may choose one row; then some of the other rows, evenly spread, are added
    unused_numbers = [i for i in range(len(ordinary_rows)) if i not in frame_numbers]
    missing_count = ordinary_count - len(frame_numbers)
    spacing = (len(unused_numbers) - 1) / max(missing_count - 1, 1)
    frame_numbers |= {
        unused_numbers[round(i * spacing)] for i in range(min(missing_count, len(unused_numbers)))
    }
    return sorted(
        [*marked_rows, *(ordinary_rows[i] for i in frame_numbers)],
        key=lambda row: int(row["point"]),
    )


def _numbers_in(row: Row, columns: Sequence[str]) -> list[float]:
    """Return the numbers of a row in some columns."""
    return [float(row[name]) for name in columns]


def _change_of_shape(rows: Sequence[Row]) -> Array:
    """Return (n,) how far the shape has changed from the first row to each row.

    It is the sum of the changes of all displacements over their ranges, plus an equal share for
    each row. All shares together are half of the sum of all changes.
    """
    columns = [name for name in rows[0] if quantity(name).kind in ("displacement", "place")]
    values = np.array([_numbers_in(row, columns) for row in rows]).reshape(len(rows), -1)
    ranges = np.ptp(values, axis=0)
    steps = np.abs(np.diff(values[:, ranges > 0] / ranges[ranges > 0], axis=0)).sum(axis=1)
    # where nothing changes, the sum counts as one, and rows are at equal distances
    share = 0.5 * (float(steps.sum()) or 1.0) / max(len(steps), 1)
    return np.concatenate([[0.0], np.cumsum(steps + share)])


def _has_numbers(column: str, rows: Sequence[Row]) -> bool:
    """Return whether a column has a number in each row, neither text nor nan as of a solid."""
    values = (row[column] for row in rows)
    return not any(isinstance(value, str) or isnan(value) for value in values)


def _path(
    rows: Sequence[Row], last: Row, pole: str, load: str, arrays: "_Packed"
) -> dict[str, Any]:
    """Return the path for the page: varying columns of path.csv, labels and curves.

    Parameters
    ----------
    rows
        Rows of path.csv of the points that have fields.
    last
        The last row that is no solution of a search; its amplitude is the first choice of the
        curve.
    pole
        Words for the point of w_pole_over_h.
    load
        The dead load at a load factor of 1, as text.
    arrays
        Gets the slopes of the curves.
    """
    amplitude_name = next(
        (str(row["amplitude"]) for row in [last, *reversed(rows)] if row["amplitude"]), ""
    )
    steps = _steps_of_curve(rows, amplitude_name) if amplitude_name else []
    # all columns that an axis may show: those of the curves first, then those that vary
    quantities = _quantities(rows[0])
    axes = list[str]()  # columns of the curves' axes, those of the last step first
    for step in reversed(steps):
        # the quantity of an axis is taken from its step, which says whose displacement it is
        quantities |= {q.name: q for q in axes_for(step)}
        axes += [q.name for q in axes_for(step)]
    numeric = [name for name in rows[0] if _has_numbers(name, rows)]
    columns = {}
    for name in dict.fromkeys([*axes, *varying_columns(rows, numeric)]):
        column_quantity = quantities.get(name) or quantity(name)
        values = [row[name] for row in rows]
        columns[name] = {
            "label": label(column_quantity, rows[0], pole, load),
            "values": values,
            "sign": column_quantity.sign,
        }
    return {
        "columns": columns,
        "steps": [_step(step, rows, columns, arrays) for step in steps],
        "segments": SEGMENTS_PER_INTERVAL,
        "points": [row["point"] for row in rows],
        "labels": [row["label"] for row in rows],
        "unstable": [is_unstable(row) for row in rows],
    }


def _quantities(names: Iterable[str]) -> dict[str, Quantity]:
    """Return column -> quantity; a column in units has the words of the column without units.

    Examples
    --------
    >>> _quantities(["w_over_h", "w_mm"])["w_mm"].label
    'displacement  $w$  (mm)'
    """
    by_column = dict[str, Quantity]()
    for without_units in map(quantity, names):
        for in_unit in (without_units, *without_units.in_units):
            by_column.setdefault(in_unit.name, in_unit)
    return by_column


def _step(
    part: CurveStep, rows: Sequence[Row], columns: Iterable[str], arrays: "_Packed"
) -> dict[str, Any]:
    """Return a step of the curve for the page.

    It has title, axes, numbers of its rows in `rows`, and the lines between these. The slopes of
    all `columns` along the lines are put into `arrays`.
    """
    number_of_point = {int(row["point"]): i for i, row in enumerate(rows)}

    def numbers_of(rows_of_line: Sequence[Row]) -> list[int]:
        """Return the numbers in `rows` of the rows of a line."""
        return [number_of_point[int(row["point"])] for row in rows_of_line]

    varied_column = amplitude(part.amplitude).column
    lines = [
        {
            "rows": numbers_of(line.rows),
            "pieces": line.segments,
            **_cubics(line, part, columns, arrays),
        }
        for line in line_coordinates(part)
    ]
    return {
        "title": curve_title([part]) or quantity(varied_column).words,
        "axes": [q.name for q in axes_for(part)],
        "varied": shown_quantity(varied_column, rows[0]).name,
        "rows": numbers_of(part.rows),
        "lines": lines,
    }


def _cubics(
    line: Line, part: CurveStep, columns: Iterable[str], arrays: "_Packed"
) -> dict[str, Any]:
    """Return the parameter of a line at its n rows, and where the slopes there are in `arrays`.

    Slopes are (columns, n). The page draws the line with them as the pictures do. The parameter is
    that of the axes of the step, whichever columns the page shows.
    """
    places = [curve_coordinates(row, part.amplitude) for row in line.rows]
    parameter = line.parameter(*zip(*places, strict=True))
    # the column of the axis that shows the amplitude
    load_column = axes_for(part)[load_axis(part.amplitude)].name
    slopes = []
    for name in columns:
        values = [float(row[name]) for row in line.rows]
        slopes.append(line.slopes(parameter, values, of_amplitude=name == load_column))
    return {"parameter": parameter.tolist(), "slopes": arrays.raw(np.array(slopes, np.float32))}


def _steps_of_curve(rows: Sequence[Row], amplitude_name: str) -> list[CurveStep]:
    """Return the steps that curve.png draws, after those that curve.png leaves out.

    It leaves out, for instance, the step in which the field is applied before the loads. A step of
    one row alone has no curve and is dropped.
    """
    drawn_steps = curve_steps(rows, amplitude_name)
    drawn_points = {int(row["point"]) for part in drawn_steps for row in part.rows}
    earlier_rows = [row for row in rows if int(row["point"]) not in drawn_points]
    names = list(dict.fromkeys(str(row["amplitude"]) for row in earlier_rows if row["amplitude"]))
    earlier_steps = []
    for step_amplitude in names:
        rows_of_step = [row for row in earlier_rows if row["amplitude"] == step_amplitude]
        # a step begins at the row before it, unless it is the first of all
        row_before = rows[max(rows.index(rows_of_step[0]) - 1, 0)]
        if row_before is not rows_of_step[0]:
            rows_of_step = [row_before, *rows_of_step]
        earlier_steps.append(CurveStep(step_amplitude, rows_of_step))
    return [part for part in (*earlier_steps, *drawn_steps) if len(part.rows) > 1]


def label(of_axis: Quantity, row: Row, pole: str, load: str = "") -> str:
    """Return the label of an axis as HTML, with the words of curve.png.

    Parameters
    ----------
    of_axis
        Quantity of the axis.
    row
        A row of path.csv, whose columns name the case's points and units.
    pole
        Words for the point of w_pole_over_h in a case without named points.
    load
        The dead load at a load factor of 1, as text.
    """
    if of_axis.name == LOAD_FACTOR and load:
        return f"{_html_label(of_axis)} (× {load})"
    return _html_label(with_point_name(of_axis, row, pole))


def _html_label(axis_quantity: Quantity) -> str:
    """Return words, symbol and unit of a quantity as HTML."""
    words = f"{axis_quantity.words} {axis_quantity.note}".strip()
    unit = f" ({axis_quantity.shown_unit})" if axis_quantity.shown_unit else ""
    minus = "−" if axis_quantity.sign < 0 else ""
    symbol = Markup(f" {minus}{axis_quantity.html}") if axis_quantity.symbol else ""
    return str(Markup("{}{}{}").format(words, symbol, unit))


def _fields(
    shells: Sequence[Surface],
    sizes: Sequence[CaseSizes],
    mesh: SimplifiedSurface,
    h: float,
    arrays: "_Packed",
) -> list[dict[str, Any]]:
    """Return every scalar field and every length of a vector field, for the page.

    Each has name, label, limits over the whole path, colours as in the pictures, and where its
    values are in `arrays`. A field that is absent at a frame is left out.

    Parameters
    ----------
    shells
        The surface at each frame, on the nodes of one mesh.
    sizes
        Sizes of the case at each frame.
    mesh
        Vertices at which values are shown.
    h
        Thickness over R.
    """
    fields = []
    for name, field in FIELDS.items():
        values = [_values(shell, name, h) for shell in shells]
        nodal_values = [
            values_of_shell for values_of_shell in values if values_of_shell is not None
        ]
        if len(nodal_values) < len(shells):
            continue
        caption, nodal_values, limit = _in_case_unit(field, nodal_values, sizes)
        low, high, colours = _colour_scale(name, nodal_values, limit)
        if name == SHELL:
            names = [f"{i} {shell_name}" for i, shell_name in enumerate(shells[0].shells)]
            caption = f"{caption}: {', '.join(names)}"
        at_vertices = [mesh.at_vertices(values_of_shell) for values_of_shell in nodal_values]
        # values between the limits become whole numbers from 0 to 255
        fractions = [np.clip((values - low) / (high - low), 0.0, 1.0) for values in at_vertices]
        levels = [np.rint(255 * fraction).astype(np.uint8) for fraction in fractions]
        is_constant = all((level == levels[0]).all() for level in levels)
        # a field that does not change is stored once
        locations = [arrays.raw(level) for level in (levels[:1] if is_constant else levels)]
        fields.append(
            {
                "name": name,
                "label": caption,
                "low": low,
                "high": high,
                "colours": colours,
                "at": locations,
            }
        )
    return fields


def _in_case_unit(
    field: Quantity, nodal_values: Sequence[Array], sizes: Sequence[CaseSizes]
) -> tuple[str, list[Array], float]:
    """Return a field in the unit of the case: label in HTML, values at each frame, size of a 1.

    The size is the largest one of all frames. `nodal_values` and `sizes` are the values over the
    field's own unit, and the sizes of the case, at each frame.
    """
    largest = [float(np.abs(values).max()) for values in nodal_values]
    values_of_unit = largest if max(largest) > MIN_RANGE else [0.0] * len(largest)
    in_unit, factors = in_case_unit_along_path(field, sizes, values_of_unit)
    values = [factor * values for factor, values in zip(factors, nodal_values, strict=True)]
    return _html_label(in_unit), values, max(map(abs, factors))


def _colour_scale(
    name: str, nodal_values: Sequence[Array], unit_size: float
) -> tuple[float, float, list[tuple[float, str]]]:
    """Return the lower and the upper limit of a field over all frames, and its colours.

    `nodal_values` are the field's values at each frame, `unit_size` is the size of a 1 over the
    field's own unit. Colours are pairs of a fraction of the limits' range and a colour. Without
    pairs the page takes Plotly's own colour map.
    """
    low = min(float(values_of_shell.min()) for values_of_shell in nodal_values)
    high = max(float(values_of_shell.max()) for values_of_shell in nodal_values)
    if high - low <= MIN_RANGE * unit_size:
        low, high = low - 1.0, low + 1.0
    if name == "gap_over_h":  # what is farther than one thickness is grey
        return 0.0, unit_size, _stops(DISTANCE)
    if name in WITH_SIGN:
        low, high = from_zero(low, high)
        return low, high, _stops(SIGNED, (low, high))
    return low, high, []


def _stops(name: str, limits: tuple[float, float] = (-1.0, 1.0)) -> list[tuple[float, str]]:
    """Return a colour map of the pictures in Plotly's form: pairs of a fraction and a colour.

    `limits` are the values at its ends, which place the neutral colour of a map with a sign.
    """
    from matplotlib.colors import to_hex

    colours = colour_map(name, limits)
    # the last colour begins just before the end. In a map of distances it is grey, unlike the one
    # before it
    fractions = [
        *(float(fraction) for fraction in np.linspace(0.0, 1.0, COLOUR_STOPS)[:-1]),
        1 - 1e-3,
        1.0,
    ]
    return [(fraction, to_hex(colours(fraction))) for fraction in fractions]


def _values(surface: Surface, name: str, h: float) -> Array | None:
    """Return a field at the nodes (n,), or the length of a vector field; None if it is absent."""
    if name == "w_over_h":
        return np.asarray(surface.w / h)
    values = couple(surface) if name == "couple" else surface.fields.get(name)
    if values is None:
        is_before_field = name == "couple" and "Ba" in surface.fields
        return np.zeros(len(surface.r0)) if is_before_field else None
    return np.nan_to_num(values if values.ndim == 1 else np.linalg.norm(values, axis=1))


class _Packed:
    """Arrays in one block of bytes, each beginning at a multiple of four bytes.

    `_parts` are the bytes of each array, `_length` is the length of all of them.
    """

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def add(self, values: Array, kind: type[np.integer[Any]]) -> dict[str, Any]:
        """Add values (n, 3), rounded to integers i with value = low + step i.

        Parameters
        ----------
        kind
            Type of the integers; a signed one is symmetric to zero, with low = 0.

        Returns
        -------
        The location of the integers, with the keys of `raw`, and `low` and `step`.
        """
        min_integer, max_integer = np.iinfo(kind).min, np.iinfo(kind).max
        low, high = float(values.min()), float(values.max())
        if min_integer < 0:  # a signed type: zero stays exactly zero
            low, high = 0.0, max(abs(low), abs(high))
        step = (high - low) / max_integer or 1.0
        return {**self.raw(np.rint((values - low) / step).astype(kind)), "low": low, "step": step}

    def raw(self, values: NDArray[Any]) -> dict[str, Any]:
        """Add an array unchanged, and return its location.

        Returns
        -------
        `at`: its first byte; `size`: its number of elements; `kind`: the name of its type.
        """
        content = np.ascontiguousarray(values).tobytes()
        location = {"at": self._length, "size": int(values.size), "kind": values.dtype.name}
        self._parts.append(content + bytes(-len(content) % 4))  # zeros up to a multiple of four
        self._length += len(self._parts[-1])
        return location

    @property
    def content(self) -> str:
        """All arrays, compressed and in base64."""
        return packed(b"".join(self._parts))


def packed(content: bytes) -> str:
    """Return bytes compressed by zlib, in base64."""
    return base64.b64encode(zlib.compress(content, COMPRESSION_LEVEL)).decode()


@cache
def plotly() -> str | None:
    """Return Plotly's script, compressed and in base64; None if Plotly is not installed.

    Only its file is read: importing Plotly in Python would take long.
    """
    package = importlib.util.find_spec("plotly")
    places = package.submodule_search_locations if package else None
    for place in places or []:
        file = Path(place) / "package_data" / "plotly.min.js"
        if file.exists():
            return _packed_file(file)
    return None


def _packed_file(file: Path) -> str:
    """Return a file compressed and in base64; the disk cache keeps the result for all runs."""
    file_status = file.stat()
    # another version of the file has another size or time, and so another name
    name = f"packed_{file.name}_{file_status.st_size}_{file_status.st_mtime_ns}_{COMPRESSION_LEVEL}"
    if cached := load_cached(name):
        return cached.decode()
    packed_file = packed(file.read_bytes())
    save_cached(name, packed_file.encode())
    return packed_file
