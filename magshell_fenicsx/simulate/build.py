"""From a plan to the model of a shell, its meridian or its body."""

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.hexahedra import sweep
from magshell_fenicsx.mesh.midsurface import Midsurface, distribute
from magshell_fenicsx.mesh.mirror import Y0
from magshell_fenicsx.models.axisymmetric.meridian import make_meridian
from magshell_fenicsx.models.axisymmetric.model import MeridianModel
from magshell_fenicsx.models.shell.model import ShellModel
from magshell_fenicsx.models.shell.thickness import Thickness, refuse_unfit
from magshell_fenicsx.models.solid.model import SolidModel
from magshell_fenicsx.platform.first import from_first
from magshell_fenicsx.problem.problem import Plan, meridian_vertices

Array = NDArray[np.float64]


def build_model(plan: Plan, comm: MPI.Comm) -> ShellModel:
    """The whole shell or half of it, on all ranks together."""
    surface = build_midsurface(plan, comm)
    return ShellModel(
        surface,
        plan.material,
        plan.mesh.degree,
        plan.conditions,
        plan.loads,
        plan.mesh.penalty,
        plan.thickness,
        plan.mirror or Y0,
    )


def build_meridian_model(plan: Plan) -> MeridianModel:
    """The meridian, whole on every rank."""
    span = plan.meridian
    assert span
    points = {name: span.place(x) for name, x in plan.points.items()}
    vertices = meridian_vertices(plan)
    meridian = make_meridian(span.embedding, vertices, span.names, points, span.curvature)
    model = MeridianModel(
        meridian, plan.material, plan.mesh.degree, plan.conditions, plan.loads, plan.mesh.penalty, plan.thickness
    )
    model.held.refuse_loose(model.r0)
    return model


def build_solid_model(plan: Plan, comm: MPI.Comm) -> SolidModel:
    """The whole body or half of it, on all ranks together."""

    def factor(x: Array) -> Array:
        found = (plan.thickness or Thickness()).at(x)
        refuse_unfit(found, x, comm)
        return found

    solid = plan.body
    assert solid
    body = sweep(from_first(comm, plan.triangulated), plan.material.h, solid.layers, comm, factor)
    return SolidModel(body, plan.material, solid.material, plan.conditions, plan.loads, plan.mirror or Y0)


def build_midsurface(plan: Plan, comm: MPI.Comm) -> Midsurface:
    """Triangulate on rank 0, distribute to all."""
    return distribute(from_first(comm, plan.triangulated), comm)
