"""Contact with rigid bodies: the penalty of the gap by its Taylor polynomial at each quadrature
point.

The gap between a body and the shell's face is g(x - a d) - t h/2, with the body's signed distance g
at approach zero, its approach a along d, the place x of the mid-surface and the factor t of the
thickness. The penalty psi(-gap) is zero where the gap is open. As of an applied field
(`magnetism.applied`), the polynomial of second order in y = u - a d at the present y has the
derivatives of the penalty itself, by the displacement and by the approach, for every shape of a
body. Where the thickness varies, or is that of a shell that gets thinner as it stretches, t is one
more variable of the polynomial. docs/theory.md, Contact.

- The approach a is a load parameter: how far the body has moved from where it is at first.
- psi is the penalty energy per undeformed area, a function of the penetration (minus the gap).
- The expansion point is the y for which a polynomial was computed. P are a polynomial's
  coefficients: the expansion point in P[0:3], psi there in P[3], its gradient in P[4:7], its
  Hessian in P[7:13]. F are t at the expansion point, and the derivatives by t.
- A point is pressed if its gap is closed.
- A jet is a map with its first and second derivatives at quadrature points, a density an energy per
  undeformed area as a function of jets.
- A memo is a value that is computed again where its inputs have changed: `renew` returns it.
- Lengths are over R, the approach is over h, psi over E h.
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
from magshell_fenicsx.models.domains import IntegrationDomain
from magshell_fenicsx.models.shell.kinematics import Forms, Jet
from magshell_fenicsx.parts.bodies.body import Distance
from magshell_fenicsx.parts.gap import ThicknessRatio, thickness_ratio
from magshell_fenicsx.parts.penalty_contact import (
    PASS_THROUGH_DISTANCE,
    GapAlongStep,
    PenaltyContact,
    PressedPoints,
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
    """A rigid body in contact with a shell, dimensionless and in the model's frame.

    Attributes
    ----------
    body
        Its name in the case.
    amplitude
        Name of the load parameter that is its approach, over h.
    distance
        Its signed distance function at approach zero.
    direction
        Unit vector (3,) of the approach.
    front
        Place (3,) over R of the point of its surface that goes ahead. Radii of contact are
        distances from the axis through this point along the approach.
    stiffness
        Stiffness k of the penalty, over E h/R^2.
    max_penetration
        Largest penetration that is allowed, over h.
    size
        Radius over R of the part that touches, such as a ball's; infinite for a plane.
    has_given_stiffness
        Whether the case gives the stiffness, which then stays.
    front_offset
        Distance over R of its front from its reference point, such as the centre of a ball.
    shells
        Names of the shells that it may touch, where there are several.
    start, lift
        Only for a body that starts at the shell's face: the place (3,) of the mid-surface there,
        and the vector (3,) from this place to the body's front. None for a body that has a position
        of its own.
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
    front_offset: float = 0.0
    shells: tuple[str, ...] = ()
    start: Array | None = None
    lift: Array | None = None

    @property
    def reference_point(self) -> Array:
        """Place (3,) over R of the body's reference point at approach zero."""
        return np.asarray(self.front - self.front_offset * self.direction)

    def gap(self, x: Array, approach: float, half: float | Array) -> tuple[Array, Array, Array]:
        """Return the gap (n,) between the body and the shell's face, with its gradient and Hessian.

        All lengths are over R; derivatives (n, 3) and (n, 3, 3) are by the place.

        Parameters
        ----------
        x
            (n, 3) places of the mid-surface.
        approach
            Displacement of the body along its direction.
        half
            Half the thickness of the shell, one number or (n,).
        """
        # moving the body forward is the same as moving the place back
        g, n, N = self.distance(x - approach * self.direction)
        return g - half, n, N

    @property
    def setting(self) -> str:
        """The name under which a state stores the body's stiffness if it was raised."""
        return f"stiffness_{self.body}"


