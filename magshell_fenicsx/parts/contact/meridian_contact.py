"""Contact of shells with one axis on their meridians.

A point x of one curve has the closest place y of the other. With d = |x - y|, n = (x - y)/d,
F = d^2/2, A = F,ss = |y'|^2 - (x - y) . y'' and changes D = dx - dy:

    d,uu = [D . D - (n . D)^2 - C_s^2/A - C_theta^2/B]/d,   C_s = -D . y' - (x - y) . dy',
    B = rho_x rho_y

Where the thickness varies d is the least of |x - y| - H(y), less H(x), plus h, with half the
thickness H. Then n . y' is -H', C_s has y' less its part along n, and A is
|y'|^2 - (x - y) . y'' - H'^2 - |x - y| H''. H less h/2 is a third component of places.

Along e_theta the closest place moves as it does along the curve. A wave (U cos, V sin, W cos) of m
theta moves it by C_theta = -rho_y D_V + (x - y)_rho (m U_y + V_y) + (x - y)_z m W_y; without waves
it stays. The points are those of a rule on each cell. At a free end one is next to the end, which
an edge stands on. docs/theory.md, Contact.

A place is a closest place y: a cell with a coordinate X from 0 to 1 in it; it is free if it is
inside the cell, so that it can move along the curve. U, V and W are displacements along rho, theta
and z. `PairContact` has the words of every contact of a pair.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from zlib import crc32

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.nonlocal_terms import Entries
from magshell_fenicsx.parts.contact.active_set import FrozenContact, Geometry
from magshell_fenicsx.parts.contact.closest_points import STEEP_COSINE
from magshell_fenicsx.parts.contact.contact_section import WHOLE_SHELL, Pair
from magshell_fenicsx.parts.contact.face_offsets import unknown_numbers
from magshell_fenicsx.parts.contact.field_derivatives import ContactFields
from magshell_fenicsx.parts.contact.meridian_offsets import IN_PLANE, MeridianOffsets
from magshell_fenicsx.parts.contact.meridian_projection import (
    COMPONENT_SIGNS,
    DISTANCE_TOLERANCE,
    CandidateSearch,
    MeridianCurves,
    MeridianPoints,
    MeridianProjections,
    NeighbouringMaterial,
    distances,
    no_projections,
    slopes,
)
from magshell_fenicsx.parts.contact.pair_contact import ContactGeometry, PairContact
from magshell_fenicsx.parts.contact.projection import (
    FOLLOW_ITERATIONS,
    JoinedPlaces,
    polynomial_bound,
)
from magshell_fenicsx.parts.contact.time_averaging import SampleCache, at_each_sample
from magshell_fenicsx.parts.gap import GrownSurface

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class ModelMeridian:
    """The meridians of a model, as contact needs them; every rank has all of them.

    Attributes
    ----------
    r0, u
        Undeformed placement (rho, z) and displacement over R, in one space.
    patches
        Name of a patch or shell -> whether each cell belongs to it.
    h
        Thickness over R; where it varies, that of the first shell.
    degree
        Degree of the quadrature.
    thickness
        Factor of h, (1,) per node; None for 1.
    thins
        (cells, 1) or one number for all: 1 in cells whose thickness follows from their area, as of
        rubber, else 0.
    natural
        The natural shape; None if it is the undeformed one.
    """

    r0: fem.Function
    u: fem.Function
    patches: Mapping[str, Flags]
    h: float
    degree: int
    thickness: fem.Function | None = None
    thins: Array | int = 0
    natural: GrownSurface | None = None

    @cached_property
    def nodes(self) -> Longs:
        """(cells, functions): numbers of nodes, the ends first."""
        return np.asarray(self.r0.function_space.dofmap.list.astype(np.int64))

    @cached_property
    def places(self) -> Array:
        """(nodes, 2) undeformed."""
        return np.array(self.r0.x.array.reshape(-1, 2))

    @cached_property
    def curves(self) -> MeridianCurves:
        """The undeformed curves."""
        element = self.r0.function_space.element.basix_element
        return MeridianCurves(element, self.nodes, self.places, self.h)

    @cached_property
    def geometry(self) -> ContactGeometry:
        """The cells between which contact is sought: every rank has all, and all contact points."""
        fields = ContactFields(self.r0, self.thickness, self.nodes, slice(None))
        local_cells, comm = (0, len(self.nodes)), MPI.COMM_SELF
        return ContactGeometry(
            self.curves, self.places, self.u, self.h, fields, self.offsets, local_cells, comm
        )

    @cached_property
    def offsets(self) -> MeridianOffsets | None:
        """Half the thickness at nodes; None where it is h/2 everywhere and in all states."""
        keeps_volume = np.broadcast_to(np.asarray(self.thins) > 0, (len(self.nodes), 1))[:, 0]
        if self.thickness is None and not keeps_volume.any():
            return None
        factor = np.ones(self.nodes.shape)
        if self.thickness is not None:
            factor = self.thickness.x.array[self.thickness.function_space.dofmap.list]
        curves, r0, h = self.curves, self.places, self.h
        offsets = MeridianOffsets(curves, r0, h, np.array([factor]), keeps_volume)
        if not (self.natural and self.natural.stretch is not None):
            return offsets
        tangents, points = offsets.undeformed_tangents(), curves.element.points
        rates = self.natural.volume_coefficients(tangents, points)
        # elsewhere the volume does not grow: 1, and zero for the three higher powers
        rates[:, ~keeps_volume] = np.eye(4)[0][:, None, None]
        return MeridianOffsets(curves, r0, h, factor * rates, keeps_volume, self.natural.stretch)


class MeridianContact(PairContact[MeridianProjections]):
    """The contact energy of a pair on the meridian; a `Term` and a `NonlocalTerm` of `assembly`.

    Parameters
    ----------
    pair
        The two members, with the stiffness of their penalty.
    model
        The meridians of the model.
    sides
        (cells,) flags of the cells of the first shell, and of the second.

    Private fields of the model, besides those of `PairContact`: `_curves` are the meridians,
    `_points` the contact points and `_normals` (cells, 2) undeformed normals of cells.
    `_candidates` finds the cells near points. `_material` is the material around points of a shell
    that may touch itself; None for two shells. `_meridian_offsets` is half the thickness where it
    varies, else None.

    Private fields of the last active set: `_places` and `_joined` have its places. `_active_sets`
    is a cache.
    """

    _points: MeridianPoints
    common_translations = (0.0, 1.0)  # along the axis alone
    ends_steps = False  # steps on which meridians meet do without

    def __init__(self, pair: Pair, model: ModelMeridian, sides: tuple[Flags, Flags]) -> None:
        """Prepare the points and the search; places are looked for at the first evaluation."""
        super().__init__(pair, model.geometry, sides)
        self._curves, self._meridian_offsets = model.curves, model.offsets
        # Gauss's rule of n points is exact to the degree 2 n - 1
        self._points = self._curves.rule(model.degree // 2 + 1, sides)
        self._normals = self._curves.cell_normals()
        self._material: NeighbouringMaterial | None = None
        if np.any(sides[0] & sides[1]):  # a shell and itself
            undeformed = np.column_stack([self._r0, self._half])
            nodal = undeformed[self._nodes]
            undeformed_points = self._places_of_points(undeformed)
            self._material = NeighbouringMaterial(
                undeformed_points, nodal, self._nodes, self._points.cell
            )
        self._places = no_projections()
        self._joined = JoinedPlaces.separate(self._places.distance)
        self._active_sets = SampleCache[tuple[MeridianProjections, JoinedPlaces]]()
        self._candidates = CandidateSearch(
            self._points, self._nodes, sides, self._curves.element, self._material
        )

    # as a term

    def _add(self, b: Array, forces: Array) -> None:
        """Add forces (nodes, 2) to the vector b; every rank has all nodes."""
        b[: forces.size] += forces.ravel()

    def _entries_by_place_and_offset(self) -> Entries:
        """Return entries of the second derivative by places (rho, z) and offsets H of nodes."""
        blocks, nodes = self._second_derivative(m=0.0)
        return self._block_entries(blocks, nodes, of_place=[0, 2])  # U and W

    def _block_entries(self, H: Array, nodes: Longs, of_place: list[int]) -> Entries:
        """Return the entries of blocks by some components of nodes, and by H where it varies.

        Parameters
        ----------
        H, nodes
            (n, dofs, dofs) blocks of second derivatives by (U, V, W, H), and their nodes (n,
            functions).
        of_place
            Which of U, V and W are unknowns, as numbers 0, 1 and 2: [0, 2] for U and W.
        """
        # the fourth unknown of a node, number 3, is the offset H
        components = [*of_place, 3] if self._offsets else of_place
        rows_of_block = np.flatnonzero(np.isin(np.arange(H.shape[1]) % 4, components))
        # global numbers of these unknowns (n, rows of a block): those of places come first
        dofs = unknown_numbers(
            nodes, count=len(self._r0), components=len(components), dim=len(of_place)
        )
        rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None])
        values = H[:, rows_of_block[:, None], rows_of_block]
        return rows.ravel(), columns.ravel(), values.ravel()

    @property
    def pattern_key(self) -> float:
        """A number that identifies the pairs of cells in contact.

        The sparsity pattern of the tangent is made again where it changes.
        """
        return float(crc32(self._cells_in_contact().tobytes()))

    def _coupled_cells(self) -> Longs:
        return self._cells_in_contact().T

    def _cells_in_contact(self) -> Longs:
        """Return the pairs (n, 2) of cells in contact: cell of the point, cell of the place.

        In a step in time they are those of all its samples.
        """
        pairs = [
            np.column_stack([self._points.cell[active.places.point], active.places.cell])
            for active in at_each_sample(self, self._active_set)
        ]
        return np.asarray(np.unique(np.concatenate(pairs), axis=0))

    def entries_of_waves(self, m: float) -> Entries:
        """Return the entries of the second variation along waves (U cos, V sin, W cos) of m theta.

        They are by the coefficients (U + V, V, W), as in `Waves`. The mean of cos^2 m theta around
        the axis gives them the factor 1/2.
        """
        blocks, nodes = self._second_derivative(m)
        rows, columns, values = self._block_entries(blocks, nodes, of_place=[0, 1, 2])
        if self._meridian_offsets:
            # by the chain rule: entries by (U, V, W) and offsets become those by (U, V, W) alone
            offsets, by_offset = self._meridian_offsets.waves(m), self._gradient()[:, -1]
            rows, columns, values = offsets.entries(self._at, (rows, columns, values), by_offset)
        # from (U, V, W) to (P, V, W) with P = U + V. The derivative by V at fixed P is that by V
        # less that by U: each entry of U stays as one of P, and is subtracted from V, the next
        # unknown. The first round does so for the columns, and exchanges them with the rows. The
        # second does so for the rows, and exchanges both back
        for _ in range(2):
            is_U = columns % 3 == 0
            values = np.concatenate([values, -values[is_U]])
            rows, columns = (
                np.concatenate([columns, columns[is_U] + 1]),
                np.concatenate([rows, rows[is_U]]),
            )
        return rows, columns, values / 2

    # what is observed

    def least_gap(self) -> float:
        """Return the least gap over R at present; nan where no faces are within the reach."""
        u = self._displacement()
        reach = self._reach
        if not self._material:
            # the least distance of two shells is at most that of points from nodes, which costs
            # less to compute: a search up to this distance is enough
            reach = min(reach, self._distance_to_nodes(u) * (1 + DISTANCE_TOLERANCE))
        least_distance = self._projections(u, reach).distance.min(initial=np.inf)
        return float(least_distance - self._h) if np.isfinite(least_distance) else np.nan

    def _distance_to_nodes(self, u: Array) -> float:
        """Return the least distance over R of points from the nodes of the other shell.

        Parameters
        ----------
        u
            (nodes, 2) displacement over R.
        """
        r = self._places_of_nodes(u)
        x, is_first = self._places_of_points(r), self._points.is_first
        first, second = (np.unique(self._nodes[side]) for side in self._sides)
        # points of the first shell from nodes of the second, and the other way round
        differences = x[is_first][:, None] - r[second], x[~is_first][:, None] - r[first]
        return min(float(distances(off).min()) for off in differences)

    def gap_along_step(self, begin: Array, end: Array) -> None:
        return None

    def deepest_penetration(self) -> tuple[float, Array]:
        undeformed = 0 * self._r0  # the displacement zero
        places = self._projections(undeformed, self._h)
        if not len(places.point):
            return 0.0, np.zeros(3)
        deepest = int(places.distance.argmin())
        rho, z = self._places_of_points(self._r0)[places.point[deepest]]
        return float(self._h - places.distance[deepest]), np.array([rho, 0.0, z])

    # geometry

    def _nodal_values(self, function: fem.Function) -> Array:
        return np.asarray(function.x.array.reshape(-1, 2)[: len(self._r0)])

    def _places_in_contact(self) -> tuple[MeridianProjections, JoinedPlaces]:
        u, growth = self._displacement(), self._offsets.growth if self._offsets else 0.0
        # the places are found again where the displacement or the growth has changed
        if growth != self._growth or not np.array_equal(u, self._at):
            self._growth, self._at = growth, np.array(u)
            self._places, self._joined = self._active_sets.get(
                (u, growth), lambda: self._find_places(self._at)
            )
        return self._places, self._joined

    def _find_places(self, u: Array) -> tuple[MeridianProjections, JoinedPlaces]:
        """Return the places that count at a displacement u (nodes, 2), each joined place of one."""
        places = self._projections(u, self._h)
        counted = places.select(~self._are_left_to_edges(places))
        return counted, JoinedPlaces.separate(counted.distance)

    def _own_points(self, frozen: FrozenContact[MeridianProjections]) -> MeridianPoints:
        return self._points

    def _follow(self, places: MeridianProjections) -> MeridianProjections:
        """Return places moved on to where points project at present, by Newton's method.

        Free places may move beyond an end of their cells; the others stay.
        """
        r, X = self._places_of_nodes(self._at), places.X
        x, nodal = self._places_of_points(r)[places.point], r[self._nodes[places.cell]]
        for _ in range(FOLLOW_ITERATIONS):  # a fixed number keeps the result smooth in the state
            # minus the first derivative of the distance by X, and the second
            descent, curvature, _ = slopes(x, self._curves.jets(X, nodal))
            X = X + np.where(
                places.is_free, descent / np.where(places.is_free, curvature, 1.0), 0.0
            )
        y, _, _ = self._curves.jets(X, nodal)
        return replace(places, X=X, distance=distances(x - y))

    def _places_of_nodes(self, u: Array, *, to_faces: bool = True) -> Array:
        """Return all nodes (nodes, 3) at a displacement: rho, z, and half the thickness less h/2.

        The last component is 0 unless `to_faces` is set. All are over R.
        """
        half = self._offsets.half_thickness(u) if self._offsets else self._half
        offset = (half - self._h / 2) * to_faces
        return np.column_stack([self._r0 + u, offset])

    def _places_of_points(self, r: Array) -> Array:
        """Return the points (n, dim) for nodes r (nodes, dim), dim 2 or 3.

        A third component, half the thickness, has the other sign for points than for nodes.
        """
        nodal = r[self._nodes[self._points.cell]] * COMPONENT_SIGNS[: r.shape[1]]
        # shape functions k of each point n times the components i at the nodes of its cell
        return np.asarray(np.einsum("nk,nki->ni", self._points.shape, nodal))

    def _projections(
        self, u: Array, face_reach: float, *, to_faces: bool = True
    ) -> MeridianProjections:
        """Return the places that points face at a displacement, at most one on each side.

        Parameters
        ----------
        u
            (nodes, 2) displacement over R.
        face_reach
            Largest distance over R: between mid-surfaces, or with `to_faces` between faces plus h.
        to_faces
            Whether a variable thickness counts in distances.
        """
        r = self._places_of_nodes(u, to_faces=to_faces)
        x, nodal = self._places_of_points(r), r[self._nodes]
        # mid-surfaces may be farther apart than faces, by both offsets
        largest_offset = polynomial_bound(nodal[..., 2], self._curves.lebesgue_constant)
        reach = face_reach + 2 * largest_offset
        # pairs of points and cells that may be nearer than that, and the closest place of each
        point, cell = self._candidates(x[:, :2], nodal[..., :2], reach)
        if not len(point):
            return no_projections()
        places = self._curves.project(x, nodal, point, cell)
        near_places = places.select(places.distance < face_reach)
        return self._curves.select_nearest(near_places, x, nodal, self._material)

    def _are_left_to_edges(self, places: MeridianProjections) -> Flags:
        """Return flags (n,): which places do not count, because a free end presses there.

        They are places at the end of a shell that a point inside another shell faces steeply. Only
        the end's own point presses there: it would catch at each point inside the other shell as it
        slides. Normals are undeformed, so that the energy is a function of the state.
        """
        at_end, is_steep = self._end_and_steepness(places)
        return np.asarray(at_end & is_steep & ~self._points.is_on_edge[places.point])

    def _end_and_steepness(self, places: MeridianProjections) -> tuple[Flags, Flags]:
        """Return flags (n,) whether places are at a free end, and flags whether they are steep.

        A place is steep to its point if the undeformed normals of both cells have a cosine below
        `STEEP_COSINE`.
        """
        # number of the cell's end, which counts only for places that are at one
        end = (places.X == 1.0).astype(np.int64)
        at_end = ~places.is_free & (self._curves.neighbours[places.cell, end] < 0)
        normals = self._points.normal[places.point] * self._normals[places.cell]
        cosine = np.abs(np.sum(normals, axis=1))
        return np.asarray(at_end), np.asarray(cosine < STEEP_COSINE)

    def _may_touch(self, cell: Longs, other: Longs) -> Flags:
        """Return flags (n,): whether cells (n,) may touch others, which are not their material."""
        is_pair = self._is_of_pair(cell, other)
        return is_pair & ~self._material.are_near(cell, other) if self._material else is_pair

    def _mean_thickness(self, places: MeridianProjections) -> Array:
        half = self._half[self._nodes]
        # half the thickness at points and at places: their sum is the mean thickness
        shape, own_cell = self._points.shape[places.point], self._points.cell[places.point]
        half_at_points = np.sum(shape * half[own_cell], axis=1)
        shape_at_places = self._curves.table(0, places.X)[0]
        return np.asarray(half_at_points + np.sum(shape_at_places * half[places.cell], axis=1))

    def _are_edges_alone(self, nearest: MeridianProjections) -> Flags:
        at_end, is_steep = self._end_and_steepness(nearest)
        return is_steep & ~at_end

    def _places_within_reach(self) -> MeridianProjections:
        return self._projections(self._displacement(), self._reach)

    def _projections_of_midsurfaces(self, u: Array, reach: float) -> MeridianProjections:
        return self._projections(u, reach, to_faces=False)

    def _gap_geometry(self, places: MeridianProjections) -> Geometry:
        own_nodes = self._nodes[self._points.cell[places.point]]
        nodes = np.concatenate([own_nodes, self._nodes[places.cell]], axis=1)
        r = self._r0 + self._at
        # shape functions of the point's cell at the point, and of the place's cell at the place
        N_x, N_y = self._points.shape[places.point], self._curves.table(0, places.X)[0]
        beta = np.concatenate([N_x, -N_y], axis=1)
        off = np.einsum("nk,nki->ni", beta, r[nodes])  # x - y
        d = np.linalg.norm(off, axis=1)
        return d, off / d[:, None], beta, nodes

    def _second_derivative(self, m: float) -> tuple[Array, Longs]:
        """Return second derivatives (n, dofs, dofs) of the energy of each place, and its nodes.

        They are by (U, V, W, H) at the nodes (n, functions) of both cells, over the whole
        circumference, for waves of m theta. With the penalty psi they are
        psi'' d,u d,u - psi' d,uu. By the module's formula of d,uu they are the squares of four row
        vectors with a factor each, and the term D . D.
        """
        active = self._active_set()
        places, (_, first, second) = active.places, active.penalties
        d, n, beta, nodes = self._gap_geometry(places)
        off = d[:, None] * n  # x - y
        # the places y with their derivatives along the curve, and A of the module's formula
        r = self._places_of_nodes(self._at)
        jets = self._curves.jets(places.X, r[self._nodes[places.cell]])
        _, A, _ = slopes(self._places_of_points(r)[places.point], jets)
        y = jets[0]
        rows = self._squared_rows(m, places, (d, n, beta), jets)  # (places, 4, dofs)
        # factors of the squared rows; the terms of d,uu have the tension over the distance
        weight = self._points.weight[places.point] / 2
        B, tension = y[:, 0] * (y[:, 0] + off[:, 0]), -weight * first / d
        # a place that is not free does not move along the curve, and one on the axis not around it
        by_A, by_B = _inverse_where(places.is_free, A), _inverse_where(B > 0, B)
        factors = np.column_stack([weight * second, -tension, -tension * by_A, -tension * by_B])
        H = rows.transpose(0, 2, 1) @ (factors[..., None] * rows)
        # the term D . D, which is the same for U, V and W
        isotropic_part = tension[:, None, None] * beta[:, :, None] * beta[:, None]
        for i in range(3):
            H[:, i::4, i::4] += isotropic_part
        return H, nodes

    def _squared_rows(
        self,
        m: float,
        places: MeridianProjections,
        geometry: tuple[Array, Array, Array],
        jets: Array,
    ) -> Array:
        """Return four row vectors (places, 4, dofs) of each place, by (U, V, W, H) of both cells.

        They are d,u; its part n . D, without H; and C_s and C_theta of the module's formulas.

        Parameters
        ----------
        m
            Number of waves.
        geometry
            Distances d (places,) from places to points, normals n (places, 2), and beta: the shape
            functions of the point, minus those of the place.
        jets
            (3, places, 3) the places y and their two derivatives along the curve.
        """
        d, n, beta = geometry
        off, (count, functions) = d[:, None] * n, beta.shape  # off is x - y
        y, tangent = jets[0], jets[1, :, :2]
        shape, shape_slope = self._curves.table(1, places.X)
        rows = np.zeros((4, *beta.shape, 4))
        normal, closing, slide, circumferential = rows
        half = functions // 2  # columns of the point, before those of the place
        normal[..., IN_PLANE] = closing[..., IN_PLANE] = beta[..., None] * n[:, None]
        normal[..., 3] = np.concatenate([-beta[:, :half], beta[:, half:]], axis=1)
        tangential = tangent - np.sum(tangent * n, axis=1)[:, None] * n
        slide[..., IN_PLANE] = -beta[..., None] * tangential[:, None]
        slide[:, half:, IN_PLANE] -= shape_slope[..., None] * off[:, None]
        slide[:, half:, 3] -= shape_slope * d[:, None]
        _fill_circumferential(circumferential, m, beta, y[:, :1], off, d, shape)
        return np.asarray(rows.reshape(4, count, 4 * functions).swapaxes(0, 1))

    def weight_slopes(self, tables: Array, places: Array) -> Array:
        """Return relative derivatives (n, functions, 2) of the points' weights by nodes.

        The weight is rho |r'| times constants; the derivative along the curve is number 1 of the
        shape functions and of the places.
        """
        tangent = places[1]  # r'; the relative derivative of |r'| is along r'/|r'|^2
        direction = tangent / np.sum(tangent**2, axis=1)[:, None]
        by_place = tables[1][..., None] * direction[:, None]
        # that of rho, by the first component of places alone
        by_place[..., 0] += tables[0] / places[0, :, :1]
        return np.asarray(by_place)


def _fill_circumferential(
    row: Array, m: float, beta: Array, rho_y: Array, off: Array, d: Array, shape: Array
) -> None:
    """Set C_theta of the module's formula in a row vector of zeros, by (U, V, W, H) of nodes.

    Parameters
    ----------
    row
        (n, functions of both cells, 4) the row of each place.
    m
        Number of waves.
    beta, shape
        Shape functions of the point, minus those of the place; and those of the place alone.
    rho_y, off, d
        (n, 1) rho of the places, (n, 2) x - y, and (n,) its length.
    """
    half = beta.shape[1] // 2  # columns of the point, before those of the place
    row[..., 1] = -beta * rho_y
    row[:, half:, 0] += m * off[:, :1] * shape
    row[:, half:, 1] += off[:, :1] * shape
    row[:, half:, 2] += m * off[:, 1:] * shape
    row[:, half:, 3] += m * d[:, None] * shape


def _inverse_where(condition: Flags, values: Array) -> Array:
    """Return 1/values where a condition holds, else 0."""
    return np.where(condition, 1 / np.where(condition, values, 1.0), 0.0)


def meridian_contacts(pairs: Sequence[Pair], model: ModelMeridian) -> list[MeridianContact]:
    """Return the contacts of pairs on meridians.

    Raises
    ------
    MeshError
        If the shells of a pair overlap undeformed.
    """
    patches = {WHOLE_SHELL: np.ones(len(model.nodes), dtype=bool), **model.patches}
    contacts = list[MeridianContact]()
    for pair in pairs:
        sides = patches[pair.names[0]], patches[pair.names[1]]
        contacts.append(MeridianContact(pair, model, sides))
        contacts[-1].refuse_overlap()
    return contacts
