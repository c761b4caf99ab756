"""T-junctions: an edge of one shell that stands on another one, and moves and turns with it.

Points of the edge, as many on each side of a triangle as the degree and on a meridian one, are tied
to the places of the other mid-surface at which they are undeformed. So the edge follows the other
shell, whose own displacements stay free: cells need not meet. Both ties are springs, `TIGHT` times
as stiff as an element beside them. With n of the edge's cell and m of the other shell, t along the
edge, s = t . (n x m) and c = n . m:

    k/2 |u - u'|^2 + (q/2) (angle of (c c0 + s s0, s c0 - c s0))^2        per undeformed length.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import TYPE_CHECKING, Self

import basix
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from scipy.linalg import block_diag
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.connected import CellsOfAll, add_own, whole
from magshell_fenicsx.assembly.coupled import Entries, pairs_of
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.point_kernels import (
    PointKernel,
    Points,
    point_gradient,
    point_values,
    whole_hessian,
)
from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.mesh.patch import MeshError, place_text
from magshell_fenicsx.models.axisymmetric.meridian import Meridian
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.parts.joints import Joint
from magshell_fenicsx.parts.touching.nearest import Cells, places_near
from magshell_fenicsx.platform import compat

if TYPE_CHECKING:
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
TIGHT = 1e4  # stiffness of a tie over that of an element
NEAR = 2e-9  # of a parameter: rounding
APART = (
    0.05  # thicknesses: a place of the edge that is farther from the other mid-surface is not on it
)
SIDES = np.array([[1, 2], [0, 2], [0, 1]])
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
AROUND = 1.2  # of the radius of a cell's nodes about their centre, that of all of it
PARTS = 12  # of both tangents of both shells at a point
AROUND_E3 = np.array(
    [[[1, 0], [0, 0], [0, 1]], [[0, 0], [1, 0], [0, 0]]]
)  # (U, W) -> vector and its derivative


class Tie:
    """Points of an edge tied to places of another shell: an `assembly.terms.Term` and
    `assembly.coupled.Coupled`.

    Parameters
    ----------
    unknowns
        (n, k) global numbers of those on which each point depends.
    gap, tangents
        (n, 3, k) and (n, 12, k): what makes of these u - u', and both tangents of both shells.
    along
        (n, 2) the edge's direction in the coordinates of its cell.
    stiffness
        (n, 2) of both ties.
    """

    amplitude = None
    column = "bending"

    def __init__(
        self,
        joint: Joint,
        r0: fem.Function,
        u: fem.Function,
        unknowns: Longs,
        gap: Array,
        tangents: Array,
        along: Array,
        stiffness: Array,
        log: KernelLog,
    ) -> None:
        V = u.function_space
        self._comm, self._u, self._size = V.mesh.comm, u, V.dofmap.bs
        index = V.dofmap.index_map
        self._own = self._size * index.local_range[0], self._size * index.size_local
        self.name = self.group = f"joint of {' and '.join(joint.edges)}"
        self._unknowns, self._gaps, self._tangents, self._tie = (
            unknowns,
            gap,
            tangents,
            stiffness[:, 0],
        )
        self._turns = bool(joint.rigid or joint.stiffness)
        self._points = Points(max(len(unknowns), 1))
        self._present, self._moved = self._points.field(PARTS), self._points.field(PARTS)
        # direction along the edge, sine and cosine of the placement, stiffness
        self._fixed = fixed = self._points.field(5)
        angle = _angle(self._present, self._moved, fixed)
        sine = angle[0] * fixed[3] - angle[1] * fixed[2]
        cosine = angle[1] * fixed[3] + angle[0] * fixed[2]
        W = fixed[4] / 2 * ufl.atan2(sine, cosine) ** 2
        self._moved.x.array[:] = 0.0
        self._kernels: Mapping[str, PointKernel] = {
            "angle": point_values("T-junction angle", angle, log),
            "energy": point_values("T-junction energy", W, log),
            "gradient": point_gradient("T-junction gradient", [(W, self._moved)], log),
            "hessian": whole_hessian("T-junction Hessian", W, self._moved, log),
        }
        self._placed = self._times(tangents, whole(r0))
        values = fixed.x.array.reshape(-1, 5)[: len(unknowns)]
        values[:, :2], values[:, 4] = along, stiffness[:, 1]
        values[:, 2:4] = self._at("angle", 0 * whole(r0))

    # as a term

    def compile_residual(self) -> None:
        """Its kernels are compiled."""

    def compile_tangent(self) -> None:
        """Its kernels are compiled."""

    def energy(self) -> float:
        u = whole(self._u)
        tied = float(self._tie @ np.sum(self._times(self._gaps, u) ** 2, axis=1)) / 2
        return tied + (float(self._at("energy", u).sum()) if self._turns else 0.0)

    def add_residual(self, b: Array, factor: float) -> None:
        u = whole(self._u)
        residual = np.zeros(u.size)
        forces = np.einsum(
            "nc,nck->nk", self._tie[:, None] * self._times(self._gaps, u), self._gaps
        )
        if self._turns:
            forces += np.einsum("nc,nck->nk", self._at("gradient", u), self._tangents)
        np.add.at(residual, self._unknowns, factor * forces)
        add_own(b, residual, self._own, self._comm)

    def add_tangent(self, K: object, factor: float, clamped: object) -> None:
        """None here: what assembles the others adds `entries`."""

    def entries(self) -> Entries:
        return _entries(self._unknowns, self._second(self._gaps, self._tangents))

    def around(self) -> tuple[Longs, Longs]:
        """See `Coupled`: those that act on each other always do."""
        return pairs_of(self._unknowns[:, :: self._size] // self._size)

    @property
    def since(self) -> float:
        """See `Coupled`."""
        return 0.0

    def _second(self, gap: Array, tangents: Array) -> Array:
        """(n, k, k) the second variation at the present u, along what these make of any k unknowns;
        collective.
        """
        H, u = np.einsum("n,nck,ncl->nkl", self._tie, gap, gap, optimize=True), whole(self._u)
        if self._turns and len(H):
            of_parts = np.zeros((len(H), PARTS, PARTS))
            upper = np.triu_indices(PARTS)
            of_parts[:, upper[0], upper[1]] = of_parts[:, upper[1], upper[0]] = self._at(
                "hessian", u
            )
            H += np.einsum("nik,nij,njl->nkl", tangents, of_parts, tangents, optimize=True)
        return np.asarray(H)

    def _times(self, maps: Array, u: Array) -> Array:
        """(n, c) what maps (n, c, k) make of the values (nodes, components) of all nodes."""
        return np.asarray(np.einsum("nck,nk->nc", maps, u.ravel()[self._unknowns]))

    def _at(self, kernel: str, u: Array) -> Array:
        """(n, ..) what a kernel gives at the points, with this displacement (nodes, components) of
        all nodes.
        """
        count = len(self._unknowns)
        self._present.x.array[: count * PARTS] = (
            self._placed + self._times(self._tangents, u)
        ).ravel()
        return np.array(self._points.evaluate(self._kernels[kernel], count))


class Tee(Tie):
    """The junction of two surfaces.

    Parameters
    ----------
    foot
        Local facets of the edge.
    on
        Whether each cell of this rank, ghosts included, belongs to the other shell.
    stiffness
        (cells of this rank, 2) E h and E h^3 of each over those of the first shell.

    Raises
    ------
    MeshError
        On every rank, if the edge is not on the other shell; the message begins with `key`.
    """

    def __init__(
        self,
        joint: Joint,
        key: str,
        r0: fem.Function,
        u: fem.Function,
        foot: NDArray[np.int32],
        on: NDArray[np.bool_],
        stiffness: Array,
        material: Material,
        log: KernelLog,
    ) -> None:
        surfaces = Surfaces.of(r0)
        at = surfaces.foot_of(foot, on)
        at.refuse_misplaced(r0.function_space.mesh.comm, material.h, key, joint)
        nodes = surfaces.cells.nodes
        both = np.concatenate([nodes[at.cell], nodes[at.other_cell]], axis=1)
        of_cells = surfaces.cells.gathered(stiffness)
        half, axes, count = nodes.shape[1], np.eye(3), 3 * both.shape[1]  # a rank may have no point
        on_other = surfaces.shapes(at.Y)
        D = np.zeros((len(at.x), 4, both.shape[1]))
        D[:, :2, :half], D[:, 2:, half:] = (
            N[1:].transpose(1, 0, 2) for N in (at.on_edge, on_other)
        )
        beta = np.concatenate([at.on_edge[0], -on_other[0]], axis=1)
        super().__init__(
            joint,
            r0,
            u,
            (3 * both[:, :, None] + np.arange(3)).reshape(len(at.x), count),
            np.einsum("nk,cd->nckd", beta, axes).reshape(len(at.x), 3, count),
            np.einsum("nik,cd->nickd", D, axes).reshape(len(at.x), PARTS, count),
            at.along,
            _stiff(
                joint,
                material,
                np.maximum(of_cells[at.cell], of_cells[at.other_cell]),
                at.length,
                at.weight,
            ),
            log,
        )


@dataclass(frozen=True)
class Foot:
    """Points (n, 3) of an edge, and the places of another shell that are nearest to them.

    Attributes
    ----------
    cell, other_cell
        (n,) global numbers of the cells of both.
    on_edge
        (3, n, functions): shape functions of the edge's cells at the points, and their derivatives.
    x
        The points, undeformed.
    along
        (n, 2) the edge's direction in the coordinates of its cell.
    weight, length
        (n,) the length for which a point stands, and that of its cell's side.
    Y, apart
        (n, 2) the places in their cells, and (n,) their distances, inf without a cell.
    clearance
        Greatest distance from the other shell of all nodes of a cell beside the edge, the least of
        these cells.
    """

    cell: Longs
    on_edge: Array
    x: Array
    along: Array
    weight: Array
    length: Array
    other_cell: Longs
    Y: Array
    apart: Array
    clearance: float

    def refuse_misplaced(self, comm: MPI.Comm, h: float, key: str, joint: Joint) -> None:
        """See that the edge is on the other shell, and its own shell is not; collective.

        Raises
        ------
        MeshError
            On every rank, with the place and how far it is.
        """
        _refuse_apart(comm, self.apart, self.x, h, key, joint)
        if min(comm.allgather(self.clearance)) < APART * h:
            foot, other = joint.edges
            raise MeshError(
                f"{key}: the shell of the edge {foot} lies in the mid-surface of {other}, where both take the same "
                "place: turn it out, or join edges of both"
            )


@dataclass(frozen=True)
class Surfaces:
    """The undeformed mid-surfaces of all shells, whole on every rank.

    Attributes
    ----------
    cells
        Of all ranks.
    r0
        (nodes, 3) places.
    """

    V: fem.FunctionSpace
    cells: CellsOfAll
    r0: Array

    @classmethod
    def of(cls, r0: fem.Function) -> Self:
        """Those of a placement; collective."""
        return cls(r0.function_space, CellsOfAll.of(r0.function_space), whole(r0))

    @property
    def _element(self) -> basix.finite_element.FiniteElement:
        return self.V.element.basix_element

    def shapes(self, X: Array) -> Array:
        """Return (3, n, functions): shape functions at places and their derivatives."""
        return np.asarray(self._element.tabulate(1, X)[..., 0])

    def foot_of(self, facets: NDArray[np.int32], on: NDArray[np.bool_]) -> Foot:
        """Return the foot of an edge on another shell; collective.

        Parameters
        ----------
        facets
            Local ones of the edge.
        on
            Which local cells are of the other shell.
        """
        first, nodes = self.cells.own.start, self.cells.nodes
        cells, ends = _sides(self.V, facets, len(self.cells.own))
        s, weights = basix.make_quadrature(basix.CellType.interval, 2 * self._element.degree - 1)
        X = ends[:, None, 0] + s[None, :, :1] * (ends[:, None, 1] - ends[:, None, 0])
        along = np.repeat(ends[:, 1] - ends[:, 0], len(s), axis=0)
        cell = np.repeat(first + cells, len(s))
        on_edge = self.shapes(X.reshape(-1, 2))
        x = np.einsum("nk,nki->ni", on_edge[0], self.r0[nodes[cell]])
        tangent = np.einsum("na,ank,nki->ni", along, on_edge[1:], self.r0[nodes[cell]])
        weight = np.tile(weights, len(cells)) * np.linalg.norm(tangent, axis=1)
        length = np.repeat(np.sum(weight.reshape(-1, len(s)), axis=1), len(s))
        shell = np.flatnonzero(self.cells.gathered(on))
        other, Y, apart = self.nearest_places(x, shell)
        beside = self.r0[nodes[first + cells]]
        far = self.nearest_places(beside.reshape(-1, 3), shell)[2].reshape(beside.shape[:2])
        clearance = float(far.max(axis=1, initial=0.0).min(initial=np.inf))
        return Foot(cell, on_edge, x, along, weight, length, other, Y, apart, clearance)

    def nearest_places(self, x: Array, cells: Longs) -> tuple[Longs, Array, Array]:
        """For points (n, 3) the nearest of some cells, the place in it (n, 2), and the distance,
        inf without a cell.
        """
        from scipy.spatial import cKDTree  # takes long to import

        nearest, Y, apart = (
            np.zeros(len(x), dtype=np.int64),
            np.zeros((len(x), 2)),
            np.full(len(x), np.inf),
        )
        nodal = self.r0[self.cells.nodes[cells]]
        centres = nodal.mean(axis=1)
        radii = AROUND * np.linalg.norm(nodal - centres[:, None], axis=2).max(axis=1)
        near = (
            cKDTree(centres).query_ball_point(x, 2 * radii.max()) if len(cells) else [[]] * len(x)
        )
        point = np.repeat(np.arange(len(x)), [len(numbers) for numbers in near])
        which = np.concatenate([np.asarray(numbers, dtype=np.int64) for numbers in (*near, [])])
        if not len(point):
            return nearest, Y, apart
        surface = Cells(
            self._element, self.cells.nodes[cells], np.zeros((len(cells), 3), dtype=np.int64)
        )
        each = which, np.arange(len(which)), np.ones(len(which), dtype=np.int64), point
        pair, at = places_near(surface, self.r0, x, each, np.inf)
        point, which, foot, distance = at.point, which[pair], at.X, at.distance
        order = np.lexsort((cells[which], np.round(distance, 12), point))  # of equal ones the first
        best = order[np.flatnonzero(np.diff(point[order], prepend=-1))]
        nearest[point[best]], Y[point[best]], apart[point[best]] = (
            cells[which[best]],
            foot[best],
            distance[best],
        )
        return nearest, Y, apart


class MeridianTee(Tie):
    """The junction of two meridians, which are `Tie`d at one point.

    Parameters
    ----------
    tied
        The parameters of both.
    stiffness
        See `Tee`.
    """

    def __init__(
        self,
        joint: Joint,
        key: str,
        r0: fem.Function,
        u: fem.Function,
        tied: tuple[float, float],
        stiffness: Array,
        material: Material,
        log: KernelLog,
    ) -> None:
        V = r0.function_space
        ends, dofs = _ends_of_cells(V), V.dofmap.list
        cells, self._shapes = _rings(V, tied)
        self._nodes = dofs[np.concatenate(cells)].reshape(1, -1).astype(np.int64)
        nodal = r0.x.array.reshape(-1, 2)
        rho = _refuse_rings_apart(r0, tied, material.h, key, joint)
        foot = int(cells[0][0])
        length = np.abs(ends[foot, 1] - ends[foot, 0]) * np.linalg.norm(
            self._shapes[0][1] @ nodal[dofs[foot]]
        )
        stiff = stiffness[np.concatenate(cells)].max(axis=0, keepdims=True)
        ties = _stiff(joint, material, stiff, np.array([length]), 2 * np.pi * np.array([rho]))
        of_u = self._numbers(2), *self._maps(AROUND_E3)
        super().__init__(joint, r0, u, *of_u, np.array([[0.0, 1.0]]), ties, log)

    def entries_of_waves(self, m: float) -> Entries:
        """Those of the second variation along waves, by the coefficients (U + V, V, W), as
        `shells.waves` has it.
        """
        cosine = np.array([[[1, 0, 0], [0, 0, 0], [0, 0, 1]], [[0, 0, 0], [1, m, 0], [0, 0, 0]]])
        sine = np.array([[[0, 0, 0], [0, 1, 0], [0, 0, 0]], [[-m, -1, 0], [0, 0, 0], [0, 0, -m]]])
        U_from_P = np.array([[1, -1, 0], [0, 1, 0], [0, 0, 1]])
        H = sum(self._second(*self._maps(part @ U_from_P)) for part in (cosine, sine))
        return _entries(self._numbers(3), np.asarray(H / 2))

    def _numbers(self, size: int) -> Longs:
        return np.asarray(size * self._nodes[:, :, None] + np.arange(size)).reshape(1, -1)

    def _maps(self, of: Array) -> tuple[Array, Array]:
        """`gap` and `tangents`; `of` (2, 3, c) makes of a node's numbers its vector, and the
        derivative around e3.
        """
        value, around = of
        places, tangents = [], []
        for N, along in self._shapes:
            places.append(np.kron(N, value))
            tangents.append(np.vstack([np.kron(along, value), np.kron(N, around)]))
        return np.hstack([places[0], -places[1]])[None], block_diag(*tangents)[None]


def _ends_of_cells(V: fem.FunctionSpace) -> Array:
    """Return the parameters (cells, 2) of the ends of a meridian's cells."""
    return np.asarray(V.mesh.geometry.x[compat.corner_numbers(V.mesh), 0])


