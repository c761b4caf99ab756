"""Further solutions at the amplitudes of a known state, by deflation from guesses of snapped
shapes.

A guess is the shell with a part of it mirrored in a plane, as Pogorelov's dents are. The mirrored
part is an isometric copy of itself, so only the fold around it costs energy. The plane is parallel
to that of the supports; the fold is as wide as the boundary layer of a sphere, sqrt(2 h H) for a
dent of depth H.

A guess settles where its energy is let fall, until Newton's method can find an equilibrium near.
Deflation removes known solutions from the equations, so that others are found. h is the thickness,
lengths are over the reference length R. A stage is the scene with the solver of a step; `enter`
and `leave` convert states of the model to states of the step's system and back. A fold is here the
narrow bent edge of a dent.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.point import StepOptions
from magshell_fenicsx.continuation.search import (
    AcceptanceRules,
    SearchLimits,
    Settling,
    further_solutions,
)
from magshell_fenicsx.continuation.stability_monitor import unstable_count
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.parts.step_course import SearchSection
from magshell_fenicsx.quantities.registry import amplitude
from magshell_fenicsx.simulate.contact_control import before_passing, passes, with_own_contact
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage, load_stage, make_stage
from magshell_fenicsx.simulate.steps import held_conjugates_of_step
from magshell_fenicsx.simulate.transfer import nodes_of_shells

Array = NDArray[np.float64]
DEPTHS = 0.9, 0.03, 0.8, 0.2  # of the dents, over the height of the shell above its supports
FOLD_WIDTH = 0.2  # of half a fold, over sqrt(2 h H)
SUPPORT_DISTANCE = 3.0  # such widths between a fold and the supports
MIN_HEIGHT = 2.0  # shells of a smaller height, over h, are flat
ROUNDING = 1e-9  # of a component of a unit normal
# a smaller mean square distance from a plane or a line, over the largest, is zero
FLATNESS_TOLERANCE = 1e-6


def dented_states(scene: Scene, state: State) -> Iterator[State]:
    """Yield dented copies of a state of the model, as guesses of snapped shapes; collective.

    There are none of flat shells. Of several shells each is dented alone, then all are.
    """
    system = scene.model.system
    # deformed places of this rank's nodes
    places = (scene.model.r0.x.array[: system.size] + state.u).reshape(-1, scene.model.V.dofmap.bs)
    h = scene.problem.material.h
    shells = [CurvedShell.of_nodes(scene, places, is_own) for is_own in nodes_of_shells(scene)]
    curved_shells = [shell for shell in shells if shell.top > MIN_HEIGHT * h]
    for depth in DEPTHS:
        dents = [shell.dent(depth, h) for shell in curved_shells]  # displacements
        all_at_once = [np.sum(dents, axis=0)] if len(dents) > 1 else []
        for dent in [*dents, *all_at_once]:
            yield State(state.u + system.zero_at_supports(dent.ravel()), dict(state.mu))


@dataclass(frozen=True)
class CurvedShell:
    """A shell above the plane of its supports.

    Attributes
    ----------
    is_own
        (n,), whether a node of this rank belongs to the shell.
    normal
        Unit normal of the plane.
    height
        (n,), heights of nodes along the normal, over R.
    top
        The largest height of all ranks.
    """

    is_own: NDArray[np.bool_]
    normal: Array
    height: Array
    top: float

    @classmethod
    def of_nodes(cls, scene: Scene, x: Array, is_own: NDArray[np.bool_]) -> "CurvedShell":
        """Return the shell of some of this rank's nodes; collective.

        Its normal points to the side on which most of it is.

        Parameters
        ----------
        x
            Places (n, 2 or 3) of this rank's nodes, over R.
        is_own
            (n,), whether a node belongs to the shell.
        """
        comm = scene.model.system.comm
        normal, level = _plane(scene, x, is_own)
        height = x @ normal - level
        top = float(comm.allreduce(float(height[is_own].max(initial=0.0)), MPI.MAX))
        bottom = float(comm.allreduce(float(height[is_own].min(initial=0.0)), MPI.MIN))
        if -bottom > top:  # it hangs down: the normal is reversed
            return cls(is_own, -normal, -height, -bottom)
        return cls(is_own, normal, height, top)

    def dent(self, depth: float, h: float) -> Array:
        """Return the displacement (n, 2 or 3) of a dent: the top is mirrored in a plane below it.

        Parameters
        ----------
        depth
            Depth of the dent over the shell's height.
        h
            The thickness over R.
        """
        width = FOLD_WIDTH * np.sqrt(2 * h * depth * self.top)
        # a fold at the supports could not bend; shallow shells have it half way up
        lowest_plane = min(SUPPORT_DISTANCE * width, self.top / 2)
        height_above = self.height - max((1 - depth) * self.top, lowest_plane)  # above the plane
        # A mirrored point moves by twice its height above the plane. Instead of max(0, height) the
        # smooth function width log(1 + exp(height/width)) is taken, so that the fold is rounded.
        displacement_along_normal = np.where(
            self.is_own, -2 * width * np.logaddexp(0.0, height_above / width), 0.0
        )
        return np.outer(displacement_along_normal, self.normal)


def _plane(scene: Scene, x: Array, is_own: NDArray[np.bool_]) -> tuple[Array, float]:
    """Return the unit normal of the plane of the supports, and its distance from the origin.

    It is the plane with the least mean square distance from the supports, whose normal is the
    eigenvector of the covariance with the least eigenvalue. If the supports are on a line or are
    none, the plane through them that is nearest to the whole shell is taken. Collective.

    Parameters
    ----------
    x
        Places (n, 2 or 3) of this rank's nodes.
    is_own
        (n,), whether a node belongs to the shell.
    """
    # nodes of the shell's supports
    is_held = np.zeros(len(x), dtype=bool)
    for support in scene.model.supports.values():
        own_dofs = support.dofs[support.dofs < x.size]
        is_held[own_dofs // x.shape[1]] = True
    is_held &= is_own
    if scene.model.axisymmetric:  # the plane is across the axis
        mean_height = float(x[is_held, 1].mean()) if is_held.any() else 0.0
        return np.array([0.0, 1.0]), mean_height
    centre, covariance = _moments(scene, x[is_held])
    variances, axes = np.linalg.eigh(covariance)
    # variances ascend. If only the last one is not zero, the supports are on a line along its axis
    if variances[1] <= FLATNESS_TOLERANCE * variances[2]:
        _, covariance = _moments(scene, x[is_own])
        # projection on the line; zero for a single point, which gives no direction
        along_line = np.outer(axes[:, 2], axes[:, 2]) if variances[2] > 0 else np.zeros((3, 3))
        across_line = np.eye(3) - along_line
        # The covariance of the shell is taken across the line, with a large eigenvalue along it. So
        # the eigenvector with the least eigenvalue is across the line.
        variances, axes = np.linalg.eigh(
            across_line @ covariance @ across_line + along_line * np.trace(covariance)
        )
    normal = np.where(np.abs(axes[:, 0]) < ROUNDING, 0.0, axes[:, 0])
    # the largest component is positive, so that the sense does not depend on rounding
    normal /= np.linalg.norm(normal) * np.sign(normal[np.argmax(np.abs(normal))])
    return normal, float(centre @ normal)


def _moments(scene: Scene, x: Array) -> tuple[Array, Array]:
    """Return the mean (3,) and the covariance (3, 3) of places of all ranks; collective.

    For a half or a sector the images of the places count too.

    Parameters
    ----------
    x
        Places (n, 3) of this rank.
    """
    comm, mirror = scene.model.system.comm, scene.problem.mirror
    if mirror:
        x = mirror.with_images(x)
    count = max(comm.allreduce(len(x)), 1)  # without places both are zero
    mean = comm.allreduce(x.sum(axis=0)) / count
    return mean, comm.allreduce((x - mean).T @ (x - mean)) / count


def search_at_end_of_step(
    scene: Scene, step: ProgrammeStep, begin: State, end: State
) -> Iterator[Record]:
    """Yield records of the solutions that the search of a step finds at its end; collective.

    Without a search in the step there are none.

    Parameters
    ----------
    begin, end
        The states at both ends of the step.
    """
    if step.load.search:
        held_conjugates = held_conjugates_of_step(scene, step, begin)
        stage = make_stage(scene, end, held_conjugates)
        # a step that turns the field has an angle, which is no amplitude of the state
        name = step.name if step.name in end.mu else amplitude(step.name).turned_load
        for record in _solutions(stage, name, end, step.load.search):
            yield replace(record, amplitude=step.name)


def solutions(
    scene: Scene,
    start: Record | State,
    *,
    most: int = 3,
    guesses: int = 12,
    stable: bool = False,
    seconds: float | None = None,
) -> Iterator[Record]:
    """Find further equilibria at the amplitudes of a record or a state; see `Record.solutions`.

    Raises
    ------
    ValueError
        If the state is of another scene.
    Stopped
        If the known state is no equilibrium.
    """
    state = start.point.state if isinstance(start, Record) else start
    scene.refuse_foreign(state)
    name = (
        start.amplitude
        if isinstance(start, Record) and start.amplitude in state.mu
        else next(iter(state.mu))
    )
    outcome = scene.newton.solve(state, name, PrescribedLoad(name, state.mu[name]))
    if not outcome.converged:
        raise Stopped(
            f"there is no equilibrium to start from near the given state: {outcome.reason}"
        )
    search = SearchSection(solutions=most, guesses=guesses, stable=stable, seconds=seconds)
    for record in _solutions(load_stage(scene), name, outcome.state, search):
        yield record.with_scene(scene)


def _solutions(stage: Stage, name: str, state: State, search: SearchSection) -> Iterator[Record]:
    """Yield the records of the solutions that a search finds from a state of the model; collective.

    Parameters
    ----------
    stage
        Scene with the solver of the step.
    name
        Amplitude of the step.
    search
        Limits of the search.
    """
    scene, start = stage.scene, time.perf_counter()
    dents = _Dents(stage, state)

    def is_over() -> bool:
        """Return whether the time of the search is over, by the clock of rank 0; collective."""
        is_late = search.seconds is not None and time.perf_counter() - start > search.seconds
        return bool(scene.comm.bcast(is_late))

    # The path corrects states at the present amplitude. No steps are taken along it.
    path = stage.path(name, "load", StepOptions(1.0, 1.0, 1.0))
    guesses = [partial(dents.settled, number) for number in range(dents.count)]
    limits = SearchLimits(search.solutions, search.guesses, is_over)
    excluded_modes = scene.model.symmetry_breaking_modes
    descend_to_stable = dents.descended if search.stable else None
    solutions_found = further_solutions(
        path,
        stage.enter(state),
        guesses,
        limits,
        displacement=stage.displaced,
        descend=descend_to_stable,
        rules=_rules(stage),
    )
    for number, solution in enumerate(solutions_found, 1):
        point = stage.point(solution)
        unstable = unstable_count(excluded_modes, point.state)
        yield Record("solution", name, point, branch=number, excluded_pivots=unstable)


def _rules(stage: Stage) -> AcceptanceRules:
    """Return the rules by which a search accepts solutions.

    Where shells may touch, a solution must have the penalties and cuts (quadrature of contact) that
    fit its own displacement, and no shell may pass through another on the straight way to it.
    """
    scene = stage.scene
    if not scene.model.shell_contacts:
        return AcceptanceRules()

    def with_fit_contact(state: State) -> State | None:
        """Return a state of the stage with the contact settings it needs; None if it has them."""
        changed = with_own_contact(scene, stage.leave(state))
        return State(state.u, {**state.mu, **changed.mu}) if changed else None

    return AcceptanceRules(partial(passes, stage), with_fit_contact)


class _Dents:
    """Dented shells that have settled, as states of a stage.

    Parameters
    ----------
    state
        State of the model that is dented.

    Attributes
    ----------
    count
        Number of dented shells.
    _stage, _state
        The parameters.
    _guesses
        Dented shells before they settle, as states of the model.
    """

    def __init__(self, stage: Stage, state: State) -> None:
        self._stage, self._state = stage, state
        self._guesses = list(dented_states(stage.scene, state))
        self.count = len(self._guesses)

    @cached_property
    def _settling(self) -> Settling:
        """How dented shells settle in energy, without passing through each other."""
        scene = self._stage.scene
        return Settling(scene.model.system, scene.unloaded(), partial(passes, load_stage(scene)))

    def settled(self, number: int) -> State:
        """Return a dented shell that has settled, as a state of the stage; collective.

        Parameters
        ----------
        number
            Number of the dented shell, from 0.
        """
        guess = before_passing(load_stage(self._stage.scene), self._state, self._guesses[number])
        return self._stage.enter(self._settling.settled(guess))

    def descended(self, state: State) -> State:
        """Return a state of the stage with less energy, reached from another one; collective.

        Amplitudes whose conjugates are held stay.
        """
        return self._stage.enter(self._settling.settled(self._stage.leave(state)))
