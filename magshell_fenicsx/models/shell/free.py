"""Parameters that enter the densities of surface energies freely, as amplitudes of their own."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from dolfinx import fem, mesh
from numpy.typing import NDArray

from magshell_fenicsx.assembly.parameter import Parameter
from magshell_fenicsx.assembly.terms import Term
from magshell_fenicsx.models.shell.own_term import Free, OwnTerm

Constants = dict[str, fem.Constant]


def constants_of(term: OwnTerm, domain: mesh.Mesh, known: Constants) -> tuple[fem.Constant, ...]:
    """The parameters of a term as constants; a free one has the same constant in all terms, kept in `known`."""

    def constant(value: float | NDArray[np.float64]) -> fem.Constant:
        return fem.Constant(domain, np.asarray(value, dtype=float))

    return tuple(
        known.setdefault(p.name, constant(p.value)) if isinstance(p, Free) else constant(p) for p in term.parameters
    )


def free_parameters(
    terms: Sequence[OwnTerm],
    known: Constants,
    energy: Callable[[OwnTerm], Term],
    integrals: Callable[[OwnTerm], Mapping[str, fem.Form]],
) -> dict[str, Parameter]:
    """The free parameters of a model's terms, by name.

    Parameters
    ----------
    known
        Their constants, in the terms that the model has made.
    energy, integrals
        Make a term, and what it observes, compiled.
    """
    entering = {p.name: [term for term in terms if p in term.free] for term in terms for p in term.free}
    found = {}
    for name, users in entering.items():
        slopes = {term.name: energy(_slope(term, name)) for term in users}
        for slope in slopes.values():
            slope.compile_residual()
        bends: dict[str, dict[str, fem.Form]] = {}
        for term in users:
            seconds = {p.name: term.derivative(name, p.name) for p in term.free}
            for other, form in integrals(replace(term, observed=seconds)).items():
                bends.setdefault(other, {})[term.name] = form
        found[name] = Parameter(known[name], slopes, bends)
    return found


def _slope(term: OwnTerm, name: str) -> OwnTerm:
    return replace(term, name=f"{term.name}_by_{name}", density=term.derivative(name), observed={})
