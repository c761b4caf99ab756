"""Colour maps, colour bars and the numbers of axes."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.ticker import ScalarFormatter

SIGNED = "signed"  # the colours of fields with a sign


@dataclass(frozen=True)
class Scale:
    """Limits of colours, a colour map (`SIGNED` or one of matplotlib's; empty for none), and what they mean.

    `beyond`: whether values lie below and above the limits.
    """

    limits: tuple[float, float] = (0.0, 1.0)
    colours: str = ""
    caption: str = ""
    beyond: tuple[bool, bool] = (False, False)


def colour_map(name: str) -> "Colormap":
    """A colour map of 257 colours; that of fields with a sign is exactly white in the middle."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    if name != SIGNED:
        return colormaps[name].resampled(257)
    at = np.linspace(0, 1, 257)
    colours = colormaps["RdBu_r"](at)[:, :3]
    near = np.clip(1 - np.abs(at - 0.5) / 0.1, 0, 1)[:, None]  # the map's own middle is a light grey
    return ListedColormap(np.minimum(colours + near * (1 - colours[128]), 1), name)


def colour_bar(
    figure: "Figure", axes: "Axes", of: Scale, orientation: str = "horizontal", room: float = np.inf
) -> None:
    """Draw a colour bar; its ends are pointed if values lie beyond them.

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

    extend = {(True, True): "both", (True, False): "min", (False, True): "max", (False, False): "neither"}
    few = 3 if axes.get_position().width * figure.get_figwidth() < 16 * rcParams["font.size"] / 72 else 5
    bar: Any = figure.colorbar(
        ScalarMappable(Normalize(*of.limits), colour_map(of.colours)),
        cax=axes,
        orientation=orientation,
        ticks=MaxNLocator(few, steps=[1, 2, 5, 10]),
        extend=extend[of.beyond],
        extendfrac=0.04,
    )
    if orientation == "vertical":
        bar.set_label(of.caption)
        return
    numbers = number_format((-2, 3))
    bar.ax.xaxis.set_major_formatter(numbers)
    numbers.set_locs(bar.get_ticks())
    if power := numbers.get_offset():  # beside the bar, where it meets no number
        bar.ax.xaxis.get_offset_text().set_visible(False)
        bar.ax.text(1.07, 0.5, power, transform=bar.ax.transAxes, va="center", fontsize="small")
    title = bar.ax.set_title(of.caption, pad=3)
    if np.isfinite(room):
        wide = title.get_window_extent(FigureCanvasAgg(figure).get_renderer()).width / figure.dpi
        title.set_fontsize(title.get_fontsize() * min(1.0, room / wide))


def number_format(limits: tuple[int, int] = (-3, 4)) -> "ScalarFormatter":
    """Numbers of an axis as plain text, with a common power of ten beyond the limits."""
    from matplotlib.ticker import ScalarFormatter

    class Numbers(ScalarFormatter):
        def get_offset(self) -> str:
            power, offset = self.orderOfMagnitude, self.offset
            if not len(self.locs):
                return ""
            return (rf"$\times 10^{{{power}}}$" if power else "") + (f"{offset:+.10g}" if offset else "")

    numbers = Numbers(useMathText=False)
    numbers.set_powerlimits(limits)
    return numbers
