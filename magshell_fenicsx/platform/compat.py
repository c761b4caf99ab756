"""Calls that differ between dolfinx 0.9, 0.10 and 0.11.

No other module depends on the version of dolfinx. FFCx turns a form of UFL into kernels: C
functions that integrate over one cell or facet, described by structures of the header UFCx. cffi
reads such structures. Fields are coefficients of a form.
"""

import ctypes
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

import cffi
import ffcx
import numpy as np
import ufl
from dolfinx import fem, mesh
from dolfinx.cpp.fem import pack_coefficients, pack_constants
from dolfinx.cpp.fem.petsc import assemble_matrix as _assemble_matrix
from dolfinx.cpp.fem.petsc import insert_diagonal
from dolfinx.fem.forms import form_cpp_class, get_integration_domains
from ffcx import naming
from ffcx.codegeneration import get_include_path, jit
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.platform.packages import Unusable

if np.issubdtype(PETSc.ScalarType, np.complexfloating):
    raise Unusable(
        "this PETSc computes with complex numbers; the program takes one with real numbers: of "
        "PyPI's wheels dolfinx-solver-real in place of dolfinx-solver"
    )
_Reason = PETSc.SNES.ConvergedReason
NOT_A_NUMBER = (  # renamed by PETSc 3.25
    _Reason.DIVERGED_FNORM_NAN
    if hasattr(_Reason, "DIVERGED_FNORM_NAN")
    else _Reason.DIVERGED_FUNCTION_NANORINF
)


Field = TypeVar("Field")


_UFCX_DECLARATIONS = (
    jit.UFC_HEADER_DECL.format("float64") + jit.UFC_INTEGRAL_DECL + jit.UFC_FORM_DECL
)
# cffi lacks pointers to complex numbers, which kernels in real numbers do not have.
UFCX = cffi.FFI()
UFCX.cdef(_UFCX_DECLARATIONS.replace("_Complex", ""))


@cache
def _form_options() -> dict[str, Any]:
    """Return FFCx's options for kernels in double precision."""
    return dict(ffcx.get_options({"scalar_type": np.float64}))


def form_signature(form: ufl.Form) -> str:
    """Return a name that depends on everything that the code of a form depends on."""
    return str(naming.compute_signature([form], str(sorted(_form_options().items()))))


def form_code(form: ufl.Form) -> str:
    """Return the C code of a form, as FFCx generates it."""
    from ffcx import compiler  # a run with compiled kernels does without

    generated = compiler.compile_ufl_objects([form], _form_options())
    # From FFCx 0.10 on the result has lists of files and of their endings.
    source = generated[1] if isinstance(generated[1], str) else generated[0][1]
    return str(source)


def form_include_folder() -> str:
    """Return the folder of the header that the code of forms includes."""
    return str(get_include_path())


@dataclass(frozen=True)
class FormKernels:
    """The kernels of a compiled form, without mesh, fields and constants.

    Attributes
    ----------
    ufcx
        The form's structure in C, as FFCx defines it.
    library
        The shared library that holds the structure; it must stay loaded.
    """

    ufcx: Any
    library: ctypes.CDLL

    @classmethod
    def from_library(cls, form: ufl.Form, library: ctypes.CDLL) -> "FormKernels":
        """Return the kernels of a form from the library that its code was compiled into."""
        # the structure's name in the library, of the only form (number 0) without a prefix
        variable = ctypes.c_char.in_dll(library, naming.form_name(form, 0, ""))
        return cls(UFCX.cast("ufcx_form*", ctypes.addressof(variable))[0], library)

    @property
    def ffi(self) -> cffi.FFI:
        """The cffi object that dolfinx expects of a module."""
        return UFCX

    def order_fields(self, fields: Sequence[Field]) -> list[Field]:
        """Return the fields of a form that its kernels take, in the kernels' order.

        `fields` are all coefficients of the form, in UFL's order.
        """
        positions = self.ufcx.original_coefficient_positions
        return [fields[positions[i]] for i in range(self.ufcx.num_coefficients)]

    def subdomain_ids(self, kind: Any) -> list[int]:
        """Return the ids of the subdomains of a form's integrals of a kind, such as cells.

        Integrals over the whole mesh have no id.
        """
        # ids of all kinds stand in one array, and those of a kind between two offsets
        first, last = (self.ufcx.form_integral_offsets[int(kind.value) + i] for i in (0, 1))
        ids = [self.ufcx.form_integral_ids[i] for i in range(first, last)]
        return [subdomain_id for subdomain_id in ids if subdomain_id != -1]


