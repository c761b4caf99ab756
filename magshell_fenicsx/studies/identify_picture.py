"""The picture of an identification: data and prediction with their bands, and what is known of the parameters."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.studies.naming import key_words, result_label

Row = Mapping[str, Any]
Array = NDArray[np.float64]


def draw_identified(
    content: Mapping[str, Any], curves: Mapping[str, Sequence[tuple[float, float]]], file: Path
) -> None:
    """Draw each column of the data over its places, and the parameters before and after.

    Parameters
    ----------
    content
        As in identify.json.
    curves
        Result -> places and values along the path.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = sorted(content["rows"], key=lambda row: str(row["result"]))
    columns = {of: list(own) for of, own in groupby(rows, key=lambda row: str(row["result"]))}
    count = len(columns) + 1
    figure, plots = plt.subplots(1, count, figsize=(4.2 * count, 3.6), layout="constrained")
    for plot, (of, own) in zip(plots, columns.items(), strict=False):
        _data(plot, of, own, curves.get(of, ()), content)
    _parameters(plots[-1], content["parameters"])
    figure.suptitle(content["case"])
    figure.savefig(file, dpi=200)
    plt.close(figure)


def _data(plot: Any, of: str, rows: Sequence[Row], curve: Sequence[tuple[float, float]], content: Row) -> None:
    placed = all(row["at"] != "end" for row in rows)
    rows = sorted(rows, key=lambda row: (row["settings"], row["at"])) if placed else rows
    x = np.array([row["at"] for row in rows]) if placed else np.arange(1.0, len(rows) + 1)
    alone = len({row["settings"] for row in rows}) == 1 and placed

    def get(name: str) -> Array:
        return np.array([row[name] for row in rows])

    if alone:
        plot.fill_between(
            x, get("low_measured"), get("high_measured"), color="C0", alpha=0.12, lw=0, label="95 %, data"
        )
        plot.fill_between(x, get("low"), get("high"), color="C0", alpha=0.35, lw=0, label="95 %, curve")
        line = [(a, b) for a, b in curve if min(x) <= a <= max(x)]
        line = sorted([*line, *zip(x, get("predicted"), strict=True)])
        plot.plot(*zip(*line, strict=True), color="C0", lw=1.2, label="fitted")
    else:
        half = [get("predicted") - get("low_measured"), get("high_measured") - get("predicted")]
        plot.errorbar(x, get("predicted"), half, fmt="_", color="C0", label="fitted, 95 %")
    plot.plot(x, get("measured"), ".", color="C1", label="measured", zorder=5)
    plot.set(xlabel=result_label(content["places"]) if placed else "number", ylabel=result_label(of))
    plot.legend(frameon=False, fontsize=8)


def _parameters(plot: Any, parameters: Mapping[str, Row]) -> None:
    """Bands over the value that fits best: before in grey, after in blue."""
    widest = 0.0
    for i, each in enumerate(parameters.values()):
        size = abs(each["value"]) or 1.0
        prior = each["prior"]
        if prior:
            middle, half = prior["mean"] / size - np.sign(each["value"]), 1.96 * prior["deviation"] / size
            plot.barh(i, 200 * half, left=100 * (middle - half), height=0.5, color="0.85")
            widest = max(widest, abs(middle) + half)
        low, high = ((each[name] - each["value"]) / size for name in ("low", "high"))
        plot.barh(i, 100 * (high - low), left=100 * low, height=0.25, color="C0")
        widest = max(widest, high)
    names = [f"{key_words(key, p['unit'])}\n{p['value']:.4g} {p['unit']}".rstrip() for key, p in parameters.items()]
    plot.set_yticks(range(len(names)), names, fontsize=8)
    plot.set(xlabel="95 % bands: data (blue), prior (grey), in %", xlim=(-120 * widest, 120 * widest))
    plot.axvline(0.0, color="0.4", lw=0.6)
