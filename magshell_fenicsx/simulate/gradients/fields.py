"""Derivatives by a field, at the nodes of all cells at once, and as densities per area; mass.

Each field is a coefficient of the terms' forms, or a part of one: the remanence, a factor of its
magnitude, the factor of the thickness, the natural curvature in the case's frame, and a deviation
w0 of the drawn shape along the normal of the perfect one. A deviation changes the placement; what
else follows from the placement is in the module `shape`. The mass has derivatives by the same
fields.

Words and symbols:

- J is the result, with its `Adjoint`: at each of its places, which are states, there are the
  multiplier w of the residual and factors c_i of the derivatives dPi/dmu_i of the potential by
  amplitudes.
- A place is also a point of the surface, where it is an array: (cells, nodes, 3) over R, with the
  components of the axes of the model alone where a meridian is modelled.
- w also means a function: the vector along which residuals are taken at a place, the multiplier
  with the motion of supports.
- `forces` are the derivatives of J by the values of a field: (own cells, nodes, components).
- A share is a term with its weights in a gradient (`WeightedTerm`): the weight `energy` of dPi/df,
  and the weight `work` of the derivative of the residual along w.
- Br is the remanence, r0 the undeformed placement, h the thickness, R the reference length. A thin
  model is a shell; the other one is a solid.
- The slope of a result is the observable that a sensor reads, with its own derivatives.
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

from magshell_fenicsx.assembly.field_gradient import (
    FieldGradient,
    WeightedTerm,
    derivatives_by_field,
)
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.nonlocal_terms import FieldDifferentiable
from magshell_fenicsx.assembly.terms import FormTerm, LinearTerm, Term, factor_of
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.models.shell import spatial_fields
from magshell_fenicsx.models.shell.residual import ParameterDerivative
from magshell_fenicsx.models.shell.spatial_fields import (
    PlacementField,
    Uniform,
    cell_geometry,
    fields_of_placement,
    user_field_polynomials,
)
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.parts.magnetism.applied import AppliedField
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.natural.planned import frame
from magshell_fenicsx.parts.natural.shape import Natural
from magshell_fenicsx.parts.observables import Slope
from magshell_fenicsx.shells.energy_factory import EnergyFactory
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, AdjointState, energies_along
from magshell_fenicsx.simulate.gradients.shape import (
    of_measures,
    of_normals,
    rates,
)
from magshell_fenicsx.simulate.perturbation import expand_shell_contact
from magshell_fenicsx.simulate.scene import Scene
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
    """A field by which results are differentiated.

    Attributes
    ----------
    coefficient
        Name of the coefficient in the forms of the terms.
    project
        Function from derivatives by the coefficient's components to those by the field's own; None:
        they are the same.
    """

    coefficient: str
    project: Projection | None = None


def by_field(adjoint: Adjoint, name: str, origin: Adjoint | None = None) -> FieldGradient:
    """Return the derivatives of a result J by a field of `FIELDS`; collective.

    Parameters
    ----------
    adjoint
        J with the multipliers of its equations.
    name
        Name of the field, a key of `FIELDS`.
    origin
        Adjoint in the scene that was solved, if `adjoint` is on another scene with the field as a
        coefficient; None: it is the same scene.

    Raises
    ------
    CaseError
        If no result of the scene depends on the field, or the result has no derivative by it.
    """
    scene = adjoint.scene
    # a scene whose terms have the field; if it is another one, the adjoint moves there
    scene_with_field = _with_field(adjoint, name)
    if scene_with_field is not scene:
        return by_field(_transferred(adjoint, scene_with_field), name, origin=adjoint)
    _refuse_without_derivative(adjoint, name)
    model, kind = scene.model, FIELDS[name]
    over_all_places = partial(_over_all_places, adjoint, origin, name)
    f, forces = over_all_places(kind.coefficient)
    places, normals = (nodal_vectors[: len(forces)] for nodal_vectors in places_of(scene, f))
    if name == "deviation":
        places, normals = _perfect(scene, places, normals)
    if kind.project:  # to the components of the field
        forces = kind.project(scene, f, forces, places, normals)
    if model.thin and name == "deviation":
        # dJ/df : df/dw0 for the fields f that follow from the placement
        for field in _placement_fields(adjoint, name, normals):
            _, by_dependent_field = over_all_places(field)
            contracted = (
                np.sum(by_dependent_field * rate, axis=(1, 2))
                for rate in rates(model, field, normals)
            )
            forces = forces + np.stack(list(contracted), axis=1)[..., None]
    return FieldGradient(f, forces, places, normals, partial(_at_nodes, scene, f))


def _at_nodes(scene: Scene, f: fem.Function, function: fem.Function) -> Array:
    """Return a function on a program's mesh at the nodes of a field; collective.

    Returns
    -------
    Array
        (own cells, nodes of f, components of the function).

    Raises
    ------
    ValueError
        If the scene has no such mesh.
    MeshError
        If the function is on another mesh, or its degree is above that of the displacement.
    """
    surface, user_mesh = scene.model.midsurface, scene.user_mesh("along")
    if not (surface and user_mesh):
        raise ValueError(
            "along: a function needs a shell on a dolfinx mesh: give values at gradient.places"
        )
    polynomials = user_field_polynomials(
        user_mesh.field(function, "along"), surface, cell_geometry(scene.model.r0)
    )
    nodes = f.function_space.element.basix_element.points
    table = polynomials.element.tabulate(0, nodes)[0, :, :, 0]
    return np.asarray(np.matmul(table, polynomials.values[: polynomials.cells.owned]))


def _refuse_without_derivative(adjoint: Adjoint, name: str) -> None:
    """Check that a result has a derivative by a field, the key `name` of `FIELDS`.

    Raises
    ------
    CaseError
        If a sensor reads the result, or contacts or applied fields have no derivative by the shape.
    """
    scene = adjoint.scene
    if adjoint.slope and name in ("thickness", "deviation"):
        raise CaseError(
            f"{name}: what a sensor reads has no gradient by this field; allowed are remanence, "
            "magnitude"
        )
    if name != "deviation":
        return
    if scene.model.contacts or getattr(scene.problem.loads.magnetic, "in_space", None):
        raise CaseError(
            "deviation: no gradient beside bodies, or in a field that is known at points of space"
        )


def _over_all_places(
    adjoint: Adjoint,
    origin: Adjoint | None,
    name: str,
    coefficient_or_name: str | PlacementField,
) -> tuple[fem.Function, Array]:
    """Return a field and its gradient (own cells, nodes, components), summed over places.

    The system is put at the state of each place in turn. Parameters are those of `_field_at_place`.
    Collective.
    """
    fields_and_gradients = [
        adjoint.scene.model.system.at_state(place.state).evaluate(
            partial(_field_at_place, adjoint, origin, name, number, place, coefficient_or_name)
        )
        for number, place in enumerate(adjoint.places)
    ]
    f, _ = fields_and_gradients[-1]  # the field is the same at all places
    gradients = [
        gradient_at_place
        for _, gradients_at_place in fields_and_gradients
        for gradient_at_place in gradients_at_place
    ]
    return f, np.sum(gradients, axis=0)


def _field_at_place(
    adjoint: Adjoint,
    origin: Adjoint | None,
    name: str,
    number: int,
    place: AdjointState,
    coefficient_or_name: str | PlacementField,
) -> tuple[fem.Function, list[Array]]:
    """Return a field, and the parts of its gradient that come from one place; collective.

    The system must be at the state of this place.

    Parameters
    ----------
    origin
        Adjoint in the scene that was solved; None: it is `adjoint`.
    name
        Name of the field, a key of `FIELDS`.
    number, place
        Index of the place in `adjoint.places`, and the place itself.
    coefficient_or_name
        The coefficient of the forms, or its name. It may follow from the field, as the normals do
        from the placement; then it is given itself.

    Returns
    -------
    f, gradients
        The coefficient, and arrays (own cells, nodes, components) whose sum is the gradient.

    Raises
    ------
    CaseError
        If no term has the field.
    """
    scene, model, slope = adjoint.scene, adjoint.scene.model, adjoint.slope
    self_differentiating_terms = [
        term for term in model.system.terms if isinstance(term, FieldDifferentiable)
    ]
    if origin:  # contact is to be the same in the scene that has the field
        expand_shell_contact(origin.scene, scene, origin.places[number].state)
    # terms with weights, and the vector along which their residuals are taken
    shares, w = _shares(adjoint, number, place, name), _direction_of_residuals(scene, place)
    coefficient = (
        coefficient_or_name if isinstance(coefficient_or_name, str) else coefficient_or_name.name
    )
    # the field: in a form, in a term that provides its own derivatives, or in J itself
    f = _coefficient_in_forms(shares, coefficient_or_name)
    known_gradients = [
        field_and_gradient
        for term in self_differentiating_terms
        if (field_and_gradient := _known_gradient(term, place, w, coefficient))
    ]
    f = f or next((known_field for known_field, _ in known_gradients), None)
    field_in_result, gradients_of_result = _dependence_of_result(slope, coefficient)
    f = field_in_result if f is None else f
    has_other_field = not model.thin and coefficient != "Br"  # a solid has the remanence alone
    if f is None or has_other_field:
        raise CaseError(f"{name}: the case has no such field: no result depends on it")
    # gradients of terms with derivatives of their own, then of forms
    gradients = [gradient_at_points for _, gradient_at_points in known_gradients]
    if coefficient_or_name == "r0":
        gradients.append(_gradient_by_placement(adjoint, number, place, shares, f, w))
    else:
        gradients.append(derivatives_by_field(shares, f, model.u, w, model.kernels))
    # J itself, as what a sensor reads, counts once: at the first place
    if not number:
        gradients += gradients_of_result
    if name == "thickness" and scene.problem.loads.contacts:
        gradients.append(_by_start_of_bodies(scene, shares, f, w))
    return f, gradients


def _coefficient_in_forms(
    shares: Sequence[WeightedTerm], coefficient_or_name: str | PlacementField
) -> fem.Function | None:
    """Return the first coefficient of terms' forms that is a field or has its name; else None."""
    return next(
        (
            candidate
            for share in shares
            for candidate in share.term.form.coefficients()
            if candidate is coefficient_or_name or candidate.name == coefficient_or_name
        ),
        None,
    )


