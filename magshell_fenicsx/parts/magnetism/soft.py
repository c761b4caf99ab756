"""A soft-magnetic shell: its magnetisation follows the field at each place.

Along a thin sheet H is continuous, across it B is. So a sheet of susceptibility chi has the polarisation
mu0 M = chi (B_t + B_n n/(1 + chi)) and, per area, the energy -h M.B/2. Over E h, with B in units of mu0 E/|Br|
(lambda_m is the size of the applied field in them), it is -chi/2 (s B)² with s = sqrt(mu0 E)/|Br|. A shell without
remanence has sqrt(mu0 E) in place of |Br|. The field of other places of the shell is left out.

With a saturation J the material follows Langevin's law, mu0 M = J L(3 chi b/J) along b = mu0 H, L(x) = coth x - 1/x,
with the coenergy w = J²/(3 chi) ln (sinh x/x), x = 3 chi b/J. Along the sheet b is B; across it is the number for which

    e(B) = max over b_n of -w(|(B_t, b_n)|) - (B_n - b_n)²/2,

that is B_n = b_n + mu0 M_n. Newton's method finds it from b_n = B_n/(1 + chi), from below, in steps (`STEPS`) that are
part of the density.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import ufl
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.densities import around
from magshell_fenicsx.models.shell.kinematics import Jet

if TYPE_CHECKING:
    from magshell_fenicsx.models.shell.patterns import Pattern
    from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation

Array = NDArray[np.float64]
TERM = "soft magnetism"
STEPS = ((5.0, 3), (20.0, 4), (100.0, 5), (np.inf, 6))  # largest susceptibility, and Newton's steps for 1e-6
TINY = 1e-30  # where there is no field
SMALL = 0.04  # x² below which a series is exact to rounding


@dataclass(frozen=True)
class Soft:
    """What is soft.

    Attributes
    ----------
    susceptibility
        A number, or a pattern of numbers (cells, nodes, 1).
    scale
        sqrt(mu0 E)/|Br|; 1 without remanence.
    tesla
        What lambda_m = 1 is in T; 1 if the case has no flux densities.
    alone
        Whether nothing is remanent.
    patches
        Numbers (1,) of named patches of a mesh, in place of `susceptibility`.
    saturation
        The largest polarisation in the unit of lambda_m; None if it grows in proportion.
    """

    susceptibility: "float | Pattern"
    scale: float = 1.0
    tesla: float = 1.0
    alone: bool = True
    patches: Mapping[str, Array] | None = None
    saturation: float | None = None

    @property
    def steps(self) -> int:
        """Of Newton's method for the field across the sheet."""
        chi = self.susceptibility
        return STEPS[-1][1] if callable(chi) else next(steps for most, steps in STEPS if chi <= most)

    def on(self, carried: "Callable[[Mapping[str, Array]], Pattern]") -> "Soft":
        """With a pattern in place of patches."""
        return replace(self, susceptibility=carried(self.patches), patches=None) if self.patches else self

    def at(self, r0: Array, n0: Array) -> Array:
        """The susceptibility (...) at places (..., 3)."""
        chi = self.susceptibility
        return np.asarray(chi(r0, n0)[..., 0] if callable(chi) else np.full(r0.shape[:-1], chi))

    def polarisation(self, r0: Array, n0: Array, n: Array, B: Array) -> Array:
        """mu0 M (..., 3) in the unit of B at places of the undeformed shell, with the present normals n (..., 3)."""
        chi = self.at(r0, n0)[..., None]
        across = np.sum(n * B, axis=-1, keepdims=True)
        if self.saturation is None:
            return np.asarray(chi * (B - chi / (1 + chi) * across * n))
        along = B - across * n
        b = _across(chi, across, np.sum(along * along, axis=-1, keepdims=True), self.saturation, self.steps, _ratio)
        y = (3 * chi / self.saturation) ** 2 * (np.sum(along * along, axis=-1, keepdims=True) + b**2)
        return np.asarray(chi * _ratio(y) * (along + b * n))


