"""The calls that differ between dolfinx 0.9, 0.10 and 0.11; no other module depends on a version."""

from typing import Any

import numpy as np
from dolfinx import fem, mesh
from dolfinx.cpp.fem import pack_coefficients, pack_constants
from dolfinx.cpp.fem.petsc import assemble_matrix as _assemble_matrix
from dolfinx.cpp.fem.petsc import insert_diagonal
from numpy.typing import NDArray
from petsc4py import PETSc

_Reason = PETSc.SNES.ConvergedReason
NOT_A_NUMBER = (  # renamed by PETSc 3.25
    _Reason.DIVERGED_FNORM_NAN if hasattr(_Reason, "DIVERGED_FNORM_NAN") else _Reason.DIVERGED_FUNCTION_NANORINF
)


def shared_facets() -> Any:
    """The partitioner for `create_mesh` that gives each rank one layer of ghosts."""
    mode = mesh.GhostMode.shared_facet
    try:
        return mesh.create_cell_partitioner(mode)
    except TypeError:
        return mesh.create_cell_partitioner(mode, 2)  # cells at a facet, from dolfinx 0.11


def interpolation_points(V: fem.FunctionSpace) -> NDArray[np.float64]:
    """The nodes (n, dim) of a Lagrange space on the reference cell."""
    points = V.element.interpolation_points  # a method in dolfinx 0.9
    return np.asarray(points() if callable(points) else points)


def corner_numbers(domain: mesh.Mesh) -> NDArray[np.int32]:
    """Rows of `geometry.x` at each cell's nodes; (cells, nodes)."""
    dofmaps = getattr(domain.geometry, "dofmaps", None)  # a list since dolfinx 0.11, where `dofmap` is deprecated
    return np.asarray(dofmaps[0] if isinstance(dofmaps, list) else domain.geometry.dofmap)


def original_cells(domain: mesh.Mesh) -> NDArray[np.int64]:
    """The number of each local cell in the order in which they were made; none of a part of another mesh."""
    try:
        return np.asarray(domain.topology.original_cell_index, dtype=np.int64)
    except RuntimeError:  # in dolfinx 0.9
        return np.empty(0, dtype=np.int64)


def tags_of(tags: mesh.MeshTags, domain: mesh.Mesh) -> bool:
    """Whether tags belong to a mesh; topologies have a wrapper, or not."""
    topologies = (tags.topology, domain.topology)
    own, other = (getattr(each, "_cpp_object", each) for each in topologies)
    return own is other


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
