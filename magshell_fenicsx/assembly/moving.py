"""Nodes whose displacement is prescribed by rigid motions, edges whose normals turn with them, and
the lids there.

Under a live pressure rigid lids close the shell at edges that move, and the pressure presses on the
edges too. The potential of the pressure is the volume that the surface sweeps when its points move
straight to their places. An edge that moves sweeps with it. With a lid on the edge, which moves as
rigidly, the two volumes add up to the change of the volume enclosed, whatever the shape of the lid:
the lids here are cones.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import basix
import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.motion import Motion, Pair, moved, turned
from magshell_fenicsx.assembly.shape_tables import CORNERS

Array = NDArray[np.float64]
Amplitudes = Mapping[str, float]
Side = tuple[
    Array, Array, tuple[int, int]
]  # its first and last place in the reference cell, and the corners there
HALVES = (
    0.5 - np.sqrt(1 / 12),
    0.5 + np.sqrt(1 / 12),
)  # Gauss points of equal weights, exact for cubic polynomials


@dataclass(frozen=True)
class Curve:
    """Sides of cells on this rank, with the surface on their left.

    Attributes
    ----------
    nodes
        (sides, functions): local numbers.
    values, slopes
        (sides, points, functions): the shape functions at points of a rule; their derivatives along
        times its weights.
    corners
        (sides, 2): the first and the last corner, by numbers that are the same on all ranks.
    """

    nodes: NDArray[np.int32]
    values: Array
    slopes: Array
    corners: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        V: fem.FunctionSpace,
        facets: NDArray[np.int32],
        sides: Mapping[int, Side],
        pressed: Array | None = None,
    ) -> "Curve":
        """Of the facets that this rank owns; `sides` by their numbers in a cell.

        Beside local cells that are `pressed` from inside, where that is -1, the surface is on their
        right.
        """
        topology, element, dim = V.mesh.topology, V.element.basix_element, V.mesh.topology.dim
        for dims in ((dim - 1, dim), (dim, dim - 1), (dim, 0)):
            topology.create_connectivity(*dims)
        facets = facets[facets < topology.index_map(dim - 1).size_local]
        x, weights = (
            np.asarray(each)
            for each in basix.make_quadrature(basix.CellType.interval, 3 * element.degree)
        )
        values, slopes = {}, {}
        for number, (first, last, _) in sides.items():
            table = element.tabulate(1, first + x * (last - first))[..., 0]
            values[number], slopes[number] = (
                table[0],
                weights[:, None] * np.tensordot(last - first, table[1:], 1),
            )
        cells = [int(topology.connectivity(dim - 1, dim).links(facet)[0]) for facet in facets]
        of_cell = topology.connectivity(dim, dim - 1)
        numbers = [
            int(np.flatnonzero(of_cell.links(c) == f)[0])
            for c, f in zip(cells, facets, strict=True)
        ]
        corners = [
            topology.connectivity(dim, 0).links(c)[list(sides[n][2])]
            for c, n in zip(cells, numbers, strict=True)
        ]
        shape = len(cells), len(weights), element.dim
        turned = np.ones(len(cells)) if pressed is None else pressed[cells]
        return cls(
            V.dofmap.list[cells],
            np.reshape([values[n] for n in numbers], shape),
            turned[:, None, None] * np.reshape([slopes[n] for n in numbers], shape),
            topology.index_map(0)
            .local_to_global(np.array(corners, dtype=np.int32).ravel())
            .reshape(-1, 2),
        )

    def at(self, x: Array) -> Array:
        """(sides, points, 3) of vectors (nodes, 3)."""
        return np.asarray(self.values @ x[self.nodes])

    def along(self, x: Array) -> Array:
        """The derivatives along, times the weights, (sides, points, 3)."""
        return np.asarray(self.slopes @ x[self.nodes])


def triangle_sides() -> dict[int, Side]:
    """The sides of a triangle, which is on their left."""
    return {
        i: (CORNERS[a], CORNERS[b], (a, b)) for i, (a, b) in enumerate(((1, 2), (2, 0), (0, 1)))
    }


def level_sides(height: float) -> dict[int, Side]:
    """Lines on the side faces of a hexahedron at a height, 0 to 1; the face above is on their left."""
    corners = np.array(
        [[0.0, 0.0, height], [1.0, 0.0, height], [0.0, 1.0, height], [1.0, 1.0, height]]
    )
    return {
        i: (corners[a], corners[b], (a, b))
        for i, (a, b) in {1: (0, 1), 3: (1, 3), 4: (3, 2), 2: (2, 0)}.items()
    }


def ends(curves: Sequence[Curve], comm: MPI.Comm) -> NDArray[np.int64]:
    """Corners at which curves begin or end, none where they are closed; collective."""
    own = np.concatenate([np.empty(0, np.int64), *(curve.corners.ravel() for curve in curves)])
    corners, count = np.unique(np.concatenate(comm.allgather(own)), return_counts=True)
    return np.asarray(corners[count % 2 == 1])


@dataclass(frozen=True)
class Lid:
    """A surface that closes an edge and moves with it.

    Attributes
    ----------
    motions
        One after the other.
    origin
        (3,): the apex of the cone.
    area, moment
        The integrals of n, (3,), and of y n^T, (3, 3), over the lid; y is counted from the origin.
    """

    motions: Sequence[Motion]
    origin: Array
    area: Array
    moment: Array

    @classmethod
    def over(
        cls,
        curves: Sequence[Curve],
        x: Array,
        motions: Sequence[Motion],
        origin: Array,
        comm: MPI.Comm,
    ) -> "Lid":
        """The cone over curves through nodes at x (nodes, 3); collective."""
        area, moment = np.zeros(3), np.zeros((3, 3))
        for curve in curves:
            y = curve.at(x) - origin
            normal = np.cross(y, curve.along(x))
            area -= normal.sum(axis=(0, 1)) / 2
            moment -= np.einsum("sqi,sqj->ij", y, normal) / 3
        return cls(motions, origin, comm.allreduce(area), comm.allreduce(moment))

    @classmethod
    def over_ring(cls, rho: float, motions: Sequence[Motion], *, last: bool) -> "Lid":
        """On the first or the last end of a meridian, whose motions are along e3."""
        area = np.array([0.0, 0.0, np.pi * rho**2])
        return cls(motions, np.zeros(3), -area if last else area, np.zeros((3, 3)))

    def swept(self, mu: Amplitudes) -> tuple[float, dict[str, float], dict[Pair, float]]:
        """The volume that it sweeps when its points move straight to their places; first and second
        derivatives.
        """
        turn, place = turned(self.motions, mu), moved(self.motions, mu, self.origin[None])
        whole = turn.x.T - np.eye(3), place.x[0] - self.origin  # u = G y + s
        by = {name: (turn.by[name].T, place.by[name][0]) for name in turn.by}
        twice = {pair: (turn.twice[pair].T, place.twice[pair][0]) for pair in turn.twice}
        volume, first, second = 0.0, dict.fromkeys(by, 0.0), dict.fromkeys(twice, 0.0)
        for tau in HALVES:
            F = np.eye(3) + tau * whole[0]
            own = self._pressed(*whole)
            volume += float((_cofactor(F, F) * own).sum()) / 2
            for a, (G, s) in by.items():
                bent = 2 * tau * _cofactor(F, G)
                first[a] += float((bent * own + _cofactor(F, F) * self._pressed(G, s)).sum()) / 2
            for (a, b), (G, s) in twice.items():
                bent = 2 * tau**2 * _cofactor(by[a][0], by[b][0]) + 2 * tau * _cofactor(F, G)
                mixed = [
                    2 * tau * _cofactor(F, by[i][0]) * self._pressed(*by[j])
                    for i, j in ((a, b), (b, a))
                ]
                second[a, b] += (
                    float((bent * own + sum(mixed) + _cofactor(F, F) * self._pressed(G, s)).sum())
                    / 2
                )
        return volume, first, second

    def _pressed(self, G: Array, s: Array) -> Array:
        """The integral of u n^T for u = G y + s."""
        return np.asarray(G @ self.moment + np.outer(s, self.area))


def _cofactor(X: Array, Y: Array) -> Array:
    """The bilinear symmetric form of which cof F is the value for X = Y = F."""
    trace = np.trace(X) * np.trace(Y) - np.trace(X @ Y)
    return np.asarray((X @ Y + Y @ X - np.trace(X) * Y - np.trace(Y) * X + trace * np.eye(3)).T / 2)


@dataclass(frozen=True)
class Pressed:
    """What a live pressure with a potential does at edges that move.

    Attributes
    ----------
    load, unit
        The amplitude of the pressure, and what p = 1 in its unit is.
    lids
        On edges that are closed.
    curves
        The edges.
    """

    load: str
    unit: float
    lids: Sequence[Lid]
    curves: Sequence[Curve] = ()

    def swept(self, mu: Amplitudes) -> float:
        """The volume that the lids sweep."""
        return sum(lid.swept(mu)[0] for lid in self.lids)

    def slope(self, mu: Amplitudes, name: str) -> float:
        """Its derivative by an amplitude."""
        return sum(lid.swept(mu)[1].get(name, 0.0) for lid in self.lids)

    def bend(self, mu: Amplitudes, name: str, other: str) -> float:
        """Its second derivative."""
        return sum(lid.swept(mu)[2].get((name, other), 0.0) for lid in self.lids)

    def on_edges(self, x0: Array, u: Array) -> Array:
        """Nodal forces (nodes, 3) of p = 1 on the edges, less those in the derivative of the volume
        that is swept.

        An edge that moves straight by u sweeps a ribbon. Where a node moves further by v, the
        volume between the two ribbons is the integral of v . u x (x0/2 + u/3)' along the edge.
        """
        forces = np.zeros_like(x0)
        for curve in self.curves:
            ribbon = np.cross(curve.at(u), curve.along(x0) / 2 + curve.along(u) / 3)
            np.add.at(forces, curve.nodes, np.einsum("sqf,sqi->sfi", curve.values, ribbon))
        return self.unit * forces


PLANE = {2: (0, 2), 3: (0, 1, 2)}  # the axes of a displacement's components


@dataclass(frozen=True)
class Body:
    """What moves as one rigid body.

    Attributes
    ----------
    motions
        One after the other.
    dofs
        Local numbers, with ghosts, of the components that are prescribed.
    edge
        Name of the term that holds the normal of a clamped edge; "" without.
    turn
        The rotation in that term; None if no motion turns.
    """

    motions: Sequence[Motion]
    dofs: NDArray[np.int32]
    edge: str = ""
    turn: fem.Constant | None = None

    @property
    def names(self) -> set[str]:
        return {motion.name for motion in self.motions}


class Moving:
    """The displacement E(mu) of all nodes that move; vectors are local, with ghosts.

    The energy of a clamped edge depends on its normal through Q^T r alone, Q the edge's rotation.
    So its derivatives by Q are those by the displacement along A r, with A = Q dQ^T.

    Parameters
    ----------
    r0
        The placement.
    pressed
        What a live pressure does at edges that move.
    """

    def __init__(
        self, r0: fem.Function, bodies: Sequence[Body], pressed: Pressed | None = None
    ) -> None:
        self.pressed = pressed
        self._axes = list(PLANE[r0.function_space.dofmap.index_map_bs])
        self._r0, self._bodies = r0, bodies
        places = in_space(r0.x.array, len(self._axes))
        self._places = [places[body.dofs // len(self._axes)] for body in bodies]
        self.names = frozenset(name for body in bodies for name in body.names)
        V = r0.function_space
        still = np.zeros(len(r0.x.array) // len(self._axes), dtype=bool)
        for body in bodies:
            still[body.dofs // len(self._axes)] = True
        self.cells = still[V.dofmap.list].any(axis=1)  # local cells with a node that moves

    def put(self, u: Array, mu: Amplitudes) -> None:
        """Write E(mu) into a displacement."""
        for body, places in zip(self._bodies, self._places, strict=True):
            u[body.dofs] = self._components(body, moved(body.motions, mu, places).x - places)

    def turn(self, mu: Amplitudes) -> None:
        """Write the rotations into the terms of the edges; amplitudes that are not given are zero."""
        for body in self._bodies:
            if body.turn is not None:
                body.turn.value[:] = turned(
                    body.motions, dict.fromkeys(body.names, 0.0) | dict(mu)
                ).x.T

    def rate(self, mu: Amplitudes, name: str) -> Array:
        """dE/dmu."""
        rates = np.zeros(len(self._r0.x.array))
        for body, places in self._with(name):
            rates[body.dofs] = self._components(body, moved(body.motions, mu, places).by[name])
        return rates

    def bend(self, mu: Amplitudes, name: str, other: str) -> Array:
        """d2E/dmu_i dmu_j."""
        bends = np.zeros(len(self._r0.x.array))
        for body, places in self._with(name, other):
            bends[body.dofs] = self._components(
                body, moved(body.motions, mu, places).twice[name, other]
            )
        return bends

    def on_edges(self, u: Array) -> Array:
        """Nodal forces of p = 1 that the derivative of its potential does not have, see
        `Pressed.on_edges`.
        """
        if not (self.pressed and self.pressed.curves):
            return np.zeros_like(u)
        return self.pressed.on_edges(self._r0.x.array.reshape(-1, 3), u.reshape(-1, 3)).ravel()

    def turning(self, mu: Amplitudes, name: str) -> Iterator[tuple[str, Array]]:
        """Edges that the motion turns, each with A = Q dQ^T/dmu (3, 3)."""
        for body, _ in self._with(name):
            if body.turn is not None:
                now = turned(body.motions, mu)
                yield body.edge, now.x.T @ now.by[name]

    def turning_twice(self, mu: Amplitudes, pair: Pair) -> Iterator[tuple[str, Array]]:
        """The same edges with dA_i/dmu_j."""
        for body, _ in self._with(*pair):
            if body.turn is not None:
                now = turned(body.motions, mu)
                yield body.edge, now.by[pair[1]].T @ now.by[pair[0]] + now.x.T @ now.twice[pair]

    def along(self, A: Array, u: Array) -> Array:
        """The displacement A r."""
        return self.times(A, self._r0.x.array + u)

    def times(self, A: Array, v: Array) -> Array:
        """A matrix (3, 3) times the vectors of all nodes."""
        return np.ascontiguousarray((in_space(v, len(self._axes)) @ A.T)[:, self._axes]).ravel()

    def _with(self, *names: str) -> Iterator[tuple[Body, Array]]:
        """Bodies that all these motions move, with the places of their nodes."""
        for body, places in zip(self._bodies, self._places, strict=True):
            if body.names.issuperset(names):
                yield body, places

    def _components(self, body: Body, vectors: Array) -> Array:
        axes = np.array(self._axes)[body.dofs % len(self._axes)]
        return np.asarray(vectors[np.arange(len(axes)), axes])


def in_space(v: Array, components: int) -> Array:
    """Vectors (n, 3) of nodes with all components, or with those of the plane of a meridian."""
    vectors = np.zeros((len(v) // components, 3))
    vectors[:, PLANE[components]] = v.reshape(-1, components)
    return vectors
