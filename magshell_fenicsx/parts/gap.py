"""What touches a shell's faces: the penalty of a penetration, and how far the faces are from the
mid-surface.

A shell that keeps its volume gets thinner as its surface stretches; a natural shape is what has
grown without stress, and its volume stays.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.free_parameters import SettableNumber
from magshell_fenicsx.assembly.memo import Memo
from magshell_fenicsx.models.domains import Carrier
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.kinematics import Forms, Jet

Array = NDArray[np.float64]
SOFT = 1e-3  # of h: the penalty's stiffness grows from zero over this penetration
ROUNDING = 1e-5  # of the soft penetration: a smaller change of it is no divisor
Thinning = Callable[
    [Array], Memo[Array]
]  # from places in the reference cell to values there, (cells * places,)


class Grown(Protocol):
    """A natural shape."""

    @property
    def stretch(self) -> SettableNumber | None:
        """The amplitude of its stretch; None if that does not grow."""
        ...

    @property
    def values(self) -> tuple[Array, ...] | None:
        """On which its volume depends; None if that is the undeformed one."""
        ...

    def volume(self, first: Array, points: Array) -> Array:
        """Over the undeformed one (cells, places), where the surface has these tangents (2, cells,
        places, 3).
        """
        ...

    def volumes(self, first: Array, points: Array) -> Array:
        """Its coefficients (4, cells, places) by powers of the amplitude."""
        ...


def thinned(r0: Jet, u: Jet, natural: Forms | None = None, thins: Expr | int = 1) -> Expr:
    """The deformed thickness over the undeformed one: where `thins` is 1 undeformed, or natural,
    over deformed area.
    """
    stretch = kin.area_ratio(r0) / kin.area_ratio(r0 + u)
    stretch = stretch if natural is None else stretch * natural.area * natural.thickness
    return 1 + thins * (stretch - 1)


def thinning(
    carrier: Carrier, u: fem.Function, natural: Grown | None, thins: Array | int = 1
) -> Thinning:
    """The same at points, at the present displacement and natural shape; `thins` of each cell
    (cells, 1).
    """
    r0, V = carrier.r0, u.function_space
    by = natural.values if natural else None

    def at(points: Array) -> Memo[Array]:
        jets_of = carrier.tables(V, points)

        def values() -> Array:
            first = jets_of(r0.x.array)[1:3]
            area0, area = (
                np.linalg.norm(np.cross(*a), axis=-1)
                for a in (first, first + jets_of(u.x.array)[1:3])
            )
            factor = natural.volume(first, points) if natural and by else 1.0
            return np.asarray(1 + thins * (factor * area0 / area - 1)).ravel()

        return Memo(values, lambda: (r0.x.array, u.x.array, *(by or ())))

    return at


def penalty(s: Array, k: float, soft: float) -> tuple[Array, Array, Array]:
    """psi of a penetration s with two derivatives: psi'' grows from 0 to k over `soft`, and is
    continuous.
    """
    t = np.maximum(s, 0.0)
    full = t > soft
    second = np.where(full, k, k * t / soft)
    first = np.where(full, k * (t - soft / 2), k * t**2 / (2 * soft))
    value = np.where(full, k * (t**2 / 2 - t * soft / 2 + soft**2 / 6), k * t**3 / (6 * soft))
    return value, first, second


def expanded(
    s: Array, about: Array, k: float, soft: float, *, bends: bool = False
) -> tuple[Array, Array, Array]:
    """Its Taylor polynomial of second order about other penetrations, or of third, and the
    derivatives of that.

    Differences over a part of `soft` are better by that of second order; the derivative of `second`
    needs the third.
    """
    value, first, second = penalty(about, k, soft)
    more, third = s - about, bends * np.where((about > 0) & (about <= soft), k / soft, 0.0)
    bend = second + more * third
    return (
        value + more * (first + more * (second / 2 + more / 6 * third)),
        first + more * (second + bend) / 2,
        bend,
    )


def mean_pressure(s0: Array, s1: Array, k: float, soft: float) -> tuple[Array, Array]:
    """(psi(s1) - psi(s0))/(s1 - s0) and its derivative by s1."""
    (v0, p0, _), (v1, p1, k1) = penalty(s0, k, soft), penalty(s1, k, soft)
    _, middle, stiff = penalty((s0 + s1) / 2, k, soft)
    simpson, slope = (
        (p0 + 4 * middle + p1) / 6,
        (2 * stiff + k1) / 6,
    )  # exact where psi'' has no kink between
    across = (np.digitize(s0, (0.0, soft)) != np.digitize(s1, (0.0, soft))) & (
        np.abs(s1 - s0) > ROUNDING * soft
    )
    ds = np.where(across, s1 - s0, 1.0)
    mean = np.where(across, (v1 - v0) / ds, simpson)
    return mean, np.where(across, (p1 - mean) / ds, slope)
