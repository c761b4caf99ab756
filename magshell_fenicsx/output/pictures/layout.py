"""Figures of panels: images of shells with outlines, arrows, colour bars and the directions of e1,
e2, e3.
"""

import io
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.pictures.scales import Scale, colour_bar
from magshell_fenicsx.output.pictures.view import Camera, Image, Window, axes_on_screen
from magshell_fenicsx.problem.wanted import OutputSection

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Pen = tuple[str, str]
INCH = 25.4  # mm
ONE, SEVERAL = 90.0, 180.0  # default widths in mm: one and two columns of a journal
GAP = 4.0  # mm between panels
HEAD = 0.012  # around the ends of arrows, over a panel's width
LONG = 0.08  # an arrow of this length over a panel's width has the full thickness
LINE = 1.45 / 72  # height of a line of text in inches, for each point of the font
LETTER = 0.6  # room of a letter beside the directions
LEVEL = 3  # files are a quarter larger than by default and take a third of the time


@dataclass(frozen=True)
class Arrow:
    """Arrows in a panel: feet and vectors (n, 3) as the camera projects them, colour, name."""

    feet: Array
    vectors: Array
    colour: str
    name: str


@dataclass(frozen=True)
class Panel:
    """One view of a shell.

    Attributes
    ----------
    lines
        Lines (n, 2) in the projection, with their pens: a grey, and matplotlib's name of dashes.
    texts
        Places in the projection, and letters there.
    names
        The same of names of shells.
    """

    image: Image
    window: Window
    camera: Camera
    scale: Scale = field(default_factory=Scale)
    lines: tuple[tuple[Array, Pen], ...] = ()
    arrows: tuple[Arrow, ...] = ()
    texts: tuple[tuple[float, float, str], ...] = ()
    names: tuple[tuple[float, float, str], ...] = ()

    @property
    def frame(self) -> tuple[float, float, float, float]:
        """(left, right, low, high) of what is drawn: the window, and arrows that leave it."""
        left, right, low, high = self.window.box
        if not any(len(arrows.feet) for arrows in self.arrows):
            return self.window.box
        x, y = np.concatenate(
            [p[:, :2] for a in self.arrows for p in (a.feet, a.feet + a.vectors)]
        ).T
        spare = HEAD * (right - left)
        return (
            min(left, x.min() - spare),
            max(right, x.max() + spare),
            min(low, y.min() - spare),
            max(high, y.max() + spare),
        )

    @property
    def size(self) -> tuple[float, float]:
        """Height and width in pixels, the width that of the image."""
        left, right, low, high = self.frame
        width = self.image.shape[1]
        return width * (high - low) / (right - left), width


def drawing(style: OutputSection) -> AbstractContextManager[None]:
    """Matplotlib's settings while a figure is made and written: text stays text in svg and pdf."""
    import matplotlib

    size = style.font_size
    own: dict[str, Any] = {
        "font.size": size,
        "axes.labelsize": size,
        "axes.titlesize": size,
        "legend.fontsize": size,
    }
    own |= {"xtick.labelsize": 0.9 * size, "ytick.labelsize": 0.9 * size, "axes.linewidth": 0.6}
    own |= {"svg.fonttype": "none", "pdf.fonttype": 42, "svg.hashsalt": "magshell"}
    return matplotlib.rc_context(own)


def columns(panels: int) -> int:
    """The number of panels beside each other, of so many."""
    return panels if panels < 4 else 2 if panels == 4 else 3


def panel_width(style: OutputSection, beside: int) -> int:
    """The width of a panel's image in pixels, of so many panels beside each other."""
    width = style.width or (ONE if beside == 1 else SEVERAL)
    return max(int((width / beside - GAP) / INCH * style.dpi), 50)


