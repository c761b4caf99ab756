"""An applied flux density that is known by its values: its Taylor polynomial at the present place
of each point.

The polynomial of second order has the first and second derivatives of the field itself, and so have
the energies that take it: the forms and kernels are the same for every field. A shell that has
passed through a magnet between two states is noticed, however thin that is. The amplitudes of
fields that are driven are free parameters of a system.
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
from magshell_fenicsx.models.shell.densities import PAIRS, SIZE
from magshell_fenicsx.models.shell.patterns import refuse_unbounded
from magshell_fenicsx.parts.magnetism.moving_source import (
    FieldAtPlaces,
    FieldInSpace,
    MovingField,
    combined_motion,
)

Array = NDArray[np.float64]
HALVINGS = 16  # of a way, whose parts are then shorter than rounding in the places of a path


def crossing(distance: Callable[[Array], Array], before: Array, after: Array) -> Array | None:
    """A place (3,) inside a body on the straight ways from some places (n, 3) to others; None if
    there is none.

    A distance changes by at most the length of a way. So no place of a way is inside if the
    distances at both ends add up to more than its length; the other ways are halved.
    """
    low, high = distance(before), distance(after)
    for _ in range(HALVINGS):
        near = low + high <= np.linalg.norm(after - before, axis=1)
        if not near.any():
            return None
        before, after, low, high = (values[near] for values in (before, after, low, high))
        middle = (before + after) / 2
        between = distance(middle)
        if (between < 0).any():
            return np.asarray(middle[between.argmin()])
        before, after = np.concatenate([before, middle]), np.concatenate([middle, after])
        low, high = np.concatenate([low, between]), np.concatenate([between, high])
    return None


class AppliedField:
    """The polynomials of a field at the quadrature points of a shell, a meridian or a body.

    Parameters
    ----------
    of
        The field that no amplitude drives.
    r0, u
        Placement and displacement in one space; on a meridian along e_rho and e_z.
    degree
        Of the quadrature.
    driven
        The fields that amplitudes drive, which are added.

    Raises
    ------
    MeshError
        On every rank, if the field has no finite value or derivative on the undeformed surface.

    Attributes
    ----------
    polynomial
        The parameter of the densities.
    mu
        The amplitudes of the driven fields.
    lost
        Where the field was not finite, since a walk began and emptied this.
    """

    def __init__(
        self,
        of: FieldInSpace,
        r0: fem.Function,
        u: fem.Function,
        degree: int,
        driven: Sequence[MovingField] = (),
    ) -> None:
        V = u.function_space
        self._degree = degree
        self.polynomial = PointField(V.mesh, degree, SIZE)
        self._of, self._driven, self._u = of, driven, u
        self.mu = {name: 0.0 for each in driven for name in each.names}
        self.lost = ""
        self._here: list[FieldAtPlaces] = []
        points = self.polynomial.points
        self._r0 = Memo(lambda: at_quadrature(r0, points), lambda: (r0.x.array,))
        self._moved = Memo(lambda: at_quadrature(u, points), lambda: (u.x.array,))
        self._still = Memo(lambda: of(self.places), lambda: (r0.x.array, u.x.array))
        places = self._r0.renew()
        B, G, H = self._sum(of(places.reshape(-1, 3)), places.reshape(-1, 3))
        differentiable = np.isfinite(G).all(axis=(1, 2)) & np.isfinite(H).all(axis=(1, 2, 3))
        self._B0 = np.where(np.reshape(differentiable, (-1, 1)), B, np.nan).reshape(places.shape)
        refuse_unbounded(self._B0, places, V.mesh.comm, "magnetic.applied")
        self.polynomial.compute_by(
            self._polynomials, lambda: (r0.x.array, u.x.array, *self.mu.values())
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The amplitudes of the driven fields."""
        return tuple(self.mu)

    def _polynomials(self) -> Array:
        u, x = self._moved.renew(), self.places
        B, G, H = self._sum(self._still.renew(), x)
        bad = ~np.isfinite(B).all(axis=1)
        self.lost = self._where(x[bad][0]) if bad.any() else self.lost
        second = H[:, :, *PAIRS] * np.where(PAIRS[0] == PAIRS[1], 0.5, 1.0)
        flat = [a.reshape(*u.shape[:2], -1) for a in (u, self._B0, B, G, second)]
        return np.concatenate(flat, axis=-1)

    def slope(self, name: str, other: str = "", *, moved: bool = True) -> PointField:
        """The polynomials of dB/dmu, or the values of d2B/dmu_i dmu_j, by driven amplitudes.

        Parameters
        ----------
        moved
            Whether they are about the present places; else they are changes of the polynomials
            there.
        """
        field = PointField(self._u.function_space.mesh, self._degree, SIZE)
        field.compute_by(
            lambda: self._slopes(name, other, moved=moved), lambda: (self.polynomial.renew(),)
        )
        return field

    def _slopes(self, name: str, other: str, *, moved: bool) -> Array:
        values = np.zeros_like(self.polynomial.values)
        values[..., :3] = self.polynomial.values[..., :3] if moved else 0.0
        shape = values.shape[:2]
        for curve in self._here:
            if name in curve.driven.names and (not other or other in curve.driven.names):
                B, G = (curve.twice(name, other), None) if other else curve.by(name)
                values[..., 6:9] += B.reshape(*shape, 3)
                if G is not None:
                    values[..., 9:18] += G.reshape(*shape, 9)
        return values

    @property
    def places(self) -> Array:
        """The present places (n, 3) of the quadrature points."""
        return (self._r0.renew() + self._moved.renew()).reshape(-1, 3)

    def passed(
        self, before: tuple[Array, Mapping[str, float]], after: tuple[Array, Mapping[str, float]]
    ) -> str:
        """Through what a point has moved between two states, from their places and amplitudes; ""
        if through none.
        """
        still: list[tuple[FieldInSpace, MovingField]] = [
            (part, MovingField(part)) for part in getattr(self._of, "parts", [])
        ]
        for of, driven in [*still, *((each.of, each) for each in self._driven)]:
            if distance := getattr(of, "distance", None):
                ways = [
                    (x - t) @ Q
                    for x, (Q, t) in (
                        (x, combined_motion(driven.motions, mu)) for x, mu in (before, after)
                    )
                ]
                if crossing(distance, *ways) is not None:
                    said = getattr(of, "nowhere", "is inside a source")
                    return f"a point of the shell {said} between two points of the path"
        return ""

    def _sum(self, still: tuple[Array, Array, Array], x: Array) -> tuple[Array, Array, Array]:
        """B, G and H of the field that no amplitude drives and of those that are driven, at
        places."""
        self._here = [each.at(x, self.mu) for each in self._driven]
        parts = [still, *(curve.value for curve in self._here)]
        B, G, H = (np.sum(part, axis=0) for part in zip(*parts, strict=True))
        return B, G, H

    def _where(self, x: Array) -> str:
        """What a place (3,) without a finite field is."""
        still = [(part, part(x[None])[0]) for part in getattr(self._of, "parts", [self._of])]
        for of, B in [*still, *((each.of, each.at(x[None], self.mu).B) for each in self._driven)]:
            if not np.isfinite(B).all():
                said = getattr(of, "nowhere", "is where magnetic.applied has no finite value")
                return (
                    f"the shell's point (x, y, z)/R = ({x[0]:.3g}, {x[1]:.3g}, {x[2]:.3g}) {said}"
                )
        return ""


