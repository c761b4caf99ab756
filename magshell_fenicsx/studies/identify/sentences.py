"""Sentences about the results of an identification.

Content is that of identify.json. A band has the true value with 95 % probability. A prior is what
was known of a parameter before; the noise of a column is the standard deviation of its errors.
"""

from typing import Any

import numpy as np
import scipy

from magshell_fenicsx.studies.identify.data import MeasuredTable
from magshell_fenicsx.studies.identify.laplace import NORMAL, Posterior
from magshell_fenicsx.studies.identify.remanence_field import words

HIGH_CORRELATION = 0.95  # correlation from which two parameters are hardly told apart
PRIOR = 0.9  # part of the prior's deviation above which data say little
UNLIKELY = 1e-3  # probability of so large a misfit, if the noise is as given


def sentences(content: dict[str, Any], posterior: Posterior, table: MeasuredTable) -> list[str]:
    """Describe the results of an identification in sentences.

    Parameters
    ----------
    content
        The content of identify.json.
    table
        The measured data.
    """
    lines = _sentences_of_parameters(content)
    if content["remanence"]:
        lines += words(content["remanence"])
    return [
        *lines,
        *_sentences_of_correlations(list(content["parameters"]), posterior),
        *_sentences_of_noise(content, table),
        *_warnings(content, posterior, table),
        *_sentences_of_predictions(content),
    ]


def _sentences_of_parameters(content: dict[str, Any]) -> list[str]:
    """Return value and band of each parameter, and whether the data add little to its prior."""
    lines = list[str]()
    for key, entry in content["parameters"].items():
        unit = f" {entry['unit']}" if entry["unit"] else ""
        lines.append(
            f"{key} = {entry['value']:.6g}{unit}, 95 % between {entry['low']:.6g} and "
            f"{entry['high']:.6g}{unit}"
        )
        if entry["prior"] and entry["deviation"] > PRIOR * entry["prior"]["deviation"]:
            lines.append(f"{key}: the data add little to its prior")
    return lines


def _sentences_of_correlations(keys: list[str], posterior: Posterior) -> list[str]:
    """Return a sentence for each pair of parameters that the data hardly tell apart."""
    lines = list[str]()
    for i, j in zip(*np.triu_indices(len(keys), 1), strict=True):  # pairs i < j
        correlation = float(posterior.correlation[i, j])
        if abs(correlation) > HIGH_CORRELATION:
            lines.append(
                f"{keys[i]} and {keys[j]} can hardly be told apart by these data: correlation "
                f"{correlation:+.4f}; data of a second field or load may, or a prior of one; "
                "candidates says which data narrow them most"
            )
    return lines


def _sentences_of_noise(content: dict[str, Any], table: MeasuredTable) -> list[str]:
    """Return the noise of each column, and the number of rows that are left out."""
    lines = list[str]()
    for header, entry in content["noise"].items():
        origin = "estimated" if entry["estimated"] else "given"
        lines.append(
            f"noise of {header}: {entry['deviation']:.4g} {entry['unit']}".rstrip() + f", {origin}"
        )
    for header, count in table.missing.items():
        lines.append(f"{header}: rows without a number, left out: {count}")
    return lines


def _warnings(content: dict[str, Any], posterior: Posterior, table: MeasuredTable) -> list[str]:
    """Return warnings of a misfit beyond the noise, of rough bands, and of a fit not converged."""
    measured, lines = posterior.measured, list[str]()
    # estimated noise always fits the residuals; only given noise can be too small
    if not np.isnan(measured.noise).any():
        deviations = (measured.data - posterior.y) / posterior.noise[table.column]
        # is so large a sum of squares unlikely by chance?
        chi_squared = float((deviations**2).sum())
        if scipy.stats.chi2.sf(chi_squared, max(len(measured.data), 1)) < UNLIKELY:
            lines.append(
                f"warning: the misfit is {content['misfit_over_noise']:.3g} times the noise: the "
                "model does not describe these data, or their noise is larger; leave it out to "
                "have it estimated"
            )
    # the largest relative difference of the misfit from its parabola, at the ends of the bands; and
    # the number of these ends at which nothing is predicted
    misfit_difference, lost_count = content["normal"]["difference"], content["normal"]["lost"]
    if misfit_difference > NORMAL or lost_count:
        nowhere = f", and at {lost_count} such places nothing is predicted" if lost_count else ""
        lines.append(
            "warning: at the ends of the bands the misfit differs by "
            f"{100 * misfit_difference:.0f} % from its parabola{nowhere}: the bands are rough"
        )
    if content["ended"] != "converged":
        lines.append(f"warning: the fit has not converged: {content['ended']}")
    return lines


def _sentences_of_predictions(content: dict[str, Any]) -> list[str]:
    """Return value and band of each candidate, and the measurement that narrows a band most."""
    lines = list[str]()
    for entry in content["predicted"]:
        place = f" at {entry['at']:g}" if entry["at"] != "end" else ""
        if "note" in entry:
            lines.append(f"{entry['result']}{place}: is not predicted: {entry['note']}")
            continue
        lines.append(
            f"{entry['result']}{place} = {entry['value']:.6g} {entry['unit']}".rstrip()
            + f" predicted, 95 % between {entry['low']:.6g} and {entry['high']:.6g}"
        )
    best = content["next"]
    if best:
        place = "" if best["at"] == "end" else f" at {best['at']:g}"
        lines.append(
            f"next: {best['result']}{place} narrows {best['parameter']} most: "
            f"deviation {best['from']:.3g} -> {best['to']:.3g}"
        )
    return lines
