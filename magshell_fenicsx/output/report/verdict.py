"""The result of a run in one sentence, for its report."""

from collections.abc import Mapping, Sequence
from math import pi
from typing import Any

from markupsafe import Markup

from magshell_fenicsx.output.report.html_numbers import number
from magshell_fenicsx.output.report.report_path import Line, symbol
from magshell_fenicsx.output.store.known import pole_of
from magshell_fenicsx.output.store.table import LOCATED, OWN_MODES, pole_name
from magshell_fenicsx.quantities.registry import amplitude, quantity

Summary = Mapping[str, Any]


def located(lines: Sequence[Line]) -> list[Line]:
    """The folds and bifurcations among the rows of a path."""
    return [line for line in lines if line["label"] in LOCATED]


def verdict(summary: Summary, lines: Sequence[Line]) -> Markup:
    """The result, and the reason if the run stopped early."""
    loading = summary["case"].get("loading") or {}
    until = (loading[-1] if isinstance(loading, list) else loading).get("until", "target")
    first = next((line for line in located(lines) if line["branch"] == "0"), None)
    sentences = [_end(summary, lines)] if not first or until in ("target", "points") else []
    if first:
        sentences.append(_instability(first, summary))
    if found := summary.get("solutions"):
        stable = sum(it["stable"] for it in found)
        more = "further solution" + "s" * (len(found) != 1)
        sentences.append(
            Markup("A search has found {} {}, {} of them stable.").format(len(found), more, stable or "none")
        )
    if summary["stopped"]:
        points = f"{len(lines)} point{'s' * (len(lines) != 1)}"
        sentences.insert(0, Markup("The run stopped early, after {}: {}.").format(points, summary["stopped"]))
    return Markup(" ").join(sentences)


def value(line: Line, summary: Summary) -> Markup:
    """The amplitude that varied at a point, as "p/p_c = 0.326233 (53.7 Pa)"."""
    name = amplitude(line["amplitude"]).column
    amount, degrees = float(line[name]), "°" if line["amplitude"] == "angle" else ""
    size, unit = physical_units(summary).get(line["amplitude"], (0.0, ""))
    measured = Markup(" ({} {})").format(number(amount * size), unit) if size else ""
    return Markup("{} = {}{}{}").format(symbol(name), number(amount), degrees, measured)


def physical_units(summary: Summary) -> dict[str, tuple[float, str]]:
    """Amplitude -> (size of one, unit) in SI, where the case gives units; the field by its flux density."""
    dims, of, sizes = summary["dimensions"], summary["dimensionless"], {}
    applied = ((summary["case"].get("magnetic") or {}).get("applied") or {}).get("flux_density")
    if applied and of["lambda_m"]:
        sizes["lambda_m"] = 1e3 * abs(applied / of["lambda_m"])
    if dims["units"] == "SI" and dims["youngs_modulus"]:
        sizes["pressure"] = of["pc_over_E"] * dims["youngs_modulus"]
        if dims["thickness"]:
            sizes["force"] = 2 * pi * bending_stiffness(summary) / dims["radius"]
    return {name: (size, quantity(amplitude(name).column).si) for name, size in sizes.items()}


def bending_stiffness(summary: Summary) -> float:
    """D = E h^3/(12 (1 - nu^2)) in the units of the case's dimensions."""
    dims, nu = summary["dimensions"], summary["dimensionless"]["poisson_ratio"]
    return float(dims["youngs_modulus"] * dims["thickness"] ** 3 / (12 * (1 - nu**2)))


def _instability(line: Line, summary: Summary) -> Markup:
    kind = line["label"]
    if line["mode"]:
        kind += f" ({line['mode']}{' waves' if line['mode'] not in (*OWN_MODES, 'antisymmetric') else ''})"
    at, place = value(line, summary), _displacement(line, summary)
    if line["amplitude"] == "pressure" and summary["knockdown"] is not None:
        sentence = "The shell buckles at the knockdown factor k<sub>d</sub> = {}: a {}, {}."
    elif line["amplitude"] == "lambda_m":
        sentence = "The field makes the shell unstable at the critical {}: a {}, {}."
    else:
        sentence = "The first instability on the path is at {}: a {}, {}."
    return Markup(sentence).format(at, kind, place)


def _end(summary: Summary, lines: Sequence[Line]) -> Markup:
    path = [line for line in lines if line["branch"] == "0" and line["label"] not in LOCATED]
    last = path[-1] if path else None
    if last is None or not last["amplitude"]:
        return Markup("Nothing loads the shell: this is its undeformed state." if not summary["stopped"] else "")
    reached = "The run reached its target" if last["label"] == "target" and not summary["stopped"] else "The last point"
    return Markup("{}: {}, {}.").format(reached, value(last, summary), _displacement(last, summary))


def _displacement(line: Line, summary: Summary) -> Markup:
    varied, w = amplitude(line["amplitude"]), symbol("w_over_h")
    if varied.conjugate == "w_over_h" and line["w_over_h"] != line["w_pole_over_h"]:
        return Markup("{} = {} {}").format(w, number(float(line["w_over_h"])), varied.place)
    return Markup("{} = {} at {}").format(
        w, number(float(line["w_pole_over_h"])), pole_name(line, pole_of(summary["case"]))
    )
