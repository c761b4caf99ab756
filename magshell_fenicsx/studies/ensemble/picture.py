"""ensemble.png: the distribution of a result over random samples, and what it depends on most.

Rows and their columns are those of samples.csv, one row for each random case. The distribution
function is the probability of a smaller value, the density its derivative. A Weibull distribution
is fitted to the results. Some results are without the weakest defects of the sample.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.studies.ensemble.statistics import (
    RESULT,
    WITHOUT,
    Row,
    Weibull,
    correlations,
    fit,
    results,
)
from magshell_fenicsx.studies.figures import PANEL_HEIGHT, PANEL_WIDTH, add_legend, saved_figure
from magshell_fenicsx.studies.naming import result_label

Array = NDArray[np.float64]
MIN_SAMPLES_FOR_HISTOGRAM = 20  # samples: of fewer each is shown, no histogram
TAIL = 1e-3  # probability of the lowest value that a fitted curve shows


def draw_ensemble(rows: Sequence[Row], name: str, file: Path) -> None:
    """Draw the distribution of a result over samples, and what it depends on most.

    Parameters
    ----------
    rows
        Rows of samples.csv.
    name
        The result, as `--result` names it.
    file
        Name of the picture file.
    """
    values, label = results(rows), result_label(name) if name == "knockdown" else name
    # column with the strongest correlation, and its correlations; None if there is none
    strongest = max(
        correlations(rows).items(), key=lambda item: abs(item[1]["spearman"]), default=None
    )
    weibull = fit(values) if len(values) else None
    # marks of few samples alone need no panel
    with_density = weibull is not None or len(values) >= MIN_SAMPLES_FOR_HISTOGRAM
    panels = 1 + with_density + (strongest is not None)
    with saved_figure(file, PANEL_WIDTH * panels, PANEL_HEIGHT, dpi=160) as figure:
        # axes of the density (one or none), of the distribution function, and of the correlation
        *density, function = figure.subplots(1, panels, squeeze=False)[0][: 1 + with_density]
        further_axes = figure.axes[1 + with_density :]
        if density:
            density[0].set(xlabel=label, ylabel="probability density")
            _draw_density(density[0], values, weibull)
        if len(values):
            _draw_function(function, values, results(rows, WITHOUT), weibull)
        function.set(xlabel=label, ylabel="probability of a smaller value", ylim=(0, 1))
        if strongest:
            key, _ = strongest
            _draw_correlation(further_axes[0], rows, key, label)
        for axes in figure.axes:
            axes.locator_params(axis="x", nbins=5)  # long numbers would touch


def _places(values: Array, weibull: Weibull) -> Array:
    """Return the values at which a fitted curve is drawn, from the lowest likely value on."""
    smallest_value = float(values.min())
    # not farther below the samples than they extend
    low = max(weibull.quantile(TAIL), smallest_value - np.ptp(values))
    return np.linspace(min(low, smallest_value), values.max() + 0.1 * np.ptp(values), 400)


def _draw_density(density: Any, values: Array, weibull: Weibull | None) -> None:
    """Draw the histogram, a mark for each sample, and the fitted Weibull density if any."""
    if len(values) >= MIN_SAMPLES_FOR_HISTOGRAM:
        density.hist(
            values, bins="auto" if np.ptp(values) > 0 else 1, density=True, color="C0", alpha=0.4
        )
    density.plot(
        values,
        np.zeros(len(values)),
        "|",
        color="C0",
        markersize=14,
        clip_on=False,
        label="samples",
    )
    if weibull:
        x = _places(values, weibull)
        density.plot(x, weibull.density(x), color="C3")
    density.set_ylim(bottom=0)


def _draw_function(function: Any, values: Array, without: Array, weibull: Weibull | None) -> None:
    """Draw the distribution function of the samples, and of the fitted Weibull distribution.

    Parameters
    ----------
    values
        (n,) results.
    without
        Results without the weakest defects; empty if they were not computed.
    """
    sorted_values = np.sort(values)
    probabilities = np.arange(len(values) + 1) / len(values)
    function.step(
        np.append(sorted_values[:1], sorted_values),  # the step at the first value begins at zero
        probabilities,
        where="post",
        color="C0",
        label=f"{len(values)} samples",
    )
    if len(values_without_weakest := np.sort(without)):
        probabilities = np.arange(1, len(values_without_weakest) + 1) / len(values_without_weakest)
        function.step(
            values_without_weakest,
            probabilities,
            where="post",
            color="C2",
            linewidth=1,
            label="without the weakest defects",
        )
    if weibull:
        x = _places(values, weibull)
        function.plot(
            x, weibull.probability_below(x), color="C3", label=f"Weibull, shape {weibull.shape:.3g}"
        )
    add_legend(function)


def _draw_correlation(axes: Any, rows: Sequence[Row], key: str, label: str) -> None:
    """Draw the result over a column, with Spearman's correlation and its probability by chance.

    Parameters
    ----------
    key
        The column of samples.csv.
    label
        Label of the result.
    """
    pairs = np.array(
        [
            (row[key], row[RESULT])
            for row in rows
            if row[RESULT] is not None and row.get(key) is not None
        ]
    )
    rho, chance = correlation(*pairs.T)
    axes.plot(*pairs.T, ".", color="C0", markersize=5)
    # the probability of so strong a correlation by chance
    probability_text = "$p$ < 0.001" if chance < 1e-3 else f"$p$ = {chance:.2g}"
    number = f"{rho:.2f}".replace("-", "−")
    axes.set(xlabel=words(key).replace(" of the", "\nof the"), ylabel=label)
    axes.set_title(
        f"Spearman's correlation {number},\n$n$ = {len(pairs)}, {probability_text}", fontsize=9
    )


def correlation(x: Array, y: Array) -> tuple[float, float]:
    """Return Spearman's correlation, and its probability by chance.

    For few samples the probability is from permutations.

    Examples
    --------
    >>> x = np.arange(4.0)
    >>> [round(float(each), 4) for each in correlation(x, x)]  # 2 of 24 orders
    [1.0, 0.0833]
    """
    from scipy.stats import permutation_test, rankdata, spearmanr

    rho, chance = spearmanr(x, y)
    if len(x) >= MIN_SAMPLES_FOR_HISTOGRAM or np.isnan(rho):
        return float(rho), float(chance)
    # centred ranks: their product is Spearman's correlation up to a factor
    ranks, other_ranks = (rankdata(sample) - (len(x) + 1) / 2 for sample in (x, y))

    def rank_product(values: Array, axis: int = -1) -> Array:
        """Return the sum of products of permuted ranks with the other ranks."""
        return np.asarray(np.sum(values * other_ranks, axis=axis))

    test = permutation_test(
        (ranks,), rank_product, permutation_type="pairings", vectorized=True, random_state=1
    )
    return float(rho), float(test.pvalue)


def words(key: str) -> str:
    """Return the label of a column of samples.csv, the last word of its key with the unit.

    Examples
    --------
    >>> words("severest.amplitude_mm"), words("severest.at.polar")
    ('amplitude of the most severe defect  (mm)', 'polar of the most severe defect  (degrees)')
    >>> words("severest.amplitude")
    'amplitude over $h$ of the most severe defect'
    """
    parent, _, last_word = key.rpartition(".")
    name, unit = last_word, ""
    first_words, _, ending = last_word.rpartition("_")
    if ending == "mm":
        name, unit = first_words, "mm"
    elif last_word in ("polar", "azimuth"):
        unit = "degrees"
    name = "amplitude over $h$" if name == "amplitude" and not unit else name.replace("_", " ")
    suffix = " of the most severe defect" if parent.startswith("severest") else ""
    return f"{name}{suffix}" + (f"  ({unit})" if unit else "")
