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

Weighted = tuple[str | None, float]  # an amplitude, None for 1, and this rank's part of what it multiplies


class Settable(Protocol):
    """A number that terms depend on."""

    value: Any


class Slope(Protocol):
    """The derivative of terms with one amplitude."""

    @property
    def amplitude(self) -> str | None: ...

    def energy(self) -> float:
        """On this rank's part."""

    def add_residual(self, b: NDArray[np.float64], factor: float) -> None:
        """Add its gradient, see `Term`."""


class FreeParameter(Protocol):
    """What a system needs of a parameter, see `Parameter`."""

    @property
    def constant(self) -> Settable: ...

    @property
    def slopes(self) -> Sequence[Slope]: ...

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
    _bends: dict[fem.Constant, list[tuple[str | None, fem.Form]]] = field(default_factory=dict)

    def bends(self, q: Any) -> list[Weighted]:
        """d2Pi_i/dp dq with the amplitudes mu_i; q may be p. Its first call compiles: collective."""
        if not isinstance(q, fem.Constant):
            return bends_of(q, self.constant)
        if q not in self._bends:
            entered = [slope for slope in self.slopes if q in slope.form.constants()]
            self._bends[q] = [
                (slope.amplitude, self.log.compile(f"{slope.name} twice", derived(slope.form, q))) for slope in entered
            ]
        return [(amplitude, fem.assemble_scalar(form)) for amplitude, form in self._bends[q]]


def bends_of(q: Any, p: Any) -> list[Weighted]:
    """The mixed derivatives by what is no constant in a form, as that has them; else none."""
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