def _rings(
    V: fem.FunctionSpace, tied: tuple[float, float]
) -> tuple[list[Longs], list[tuple[Array, Array]]]:
    """Return the cells at both parameters of a junction, with their shape functions there and
    slopes, all in one row."""
    ends, shapes = _ends_of_cells(V), []
    inside = [(ends.min(axis=1) < s + NEAR) & (s - NEAR < ends.max(axis=1)) for s in tied]
    cells = [
        np.flatnonzero(of) for of in inside
    ]  # a place on a vertex is tied to by the mean of two cells
    for s, of in zip(tied, cells, strict=True):
        lengths = (ends[of, 1] - ends[of, 0])[:, None]
        N, slopes = V.element.basix_element.tabulate(1, (s - ends[of, :1]) / lengths)[..., 0] / len(
            of
        )
        shapes.append((N.ravel(), (slopes / lengths).ravel()))
    return cells, shapes


def _refuse_rings_apart(
    r0: fem.Function, tied: tuple[float, float], h: float, key: str, joint: Joint
) -> float:
    """Return the radius of the ring of an edge, which must be on the other shell.

    Raises
    ------
    MeshError
        If it is not.
    """
    V, nodal = r0.function_space, r0.x.array.reshape(-1, 2)
    cells, shapes = _rings(V, tied)
    (rho, z), other = (
        N @ nodal[V.dofmap.list[of].ravel()] for (N, _), of in zip(shapes, cells, strict=True)
    )
    apart = np.array([np.hypot(*(other - [rho, z]))])
    _refuse_apart(V.mesh.comm, apart, np.array([[rho, 0.0, z]]), h, key, joint)
    return float(rho)


