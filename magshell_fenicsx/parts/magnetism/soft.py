"""A soft-magnetic shell: its magnetisation follows the field at each place.

Along a thin sheet H is continuous, across it B is. So a sheet of susceptibility chi has the polarisation
mu0 M = chi (B_t + B_n n/(1 + chi)) and, per area, the energy -h M.B/2. Over E h, with B in units of mu0 E/|Br|
(lambda_m is the size of the applied field in them), it is -chi/2 (s B)² with s = sqrt(mu0 E)/|Br|. A shell without
remanence has sqrt(mu0 E) in place of |Br|. The field of other places of the shell is left out.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

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
    """

    susceptibility: "float | Pattern"
    scale: float = 1.0
    tesla: float = 1.0
    alone: bool = True
    patches: Mapping[str, Array] | None = None

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
        return np.asarray(chi * (B - chi / (1 + chi) * across * n))


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
        return of_field(chi, s, B, kin.normal(r0 + u)) - of_field(chi, s, B0, kin.normal(r0))

    def induced(self, r0: Jet, u: Jet, chi: Expr, e: Expr, *given: Expr) -> Expr:
        """The polarisation along a vector, in the unit of lambda_m."""
        B, _ = self.fields(r0.r, u.r, given)
        return ufl.dot(e, polarisation(chi, B, kin.normal(r0 + u)))

    def of_body(self, X: Expr, u: Expr, H: Expr, chi: Expr, s: Expr, n0: Expr, h: Expr, *given: Expr) -> Expr:
        """The same of a body, in units of E h R²: its layers are sheets, with the normal n0 before."""
        B, B0 = self.fields(X, u, given)
        return (of_field(chi, s, B, across(H, n0)) - of_field(chi, s, B0, n0)) / h

    def induced_in_body(self, X: Expr, u: Expr, H: Expr, chi: Expr, e: Expr, n0: Expr, *given: Expr) -> Expr:
        """As `induced`."""
        B, _ = self.fields(X, u, given)
        return ufl.dot(e, polarisation(chi, B, across(H, n0)))


def number(chi: Expr) -> Expr:
    """A susceptibility, that is a constant or a field (1,)."""
    return chi[0] if chi.ufl_shape else chi


def polarisation(chi: Expr, B: Expr, n: Expr) -> Expr:
    """mu0 M = chi (B_t + B_n n/(1 + chi))."""
    chi = number(chi)
    return chi * (B - chi / (1 + chi) * ufl.dot(B, n) * n)


def of_field(chi: Expr, s: Expr, B: Expr, n: Expr) -> Expr:
    """-s² mu0 M.B/2."""
    return -(s**2) / 2 * ufl.dot(B, polarisation(chi, B, n))


def across(H: Expr, n0: Expr) -> Expr:
    """The normal of a layer of a body, cof F n0 over its length."""
    F = ufl.Identity(3) + H
    f = [F[:, i] for i in range(3)]
    cofactor = ufl.as_tensor([ufl.cross(f[1], f[2]), ufl.cross(f[2], f[0]), ufl.cross(f[0], f[1])]).T
    n = ufl.dot(cofactor, n0)
    return n / ufl.sqrt(ufl.dot(n, n))
