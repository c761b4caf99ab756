"""Contact control along a path: first contact, penalties, cuts, and ways that contact forbids.

A body approaches until it touches first. Penalties become stiffer where something penetrates too
much, and shells are cut anew where their points of contact have slid. No shell may pass through
another one, and no body may go back the way it came. docs/theory.md has the penalty.

Words and symbols:

- A penalty is an energy of penetration, with a stiffness. A contact is one body against the shell
  (`contact.amplitude` is the approach of the body, over h), or a `Pair` of shells that may touch.
- Cuts divide cells of shells that touch into segments, each with quadrature points of its own and
  opposite to one other cell. Each set of cuts has a number.
- A setting is an entry of `State.mu` that is no load: the present stiffness of a contact
  (`contact.setting`, `pair.setting`) or the number of a pair's cuts (`pair.cuts`). Functions that
  change contact return setting -> new value, and the caller solves again.
- A bound is `max_penetration`, the largest penetration that a contact is meant to have.
- Points `low` and `high` are two successive points of a path, the earlier one first. Their states
  are those of the stage, the scene with the solver of a step; `stage.leave` gives the model's.
- h and R are thickness and reference length.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from math import inf

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.modes import NoEigenpair, critical_mode
from magshell_fenicsx.continuation.point import PathStopped, Point, StepTooLong
from magshell_fenicsx.continuation.system import State, max_abs
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.bodies.body_contact import ContactBody
from magshell_fenicsx.parts.contact.contact_section import Pair
from magshell_fenicsx.parts.contact.meridian_contact import MeridianContact
from magshell_fenicsx.parts.contact.surface_contact import SurfaceContact
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.simulate.contact_onset import CONTACT_DEPTH, gathered_displacement
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage

# of h: how far past the first contact the path begins, the first try first
FIRST_CONTACT_DEPTHS = tuple(CONTACT_DEPTH / 4**i for i in range(7))
GAP_TOLERANCE = 1e-7  # of h: a smaller gap is none
MAX_APPROACHES = 1000  # approaches by the least gap
RETURN_DISTANCE = 0.1  # of h: how far a path that returns is from its turn
RETURN_TOLERANCE = 0.02  # of that: how far it is from the way there
STIFFENING = 4.0  # how much stiffer a contact becomes at once
MAX_STIFFENING = 1e4  # how much stiffer a body becomes at most
# how much stiffer a shell becomes at most: the point of a corner has a small weight
MAX_STIFFENING_OF_SHELLS = 1e6
# of the bound, at points: between them, with other cuts, shells may be deeper
BOUND_AT_POINTS = 0.75
# of a critical mode's stiffness: what closer points of contact may change of it
CERTAIN_STIFFNESS_CHANGE = 0.5
HALVINGS_BEFORE_PASSING = 8  # halvings of a way on which shells would pass through each other
# of h: the penetration that shells which hit each other flat are meant to have
IMPACT_PENETRATION = 0.03
IMPACT_BOUND_RATIO = 100.0  # times the bound: a penetration that lasts for a moment
SAMPLES_OF_MOTION = 65  # places of supports on their way at which shells are compared
HALVINGS_OF_MOTION = 30  # halvings of the part of the way in which shells meet
RIGID_RATIO = 2.0  # displacement over penetration below which a body is rigid enough
MAX_DISPLACEMENT = 0.05  # of h: farther from it, an equilibrium is another one
MAX_STIFFENINGS = 4  # times that bodies become stiffer


def state_at_first_contact(scene: Scene, step: ProgrammeStep, state: State) -> State:
    """Return the state just after the body of a step first touches the shell; collective.

    The given state returns if the body touches already. If the step's target is nearer than the
    first contact, the state has the body at the target.

    Parameters
    ----------
    step
        Step whose amplitude is the approach of a body, over h.

    Raises
    ------
    Stopped
        If the body never meets the shell, or the first contact has no equilibrium.
    """
    name, h = step.name, scene.problem.material.h
    # the target is a pair: what it prescribes, and the value
    target = step.load.target or step.load.limit_target
    end_of_approach = target[1] if target and target[0].quantity == "load" else inf
    region = scene.model.region(state, name)
    # it touches already, or the step has nowhere to go
    if region.penetration > GAP_TOLERANCE * h or end_of_approach <= state.mu[name]:
        return state
    for _ in range(MAX_APPROACHES):
        gap = -scene.model.region(state, name).penetration / h
        if gap <= GAP_TOLERANCE:
            break
        # the body can approach by the gap without passing the first contact
        state = state.with_(state.u, name, state.mu[name] + gap)
        if state.mu[name] + CONTACT_DEPTH >= end_of_approach:
            return state.with_(state.u, name, end_of_approach)
    else:
        raise Stopped("the body does not meet the shell")
    reason = ""
    # a little beyond, so that there is a force; less far where there is no equilibrium
    for depth in FIRST_CONTACT_DEPTHS:
        approach = state.mu[name] + depth
        outcome = scene.newton.solve(
            state.with_(state.u, name, approach), name, PrescribedLoad(name, approach)
        )
        if outcome.converged:
            return outcome.state
        reason = outcome.reason
    raise Stopped(f"no equilibrium found at the first contact: {reason}")


def raised_stiffnesses(scene: Scene, state: State) -> dict[str, float]:
    """Return setting of a contact -> stiffness `STIFFENING` times as large, where it is too deep.

    A contact is too deep if it penetrates more than its bound at this state. A stiffness that the
    case gives stays, and so does one at its upper limit. Collective.
    """
    h, settings = scene.problem.material.h, dict[str, float]()
    for contact in scene.problem.loads.contacts:
        stiffness = state.mu.get(contact.setting, contact.stiffness)
        depth = scene.model.region(state, contact.amplitude).penetration
        if (
            depth > contact.max_penetration * h
            and not contact.has_given_stiffness
            and stiffness < MAX_STIFFENING * contact.stiffness
        ):
            settings[contact.setting] = STIFFENING * stiffness
    for pair, depth in shell_penetrations(scene, state):  # depth over the thickness
        stiffness = state.mu.get(pair.setting, pair.stiffness)
        if (  # between the points of contact shells may be deeper: a part of the bound
            depth > BOUND_AT_POINTS * pair.max_penetration
            and not pair.has_given_stiffness
            and stiffness < MAX_STIFFENING_OF_SHELLS * pair.stiffness
        ):
            settings[pair.setting] = STIFFENING * stiffness
    return settings


def stiff_for(pair: Pair, speed: float, h: float) -> float:
    """Return a stiffness with which shells that hit each other flat penetrate little enough.

    At the penetration s of `IMPACT_PENETRATION` h the penalty has taken all kinetic energy of the
    relative motion with the speed v: k s^2 = m v^2 per area, where m is half the mass of one of two
    equal shells (in units where this mass is 1). The stiffness is the pair's own, raised by factors
    of `STIFFENING` until it is at least k.

    Parameters
    ----------
    pair
        Two shells that may touch.
    speed
        Their relative speed over that of waves.
    h
        Thickness over R.
    """
    needed_stiffness, stiffness = (speed / (IMPACT_PENETRATION * h)) ** 2 / 2, pair.stiffness
    while stiffness < needed_stiffness:
        stiffness *= STIFFENING
    return stiffness


def recall_cuts(stage: Stage, high: Point, numbers: Mapping[str, float]) -> None:
    """Let numbers of cuts stand for the cuts at the displacement of a point; collective.

    A state has only the number of its cuts. So an interrupted run that is repeated from its journal
    must make the same cuts again under the same numbers.

    Parameters
    ----------
    high
        Point at whose displacement the cuts are made.
    numbers
        Setting of a pair's cuts -> their number; empty: nothing is done.
    """
    evaluation = stage.scene.model.system.at_state(stage.leave(high.state)) if numbers else None
    for shell_contact in _with_cuts(stage.scene):
        if evaluation and shell_contact.pair.cuts in numbers:
            evaluation.evaluate(
                partial(shell_contact.recall_cuts, numbers[shell_contact.pair.cuts])
            )


def closer_points(stage: Stage, low: Point, high: Point) -> dict[str, float]:
    """Return setting of a pair's cuts -> number of cuts with closer points of contact.

    Points of contact are quadrature points of segments. Between the two points of the path there is
    an instability, which might come from too coarse a quadrature. So it is computed again with
    closer points, unless these hardly change the critical modes at both ends; then the result is
    empty. Collective.
    """
    scene, state = stage.scene, stage.leave(high.state)
    evaluation = scene.model.system.at_state(state)
    numbers = {
        shell_contact.pair.cuts: evaluation.evaluate(shell_contact.finer_cuts)
        for shell_contact in _with_cuts(scene)
    }
    closer = {name: number for name, number in numbers.items() if number is not None}
    is_certain = not closer or all(_is_certain(stage, point, closer) for point in (high, low))
    return {} if is_certain else closer


def _is_certain(stage: Stage, point: Point, finer: Mapping[str, float]) -> bool:
    """Return whether closer points of contact hardly change the critical mode at a point.

    The critical mode has the eigenvalue of the tangent that is nearest to zero. This eigenvalue may
    change by less than the part `CERTAIN_STIFFNESS_CHANGE`, the number of unstable directions not
    at all. Also True if a mode is not found: then nothing says that closer points would help.

    Parameters
    ----------
    finer
        Setting of a pair's cuts -> number of cuts with closer points.
    """
    state_with_finer_cuts = State(point.state.u, {**point.state.mu, **finer})
    try:
        mode, mode_with_finer_cuts = (
            critical_mode(stage.newton, state) for state in (point.state, state_with_finer_cuts)
        )
    except NoEigenpair:
        return True
    error = abs(mode_with_finer_cuts.eigenvalue - mode.eigenvalue)
    return (
        mode_with_finer_cuts.negative_pivots == mode.negative_pivots
        and error < CERTAIN_STIFFNESS_CHANGE * abs(mode.eigenvalue)
    )


def better_cuts(scene: Scene, state: State) -> dict[str, float]:
    """Return setting of a pair's cuts -> number of new cuts, where these are much better.

    As shells slide on each other, segments of old cuts no longer face one cell each, and the
    quadrature becomes less exact. Collective.
    """
    evaluation = scene.model.system.at_state(state)
    numbers = {
        shell_contact.pair.cuts: evaluation.evaluate(shell_contact.improved_cuts)
        for shell_contact in _with_cuts(scene)
    }
    return {name: number for name, number in numbers.items() if number is not None}


def with_cuts_here(scene: Scene, state: State) -> State:
    """Return a state of another model with cuts made at its own displacement; collective.

    Cuts belong to the mesh of a model, so numbers of another one mean nothing here.
    """
    evaluation = scene.model.system.at_state(state)
    numbers = {
        shell_contact.pair.cuts: evaluation.evaluate(shell_contact.present_cuts)
        for shell_contact in _with_cuts(scene)
    }
    return State(state.u, {**state.mu, **numbers})


def _with_cuts(scene: Scene) -> list[SurfaceContact]:
    """Return the contacts between shells that have cuts: those of surfaces, not of meridians."""
    return [
        shell_contact
        for shell_contact in scene.model.shell_contacts
        if isinstance(shell_contact, SurfaceContact)
    ]


def with_own_contact(scene: Scene, state: State) -> State | None:
    """Return a state with the stiffnesses and cuts that its displacement needs, to solve it again.

    Contacts become stiffer where shells or bodies penetrate too much. None if the state's settings
    are fit already, or if no shells may touch each other. Collective.
    """
    changed = (
        {**raised_stiffnesses(scene, state), **better_cuts(scene, state)}
        if scene.model.shell_contacts
        else {}
    )
    return State(state.u, {**state.mu, **changed}) if changed else None


def shell_penetrations(scene: Scene, state: State) -> list[tuple[Pair, float]]:
    """Return pairs of shells that may touch, each with penetration over thickness; collective."""
    evaluation = scene.model.system.at_state(state)
    return [
        (shell_contact.pair, evaluation.evaluate(shell_contact.relative_penetration))
        for shell_contact in scene.model.shell_contacts
    ]


def refuse_passing(stage: Stage, low: Point, high: Point) -> None:
    """Check that no shell passes through another one, itself or a mirror plane between two points.

    The way between the displacements of the two points is straight. Collective.

    Parameters
    ----------
    low, high
        Points with states of the stage's system.

    Raises
    ------
    StepTooLong
        If a shell passes through another one or itself.
    PathStopped
        If it touches its mirror image behind a plane that does not act as contact.
    """
    model, comm = stage.scene.model, stage.scene.comm
    if not model.shell_contacts:
        return
    if model.axisymmetric:
        displacements_of_meridian = [
            model.system.with_ghosts(model_state.u, model_state.mu).reshape(-1, 2)
            for model_state in map(stage.leave, (low.state, high.state))
        ]
        _refuse_through(model.shell_contacts, displacements_of_meridian)
        return
    end = stage.leave(high.state)
    displacements = [  # of all ranks' nodes
        gathered_displacement(stage.scene, state) for state in (stage.leave(low.state), end)
    ]
    undeformed_places = model.r0.x.array[: model.system.size].reshape(-1, 3)
    deformed_places = undeformed_places + model.system.with_ghosts(end.u, end.mu)[
        : model.system.size
    ].reshape(-1, 3)
    evaluation, shell_contacts = (
        model.system.at_state(end),
        [
            shell_contact
            for shell_contact in model.shell_contacts
            if isinstance(shell_contact, SurfaceContact)
        ],
    )
    owned = slice(*model.V.dofmap.index_map.local_range)
    undeformed_half_thickness, half_thickness = (
        values[owned] for values in evaluation.evaluate(shell_contacts[0].halves)
    )
    half_thickness = np.minimum(half_thickness, undeformed_half_thickness)
    # across these planes contact sees the other half
    seen_through = [*model.mirror.planes.values()] if model.multiplicity > 1 else []
    for plane in (
        mirror_plane for mirror_plane in model.planes if mirror_plane not in seen_through
    ):
        distance_before, distance_after = (
            plane.signed_distance(undeformed_places),
            plane.signed_distance(deformed_places),
        )
        # 1 or -1: on which side of the plane the shell is
        side = np.sign(comm.allreduce(float(distance_before.sum())))
        # nodes that were farther than the thickness from the plane, and now are within half of it
        if comm.allreduce(
            int(
                np.sum(
                    (side * distance_before > 2 * undeformed_half_thickness)
                    & (side * distance_after < half_thickness)
                )
            )
        ):
            raise PathStopped(
                "the shell touches its mirror image behind a plane of boundary: symmetry, which it "
                "does not feel: model both sides",
                low,
                final=True,
            )
    _refuse_through(shell_contacts, displacements)


def passes(stage: Stage, low: Point | State, high: Point | State) -> bool:
    """Return whether a shell passes through another one, itself or a mirror plane.

    The way between the two points, or states of the stage's system, is straight. Collective.
    """
    end_points = (
        # the check reads the state of a point alone; s, the tangent and pivots are zero
        end if isinstance(end, Point) else Point(end, 0.0, 0.0 * end.u, 0.0, 0, 0)
        for end in (low, high)
    )
    try:
        refuse_passing(stage, *end_points)
    except (StepTooLong, PathStopped):
        return True
    return False


def _refuse_through(
    shell_contacts: Sequence[SurfaceContact] | Sequence[MeridianContact],
    ends: Sequence[NDArray[np.float64]],
) -> None:
    """Check that no shell passes through another one on the straight way between two displacements.

    Parameters
    ----------
    ends
        Displacements over R at the two ends, as `passes_through` of the contacts takes them: of all
        nodes of a surface, or (n, 2) of a meridian.

    Raises
    ------
    StepTooLong
        With the shells that pass.
    """
    for shell_contact in shell_contacts:
        if shell_contact.passes_through(*ends):
            raise StepTooLong(
                f"the shortest step passes {shell_contact.pair.words} through each other"
            )


def refuse_crossing(stage: Stage, low: Point, high: Point) -> None:
    """Check that the shell passes through no magnet or other source between two points; collective.

    Each applied field compares the places and amplitudes at both ends, on each rank its own nodes.

    Raises
    ------
    PathStopped
        With the message of the source that it passes; the path must end there.
    """
    model, states = stage.scene.model, [stage.leave(point.state) for point in (low, high)]
    for field in model.fields:
        # for each of the two points: `field.places` at its state, and the amplitudes
        ends = list[tuple[NDArray[np.float64], Mapping[str, float]]]()
        for state in states:
            evaluation = model.system.at_state(state)
            ends.append((evaluation.evaluate(partial(getattr, field, "places")), state.mu))
        # "" on a rank whose nodes pass through nothing
        messages = model.system.comm.allgather(field.passed_through(*ends))
        if message := next((message for message in messages if message), ""):
            raise PathStopped(message, low, final=True)


def before_passing(stage: Stage, low: State, high: State) -> State:
    """Return the second of two states of a stage, or one before shells pass through each other.

    The latter is on the straight way to the second state, found by halving; it has the amplitudes
    of the second state. Collective.
    """
    if not stage.scene.model.shell_contacts or not passes(stage, low, high):
        return high
    # parts of the way: without passing, and with
    safe_part, passing_part, displacement = 0.0, 1.0, high.u - low.u
    for _ in range(HALVINGS_BEFORE_PASSING):
        middle = (safe_part + passing_part) / 2
        passes_there = passes(stage, low, State(low.u + middle * displacement, high.mu))
        safe_part, passing_part = (safe_part, middle) if passes_there else (middle, passing_part)
    return State(low.u + safe_part * displacement, high.mu)


def refuse_return(stage: Stage, name: str, points: Sequence[Point], high: Point) -> None:
    """Check that a body does not go back the way it came; collective.

    At a fold in its approach the shell may snap away. A path that then follows the same equilibria
    backwards, or with the body off the shell, is of no use.

    Parameters
    ----------
    name
        The amplitude that varies; nothing is checked unless it moves a body.
    points
        Points of the path so far.
    high
        The next point.

    Raises
    ------
    PathStopped
        If the body goes back on its path, or if it moves away from the shell without touching.
    """
    model, comm, low = stage.scene.model, stage.scene.comm, points[-1]
    if name not in model.contacts:
        return
    h = stage.newton.system.length
    approaches = [point.state.mu[name] for point in (*points, high)]
    # index of the point of the farthest approach, from where the path may turn
    turn = int(np.argmax(np.abs(np.subtract(approaches, approaches[0]))))
    distance_from_turn = max_abs(comm, high.state.u - points[min(turn, len(points) - 1)].state.u)
    # `high` is the farthest itself, or too near to the turn to tell the ways apart
    if turn == len(points) or distance_from_turn < RETURN_DISTANCE * h:
        return
    # is `high` on the way to the turn, that is near the displacement there at the same approach?
    for earlier_point, later_point in pairwise(points[: turn + 1]):
        displacement_before = _displacement_at(name, approaches[-1], earlier_point, later_point)
        if displacement_before is None:
            continue
        if (
            max_abs(comm, high.state.u - displacement_before)
            < RETURN_TOLERANCE * distance_from_turn
        ):
            message = (
                "the body goes back the way it came: at its fold the shell snaps under a given "
                "approach"
            )
            raise PathStopped(message, low, final=True)
    if max_abs(comm, high.du) == 0:  # the shell does not move with the body
        depth_low, depth_high = [
            model.region(stage.leave(point.state), name).penetration for point in (low, high)
        ]
        if depth_high < min(depth_low, 0.0):
            message = (
                "the body has left the shell: at its fold the shell snaps under a given approach"
            )
            raise PathStopped(message, high, final=True)


def _displacement_at(
    name: str, value: float, earlier_point: Point, later_point: Point
) -> NDArray[np.float64] | None:
    """Return the displacement of a path where an amplitude has a value, between two of its points.

    It is the cubic Hermite polynomial through both points. None if the value is not between theirs,
    or a slope du/dmu is infinite.

    Parameters
    ----------
    name
        The amplitude.
    """
    mu_a, mu_b = earlier_point.state.mu[name], later_point.state.mu[name]
    is_outside = (value - mu_a) * (value - mu_b) > 0
    if is_outside or not earlier_point.dmu or not later_point.dmu:
        return None
    slope_a, slope_b = earlier_point.du / earlier_point.dmu, later_point.du / later_point.dmu
    polynomial = scipy.interpolate.CubicHermiteSpline(
        [mu_a, mu_b], [earlier_point.state.u, later_point.state.u], [slope_a, slope_b]
    )
    return np.asarray(polynomial(value))


def penetration_message(scene: Scene, state: State, *, moving: bool = False) -> str:
    """Return a message on a body or a shell that penetrates more than its bound; "" if none does.

    It says which stiffness would halve the penetration. Collective.

    Parameters
    ----------
    moving
        Whether the state is one of a motion, where shells may hit each other: then the bound
        between shells is `IMPACT_BOUND_RATIO` times as large.
    """
    h = scene.problem.material.h
    for contact in scene.problem.loads.contacts:
        depth = scene.model.region(state, contact.amplitude).penetration / h
        if depth > contact.max_penetration:
            stiffness = state.mu.get(contact.setting, contact.stiffness)
            return (
                f"the penetration of the body {contact.body} is {depth:.3g} h, more than "
                f"bodies.{contact.body}.penetration: {contact.max_penetration:g}; its stiffness is "
                f"{stiffness:.4g}: give four times as much"
            )
    for pair, depth in shell_penetrations(scene, state):
        bound = pair.max_penetration * (IMPACT_BOUND_RATIO if moving else 1.0)
        if depth > bound:
            finding = (
                f"the penetration between {pair.words} is {depth:.3g} h, more than {bound:g} h"
            )
            stiffness = state.mu.get(pair.setting, pair.stiffness)
            if moving or pair.has_given_stiffness:
                return f"{finding}; contact: stiffness: is {stiffness:.4g}: give four times as much"
            return (
                f"{finding} even with the stiffest penalty: take smaller elements where they touch"
            )
    return ""


def support_motion_limit(scene: Scene, state: State, name: str, end: float) -> tuple[float, str]:
    """Return how far supports can move before shells that they hold would overlap; collective.

    Only nodes whose displacement is prescribed count, as they do not give way. Edges that cross
    between nodes are not seen.

    Parameters
    ----------
    name
        Amplitude that moves supports.
    end
        Value at which the motion ends.

    Returns
    -------
    limit
        Largest value without overlap, at most `end`.
    shells
        Words for the shells that stop the motion; "" if nothing stops it.
    """
    model, comm, dim = scene.model, scene.model.system.comm, 2 if scene.model.axisymmetric else 3
    if name not in scene.motions or not model.shell_contacts:
        return end, ""
    fixed = np.zeros(model.system.size, dtype=bool)  # unknowns with a prescribed displacement
    for bc in model.system.clamped:
        dofs = bc.dof_indices()[0]
        fixed[dofs[dofs < len(fixed)]] = True
    prescribed_nodes = np.flatnonzero(
        np.concatenate(comm.allgather(fixed)).reshape(-1, dim).all(axis=1)
    )
    begin = state.mu[name]

    def meeting_shells(part: float) -> str:
        """Return words for shells whose held nodes overlap after a part of the way, or ""."""
        moved_state = state.with_(state.u, name, begin + part * (end - begin))
        u = np.concatenate(
            comm.allgather(
                model.system.with_ghosts(moved_state.u, moved_state.mu)[: model.system.size]
            )
        ).reshape(-1, dim)
        for shell_contact in model.shell_contacts:
            if (
                shell_contact.gap_at_supports(prescribed_nodes, u)
                < -shell_contact.pair.max_penetration * scene.problem.material.h
            ):
                return shell_contact.pair.words
        return ""

    parts_of_way = np.linspace(0.0, 1.0, SAMPLES_OF_MOTION)
    first_meeting = next(
        (i for i in range(1, SAMPLES_OF_MOTION) if meeting_shells(parts_of_way[i])), None
    )
    # shells that overlap from the start are not stopped by the motion
    if first_meeting is None or meeting_shells(0.0):
        return end, ""
    free_part, overlapping_part = parts_of_way[first_meeting - 1 : first_meeting + 1]
    for _ in range(HALVINGS_OF_MOTION):
        middle = (free_part + overlapping_part) / 2
        free_part, overlapping_part = (
            (free_part, middle) if meeting_shells(middle) else (middle, overlapping_part)
        )
    return float(begin + free_part * (end - begin)), meeting_shells(overlapping_part)


def touching_bodies(scene: Scene, state: State) -> list[ContactBody]:
    """Return the contacts of the bodies that penetrate the shell at a state; collective."""
    contacts = scene.problem.loads.contacts
    return [
        contact
        for contact in contacts
        if scene.model.region(state, contact.amplitude).penetration > 0
    ]


def refuse_touching_shells(scene: Scene, state: State, result: str) -> None:
    """Check that no shells touch: else the second variation of a wave has no derivative here.

    Collective.

    Parameters
    ----------
    result
        Begin of the message: name of the result that has no gradient.

    Raises
    ------
    CaseError
        With the shells that touch.
    """
    for pair, deep in shell_penetrations(scene, state):
        if deep > 0:
            raise CaseError(
                f"{result}: has no gradient where shells touch ({pair.words}): take symmetry: "
                "half, where a wave is a mode as others are, or differences of runs"
            )


@contextmanager
def contact_expanded_about(scene: Scene, state: State | None) -> Iterator[None]:
    """Expand contact between shells into polynomials about a state, for states near it.

    Within the context contact has fixed active sets, so that differences of states are smooth. None
    leaves contact as it is. Collective.
    """
    if state is None:
        yield
        return
    evaluation = scene.model.system.at_state(state)
    for shell_contact in scene.model.shell_contacts:
        shell_contact.hold(evaluation.evaluate(shell_contact.freeze))
    try:
        yield
    finally:
        for shell_contact in scene.model.shell_contacts:
            shell_contact.hold(None)


def with_stiffer_bodies(scene: Scene, state: State, bodies: list[ContactBody]) -> State | None:
    """Return the equilibrium near a state with bodies `STIFFENING` times as stiff; collective.

    All loads and approaches stay.

    Parameters
    ----------
    bodies
        Contacts of the bodies that become stiffer, at least one.

    Returns
    -------
    State or None
        None if there is no equilibrium within the displacement `MAX_DISPLACEMENT` h.
    """
    stiffnesses = {
        contact.setting: STIFFENING * state.mu.get(contact.setting, contact.stiffness)
        for contact in bodies
    }
    name = bodies[0].amplitude  # the solver needs one amplitude to prescribe; any serves
    outcome = scene.newton.solve(
        State(state.u, {**state.mu, **stiffnesses}), name, PrescribedLoad(name, state.mu[name])
    )
    if (
        not outcome.converged
        or _largest_displacement(scene, state, outcome.state)
        > MAX_DISPLACEMENT * scene.problem.material.h
    ):
        return None
    return outcome.state


def stiffened_equilibrium(scene: Scene, state: State) -> State:
    """Return the equilibrium with bodies so stiff that their stiffness does not matter; collective.

    A shell may rest on a soft body otherwise than on a hard one, where it lies flat. So the bodies
    that touch become stiffer, until the last change moves the shell by at most `RIGID_RATIO` times
    the penetration before it. A stiffness that the case gives stays.
    """
    for _ in range(MAX_STIFFENINGS):
        bodies = [
            contact for contact in touching_bodies(scene, state) if not contact.has_given_stiffness
        ]
        stiffer_state = with_stiffer_bodies(scene, state, bodies) if bodies else None
        if stiffer_state is None:
            break
        depth = max(scene.model.region(state, contact.amplitude).penetration for contact in bodies)
        state, displacement = stiffer_state, _largest_displacement(scene, state, stiffer_state)
        if displacement <= RIGID_RATIO * depth:
            break
    return state


def _largest_displacement(scene: Scene, state: State, other: State) -> float:
    """Return the largest component of the displacement between two states, over R; collective."""
    return max_abs(scene.model.system.comm, other.u - state.u)
