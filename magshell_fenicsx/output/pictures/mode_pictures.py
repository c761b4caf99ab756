"""Pictures of modes and further solutions as small panels, and pictures of gradients.

gradients.png shows where a result would change most with more of a field.

A row is a line of path.csv: one point of the path. A null vector is the mode that is neutral at an
instability; a point there is singular. Instabilities are numbered along the path. "mode" and
"mode_w" are the fields of a mode: its displacement, of largest length one, and the inward normal
component of that. A layer is the field in whose colours a shell is drawn. h and R are thickness and
reference length. Lengths of the layout are in inches; `line_height` is that of a line of text, and
numbers that multiply it are chosen by eye.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.mode_fields import mode_caption, mode_file, wave_number
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.vtu import read_vtu
from magshell_fenicsx.output.pictures.captions import in_mathematics, named_value
from magshell_fenicsx.output.pictures.colours import ColouredField, field_caption, in_units
from magshell_fenicsx.output.pictures.layout import (
    GAP,
    INCH,
    LINE_HEIGHT,
    ONE_COLUMN,
    TWO_COLUMNS,
    Arrow,
    FigureBoxes,
    Panel,
    columns,
    directions,
    draw_panel,
    drawing,
    panel_width,
    panels_figure,
)
from magshell_fenicsx.output.pictures.lines import instability_numbers
from magshell_fenicsx.output.pictures.picture import Background, spread_points
from magshell_fenicsx.output.pictures.rendering import Camera, Window
from magshell_fenicsx.output.pictures.scales import SIGNED, colour_bar, from_zero
from magshell_fenicsx.output.store.table import LOCATED, SOLUTION, Row, read_csv, stability
from magshell_fenicsx.problem.requests import OutputSection
from magshell_fenicsx.quantities.fields import FIELDS, in_case_unit
from magshell_fenicsx.quantities.quantity import NO_UNITS, CaseSizes
from magshell_fenicsx.quantities.registry import OWN_MODES, amplitude, quantity, shown_quantity

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Array = NDArray[np.float64]
# the limit of colours is at most PEAK times this quantile of the nodes
QUANTILE, PEAK = 0.995, 1.3
MIN_ARROW_LENGTH = 0.15  # of a vector that is drawn, over the longest one
ARROW_DISTANCE = 0.16  # of arrows, over the extent of the places of drawn vectors
DEPTH_TOLERANCE = 0.03  # over the shell's extent: depth at which places of arrows are visible
# over the largest load on the path: a smaller load is zero, up to the error of where a path ends
ZERO_LOAD = 1e-4
# over the largest displacements: distance of instabilities that are the same one
SAME_INSTABILITY_TOLERANCE = 5e-3
ALIKE_DISTANCE = 0.04  # over the largest displacement: distance of solutions that look alike
NOTE = "Change of a result per area by the change of a field there."
WORDS = {
    "remanence": "more remanence, along arrows",
    "magnitude": "stronger magnet",
    "thickness": "more thickness",
    "curvature_11": r"natural curvature $\kappa_{11}$",
    "curvature_22": r"natural curvature $\kappa_{22}$",
    "curvature_12": r"natural twist $\kappa_{12}$",
    "deviation": r"shape moved outwards, $w_0/R$",
}


def small_panels(
    surfaces: Sequence[Surface],
    layers: Sequence[ColouredField],
    captions: Sequence[str],
    style: OutputSection,
    camera: Camera,
    note: str = "",
) -> "Figure":
    """Return a figure of small panels in one window, with captions and one colour bar.

    The layers must have the same limits.

    Parameters
    ----------
    surfaces, layers, captions
        For each panel: the deformed shell, its coloured field, and the text above it.
    note
        Text at the foot of the figure; empty for none.
    """
    from matplotlib.figure import Figure

    count, line_height, gap = len(surfaces), LINE_HEIGHT * style.font_size, GAP / INCH
    per_row = columns(count) if count < 10 else 4
    # sizes: all panels have one window, around the undeformed and the deformed shells
    width = (style.width or (ONE_COLUMN if count == 1 else TWO_COLUMNS)) / INCH
    cell_width = width / per_row
    places = [camera(np.concatenate([surface.r0, surface.r0 + surface.u])) for surface in surfaces]
    pixels = max(int((cell_width - gap) * style.dpi), 50)
    window = Window.around(np.concatenate(places), pixels)
    image_height = window.shape[0] / style.dpi
    caption_lines = max(caption.count("\n") + 1 for caption in captions)
    cell_height = image_height + caption_lines * line_height + gap / 2
    height_below = 4.4 * line_height  # of the colour bar
    foot_height = line_height if note else 0.0
    height = -(-count // per_row) * cell_height + height_below + foot_height
    figure = Figure(figsize=(width, height), dpi=style.dpi)
    boxes = FigureBoxes(figure)
    text_place = boxes.place(gap / 2, 0.5 * line_height)
    figure.text(*text_place, note, va="center", fontsize=style.font_size)
    for i, (surface, layer, caption) in enumerate(zip(surfaces, layers, captions, strict=True)):
        # the window is given, so that the width of the picture does not count
        panel = Background(surface, camera, width=0, window=window).panel(layer, style)
        left, lower = i % per_row * cell_width, height - (i // per_row + 1) * cell_height
        axes = boxes.axes(left + gap / 2, lower, cell_width - gap, image_height)
        draw_panel(axes, panel, style)
        text_place = boxes.place(
            left + cell_width / 2, lower + image_height + caption_lines * line_height / 2
        )
        figure.text(*text_place, caption, ha="center", va="center")
    _draw_bar_and_directions(boxes, panel, style, width, foot_height)  # all have one scale
    return figure


def _draw_bar_and_directions(
    boxes: FigureBoxes, panel: Panel, style: OutputSection, width: float, foot_height: float
) -> None:
    """Draw the colour bar of a panel in the middle, and the directions of e1, e2, e3 to its left.

    `width` is that of the figure, `foot_height` the height below both, in inches.
    """
    line_height, gap = LINE_HEIGHT * style.font_size, GAP / INCH
    bar_length = min(width - gap - 8 * line_height, 4.0)  # inches, with room for the directions
    bar_axes = boxes.axes(
        (width - bar_length) / 2, foot_height + 1.7 * line_height, bar_length, 0.65 * line_height
    )
    colour_bar(boxes.figure, bar_axes, panel.scale, room=bar_length)
    directions(
        boxes.axes(gap / 2, foot_height + 0.4 * line_height, 3.4 * line_height, 3.4 * line_height),
        panel.camera,
        style,
    )


def solution_rows(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of all solutions that searches have found, in the order of `rows`.

    Before the solutions of each step comes the last point of the path there.
    """
    rows_of_solutions: list[Row] = []
    for number_of_row, row in enumerate(rows):
        if row["label"] == SOLUTION:
            previous = rows[number_of_row - 1]
            # before the first solution of its step comes the last point of the path so far
            if previous["label"] != SOLUTION or previous["step"] != row["step"]:
                earlier_path = [
                    earlier_row
                    for earlier_row in rows[:number_of_row]
                    if earlier_row["branch"] == 0
                ]
                rows_of_solutions.append(earlier_path[-1])
            rows_of_solutions.append(row)
    return rows_of_solutions


