"""The mass as a result: the mean of the thickness's factor over the undeformed area."""

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.la import InsertMode

from magshell_fenicsx.assembly.forms import FieldGradient
from magshell_fenicsx.simulate.gradients.fields import places_of
from magshell_fenicsx.simulate.scene import Scene

MASS = "mass"


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
    found = forces.x.array[Q.dofmap.list[:cells]][..., None] / area
    places, normals = places_of(scene, t)
    return float(value), FieldGradient(t, np.asarray(found), places[:cells], normals[:cells])
