"""Switch from a reduced model to the smallest one with a mode that it excludes; that mode's branch.

Waves cos(m theta) around a meridian have two planes of symmetry at 180/m degrees: they are followed
in that sector, where a part has not these planes in a half, and else in the whole shell. A mode
that is antisymmetric to a half is one of the whole shell. The state and the mode are carried over,
and the bifurcation is located again (`continuation/bifurcation.py`): its load, energy and
displacement differ by the error of the two meshes alone.

Words and symbols:

- A reduced model is a meridian, a sector or a half, which excludes modes without its symmetry. The
  name of a mode in a record is "m = 7" for waves around a meridian, "antisymmetric" for a half, or
  one of `OWN_MODES` for a mode that the model itself has.
- phi is the mode of the bifurcation, the null vector of the tangent; u is the displacement.
- A stage is a scene with the solver of one step. `enter` and `leave` convert states of the model to
  states of the step's system and back, which may have amplitudes among its unknowns; `padded` does
  so with a vector.
- The scale of a path is the unit of its amplitude in arc length.
- Settled contact has the cuts (quadrature of shells that touch) and penalties that fit its state.
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
from magshell_fenicsx.quantities.mode_labels import waves_of_label
from magshell_fenicsx.quantities.registry import OWN_MODES, amplitude
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.shells.waves import wave_in_space
from magshell_fenicsx.simulate.contact_control import passes, with_cuts_here, with_own_contact
from magshell_fenicsx.simulate.path_records import Records, RecordStream, amount, follow_branch
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import LONGEST, Stage
from magshell_fenicsx.simulate.transfer import nodes_by_shell

Array = NDArray[np.float64]
NEIGHBOURS = 24  # nodes through which a cubic polynomial runs
MAX_CONTACT_CHANGES = 10  # times that a carried state gets stiffer penalties or new cuts
FIRST_STEP = 0.1  # step of a branch by arc length
TINY = 1e-300  # avoids a division by zero
PLANE_TOLERANCE = 1e-9  # over R: distance of a place in a mirror plane


@dataclass(frozen=True)
class SymmetrySwitch:
    """A bifurcation in the model that has its mode, from which the branch can be followed.

    Attributes
    ----------
    stage
        The larger scene with the solver of the step.
    path
        A path by arc length, in the amplitude of the step.
    point
        The bifurcation, as a point of that path; its direction is the mode, in lengths of the
        system.
    said
        Changes by the switch, in words; "" where the model is the same.
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
        """Scene of the model."""
        return self.stage.scene

    def record(self, number: int) -> Record:
        """Return the record of the bifurcation, in the model's own amplitudes and displacements.

        Parameters
        ----------
        number
            Number of the branch; 0 on the path itself.
        """
        # the point with displacement and amplitudes of the model, instead of the step's system
        point = self.stage.point(self.point)
        state = self.scene.model.system.advance(point.state, point.state.mu)
        return Record(
            "step",
            self.path.name,
            replace(point, state=state),
            branch=number,
            excluded_pivots=self.unstable,
            scene=self.scene,
            said=self.said,
        )

    def starts_of_branch(self, mode: str) -> list[Point]:
        """Return the first points of the branch in its two directions; collective.

        They are points of the step's system. That along the mode comes first.

        Parameters
        ----------
        mode
            Name of the mode, for a message.

        Raises
        ------
        Stopped
            If the branch is not found.
        """
        # `passes` refuses a start to which a shell would pass through another one
        crossing = switch_branch(self.path, self.point, partial(passes, self.stage))
        if crossing is None:
            raise Stopped(f"the branch at the bifurcation ({mode}) is not found")
        comm, u, phi = self.scene.model.system.comm, self.point.state.u, self.point.du

        def component_along_mode(start: Point) -> float:
            """Return how far a point is along the mode."""
            return dot(comm, start.state.u - u, phi)

        return sorted(crossing.starts, key=component_along_mode, reverse=True)


