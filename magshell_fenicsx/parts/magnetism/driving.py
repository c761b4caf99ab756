"""The amplitudes of driven fields as free parameters of a system."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import ufl
from dolfinx import fem

from magshell_fenicsx.assembly.following import PointField
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.parameters import Derivative, bends_of
from magshell_fenicsx.assembly.terms import FormTerm, Term
from magshell_fenicsx.parts.magnetism.applied import AppliedField


@dataclass
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


@dataclass(frozen=True)
class FieldParameter:
    """An amplitude of a driven field, as `assembly.parameters.Parameter`.

    The energy is linear in the field: of dB/dmu it is dPi/dmu. So the forms are those of the terms, with the
    polynomials of the derivatives.

    Attributes
    ----------
    slopes
        dPi_i/dmu as terms.
    """

    constant: Amplitude
    terms: Sequence[FormTerm]
    log: KernelLog
    slopes: Sequence[FormTerm]
    _bends: dict[str, list[FormTerm]] = field(default_factory=dict)

    def bends(self, q: object) -> Sequence[Derivative]:
        """d2Pi_i/dmu dq with the amplitudes that multiply them."""
        known = self.constant.known
        if not isinstance(q, Amplitude) or q.known is not known:
            return bends_of(q, self.constant)
        if q.name not in self._bends:
            bend = known.slope(self.constant.name, q.name)
            self._bends[q.name] = [
                FormTerm(t.name, _with(t.form, known, bend), t._u, self.log, t.amplitude) for t in self.terms
            ]
        return self._bends[q.name]


def field_parameters(
    fields: Sequence[AppliedField], terms: Sequence[Term], u: fem.Function, log: KernelLog
) -> dict[str, FieldParameter]:
    """The amplitudes of driven fields, by name; collective."""
    found = {}
    for known in fields:
        own = [t for t in terms if isinstance(t, FormTerm) and known.polynomial in t.form.coefficients()]
        for name in known.names:
            slope = known.slope(name)
            slopes = [FormTerm(t.name, _with(t.form, known, slope), u, log, t.amplitude) for t in own]
            for each in slopes:
                each.compile_residual()
            found[name] = FieldParameter(Amplitude(known, name), own, log, slopes)
    return found


def _with(form: ufl.Form, known: AppliedField, instead: PointField) -> ufl.Form:
    return ufl.replace(form, {known.polynomial: instead})
