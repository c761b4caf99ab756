"""The picture of a boundary of stability: load over key, with the names of the regions."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from magshell_fenicsx.quantities.registry import amplitude, quantity
from magshell_fenicsx.studies.points import short

MARKS = {"cusp": "o", "turn": "s", "meeting": "D"}
WORDS = {"cusp": "cusp", "turn": "turning point", "meeting": "second mode neutral"}
Row = Mapping[str, Any]


def draw_boundary(rows: Sequence[Row], content: Mapping[str, Any], file: Path) -> None:
    """Draw the curve, dashed where other modes are unstable already, and name what it divides.

    Parameters
    ----------
    rows, content
        As in boundary.csv and boundary.json.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, plot = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    for one, two in pairwise(rows):
        first = not one["unstable"] and not two["unstable"]
        plot.plot([one["key"], two["key"]], [one["load"], two["load"]], "-" if first else "--", color="C0")
    for kind, mark in MARKS.items():
        places = [(row["key"], row["load"]) for row in rows if row["kind"] == kind]
        if places:
            plot.plot(*zip(*places, strict=True), mark, color="C3", label=WORDS[kind], zorder=5)
    for x, y, words in _regions(rows, content, plot.get_ylim()):
        plot.annotate(words, (x, y), ha="center", va="center", color="0.35")
    arms = _arms(rows)
    if arms:
        low, high = arms
        outline = [*low, *reversed(high)]
        plot.fill(*zip(*outline, strict=True), color="C0", alpha=0.12, linewidth=0)
    unit = f"  ({content['unit']})" if content["unit"] else ""
    label = quantity(amplitude(content["load"]).column).label
    plot.set(xlabel=short(content["key"]).replace("_", " ") + unit, ylabel=label, title=content["case"])
    if plot.get_legend_handles_labels()[1]:
        plot.legend(frameon=False, fontsize=8)
    figure.savefig(file, dpi=200)
    plt.close(figure)


def draw_map(rows: Sequence[Row], content: Mapping[str, Any], file: Path) -> None:
    """Draw the boundaries in their own key, one line a value of the second, and cusps in the plane of both keys.

    Parameters
    ----------
    rows, content
        As in boundary.csv and map.json.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (plot, plane) = plt.subplots(1, 2, figsize=(10.2, 4.2), layout="constrained")
    names = [
        short(key).replace("_", " ") + (f"  ({unit})" if unit else "")
        for key, unit in zip(content["keys"], content["units"], strict=True)
    ]
    values = content["values"]
    shade = plt.Normalize(min(values), max(values) if max(values) > min(values) else min(values) + 1)
    for value in dict.fromkeys(row["second"] for row in rows):
        line = [row for row in rows if row["second"] == value]
        colour = plt.cm.viridis(0.9 * shade(value))
        keys, loads = [row["key"] for row in line], [row["load"] for row in line]
        other = line[0]["amplitude"] != content["load"]
        if not other:
            plot.plot(keys, loads, color=colour, label=f"{value:g}")
        how = {"ls": "--", "lw": 1.2, "label": f"by {line[0]['amplitude']}"} if other else {"lw": 3, "alpha": 0.6}
        plane.plot([min(keys), max(keys)], [value, value], color=colour, **how)
    for kind, mark in MARKS.items():
        own = [row for row in rows if row["kind"] == kind]
        if own:
            drawn = [row for row in own if row["amplitude"] == content["load"]]
            plot.plot([row["key"] for row in drawn], [row["load"] for row in drawn], mark, color="C3", zorder=5)
            plane.plot(
                [r["key"] for r in own], [r["second"] for r in own], mark, color="C3", label=WORDS[kind], zorder=5
            )
    for value in set(values) - {row["second"] for row in rows}:
        plane.plot(content["range"], [value, value], ":", color="0.5")
    plot.set(xlabel=names[0], ylabel=quantity(amplitude(content["load"]).column).label, title=content["case"])
    plot.legend(frameon=False, fontsize=8, title=names[1], title_fontsize=8)
    plane.set(xlabel=names[0], ylabel=names[1], title="where it loses its stability (dotted: nowhere)")
    if plane.get_legend_handles_labels()[1]:
        plane.legend(frameon=False, fontsize=8)
    figure.savefig(file, dpi=200)
    plt.close(figure)


def _arms(rows: Sequence[Row]) -> tuple[list[tuple[float, float]], list[tuple[float, float]]] | None:
    """The two folds of the first cusp, from it on; None without one."""
    at = next((i for i, row in enumerate(rows) if row["kind"] == "cusp"), None)
    if at is None:
        return None
    before, after = ([(row["key"], row["load"]) for row in part] for part in (rows[at::-1], rows[at:]))
    return before, after


def _regions(rows: Sequence[Row], content: Mapping[str, Any], limits: tuple[float, float]) -> list[tuple[Any, ...]]:
    """Places and names of the regions."""
    lost = "snaps" if content["kind"] == "fold" else f"buckles {_mode(content['mode'])}".rstrip()
    x = float(np.mean([min(row["key"] for row in rows), max(row["key"] for row in rows)]))
    crossed = sorted(
        one["load"] + (x - one["key"]) / (two["key"] - one["key"]) * (two["load"] - one["load"])
        for one, two in pairwise(rows)
        if (one["key"] - x) * (two["key"] - x) <= 0 and one["key"] != two["key"]
    )
    if not crossed:
        return []
    up = np.mean(crossed) > 0  # loads are negative elsewhere
    outer, inner = (limits[1], limits[0]) if up else (limits[0], limits[1])
    last, first = (crossed[-1], crossed[0]) if up else (crossed[0], crossed[-1])
    named = [(x, (last + outer) / 2, lost), (x, (first + inner) / 2, "stable")]
    if len(crossed) > 1:
        between = "bistable" if content["kind"] == "fold" else lost
        named.append((x, (crossed[0] + crossed[-1]) / 2, between))
        if content["kind"] != "fold":
            named[0] = (x, (last + outer) / 2, "stable")
    return named


def _mode(mode: str) -> str:
    return f"with {mode}" if mode.startswith("m = ") else ""
