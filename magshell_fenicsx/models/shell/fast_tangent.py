"""The tangent without compiled tangent forms, from the point Hessians of the terms' densities."""

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
        """Add element matrices, see `HessianIntegral.add`."""


class FastTangent:
    """The tangent of a sum of terms; an `assembly.terms.TangentAssembler`.

    Parameters
    ----------
    u
        The displacement that the terms were written with.
    integrals
        Integrals of the terms; they may have other terms too.
    constraints
        Constraints of components of u; those along other directions are the system's.
    moving
        Flags (local cells,) of cells with nodes that move, and integrals of the terms on these
        cells and their edges alone; None without.
    """

    def __init__(
        self,
        u: fem.Function,
        integrals: Sequence[ElementIntegral],
        constraints: Sequence[Constraint],
        moving: tuple[NDArray[np.bool_], Sequence[ElementIntegral]] | None = None,
    ) -> None:
        V, clamped = u.function_space, [c for c in constraints if isinstance(c, fem.DirichletBC)]
        self._u, self._integrals, self._nodes = u, integrals, V.dofmap.list
        self._moving = moving[0] if moving else None
        self._moving_integrals = moving[1] if moving else ()
        self._matrix = BlockMatrix(
            V, [batch.cells for integral in integrals for batch in integral.coupling], clamped
        )
        cells, functions = V.dofmap.list.shape
        self._element_matrices = np.empty((cells, 9, functions * (functions + 1) // 2))

    def tangent(self, factors: Mapping[str, float], stress: Sequence[Weighted] = ()) -> PETSc.Mat:
        """Return the assembled matrix at the present u; it is reused by the next call. Collective.

        Parameters
        ----------
        factors
            Factors of terms by name.
        stress
            Weights and displacements with ghosts. The weighted sum of their membrane strains gives
            the membrane stress in place of the present strain; empty for the present strain.
        """
        self._element_matrices[:] = 0
        self._matrix.clear()
        first = 0
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

        It has contributions of moving cells alone, so it is exact at nodes that move. `v` and the
        product (dofs,) include ghosts.
        """
        product, x = np.zeros((len(v) // 3, 3)), v.reshape(-1, 3)
        element_matrices = np.zeros(self._element_matrices.shape)
        for integral in self._moving_integrals:

            def couple(batch: int, K: Array, integral: ElementIntegral = integral) -> None:
                first, second = (self._nodes[cells] for cells in integral.coupling[batch].cells)
                add_coupling_products(product, K, first, second, x)

            integral.add(self._u.x.array, factors, element_matrices, couple)
        add_cell_products(
            product, element_matrices[self._moving], self._nodes[self._moving], x
        )  # others have no node that moves
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

    There is one for the cells of each quadrature, one for all interior edges, and one for each
    term's boundary edges. Terms that are linear in the displacement have none.

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
        See `HessianIntegral`.
    cell_mask
        Flags (local cells,) of the cells that count, with their edges; None for all.
    """
    V = r0.function_space
    nonlinear = [t for t in terms if isinstance(t, ShellTerm | HessianTerm) and not t.linear]
    cells = [t for t in nonlinear if t.density.facets is None and t.density.sides == 1]
    interior = [t for t in nonlinear if t.density.sides == 2]
    integrals = []
    for rule in dict.fromkeys(t.density.quadrature for t in cells):
        terms_of_rule = [t for t in cells if t.density.quadrature == rule]
        batches = cell_batches(V, rule or cell_quadrature(degree), cell_mask)
        integrals.append(
            HessianIntegral(r0, batches, 1, terms_of_rule, log, None if rule else prestress)
        )
    if interior:
        integrals.append(
            HessianIntegral(
                r0, interior_batches(V, edge_quadrature(degree), cell_mask), 2, interior, log
            )
        )
    for term in nonlinear:
        if term.density.facets is not None:
            batches = boundary_batches(V, edge_quadrature(degree), term.density.facets, cell_mask)
            integrals.append(HessianIntegral(r0, batches, 1, [term], log))
    return integrals