def contact_energy(r0: Jet, u: Jet, P: Expr, motion: Expr, approach: Expr, *face: Expr) -> Expr:
    """Return the penalty psi per undeformed area from its polynomial, as a UFL expression.

    Parameters
    ----------
    r0, u
        Jets (values and derivatives) of the undeformed placement and of the displacement.
    P
        (`POLYNOMIAL_SIZE`,) coefficients of the polynomial at the point.
    motion
        Displacement (3,) of the body over R for an approach of one thickness.
    approach
        The approach of the body over h.
    face
        Only where the thickness varies: derivatives by the thickness (`FACE_SIZE`,), and the
        thickness over h, (1,).
    """
    # r0 is an argument of all densities, and not needed here
    s = _off_expansion_point(u, P, motion, approach)  # offset (3,) from the expansion point
    psi = _polynomial(P, s)
    if not face:
        return psi
    F, thickness = face
    return psi + _face_term(F, thickness[0], s)


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
    """Return the penalty psi per undeformed area of a shell that thins as it stretches.

    It is `contact_energy` with the deformed thickness, which follows from the stretch.

    Parameters
    ----------
    r0, u
        Jets of the undeformed placement and of the displacement.
    P
        (`POLYNOMIAL_SIZE`,) coefficients of the polynomial at the point.
    motion, approach
        Displacement (3,) of the body over R for an approach of one thickness; approach over h.
    F
        (`FACE_SIZE`,) derivatives of psi by the thickness factor.
    factor
        The undeformed thickness over h, (1,), if it varies.
    natural
        The natural shape, whose volume stays; None if it is the undeformed shape.
    thins
        1 where the shell keeps its volume, else 0.
    """
    s, t = _off_expansion_point(u, P, motion, approach), thickness_ratio(r0, u, natural, thins)
    # t is the deformed over the undeformed thickness; times `factor` it is over h
    return _polynomial(P, s) + _face_term(F, factor[0][0] * t if factor else t, s)


def _polynomial(P: Expr, s: Expr) -> Expr:
    """Return psi at an offset s (3,) from the expansion point of the polynomial P."""
    # numbers n with index pairs (i, j) of the Hessian, whose entries are P[7 + n]
    pairs = enumerate(zip(*INDEX_PAIRS, strict=True))
    return (
        P[3]
        + ufl.dot(_gradient(P), s)
        + sum(P[7 + n] * s[int(i)] * s[int(j)] for n, (i, j) in pairs)
    )


def _face_term(F: Expr, t: Expr, s: Expr) -> Expr:
    """Return the change of psi with the thickness factor t, at an offset s from the expansion.

    F (`FACE_SIZE`,) has the factor at the expansion point, the first derivative of psi by the
    factor, the mixed derivatives (3,) by factor and place, and the second derivative by the factor.
    """
    change = t - F[0]
    mixed_derivatives = ufl.as_vector([F[2 + i] for i in range(3)])
    return change * (F[1] + ufl.dot(mixed_derivatives, s) + change / 2 * F[5])


def _off_expansion_point(u: Jet, P: Expr, motion: Expr, approach: Expr) -> Expr:
    """Return the offset (3,) of y = u - a d from the expansion point of the polynomial P.

    Here u is the displacement, a the approach and d its direction.
    """
    return u.r - approach * motion - ufl.as_vector([P[i] for i in range(3)])


def _gradient(P: Expr) -> Expr:
    """Return the gradient (3,) of psi at the expansion point of the polynomial P."""
    return ufl.as_vector([P[4 + i] for i in range(3)])


@dataclass(frozen=True)
class Region:
    """The region in which a body touches the shell; lengths are over R.

    Attributes
    ----------
    penetration
        Largest penetration. While nothing touches it is negative: minus the least gap.
    radius, inner, outer
        Mean, least and largest distance of the contact pressure from the axis of the approach; 0
        without contact.
    pressure
        Largest contact pressure at the points, over E h/R.
    """

    penetration: float
    radius: float
    inner: float
    outer: float
    pressure: float


@dataclass(frozen=True)
class _ActivePenalty:
    """The penalty and its derivatives at the quadrature points where the gap is closed.

    Attributes
    ----------
    is_pressed
        (points,) flags of these points among all; m of them are set.
    value, first, second
        (m, 1) psi with its first and second derivative by the penetration.
    n, N
        Gradients (m, 3) and Hessians (m, 3, 3) of the body's signed distance.
    """

    is_pressed: NDArray[np.bool_]
    value: Array
    first: Array
    second: Array
    n: Array
    N: Array

    def flags_and_coefficients(self) -> tuple[NDArray[np.bool_], Array]:
        """Return the flags of the pressed points, and the polynomial coefficients of psi there.

        Returns
        -------
        is_pressed, coefficients
            (points,) the flags, and (m, 10) the coefficients at pressed points: psi, its gradient
            (3) and its Hessian (6) by the place, as P[3:] of a polynomial.
        """
        # derivatives of psi by the place: the penetration has the gradient -n and the Hessian -N
        H = (
            self.second[..., None] * self.n[:, :, None] * self.n[:, None, :]
            - self.first[..., None] * self.N
        )
        return self.is_pressed, _flattened(self.value, -self.first * self.n, H)


