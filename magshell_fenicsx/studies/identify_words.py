"""What an identification has found, in words."""

from typing import Any

import numpy as np
import scipy

from magshell_fenicsx.studies.identify_data import Table
from magshell_fenicsx.studies.identify_field import words
from magshell_fenicsx.studies.laplace import NORMAL, Fit

ALIKE = 0.95  # correlation from which two parameters are hardly told apart
PRIOR = 0.9  # part of the prior's deviation above which data say little
UNLIKELY = 1e-3  # probability of so large a misfit, if the noise is as given


def sentences(content: dict[str, Any], fit: Fit, table: Table) -> list[str]:
    """What is found, in words."""
    measured = fit.known
    said, keys = list[str](), list(content["parameters"])
    for key, each in content["parameters"].items():
        unit = f" {each['unit']}" if each["unit"] else ""
        said.append(
            f"{key} = {each['value']:.6g}{unit}, 95 % between {each['low']:.6g} and {each['high']:.6g}{unit}"
        )
        if each["prior"] and each["deviation"] > PRIOR * each["prior"]["deviation"]:
            said.append(f"{key}: the data add little to its prior")
    if content["remanence"]:
        said += words(content["remanence"])
    for i, j in zip(*np.triu_indices(len(keys), 1), strict=True):
        if abs(c := float(fit.correlation[i, j])) > ALIKE:
            said.append(
                f"{keys[i]} and {keys[j]} can hardly be told apart by these data: correlation {c:+.4f}"
            )
    for header, each in content["noise"].items():
        how = "estimated" if each["estimated"] else "given"
        said.append(
            f"noise of {header}: {each['deviation']:.4g} {each['unit']}".rstrip() + f", {how}"
        )
    for header, count in table.missing.items():
        said.append(f"{header}: rows without a number, left out: {count}")
    if not np.isnan(measured.noise).any():
        square = float((((measured.data - fit.y) / fit.noise[table.column]) ** 2).sum())
        if scipy.stats.chi2.sf(square, max(len(measured.data), 1)) < UNLIKELY:
            said.append(
                f"warning: the misfit is {content['misfit_over_noise']:.3g} times the noise: the model does not "
                "describe these data, or their noise is larger; leave it out to have it estimated"
            )
    bent, lost = content["normal"]["difference"], content["normal"]["lost"]
    if bent > NORMAL or lost:
        nowhere = f", and at {lost} such places nothing is predicted" if lost else ""
        said.append(
            f"warning: at the ends of the bands the misfit differs by {100 * bent:.0f} % from its parabola{nowhere}: "
            "the bands are rough"
        )
    if content["ended"] != "converged":
        said.append(f"warning: the fit has not converged: {content['ended']}")
    for each in content["predicted"]:
        place = f" at {each['at']:g}" if each["at"] != "end" else ""
        if "note" in each:
            said.append(f"{each['result']}{place}: is not predicted: {each['note']}")
            continue
        said.append(
            f"{each['result']}{place} = {each['value']:.6g} {each['unit']}".rstrip()
            + f" predicted, 95 % between {each['low']:.6g} and {each['high']:.6g}"
        )
    if best := content["next"]:
        place = "" if best["at"] == "end" else f" at {best['at']:g}"
        said.append(
            f"next: {best['result']}{place} narrows {best['parameter']} most: "
            f"deviation {best['from']:.3g} -> {best['to']:.3g}"
        )
    return said
