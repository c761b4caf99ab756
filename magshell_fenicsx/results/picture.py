"""Pictures of the deformed shell: its displacement, the magnetic loads on it, its modes."""

import io
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.results.render import Image, View, axes_on_screen, rendered, smooth_surface
from magshell_fenicsx.results.surface import Surface

if TYPE_CHECKING:  # takes long to import
    import pyvista
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
DPI = 120
LOADS = {
    "p_mag": r"magnetic pressure $p_\mathrm{mag}$",
    "f_mag": r"in-plane force $|f_\mathrm{mag}|$",
    "k": "stiffness of rotational springs $k$",
    "tau": r"torque $|\tau(u)|$",
}
CONSTANT = 1e-9  # difference of a load, over that of fields along the normal, that is none
QUICKLY = {"compress_level": 3}  # a quarter larger than by default, in a third of the time
FROM_THE_SIDE = np.array([2.2, -3.6, 2.85])
SHOWN = 0.08  # lengths R that the largest displacement of a mode is drawn with


def draw_deformed(surface: Surface, h: float, title: str) -> tuple[bytes, bytes | None]:
    """Draw the deformed mid-surface coloured by w/h, and the magnetic energy read as loads on it, a panel each.

    Returns
    -------
    Two PNG files; None where there are no loads.
    """
    smooth = smooth_surface(surface, h)
    shell = _deformed(surface, smooth, h)
    shown = [name for name in LOADS if name in surface.fields]
    loads = [_load(smooth, name) for name in shown]
    images = rendered([shell, *loads])
    picture = _png(_shell(images[0], shell, title))
    return picture, _panels(images[1:], loads, [LOADS[name] for name in shown], title) if shown else None


def deformed_figure(surface: Surface, h: float, title: str) -> "Figure":
    """The first of the pictures of `draw_deformed`."""
    view = _deformed(surface, smooth_surface(surface, h), h)
    return _shell(rendered([view])[0], view, title)


def _deformed(surface: Surface, smooth: "pyvista.PolyData", h: float) -> View:
    limit = float(np.abs(surface.w).max() / h) or 1.0
    place = surface.r0[np.argmax(np.abs(surface.w))]
    return View(smooth, smooth.point_data["w_over_h"], (-limit, limit), "RdBu_r", towards(place), 1200)


def towards(place: Array) -> Array:
    """The direction (3,) from which a place (3,) of a shell shows: from above, to the side of it."""
    heading = np.arctan2(place[1], place[0]) if np.hypot(*place[:2]) > 0.1 else -0.5
    return np.array([4.2 * np.cos(heading - 0.5), 4.2 * np.sin(heading - 0.5), 2.75])


def _load(smooth: "pyvista.PolyData", name: str) -> View:
    values = np.asarray(smooth.point_data[name])
    values = np.linalg.norm(values, axis=1) if values.ndim == 2 else values
    low, high = float(values.min()), float(values.max())
    if high - low < CONSTANT:  # no pictures of rounding
        low, high = low - 1, high + 1
    return View(smooth, values, (low, high), "viridis", FROM_THE_SIDE, 700)


