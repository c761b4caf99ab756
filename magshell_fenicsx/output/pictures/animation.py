"""An animation of the path: the deformed shell, and a marker on the curve beside it."""

import io
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.beside import near_places
from magshell_fenicsx.output.pictures.colours import Coloured
from magshell_fenicsx.output.pictures.curve import plot_curve
from magshell_fenicsx.output.pictures.layout import Boxes, Panel, directions, drawing
from magshell_fenicsx.output.pictures.lines import Part, drawn_parts, place
from magshell_fenicsx.output.pictures.picture import Background
from magshell_fenicsx.output.pictures.scales import SIGNED, colour_bar, from_zero
from magshell_fenicsx.output.pictures.view import Camera, Image, Window
from magshell_fenicsx.output.store.table import POLE, Row
from magshell_fenicsx.problem.wanted import OutputSection

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D
    from PIL import Image as Pillow

SEEN = 0.1  # least drawn size of the largest displacement, over the shell's extent
WINDOW = 620  # pixels
SECONDS = 6.0  # duration of all frames
HELD = 1500  # milliseconds of the last frame
MOST_CURVES = 4  # beside each other
COLOURS = 128
STYLE = OutputSection(dpi=120, font_size=9)
WHITE = (255, 255, 255)
FOOT = 34  # pixels below the shell
GREY, RIM = 0.35, 0.8  # of the line around what is drawn, and how much of it is seen
Array = NDArray[np.float64]


def magnification(surfaces: Sequence[Surface]) -> float:
    """The factor of the drawn displacements: the least of 1, 2, 5, 10, ... with which the largest
    is visible.

    Examples
    --------
    >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> [magnification([Surface(square, u * square, square, np.array([[0, 1, 2]]), {})]) for u in (0.3, 0.03, 0.006)]
    [1.0, 5.0, 20.0]
    """
    largest = max(float(np.linalg.norm(s.u, axis=1).max()) for s in surfaces)
    wanted = SEEN * float(np.ptp(surfaces[0].r0, axis=0).max()) / (largest or np.inf)
    if wanted <= 1:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(decade * next(step for step in (1, 2, 5, 10) if step * decade >= wanted))


