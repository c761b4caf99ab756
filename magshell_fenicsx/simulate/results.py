"""Functionals of a state, with their derivatives by it; and the energy barrier of a run.

The barrier is what a probing force passes: its work from zero, over its largest value, back to
zero.

Words and symbols:

- J is a number of a state (u, mu): u is the displacement over the reference length R, mu holds the
  amplitudes (load parameters) by name. p is any parameter of the case.
- Pi is the potential energy of the modelled part, R also its residual Pi_u; the whole shell has
  `multiplicity` such parts.
- The conjugate of an amplitude is q = -dPi/dmu, the displacement on which it does work.
- w is the deflection inwards, against the normal n0. h is the thickness, E Young's modulus.
- A column is one of path.csv; observables are columns of a part of the package, as of magnets.
- Q rotates from the case's frame into that of the model.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy
import ufl
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.continuation.device import Conjugate
from magshell_fenicsx.continuation.system import State, Vector, dot
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.models.shell.spatial_fields import PlacementField
from magshell_fenicsx.parts.magnetism.readings import slope_of_sensor
from magshell_fenicsx.parts.observables import Slope
from magshell_fenicsx.parts.registered import OBSERVABLES
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.parts.supports.reactions import weights
from magshell_fenicsx.quantities.registry import amplitude, quantity
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.steps import held_conjugates_of_step

Array = NDArray[np.float64]
AT_POLE = ("w_pole_over_h", "w_over_h")
Target = Callable[[Array], Array]  # undeformed places (n, 3) over R -> wanted places (n, 3) over R


@dataclass(frozen=True)
class Functional:
    """A number J(u, mu; p) of a state, with what its derivatives need.

    Attributes
    ----------
    by_u, by_mu
        dJ/du, zero at supports, and dJ/dmu_i where J contains the amplitude itself.
    potentials
        c_i: J contains the sum of c_i dPi/dmu_i.
    energy
        c: J contains c Pi.
    reaction
        e, a motion of supports: J is e . R, with the residual of all nodes, also at supports.
    forms
        Other energies in J that depend on the placement, and their factors.
    deflections
        Name of a point -> the factor of u . n0 there in J.
    slope
        The observable of a part that J is, with its derivatives by a field; then J is no amplitude
        itself, whatever `by_mu` is.
    """

    value: float
    by_u: Vector
    by_mu: Mapping[str, float] = field(default_factory=dict)
    potentials: Mapping[str, float] = field(default_factory=dict)
    energy: float = 0.0
    reaction: Vector | None = None
    slope: Slope | None = None
    forms: Sequence[tuple[FormTerm, float]] = ()
    deflections: Mapping[str, float] = field(default_factory=dict)


def functional(scene: Scene, state: State, result: str | Target) -> Functional:
    """Return a result as a functional of the state, with its derivatives; collective.

    Parameters
    ----------
    result
        A column of path.csv; or a target shape, whose mean square distance over the area, in R^2,
        is the result.

    Raises
    ------
    CaseError
        If the scene has no such column, or it has no derivative here; the message has the columns
        that have one.
    """
    model, system = scene.model, scene.model.system
    # a target shape
    if callable(result):
        return _misfit(scene, state, result)
    # the energy, whose derivative is the residual
    if result == "energy":
        by_u = model.multiplicity * system.residual(state.u, state.mu)
        return Functional(scene.observe(state)["energy"], by_u, energy=model.multiplicity)
    # the displacement of a point
    points = _displacements(scene)
    if result in points:
        point, axis = points[result]
        # `probe` has the derivatives of the point's displacement by the unknowns, one row per axis
        by_u = scene.problem.length * (_to_case_frame(scene) @ model.probe(point))[axis]
        return Functional(scene.observe(state)[result], system.zero_at_supports(by_u))
    if result in (conjugate_columns := conjugates(scene)):
        # J = -dPi/dmu over its unit. The unit may depend on the size of the shell; then `forms` are
        # the derivatives by it.
        name, conjugate_unit = conjugate_columns[result]
        by_u = np.asarray(-system.load(state.u, state.mu, name) / conjugate_unit)
        value = -system.potential(state.u, state.mu, name) / conjugate_unit
        forms = [(term, -value / model.load_size[name]) for term in model.size_terms(name)]
        return Functional(value, by_u, potentials={name: -1 / conjugate_unit}, forms=forms)
    if result in AT_POLE and "pole" in model.normals:
        return _deflection_of_pole(scene, state)
    # the reaction of a support
    if result in (reactions := _reactions(scene)):
        support, axis = reactions[result]
        return _reaction(scene, state, support, axis, result)
    # a column of a sensor
    if slope := slope_of_sensor(scene.view, state, result):
        return Functional(slope.value, slope.by_u, slope.by_mu, slope=slope)
    # an amplitude, by its name or its column
    name = next((name for name in state.mu if result in (name, amplitude(name).column)), "")
    if name:
        return Functional(state.mu[name], np.zeros(system.size), {name: 1.0})
    raise CaseError(
        f"{result}: has no gradient here; allowed are {', '.join(differentiable(scene, state))}"
    )


def _deflection_of_pole(scene: Scene, state: State) -> Functional:
    """Return the deflection w = -u . n0 at the pole, over h, as a functional; collective."""
    model, h = scene.model, scene.problem.material.h
    by_u = np.asarray(-(model.normals["pole"] @ model.probe("pole")) / h)
    return Functional(
        scene.observe(state)["w_pole_over_h"],
        model.system.zero_at_supports(by_u),
        deflections={"pole": -1 / h},
    )


def differentiable(scene: Scene, state: State) -> list[str]:
    """Return the columns of path.csv that `functional` takes, also those in units."""
    at_pole = AT_POLE if "pole" in scene.model.normals else ()
    part_columns = (column for sensor in scene.problem.loads.sensors for column in sensor.columns)
    amplitudes = (
        amplitude(name).column for name in state.mu if name not in scene.model.system.history
    )
    columns = dict.fromkeys(
        (
            "energy",
            *conjugates(scene),
            *_displacements(scene),
            *_reactions(scene),
            *at_pole,
            *part_columns,
            *amplitudes,
        )
    )
    return [*columns, *scene.sizes.columns(columns)]


def in_units(scene: Scene, state: State, column: str) -> tuple[str, str]:
    """Return the dimensionless column of a column in units, and the name of the scale of its unit.

    Another column is returned itself, with "".
    """
    for dimensionless_column in differentiable(scene, state):
        if (in_unit := scene.sizes.column(dimensionless_column)) and in_unit.name == column:
            return dimensionless_column, quantity(dimensionless_column).scale
    return column, ""


def _displacements(scene: Scene) -> dict[str, tuple[str, int]]:
    """Return column of a named point's displacement -> the point and the axis (0, 1 or 2)."""
    return {
        f"{point}_u{axis}": (point, i)
        for point in scene.problem.context.points
        for i, axis in enumerate("xyz")
    }


