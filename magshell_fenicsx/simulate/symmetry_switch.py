"""From a reduced model to the smallest one that has a mode which it excludes, and the branch of
that mode.

Waves cos(m theta) around a meridian have two planes of symmetry at 180/m degrees: they are followed
in that sector, where a part has not these planes in a half, and else in the whole shell. A mode
that is antisymmetric to a half is one of the whole shell. The state and the mode are carried over,
and the bifurcation is located again (`continuation/bifurcation.py`): its load, energy and
displacement differ by the error of the two meshes alone.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.continuation.bifurcation import (
    BifurcationLost,
    find_bifurcation,
    switch_branch,
)
from magshell_fenicsx.continuation.continuation_run import ContinuationGoal
from magshell_fenicsx.continuation.fold import held_along
from magshell_fenicsx.continuation.modes import ModesNotFound, NoEigenpair, critical_mode
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import Point, StepOptions
from magshell_fenicsx.continuation.system import State, Vector, dot, max_abs
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import Mirror, rotation
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.platform import compat
from magshell_fenicsx.quantities.registry import OWN_MODES
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.simulate.contact_control import passes, with_cuts_here, with_own_contact
from magshell_fenicsx.simulate.path_records import Records, RecordStream, amount, follow_branch
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import LONGEST, Stage
from magshell_fenicsx.simulate.transfer import nodes_by_shell

Array = NDArray[np.float64]
WAVES = "m = "
NEIGHBOURS = 24  # nodes through which a cubic polynomial runs
MAX_CONTACT_CHANGES = 10  # times that a carried state gets stiffer penalties or new cuts
FIRST_STEP = 0.1  # step of a branch by arc length
TINY = 1e-300


@dataclass(frozen=True)
class SymmetrySwitch:
    """A bifurcation in the model that has its mode.

    Attributes
    ----------
    stage
        The solver of the step there.
    path
        By arc length, in the amplitude of the step.
    point
        The bifurcation, as a point of that path; its direction is the mode, in lengths of the
        system.
    said
        What handing over has changed, in words; "" where the model is the same.
    unstable
        Number of unstable directions that the model excludes, without those that are neutral here.
    """

    stage: Stage
    path: Path
    point: Point
    said: str = ""
    unstable: int = 0

    @property
    def scene(self) -> Scene:
        return self.stage.scene

    def record(self, number: int) -> Record:
        """The point in the model's own amplitudes and displacements."""
        own = self.stage.point(self.point)
        point = replace(own, state=self.scene.model.system.advance(own.state, own.state.mu))
        of = {
            "branch": number,
            "excluded_pivots": self.unstable,
            "said": self.said,
            "scene": self.scene,
        }
        return Record("step", self.path.name, point, **of)  # type: ignore[arg-type]


def switch_symmetry(stage: Stage, bifurcation: Record, scale: float) -> SymmetrySwitch:
    """The bifurcation of a record in the smallest model that has its mode; collective.

    Parameters
    ----------
    stage
        The solver of the step that has found it.
    scale
        That of the path.

    Raises
    ------
    Stopped
        If there is no such model, or the bifurcation is not found in it.
    """
    stage.scene.progress.doing("handing over to the model that has the mode")
    if bifurcation.mode in OWN_MODES:
        path = _arc_length_path(stage, bifurcation.amplitude, scale)
        state = stage.enter(bifurcation.point.state)
        try:
            phi = critical_mode(stage.newton, state).vector
        except NoEigenpair as e:
            raise Stopped(f"the mode of the bifurcation is not found: {e}") from None
        excluded = bifurcation.point
        point = _point_along(
            path, state, phi, excluded.negative_pivots, excluded.error, excluded.load_error
        )
        return SymmetrySwitch(stage, path, point, unstable=bifurcation.excluded_pivots)
    new = model_with_mode(stage.scene, bifurcation.mode)
    other = stage.on(new)
    try:
        mode = ShellModes(stage.scene.model).null_vector(bifurcation.point.state, bifurcation.mode)
    except ModesNotFound as e:
        raise Stopped(
            f"the mode of the bifurcation ({bifurcation.mode}) is not found: {e}"
        ) from None
    u, phi = _carried_over(stage.scene, new, bifurcation, mode)
    mu = {**new.unloaded().mu, **bifurcation.point.state.mu}
    path = _arc_length_path(other, bifurcation.amplitude, scale)
    guess = _settled_contact(other, path, State(u, mu), phi)
    located = (
        guess
        if isinstance(guess, str)
        else path.recorded(partial(_located, other, path, guess, phi))
    )
    if isinstance(located, str):
        raise Stopped(
            f"the bifurcation ({bifurcation.mode}) is not found in the {new.problem.included[0]}: {located}"
        )
    departure = SymmetrySwitch(other, path, located, unstable=bifurcation.excluded_pivots)
    return replace(departure, said=_differences(stage.scene, bifurcation, departure))


