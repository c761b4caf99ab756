"""Fields at the points of a surface: strains, stresses, magnetic loads, gaps to bodies.

Input: jets of the placement and the displacement at points (cells, points per cell). Output: arrays
by name, as `surface.Surface` has them. The theory is in docs/theory.md.

- A jet is a map with its first and second derivatives by coordinates at points.
- h and R are thickness and reference length; lengths are over R.
- Br and Ba are remanence and applied flux density, mu the amplitudes (load parameters) of a state.
  The strength of the field is |Br||Ba|/(mu_0 E).
- A field acts on a thin shell by a pressure p_mag, an in-plane force f_mag, rotational springs k
  and a torque tau. B0 = -Br (x) Ba is their tensor.
- The remanence law is "deformation" (Br is convected) or "rotation" (Br turns and does not
  stretch).
- The arrays E and M are the components 11, 12, 22 of membrane strain and bending moment; in a unit
  such as h E, E is Young's modulus, and D is the bending stiffness.
- a0_a is the tangent basis of the undeformed surface, a0^a its dual basis, n0 its normal, b0 its
  curvature.
- The natural shape is the one that the shell would have without stress; its growth is given by two
  amplitudes, `CURVATURE` and `STRETCH`.
- A material thins if its thickness follows from its area, as that of rubber. Soft material has a
  polarisation that the field induces; it may have a remanence too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.law import Law
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.shell.spatial_fields import inside_cells
from magshell_fenicsx.models.shell.strains import NaturalFrame, TangentFrame, principal
from magshell_fenicsx.parts.bodies.body_contact import ContactBody
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.natural.shape import CURVATURE, STRETCH, Natural
from magshell_fenicsx.parts.stress import von_mises
from magshell_fenicsx.quantities.stresses import LAYERS

Array = NDArray[np.float64]


def magnetic_loads(
    g: "SurfaceGeometry", field: Magnetisation, r0: Array, h: float | Array
) -> tuple[dict[str, Array], "Torque"]:
    """Return the magnetic loads p_mag, k and f_mag, and the torque of the displacement.

    Br and Ba are of unit length: p_mag and f_mag are over E, k and the torque over h E, times the
    field's strength. f_mag is there only if the remanence and the thickness are uniform. The
    formulas are in docs/theory.md.

    Parameters
    ----------
    g
        Bases, normal and curvature at the points.
    field
        The magnetisation and the applied field.
    r0
        (..., 3) places of the points.
    h
        Thickness over R; an array (...) if it varies.

    Returns
    -------
    loads
        Name -> (...) p_mag and k, and (..., 3) f_mag.
    torque
        Function of the displacement's derivatives u,_1 and u,_2, (..., 2, 3), which returns the
        torque (..., 3).
    """
    pattern = field.remanent  # a vector, or a function of places and normals
    Br = pattern(r0, g.n0) if callable(pattern) else np.broadcast_to(pattern, r0.shape)
    Ba = field.applied
    # first for a convected remanence, then changed for one that rotates
    rotates = field.law == "rotation"
    loads = {"p_mag": magnetic_pressure(g, Br, Ba, h), "k": spring_stiffness(g, Br, Ba)}
    if rotates:
        # to first order only the antisymmetric part of B0 does work: its product with the symmetric
        # b0 is zero
        loads = {"p_mag": 0 * loads["p_mag"], "k": loads["k"] - (Br @ Ba + loads["k"]) / 2}
    if not callable(pattern) and isinstance(h, float):
        # the formula of f_mag assumes uniform vectors and thickness
        loads["f_mag"] = in_plane_force(g, Br, Ba, h)
        if rotates:
            # the antisymmetric part: the transpose of B0 has Br and Ba exchanged
            of_transpose = in_plane_force(g, Br=Ba, Ba=pattern, h=h)
            loads["f_mag"] = (loads["f_mag"] - of_transpose) / 2
    return loads, torque(g, Br, Ba, rotates=rotates)


@dataclass(frozen=True)
class SurfaceGeometry:
    """Undeformed geometry of a surface at points.

    Attributes
    ----------
    a
        (..., 2, 3) tangent basis a1, a2.
    n0
        (..., 3) unit normal.
    b0
        (..., 2, 2) curvature b0_ij = r0,_ij . n0.
    """

    a: Array
    n0: Array
    b0: Array

    @property
    def dual(self) -> Array:
        """Dual basis a0^1, a0^2, (..., 2, 3)."""
        metric = np.einsum("...ai,...bi->...ab", self.a, self.a)
        return np.asarray(np.einsum("...ab,...bi->...ai", np.linalg.inv(metric), self.a))


def magnetic_pressure(g: SurfaceGeometry, Br: Array, Ba: Array, h: float | Array) -> Array:
    """Return the magnetic pressure p_mag = h b0:B0 (...), with B0 = -Br (x) Ba.

    Br (..., 3) and Ba (3,) are remanence and applied field; h is the thickness over R.
    """
    b = np.einsum("...ab,...ai,...bj->...ij", g.b0, g.dual, g.dual)
    return np.asarray(-h * np.einsum("...ij,...i,j->...", b, Br, Ba))


def in_plane_force(g: SurfaceGeometry, Br: Array, Ba: Array, h: float) -> Array:
    """Return the in-plane force f_mag (..., 3) of uniform Br and Ba, as a vector.

    Its covariant component f_c is -h times the surface divergence of -(a_c . Ba)(a^a . Br). For
    constant vectors this equals h [b_ca (n . Ba)(a^a . Br) + tr b (n . Br)(a_c . Ba)].
    """
    dual = g.dual
    tangential_Br = np.einsum("...ai,...i->...a", dual, Br)  # a^a . Br
    normal_Ba = np.einsum("...i,i->...", g.n0, Ba)  # n . Ba
    trace = np.einsum("...ab,...ai,...bi->...", g.b0, dual, dual)  # tr b
    covariant = np.einsum("...ca,...a->...c", g.b0, tangential_Br) * normal_Ba[..., None]
    normal_Br = np.einsum("...i,...i->...", g.n0, Br)  # n . Br
    tangential_Ba = np.einsum("...ci,i->...c", g.a, Ba)  # a_c . Ba
    covariant += (trace * normal_Br)[..., None] * tangential_Ba
    return np.asarray(h * np.einsum("...c,...ci->...i", covariant, dual))


def spring_stiffness(g: SurfaceGeometry, Br: Array, Ba: Array) -> Array:
    """Return the stiffness of rotational springs k = (n0 (x) n0):B0 (...), with B0 = -Br (x) Ba."""
    return np.asarray(-np.einsum("...i,...i->...", g.n0, Br) * np.einsum("...i,i->...", g.n0, Ba))


@dataclass(frozen=True)
class Torque:
    """Magnetic torque tau at points, as a function of the derivatives of the displacement.

    Attributes
    ----------
    n0
        (..., 3) normals.
    coefficients
        (..., 2) the factors of u,_a: -(n0 . Br)(a0^a . Ba). For a remanence that does not stretch,
        half of (n0 . Ba)(a0^a . Br) is added.
    dual, transposed
        Only for a remanence that does not stretch, which has one more term, of the transposed B0:
        the dual basis (..., 2, 3), and half of (n0 . Ba) times the tangential part of Br, (..., 3).
        Else None.
    """

    n0: Array
    coefficients: Array
    dual: Array | None = None
    transposed: Array | None = None

    def __call__(self, du: Array) -> Array:
        """Return tau_c = B0^ij (a0^a . e_j)(n0 . e_i) (u,_a . a0_c) as a vector (..., 3).

        `du` are the derivatives u,_1 and u,_2 (..., 2, 3).
        """
        # the sum of coefficients times u,_a, of which the part along n0 is left out
        weighted_du = np.matmul(self.coefficients[..., None, :], du)[..., 0, :]
        torque = weighted_du - np.sum(weighted_du * self.n0, axis=-1, keepdims=True) * self.n0
        if self.dual is not None and self.transposed is not None:
            torque = torque + np.einsum("...ac,...c,...ai->...i", du, self.transposed, self.dual)
        return np.asarray(torque)


def torque(g: SurfaceGeometry, Br: Array, Ba: Array, *, rotates: bool = False) -> Torque:
    """Return the magnetic torque tau as a function of the displacement's derivatives.

    The remanence rotates with the surface if `rotates`; otherwise it is convected.
    """
    normal_Br = np.einsum("...i,...i->...", g.n0, Br)[..., None]
    coefficients = -normal_Br * np.einsum("...ai,i->...a", g.dual, Ba)
    if not rotates:
        return Torque(g.n0, coefficients)
    # a remanence that does not stretch has further terms
    in_surface = Br - normal_Br * g.n0
    half_normal_Ba = (g.n0 @ Ba / 2)[..., None]
    coefficients = coefficients + half_normal_Ba * np.einsum("...ai,...i->...a", g.dual, Br)
    return Torque(g.n0, coefficients, g.dual, half_normal_Ba * in_surface)


def principal_fields(components: Mapping[str, Array]) -> dict[str, Array]:
    """Return E_1, E_2, M_1, M_2 (...): the principal values of E and M, the larger first.

    `components` maps "E" and "M" to components 11, 12 and 22 (..., 3) in an orthonormal frame.
    """
    return {
        f"{name}_{number}": values
        for name in ("E", "M")
        for number, values in enumerate(principal(components[name]), 1)
    }


def mises_fields(fields: Mapping[str, Array]) -> dict[str, Array]:
    """Return von Mises' stress (...) of the faces and the middle, of those that there are.

    `fields` maps names such as "stress_top" to tensors of plane stress in space (..., 3, 3).
    """
    stresses = {layer: fields.get(f"stress_{layer}") for layer in LAYERS}
    return {f"mises_{layer}": von_mises(S) for layer, S in stresses.items() if S is not None}


def rubber_fields(fields: Mapping[str, Array], law: Law) -> dict[str, Array]:
    """Return stretches and true stresses over E of a rubber, whose thickness follows its area.

    Parameters
    ----------
    fields
        E_1 and E_2 (...), the principal strains.
    law
        The law of elasticity; without such a material the result is empty, and values are nan where
        the thickness is constant.

    Returns
    -------
    stretch_1, stretch_2, stretch_3
        In the surface, descending, and of the thickness.
    sigma_1, sigma_2
        Force per deformed area of the middle layer, in the same directions.
    """
    if not law.thins_somewhere:
        return {}
    # in principal axes, where strains and stresses are diagonal
    E = np.stack([fields["E_1"], fields["E_2"]], axis=-1)
    squared_stretch = 1 + 2 * E
    S1, _, S2 = law.stress(E[..., None] * np.eye(2), np.eye(2))  # components 11, 12, 22
    stretches = [
        *np.sqrt(np.moveaxis(squared_stretch, -1, 0)),
        1 / np.sqrt(np.prod(squared_stretch, axis=-1)),  # the volume is constant
    ]
    stretch_fields = {f"stretch_{number}": values for number, values in enumerate(stretches, 1)}
    stretch_fields |= {
        "sigma_1": squared_stretch[..., 0] * S1,
        "sigma_2": squared_stretch[..., 1] * S2,
    }
    return {name: np.where(law.thins, values, np.nan) for name, values in stretch_fields.items()}


def in_space(S: Array, t: Array) -> Array:
    """Return symmetric tensors in space (..., 3, 3) with components 11, 12, 22 (..., 3).

    The frames `t` (..., 2, 3) are orthonormal and tangent to the surface.
    """
    return np.asarray(np.swapaxes(t, -1, -2) @ S[..., [[0, 1], [1, 2]]] @ t)


def in_frame(S: Array, t: Array) -> Array:
    """Return components 11, 12, 22 (..., 3) of symmetric tensors in space (..., 3, 3).

    The frames `t` (..., 2, 3) are orthonormal and tangent to the surface.
    """
    return np.asarray((t @ S @ np.swapaxes(t, -1, -2))[..., [0, 0, 1], [0, 1, 1]])


class PointFields:
    """Magnetic fields and gaps of a shell at points (cells, points per cell).

    Parameters
    ----------
    r0
        (6, cells, points, 3) jet of the placement: r0, r0,_1, r0,_2, r0,_11, r0,_12, r0,_22.
    material
        Material of the shell.
    field
        The magnetisation with its applied field; None without a field.
    thickness
        (cells, points) factor of the thickness h; None for 1.
    contacts
        Rigid bodies in contact with the shell.
    remanence
        The magnetisation of a shell without an applied field; None if it has none.
    natural
        The natural shape. A material that thins has its thickness from the volume of this shape.
    made_of
        (cells, 4) numbers of each cell's material: modulus over that of the first shell, Poisson's
        ratio, density ratio, number of the law. None if all cells have `material`.

    Attributes
    ----------
    constant
        Name -> values (cells, points, ...) of the fields that do not depend on the displacement:
        p_mag, k and f_mag of a uniform applied field.
    n0
        (cells, points, 3) undeformed unit normals.
    weight
        (cells, points) area: the weight of a cell in the mean over the cells that share a point.
    Br
        (cells, points, 3) undeformed remanence over its largest magnitude; (cells, points, 0)
        without one.
    susceptibility
        (cells, points, 1) magnetic susceptibility; (cells, points, 0) without soft material.

    The field `_field` has the applied field. `_magnetisation` has the remanence, with or without an
    applied field; it is None if the material is soft alone. `_frame` are the tangent frames at the
    points. `_thins` (1 or 0) tells where the material thins. `_natural` are the tensors of the
    natural shape, None where no gap depends on them. `_torque` is a function of the displacement's
    derivatives, None without a uniform field.
    """

    def __init__(
        self,
        r0: Array,
        material: Material,
        field: Magnetisation | None,
        thickness: Array | None,
        contacts: Sequence[ContactBody] = (),
        remanence: Magnetisation | None = None,
        natural: Natural | None = None,
        made_of: Array | None = None,
    ) -> None:
        """Set the constant fields, and what fields of a displacement need.

        Formulas are evaluated slightly inside cells, so that one that jumps has both its values.
        """
        self._contacts, self._h, self._thins = contacts, material.h, material.law_in(made_of).thins
        self._frame, self._field, self._thickness = TangentFrame.from_jet(r0), field, thickness
        needs_natural_thickness = bool(contacts) and np.any(self._thins)
        self._natural = (
            natural.tensors_at(r0[0], self._frame.n0)
            if natural and needs_natural_thickness
            else None
        )
        self.n0, self.weight = self._frame.n0, self._frame.area
        # soft material, with or without remanence
        soft = field.soft if field else None
        self.susceptibility = np.zeros((*r0.shape[1:-1], 0))
        if soft:
            susceptibility = soft.susceptibility_at(inside_cells(r0[0]), self.n0)
            self.susceptibility = susceptibility[..., None]
        has_no_remanence = bool(soft and soft.alone)
        # remanence
        self._magnetisation = None if has_no_remanence else field or remanence
        self.Br = np.zeros((*r0.shape[1:-1], 0))
        if self._magnetisation:
            pattern = self._magnetisation.remanent
            self.Br = (
                pattern(inside_cells(r0[0]), self.n0)
                if callable(pattern)
                else np.broadcast_to(pattern, r0[0].shape)
            )
        # loads on the remanence, which are derived for a uniform field
        self.constant: dict[str, Array] = {}
        self._torque: Torque | None = None
        field_at_remanence = None if has_no_remanence else field
        if field_at_remanence and field_at_remanence.uniform:
            h = material.h if thickness is None else material.h * thickness
            self.constant, self._torque = magnetic_loads(
                self._geometry(), field_at_remanence, inside_cells(r0[0]), h
            )

    @property
    def jet(self) -> Array:
        """Jet (6, cells, points, 3) of the placement."""
        return self._frame.jet

    def values_of(self, u: Array, mu: Mapping[str, float]) -> dict[str, Array]:
        """Return the fields of a displacement at the points.

        Parameters
        ----------
        u
            (3 or 6, cells, points, 3) jet of the displacement over R.
        mu
            Amplitudes of the state.

        Returns
        -------
        Br, Ba
            (..., 3) the remanence as the shell carries it, over its magnitude; the applied flux
            density at the deformed point, over mu_0 E / |Br|, so that its magnitude is its
            strength.
        J
            (..., 3) the polarisation mu_0 M that the field induces in soft magnetic material, in
            the same unit.
        tau
            (..., 3) torque, for a uniform field.
        gap_over_h
            (...) the least gap to a body.
        """
        frame, fields = self._frame, dict[str, Array]()
        if self._magnetisation:
            is_convected = self._magnetisation.law == "deformation"
            fields["Br"] = (
                frame.convected(self.Br, u, thins=self._thins)
                if is_convected
                else frame.rotated(self.Br, u)
            )
        if self._field:
            fields["Ba"] = self._field.field_at(mu, frame.jet[0] + u[0])
        if self._field and self._field.soft:
            # the vector product of the deformed tangents, and its direction
            area_vector = np.cross(frame.jet[1] + u[1], frame.jet[2] + u[2])
            area = np.linalg.norm(area_vector, axis=-1, keepdims=True)
            deformed_normal = area_vector / area
            fields["J"] = self._field.soft.polarisation(
                inside_cells(frame.jet[0]), self.n0, deformed_normal, fields["Ba"]
            )
        if self._torque:
            fields["tau"] = self._torque(np.moveaxis(u[1:3], 0, -2))
        if self._contacts:
            fields["gap_over_h"] = self._gap(u, mu)
        return fields

    def _thinned(self, u: Array, mu: Mapping[str, float]) -> Array:
        """Return the deformed thickness over the undeformed one (cells, points).

        It is 1 where the thickness is constant. `u` (3 or 6, cells, points, 3) is the jet of the
        displacement, `mu` has the amplitudes of the state.
        """
        area = np.linalg.norm(np.cross(*(self._frame.jet[1:3] + u[1:3])), axis=-1)
        # of constant volume: the thickness grows as the area shrinks
        stretch = self._frame.area / area
        if self._natural is not None:
            shape = NaturalFrame.from_tensors(
                self._frame,
                *self._natural,
                bent=mu.get(CURVATURE, 0.0),
                stretched=mu.get(STRETCH, 0.0),
            )
            # the volume is that of the natural shape, whose area and thickness are other ones
            stretch = stretch * shape.thickness / np.linalg.det(shape.inverse)
        return np.asarray(1 + self._thins * (stretch - 1))

    def _gap(self, u: Array, mu: Mapping[str, float]) -> Array:
        """Return the least gap to a body over h (cells, points); negative where they overlap.

        `u` (3 or 6, cells, points, 3) is the jet of the displacement, `mu` has the amplitudes of
        the state.
        """
        h, r = self._h, self._frame.jet[0] + u[0]
        thickness = 1.0 if self._thickness is None else self._thickness
        thickness = thickness * (self._thinned(u, mu) if np.any(self._thins) else 1.0)
        thickness = np.broadcast_to(thickness, r.shape[:-1]).ravel()
        gaps, places = list[Array](), r.reshape(-1, 3)
        for contact in self._contacts:
            # the amplitude is the body's approach over h; gradient and Hessian are not needed
            approach = h * mu.get(contact.amplitude, 0.0)
            gap, *_ = contact.gap(places, approach, half=h / 2 * thickness)
            gaps.append(gap)
        return np.asarray(np.min(gaps, axis=0) / h).reshape(r.shape[:-1])

    def _geometry(self) -> SurfaceGeometry:
        """Return tangent bases, normals and curvature of the undeformed surface at the points."""
        r0 = self._frame.jet
        b11, b12, b22 = np.einsum("d...i,...i->d...", r0[3:], self.n0)
        b0 = np.stack([np.stack([b11, b12], -1), np.stack([b12, b22], -1)], -2)
        return SurfaceGeometry(np.moveaxis(r0[1:3], 0, -2), self.n0, b0)
