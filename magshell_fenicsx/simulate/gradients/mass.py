"""The mass as a result, the mean of the thickness's factor over the undeformed area; derivatives as densities per area.

With the derivatives f by a field at the nodes of the cells and the hat functions H_v of the vertices,

    g_v = sum(f H_v)/int(H_v dA)

is what J changes by where the field changes by one over a unit of area, averaged over about a cell. The sum of g_v
int(H_v dA) is the derivative by a field that changes alike everywhere. It is drawn at the nodes of the displacement.
"""

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.la import InsertMode
from numpy.typing import NDArray

from magshell_fenicsx.assembly.forms import FieldGradient
from magshell_fenicsx.simulate.gradients.fields import places_of
from magshell_fenicsx.simulate.scene import Scene

MASS = "mass"
Array = NDArray[np.float64]


def mass(scene: Scene) -> tuple[float, FieldGradient | None]:
    """It over that of the same shell with the thickness h, and its derivatives by the thickness; collective."""
    model = scene.model
    if model.thickness is None:
        return 1.0, None
    t, over, log = model.thickness, model.over_area(), model.kernels
    Q, comm = t.function_space, t.function_space.mesh.comm
    one = fem.Constant(Q.mesh, 1.0)
    area = comm.allreduce(fem.assemble_scalar(log.compile("area", over(one))))
    value = comm.allreduce(fem.assemble_scalar(log.compile("mass", over(t[0])))) / area
    forces = fem.Function(Q)
    fem.assemble_vector(forces.x.array, log.compile("mass by thickness", over(ufl.TestFunction(Q)[0])))
    forces.x.scatter_reverse(InsertMode.add)
    cells = Q.mesh.topology.index_map(Q.mesh.topology.dim).size_local
    density = forces.x.array[Q.dofmap.list[:cells]][..., None] / area
    places, normals = places_of(scene, t)
    return float(value), FieldGradient(t, np.asarray(density), places[:cells], normals[:cells])


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
