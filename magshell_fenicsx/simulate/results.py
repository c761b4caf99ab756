"""Numbers of a state that can be differentiated, with their derivatives by the state; the energy
barrier of a run.

The barrier is what a probing force passes: its work from zero, over its largest value, back to
zero.
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
from magshell_fenicsx.continuation.system import State, Vector, dot
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.models.shell.spatial_fields import PlacementField
from magshell_fenicsx.parts.observables import Slope
from magshell_fenicsx.parts.registered import SEEN
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
    """A number J(u, mu; p) of a state.

    Attributes
    ----------
    by_u, by_mu
        dJ/du, zero at supports, and dJ/dmu_i where J contains the amplitude itself.
    potentials
        c_i: J contains the sum of c_i dPi/dmu_i.
    energy
        c: J contains c Pi.
    reaction
        e at supports: J is e . R of the residual of all nodes.
    forms
        What else of J depends on the placement: energies, and what they are multiplied by.
    deflections
        Name of a point -> what u . n0 there is multiplied by in J.
    slope
        What J is of a room, with its derivatives by a field; then J is no amplitude itself,
        whatever `by_mu` is.
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


def functional(scene: Scene, state: State, of: str | Target) -> Functional:
    """A column of path.csv, or the mean square distance to a target over the area, in R^2;
    collective.

    Raises
    ------
    CaseError
        If the scene has no such column, or it has no derivative here; the message has those that
        have one.
    """
    model, system = scene.model, scene.model.system
    if callable(of):
        return _misfit(scene, state, of)
    still: Vector = np.zeros(system.size)
    if of == "energy":
        by_u = model.multiplicity * system.residual(state.u, state.mu)
        return Functional(scene.observe(state)["energy"], by_u, energy=model.multiplicity)
    points = _displacements(scene)
    if of in points:
        point, i = points[of]
        by_u = scene.problem.length * (_turned(scene) @ model.probe(point))[i]
        return Functional(scene.observe(state)[of], system.zero_at_supports(by_u))
    if of in (of_loads := conjugates(scene)):
        name, unit = of_loads[of]
        by_u = np.asarray(-system.load(state.u, state.mu, name) / unit)
        value = -system.potential(state.u, state.mu, name) / unit
        forms = [(term, -value / model.load_size[name]) for term in model.size_terms(name)]
        return Functional(value, by_u, potentials={name: -1 / unit}, forms=forms)
    if of in AT_POLE and "pole" in model.normals:
        by_u = np.asarray(-(model.normals["pole"] @ model.probe("pole")) / scene.problem.material.h)
        by_normal = {"pole": -1 / scene.problem.material.h}
        return Functional(
            scene.observe(state)["w_pole_over_h"],
            system.zero_at_supports(by_u),
            deflections=by_normal,
        )
    if of in (forces := _forces(scene)):
        return _reaction(scene, state, *forces[of], of)
    for room in SEEN:
        if slope := room.slope(scene.sight, state, of):
            return Functional(slope.value, slope.by_u, slope.by_mu, slope=slope)
    name = next((name for name in state.mu if of in (name, amplitude(name).column)), "")
    if name:
        return Functional(state.mu[name], still, {name: 1.0})
    raise CaseError(
        f"{of}: has no gradient here; allowed are {', '.join(differentiable(scene, state))}"
    )


def differentiable(scene: Scene, state: State) -> list[str]:
    """The columns of path.csv that `functional` takes, and those of them in units."""
    at_pole = AT_POLE if "pole" in scene.model.normals else ()
    rooms = (column for room in SEEN for column in room.differentiable(scene.problem.loads))
    amplitudes = (
        amplitude(name).column for name in state.mu if name not in scene.model.system.history
    )
    columns = dict.fromkeys(
        (
            "energy",
            *conjugates(scene),
            *_displacements(scene),
            *_forces(scene),
            *at_pole,
            *rooms,
            *amplitudes,
        )
    )
    return [*columns, *scene.sizes.columns(columns)]


def in_units(scene: Scene, state: State, of: str) -> tuple[str, str]:
    """The dimensionless column of a column in units, and the scale of its unit; else the column
    itself, and "".
    """
    for name in differentiable(scene, state):
        if (of_unit := scene.sizes.column(name)) and of_unit.name == of:
            return name, quantity(name).scale
    return of, ""


def _displacements(scene: Scene) -> dict[str, tuple[str, int]]:
    """Columns of named points -> the point and the axis."""
    return {
        f"{point}_u{axis}": (point, i)
        for point in scene.problem.context.points
        for i, axis in enumerate("xyz")
    }


def force_unit(scene: Scene) -> float:
    """E h R^2 over R in the case's unit of force."""
    return scene.problem.modulus * scene.problem.material.h * scene.problem.length**2


