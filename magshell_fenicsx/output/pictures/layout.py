"""Figures around bare views: titles, colour bars, axes, panels."""

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

from magshell_fenicsx.output.pictures.render import Image, View, axes_on_screen

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 120
CAPTION, TITLE = 360, 560  # least width of a panel's caption and of a title, pixels
QUICKLY = {"compress_level": 3}  # files are a quarter larger than by default and take a third of the time


def empty_figure(width: int, height: int, title: str) -> "Figure":
    """An empty picture of a size in pixels, with a title."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    text = figure.text(15 / width, 1 - 12 / height, title, fontsize=10, va="top")
    if title and (wide := text.get_window_extent().width) > width - 30:
        text.set_fontsize(10 * (width - 30) / wide)
    return figure


def axes_in(figure: "Figure", left: float, low: float, width: float, height: float) -> "Axes":
    """Axes in a box of pixels."""
    across, up = figure.get_size_inches() * DPI
    return figure.add_axes((left / across, low / up, width / across, height / up))


def beside(image: Image, view: View, title: str) -> "Figure":
    """One view with its colour bar and the directions of e1, e2, e3 on the right."""
    figure = with_margin(image, 170, title)
    width, height = (figure.get_size_inches() * DPI).round()
    colour_bar(figure, view, (width - 110, 140, 22, height - 210), "vertical")
    directions(figure, view, width - 130, 10)
    return figure


def with_margin(image: Image, margin: int, title: str) -> "Figure":
    """A figure with an image on the left and a margin in pixels on the right."""
    width, height = max(image.shape[1] + margin, TITLE), max(image.shape[0] + 60, 400)
    figure = empty_figure(width, height, title)
    figure.figimage(image, (width - margin - image.shape[1]) // 2 + 20, (height - 40 - image.shape[0]) // 2)
    return figure


def panels(images: Sequence[Image], views: Sequence[View], title: str) -> "Figure":
    """Two images per row, each with a colour bar below."""
    down, across = (max(least, *(image.shape[axis] for image in images)) for axis, least in ((0, 0), (1, CAPTION)))
    rows = -(-len(images) // 2)
    width, height = 2 * across + 120, rows * (down + 110) + 50
    figure = empty_figure(width, height, title)
    for i, (image, view) in enumerate(zip(images, views, strict=True)):
        left, low = 40 + (i % 2) * (across + 40), (rows - 1 - i // 2) * (down + 110)
        figure.figimage(image, left + (across - image.shape[1]) // 2, low + 100)
        colour_bar(figure, view, (left + 0.15 * across, low + 46, 0.7 * across, 18), "horizontal")
    return figure


def directions(figure: "Figure", view: View, left: float, low: float) -> None:
    """Draw the directions of e1, e2, e3 in a view, in a square of 100 pixels."""
    axes = axes_in(figure, left, low, 100, 100)
    axes.set(xlim=(-1.5, 1.5), ylim=(-1.5, 1.5))
    axes.set_axis_off()
    for number, x, y in zip((1, 2, 3), *axes_on_screen(view.camera).T, strict=True):
        axes.annotate("", (x, y), (0, 0), arrowprops={"arrowstyle": "->", "shrinkA": 0, "shrinkB": 0})
        axes.text(1.3 * x, 1.3 * y, f"$e_{number}$", ha="center", va="center", fontsize=10)


def colour_bar(figure: "Figure", view: View, box: tuple[float, float, float, float], orientation: str) -> None:
    """Draw a colour bar in a box (left, low, width, height) of pixels; its ends are pointed if values exceed them."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    colours = ScalarMappable(Normalize(*view.limits), view.colours)
    below, above = view.values.min() < view.limits[0], view.values.max() > view.limits[1]
    bar = figure.colorbar(
        colours,
        cax=axes_in(figure, *box),
        orientation=orientation,
        ticks=MaxNLocator(5, steps=[1, 2, 5, 10]),
        extend="both" if below and above else "min" if below else "max" if above else "neither",
    )
    if orientation == "vertical":
        bar.set_label(view.caption, fontsize=10)
    else:  # above the bar, because the ticks' common factor is below it
        bar.ax.set_title(view.caption, fontsize=10, pad=5)
    bar.ax.tick_params(labelsize=9)


def png(figure: "Figure") -> bytes:
    """A PNG file."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=figure.dpi, pil_kwargs=QUICKLY)
    return content.getvalue()