def refuse_misplaced_rings(
    joints: Sequence[Joint], meridian: Meridian, r0: fem.Function, h: float
) -> None:
    """See that the edges of T-junctions are on the other shell, as a model of the meridian does.

    Raises
    ------
    MeshError
        With the edge.
    """
    for i, (joint, s, of) in enumerate(zip(joints, meridian.tied, meridian.joints, strict=True)):
        if of is None:
            _refuse_rings_apart(r0, s, h, f"joints.{i}.edges", joint)


def _entries(unknowns: Longs, H: Array) -> Entries:
    rows, columns = np.broadcast_arrays(unknowns[:, :, None], unknowns[:, None, :])
    return rows.ravel(), columns.ravel(), H.ravel()


def _stiff(joint: Joint, material: Material, factors: Array, length: Array, weight: Array) -> Array:
    """(n, 2) stiffness of both ties at points that stand for a length `weight`, of cells with sides
    of that length.
    """
    turned = (
        TIGHT * factors[:, 1] * material.bending_stiffness / length
        if joint.rigid
        else joint.stiffness
    )
    return np.column_stack([weight * TIGHT * factors[:, 0] / length, weight * turned])


def _refuse_apart(comm: MPI.Comm, apart: Array, x: Array, h: float, key: str, joint: Joint) -> None:
    worst = int(apart.argmax()) if len(apart) else -1
    of_rank = (float(apart[worst]), x[worst]) if len(apart) else (0.0, np.zeros(3))
    far, place = max(comm.allgather(of_rank), key=lambda distance_and_place: distance_and_place[0])
    if far > APART * h:
        foot, other = joint.edges
        by = f"by {far:.4g} R" if np.isfinite(far) else "by more than a cell"
        raise MeshError(
            f"{key}: the edge {foot} is not on the mid-surface of {other}, {by} at {place_text(place)}, over R: "
            "move one of the shells"
        )


