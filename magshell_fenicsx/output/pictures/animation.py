"""An animation of the path: the deformed shell, and a marker on the curve beside it."""

import io
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.curve import Part, drawn_parts, place, plot_curve
from magshell_fenicsx.output.pictures.layout import axes_in, colour_bar, empty_figure
from magshell_fenicsx.output.pictures.picture import deflected_place, towards
from magshell_fenicsx.output.pictures.render import Image, View, rendered, smooth_surface
from magshell_fenicsx.output.store.table import Row

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
FOOT = 34  # pixels below the shell


def magnification(surfaces: Sequence[Surface]) -> float:
    """The factor of the drawn displacements: the least of 1, 2, 5, 10, ... with which the largest is visible.

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
    surfaces: Sequence[Surface], h: float, titles: Sequence[str], rows: Sequence[Row], shown: Sequence[Row]
) -> bytes:
    """A GIF file.

    Parameters
    ----------
    surfaces, titles, shown
        For each frame: the whole deformed shell, the title and the row of path.csv.
    rows
        All rows of the path.
    """
    from PIL import Image as Pillow

    factor = magnification(surfaces)
    views = _views(surfaces, h, factor)
    frames = _composed(rendered(views), views[0], factor, titles, rows, shown)
    palette = _palette([frames[i] for i in sorted({0, len(frames) // 2, len(frames) - 1})])  # the same for all
    first, *others = (Pillow.fromarray(f).quantize(palette=palette, dither=Pillow.Dither.NONE) for f in frames)
    each = round(max(1000 * SECONDS / len(frames), 80), -1)
    durations = [*[each] * len(others), HELD]
    content = io.BytesIO()
    first.save(content, "GIF", save_all=True, append_images=others, duration=durations, loop=0, optimize=False)
    return content.getvalue()


def _palette(frames: Sequence[Image]) -> "Pillow.Image":
    """A palette of 2 COLOURS: half of them cover all colours, half resolve the frequent ones."""
    from PIL import Image as Pillow

    colours = Pillow.fromarray(np.unique(np.concatenate(frames).reshape(-1, 3), axis=0)[None])
    palette = Pillow.new("P", (1, 1))
    methods = Pillow.Quantize.MAXCOVERAGE, Pillow.Quantize.MEDIANCUT
    palette.putpalette([c for method in methods for c in colours.quantize(COLOURS, method).getpalette() or []])
    return palette


def _views(surfaces: Sequence[Surface], h: float, factor: float) -> list[View]:
    """The same camera, window and colours for all frames."""
    limit = max(float(np.abs(s.w).max()) / h for s in surfaces) or 1.0
    last = max(surfaces, key=lambda s: float(np.abs(s.w).max()))
    camera = towards(deflected_place(last))
    places = [np.concatenate([s.r0 + factor * s.u, *s.outlines]) for s in surfaces]
    low, high = np.min([r.min(axis=0) for r in places], axis=0), np.max([r.max(axis=0) for r in places], axis=0)
    bounds = tuple(float(x) for x in np.column_stack([low, high]).ravel())
    views = []
    for s in surfaces:
        smooth = smooth_surface(replace(s, u=factor * s.u, fields={}), factor * h)
        colours = smooth.point_data["w_over_h"]
        view = View(smooth, colours, (-limit, limit), "RdBu_r", camera, WINDOW, "$w/h$", bounds=bounds)
        views.append(replace(view, outlines=s.outlines))
    return views


def _composed(
    images: Sequence[Image],
    view: View,
    factor: float,
    titles: Sequence[str],
    rows: Sequence[Row],
    shown: Sequence[Row],
) -> list[NDArray[np.uint8]]:
    """Frames (height, width, 3); the fixed parts are drawn once, then the title and the marker on copies."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    high, across = images[0].shape[:2]
    height = max(high + 40 + FOOT, 400)
    low = FOOT + (height - 40 - FOOT - high) // 2
    figure = empty_figure(across + 600, height, "")
    canvas = FigureCanvasAgg(figure)
    colour_bar(figure, view, (across + 30, 90, 16, height - 180), "vertical")
    figure.text(15 / (across + 600), 12 / height, _scale(factor), fontsize=9)
    parts = drawn_parts(rows, str(rows[-1]["amplitude"]))[-MOST_CURVES:] if rows[-1]["amplitude"] else []
    room = (height - 70) // max(len(parts), 1)
    markers: dict[int, tuple[Axes, Part, Line2D]] = {}
    for i, part in enumerate(reversed(parts)):  # from below
        axes = axes_in(figure, across + 230, 70 + i * room, 350, room - 70)
        plot_curve(axes, part)
        marker = axes.plot([], [], "o", color="k", markersize=8, animated=True)[0]
        markers |= {int(row["point"]): (axes, part, marker) for row in part.rows}
    title = figure.text(15 / (across + 600), 1 - 12 / height, "", fontsize=10, va="top", animated=True)
    canvas.draw()
    still = canvas.copy_from_bbox(figure.bbox)
    frames = []
    for image, text, row in zip(images, titles, shown, strict=True):
        canvas.restore_region(still)
        title.set_text(text)
        figure.draw_artist(title)
        if row["point"] in markers:
            axes, part, marker = markers[int(row["point"])]
            marker.set_data(*([x] for x in place(row, part.amplitude)))
            axes.draw_artist(marker)
        frame = np.array(canvas.buffer_rgba())[:, :, :3]
        frame[height - low - high : height - low, 10 : 10 + across] = image
        frames.append(frame)
    return frames


def _scale(factor: float) -> str:
    return "displacements to scale" if factor == 1 else rf"displacements drawn $\times$ {factor:g}"
