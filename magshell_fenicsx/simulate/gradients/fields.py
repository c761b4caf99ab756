"""Derivatives by a field, at the nodes of all cells at once, and as densities per area; those of
the mass.

Each field is a coefficient of the terms' forms, or a part of one: the remanence, a factor of its
magnitude, the factor of the thickness, the natural curvature in the case's frame, and a deviation
w0 of the drawn shape along the normal of the perfect one. Of a deviation see `shape`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import basix
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.la import InsertMode
from numpy.typing import NDArray

from magshell_fenicsx.assembly.field_gradient import FieldGradient, WeightedTerm
from magshell_fenicsx.assembly.field_gradient import derivatives_by_field as summed
from magshell_fenicsx.assembly.nonlocal_terms import FieldDifferentiable
from magshell_fenicsx.assembly.terms import FormTerm, LinearTerm, Term, factor_of
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.models.shell import spatial_fields
from magshell_fenicsx.models.shell.residual import ParameterDerivative
from magshell_fenicsx.models.shell.spatial_fields import PlacementField, Uniform
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.parts.natural.planned import frame
from magshell_fenicsx.parts.natural.shape import Natural
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, AdjointState, energies_along
from magshell_fenicsx.simulate.gradients.shape import (
    fields_of_placement,
    of_measures,
    of_normals,
    of_widths,
    rates,
)
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.sensitivity import expand_shell_contact, magnetic_terms
from magshell_fenicsx.simulate.transfer import transfer

if TYPE_CHECKING:  # one of them is built
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel

Array = NDArray[np.float64]
# of field, forces, places, normals -> forces
Projection = Callable[[Scene, fem.Function, Array, Array, Array], Array]
MASS = "mass"


@dataclass(frozen=True)
class Kind:
    """A field that results are differentiated by.

    Attributes
    ----------
    coefficient
        Its name in the terms.
    project
        From the coefficient's components to the field's own; None: they are the same.
    """

    coefficient: str
    project: Projection | None = None


def by_field(adjoint: Adjoint, name: str, origin: Adjoint | None = None) -> FieldGradient:
    """The derivatives by a field of `FIELDS`; collective.

    Parameters
    ----------
    origin
        The same in the scene that was solved, if it is another one.

    Raises
    ------
    CaseError
        If no result of the scene depends on it.
    """
    scene = adjoint.scene
    other = _with_field(adjoint, name)
    if other is not scene:
        return by_field(_transferred(adjoint, other), name, adjoint)
    model, kind = scene.model, FIELDS[name]
    slope = adjoint.slope
    if slope and name in ("thickness", "deviation"):
        raise CaseError(
            f"{name}: what a sensor reads has no gradient by this field; allowed are remanence, "
            "magnitude"
        )
    if name == "deviation" and (
        model.contacts or getattr(scene.problem.loads.magnetic, "in_space", None)
    ):
        raise CaseError(
            "deviation: no gradient beside bodies, or in a field that is known at points of space"
        )

    def over_all_places(coefficient_or_name: str | PlacementField) -> tuple[fem.Function, Array]:
        parts = [
            model.system.at_state(place.state).evaluate(
                partial(_field_at_place, adjoint, origin, name, number, place, coefficient_or_name)
            )
            for number, place in enumerate(adjoint.places)
        ]
        return parts[-1][0], np.sum(
            [gradient_at_place for _, of_place in parts for gradient_at_place in of_place], axis=0
        )

    f, forces = over_all_places(kind.coefficient)
    places, normals = (v[: len(forces)] for v in places_of(scene, f))
    if name == "deviation":
        places, normals = _perfect(scene, places, normals)
    if kind.project:
        forces = kind.project(scene, f, forces, places, normals)
    if model.thin and name == "deviation":
        for field in _placement_fields(adjoint, name, normals):
            _, by_rate = over_all_places(field)
            contracted = (
                np.sum(by_rate * rate, axis=(1, 2)) for rate in rates(model, field, normals)
            )
            forces = forces + np.stack(list(contracted), axis=1)[..., None]
    return FieldGradient(f, forces, places, normals)


def _field_at_place(
    adjoint: Adjoint,
    origin: Adjoint | None,
    name: str,
    number: int,
    place: AdjointState,
    coefficient_or_name: str | PlacementField,
) -> tuple[fem.Function, list[Array]]:
    """Return a field, and its gradients that a place gives, whose state is set.

    Parameters
    ----------
    origin, name
        See `by_field`.
    coefficient_or_name
        The field, or its name in the terms.
    """
    scene, model, slope = adjoint.scene, adjoint.scene.model, adjoint.slope
    knowing = [term for term in model.system.terms if isinstance(term, FieldDifferentiable)]
    if origin:
        expand_shell_contact(origin.scene, scene, origin.places[number].state)
    shares, w = _shares(adjoint, number, place, name), _contracted(scene, place)
    coefficient = (
        coefficient_or_name if isinstance(coefficient_or_name, str) else coefficient_or_name.name
    )
    f = next(
        (
            c
            for s in shares
            for c in s.term.form.coefficients()
            if c is coefficient_or_name or c.name == coefficient_or_name
        ),
        None,
    )
    known_gradients = [
        field_and_gradient
        for term in knowing
        if (field_and_gradient := _known_gradient(term, place, w, coefficient))
    ]
    f = f or next((field_and_gradient for field_and_gradient, _ in known_gradients), None)
    if f is None and slope and slope.field is not None and coefficient == slope.field.name:
        f = slope.field
    if f is None or (not model.thin and coefficient != "Br"):
        raise CaseError(f"{name}: the case has no such field: no result depends on it")
    if model.thin and coefficient_or_name == "r0":
        shares += of_measures(model, shares, w)
    forces = [gradient_at_points for _, gradient_at_points in known_gradients] + [
        summed(shares, f, model.u, w, model.kernels)
    ]
    if slope and slope.by_field is not None and slope.field is not None and not number:
        forces += [slope.by_field] if coefficient == slope.field.name else []
    if (
        model.thin
        and coefficient_or_name == "r0"
        and (by_vertices := of_widths(model, shares, w)) is not None
    ):
        forces[-1][:, : by_vertices.shape[1]] += by_vertices  # vertices are the first nodes
    if coefficient_or_name == "r0":
        forces[-1] += of_normals(adjoint, place, first=not number)
    if name == "thickness" and scene.problem.loads.contacts:
        forces.append(_of_starts(scene, shares, f, w))
    return f, forces


def _placement_fields(adjoint: Adjoint, name: str, normals: Array) -> Iterator[PlacementField]:
    """Yield the fields of an adjoint's terms that change with the placement; collective.

    Parameters
    ----------
    name
        See `by_field`.
    normals
        Directions in which places move.
    """
    scene, model = adjoint.scene, adjoint.scene.model
    assert model.thin
    shares = [
        share
        for i, place in enumerate(adjoint.places)
        for share in _shares(adjoint, i, place, name)
    ]
    for field in fields_of_placement([share.term for share in shares]):
        if scene.comm.allreduce(any(rate.any() for rate in rates(model, field, normals))):
            yield field


def _shares(adjoint: Adjoint, number: int, place: AdjointState, name: str) -> list[WeightedTerm]:
    """Return the terms that contribute at a place, with their weights."""
    scene, c, mu = adjoint.scene, place.conjugates, place.state.mu
    acts = scene.comm.allreduce(bool(place.w.any())) or any(c.values())
    of_terms = [(t, factor_of(t.amplitude, mu)) for t in _terms(scene, place.state, name)]
    shares = [
        WeightedTerm(t, place.energy * m + c.get(t.amplitude or "", 0.0), m if acts else 0.0)
        for t, m in of_terms
    ]
    shares += _of_parameters(scene, place, name)
    # as many of its unit
    for held_amplitude in place.rows.keys() & scene.model.load_sizes.keys() - place.follows:
        share = (
            -c[held_amplitude]
            * scene.model.system.potential(place.state.u, mu, held_amplitude)
            / scene.model.load_size[held_amplitude]
        )
        shares += [WeightedTerm(t, share, 0.0) for t in scene.model.size_terms(held_amplitude)]
    if not number:
        shares += [
            WeightedTerm(t, c * factor_of(t.amplitude, mu), 0.0)
            for t, c in (*energies_along(scene, adjoint), *adjoint.forms)
        ]
    return shares


def _known_gradient(
    term: FieldDifferentiable, place: AdjointState, w: fem.Function, name: str
) -> tuple[fem.Function, Array] | None:
    """Return the contribution of a term that provides its own derivatives by a field; None without
    one.
    """
    mu = factor_of(term.amplitude, place.state.mu)
    return term.by_field(
        name, w, place.energy * mu + place.conjugates.get(term.amplitude or "", 0.0), mu
    )


def _transferred(adjoint: Adjoint, other: Scene) -> Adjoint:
    """Transfer an adjoint to another scene on the same mesh."""
    mu = dict.fromkeys(other.unloaded().mu, 1.0)  # of a natural curvature of zero
    places = []
    for place in adjoint.places:
        u, w = (transfer(adjoint.scene, other, v) for v in (place.state.u, place.w))
        places.append(replace(place, state=State(u, mu | dict(place.state.mu)), w=w))
    directions = [
        d if d.wave is not None else replace(d, phi=transfer(adjoint.scene, other, d.phi))
        for d in adjoint.directions
    ]
    return replace(adjoint, scene=other, places=places, directions=directions)


def _of_parameters(scene: Scene, place: AdjointState, name: str) -> list[WeightedTerm]:
    """The shares of the conjugates of free parameters of terms."""
    system, c, shares = scene.model.system, place.conjugates, list[WeightedTerm]()
    for parameter in c.keys() & system.parameters.keys():
        for slope in system.parameters[parameter].slopes:
            if isinstance(slope, ParameterDerivative) and not slope.density.on_edges:
                slope = _as_form(scene, slope)
            if not isinstance(slope, FormTerm):
                raise CaseError(
                    f"{name}: the conjugate of {parameter} has no gradient by this field"
                )
            shares.append(
                WeightedTerm(slope, c[parameter] * factor_of(slope.amplitude, place.state.mu), 0.0)
            )
    return shares


def _as_form(scene: Scene, slope: ParameterDerivative) -> FormTerm:
    """A derivative at points as a form."""
    assert scene.model.thin
    domain = scene.model.domain
    energy = domain.integral(slope.density, domain.jet(scene.model.u))
    return FormTerm(slope.name, energy, scene.model.u, scene.model.kernels, slope.amplitude)


def _of_starts(
    scene: Scene, shares: Sequence[WeightedTerm], f: fem.Function, w: fem.Function
) -> Array:
    """Derivative by the thickness where bodies start from the shell's face, which lifts them;
    collective.

    To lift a body is to lower the whole shell for this body alone.
    """
    model, domain = scene.model, f.function_space.mesh
    assert model.thin  # on which no bodies press
    axes = model.axes
    slopes = np.zeros(
        (
            domain.topology.index_map(domain.topology.dim).size_local,
            f.function_space.element.space_dimension,
        )
    )
    for contact in scene.problem.loads.contacts:
        if contact.start is None or contact.lift is None:
            continue
        of_body = [
            share for share in shares if share.term.name.startswith(f"contact {contact.body}")
        ]
        forces = domain.comm.allreduce(
            summed(of_body, model.u, model.u, w, model.kernels).sum(axis=(0, 1))
        )
        if (at_start := _basis_at(model, f, contact.start[axes])) is not None:
            slopes[at_start[0]] -= float(forces @ contact.lift[axes]) * at_start[1]
    return slopes[..., None]


def _basis_at(
    model: "ShellModel | MeridianModel", f: fem.Function, x: Array
) -> tuple[int, Array] | None:
    """The cell of a place of the surface and its basis functions' values there; None on other
    ranks; collective.

    In the cell it is the nearest place on the plane of the corners.
    """
    element, nodes = f.function_space.element.basix_element, model.V.element.basix_element.points
    corners = [
        int(np.abs(nodes - corner).sum(axis=1).argmin())
        for corner in basix.geometry(element.cell_type)
    ]
    topology, comm = f.function_space.mesh.topology, f.function_space.mesh.comm
    cells = model.V.dofmap.list[: topology.index_map(topology.dim).size_local, corners]
    first, *others = np.moveaxis(model.r0.x.array.reshape(-1, len(x))[cells], 1, 0)
    sides = np.stack([other - first for other in others], axis=-1)  # (cells, components, dimension)
    barycentric = np.einsum("cdi,ci->cd", np.linalg.pinv(sides), x - first)
    distance_outside = np.maximum(
        0.0, np.maximum(-barycentric.min(axis=1), barycentric.sum(axis=1) - 1)
    )
    distances = distance_outside + np.linalg.norm(
        np.einsum("cid,cd->ci", sides, barycentric) - (x - first), axis=1
    )
    least_of_ranks = comm.allgather(float(distances.min(initial=np.inf)))
    if comm.rank != int(np.argmin(least_of_ranks)):
        return None
    nearest = int(distances.argmin())
    return nearest, element.tabulate(0, barycentric[nearest][None])[0, 0, :, 0]


def _contracted(scene: Scene, place: AdjointState) -> fem.Function:
    """The vector along which residuals are taken, with what the supports that move add."""
    model, system = scene.model, scene.model.system
    direction = fem.Function(model.V)
    direction.x.array[: system.size] = place.w
    direction.x.scatter_forward()
    if system.moving:
        c = place.conjugates
        for motion in c.keys() & system.moving.names:
            direction.x.array[:] += c[motion] * system.moving.rate(place.state.mu, motion)
    return direction


def _with_field(adjoint: Adjoint, name: str) -> Scene:
    """The scene, or one in whose terms a number that is the same everywhere is a field."""
    scene, problem = adjoint.scene, adjoint.scene.problem
    if not scene.model.thin:
        return scene
    if name == "thickness" and not scene.model.thickness:
        return Scene(replace(problem, thickness=Thickness()), scene.comm)
    loads, natural = problem.loads, problem.loads.natural
    if name == "curvature" and (natural is None or natural.curvature is None):
        bent = Natural(
            np.zeros(3),
            natural.stretch if natural else None,
            frame(scene.problem.context, problem.azimuth),
        )
        return Scene(replace(problem, loads=replace(loads, natural=bent)), scene.comm)
    magnetic = loads.magnetic
    if (
        adjoint.directions
        and FIELDS[name].coefficient == "Br"
        and magnetic
        and not callable(magnetic.remanent)
    ):
        uniform = replace(magnetic, remanent=Uniform(np.asarray(magnetic.remanent)))
        return Scene(replace(problem, loads=replace(loads, magnetic=uniform)), scene.comm)
    return scene


def _terms(scene: Scene, state: State, name: str) -> list[FormTerm]:
    """The terms with the field as a coefficient; a remanence that is the same everywhere is no
    field in the model's.
    """
    parts = (
        (term.forms if isinstance(term, LinearTerm) else (term,))
        for term in scene.model.system.terms
    )
    terms: list[Term] = [term for terms_of_part in parts for term in terms_of_part]
    magnetic = scene.model.loads.magnetic
    if FIELDS[name].coefficient == "Br" and magnetic and not callable(magnetic.remanent):
        terms = list(
            magnetic_terms(
                scene, state, replace(magnetic, remanent=Uniform(np.asarray(magnetic.remanent)))
            )
        )
    return [term for term in terms if isinstance(term, FormTerm)]


def places_of(scene: Scene, f: fem.Function) -> tuple[Array, Array]:
    """Nodes of every cell of a field and normals there, as the field's pattern is given them."""
    model, nodes = scene.model, f.function_space.element.basix_element.points
    places, normals = model.places(nodes)
    return spatial_fields.inside_cells(places), normals


