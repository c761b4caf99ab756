"""Colours and numbers: colour maps, bars with the values at their ends, numbers of axes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.ticker import ScalarFormatter

SIGNED = "signed"  # the colours of fields with a sign
NEAR = "near"  # those of a distance: what is farther than the limit is grey
FAR = "0.86"  # that grey
COLOURS = 257
CLOSE = 0.16  # of a bar: ticks nearer to its ends give way to the numbers there
LETTERS = 3.2  # the same on a short bar, in heights of a letter


@dataclass(frozen=True)
class Scale:
    """Limits of colours, a colour map (`SIGNED`, `NEAR` or one of matplotlib's; empty for none),
    and what they mean.

    `beyond`: whether values lie below and above the limits.
    """

    limits: tuple[float, float] = (0.0, 1.0)
    colours: str = ""
    caption: str = ""
    beyond: tuple[bool, bool] = (False, False)


def colour_map(name: str, limits: tuple[float, float] = (-1.0, 1.0)) -> "Colormap":
    """A colour map between limits.

    That of fields with a sign is white at zero and equally dark at equal distances from it: between
    zero and a positive limit it is its red half.
    """
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap, to_rgb

    if name == NEAR:
        colours = colormaps["viridis_r"](np.linspace(0, 1, COLOURS))[:, :3]
        colours[-1] = to_rgb(FAR)
        return ListedColormap(colours, name).with_extremes(over=FAR)
    if name != SIGNED:
        return colormaps[name].resampled(COLOURS)
    at = 0.5 + np.linspace(*limits, COLOURS) / (2 * max(map(abs, limits)))
    colours = colormaps["RdBu_r"](at)[:, :3]
    near = np.clip(1 - np.abs(at - 0.5) / 0.1, 0, 1)[
        :, None
    ]  # the map's own middle is a light grey
    return ListedColormap(
        np.minimum(colours + near * (1 - np.array(colormaps["RdBu_r"](0.5)[:3])), 1), name
    )


def from_zero(low: float, high: float, least: float = 0.01) -> tuple[float, float]:
    """Limits of a field with a sign: its own and zero; what is below a part `least` of the other
    end is none.

    Examples
    --------
    >>> from_zero(-1.0, 4.0), from_zero(2.0, 4.0), from_zero(-0.01, 4.0), from_zero(0.0, 0.0)
    ((-1.0, 4.0), (0.0, 4.0), (0.0, 4.0), (-1.0, 1.0))
    """
    low, high = min(low, 0.0), max(high, 0.0)
    if not high - low > 0:
        return -1.0, 1.0
    return (0.0 if -low < least * high else low), (0.0 if high < -least * low else high)


def colour_bar(
    figure: "Figure", axes: "Axes", of: Scale, orientation: str = "horizontal", room: float = np.inf
) -> None:
    """Draw a colour bar with the values at its ends, which are pointed if values lie beyond them.

    Parameters
    ----------
    room
        Inches that the caption above a horizontal bar may be wide; a longer one is written smaller.
    """
    from matplotlib import rcParams
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    extend = {
        (True, True): "both",
        (True, False): "min",
        (False, True): "max",
        (False, False): "neither",
    }
    reach = (
        axes.get_position().width * figure.get_figwidth() * 72 / rcParams["font.size"]
    )  # letters
    short = orientation == "horizontal" and reach < 16
    few, close = (3, max(CLOSE, LETTERS / reach)) if short else (5, CLOSE)
    low, high = of.limits
    between = MaxNLocator(few, steps=[1, 2, 5, 10]).tick_values(low, high)
    inner = [v for v in between if close < (v - low) / (high - low) < 1 - close]
    texts, power = numbers([low, *inner, high])
    bar = figure.colorbar(
        ScalarMappable(Normalize(*of.limits), colour_map(of.colours, of.limits)),
        cax=axes,
        orientation=orientation,
        extend=extend[of.beyond],
        extendfrac=0.04,
    )
    bar.set_ticks([low, *inner, high], labels=texts)
    if orientation == "vertical":
        bar.set_label(f"{of.caption}  ({power})" if power else of.caption)
        return
    if power:  # beside the bar, where it meets no number
        bar.ax.text(1.07, 0.5, power, transform=bar.ax.transAxes, va="center", fontsize="small")
    title = bar.ax.set_title(of.caption, pad=3)
    if np.isfinite(room):
        wide = title.get_window_extent(FigureCanvasAgg(figure).get_renderer()).width / figure.dpi
        title.set_fontsize(float(title.get_fontsize()) * min(1.0, room / wide))


def numbers(values: Sequence[float]) -> tuple[list[str], str]:
    """Numbers with three digits, and their common power of ten; empty if they need none.

    Examples
    --------
    >>> numbers([-0.5, 0.0, 20.04]), numbers([0.0, 1e-5, 3.412e-5])
    ((['−0.5', '0', '20'], ''), (['0', '1', '3.41'], '$\\\\times 10^{-5}$'))
    """
    largest = max(map(abs, values)) or 1.0
    order = int(np.floor(np.log10(largest)))
    power = 0 if -2 <= order < 4 else order
    texts = [f"{round(v / 10.0**power, 2 - order + power):.10g}" for v in values]
    return [("0" if not text.strip("-0.") else text).replace("-", "−") for text in texts], (
        rf"$\times 10^{{{power}}}$" if power else ""
    )


def number_format(limits: tuple[int, int] = (-3, 4)) -> "ScalarFormatter":
    """Numbers of an axis as plain text, with a common power of ten beyond the limits."""
    from matplotlib.ticker import ScalarFormatter

    class Numbers(ScalarFormatter):
        def get_offset(self) -> str:
            power, offset = self.orderOfMagnitude, self.offset
            if not len(self.locs):
                return ""
            return (rf"$\times 10^{{{power}}}$" if power else "") + (
                f"{offset:+.10g}" if offset else ""
            )

    numbers = Numbers(useMathText=False)
    numbers.set_powerlimits(limits)
    return numbers