def bind_form(
    kernels: FormKernels,
    spaces: Sequence[fem.FunctionSpace],
    fields: Sequence[fem.Function],
    constants: Sequence[fem.Constant],
    tags: Mapping[str, mesh.MeshTags | None],
    domain: Any,
) -> fem.Form:
    """Return a compiled form on a mesh, as `fem.form` makes it.

    Parameters
    ----------
    spaces
        Function spaces of the form's arguments.
    fields, constants
        Coefficients and constants of the form, in the order of the kernels.
    tags
        Kind of integral, such as "exterior_facet" -> subdomains; None for integrals without.
    domain
        The mesh in C++.
    """
    tags_by_kind = {
        getattr(fem.IntegralType, name): tags_of_kind for name, tags_of_kind in tags.items()
    }
    integration_domains = {
        kind: get_integration_domains(kind, tags_of_kind, kernels.subdomain_ids(kind))
        for kind, tags_of_kind in tags_by_kind.items()
    }
    address = int(UFCX.cast("uintptr_t", UFCX.addressof(kernels.ufcx)))
    inputs = (*(_cpp_objects(group) for group in (spaces, fields, constants)), integration_domains)
    create_form = form_cpp_class(np.float64)
    try:
        # no entity maps: all spaces are on this mesh
        cpp_form = create_form(address, *inputs, {}, domain)
    except TypeError:
        # From dolfinx 0.10 on a form may have cells of several kinds.
        cpp_form = create_form([address], *inputs, [], domain)
    return fem.Form(cpp_form, kernels.ufcx, None, kernels)


def _cpp_objects(objects: Sequence[Any]) -> list[Any]:
    """Return the C++ objects that dolfinx objects wrap."""
    return [wrapper._cpp_object for wrapper in objects]


def shared_facet_partitioner() -> Any:
    """Return the partitioner for `create_mesh` that gives each rank one layer of ghost cells.

    It divides equal meshes in the same way each time. Scenes on one mesh with other numbers of the
    case rely on this: they pass on contacts by the numbers of cells and nodes.
    """
    os.environ["SCOTCH_PTHREAD_NUMBER"] = "1"  # with threads it divides in several ways
    mode = mesh.GhostMode.shared_facet
    try:
        return mesh.create_cell_partitioner(mode)
    except TypeError:
        return mesh.create_cell_partitioner(mode, 2)  # cells at a facet, from dolfinx 0.11


def interpolation_points(V: fem.FunctionSpace) -> NDArray[np.float64]:
    """Return the nodes (n, dim) of a Lagrange space on the reference cell."""
    points = V.element.interpolation_points  # a method in dolfinx 0.9
    return np.asarray(points() if callable(points) else points)


def geometry_dofs(domain: mesh.Mesh) -> NDArray[np.int32]:
    """Return the rows (cells, nodes) of `geometry.x` at the nodes of each cell."""
    # A list since dolfinx 0.11, where `dofmap` is deprecated.
    dofmaps = getattr(domain.geometry, "dofmaps", None)
    return np.asarray(dofmaps[0] if isinstance(dofmaps, list) else domain.geometry.dofmap)


def original_cells(domain: mesh.Mesh) -> NDArray[np.int64]:
    """Return the number of each local cell in the input of its mesh.

    The array is empty for a submesh.
    """
    try:
        return np.asarray(domain.topology.original_cell_index, dtype=np.int64)
    except RuntimeError:  # in dolfinx 0.9
        return np.empty(0, dtype=np.int64)


def tags_belong_to(tags: mesh.MeshTags, domain: mesh.Mesh) -> bool:
    """Return whether mesh tags have been made for a mesh: whether both have the same topology."""
    # Some versions wrap topologies.
    topologies = tags.topology, domain.topology
    of_tags, of_mesh = (getattr(topology, "_cpp_object", topology) for topology in topologies)
    return of_tags is of_mesh


def add_matrix(K: PETSc.Mat, form: fem.Form, clamped: list[fem.DirichletBC]) -> None:
    """Add the matrix of a bilinear form to a matrix, without the rows and columns of `clamped`.

    `finish_matrix` must follow, to communicate the entries.
    """
    cpp = form._cpp_object
    constants, coefficients = pack_constants(cpp), pack_coefficients(cpp)
    _assemble_matrix(K, cpp, constants, coefficients, _cpp_objects(clamped))


def finish_matrix(K: PETSc.Mat, V: fem.FunctionSpace, clamped: list[fem.DirichletBC]) -> None:
    """Communicate the entries of a matrix, and put ones on the diagonal of `clamped`.

    Collective.
    """
    K.assemblyBegin(PETSc.Mat.AssemblyType.FLUSH)
    K.assemblyEnd(PETSc.Mat.AssemblyType.FLUSH)
    # entries may be added before this, and set from here on
    insert_diagonal(K, V._cpp_object, _cpp_objects(clamped), 1.0)
    K.assemble()