def switch_symmetry(stage: Stage, bifurcation: Record, scale: float) -> SymmetrySwitch:
    """Return the bifurcation of a record in the smallest model that has its mode; collective.

    Parameters
    ----------
    stage
        The scene that has found the bifurcation, with the solver of the step.
    bifurcation
        Its record.
    scale
        Value of the amplitude that counts as of order one in the arc length of the branch.

    Raises
    ------
    Stopped
        If there is no such model, or the bifurcation is not found in it.
    """
    stage.scene.progress.doing("handing over to the model that has the mode")
    if bifurcation.mode in OWN_MODES:
        return _switch_in_same_model(stage, bifurcation, scale)
    new_scene = model_with_mode(stage.scene, bifurcation.mode)
    new_stage = stage.on_scene(new_scene)
    try:
        mode = ShellModes(stage.scene.model).null_vector(bifurcation.point.state, bifurcation.mode)
    except ModesNotFound as e:
        raise Stopped(
            f"the mode of the bifurcation ({bifurcation.mode}) is not found: {e}"
        ) from None
    # displacement and mode in the unknowns of the new model; amplitudes that it alone has are zero
    u, phi = _carried_over(stage.scene, new_scene, bifurcation, mode)
    mu = {**new_scene.unloaded().mu, **bifurcation.point.state.mu}
    path = _arc_length_path(new_stage, bifurcation.amplitude, scale)
    # first contact settles, then the bifurcation is located; either returns a text if it fails
    settled = _settled_contact(new_stage, path, State(u, mu), phi)
    located: Point | str
    if isinstance(settled, str):
        located = settled
    else:
        located = path.recorded(partial(_located, new_stage, path, settled, phi))
    if isinstance(located, str):
        model_words = new_scene.problem.included[0]  # the phrase that says what is modelled
        raise Stopped(
            f"the bifurcation ({bifurcation.mode}) is not found in the {model_words}: {located}"
        )
    switch = SymmetrySwitch(new_stage, path, located, unstable=bifurcation.excluded_pivots)
    return replace(switch, said=_differences(stage.scene, bifurcation, switch))


def _switch_in_same_model(stage: Stage, bifurcation: Record, scale: float) -> SymmetrySwitch:
    """Return the bifurcation of a record whose mode the model itself has; collective.

    Nothing is located again: the record's point is exact in this model.

    Parameters
    ----------
    stage, bifurcation
        Scene with the solver of the step, and the record of the bifurcation.
    scale
        Value of the amplitude that counts as of order one in the arc length of the branch.

    Raises
    ------
    Stopped
        If the mode is not found.
    """
    path = _arc_length_path(stage, bifurcation.amplitude, scale)
    state = stage.enter(bifurcation.point.state)
    try:
        phi = critical_mode(stage.newton, state).vector
    except NoEigenpair as e:
        raise Stopped(f"the mode of the bifurcation is not found: {e}") from None
    point = bifurcation.point
    located = _point_along(path, state, phi, point.negative_pivots, point.error, point.load_error)
    return SymmetrySwitch(stage, path, located, unstable=bifurcation.excluded_pivots)


def model_with_mode(scene: Scene, mode: str) -> Scene:
    """Return the scene of the smallest model that has a mode which a scene excludes; collective.

    Parameters
    ----------
    scene
        Scene of the reduced model; the new scene shares its journal and listener.
    mode
        Name of the mode: "m = 7" or "antisymmetric".

    Raises
    ------
    Stopped
        If no larger model can be built.
    """
    symmetries: list[int | str] = ["none"]
    if m := waves_of_label(mode):  # from the smallest model: the sector of 180/m degrees
        symmetries = [m, "half", "none"]
    first_reason = ""  # why the first one cannot be built
    for symmetry in symmetries:
        try:
            problem = scene.remesh(scene.problem.with_values({"symmetry": symmetry}))
            new_scene = Scene(problem, scene.comm)
        except (CaseError, MeshError) as e:
            first_reason = first_reason or str(e)
            continue
        # the journal goes on with the unknowns of the new model
        scene.journal.begin(new_scene.model.V)
        new_scene.journal, new_scene.progress = scene.journal, scene.progress
        new_scene.newton.factorisation.allow = scene.newton.factorisation.allow
        return new_scene
    raise Stopped(f"no model has the mode {mode}: {first_reason}")


