"""A magnetised shell at points of its cells: places, normals, remanence, and their derivatives.

Coordinates (a, b) in [0, 1]² are the same for both kinds of cells. A triangle is the square with
one side drawn together into a corner; a cell of a meridian is swept around the axis. Lengths are
over R, remanences over a magnitude of their own. Theory: docs/theory.md, the field of a magnetised
shell.

- Jets (`SurfaceJets`) are values with derivatives by a and b: six for places (value, two first and
  three second derivatives), three for other fields. Arrays (d, n, m, ...) have derivative d at m
  points in each of n cells.
- r0 and r are undeformed and deformed places of the mid-surface, u is the displacement, n0 and n
  are unit normals, t is the thickness, B the remanence in the undeformed shell.
- eta is the height over the mid-surface, over the thickness: from -1/2 to 1/2.
- A swept cell is an interval of a meridian; b is its azimuth over a full turn. Its nodal values
  have components along e_rho and e_z, for places, or along three directions, for the remanence.
- J is any number that depends on the shell, as the field at a place; `NodalDerivatives` collect
  its derivatives by nodal values.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
COMPLEX_STEP = 1e-30  # imaginary change for derivatives that are exact to rounding


@dataclass
class NodalDerivatives:
    """Derivatives of a number by values at the nodes of cells.

    Attributes
    ----------
    by_u, by_remanence
        (cells, nodes, 3) by the displacement and by the remanence.
    by_place
        (cells, nodes, 3) by the undeformed place; None if nobody asks for it.
    by_thickness
        (cells, nodes) by the factor of the thickness; None if nobody asks for it.
    """

    by_u: Array
    by_remanence: Array
    by_place: Array | None = None
    by_thickness: Array | None = None


@dataclass(frozen=True)
class MagnetisedShell:
    """Cells of a magnetised shell, with nodal values.

    Attributes
    ----------
    element
        Lagrange element of r0 and u.
    r0, u
        (cells, nodes, components) undeformed places and displacements, over R.
    remanence_element
        Discontinuous element of the remanence.
    remanence
        (cells, its nodes, 3) remanence in the undeformed shell.
    h
        Thickness over R.
    thickness_factor
        Element and nodal values (cells, its nodes) of the factor of the thickness; None for 1.
    swept
        Whether the cells are those of a meridian.
    incompressible
        1 where the thickness follows from the area, so that the volume stays, else 0; of each cell
        (cells, 1), or of all.
    """

    element: Any
    r0: Array
    u: Array
    remanence_element: Any
    remanence: Array
    h: float
    thickness_factor: tuple[Any, Array] | None = None
    swept: bool = False
    incompressible: Array | float = 0

    def reference(self, ab: Array) -> tuple[Array, Array, Array]:
        """Map coordinates ab (n, m, 2) to places on the reference cell.

        A triangle (d = 2) is a square whose side a = 1 is a corner; a cell of a meridian (d = 1)
        has the place a and the azimuth b.

        Returns
        -------
        tuple
            Places (n, m, d), their derivatives (n, m, 2, d) by a and b, and azimuths (n, m) over a
            full turn, zero for a triangle.
        """
        a, b = ab[..., 0], ab[..., 1]
        if self.swept:
            return a[..., None], np.stack([np.ones_like(a), np.zeros_like(a)], -1)[..., None], b
        # X = a and Y = (1 - a) b, with their derivatives by a and by b
        ones = np.ones_like(a)
        by_a, by_b = np.stack([ones, -b], -1), np.stack([0 * ones, 1 - a], -1)
        return np.stack([a, (1 - a) * b], -1), np.stack([by_a, by_b], -2), 0 * a

    def thickness(self, cells: Ints, X: Array) -> Array:
        """Return the undeformed thickness over R, then its derivatives by X.

        X (n, m, d) are places on the reference cell, m for each of the cells (n,). The result is (1
        + d, n, m); for a constant thickness it is (3, n, m) whatever d, with zero derivatives.
        """
        if self.thickness_factor is None:
            thickness = np.zeros((3, *X.shape[:2]))
            thickness[0] = self.h
            return thickness
        element, values = self.thickness_factor
        return np.asarray(self.h * np.einsum("dnmk,nk->dnm", tables(element, X, 1), values[cells]))

    def zero_derivatives(self, *, of_shape: bool = False) -> NodalDerivatives:
        """Return derivatives that are all zero, to which contributions are added.

        With `of_shape`, derivatives by the undeformed place and by the thickness are included.
        Without a thickness factor the latter are an empty array.
        """
        zero = NodalDerivatives(np.zeros_like(self.r0), np.zeros_like(self.remanence))
        if not of_shape:
            return zero
        by_thickness: Array = np.zeros((len(self.r0), 0))
        if self.thickness_factor is not None:
            by_thickness = np.zeros_like(self.thickness_factor[1])
        return replace(zero, by_place=np.zeros_like(self.r0), by_thickness=by_thickness)

    def add_thickness_derivatives(
        self, cells: Ints, X: Array, by_thickness: Array, nodal_derivatives: NodalDerivatives
    ) -> None:
        """Add a number's derivatives by nodal factors of the thickness to `nodal_derivatives`.

        `by_thickness` (n, m) are its derivatives by the thickness over R at places X (m, d) of the
        reference cell, in cells (n,). Nothing is added to derivatives without `by_thickness`.
        """
        if self.thickness_factor and nodal_derivatives.by_thickness is not None:
            T = self.thickness_factor[0].tabulate(0, X)[0, :, :, 0]
            np.add.at(nodal_derivatives.by_thickness, cells, self.h * by_thickness @ T)


def tables(element: Any, X: Array, order: int) -> Array:
    """Return values and derivatives (.., n, m, nodes) of an element's basis at places (n, m, d).

    The first index counts derivatives up to an order, as in basix.
    """
    flat = element.tabulate(order, X.reshape(-1, X.shape[-1]))[..., 0]
    return np.asarray(flat.reshape(len(flat), *X.shape[:2], -1))


def rotate_about_axis(v: Array, angle: Array, sign: float = 1.0) -> Array:
    """Rotate vectors (n, m, ..., 3) about e3 by angles (n, m) in rad; back with `sign` -1."""
    c, s = np.cos(angle), sign * np.sin(angle)
    c, s = (component.reshape(*angle.shape, *[1] * (v.ndim - 3)) for component in (c, s))
    return np.stack(
        [c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1], v[..., 2]], axis=-1
    )


@dataclass(frozen=True)
class SurfaceJets:
    """Jets (values and derivatives by a and b) of a magnetised shell at points of its cells.

    Attributes
    ----------
    r0, r
        (6, n, m, 3) jet of the undeformed place, up to second derivatives; (3, n, m, 3) jet of the
        deformed one.
    B
        (3, n, m, 3) jet of the remanence.
    t
        (3, n, m) jet of the undeformed thickness over R.
    shape, cells
        The shell, and the numbers (n,) of the cells.
    shape_tables, remanence_tables
        Values and derivatives of the bases of both elements at the points.
    angle
        (n, m) azimuths (rad).
    ab
        (n, m, 2) coordinates.
    """

    r0: Array
    r: Array
    B: Array
    t: Array
    shape: MagnetisedShell
    cells: Ints
    shape_tables: Array
    remanence_tables: Array
    angle: Array
    ab: Array

    @classmethod
    def at_points(cls, shape: MagnetisedShell, cells: Ints, ab: Array) -> "SurfaceJets":
        """Return the jets at coordinates ab (n, m, 2) in cells (n,).

        On a meridian they are first taken at azimuth zero and then rotated about e3. On a triangle
        derivatives by reference coordinates are first turned into derivatives by a and b.
        """
        X, slopes, b = shape.reference(ab)
        angle = 2 * np.pi * b
        shape_tables = tables(shape.element, X, 2)
        remanence_tables = tables(shape.remanence_element, X, 1)
        if not shape.swept:
            shape_tables = _chain(shape_tables, slopes, ab)
            remanence_tables = _chain(remanence_tables, slopes, ab)
        r0, u = (
            np.einsum("dnmk,nki->dnmi", shape_tables, nodal[cells]) for nodal in (shape.r0, shape.u)
        )
        B = np.einsum("dnmk,nki->dnmi", remanence_tables, shape.remanence[cells])
        thickness = shape.thickness(cells, X)
        if shape.swept:
            # so far these are values on the meridian
            r0, u = (_swept_jet(on_meridian, angle) for on_meridian in (r0, u))
            B = _swept_remanence(B, angle)
            # value, derivative along the meridian, and none around the axis
            thickness = np.stack([thickness[0], thickness[1], 0 * thickness[0]])
        elif len(thickness) > 1:
            by_a_and_b = np.einsum("nmad,dnm->anm", slopes, thickness[1:3])
            thickness = np.concatenate([thickness[:1], by_a_and_b])
        return cls(
            r0=r0,
            r=r0[:3] + u[:3],
            B=B,
            t=thickness,
            shape=shape,
            cells=cells,
            shape_tables=shape_tables,
            remanence_tables=remanence_tables,
            angle=angle,
            ab=ab,
        )

    def layer(self, eta: float) -> tuple[Array, Array, Array]:
        """Return dX/da, dX/db and dX/deta (n, m, 3) of the undeformed shell at the height `eta`.

        X = r0 + eta t n0 is a place in the shell, with the thickness t over R.
        """
        _, a1, a2, _a11, _a12, _a22 = self.r0
        n0, (n1, n2) = _normals(self.r0)
        t, t1, t2 = (component[..., None] for component in self.t)
        return a1 + eta * (t * n1 + t1 * n0), a2 + eta * (t * n2 + t2 * n0), t * n0

    @property
    def thickness(self) -> Array:
        """Thickness (n, m) of the deformed shell, over R.

        Incompressible cells get thinner as their area grows.
        """
        if not np.any(self.shape.incompressible):
            return np.asarray(self.t[0])
        area0, area = (np.linalg.norm(np.cross(a[1], a[2]), axis=-1) for a in (self.r0, self.r))
        return np.asarray(self.t[0] * (1 + self._incompressible * (area0 / area - 1)))

    @property
    def _incompressible(self) -> Array | float:
        """1 in these cells (n, 1) if they keep their volume, else 0; or one number for all."""
        incompressible = self.shape.incompressible
        return np.asarray(incompressible)[self.cells] if np.ndim(incompressible) else incompressible

    def place(self, eta: float) -> Array:
        """Return places (n, m, 3) over R of the deformed shell at a height over the thickness."""
        return np.asarray(
            self.r[0] + eta * self.thickness[..., None] * unit(np.cross(self.r[1], self.r[2]))
        )

    def add_derivatives(
        self, nodal_derivatives: NodalDerivatives, by_place: Array, by_normal: Array, by_B: Array
    ) -> None:
        """Add dJ/du and dJ/dBr by nodal values to `nodal_derivatives`, for a number J.

        J depends on the deformed shell by its mid-surface places, by its normals times height, and
        by the remanence.

        Parameters
        ----------
        by_place, by_normal
            (n, m, 3) derivatives by mid-surface places, and by normals with the factor of the
            height.
        by_B
            (3, n, m, 3) derivatives by the remanence and its derivatives by a and b.
        """
        area_vector = np.cross(self.r[1], self.r[2])
        area = np.linalg.norm(area_vector, axis=-1, keepdims=True)
        n = area_vector / area
        # with the area vector m = r_a x r_b the normal is m/|m|: the part of `by_normal` along n is
        # subtracted. The height of incompressible cells is over |m| as well: it is subtracted twice
        normal_factor = 1 + np.asarray(self._incompressible)[..., None]
        along_normal = np.sum(by_normal * n, axis=-1, keepdims=True)
        by_area_vector = (by_normal - normal_factor * along_normal * n) / area
        by_tangents = np.cross(self.r[2], by_area_vector), np.cross(by_area_vector, self.r[1])
        by_jets = np.stack([by_place, *by_tangents])
        if self.shape.swept:
            by_u, by_remanence = self._by_values_on_meridian(by_jets, by_B)
        else:
            by_u = np.einsum("dnmk,dnmi->nki", self.shape_tables[:3], by_jets)
            by_remanence = np.einsum("dnmk,dnmi->nki", self.remanence_tables, by_B)
        np.add.at(nodal_derivatives.by_u, self.cells, by_u)
        np.add.at(nodal_derivatives.by_remanence, self.cells, by_remanence)

    def _by_values_on_meridian(self, by_jets: Array, by_B: Array) -> tuple[Array, Array]:
        """Return a number's derivatives by nodal displacements and remanences of a meridian.

        `by_jets` and `by_B` (3, n, m, 3) are its derivatives by the jets of the deformed place and
        of the remanence: by value, by the derivative along the meridian, by that around the axis.
        """

        def at_azimuth_zero(derivatives: Array) -> Array:
            """Return derivatives turned back to where nodal values have their components."""
            return np.stack([rotate_about_axis(d, self.angle, -1.0) for d in derivatives])

        by_jets, by_B = at_azimuth_zero(by_jets), at_azimuth_zero(by_B)
        full_turn = 2 * np.pi
        # a place (U, 0, W) has the derivative (0, U, 0) around the axis, times the full turn: to
        # the derivatives by U and W, and by their slopes, it adds one by U
        by_meridian = np.stack([by_jets[0], by_jets[1]])[..., [0, 2]]
        by_meridian[0][..., 0] += full_turn * by_jets[2][..., 1]
        by_u = np.einsum("dnmk,dnmi->nki", self.shape_tables[:2], by_meridian)
        # a remanence (B1, B2, B3) has the derivative (-B2, B1, 0) around the axis
        by_remanence_jets = np.stack([by_B[0], by_B[1]])
        by_remanence_jets[0][..., 0] += full_turn * by_B[2][..., 1]
        by_remanence_jets[0][..., 1] -= full_turn * by_B[2][..., 0]
        by_remanence = np.einsum("dnmk,dnmi->nki", self.remanence_tables[:2], by_remanence_jets)
        return by_u, by_remanence

    def add_reference_derivatives(
        self,
        nodal_derivatives: NodalDerivatives,
        charges_of: "Callable[[SurfaceJets], Array]",
        by_charges: Array,
    ) -> None:
        """Add a number's derivatives by the undeformed place and the thickness; triangles only.

        They are added to `nodal_derivatives` if it has arrays for them. The number depends on the
        undeformed shell by its charges. Their derivatives by each component of the jets r0 and t
        are found by an imaginary change, so they are exact to rounding.

        Parameters
        ----------
        charges_of
            Jets -> charges (n, m, l), an analytic function.
        by_charges
            (n, m, l) derivatives of the number by these charges.
        """
        if nodal_derivatives.by_place is None or nodal_derivatives.by_thickness is None:
            return
        by_r0, by_t = np.zeros((6, *self.r0.shape[1:])), np.zeros((3, *self.t.shape[1:]))

        def rate(**jets: Any) -> Array:
            """Return the number's derivative (n, m) along an imaginary change of jets.

            `jets` are the changed fields r0 or t; all others stay.
            """
            change = charges_of(replace(self, **jets)).imag
            total = np.sum(by_charges * change, axis=-1)
            return np.asarray(total / COMPLEX_STEP, dtype=np.float64)

        for d, i in product(range(1, 6), range(3)):  # charges do not depend on the place r0[0]
            r0 = self.r0.astype(np.complex128)
            r0[d, ..., i] += COMPLEX_STEP * 1j
            by_r0[d, ..., i] = rate(r0=r0)
        for d in range(3):
            t = self.t.astype(np.complex128)
            t[d] += COMPLEX_STEP * 1j
            by_t[d] = rate(t=t)
        # from jets to nodal values, by the transposed shape functions
        np.add.at(
            nodal_derivatives.by_place,
            self.cells,
            np.einsum("dnmk,dnmi->nki", self.shape_tables, by_r0),
        )
        if self.shape.thickness_factor:
            X, slopes, _ = self.shape.reference(self.ab)
            T = _chain(tables(self.shape.thickness_factor[0], X, 1), slopes, self.ab)
            np.add.at(
                nodal_derivatives.by_thickness,
                self.cells,
                self.shape.h * np.einsum("dnmk,dnm->nk", T, by_t),
            )


def unit(m: Array) -> Array:
    """Return vectors m (..., 3) over their lengths."""
    return np.asarray(m / np.linalg.norm(m, axis=-1, keepdims=True))


def _normals(jet: Array) -> tuple[Array, tuple[Array, Array]]:
    """Return the unit normal (..., 3) of a surface, and its two derivatives by the coordinates.

    The jet (6, ..., 3) may be complex: no absolute values are taken, so that the result is analytic
    in the jet.
    """
    _, a1, a2, a11, a12, a22 = jet
    m = np.cross(a1, a2)
    length = np.sqrt(np.sum(m * m, axis=-1, keepdims=True))  # np.linalg.norm is not analytic
    n, slopes = m / length, []
    # by the first, then by the second coordinate: the derivatives of a1 and of a2
    for slope_of_a1, slope_of_a2 in ((a11, a12), (a12, a22)):
        change = (np.cross(slope_of_a1, a2) + np.cross(a1, slope_of_a2)) / length
        slopes.append(change - np.sum(change * n, axis=-1, keepdims=True) * n)
    return n, (slopes[0], slopes[1])


def _swept_jet(on_meridian: Array, angle: Array) -> Array:
    """Return the jet (6, n, m, 3) of an axisymmetric field at azimuths `angle` (n, m).

    `on_meridian` (3, n, m, 2) are its components along e_rho and e_z, with two derivatives.
    """
    at_azimuth_zero = _ring(on_meridian, 2 * np.pi)
    return np.stack([rotate_about_axis(d, angle) for d in at_azimuth_zero])


def _swept_remanence(B: Array, angle: Array) -> Array:
    """Return the jet (3, n, m, 3) of a remanence at azimuths `angle` (n, m).

    B (2, n, m, 3) are its components along e_rho, e_theta and e_z, and their derivatives along the
    meridian. The first two components turn with the azimuth, so that the derivative around the axis
    is not zero.
    """
    by_azimuth = 2 * np.pi * np.stack([-B[0, ..., 1], B[0, ..., 0], 0 * B[0, ..., 0]], -1)
    return np.stack([rotate_about_axis(d, angle) for d in (B[0], B[1], by_azimuth)])


def _ring(f: Array, ring: float) -> Array:
    """Return the jet (6, n, m, 3) of an axisymmetric field by (s, b), at azimuth zero.

    `f` (3, n, m, 2) are its components along e_rho and e_z with two derivatives by the meridian's
    coordinate s. The azimuth is `ring` times b, so that `ring` (rad) is the angle for b = 1.
    """
    (U, W), (Us, Ws), (Uss, Wss) = (np.moveaxis(components, -1, 0) for components in f)
    zero = np.zeros_like(U)
    jet_components = [(U, zero, W), (Us, zero, Ws), (zero, ring * U, zero)]
    jet_components += [(Uss, zero, Wss), (zero, ring * Us, zero), (-(ring**2) * U, zero, zero)]
    return np.stack([np.stack(vector, axis=-1) for vector in jet_components])


def _chain(T: Array, slopes: Array, ab: Array) -> Array:
    """Return derivatives by (a, b) of shape functions, from derivatives by X and Y.

    A triangle has the reference coordinates X = a, Y = (1 - a) b.

    Parameters
    ----------
    T
        (3 or 6, n, m, k) values and first, perhaps also second derivatives of k functions.
    slopes
        (n, m, 2, 2) derivatives of X and Y by a and b.
    ab
        (n, m, 2) the coordinates.
    """
    value, first = T[0], np.einsum("nmad,dnmk->anmk", slopes, T[1:3])
    if len(T) == 3:  # no second derivatives
        return np.stack([value, *first])
    XX, XY, YY = T[3:6]
    b, c = ab[..., 1, None], 1 - ab[..., 0, None]
    # by aa, ab and bb; X and Y have the single second derivative Y_ab = -1
    twice = [XX - 2 * b * XY + b**2 * YY, c * (XY - b * YY) - T[2], c**2 * YY]
    return np.stack([value, *first, *twice])