def _sides(V: fem.FunctionSpace, facets: NDArray[np.int32], owned: int) -> tuple[Longs, Array]:
    """Local cells of this rank that have boundary facets, and both ends (n, 2, 2) of each in the
    reference cell.
    """
    topology = V.mesh.topology
    topology.create_connectivity(1, 2)
    topology.create_connectivity(2, 1)
    to_cell, to_facet = topology.connectivity(1, 2), topology.connectivity(2, 1)
    cells, ends = list[int](), list[Array]()
    for facet in facets:
        cell = int(to_cell.links(facet)[0])
        if cell < owned:
            cells.append(cell)
            ends.append(CORNERS[SIDES[int(np.flatnonzero(to_facet.links(cell) == facet)[0])]])
    return np.array(cells, dtype=np.int64), np.array(ends).reshape(-1, 2, 2)


def _angle(tangents: fem.Function, moved: fem.Function, along: fem.Function) -> Expr:
    """Sine and cosine of the angle between both normals about the edge, whose direction is the
    first two of `along`.
    """
    a1, a2, b1, b2 = (
        ufl.as_vector([tangents[3 * i + c] + moved[3 * i + c] for c in range(3)]) for i in range(4)
    )

    def unit(v: Expr) -> Expr:
        return v / ufl.sqrt(ufl.dot(v, v))

    n, m, t = unit(ufl.cross(a1, a2)), unit(ufl.cross(b1, b2)), unit(along[0] * a1 + along[1] * a2)
    return ufl.as_vector([ufl.dot(ufl.cross(n, m), t), ufl.dot(n, m)])


