"""The matrix of a vector field, assembled from the matrices of cells and of interior edges."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.sparsity import Ints, Longs, Pattern
from magshell_fenicsx.platform.native import native

Array = NDArray[np.float64]
FUNCTIONS = """
    void scatter_same(double *, const int32_t *, int32_t, int64_t, int64_t, const int32_t *, const int32_t *,
        const double *);
    void scatter_cross(double *, const int32_t *, int32_t, int64_t, int64_t, const int32_t *, const int32_t *,
        const int32_t *, const double *);
"""


class BlockMatrix:
    """A symmetric matrix; clamped degrees of freedom have ones on the diagonal and zeros beside it.

    PETSc shares the array of its values, so assembly copies and sorts nothing.

    Parameters
    ----------
    coupled
        Batches of pairs of local cells, (n,) on one side and on the other, with blocks that couple them.
    clamped
        Homogeneous Dirichlet conditions.
    """

    def __init__(
        self, V: fem.FunctionSpace, coupled: Sequence[tuple[Ints, ...]], clamped: list[fem.DirichletBC]
    ) -> None:
        comm, nodes = V.mesh.comm, V.dofmap.index_map
        self._ffi, self._lib = native(Path(__file__).with_name("scatter.c"), FUNCTIONS, comm)
        self._cells = np.ascontiguousarray(V.dofmap.list)
        self._coupled = [(self._cells[here], self._cells[there]) for here, there in coupled]
        held = np.zeros((nodes.size_local + nodes.num_ghosts, 3), dtype=bool)
        for bc in clamped:
            held.ravel()[bc.dof_indices()[0]] = True
        self._wholly = np.array(held.all(axis=1))
        self._pattern = pattern = Pattern(nodes, self._free_pairs(), comm)
        self._blocks = pattern.blocks(*_pairs(self._cells, self._cells))
        self._coupling_blocks = [
            np.stack([pattern.blocks(*_pairs(here, there)), pattern.blocks(*_pairs(there, here))], axis=1)
            for here, there in self._coupled
        ]
        self._zeros, self._ones = self._held_entries(held)
        n = pattern.owned
        self._values = np.zeros(9 * int(pattern.starts[-1]))
        i, j = pattern.csr(0, n)
        parts = [(i, j, self._values[: len(j)])]
        if comm.size > 1:
            oi, oj = pattern.csr(n, 2 * n)
            oj -= 3 * n
            numbers = (3 * pattern.others[oj // 3] + oj % 3).astype(PETSc.IntType)
            parts.append((oi, numbers, self._values[len(j) : len(j) + len(oj)]))
        size = ((3 * n, None), (3 * n, None))
        self._K = PETSc.Mat().createAIJWithArrays(size, parts[0] if comm.size == 1 else tuple(parts), comm=comm)
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            self._K.setOption(option, True)

    def clear(self) -> None:
        """Set all values to zero."""
        self._values[:] = 0

    def add_cells(self, K: Array) -> None:
        """Add the matrices of all local cells.

        Parameters
        ----------
        K
            (cells, 9, pairs a <= b of functions): the symmetric parts of the blocks at a, b, components in the
            order of `point_kernels.COMPONENTS`, then their skew parts in that of `point_kernels.SKEW`.
        """
        self._scatter("same", self._cells, self._blocks, K)

    def add_coupling(self, batch: int, K: Array) -> None:
        """Add the blocks that couple the two cells of each pair of a batch, and their transposes.

        Parameters
        ----------
        K
            (pairs, 9, functions^2).
        """
        self._scatter("cross", *self._coupled[batch], self._coupling_blocks[batch], K)

    def assemble(self) -> PETSc.Mat:
        """The matrix, summed over the ranks; always the same object. Collective."""
        self._values[self._zeros] = 0
        self._pattern.add_ghosts(self._values)
        self._values[self._ones] = 1
        self._K.stateIncrease()
        return self._K

    def _scatter(self, kind: str, *arrays: NDArray[np.float64] | Ints) -> None:
        def pointer(x: NDArray[np.float64] | Ints) -> object:
            assert x.flags.c_contiguous
            return self._ffi.from_buffer("double[]" if x.dtype == np.float64 else "int32_t[]", x)

        add = getattr(self._lib, f"scatter_{kind}")
        values, starts = pointer(self._values), pointer(self._pattern.starts)
        entities, functions = arrays[0].shape
        add(values, starts, self._pattern.owned, entities, functions, *map(pointer, arrays))

    def _free_pairs(self) -> Iterator[tuple[Ints, Ints]]:
        """Pairs of nodes with a block; a clamped node has only its diagonal block."""
        for rows, columns in self._together():
            i, j = _pairs(rows, columns)
            free = ~(self._wholly[i] | self._wholly[j])
            yield i[free], j[free]

    def _together(self) -> Iterable[tuple[Ints, Ints]]:
        yield self._cells, self._cells
        for here, there in self._coupled:
            yield here, there
            yield there, here

    def _held_entries(self, held: NDArray[np.bool_]) -> tuple[Longs, Longs]:
        """This rank's entries in clamped rows and columns, and the diagonal ones among them."""
        some, own = np.array(held.any(axis=1)), np.arange(self._pattern.owned, dtype=np.int32)
        keys = [own[some[own]] * (len(held) + np.int64(1))]
        for i, j in self._free_pairs():
            touched = some[i] | some[j]
            keys.append(np.unique(i[touched] * np.int64(len(held)) + j[touched]))
        i, j = (x.astype(np.int32) for x in np.divmod(np.unique(np.concatenate(keys)), len(held)))
        entries, rows, columns = self._pattern.entries(i, j), held[i][:, :, None], held[j][:, None, :]
        diagonal = (i == j)[:, None, None] & rows & np.eye(3, dtype=bool) & (i < self._pattern.owned)[:, None, None]
        return entries[rows | columns], entries[diagonal]


def _pairs(rows: Ints, columns: Ints) -> tuple[Ints, Ints]:
    """All pairs of an entity's nodes, (entities, functions, functions)."""
    i, j = np.broadcast_arrays(rows[:, :, None], columns[:, None, :])
    return i, j
