"""What viscous forces need to know of a meridian."""

import basix
import basix.ufl
import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.models.axisymmetric.model import MeridianModel
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.parts.motion.viscous import SIZE, Edge, Surface, held_jump, mirrored_jump

Array = NDArray[np.float64]


def surface_of(model: MeridianModel) -> Surface:
    """Strains are known inside the cells: on the axis the coordinates are singular."""
    mesh, carrier = model.V.mesh, model.factory.carrier
    j0, m = carrier.j0, carrier.covector
    inside = basix.ufl.element(
        "DG", "interval", model.degree, lagrange_variant=basix.LagrangeVariant.gl_isaac, shape=(SIZE,)
    )
    stresses = fem.functionspace(mesh, inside)
    clamped = [facets for name, (facets, _) in model.held.named.items() if model.conditions[name] == "clamped"]
    ends = [Edge(held_jump(j0, m, kin.normal(j0)), 1, carrier.ds(facets)) for facets in clamped]
    if len(model.held.mirror):
        up = carrier.constant(np.array([0.0, 0.0, 1.0]))
        ends.append(Edge(mirrored_jump(j0, m, up), 2, carrier.ds(model.held.mirror)))
    return Surface(
        stresses,
        _Tables(model.V, stresses.element.basix_element.points),
        carrier.jet,
        j0,
        model.thickness,
        (carrier.dx(), carrier.dS()),
        m,
        carrier.widths,
        ends,
        whole=carrier.whole,
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
