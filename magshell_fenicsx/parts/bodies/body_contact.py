"""Rigid bodies that press on the shell: the penalty of the gap by its Taylor polynomial at each
quadrature point.

The gap between a body and the shell's face is g(x - a d) - t h/2, with the body's signed distance g
at approach zero, its approach a along d, the place x of the mid-surface and the factor t of the
thickness. The penalty psi(-gap) is zero where the gap is open. As of an applied field (`applied`),
the polynomial of second order in y = u - a d at the present y has the derivatives of the penalty
itself, by the displacement and by the approach, for every shape of a body. Where the thickness
varies, or is that of a shell that gets thinner as it stretches, t is one more variable of the
polynomial.
"""

from collections.abc import Callable
from dataclasses import dataclass

import basix
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.memo import Memo, PointField, at_quadrature
from magshell_fenicsx.models.shell.kinematics import Forms, Jet
from magshell_fenicsx.parts.bodies.body import Distance
from magshell_fenicsx.parts.gap import (
    SOFT_PENETRATION,
    ThicknessRatio,
    expanded_penalty,
    mean_pressure,
    penalty,
    thickness_ratio,
)

Array = NDArray[np.float64]
PAIRS = np.triu_indices(3)
SIZE = 3 + 1 + 3 + 6  # y*, psi*, its gradient, its Hessian by pairs i <= j
FACE = (
    1 + 1 + 3 + 1
)  # t*, the derivatives of psi* by the thickness factor t, of its gradient, and the second by t
LARGEST_OVER_MEAN_PRESSURE = 1.5  # in a cell whose mean is drawn, at most
PRESSED = 1e-3  # of the largest pressure: less does not count as contact


@dataclass(frozen=True)
class Contact:
    """A rigid body, dimensionless and in the model's frame.

    Attributes
    ----------
    body
        Its name.
    amplitude
        Name of its approach, over h.
    distance
        At approach zero.
    direction
        Unit vector (3,) of the approach.
    front
        Place (3,) of its surface that goes ahead: radii of contact are distances from the axis
        through it.
    stiffness
        k of the penalty, over E h/R^2.
    bound
        Largest penetration that is allowed, over h.
    given
        Whether the case gives its stiffness, which then stays.
    size
        Radius over R of what touches, such as a ball's; infinite for a plane.
    start, lift
        Of a body that starts at the shell's face: the place (3,) of the mid-surface there, and from
        it to the face; None of one with a position of its own.
    """

    body: str
    amplitude: str
    distance: Distance
    direction: Array
    front: Array
    stiffness: float
    bound: float
    size: float
    given: bool = False
    start: Array | None = None
    lift: Array | None = None

    def gap(self, x: Array, approach: float, half: float | Array) -> tuple[Array, Array, Array]:
        """The gap at places (n, 3) with its gradient and Hessian; `approach` and half the thickness
        over R.
        """
        g, n, N = self.distance(x - approach * self.direction)
        return g - half, n, N

    @property
    def setting(self) -> str:
        """Name of its stiffness among the amplitudes of a state, where it was raised."""
        return f"stiffness_{self.body}"


def contact_energy(r0: Jet, u: Jet, P: Expr, motion: Expr, approach: Expr, *face: Expr) -> Expr:
    """psi per undeformed area from its polynomial P (`SIZE`,); `motion` is d for an approach of
    one.

    Where the thickness varies, what psi changes by with it (`FACE`,) and its factor (1,) are given
    too.
    """
    s = _moved(u, P, motion, approach)
    psi = _polynomial(P, s)
    return psi + _of_face(face[0], face[1][0], s) if face else psi


def thinned_energy(
    r0: Jet,
    u: Jet,
    P: Expr,
    motion: Expr,
    approach: Expr,
    F: Expr,
    *factor: Expr,
    natural: Forms | None = None,
    thins: Expr | int = 1,
) -> Expr:
    """That of a shell that gets thinner as it stretches, which its thickness factor, if it varies,
    multiplies.
    """
    s, t = _moved(u, P, motion, approach), thickness_ratio(r0, u, natural, thins)
    return _polynomial(P, s) + _of_face(F, factor[0][0] * t if factor else t, s)


