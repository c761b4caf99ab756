"""Derivatives by the drawn shape beside those by the placement that densities contain.

A case with another deviation has other places and normals, and all that is said by them: remanence,
thickness and natural shape by formulas, loads per area and length, those on an edge in all, and
cells of another width. The derivative is the sum of those by the placement r0, by the width of the
cells, and by each field f that follows from r0,

    dJ/dw0 = n . (dJ/dr0 + dJ/dx) + dJ/df : df/dw0,

where df/dw0 are differences: f in a cell follows from the nodes of this cell alone, so that a node
of all cells is moved at once. Cells are as wide as the flat triangles between their vertices x.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.field_gradient import WeightedTerm, broken_space
from magshell_fenicsx.assembly.field_gradient import derivatives_by_field as summed
from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.spatial_fields import PlacementField
from magshell_fenicsx.parts.forces.load_vectors import by_vertex_normal
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.shells.shell import ShellModel
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, AdjointState

Array = NDArray[np.float64]
STEP = 1e-4  # of h: of a node


def of_measures(
    model: ShellModel | MeridianModel, shares: Sequence[WeightedTerm], w: fem.Function
) -> list[WeightedTerm]:
    """Return the terms that come from the derivative of an integral by which other terms are
    divided; collective.
    """
    added, comm, v = list[WeightedTerm](), model.V.mesh.comm, fem.Function(model.V)
    for share in shares:
        if share.term.over is None:
            continue
        v.x.array[:] = share.energy * model.u.x.array + share.work * w.x.array
        numerator = model.kernels.compile(
            f"{share.term.name} along", ufl.replace(share.term.form, {model.u: v})
        )
        measure = FormTerm(f"{share.term.name} over", share.term.over, model.u, model.kernels)
        value, size = (
            comm.allreduce(integral)
            for integral in (fem.assemble_scalar(numerator), measure.energy())
        )
        added.append(WeightedTerm(measure, -value / size, 0.0))
    return added


def of_widths(
    model: ShellModel | MeridianModel, shares: Sequence[WeightedTerm], w: fem.Function
) -> Array | None:
    """The derivatives (cells, vertices, 3) by the vertices of flat cells, whose widths are in
    energies of edges.
    """
    if model.axisymmetric:  # where the placement says how wide they are
        return None
    domain = model.V.mesh
    x = fem.Function(fem.functionspace(domain, ("Lagrange", 1, (3,))), name="x")
    x.interpolate(lambda places: places)
    jet, (volume, side) = kin.jet(x, domain), (ufl.CellVolume(domain), ufl.FacetArea(domain))
    length = kin.conormal(jet, kin.facet_covector(domain))[2]
    moved_measures = {volume: volume * kin.area_ratio(jet), side: side * length}
    widened_terms = list[WeightedTerm]()
    for share in shares:
        form = share.term.form
        on_edges = any(integral.integral_type() != "cell" for integral in form.integrals())
        if on_edges and (other := ufl.replace(form, moved_measures)) != form:
            widened_terms.append(
                WeightedTerm(
                    FormTerm(share.term.name, other, model.u, model.kernels),
                    share.energy,
                    share.work,
                )
            )
    return summed(widened_terms, x, model.u, w, model.kernels) if widened_terms else None


def of_normals(adjoint: Adjoint, place: AdjointState, *, first: bool) -> Array | float:
    """The derivatives (own cells, nodes, 3) by normals at points, along which forces and
    deflections are.
    """
    model, mu, c = adjoint.scene.model, place.state.mu, place.conjugates
    if not model.midsurface:  # on the axis of a meridian they stay
        return 0.0
    deflected_points = (
        [(point, factor, 0.0) for point, factor in adjoint.deflections.items()] if first else []
    )
    for name, force in model.loads.forces.items():
        energy = place.energy * mu[name] + c.get(name, 0.0)
        deflected_points.append(
            (force.point, model.force_unit * energy, model.force_unit * mu[name])
        )
    total: Array | float = 0.0
    for point, of_u, of_w in deflected_points:
        v = of_u * model.displacement(place.state.u, point) + of_w * model.displacement(
            place.w, point
        )
        location = model.midsurface.points[point], v, model.midsurface.cells_of_point(point)
        total = total + by_vertex_normal(model.r0, *location)
    return total


def fields_of_placement(terms: Sequence[FormTerm]) -> list[PlacementField]:
    """The fields in terms that follow from the placement."""
    coefficients = (
        c for term in terms for c in term.form.coefficients() if isinstance(c, PlacementField)
    )
    return list(dict.fromkeys(coefficients))


def rates(
    model: ShellModel | MeridianModel, field: PlacementField, normals: Array
) -> Iterator[Array]:
    """Derivative of a field (own cells, nodes, size) by a motion of each node of all cells along
    its normal; collective.

    `normals` (own cells, nodes, 3) are those of own cells.
    """
    V, step = model.V, STEP * model.material.h
    r = fem.Function(broken_space(V))
    nodes = r.x.array.reshape(-1, V.dofmap.bs)
    coordinates = model.r0.x.array.reshape(-1, V.dofmap.bs)[V.dofmap.list]
    node_dofs, dofs = r.function_space.dofmap.list, field.function_space.dofmap.list[: len(normals)]
    for k in range(coordinates.shape[1]):
        values = list[Array]()
        for sign in (1, -1):
            moved_coordinates = coordinates.copy()
            moved_coordinates[: len(normals), k] += sign * step * normals[:, k][:, model.axes]
            nodes[node_dofs] = moved_coordinates
            values.append(
                field.rebuild(r).x.array.reshape(-1, field.function_space.dofmap.bs)[dofs]
            )
        yield np.asarray((values[0] - values[1]) / (2 * step))
