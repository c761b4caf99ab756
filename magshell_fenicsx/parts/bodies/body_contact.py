"""Contact with rigid bodies: the penalty of the gap by its Taylor polynomial at each quadrature
point.

The gap between a body and the shell's face is g(x - a d) - t h/2, with the body's signed distance g
at approach zero, its approach a along d, the place x of the mid-surface and the factor t of the
thickness. The penalty psi(-gap) is zero where the gap is open. As of an applied field
(`magnetism.applied`), the polynomial of second order in y = u - a d at the present y has the
derivatives of the penalty itself, by the displacement and by the approach, for every shape of a
body. Where the thickness varies, or is that of a shell that gets thinner as it stretches, t is one
more variable of the polynomial. docs/theory.md, Contact.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

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
INDEX_PAIRS = np.triu_indices(3)  # i <= j of a Hessian
POLYNOMIAL_SIZE = 3 + 1 + 3 + 6  # y*, psi*, its gradient, its Hessian by pairs i <= j
# t*, and derivatives by the thickness factor t: of psi*, of its gradient, and the second of psi*
FACE_SIZE = 1 + 1 + 3 + 1
LARGEST_OVER_MEAN_PRESSURE = 1.5  # in a cell whose mean is drawn, at most
PRESSURE_THRESHOLD = 1e-3  # over the largest pressure: less does not count as contact


@dataclass(frozen=True)
class ContactBody:
    """A rigid body, dimensionless and in the model's frame.

    Attributes
    ----------
    body
        Its name.
    amplitude
        Name of its approach, over h.
    distance
        Its signed distance at approach zero.
    direction
        Unit vector (3,) of the approach.
    front
        Place (3,) of its surface that goes ahead: radii of contact are distances from the axis
        through it.
    stiffness
        k of the penalty, over E h/R^2.
    max_penetration
        Largest penetration that is allowed, over h.
    size
        Radius over R of what touches, such as a ball's; infinite for a plane.
    has_given_stiffness
        Whether the case gives its stiffness, which then stays.
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
    max_penetration: float
    size: float
    has_given_stiffness: bool = False
    start: Array | None = None
    lift: Array | None = None

    def gap(self, x: Array, approach: float, half: float | Array) -> tuple[Array, Array, Array]:
        """Return the gap at places (n, 3) over R, with its gradient and Hessian.

        Parameters
        ----------
        approach, half
            The approach, and half the thickness, over R.
        """
        g, n, N = self.distance(x - approach * self.direction)
        return g - half, n, N

    @property
    def setting(self) -> str:
        """The name of its stiffness in a state, where it was raised."""
        return f"stiffness_{self.body}"


def contact_energy(r0: Jet, u: Jet, P: Expr, motion: Expr, approach: Expr, *face: Expr) -> Expr:
    """Return psi per undeformed area from its polynomial P (`POLYNOMIAL_SIZE`,).

    Parameters
    ----------
    motion
        d for an approach of one.
    face
        Where the thickness varies: the derivatives by it (`FACE_SIZE`,), and its factor (1,).
    """
    s = _off_expansion_point(u, P, motion, approach)
    psi = _polynomial(P, s)
    return psi + _face_term(face[0], face[1][0], s) if face else psi


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
    """Return `contact_energy` of a shell that gets thinner as it stretches.

    Parameters
    ----------
    F
        The derivatives by the thickness (`FACE_SIZE`,).
    factor
        The factor of the thickness, if it varies.
    """
    s, t = _off_expansion_point(u, P, motion, approach), thickness_ratio(r0, u, natural, thins)
    return _polynomial(P, s) + _face_term(F, factor[0][0] * t if factor else t, s)


def _polynomial(P: Expr, s: Expr) -> Expr:
    """Return the polynomial at an offset s from its expansion point."""
    pairs = enumerate(zip(*INDEX_PAIRS, strict=True))
    return (
        P[3]
        + ufl.dot(_gradient(P), s)
        + sum(P[7 + n] * s[int(i)] * s[int(j)] for n, (i, j) in pairs)
    )


def _face_term(F: Expr, t: Expr, s: Expr) -> Expr:
    """Return what psi changes by with the thickness factor t, at an offset s."""
    change = t - F[0]
    return change * (
        F[1] + ufl.dot(ufl.as_vector([F[2 + i] for i in range(3)]), s) + change / 2 * F[5]
    )


