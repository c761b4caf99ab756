"""Colours and numbers: colour maps, bars with the values at their ends, numbers of axes.

A field with a sign has a colour map that is white at zero, red above and blue below. Limits are the
values at the ends of the colours. Ticks are the values that have numbers beside a bar.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.text import Text
    from matplotlib.ticker import ScalarFormatter

SIGNED = "signed"  # colour map of fields with a sign
DISTANCE = "near"  # colour map of a distance: what is farther than the limit is grey
FAR_GREY = "0.86"
COLOURS = 257  # of a colour map
END_DISTANCE = 0.16  # of a bar: ticks nearer to its ends give way to the numbers there
END_DISTANCE_IN_LETTERS = 3.2  # the same on a short bar, in heights of a letter
MAX_INTERVALS, STEPS = 5, (1, 2, 5, 10)  # between ticks of a bar
STEP_TOLERANCE = 1e-9  # of logarithms, and of a zero over the length of a bar
MAX_DECIMALS = 5  # after the first digit of the largest number
ZERO_DISTANCE = 0.8  # least, of a zero from the end of a bar, in heights of a letter
LINE_DISTANCE = 1.1  # least, of numbers at an upright bar, in heights of a letter
DIGIT_WIDTH = 0.55  # of a number at a bar, in heights of a letter
SHORT_BAR = 16  # heights of a letter
PALENESS = 0.76  # part of matplotlib's colours in use: the others are darker than shade
WHITE_ZONE = 0.1  # of the colour map around zero that is made lighter


@dataclass(frozen=True)
class Scale:
    """Scale of a colour bar.

    Attributes
    ----------
    limits
        Values at the ends of the colours.
    colours
        A colour map: `SIGNED`, `DISTANCE` or one of matplotlib's; empty for none.
    caption
        What the colours mean.
    beyond
        Whether values lie below and above the limits.
    """

    limits: tuple[float, float] = (0.0, 1.0)
    colours: str = ""
    caption: str = ""
    beyond: tuple[bool, bool] = (False, False)


def colour_map(name: str, limits: tuple[float, float] = (-1.0, 1.0)) -> "Colormap":
    """Return the colour map of a `name` between limits, as matplotlib's object.

    The map of fields with a sign is white at zero, and equally dark at equal distances from zero.
    Between zero and a positive limit it is the red half alone. Other names are `DISTANCE` and those
    of matplotlib.
    """
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap, to_rgb

    if name == DISTANCE:
        colours = colormaps["viridis_r"](np.linspace(0, 1, COLOURS))[:, :3]
        colours[-1] = to_rgb(FAR_GREY)
        return ListedColormap(colours, name).with_extremes(over=FAR_GREY)
    if name != SIGNED:
        return colormaps[name].resampled(COLOURS)
    # matplotlib's map has positions from 0 to 1: zero is at 0.5, and the limit with the larger
    # magnitude is near one of its ends, which are too dark for shade
    positions = 0.5 + PALENESS * np.linspace(*limits, COLOURS) / (2 * max(map(abs, limits)))
    colours = colormaps["RdBu_r"](positions)[:, :3]
    # the middle of matplotlib's map is a light grey, which is made white
    nearness = np.clip(1 - np.abs(positions - 0.5) / WHITE_ZONE, 0, 1)[:, None]
    middle = np.array(colormaps["RdBu_r"](0.5)[:3])
    return ListedColormap(np.minimum(colours + nearness * (1 - middle), 1), name)


def from_zero(low: float, high: float, min_fraction: float = 0.01) -> tuple[float, float]:
    """Return colour limits of a field with a sign, which include zero.

    A limit is zero if it is smaller than a part `min_fraction` of the other one.

    Examples
    --------
    >>> from_zero(-1.0, 4.0), from_zero(2.0, 4.0), from_zero(-0.01, 4.0), from_zero(0.0, 0.0)
    ((-1.0, 4.0), (0.0, 4.0), (0.0, 4.0), (-1.0, 1.0))
    """
    low, high = min(low, 0.0), max(high, 0.0)
    if not high - low > 0:  # zero everywhere, or nan
        return -1.0, 1.0
    lower = 0.0 if -low < min_fraction * high else low
    upper = 0.0 if high < -min_fraction * low else high
    return lower, upper


def round_limits(low: float, high: float) -> tuple[float, float]:
    """Return colour limits around two values, that are multiples of the step of the bar's ticks.

    Examples
    --------
    >>> round_limits(1.048, 1.153)
    (1.0, 1.2)
    """
    from matplotlib.ticker import MaxNLocator

    ticks = MaxNLocator(MAX_INTERVALS, steps=STEPS).tick_values(low, high)
    return float(ticks[0]), float(ticks[-1])


def contour_values(low: float, high: float) -> list[float]:
    """Return the values of contours between two limits: steps of the bar's ticks, without zero.

    Examples
    --------
    >>> contour_values(-1.4, 20.0), contour_values(-20.0, 0.0)
    ([5.0, 10.0, 15.0], [-15.0, -10.0, -5.0])
    """
    from matplotlib.ticker import MaxNLocator

    ticks = MaxNLocator(MAX_INTERVALS, steps=STEPS).tick_values(low, high)
    return [float(tick) for tick in ticks if low < tick < high and tick != 0]


def colour_bar(
    figure: "Figure",
    axes: "Axes",
    scale: Scale,
    orientation: str = "horizontal",
    room: float = np.inf,
) -> None:
    """Draw a colour bar with the values at its ends.

    An end is pointed if values lie beyond it.

    Parameters
    ----------
    axes
        Axes that become the bar.
    scale
        Limits, colours and caption.
    orientation
        "horizontal" or "vertical".
    room
        Inches that the caption above a horizontal bar may be wide; a longer one is written smaller.
    """
    from matplotlib import rcParams
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    # matplotlib's names of the pointed ends
    extend = {
        (True, True): "both",
        (True, False): "min",
        (False, True): "max",
        (False, False): "neither",
    }
    is_horizontal, box = orientation == "horizontal", axes.get_position()
    width, height = figure.get_size_inches()
    inches = float(box.width * width if is_horizontal else box.height * height)
    low, high = scale.limits
    length = inches * 72 / rcParams["font.size"]  # in heights of a letter
    ticks, texts, power = _ticks(low, high, length, is_horizontal=is_horizontal)
    bar = figure.colorbar(
        ScalarMappable(Normalize(*scale.limits), colour_map(scale.colours, scale.limits)),
        cax=axes,
        orientation=orientation,
        extend=extend[scale.beyond],
        extendfrac=0.04,
    )
    bar.set_ticks(ticks, labels=texts)
    if is_horizontal:
        _make_room_for_zero(axes, ticks, texts, length / (high - low))
    else:
        bar.set_label(f"{scale.caption}  ({power})" if power else scale.caption)
        return
    if power:  # beside the bar, where it meets no number
        bar.ax.text(1.07, 0.5, power, transform=bar.ax.transAxes, va="center")
    title = bar.ax.set_title(scale.caption, pad=3)
    if np.isfinite(room):
        _fit_into(title, room, figure)


def _ticks(
    low: float, high: float, length: float, *, is_horizontal: bool
) -> tuple[list[float], list[str], str]:
    """Return the ticks of a bar with its ends, their numbers, and the common power of ten.

    Parameters
    ----------
    low, high
        Values at the ends.
    length
        Length of the bar in heights of a letter.
    """
    is_short = is_horizontal and length < SHORT_BAR
    ticks = [low, *_inner_ticks(low, high, letters=length if is_short else None), high]
    texts, power = numbers(ticks)

    def is_apart(number: int, end: int) -> bool:
        """Whether the number of an inner tick does not touch that of an end, 0 or -1.

        A zero may be so near that the number of the end gives way.
        """
        least_distance = LINE_DISTANCE
        if is_horizontal and texts[number] == "0":
            least_distance = ZERO_DISTANCE
        elif is_horizontal:
            least_distance = _distance_of_texts(texts[number], texts[end])
        return abs(ticks[number] - ticks[end]) / (high - low) * length > least_distance

    inner = [i for i in range(1, len(ticks) - 1) if is_apart(i, 0) and is_apart(i, -1)]
    shown_ticks = [0, *inner, len(ticks) - 1]
    return [ticks[i] for i in shown_ticks], [texts[i] for i in shown_ticks], power


def _make_room_for_zero(
    axes: "Axes", ticks: Sequence[float], texts: Sequence[str], letters_per_unit: float
) -> None:
    """Move the number of a bar's end outwards where it would touch a zero inside the bar.

    `axes` is the horizontal bar with its ticks and their numbers.
    """
    from matplotlib import rcParams
    from matplotlib.transforms import Affine2D

    if "0" not in texts[1:-1]:
        return
    for end, direction in ((0, -1), (-1, 1)):
        # how much nearer they are than they may be, in heights of a letter
        lack = _distance_of_texts("0", texts[end]) - abs(ticks[end]) * letters_per_unit
        if lack > 0:
            label = axes.get_xticklabels()[end]
            move = Affine2D().translate(direction * lack * rcParams["font.size"] / 72, 0.0)
            inches_to_pixels = axes.figure.dpi_scale_trans
            label.set_transform(
                label.get_transform() + inches_to_pixels.inverted() + move + inches_to_pixels
            )


def _distance_of_texts(text: str, other: str) -> float:
    """Return the least distance of the middles of two numbers, in heights of a letter."""
    return DIGIT_WIDTH * (len(text) + len(other)) / 2 + DIGIT_WIDTH


def _inner_ticks(low: float, high: float, letters: float | None) -> list[float]:
    """Return round values between the ends of a bar, not too near to the numbers there.

    Zero may be as near as its number has room, which is not checked here.

    Parameters
    ----------
    low, high
        Values at the ends.
    letters
        Length of a short bar in heights of a letter; None for a long one.
    """
    from matplotlib.ticker import MaxNLocator

    max_intervals, end_distance = MAX_INTERVALS, END_DISTANCE
    if letters is not None:
        max_intervals = 3
        end_distance = max(END_DISTANCE, END_DISTANCE_IN_LETTERS / letters)
    ticks = np.array(MaxNLocator(max_intervals, steps=STEPS).tick_values(low, high))
    positions = (ticks - low) / (high - low)
    is_zero = np.abs(ticks) < STEP_TOLERANCE * (high - low)
    margins = np.where(is_zero, 0.0, end_distance)
    return [float(tick) for tick in ticks[(margins < positions) & (positions < 1 - margins)]]


def pixel_canvas(figure: "Figure") -> "FigureCanvasAgg":
    """Return the canvas that draws a figure in pixels, the same one each time.

    So its texts are measured and drawn by one renderer: each one parses formulas anew.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = figure.canvas
    return canvas if isinstance(canvas, FigureCanvasAgg) else FigureCanvasAgg(figure)


