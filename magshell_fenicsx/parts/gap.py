"""The penalty of a penetration into the face of a shell, and the thickness of the shell.

A shell that keeps its volume gets thinner as its surface stretches. A natural shape is what has
grown without stress, and its volume stays. Penetrations and thicknesses are over R, stiffnesses
over E h/R^2, with Young's modulus E, thickness h and reference length R. docs/theory.md, Contact.

A jet is a map with its derivatives at a point. A memo is a value that is computed again where its
inputs have changed. An amplitude is a load parameter.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.free_parameters import SettableNumber
from magshell_fenicsx.assembly.memo import Memo
from magshell_fenicsx.models.domains import IntegrationDomain
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.kinematics import Forms, Jet

Array = NDArray[np.float64]
SOFT_PENETRATION = 1e-3  # over h: the penalty's stiffness grows from zero over this penetration
PENETRATION_ROUNDING = 1e-5  # over the soft penetration: a smaller change of it is no divisor
ThicknessRatio = Callable[[Array], Memo[Array]]
"""From places in the reference cell to the deformed thickness over the undeformed one there,
(cells * places,)."""


class GrownSurface(Protocol):
    """A natural shape whose volume is known at each place of the shell."""

    @property
    def stretch(self) -> SettableNumber | None:
        """The amplitude of its stretch; None if that does not grow."""
        ...

    @property
    def values(self) -> tuple[Array, ...] | None:
        """The arrays on which its volume depends; None if the undeformed volume stays."""
        ...

    def volume(self, first: Array, points: Array) -> Array:
        """Return the volume over the undeformed one (cells, places).

        Parameters
        ----------
        first
            (2, cells, places, 3) tangents of the undeformed surface.
        points
            (places, 2) in the reference cell.
        """
        ...

    def volume_coefficients(self, first: Array, points: Array) -> Array:
        """Return the coefficients (4, cells, places) of `volume` by powers of the amplitude."""
        ...


def thickness_ratio(r0: Jet, u: Jet, natural: Forms | None = None, thins: Expr | int = 1) -> Expr:
    """Return the deformed thickness over the undeformed one, as a UFL expression.

    A jet is a map with its derivatives at a point.

    Parameters
    ----------
    r0, u
        Jets of the undeformed placement and of the displacement.
    natural
        The natural shape at the point; None without.
    thins
        1 where the shell keeps its volume: the ratio is the undeformed, or natural, area over the
        deformed one, times the natural thickness. 0 where the thickness stays: the ratio is 1.
    """
    ratio = kin.area_ratio(r0) / kin.area_ratio(r0 + u)  # undeformed over deformed area
    ratio = ratio if natural is None else ratio * natural.area * natural.thickness
    return 1 + thins * (ratio - 1)


def thickness_ratio_at_points(
    domain: IntegrationDomain, u: fem.Function, natural: GrownSurface | None, thins: Array | int = 1
) -> ThicknessRatio:
    """Return `thickness_ratio` as arrays, at the present displacement and natural shape.

    Parameters
    ----------
    domain
        The surface over which integrals run.
    thins
        (cells, 1) 1 in the cells that get thinner, or 1 for all.

    Returns
    -------
    ThicknessRatio
        Function of places in the reference cell. Its result is computed again where the
        displacement or the natural shape has changed.
    """
    r0, V = domain.r0, u.function_space
    # arrays that change in place as the shape grows: the memo compares them
    natural_values = natural.values if natural else None

    def ratio_at(points: Array) -> Memo[Array]:
        """Return the thickness ratio at places (places, 2) of the reference cell.

        It is a memo: a value that is computed again where displacement or natural shape have
        changed.
        """
        # a function: from the coefficients of a field to its value and its derivatives d/ds1,
        # d/ds2, ... at the places
        jets_of = domain.tables(V, points)

        def values() -> Array:
            """Return the ratio (cells * places,) at the present displacement."""
            # (2, cells, places, 3) both tangents, whose cross product has the area as its length
            undeformed_tangents = jets_of(r0.x.array)[1:3]
            deformed_tangents = undeformed_tangents + jets_of(u.x.array)[1:3]
            area0, area = (
                np.linalg.norm(np.cross(*tangents), axis=-1)
                for tangents in (undeformed_tangents, deformed_tangents)
            )
            # the volume over the undeformed one, which is 1 without growth
            volume = (
                natural.volume(undeformed_tangents, points) if natural and natural_values else 1.0
            )
            return np.asarray(1 + thins * (volume * area0 / area - 1)).ravel()

        return Memo(values, lambda: (r0.x.array, u.x.array, *(natural_values or ())))

    return ratio_at


@dataclass(frozen=True)
class Penalty:
    """The penalty energy psi(s) per area of a penetration s; psi' is the contact pressure.

    psi'' grows linearly from 0 to the stiffness over the soft penetration, and is then constant.

    Attributes
    ----------
    stiffness
        k, over E h/R^2.
    soft_penetration
        Over R.
    """

    stiffness: float
    soft_penetration: float

    def derivatives(self, s: Array) -> tuple[Array, Array, Array]:
        """Return psi, psi' and psi'' at penetrations s, of their shape.

        Without penetration (s <= 0) all are zero.
        """
        k, soft_penetration, t = self.stiffness, self.soft_penetration, np.maximum(s, 0.0)
        # up to the soft penetration psi is a cubic; beyond, psi'' is k, and the constants make psi
        # and psi' continuous
        is_full = t > soft_penetration
        second = np.where(is_full, k, k * t / soft_penetration)
        first = np.where(is_full, k * (t - soft_penetration / 2), k * t**2 / (2 * soft_penetration))
        value = np.where(
            is_full,
            k * (t**2 / 2 - t * soft_penetration / 2 + soft_penetration**2 / 6),
            k * t**3 / (6 * soft_penetration),
        )
        return value, first, second

    def expanded(
        self, s: Array, s0: Array, *, with_third_order: bool = False
    ) -> tuple[Array, Array, Array]:
        """Return the Taylor polynomial of psi about s0, with both derivatives, at penetrations s.

        It is of the second order, or of the third `with_third_order`. The second order is better
        for differences over a part of the soft penetration. The third order is needed where psi''
        itself is differentiated.
        """
        value, first, second = self.derivatives(s0)
        step = s - s0
        # psi''' is zero where psi'' is constant: without penetration, and beyond the soft one
        third = with_third_order * np.where(
            (s0 > 0) & (s0 <= self.soft_penetration), self.stiffness / self.soft_penetration, 0.0
        )
        second_at_s = second + step * third
        return (
            value + step * (first + step * (second / 2 + step / 6 * third)),
            first + step * (second + second_at_s) / 2,
            second_at_s,
        )

    def segments(self, s: Array) -> NDArray[np.int64]:
        """Return where penetrations are among the kinks of psi'': 0 open, 1 soft, 2 beyond."""
        return np.digitize(s, (0.0, self.soft_penetration))

    def mean_pressure(self, s0: Array, s1: Array) -> tuple[Array, Array]:
        """Return the mean pressure (psi(s1) - psi(s0))/(s1 - s0) and its derivative by s1.

        It is the pressure over a step of penetration from s0 to s1 that conserves energy. Between
        the kinks of psi'' the pressure psi' is a polynomial. Simpson's rule then gives its mean
        exactly, and needs no division by s1 - s0, which may be zero. Steps over a kink take the
        quotient.
        """
        # psi, psi' and psi'' at both penetrations, and in the middle
        (v0, p0, _), (v1, p1, k1) = self.derivatives(s0), self.derivatives(s1)
        _, p_middle, k_middle = self.derivatives((s0 + s1) / 2)
        # Simpson's rule, and its derivative by s1
        simpson, simpson_slope = (p0 + 4 * p_middle + p1) / 6, (2 * k_middle + k1) / 6
        # the quotient where a step passes a kink; over a tiny step it would be rounding, and
        # Simpson's rule is good enough
        takes_quotient = self.segments(s0) != self.segments(s1)
        takes_quotient &= np.abs(s1 - s0) > PENETRATION_ROUNDING * self.soft_penetration
        ds = np.where(takes_quotient, s1 - s0, 1.0)  # 1 where the quotient is not used
        mean = np.where(takes_quotient, (v1 - v0) / ds, simpson)
        return mean, np.where(takes_quotient, (p1 - mean) / ds, simpson_slope)
