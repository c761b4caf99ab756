"""A point of a run, computed again with elements of one degree more on the same mesh.

It starts from the state of the run by Newton's method, without its path. At a target the
equilibrium is solved with the same load, or the same conjugate; a fold is located again; where a
mode is neutral, the eigenvalue nearest to zero and its slope along the path tell where it is.

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

from collections.abc import Callable
from dataclasses import dataclass, replace
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
from magshell_fenicsx.quantities.registry import OWN_MODES
from magshell_fenicsx.shells.waves import WaveFamily
from magshell_fenicsx.simulate.adapt.ending import at_target
from magshell_fenicsx.simulate.contact_control import with_cuts_here
from magshell_fenicsx.simulate.path_records import LOCATED
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import barrier
from magshell_fenicsx.simulate.scene import Scene, beyond_memory
from magshell_fenicsx.simulate.scene_cache import problem_on_mesh_of
from magshell_fenicsx.simulate.stage import Stage, load_stage
from magshell_fenicsx.simulate.steps import stage_of_step

Transfer = Callable[[Scene, Scene, Vector], Vector]
MAX_LOAD_CHANGE = 0.5  # over the load: an instability farther away is another one
SOLVER_ERROR = 1e-4  # of Newton's method, over the change by one degree more
SLOPE_STEP = 1e-4  # relative change of a load, for the slope of an eigenvalue along the path
ROUNDING = 1e-13  # dimensionless numbers as small as this are zero
MIN_COSINE = 0.5  # between a mode and the same mode with one degree more
OTHERS_FIRST = (
    "with one degree more other modes are unstable there: the load is off by far, as the mesh is "
    "too coarse"
)
NO_EQUILIBRIUM = "with one degree more Newton's method finds no equilibrium"


class NotEstimated(RuntimeError):
    """A result has no estimate of its error; the message says why."""


class TooCoarse(NotEstimated):
    """One degree more has no such result nearby: the mesh of the run may be too coarse."""


def refuse_no_comparison(scene: Scene, record: Record) -> None:
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
    refuse_no_comparison(source, record)
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
        more, as those of pairs of waves, the lowest mode is neutral first.

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
        # with a held conjugate the lowest mode may be one that the hold stabilises
        has_free_conjugates = stage.device is None
        if has_free_conjugates and self._others_are_first(tangent.unstable, unstable_before):
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