def _polynomial(P: Expr, s: Expr) -> Expr:
    pairs = enumerate(zip(*PAIRS, strict=True))
    return (
        P[3]
        + ufl.dot(_gradient(P), s)
        + sum(P[7 + n] * s[int(i)] * s[int(j)] for n, (i, j) in pairs)
    )


def _of_face(F: Expr, t: Expr, s: Expr) -> Expr:
    more = t - F[0]
    return more * (F[1] + ufl.dot(ufl.as_vector([F[2 + i] for i in range(3)]), s) + more / 2 * F[5])


def contact_pressure(
    r0: Jet, u: Jet, P: Expr, motion: Expr, approach: Expr, *face: Expr, **options: Forms
) -> Expr:
    """The pressure on the shell per undeformed area, at the state of P."""
    return ufl.sqrt(ufl.dot(_gradient(P), _gradient(P)))


def pressed_radius(front: Expr, along: Expr) -> Callable[..., Expr]:
    """The pressure times the distance from the axis of the approach."""

    def density(r0: Jet, u: Jet, P: Expr, motion: Expr, approach: Expr, *face: Expr) -> Expr:
        x = r0.r + u.r - front
        off = x - ufl.dot(x, along) * along
        return contact_pressure(r0, u, P, motion, approach) * ufl.sqrt(ufl.dot(off, off))

    return density


def _moved(u: Jet, P: Expr, motion: Expr, approach: Expr) -> Expr:
    return u.r - approach * motion - ufl.as_vector([P[i] for i in range(3)])


def _gradient(P: Expr) -> Expr:
    return ufl.as_vector([P[4 + i] for i in range(3)])


@dataclass(frozen=True)
class Region:
    """Where a body touches, over R.

    Attributes
    ----------
    penetration
        The largest; while nothing touches it is negative, minus the least gap.
    radius, inner, outer
        Mean distance of the pressure from the axis of the approach, and its least and largest one;
        0 without.
    """

    penetration: float
    radius: float
    inner: float
    outer: float


@dataclass(frozen=True)
class _Expanded:
    """The penalty of the points that are pressed: which they are, psi and its derivatives by the
    depth, normals.
    """

    pressed: NDArray[np.bool_]
    value: Array
    first: Array
    second: Array
    n: Array
    N: Array

    def penalty(self) -> tuple[NDArray[np.bool_], Array]:
        """These points, and psi with its gradient and half its Hessian there."""
        H = (
            self.second[..., None] * self.n[:, :, None] * self.n[:, None, :]
            - self.first[..., None] * self.N
        )
        return self.pressed, _flat(self.value, -self.first * self.n, H)


def _flat(value: Array, gradient: Array, H: Array) -> Array:
    """The polynomial of a function without its place."""
    pairs = H[:, *PAIRS] * np.where(PAIRS[0] == PAIRS[1], 0.5, 1.0)
    return np.concatenate([value, gradient, pairs], axis=1)


