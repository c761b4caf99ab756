"""The calls that differ between dolfinx 0.9, 0.10 and 0.11; no other module depends on a version."""

import ctypes
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
from dolfinx.cpp.graph import AdjacencyList_int32
from dolfinx.fem.forms import form_cpp_class, get_integration_domains
from ffcx import compiler, naming
from ffcx.codegeneration import get_include_path, jit
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.platform.packages import Unusable

if np.issubdtype(PETSc.ScalarType, np.complexfloating):
    raise Unusable(
        "this PETSc computes with complex numbers; the program takes one with real numbers: of PyPI's wheels "
        "dolfinx-solver-real in place of dolfinx-solver"
    )
_Reason = PETSc.SNES.ConvergedReason
NOT_A_NUMBER = (  # renamed by PETSc 3.25
    _Reason.DIVERGED_FNORM_NAN
    if hasattr(_Reason, "DIVERGED_FNORM_NAN")
    else _Reason.DIVERGED_FUNCTION_NANORINF
)


Field = TypeVar("Field")


FORMS = (
    cffi.FFI()
)  # the declarations of UFCx; pointers to complex numbers, which cffi lacks, are none of ours
FORMS.cdef(
    (jit.UFC_HEADER_DECL.format("float64") + jit.UFC_INTEGRAL_DECL + jit.UFC_FORM_DECL).replace(
        "_Complex", ""
    )
)


@cache
def _form_options() -> dict[str, Any]:
    return dict(ffcx.get_options({"scalar_type": np.float64}))


def form_signature(form: ufl.Form) -> str:
    """Return the name of all that the code of a form depends on."""
    return str(naming.compute_signature([form], str(sorted(_form_options().items()))))


def form_code(form: ufl.Form) -> str:
    """The code of a form in C, as FFCx makes it."""
    made = compiler.compile_ufl_objects([form], _form_options())
    source = (
        made[1] if isinstance(made[1], str) else made[0][1]
    )  # lists of files, and their endings, from FFCx 0.10
    return str(source)


def form_include() -> str:
    """The folder of the header that the code includes."""
    return str(get_include_path())


@dataclass(frozen=True)
class Kernels:
    """A compiled form without mesh, fields and numbers."""

    ufcx: Any
    library: ctypes.CDLL

    @classmethod
    def of(cls, form: ufl.Form, library: ctypes.CDLL) -> "Kernels":
        """Those of a form in the library that its code became."""
        variable = ctypes.c_char.in_dll(library, naming.form_name(form, 0, ""))
        return cls(FORMS.cast("ufcx_form*", ctypes.addressof(variable))[0], library)

    @property
    def ffi(self) -> cffi.FFI:
        """What dolfinx asks of a module that cffi has made."""
        return FORMS

    def in_order(self, fields: Sequence[Field]) -> list[Field]:
        """Those of a form that its kernels take, in their order."""
        places = self.ufcx.original_coefficient_positions
        return [fields[places[i]] for i in range(self.ufcx.num_coefficients)]

    def marked(self, kind: Any) -> list[int]:
        """The marks of the parts of the mesh that integrals of a kind are over; those over all of
        it have none.
        """
        first, last = (self.ufcx.form_integral_offsets[int(kind.value) + i] for i in (0, 1))
        return [mark for i in range(first, last) if (mark := self.ufcx.form_integral_ids[i]) != -1]


def bound(
    kernels: Kernels,
    spaces: Sequence[fem.FunctionSpace],
    fields: Sequence[fem.Function],
    numbers: Sequence[fem.Constant],
    marks: Mapping[str, mesh.MeshTags | None],
    domain: Any,
) -> fem.Form:
    """A compiled form on a mesh, as `fem.form` makes it.

    Parameters
    ----------
    marks
        By the kind of integral, such as "exterior_facet".
    domain
        The mesh in C++.
    """
    kinds = {getattr(fem.IntegralType, name): tags for name, tags in marks.items()}
    parts = {
        kind: get_integration_domains(kind, tags, kernels.marked(kind))
        for kind, tags in kinds.items()
    }
    address = int(FORMS.cast("uintptr_t", FORMS.addressof(kernels.ufcx)))
    objects = ([each._cpp_object for each in of] for of in (spaces, fields, numbers))
    make, given = form_cpp_class(np.float64), (*objects, parts)
    try:
        made = make(address, *given, {}, domain)
    except TypeError:
        made = make([address], *given, [], domain)  # of cells of several kinds, from dolfinx 0.10
    return fem.Form(made, kernels.ufcx, None, kernels)


def adjacency(links: NDArray[np.int32], offsets: NDArray[np.int32]) -> Any:
    """What a partitioner returns: the ranks of each cell, and where these begin."""
    return AdjacencyList_int32(links, offsets)


def interpolation_points(V: fem.FunctionSpace) -> NDArray[np.float64]:
    """The nodes (n, dim) of a Lagrange space on the reference cell."""
    points = V.element.interpolation_points  # a method in dolfinx 0.9
    return np.asarray(points() if callable(points) else points)


def corner_numbers(domain: mesh.Mesh) -> NDArray[np.int32]:
    """Rows of `geometry.x` at each cell's nodes; (cells, nodes)."""
    dofmaps = getattr(
        domain.geometry, "dofmaps", None
    )  # a list since dolfinx 0.11, where `dofmap` is deprecated
    return np.asarray(dofmaps[0] if isinstance(dofmaps, list) else domain.geometry.dofmap)


def original_cells(domain: mesh.Mesh) -> NDArray[np.int64]:
    """The number of each local cell in the order in which they were made; none of a part of another
    mesh.
    """
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
    _assemble_matrix(
        K, cpp, pack_constants(cpp), pack_coefficients(cpp), [bc._cpp_object for bc in clamped]
    )


def finish_matrix(K: PETSc.Mat, V: fem.FunctionSpace, clamped: list[fem.DirichletBC]) -> None:
    """Communicate the entries and put ones on the diagonal of `clamped`."""
    K.assemblyBegin(PETSc.Mat.AssemblyType.FLUSH)
    K.assemblyEnd(PETSc.Mat.AssemblyType.FLUSH)
    insert_diagonal(K, V._cpp_object, [bc._cpp_object for bc in clamped], 1.0)
    K.assemble()
