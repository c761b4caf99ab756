"""The rows of samples.csv, their statistics in words and numbers, and the picture of an ensemble.

The statistics are moments, correlations and the three-parameter Weibull distribution, P(x) = 1 -
exp(-((x - location)/scale)^shape) for x > location, fitted by maximum likelihood. At a given
location the shape is the root of one equation and the scale follows from it, so that the likelihood
is maximised over the location alone (profile likelihood). It has no maximum where the shape is
below one: such shapes are left out.

A sample of an ensemble is a random case. Its outcome is what its run gave, its result one number of
that (a scalar), and its status a key of `STATUS`. Rows and columns are those of samples.csv: the
result, the drawn values by keys of the case (a unit as ending), and the most severe defect
(`severest.`). The weakest defects may be deleted in a second run of a sample (`WITHOUT`).
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
from magshell_fenicsx.studies.ensemble.samples import Sample
from magshell_fenicsx.studies.outcome import Outcome
from magshell_fenicsx.studies.results import Scalar

Array = NDArray[np.float64]

Row = dict[str, Any]
RESULT, WITHOUT = "result", "result_without_weakest"
SEVEREST = "severest."
FIRST_COLUMNS = ("sample", "status", RESULT, "result_error")
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
LEAST_DIFFERENT = 8  # different values of a sample, for a fit of three parameters
SPANS = 1e-3, 1e2  # distances of the location below the least value, in standard deviations
# locations that are tried at once, and how often the grid is refined around the best
GRID, ROUNDS = 9, 9
SHAPES = 1.0, 1e3
STEPS = 5  # of Newton's method, which begins close
LEVEL = 0.95
MOST_LISTED = 50


def make_row(sample: Sample, outcome: Outcome | None, scalar: Scalar) -> Row:
    """Return the row of a sample in samples.csv.

    Parameters
    ----------
    outcome
        None if the sample has not been computed.
    scalar
        The number that is the result.
    """
    result = outcome.value(scalar) if outcome else None
    # the reason is that of a run that stopped, or of no result
    status, reason = _status(outcome, result)
    computed = ("found", "factorisations", "dofs", "cpu_s", "wall_s")
    return {
        "sample": sample.number,
        "status": status,
        RESULT: result,
        "result_error": outcome.error(scalar) if outcome else None,
        **_columns(sample.values),
        **_columns({f"{SEVEREST}{key}": number for key, number in sample.severest.items()}),
        **{name: getattr(outcome, name, None) for name in computed},
        "why": f"no {scalar.name}" if status == "none" else reason,
        "point": sample.key,
    }


def _status(outcome: Outcome | None, result: float | None) -> tuple[str, str | None]:
    """Return a key of `STATUS`, and the reason why the run stopped early; None if it did not.

    Parameters
    ----------
    outcome
        What the run of a sample gave; None if it has not been computed.
    result
        The result of the sample; None without.
    """
    if outcome is None:
        return "missing", "not computed"
    reason = outcome.stopped
    if result is not None:
        return "found", reason
    if reason is None:  # the run reached its end
        return "none", reason
    return "failed" if outcome.is_error else "stopped", reason


def _columns(values: Mapping[str, Any]) -> Row:
    """Return column -> value, for keys of a case; a value with a unit becomes a number.

    The name of its column has the unit as ending.

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
    """Return the columns of the most severe defect."""
    return list(dict.fromkeys(key for row in rows for key in row if key.startswith(SEVEREST)))


def drawn_keys(rows: Sequence[Row]) -> list[str]:
    """Return the columns of drawn values, in the order of the rows."""
    other_columns = {*FIRST_COLUMNS, *LAST_COLUMNS, *severest_keys(rows), WITHOUT}
    return list(dict.fromkeys(key for row in rows for key in row if key not in other_columns))


def write_samples(rows: Sequence[Row], file: Path) -> None:
    """Write samples.csv: result, defects and drawn values first, then the columns of the runs."""
    extra_columns = [WITHOUT] if any(WITHOUT in row for row in rows) else []
    write_csv(
        rows,
        (*FIRST_COLUMNS, *extra_columns, *severest_keys(rows), *drawn_keys(rows), *LAST_COLUMNS),
        file,
    )


def results(rows: Sequence[Row], column: str = RESULT) -> Array:
    """Return the results (n,) of the samples that have one."""
    return np.array([row[column] for row in rows if row.get(column) is not None], dtype=float)


