"""The tangent without compiled tangent forms, from the point Hessians of the terms' densities.

In: terms with densities. Out: the assembled matrix, the derivative of the residual by u.

- An integral (`HessianIntegral`, `ElementIntegral`) adds element matrices of some terms on cells,
  interior edges or boundary edges. Matrices at interior edges couple two cells.
- An element matrix is (9, pairs of functions): nine parts of a block (3, 3) for each pair of shape
  functions of a cell.
- Factors are the numbers that multiply the terms, by name.
- A batch has entities (cells or edges) with the same quadrature rule.
- Moving nodes are those of supports whose motion is prescribed.
- An oblique support acts along directions that are no coordinates; the system applies it.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Protocol

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.batches import (
    CellMask,
    EntityBatch,
    add_cell_products,
    add_coupling_products,
    boundary_batches,
    cell_batches,
    interior_batches,
)
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.oblique_supports import Constraint
from magshell_fenicsx.assembly.scatter import BlockMatrix
from magshell_fenicsx.assembly.terms import Term
from magshell_fenicsx.models.shell.element_hessians import HessianIntegral
from magshell_fenicsx.models.shell.energy import (
    Density,
    HessianTerm,
    ShellTerm,
    cell_quadrature,
    edge_quadrature,
)

Array = NDArray[np.float64]


Weighted = tuple[float, Array]


class ElementIntegral(Protocol):
    """Integral that adds element matrices to a `FastTangent`.

    Attributes
    ----------
    coupling
        Batches of entities that couple two cells.
    """

    @property
    def coupling(self) -> Sequence[EntityBatch]: ...

    def add(
        self,
        u: Array,
        factors: Mapping[str, float],
        element_matrices: Array,
        couple: Callable[[int, Array], None],
    ) -> None:
        """Add the element matrices at the displacement u (dofs,), with factors of terms by name.

        `couple` is called for each batch in `coupling`, with its number and the matrices between
        two cells.
        """


class FastTangent:
    """The tangent of a sum of terms, assembled from element matrices.

    Parameters
    ----------
    u
        The displacement that the terms were written with.
    integrals
        Integrals of the terms; they may have other terms too.
    constraints
        Constraints of u. Only those of components are applied here, not oblique ones.
    moving
        A pair: flags (local cells,) of cells with moving nodes, and integrals of the terms on these
        cells and their edges alone. None without moving nodes.

    Attributes
    ----------
    _moving, _moving_integrals
        Both parts of `moving`; None and empty without moving nodes.
    _u, _integrals, _nodes
        `u`, `integrals`, and the nodes (cells, functions) of the cells.
    _matrix
        The matrix, to which element matrices are added.
    _element_matrices
        (cells, 9, pairs a <= b of functions) the sum of all integrals, stored for the next call.
    """

    def __init__(
        self,
        u: fem.Function,
        integrals: Sequence[ElementIntegral],
        constraints: Sequence[Constraint],
        moving: tuple[NDArray[np.bool_], Sequence[ElementIntegral]] | None = None,
    ) -> None:
        """Make the matrix with the sparsity of all integrals."""
        V, clamped = u.function_space, [c for c in constraints if isinstance(c, fem.DirichletBC)]
        self._u, self._integrals, self._nodes = u, integrals, V.dofmap.list
        self._moving = moving[0] if moving else None
        self._moving_integrals = moving[1] if moving else ()
        self._matrix = BlockMatrix(
            V, [batch.cells for integral in integrals for batch in integral.coupling], clamped
        )
        cells, functions = V.dofmap.list.shape
        # of a symmetric element matrix the pairs a <= b of functions are stored
        self._element_matrices = np.empty((cells, 9, functions * (functions + 1) // 2))

    def tangent(self, factors: Mapping[str, float], stress: Sequence[Weighted] = ()) -> PETSc.Mat:
        """Return the assembled matrix at the present u; it is reused by the next call. Collective.

        Parameters
        ----------
        factors
            Factors of terms by name.
        stress
            Pairs of a weight and a displacement with ghosts. The weighted sum of their membrane
            strains gives the membrane stress, in place of the present strain. Cells with moving
            nodes keep their present strain. Empty for the present strain everywhere.
        """
        self._element_matrices[:] = 0
        self._matrix.clear()
        first = 0  # number of an integral's first batch among those of all integrals
        for integral in self._integrals:
            if stress and isinstance(integral, HessianIntegral):
                integral.replace_strain(self._u.x.array, stress, self._moving)
            integral.add(
                self._u.x.array, factors, self._element_matrices, partial(self._couple, first)
            )
            first += len(integral.coupling)
        self._matrix.add_cells(self._element_matrices)
        return self._matrix.assemble()

    def times(self, v: Array, factors: Mapping[str, float]) -> Array:
        """Return this rank's part of the matrix without supports times a vector v.

        Only cells with moving nodes contribute, so that it is exact at moving nodes and no others.
        `v` and the product (dofs,) include ghosts.
        """
        product, x = np.zeros((len(v) // 3, 3)), v.reshape(-1, 3)
        element_matrices = np.zeros(self._element_matrices.shape)
        for integral in self._moving_integrals:
            # products of coupled cells are added at once, those within cells after the loop. The
            # default value binds the integral of this pass

            def couple(batch: int, K: Array, integral: ElementIntegral = integral) -> None:
                """Add the products of matrices K that couple the two cells at each edge."""
                first, second = (self._nodes[cells] for cells in integral.coupling[batch].cells)
                add_coupling_products(product, K, first, second, x)

            integral.add(self._u.x.array, factors, element_matrices, couple)
        # other cells have no node that moves
        add_cell_products(product, element_matrices[self._moving], self._nodes[self._moving], x)
        return product.ravel()

    def _couple(self, first: int, batch: int, K: Array) -> None:
        """Add matrices K that couple two cells at the edges of a batch.

        The batch is counted within its integral; `first` is the number of that integral's first
        batch.
        """
        self._matrix.add_coupling(first + batch, K)


def hessian_integrals(
    r0: fem.Function,
    degree: int,
    terms: Iterable[Term],
    log: KernelLog,
    prestress: Density | None = None,
    cell_mask: CellMask = None,
) -> list[HessianIntegral]:
    """Return the integrals of terms' Hessians; collective.

    There is one for each quadrature on cells, one for all interior edges, and one for the boundary
    edges of each term. Terms that are linear in the displacement have no Hessian.

    Parameters
    ----------
    r0
        The placement.
    degree
        Degree of the elements.
    terms
        Terms with a density, and others, which are left out.
    log
        Log of compiled kernels.
    prestress
        Density of the second variation under an additional membrane stress, with which the stress
        can be exchanged. Terms with a quadrature of their own do not have it.
    cell_mask
        Flags (local cells,) of the cells that count, with their edges; None for all.
    """
    V = r0.function_space
    nonlinear = [t for t in terms if isinstance(t, ShellTerm | HessianTerm) and not t.linear]
    cells = [t for t in nonlinear if t.density.facets is None and t.density.sides == 1]
    interior = [t for t in nonlinear if t.density.sides == 2]
    integrals = []
    # cells: one integral for each quadrature, None for the usual one
    for rule in dict.fromkeys(t.density.quadrature for t in cells):
        terms_of_rule = [t for t in cells if t.density.quadrature == rule]
        batches = cell_batches(V, rule or cell_quadrature(degree), cell_mask)
        prestress_of_rule = None if rule else prestress
        integrals.append(HessianIntegral(r0, batches, 1, terms_of_rule, log, prestress_of_rule))
    if interior:
        batches = interior_batches(V, edge_quadrature(degree), cell_mask)
        integrals.append(HessianIntegral(r0, batches, 2, interior, log))
    # boundary edges: one integral for each term
    for term in nonlinear:
        if term.density.facets is not None:
            batches = boundary_batches(V, edge_quadrature(degree), term.density.facets, cell_mask)
            integrals.append(HessianIntegral(r0, batches, 1, [term], log))
    return integrals