def _forces(scene: Scene) -> dict[str, tuple[str, int]]:
    """Column of a force of a support -> the support and the axis."""
    supports = scene.problem.supports if scene.problem.reactions else ()
    return {f"{name}_f{axis}": (name, i) for name in supports for i, axis in enumerate("xyz")}


def _reaction(scene: Scene, state: State, name: str, axis: int, of: str) -> Functional:
    """A force of a support."""
    system, problem = scene.model.system, scene.problem
    if scene.model.without_potential and problem.loads.pressure:
        raise CaseError(
            f"{of}: has no gradient under a pressure at a free edge, which has no potential"
        )
    way = rotation(problem.azimuth)[:, axis]
    e = force_unit(scene) * weights(scene.model, name, way, problem.mirror)
    value = dot(system.comm, e, system.forces(state.u, state.mu))
    return Functional(
        value, system.zero_at_supports(system.at_state(state).stiffness_along(e)), reaction=e
    )


def conjugates(scene: Scene) -> dict[str, tuple[str, float]]:
    """Column -> the amplitude whose conjugate it is, and the conjugate's unit."""
    model, loads = scene.model, scene.problem.loads
    amplitudes = {"volume_change": "pressure"} if loads.pressure else {}
    amplitudes |= {column: name for room in SEEN for name, column in room.conjugates(loads).items()}
    with_units = {column: (name, scene.conjugate_unit(name)) for column, name in amplitudes.items()}
    for name in (*loads.forces, *loads.dead):
        if size := model.force_unit if name in loads.forces else model.load_size.get(name, 0.0):
            column = "w_over_h" if name == loads.displaced else f"w_{name}_over_h"
            with_units[column] = name, size * scene.problem.material.h
    return with_units


def _turned(scene: Scene) -> Array:
    """From the model's frame to the case's."""
    return rotation(scene.problem.azimuth).T


def offset(scene: Scene, target: Target) -> fem.Function:
    """The displacement that reaches the target, at the nodes of the model."""
    axes, Q = scene.model.axes, rotation(scene.problem.azimuth)

    def of(r0: fem.Function) -> PlacementField:
        offsets = PlacementField(r0.function_space, "offset", of)
        places = np.zeros((np.size(r0.x.array) // len(axes), 3))
        places[:, axes] = np.reshape(r0.x.array, (-1, len(axes)))
        wanted = target(places @ Q) @ Q.T
        offsets.x.array[:] = (wanted - places)[:, axes].ravel()
        return offsets

    return of(scene.model.r0)


def distances(scene: Scene, state: State, target: Target) -> tuple[float, float]:
    """Root mean square and largest distance to a target at the nodes, over R; collective."""
    system, away = scene.model.system, offset(scene, target)
    u = system.with_ghosts(state.u, state.mu)
    gaps = np.linalg.norm((u - away.x.array).reshape(-1, scene.model.V.dofmap.bs), axis=1)
    largest = system.comm.allreduce(float(gaps.max(initial=0.0)), MPI.MAX)
    return float(np.sqrt(_misfit(scene, state, target).value)), largest


def _misfit(scene: Scene, state: State, target: Target) -> Functional:
    model, system = scene.model, scene.model.system
    over, away = model.over_area(), offset(scene, target)
    gap, log = system.u - away, model.kernels
    one = fem.Constant(model.V.mesh, 1.0)
    square = FormTerm("misfit", over(ufl.dot(gap, gap)), system.u, log)
    whole = FormTerm("area", over(one), system.u, log)
    at = system.at_state(state)
    area = at.integral(whole.energy_form)
    slope = log.compile("misfit slope", over(2 * ufl.dot(gap, ufl.TestFunction(model.V))))
    value = at.integral(square.energy_form) / area
    forms = [(square, 1 / area), (whole, -value / area)]
    return Functional(value, np.asarray(at.gradient([slope]) / area), forms=forms)


def barrier(scene: Scene, step: ProgrammeStep, begin: State, end: State) -> float:
    """The work of a step's load between two states without this load, over E h R^2; collective.

    It is the change of the energy under the other loads as they are held: that of Pi, plus the
    integral of q dmu for each amplitude whose conjugate q is held.
    """
    held = held_conjugates_of_step(scene, step, begin)
    before, after = (sum(scene.energies(state).values()) for state in (begin, end))
    change = after - before
    for name, q in held.items():
        a, b = begin.mu[name], end.mu[name]
        work = (
            scipy.integrate.quad(lambda mu, q=q: q(mu)[0], a, b)[0] if callable(q) else q * (b - a)
        )
        change += scene.model.multiplicity * work
    return float(change)
