"""Derivatives by the drawn shape beside those by the placement that densities contain.

A case with another deviation has other places and normals, and all that is said by them: remanence,
thickness and natural shape by formulas, loads per area and length, and those on an edge in all. The
derivative is the sum of those by the placement r0 and by each field f that follows from r0,

    dJ/dw0 = n . dJ/dr0 + dJ/df : df/dw0,

where df/dw0 are differences: f in a cell follows from the nodes of this cell alone, so that a node
of all cells is moved at once.

Words and symbols:

- J is a result; w0 the deviation, a motion of the undeformed surface along its normal n; r0 the
  placement, the undeformed place as a function on the mesh; Pi the potential energy.
- A share is a term Pi_k with its weights in a gradient of J: `energy`, the factor of its own
  derivative, and `work`, the factor of the derivative of its residual along w.
- `over` of a term is the form of the integral (area, length, volume) by which its load is divided.
- A measure is such an integral. Own cells are the cells of this rank without ghosts.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.field_gradient import (
    WeightedTerm,
    broken_space,
)
from magshell_fenicsx.assembly.terms import FormTerm
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
    """Return further terms for loads that are divided by an integral, such as an area; collective.

    A load L/A with A = int dA has the derivative L'/A - (L/A) A'/A. The first part is that of the
    term itself; here the second one is added, as a term A with the weight -(L/A)/A.

    Parameters
    ----------
    shares
        Terms with their weights in a gradient; those without such an integral add nothing.
    w
        The vector along which residuals are taken.
    """
    measure_terms, comm, direction = list[WeightedTerm](), model.V.mesh.comm, fem.Function(model.V)
    for share in shares:
        if share.term.over is None:  # the form of the integral A
            continue
        # dead loads are linear in u, so both weights are taken along one vector
        direction.x.array[:] = share.energy * model.u.x.array + share.work * w.x.array
        numerator = model.kernels.compile(
            f"{share.term.name} along", ufl.replace(share.term.form, {model.u: direction})
        )
        measure = FormTerm(f"{share.term.name} over", share.term.over, model.u, model.kernels)
        # the load L/A along this direction, and A
        load_value, measure_value = (
            comm.allreduce(integral)
            for integral in (fem.assemble_scalar(numerator), measure.energy())
        )
        measure_terms.append(WeightedTerm(measure, -load_value / measure_value, 0.0))
    return measure_terms


def of_normals(adjoint: Adjoint, place: AdjointState, *, first: bool) -> Array | float:
    """Return derivatives (own cells, nodes, 3) by the placement, from normals at points.

    Point forces act along the normal at their point, and J may contain a deflection along a normal.
    0.0 of a model without a mid-surface, where the normals stay. Collective.

    Parameters
    ----------
    place
        State with its multipliers.
    first
        Whether this is the first place of the adjoint, whose deflections J contains.
    """
    model, mu, conjugates = adjoint.scene.model, place.state.mu, place.conjugates
    if not model.midsurface:  # on the axis of a meridian they stay
        return 0.0
    # name of a point, weight of u . n there, and weight of w . n there
    deflected_points = (
        [(point, factor, 0.0) for point, factor in adjoint.deflections.items()] if first else []
    )
    for name, force in model.loads.forces.items():
        energy = place.energy * mu[name] + conjugates.get(name, 0.0)
        deflected_points.append(
            (force.point, model.force_unit * energy, model.force_unit * mu[name])
        )
    gradient: Array | float = 0.0
    for point, weight_of_u, weight_of_w in deflected_points:
        displacement = weight_of_u * model.displacement(
            place.state.u, point
        ) + weight_of_w * model.displacement(place.w, point)
        vertex, cells = model.midsurface.points[point], model.midsurface.cells_of_point(point)
        # by the placement, of displacement . n at this vertex
        gradient = gradient + by_vertex_normal(model.r0, vertex, displacement, cells)
    return gradient


def rates(
    model: ShellModel | MeridianModel, field: PlacementField, normals: Array
) -> Iterator[Array]:
    """Yield the derivatives of a field by a motion of nodes along the normal; collective.

    One array (own cells, nodes of the field, components) for each local number of a node of the
    model: in every cell this node moves at once, and the field in the cell follows from its own
    nodes.

    Parameters
    ----------
    normals
        (own cells, nodes, 3) at the nodes of the model.
    """
    V, step = model.V, STEP * model.material.h
    placement = fem.Function(broken_space(V))  # each cell has nodes of its own
    nodes = placement.x.array.reshape(-1, V.dofmap.bs)  # a view
    coordinates = model.r0.x.array.reshape(-1, V.dofmap.bs)[V.dofmap.list]
    node_dofs = placement.function_space.dofmap.list
    field_dofs = field.function_space.dofmap.list[: len(normals)]
    for node_number in range(coordinates.shape[1]):
        values = list[Array]()
        # central difference, in cells that share no nodes
        for sign in (1, -1):
            # this node of all own cells moves along its normal, and the field follows
            moved_coordinates = coordinates.copy()
            moved_coordinates[: len(normals), node_number] += (
                sign * step * normals[:, node_number][:, model.axes]
            )
            nodes[node_dofs] = moved_coordinates
            moved_field = field.rebuild(placement)
            values.append(
                moved_field.x.array.reshape(-1, field.function_space.dofmap.bs)[field_dofs]
            )
        forward, backward = values
        yield np.asarray((forward - backward) / (2 * step))
