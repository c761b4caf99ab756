"""Layout of figures: panels with images of shells, outlines, arrows and colour bars, in inches.

A figure has cells of one size in rows, each with the image of a panel in the middle, the names of
arrows above it and its colour bar below. The directions of e1, e2, e3 are drawn once in a figure. A
window is the part of the camera's projection that an image shows, over the reference length R. A
pen is a grey and a style of dashes. Room for text is counted in lines, `line_height`; numbers that
multiply it are chosen by eye. The size of a font is in points, 1/72 inch.
"""

import io
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.pictures.rendering import Camera, Image, Window, axes_on_screen
from magshell_fenicsx.output.pictures.scales import Scale, colour_bar, pixel_canvas
from magshell_fenicsx.output.pictures.sections import UprightSection
from magshell_fenicsx.problem.requests import OutputSection

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Pen = tuple[str, str]
INCH = 25.4  # mm
ONE_COLUMN, TWO_COLUMNS = 90.0, 180.0  # mm: default widths, of a journal
GAP = 4.0  # mm between panels
ARROW_MARGIN = 0.012  # around the ends of arrows, over a panel's width
FULL_ARROW_LENGTH = 0.08  # over a panel's width: a longer arrow has the full thickness
LINE_HEIGHT = 1.45 / 72  # inches of a line of text, for each point of the font
SECTION_LINES = 2.4  # of text: room around a section, with its words
MAX_SECTION_HEIGHT = 0.5  # over the width of an image
TINY = 1e-300  # least divisor
LETTER_WIDTH = 0.53  # of the font
LETTER_DISTANCE = 0.6  # least distance of letters at the directions
MAX_SLOPE_TO_EYE = 0.3  # length in the picture over the length, of an arrow drawn as a point
MIN_DIRECTION = 0.05  # length in the picture of a direction that is no point
COMPRESSION_LEVEL = 3  # PNG files are a quarter larger than by default and take a third of the time


@dataclass(frozen=True)
class Arrow:
    """Arrows of one field in a panel.

    Attributes
    ----------
    feet, vectors
        (n, 3) places and vectors as the camera projects them: right, up, towards the eye.
    colour, name
        Colour of all arrows, and the name of the field.
    """

    feet: Array
    vectors: Array
    colour: str
    name: str


@dataclass(frozen=True)
class Panel:
    """One view of a shell in a figure.

    Attributes
    ----------
    image
        (height, width, 4) colours.
    window
        Part of the projection that the image shows.
    camera
        Projection.
    scale
        What the colours mean.
    lines
        Lines (n, 2) in the projection, with their pens: a grey, and matplotlib's name of dashes.
    arrows
        Arrows of fields.
    texts
        (x, y, letter) in the projection, of the poles of magnets.
    names
        (x, y, name) in the projection, of shells.
    section
        The shell in an upright plane, drawn below the image; None for none.
    """

    image: Image
    window: Window
    camera: Camera
    scale: Scale = field(default_factory=Scale)
    lines: tuple[tuple[Array, Pen], ...] = ()
    arrows: tuple[Arrow, ...] = ()
    texts: tuple[tuple[float, float, str], ...] = ()
    names: tuple[tuple[float, float, str], ...] = ()
    section: UprightSection | None = None

    @property
    def frame(self) -> tuple[float, float, float, float]:
        """Box (left, right, low, high) over R around the window and all arrows, with a margin."""
        left, right, low, high = self.window.box
        if not any(len(arrows.feet) for arrows in self.arrows):
            return self.window.box
        ends = list[Array]()
        for arrows in self.arrows:
            ends += [arrows.feet[:, :2], (arrows.feet + arrows.vectors)[:, :2]]
        x, y = np.concatenate(ends).T
        margin = ARROW_MARGIN * (right - left)
        return (
            min(left, x.min() - margin),
            max(right, x.max() + margin),
            min(low, y.min() - margin),
            max(high, y.max() + margin),
        )

    @property
    def size(self) -> tuple[float, float]:
        """Height and width in pixels; the width is that of the image."""
        left, right, low, high = self.frame
        width = self.image.shape[1]
        return width * (high - low) / (right - left), width

    @property
    def section_size(self) -> tuple[float, float]:
        """Height and width of the section in pixels, 0 without one.

        It has the scale of the image, or a smaller one if it would be wider than that, or too tall.
        """
        if self.section is None:
            return 0.0, 0.0
        left, right, low, high = self.section.box
        width = self.image.shape[1]
        scale = min(
            self.window.scale,
            width / max(right - left, TINY),
            MAX_SECTION_HEIGHT * width / max(high - low, TINY),
        )
        return scale * (high - low), scale * (right - left)


