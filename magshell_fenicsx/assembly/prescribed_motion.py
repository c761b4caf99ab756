"""Prescribed motion of supports: displacements of nodes, normals of clamped edges, swept volumes.

Nodes of moving supports follow rigid motions, and the normals of clamped edges turn with them.

Under a live pressure, rigid lids close the shell at edges that move, and the pressure acts on the
edges too. The potential of the pressure is the volume that the surface sweeps when its points move
straight to their places. An edge that moves sweeps a volume as well. With a lid on the edge, which
moves as rigidly, the two volumes add up to the change of the enclosed volume, whatever the shape of
the lid: here it is a cone. Theory: docs/theory.md, live pressure and moving supports.

mu are amplitudes of rigid motions by name; each motion of a body has one. E(mu) is the displacement
of the nodes that move, A = Q dQ^T/dmu the spin of a clamped edge with the rotation Q. R is the
reference length. A side is a cell's side on the edge; y is a place counted from a lid's origin, n
the normal. Local vectors have the nodes of this rank with ghosts, which other ranks own.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import basix
import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.rigid_motion import (
    AmplitudePair,
    RigidMotion,
    apply_motions,
    total_rotation,
)
from magshell_fenicsx.assembly.shape_tables import CORNERS

Array = NDArray[np.float64]
Amplitudes = Mapping[str, float]

# First and last place in the reference cell, and the numbers of the corners there.
CellSide = tuple[Array, Array, tuple[int, int]]

AffineMap = tuple[Array, Array]  # (G, s) of G y + s: a matrix (3, 3) and a vector (3,)

# Points in (0, 1) of the two-point Gauss rule, whose weights are equal; exact for cubics.
GAUSS_POINTS = (0.5 - np.sqrt(1 / 12), 0.5 + np.sqrt(1 / 12))


@dataclass(frozen=True)
class EdgeCurve:
    """Sides of cells on this rank, oriented with the surface on their left.

    Attributes
    ----------
    nodes
        (sides, functions): local numbers of the nodes of each side's cell.
    values
        (sides, points, functions): the shape functions at quadrature points.
    slopes
        (sides, points, functions): their derivatives along the side, times the weights.
    corners
        (sides, 2): the first and the last corner, by numbers that are the same on all ranks.
    """

    nodes: NDArray[np.int32]
    values: Array
    slopes: Array
    corners: NDArray[np.int64]

    @classmethod
    def from_facets(
        cls,
        V: fem.FunctionSpace,
        facets: NDArray[np.int32],
        sides: Mapping[int, CellSide],
        pressure_signs: Array | None = None,
    ) -> "EdgeCurve":
        """Return the curve of facets that this rank owns.

        Parameters
        ----------
        V
            Space of the shape functions.
        facets
            Local numbers of boundary facets; those of other ranks are left out.
        sides
            Local number of a facet in its cell -> the side of the reference cell.
        pressure_signs
            (local cells,): -1 beside cells on which the pressure acts from inside, where the
            surface is on the right of the curve; 1 elsewhere. None: 1 everywhere.
        """
        topology, element, dim = V.mesh.topology, V.element.basix_element, V.mesh.topology.dim
        for dims in ((dim - 1, dim), (dim, dim - 1), (dim, 0)):
            topology.create_connectivity(*dims)
        facets = facets[facets < topology.index_map(dim - 1).size_local]
        # exact for the product of a place, a place and a slope
        rule = basix.make_quadrature(basix.CellType.interval, 3 * element.degree)
        points, weights = (np.asarray(array) for array in rule)
        # shape functions and weighted slopes (points, functions), by number of the side
        tables = {
            number: _tabulate_side(element, side, points, weights) for number, side in sides.items()
        }
        # the cell of each facet, then the facet's number in the cell
        cells = [int(topology.connectivity(dim - 1, dim).links(facet)[0]) for facet in facets]
        facets_of_cells = topology.connectivity(dim, dim - 1)
        numbers = [
            int(np.flatnonzero(facets_of_cells.links(cell) == facet)[0])
            for cell, facet in zip(cells, facets, strict=True)
        ]
        # the vertices at both ends of each side
        vertices_of_cells = topology.connectivity(dim, 0)
        corners_of_sides = {number: list(corners) for number, (_, _, corners) in sides.items()}
        corners = [
            vertices_of_cells.links(cell)[corners_of_sides[number]]
            for cell, number in zip(cells, numbers, strict=True)
        ]
        flat_corners = np.array(corners, dtype=np.int32).ravel()
        # the shape functions and weighted slopes of each facet; the sign turns curves whose surface
        # is on the right
        shape = len(cells), len(weights), element.dim
        values = np.reshape([tables[number][0] for number in numbers], shape)
        slopes = np.reshape([tables[number][1] for number in numbers], shape)
        signs = np.ones(len(cells)) if pressure_signs is None else pressure_signs[cells]
        return cls(
            V.dofmap.list[cells],
            values,
            signs[:, None, None] * slopes,
            topology.index_map(0).local_to_global(flat_corners).reshape(-1, 2),
        )

    def at_points(self, x: Array) -> Array:
        """Return nodal vectors (nodes, 3) at the quadrature points, (sides, points, 3)."""
        return np.asarray(self.values @ x[self.nodes])

    def derivative(self, x: Array) -> Array:
        """Return the derivatives of nodal vectors x (nodes, 3) along the curve, times the weights.

        The shape is (sides, points, 3).
        """
        return np.asarray(self.slopes @ x[self.nodes])


def _tabulate_side(
    element: basix.finite_element.FiniteElement, side: CellSide, points: Array, weights: Array
) -> tuple[Array, Array]:
    """Return shape functions on a side of the reference cell, and their slopes along the side.

    Both are (points, functions); the slopes are multiplied by the weights.

    Parameters
    ----------
    points, weights
        (points, 1) and (points,): a quadrature on the interval from 0 to 1, which runs along the
        side.
    """
    first_place, last_place, _ = side
    # [0] the shape functions, [1:] their derivatives by reference coordinates
    tabulated = element.tabulate(1, first_place + points * (last_place - first_place))[..., 0]
    slopes = np.tensordot(last_place - first_place, tabulated[1:], 1)
    return np.asarray(tabulated[0]), np.asarray(weights[:, None] * slopes)


def triangle_sides() -> dict[int, CellSide]:
    """Return the sides of the reference triangle by number; the triangle is on their left."""
    corners_of_sides = ((1, 2), (2, 0), (0, 1))
    return {i: (CORNERS[a], CORNERS[b], (a, b)) for i, (a, b) in enumerate(corners_of_sides)}


def level_sides(height: float) -> dict[int, CellSide]:
    """Return lines on the side faces of the reference hexahedron, by number of the face.

    The part of the face above a line is on its left.

    Parameters
    ----------
    height
        Height of the lines, from 0 to 1.
    """
    corners = np.array(
        [[0.0, 0.0, height], [1.0, 0.0, height], [0.0, 1.0, height], [1.0, 1.0, height]]
    )
    # faces 0 and 5 are the bottom and the top; the lines run around the hexahedron
    corners_of_faces = {1: (0, 1), 3: (1, 3), 4: (3, 2), 2: (2, 0)}
    return {i: (corners[a], corners[b], (a, b)) for i, (a, b) in corners_of_faces.items()}


def end_corners(curves: Sequence[EdgeCurve], comm: MPI.Comm) -> NDArray[np.int64]:
    """Return the corners at which curves begin or end; closed curves have none. Collective.

    Such a corner belongs to an odd number of sides. The numbers are the same on all ranks.
    """
    local = np.concatenate([np.empty(0, np.int64), *(curve.corners.ravel() for curve in curves)])
    corners, count = np.unique(np.concatenate(comm.allgather(local)), return_counts=True)
    return np.asarray(corners[count % 2 == 1])


@dataclass(frozen=True)
class Lid:
    """A surface that closes an edge and moves with it as a rigid body.

    Attributes
    ----------
    motions
        Motions of the lid, carried out one after the other.
    origin
        (3,): the apex of the cone, over R.
    area
        (3,): the integral of the normal n over the lid.
    moment
        (3, 3): the integral of y n^T over the lid; y is counted from the origin.
    """

    motions: Sequence[RigidMotion]
    origin: Array
    area: Array
    moment: Array

    @classmethod
    def cone(
        cls,
        curves: Sequence[EdgeCurve],
        x: Array,
        motions: Sequence[RigidMotion],
        origin: Array,
        comm: MPI.Comm,
    ) -> "Lid":
        """Return the cone over curves through nodes, as lid. Collective.

        Its area and moment are integrals of y x dy/2 and y (y x dy)^T/3 along the curves. They are
        negative, since the lid lies on the right of a curve, the surface on the left.

        Parameters
        ----------
        x
            (nodes, 3): places of all local nodes.
        origin
            (3,): the apex.
        """
        area, moment = np.zeros(3), np.zeros((3, 3))
        for curve in curves:
            y = curve.at_points(x) - origin
            y_cross_slope = np.cross(y, curve.derivative(x))
            area -= y_cross_slope.sum(axis=(0, 1)) / 2
            moment -= np.einsum("sqi,sqj->ij", y, y_cross_slope) / 3
        return cls(motions, origin, area=comm.allreduce(area), moment=comm.allreduce(moment))

    @classmethod
    def disc(cls, rho: float, motions: Sequence[RigidMotion], *, last: bool) -> "Lid":
        """Return the disc at the first or the last end of a meridian, with motions along e3.

        Parameters
        ----------
        rho
            Radius of the disc.
        last
            Whether it is at the last end; its normal then points the other way.
        """
        area = np.array([0.0, 0.0, np.pi * rho**2])
        return cls(
            motions,
            origin=np.zeros(3),
            area=-area if last else area,
            moment=np.zeros((3, 3)),  # without rotation G is zero, and this is not used
        )

    def swept_volume(
        self, mu: Amplitudes
    ) -> tuple[float, dict[str, float], dict[AmplitudePair, float]]:
        """Return the volume that the lid sweeps when its points move straight to their places.

        The volume is the integral of u . cof(F) n over the time tau of the motion and the lid, with
        the displacement u = G y + s and F = 1 + tau G.

        Returns
        -------
        tuple
            The volume, its first derivatives by amplitude, and its second ones by pair of
            amplitudes.
        """
        turn = total_rotation(self.motions, mu)
        place = apply_motions(self.motions, mu, self.origin[None])
        # (G, s) of the displacement u = G y + s, then of its derivatives. Rows of `turn` and
        # `place` are images, so matrices are transposed.
        displacement = turn.x.T - np.eye(3), place.x[0] - self.origin
        rates = {name: (turn.slopes[name].T, place.slopes[name][0]) for name in turn.slopes}
        second_rates = {
            pair: (turn.curvatures[pair].T, place.curvatures[pair][0]) for pair in turn.curvatures
        }
        volume = 0.0
        slopes = dict.fromkeys(rates, 0.0)
        curvatures = dict.fromkeys(second_rates, 0.0)
        # cof F is quadratic in tau: two Gauss points, of weight 1/2 each, integrate exactly. The
        # integrand is cof F times the flux of u, entry by entry. The product rule gives its
        # derivatives; the change of cof F by dF is 2 cof(F, dF), with the bilinear `_cofactor`.
        for tau in GAUSS_POINTS:
            F = np.eye(3) + tau * displacement[0]
            flux = self._flux(*displacement)
            volume += float((_cofactor(F, F) * flux).sum()) / 2
            for a, (G, s) in rates.items():
                # the part from the change of cof F, then with that from the change of the flux
                by_F = 2 * tau * _cofactor(F, G) * flux
                slopes[a] += float((by_F + _cofactor(F, F) * self._flux(G, s)).sum()) / 2
            for (a, b), second_rate in second_rates.items():
                integrand = self._second_integrand(tau, F, flux, (rates[a], rates[b]), second_rate)
                curvatures[a, b] += float(integrand.sum()) / 2
        return volume, slopes, curvatures

    def _second_integrand(
        self,
        tau: float,
        F: Array,
        flux: Array,
        rates: tuple[AffineMap, AffineMap],
        second_rate: AffineMap,
    ) -> Array:
        """Return the second derivative (3, 3) of cof F * flux by two amplitudes a and b.

        The sum of its entries is the derivative of u . cof(F) n, integrated over the lid.

        Parameters
        ----------
        tau
            Time of the motion, from 0 to 1.
        F, flux
            1 + tau G, and the integral of u n^T over the lid.
        rates, second_rate
            (G, s) of the derivatives of u by a and by b, and of the mixed one.
        """
        rate_a, rate_b = rates
        (G_a, _), (G_b, _), (G, s) = rate_a, rate_b, second_rate
        # cof F alone is differentiated: by one amplitude and by the other, and by the mixed
        # derivative G of its argument
        by_both = 2 * tau**2 * _cofactor(G_a, G_b)
        by_F = (by_both + 2 * tau * _cofactor(F, G)) * flux
        # cof F is differentiated by one amplitude, the flux by the other
        mixed = [
            2 * tau * _cofactor(F, G_a) * self._flux(*rate_b),
            2 * tau * _cofactor(F, G_b) * self._flux(*rate_a),
        ]
        return np.asarray(by_F + sum(mixed) + _cofactor(F, F) * self._flux(G, s))

    def _flux(self, G: Array, s: Array) -> Array:
        """Return the integral (3, 3) of u n^T over the lid for u = G y + s."""
        return np.asarray(G @ self.moment + np.outer(s, self.area))


def _cofactor(X: Array, Y: Array) -> Array:
    """Return the symmetric bilinear form of X and Y (3, 3) whose value for X = Y = F is cof F."""
    trace = np.trace(X) * np.trace(Y) - np.trace(X @ Y)
    return np.asarray((X @ Y + Y @ X - np.trace(X) * Y - np.trace(Y) * X + trace * np.eye(3)).T / 2)


@dataclass(frozen=True)
class EdgePressure:
    """The part of a live pressure with a potential that acts at edges that move.

    Attributes
    ----------
    load
        Name of the amplitude of the pressure.
    unit
        The pressure that the amplitude 1 stands for.
    lids
        Lids on edges that are closed.
    curves
        The moving edges.
    """

    load: str
    unit: float
    lids: Sequence[Lid]
    curves: Sequence[EdgeCurve] = ()

    def swept_volume(self, mu: Amplitudes) -> float:
        """Return the volume that the lids sweep."""
        of_lids = (lid.swept_volume(mu) for lid in self.lids)
        return sum(volume for volume, _, _ in of_lids)

    def volume_slope(self, mu: Amplitudes, name: str) -> float:
        """Return the derivative of the swept volume by an amplitude."""
        of_lids = (lid.swept_volume(mu) for lid in self.lids)
        return sum(slopes.get(name, 0.0) for _, slopes, _ in of_lids)

    def volume_curvature(self, mu: Amplitudes, name: str, other: str) -> float:
        """Return the second derivative of the swept volume by two amplitudes."""
        of_lids = (lid.swept_volume(mu) for lid in self.lids)
        return sum(curvatures.get((name, other), 0.0) for _, _, curvatures in of_lids)

    def edge_forces(self, x0: Array, u: Array) -> Array:
        """Return nodal forces (nodes, 3) of the unit pressure on the moving edges.

        The forces that the derivative of the swept volume gives are not part of them. An edge that
        moves straight by u sweeps a ribbon. Where a node moves further by v, the volume between the
        two ribbons is the integral of v . u x (x0/2 + u/3)' along the edge.

        Parameters
        ----------
        x0, u
            (nodes, 3): undeformed places and displacements of all local nodes.
        """
        forces = np.zeros_like(x0)
        for curve in self.curves:
            tangent = curve.derivative(x0) / 2 + curve.derivative(u) / 3
            ribbon = np.cross(curve.at_points(u), tangent)
            np.add.at(forces, curve.nodes, np.einsum("sqf,sqi->sfi", curve.values, ribbon))
        return self.unit * forces


# Axes of a displacement's components: in the plane of a meridian, or in space.
AXES_OF_COMPONENTS = {2: (0, 2), 3: (0, 1, 2)}


@dataclass(frozen=True)
class RigidBody:
    """Nodes that move together as one rigid body.

    Attributes
    ----------
    motions
        Motions of the body, carried out one after the other.
    dofs
        Local numbers, with ghosts, of the components that are prescribed.
    edge
        Name of the term that holds the normal of a clamped edge; "" without.
    turn
        The rotation in that term; None if no motion turns.
    """

    motions: Sequence[RigidMotion]
    dofs: NDArray[np.int32]
    edge: str = ""
    turn: fem.Constant | None = None

    @property
    def names(self) -> set[str]:
        """Names of the motions' amplitudes."""
        return {motion.name for motion in self.motions}


