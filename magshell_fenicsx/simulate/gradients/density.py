"""A gradient by a field as a density per area at the nodes of the displacement, for pictures.

With the derivatives f at the nodes of the cells and the hat functions H_v of the vertices,

    g_v = sum(f H_v)/int(H_v dA)

is what J changes by where the field changes by one over a unit of area, averaged over about a cell. The sum of g_v
int(H_v dA) is the derivative by a field that changes alike everywhere.
"""

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.la import InsertMode
from numpy.typing import NDArray

from magshell_fenicsx.assembly.forms import FieldGradient
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]


def density(scene: Scene, found: FieldGradient) -> Array:
    """dJ per area over R^2 (per volume of a solid) at the nodes of V on this rank, (nodes, components); collective."""
    V, nodes = scene.model.V, found.field.function_space.element.basix_element.points
    H = fem.functionspace(V.mesh, ("Lagrange", 1))
    hat, count = H.element.basix_element, len(found.forces)
    area = fem.Function(H)
    form = scene.model.kernels.compile("area of a vertex", scene.model.over_area()(ufl.TestFunction(H)))
    fem.assemble_vector(area.x.array, form)
    _added(area)
    shares = np.einsum("cnk,nv->cvk", found.forces, hat.tabulate(0, nodes)[0, :, :, 0])
    at_vertices = []
    for component in np.moveaxis(shares, -1, 0):
        g = fem.Function(H)
        np.add.at(g.x.array, H.dofmap.list[:count], component)
        _added(g)
        at_vertices.append(g.x.array / area.x.array / scene.model.multiplicity)
    in_cells = np.stack(at_vertices, axis=-1)[H.dofmap.list[:count]]
    table = hat.tabulate(0, V.element.basix_element.points)[0, :, :, 0]
    map_ = V.dofmap.index_map
    values = np.zeros((map_.size_local + map_.num_ghosts, shares.shape[-1]))
    values[V.dofmap.list[:count]] = np.einsum("nv,cvk->cnk", table, in_cells)
    return values


def _added(f: fem.Function) -> None:
    """Add what other ranks have of shared vertices."""
    f.x.scatter_reverse(InsertMode.add)
    f.x.scatter_forward()
