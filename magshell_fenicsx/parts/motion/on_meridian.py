"""What viscous forces need to know of a meridian."""

import basix
import basix.ufl
import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.models.axisymmetric import jets
from magshell_fenicsx.models.axisymmetric.model import MeridianModel
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.parts.motion.viscous import SIZE, Edge, Surface, held_jump, mirrored_jump

Array = NDArray[np.float64]


def surface_of(model: MeridianModel) -> Surface:
    """Strains are known inside the cells: on the axis the coordinates are singular."""
    mesh, factory, j0 = model.V.mesh, model.factory, model.factory.j0
    inside = basix.ufl.element(
        "DG", "interval", model.degree, lagrange_variant=basix.LagrangeVariant.gl_isaac, shape=(SIZE,)
    )
    stresses, m, width = fem.functionspace(mesh, inside), factory.covector(), factory.width()
    clamped = [facets for name, (facets, _) in model.held.named.items() if model.conditions[name] == "clamped"]
    ends = [Edge(held_jump(j0, m, kin.normal(j0)), 1, factory.ds(facets)) for facets in clamped]
    if len(model.held.mirror):
        up = factory.constant(np.array([0.0, 0.0, 1.0]))
        ends.append(Edge(mirrored_jump(j0, m, up), 2, factory.ds(model.held.mirror)))
    return Surface(
        stresses,
        _Tables(model.V, stresses.element.basix_element.points),
        jets.revolved,
        j0,
        factory.thickness,
        (factory.dx(), ufl.Measure("dS", domain=mesh)),
        m,
        (ufl.avg(width), width),
        ends,
        whole=2 * np.pi,
    )


class _Tables:
    """From nodal values (U, W) to jets (6, cells, places, 3) at azimuth zero, as `jets.revolved`, by X in [0, 1]."""

    def __init__(self, V: fem.FunctionSpace, places: Array) -> None:
        self._shapes, self._nodes = V.element.basix_element.tabulate(2, places)[..., 0], V.dofmap.list

    def __call__(self, nodal: Array) -> Array:
        found = np.einsum("dpn,cni->dcpi", self._shapes, nodal.reshape(-1, 2)[self._nodes])
        (U, W), (Us, Ws), (Uss, Wss) = np.moveaxis(found, -1, 1)
        parts = [(U, 0, W), (Us, 0, Ws), (0, U, 0), (Uss, 0, Wss), (0, Us, 0), (-U, 0, 0)]
        return np.array([np.stack(np.broadcast_arrays(*part), axis=-1) for part in parts])
