"""A soft-magnetic shell: its magnetisation follows the field at each place.

Along a thin sheet H is continuous, across it B is. So a sheet of susceptibility chi has the
polarisation mu0 M = chi (B_t + B_n n/(1 + chi)) and, per area, the energy -h M.B/2. Over E h, with
B in units of mu0 E/|Br| (lambda_m is the size of the applied field in them), it is -chi/2 (s B)²
with s = sqrt(mu0 E)/|Br|. A shell without remanence has sqrt(mu0 E) in place of |Br|. The field of
other places of the shell is left out.

With a saturation J the material follows Langevin's law: `saturation.py`.

B_t and B_n are the parts of the applied field B along and across the sheet, n is the present unit
normal, n0 the undeformed one. A solid is taken as a stack of sheets. chi is the susceptibility mu_r
- 1. The material's data, `law` in the densities, are chi or, with a saturation, the coefficients of
two polynomials of the energy in the field: at the displacement u and at u = 0. A field is uniform,
linear in space (with a gradient), or "known by its values": then a Taylor polynomial at each
quadrature point takes its place. An amplitude is a factor of a uniform part of the field.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.memo import PointField
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.densities import field_at_displacement
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.parts.magnetism import saturation

if TYPE_CHECKING:
    from magshell_fenicsx.models.shell.spatial_fields import Pattern
    from magshell_fenicsx.parts.magnetism.applied import AppliedField
    from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation

Array = NDArray[np.float64]
TERM = "soft magnetism"


@dataclass(frozen=True)
class SoftMagnet:
    """Soft-magnetic material of a shell.

    Attributes
    ----------
    susceptibility
        A number mu_r - 1, or a pattern: a function of undeformed places and normals to numbers
        (cells, nodes, 1).
    scale
        sqrt(mu0 E)/|Br|; 1 without remanence.
    tesla
        The flux density of lambda_m = 1 in T; 1 if the case has no flux densities.
    alone
        Whether nothing is remanent.
    patches
        Patch of a mesh -> number (1,), in place of `susceptibility`.
    saturation
        The largest polarisation in the unit of lambda_m; None if it grows in proportion.
    """

    susceptibility: "float | Pattern"
    scale: float = 1.0
    tesla: float = 1.0
    alone: bool = True
    patches: Mapping[str, Array] | None = None
    saturation: float | None = None

    def with_patches(self, pattern_of: "Callable[[Mapping[str, Array]], Pattern]") -> "SoftMagnet":
        """Return the same material with a pattern in place of patches.

        `pattern_of` makes a pattern of the numbers of patches.
        """
        return (
            replace(self, susceptibility=pattern_of(self.patches), patches=None)
            if self.patches
            else self
        )

    def susceptibility_at(self, r0: Array, n0: Array) -> Array:
        """Return the susceptibility (...) at undeformed places and normals (..., 3)."""
        chi = self.susceptibility
        return np.asarray(chi(r0, n0)[..., 0] if callable(chi) else np.full(r0.shape[:-1], chi))

    def polarisation(self, r0: Array, n0: Array, n: Array, B: Array) -> Array:
        """Return the induced polarisation mu0 M (..., 3), in the unit of B.

        Parameters
        ----------
        r0, n0
            Undeformed places and normals (..., 3), at which the susceptibility is taken.
        n
            Present normals (..., 3).
        B
            Applied field (..., 3).
        """
        chi = self.susceptibility_at(r0, n0)[..., None]
        normal_field = np.sum(n * B, axis=-1, keepdims=True)
        if self.saturation is None:
            return np.asarray(chi * (B - chi / (1 + chi) * normal_field * n))
        return saturation.polarisation(chi, B - normal_field * n, normal_field, n, self.saturation)


@dataclass(frozen=True)
class Sheet:
    """Densities of a soft-magnetic shell or solid in the applied field.

    They are functions of the jets (value and derivatives) r0 and u of placement and displacement,
    or of place X, displacement u and gradient H in a solid. Then they take parameters in this
    order: the susceptibility chi (or the magnetisation state), the scale s, and an amplitude for
    each uniform part of the field. Then follow these parts, and perhaps the gradient, or the
    polynomial of a field known by its values.

    Attributes
    ----------
    field
        The magnetisation with its soft material and the applied field.
    """

    field: "Magnetisation"

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Names of the amplitudes of the field's uniform parts, along its first direction first."""
        return tuple(part.amplitude for part in self.field.uniform_parts)

    @property
    def vectors(self) -> list[Array]:
        """The uniform parts of the field and its gradient; none of a field known by its values."""
        field = self.field
        if field.in_space:
            return []
        return [field.applied, *field.across, *([] if field.gradient is None else [field.gradient])]

    def fields(self, x0: Expr, u: Expr, given: Sequence[Expr]) -> tuple[Expr, Expr]:
        """Return the applied field at the displacement u and at u = 0, as vectors of UFL.

        `given` are the amplitudes, then the field's vectors or its polynomial. `x0` and `u` are
        undeformed place and displacement, over R.
        """
        count = len(self.amplitudes)
        amplitudes, vectors = given[:count], given[count:]
        if self.field.in_space:
            B, change_from_rest = field_at_displacement(vectors[0], u)
            return amplitudes[0] * B, amplitudes[0] * (B - change_from_rest)
        B = sum(
            (amplitude * part for amplitude, part in zip(amplitudes, vectors, strict=False)),
            ufl.zero(3),
        )
        if self.field.gradient is None:
            return B, B
        # the gradient, last among the vectors, has the amplitude lambda_m
        G = amplitudes[0] * vectors[-1]
        return B + ufl.dot(G, x0 + u), B + ufl.dot(G, x0)

    def saturated(
        self,
        chi: fem.Constant | fem.Function,
        amplitudes: Sequence[fem.Constant],
        applied: "AppliedField | None",
        field: PointField,
        followed: Sequence[fem.Function],
        places_and_normals: Callable[[], Sequence[Array]],
    ) -> PointField:
        """Let `field` follow the polynomials of the energy at u and at u = 0, and return it.

        They are Taylor polynomials in the applied field, by Langevin's law, at each point.

        Parameters
        ----------
        chi
            Susceptibility.
        amplitudes
            Constants of `amplitudes`.
        applied
            A field known by its values; None for a uniform or linear one.
        followed
            Placement and displacement.
        places_and_normals
            Function that gives x0, u, n and n0 (cells, points, 3) at the points of `field`.
        """
        assert self.saturation is not None

        def fields_and_normals() -> list[tuple[Array, Array]]:
            """Return field and normal at u, then at u = 0."""
            x0, u, n, n0 = places_and_normals()
            values = applied.polynomial.values if applied else None
            return list(
                zip(self._fields_at_points(amplitudes, values, x0, u), (n, n0), strict=True)
            )

        def inputs() -> tuple[Any, ...]:
            """Return all values on which the polynomials depend."""
            renewed = [applied.polynomial.renew()] if applied else []
            return *(f.x.array for f in followed), *(a.value for a in amplitudes), *renewed

        return saturation.point_field(field, chi, self.saturation, fields_and_normals, inputs)

    def _fields_at_points(
        self, amplitudes: Sequence[fem.Constant], polynomials: Array | None, x0: Array, u: Array
    ) -> list[Array]:
        """Return the values (cells, points, 3) of the applied field at u and at u = 0, at points.

        `x0` and `u` are undeformed places and displacements there. `polynomials` are those of a
        field known by its values, else None.
        """
        amplitude_values = [float(amplitude.value) for amplitude in amplitudes]
        if polynomials is not None:
            # components 3 to 5 are B at u = 0, 6 to 8 B at u
            return [
                amplitude_values[0] * polynomials[..., 6:9],
                amplitude_values[0] * polynomials[..., 3:6],
            ]
        vectors = [self.field.applied, *self.field.across]
        B = sum(
            (
                amplitude_value * vector
                for amplitude_value, vector in zip(amplitude_values, vectors, strict=True)
            ),
            np.zeros(3),
        )
        G = (
            np.zeros((3, 3))
            if self.field.gradient is None
            else amplitude_values[0] * self.field.gradient
        )
        return [B + x @ G.T for x in (x0 + u, x0)]

    def energy_per_area(self, r0: Jet, u: Jet, law: Expr, s: Expr, *given: Expr) -> Expr:
        """Return the energy over E h per area of a shell, less that at u = 0 in the same field.

        `law` is the susceptibility or, of a saturating material, its polynomials at u and at u = 0.
        `s` is the scale. `given` are the amplitudes, then the field's vectors or its polynomial.
        """
        (B, B0), (present, at_first) = self.fields(r0.r, u.r, given), self._halves(law)
        return s**2 * (
            self.energy_in_field(present, B, kin.normal(r0 + u))
            - self.energy_in_field(at_first, B0, kin.normal(r0))
        )

    def induced(self, r0: Jet, u: Jet, law: Expr, e: Expr, *given: Expr) -> Expr:
        """Return the polarisation along a vector e, in the unit of lambda_m.

        `law` is the susceptibility or the polynomials of the material. `given` are the amplitudes,
        then the field's vectors or its polynomial.
        """
        B, _ = self.fields(r0.r, u.r, given)
        present, _ = self._halves(law)
        return ufl.dot(e, self.polarisation(present, B, kin.normal(r0 + u)))

    def energy_in_solid(
        self, X: Expr, u: Expr, H: Expr, law: Expr, s: Expr, n0: Expr, h: Expr, *given: Expr
    ) -> Expr:
        """Return the energy per volume in a solid, in E h R², less its value at u = 0.

        Layers of the solid are sheets, with the undeformed normal n0. H is du/dX, h the thickness
        over R, s the scale. `law` is the susceptibility or the polynomials of the material. `given`
        are the amplitudes, then the field's vectors or its polynomial.
        """
        (B, B0), (present, at_first) = self.fields(X, u, given), self._halves(law)
        return (
            s**2
            * (
                self.energy_in_field(present, B, deformed_normal(H, n0))
                - self.energy_in_field(at_first, B0, n0)
            )
            / h
        )

    def induced_in_solid(
        self, X: Expr, u: Expr, H: Expr, law: Expr, e: Expr, n0: Expr, *given: Expr
    ) -> Expr:
        """Return the polarisation along a vector e in a solid, in the unit of lambda_m.

        X, u and H = du/dX are place, displacement and its gradient, n0 is the undeformed normal of
        the layer. `law` and `given` are the material and the field, as for the energy.
        """
        B, _ = self.fields(X, u, given)
        present, _ = self._halves(law)
        return ufl.dot(e, self.polarisation(present, B, deformed_normal(H, n0)))

    def polarisation(self, law: Any, B: Expr, n: Expr) -> Expr:
        """Return mu0 M; of a linear material it is chi (B_t + B_n n/(1 + chi))."""
        normal = ufl.dot(B, n)
        if self.saturation is not None:
            return saturation.induced(law, B, normal, n)
        return law * (B - law / (1 + law) * normal * n)

    def energy_in_field(self, law: Any, B: Expr, n: Expr) -> Expr:
        """Return the energy over E h and s²; of a linear material it is -mu0 M.B/2."""
        if self.saturation is None:
            return -ufl.dot(B, self.polarisation(law, B, n)) / 2
        normal = ufl.dot(B, n) ** 2
        return saturation.energy(law, normal, ufl.dot(B, B) - normal)

    def _halves(self, law: Expr) -> tuple[Any, Any]:
        """Return the material's data at u and at u = 0: susceptibilities or polynomials.

        A susceptibility is the same at both.
        """
        if self.saturation is None:
            chi = law[0] if law.ufl_shape else law  # a field (1,), or a constant
            return chi, chi
        size = saturation.SIZE
        return [law[i] for i in range(size)], [law[size + i] for i in range(size)]

    @property
    def saturation(self) -> float | None:
        """The largest polarisation of the material; None without saturation."""
        return self.field.soft.saturation if self.field.soft else None


def deformed_normal(H: Expr, n0: Expr) -> Expr:
    """Return the deformed unit normal of a layer of a solid: cof F n0 over its length.

    F = 1 + H, with H = du/dX, and n0 is the undeformed normal.
    """
    F = ufl.Identity(3) + H
    f = [F[:, i] for i in range(3)]
    cofactor = ufl.as_tensor(
        [ufl.cross(f[1], f[2]), ufl.cross(f[2], f[0]), ufl.cross(f[0], f[1])]
    ).T
    n = ufl.dot(cofactor, n0)
    return n / ufl.sqrt(ufl.dot(n, n))
