"""An animation of the path: the deformed shell, and a marker on the curve beside it.

A frame shows one row of path.csv, that is one point of the path. A panel is a drawn view of the
shell with its scale of colours; a window the part of the projection that it shows. Displacements
may be magnified; colours show w/h, the inward normal displacement over the thickness. The pole is
the point whose displacement the column w_pole_over_h has. Lengths of the layout are in pixels.
"""

import io
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.bodies_and_magnets import near_places
from magshell_fenicsx.output.pictures.colours import ColouredField, in_units
from magshell_fenicsx.output.pictures.curve import plot_curve
from magshell_fenicsx.output.pictures.layout import FigureBoxes, Panel, directions, drawing
from magshell_fenicsx.output.pictures.lines import (
    CurveStep,
    curve_coordinates,
    curve_panels,
    curve_steps,
)
from magshell_fenicsx.output.pictures.picture import Background
from magshell_fenicsx.output.pictures.rendering import Camera, Image, Window
from magshell_fenicsx.output.pictures.scales import SIGNED, colour_bar, from_zero
from magshell_fenicsx.output.store.table import POLE, Row
from magshell_fenicsx.problem.requests import OutputSection
from magshell_fenicsx.quantities.quantity import NO_UNITS, CaseSizes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D
    from PIL import Image as Pillow

MIN_DRAWN_DISPLACEMENT = 0.1  # drawn size of the largest displacement, over the shell's extent
WINDOW_WIDTH = 620  # pixels
DURATION = 6.0  # s, of all frames
DURATION_OF_LAST = 1500  # ms, of the last frame
MIN_FRAME_DURATION = 80  # ms
MAX_CURVES = 4  # above each other
MIN_CURVE_HEIGHT = 230  # pixels of a curve with its labels
COLOURS = 256  # of the palette
STYLE = OutputSection(dpi=120, font_size=9)
WHITE = (255, 255, 255)
FOOT = 34  # pixels below the shell
EDGE_GREY, EDGE_OPACITY = 0.35, 0.8  # of the line around the shell
Array = NDArray[np.float64]


def magnification(surfaces: Sequence[Surface]) -> float:
    """Return the factor by which drawn displacements are magnified: 1, 2, 5, 10, ...

    It is the least factor with which the largest displacement is visible.

    Examples
    --------
    >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> cells = np.array([[0, 1, 2]])
    >>> sizes = (0.3, 0.03, 0.006)
    >>> [magnification([Surface(square, u * square, square, cells, {})]) for u in sizes]
    [1.0, 5.0, 20.0]
    """
    largest = max(float(np.linalg.norm(surface.u, axis=1).max()) for surface in surfaces)
    ideal = (
        MIN_DRAWN_DISPLACEMENT * float(np.ptp(surfaces[0].r0, axis=0).max()) / (largest or np.inf)
    )
    if ideal <= 1:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(ideal))
    return float(decade * next(step for step in (1, 2, 5, 10) if step * decade >= ideal))


