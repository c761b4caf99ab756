"""A free parameter of terms: the derivatives of their energies with respect to it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.terms import FormTerm, Term


class Settable(Protocol):
    """A number that terms depend on."""

    value: Any


class Derivative(Protocol):
    """An energy's derivative by parameters, with the amplitude of its term."""

    @property
    def amplitude(self) -> str | None: ...

    def energy(self) -> float: ...

    def add_residual(self, b: NDArray[np.float64], factor: float) -> None: ...


class FreeParameter(Protocol):
    """What a system needs of a parameter, see `Parameter`."""

    @property
    def constant(self) -> Settable: ...

    @property
    def slopes(self) -> Sequence[Derivative]: ...

    def bends(self, q: Any) -> Sequence[Derivative]: ...


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
    _bends: dict[fem.Constant, list[FormTerm]] = field(default_factory=dict)

    def bends(self, q: Any) -> Sequence[Derivative]:
        """d2Pi_i/dp dq with the amplitudes mu_i; q may be p."""
        if not isinstance(q, fem.Constant):
            return bends_of(q, self.constant)
        if q not in self._bends:
            self._bends[q] = [
                FormTerm(f"{t.name} twice", derived(t.form, q), t._u, self.log, t.amplitude)
                for t in self.slopes
                if q in t.form.constants()
            ]
        return self._bends[q]


def bends_of(q: Any, p: Any) -> Sequence[Derivative]:
    """The mixed derivatives by q, which is no constant in a form, as q has them; else none."""
    return list(q.bends(p)) if hasattr(q, "bends") else []


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
