"""Errors of the discretisation in the results of a run, by one degree more on the same mesh.

A result is computed again with elements of one degree more, from the state of the run by Newton's
method, without its path. The change of the result, times `SAFETY`, estimates its error. At a target
the equilibrium is solved with the same load, or the same conjugate; a fold is located again; where
a mode is neutral, the eigenvalue nearest to zero and its slope along the path tell where it is.

Words and symbols:

- The fine scene has the mesh of the coarse one, that of the run, and one degree more. Each field of
  the coarse scene is one of the fine scene: to raise its degree is exact.
- An amplitude mu is a load parameter; its conjugate -dPi/dmu is the displacement on which it does
  work. What a step holds or prescribes keeps its value.
- A stage is a scene with the solver of one step; `enter` and `leave` convert states of the model to
  states of the step's system and back.
- A located record is a fold or a bifurcation. A family has modes that share a tangent; a model with
  symmetry excludes families of modes.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import isfinite

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.continuation.control import (
    ConstraintRow,
    PrescribedConjugate,
    PrescribedLoad,
)
from magshell_fenicsx.continuation.fold import (
    AugmentedTangent,
    first_difference,
    fold_by_one_step,
    held_along,
    third_derivative,
)
from magshell_fenicsx.continuation.modes import (
    critical_mode,
    lowest_mode,
    nearest_to_zero,
)
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.stability_monitor import ModeFamily
from magshell_fenicsx.continuation.system import State, System, Vector, dot, symmetric_part
from magshell_fenicsx.models.shell.antisymmetric import AntisymmetricModes
from magshell_fenicsx.quantities.registry import AMPLITUDES, OWN_MODES, amplitude
from magshell_fenicsx.shells.modes import ShellMode, ShellModes, mode_space
from magshell_fenicsx.shells.waves import WaveFamily
from magshell_fenicsx.simulate.adapt.ending import History, at_target
from magshell_fenicsx.simulate.contact_control import with_cuts_here
from magshell_fenicsx.simulate.path_records import LOCATED
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import barrier
from magshell_fenicsx.simulate.scene import Scene, beyond_memory
from magshell_fenicsx.simulate.scene_cache import problem_on_mesh_of
from magshell_fenicsx.simulate.stage import Stage, load_stage
from magshell_fenicsx.simulate.steps import stage_of_step

SAFETY = 1.25  # factor of the change by one degree more, for the error
Transfer = Callable[[Scene, Scene, Vector], Vector]
MAX_LOAD_CHANGE = 0.5  # over the load: an instability farther away is another one
SOLVER_ERROR = 1e-4  # of Newton's method, over the change by one degree more
SLOPE_STEP = 1e-4  # relative change of a load, for the slope of an eigenvalue along the path
ROUNDING = 1e-13  # dimensionless numbers as small as this are zero
FURTHER_MODES = 2  # that are computed with one degree more, as their order may differ
MIN_COSINE = 0.5  # between a mode and the same mode with one degree more
LATER = "limit_load_"  # before the number of an instability after the first
LATER_TAKE_LONG = "this and later instabilities have no estimate, as it would take long"
MOST_INSTABILITIES = 4  # of a path on a meridian, whose errors are estimated
OTHERS_FIRST = (
    "with one degree more other modes are unstable there: the load is off by far, as the mesh is "
    "too coarse"
)
NO_EQUILIBRIUM = "with one degree more Newton's method finds no equilibrium"


class NotEstimated(RuntimeError):
    """A result has no estimate of its error; the message says why."""


class TooCoarse(NotEstimated):
    """One degree more has no such result nearby: the mesh of the run may be too coarse."""


@dataclass
class ErrorEstimates:
    """Estimated errors of the results of a run.

    Attributes
    ----------
    errors
        Name of a result -> its estimated absolute error. Names: "knockdown", "critical_field",
        "limit_load" (the first value of `limit_points` in summary.json), "limit_load_2" and so on
        for later ones that are not on a branch, and "barrier"; at the last point COLUMN@end of
        columns of path.csv, and "omega2_1", "omega2_2" and so on.
    reasons
        Name of a result, "end" for all at the last point -> why it has no estimate.
    too_coarse
        Those of these names for which the mesh may be too coarse, without later instabilities.
    """

    errors: dict[str, float] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    too_coarse: list[str] = field(default_factory=list)

    @contextmanager
    def naming(self, *names: str) -> Iterator[None]:
        """Note the reason for some results where their estimate fails inside `with`."""
        try:
            yield
        except NotEstimated as e:
            self.reasons |= dict.fromkeys(names, str(e))
            if isinstance(e, TooCoarse):
                self.too_coarse += [name for name in names if not name.startswith(LATER)]
        except Exception as e:  # whatever it is: the run has its results, and the summary names it
            self.reasons |= dict.fromkeys(names, f"{type(e).__name__}: {e}".rstrip(": "))


class FineScenes:
    """Fine scenes of the scenes of a run, and the comparisons at its records, each made once.

    Parameters
    ----------
    check
        Called before each of them, on all ranks; it raises `NotEstimated` to end the estimate.
    """

    def __init__(self, check: Callable[[], None] = lambda: None) -> None:
        self._check = check
        self._scenes = dict[int, Scene]()
        self._comparisons = dict[int, DegreeComparison]()

    def comparison(
        self, first_scene: Scene, record: Record, *, is_later: bool = False
    ) -> "DegreeComparison":
        """Return the comparison at a record, whose state is computed; collective.

        `is_later` tells that the record is an instability after another one.

        Raises
        ------
        NotEstimated, CaseError, MeshError
            If there is none; and other errors if the state is not found.
        """
        if id(record) not in self._comparisons:
            scene = record.scene or first_scene
            _refuse(scene, record)
            self._check()
            if id(scene) not in self._scenes:
                self._scenes[id(scene)] = fine_scene(scene)
                self._check()
            comparison = DegreeComparison(scene, self._scenes[id(scene)], record, is_later)
            _ = comparison.state
            self._comparisons[id(record)] = comparison
        return self._comparisons[id(record)]

    def clear(self) -> None:
        """Let go of all scenes and comparisons, which take memory."""
        self._scenes.clear()
        self._comparisons.clear()


def estimate_errors(
    scene: Scene, history: History, fine_scenes: FineScenes, *, has_stopped: bool = False
) -> ErrorEstimates:
    """Return the estimated errors of the results of a run; collective.

    Parameters
    ----------
    scene
        The first scene of the run.
    history
        The records of the run.
    fine_scenes
        Scenes with one degree more, to which those of the run are added.
    has_stopped
        Whether the run stopped before its end: then only instabilities are results.
    """
    estimates, end = ErrorEstimates(), history.end

    def comparison(record: Record) -> DegreeComparison:
        """Return the comparison at a record."""
        is_later = record.label in LOCATED and record is not history.located[0]
        return fine_scenes.comparison(scene, record, is_later=is_later)

    for record, columns in _instabilities(scene, history):
        with estimates.naming(*columns):
            changes = comparison(record).changes
            estimates.errors |= {
                name: _estimated(changes.get(column, 0.0), record.point.load_error)
                for name, column in columns.items()
            }
    if len(history.located) > (count := _estimated_count(scene)):
        estimates.reasons[f"{LATER}{count + 1}"] = LATER_TAKE_LONG
    if has_stopped:
        estimates.reasons["end"] = "the run stopped early"
        return estimates
    if end and end.amplitude:
        with estimates.naming("end"):
            changes = comparison(end).changes
            estimates.errors |= {
                f"{column}@end": _estimated(change) for column, change in changes.items() if change
            }
    steps = scene.problem.programme
    if steps and steps[-1].until == "zero" and history.begin and history.last:
        with estimates.naming("barrier"):
            begin, last = (comparison(record) for record in (history.begin, history.last))
            if begin.fine is not last.fine:
                raise NotEstimated("the step begins in another model")
            change = last.barrier_from(begin)
            estimates.errors["barrier"] = _estimated(change)
    return estimates


def frequency_errors(
    scene: Scene, record: Record, modes: Sequence[ShellMode], fine_scenes: FineScenes
) -> dict[str, float]:
    """Return name -> estimated error of the natural modes at a record, "omega2_1", ...; collective.

    A mode is compared with the mode of the same label and rank.

    Parameters
    ----------
    scene
        Scene of the record.
    modes
        Natural modes there, in ascending order.
    fine_scenes
        Scenes with one degree more, to which that of the record is added.

    Raises
    ------
    NotEstimated
        If they cannot be compared; and other errors if the state or the modes are not found.
    """
    if scene.model.contacts or scene.model.shell_contacts:
        raise NotEstimated("frequencies depend on the stiffness of contacts")
    comparison = fine_scenes.comparison(scene, record)
    space = mode_space(comparison.fine.model)
    fine_modes = ShellModes(space.model).vibrations(
        space.state(comparison.state),
        len(modes) + FURTHER_MODES,
        allows_rigid_motion=scene.allows_rigid_motion,
    )
    errors, ranks = dict[str, float](), Counter[str]()
    for number, mode in enumerate(modes, 1):
        of_label = [other.eigenvalue for other in fine_modes if other.label == mode.label]
        if mode.eigenvalue and ranks[mode.label] < len(of_label):  # zero of a rigid motion is exact
            change = of_label[ranks[mode.label]] - mode.eigenvalue
            errors[f"omega2_{number}"] = _estimated(change)
        ranks[mode.label] += 1
    return errors


def _estimated(change: float, load_error: float = 0.0) -> float:
    """Return the error of a number that one degree more changes, with that of the solver."""
    return float(SAFETY * abs(change) + load_error)


def _estimated_count(scene: Scene) -> int:
    """Return of how many instabilities errors are estimated; on a meridian that is quick."""
    return MOST_INSTABILITIES if scene.problem.axisymmetric else 1


def _instabilities(scene: Scene, history: History) -> list[tuple[Record, dict[str, str]]]:
    """Return instabilities of a path, each with name of the result -> its column.

    They are those that are results, and the first ones of the path. All but the very first have the
    name `LATER` with their number.
    """
    columns_of = dict[int, dict[str, str]]()
    steps_with_held_conjugate = {
        step.number for step in scene.problem.programme if step.name in step.load.hold
    }
    # name of a result -> the load that has it; "" for any load
    load_of_result = {a.critical_names[0]: a.name for a in AMPLITUDES.values() if a.critical_names}
    for name, mu in {**load_of_result, "limit_load": ""}.items():
        for number, record in enumerate(history.located):
            at_held_volume = name == "knockdown" and record.step in steps_with_held_conjugate
            if mu in ("", record.amplitude) and not at_held_volume:
                column = amplitude(record.amplitude).column
                columns_of.setdefault(number, {})[name] = column
                break
    for number, record in enumerate(history.located[1 : _estimated_count(scene)], 1):
        column = amplitude(record.amplitude).column
        columns_of.setdefault(number, {})[f"{LATER}{number + 1}"] = column
    return [(history.located[number], columns) for number, columns in sorted(columns_of.items())]


def _refuse(scene: Scene, record: Record) -> None:
    """Check that the state of a record can be computed with one degree more.

    Raises
    ------
    NotEstimated
        If it cannot.
    """
    problem = scene.problem
    if problem.body:
        raise NotEstimated("a solid has one degree alone; mesh.tolerance estimates its error")
    if record.amplitude == "time":
        raise NotEstimated("the state depends on a motion before it")
    if problem.loads.interaction:
        raise NotEstimated("the field of the shell's own magnets takes too long")
    step = problem.programme[record.step - 1] if record.step else None
    if step and step.name in step.load.hold:
        raise NotEstimated("the conjugate of its load is held")


def fine_scene(scene: Scene) -> Scene:
    """Return the scene on the same mesh with one degree more; collective.

    Raises
    ------
    CaseError
        If both do not fit into memory together.
    NotEstimated
        If they come near the memory, or the cells of the mesh are in another order.
    """
    problem, degree = problem_on_mesh_of(scene, scene.problem), scene.model.degree
    mesh = problem.mesh.model_copy(update={"degree": degree + 1})
    # those of both scenes, which are in memory at once
    unknowns = problem.unknowns * (1 + ((degree + 1) / degree) ** 2)
    fine_problem = replace(problem, mesh=mesh, unknowns=unknowns)
    if warning := beyond_memory(fine_problem, scene.comm):
        raise NotEstimated(warning)
    fine_scene_of_run = Scene(fine_problem, scene.comm)
    cells, fine_cells = (
        s.model.V.mesh.topology.original_cell_index for s in (scene, fine_scene_of_run)
    )
    if not scene.comm.allreduce(np.array_equal(cells, fine_cells), MPI.LAND):
        raise NotEstimated("the cells of the mesh are in another order")
    return fine_scene_of_run


def with_higher_degree(source: Scene, target: Scene, u: Vector) -> Vector:
    """Return a displacement of a scene in the unknowns of its fine scene; collective.

    It is zero at supports.
    """
    V, W = source.model.V, target.model.V
    # in each cell: the polynomials of the source at the nodes of the target
    nodes = W.element.basix_element.points
    table = V.element.basix_element.tabulate(0, nodes)[0, :, :, 0]
    values = source.model.system.with_ghosts(u).reshape(-1, V.dofmap.bs)[V.dofmap.list]
    fine_values = np.zeros(
        (W.dofmap.index_map.size_local + W.dofmap.index_map.num_ghosts, W.dofmap.bs)
    )
    fine_values[W.dofmap.list] = np.einsum("qp,npc->nqc", table, values)
    return target.model.system.zero_at_supports(fine_values.ravel()[: target.model.system.size])


def state_on_other_mesh(
    source: Scene, target: Scene, record: Record, transferred: Transfer
) -> State:
    """Return the state of a scene at a point like that of another scene; collective.

    Parameters
    ----------
    source, target
        Scene of the point, and the scene of the result.
    record
        The point.
    transferred
        Function that returns a displacement of `source` in the unknowns of `target`.

    Raises
    ------
    NotEstimated, FoldLost, NoEigenpair, LinAlgError
        If there is none nearby.
    """
    _refuse(source, record)
    return DegreeComparison(source, target, record, transferred=transferred).state


@dataclass(frozen=True)
class DegreeComparison:
    """A point of a run, and the same point with one degree more.

    Attributes
    ----------
    scene, fine
        The scene of the point, and its fine scene.
    record
        The point.
    is_later
        Whether it is an instability after another one.
    transferred
        Function that returns a displacement of `scene` in the unknowns of `fine`.
    """

    scene: Scene
    fine: Scene
    record: Record
    is_later: bool = False
    transferred: Transfer = with_higher_degree

    @cached_property
    def changes(self) -> dict[str, float]:
        """Column of path.csv -> its change by one degree more; collective.

        Columns in units are among them.

        Raises
        ------
        NotEstimated, FoldLost, NoEigenpair, LinAlgError
            If the point is not found with one degree more.
        """
        row = self.scene.observe(self.record.point.state)
        fine_row = self.fine.observe(self.state)
        changes = {
            column: fine_row[column] - value
            for column, value in row.items()
            if isfinite(value + fine_row[column])
            and max(abs(value), abs(fine_row[column])) > ROUNDING
        }
        return changes | self.scene.sizes.values(changes)

    def barrier_from(self, begin: "DegreeComparison") -> float:
        """Return the change of the barrier of the last step, by one degree more; collective.

        Parameters
        ----------
        begin
            The comparison where the step begins.
        """
        step = self.scene.problem.programme[self.record.step - 1]
        states = begin.record.point.state, self.record.point.state
        barrier_of_run = barrier(self.scene, step, *states)
        return barrier(self.fine, step, begin.state, self.state) - barrier_of_run

    @cached_property
    def state(self) -> State:
        """State of the fine scene at the point; collective."""
        if not self.record.amplitude:  # the undeformed shell
            return State(self.fine.model.zero(), dict(self.record.point.state.mu))
        if self.record.label not in LOCATED:
            stage, state, _ = self._equilibrium()
            return stage.leave(state)
        if self.record.mode in OWN_MODES:
            return self._fold() if self.record.label == "fold" else self._own_bifurcation()
        return self._excluded_bifurcation()

    def _stage(self) -> tuple[Stage, State]:
        """Return the stage of the record's step on the fine scene, and the state as a guess.

        What the step holds has the value of the record.
        """
        fine_scene, record = self.fine, self.record
        u = self.transferred(self.scene, fine_scene, record.point.state.u)
        # cuts belong to the mesh and the degree
        guess = with_cuts_here(fine_scene, State(u, dict(record.point.state.mu)))
        stage = load_stage(fine_scene)
        if record.step:
            stage = stage_of_step(fine_scene, fine_scene.problem.programme[record.step - 1], guess)
        return stage, stage.enter(guess)

    def _equilibrium(self) -> tuple[Stage, State, ConstraintRow]:
        """Return stage and state of the equilibrium near the record, and what is prescribed there.

        Raises
        ------
        NotEstimated
            If Newton's method finds none.
        """
        stage, guess = self._stage()
        name, by_conjugate = self.record.amplitude, False
        if self.record.step and self.record.label not in LOCATED:
            end = at_target(self.scene, self.record)
            is_unloaded = self.fine.problem.programme[self.record.step - 1].until == "zero"
            name, by_conjugate = end.name, end.held is not None and not is_unloaded
        system = stage.newton.system
        row: ConstraintRow = PrescribedLoad(name, guess.mu[name])
        if by_conjugate:
            held_value = -system.potential(guess.u, guess.mu, name)
            row = PrescribedConjugate(system, name, held_value)
        outcome = stage.newton.solve_roughly(guess, name, row, SOLVER_ERROR)
        if not outcome.converged:
            raise TooCoarse(f"with one degree more: {outcome.reason}")
        return stage, outcome.state, row

    def _fold(self) -> State:
        """Return the state at the fold near the record."""
        stage, guess = self._stage()
        du = self.transferred(self.scene, self.fine, self.record.point.du)
        phi = stage.padded(du)
        name = self.record.amplitude
        state, fine_phi, unstable = fold_by_one_step(stage.newton, guess, phi, name)
        system = stage.newton.system
        if not _imbalance(system, state) < _imbalance(system, guess):
            raise TooCoarse(NO_EQUILIBRIUM)
        _refuse_other_mode(stage, phi, fine_phi)
        self._refuse_later(unstable, self.record.point.negative_pivots)
        return stage.leave(state)

    def _own_bifurcation(self) -> State:
        """Return the state where a mode of the model itself is neutral, near the record.

        A force along the mode b holds the displacement along b near the point, so that the tangent
        stays regular. The mode is neutral where K v + g b = 0, b . v = 1 gives g = 0: one step of
        Newton's method along the path goes there. Where other modes are unstable with one degree
        more, as the other one of a pair, the lowest mode is neutral first.

        Raises
        ------
        NotEstimated
            If the load changes along the branch, or no neutral mode is nearby.
        """
        if self.record.mode == "asymmetric":
            raise NotEstimated("a bifurcation at which the load changes along the branch")
        stage, guess = self._stage()
        newton, name = stage.newton, self.record.amplitude
        system, unstable_before = newton.system, self.record.point.negative_pivots
        state, tangent = _held_along_mode(newton, guess, critical_mode(newton, guess).vector)
        if self._others_are_first(tangent.unstable, unstable_before):
            lowest = lowest_mode(system.tangent(state.u, state.mu))
            state, tangent = _held_along_mode(newton, state, lowest)
        else:
            self._refuse_later(tangent.unstable, unstable_before)
        w_mu, _ = tangent.solve(system.load(state.u, state.mu, name))
        cubic = third_derivative(system, state, tangent.v)
        K_mu_v = first_difference(
            lambda u: system.load(u, state.mu, name), system, state.u, tangent.v
        )
        slope = dot(system.comm, cubic, w_mu) - dot(system.comm, tangent.v, K_mu_v)
        dmu = _load_change(-tangent.g, slope, state.mu[name])
        return stage.leave(state.with_(state.u - dmu * w_mu, name, state.mu[name] + dmu))

    def _excluded_bifurcation(self) -> State:
        """Return the state where a mode that the model excludes is neutral, near the record.

        Raises
        ------
        NotEstimated
            If the modes have no tangent of their own, or none is neutral nearby.
        """
        stage, state, row = self._equilibrium()
        name, mu = self.record.amplitude, state.mu[self.record.amplitude]
        response = stage.newton.response(state, name, row)
        family = _family(self.fine, self.record.mode)
        factors = family.factor_at(stage.leave(state))
        eigenvalue, v = nearest_to_zero(factors)
        self._refuse_later(factors.negative_pivots - (eigenvalue < 0), self.record.excluded_pivots)

        def state_further_along(dmu: float) -> State:
            """Return the state of the model further along the path."""
            return stage.leave(state.with_(state.u + dmu * response.du, name, mu + dmu))

        step = SLOPE_STEP * (abs(mu) or 1.0)
        product = _tangent_times(family, state_further_along(step), v)
        slope = (dot(self.fine.comm, v, product) - eigenvalue) / step
        return state_further_along(_load_change(-eigenvalue, slope, mu))

    def _refuse_later(self, unstable: int, unstable_before: int) -> None:
        """Check that no other modes are unstable at an instability with one degree more.

        Parameters
        ----------
        unstable, unstable_before
            Number of other unstable directions with one degree more, and of all at the record, with
            or without the neutral one: a first instability has 0 or 1.

        Raises
        ------
        NotEstimated
            If there are more.
        """
        if unstable > unstable_before or self._others_are_first(unstable, unstable_before):
            raise TooCoarse(OTHERS_FIRST)

    def _others_are_first(self, unstable: int, unstable_before: int) -> bool:
        """Return whether other modes are unstable at a first instability, with one degree more.

        Parameters are those of `_refuse_later`.
        """
        return not self.is_later and unstable_before <= 1 <= unstable


def _held_along_mode(
    newton: BorderedNewton, guess: State, b: Vector
) -> tuple[State, AugmentedTangent]:
    """Return the equilibrium with a force along a mode, and its tangent; collective.

    Raises
    ------
    TooCoarse
        If Newton's method finds none.
    """
    held_state = held_along(newton, guess, b)
    if held_state is None:
        raise TooCoarse(NO_EQUILIBRIUM)
    return held_state[0], AugmentedTangent(newton, held_state[0], b)


def _load_change(eigenvalue_change: float, slope: float, load: float) -> float:
    """Return the change of a load that changes an eigenvalue by a given amount.

    Parameters
    ----------
    slope
        Derivative of the eigenvalue by the load, along the path.
    load
        The load, which sets what is nearby.

    Raises
    ------
    TooCoarse
        If the change is large, or the eigenvalue does not depend on the load.
    """
    largest_change = MAX_LOAD_CHANGE * (abs(load) or 1.0)
    if not abs(eigenvalue_change) < largest_change * abs(slope):
        raise TooCoarse("with one degree more no mode is neutral nearby")
    return eigenvalue_change / slope


def _imbalance(system: System, state: State) -> float:
    """Return the square of the residual's length; collective."""
    residual = system.residual(state.u, state.mu)
    return dot(system.comm, residual, residual)


