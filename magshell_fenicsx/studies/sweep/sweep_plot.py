"""The picture of a sweep: the knockdown factor or the energy barrier over a swept number, or all curves."""

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magshell_fenicsx.output.store.table import OWN_MODES
from magshell_fenicsx.quantities.registry import axes_of
from magshell_fenicsx.studies.sweep.axes import Axis, along
from magshell_fenicsx.studies.sweep.outcome import Outcome
from magshell_fenicsx.studies.sweep.points import SweepPoint, short

if TYPE_CHECKING:
    from magshell_fenicsx.output.store.table import Row

LEGEND_ROWS = 16
STYLES = ("-", "--", ":", "-.")
UNITS = {"polar": "degrees", "azimuth": "degrees"}


def draw_sweep(axes: Sequence[Axis], points: Sequence[SweepPoint], outcomes: Sequence[Outcome], file: Path) -> None:
    """Draw one line for each combination of the values that are not on the horizontal axis."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, plot = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
    knockdowns, barriers = [o.knockdown for o in outcomes], [o.barrier for o in outcomes]
    if any(value is not None for value in barriers):
        _values(plot, axes, points, barriers, r"energy barrier  ($E h R^2$)")
    elif any(value is not None for value in knockdowns):
        _values(plot, axes, points, knockdowns, r"knockdown factor  $k_\mathrm{d}$")
    else:
        _curves(plot, points, outcomes)
    labels = plot.get_legend_handles_labels()[1]
    if labels:
        columns = -(-len(labels) // LEGEND_ROWS)
        figure.legend(loc="outside right upper", fontsize=8, frameon=False, ncols=columns)
    figure.savefig(file, dpi=200)
    plt.close(figure)


def _values(
    plot: Any, axes: Sequence[Axis], points: Sequence[SweepPoint], values: Sequence[float | None], label: str
) -> None:
    """Draw a number of each point over the last axis with numbers; points without it are left out."""
    axis = along(axes) or axes[-1]
    lines: dict[str, list[tuple[float | str, float]]] = {}
    for point, value in zip(points, values, strict=True):
        line = lines.setdefault(_label(point, axis), [])
        if value is not None:
            x = point.values[axis.keys[0]]
            line.append((float(x) if axis.numbers else x, value))
    for (name, line), style in zip(lines.items(), cycle(STYLES), strict=False):
        plot.plot(*zip(*line, strict=True), style, marker=".", label=name) if line else None
    unit = UNITS.get(axis.keys[0].split(".")[-1])
    if axis.numbers:
        plot.locator_params(axis="x", nbins=5)  # long numbers would overlap
    plot.set_xlabel(" = ".join(short(key) for key in axis.keys) + (f"  ({unit})" if unit else ""))
    plot.set_ylabel(label)


def _curves(plot: Any, points: Sequence[SweepPoint], outcomes: Sequence[Outcome]) -> None:
    """Draw the last varied load over its displacement, for every point."""
    amplitude = next((str(o.curve[-1]["amplitude"]) for o in outcomes if len(o.curve) > 1), "force")
    x, y = axes_of(amplitude, next((o.curve[-1] for o in outcomes if o.curve), ()))
    for point, outcome, style in zip(points, outcomes, cycle(STYLES), strict=False):
        part = loaded(outcome.curve, amplitude)
        places = ([each.on_axis(row) for row in part] for each in (x, y))
        plot.plot(*places, style, marker=".", label=_label(point, None))
    plot.axhline(0, color="0.8", linewidth=0.8, zorder=0)
    plot.set(xlabel=x.label, ylabel=y.label)


def loaded(curve: Sequence["Row"], amplitude: str) -> list["Row"]:
    """The part of a curve in which an amplitude varied, and the point before it.

    Branches are left out, and so are instabilities of excluded modes, whose rows are not in the order of the path.
    """
    first = next((i for i, row in enumerate(curve) if row["amplitude"] == amplitude), len(curve))
    part = curve[max(first - 1, 0) :] if first < len(curve) else []
    return [row for row in part if row["mode"] in OWN_MODES and not row["branch"]]


def _label(point: SweepPoint, without: Axis | None) -> str:
    hidden = without.keys if without else ()
    return ", ".join(f"{short(key)} {value}" for key, value in point.values.items() if key not in hidden)
