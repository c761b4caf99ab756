"""The amplitudes of driven fields as free parameters of a system."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import ufl
from dolfinx import fem

from magshell_fenicsx.assembly.following import PointField
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.parameters import Derivative, Parameter, derived
from magshell_fenicsx.assembly.terms import FormTerm, Term
from magshell_fenicsx.parts.magnetism.applied import AppliedField


@dataclass(eq=False)
class Amplitude:
    """The value of an amplitude in a field, which takes the place of a constant in a form.

    Attributes
    ----------
    terms
        The energies of the field. Those with an amplitude are linear in it, as in the field; what is soft is quadratic.
    """

    known: AppliedField
    name: str
    terms: Sequence[FormTerm]
    u: fem.Function
    log: KernelLog

    @property
    def value(self) -> float:
        return self.known.mu[self.name]

    @value.setter
    def value(self, value: float) -> None:
        self.known.mu[self.name] = float(value)

    def slopes(self) -> list[FormTerm]:
        """dPi/dmu: of what is linear in the field the energy in dB/dmu."""
        linear = [self._instead(t, self.known.slope(self.name)) for t in self._linear]
        return linear + [self._along(t, self.known.slope(self.name, moved=False)) for t in self._quadratic]

    def bends(self, q: Any) -> Sequence[Derivative]:
        """d2Pi/dmu dq by a value of a field, a constant of the terms, or what has a method of its own."""
        if not isinstance(q, Amplitude):
            if hasattr(q, "bends"):
                found: Sequence[Derivative] = q.bends(self)
                return found
            entered = [t for t in self.slopes() if q in t.form.constants()]
            return [self._term(t, derived(t.form, q)) for t in entered]
        if q.known is not self.known:
            return []
        linear = [self._instead(t, self.known.slope(self.name, q.name)) for t in self._linear]
        both, one, other = (
            self.known.slope(*names, moved=False) for names in ((self.name, q.name), (self.name,), (q.name,))
        )
        by_both = [self._along(t, both) for t in self._quadratic]
        return linear + by_both + [self._along(self._along(t, one), other) for t in self._quadratic]

    @property
    def _linear(self) -> list[FormTerm]:
        return [t for t in self.terms if t.amplitude is not None]

    @property
    def _quadratic(self) -> list[FormTerm]:
        return [t for t in self.terms if t.amplitude is None]

    def _instead(self, t: FormTerm, polynomial: PointField) -> FormTerm:
        """The term with another polynomial in place of the field's own."""
        return self._term(t, ufl.replace(t.form, {self.known.polynomial: polynomial}))

    def _along(self, t: FormTerm, change: PointField) -> FormTerm:
        """The derivative of the term along a change of the polynomial."""
        return self._term(t, ufl.derivative(t.form, self.known.polynomial, change))

    def _term(self, t: FormTerm, form: ufl.Form) -> FormTerm:
        return FormTerm(t.name, form, self.u, self.log, t.amplitude)


def field_parameters(
    fields: Sequence[AppliedField], terms: Sequence[Term], u: fem.Function, log: KernelLog
) -> dict[str, Parameter]:
    """The amplitudes of driven fields, by name; collective."""
    found = {}
    for known in fields:
        own = [t for t in terms if isinstance(t, FormTerm) and known.polynomial in t.form.coefficients()]
        for name in known.names:
            p = Amplitude(known, name, own, u, log)
            slopes = p.slopes()
            for each in slopes:
                each.compile_residual()
            found[name] = Parameter(p, slopes, p.bends)
    return found