def _flattened(value: Array, gradient: Array, H: Array) -> Array:
    """Return the Taylor coefficients (m, 10) of psi: value, gradient, and Hessian by pairs i <= j.

    Diagonal entries of the Hessian are halved, so that the polynomial is the sum of H_ij s_i s_j
    over pairs i <= j.

    Parameters
    ----------
    value, gradient, H
        (m, 1), (m, 3) and (m, 3, 3).
    """
    pairs = H[:, *INDEX_PAIRS] * np.where(INDEX_PAIRS[0] == INDEX_PAIRS[1], 0.5, 1.0)
    return np.concatenate([value, gradient, pairs], axis=1)


def _thickness_factor(
    thickness: fem.Function | None, ratio_memo: "Memo[Array] | None", points: Array
) -> tuple[Callable[[], float | Array], Callable[[], tuple[Array, ...]]]:
    """Return two functions: one gives the thickness over h, the other the arrays it depends on.

    The thickness is that at all points of all cells, in one array; 1 where it neither varies nor
    changes.

    Parameters
    ----------
    thickness
        The undeformed thickness over h; None where it is h.
    ratio_memo
        The deformed over the undeformed thickness at the points; None where it is 1.
    points
        Points of the rule in a reference cell.
    """

    def factor() -> float | Array:
        """Return the thickness over h: the undeformed one, times the ratio."""
        undeformed: float | Array = 1.0
        if thickness is not None:
            undeformed = at_quadrature(thickness, points)[..., 0].ravel()
        return undeformed if ratio_memo is None else undeformed * ratio_memo.renew()

    def thicknesses() -> tuple[Array, ...]:
        """Return the arrays that the thickness depends on."""
        undeformed_thickness = () if thickness is None else (thickness.x.array,)
        return (*undeformed_thickness, ratio_memo.renew()) if ratio_memo else undeformed_thickness

    return factor, thicknesses


def _times(c: Array, a: Array) -> Array:
    """Return numbers c (points,) times arrays a (points, ...)."""
    return c.reshape(-1, *[1] * (a.ndim - 1)) * a


def _outer_square(a: Array) -> Array:
    """Return the products a_i a_j (points, 3, 3) of the components of vectors a (points, 3)."""
    return a[:, :, None] * a[:, None, :]


@dataclass(frozen=True)
class PointConfiguration:
    """Positions of the points of a shell relative to a body; lengths are over R.

    Attributes
    ----------
    r0
        (cells, points, 3) undeformed places.
    y
        (cells, points, 3) displacements u - a d relative to the body.
    factor
        Thickness over h, one number or (cells * points,).
    """

    r0: Array
    y: Array
    factor: float | Array

    @property
    def places(self) -> Array:
        """(cells * points, 3) places relative to the body at approach zero."""
        return np.asarray((self.r0 + self.y).reshape(-1, 3))