class PrescribedMotion:
    """The displacement E(mu) of all nodes that move; vectors are local, with ghosts.

    The energy of a clamped edge depends on its normal through Q^T r alone, with the edge's rotation
    Q and the place r = r0 + u. So a change of Q acts like the displacement A r, A = Q dQ^T.

    Parameters
    ----------
    r0
        The reference placement.
    bodies
        The rigid bodies to which the moving nodes belong.
    edge_pressure
        The part of a live pressure at edges that move; None: there is none.

    Attributes
    ----------
    names
        Names of the amplitudes of all motions.
    cells
        (local cells,): whether a node of the cell moves.

    Private fields: `_axes` are the axes of a node's components, two in a meridian, three in space.
    `_places` has for each body the places (dofs, 3) of the nodes of its prescribed components. A
    degree of freedom is numbered by node, then component. `_r0` and `_bodies` are the parameters.
    """

    def __init__(
        self,
        r0: fem.Function,
        bodies: Sequence[RigidBody],
        edge_pressure: EdgePressure | None = None,
    ) -> None:
        """Find the places of the prescribed components, and the cells with nodes that move."""
        self.edge_pressure = edge_pressure
        self._axes = list(AXES_OF_COMPONENTS[r0.function_space.dofmap.index_map_bs])
        self._r0, self._bodies = r0, bodies
        places = vectors_in_space(r0.x.array, len(self._axes))
        self._places = [places[body.dofs // len(self._axes)] for body in bodies]
        self.names = frozenset(name for body in bodies for name in body.names)
        V = r0.function_space
        node_moves = np.zeros(len(r0.x.array) // len(self._axes), dtype=bool)
        for body in bodies:
            node_moves[body.dofs // len(self._axes)] = True
        self.cells = node_moves[V.dofmap.list].any(axis=1)

    def put(self, u: Array, mu: Amplitudes) -> None:
        """Write E(mu) into a local displacement, at the nodes that move."""
        for body, places in zip(self._bodies, self._places, strict=True):
            displacement = apply_motions(body.motions, mu, places).x - places
            u[body.dofs] = self._components(body, displacement)

    def turn(self, mu: Amplitudes) -> None:
        """Write the rotations Q^T into the terms of clamped edges; missing amplitudes are zero.

        The terms measure the normal in the frame that turns with the edge.
        """
        for body in self._bodies:
            if body.turn is not None:
                amplitudes = dict.fromkeys(body.names, 0.0) | dict(mu)
                body.turn.value[:] = total_rotation(body.motions, amplitudes).x.T

    def rate(self, mu: Amplitudes, name: str) -> Array:
        """Return dE/dmu by the amplitude `name`, zero at nodes that do not move with it."""
        rates = np.zeros(len(self._r0.x.array))
        for body, places in self._bodies_moved_by(name):
            velocity = apply_motions(body.motions, mu, places).slopes[name]
            rates[body.dofs] = self._components(body, velocity)
        return rates

    def bend(self, mu: Amplitudes, name: str, other: str) -> Array:
        """Return d2E/dmu_i dmu_j by two amplitudes, zero at nodes that do not move with both."""
        bends = np.zeros(len(self._r0.x.array))
        for body, places in self._bodies_moved_by(name, other):
            curvature = apply_motions(body.motions, mu, places).curvatures[name, other]
            bends[body.dofs] = self._components(body, curvature)
        return bends

    def edge_forces(self, u: Array) -> Array:
        """Return the nodal forces of the unit pressure on edges that move, as a local vector.

        They are zero without a live pressure there.
        """
        if not (self.edge_pressure and self.edge_pressure.curves):
            return np.zeros_like(u)
        x0 = self._r0.x.array.reshape(-1, 3)
        return self.edge_pressure.edge_forces(x0, u.reshape(-1, 3)).ravel()

    def turning(self, mu: Amplitudes, name: str) -> Iterator[tuple[str, Array]]:
        """Iterate over the clamped edges that a motion turns.

        Yields
        ------
        The name of the edge's term, and A = Q dQ^T/dmu (3, 3).
        """
        for body, _ in self._bodies_moved_by(name):
            if body.turn is not None:
                rotation = total_rotation(body.motions, mu)
                yield body.edge, rotation.x.T @ rotation.slopes[name]

    def turning_twice(self, mu: Amplitudes, pair: AmplitudePair) -> Iterator[tuple[str, Array]]:
        """Iterate over the clamped edges that both motions of a pair turn.

        Yields
        ------
        The name of the edge's term, and dA_i/dmu_j (3, 3).
        """
        for body, _ in self._bodies_moved_by(*pair):
            if body.turn is not None:
                rotation = total_rotation(body.motions, mu)
                i, j = pair
                product = rotation.slopes[j].T @ rotation.slopes[i]
                yield body.edge, product + rotation.x.T @ rotation.curvatures[pair]

    def spin_displacement(self, A: Array, u: Array) -> Array:
        """Return the displacement A r of all nodes, r = r0 + u, for a matrix A (3, 3)."""
        return self.transform(A, self._r0.x.array + u)

    def transform(self, A: Array, v: Array) -> Array:
        """Return a matrix A (3, 3) times the vectors of all nodes, as a local vector."""
        vectors = vectors_in_space(v, len(self._axes)) @ A.T
        return np.ascontiguousarray(vectors[:, self._axes]).ravel()

    def _bodies_moved_by(self, *names: str) -> Iterator[tuple[RigidBody, Array]]:
        """Iterate over the bodies that all these motions move, with the places of their nodes."""
        for body, places in zip(self._bodies, self._places, strict=True):
            if body.names.issuperset(names):
                yield body, places

    def _components(self, body: RigidBody, vectors: Array) -> Array:
        """Return the prescribed component of each vector.

        Parameters
        ----------
        vectors
            (n, 3): one for each of the body's n prescribed degrees of freedom.
        """
        axes = np.array(self._axes)[body.dofs % len(self._axes)]  # of each degree of freedom
        return np.asarray(vectors[np.arange(len(axes)), axes])


def vectors_in_space(v: Array, components: int) -> Array:
    """Return nodal vectors in space, from those in space or in a meridian's plane.

    Parameters
    ----------
    v
        (n * components,): nodal values.
    components
        3 in space, 2 in the plane of e1 and e3.

    Returns
    -------
    (n, 3) vectors.
    """
    vectors = np.zeros((len(v) // components, 3))
    vectors[:, AXES_OF_COMPONENTS[components]] = v.reshape(-1, components)
    return vectors