def model_with_mode(scene: Scene, mode: str) -> Scene:
    """The smallest model that has a mode which a model excludes; collective.

    Raises
    ------
    Stopped
        If it cannot be built.
    """
    symmetries: list[int | str] = ["none"]
    if mode.startswith(WAVES):
        symmetries = [int(mode.removeprefix(WAVES)), "half", "none"]
    why = ""
    for symmetry in symmetries:
        try:
            problem = scene.remesh(scene.problem.with_values({"symmetry": symmetry}))
            new = Scene(problem, scene.comm)
        except (CaseError, MeshError) as e:
            why = why or str(e)
            continue
        scene.journal.begin(new.model.V)
        new.journal, new.progress = scene.journal, scene.progress
        return new
    raise Stopped(f"no model has the mode {mode}: {why}")


def follow_switched_branch(
    stage: Stage, bifurcation: Record, goal: ContinuationGoal, scale: float, number: int
) -> Records:
    """The records of the branch at a bifurcation in the model that has its mode; its value is the
    state at their end.

    One direction is followed: the other is the same shape, turned about e3 or mirrored.

    Parameters
    ----------
    number
        `Record.branch`.

    Raises
    ------
    Stopped
        If the branch is not found, or lost.
    """
    departure = switch_symmetry(stage, bifurcation, scale)
    yield departure.record(number)
    crossing = switch_branch(departure.path, departure.point, partial(passes, departure.stage))
    if crossing is None:
        raise Stopped(f"the branch at the bifurcation ({bifurcation.mode}) is not found")
    comm, u, phi = departure.scene.model.system.comm, departure.point.state.u, departure.point.du
    start = max(crossing.starts, key=lambda point: dot(comm, point.state.u - u, phi))
    records = RecordStream(follow_branch(departure.stage, departure.path, start, goal, number))
    earlier_mu, advance = departure.point.state.mu, departure.scene.model.system.advance
    for record in records:
        point = departure.stage.point(record.point)
        earlier_mu = (state := advance(point.state, earlier_mu)).mu
        yield replace(record, point=replace(point, state=state), scene=departure.scene)
    return advance(departure.stage.leave(records.end), earlier_mu)


def _arc_length_path(stage: Stage, name: str, scale: float) -> Path:
    return stage.path(
        name, "arc", StepOptions(FIRST_STEP, LONGEST * FIRST_STEP, 1e-5 * FIRST_STEP), scale
    )


def _point_along(
    path: Path,
    state: State,
    phi: Vector,
    unstable: int,
    error: float = 0.0,
    load_error: float = 0.0,
) -> Point:
    comm = path.system.comm
    along = np.asarray(phi * path.system.length / max_abs(comm, phi))
    return Point(state, 0.0, along, 0.0, unstable, unstable, error=error, load_error=load_error)


def _settled_contact(stage: Stage, path: Path, guess: State, phi: Vector) -> State | str:
    """A carried state of shells that touch, at rest but for a force along the mode, with contact of the model's own:
    cuts there, and penalties that hold its nodes apart. Without contact the guess itself."""
    scene = stage.scene
    if not scene.model.shell_contacts:
        return guess
    state, mode = with_cuts_here(scene, guess), stage.padded(phi)
    for _ in range(MAX_CONTACT_CHANGES):
        point = path.recorded(partial(_at_rest, stage, path, state, mode))
        if isinstance(point, str):
            return point
        state = stage.leave(point.state)
        if (own := with_own_contact(scene, state)) is None:
            return state
        state = own
    return "the shells that touch have no cuts and penalties that last"