def _refuse_other_mode(stage: Stage, phi: Vector, fine_phi: Vector) -> None:
    """Check that a mode is the same with one degree more; collective.

    Raises
    ------
    NotEstimated
        If the two are far from parallel.
    """
    u, v = (stage.displacement(x) for x in (phi, fine_phi))
    comm = stage.scene.comm
    if dot(comm, u, v) ** 2 < MIN_COSINE**2 * dot(comm, u, u) * dot(comm, v, v):
        raise TooCoarse("with one degree more the instability nearby has another mode")


def _family(scene: Scene, label: str) -> ModeFamily:
    """Return the family of modes with a label that a model excludes.

    Raises
    ------
    NotEstimated
        If the model has none.
    """
    modes = scene.model.symmetry_breaking_modes
    families = modes.families if modes else ()
    family = next((item for item in families if item.label == label), None)
    if family is None:
        raise NotEstimated(f"the model has no tangent of its modes {label}")
    return family


def _tangent_times(family: ModeFamily, state: State, v: Vector) -> Vector:
    """Return the tangent of a family at a state, times a vector; collective."""
    if isinstance(family, WaveFamily):
        K = family.waves.tangent(state, family.m)
    else:
        assert isinstance(family, AntisymmetricModes)
        K = symmetric_part(family.system.tangent(state.u, state.mu))
    x, y = K.createVecs()
    x.setArray(v)
    K.mult(x, y)
    return np.array(y.array_r)