def panels_figure(panels: Sequence[Panel], style: OutputSection, note: str = "") -> "Figure":
    """Panels in rows, each above its colour bar; the directions once; a note at the foot."""
    from matplotlib.figure import Figure

    across, line = columns(len(panels)), LINE * style.font_size
    rows = -(-len(panels) // across)
    gap, dpi = GAP / INCH, style.dpi
    tall, wide = (max(size) / dpi for size in zip(*(panel.size for panel in panels), strict=True))
    wide += gap
    barred = any(panel.scale.colours for panel in panels)
    below = (4.2 if barred else 0.4) * line
    legend = max((sum(bool(arrows.name) for arrows in panel.arrows) for panel in panels), default=0)
    above = gap / 2 + legend * line
    beside = (
        barred and across < 3
    )  # the directions stand beside the first bar, else in a free panel or at the foot
    free = 0 if beside else len(panels) % across
    indent = gap / 2 + (0.0 if beside or free else 4.0 * line)
    notes = _wrapped(note, wide * across - indent - gap / 2, style.font_size)
    foot = max(len(notes) * line, 0.0 if beside or free else 3.2 * line)
    height = rows * (tall + below + above) + foot
    figure = Figure(figsize=(wide * across, height), dpi=dpi)
    boxes = Boxes(figure)
    for i, panel in enumerate(panels):
        left, low = i % across * wide, height - (i // across + 1) * (tall + below + above)
        h, w = (n / dpi for n in panel.size)
        start = left + (wide - w) / 2
        draw_panel(boxes.axes(start, low + below + (tall - h) / 2, w, h), panel, style)
        for k, arrows in enumerate(panel.arrows):
            y = low + below + tall + above - gap / 2 - (k + 0.5) * line
            figure.text(
                *boxes.place(left + gap / 2, y), arrows.name, color=arrows.colour, va="center"
            )
        if panel.scale.colours:
            spare = (4.4 if beside else 2.2) * line  # a power of ten needs the other side
            reach = max(wide - gap - spare - 3.2 * line, 3 * line)
            bar = boxes.axes(left + gap / 2 + spare, low + 1.7 * line, reach, 0.65 * line)
            colour_bar(figure, bar, panel.scale, room=reach + (0.8 if beside else 2 * 2.2) * line)
    size, low = 3.4 * line, height - (tall + below + above) if beside else foot
    low += -3.3 * line if not beside and not free else 0.4 * line
    directions(boxes.axes(free * wide + gap / 2, low, size, size), panels[0].camera, style)
    for k, text in enumerate(reversed(notes)):
        figure.text(
            *boxes.place(indent, (k + 0.5) * line),
            text,
            va="center",
            fontsize=0.9 * style.font_size,
        )
    return figure


@dataclass(frozen=True)
class Boxes:
    """Places in inches from the lower left of a figure."""

    figure: "Figure"

    def place(self, x: float, y: float) -> tuple[float, float]:
        """In the figure's own coordinates."""
        wide, tall = self.figure.get_size_inches()
        return x / wide, y / tall

    def axes(self, left: float, low: float, width: float, height: float) -> "Axes":
        """Axes in a box."""
        return self.figure.add_axes((*self.place(left, low), *self.place(width, height)))


def draw_panel(axes: "Axes", panel: Panel, style: OutputSection) -> None:
    """Draw a panel's image, lines, arrows and names in axes of its proportions."""
    from matplotlib.patheffects import withStroke

    left, right, low, high = panel.frame
    same = panel.frame == panel.window.box  # pixel by pixel
    axes.imshow(
        panel.image,
        extent=panel.window.box,
        interpolation="none" if same else "antialiased",
        aspect="auto",
    )
    for line, (grey, dashes) in panel.lines:
        axes.plot(*line.T, dashes, color=grey, lw=0.06 * style.font_size)
    for arrows in panel.arrows:
        _draw_arrows(axes, arrows, right - left, style)
    for x, y, text in panel.texts:
        axes.text(
            x,
            y,
            text,
            ha="center",
            va="center",
            color="white",
            weight="bold",
            fontsize=0.9 * style.font_size,
        )
    for x, y, name in panel.names:
        around = [withStroke(linewidth=0.25 * style.font_size, foreground="white")]
        axes.text(
            x,
            y,
            name,
            ha="center",
            va="center",
            color="0.1",
            fontsize=0.9 * style.font_size,
            path_effects=around,
        )
    axes.set(xlim=(left, right), ylim=(low, high))
    axes.set_axis_off()


def _draw_arrows(axes: "Axes", arrows: Arrow, extent: float, style: OutputSection) -> None:
    """In the plane of the picture; what points to the eye is a dot in a circle, what points away a
    cross in it.
    """
    flat, length = arrows.vectors[:, :2], np.linalg.norm(arrows.vectors, axis=1)
    along = np.linalg.norm(flat, axis=1) < 0.3 * length
    x, y = arrows.feet[:, :2].T
    thin = min(1.0, float(np.linalg.norm(flat, axis=1).max(initial=0.0)) / (LONG * extent))
    axes.quiver(
        *(x[~along], y[~along], *flat[~along].T),
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.006 * thin,
        minlength=0,
        zorder=4,
        clip_on=False,
        color=arrows.colour,
        headwidth=4,
        headlength=5,
        headaxislength=4.5,
    )
    size = (0.9 * style.font_size) ** 2
    axes.scatter(
        x[~along], y[~along], s=size / 9 * thin**2, color=arrows.colour, zorder=4, linewidths=0
    )
    for inside, marker in ((arrows.vectors[:, 2] > 0, "."), (arrows.vectors[:, 2] <= 0, "x")):
        at = along & inside
        if at.any():
            axes.scatter(
                x[at],
                y[at],
                s=size,
                facecolors="white",
                edgecolors=arrows.colour,
                linewidths=0.8,
                zorder=5,
            )
            axes.scatter(
                x[at],
                y[at],
                s=size / 3,
                color=arrows.colour,
                marker=marker,
                linewidths=0.8,
                zorder=6,
            )


def directions(axes: "Axes", camera: Camera, style: OutputSection) -> None:
    """Draw the directions of e1, e2, e3."""
    axes.set(xlim=(-1.5, 1.5), ylim=(-1.5, 1.5))
    axes.set_axis_off()
    on_screen = axes_on_screen(camera.direction)
    arrow = {
        "arrowstyle": "->",
        "shrinkA": 0,
        "shrinkB": 0,
        "lw": 0.7,
        "mutation_scale": style.font_size * 0.8,
    }
    written = list[Array]()
    for number, (x, y) in enumerate(zip(*(0.9 * on_screen).T, strict=True), 1):
        size = float(np.hypot(x, y))
        if size < 0.05:  # it points to the eye, or away
            axes.plot(0, 0, "k.", ms=0.4 * style.font_size)
            x, y, size = -0.35, -0.35, 0.5
        else:
            axes.annotate("", (x, y), (0, 0), arrowprops=arrow)
        written.append(_beside(np.array([x, y]), size, written))
        axes.text(
            float(written[-1][0]), float(written[-1][1]), f"$e_{number}$", ha="center", va="center"
        )


def _beside(end: Array, size: float, others: Sequence[Array]) -> Array:
    """Where the letter of an arrow stands: ahead of its end, or beside it if another letter is
    there.
    """
    ahead, across = 0.4 * end / size, LETTER * np.array([-end[1], end[0]]) / size
    places = [end + ahead, end + across, end - across]
    free = [
        place for place in places if all(np.linalg.norm(place - other) > LETTER for other in others)
    ]
    return np.asarray((free or places)[0])


def _wrapped(text: str, inches: float, size: float) -> list[str]:
    import textwrap

    return textwrap.wrap(text, max(int(inches * 72 / (0.47 * size)), 20)) if text else []


def written(figure: "Figure", style: OutputSection, name: str) -> Iterator[tuple[str, bytes]]:
    """Names and contents of a figure's files: PNG and the further formats."""
    with drawing(style):
        yield f"{name}.png", png(figure)
    for kind in dict.fromkeys(kind for kind in style.formats if kind != "png"):
        content = io.BytesIO()
        with drawing(style):
            figure.savefig(content, format=kind, dpi=style.dpi, metadata={_DATE[kind]: None})
        yield f"{name}.{kind}", content.getvalue()


_DATE = {"svg": "Date", "pdf": "CreationDate"}


def png(figure: "Figure") -> bytes:
    """A PNG file, without the fourth channel that Matplotlib writes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image as Pillow

    canvas, content = FigureCanvasAgg(figure), io.BytesIO()
    canvas.draw()
    colours = Pillow.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    colours.save(content, "PNG", dpi=(figure.dpi, figure.dpi), compress_level=LEVEL)
    return content.getvalue()
