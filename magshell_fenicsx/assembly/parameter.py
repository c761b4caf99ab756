"""A free parameter of terms: the derivatives of their energies with respect to it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import ufl
from dolfinx import fem

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.terms import FormTerm, Term


@dataclass(frozen=True)
class Parameter:
    """A free parameter p of a system with the terms mu_i Pi_i(u; p), in which p is a constant.

    Attributes
    ----------
    constant
        p in the terms.
    slopes
        Amplitude mu_i -> dPi_i/dp, as a term; None -> that of the terms without an amplitude.
    bends
        Parameter q -> amplitude mu_i, or None -> d2Pi_i/dp dq, as a form; q may be p.
    """

    constant: fem.Constant
    slopes: Mapping[str | None, Term]
    bends: Mapping[str, Mapping[str | None, fem.Form]]


def make_parameters(
    constants: Mapping[str, fem.Constant], terms: Sequence[Term], u: fem.Function, log: KernelLog
) -> dict[str, Parameter]:
    """The free parameters of a model, by name; collective.

    Parameters
    ----------
    constants
        The parameters as they stand in the forms of the terms.
    """
    energies: dict[str | None, ufl.Form] = {}
    for term in terms:
        if isinstance(term, FormTerm) and set(constants.values()) & set(term.form.constants()):
            energies[term.amplitude] = energies.get(term.amplitude, 0) + term.form
    found = {}
    for name, p in constants.items():
        entered = {mu: energy for mu, energy in energies.items() if p in energy.constants()}
        first = {mu: _derived(energy, p) for mu, energy in entered.items()}
        slopes = {mu: FormTerm(f"{mu or 'energy'} by {name}", form, u, log, mu) for mu, form in first.items()}
        for slope in slopes.values():
            slope.compile_residual()
        bends = {
            other: {
                mu: log.compile(f"{mu or 'energy'} by {name} and {other}", _derived(form, q))
                for mu, form in first.items()
                if q in entered[mu].constants()
            }
            for other, q in constants.items()
        }
        found[name] = Parameter(p, slopes, bends)
    return found


def _derived(energy: ufl.Form, p: fem.Constant) -> ufl.Form:
    variable = ufl.variable(p)
    return ufl.diff(ufl.replace(energy, {p: variable}), variable)