@dataclass(frozen=True)
class Sheet:
    """The densities of a field's soft part, of numbers and vectors in this order.

    chi, s, an amplitude for each uniform part of the field, then either these parts and perhaps the gradient, or the
    polynomial of a field known by its values.
    """

    field: "Magnetisation"

    @cached_property
    def amplitudes(self) -> tuple[str, ...]:
        """The amplitudes of the field's parts."""
        from magshell_fenicsx.parts.magnetism.magnetised import ACROSS  # it needs this module

        return ("lambda_m", *(() if self.field.in_space else ACROSS[: len(self.field.across)]))

    @property
    def vectors(self) -> list[Array]:
        """The uniform parts of the field and its gradient; none of a field known by its values."""
        field = self.field
        if field.in_space:
            return []
        return [field.applied, *field.across, *([] if field.gradient is None else [field.gradient])]

    def fields(self, x0: Expr, u: Expr, given: Sequence[Expr]) -> tuple[Expr, Expr]:
        """The applied field at the displacement u and at u = 0."""
        count = len(self.amplitudes)
        numbers, parts = given[:count], given[count:]
        if self.field.in_space:
            B, change = around(parts[0], u)
            return numbers[0] * B, numbers[0] * (B - change)
        B = sum((number * part for number, part in zip(numbers, parts, strict=False)), ufl.zero(3))
        if self.field.gradient is None:
            return B, B
        G = numbers[0] * parts[-1]
        return B + ufl.dot(G, x0 + u), B + ufl.dot(G, x0)

    def of_surface(self, r0: Jet, u: Jet, chi: Expr, s: Expr, *given: Expr) -> Expr:
        """The energy over E h per area, without its value at u = 0 in this field."""
        B, B0 = self.fields(r0.r, u.r, given)
        return self.of_field(chi, s, B, kin.normal(r0 + u)) - self.of_field(chi, s, B0, kin.normal(r0))

    def induced(self, r0: Jet, u: Jet, chi: Expr, e: Expr, *given: Expr) -> Expr:
        """The polarisation along a vector, in the unit of lambda_m."""
        B, _ = self.fields(r0.r, u.r, given)
        return ufl.dot(e, self.polarisation(chi, B, kin.normal(r0 + u)))

    def of_body(self, X: Expr, u: Expr, H: Expr, chi: Expr, s: Expr, n0: Expr, h: Expr, *given: Expr) -> Expr:
        """The same of a body, in units of E h R²: its layers are sheets, with the normal n0 before."""
        B, B0 = self.fields(X, u, given)
        return (self.of_field(chi, s, B, across(H, n0)) - self.of_field(chi, s, B0, n0)) / h

    def induced_in_body(self, X: Expr, u: Expr, H: Expr, chi: Expr, e: Expr, n0: Expr, *given: Expr) -> Expr:
        """As `induced`."""
        B, _ = self.fields(X, u, given)
        return ufl.dot(e, self.polarisation(chi, B, across(H, n0)))

    def polarisation(self, chi: Expr, B: Expr, n: Expr) -> Expr:
        """mu0 M, that of a linear material chi (B_t + B_n n/(1 + chi))."""
        chi, largest, normal = number(chi), self._saturation, ufl.dot(B, n)
        if largest is None:
            return chi * (B - chi / (1 + chi) * normal * n)
        along = B - normal * n
        b = self._across(chi, normal, ufl.dot(along, along))
        return chi * _ratio_of((3 * chi / largest) ** 2 * (ufl.dot(along, along) + b**2)) * (along + b * n)

    def of_field(self, chi: Expr, s: Expr, B: Expr, n: Expr) -> Expr:
        """The energy over E h, that of a linear material -s² mu0 M.B/2."""
        chi, largest, normal = number(chi), self._saturation, ufl.dot(B, n)
        if largest is None:
            return -(s**2) / 2 * ufl.dot(B, self.polarisation(chi, B, n))
        squared = ufl.dot(B, B) - normal**2
        b = self._across(chi, normal, squared)
        field = squared + b**2
        return -(s**2) / 2 * (chi * field * _coenergy((3 * chi / largest) ** 2 * field) + (normal - b) ** 2)

    def _across(self, chi: Expr, normal: Expr, along: Expr) -> Expr:
        assert self.field.soft
        assert self._saturation
        return _across(chi, normal, along, self._saturation, self.field.soft.steps, _ratio_of)

    @property
    def _saturation(self) -> float | None:
        return self.field.soft.saturation if self.field.soft else None


def number(chi: Expr) -> Expr:
    """A susceptibility, that is a constant or a field (1,)."""
    return chi[0] if chi.ufl_shape else chi


def _across(chi: Any, normal: Any, along: Any, largest: float, steps: int, ratio: Callable[[Any], Any]) -> Any:
    """b_n, from B_n and |B_t|², see above; `ratio` is 3 L(x)/x of x², whose slope is 3 (1 - k) - x² k²/3 over 2 x²."""
    scale, b = (3 * chi / largest) ** 2, normal / (1 + chi)
    for _ in range(steps):
        y = scale * (along + b**2)
        k = ratio(y)
        slope = k + (3 * (1 - k) - y * k**2 / 3) * b**2 / (along + b**2 + TINY)
        b = b + (normal - b - chi * b * k) / (1 + chi * slope)
    return b


def _ratio(y: Array) -> Array:
    x = np.sqrt(np.maximum(y, SMALL))
    return np.asarray(np.where(y < SMALL, _series(y)[1], 3 * (x / np.tanh(x) - 1) / x**2))


def _ratio_of(y: Expr) -> Expr:
    """The same of an expression."""
    small = ufl.lt(y, SMALL)
    x = ufl.sqrt(ufl.conditional(small, SMALL, y))
    return ufl.conditional(small, _series(y)[1], 3 * (x * (1 + 2 / (ufl.exp(2 * x) - 1)) - 1) / x**2)


def _coenergy(y: Expr) -> Expr:
    """6 ln (sinh x/x)/x² of x²."""
    small = ufl.lt(y, SMALL)
    x = ufl.sqrt(ufl.conditional(small, SMALL, y))
    return ufl.conditional(small, _series(y)[0], 6 * (x + ufl.ln((1 - ufl.exp(-2 * x)) / (2 * x))) / x**2)


def _series(y: Any) -> tuple[Any, Any]:
    """Of both near zero."""
    w = 1 - y * (1 / 30 - y * (2 / 945 - y * (1 / 6300 - y * 2 / 155925)))
    return w, 1 - y * (1 / 15 - y * (2 / 315 - y * (1 / 1575 - y * 2 / 31185)))


def across(H: Expr, n0: Expr) -> Expr:
    """The normal of a layer of a body, cof F n0 over its length."""
    F = ufl.Identity(3) + H
    f = [F[:, i] for i in range(3)]
    cofactor = ufl.as_tensor([ufl.cross(f[1], f[2]), ufl.cross(f[2], f[0]), ufl.cross(f[0], f[1])]).T
    n = ufl.dot(cofactor, n0)
    return n / ufl.sqrt(ufl.dot(n, n))
