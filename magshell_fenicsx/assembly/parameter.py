"""A free parameter of terms: the derivatives of their energies with respect to it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import ufl
from dolfinx import fem

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.terms import FormTerm, Term

Weighted = tuple[str | None, fem.Form]  # an amplitude, None for 1, and a form that it multiplies


class Settable(Protocol):
    """A number that terms depend on."""

    value: Any


class FreeParameter(Protocol):
    """What a system needs of a parameter, see `Parameter`."""

    @property
    def constant(self) -> Settable: ...

    @property
    def slopes(self) -> Sequence[FormTerm]: ...

    def bends(self, q: Any) -> list[Weighted]: ...


@dataclass(frozen=True)
class Parameter:
    """A free parameter p of a system with the terms mu_i Pi_i(u; p), in which p is a constant.

    Attributes
    ----------
    constant
        p in the terms.
    slopes
        dPi_i/dp as terms with the amplitudes mu_i.
    log
        Of the kernels that are compiled on first use.
    """

    constant: fem.Constant
    slopes: Sequence[FormTerm]
    log: KernelLog
    _bends: dict[fem.Constant, list[Weighted]] = field(default_factory=dict)

    def bends(self, q: fem.Constant) -> list[Weighted]:
        """d2Pi_i/dp dq with the amplitudes mu_i; q may be p. Its first call compiles: collective."""
        if q not in self._bends:
            entered = [slope for slope in self.slopes if q in slope.form.constants()]
            self._bends[q] = [
                (slope.amplitude, self.log.compile(f"{slope.name} twice", derived(slope.form, q))) for slope in entered
            ]
        return self._bends[q]


def make_parameters(
    constants: Mapping[str, fem.Constant], terms: Sequence[Term], u: fem.Function, log: KernelLog
) -> dict[str, Parameter]:
    """The free parameters of a model, by name; collective.

    Parameters
    ----------
    constants
        The parameters as they stand in the forms of the terms.
    """
    found, forms = {}, [term for term in terms if isinstance(term, FormTerm)]
    for name, p in constants.items():
        slopes = [
            FormTerm(f"{term.name} by {name}", derived(term.form, p), u, log, term.amplitude)
            for term in forms
            if p in term.form.constants()
        ]
        for slope in slopes:
            slope.compile_residual()
        found[name] = Parameter(p, slopes, log)
    return found


def derived(energy: ufl.Form, p: fem.Constant) -> ufl.Form:
    """The derivative of a form by a constant in it."""
    variable = ufl.variable(p)
    return ufl.diff(ufl.replace(energy, {p: variable}), variable)