def follow_switched_branch(
    stage: Stage, bifurcation: Record, goal: ContinuationGoal, scale: float, number: int
) -> Records:
    """Yield the records of the branch at a bifurcation, in the model that has its mode; collective.

    One direction is followed: the other is the same shape, turned about e3 or mirrored.

    Parameters
    ----------
    stage, bifurcation
        Scene of the reduced model with the solver of the step, and its record of the bifurcation.
    goal
        Where the branch ends.
    scale
        Value of the amplitude that counts as of order one in the arc length of the branch.
    number
        Number of the branch in its records; 0: the path itself goes on along it.

    Returns
    -------
    State
        State of the larger model at the end (the generator's return value).

    Raises
    ------
    Stopped
        If the branch is not found, or lost.
    """
    switch = switch_symmetry(stage, bifurcation, scale)
    yield switch.record(number)
    new_stage, at_switch, system = switch.stage, switch.point, switch.scene.model.system
    start, _ = switch.starts_of_branch(bifurcation.mode)
    records = RecordStream(follow_branch(new_stage, switch.path, start, goal, number))
    earlier_mu = at_switch.state.mu
    for record in records:
        # the point with displacement and amplitudes of the model; its state then gets its history:
        # angles of edges under moments, which go on from those of the point before
        point = new_stage.point(record.point)
        state = system.advance(point.state, earlier_mu)
        earlier_mu = state.mu
        yield replace(record, point=replace(point, state=state), scene=switch.scene)
    return system.advance(new_stage.leave(records.end), earlier_mu)


def _arc_length_path(stage: Stage, name: str, scale: float) -> Path:
    """Return a path by arc length with the steps of a branch: first, longest and shortest.

    Parameters
    ----------
    name
        The amplitude that varies.
    scale
        Value of the amplitude that counts as of order one in the arc length.
    """
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
    """Return a point of a path whose direction is a mode, scaled to the system's length.

    Parameters
    ----------
    phi
        The mode, of any size.
    unstable
        Number of unstable directions.
    error, load_error
        Estimated errors of the displacement, over the system's length, and of the amplitude.
    """
    direction = np.asarray(phi * path.system.length / max_abs(path.system.comm, phi))
    # s = 0 here, and dmu = 0: along the mode the load does not change to first order
    return Point(state, 0.0, direction, 0.0, unstable, unstable, error=error, load_error=load_error)


def _settled_contact(stage: Stage, path: Path, guess: State, phi: Vector) -> State | str:
    """Return a state near a guess that is in equilibrium, but for a force along the mode.

    The guess comes from another model. Shells that touch get cuts and penalties of this model; the
    force keeps the state from running off along the neutral mode meanwhile. Without contact the
    state is the guess itself. Collective.

    Parameters
    ----------
    guess, phi
        State and mode of the model.

    Returns
    -------
    State or str
        State of the model, or the reason why there is none.
    """
    scene = stage.scene
    if not scene.model.shell_contacts:
        return guess
    # cuts of this model at the guess, and the mode as a vector of the step's system
    state, mode = with_cuts_here(scene, guess), stage.padded(phi)
    for _ in range(MAX_CONTACT_CHANGES):
        point = path.recorded(partial(_at_rest, stage, path, state, mode))
        if isinstance(point, str):
            return point
        state = stage.leave(point.state)
        # with stiffer penalties or better cuts; None if those of the state fit it
        changed_state = with_own_contact(scene, state)
        if changed_state is None:
            return state
        state = changed_state
    return "the shells that touch have no cuts and penalties that last"


