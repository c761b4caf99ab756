"""An applied flux density by its Taylor polynomial at the present place of each quadrature point.

The polynomial of second order has the first and second derivatives of the field itself, and so have
the energies that take it: the forms and kernels are the same for every field. A shell that has
passed through a magnet between two states is noticed, however thin that is. The amplitudes of
fields that are driven are free parameters of a system.

- B, G and H are the flux density with its first and second derivatives: (n, 3), (n, 3, 3) and (n,
  3, 3, 3). Places are over R.
- The entries of the polynomial at a point are: u (3), B at the undeformed place (3), then at the
  present place B (3), G (9) and the coefficients of second order (18).
- A field at rest depends on no amplitude. A moving, or driven, field is moved or multiplied by
  amplitudes: load parameters by name, which `mu` holds.
- A point field is a fem.Function with values at quadrature points, computed again when its inputs
  change; a `Memo` is such an array.
- Pi is an energy; terms are energies with their forms. Energies of a remanence are linear in the
  field, energies of a soft magnet are quadratic in it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.free_parameters import Derivative, FreeParameter, derived
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.memo import Memo, PointField, at_quadrature
from magshell_fenicsx.assembly.terms import FormTerm, Term
from magshell_fenicsx.models.shell.densities import COMPONENT_PAIRS, FIELD_POLYNOMIAL_SIZE
from magshell_fenicsx.models.shell.spatial_fields import refuse_unbounded
from magshell_fenicsx.parts.magnetism.moving_source import (
    FieldAtPlaces,
    FieldInSpace,
    MovingField,
    combined_motion,
)

Array = NDArray[np.float64]
MAX_HALVINGS = 16  # of a segment, whose parts are then shorter than rounding in places of a path


def crossed_place(distance: Callable[[Array], Array], starts: Array, ends: Array) -> Array | None:
    """Return a place (3,) inside a body on straight segments between places; None without one.

    Parameters
    ----------
    distance
        Places (n, 3) -> their distances (n,) from the body, negative inside it.
    starts, ends
        (n, 3) ends of the segments.

    Notes
    -----
    From one place to another the distance from a body changes by at most the length between them.
    So no place of a segment is inside if the distances at both ends add up to more than its length.
    Other segments are halved, at most `MAX_HALVINGS` times; a graze that is shorter is ignored.
    """
    # at the start and at the end of each segment
    distance_before, distance_after = distance(starts), distance(ends)
    for _ in range(MAX_HALVINGS):
        may_cross = distance_before + distance_after <= np.linalg.norm(ends - starts, axis=1)
        if not may_cross.any():
            return None
        starts, ends, distance_before, distance_after = (
            values[may_cross] for values in (starts, ends, distance_before, distance_after)
        )
        middle = (starts + ends) / 2
        distance_of_middle = distance(middle)
        if (distance_of_middle < 0).any():
            return np.asarray(middle[distance_of_middle.argmin()])
        # all first halves, then all second halves
        starts, ends = np.concatenate([starts, middle]), np.concatenate([middle, ends])
        distance_before = np.concatenate([distance_before, distance_of_middle])
        distance_after = np.concatenate([distance_of_middle, distance_after])
    return None


class AppliedField:
    """Taylor polynomials of a field at the quadrature points of a shell, a meridian or a solid.

    The constructor is collective.

    Parameters
    ----------
    field_at_rest
        The field that no amplitude drives: places (n, 3) over R -> B, first and second derivatives.
    r0, u
        Placement and displacement in one space; on a meridian along e_rho and e_z.
    degree
        Degree of the quadrature.
    moving_fields
        The fields that amplitudes drive, which are added.

    Raises
    ------
    MeshError
        On every rank, if the field has no finite value or derivative on the undeformed surface.

    Attributes
    ----------
    polynomial
        The coefficient of the densities: at each point u, B at the undeformed place, then B, its
        gradient and its halved second derivatives at the present place.
    mu
        Name -> value of the amplitudes of the driven fields.
    lost
        Where the field was not finite since the path began; empty if it was finite everywhere.
    _B0
        (cells, points, 3) B at the undeformed places.
    _values_at_rest
        B, G and H of the field at rest, at the present places.
    _fields_at_places
        The moving fields at the places where they were last evaluated.
    _r0, _displacement
        Undeformed places and displacements (cells, points, 3) at quadrature points; memos, whose
        `renew` returns the present value.
    _field_at_rest, _moving_fields, _u, _degree
        The parameters.
    """

    def __init__(
        self,
        field_at_rest: FieldInSpace,
        r0: fem.Function,
        u: fem.Function,
        degree: int,
        moving_fields: Sequence[MovingField] = (),
    ) -> None:
        """Set up the quantities that follow r0, u and mu, and check the undeformed field.

        Arrays in a `Memo` are computed again where their inputs, the second argument, have changed.
        """
        V = u.function_space
        self._degree = degree
        self.polynomial = PointField(V.mesh, degree, FIELD_POLYNOMIAL_SIZE)
        self._field_at_rest, self._moving_fields, self._u = field_at_rest, moving_fields, u
        self.mu = {name: 0.0 for field in moving_fields for name in field.names}
        self.lost = ""
        self._fields_at_places: list[FieldAtPlaces] = []
        points = self.polynomial.points
        self._r0 = Memo(lambda: at_quadrature(r0, points), lambda: (r0.x.array,))
        self._displacement = Memo(lambda: at_quadrature(u, points), lambda: (u.x.array,))
        self._values_at_rest = Memo(
            lambda: field_at_rest(self.places), lambda: (r0.x.array, u.x.array)
        )
        # the field at the undeformed places; nan where it is not differentiable, which
        # `refuse_unbounded` reports
        undeformed = self._r0.renew()
        x = undeformed.reshape(-1, 3)
        B, G, H = self._total_field(field_at_rest(x), x)
        differentiable = np.isfinite(G).all(axis=(1, 2)) & np.isfinite(H).all(axis=(1, 2, 3))
        self._B0 = np.where(differentiable.reshape(-1, 1), B, np.nan).reshape(undeformed.shape)
        refuse_unbounded(self._B0, undeformed, V.mesh.comm, "magnetic.applied")
        self.polynomial.compute_by(
            self._polynomials, lambda: (r0.x.array, u.x.array, *self.mu.values())
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The amplitudes of the driven fields."""
        return tuple(self.mu)

    def _polynomials(self) -> Array:
        """Return the values (cells, points, size) of `polynomial` at the present state.

        As a side effect `lost` is set to a description of the first present place at which the
        field is not finite. Later states do not clear it.
        """
        displacement, places = self._displacement.renew(), self.places
        # field with first and second derivatives at the present places (n, 3)
        B, G, H = self._total_field(self._values_at_rest.renew(), places)
        is_lost = ~np.isfinite(B).all(axis=1)
        self.lost = self._lost_description(places[is_lost][0]) if is_lost.any() else self.lost
        # coefficients of second order: B,jk dx_j dx_k/2 for pairs j <= k. Of j < k there are two
        # equal terms, which cancel the half
        second_order = H[:, :, *COMPONENT_PAIRS] * np.where(
            COMPONENT_PAIRS[0] == COMPONENT_PAIRS[1], 0.5, 1.0
        )
        columns = [
            array.reshape(*displacement.shape[:2], -1)
            for array in (displacement, self._B0, B, G, second_order)
        ]
        return np.concatenate(columns, axis=-1)

    def slope(self, name: str, other: str = "", *, at_present_places: bool = True) -> PointField:
        """Return a point field of the derivative of the Taylor polynomial by one or two amplitudes.

        With `name` alone it has dB/dmu and its gradient. With `other` too it has the second
        derivative d2B/dmu_i dmu_j, without a gradient. The values follow the state.

        Parameters
        ----------
        name, other
            Names of amplitudes; `other` is empty for a first derivative.
        at_present_places
            True for a field that replaces `polynomial` in a form: its first entries are then the
            displacement. False for a direction in which a form is differentiated by `polynomial`:
            these entries are then zero.
        """
        field = PointField(self._u.function_space.mesh, self._degree, FIELD_POLYNOMIAL_SIZE)
        field.compute_by(
            lambda: self._slopes(name, other, at_present_places=at_present_places),
            lambda: (self.polynomial.renew(),),
        )
        return field

    def _slopes(self, name: str, other: str, *, at_present_places: bool) -> Array:
        """Return the values (cells, points, size) of the point field that `slope` returns."""
        values = np.zeros_like(self.polynomial.values)
        values[..., :3] = self.polynomial.values[..., :3] if at_present_places else 0.0
        shape = values.shape[:2]
        # columns as in `polynomial`: 0:3 u, 3:6 B at the undeformed place, 6:9 B, 9:18 gradient
        for at_places in self._fields_at_places:
            # a field that does not depend on the amplitudes has no derivative by them
            names = at_places.moving_field.names
            if name not in names:
                continue
            if other and other not in names:
                continue
            if other:
                values[..., 6:9] += at_places.second_derivative(name, other).reshape(*shape, 3)
            else:
                B, G = at_places.derivative(name)
                values[..., 6:9] += B.reshape(*shape, 3)
                values[..., 9:18] += G.reshape(*shape, 9)
        return values

    @property
    def places(self) -> Array:
        """The present places (n, 3) of the quadrature points."""
        return (self._r0.renew() + self._displacement.renew()).reshape(-1, 3)

    def passed_through(
        self, start: tuple[Array, Mapping[str, float]], end: tuple[Array, Mapping[str, float]]
    ) -> str:
        """Describe the body through which a point has moved between two states; "" without one.

        Each state is given by the places (n, 3) of all quadrature points and the amplitudes by
        name. Only fields of bodies can be passed through: they have a function `distance` of
        places. Sums of fields list their summands in `parts`.
        """
        # the summands at rest count as fields without motions
        parts_at_rest = [
            MovingField(field_part) for field_part in getattr(self._field_at_rest, "parts", [])
        ]
        for moving_field in [*parts_at_rest, *self._moving_fields]:
            field = moving_field.at_rest
            if distance := getattr(field, "distance", None):
                # the places of both states as seen from the body, which moves by x -> Q x + t
                seen_from_body = []
                for x, mu in (start, end):
                    Q, t = combined_motion(moving_field.motions, mu)
                    seen_from_body.append((x - t) @ Q)
                if crossed_place(distance, *seen_from_body) is not None:
                    description = getattr(field, "nowhere", "is inside a source")
                    return f"a point of the shell {description} between two points of the path"
        return ""

    def _total_field(
        self, at_rest: tuple[Array, Array, Array], x: Array
    ) -> tuple[Array, Array, Array]:
        """Return B, G and H of the whole field at places x (n, 3).

        `at_rest` are B, G and H of the field at rest, to which the moving fields are added. As a
        side effect the moving fields at x are kept for `_slopes`.
        """
        self._fields_at_places = [moving.field_at(x, self.mu) for moving in self._moving_fields]
        fields = [at_rest, *(at_places.value for at_places in self._fields_at_places)]
        B, G, H = (np.sum(contributions, axis=0) for contributions in zip(*fields, strict=True))
        return B, G, H

    def _lost_description(self, x: Array) -> str:
        """Describe for the user why the field is not finite at a place (3,); "" if it is finite."""
        # pairs of a field and its value: a sum of fields is looked at summand by summand, so that
        # the right one is named
        values_at_rest = [
            (field_part, field_part(x[None])[0])
            for field_part in getattr(self._field_at_rest, "parts", [self._field_at_rest])
        ]
        values_of_moving = [
            (moving.at_rest, moving.field_at(x[None], self.mu).B) for moving in self._moving_fields
        ]
        for field, B in [*values_at_rest, *values_of_moving]:
            if not np.isfinite(B).all():
                description = getattr(
                    field, "nowhere", "is where magnetic.applied has no finite value"
                )
                place = f"({x[0]:.3g}, {x[1]:.3g}, {x[2]:.3g})"
                return f"the shell's point (x, y, z)/R = {place} {description}"
        return ""


