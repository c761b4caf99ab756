"""The amplitudes of driven fields as free parameters of a system."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import ufl
from dolfinx import fem

from magshell_fenicsx.assembly.following import PointField
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.parameters import Derivative, Parameter
from magshell_fenicsx.assembly.terms import FormTerm, Term
from magshell_fenicsx.parts.magnetism.applied import AppliedField


@dataclass(eq=False)
class Amplitude:
    """The value of an amplitude in a field, which takes the place of a constant in a form."""

    known: AppliedField
    name: str

    @property
    def value(self) -> float:
        return self.known.mu[self.name]

    @value.setter
    def value(self, value: float) -> None:
        self.known.mu[self.name] = float(value)


def field_parameters(
    fields: Sequence[AppliedField], terms: Sequence[Term], u: fem.Function, log: KernelLog
) -> dict[str, Parameter]:
    """The amplitudes of driven fields, by name; collective.

    The energy is linear in the field: of dB/dmu it is dPi/dmu. So the forms are those of the terms, with the
    polynomials of the derivatives.
    """
    found = {}
    for known in fields:
        own = [t for t in terms if isinstance(t, FormTerm) and known.polynomial in t.form.coefficients()]
        for name in known.names:
            p, slopes = Amplitude(known, name), _with(own, known, known.slope(name), u, log)
            for each in slopes:
                each.compile_residual()
            found[name] = Parameter(p, slopes, partial(_twice, p, own, u, log))
    return found


def _twice(p: Amplitude, own: Sequence[FormTerm], u: fem.Function, log: KernelLog, q: object) -> Sequence[Derivative]:
    """Derivatives by two amplitudes of one field; none by what is not in it."""
    if not isinstance(q, Amplitude) or q.known is not p.known:
        return []
    return _with(own, p.known, p.known.slope(p.name, q.name), u, log)


def _with(
    own: Sequence[FormTerm], known: AppliedField, instead: PointField, u: fem.Function, log: KernelLog
) -> list[FormTerm]:
    """The terms with another polynomial in place of the field's own."""
    return [FormTerm(t.name, ufl.replace(t.form, {known.polynomial: instead}), u, log, t.amplitude) for t in own]