def animated(
    surfaces: Sequence[Surface],
    h: float,
    titles: Sequence[str],
    rows: Sequence[Row],
    shown: Sequence[Row],
    camera: Camera,
    pole: str = POLE,
) -> bytes:
    """A GIF file.

    Parameters
    ----------
    surfaces, titles, shown
        For each frame: the whole deformed shell, the title and the row of path.csv.
    rows
        All rows of the path.
    pole
        Name of the point of w_pole_over_h.
    """
    from PIL import Image as Pillow

    factor = magnification(surfaces)
    with drawing(STYLE):
        views = _views(surfaces, h, factor, camera)
        frames = _composed(views, factor, titles, rows, shown, pole)
    dither = Pillow.Dither.FLOYDSTEINBERG  # without it 256 colours are contours that are not there
    palette = _palette(
        [frames[i] for i in sorted({0, len(frames) // 2, len(frames) - 1})]
    )  # the same for all
    first, *others = (
        _with_white(frame, Pillow.fromarray(frame).quantize(palette=palette, dither=dither))
        for frame in frames
    )
    each = round(max(1000 * SECONDS / len(frames), 80), -1)
    durations = [*[each] * len(others), HELD]
    content = io.BytesIO()
    first.save(
        content,
        "GIF",
        save_all=True,
        append_images=others,
        duration=durations,
        loop=0,
        optimize=False,
    )
    return content.getvalue()


def _with_white(frame: Image, reduced: "Pillow.Image") -> "Pillow.Image":
    """A frame in the colours of a palette, white where it is white: Pillow takes a neighbour of
    white there.
    """
    from PIL import Image as Pillow

    numbers = np.asarray(reduced).copy()
    numbers[(frame == WHITE[0]).all(axis=-1)] = 0
    white = Pillow.fromarray(numbers, "P")
    white.putpalette(reduced.getpalette() or [])
    return white


def _palette(frames: Sequence[Image]) -> "Pillow.Image":
    """A palette of 2 COLOURS: half of them cover all colours, half resolve the frequent ones."""
    from PIL import Image as Pillow

    colours = Pillow.fromarray(np.unique(np.concatenate(frames).reshape(-1, 3), axis=0)[None])
    palette = Pillow.new("P", (1, 1))
    methods = Pillow.Quantize.MAXCOVERAGE, Pillow.Quantize.MEDIANCUT
    levels = [c for method in methods for c in colours.quantize(COLOURS, method).getpalette() or []]
    palette.putpalette([*WHITE, *levels[3:]])
    return palette


def _views(surfaces: Sequence[Surface], h: float, factor: float, camera: Camera) -> list[Panel]:
    """The same window and colours for all frames."""
    limits = from_zero(
        min(float(s.w.min()) for s in surfaces) / h, max(float(s.w.max()) for s in surfaces) / h
    )
    moved = [replace(s, u=factor * s.u) for s in surfaces]
    places = [r for s in moved for r in (s.r0 + s.u, *near_places(s))]
    window = Window.around(camera(np.concatenate([surfaces[0].r0, *places])), WINDOW)
    panels = []
    for surface, drawn in zip(surfaces, moved, strict=True):
        layer = Coloured("w_over_h", np.asarray(surface.w / h), limits, SIGNED, "$w/h$")
        panels.append(Background(drawn, camera, WINDOW, window).panel(layer, STYLE))
    return panels


def _composed(
    views: Sequence[Panel],
    factor: float,
    titles: Sequence[str],
    rows: Sequence[Row],
    shown: Sequence[Row],
    pole: str,
) -> list[NDArray[np.uint8]]:
    """Frames (height, width, 3); the fixed parts are drawn once, then the title, the shell and the
    marker on copies.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    high, across = views[0].image.shape[:2]
    width, height = across + 600, max(high + 40 + FOOT, 400)
    low = FOOT + (height - 40 - FOOT - high) // 2
    figure = Figure(figsize=(width / STYLE.dpi, height / STYLE.dpi), dpi=STYLE.dpi)
    boxes = Boxes(figure)

    def box(left: float, low: float, wide: float, tall: float) -> "Axes":
        return boxes.axes(*(n / STYLE.dpi for n in (left, low, wide, tall)))

    canvas = FigureCanvasAgg(figure)
    colour_bar(figure, box(across + 30, 90, 16, height - 180), views[0].scale, "vertical")
    figure.text(15 / width, 12 / height, _scale(factor))
    directions(box(across - 60, 4, 70, 70), views[0].camera, STYLE)
    parts = (
        drawn_parts(rows, str(rows[-1]["amplitude"]))[-MOST_CURVES:]
        if rows[-1]["amplitude"]
        else []
    )
    room = (height - 70) // max(len(parts), 1)
    markers: dict[int, tuple[Axes, Part, Line2D]] = {}
    for i, part in enumerate(reversed(parts)):  # from below
        axes = box(across + 230, 70 + i * room, 350, room - 70)
        plot_curve(axes, part, pole)
        marker = axes.plot([], [], "o", color="k", markersize=8, animated=True)[0]
        markers |= {int(row["point"]): (axes, part, marker) for row in part.rows}
    title = figure.text(15 / width, 1 - 12 / height, "", va="top", animated=True)
    canvas.draw()
    still = canvas.copy_from_bbox(figure.bbox)
    frames = []
    for view, text, row in zip(views, titles, shown, strict=True):
        canvas.restore_region(still)
        title.set_text(text)
        figure.draw_artist(title)
        if row["point"] in markers:
            axes, part, marker = markers[int(row["point"])]
            marker.set_data(*([x] for x in place(row, part.amplitude)))
            axes.draw_artist(marker)
        frame = np.array(canvas.buffer_rgba())[:, :, :3]
        _lay(view.image, frame[height - low - high : height - low, 10 : 10 + across])
        frames.append(frame)
    return frames


def _lay(image: Image, under: NDArray[np.uint8]) -> None:
    """Put an image with transparency on a part of a frame."""
    part = image[..., 3:] / 255
    laid = part * image[..., :3] + (1 - part) * under
    edge = RIM * edge_of(part)
    under[:] = np.rint((1 - edge) * laid + edge * 255 * GREY)


def edge_of(part: Array) -> Array:
    """Where what is drawn ends, of how much of each pixel (n, m, 1) it covers: one in the pixels at
    its rim.
    """
    least = part.copy()
    for axis, way in ((0, 1), (0, -1), (1, 1), (1, -1)):
        least = np.minimum(least, np.roll(part, way, axis))
    return np.asarray(part - least)


def _scale(factor: float) -> str:
    return "displacements to scale" if factor == 1 else rf"displacements drawn $\times$ {factor:g}"
