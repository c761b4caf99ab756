"""A remanence that varies over a body, through its thickness too."""

from collections.abc import Sequence

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.mesh.hexahedra import Body
from magshell_fenicsx.models.shell.fitted import Cells
from magshell_fenicsx.models.shell.parameters import Magnetisation
from magshell_fenicsx.models.shell.patterns import ByPatch, Pattern, by_patch, inside, refuse_unbounded, shown

Array = NDArray[np.float64]


def remanence_field(pattern: Pattern, V: fem.FunctionSpace) -> fem.Function:
    """The pattern at the nodes of every cell, free to jump from cell to cell; collective.

    Raises
    ------
    MeshError
        On every rank, if it has no finite value somewhere.
    """
    nodes, normals = places(V)
    Q = fem.functionspace(V.mesh, ("DG", V.element.basix_element.degree, (3,)))
    field = fem.Function(Q, name="Br")
    refuse_unbounded(pattern(nodes, normals), nodes, V.mesh.comm)
    fit = shown(pattern, cells_of_body(V), pattern(inside(nodes), normals), Q.element.basix_element)
    field.x.array.reshape(-1, 3)[Q.dofmap.list] = fit.nodal
    return field


def cells_of_body(V: fem.FunctionSpace) -> Cells:
    """The cells of a body."""
    owned = V.mesh.topology.index_map(3).size_local
    return Cells(V.element.basix_element, V.tabulate_dof_coordinates()[V.dofmap.list], owned, V.mesh.comm)


def places(V: fem.FunctionSpace) -> tuple[Array, Array]:
    """The nodes of every cell, and the normals of the surface at their height, (cells, nodes, 3) each."""
    element = V.element.basix_element
    along = element.tabulate(1, element.points)[:, :, :, 0]
    nodes = V.tabulate_dof_coordinates()[V.dofmap.list]
    a1, a2 = np.einsum("dvk,cki->dcvi", along[1:3], nodes)
    m = np.cross(a1, a2)
    return nodes, np.asarray(m / np.linalg.norm(m, axis=-1, keepdims=True))


def in_cells(field: Magnetisation, body: Body) -> Array | Pattern:
    """The remanence, with a vector for each cell where it is given by patches or by layers.

    Raises
    ------
    MeshError
        If the body has no such patch.
    """
    if field.patches:
        return by_patch(field.patches, body.patches, len(body.between))
    return _layered(field.layers, body) if field.layers else field.remanent


def _layered(layers: Sequence[tuple[float, Array]], body: Body) -> ByPatch:
    """Layers from the inner face outwards: fractions of the thickness, which end where cells do, and vectors."""
    ends = np.cumsum([fraction for fraction, _ in layers])
    middle = body.between.mean(axis=1)
    return ByPatch(np.array([vector for _, vector in layers])[np.searchsorted(ends[:-1], middle)])
