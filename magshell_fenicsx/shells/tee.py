"""T-junctions: an edge of one shell that stands on another one, and moves and turns with it.

Points of the edge, as many on each side of a triangle as the degree, are tied to the places of the other mid-surface at
which they are undeformed. So the edge follows the other shell, whose own displacements stay free: cells need not meet.
Both ties are springs, `TIGHT` times as stiff as an element beside them. With n of the edge's cell and m of the other
shell, t along the edge, s = t . (n x m) and c = n . m:

    k/2 |u - u'|^2 + (q/2) (angle of (c c0 + s s0, s c0 - c s0))^2        per undeformed length.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import basix
import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.connected import CellsOfAll, add_own, whole
from magshell_fenicsx.assembly.coupled import Entries, pairs_of
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.point_kernels import PointKernel, Points, point_gradient, point_values, whole_hessian
from magshell_fenicsx.mesh.patch import MeshError, place_text
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.parts.joints import Joint
from magshell_fenicsx.parts.touching.nearest import Cells, places_near

if TYPE_CHECKING:
    from magshell_fenicsx.shells.shell import ShellModel

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
TIGHT = 1e4  # stiffness of a tie over that of an element
APART = 0.05  # thicknesses: a place of the edge that is farther from the other mid-surface is not on it
SIDES = np.array([[1, 2], [0, 2], [0, 1]])
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
AROUND = 1.2  # of the radius of a cell's nodes about their centre, that of all of it
PARTS = 12  # of both tangents of both shells at a point


class Tee:
    """The energy of a junction; an `assembly.terms.Term` and `assembly.coupled.Coupled`.

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

    amplitude = None
    column = "bending"

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
        V = r0.function_space
        self._comm, element, index = V.mesh.comm, V.element.basix_element, V.dofmap.index_map
        self._own = 3 * index.local_range[0], 3 * index.size_local
        self.name = self.group = f"joint of {' and '.join(joint.edges)}"
        self._of_all, self._r0, self._u = CellsOfAll.of(V), whole(r0), u
        self._element = element
        first = self._of_all.own.start
        cells, ends = _sides(V, foot, len(self._of_all.own))
        s, weights = basix.make_quadrature(basix.CellType.interval, 2 * element.degree - 1)
        X = ends[:, None, 0] + s[None, :, :1] * (ends[:, None, 1] - ends[:, None, 0])
        along = np.repeat(ends[:, 1] - ends[:, 0], len(s), axis=0)
        cell = np.repeat(first + cells, len(s))
        on_edge = self._shapes(X.reshape(-1, 2))
        nodes = self._of_all.nodes
        x = np.einsum("nk,nki->ni", on_edge[0], self._r0[nodes[cell]])
        tangent = np.einsum("na,ank,nki->ni", along, on_edge[1:], self._r0[nodes[cell]])
        weight = np.tile(weights, len(cells)) * np.linalg.norm(tangent, axis=1)
        length = np.repeat(np.sum(weight.reshape(-1, len(s)), axis=1), len(s))
        other, Y, apart = self._places(x, np.flatnonzero(self._of_all.gathered(on)))
        self._refuse_apart(apart, x, material.h, key, joint)
        on_other = self._shapes(Y)
        self._nodes = np.concatenate([nodes[cell], nodes[other]], axis=1)
        self._beta = np.concatenate([on_edge[0], -on_other[0]], axis=1)
        self._D = np.zeros((len(x), 4, self._nodes.shape[1]))
        half = nodes.shape[1]
        self._D[:, :2, :half], self._D[:, 2:, half:] = (N[1:].transpose(1, 0, 2) for N in (on_edge, on_other))
        of_cells = self._of_all.gathered(stiffness)
        stiff = np.maximum(of_cells[cell], of_cells[other]) / length[:, None]
        self._tie = weight * TIGHT * stiff[:, 0]
        turned = weight * (TIGHT * stiff[:, 1] * material.bending_stiffness if joint.rigid else joint.stiffness)
        self._turns = bool(joint.rigid or joint.stiffness)
        self._points = Points(max(len(x), 1))
        self._tangents, self._moved = self._points.field(PARTS), self._points.field(PARTS)
        # direction along the edge, sine and cosine of the placement, stiffness
        self._fixed = fixed = self._points.field(5)
        angle = _angle(self._tangents, self._moved, fixed)
        sine = angle[0] * fixed[3] - angle[1] * fixed[2]
        cosine = angle[1] * fixed[3] + angle[0] * fixed[2]
        W = fixed[4] / 2 * ufl.atan2(sine, cosine) ** 2
        self._moved.x.array[:] = 0.0
        self._kernels: Mapping[str, PointKernel] = {
            "angle": point_values("T-junction angle", angle, log, self._comm),
            "energy": point_values("T-junction energy", W, log, self._comm),
            "gradient": point_gradient("T-junction gradient", [(W, self._moved)], log, self._comm),
            "hessian": whole_hessian("T-junction Hessian", W, self._moved, log, self._comm),
        }
        values = fixed.x.array.reshape(-1, 5)[: len(x)]
        values[:, :2], values[:, 4] = along, turned
        values[:, 2:4] = self._at("angle", self._r0)

    # as a term

    def compile_residual(self) -> None:
        """Its kernels are compiled."""

    def compile_tangent(self) -> None:
        """Its kernels are compiled."""

    def energy(self) -> float:
        u = whole(self._u)
        gap = self._gap(u)
        tied = float(self._tie @ np.sum(gap**2, axis=1)) / 2
        return tied + (float(self._at("energy", self._r0 + u).sum()) if self._turns else 0.0)

    def add_residual(self, b: Array, factor: float) -> None:
        u, residual = whole(self._u), np.zeros(self._r0.shape)
        forces = (self._tie[:, None] * self._gap(u))[:, None, :] * self._beta[:, :, None]
        if self._turns:
            g = self._at("gradient", self._r0 + u).reshape(-1, 4, 3)
            forces = forces + np.einsum("nik,nic->nkc", self._D, g)
        np.add.at(residual, self._nodes, factor * forces)
        add_own(b, residual, self._own, self._comm)

    def add_tangent(self, K: object, factor: float, clamped: object) -> None:
        """None here: what assembles the others adds `entries`."""

    def entries(self) -> Entries:
        r = self._r0 + whole(self._u)
        count, k = self._nodes.shape
        H = np.zeros((count, k, 3, k, 3))
        tied = self._tie[:, None, None] * self._beta[:, :, None] * self._beta[:, None, :]
        for c in range(3):
            H[:, :, c, :, c] = tied
        if self._turns and count:
            of_parts = np.zeros((count, PARTS, PARTS))
            upper = np.triu_indices(PARTS)
            of_parts[:, upper[0], upper[1]] = of_parts[:, upper[1], upper[0]] = self._at("hessian", r)
            H += np.einsum("nik,nicjd,njl->nkcld", self._D, of_parts.reshape(count, 4, 3, 4, 3), self._D, optimize=True)
        dofs = (3 * self._nodes[:, :, None] + np.arange(3)).reshape(count, 3 * k)
        rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
        return rows.ravel(), columns.ravel(), H.ravel()

    def around(self) -> tuple[Longs, Longs]:
        """See `Coupled`: those that act on each other always do."""
        return pairs_of(self._nodes)

    @property
    def since(self) -> float:
        """See `Coupled`."""
        return 0.0

    # geometry

    def _gap(self, u: Array) -> Array:
        """u - u' (n, 3) at the points, from the displacement (nodes, 3) of all nodes."""
        return np.asarray(np.einsum("nk,nkc->nc", self._beta, u[self._nodes]))

    def _at(self, kernel: str, r: Array) -> Array:
        """(n, ..) what a kernel gives at the points, where the nodes are at r (nodes, 3)."""
        count = len(self._nodes)
        z = np.einsum("nik,nkc->nic", self._D, r[self._nodes])
        self._tangents.x.array[: count * PARTS] = z.ravel()
        return np.array(self._points.evaluate(self._kernels[kernel], count))

    def _shapes(self, X: Array) -> Array:
        """(3, n, functions): shape functions at places and their derivatives."""
        return np.asarray(self._element.tabulate(1, X)[..., 0])

    def _places(self, x: Array, cells: Longs) -> tuple[Longs, Array, Array]:
        """For points (n, 3) the nearest of some cells, the place in it (n, 2), and the distance, inf without a cell."""
        from scipy.spatial import cKDTree  # takes long to import

        nearest, Y, apart = np.zeros(len(x), dtype=np.int64), np.zeros((len(x), 2)), np.full(len(x), np.inf)
        nodal = self._r0[self._of_all.nodes[cells]]
        centres = nodal.mean(axis=1)
        radii = AROUND * np.linalg.norm(nodal - centres[:, None], axis=2).max(axis=1)
        near = cKDTree(centres).query_ball_point(x, 2 * radii.max()) if len(cells) else [[]] * len(x)
        point = np.repeat(np.arange(len(x)), [len(numbers) for numbers in near])
        which = np.concatenate([np.asarray(numbers, dtype=np.int64) for numbers in (*near, [])])
        if not len(point):
            return nearest, Y, apart
        surface = Cells(self._element, self._of_all.nodes[cells], np.zeros((len(cells), 3), dtype=np.int64))
        each = which, np.arange(len(which)), np.ones(len(which), dtype=np.int64), point
        pair, at = places_near(surface, self._r0, x, each, np.inf)
        point, which, foot, distance = at.point, which[pair], at.X, at.distance
        order = np.lexsort((cells[which], np.round(distance, 12), point))  # of equal ones the first
        best = order[np.flatnonzero(np.diff(point[order], prepend=-1))]
        nearest[point[best]], Y[point[best]], apart[point[best]] = cells[which[best]], foot[best], distance[best]
        return nearest, Y, apart

    def _refuse_apart(self, apart: Array, x: Array, h: float, key: str, joint: Joint) -> None:
        worst = int(apart.argmax()) if len(apart) else -1
        of_rank = (float(apart[worst]), x[worst]) if len(apart) else (0.0, np.zeros(3))
        far, place = max(self._comm.allgather(of_rank), key=lambda distance_and_place: distance_and_place[0])
        if far > APART * h:
            foot, other = joint.edges
            by = f"by {far:.4g} R" if np.isfinite(far) else "by more than a cell"
            raise MeshError(
                f"{key}: the edge {foot} is not on the mid-surface of {other}, {by} at {place_text(place)}, over R: "
                "move one of the shells"
            )