def _at_rest(stage: Stage, path: Path, guess: State, mode: Vector) -> Point | str:
    """Return the point near a guess that a force along a mode holds at rest, or why there is none.

    The force keeps the component of the guess along the mode. The number of unstable directions at
    the point is not known, and is set to 0.

    Parameters
    ----------
    guess
        State of the model.
    mode
        Vector of the step's system.
    """
    try:
        state_and_error = held_along(stage.newton, stage.enter(guess), mode)
    except np.linalg.LinAlgError:
        state_and_error = None
    if state_and_error is None:
        return "shells that touch do not come to rest there; take a finer mesh"
    state, _ = state_and_error
    return _point_along(path, state, mode, unstable=0)


def _located(stage: Stage, path: Path, guess: State, phi: Vector) -> Point | str:
    """Return the bifurcation near a guess by its mode, as a point of a path, or why there is none.

    Parameters
    ----------
    guess, phi
        State and mode of the model.
    """
    state, mode = stage.enter(guess), stage.padded(phi)
    try:
        located = find_bifurcation(stage.newton, state, mode, path.name)
    except BifurcationLost:
        return "Newton's method does not converge; take a finer mesh"
    comm = path.system.comm
    # the mode keeps its sense, and so the branch its side
    sign = 1.0 if dot(comm, located.phi, mode) > 0 else -1.0
    point = _point_along(
        path, located.state, sign * located.phi, located.unstable, located.error, located.load_error
    )
    return replace(point, iterations=located.iterations, factorisations=located.factorisations)


def _differences(old: Scene, event: Record, switch: SymmetrySwitch) -> str:
    """Return a message on what a switch has changed at its bifurcation; collective.

    Parameters
    ----------
    old, event
        Scene of the reduced model, and its record of the bifurcation.
    switch
        The bifurcation in the larger model.
    """
    new_scene, name = switch.scene, event.amplitude
    state = switch.stage.point(switch.point).state
    # columns of the results at the bifurcation, in both models
    old_row, new_row = old.observe(event.point.state), new_scene.observe(state)
    old_load, new_load = amount_of(name, event.point.state), amount_of(name, state)
    # relative changes of load and energy, and the change of w/h
    load_change = abs(new_load - old_load) / max(abs(old_load), TINY)
    old_energy = old_row["energy"]
    energy_change = abs(new_row["energy"] - old_energy) / max(abs(old_energy), TINY)
    deflection_change = abs(new_row["w_over_h"] - old_row["w_over_h"])
    count_text = ""
    if new_scene.problem.is_half:  # a half or a sector counts modes of the whole shell too
        exception = ", but for its turning about e3" if new_scene.problem.turns else ""
        count_text = f"; its excluded_pivots are those of all other modes of the shell{exception}"
    return (
        f"the branch of the mode ({event.mode}) is followed in the "
        f"{new_scene.problem.included[0]}, "
        f"{new_scene.model.system.dofs} unknowns: its bifurcation is at "
        f"{amount(new_scene, name, new_load)}, by "
        f"{load_change:.2g} of it beside that of the {old.problem.included[0]}; the energy there "
        f"differs by {energy_change:.2g} of it, w/h by {deflection_change:.2g}{count_text}"
    )


def amount_of(name: str, state: State) -> float:
    """Return the value of an amplitude at a state; of an angle, that of the load that it turns."""
    return state.mu.get(name, state.mu.get(amplitude(name).turned_load, 0.0))


def _carried_over(
    old: Scene, new: Scene, bifurcation: Record, mode: Vector
) -> tuple[Vector, Vector]:
    """Return displacement and mode of a record in the unknowns of a larger model; collective.

    Both are zero at supports, on this rank.

    Parameters
    ----------
    old, new
        Scenes of the reduced model and of the larger one.
    mode
        The excluded mode, as `ShellModes.null_vector` of the reduced model gives it.
    """
    system, u = new.model.system, bifurcation.point.state.u
    if old.model.axisymmetric:
        s, theta = _along_meridian(old, new)
        m = waves_of_label(bifurcation.mode)
        assert m
        displacement, new_mode = _revolved(old.model, s, theta, u, mode, m)
    else:
        displacement, new_mode = _mirrored(old, new, u, mode)
    return (
        system.zero_at_supports(displacement.ravel()),
        system.zero_at_supports(new_mode.ravel()),
    )