def solutions_figure(
    surfaces: Sequence[Surface],
    rows: Sequence[Row],
    h: float,
    style: OutputSection,
    camera: Camera,
    sizes: CaseSizes = NO_UNITS,
) -> "Figure":
    """Return the figure of the deformed shells of some rows, coloured alike by w.

    Parameters
    ----------
    surfaces, rows
        Deformed shells, and their rows of path.csv: solutions, and ends of the path before them.
    h
        Thickness over R.
    sizes
        Sizes of the case.
    """
    lowest = min(float(surface.w.min()) for surface in surfaces)
    highest = max(float(surface.w.max()) for surface in surfaces)
    limits, caption = from_zero(lowest / h, highest / h), field_caption("w_over_h")
    fields = [
        ColouredField("w_over_h", np.asarray(surface.w / h), limits, SIGNED, caption)
        for surface in surfaces
    ]
    layers = [in_units(field, sizes) for field in fields]
    w, size = in_case_unit(FIELDS["w_over_h"], sizes, max(map(abs, limits)))
    unit = f" {w.shown_unit}" if w.shown_unit else ""
    captions = list[str]()
    for number, (row, layer) in enumerate(zip(rows, layers, strict=True)):
        stable_or_unstable, *_ = stability(row).split()  # the first word
        largest = float(layer.values[np.abs(layer.values).argmax()])
        lines = [
            f"{_name(row)}: {stable_or_unstable}",
            f"largest {w.latex} = {in_mathematics(largest, 4)}{unit}",
        ]
        # an earlier shell from which this one can hardly be told in a picture
        for earlier_row, earlier in zip(rows[:number], surfaces[:number], strict=True):
            difference = np.linalg.norm(surfaces[number].u - earlier.u, axis=1)
            distance = size * float(difference.max()) / h
            if distance < ALIKE_DISTANCE * abs(largest):
                text = f"{in_mathematics(distance, 2)}{unit or ' $h$'}"
                lines.append(f"at most {text} from {_name(earlier_row)}")
        captions.append("\n".join(lines))
    with drawing(style):
        note = f"Lines are at round values of each shell's own {w.latex}."
        return small_panels(surfaces, layers, captions, style, camera, note)


