"""Additions to a curve: the curves of several runs in one picture, and the shell at some points.

A row is a line of path.csv: one point of the path. A step (`CurveStep`) has the rows of one load
step, drawn as one curve. A window is the part of the projection that an image shows. "Over the
axes" means in units of width and height of the axes, from 0 to 1.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.animation import STYLE, edge_of, magnification
from magshell_fenicsx.output.pictures.colours import ColouredField
from magshell_fenicsx.output.pictures.curve import MARK_SIZE, draw_lines, drawn_points, legend
from magshell_fenicsx.output.pictures.layout import INCH, ONE_COLUMN, drawing, place_axes
from magshell_fenicsx.output.pictures.lines import (
    CurveStep,
    axes_for,
    curve_coordinates,
    curve_steps,
    with_point_name,
)
from magshell_fenicsx.output.pictures.picture import Background
from magshell_fenicsx.output.pictures.rendering import Camera, Image, Window
from magshell_fenicsx.output.pictures.scales import (
    SIGNED,
    from_zero,
    number_format,
    numbers,
    pixel_canvas,
)
from magshell_fenicsx.output.pictures.sections import (
    UprightSection,
    section_along,
    upright_section,
)
from magshell_fenicsx.output.store.stored_results import case_in, pole_of
from magshell_fenicsx.output.store.table import LOCATED, SOLUTION, Row
from magshell_fenicsx.problem.requests import OutputSection
from magshell_fenicsx.quantities.fields import FIELDS, in_case_unit
from magshell_fenicsx.quantities.quantity import NO_UNITS, CaseSizes
from magshell_fenicsx.quantities.registry import QUANTITIES

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
MAX_KEYS = 2  # of a case in the label of its run
MAX_WIDTH, MAX_HEIGHT = 0.26, 0.34  # of a shell on a curve, over the axes
EDGE_GREY, EDGE_OPACITY = 0.3, 0.8  # of the line around a shell
PLACES_PER_SIDE = 9  # that are tried for a shell
MARGIN = 0.02  # around these places, over the axes
# costs of covering all of the curve, and another shell; a distance of one width of the axes costs 1
COST_OF_CURVE, COST_OF_SHELL = 12.0, 50.0
NARROW_RATIO = 0.25  # width over length of a shell, seen from above, of which sections are drawn
TINY = 1e-300  # least divisor
OPAQUE = 127  # of 255: pixels with a larger opacity belong to a shell


def runs_figure(runs: Mapping[Path, Sequence[Row]], style: OutputSection) -> "Figure":
    """Return the last curve of each run in one picture, with labels that say how the cases differ.

    Parameters
    ----------
    runs
        Folder -> the rows of its path.

    Raises
    ------
    CaseError
        If they have no curve, or curves over different quantities.
    """
    from matplotlib.figure import Figure

    # all curves must have the quantities of the first one on their axes
    steps = {folder: _last_step(folder, rows) for folder, rows in runs.items()}
    axes_names = {folder: _axes_names(step) for folder, step in steps.items()}
    first_folder = next(iter(steps))
    first_step = steps[first_folder]
    for folder, names in axes_names.items():
        if names != axes_names[first_folder]:
            curve = " over ".join(reversed(names))
            first_curve = " over ".join(reversed(axes_names[first_folder]))
            raise CaseError(
                f"{folder}: its curve is {curve}, that of {first_folder} {first_curve}: "
                "draw them alone"
            )
    cases = {folder: case_in(folder) for folder in steps}
    width = (style.width or ONE_COLUMN) / INCH
    with drawing(style):
        figure = Figure(figsize=(width, 0.8 * width), dpi=style.dpi, layout="constrained")
        axes = figure.subplots()
        for i, (name, step) in enumerate(zip(labels(cases), steps.values(), strict=True)):
            # matplotlib's ten colours are C0 to C9, then C10 is C0 again; C3 is that of the marks
            number = i % 10
            colour = f"C{number if number < 3 else number + 1}"
            draw_lines(axes, step, colour)
            axes.plot([], [], color=colour, lw=1.2, label=name)  # an empty line, for the legend
        pole = pole_of(cases[first_folder])
        x_label, y_label = (
            with_point_name(axis_quantity, first_step.rows[0], pole, r"\$").label
            for axis_quantity in axes_for(first_step)
        )
        axes.set(xlabel=x_label, ylabel=y_label)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(number_format())
        axes.axhline(0, color="0.8", linewidth=0.8, zorder=0)
        legend(figure, max_columns=2)
    return figure


def _last_step(folder: Path, rows: Sequence[Row]) -> CurveStep:
    """Return the last step of a run's path.

    Raises
    ------
    CaseError
        If no amplitude has varied, so that there is no curve.
    """
    path = [row for row in rows if row["label"] != SOLUTION]
    if not path or not path[-1]["amplitude"]:
        raise CaseError(f"{folder}: has no curve: nothing has varied")
    return curve_steps(path, str(path[-1]["amplitude"]))[-1]


def _axes_names(step: CurveStep) -> tuple[str, ...]:
    """Return the names of the quantities on the axes of a step's curve."""
    return tuple(q.name for q in axes_for(step))