def animated(
    surfaces: Sequence[Surface],
    h: float,
    titles: Sequence[str],
    rows: Sequence[Row],
    frame_rows: Sequence[Row],
    camera: Camera,
    pole: str = POLE,
    sizes: CaseSizes = NO_UNITS,
) -> bytes:
    """Return the animation of a path as the content of a GIF file.

    Parameters
    ----------
    surfaces, titles, frame_rows
        For each frame: the whole deformed shell, the title and the row of path.csv.
    h
        Thickness over R.
    rows
        All rows of the path.
    camera
        Projection of the shell.
    pole
        Name of the point of w_pole_over_h.
    sizes
        Sizes of the case.
    """
    from PIL import Image as Pillow

    factor = magnification(surfaces)
    with drawing(STYLE):
        views = _views(surfaces, h, factor, camera, sizes)
        frames = _composed(views, factor, titles, rows, frame_rows, pole)
    # a GIF file has 256 colours; without dither they would look like contours
    dither = Pillow.Dither.FLOYDSTEINBERG
    # the first, the middle and the last frame stand for the colours of all
    samples = [frames[i] for i in sorted({0, len(frames) // 2, len(frames) - 1})]
    palette = _palette(samples)  # the same for all frames
    first_image, *further_images = (
        _with_white(frame, Pillow.fromarray(frame).quantize(palette=palette, dither=dither))
        for frame in frames
    )
    # ms, in multiples of ten: GIF files count hundredths of a second
    duration = round(max(1000 * DURATION / len(frames), MIN_FRAME_DURATION), -1)
    durations = [*[duration] * len(further_images), DURATION_OF_LAST]
    content = io.BytesIO()
    first_image.save(
        content,
        "GIF",
        save_all=True,
        append_images=further_images,
        duration=durations,
        loop=0,
        optimize=False,
    )
    return content.getvalue()


def _with_white(frame: Image, reduced: "Pillow.Image") -> "Pillow.Image":
    """Return a frame reduced to a palette, with white kept white.

    Pillow alone takes a colour next to white there.

    Parameters
    ----------
    frame
        (height, width, 3) colours.
    reduced
        The frame as Pillow reduces it to the palette, whose first colour is white.
    """
    from PIL import Image as Pillow

    numbers = np.asarray(reduced).copy()  # of each pixel in the palette
    numbers[(frame == WHITE[0]).all(axis=-1)] = 0
    white = Pillow.fromarray(numbers, "P")
    white.putpalette(reduced.getpalette() or [])
    return white


def _palette(frames: Sequence[Image]) -> "Pillow.Image":
    """Return a palette of `COLOURS` entries for all frames; the first entry is white."""
    from PIL import Image as Pillow

    pixels = np.concatenate(frames).reshape(-1, 3)
    coloured = Pillow.fromarray(pixels[(pixels < WHITE[0]).any(axis=1)][None])
    # entries that cover all colours, each moved to the mean of the pixels that are nearest to it:
    # where an entry is off the shades of a shell, dither shows bands
    reduced = coloured.quantize(COLOURS - 1, Pillow.Quantize.MAXCOVERAGE, kmeans=1)
    palette = Pillow.new("P", (1, 1))
    palette.putpalette([*WHITE, *(reduced.getpalette() or [])[: 3 * (COLOURS - 1)]])
    return palette


def _views(
    surfaces: Sequence[Surface], h: float, factor: float, camera: Camera, sizes: CaseSizes
) -> list[Panel]:
    """Return the panels of all frames, with one window and one scale of colours.

    Parameters
    ----------
    h
        Thickness over R.
    factor
        Magnification of the displacements; colours show the true ones.
    sizes
        Sizes of the case.
    """
    lowest = min(float(surface.w.min()) for surface in surfaces)
    highest = max(float(surface.w.max()) for surface in surfaces)
    limits = from_zero(lowest / h, highest / h)
    magnified = [replace(surface, u=factor * surface.u) for surface in surfaces]
    places = [surfaces[0].r0]  # the window is around all that any frame draws
    for surface in magnified:
        places += [surface.r0 + surface.u, *near_places(surface)]
    window = Window.around(camera(np.concatenate(places)), WINDOW_WIDTH)
    panels = []
    for surface, magnified_surface in zip(surfaces, magnified, strict=True):
        w = ColouredField("w_over_h", np.asarray(surface.w / h), limits, SIGNED, "$w/h$")
        layer = in_units(w, sizes)
        panels.append(
            Background(magnified_surface, camera, WINDOW_WIDTH, window).panel(layer, STYLE)
        )
    return panels


def _composed(
    views: Sequence[Panel],
    factor: float,
    titles: Sequence[str],
    rows: Sequence[Row],
    frame_rows: Sequence[Row],
    pole: str,
) -> list[NDArray[np.uint8]]:
    """Return the frames (height, width, 3) of an animation.

    The fixed parts are drawn once; title, shell and marker are drawn on copies.

    Parameters
    ----------
    views, titles, frame_rows
        For each frame: the shell, the title and the row of path.csv.
    factor
        Magnification of the displacements.
    rows
        All rows of the path, for the curves.
    pole
        Name of the point of w_pole_over_h in a case without named points.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # from the left: shell, bar of colours, curves; the title above takes 40 pixels
    shell_height, shell_width = views[0].image.shape[:2]
    panels = list[list[CurveStep]]()
    if rows[-1]["amplitude"]:
        panels = curve_panels(curve_steps(rows, str(rows[-1]["amplitude"])))[-MAX_CURVES:]
    height = max(shell_height + 40 + FOOT, 400, 70 + MIN_CURVE_HEIGHT * len(panels))
    width = shell_width + 600
    shell_low = FOOT + (height - 40 - FOOT - shell_height) // 2
    figure = Figure(figsize=(width / STYLE.dpi, height / STYLE.dpi), dpi=STYLE.dpi)
    boxes = FigureBoxes(figure)

    def box(left: float, low: float, box_width: float, box_height: float) -> "Axes":
        """Return axes in a box of pixels from the lower left of the figure."""
        return boxes.axes(*(length / STYLE.dpi for length in (left, low, box_width, box_height)))

    canvas = FigureCanvasAgg(figure)
    colour_bar(figure, box(shell_width + 30, 90, 16, height - 180), views[0].scale, "vertical")
    figure.text(15 / width, 12 / height, _scale(factor))
    directions(box(shell_width - 60, 4, 70, 70), views[0].camera, STYLE)
    markers = _draw_curves(box, shell_width + 230, height, panels, pole)
    # artists that are "animated" are left out of the fixed parts
    title = figure.text(15 / width, 1 - 12 / height, "", va="top", animated=True)
    canvas.draw()
    fixed_parts = canvas.copy_from_bbox(figure.bbox)
    frames = []
    for view, text, row in zip(views, titles, frame_rows, strict=True):
        canvas.restore_region(fixed_parts)
        title.set_text(text)
        figure.draw_artist(title)
        if row["point"] in markers:
            _draw_marker(*markers[int(row["point"])], row)
        frame = np.array(canvas.buffer_rgba())[:, :, :3]
        # the place of the shell in the frame; rows of an image go downwards
        shell_rows = slice(height - shell_low - shell_height, height - shell_low)
        _overlay(view.image, frame[shell_rows, 10 : 10 + shell_width])
        frames.append(frame)
    return frames


def _draw_curves(
    box: "Callable[[float, float, float, float], Axes]",
    left: float,
    height: float,
    panels: Sequence[Sequence[CurveStep]],
    pole: str,
) -> "dict[int, tuple[Axes, str, Line2D]]":
    """Draw the curves of panels above each other, and return where points have markers.

    Parameters
    ----------
    box
        Function from left, low, width and height of a box in pixels to axes in it.
    left, height
        Left side of the axes, and height of the figure, in pixels.
    panels
        The steps in each panel, from above.
    pole
        Name of the point of w_pole_over_h in a case without named points.

    Returns
    -------
    Number of a point -> axes, amplitude and marker of its curve. Markers have no places yet.
    """
    height_of_curve = (height - 70) // max(len(panels), 1)
    markers: dict[int, tuple[Axes, str, Line2D]] = {}
    for i, steps in enumerate(reversed(panels)):  # from below
        axes = box(left, 70 + i * height_of_curve, 350, height_of_curve - 70)
        plot_curve(axes, steps, pole)
        (marker,) = axes.plot([], [], "o", color="k", markersize=8, animated=True)
        place = axes, steps[0].amplitude, marker
        markers |= {int(row["point"]): place for step in steps for row in step.rows}
    return markers


def _draw_marker(axes: "Axes", amplitude: str, marker: "Line2D", row: Row) -> None:
    """Draw the marker of a curve at a row of path.csv on the canvas."""
    x, y = curve_coordinates(row, amplitude)
    marker.set_data([x], [y])
    axes.draw_artist(marker)


def _overlay(image: Image, frame: NDArray[np.uint8]) -> None:
    """Draw an image (n, m, 4) with transparency over a part of a frame (n, m, 3), in place.

    A thin grey line is drawn around what the image shows.
    """
    opacity = image[..., 3:] / 255
    overlaid = opacity * image[..., :3] + (1 - opacity) * frame
    edge = EDGE_OPACITY * edge_of(opacity)
    frame[:] = np.rint((1 - edge) * overlaid + edge * 255 * EDGE_GREY)


def edge_of(coverage: Array) -> Array:
    """Return the edge (n, m, 1) of what is drawn: 1 in pixels at its rim, 0 elsewhere.

    `coverage` (n, m, 1) is the drawn fraction of each pixel.
    """
    # least coverage of a pixel and its four neighbours
    smallest = coverage.copy()
    for axis, shift in ((0, 1), (0, -1), (1, 1), (1, -1)):
        smallest = np.minimum(smallest, np.roll(coverage, shift, axis))
    return np.asarray(coverage - smallest)


def _scale(factor: float) -> str:
    """Return words for the scale of the displacements."""
    return "displacements to scale" if factor == 1 else rf"displacements drawn $\times$ {factor:g}"
