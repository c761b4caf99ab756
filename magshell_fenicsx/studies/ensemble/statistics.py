"""The statistics of an ensemble: the content of its summary.json."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.studies.ensemble.table import RESULT, WITHOUT, Row, drawn_keys, severest_keys
from magshell_fenicsx.studies.ensemble.weibull import LEVEL, Weibull, fit, intervals

Array = NDArray[np.float64]
RESAMPLED = 300
LEAST = 3  # samples for a correlation


def results(rows: Sequence[Row], column: str = RESULT) -> Array:
    """The results of the samples that have one."""
    return np.array([row[column] for row in rows if row.get(column) is not None], dtype=float)


def statistics(rows: Sequence[Row], seed: int) -> dict[str, Any]:
    """Numbers of samples, moments, the Weibull fit, correlations, and the change without the weakest defects.

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
        "intervals": intervals(values, seed, RESAMPLED) if len(values) >= LEAST else {},
        "correlations": correlations(rows),
        "without_weakest": _without(rows),
        "cpu_s_per_sample": float(np.mean([row["cpu_s"] for row in rows if row["cpu_s"] is not None] or [np.nan])),
    }


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """The number of samples, and of those with each status."""
    statuses = [row["status"] for row in rows]
    return {"samples": len(rows), **{status: statuses.count(status) for status in sorted(set(statuses))}}


def moments(values: Array) -> dict[str, Any]:
    """Mean, standard deviation and quartiles; None where there are too few values."""
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
    found = fit(values) if len(values) else None
    if found is None:
        return None
    return {**asdict(found), "quantile_1_percent": found.quantile(0.01), "distance": distance(values, found)}


def distance(values: Array, found: Weibull) -> float:
    """The largest difference between the empirical and the fitted distribution function (Kolmogorov and Smirnov)."""
    below, n = found.below(np.sort(values)), len(values)
    return float(np.max([np.arange(1, n + 1) / n - below, below - np.arange(n) / n]))


def correlations(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """The correlation of the result with the most severe defect and with every key: Pearson's and Spearman's."""
    from scipy.stats import pearsonr, spearmanr

    found = {}
    drawn = [key for key in drawn_keys(rows) if not key.startswith("shell.imperfections.")]
    for key in (*severest_keys(rows), *drawn):
        pairs = np.array([(x, y) for row in rows if _is_number(x := row.get(key)) and (y := row[RESULT]) is not None])
        if len(pairs) < LEAST or not np.ptp(pairs, axis=0).all():
            continue
        x, y = pairs.T
        found[key] = {"pearson": float(pearsonr(x, y)[0]), "spearman": float(spearmanr(x, y)[0])}
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, float | int)


def _without(rows: Sequence[Row]) -> dict[str, Any] | None:
    """The change of the result by deleting the weakest defects, over the samples that have both."""
    both = [(row[RESULT], row[WITHOUT]) for row in rows if row[RESULT] is not None and row.get(WITHOUT) is not None]
    if not both:
        return None
    whole, less = np.array(both).T
    change = less / whole - 1
    return {
        "samples": len(both),
        "mean": float(less.mean()),
        "change_of_mean": float(less.mean() / whole.mean() - 1),
        "largest_change": float(change[np.argmax(np.abs(change))]),
    }