def _tee_joints(
    joints: Sequence[Joint], surface: Midsurface
) -> list[tuple[Joint, str, NDArray[np.bool_]]]:
    """Return the joints that are T-junctions, with their keys and which cells of this rank the
    other shell has."""
    pairs = enumerate(zip(joints, surface.joints, strict=True))
    tied = [
        (joint, f"joints.{i}.edges", surface.patches[joint.edges[1]])
        for i, (joint, of) in pairs
        if of is None
    ]
    return [
        *tied,
        *(
            (Joint((name, "the sheet"), rigid=True), "shell.file", on)
            for name, on in surface.feet.items()
        ),
    ]


def refuse_misplaced_feet(
    joints: Sequence[Joint], surface: Midsurface, r0: fem.Function, h: float
) -> None:
    """See that the edges of T-junctions are on the other shell, as a model does; collective.

    Raises
    ------
    MeshError
        On every rank, with the edge.
    """
    tied = _tee_joints(joints, surface)
    surfaces = Surfaces.of(r0) if tied else None
    for joint, key, on in tied:
        assert surfaces
        surfaces.foot_of(surface.edges[joint.edges[0]], on).refuse_misplaced(
            r0.function_space.mesh.comm, h, key, joint
        )
    refuse_coinciding_shells(tied, surface, r0, h)


