"""Supports in any direction, imposed by a projection.

With the projector P of every such node, u is replaced by P u. The residual becomes P b and the
tangent P K P + (I - P), whose number of negative eigenvalues is that of K for admissible
displacements.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

Array = NDArray[np.float64]
SAME = 1e-6  # directions at an angle with a smaller sine are equal


@dataclass(frozen=True)
class Sliding:
    """Nodes (local numbers, ghosts included) that do not move along the unit vector `normal` (3,)."""

    nodes: NDArray[np.int32]
    normal: Array


Constraint: TypeAlias = fem.DirichletBC | Sliding


def held_along(
    V: fem.FunctionSpace, dim: int, entities: NDArray[np.int32], normal: Array
) -> Constraint:
    """u . normal = 0 on some edges (`dim` 1) or faces (2)."""
    axis = int(np.argmax(np.abs(normal)))
    if np.delete(normal, axis).any():
        return Sliding(fem.locate_dofs_topological(V, dim, entities), normal)
    part = V.sub(axis)
    return fem.dirichletbc(0.0, fem.locate_dofs_topological(part, dim, entities), part)


class Projection:
    """The projection of displacements onto the admissible ones.

    Parameters
    ----------
    clamped
        Conditions on components, possibly at the same nodes.
    """

    def __init__(
        self, V: fem.FunctionSpace, sliding: Sequence[Sliding], clamped: Sequence[fem.DirichletBC]
    ) -> None:
        index = V.dofmap.index_map
        held = np.zeros((index.size_local + index.num_ghosts, 3), dtype=bool)
        for bc in clamped:
            held.ravel()[bc.dof_indices()[0]] = True
        self._nodes = np.unique(np.concatenate([s.nodes for s in sliding]))
        directions = [np.eye(3)[held[node]] for node in self._nodes]
        for s in sliding:
            for i in np.searchsorted(self._nodes, s.nodes):
                directions[i] = np.vstack([directions[i], s.normal])
        self._P = np.array([_beside(d) for d in directions]).reshape(-1, 3, 3)
        self._owned, self._comm = index.size_local, V.mesh.comm
        self._first = index.local_range[0]
        self._by_node: PETSc.Mat | None = None
        self._K: PETSc.Mat | None = None
        self._of: PETSc.Mat | None = None  # kept, so that no other matrix has its handle

    def project(self, u: Array) -> None:
        """Project a vector of owned nodes, with or without ghosts, in place."""
        owned = self._nodes < len(u) // 3
        nodes, x = self._nodes[owned], u.reshape(-1, 3)
        x[nodes] = np.einsum("nij,nj->ni", self._P[owned], x[nodes])

    def outside(self, u: Array) -> Array:
        """u - P u: rounding, which the extrapolation of a path would multiply from step to step."""
        inside = np.array(u)
        self.project(inside)
        return np.asarray(u - inside)

    def tangent(self, K: PETSc.Mat) -> PETSc.Mat:
        """P K P + (I - P); the same object while K is the same, which contact makes another.

        Collective.
        """
        if self._by_node is None:
            self._by_node, self._rest = (
                self._blocks(self._P, 1.0),
                self._blocks(np.eye(3) - self._P, 0.0),
            )
        same = self._of is not None and self._of.handle == K.handle
        self._K = K.ptap(self._by_node, self._K if same else None)
        self._of = K
        self._K.axpy(1.0, self._rest, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            self._K.setOption(option, True)
        return self._K

    def both_sides(self, M: PETSc.Mat) -> PETSc.Mat:
        """P M P. Collective."""
        return M.ptap(self._blocks(self._P, 1.0))

    def mass(self, M: PETSc.Mat) -> PETSc.Mat:
        """P M P, symmetric; held directions then have no finite eigenvalue. Collective."""
        product = self.both_sides(M)
        product.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        return product

    def _blocks(self, blocks: Array, elsewhere: float) -> PETSc.Mat:
        """The block-diagonal matrix with blocks at these nodes and a number on the diagonal
        elsewhere.
        """
        n, first = 3 * self._owned, 3 * self._first
        mat = PETSc.Mat().createAIJ(((n, None), (n, None)), nnz=(3, 0), comm=self._comm)
        owned = self._nodes < self._owned
        rest = np.setdiff1d(np.arange(self._owned), self._nodes[owned])
        for i in (3 * rest[:, None] + np.arange(3)).ravel() if elsewhere else ():
            mat.setValue(first + i, first + i, elsewhere)
        for node, block in zip(self._nodes[owned], blocks[owned], strict=True):
            rows = (first + 3 * node + np.arange(3)).astype(PETSc.IntType)
            mat.setValues(rows, rows, block)
        mat.assemble()
        return mat


def _beside(directions: Array) -> Array:
    """The (3, 3) projector onto the complement of the directions (n, 3)."""
    _, sizes, axes = np.linalg.svd(directions)
    along = axes[: len(sizes)][sizes > SAME]
    return np.asarray(np.eye(3) - along.T @ along)