class BodyContact(PenaltyContact[PointConfiguration, Array]):
    """Contact of a rigid body with a shell: Taylor polynomials of its penalty at quadrature points.

    The polynomials are coefficients of the densities `contact_energy` and `thinned_energy`. They
    are computed again where the state has changed.

    Parameters
    ----------
    h
        Thickness over R.
    domain
        The surface or the meridian, with the placement.
    u
        Displacement over R in the placement's space; on a meridian along e_rho and e_z.
    approach
        The approach over h, as a constant in the forms.
    thickness
        The thickness over h; None where it is h.
    ratio_at_points
        Function from points in a reference cell to a memo of the deformed over the undeformed
        thickness there; None for 1.

    Attributes
    ----------
    parameters
        Arguments of the densities after the jets: polynomial, motion, approach, and where the
        thickness varies the derivatives by it and the thickness factor.
    polynomial
        (cells, points, `POLYNOMIAL_SIZE`) coefficients at quadrature points.
    stiffness
        Stiffness k of the penalty, over E h/R^2.

    The field `_points` has the points of the quadrature in a reference cell, and `_owned` is the
    number of cells that are not ghosts. `_face_field` (cells, points, `FACE_SIZE`) has the
    thickness factor t and the derivatives by t; None where the thickness is h.

    `_step_derivatives` are those of the mean forces of a step in time, if they count in place of
    the present ones: the gradient (points, 3) and Hessian (points, 3, 3) of psi by the place, and
    its derivatives by t (points, 5). `_expansion_gap` are the gaps (points,) about which the
    penalty is expanded, if these are not the present ones. Both are empty tuples otherwise.

    The memos are those of the placement r0 (cells, points, 3) at the points, the areas (cells,
    points) that they stand for, on a meridian of whole rings, the factor t, the gap with its
    gradient and Hessian (`_gap_memo`), and the penalty (`_penalty_memo`). Points of all
    cells are also counted in one row: (points,) stands for (cells * points,).
    """

    max_stiffening = 1e4

    def __init__(
        self,
        contact: ContactBody,
        h: float,
        domain: IntegrationDomain,
        u: fem.Function,
        approach: fem.Constant,
        thickness: fem.Function | None = None,
        ratio_at_points: ThicknessRatio | None = None,
    ) -> None:
        """Create the polynomials as functions of the state, with memos of what they depend on.

        A memo takes a function of its value, and one of the arrays whose change makes it outdated.
        """
        V, r0, degree = u.function_space, domain.r0, domain.contact_rule
        self.contact, self._h, self._u, self._approach = contact, h, u, approach
        self.polynomial = PointField(V.mesh, degree, POLYNOMIAL_SIZE)
        self._points, self._degree = self.polynomial.points, degree
        self._placement_memo = Memo(lambda: at_quadrature(r0, self._points), lambda: (r0.x.array,))
        jets_at_points = domain.tables(V, self._points)
        _, weights = basix.make_quadrature(V.mesh.basix_cell(), degree)

        def areas() -> Array:
            """Return the undeformed areas (cells, points) that points stand for, over R²."""
            tangents = jets_at_points(r0.x.array)[1:3]
            ratio = np.linalg.norm(np.cross(*tangents), axis=-1)
            return np.asarray(domain.revolution_factor * weights * ratio)

        self._area_memo = Memo(areas, lambda: (r0.x.array,))
        # the deformed over the undeformed thickness at the points; None where it is 1
        ratio_memo = ratio_at_points and ratio_at_points(self._points)
        factor, thicknesses = _thickness_factor(thickness, ratio_memo, self._points)
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
        self._step_derivatives: tuple[Array, ...] = ()
        self._expansion_gap: tuple[Array, ...] = ()

        def inputs_of_gaps() -> tuple[Array, ...]:
            """Return the arrays that gaps depend on."""
            return r0.x.array, u.x.array, approach.value, *thicknesses()

        def inputs_of_forces() -> tuple[Array, ...]:
            """Return the arrays that the penalty and its derivatives depend on."""
            return (
                *inputs_of_gaps(),
                self.stiffness.value,
                *self._step_derivatives,
                *self._expansion_gap,
            )

        self._gap_memo = Memo(lambda: self._gap_at(self.place, self.factor), inputs_of_gaps)
        self._penalty_memo = Memo(self._active_penalty, inputs_of_forces)
        self.polynomial.compute_by(self._compute_polynomials, inputs_of_forces)
        if self._face_field is not None:
            self._face_field.compute_by(self._compute_face_terms, inputs_of_forces)

    @property
    def options(self) -> ContactBody:
        return self.contact

    @property
    def history(self) -> dict[str, tuple[fem.Constant, float]]:
        """The name, constant and default of its stiffness, which a state stores by this name."""
        return {self.contact.setting: (self.stiffness, self.contact.stiffness)}

    @property
    def motion(self) -> Array:
        """The displacement (3,) of the body for an approach of one."""
        return self._h * self.contact.direction

    @property
    def gap(self) -> Array:
        """The gaps (points,) over R, at the points of all cells."""
        gaps, *_ = self._gap_memo.renew()
        return gaps

    @property
    def comm(self) -> MPI.Comm:
        """The communicator of the mesh."""
        comm: MPI.Comm = self._u.function_space.mesh.comm
        return comm

    def penetration(self) -> float:
        """Return the largest penetration over R, 0 without contact; collective."""
        return float(self.comm.allreduce(float((-self.gap).max(initial=0.0)), MPI.MAX))

    def relative_penetration(self) -> float:
        """Return the largest penetration over h, 0 without contact; collective."""
        return self.penetration() / self._h

    def penetration_message(self, stiffness: float, *, moving: bool) -> str:
        depth, body = self.relative_penetration(), self.contact.body
        if depth <= self.contact.max_penetration:
            return ""
        return (
            f"the penetration of the body {body} is {depth:.3g} h, more than "
            f"bodies.{body}.penetration: {self.contact.max_penetration:g}; its stiffness is "
            f"{stiffness:.4g}: give four times as much"
        )

    def gap_along_step(
        self, begin: PointConfiguration, end: PointConfiguration
    ) -> GapAlongStep | None:
        """Return the gap on the way of a step; None if nothing moves. Collective.

        The places are those of quadrature points of this rank, the thickness is that at the end.
        """
        x, y, half = begin.places, end.places, self._h / 2 * end.factor
        largest_approach = self.comm.allreduce(
            float(np.linalg.norm(y - x, axis=1).max(initial=0.0)), MPI.MAX
        )

        def gap(part: float) -> float:
            """Return the least gap over R after a part of the way."""
            gaps, _, _ = self.contact.gap(x + part * (y - x), approach=0.0, half=half)
            return float(self.comm.allreduce(float(gaps.min(initial=np.inf)), MPI.MIN))

        crossing_distance = PASS_THROUGH_DISTANCE * self._h
        return GapAlongStep(gap, largest_approach, crossing_distance) if largest_approach else None

    def _gap_at(self, y: Array, factor: float | Array) -> tuple[Array, Array, Array]:
        """Return the gap (points,), its gradient (points, 3) and its Hessian (points, 3, 3).

        Parameters
        ----------
        y
            (cells, points, 3) displacements u - a d relative to the body, over R.
        factor
            Thickness over h, one number or (cells * points,).
        """
        relative_places = (self._placement_memo.renew() + y).reshape(-1, 3)
        # the displacements are relative to the body, which is then at approach zero
        return self.contact.gap(relative_places, approach=0.0, half=self._h / 2 * factor)

    def _active_penalty(self) -> "_ActivePenalty":
        """Return the penalty at the points whose gap is closed, which are few of all.

        If `expand_about` has set gaps, the penalty is expanded about these, and the points are
        those where these gaps are closed. Otherwise the penalty is that of the present gap.
        """
        gap, n, N = self._gap_memo.renew()
        expansion_gap = self._expansion_gap[0] if self._expansion_gap else gap
        is_pressed = expansion_gap < 0
        penalties = self.penalty.expanded(-gap[is_pressed], -expansion_gap[is_pressed])
        value, first, second = (derivative[:, None] for derivative in penalties)
        return _ActivePenalty(is_pressed, value, first, second, n[is_pressed], N[is_pressed])

    def _compute_polynomials(self) -> Array:
        """Return the coefficients (cells, points, `POLYNOMIAL_SIZE`) of psi at the present state.

        While the mean forces of a step are used in place of the present ones (`average`), the
        coefficients are theirs.
        """
        y = self.place
        polynomials = np.zeros((*y.shape[:2], POLYNOMIAL_SIZE))
        polynomials[..., :3] = y  # the expansion point; other coefficients are zero at open points
        # the other coefficients (m, 10) at the points that are flagged among all points
        if self._step_derivatives:
            is_pressed, coefficients = self._step_mean()
        else:
            is_pressed, coefficients = self._penalty_memo.renew().flags_and_coefficients()
        polynomials.reshape(-1, POLYNOMIAL_SIZE)[is_pressed, 3:] = coefficients
        return polynomials

    def _step_mean(self) -> tuple[NDArray[np.bool_], Array]:
        """Return flags (points,), which are all set, and coefficients (points, 10) of psi there.

        The coefficients are those of the mean force of a step: P[3:] of polynomials, with zero for
        the value of psi.
        """
        gradient, H, _ = self._step_derivatives
        no_values = np.zeros((len(gradient), 1))  # of psi, which does not enter the forces
        return np.ones(len(gradient), dtype=bool), _flattened(no_values, gradient, H)

    def _compute_face_terms(self) -> Array:
        """Return the thickness factor t and derivatives of psi by t: (cells, points, `FACE_SIZE`).

        After t come the first derivative, the mixed ones by t and place (3), and the second one.
        """
        active, half = self._penalty_memo.renew(), self._h / 2
        face_terms = np.zeros((len(active.is_pressed), FACE_SIZE))
        face_terms[:, 0] = self.factor
        if self._step_derivatives:
            *_, step_by_t = self._step_derivatives
            face_terms[:, 1:] = step_by_t
        else:
            # the penetration grows by h/2 with t, and by -n with the place
            face_terms[active.is_pressed, 1:] = half * np.concatenate(
                [active.first, -active.second * active.n, half * active.second], axis=1
            )
        return face_terms.reshape(*self.polynomial.values.shape[:2], FACE_SIZE)

    def freeze(self) -> Array:
        """Return the gaps (points,) over R, about which the penalty can be expanded."""
        return self.gap

    def expand_about(self, frozen: Array) -> None:
        self._expansion_gap = (frozen,)

    @property
    def place(self) -> Array:
        """The displacements y = u - a d of the points relative to the body, (cells, points, 3).

        Here u is the shell's displacement and a the approach along d, all over R.
        """
        return at_quadrature(self._u, self._points) - float(self._approach.value) * self.motion

    @property
    def factor(self) -> float | Array:
        """The thickness over h at the points, (cells * points,); one number where it is uniform."""
        return self._factor_memo.renew()

    @property
    def configuration(self) -> PointConfiguration:
        """The present places of the points relative to the body."""
        return PointConfiguration(self._placement_memo.renew(), self.place, self.factor)

    def average(self, begin: PointConfiguration, end: PointConfiguration, part: float) -> None:
        """Use the mean force of a step in time, until `use_present_force` is called.

        The product of the mean force with the change of y is the change of psi, plus the energy
        that the step dissipates. The mean gradient is the mean of psi's gradient over the
        penetrations of the step, not over its time: so contact that sets in or ceases within the
        step counts in full. A dissipative force is added as in generalised alpha, the scheme of
        time integration: the change of the force over the step, times `part` - 1/2. See
        docs/theory.md, Motion.
        """
        penalty, half = self.penalty, self._h / 2
        # gaps with gradients n and Hessians N, each at the begin (0), middle (1) and end (2)
        middle = (begin.y + end.y) / 2, (begin.factor + end.factor) / 2
        states = (begin.y, begin.factor), middle, (end.y, end.factor)
        gaps, n, N = zip(*(self._gap_at(*state) for state in states), strict=True)
        s0, _, s1 = (-gap for gap in gaps)  # penetrations at the begin and the end
        # the mean normal by Simpson's rule; the middle depends on the end of the step by half, so
        # that the derivative of the mean normal has the weights 4/6/2 and 1/6
        normal, mean_hessian = (n[0] + 4 * n[1] + n[2]) / 6, (2 * N[1] + N[2]) / 6
        # the mean pressure with its derivative by s1, then the pressures at both ends
        mean_slope, mean_curvature = penalty.mean_pressure(s0, s1)
        _, p0, _ = penalty.derivatives(s0)
        _, p1, k1 = penalty.derivatives(s1)
        # psi by the place: the penetration has the gradient -n. The terms with off_middle are the
        # dissipative force; second derivatives are those by the end of the step alone
        off_middle = part - 0.5
        gradient = -_times(mean_slope, normal) - off_middle * (_times(p1, n[2]) - _times(p0, n[0]))
        H = (
            _times(mean_curvature, _outer_square(normal))
            - _times(mean_slope, mean_hessian)
            + off_middle * (_times(k1, _outer_square(n[2])) - _times(p1, N[2]))
        )
        # psi by the thickness factor t, with which the penetration grows by h/2
        by_t = half * (mean_slope + off_middle * (p1 - p0))
        mixed = -half * (_times(mean_curvature, normal) + off_middle * _times(k1, n[2])) / part
        second_by_t = half**2 * (mean_curvature + off_middle * k1) / part
        # the end moves by 1/part of the motion at `part`, by which the system differentiates: hence
        # the division of second derivatives
        self._step_derivatives = (
            gradient,
            np.asarray(H / part),
            np.column_stack([by_t, mixed, second_by_t]),
        )

    def use_present_force(self) -> None:
        self._step_derivatives = ()

    def cell_pressures(self) -> Array:
        """Return the mean contact pressure (cells,) in each local cell, over E h/R.

        Values at nodes would not resolve the ring of a contact, which is narrower than a cell.
        """
        V = self._u.function_space
        _, weights = basix.make_quadrature(V.mesh.basix_cell(), self._degree)
        return np.asarray(self._pressures() @ weights / weights.sum())

    def evenly_pressed(self) -> NDArray[np.bool_]:
        """Return the flags (cells,) of local cells that are pressed evenly.

        All points of such a cell are pressed, and the largest pressure is at most
        `LARGEST_OVER_MEAN_PRESSURE` times the mean.
        """
        pressures = self._pressures()
        # true of a cell without pressure too, which the other condition excludes
        is_even = pressures.max(axis=1) <= LARGEST_OVER_MEAN_PRESSURE * self.cell_pressures()
        return np.asarray((pressures > 0).all(axis=1) & is_even)

    def _tractions(self) -> Array:
        """Return the forces per undeformed area on the body (cells, points, 3), over E h/R."""
        self.polynomial.renew()
        return self.polynomial.values[..., 4:7]

    def _pressures(self) -> Array:
        """Return the contact pressure at the points of local cells (cells, points), over E h/R."""
        return np.asarray(np.linalg.norm(self._tractions(), axis=-1))

    def pressed_points(self) -> PressedPoints:
        pressures, area = self._pressures()[: self._owned], self._area_memo.renew()[: self._owned]
        places = self._placement_memo.renew() + at_quadrature(self._u, self._points)
        cell, point = np.nonzero(pressures)
        return PressedPoints(
            places[cell, point],
            pressures[cell, point],
            area[cell, point],
            area.sum(axis=1)[cell],
        )

    def forces_and_moments(self) -> tuple[Array, Array]:
        """Return the forces on the body at the points of own cells, and their moments.

        Both are (cells, points, 3), over E h R and E h R². Moments are about the body's reference
        point, where it is at present. On a meridian a force is the sum of the forces at azimuth
        zero that the ring of a point has.
        """
        body, own_cells = self.contact, slice(0, self._owned)
        forces = (self._area_memo.renew()[..., None] * self._tractions())[own_cells]
        # relative to the body, which is then at approach zero
        places = (self._placement_memo.renew() + self.place)[own_cells]
        arms = places - body.reference_point
        return forces, np.asarray(np.cross(arms, forces), np.float64)

    def region(self) -> Region:
        """Return the region where the body touches the shell; collective."""
        # points of owned cells alone: ghosts belong to other ranks
        owned, comm = slice(0, self._owned * len(self._points)), self.comm
        gap = self.gap[owned]
        x, d = (self._placement_memo.renew() + self.place).reshape(-1, 3), self.contact.direction
        _, pressure, _ = self.penalty.derivatives(-gap)
        largest = comm.allreduce(float(pressure.max(initial=0.0)), MPI.MAX)
        # distances of the pressed points from the axis through the front, along the approach
        from_front = x[owned] - self.contact.front
        distance_from_axis = np.linalg.norm(from_front - (from_front @ d)[:, None] * d, axis=1)
        from_axis = distance_from_axis[pressure > PRESSURE_THRESHOLD * largest]
        # the mean distance, weighted with the force
        force = (self._area_memo.renew() * self._pressures()).ravel()[owned]
        total, moment = comm.allreduce(np.array([force.sum(), force @ distance_from_axis]))
        radius = float(moment / total) if total else 0.0
        penetration = comm.allreduce(float(-gap.min(initial=np.inf)), MPI.MAX)
        inner = comm.allreduce(float(from_axis.min(initial=np.inf)), MPI.MIN)
        outer = comm.allreduce(float(from_axis.max(initial=0.0)), MPI.MAX)
        # without contact the least distance is that of no points, infinite
        return Region(penetration, radius, inner if largest else 0.0, outer, largest)