@dataclass(eq=False)
class Amplitude:
    """The value of an amplitude in a field, which takes the place of a constant in a form.

    Attributes
    ----------
    terms
        The energies of the field. Those with an amplitude are linear in it, as in the field; what
        is soft is quadratic.
    """

    known: AppliedField
    name: str
    terms: Sequence[FormTerm]
    u: fem.Function
    log: KernelLog

    @property
    def value(self) -> float:
        return self.known.mu[self.name]

    @value.setter
    def value(self, value: float) -> None:
        self.known.mu[self.name] = float(value)

    def slopes(self) -> list[FormTerm]:
        """dPi/dmu: of what is linear in the field the energy in dB/dmu."""
        linear = [self._instead(t, self.known.slope(self.name)) for t in self._linear]
        return linear + [
            self._along(t, self.known.slope(self.name, moved=False)) for t in self._quadratic
        ]

    def second_derivatives(self, q: Any) -> Sequence[Derivative]:
        """d2Pi/dmu dq by a value of a field, a constant of the terms, or what has a method of its
        own.
        """
        if not isinstance(q, Amplitude):
            if hasattr(q, "second_derivatives"):
                derivatives: Sequence[Derivative] = q.second_derivatives(self)
                return derivatives
            entered = [t for t in self.slopes() if q in t.form.constants()]
            return [self._term(t, derived(t.form, q)) for t in entered]
        if q.known is not self.known:
            return []
        linear = [self._instead(t, self.known.slope(self.name, q.name)) for t in self._linear]
        both, one, other = (
            self.known.slope(*names, moved=False)
            for names in ((self.name, q.name), (self.name,), (q.name,))
        )
        by_both = [self._along(t, both) for t in self._quadratic]
        return linear + by_both + [self._along(self._along(t, one), other) for t in self._quadratic]

    @property
    def _linear(self) -> list[FormTerm]:
        return [t for t in self.terms if t.amplitude is not None]

    @property
    def _quadratic(self) -> list[FormTerm]:
        return [t for t in self.terms if t.amplitude is None]

    def _instead(self, t: FormTerm, polynomial: PointField) -> FormTerm:
        """The term with another polynomial in place of the field's own."""
        return self._term(t, ufl.replace(t.form, {self.known.polynomial: polynomial}))

    def _along(self, t: FormTerm, change: PointField) -> FormTerm:
        """The derivative of the term along a change of the polynomial."""
        return self._term(t, ufl.derivative(t.form, self.known.polynomial, change))

    def _term(self, t: FormTerm, form: ufl.Form) -> FormTerm:
        return FormTerm(t.name, form, self.u, self.log, t.amplitude)


def field_parameters(
    fields: Sequence[AppliedField], terms: Sequence[Term], u: fem.Function, log: KernelLog
) -> dict[str, FreeParameter]:
    """The amplitudes of driven fields, by name; collective."""
    parameters = {}
    for field in fields:
        own = [
            t
            for t in terms
            if isinstance(t, FormTerm) and field.polynomial in t.form.coefficients()
        ]
        for name in field.names:
            p = Amplitude(field, name, own, u, log)
            slopes = p.slopes()
            for each in slopes:
                each.compile_residual()
            parameters[name] = FreeParameter(p, slopes, p.second_derivatives)
    return parameters