def drawing(style: OutputSection) -> AbstractContextManager[None]:
    """Return a context with matplotlib's settings for making and writing a figure.

    Text stays text in svg and pdf.
    """
    import matplotlib

    font_size = style.font_size
    settings: dict[str, Any] = {
        "font.size": font_size,
        "axes.labelsize": font_size,
        "axes.titlesize": font_size,
        "legend.fontsize": font_size,
    }
    settings |= {
        "xtick.labelsize": font_size,
        "ytick.labelsize": font_size,
        "axes.linewidth": 0.6,
    }
    # text stays text; a fixed salt makes equal pictures equal files
    settings |= {"svg.fonttype": "none", "pdf.fonttype": 42, "svg.hashsalt": "magshell"}
    return matplotlib.rc_context(settings)


def columns(panels: int) -> int:
    """Return the number of panels in a row, of `panels` in all."""
    if panels == 4:
        return 2
    return min(panels, 3)


def panel_width(style: OutputSection, panels_per_row: int) -> int:
    """Return the width of a panel's image in pixels, with `panels_per_row` panels in a row."""
    width = style.width or (ONE_COLUMN if panels_per_row == 1 else TWO_COLUMNS)
    return max(int((width / panels_per_row - GAP) / INCH * style.dpi), 50)


def panels_figure(panels: Sequence[Panel], style: OutputSection, note: str = "") -> "Figure":
    """Return a figure with panels in rows, each above its colour bar.

    The directions of e1, e2, e3 are drawn once. `note` is at the foot. Lengths and places in the
    code are in inches from the lower left of the figure.
    """
    from matplotlib.figure import Figure

    per_row = columns(len(panels))
    row_count = -(-len(panels) // per_row)  # rounded up
    cell = _CellSizes.around(panels, style)
    line_height, gap, dpi = cell.line_height, GAP / INCH, style.dpi

    # the directions are beside the first bar, else in a free cell or at the foot
    has_bar = any(panel.scale.colours for panel in panels)
    beside_bar = has_bar and per_row < 3
    cells_in_last_row = 0 if beside_bar else len(panels) % per_row  # 0 too if no cell is free there
    at_foot = not beside_bar and not cells_in_last_row
    indent = gap / 2 + (4.0 * line_height if at_foot else 0.0)  # of the note
    note_lines = _wrapped(note, cell.width * per_row - indent - gap / 2, style.font_size)
    foot_height = max(len(note_lines) * line_height, 3.2 * line_height if at_foot else 0.0)
    height = row_count * cell.height + foot_height
    figure = Figure(figsize=(cell.width * per_row, height), dpi=dpi)
    boxes = FigureBoxes(figure)
    for i, panel in enumerate(panels):
        left, lower = i % per_row * cell.width, height - (i // per_row + 1) * cell.height
        panel_height, width = (pixels / dpi for pixels in panel.size)
        panel_left = left + (cell.width - width) / 2
        panel_low = lower + cell.height_below + (cell.image_height - panel_height) / 2
        draw_panel(boxes.axes(panel_left, panel_low, width, panel_height), panel, style)
        _draw_names_of_arrows(boxes, panel, cell, left, lower)
        if panel.scale.colours:
            _draw_bar(boxes, panel.scale, cell, left, lower, with_directions=beside_bar)
        if panel.section:
            _draw_section(boxes, panel, panel.section, cell, left, lower)
    directions_size, lower = 3.4 * line_height, height - cell.height if beside_bar else foot_height
    lower += -3.3 * line_height if at_foot else 0.4 * line_height
    directions_axes = boxes.axes(
        cells_in_last_row * cell.width + gap / 2, lower, directions_size, directions_size
    )
    directions(directions_axes, panels[0].camera, style)
    for k, text in enumerate(reversed(note_lines)):
        text_place = boxes.place(indent, (k + 0.5) * line_height)
        figure.text(*text_place, text, va="center", fontsize=style.font_size)
    return figure


def _named_arrow_count(panel: Panel) -> int:
    """Return how many arrows of a panel have a name, each a line of its legend."""
    return sum(bool(arrows.name) for arrows in panel.arrows)


@dataclass(frozen=True)
class _CellSizes:
    """Sizes of the cells of a figure, in inches; each cell has one panel.

    Attributes
    ----------
    line_height
        Height of a line of text.
    width
        Width of a cell.
    image_height
        Height of the tallest image.
    height_of_bar
        Height of the bar with its numbers and its caption, at the foot of a cell.
    height_of_section
        Height below an image, of the tallest section with its caption.
    height_above
        Height above an image, of a line for each field of arrows.
    """

    line_height: float
    width: float
    image_height: float
    height_of_bar: float
    height_of_section: float
    height_above: float

    @classmethod
    def around(cls, panels: Sequence[Panel], style: OutputSection) -> "_CellSizes":
        """Return the sizes of cells in which each of some panels has room."""
        line_height = LINE_HEIGHT * style.font_size
        gap, dpi = GAP / INCH, style.dpi
        heights, widths = zip(*(panel.size for panel in panels), strict=True)
        image_height, cell_width = max(heights) / dpi, max(widths) / dpi + gap
        has_bar = any(panel.scale.colours for panel in panels)
        height_of_bar = (4.2 if has_bar else 0.4) * line_height
        section_height = max(panel.section_size[0] for panel in panels) / dpi
        height_of_section = section_height + SECTION_LINES * line_height if section_height else 0.0
        legend_lines = max((_named_arrow_count(panel) for panel in panels), default=0)
        height_above = gap / 2 + legend_lines * line_height
        return cls(
            line_height, cell_width, image_height, height_of_bar, height_of_section, height_above
        )

    @property
    def height_below(self) -> float:
        """Height below an image."""
        return self.height_of_bar + self.height_of_section

    @property
    def height(self) -> float:
        """Height of a cell."""
        return self.image_height + self.height_below + self.height_above


def _draw_section(
    boxes: "FigureBoxes",
    panel: Panel,
    section: UprightSection,
    cell: _CellSizes,
    left: float,
    lower: float,
) -> None:
    """Draw the section of a panel between its image and its bar, with words below it.

    `left` and `lower` are the lower left corner of the panel's cell.
    """
    height, width = (pixels / boxes.figure.dpi for pixels in panel.section_size)
    middle, words_low = left + cell.width / 2, lower + cell.height_of_bar
    low = words_low + cell.height_of_section - 0.5 * cell.line_height - height
    section.draw(boxes.axes(middle - width / 2, low, width, height))
    place = boxes.place(middle, low - 0.9 * cell.line_height)
    words = f"section {section.words}; grey: undeformed"
    boxes.figure.text(*place, words, ha="center", va="center")


def _draw_names_of_arrows(
    boxes: "FigureBoxes", panel: Panel, cell: _CellSizes, left: float, lower: float
) -> None:
    """Draw the names of a panel's arrows above its image, in their colours.

    `left` and `lower` are the lower left corner of the panel's cell.
    """
    for k, arrows in enumerate(panel.arrows):
        y = (
            lower
            + cell.height_below
            + cell.image_height
            + cell.height_above
            - GAP / INCH / 2
            - (k + 0.5) * cell.line_height
        )
        text_place = boxes.place(left + GAP / INCH / 2, y)
        boxes.figure.text(*text_place, arrows.name, color=arrows.colour, va="center")


def _draw_bar(
    boxes: "FigureBoxes",
    scale: Scale,
    cell: _CellSizes,
    left: float,
    lower: float,
    *,
    with_directions: bool,
) -> None:
    """Draw a colour bar below the image of a cell.

    Parameters
    ----------
    left, lower
        Lower left corner of the cell.
    with_directions
        Whether the directions are to the left of the first bar, so that all bars leave room there.
    """
    gap, line_height = GAP / INCH, cell.line_height
    # at the right there is room for a power of ten
    room_at_left = (4.4 if with_directions else 2.2) * line_height
    bar_length = max(cell.width - gap - room_at_left - 3.2 * line_height, 3 * line_height)
    bar_axes = boxes.axes(
        left + gap / 2 + room_at_left, lower + 1.7 * line_height, bar_length, 0.65 * line_height
    )
    caption_room = bar_length + (0.8 if with_directions else 2 * 2.2) * line_height
    colour_bar(boxes.figure, bar_axes, scale, room=caption_room)


@dataclass(frozen=True)
class FigureBoxes:
    """Boxes of a figure, given in inches from its lower left."""

    figure: "Figure"

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Return a place in the figure's own coordinates, from 0 to 1."""
        width, height = self.figure.get_size_inches()
        return x / width, y / height

    def axes(self, left: float, low: float, width: float, height: float) -> "Axes":
        """Return new axes in the box with lower left corner (left, low)."""
        return self.figure.add_axes((*self.place(left, low), *self.place(width, height)))


def draw_panel(axes: "Axes", panel: Panel, style: OutputSection) -> None:
    """Draw a panel's image, lines, arrows and names in axes of its proportions."""
    from matplotlib.patheffects import withStroke

    left, right, low, high = panel.frame
    is_whole_image = panel.frame == panel.window.box  # then it is drawn pixel by pixel
    axes.imshow(
        panel.image,
        extent=panel.window.box,
        interpolation="none" if is_whole_image else "antialiased",
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
            fontsize=style.font_size,
        )
    for x, y, name in panel.names:
        halo = [withStroke(linewidth=0.25 * style.font_size, foreground="white")]
        axes.text(
            x,
            y,
            name,
            ha="center",
            va="center",
            color="0.1",
            fontsize=style.font_size,
            path_effects=halo,
        )
    axes.set(xlim=(left, right), ylim=(low, high))
    axes.set_axis_off()


def _draw_arrows(axes: "Axes", arrows: Arrow, extent: float, style: OutputSection) -> None:
    """Draw the arrows of one field in the plane of the picture.

    An arrow towards the eye is a dot in a circle, an arrow away from it a cross in a circle.
    `extent` is the width of the panel over R.
    """
    # arrows that are seen nearly from their ends are drawn as circles, the others as arrows
    in_picture, lengths = arrows.vectors[:, :2], np.linalg.norm(arrows.vectors, axis=1)
    is_point = np.linalg.norm(in_picture, axis=1) < MAX_SLOPE_TO_EYE * lengths
    x, y = arrows.feet[:, :2].T
    longest = float(np.linalg.norm(in_picture, axis=1).max(initial=0.0))
    thinness = min(1.0, longest / (FULL_ARROW_LENGTH * extent))  # short arrows are thin too
    axes.quiver(
        *(x[~is_point], y[~is_point], *in_picture[~is_point].T),
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.006 * thinness,
        minlength=0,
        zorder=4,
        clip_on=False,
        color=arrows.colour,
        headwidth=4,
        headlength=5,
        headaxislength=4.5,
    )
    # a dot at the foot of each arrow
    marker_area = (0.9 * style.font_size) ** 2
    axes.scatter(
        x[~is_point],
        y[~is_point],
        s=marker_area / 9 * thinness**2,
        color=arrows.colour,
        zorder=4,
        linewidths=0,
    )
    # circles; the third component of a vector is towards the eye
    for is_selected, marker in ((arrows.vectors[:, 2] > 0, "."), (arrows.vectors[:, 2] <= 0, "x")):
        points = is_point & is_selected
        if points.any():
            _draw_circles(axes, x[points], y[points], marker_area, arrows.colour, marker)


def _draw_circles(axes: "Axes", x: Array, y: Array, area: float, colour: str, marker: str) -> None:
    """Draw white circles at places (n,) with a marker in each; `area` is theirs in points²."""
    axes.scatter(x, y, s=area, facecolors="white", edgecolors=colour, linewidths=0.8, zorder=5)
    axes.scatter(x, y, s=area / 3, color=colour, marker=marker, linewidths=0.8, zorder=6)


def directions(axes: "Axes", camera: Camera, style: OutputSection) -> None:
    """Draw arrows along e1, e2, e3 with their letters, as the camera sees them."""
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
    letters = list[Array]()
    for number, (x, y) in enumerate(zip(*(0.9 * on_screen).T, strict=True), 1):
        length = float(np.hypot(x, y))
        if length < MIN_DIRECTION:  # it points to the eye, or away
            axes.plot(0, 0, "k.", ms=0.4 * style.font_size)
            x, y, length = -0.35, -0.35, 0.5  # the letter is beside the dot
        else:
            axes.annotate("", (x, y), (0, 0), arrowprops=arrow)
        place = _letter_place(np.array([x, y]), length, letters)
        letters.append(place)
        axes.text(float(place[0]), float(place[1]), f"$e_{number}$", ha="center", va="center")


def _letter_place(end: Array, size: float, others: Sequence[Array]) -> Array:
    """Return the place (2,) of the letter of an arrow from the origin.

    Parameters
    ----------
    end
        (2,) end of the arrow.
    size
        Length of the arrow.
    others
        Places of earlier letters; the letter is beside the arrow if one of them is ahead of it.
    """
    forward, sideways = 0.4 * end / size, LETTER_DISTANCE * np.array([-end[1], end[0]]) / size
    places = [end + forward, end + sideways, end - sideways]  # the preferred first
    for place in places:
        if all(np.linalg.norm(place - other_letter) > LETTER_DISTANCE for other_letter in others):
            return np.asarray(place)
    return np.asarray(places[0])


def place_axes(figure: "Figure") -> None:
    """Give the axes of a figure the places of its layout, which they get only when it is drawn."""
    pixel_canvas(figure)  # it measures the texts
    layout = figure.get_layout_engine()
    assert layout
    layout.execute(figure)


def _wrapped(text: str, inches: float, size: float) -> list[str]:
    """Return a text in lines that fit into a width in inches; `size` is the font's in points."""
    import textwrap

    return textwrap.wrap(text, max(int(inches * 72 / (LETTER_WIDTH * size)), 20)) if text else []


def figure_files(figure: "Figure", style: OutputSection, name: str) -> Iterator[tuple[str, bytes]]:
    """Yield names and contents of a figure's files: `name`.png, and one in each further format."""
    with drawing(style):
        yield f"{name}.png", png(figure)
    for kind in dict.fromkeys(kind for kind in style.formats if kind != "png"):
        content = io.BytesIO()
        with drawing(style):
            figure.savefig(content, format=kind, dpi=style.dpi, metadata={DATE_KEYS[kind]: None})
        yield f"{name}.{kind}", content.getvalue()


DATE_KEYS = {"svg": "Date", "pdf": "CreationDate"}  # of metadata


def png(figure: "Figure") -> bytes:
    """Return a figure as a PNG file, without the channel of opacity that Matplotlib writes."""
    from PIL import Image as Pillow

    canvas, content = pixel_canvas(figure), io.BytesIO()
    canvas.draw()
    colours = Pillow.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    colours.save(content, "PNG", dpi=(figure.dpi, figure.dpi), compress_level=COMPRESSION_LEVEL)
    return content.getvalue()
