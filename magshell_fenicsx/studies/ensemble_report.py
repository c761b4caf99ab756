"""The report of an ensemble in words and numbers, and its picture."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from magshell_fenicsx.studies.statistics import RESULT, STATUS, WITHOUT, Row, correlations, fit, results

MOST_LISTED = 50


def report(content: Mapping[str, Any], rows: Sequence[Row], ending: str = "") -> str:
    """The text of report.md.

    Parameters
    ----------
    content
        The content of summary.json.
    ending
        Of the names of its table and its picture, in front of the suffix.
    """
    table = f"samples{ending}.csv"
    counts, fit = content["counts"], content["weibull"]
    counted = ", ".join(f"{number} {STATUS[name]}" for name, number in counts.items() if name != "samples")
    lines = [
        f"# {content['result']} of {content['case']}: {counts['samples']} random samples",
        "",
        f"Seed {content['seed']}; {counted}. Mean CPU time of a sample: {content['cpu_s_per_sample']:.3g} s.",
        "Sample k is drawn from the seed and k alone. Intervals are bootstrap intervals of "
        f"{100 * content['level']:.0f} %, by percentiles. [{table}]({table}) has all samples.",
        "",
        f"![](ensemble{ending}.png)",
        "",
        "| quantity | value | interval |",
        "| --- | --- | --- |",
    ]
    numbers = {key: content[key] for key in ("mean", "deviation", "least", "median", "largest")}
    lines += [_row(key, value, content["intervals"]) for key, value in numbers.items()]
    if fit:
        names = ("shape", "location", "scale", "quantile_1_percent", "distance")
        lines += [_row(key, fit[key], content["intervals"], "Weibull, ") for key in names]
        if fit["bounded"]:
            lines += ["", "The likelihood has no maximum inside the bounds of the search: the three parameters are not"]
            lines += ["determined by these samples."]
    else:
        lines += ["", "Too few different results for a Weibull distribution."]
    if content["correlations"]:
        lines += ["", f"| {content['result']} against | Pearson | Spearman |", "| --- | --- | --- |"]
        lines += [f"| {key} | {c['pearson']:.3f} | {c['spearman']:.3f} |" for key, c in content["correlations"].items()]
    if less := content["without_weakest"]:
        lines += [
            "",
            f"Without the {content['deleted']} weakest defects of each sample: mean {less['mean']:.6g}, a change of "
            f"{100 * less['change_of_mean']:+.2f} %; the largest change of one sample is "
            f"{100 * less['largest_change']:+.2f} %.",
        ]
    without = [row for row in rows if row["status"] != "found"]
    if without:
        lines += ["", "Samples without the result:", "", "| sample | status | why |", "| --- | --- | --- |"]
        lines += [
            f"| {row['sample']} | {row['status']} | {str(row['why']).replace('|', '/')} |"
            for row in without[:MOST_LISTED]
        ]
        if len(without) > MOST_LISTED:
            lines.append(f"| … | | {len(without) - MOST_LISTED} more in {table} |")
    return "\n".join(lines) + "\n"


def _row(key: str, value: float | None, intervals: dict[str, tuple[float, float]], of: str = "") -> str:
    ends = intervals.get(key)
    shown = "" if value is None else f"{value:.6g}"
    return f"| {of}{key.replace('_', ' ')} | {shown} | {f'{ends[0]:.5g} to {ends[1]:.5g}' if ends else ''} |"


KNOCKDOWN = r"knockdown factor  $k_\mathrm{d}$"


def draw_ensemble(rows: Sequence[Row], name: str, file: Path) -> None:
    """Write the picture.

    Parameters
    ----------
    name
        The result, as `--result` names it.
    """
    from matplotlib.figure import Figure

    values, label = results(rows), KNOCKDOWN if name == "knockdown" else name
    strongest = max(correlations(rows).items(), key=lambda item: abs(item[1]["spearman"]), default=None)
    panels = 2 + (strongest is not None)
    figure = Figure(figsize=(4.2 * panels, 3.6), dpi=160, layout="constrained")
    histogram, function, *others = figure.subplots(1, panels, squeeze=False)[0]
    if len(values):
        x, fitted = np.linspace(values.min(), values.max(), 300), fit(values)
        histogram.hist(values, bins="auto" if np.ptp(values) > 0 else 1, density=True, color="C0", alpha=0.4)
        ordered = np.sort(values)
        part = np.arange(len(values) + 1) / len(values)
        function.step(np.append(ordered[:1], ordered), part, where="post", color="C0", label="samples")
        if len(less := np.sort(results(rows, WITHOUT))):
            part = np.arange(1, len(less) + 1) / len(less)
            function.step(less, part, where="post", color="C2", linewidth=1, label="without the weakest defects")
        if fitted:
            histogram.plot(x, fitted.density(x), color="C3")
            function.plot(x, fitted.below(x), color="C3", label=f"Weibull, shape {fitted.shape:.3g}")
        function.legend(frameon=False, fontsize=8)
    histogram.set(xlabel=label, ylabel="probability density")
    function.set(xlabel=label, ylabel="probability of a smaller value", ylim=(0, 1))
    if strongest:
        key, numbers = strongest
        pairs = [(row[key], row[RESULT]) for row in rows if row[RESULT] is not None and row.get(key) is not None]
        others[0].plot(*zip(*pairs, strict=True), ".", color="C0", markersize=4)
        others[0].set(xlabel=_words(key), ylabel=label, title=f"Spearman's correlation {numbers['spearman']:.2f}")
        others[0].title.set_fontsize(9)
    for axes in figure.axes:
        axes.locator_params(axis="x", nbins=5)  # long numbers would touch
    figure.savefig(file)


def _words(key: str) -> str:
    """The label of a column of samples.csv.

    Examples
    --------
    >>> _words("severest.amplitude_mm"), _words("severest.at.polar")
    ('amplitude mm of the most severe defect', 'polar of the most severe defect')
    """
    of, _, last = key.rpartition(".")
    return last.replace("_", " ") + (" of the most severe defect" if of.startswith("severest") else "")