def statistics(rows: Sequence[Row], seed: int) -> dict[str, Any]:
    """Return the statistics of an ensemble, as in summary.json.

    They are counts of samples, moments, the Weibull fit with intervals, correlations, and the
    change without the weakest defects.

    Parameters
    ----------
    rows
        Rows of samples.csv.
    seed
        Seed of the resampling for intervals.
    """
    values = results(rows)
    return {
        "counts": counts(rows),
        **moments(values),
        "weibull": _weibull(values),
        "level": LEVEL,
        # bootstrap intervals, of enough values
        "intervals": intervals(values, seed, count=RESAMPLED)
        if len(values) >= MIN_SAMPLES_FOR_CORRELATION
        else {},
        "correlations": correlations(rows),
        "without_weakest": _without(rows),
        "cpu_s_per_sample": float(
            np.mean([row["cpu_s"] for row in rows if row["cpu_s"] is not None] or [np.nan])
        ),
    }


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """Return the number of samples, and of those with each status."""
    statuses = [row["status"] for row in rows]
    return {
        "samples": len(rows),
        **{status: statuses.count(status) for status in sorted(set(statuses))},
    }


def moments(values: Array) -> dict[str, Any]:
    """Return mean, standard deviation, least, median and largest value; None for too few values."""
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
    """Return the fitted Weibull distribution as plain data; None if it cannot be fitted."""
    weibull = fit(values) if len(values) else None
    if weibull is None:
        return None
    return {
        **asdict(weibull),
        "quantile_1_percent": weibull.quantile(0.01),
        "distance": distance(values, weibull),
    }


