"""Refusal of shells that overlap undeformed, and of edges off the shell that they join.

It needs the geometry alone: no equations are assembled, as a scene does. A scene refuses the same
in the same words. r0 is the undeformed placement over the reference length, h the thickness. Parts
are pieces of the surface that are not connected.
"""

from dataclasses import replace

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from magshell_fenicsx.assembly.global_mesh import component_numbers
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.models.domains import meridian_domain, surface_domain
from magshell_fenicsx.models.shell.spatial_fields import cell_geometry, user_field_polynomials
from magshell_fenicsx.models.shell.thickness import thickness_field
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.shells.t_junctions import (
    MidSurfaces,
    refuse_misplaced_edges,
    refuse_misplaced_parallels,
)
from magshell_fenicsx.simulate.scene import build_meridian, build_midsurface

MAX_CELLS = 20_000  # of larger meshes nothing is looked for: it would take more than seconds


def refuse_overlap(problem: Problem, cells: int) -> None:
    """Check that shells that may touch do not overlap, and that T-junctions are on their shells.

    Larger meshes are not checked, nor are shells that get thinner, or images of a half: a scene
    checks these.

    Parameters
    ----------
    cells
        Number of cells of the mesh.

    Raises
    ------
    MeshError
        With the shells, by how much they overlap, and where.
    CaseError
        If magnetised parts intersect.
    """
    loads = problem.loads
    may_overlap = any((loads.pairs, loads.joints, loads.interaction))
    if not may_overlap or cells > MAX_CELLS:
        return
    if problem.axisymmetric:
        _refuse_overlap_on_meridian(problem)
    else:
        _refuse_overlap_on_surface(problem)


def _refuse_overlap_on_meridian(problem: Problem) -> None:
    """Check that shells with one axis do not overlap, and that T-junctions are on their shells."""
    from magshell_fenicsx.parts.contact.meridian_contact import (
        ModelMeridian,
        meridian_contacts,
    )

    pairs, h, factor = problem.loads.pairs, problem.material.h, problem.thickness
    meridian = build_meridian(problem)
    V = fem.functionspace(meridian.mesh, ("Lagrange", problem.mesh.degree, (2,)))
    r0 = meridian.placement(V)
    refuse_misplaced_parallels(problem.loads.joints, meridian, r0, h)
    thickness = thickness_field(factor, r0, meridian.patches) if factor else None
    rule = meridian_domain(r0).contact_rule
    # the zero function is the displacement; making the contacts refuses an overlap
    model = ModelMeridian(r0, fem.Function(V), meridian.patches, h, rule, thickness)
    meridian_contacts(pairs, model)


def _refuse_overlap_on_surface(problem: Problem) -> None:
    """Check that shells do not overlap, T-junctions are on their shells, magnets are apart."""
    from magshell_fenicsx.parts.contact.model_surface import ModelSurface, surface_contacts

    pairs, h, factor = problem.loads.pairs, problem.material.h, problem.thickness
    surface = build_midsurface(problem, MPI.COMM_SELF)
    V = fem.functionspace(surface.mesh, ("Lagrange", problem.mesh.degree, (3,)))
    r0 = surface.placement(V)
    refuse_misplaced_edges(problem.loads.joints, surface, r0, h)
    if problem.loads.interaction:
        _refuse_parts_in_each_other(r0, h)
    if factor and factor.user_field:
        polynomials = user_field_polynomials(factor.user_field, surface, cell_geometry(r0))
        factor = replace(factor, polynomials=polynomials)
    thickness = thickness_field(factor, r0, surface.patches) if factor else None
    rule = surface_domain(r0).contact_rule
    # the zero function is the displacement; making the contacts refuses an overlap
    surface_contacts(pairs, ModelSurface(r0, fem.Function(V), surface.patches, h, rule, thickness))


def _refuse_parts_in_each_other(r0: fem.Function, h: float) -> None:
    """Check that the mid-surfaces of magnetised parts neither intersect nor coincide.

    Forces between such parts would not be numbers. The nodes of each part are compared with the
    cells of all earlier parts.

    Parameters
    ----------
    r0
        Undeformed placement of the whole surface.
    h
        Thickness over R.

    Raises
    ------
    CaseError
        With the message of a scene, which also refuses parts too near for the size of their cells.
    """
    from magshell_fenicsx.parts.magnetism.interacting import TOO_NEAR
    from magshell_fenicsx.parts.magnetism.stacked_faces import OVERLAP_DISTANCE

    surfaces, V = MidSurfaces.gather(r0), r0.function_space
    nodes = surfaces.cells.nodes
    part_of_cell = component_numbers(V)[V.dofmap.list[: len(nodes), 0]]  # by its first node
    for number in np.unique(part_of_cell)[1:]:  # the first part has no earlier ones
        own_nodes = np.unique(nodes[part_of_cell == number])
        cells_of_earlier_parts = np.flatnonzero(part_of_cell < number)
        _, _, distances = surfaces.nearest_places(surfaces.r0[own_nodes], cells_of_earlier_parts)
        if distances.min(initial=np.inf) < OVERLAP_DISTANCE * h:
            raise CaseError(TOO_NEAR)
