"""ensemble.png: histogram, distribution function, and the result over the most severe defect."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from magshell_fenicsx.studies.ensemble.statistics import correlations, results
from magshell_fenicsx.studies.ensemble.table import RESULT, WITHOUT, Row
from magshell_fenicsx.studies.ensemble.weibull import fit

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
        x, found = np.linspace(values.min(), values.max(), 300), fit(values)
        histogram.hist(values, bins="auto" if np.ptp(values) > 0 else 1, density=True, color="C0", alpha=0.4)
        ordered = np.sort(values)
        part = np.arange(len(values) + 1) / len(values)
        function.step(np.append(ordered[:1], ordered), part, where="post", color="C0", label="samples")
        if len(less := np.sort(results(rows, WITHOUT))):
            part = np.arange(1, len(less) + 1) / len(less)
            function.step(less, part, where="post", color="C2", linewidth=1, label="without the weakest defects")
        if found:
            histogram.plot(x, found.density(x), color="C3")
            function.plot(x, found.below(x), color="C3", label=f"Weibull, shape {found.shape:.3g}")
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