def contact_pressure(
    r0: Jet, u: Jet, P: Expr, motion: Expr, approach: Expr, *face: Expr, **options: Forms
) -> Expr:
    """Return the pressure on the shell per undeformed area, at the state of P."""
    return ufl.sqrt(ufl.dot(_gradient(P), _gradient(P)))


def radius_density(front: Expr, axis: Expr) -> Callable[..., Expr]:
    """Return the density of the pressure times the distance from the axis of the approach."""

    def density(r0: Jet, u: Jet, P: Expr, motion: Expr, approach: Expr, *face: Expr) -> Expr:
        x = r0.r + u.r - front
        from_axis = x - ufl.dot(x, axis) * axis
        return contact_pressure(r0, u, P, motion, approach) * ufl.sqrt(
            ufl.dot(from_axis, from_axis)
        )

    return density


def _off_expansion_point(u: Jet, P: Expr, motion: Expr, approach: Expr) -> Expr:
    """Return the offset of the place from the expansion point of the polynomial."""
    return u.r - approach * motion - ufl.as_vector([P[i] for i in range(3)])


def _gradient(P: Expr) -> Expr:
    return ufl.as_vector([P[4 + i] for i in range(3)])


@dataclass(frozen=True)
class Region:
    """The region in which a body touches; lengths are over R.

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
class _ActivePenalty:
    """The penalty at the points that are pressed.

    Attributes
    ----------
    is_pressed
        (points,).
    value, first, second
        psi and its derivatives by the penetration.
    n, N
        Normals, and Hessians of the distance.
    """

    is_pressed: NDArray[np.bool_]
    value: Array
    first: Array
    second: Array
    n: Array
    N: Array

    def penalty(self) -> tuple[NDArray[np.bool_], Array]:
        """Return which points are pressed, and psi with its gradient and half its Hessian there."""
        H = (
            self.second[..., None] * self.n[:, :, None] * self.n[:, None, :]
            - self.first[..., None] * self.N
        )
        return self.is_pressed, _flattened(self.value, -self.first * self.n, H)


def _flattened(value: Array, gradient: Array, H: Array) -> Array:
    """Return the polynomial of a function, without its expansion point."""
    pairs = H[:, *INDEX_PAIRS] * np.where(INDEX_PAIRS[0] == INDEX_PAIRS[1], 0.5, 1.0)
    return np.concatenate([value, gradient, pairs], axis=1)


class BodyContact:
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
        Factor of h; None for 1.
    ratio_at_points
        The deformed over the undeformed thickness, see `gap.thickness_ratio_at_points`; None for 1.

    Attributes
    ----------
    parameters
        Of the densities.
    polynomial
        The first of them.
    stiffness
        k of the penalty, over E h/R^2.
    """

    def __init__(
        self,
        contact: ContactBody,
        h: float,
        r0: fem.Function,
        u: fem.Function,
        approach: fem.Constant,
        degree: int,
        thickness: fem.Function | None = None,
        ratio_at_points: ThicknessRatio | None = None,
    ) -> None:
        V = u.function_space
        self.contact, self._h, self._u, self._approach = contact, h, u, approach
        self.polynomial = PointField(V.mesh, degree, POLYNOMIAL_SIZE)
        self._points, self._degree = self.polynomial.points, degree
        self._placement_memo = Memo(lambda: at_quadrature(r0, self._points), lambda: (r0.x.array,))
        ratio_memo = ratio_at_points and ratio_at_points(self._points)

        def factor() -> float | Array:
            factor: float | Array = 1.0
            if thickness is not None:
                factor = at_quadrature(thickness, self._points)[..., 0].ravel()
            return factor if ratio_memo is None else factor * ratio_memo.renew()

        def thicknesses() -> tuple[Array, ...]:
            has_given_stiffness = () if thickness is None else (thickness.x.array,)
            return (*has_given_stiffness, ratio_memo.renew()) if ratio_memo else has_given_stiffness

        self._factor_memo = Memo(factor, thicknesses)
        self._face_field: PointField | None = None
        motion = fem.Constant(V.mesh, h * contact.direction)
        self.parameters: tuple[Any, ...] = self.polynomial, motion, approach
        if thickness is not None or ratio_memo is not None:
            self._face_field = PointField(V.mesh, degree, FACE_SIZE)
            self.parameters = *self.parameters, self._face_field
        if thickness is not None:
            self.parameters = *self.parameters, thickness
        self._owned = V.mesh.topology.index_map(V.mesh.topology.dim).size_local
        self.stiffness = fem.Constant(V.mesh, contact.stiffness)
        # derivatives of a step by place and thickness, in place of the present ones
        self._step_derivatives: tuple[Array, ...] = ()
        self._expansion_gap: tuple[Array, ...] = ()  # about which the penalty is expanded

        def places() -> tuple[Array, ...]:
            return r0.x.array, u.x.array, approach.value, *thicknesses()

        def forces() -> tuple[Array, ...]:
            return *places(), self.stiffness.value, *self._step_derivatives, *self._expansion_gap

        self._gap_memo = Memo(lambda: self._gap_at(self.place, self.factor), places)
        self._penalty_memo = Memo(self._active_penalty, forces)
        self.polynomial.compute_by(self._compute_polynomials, forces)
        if self._face_field is not None:
            self._face_field.compute_by(self._compute_face_terms, forces)

    @property
    def history(self) -> tuple[str, tuple[fem.Constant, float]]:
        """The name, constant and default of its stiffness, see `FiniteElementSystem`."""
        return self.contact.setting, (self.stiffness, self.contact.stiffness)

    @property
    def motion(self) -> Array:
        """The displacement (3,) of the body for an approach of one."""
        return self._h * self.contact.direction

    @property
    def gap(self) -> Array:
        """The gaps at all points, over R."""
        return self._gap_memo.renew()[0]

    def _gap_at(self, y: Array, factor: float | Array) -> tuple[Array, Array, Array]:
        """Return the gap and its derivatives at places y (see `place`), of a thickness factor."""
        x = (self._placement_memo.renew() + y).reshape(-1, 3)
        return self.contact.gap(x, 0.0, self._h / 2 * factor)

    def _active_penalty(self) -> "_ActivePenalty":
        """Return the penalty where points are pressed, few of all."""
        gap, n, N = self._gap_memo.renew()
        expansion_gap = self._expansion_gap[0] if self._expansion_gap else gap
        is_pressed = expansion_gap < 0
        k = float(self.stiffness.value)
        penalties = expanded_penalty(
            -gap[is_pressed], -expansion_gap[is_pressed], k, SOFT_PENETRATION * self._h
        )
        value, first, second = (a[:, None] for a in penalties)
        return _ActivePenalty(is_pressed, value, first, second, n[is_pressed], N[is_pressed])

    def _compute_polynomials(self) -> Array:
        """Return psi, its gradient and its Hessian at the places of the points."""
        y = self.place
        polynomials = np.zeros((*y.shape[:2], POLYNOMIAL_SIZE))
        polynomials[..., :3] = y
        is_pressed, psi = (
            self._step_mean() if self._step_derivatives else self._penalty_memo.renew().penalty()
        )
        polynomials.reshape(-1, POLYNOMIAL_SIZE)[is_pressed, 3:] = psi
        return polynomials

    def _step_mean(self) -> tuple[NDArray[np.bool_], Array]:
        gradient, H, _ = self._step_derivatives
        return np.ones(len(gradient), dtype=bool), _flattened(
            np.zeros((len(gradient), 1)), gradient, H
        )

    def _compute_face_terms(self) -> Array:
        """Return the thickness factor, and what psi changes by with it."""
        active, half = self._penalty_memo.renew(), self._h / 2
        by_t = np.zeros((len(active.is_pressed), FACE_SIZE))
        by_t[:, 0] = self.factor
        if self._step_derivatives:
            by_t[:, 1:] = self._step_derivatives[2]
        else:
            by_t[active.is_pressed, 1:] = half * np.concatenate(
                [active.first, -active.second * active.n, half * active.second], axis=1
            )
        return by_t.reshape(*self.polynomial.values.shape[:2], FACE_SIZE)

    def expand_about(self, gap: Array) -> None:
        """Take in place of the penalty its Taylor polynomial about a gap, of the same contact
        elsewhere.

        For differences by a number of the case: a body that is hard closes or opens within a far
        smaller way.
        """
        self._expansion_gap = (gap,)

    @property
    def place(self) -> Array:
        """The places y = u - a d of the points, (cells, points, 3)."""
        return at_quadrature(self._u, self._points) - float(self._approach.value) * self.motion

    @property
    def factor(self) -> float | Array:
        """The thickness over h at the points, (cells * points,) where it varies."""
        return self._factor_memo.renew()

    @property
    def point_state(self) -> tuple[Array, float | Array]:
        """`place` and `factor`."""
        return self.place, self.factor

    def average(
        self, begin: tuple[Array, float | Array], end: tuple[Array, float | Array], part: float
    ) -> None:
        """Take the forces of a step in place of the present ones, until `use_present_forces`.

        Their product with the change of y is that of psi, plus what the step dissipates: the mean
        gradient is that of psi along the normal, over the penetration and not over time, so that it
        counts where contact sets in or ceases. See docs/theory.md, Motion.

        Parameters
        ----------
        begin, end
            `point_state` at both ends of the step.
        part
            Of the step at which the system has its forces.
        """
        k, soft_penetration, half = (
            float(self.stiffness.value),
            SOFT_PENETRATION * self._h,
            self._h / 2,
        )
        middle = (begin[0] + end[0]) / 2, (begin[1] + end[1]) / 2
        gaps, n, N = zip(*(self._gap_at(*state) for state in (begin, middle, end)), strict=True)
        s0, _, s1 = (-gap for gap in gaps)
        mean, slope = mean_pressure(s0, s1, k, soft_penetration)
        normal, bend = (n[0] + 4 * n[1] + n[2]) / 6, (2 * N[1] + N[2]) / 6
        (_, p0, _), (_, p1, stiff) = (
            penalty(s0, k, soft_penetration),
            penalty(s1, k, soft_penetration),
        )

        def outer(a: Array) -> Array:
            return a[:, :, None] * a[:, None, :]

        def times(c: Array, a: Array) -> Array:
            return c.reshape(-1, *[1] * (a.ndim - 1)) * a

        off_middle = part - 0.5
        gradient = -times(mean, normal) - off_middle * (times(p1, n[2]) - times(p0, n[0]))
        H = (
            times(slope, outer(normal))
            - times(mean, bend)
            + off_middle * (times(stiff, outer(n[2])) - times(p1, N[2]))
        )
        by_t = half * (mean + off_middle * (p1 - p0))
        mixed = -half * (times(slope, normal) + off_middle * times(stiff, n[2])) / part
        second_by_t = half**2 * (slope + off_middle * stiff) / part
        self._step_derivatives = (
            gradient,
            np.asarray(H / part),
            np.column_stack([by_t, mixed, second_by_t]),
        )

    def use_present_forces(self) -> None:
        """Take the present forces again."""
        self._step_derivatives = ()

    def cell_pressures(self) -> Array:
        """Return the mean pressure in each local cell, over E h/R.

        The ring of a contact is narrower than that of nodes.
        """
        V = self._u.function_space
        weights = basix.make_quadrature(V.mesh.basix_cell(), self._degree)[1]
        return np.asarray(self._pressures() @ weights / weights.sum())

    def evenly_pressed(self) -> NDArray[np.bool_]:
        """Return whether all points of each local cell are pressed, and its mean is near its
        pressure.
        """
        pressures = self._pressures()
        is_even = pressures.max(axis=1) <= LARGEST_OVER_MEAN_PRESSURE * self.cell_pressures()
        return np.asarray((pressures > 0).all(axis=1) & is_even)

    def _pressures(self) -> Array:
        """Return the pressure at the points of local cells, over E h/R."""
        self.polynomial.renew()
        return np.asarray(np.linalg.norm(self.polynomial.values[..., 4:7], axis=-1))

    def region(self, comm: MPI.Comm, radius: float) -> Region:
        """Return where the body touches; `radius` is the mean one."""
        owned = slice(0, self._owned * len(self._points))
        gap, x = (
            self.gap[owned],
            (self._placement_memo.renew() + self.place).reshape(-1, 3)[owned] - self.contact.front,
        )
        pressure, d = (
            penalty(-gap, float(self.stiffness.value), SOFT_PENETRATION * self._h)[1],
            self.contact.direction,
        )
        largest = comm.allreduce(float(pressure.max(initial=0.0)), MPI.MAX)
        from_axis = np.linalg.norm(x - (x @ d)[:, None] * d, axis=1)[
            pressure > PRESSURE_THRESHOLD * largest
        ]
        penetration = comm.allreduce(float(-gap.min(initial=np.inf)), MPI.MAX)
        inner = comm.allreduce(float(from_axis.min(initial=np.inf)), MPI.MIN)
        outer = comm.allreduce(float(from_axis.max(initial=0.0)), MPI.MAX)
        return Region(penetration, radius, inner if largest else 0.0, outer)