def _name(row: Row) -> str:
    """Return words for the row of a solution, or of the end of the path."""
    return f"solution {row['branch']}" if row["label"] == SOLUTION else "end of the path"


MODE_SIZE = 0.05  # drawn size of a mode's largest displacement, over R
MAX_CLOSED = 0.5  # of a gap between two parts, that a drawn mode closes
MIN_CLOSING = 0.1  # of a mode, of largest length one: less closes no gap
MIN_GAP = 1e-4  # over R: nearer parts touch, and the mode does not part them
MAX_PANELS = 12
CAPTION = "$w$ of the mode over its largest, of any sign"


def modes_figure(
    surfaces: Sequence[Surface],
    captions: Sequence[str],
    style: OutputSection,
    camera: Camera,
    max_panels: int = MAX_PANELS,
) -> "Figure":
    """Return the figure with one small panel per mode.

    A panel shows the deformed shell plus the mode, coloured by the mode's normal displacement.

    Parameters
    ----------
    surfaces
        Deformed surfaces with the fields "mode" (n, 3), of largest length one, and "mode_w" (n,).
    captions
        Captions of the panels, in matplotlib's mathematics.
    max_panels
        Largest number of panels; the picture says how many modes it leaves out.
    """
    note = f"The first {max_panels} of {len(captions)} modes." if len(captions) > max_panels else ""
    surfaces, captions = surfaces[:max_panels], captions[:max_panels]
    with_modes = [
        replace(surface, u=surface.u + mode_size(surface) * surface.fields["mode"])
        for surface in surfaces
    ]
    layers = []
    for surface in surfaces:
        w = surface.fields["mode_w"]
        layers.append(
            ColouredField("mode_w", w / (np.abs(w).max() or 1.0), (-1.0, 1.0), SIGNED, CAPTION)
        )
    with drawing(style):
        return small_panels(with_modes, layers, captions, style, camera, note)


def mode_size(surface: Surface) -> float:
    """Return the drawn size of a mode over R: with it no part of the shell goes through another.

    It is `MODE_SIZE`, or less where the mode closes the gap between parts that share no node.

    Parameters
    ----------
    surface
        Deformed surface with the field "mode" (n, 3), of largest length one.
    """
    from scipy.spatial import cKDTree

    part_numbers, size = _part_numbers(surface), MODE_SIZE
    r, mode = surface.r0 + surface.u, surface.fields["mode"]
    for number in range(1, int(part_numbers.max()) + 1):
        own_nodes, earlier_nodes = (
            np.flatnonzero(mask) for mask in (part_numbers == number, part_numbers < number)
        )
        gaps, nearest = cKDTree(r[earlier_nodes]).query(r[own_nodes])
        other_nodes = earlier_nodes[nearest]
        directions = (r[other_nodes] - r[own_nodes]) / np.maximum(gaps, MIN_GAP)[:, None]
        closing = np.sum((mode[own_nodes] - mode[other_nodes]) * directions, axis=1)
        closes = (closing > MIN_CLOSING) & (gaps > MIN_GAP)
        size = min(size, MAX_CLOSED * (gaps[closes] / closing[closes]).min(initial=np.inf))
    return float(size)