def force_unit(scene: Scene) -> float:
    """Return the unit of forces E h R^2/R as a number in the case's unit of force."""
    return scene.problem.modulus * scene.problem.material.h * scene.problem.length**2


def _reactions(scene: Scene) -> dict[str, tuple[str, int]]:
    """Return column of a reaction -> the support and the axis (0, 1 or 2)."""
    supports = scene.problem.supports if scene.problem.reactions else ()
    return {f"{name}_f{axis}": (name, i) for name in supports for i, axis in enumerate("xyz")}


def _reaction(scene: Scene, state: State, name: str, axis: int, result: str) -> Functional:
    """Return the reaction of a support along an axis of the case, as a functional; collective.

    Parameters
    ----------
    name, axis
        Name of the support, and number of the axis.
    result
        Column of the reaction, for messages.

    Raises
    ------
    CaseError
        If a pressure at a free edge has no potential.
    """
    system, problem = scene.model.system, scene.problem
    if scene.model.without_potential and problem.loads.pressure:
        raise CaseError(
            f"{result}: has no gradient under a pressure at a free edge, which has no potential"
        )
    axis_direction = rotation(problem.azimuth)[:, axis]
    # the unit motion e of the support, times the unit of forces: the reaction is e . R
    reaction_vector = force_unit(scene) * weights(scene.model, name, axis_direction, problem.mirror)
    value = dot(system.comm, reaction_vector, system.forces(state.u, state.mu))
    return Functional(
        value,
        # d(e . R)/du = K e
        system.zero_at_supports(system.at_state(state).stiffness_along(reaction_vector)),
        reaction=reaction_vector,
    )


