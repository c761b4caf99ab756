"""report.md: the ensemble in words and numbers."""

from collections.abc import Sequence
from typing import Any

from magshell_fenicsx.studies.ensemble.table import STATUS, Row

MOST_LISTED = 50


def report(content: dict[str, Any], rows: Sequence[Row]) -> str:
    """The text of report.md.

    Parameters
    ----------
    content
        The content of summary.json.
    """
    counts, fit = content["counts"], content["weibull"]
    told = ", ".join(f"{number} {STATUS[name]}" for name, number in counts.items() if name != "samples")
    lines = [
        f"# {content['result']} of {content['case']}: {counts['samples']} random samples",
        "",
        f"Seed {content['seed']}; {told}. Mean CPU time of a sample: {content['cpu_s_per_sample']:.3g} s.",
        "Sample k is drawn from the seed and k alone. Intervals are bootstrap intervals of "
        f"{100 * content['level']:.0f} %, by percentiles. [samples.csv](samples.csv) has all samples.",
        "",
        "![](ensemble.png)",
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
            lines.append(f"| … | | {len(without) - MOST_LISTED} more in samples.csv |")
    return "\n".join(lines) + "\n"


def _row(key: str, value: float | None, intervals: dict[str, tuple[float, float]], of: str = "") -> str:
    ends = intervals.get(key)
    shown = "" if value is None else f"{value:.6g}"
    return f"| {of}{key.replace('_', ' ')} | {shown} | {f'{ends[0]:.5g} to {ends[1]:.5g}' if ends else ''} |"