def _lengths(scene: Scene, f: fem.Function, forces: Array, places: Array, normals: Array) -> Array:
    """Derivative by a factor of the vector at each place."""
    Q = f.function_space
    vectors = f.x.array.reshape(-1, Q.dofmap.bs)[Q.dofmap.list[: len(forces)]]
    return np.asarray(np.sum(forces * vectors, axis=-1, keepdims=True))


def _curvatures(
    scene: Scene, f: fem.Function, forces: Array, places: Array, normals: Array
) -> Array:
    """Derivative by kappa_11, kappa_22 and kappa_12 in the frame of the natural shape, from that by
    the tensor in space.
    """
    natural = scene.problem.loads.natural
    assert natural
    return natural.in_frame(forces[..., :6], places, normals)


def _outwards(scene: Scene, f: fem.Function, forces: Array, places: Array, normals: Array) -> Array:
    """Derivative by the deviation w0, from that by the place."""
    return np.asarray(np.sum(forces * normals[..., scene.model.axes], axis=-1, keepdims=True))


def _perfect(scene: Scene, places: Array, normals: Array) -> tuple[Array, Array]:
    """The places of the perfect shell, of which deviations are functions, and its normals, from the
    drawn one's.
    """
    model, outward = scene.model, scene.problem.outward
    assert model.thin
    coordinates = model.meridian.embedding if model.axisymmetric else scene.problem.embedding
    if outward:
        normals_at_nodes = model.at_nodes(outward)[: len(normals)]
        normals = np.where(np.isfinite(normals_at_nodes), normals_at_nodes, normals)
    w0 = getattr(coordinates, "w0", None)
    return places if w0 is None else places - model.at_nodes(w0)[
        : len(places), :, None
    ] * normals, normals