def conjugates(scene: Scene) -> dict[str, tuple[str, float]]:
    """Return column -> the amplitude whose conjugate it is, and the unit of this conjugate."""
    model, loads = scene.model, scene.problem.loads
    # none to a pressure that varies with the place
    has_volume = loads.pressure and not loads.pressure_profile
    amplitudes = {"volume_change": "pressure"} if has_volume else {}
    amplitudes |= {
        column: name
        for observables in OBSERVABLES
        for name, column in observables.conjugates(loads).items()
    }
    with_units = {column: (name, scene.conjugate_unit(name)) for column, name in amplitudes.items()}
    for name in (*loads.forces, *loads.dead):
        # the load for an amplitude of one; 0: a dead load of moments has no displacement in h
        is_force = name in loads.forces
        load_size = model.force_unit if is_force else model.load_size.get(name, 0.0)
        if load_size:
            column = "w_over_h" if name == loads.displaced else f"w_{name}_over_h"
            with_units[column] = name, load_size * scene.problem.material.h
    return with_units


def _to_case_frame(scene: Scene) -> Array:
    """Return the rotation (3, 3) from the model's frame to that of the case."""
    return rotation(scene.problem.azimuth).T


def offset(scene: Scene, target: Target) -> fem.Function:
    """Return the displacement from the undeformed shell to a target, at the nodes of the model.

    As a `PlacementField` it can be built again for another placement, which derivatives by the
    shape need.
    """
    axes, Q = scene.model.axes, rotation(scene.problem.azimuth)

    def offset_from(r0: fem.Function) -> PlacementField:
        """Return the displacement from a placement to the target."""
        offsets = PlacementField(r0.function_space, "offset", offset_from)
        places = np.zeros((np.size(r0.x.array) // len(axes), 3))
        places[:, axes] = np.reshape(r0.x.array, (-1, len(axes)))
        target_places = target(places @ Q) @ Q.T
        offsets.x.array[:] = (target_places - places)[:, axes].ravel()
        return offsets

    return offset_from(scene.model.r0)


def distances(scene: Scene, state: State, target: Target) -> tuple[float, float]:
    """Return root mean square and largest distance of a state to a target, over R; collective.

    The mean is over the area, and the largest distance is that of the nodes.
    """
    system, offset_to_target = scene.model.system, offset(scene, target)
    u = system.with_ghosts(state.u, state.mu)
    gaps = np.linalg.norm(
        (u - offset_to_target.x.array).reshape(-1, scene.model.V.dofmap.bs), axis=1
    )
    largest = system.comm.allreduce(float(gaps.max(initial=0.0)), MPI.MAX)
    return float(np.sqrt(_misfit(scene, state, target).value)), largest


def _misfit(scene: Scene, state: State, target: Target) -> Functional:
    """Return the mean square distance to a target over the area, in R^2, as a functional.

    Collective.
    """
    model, system = scene.model, scene.model.system
    over_area, offset_to_target = model.over_area(), offset(scene, target)
    gap, log = system.u - offset_to_target, model.kernels
    one = fem.Constant(model.V.mesh, 1.0)
    # the result is the quotient of these two integrals
    square = FormTerm("misfit", over_area(ufl.dot(gap, gap)), system.u, log)
    area_form = FormTerm("area", over_area(one), system.u, log)
    evaluation = system.at_state(state)
    area = evaluation.integral(area_form.energy_form)
    slope = log.compile("misfit slope", over_area(2 * ufl.dot(gap, ufl.TestFunction(model.V))))
    value = evaluation.integral(square.energy_form) / area
    # derivatives of the quotient by its numerator and its denominator
    forms = [(square, 1 / area), (area_form, -value / area)]
    return Functional(value, np.asarray(evaluation.gradient([slope]) / area), forms=forms)


def barrier(scene: Scene, step: ProgrammeStep, begin: State, end: State) -> float:
    """Return the energy barrier that a step passes, over E h R^2; collective.

    The step's own load is zero in both states. So its work is the change of Pi between them, plus
    the integral of q dmu for each other amplitude that changes as its conjugate q is held.

    Parameters
    ----------
    begin, end
        States at both ends of the step.
    """
    held_conjugates = held_conjugates_of_step(scene, step, begin)
    energy_before, energy_after = (sum(scene.energies(state).values()) for state in (begin, end))
    change = energy_after - energy_before
    for name, q in held_conjugates.items():
        change += scene.model.multiplicity * _work(q, begin.mu[name], end.mu[name])
    return float(change)


def _work(q: float | Conjugate, mu_before: float, mu_after: float) -> float:
    """Return the integral of q dmu between two values of an amplitude.

    Parameters
    ----------
    q
        The held conjugate of the amplitude: a number; or of a gas a function of the amplitude,
        which returns the conjugate and its derivative.
    """
    if not callable(q):
        return q * (mu_after - mu_before)
    integral, _ = scipy.integrate.quad(lambda mu, law=q: law(mu)[0], mu_before, mu_after)
    return float(integral)