def _sides(V: fem.FunctionSpace, facets: NDArray[np.int32], owned: int) -> tuple[Longs, Array]:
    """Local cells of this rank that have boundary facets, and both ends (n, 2, 2) of each in the reference cell."""
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
    """Sine and cosine of the angle between both normals about the edge, whose direction is the first two of `along`."""
    a1, a2, b1, b2 = (ufl.as_vector([tangents[3 * i + c] + moved[3 * i + c] for c in range(3)]) for i in range(4))

    def unit(v: Expr) -> Expr:
        return v / ufl.sqrt(ufl.dot(v, v))

    n, m, t = unit(ufl.cross(a1, a2)), unit(ufl.cross(b1, b2)), unit(along[0] * a1 + along[1] * a2)
    return ufl.as_vector([ufl.dot(ufl.cross(n, m), t), ufl.dot(n, m)])


def tees(model: "ShellModel") -> list[Tee]:
    """The T-junctions of a model; collective."""
    joints, surface = model.loads.joints, model.midsurface
    pairs = enumerate(zip(joints, surface.joints, strict=True))
    tied = [(joint, f"joints.{i}.edges", surface.patches[joint.edges[1]]) for i, (joint, of) in pairs if of is None]
    tied += [(Joint((name, "the sheet"), rigid=True), "shell.file", on) for name, on in surface.feet.items()]
    if not tied:
        return []
    cells = model.V.mesh.topology.index_map(2)
    factors = np.ones((cells.size_local + cells.num_ghosts, 2))
    if model.thickness is not None:
        t = model.thickness.x.array[model.thickness.function_space.dofmap.list].mean(axis=1)
        factors *= np.column_stack([t, t**3])
    if model.made_of is not None:
        factors *= model.made_of.x.array.reshape(-1, 4)[model.made_of.function_space.dofmap.list[:, 0], :1]
    return [
        Tee(
            joint,
            key,
            model.r0,
            model.u,
            surface.edges[joint.edges[0]],
            on,
            factors,
            model.material,
            model.kernels,
        )
        for joint, key, on in tied
    ]