def _fit_into(title: "Text", room: float, figure: "Figure") -> None:
    """Write a text of a figure smaller if it is wider than `room`, in inches."""
    renderer = pixel_canvas(figure).get_renderer()
    title_width = title.get_window_extent(renderer).width / figure.dpi
    reduction = min(1.0, room / title_width)  # a short caption keeps its size
    title.set_fontsize(float(title.get_fontsize()) * reduction)


def numbers(values: Sequence[float]) -> tuple[list[str], str]:
    r"""Return texts of numbers with three digits, and their common power of ten.

    The power is empty if the numbers need none.

    Examples
    --------
    >>> numbers([-0.5, 0.0, 20.04]), numbers([0.0, 1e-5, 3.412e-5])
    ((['−0.5', '0', '20'], ''), (['0', '1', '3.41'], '$\\times 10^{-5}$'))
    """
    largest = max(map(abs, values)) or 1.0
    order = int(np.floor(np.log10(largest)))  # exponent of ten of the largest number
    power = 0 if -2 <= order < 4 else order  # numbers such as 0.01 and 9999 are written plainly
    # three digits of the largest number, or as many as tell the numbers apart by a hundredth
    steps = np.diff(sorted(set(values)))
    digits = max(2, order - int(np.floor(np.log10(steps.min(initial=largest)) + STEP_TOLERANCE)))
    digits = min(digits, MAX_DECIMALS)
    texts = [f"{round(v / 10.0**power, digits - order + power):.10g}" for v in values]
    texts = [text if text.strip("-0.") else "0" for text in texts]  # also of a negative zero
    power_of_ten = rf"$\times 10^{{{power}}}$" if power else ""
    return [text.replace("-", "−") for text in texts], power_of_ten


def number_format(limits: tuple[int, int] = (-3, 4)) -> "ScalarFormatter":
    """Return a formatter of axis numbers, with a common power of ten beyond the limits.

    `limits` are exponents of ten between which numbers are plain.
    """
    from matplotlib.ticker import ScalarFormatter

    class AxisNumbers(ScalarFormatter):
        """Formatter whose power of ten is plain text."""

        def get_offset(self) -> str:
            """Return the common power of ten and offset of all numbers; matplotlib calls it."""
            power, offset = self.orderOfMagnitude, self.offset
            if not len(self.locs):  # no numbers on this axis
                return ""
            power_of_ten = rf"$\times 10^{{{power}}}$" if power else ""
            return power_of_ten + (f"{offset:+.10g}" if offset else "")

    formatter = AxisNumbers(useMathText=False)
    formatter.set_powerlimits(limits)
    return formatter