def _along_meridian(old: Scene, new: Scene) -> tuple[Array, Array]:
    """Return where a surface's nodes are on its meridian: parameters s, and azimuths (rad).

    Parameters
    ----------
    old, new
        Scenes of the meridian and of the surface.
    """
    meridian_chart = old.problem.meridian
    assert meridian_chart
    places = new.model.chart()
    # (n, 2), also of a rank without nodes
    s, theta = np.array([meridian_chart.locate(place) for place in places]).reshape(-1, 2).T
    return s, theta


def _revolved(
    model: MeridianModel, s: Array, theta: Array, u: Vector, wave: Vector, m: int
) -> tuple[Array, Array]:
    """Return displacement and wave of a meridian at places of a surface, (n, 3) each.

    The sign of the wave is such that its largest crest at theta = 0 is inwards.

    Parameters
    ----------
    s, theta
        (n,), meridian parameters and azimuths (rad) of the places.
    u
        Unknowns of the axisymmetric displacement.
    wave, m
        Unknowns (U + V, V, W) of the wave, and its number of crests.
    """
    radial, axial = _evaluated(model, model.V, u, s).T
    displacement = np.column_stack([radial * np.cos(theta), radial * np.sin(theta), axial])
    coefficients = _evaluated(model, model.waves.V, wave, s)
    return displacement, _sign(model, wave) * wave_in_space(coefficients, m, theta)


def _sign(model: MeridianModel, wave: Vector) -> float:
    """Return the sign, 1 or -1, with which a wave's largest crest at azimuth 0 is inwards."""
    V = model.waves.V
    # along the meridian, so that of two equal crests always the same one counts
    values = wave.reshape(-1, 3)[np.argsort(V.tabulate_dof_coordinates()[:, 0])]
    # U at azimuth 0; a little of W decides where U is zero
    crests = values[:, 0] - values[:, 1] + 1e-3 * values[:, 2]
    return 1.0 if crests[np.argmax(np.abs(crests))] < 0 else -1.0


def _evaluated(model: MeridianModel, V: fem.FunctionSpace, x: Vector, s: Array) -> Array:
    """Return components (n, k) of a field on the meridian at places.

    Parameters
    ----------
    x
        Unknowns of the field in the space V.
    s
        (n,), meridian parameters.
    """
    domain = model.meridian.mesh
    # (cells, 2): parameters at the two ends of each cell, in any order
    cell_ends = domain.geometry.x[compat.geometry_dofs(domain), 0]
    cell_begin = cell_ends.min(axis=1)
    order = np.argsort(cell_begin)
    # the last cell that begins before s; the first or the last cell for an s beyond the meridian
    last_before = np.searchsorted(cell_begin[order], s, side="right") - 1
    cells = order[np.clip(last_before, 0, len(order) - 1)]
    first_end, second_end = cell_ends[cells, 0], cell_ends[cells, 1]
    local_coordinate = np.clip((s - first_end) / (second_end - first_end), 0.0, 1.0)
    # (places, nodes): the element's basis functions, without derivatives
    table = V.element.basix_element.tabulate(0, local_coordinate[:, None])[0, :, :, 0]
    values_at_nodes = x.reshape(-1, V.dofmap.bs)[V.dofmap.list[cells]]
    return np.asarray(np.einsum("np,npc->nc", table, values_at_nodes))