def _shell(image: Image, view: View, title: str) -> "Figure":
    width, height = image.shape[1] + 170, max(image.shape[0] + 60, 400)
    figure = _figure(width, height, title)
    figure.figimage(image, 20, (height - 40 - image.shape[0]) // 2)
    _colour_bar(figure, view, (width - 110, 140, 22, height - 210), "$w/h$", "vertical")
    axes = figure.add_axes(((width - 130) / width, 10 / height, 100 / width, 100 / height))
    axes.set(xlim=(-1.5, 1.5), ylim=(-1.5, 1.5))
    axes.set_axis_off()
    for number, x, y in zip((1, 2, 3), *axes_on_screen(view.camera).T, strict=True):
        axes.annotate("", (x, y), (0, 0), arrowprops={"arrowstyle": "->", "shrinkA": 0, "shrinkB": 0})
        axes.text(1.3 * x, 1.3 * y, f"$e_{number}$", ha="center", va="center", fontsize=10)
    return figure


def _panels(images: Sequence[Image], views: Sequence[View], captions: Sequence[str], title: str) -> bytes:
    """Two in a row, each with a colour bar below."""
    down, across = (max(image.shape[axis] for image in images) for axis in (0, 1))
    rows = -(-len(images) // 2)
    width, height = 2 * across + 120, rows * (down + 110) + 50
    figure = _figure(width, height, title)
    for i, (image, view, caption) in enumerate(zip(images, views, captions, strict=True)):
        left, low = 40 + (i % 2) * (across + 40), (rows - 1 - i // 2) * (down + 110)
        figure.figimage(image, left, low + 100)
        _colour_bar(figure, view, (left + 0.15 * across, low + 46, 0.7 * across, 18), caption, "horizontal")
    return _png(figure)


def _figure(width: int, height: int, title: str) -> "Figure":
    """An empty picture of so many pixels, with a title."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    figure.text(15 / width, 1 - 12 / height, title, fontsize=10, va="top")
    return figure


def _colour_bar(
    figure: "Figure", view: View, box: tuple[float, float, float, float], label: str, orientation: str
) -> None:
    """A colour bar in a box (left, low, width, height) of pixels."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    size = figure.get_size_inches() * DPI
    axes = figure.add_axes((box[0] / size[0], box[1] / size[1], box[2] / size[0], box[3] / size[1]))
    colours = ScalarMappable(Normalize(*view.limits), view.colours)
    bar = figure.colorbar(colours, cax=axes, orientation=orientation, ticks=MaxNLocator(5, steps=[1, 2, 5, 10]))
    if orientation == "vertical":
        bar.set_label(label, fontsize=10)
    else:  # above: the ticks' common factor is below
        bar.ax.set_title(label, fontsize=10, pad=5)
    bar.ax.tick_params(labelsize=9)


def _png(figure: "Figure") -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=DPI, pil_kwargs=QUICKLY)
    return content.getvalue()


def draw_modes(surfaces: Sequence[Surface], captions: Sequence[str], title: str) -> bytes:
    """Draw modes, one panel each: the deformed shell with the mode added, coloured by its normal displacement.

    Parameters
    ----------
    surfaces
        With the fields "mode" and "mode_w"; see `results.modes`.
    captions, title
        Of the panels and of all, with matplotlib's mathematics.

    Returns
    -------
    A PNG file.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    first = surfaces[0]
    camera = towards(first.r0[np.argmax(np.abs(first.fields["mode_w"]))])  # one of all, so that they can be compared
    panels = rendered([_mode(surface, camera) for surface in surfaces])
    columns = int(np.ceil(np.sqrt(len(panels))))
    rows = -(-len(panels) // columns)
    height, width = panels[0].shape[:2]
    figure = Figure(
        figsize=(3.6 * columns + 1.2, (3.6 * height / width + 0.3) * rows + 0.6), dpi=150, layout="constrained"
    )
    axes = figure.subplots(rows, columns, squeeze=False)
    for place in axes.flat:
        place.set_axis_off()
    for place, panel, caption in zip(axes.flat, panels, captions, strict=False):
        place.imshow(panel)
        place.set_title(caption, fontsize=10)
    colours = ScalarMappable(Normalize(-1, 1), cmap="RdBu_r")
    bar = figure.colorbar(colours, ax=axes, shrink=0.8, aspect=30, ticks=[-1, -0.5, 0, 0.5, 1])
    bar.set_label("inward normal displacement\nover its largest", fontsize=9)
    figure.suptitle(title, fontsize=10)
    content = io.BytesIO()
    figure.savefig(content, format="png", pil_kwargs=QUICKLY)
    return content.getvalue()


def _mode(surface: Surface, camera: Array) -> View:
    v, w = surface.fields["mode"], surface.fields["mode_w"]
    moved = replace(surface, u=surface.u + SHOWN * v, fields={"mode_w": w / (np.abs(w).max() or 1.0)})
    smooth = smooth_surface(moved, 1.0)
    return View(smooth, smooth.point_data["mode_w"], (-1.0, 1.0), "RdBu_r", camera, 1000)