@dataclass(eq=False)
class FieldAmplitude:
    """The amplitude of a moving field, as a free parameter: it takes the place of a UFL constant.

    Forms do not contain the amplitude, but the field's Taylor polynomial. So derivatives by it are
    made by exchanging the polynomial, or by differentiating along a change of the polynomial.

    Attributes
    ----------
    applied
        The field, which holds the value of the amplitude.
    name
        Name of the amplitude.
    terms
        The energies of the field. Terms with an amplitude of their own are linear in the field;
        terms without one, of soft magnets, are quadratic in it.
    u
        The displacement.
    log
        Log of compiled kernels.
    """

    applied: AppliedField
    name: str
    terms: Sequence[FormTerm]
    u: fem.Function
    log: KernelLog

    @property
    def value(self) -> float:
        return self.applied.mu[self.name]

    @value.setter
    def value(self, value: float) -> None:
        self.applied.mu[self.name] = float(value)

    def slopes(self) -> list[FormTerm]:
        """Return dPi/dmu as terms, one for each energy.

        For an energy that is linear in the field, dB/dmu replaces the field in the form. A
        quadratic energy is differentiated along the change of the Taylor polynomial.
        """
        # `slope` returns dB/dmu as a field at quadrature points
        linear = [self._with_polynomial(t, self.applied.slope(self.name)) for t in self._linear]
        quadratic = [
            self._derivative_along(t, self.applied.slope(self.name, at_present_places=False))
            for t in self._quadratic
        ]
        return linear + quadratic

    def second_derivatives(self, q: Any) -> Sequence[Derivative]:
        """Return d2Pi/dmu dq as terms.

        `q` is another amplitude of a field, a UFL constant, or a parameter with this method. The
        list is empty for an amplitude of another field.
        """
        if not isinstance(q, FieldAmplitude):
            if hasattr(q, "second_derivatives"):  # q knows the mixed derivative
                derivatives: Sequence[Derivative] = q.second_derivatives(self)
                return derivatives
            # a UFL constant: dPi/dmu is differentiated by it
            terms_with_q = [t for t in self.slopes() if q in t.form.constants()]
            return [self._term(t, derived(t.form, q)) for t in terms_with_q]
        if q.applied is not self.applied:
            return []
        # energies that are linear in the field: d2B/dmu dq in its place
        linear = [
            self._with_polynomial(t, self.applied.slope(self.name, q.name)) for t in self._linear
        ]
        # quadratic energies: the sum of Pi' along d2B/dmu dq, and of Pi'' along dB/dmu and dB/dq
        by_both_change, by_first, by_second = (
            self.applied.slope(*names, at_present_places=False)
            for names in ((self.name, q.name), (self.name,), (q.name,))
        )
        by_both = [self._derivative_along(t, by_both_change) for t in self._quadratic]
        by_one_after_other = [
            self._derivative_along(self._derivative_along(t, by_first), by_second)
            for t in self._quadratic
        ]
        return linear + by_both + by_one_after_other

    @property
    def _linear(self) -> list[FormTerm]:
        """The energies that are linear in the field."""
        return [t for t in self.terms if t.amplitude is not None]

    @property
    def _quadratic(self) -> list[FormTerm]:
        """The energies that are quadratic in the field."""
        return [t for t in self.terms if t.amplitude is None]

    def _with_polynomial(self, t: FormTerm, polynomial: PointField) -> FormTerm:
        """Return the term with another polynomial in place of the field's."""
        return self._term(t, ufl.replace(t.form, {self.applied.polynomial: polynomial}))

    def _derivative_along(self, t: FormTerm, change: PointField) -> FormTerm:
        """Return the derivative of the term along a change of the polynomial."""
        return self._term(t, ufl.derivative(t.form, self.applied.polynomial, change))

    def _term(self, t: FormTerm, form: ufl.Form) -> FormTerm:
        """Return a form as a term with the name and the amplitude of another term."""
        return FormTerm(t.name, form, self.u, self.log, t.amplitude)


def field_parameters(
    fields: Sequence[AppliedField], terms: Sequence[Term], u: fem.Function, log: KernelLog
) -> dict[str, FreeParameter]:
    """Return the amplitudes of moving fields as free parameters, by name; collective.

    A `FreeParameter` holds the amplitude, the terms dPi/dmu and a function to second derivatives.
    Only `terms` whose forms contain the polynomial of the field depend on it. The residuals of the
    derivatives are compiled here.
    """
    parameters = {}
    for field in fields:
        terms_of_field = [
            t
            for t in terms
            if isinstance(t, FormTerm) and field.polynomial in t.form.coefficients()
        ]
        for name in field.names:
            p = FieldAmplitude(field, name, terms_of_field, u, log)
            slopes = p.slopes()
            for slope in slopes:
                slope.compile_residual()
            parameters[name] = FreeParameter(p, slopes, p.second_derivatives)
    return parameters