def _at_rest(stage: Stage, path: Path, guess: State, mode: Vector) -> Point | str:
    try:
        path_point = held_along(stage.newton, stage.enter(guess), mode)
    except np.linalg.LinAlgError:
        path_point = None
    return (
        _point_along(path, path_point[0], mode, 0)
        if path_point
        else "shells that touch do not come to rest there; take a finer mesh"
    )


def _located(stage: Stage, path: Path, guess: State, phi: Vector) -> Point | str:
    """The bifurcation near a guess, by its mode, in the system of a step."""
    state, mode = stage.enter(guess), stage.padded(phi)
    try:
        located = find_bifurcation(stage.newton, state, mode, path.name)
    except BifurcationLost:
        return "Newton's method does not converge; take a finer mesh"
    comm = path.system.comm
    sign = 1.0 if dot(comm, located.phi, mode) > 0 else -1.0
    point = _point_along(
        path, located.state, sign * located.phi, located.unstable, located.error, located.load_error
    )
    return replace(point, iterations=located.iterations, factorisations=located.factorisations)


def _differences(old: Scene, event: Record, departure: SymmetrySwitch) -> str:
    """What handing over has changed, in words; collective."""
    new, name = departure.scene, event.amplitude
    state = departure.stage.point(departure.point).state
    one, two = old.observe(event.point.state), new.observe(state)
    a, b = (amount_of(scene, name, s) for scene, s in ((old, event.point.state), (new, state)))
    energy = abs(two["energy"] - one["energy"]) / max(abs(one["energy"]), TINY)
    counted = ""
    if new.problem.is_half:
        besides = ", but for its turning about e3" if new.problem.turns else ""
        counted = f"; its excluded_pivots are those of all other modes of the shell{besides}"
    return (
        f"the branch of the mode ({event.mode}) is followed in the {new.problem.included[0]}, {new.model.system.dofs} "
        f"unknowns: its bifurcation is at {amount(new, name, b)}, by {abs(b - a) / max(abs(a), TINY):.2g} of it beside "
        f"that of the {old.problem.included[0]}; the energy there differs by {energy:.2g} of it, w/h by "
        f"{abs(two['w_over_h'] - one['w_over_h']):.2g}{counted}"
    )


def amount_of(scene: Scene, name: str, state: State) -> float:
    """The value of an amplitude of a state, or of a step that drives several."""
    return state.mu.get(name, state.mu.get("lambda_m", 0.0))


def _carried_over(
    old: Scene, new: Scene, bifurcation: Record, mode: Vector
) -> tuple[Vector, Vector]:
    """Displacement and mode of a model in the unknowns of one with less symmetry; collective."""
    system, u = new.model.system, bifurcation.point.state.u
    if old.model.axisymmetric:
        s, theta = _along_meridian(old, new)
        both = _revolved(old.model, s, theta, u, mode, int(bifurcation.mode.removeprefix(WAVES)))
    else:
        both = _mirrored(old, new, u, mode)
    return system.zero_at_supports(both[0].ravel()), system.zero_at_supports(both[1].ravel())


def _along_meridian(old: Scene, new: Scene) -> tuple[Array, Array]:
    """Parameter of the meridian and azimuth (rad) of the nodes of a surface, in its model's frame."""
    span = old.problem.meridian
    assert span
    s, theta = np.array([span.locate(x) for x in new.model.chart()]).reshape(-1, 2).T
    return s, theta


def _revolved(
    model: MeridianModel, s: Array, theta: Array, u: Vector, wave: Vector, m: int
) -> tuple[Array, Array]:
    """u(s) and the wave U cos e_rho + V sin e_theta + W cos e_z at places, (n, 3) each; the crest
    of u . n inwards.
    """
    radial, axial = _evaluated(model, model.V, u, s).T
    U_and_V, V, W = _evaluated(model, model.symmetry_breaking_modes.waves.V, wave, s).T
    cos, sin, zero = np.cos(theta), np.sin(theta), 0 * theta
    e_rho, e_theta = np.column_stack([cos, sin, zero]), np.column_stack([-sin, cos, zero])

    def in_space(a: Array, b: Array, c: Array) -> Array:
        return np.asarray(
            a[:, None] * e_rho + b[:, None] * e_theta + np.column_stack([zero, zero, c])
        )

    waved = in_space(
        (U_and_V - V) * np.cos(m * theta), V * np.sin(m * theta), W * np.cos(m * theta)
    )
    return in_space(radial, zero, axial), _sign(model, wave) * waved