def _part_numbers(surface: Surface) -> NDArray[np.int64]:
    """Return for each node (n,) the number of its part: parts share no node; 0 for one shell."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if len(surface.shells) < 2:
        return np.zeros(len(surface.r0), np.int64)
    # each node of a cell is connected with the first one
    nodes = surface.cells[:, 1:].ravel()
    first_nodes = np.repeat(surface.cells[:, 0], surface.cells.shape[1] - 1)
    node_count = len(surface.r0)
    graph = coo_matrix((np.ones(len(nodes)), (first_nodes, nodes)), (node_count, node_count))
    _, numbers = connected_components(graph, directed=False)
    return np.asarray(numbers, np.int64)


@dataclass(frozen=True)
class StoredMode:
    """A mode as stability.csv has it: its label, and its eigenvalue over E h/R²."""

    label: str
    eigenvalue: float


def mode_figures(
    folder: Path, rows: Sequence[Row], style: OutputSection, camera: Camera
) -> Iterator[tuple[str, "Figure"]]:
    """Yield names and figures of the modes whose files are in a run's folder.

    `instabilities` shows the null vectors, `modes_NNNN` the modes of point NNNN in stability.csv.
    """
    numbers = instability_numbers(rows)
    singular_rows = [row for row in rows if row["label"] in LOCATED]
    # an instability that the path meets again is drawn once
    occurrences = _occurrences(singular_rows)
    distinct_rows = [row for row in singular_rows if int(row["point"]) in occurrences]
    null_vectors = [_null_vector(folder, row, rows, numbers, occurrences) for row in distinct_rows]
    if panels := [panel for panel in null_vectors if panel]:
        yield "instabilities", _figure(panels, style, camera)
    table = folder / "stability.csv"
    if not table.exists():
        return
    modes_of_points = read_csv(
        table,
        lambda line: (int(line["point"]), StoredMode(line["mode"], float(line["eigenvalue"]))),
    )
    for row in rows:
        point = int(row["point"])
        modes = [mode for number, mode in modes_of_points if number == point]
        panels = list[tuple[Surface, str]]()
        for rank, mode in enumerate(modes, 1):
            file = mode_file(folder, point, str(rank), mode.label)
            if file.exists():
                surface, _ = read_vtu(file)
                panels.append((surface, mode_caption(rank, mode)))
        if panels:
            yield f"modes_{point:04d}", _figure(panels, style, camera)


def _figure(
    panels: Sequence[tuple[Surface, str]], style: OutputSection, camera: Camera
) -> "Figure":
    """Return the figure of modes, from pairs of a surface with a mode and a caption."""
    surfaces, captions = zip(*panels, strict=True)
    return modes_figure(surfaces, captions, style, camera)


def _largest_size(column: str, rows: Sequence[Row]) -> float:
    """Return the largest absolute value of a column of rows."""
    return max(abs(float(row[column])) for row in rows)


def _occurrences(singular: Sequence[Row]) -> dict[int, list[Row]]:
    """Return the distinct instabilities of a path, each with all rows at which the path meets it.

    A path that turns back, or several branches, meet the same instability again.

    Parameters
    ----------
    singular
        Rows of all instabilities along the path.

    Returns
    -------
    Number of the first point of each distinct instability -> all rows at which the path meets it.
    """
    occurrences: dict[int, list[Row]] = {}
    # the displacements by which instabilities are compared, and their sizes
    columns_here = singular[0] if singular else {}
    displacements = [
        name for name in columns_here if quantity(name).kind in ("displacement", "place")
    ]
    largest_values = {name: _largest_size(name, singular) for name in displacements}

    def are_same(row: Row, other: Row) -> bool:
        """Whether two rows are one instability: of one kind, with equal displacements."""
        if any(row[name] != other[name] for name in ("label", "mode", "amplitude")):
            return False
        return all(
            abs(float(row[name]) - float(other[name])) <= SAME_INSTABILITY_TOLERANCE * largest
            for name, largest in largest_values.items()
        )

    for row in singular:
        earlier = next((rows for rows in occurrences.values() if are_same(rows[0], row)), None)
        if earlier is None:
            occurrences[int(row["point"])] = [row]
        else:
            earlier.append(row)
    return occurrences


def _null_vector(
    folder: Path,
    row: Row,
    rows: Sequence[Row],
    numbers: dict[int, int],
    occurrences: Mapping[int, Sequence[Row]],
) -> tuple[Surface, str] | None:
    """Return the surface with an instability's null vector and its caption; None without a file.

    The caption has the numbers of the instability, its kind and the load.

    Parameters
    ----------
    row, rows
        The row of the instability, and all rows of the path.
    numbers
        Number of a point -> number of its instability.
    occurrences
        Number of a point -> the rows of the same instability.
    """
    # the file of the null vector; a mode with the model's own symmetry has no label in its name
    label = "" if row["mode"] in OWN_MODES else str(row["mode"])
    file = mode_file(folder, int(row["point"]), str(row["label"]), label)
    if not file.exists():
        return None
    surface, _ = read_vtu(file)
    # in brackets: the mode's name, and the number of its waves where they can be counted
    details = [str(row["mode"])] if row["mode"] else []
    if not label and (waves := wave_number(surface)):
        details.append(f"m = {waves}")
    details = [detail.replace("m = ", "$m$ = ") for detail in details]
    kind = f" ({', '.join(details)})" if details else ""
    load_words = f"\n{_load_words(row, rows)}" if row["amplitude"] else ""
    # the numbers of all instabilities that are the same one
    rows_of_same = occurrences[int(row["point"])]
    number_words = ", ".join(str(numbers[int(other_row["point"])]) for other_row in rows_of_same)
    return surface, f"{number_words}: {row['label']}{kind}{load_words}"


def _load_words(row: Row, rows: Sequence[Row]) -> str:
    """Return the load at a row in words; a load that is small among those of all rows is zero."""
    column = amplitude(str(row["amplitude"])).column
    largest = max(abs(float(other_row[column])) for other_row in rows)
    # the load at the end of a path is zero up to an error only
    is_zero = abs(float(row[column])) <= ZERO_LOAD * largest
    if not is_zero:
        return named_value(column, row, digits=5)
    column_in_units = shown_quantity(column, row).name  # `column` itself without units
    return named_value(column, {**row, column: 0.0, column_in_units: 0.0}, digits=5)


def gradients_figure(
    by_result: Mapping[str, Surface], style: OutputSection, camera: Camera
) -> "Figure":
    """Return the figure of gradients, with one panel for each result and field.

    Red raises the result, blue lowers it. Of a vector field the length is coloured, with arrows.
    `by_result` maps a result to the surface with its gradients.
    """
    count = sum(name in surface.fields for surface in by_result.values() for name in WORDS)
    width = panel_width(style, columns(count))
    with drawing(style):
        panels = list[Panel]()
        for result, surface in by_result.items():
            panels += _panels(result, surface, style, camera, width)
        return panels_figure(panels, style, NOTE)


def _panels(
    result: str, surface: Surface, style: OutputSection, camera: Camera, width: int
) -> Iterator[Panel]:
    """Yield the panels of one result's gradients, of the fields that `surface` has."""
    view = Background(surface, camera, width)
    for name in (name for name in WORDS if name in surface.fields):
        caption, values = f"{result.replace('_', ' ')}: {WORDS[name]}", surface.fields[name]
        if values.ndim == 1:
            limit = _limit(np.abs(values))
            # no wider than the field, and without its peaks
            limits = from_zero(max(float(values.min()), -limit), min(float(values.max()), limit))
            yield view.panel(ColouredField(name, values, limits, SIGNED, caption), style)
            continue
        magnitude = np.asarray(np.linalg.norm(values, axis=1))
        panel = view.panel(
            ColouredField(name, magnitude, (0.0, _limit(magnitude)), "Reds", caption), style
        )
        yield replace(panel, arrows=(_arrows(surface, values, view, camera),))


def _limit(sizes: Array) -> float:
    """Return the largest of some magnitudes, without peaks at few nodes; 1 if all are zero."""
    return float(min(sizes.max(), PEAK * np.quantile(sizes, QUANTILE))) or 1.0


def _arrows(surface: Surface, vectors: Array, view: Background, camera: Camera) -> Arrow:
    """Return arrows of vectors (n, 3) at some of the n nodes, which are visible and well separated.

    Short vectors have no arrow. The longest arrow is as long as the least distance of arrows.
    """
    r, length = surface.r0 + surface.u, np.linalg.norm(vectors, axis=1)
    longest, extent = length.max() or 1.0, float(np.ptp(r, axis=0).max())
    visible = view.seen.shows(r, DEPTH_TOLERANCE * extent)
    nodes = np.flatnonzero((length >= MIN_ARROW_LENGTH * longest) & visible)
    distance = ARROW_DISTANCE * float(np.ptp(r[nodes], axis=0).max())
    feet = nodes[spread_points(r[nodes], distance)]
    # dark grey, without a name: the caption says what the arrows are
    return Arrow(
        camera(r[feet]), camera(distance / longest * vectors[feet]), colour="0.15", name=""
    )
