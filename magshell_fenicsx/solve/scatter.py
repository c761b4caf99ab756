"""A matrix that is filled from one long list of entries, always in the same order (PETSc's COO interface)."""

from typing import Any

import cffi  # type: ignore[import-untyped]
import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

# petsc4py 3.22 does not have these two functions; the library that it is linked with does
_ffi = cffi.FFI()
_ffi.cdef("""
    int MatSetPreallocationCOO(void *, ptrdiff_t, void *, void *);
    int MatSetValuesCOO(void *, void *, int);
""")
_petsc = _ffi.dlopen(PETSc.__file__, _ffi.RTLD_LAZY)


class ListedMatrix:
    """A + A^T on a space, with ones on the diagonal of the clamped degrees of freedom.

    Parameters
    ----------
    rows, columns
        (entries,) of A: local degrees of freedom, ghosts included. Entries at the same place add up;
        those at -1 and those in a row or column of a clamped degree of freedom are left out.
    clamped
        Homogeneous Dirichlet conditions.

    Attributes
    ----------
    entries
        (entries,) of A, to be filled before `assemble`.
    """

    def __init__(
        self,
        V: fem.FunctionSpace,
        rows: NDArray[np.int32],
        columns: NDArray[np.int32],
        clamped: list[fem.DirichletBC],
    ) -> None:
        blocks, bs = V.dofmap.index_map, V.dofmap.index_map_bs
        owned = blocks.size_local * bs
        local = np.arange(owned + blocks.num_ghosts * bs, dtype=np.int32)
        numbers = (bs * blocks.local_to_global(local // bs) + local % bs).astype(PETSc.IntType)
        fixed = np.unique(np.concatenate([bc.dof_indices()[0] for bc in clamped] or [local[:0]]))
        ones = numbers[fixed[fixed < owned]]
        numbers[fixed] = -1  # ignored by PETSc
        numbers = np.append(numbers, PETSc.IntType(-1))  # what rows and columns of -1 find
        n = len(rows)
        i = np.concatenate([numbers[rows], numbers[columns], ones])
        j = np.concatenate([i[n : 2 * n], i[:n], ones])
        self._values = np.ones(len(i))
        self.entries, self._transposed = self._values[:n], self._values[n : 2 * n]
        self._K = PETSc.Mat().create(V.mesh.comm)
        self._K.setSizes(((owned, None), (owned, None)))
        self._K.setType("aij")
        _check(_petsc.MatSetPreallocationCOO(_pointer(self._K.handle), len(i), _array(i), _array(j)))
        for option in (PETSc.Mat.Option.SYMMETRIC, PETSc.Mat.Option.SYMMETRY_ETERNAL):
            self._K.setOption(option, True)

    def assemble(self) -> PETSc.Mat:
        """The matrix with the present entries; it is reused by the next call. Collective."""
        self._transposed[:] = self.entries
        _check(_petsc.MatSetValuesCOO(_pointer(self._K.handle), _array(self._values), int(PETSc.InsertMode.INSERT)))
        return self._K


def _pointer(address: int) -> Any:
    return _ffi.cast("void *", address)


def _array(values: NDArray[Any]) -> Any:
    return _pointer(values.ctypes.data)


def _check(error: int) -> None:
    if error:
        raise PETSc.Error(error)