class Pressing:
    """The polynomials of a contact at the quadrature points of a shell or a meridian.

    Parameters
    ----------
    h
        Thickness over R.
    r0, u
        Placement and displacement in one space; on a meridian along e_rho and e_z.
    approach
        The constant in the forms, over h.
    degree
        Of the quadrature.
    thickness
        What multiplies h; None for 1.
    thinning
        How thick the deformed shell is over that, see `thickness_ratio_at_points`; None for 1.

    Attributes
    ----------
    parameters
        Those of the densities.
    polynomial
        The first of them.
    stiffness
        In the penalty.
    """

    def __init__(
        self,
        contact: Contact,
        h: float,
        r0: fem.Function,
        u: fem.Function,
        approach: fem.Constant,
        degree: int,
        thickness: fem.Function | None = None,
        thinning: ThicknessRatio | None = None,
    ) -> None:
        V = u.function_space
        self.contact, self._h, self._u, self._approach = contact, h, u, approach
        self.polynomial = PointField(V.mesh, degree, SIZE)
        self._points, self._degree = self.polynomial.points, degree
        self._r0 = Memo(lambda: at_quadrature(r0, self._points), lambda: (r0.x.array,))
        thick = [] if thickness is None else [thickness.x.array]

        thins = thinning and thinning(self._points)

        def factor() -> float | Array:
            given = (
                1.0 if thickness is None else at_quadrature(thickness, self._points)[..., 0].ravel()
            )
            return given if thins is None else given * thins.renew()

        self._factor = Memo(factor, lambda: (*thick, *([thins.renew()] if thins else [])))
        self._face = (
            None if thickness is None and thins is None else PointField(V.mesh, degree, FACE)
        )
        motion = fem.Constant(V.mesh, h * contact.direction)
        varying = () if thickness is None else (thickness,)
        self.parameters = (
            self.polynomial,
            motion,
            approach,
            *(() if self._face is None else (self._face, *varying)),
        )
        self._owned = V.mesh.topology.index_map(V.mesh.topology.dim).size_local
        self.stiffness = fem.Constant(V.mesh, contact.stiffness)
        self._mean: tuple[
            Array, ...
        ] = ()  # derivatives of a step by place and thickness, in place of the present ones
        self._about: tuple[Array, ...] = ()  # the gap about which the penalty is expanded

        def places() -> tuple[Array, ...]:
            return (
                r0.x.array,
                u.x.array,
                approach.value,
                *thick,
                *([thins.renew()] if thins else []),
            )

        def forces() -> tuple[Array, ...]:
            return *places(), self.stiffness.value, *self._mean, *self._about

        self._gaps = Memo(lambda: self._gap_at(self.place, self.factor), places)
        self._pressed = Memo(self._expanded, forces)
        self.polynomial.compute_by(self._polynomials, forces)
        if self._face is not None:
            self._face.compute_by(self._by_thickness, forces)

    @property
    def history(self) -> tuple[str, tuple[fem.Constant, float]]:
        """Its stiffness, see `FiniteElementSystem`."""
        return self.contact.setting, (self.stiffness, self.contact.stiffness)

    @property
    def motion(self) -> Array:
        """The displacement (3,) of the body for an approach of one."""
        return self._h * self.contact.direction

    @property
    def gap(self) -> Array:
        """At all points, over R."""
        return self._gaps.renew()[0]

    def _gap_at(self, y: Array, factor: float | Array) -> tuple[Array, Array, Array]:
        """The gap and its derivatives at places `place`, of a shell so many times as thick."""
        return self.contact.gap((self._r0.renew() + y).reshape(-1, 3), 0.0, self._h / 2 * factor)

    def _expanded(self) -> "_Expanded":
        """The penalty where points are pressed, few of all."""
        gap, n, N = self._gaps.renew()
        about = self._about[0] if self._about else gap
        pressed = about < 0
        k = float(self.stiffness.value)
        of_depth = expanded_penalty(-gap[pressed], -about[pressed], k, SOFT_PENETRATION * self._h)
        value, first, second = (a[:, None] for a in of_depth)
        return _Expanded(pressed, value, first, second, n[pressed], N[pressed])

    def _polynomials(self) -> Array:
        """psi, its gradient and its Hessian at the places of the points."""
        y = self.place
        flat = np.zeros((*y.shape[:2], SIZE))
        flat[..., :3] = y
        pressed, psi = self._step_mean() if self._mean else self._pressed.renew().penalty()
        flat.reshape(-1, SIZE)[pressed, 3:] = psi
        return flat

    def _step_mean(self) -> tuple[NDArray[np.bool_], Array]:
        gradient, H, _ = self._mean
        return np.ones(len(gradient), dtype=bool), _flat(np.zeros((len(gradient), 1)), gradient, H)

    def _by_thickness(self) -> Array:
        """The factor of the thickness, and what psi changes by with it."""
        at, half = self._pressed.renew(), self._h / 2
        by_t = np.zeros((len(at.pressed), FACE))
        by_t[:, 0] = self.factor
        if self._mean:
            by_t[:, 1:] = self._mean[2]
        else:
            by_t[at.pressed, 1:] = half * np.concatenate(
                [at.first, -at.second * at.n, half * at.second], axis=1
            )
        return by_t.reshape(*self.polynomial.values.shape[:2], FACE)

    def expand_about(self, gap: Array) -> None:
        """Take in place of the penalty its Taylor polynomial about a gap, of the same contact
        elsewhere.

        For differences by a number of the case: a body that is hard closes or opens within a far
        smaller way.
        """
        self._about = (gap,)

    @property
    def place(self) -> Array:
        """y = u - a d at the points, (cells, points, 3)."""
        return at_quadrature(self._u, self._points) - float(self._approach.value) * self.motion

    @property
    def factor(self) -> float | Array:
        """The thickness over h at the points, (cells * points,) where it varies."""
        return self._factor.renew()

    @property
    def where(self) -> tuple[Array, float | Array]:
        """`place` and `factor`."""
        return self.place, self.factor

    def average(
        self, begin: tuple[Array, float | Array], end: tuple[Array, float | Array], part: float
    ) -> None:
        """Take the forces of a step in place of the present ones, until `present`; see
        docs/theory.md, Motion.

        Their product with the change of y is that of psi, plus what the step dissipates: the mean
        gradient is that of psi along the normal, over the penetration and not over time, so that it
        counts where contact sets in or ceases.

        Parameters
        ----------
        begin, end
            `where` at both ends of the step.
        part
            Of the step at which the system has its forces.
        """
        k, soft, half = float(self.stiffness.value), SOFT_PENETRATION * self._h, self._h / 2
        middle = (begin[0] + end[0]) / 2, (begin[1] + end[1]) / 2
        gaps, n, N = zip(*(self._gap_at(*where) for where in (begin, middle, end)), strict=True)
        s0, _, s1 = (-gap for gap in gaps)
        mean, slope = mean_pressure(s0, s1, k, soft)
        normal, bend = (n[0] + 4 * n[1] + n[2]) / 6, (2 * N[1] + N[2]) / 6
        (_, p0, _), (_, p1, stiff) = penalty(s0, k, soft), penalty(s1, k, soft)

        def outer(a: Array) -> Array:
            return a[:, :, None] * a[:, None, :]

        def times(c: Array, a: Array) -> Array:
            return c.reshape(-1, *[1] * (a.ndim - 1)) * a

        late = part - 0.5
        gradient = -times(mean, normal) - late * (times(p1, n[2]) - times(p0, n[0]))
        H = (
            times(slope, outer(normal))
            - times(mean, bend)
            + late * (times(stiff, outer(n[2])) - times(p1, N[2]))
        )
        by_t = half * (mean + late * (p1 - p0))
        of_both = -half * (times(slope, normal) + late * times(stiff, n[2])) / part
        twice = half**2 * (slope + late * stiff) / part
        self._mean = gradient, np.asarray(H / part), np.column_stack([by_t, of_both, twice])

    def present(self) -> None:
        """Take the present forces again."""
        self._mean = ()

    def cell_pressures(self) -> Array:
        """The mean pressure in each local cell, over E h/R: the ring of a contact is narrower than
        that of nodes.
        """
        V = self._u.function_space
        weights = basix.make_quadrature(V.mesh.basix_cell(), self._degree)[1]
        return np.asarray(self._sizes() @ weights / weights.sum())

    def evenly_pressed(self) -> NDArray[np.bool_]:
        """Whether all points of each local cell are pressed, and its mean is near its pressure."""
        size = self._sizes()
        even = size.max(axis=1) <= LARGEST_OVER_MEAN_PRESSURE * self.cell_pressures()
        return np.asarray((size > 0).all(axis=1) & even)

    def _sizes(self) -> Array:
        """The pressure at the points of local cells, over E h/R."""
        self.polynomial.renew()
        return np.asarray(np.linalg.norm(self.polynomial.values[..., 4:7], axis=-1))

    def region(self, comm: MPI.Comm, radius: float) -> Region:
        """Where the body touches; `radius` is the mean one."""
        owned = slice(0, self._owned * len(self._points))
        gap, x = (
            self.gap[owned],
            (self._r0.renew() + self.place).reshape(-1, 3)[owned] - self.contact.front,
        )
        pressure, d = (
            penalty(-gap, float(self.stiffness.value), SOFT_PENETRATION * self._h)[1],
            self.contact.direction,
        )
        most = comm.allreduce(float(pressure.max(initial=0.0)), MPI.MAX)
        from_axis = np.linalg.norm(x - (x @ d)[:, None] * d, axis=1)[pressure > PRESSED * most]
        penetration = comm.allreduce(float(-gap.min(initial=np.inf)), MPI.MAX)
        inner = comm.allreduce(float(from_axis.min(initial=np.inf)), MPI.MIN)
        outer = comm.allreduce(float(from_axis.max(initial=0.0)), MPI.MAX)
        return Region(penetration, radius, inner if most else 0.0, outer)