def correlations(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Return Pearson's and Spearman's correlations of the result with drawn numbers.

    The numbers are those of the most severe defect, and of all other random keys. Single defects do
    not count, since their numbering means nothing.

    Returns
    -------
    Column -> {"pearson", "spearman"}; columns with too few or equal values are left out.
    """
    from scipy.stats import pearsonr, spearmanr

    # keys of single defects begin with one of these: "shell.imperfections." for one shell, else the
    # section of any key that ends with a place ("a.b." of "a.b.at.polar")
    polar_key, keys = "at.polar", drawn_keys(rows)
    defect_prefixes = (
        "shell.imperfections.",
        *(key.removesuffix(polar_key) for key in keys if key.endswith(f".{polar_key}")),
    )
    other_keys = [key for key in keys if not key.startswith(defect_prefixes)]
    correlated = {}
    for key in (*severest_keys(rows), *other_keys):
        # the number and the result of each sample that has both
        pairs = np.array(
            [
                (x, y)
                for row in rows
                if isinstance(x := row.get(key), float | int) and (y := row[RESULT]) is not None
            ]
        )
        if len(pairs) < MIN_SAMPLES_FOR_CORRELATION or not np.ptp(pairs, axis=0).all():
            continue  # too few, or equal values
        x, y = pairs.T
        correlated[key] = {
            "pearson": float(pearsonr(x, y)[0]),
            "spearman": float(spearmanr(x, y)[0]),
        }
    return correlated


def _without(rows: Sequence[Row]) -> dict[str, Any] | None:
    """Return the change of the result by deleting the weakest defects, as in summary.json.

    It is over the samples that have both results; None if there are none.
    """
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
    """A fitted three-parameter Weibull distribution.

    Attributes
    ----------
    shape, location, scale
        P(x) = 1 - exp(-((x - location)/scale)^shape) for x > location.
    bounded
        Whether the best location is one of the bounds of the search, so that the sample does not
        determine it.
    """

    shape: float
    location: float
    scale: float
    bounded: bool

    def probability_below(self, x: Array) -> Array:
        """Return the probability of a smaller value than each of x."""
        return np.asarray(weibull_min.cdf(x, self.shape, self.location, self.scale))

    def density(self, x: Array) -> Array:
        """Return the probability density at each of x."""
        return np.asarray(weibull_min.pdf(x, self.shape, self.location, self.scale))

    def quantile(self, part: float) -> float:
        """Return the value below which a part of the probability lies."""
        return float(weibull_min.ppf(part, self.shape, self.location, self.scale))


def fit(values: Sequence[float] | Array) -> Weibull | None:
    """Fit the Weibull distribution by maximum likelihood.

    The location is searched on a grid in the logarithm of its distance below the least value. The
    grid is refined around the best point.

    Parameters
    ----------
    values
        The sample (n,).

    Returns
    -------
    The most likely distribution; None with fewer than `LEAST_DIFFERENT` different values.
    """
    x = np.sort(np.asarray(values, dtype=float))
    if len(np.unique(x)) < LEAST_DIFFERENT:
        return None
    deviation = float(x.std())
    # logarithm of the distance below the least value, over the standard deviation: bounds of the
    # search, and the best one so far
    low, high = np.log(SPANS)
    ends, best = (low, high), 0.0
    for _ in range(ROUNDS):
        log_distances = np.linspace(low, high, GRID)
        likelihoods = _likelihoods(x, locations=x[0] - deviation * np.exp(log_distances))
        best = float(log_distances[np.argmax(likelihoods)])
        step = log_distances[1] - log_distances[0]
        # the next grid is between the neighbours of the best point
        low, high = max(best - step, ends[0]), min(best + step, ends[1])
    # the distribution with the best location
    location = x[0] - deviation * float(np.exp(best))
    shape, scale = (float(v[0]) for v in _best_shape_and_scale(x, np.array([location])))
    smallest_shape, _ = SHAPES
    is_at_bound = best in ends or shape <= smallest_shape
    return Weibull(shape, float(location), scale, bounded=is_at_bound)


def distance(values: Array, weibull: Weibull) -> float:
    """Return the distance of Kolmogorov and Smirnov of a sample from a distribution.

    It is the largest difference between the empirical and the fitted distribution function.
    """
    # the empirical function jumps at each value: from i/n to (i + 1)/n
    probabilities, n = weibull.probability_below(np.sort(values)), len(values)
    return float(
        np.max([np.arange(1, n + 1) / n - probabilities, probabilities - np.arange(n) / n])
    )


def _likelihoods(x: Array, locations: Array) -> Array:
    """Return the mean log-likelihood (m,) of a sample x (n,) for locations (m,).

    Shape and scale are the best ones for each location.
    """
    shapes, scales = _best_shape_and_scale(x, locations)
    # with z = ln((x - location)/scale), the logarithm of the density is
    # ln(shape/scale) + (shape - 1) z - exp(shape z)
    logs = np.log((x - locations[:, None]) / scales[:, None])
    powers = np.exp(shapes[:, None] * logs)
    return np.asarray(
        np.log(shapes / scales) + np.mean((shapes[:, None] - 1) * logs - powers, axis=1)
    )


def _best_shape_and_scale(x: Array, locations: Array) -> tuple[Array, Array]:
    """Return the best shape (m,) and scale (m,) of a sample x (n,) for locations (m,).

    With t = x - location, the shape k solves 1/k = sum(t^k log t)/sum(t^k) - mean(log t), by
    Newton's method for log k, and the scale is mean(t^k)^(1/k). In the code y = log t.
    """
    y = np.log(x - locations[:, None])
    mean_log = y.mean(axis=1)
    y = y - y.mean(axis=1, keepdims=True)  # its mean is 0 now, which leaves k unchanged
    # log t of a Weibull distribution has the deviation 1.28/k: a start a little below
    k = 1.2 / np.maximum(y.std(axis=1), 1e-12)
    for _ in range(STEPS):
        largest_exponent = np.max(k[:, None] * y, axis=1, keepdims=True)
        # t^k, scaled against overflow, and its sums with powers of y
        w = np.exp(k[:, None] * y - largest_exponent)
        s0, s1, s2 = w.sum(axis=1), (w * y).sum(axis=1), (w * y**2).sum(axis=1)
        # right side less left side of the equation, and its derivative by k
        value, slope = s1 / s0 - 1 / k, s2 / s0 - (s1 / s0) ** 2 + 1 / k**2
        # the step of log k, at most by 1
        k = k * np.exp(np.clip(-value / (slope * k), -1.0, 1.0))
    k = np.clip(k, *SHAPES)
    largest_exponent = np.max(k[:, None] * y, axis=1, keepdims=True)
    # logarithm of the mean of exp(k y), from which the scale follows
    log_of_mean = (
        np.log(np.mean(np.exp(k[:, None] * y - largest_exponent), axis=1)) + largest_exponent[:, 0]
    )
    return np.asarray(k), np.asarray(np.exp(mean_log + log_of_mean / k))


def intervals(
    values: Sequence[float] | Array, seed: int, count: int = 400
) -> dict[str, tuple[float, float]]:
    """Return bootstrap intervals of moments and Weibull parameters, by percentiles.

    Parameters
    ----------
    seed, count
        Seed of the resampling, and the number of resamples.

    Returns
    -------
    Name of the number -> its interval with the probability `LEVEL`.
    """
    x, rng = np.asarray(values, dtype=float), np.random.default_rng(seed)
    # name of a number -> its values in all resamples
    resampled: dict[str, list[float]] = {}
    for _ in range(count):
        resample = rng.choice(x, len(x))
        numbers = {"mean": float(resample.mean()), "deviation": float(resample.std(ddof=1))}
        if weibull := fit(resample):  # a resample may have too few different values
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
    """Return the text of report.md.

    Parameters
    ----------
    content
        The content of summary.json.
    rows
        Rows of samples.csv.
    ending
        Ending of the names of table and picture, before the suffix.
    """
    table = f"samples{ending}.csv"
    counts, weibull = content["counts"], content["weibull"]
    counted = ", ".join(
        f"{number} {STATUS[name]}" for name, number in counts.items() if name != "samples"
    )
    # heading, and the head of the table
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
    # moments, and parameters of the Weibull distribution
    numbers = {key: content[key] for key in ("mean", "deviation", "least", "median", "largest")}
    lines += [_row(key, value, content["intervals"]) for key, value in numbers.items()]
    if weibull:
        names = ("shape", "location", "scale", "quantile_1_percent", "distance")
        lines += [
            _row(key, weibull[key], content["intervals"], prefix="Weibull, ") for key in names
        ]
        if weibull["bounded"]:
            lines += [
                "",
                "The likelihood has no maximum inside the bounds of the search: the three "
                "parameters are not",
            ]
            lines += ["determined by these samples."]
    else:
        lines += ["", "Too few different results for a Weibull distribution."]
    # what not every ensemble has: correlations, a run without defects, samples without a result
    if content["correlations"]:
        lines += _lines_of_correlations(content)
    if without_weakest := content["without_weakest"]:
        lines += [
            "",
            f"Without the {content['deleted']} weakest defects of each sample: mean "
            f"{without_weakest['mean']:.6g}, a change of "
            f"{100 * without_weakest['change_of_mean']:+.2f} %; the largest change of one sample "
            "is "
            f"{100 * without_weakest['largest_change']:+.2f} %.",
        ]
    if rows_without_result := [row for row in rows if row["status"] != "found"]:
        lines += _lines_of_samples_without_result(rows_without_result, table)
    return "\n".join(lines) + "\n"


def _lines_of_correlations(content: Mapping[str, Any]) -> list[str]:
    """Return the table of correlations in report.md, for the content of summary.json."""
    return [
        "",
        f"| {content['result']} against | Pearson | Spearman |",
        "| --- | --- | --- |",
        *(
            f"| {key} | {c['pearson']:.3f} | {c['spearman']:.3f} |"
            for key, c in content["correlations"].items()
        ),
    ]


def _lines_of_samples_without_result(rows: Sequence[Row], table: str) -> list[str]:
    """Return the list of samples without the result in report.md.

    Parameters
    ----------
    rows
        Rows of these samples in samples.csv; the first `MOST_LISTED` are listed.
    table
        Name of the file that has all of them.
    """
    lines = [
        "",
        "Samples without the result:",
        "",
        "| sample | status | why |",
        "| --- | --- | --- |",
    ]
    lines += [
        f"| {row['sample']} | {row['status']} | {str(row['why']).replace('|', '/')} |"
        for row in rows[:MOST_LISTED]
    ]
    if len(rows) > MOST_LISTED:
        lines.append(f"| … | | {len(rows) - MOST_LISTED} more in {table} |")
    return lines


def _row(
    key: str, value: float | None, intervals: dict[str, tuple[float, float]], prefix: str = ""
) -> str:
    """Return a line of the table in report.md: name, value and interval of a number.

    Parameters
    ----------
    intervals
        Name of a number -> its interval.
    prefix
        Text before the name.
    """
    ends = intervals.get(key)
    value_text = "" if value is None else f"{value:.6g}"
    interval = f"{ends[0]:.5g} to {ends[1]:.5g}" if ends else ""
    return f"| {prefix}{key.replace('_', ' ')} | {value_text} | {interval} |"