def refuse_coinciding_shells(
    tied: Sequence[tuple[Joint, str, NDArray[np.bool_]]],
    surface: Midsurface,
    r0: fem.Function,
    h: float,
) -> None:
    """Refuse two shells that stand on a third one in the same place; collective.

    Parameters
    ----------
    tied
        T-junctions, their keys, and the cells of this rank of the shell that is stood on.

    Raises
    ------
    MeshError
        On every rank, with both edges.
    """
    for (joint, key, _), (other_joint, _, _) in permutations(tied, 2):
        edge, other_edge = joint.edges[0], other_joint.edges[0]
        shell, other = (_shell_of(name, surface) for name in (edge, other_edge))
        if shell == other or other is None:
            continue
        foot = Surfaces.of(r0).foot_of(surface.edges[edge], surface.patches[other])
        if min(r0.function_space.mesh.comm.allgather(foot.clearance)) < APART * h:
            raise MeshError(
                f"{key}: the shells of the edges {edge} and {other_edge} lie in each other: leave "
                "one of them out, or move it"
            )


def _shell_of(edge: str, surface: Midsurface) -> str | None:
    """Return the name of the shell of an edge, which begins with it; None of a mesh file's edge."""
    return next(
        (name for name in surface.patches if edge.startswith((f"{name}.", f"{name}_"))), None
    )