def _mirrored(old: Scene, new: Scene, u: Vector, mode: Vector) -> tuple[Array, Array]:
    """Return displacement and antisymmetric mode of a half at the nodes of the whole shell.

    Both are extended to the other half: the displacement by its mirror image, the mode by the
    negative of this image. Then they are interpolated at the new nodes. Collective.

    Parameters
    ----------
    old, new
        Scenes of the half and of the whole shell.
    u, mode
        Unknowns of the half.

    Returns
    -------
    displacement, mode
        (n, 3) each, in the frame of the new scene.
    """
    comm, size = old.model.system.comm, old.model.system.size
    mirror = old.problem.mirror
    assert isinstance(mirror, Mirror)
    # of all ranks: places, displacements and mode (n, 3) at the nodes of the half
    local_vectors = [old.model.r0.x.array[:size], u[:size], mode[:size]]
    places, *fields = (
        np.concatenate(comm.allgather(local_vector.reshape(-1, 3)))
        for local_vector in local_vectors
    )
    # nodes of both halves: first those of the half, then the images of those off the plane
    has_image = mirror.signed_distance(places) > PLANE_TOLERANCE
    places_of_both_halves = np.concatenate([places, mirror.image(places[has_image])])
    # (nodes, 6): the displacement, and the mode with the negative of its image
    values = np.hstack(
        [
            np.concatenate([field, sign * field[has_image] @ mirror.reflection])
            for field, sign in zip(fields, (1.0, -1.0), strict=True)
        ]
    )
    # places of the new nodes, turned from the new frame to the old one
    rotation_to_old = rotation(old.problem.azimuth) @ rotation(new.problem.azimuth).T
    new_places = new.model.r0.x.array[: new.model.system.size].reshape(-1, 3) @ rotation_to_old.T
    new_values = np.zeros((len(new_places), 6))  # three components of each field
    # shells that touch must not be mixed
    for old_nodes, new_nodes in nodes_by_shell(old, new):
        if new_nodes.any():
            nodes_of_both_halves = np.concatenate([old_nodes, old_nodes[has_image]])
            new_values[new_nodes] = interpolated_on_surface(
                places_of_both_halves[nodes_of_both_halves],
                values[nodes_of_both_halves],
                new_places[new_nodes],
            )
    # back to the new frame
    return new_values[:, :3] @ rotation_to_old, new_values[:, 3:] @ rotation_to_old


def interpolated_on_surface(x: Array, values: Array, places: Array) -> Array:
    """Return values (n, k) on a smooth surface at places near its nodes.

    At each place a cubic polynomial in the tangent plane is fitted to the nearest nodes by least
    squares, with weights that fall with distance.

    Parameters
    ----------
    x, values
        Nodes (m, 3), and values (m, k) there.
    places
        (n, 3).
    """
    count = min(NEIGHBOURS, len(x))
    # (n, count) numbers of the nodes nearest to each place
    _, numbers = scipy.spatial.cKDTree(x).query(places, count)
    neighbours = numbers.reshape(len(places), count)
    offsets = x[neighbours] - places[:, None]
    radius = np.linalg.norm(offsets, axis=2).max(axis=1)
    centred = offsets - offsets.mean(axis=1, keepdims=True)
    # the two axes (n, 2, 3) of the tangent plane: those along which the neighbours spread most
    _, _, principal_axes = np.linalg.svd(centred, full_matrices=False)
    axes = principal_axes[:, :2]
    # coordinates (n, neighbours) of the neighbours in this plane, over the distance of the farthest
    coordinates = np.einsum("nki,nji->nkj", offsets, axes) / radius[:, None, None]
    a, b = np.moveaxis(coordinates, 2, 0)
    # the ten monomials up to degree 3, the constant first
    basis = np.stack([a**i * b**j for i in range(4) for j in range(4 - i)], axis=2)
    # at the farthest of the nodes, at distance 1, it is 0.02
    weight = np.exp(-4 * (a**2 + b**2))[..., None]
    coefficients = np.linalg.pinv(weight * basis) @ (weight * values[neighbours])
    # the constant of the polynomial is its value at the place
    return np.asarray(coefficients[:, 0])