FIELDS = {
    "remanence": Kind("Br"),
    "magnitude": Kind("Br", _lengths),
    "thickness": Kind("thickness"),
    "curvature": Kind("natural", _curvatures),
    "deviation": Kind("r0", _outwards),
}


def mass(scene: Scene) -> Adjoint:
    """The mass over that of the same shell with the thickness h."""
    state = scene.unloaded()

    def thickness_ratio(scene_there: Scene) -> tuple[float, list[tuple[FormTerm, float]]]:
        t, thickness_integral, log, u = (
            scene_there.model.thickness,
            scene_there.model.over_area(),
            scene_there.model.kernels,
            scene_there.model.u,
        )
        if t is None:
            return 1.0, []
        rho = (
            fem.Constant(t.function_space.mesh, 1.0)
            if scene_there.model.cell_materials is None
            else scene_there.model.cell_materials[2]
        )
        terms = (
            FormTerm("mass", thickness_integral(rho * t[0]), u, log),
            FormTerm("area", thickness_integral(rho * 1.0), u, log),
        )
        value, area = (scene.comm.allreduce(term.energy()) for term in terms)
        return value / area, [(terms[0], 1 / area), (terms[1], -value / area**2)]

    value, forms = thickness_ratio(scene)
    undisplaced = AdjointState(state, 0.0 * state.u)
    return Adjoint(
        scene,
        [undisplaced],
        by_itself=lambda there, _: thickness_ratio(there)[0],
        value=value,
        forms=forms,
    )


def density(scene: Scene, gradient: FieldGradient) -> Array:
    """dJ per area over R^2 (per volume of a solid) at the nodes of V on this rank, (nodes,
    components); collective.

    With the derivatives f by a field at the nodes of the cells and the hat functions H_v of the
    vertices,

        g_v = sum(f H_v)/int(H_v dA)

    is what J changes by where the field changes by one over a unit of area, averaged over about a
    cell. The sum of g_v int(H_v dA) is the derivative by a field that changes alike everywhere.
    """
    V, nodes = scene.model.V, gradient.field.function_space.element.basix_element.points
    H = fem.functionspace(V.mesh, ("Lagrange", 1))
    hat, count = H.element.basix_element, len(gradient.forces)
    area = fem.Function(H)
    form = scene.model.kernels.compile(
        "area of a vertex", scene.model.over_area()(ufl.TestFunction(H))
    )
    fem.assemble_vector(area.x.array, form)
    _added(area)
    shares = np.einsum("cnk,nv->cvk", gradient.forces, hat.tabulate(0, nodes)[0, :, :, 0])
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