def labels(cases: Mapping[Path, Mapping[str, Any]]) -> list[str]:
    """Return a label for each run: the values of the keys in which the cases differ.

    If too many keys differ, or none, the labels are the names of the folders.

    Examples
    --------
    >>> a, b = {"shell": {"h": 1.0}, "x": 2}, {"shell": {"h": 0.5}, "x": 2}
    >>> labels({Path("a"): a, Path("b"): b})
    ['h = 1', 'h = 0.5']
    """
    flat_cases = [dict(_flat(case)) for case in cases.values()]
    all_keys = dict.fromkeys(key for case in flat_cases for key in case)

    def differs(key: str) -> bool:
        """Return whether a key has several values in the cases."""
        return len({str(case.get(key)) for case in flat_cases}) > 1

    differing_keys = [key for key in all_keys if differs(key)]
    if not 0 < len(differing_keys) <= MAX_KEYS:
        return [folder.name.replace("$", r"\$") for folder in cases]
    names = []
    for case in flat_cases:
        values = [f"{_key_words(key)} = {_value_words(case.get(key))}" for key in differing_keys]
        names.append(", ".join(values))
    return names


def _flat(section: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (key path, value) of all single values of a case, except those of the section `output`.

    `path` is the key path of `section`; empty for the whole case.
    """
    items = section.items() if isinstance(section, Mapping) else enumerate(section)
    for key, value in items:
        name = f"{path}.{key}" if path else str(key)
        if name == "output":
            continue
        if isinstance(value, Mapping | list):
            yield from _flat(value, name)
        else:
            yield name, value


def _key_words(key: str) -> str:
    """Return the symbol of the quantity with the name of a key, else the name in words."""
    _, _, name = key.rpartition(".")
    return QUANTITIES[name].latex if name in QUANTITIES else name.replace("_", " ")


def _value_words(value: Any) -> str:
    """Return a value of a case as text for matplotlib."""
    if isinstance(value, float | int):
        return f"{value:.6g}".replace("-", "−")
    return str(value).replace("$", r"\$")


def _last_panel_with(row: Row, panels: Sequence[Sequence[CurveStep]]) -> int | None:
    """Return the number of the last panel with a row; None if no panel has it."""
    numbers = range(len(panels) - 1, -1, -1)
    return next((i for i in numbers if any(row in step.rows for step in panels[i])), None)


def add_shapes(
    figure: "Figure",
    panels: Sequence[Sequence[CurveStep]],
    shapes: Sequence[tuple[Row, Surface]],
    h: float,
    camera: Camera,
    sizes: CaseSizes = NO_UNITS,
) -> None:
    """Draw the shell at some points on the curves of a figure, with a line from each to its point.

    Each shell is where it covers least. All are of one scale, coloured by their own w; of shells
    whose pictures would be blades the sections are drawn. The title has the range of colours, and
    the factor of displacements that are too small to be seen.

    Parameters
    ----------
    figure, panels
        Figure with curves, and the steps that are drawn in each of its axes.
    shapes
        Row of path.csv of each point, and the deformed shell there.
    h
        Thickness over R.
    camera
        Projection of all shells.
    sizes
        Sizes of the case.
    """
    panel_numbers = [_last_panel_with(row, panels) for row, _ in shapes]
    # one factor for the displacements of all shapes; it is in the titles
    factor = magnification([surface for _, surface in shapes])
    magnified = [replace(surface, u=factor * surface.u) for _, surface in shapes]
    limits = from_zero(
        min(float(surface.w.min()) for _, surface in shapes) / h,
        max(float(surface.w.max()) for _, surface in shapes) / h,
    )
    fields = [
        ColouredField("", np.asarray(surface.w / h), limits, SIGNED, "") for _, surface in shapes
    ]
    places = camera(np.concatenate([surface.r0 + surface.u for surface in magnified]))
    sections = _sections_of_strips(magnified)
    words = "shapes: sections; grey: undeformed" if sections else _words_of_colours(sizes, limits)
    words += f"\ndisplacements of shapes $\\times$ {factor:g}" if factor > 1 else ""
    for panel_number in dict.fromkeys(i for i in panel_numbers if i is not None):
        axes = figure.axes[panel_number]
        axes.set_title("\n".join(text for text in (axes.get_title(), words) if text))
    place_axes(figure)  # shapes are drawn to the sizes of the axes
    occupied = dict[int, list[Array]]()  # number of a panel -> boxes of the shapes drawn so far
    for i, (number, (row, _)) in enumerate(zip(panel_numbers, shapes, strict=True)):
        if number is None:
            continue
        axes = figure.axes[number]
        box = axes.get_window_extent()
        if sections:
            image = _section_image(sections[i], sections, (box.width, box.height))
        else:
            image = _shell_image(magnified[i], fields[i], camera, places, (box.width, box.height))
        # its place near the point of the curve, where other shapes are not
        size_over_axes = np.array([image.shape[1] / box.width, image.shape[0] / box.height])
        point = np.array(curve_coordinates(row, panels[number][0].amplitude))
        corner = _free_corner(axes, point, size_over_axes, occupied.setdefault(number, []))
        occupied[number].append(np.array([corner, corner + size_over_axes]))
        _add_shape(axes, image, point, corner, size_over_axes)
        if row["label"] not in LOCATED:  # those have marks
            axes.plot(*point, "o", color="k", markersize=MARK_SIZE, zorder=5)


def _words_of_colours(sizes: CaseSizes, limits: tuple[float, float]) -> str:
    """Return the range of the colours of shells, from w/h, in the unit of a case."""
    w, size = in_case_unit(FIELDS["w_over_h"], sizes, max(map(abs, limits)))
    unit = f" {w.shown_unit}" if w.shown_unit else ""
    texts, _ = numbers([size * limit for limit in limits])
    colours = [
        f"{text}{unit} {colour}" for text, colour in zip(texts, ("blue", "red"), strict=True)
    ]
    ends = ", ".join(text for text in colours if text[:2] != "0 ")
    return f"shapes: {w.latex} = 0 white, {ends}"


def _sections_of_strips(surfaces: Sequence[Surface]) -> list[UprightSection]:
    """Return sections by one plane of narrow shells, whose pictures would be blades.

    The list is empty for other shells. The surfaces are those of one shell, of which the one that
    moves most tells the plane.
    """
    spread = np.linalg.svd(np.cov(surfaces[0].r0[:, :2].T), compute_uv=False)  # squares of lengths
    if spread[1] > NARROW_RATIO**2 * spread[0]:
        return []
    section = upright_section(max(surfaces, key=lambda surface: float(np.abs(surface.u).max())))
    if section is None:
        return []
    return [section_along(surface, section.direction, section.words) for surface in surfaces]


def _section_image(
    section: UprightSection, sections: Sequence[UprightSection], axes_size: tuple[float, float]
) -> Image:
    """Return the image of a section, on the scale of several, in the room that axes have for it.

    `axes_size` is width and height of the axes in pixels.
    """
    from matplotlib.figure import Figure

    boxes = np.array([one_section.box for one_section in sections])
    left_end, low = boxes[:, [0, 2]].min(axis=0)
    right, high = boxes[:, [1, 3]].max(axis=0)
    room = MAX_WIDTH * axes_size[0], MAX_HEIGHT * axes_size[1]
    scale = min(room[0] / (right - left_end), room[1] / max(high - low, TINY))
    width, height = (max(scale * size, 8.0) for size in (right - left_end, high - low))
    figure = Figure(figsize=(width / STYLE.dpi, height / STYLE.dpi), dpi=STYLE.dpi)
    figure.patch.set_alpha(0.0)
    axes = figure.add_axes((0.02, 0.02, 0.96, 0.96))
    section.draw(axes)
    axes.set(xlim=(left_end, right), ylim=(low, high))
    canvas = pixel_canvas(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())


def _shell_image(
    surface: Surface,
    field: ColouredField,
    camera: Camera,
    places: Array,
    axes_size: tuple[float, float],
) -> Image:
    """Return the image of a shell in colours, as large as there is room for it in the axes.

    Parameters
    ----------
    places
        (n, 3) projected places of all shells, whose window is common, and so the scale.
    axes_size
        Width and height of the axes in pixels.
    """
    axes_width, axes_height = axes_size
    # proportions of the common window, from one that is 1000 pixels wide
    height_in_pixels, _ = Window.around(places, 1000).shape
    height_over_width = height_in_pixels / 1000
    room = min(MAX_WIDTH * axes_width, MAX_HEIGHT * axes_height / height_over_width)
    width = max(int(room), 8)
    window = Window.around(places, width)
    view = Background(surface, camera, width, window)
    return _cropped(view.panel(field, STYLE).image)


def _add_shape(axes: "Axes", image: Image, point: Array, corner: Array, size: Array) -> None:
    """Draw an image at a corner of the axes, with a line to a point of the data.

    Parameters
    ----------
    point
        (2,) in data coordinates.
    corner, size
        (2,) lower left corner and size of the image, over the axes.
    """
    from matplotlib.offsetbox import AnnotationBbox, OffsetImage

    line_style = {
        "arrowstyle": "-",
        "color": "0.5",
        "linewidth": 0.6,
        "shrinkA": 0,
        "shrinkB": MARK_SIZE / 2,
    }
    # the line: from the point of the data to the nearest drawn pixel of the image
    end = _nearest(axes, image, point, corner, size)
    begin = (float(point[0]), float(point[1]))
    axes.annotate("", begin, end, textcoords="axes fraction", arrowprops=line_style, zorder=3)
    # the image: it is placed by its middle
    x, y = corner + size / 2
    offset_image = OffsetImage(image, zoom=72 / axes.figure.dpi, resample=True)
    options: dict[str, Any] = {"xycoords": "axes fraction", "frameon": False, "pad": 0, "zorder": 3}
    axes.add_artist(AnnotationBbox(offset_image, (float(x), float(y)), **options))


def _cropped(image: Image) -> Image:
    """Return the drawn part of an image, with a line around the shell.

    The image (height, width, 4) is transparent where nothing is drawn.
    """
    opacity = image[..., 3:] / 255
    edge = EDGE_OPACITY * edge_of(opacity)
    lined = image.copy()
    lined[..., :3] = np.rint((1 - edge) * image[..., :3] + edge * 255 * EDGE_GREY)
    # numbers of the rows and of the columns in which something is drawn
    rows, columns = (np.flatnonzero(opacity[..., 0].any(axis=axis)) for axis in (1, 0))
    return lined[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def _nearest(
    axes: "Axes", image: Image, point: Array, corner: Array, size: Array
) -> tuple[float, float]:
    """Return (x, y), over the axes, of the image's drawn pixel nearest to a point of the data.

    `corner` and `size` are those of the image, over the axes.
    """
    # rows go downwards, places on the axes upwards
    down, right = np.nonzero(image[..., 3] > OPAQUE)
    pixels = corner + size * np.column_stack(
        [(right + 0.5) / image.shape[1], 1 - (down + 0.5) / image.shape[0]]
    )
    # distances on the screen, in its pixels
    box = axes.get_window_extent()
    target = axes.transAxes.inverted().transform(axes.transData.transform(point))
    distances = np.linalg.norm((pixels - target) * [box.width, box.height], axis=1)
    x, y = pixels[distances.argmin()]
    return float(x), float(y)


def _free_corner(axes: "Axes", point: Array, size: Array, occupied: Sequence[Array]) -> Array:
    """Return the lower left corner (2,), over the axes, for a box that belongs to a point.

    Of a grid of corners the one with the least cost is taken. The box costs more if it covers the
    curve or other boxes, or if it is far from its point.

    Parameters
    ----------
    point
        (2,) in the data.
    size
        (2,) of the box, over the axes.
    occupied
        Lower left and upper right corners (2, 2) of other boxes, over the axes.
    """
    in_axes = axes.transAxes.inverted().transform
    points = in_axes(axes.transData.transform(drawn_points(axes)))
    target = in_axes(axes.transData.transform(point))

    def cost(low: Array) -> float:
        """Return the cost of a box at `low`: what it covers, and its distance from its point."""
        high = low + size
        covered = ((points > low) & (points < high)).all(axis=1).mean()
        overlap = sum(_common_area(low, high, other_box) for other_box in occupied)
        distance = np.linalg.norm(low + size / 2 - target)
        return float(COST_OF_CURVE * covered + COST_OF_SHELL * overlap + distance)

    # abscissae, then ordinates, of the corners that are tried
    positions = (
        np.linspace(MARGIN, max(1 - MARGIN - length, MARGIN), PLACES_PER_SIDE) for length in size
    )
    return np.asarray(min((np.array(corner) for corner in product(*positions)), key=cost))


def _common_area(low: Array, high: Array, other_box: Array) -> float:
    """Return the area that a box with corners `low` and `high` (2,) shares with another (2, 2)."""
    other_low, other_high = other_box
    sides = np.minimum(high, other_high) - np.maximum(low, other_low)
    return float(np.prod(np.clip(sides, 0, None)))
