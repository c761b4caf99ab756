"""Supports along any direction, imposed by a projection.

With the projector P of every supported node, u is replaced by P u. The residual becomes P b and the
tangent P K P + (I - P), whose number of negative eigenvalues is that of K for admissible
displacements. Theory: docs/theory.md, mirror planes in any direction.

A node with a support along n has P = I - n n^T, in general the projector onto the complement of all
its directions. Own nodes belong to this rank, ghosts to others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

Array = NDArray[np.float64]
DIRECTION_TOLERANCE = 1e-6  # sine of the angle below which two directions are equal


@dataclass(frozen=True)
class ObliqueSupport:
    """Nodes that do not move along a direction.

    Attributes
    ----------
    nodes
        Local numbers, ghosts included.
    normal
        (3,): the direction, a unit vector.
    """

    nodes: NDArray[np.int32]
    normal: Array


Constraint: TypeAlias = fem.DirichletBC | ObliqueSupport


def support_along(
    V: fem.FunctionSpace, dim: int, entities: NDArray[np.int32], normal: Array
) -> Constraint:
    """Return the constraint u . normal = 0 on some edges (`dim` 1) or faces (`dim` 2).

    Along a coordinate axis it is a Dirichlet condition, else an oblique support.

    Parameters
    ----------
    V
        Space of the displacement.
    entities
        Local numbers of the edges or faces.
    normal
        (3,): the direction, a unit vector.
    """
    axis = int(np.argmax(np.abs(normal)))
    if np.delete(normal, axis).any():  # not along an axis
        return ObliqueSupport(fem.locate_dofs_topological(V, dim, entities), normal)
    component = V.sub(axis)
    dofs = fem.locate_dofs_topological(component, dim, entities)
    return fem.dirichletbc(0.0, dofs, component)


class Projection:
    """The projection of displacements onto the admissible ones, node by node.

    Parameters
    ----------
    V
        Space of the displacement.
    oblique
        Supports along any direction.
    clamped
        Conditions on components, possibly at the same nodes.

    Private fields: `_nodes` are the supported local nodes, ascending, and `_P` (nodes, 3, 3) their
    projectors. `_P_matrix` and `_complement` are P and I - P as matrices, made at first use.
    `_unprojected` is the latest K, and `_projected` its product. `_owned` is the number of own
    nodes, `_first` the global number of the first one.
    """

    def __init__(
        self,
        V: fem.FunctionSpace,
        oblique: Sequence[ObliqueSupport],
        clamped: Sequence[fem.DirichletBC],
    ) -> None:
        """Compute the projector P of each supported node, from all its directions."""
        index_map = V.dofmap.index_map
        is_clamped = np.zeros((index_map.size_local + index_map.num_ghosts, 3), dtype=bool)
        for bc in clamped:
            is_clamped.ravel()[bc.dof_indices()[0]] = True
        self._nodes = np.unique(np.concatenate([support.nodes for support in oblique]))
        # clamped components of the node, then the normals of its oblique supports
        directions = [np.eye(3)[is_clamped[node]] for node in self._nodes]
        for support in oblique:
            for i in np.searchsorted(self._nodes, support.nodes):
                directions[i] = np.vstack([directions[i], support.normal])
        self._P = np.array([_complement(d) for d in directions]).reshape(-1, 3, 3)
        self._owned, self._comm = index_map.size_local, V.mesh.comm
        self._first = index_map.local_range[0]
        self._P_matrix: PETSc.Mat | None = None
        self._projected: PETSc.Mat | None = None
        # Kept alive, so that no other matrix has its handle.
        self._unprojected: PETSc.Mat | None = None

    def project(self, u: Array) -> None:
        """Project a vector of owned nodes, with or without ghosts, in place: replace u by P u."""
        local = self._nodes < len(u) // 3
        nodes, x = self._nodes[local], u.reshape(-1, 3)
        x[nodes] = np.einsum("nij,nj->ni", self._P[local], x[nodes])

    def constrained_part(self, u: Array) -> Array:
        """Return u - P u, the part of u along the supports' directions.

        It is rounding, which extrapolation along a path would multiply.
        """
        admissible = np.array(u)
        self.project(admissible)
        return np.asarray(u - admissible)

    def tangent(self, K: PETSc.Mat) -> PETSc.Mat:
        """Return P K P + (I - P) for a tangent K. Collective.

        The result is the same object as long as K is the same; contact makes another K.
        """
        if self._P_matrix is None:
            self._P_matrix = self._block_diagonal(self._P, 1.0)
            self._complement = self._block_diagonal(np.eye(3) - self._P, 0.0)
        # P K P; for the same K PETSc writes into the last product
        is_same = self._unprojected is not None and self._unprojected.handle == K.handle
        self._projected = K.ptap(self._P_matrix, self._projected if is_same else None)
        self._unprojected = K
        subset = PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN
        self._projected.axpy(1.0, self._complement, subset)
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            self._projected.setOption(option, True)
        return self._projected

    def project_both_sides(self, M: PETSc.Mat) -> PETSc.Mat:
        """Return P M P for a matrix M. Collective."""
        return M.ptap(self._block_diagonal(self._P, 1.0))

    def mass(self, M: PETSc.Mat) -> PETSc.Mat:
        """Return P M P for a mass matrix M, marked as symmetric. Collective.

        Directions of supports then have no finite eigenvalue.
        """
        product = self.project_both_sides(M)  # P M P
        product.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        return product

    def _block_diagonal(self, blocks: Array, elsewhere: float) -> PETSc.Mat:
        """Return a block-diagonal matrix of own unknowns. Collective.

        Parameters
        ----------
        blocks
            (supported nodes, 3, 3): the block of each supported node.
        elsewhere
            The number on the diagonal at other nodes.
        """
        n, first_row = 3 * self._owned, 3 * self._first
        matrix = PETSc.Mat().createAIJ(((n, None), (n, None)), nnz=(3, 0), comm=self._comm)
        local = self._nodes < self._owned
        if elsewhere:  # zeros need not be stored
            other_nodes = np.setdiff1d(np.arange(self._owned), self._nodes[local])
            for i in (3 * other_nodes[:, None] + np.arange(3)).ravel():
                matrix.setValue(first_row + i, first_row + i, elsewhere)
        for node, block in zip(self._nodes[local], blocks[local], strict=True):
            rows = (first_row + 3 * node + np.arange(3)).astype(PETSc.IntType)
            matrix.setValues(rows, rows, block)
        matrix.assemble()
        return matrix


def _complement(directions: Array) -> Array:
    """Return the projector (3, 3) onto the complement of some directions (n, 3).

    Nearly equal directions count as one.
    """
    # orthonormal axes; those with a singular value above the tolerance span the directions
    _, singular_values, axes = np.linalg.svd(directions)
    spanned = axes[: len(singular_values)][singular_values > DIRECTION_TOLERANCE]
    return np.asarray(np.eye(3) - spanned.T @ spanned)
