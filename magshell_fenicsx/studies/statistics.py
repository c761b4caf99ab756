"""The rows of samples.csv, their statistics in words and numbers, and the picture of an ensemble.

The statistics are moments, correlations and the three-parameter Weibull distribution, P(x) = 1 -
exp(-((x - location)/scale)^shape) for x > location, fitted by maximum likelihood. At a given
location the shape is the root of one equation and the scale follows from it, so that the likelihood
is maximised over the location alone (profile likelihood). It has no maximum where the shape is
below one: such shapes are left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import weibull_min

from magshell_fenicsx.input.section import number_and_unit
from magshell_fenicsx.output.store.table import write_csv
from magshell_fenicsx.studies.results import Scalar
from magshell_fenicsx.studies.runner import FAILED, Outcome
from magshell_fenicsx.studies.samples import Sample

Array = NDArray[np.float64]

Row = dict[str, Any]
RESULT, WITHOUT = "result", "result_without_weakest"
SEVEREST = "severest."
FIRST_COLUMNS = ("sample", "status", RESULT)
LAST_COLUMNS = ("found", "factorisations", "dofs", "cpu_s", "wall_s", "why", "point")
STATUS = {
    "found": "with a result",
    "stopped": "stopped early",
    "none": "without an instability",
    "failed": "failed",
    "missing": "not computed",
}
RESAMPLED = 300
MIN_SAMPLES_FOR_CORRELATION = 3  # samples for a correlation
LEAST_DIFFERENT = 8  # different values for three parameters
SPANS = 1e-3, 1e2  # distances of the location below the least value, in standard deviations
# locations that are tried at once, and how often the grid is refined around the best
GRID, ROUNDS = 9, 9
SHAPES = 1.0, 1e3
STEPS = 5  # of Newton's method, which begins close
LEVEL = 0.95
MOST_LISTED = 50


def make_row(sample: Sample, outcome: Outcome | None, scalar: Scalar) -> Row:
    """The row of a sample; None as outcome: it has not been computed."""
    result = outcome.value(scalar) if outcome else None
    status, why = _status(outcome, result)
    computed = ("found", "factorisations", "dofs", "cpu_s", "wall_s")
    return {
        "sample": sample.number,
        "status": status,
        RESULT: result,
        **_columns(sample.values),
        **_columns({f"{SEVEREST}{key}": number for key, number in sample.severest.items()}),
        **{name: getattr(outcome, name, None) for name in computed},
        "why": f"no {scalar.name}" if status == "none" else why,
        "point": sample.key,
    }


def _status(outcome: Outcome | None, result: float | None) -> tuple[str, str | None]:
    """A key of `STATUS`, and why there is no result."""
    if outcome is None:
        return "missing", "not computed"
    why = outcome.stopped
    if result is not None:
        return "found", why
    return "none" if why is None else "failed" if why.startswith(FAILED) else "stopped", why


def _columns(values: Mapping[str, Any]) -> Row:
    """Values by the names of their columns; one with a unit is a number, and its name has the unit.

    Examples
    --------
    >>> _columns({"shell.thickness": "0.25 mm", "shell.poisson_ratio": 0.5})
    {'shell.thickness_mm': 0.25, 'shell.poisson_ratio': 0.5}
    """
    columns = {}
    for key, value in values.items():
        number, unit = number_and_unit(value) if isinstance(value, str) else ("", "")
        columns[f"{key}_{unit}" if unit else key] = float(number) if unit else value
    return columns


def severest_keys(rows: Sequence[Row]) -> list[str]:
    """The columns of the most severe defect."""
    return list(dict.fromkeys(key for row in rows for key in row if key.startswith(SEVEREST)))


def drawn_keys(rows: Sequence[Row]) -> list[str]:
    """The columns of drawn values, in the order of the rows."""
    others = {*FIRST_COLUMNS, *LAST_COLUMNS, *severest_keys(rows), WITHOUT}
    return list(dict.fromkeys(key for row in rows for key in row if key not in others))


def write_samples(rows: Sequence[Row], file: Path) -> None:
    """Write samples.csv."""
    extra_columns = [WITHOUT] if any(WITHOUT in row for row in rows) else []
    write_csv(
        rows,
        (*FIRST_COLUMNS, *extra_columns, *severest_keys(rows), *drawn_keys(rows), *LAST_COLUMNS),
        file,
    )


def results(rows: Sequence[Row], column: str = RESULT) -> Array:
    """The results of the samples that have one."""
    return np.array([row[column] for row in rows if row.get(column) is not None], dtype=float)


def statistics(rows: Sequence[Row], seed: int) -> dict[str, Any]:
    """Numbers of samples, moments, the Weibull fit, correlations, and the change without the
    weakest defects.

    Parameters
    ----------
    seed
        Of the resampling for intervals.
    """
    values = results(rows)
    return {
        "counts": counts(rows),
        **moments(values),
        "weibull": _weibull(values),
        "level": LEVEL,
        "intervals": intervals(values, seed, RESAMPLED)
        if len(values) >= MIN_SAMPLES_FOR_CORRELATION
        else {},
        "correlations": correlations(rows),
        "without_weakest": _without(rows),
        "cpu_s_per_sample": float(
            np.mean([row["cpu_s"] for row in rows if row["cpu_s"] is not None] or [np.nan])
        ),
    }


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """The number of samples, and of those with each status."""
    statuses = [row["status"] for row in rows]
    return {
        "samples": len(rows),
        **{status: statuses.count(status) for status in sorted(set(statuses))},
    }


def moments(values: Array) -> dict[str, Any]:
    """Mean, standard deviation, least, middle and largest value; None where there are too few."""
    if not len(values):
        return dict.fromkeys(("mean", "deviation", "least", "median", "largest"))
    return {
        "mean": float(values.mean()),
        "deviation": float(values.std(ddof=1)) if len(values) > 1 else None,
        "least": float(values.min()),
        "median": float(np.median(values)),
        "largest": float(values.max()),
    }


def _weibull(values: Array) -> dict[str, Any] | None:
    weibull = fit(values) if len(values) else None
    if weibull is None:
        return None
    return {
        **asdict(weibull),
        "quantile_1_percent": weibull.quantile(0.01),
        "distance": distance(values, weibull),
    }


def correlations(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """The correlation of the result with the most severe defect and with every key: Pearson's and
    Spearman's.
    """
    from scipy.stats import pearsonr, spearmanr

    correlated = {}
    place, keys = "at.polar", drawn_keys(rows)
    of_defects = (
        "shell.imperfections.",
        *(key.removesuffix(place) for key in keys if key.endswith(f".{place}")),
    )
    drawn_keys_only = [key for key in keys if not key.startswith(of_defects)]
    for key in (*severest_keys(rows), *drawn_keys_only):
        pairs = np.array(
            [
                (x, y)
                for row in rows
                if isinstance(x := row.get(key), float | int) and (y := row[RESULT]) is not None
            ]
        )
        if len(pairs) < MIN_SAMPLES_FOR_CORRELATION or not np.ptp(pairs, axis=0).all():
            continue
        x, y = pairs.T
        correlated[key] = {
            "pearson": float(pearsonr(x, y)[0]),
            "spearman": float(spearmanr(x, y)[0]),
        }
    return correlated


def _without(rows: Sequence[Row]) -> dict[str, Any] | None:
    """The change of the result by deleting the weakest defects, over the samples that have both."""
    value_pairs = [
        (row[RESULT], row[WITHOUT])
        for row in rows
        if row[RESULT] is not None and row.get(WITHOUT) is not None
    ]
    if not value_pairs:
        return None
    all_values, values_without_weakest = np.array(value_pairs).T
    change = values_without_weakest / all_values - 1
    return {
        "samples": len(value_pairs),
        "mean": float(values_without_weakest.mean()),
        "change_of_mean": float(values_without_weakest.mean() / all_values.mean() - 1),
        "largest_change": float(change[np.argmax(np.abs(change))]),
    }


@dataclass(frozen=True)
class Weibull:
    """A fitted distribution.

    Attributes
    ----------
    bounded
        Whether the best location is one of the bounds of the search, so that the sample does not
        determine it.
    """

    shape: float
    location: float
    scale: float
    bounded: bool

    def probability_below(self, x: Array) -> Array:
        """The probability of a smaller value."""
        return np.asarray(weibull_min.cdf(x, self.shape, self.location, self.scale))

    def density(self, x: Array) -> Array:
        return np.asarray(weibull_min.pdf(x, self.shape, self.location, self.scale))

    def quantile(self, part: float) -> float:
        """The value that is larger with the probability 1 - part."""
        return float(weibull_min.ppf(part, self.shape, self.location, self.scale))


def fit(values: Sequence[float] | Array) -> Weibull | None:
    """The most likely distribution; None with fewer than `LEAST_DIFFERENT` different values.

    Parameters
    ----------
    values
        The sample (n,).
    """
    x = np.sort(np.asarray(values, dtype=float))
    if len(np.unique(x)) < LEAST_DIFFERENT:
        return None
    spread = float(x.std())
    low, high = np.log(SPANS)
    ends, best = (low, high), 0.0
    for _ in range(ROUNDS):
        tried = np.linspace(low, high, GRID)
        best = float(tried[np.argmax(_likelihoods(x, x[0] - spread * np.exp(tried)))])
        step = tried[1] - tried[0]
        low, high = max(best - step, ends[0]), min(best + step, ends[1])
    location = x[0] - spread * float(np.exp(best))
    shape, scale = (float(v[0]) for v in _best_shape_and_scale(x, np.array([location])))
    return Weibull(shape, float(location), scale, best in ends or shape <= SHAPES[0])


def distance(values: Array, weibull: Weibull) -> float:
    """The largest difference between the empirical and the fitted distribution function (Kolmogorov
    and Smirnov).
    """
    probabilities, n = weibull.probability_below(np.sort(values)), len(values)
    return float(
        np.max([np.arange(1, n + 1) / n - probabilities, probabilities - np.arange(n) / n])
    )


def _likelihoods(x: Array, locations: Array) -> Array:
    """Mean logarithm of the density, at the best shape and scale of each location."""
    shapes, scales = _best_shape_and_scale(x, locations)
    logs = np.log((x - locations[:, None]) / scales[:, None])
    powers = np.exp(shapes[:, None] * logs)
    return np.asarray(
        np.log(shapes / scales) + np.mean((shapes[:, None] - 1) * logs - powers, axis=1)
    )


def _best_shape_and_scale(x: Array, locations: Array) -> tuple[Array, Array]:
    """The best shape (m,) and scale (m,) for locations (m,).

    The shape k solves 1/k = sum(y^k log y)/sum(y^k) - mean(log y) with y = x - location, by
    Newton's method for log k.
    """
    y = np.log(x - locations[:, None])
    y, middle = y - y.mean(axis=1, keepdims=True), y.mean(axis=1)  # mean(log y) = 0 then
    k = 1.2 / np.maximum(y.std(axis=1), 1e-12)
    for _ in range(STEPS):
        top = np.max(k[:, None] * y, axis=1, keepdims=True)
        w = np.exp(k[:, None] * y - top)
        s0, s1, s2 = w.sum(axis=1), (w * y).sum(axis=1), (w * y**2).sum(axis=1)
        value, slope = s1 / s0 - 1 / k, s2 / s0 - (s1 / s0) ** 2 + 1 / k**2
        k = k * np.exp(np.clip(-value / (slope * k), -1.0, 1.0))
    k = np.clip(k, *SHAPES)
    top = np.max(k[:, None] * y, axis=1, keepdims=True)
    mean = np.log(np.mean(np.exp(k[:, None] * y - top), axis=1)) + top[:, 0]
    return np.asarray(k), np.asarray(np.exp(middle + mean / k))


def intervals(
    values: Sequence[float] | Array, seed: int, count: int = 400
) -> dict[str, tuple[float, float]]:
    """Percentile intervals of the parameters, of the mean and of the 1 % quantile, from resampled
    values.

    Parameters
    ----------
    seed, count
        Of the resampling, and its number.
    """
    x, rng = np.asarray(values, dtype=float), np.random.default_rng(seed)
    resampled: dict[str, list[float]] = {}
    for _ in range(count):
        resample = rng.choice(x, len(x))
        numbers = {"mean": float(resample.mean()), "deviation": float(resample.std(ddof=1))}
        if weibull := fit(resample):
            numbers |= {
                "shape": weibull.shape,
                "location": weibull.location,
                "scale": weibull.scale,
            }
            numbers["quantile_1_percent"] = weibull.quantile(0.01)
        for name, value in numbers.items():
            resampled.setdefault(name, []).append(value)
    low, high = 0.5 - LEVEL / 2, 0.5 + LEVEL / 2
    return {
        name: (float(np.quantile(estimates, low)), float(np.quantile(estimates, high)))
        for name, estimates in resampled.items()
    }


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
    counts, weibull = content["counts"], content["weibull"]
    counted = ", ".join(
        f"{number} {STATUS[name]}" for name, number in counts.items() if name != "samples"
    )
    lines = [
        f"# {content['result']} of {content['case']}: {counts['samples']} random samples",
        "",
        f"Seed {content['seed']}; {counted}. Mean CPU time of a sample: "
        f"{content['cpu_s_per_sample']:.3g} s.",
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
    if weibull:
        names = ("shape", "location", "scale", "quantile_1_percent", "distance")
        lines += [_row(key, weibull[key], content["intervals"], "Weibull, ") for key in names]
        if weibull["bounded"]:
            lines += [
                "",
                "The likelihood has no maximum inside the bounds of the search: the three "
                "parameters are not",
            ]
            lines += ["determined by these samples."]
    else:
        lines += ["", "Too few different results for a Weibull distribution."]
    if content["correlations"]:
        lines += [
            "",
            f"| {content['result']} against | Pearson | Spearman |",
            "| --- | --- | --- |",
        ]
        lines += [
            f"| {key} | {c['pearson']:.3f} | {c['spearman']:.3f} |"
            for key, c in content["correlations"].items()
        ]
    if without_weakest := content["without_weakest"]:
        lines += [
            "",
            f"Without the {content['deleted']} weakest defects of each sample: mean "
            f"{without_weakest['mean']:.6g}, a change of "
            f"{100 * without_weakest['change_of_mean']:+.2f} %; the largest change of one sample "
            "is "
            f"{100 * without_weakest['largest_change']:+.2f} %.",
        ]
    without = [row for row in rows if row["status"] != "found"]
    if without:
        lines += [
            "",
            "Samples without the result:",
            "",
            "| sample | status | why |",
            "| --- | --- | --- |",
        ]
        lines += [
            f"| {row['sample']} | {row['status']} | {str(row['why']).replace('|', '/')} |"
            for row in without[:MOST_LISTED]
        ]
        if len(without) > MOST_LISTED:
            lines.append(f"| … | | {len(without) - MOST_LISTED} more in {table} |")
    return "\n".join(lines) + "\n"


def _row(
    key: str, value: float | None, intervals: dict[str, tuple[float, float]], suffix: str = ""
) -> str:
    ends = intervals.get(key)
    value_text = "" if value is None else f"{value:.6g}"
    interval = f"{ends[0]:.5g} to {ends[1]:.5g}" if ends else ""
    return f"| {suffix}{key.replace('_', ' ')} | {value_text} | {interval} |"