def tees(model: "ShellModel") -> list[Tee]:
    """The T-junctions of a model; collective."""
    surface = model.midsurface
    tied = _tee_joints(model.loads.joints, surface)
    if not tied:
        return []
    refuse_coinciding_shells(tied, surface, model.r0, model.material.h)
    edges, factors, log = surface.edges, _factors(model), model.kernels
    return [
        Tee(joint, key, model.r0, model.u, edges[joint.edges[0]], on, factors, model.material, log)
        for joint, key, on in tied
    ]


def tees_of_meridian(model: "MeridianModel") -> list[MeridianTee]:
    """The same of a meridian."""
    meridian, factors, log = model.meridian, _factors(model), model.kernels
    tied = enumerate(zip(model.loads.joints, meridian.tied, meridian.joints, strict=True))
    return [
        MeridianTee(joint, f"joints.{i}.edges", model.r0, model.u, s, factors, model.material, log)
        for i, (joint, s, of) in tied
        if of is None
    ]


def _factors(model: "ShellModel | MeridianModel") -> Array:
    """(cells of this rank, 2) E h and E h^3 of each over those of the first shell."""
    cells = model.V.mesh.topology.index_map(model.V.mesh.topology.dim)
    factors = np.ones((cells.size_local + cells.num_ghosts, 2))
    if model.thickness is not None:
        t = model.thickness.x.array[model.thickness.function_space.dofmap.list].mean(axis=1)
        factors *= np.column_stack([t, t**3])
    if model.made_of is not None:
        factors *= model.made_of.x.array.reshape(-1, 4)[
            model.made_of.function_space.dofmap.list[:, 0], :1
        ]
    return factors