def _sign(model: MeridianModel, wave: Vector) -> float:
    """Of a wave whose largest crest at azimuth 0 is inwards."""
    V = model.symmetry_breaking_modes.waves.V
    values = wave.reshape(-1, 3)[np.argsort(V.tabulate_dof_coordinates()[:, 0])]
    along = values[:, 0] - values[:, 1] + 1e-3 * values[:, 2]
    return 1.0 if along[np.argmax(np.abs(along))] < 0 else -1.0


def _evaluated(model: MeridianModel, V: fem.FunctionSpace, x: Vector, s: Array) -> Array:
    """Components (n, k) of a field on the meridian at its parameters s."""
    domain = model.meridian.mesh
    ends = domain.geometry.x[compat.geometry_dofs(domain), 0]
    begin = ends.min(axis=1)
    order = np.argsort(begin)
    cells = order[np.clip(np.searchsorted(begin[order], s, side="right") - 1, 0, len(order) - 1)]
    local = np.clip((s - ends[cells, 0]) / (ends[cells, 1] - ends[cells, 0]), 0.0, 1.0)
    table = V.element.basix_element.tabulate(0, local[:, None])[0, :, :, 0]
    nodes = x.reshape(-1, V.dofmap.bs)[V.dofmap.list[cells]]
    return np.asarray(np.einsum("np,npc->nc", table, nodes))


def _mirrored(old: Scene, new: Scene, u: Vector, mode: Vector) -> tuple[Array, Array]:
    """u and its antisymmetric mode of a half at the nodes of the whole shell, (n, 3) each;
    collective.
    """
    comm, size = old.model.system.comm, old.model.system.size
    mirror = old.problem.mirror
    assert isinstance(mirror, Mirror)
    parts = [old.model.r0.x.array[:size], u[:size], mode[:size]]
    places, *fields = (np.concatenate(comm.allgather(part.reshape(-1, 3))) for part in parts)
    off = mirror.signed_distance(places) > 1e-9
    S = mirror.reflection
    x = np.concatenate([places, mirror.image(places[off])])
    both = [
        np.concatenate([f, sign * f[off] @ S]) for f, sign in zip(fields, (1.0, -1.0), strict=True)
    ]
    Q = (
        rotation(old.problem.azimuth) @ rotation(new.problem.azimuth).T
    )  # from the new frame to the old one
    places = new.model.r0.x.array[: new.model.system.size].reshape(-1, 3) @ Q.T
    values, at_nodes = np.hstack(both), np.zeros((len(places), 6))
    for inside, own in nodes_by_shell(old, new):
        if own.any():
            from_own = np.concatenate([inside, inside[off]])
            at_nodes[own] = interpolated_on_surface(x[from_own], values[from_own], places[own])
    return at_nodes[:, :3] @ Q, at_nodes[:, 3:] @ Q


def interpolated_on_surface(x: Array, values: Array, places: Array) -> Array:
    """Values (n, k) on a smooth surface at places (n, 3) near nodes x, by cubic polynomials of the
    tangent plane.
    """
    count = min(NEIGHBOURS, len(x))
    neighbours = scipy.spatial.cKDTree(x).query(places, count)[1].reshape(len(places), count)
    offsets = x[neighbours] - places[:, None]
    size = np.linalg.norm(offsets, axis=2).max(axis=1)
    axes = np.linalg.svd(offsets - offsets.mean(axis=1, keepdims=True), full_matrices=False)[2][
        :, :2
    ]
    a, b = np.moveaxis(np.einsum("nki,nji->nkj", offsets, axes) / size[:, None, None], 2, 0)
    basis = np.stack([a**i * b**j for i in range(4) for j in range(4 - i)], axis=2)
    weight = np.exp(-4 * (a**2 + b**2))
    coefficients = np.linalg.pinv(weight[..., None] * basis) @ (
        weight[..., None] * values[neighbours]
    )
    return np.asarray(coefficients[:, 0])
