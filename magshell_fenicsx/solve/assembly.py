"""The calls into dolfinx's assembler that differ between its versions."""

import numpy as np
from dolfinx import fem
from dolfinx.cpp.fem import pack_coefficients, pack_constants
from dolfinx.cpp.fem.petsc import assemble_matrix as _assemble_matrix
from dolfinx.cpp.fem.petsc import insert_diagonal
from numpy.typing import NDArray
from petsc4py import PETSc


def add_vector(b: NDArray[np.float64], form: fem.Form) -> None:
    """Add a linear form to a local vector with ghosts; nothing is communicated."""
    fem.assemble_vector(b, form)


def add_matrix(K: PETSc.Mat, form: fem.Form, clamped: list[fem.DirichletBC]) -> None:
    """Add a bilinear form to a matrix, skipping the rows and columns of `clamped`."""
    cpp = form._cpp_object
    _assemble_matrix(K, cpp, pack_constants(cpp), pack_coefficients(cpp), [bc._cpp_object for bc in clamped])


def finish_matrix(K: PETSc.Mat, V: fem.FunctionSpace, clamped: list[fem.DirichletBC]) -> None:
    """Communicate the entries and put ones on the diagonal of `clamped`."""
    K.assemblyBegin(PETSc.Mat.AssemblyType.FLUSH)
    K.assemblyEnd(PETSc.Mat.AssemblyType.FLUSH)
    insert_diagonal(K, V._cpp_object, [bc._cpp_object for bc in clamped], 1.0)
    K.assemble()