def _gradient_by_placement(
    adjoint: Adjoint,
    number: int,
    place: AdjointState,
    shares: list[WeightedTerm],
    r0: fem.Function,
    w: fem.Function,
) -> Array:
    """Return the gradient (own cells, nodes, 3) of forms by the placement, at one place.

    Beside the derivatives of forms it has those of the measures by which loads are divided, and of
    normals at points. Collective.

    Parameters
    ----------
    number, place
        Index of the place in `adjoint.places`, and the place itself.
    shares, w
        Terms with their weights, and the vector along which their residuals are taken. Terms of
        measures are added to `shares`.
    """
    model = adjoint.scene.model
    if model.thin:
        shares += of_measures(model, shares, w)
    gradient = derivatives_by_field(shares, r0, model.u, w, model.kernels)
    gradient += of_normals(adjoint, place, first=not number)
    return gradient


def _placement_fields(adjoint: Adjoint, name: str, normals: Array) -> Iterator[PlacementField]:
    """Yield the fields of an adjoint's terms that change as the shape does; collective.

    Parameters
    ----------
    name
        Name of the field by which J is differentiated, a key of `FIELDS`.
    normals
        (own cells, nodes, 3), directions in which places move.
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
    """Return the terms that contribute to a gradient at a place, with their weights; collective.

    Parameters
    ----------
    number, place
        Index of the place in `adjoint.places`, and the place itself.
    name
        Name of the field, a key of `FIELDS`.
    """
    scene, c, mu = adjoint.scene, place.conjugates, place.state.mu
    # whether the residual counts at this place, on any rank; c adds motions of supports to w
    has_multipliers = scene.comm.allreduce(bool(place.w.any())) or any(c.values())
    # A term of Pi is multiplied by its amplitude, if it has one: the factor. The derivative by this
    # amplitude, which c multiplies, is the term without the factor.
    terms_with_factors = [
        (term, factor_of(term.amplitude, mu)) for term in _terms(scene, place.state, name)
    ]
    shares = [
        WeightedTerm(
            term,
            place.energy * factor + c.get(term.amplitude or "", 0.0),
            factor if has_multipliers else 0.0,
        )
        for term, factor in terms_with_factors
    ]
    shares += _shares_of_parameters(scene, place, name)
    # a held conjugate is a fixed multiple of its unit, which depends on the size of the shell
    held_amplitudes = place.rows.keys() & scene.model.load_sizes.keys() - place.follows
    for held_amplitude in sorted(held_amplitudes):  # in the same order on all ranks
        weight_of_size = (
            -c[held_amplitude]
            * scene.model.system.potential(place.state.u, mu, held_amplitude)
            / scene.model.load_size[held_amplitude]
        )
        shares += [
            WeightedTerm(term, weight_of_size, 0.0)
            for term in scene.model.size_terms(held_amplitude)
        ]
    if not number:  # energies that J itself contains are those at its own state, the first place
        shares += [
            WeightedTerm(term, factor_in_J * factor_of(term.amplitude, mu), 0.0)
            for term, factor_in_J in (*energies_along(scene, adjoint), *adjoint.forms)
        ]
    return shares


def _known_gradient(
    term: FieldDifferentiable, place: AdjointState, w: fem.Function, name: str
) -> tuple[fem.Function, Array] | None:
    """Return the contribution of a term that provides its own derivatives by a field; collective.

    Such terms, as contact or a self-field, have no form that could be differentiated.

    Parameters
    ----------
    w
        The vector along which residuals are taken.
    name
        Name of the field in the terms.

    Returns
    -------
    tuple or None
        The field and its gradient (own cells, nodes, components); None if the term has no such
        field.
    """
    factor = factor_of(term.amplitude, place.state.mu)
    # the weights of the term's energy, and of its residual along w
    energy_weight = place.energy * factor + place.conjugates.get(term.amplitude or "", 0.0)
    residual_weight = factor
    return term.by_field(name, w, energy_weight, residual_weight)


def _transferred(adjoint: Adjoint, other: Scene) -> Adjoint:
    """Return an adjoint on another scene: states and multipliers moved to its mesh; collective."""
    # an amplitude that only the other scene has multiplies a field that is zero there
    mu = dict.fromkeys(other.unloaded().mu, 1.0)
    places = []
    for place in adjoint.places:
        u, w = (transfer(adjoint.scene, other, vector) for vector in (place.state.u, place.w))
        places.append(replace(place, state=State(u, mu | dict(place.state.mu)), w=w))
    directions = [
        direction
        if direction.wave is not None
        else replace(direction, phi=transfer(adjoint.scene, other, direction.phi))
        for direction in adjoint.directions
    ]
    return replace(adjoint, scene=other, places=places, directions=directions)


def _shares_of_parameters(scene: Scene, place: AdjointState, name: str) -> list[WeightedTerm]:
    """Return the terms of a place that contain conjugates of free parameters, with weights.

    The conjugate of a free parameter is an integral of its own, the derivative of energies by it.

    Raises
    ------
    CaseError
        If such a derivative has no form.
    """
    system, conjugates, shares = scene.model.system, place.conjugates, list[WeightedTerm]()
    # in the same order on all ranks
    for parameter in sorted(conjugates.keys() & system.parameters.keys()):
        for derivative in system.parameters[parameter].slopes:
            # a density is known at points; its form can be differentiated
            if isinstance(derivative, ParameterDerivative) and not derivative.density.on_edges:
                derivative = _as_form(scene, derivative)
            if not isinstance(derivative, FormTerm):
                raise CaseError(
                    f"{name}: the conjugate of {parameter} has no gradient by this field"
                )
            shares.append(
                WeightedTerm(
                    derivative,
                    conjugates[parameter] * factor_of(derivative.amplitude, place.state.mu),
                    0.0,
                )
            )
    return shares


def _as_form(scene: Scene, slope: ParameterDerivative) -> FormTerm:
    """Return a derivative of energies by a parameter, known at points, as a term with a form."""
    assert scene.model.thin
    domain = scene.model.domain
    energy = domain.integral(slope.density, domain.jet(scene.model.u))
    return FormTerm(slope.name, energy, scene.model.u, scene.model.kernels, slope.amplitude)


def _by_start_of_bodies(
    scene: Scene, shares: Sequence[WeightedTerm], f: fem.Function, w: fem.Function
) -> Array:
    """Return the derivative by the thickness where bodies start from the shell's face; collective.

    A thicker shell lifts such a body. This is the same as to lower the whole shell for this body
    alone. So the derivative is that of the body's energies by a displacement of the whole shell
    (`forces`), along the direction `contact.lift` in which the body is lifted.

    Parameters
    ----------
    shares
        Terms with their weights in a gradient.
    f
        The factor of the thickness.
    w
        The vector along which residuals are taken.

    Returns
    -------
    Array
        (own cells, nodes of f, 1).
    """
    model, domain = scene.model, f.function_space.mesh
    assert model.thin  # for types: a solid has no field of the thickness
    axes = model.axes
    gradient = np.zeros(
        (
            domain.topology.index_map(domain.topology.dim).size_local,
            f.function_space.element.space_dimension,
        )
    )
    for contact in scene.problem.loads.contacts:
        if contact.start is None or contact.lift is None:  # it starts elsewhere
            continue
        of_body = [
            share for share in shares if share.term.name.startswith(f"contact {contact.body}")
        ]
        forces = domain.comm.allreduce(
            derivatives_by_field(of_body, model.u, model.u, w, model.kernels).sum(axis=(0, 1))
        )
        # the thickness at the start is a sum of nodal values times basis functions of one cell
        if (cell_and_basis := _basis_at(model, f, contact.start[axes])) is not None:
            cell, basis = cell_and_basis
            gradient[cell] -= float(forces @ contact.lift[axes]) * basis
    return gradient[..., None]


def _basis_at(
    model: "ShellModel | MeridianModel", f: fem.Function, x: Array
) -> tuple[int, Array] | None:
    """Return the cell nearest to a place of the surface, with its basis functions' values there.

    The place is projected on the plane of each cell's corners. The distance of a cell is the sum of
    two lengths: how far the projection is outside of the corners, in cells, and how far the place
    is off the plane. Collective: all ranks but the one with the nearest cell get None.

    Parameters
    ----------
    f
        Function whose element has the basis.
    x
        Place (2,) or (3,) over R, undeformed.
    """
    element, nodes = f.function_space.element.basix_element, model.V.element.basix_element.points
    corners = [  # numbers of the nodes that are corners
        int(np.abs(nodes - corner).sum(axis=1).argmin())
        for corner in basix.geometry(element.cell_type)
    ]
    topology, comm = f.function_space.mesh.topology, f.function_space.mesh.comm
    cells = model.V.dofmap.list[: topology.index_map(topology.dim).size_local, corners]
    origin, *other_corners = np.moveaxis(model.r0.x.array.reshape(-1, len(x))[cells], 1, 0)
    sides = np.stack(
        [corner_place - origin for corner_place in other_corners], axis=-1
    )  # (cells, components, dimension)
    # coordinates of the projection along the sides, by least squares
    barycentric = np.einsum("cdi,ci->cd", np.linalg.pinv(sides), x - origin)
    distance_outside = np.maximum(  # in cells
        0.0, np.maximum(-barycentric.min(axis=1), barycentric.sum(axis=1) - 1)
    )
    projected_offset = np.einsum("cid,cd->ci", sides, barycentric)
    distance_off_plane = np.linalg.norm(projected_offset - (x - origin), axis=1)
    distances = distance_outside + distance_off_plane
    least_of_ranks = comm.allgather(float(distances.min(initial=np.inf)))
    if comm.rank != int(np.argmin(least_of_ranks)):
        return None
    nearest = int(distances.argmin())
    # the table is (derivative, point, basis function, component)
    return nearest, element.tabulate(0, barycentric[nearest][None])[0, 0, :, 0]


def _direction_of_residuals(scene: Scene, place: AdjointState) -> fem.Function:
    """Return the vector along which residuals are taken, with the motion of supports; collective.

    It is w of the place plus, for each amplitude mu_i that moves supports, c_i times the rate of
    this motion. For such an amplitude dPi/dmu_i is the residual along that rate.
    """
    model, system = scene.model, scene.model.system
    direction = fem.Function(model.V)
    direction.x.array[: system.size] = place.w
    direction.x.scatter_forward()
    if system.moving:
        conjugates = place.conjugates
        for motion in conjugates.keys() & system.moving.names:
            direction.x.array[:] += conjugates[motion] * system.moving.rate(place.state.mu, motion)
    return direction


def _dependence_of_result(
    slope: Slope | None, coefficient: str
) -> tuple[fem.Function | None, list[Array]]:
    """Return the coefficient of this name in the result itself, and the gradient by it.

    They are None and an empty list if the result does not have it.
    """
    if not slope or slope.field is None:
        return None, []
    if coefficient != slope.field.name:
        return None, []
    return slope.field, [] if slope.by_field is None else [slope.by_field]


def _with_field(adjoint: Adjoint, name: str) -> Scene:
    """Return the scene, or one whose terms have a field in place of a uniform number; collective.

    Another scene is built where the thickness, a natural curvature or, for waves, the remanence is
    no coefficient of the terms so far.
    """
    scene, problem = adjoint.scene, adjoint.scene.problem
    if not scene.model.thin:  # a solid has the remanence alone
        return scene
    if name == "thickness" and not scene.model.thickness:
        return Scene(replace(problem, thickness=Thickness()), scene.comm)
    loads, natural = problem.loads, problem.loads.natural
    has_no_curvature = natural is None or natural.curvature is None
    if name == "curvature" and has_no_curvature:
        with_curvature = Natural(
            np.zeros(3),  # the curvatures kappa_11, kappa_22, kappa_12
            natural.stretch if natural else None,
            frame(scene.problem.context, problem.azimuth),
        )
        return Scene(replace(problem, loads=replace(loads, natural=with_curvature)), scene.comm)
    magnetic = loads.magnetic
    # without directions `_terms` takes magnetic terms with the field
    if not adjoint.directions or FIELDS[name].coefficient != "Br":
        return scene
    if not magnetic or callable(magnetic.remanent):
        return scene
    with_uniform_field = replace(magnetic, remanent=Uniform(np.asarray(magnetic.remanent)))
    return Scene(replace(problem, loads=replace(loads, magnetic=with_uniform_field)), scene.comm)


def _terms(scene: Scene, state: State, name: str) -> list[FormTerm]:
    """Return the terms of a model that have forms; the field may be a coefficient in them.

    A uniform remanence is a constant in the model's own terms. By the remanence the magnetic terms
    alone are returned then, with a field in place of the constant.
    """
    forms_of_terms = (
        (term.forms if isinstance(term, LinearTerm) else (term,))
        for term in scene.model.system.terms
    )
    terms: list[Term] = [term for terms_of_part in forms_of_terms for term in terms_of_part]
    is_by_remanence = FIELDS[name].coefficient == "Br"
    magnetic = scene.model.loads.magnetic if is_by_remanence else None
    if magnetic and not callable(magnetic.remanent):
        terms = list(
            magnetic_terms(
                scene, state, replace(magnetic, remanent=Uniform(np.asarray(magnetic.remanent)))
            )
        )
    return [term for term in terms if isinstance(term, FormTerm)]


def magnetic_terms(scene: Scene, state: State, field: Magnetisation) -> Sequence[FormTerm]:
    """Return the magnetic terms of a model with another remanence, in the applied field of a state.

    Parameters
    ----------
    field
        Magnetisation with this remanence. A soft material alone has no terms.
    """
    terms, fields = _magnetic_terms_and_fields(scene, field)
    # fields that are known by their values have amplitudes of their own
    for applied in fields:
        applied.mu.update({name: state.mu.get(name, 0.0) for name in applied.names})
    return terms


def _magnetic_terms_and_fields(
    scene: Scene, field: Magnetisation
) -> tuple[Sequence[FormTerm], Sequence[AppliedField]]:
    """Return the magnetic terms of a remanence, and the applied fields that they read.

    A soft material alone has neither; beside a remanence it is left out.
    """
    model, log, fields = scene.model, KernelLog(), list[AppliedField]()
    # the factory appends to `fields` the applied fields of the terms that it makes
    factory = replace(model.factory, log=log, fields=fields)
    if field.soft and field.soft.alone:
        return [], fields
    field = replace(field, soft=None)
    if isinstance(factory, EnergyFactory):
        return [factory.term(energy) for energy in factory.magnetic(field)], fields
    return factory.magnetic(field), fields


def places_of(scene: Scene, f: fem.Function) -> tuple[Array, Array]:
    """Return the nodes of every cell of a field, and the normals there, both (cells, nodes, 3).

    They are slightly inside of the cells, as the places at which a field by formula is evaluated.
    """
    model, nodes = scene.model, f.function_space.element.basix_element.points
    places, normals = model.places(nodes)
    return spatial_fields.inside_cells(places), normals


# The next three are `Projection`s: from derivatives by a coefficient to those by a field. Arguments
# are the scene, the coefficient f, the derivatives `forces` by its values, and places and normals
# at its nodes, all by cells.


def _lengths(scene: Scene, f: fem.Function, forces: Array, places: Array, normals: Array) -> Array:
    """Return the derivative by a factor of the remanence: forces . Br."""
    Q = f.function_space
    vectors = f.x.array.reshape(-1, Q.dofmap.bs)[Q.dofmap.list[: len(forces)]]
    return np.asarray(np.sum(forces * vectors, axis=-1, keepdims=True))


def _curvatures(
    scene: Scene, f: fem.Function, forces: Array, places: Array, normals: Array
) -> Array:
    """Return the derivative by kappa_11, kappa_22, kappa_12 of the natural shape.

    The first six components of `forces` are derivatives by the symmetric tensor of curvature in
    space. They are projected on the tangent frame of the natural shape.
    """
    natural = scene.problem.loads.natural
    assert natural
    return natural.in_frame(forces[..., :6], places, normals)


def _outwards(scene: Scene, f: fem.Function, forces: Array, places: Array, normals: Array) -> Array:
    """Return the derivative by the deviation w0.

    It is the normal part of the derivative by the placement r0.
    """
    return np.asarray(np.sum(forces * normals[..., scene.model.axes], axis=-1, keepdims=True))


def _perfect(scene: Scene, places: Array, normals: Array) -> tuple[Array, Array]:
    """Return places and normals (cells, nodes, 3) of the perfect shell, from the drawn one's.

    Deviations are functions of the perfect places, at a distance w0 along the normal.
    """
    model, outward = scene.model, scene.problem.outward
    assert model.thin
    coordinates = model.meridian.embedding if model.axisymmetric else scene.problem.embedding
    if outward:  # normals of the perfect shell; nan where it has none
        normals_at_nodes = model.at_nodes(outward)[: len(normals)]
        normals = np.where(np.isfinite(normals_at_nodes), normals_at_nodes, normals)
    w0 = getattr(coordinates, "w0", None)
    if w0 is not None:
        places = places - model.at_nodes(w0)[: len(places), :, None] * normals
    return places, normals


FIELDS = {
    "remanence": Kind("Br"),
    "magnitude": Kind("Br", _lengths),
    "thickness": Kind("thickness"),
    "curvature": Kind("natural", _curvatures),
    "deviation": Kind("r0", _outwards),
}


def mass(scene: Scene) -> Adjoint:
    """Return the adjoint of the mass over the mass of the same shell with the thickness h.

    The mass does not depend on displacements, so the only place is the undeformed state without
    multipliers. Collective.
    """
    state = scene.unloaded()

    def thickness_ratio(scene_there: Scene) -> tuple[float, list[tuple[FormTerm, float]]]:
        """Return the ratio in a scene, and its terms with factors for derivatives by fields."""
        thickness_factor = scene_there.model.thickness
        area_integral = scene_there.model.over_area()
        log, u = scene_there.model.kernels, scene_there.model.u
        if thickness_factor is None:  # a uniform thickness is h
            return 1.0, []
        density_ratio = (
            fem.Constant(thickness_factor.function_space.mesh, 1.0)
            if scene_there.model.cell_materials is None
            else scene_there.model.cell_materials[2]  # the density of each cell
        )
        # the mass, and the mass with the thickness h; the field has one component, [0]
        numerator = FormTerm("mass", area_integral(density_ratio * thickness_factor[0]), u, log)
        denominator = FormTerm("area", area_integral(density_ratio * 1.0), u, log)
        a, b = (scene.comm.allreduce(term.energy()) for term in (numerator, denominator))
        # the derivatives of a/b by a and by b
        return a / b, [(numerator, 1 / b), (denominator, -a / b**2)]

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
    """Return the change of J per area over R^2 (per volume of a solid) at the nodes of V.

    With the derivatives f of the gradient at the nodes of the cells and the hat functions H_v of
    the vertices,

        g_v = sum(f H_v)/int(H_v dA)

    is the change of J for a change of the field by one over a unit of area, averaged over the cells
    at a vertex. The sum of g_v int(H_v dA) is the derivative by a uniform change of the field.
    Collective.

    Returns
    -------
    Array
        (nodes, components) of this rank, with its ghosts.
    """
    V, nodes = scene.model.V, gradient.field.function_space.element.basix_element.points
    H = fem.functionspace(V.mesh, ("Lagrange", 1))
    hat, count = H.element.basix_element, len(gradient.forces)
    area = fem.Function(H)
    form = scene.model.kernels.compile(
        "area of a vertex", scene.model.over_area()(ufl.TestFunction(H))
    )
    fem.assemble_vector(area.x.array, form)
    _add_over_ranks(area)
    # indices: c cell, n node, v vertex of the cell, k component
    hats_at_field_nodes = hat.tabulate(0, nodes)[0, :, :, 0]
    # sum(f H_v), first over the nodes of each cell
    sums_in_cells = np.einsum("cnk,nv->cvk", gradient.forces, hats_at_field_nodes)
    density_at_vertices = []
    for sums_of_component in np.moveaxis(sums_in_cells, -1, 0):
        g = fem.Function(H)
        # then over the cells at each vertex
        np.add.at(g.x.array, H.dofmap.list[:count], sums_of_component)
        _add_over_ranks(g)
        # J is that of the whole shell, of which the model may be one of several equal parts
        density_at_vertices.append(g.x.array / area.x.array / scene.model.multiplicity)
    in_cells = np.stack(density_at_vertices, axis=-1)[H.dofmap.list[:count]]
    hats_at_nodes = hat.tabulate(0, V.element.basix_element.points)[0, :, :, 0]
    node_map = V.dofmap.index_map
    values = np.zeros((node_map.size_local + node_map.num_ghosts, sums_in_cells.shape[-1]))
    # from the vertices to the nodes; linear in each cell, so that two cells agree at their nodes
    values[V.dofmap.list[:count]] = np.einsum("nv,cvk->cnk", hats_at_nodes, in_cells)
    return values


def _add_over_ranks(f: fem.Function) -> None:
    """Add contributions of other ranks at shared vertices, and update ghosts; collective."""
    f.x.scatter_reverse(InsertMode.add)
    f.x.scatter_forward()
