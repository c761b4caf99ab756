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
- `evaluation.evaluate(f)` calls f with the model at the state of the evaluation.
- `scene.model.region(state, amplitude)` is the region where a body touches the shell. Its
  `penetration` over R is negative by the gap while they do not touch.
- h and R are thickness and reference length.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from math import inf
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.modes import NoEigenpair, critical_mode
from magshell_fenicsx.continuation.point import PathStopped, Point, StepTooLong
from magshell_fenicsx.continuation.system import State, max_abs
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import place_text
from magshell_fenicsx.parts.bodies.body_contact import ContactBody
from magshell_fenicsx.parts.penalty_contact import PenaltyOptions
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.simulate.contact_onset import CONTACT_DEPTH
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage

if TYPE_CHECKING:  # most scenes do without
    from magshell_fenicsx.parts.contact.surface_contact import SurfaceContact

# of h: how far past the first contact the path begins, the first try first
FIRST_CONTACT_DEPTHS = tuple(CONTACT_DEPTH / 4**i for i in range(7))
GAP_TOLERANCE = 1e-7  # of h: a smaller gap is none
MAX_APPROACHES = 1000  # approaches by the least gap
RETURN_DISTANCE = 0.1  # of h: how far a path that returns is from its turn
RETURN_TOLERANCE = 0.02  # of that: how far it is from the way there
STIFFENING = 4.0  # how much stiffer a contact becomes at once
# of a critical mode's stiffness: what closer points of contact may change of it
CERTAIN_STIFFNESS_CHANGE = 0.5
HALVINGS_BEFORE_PASSING = 8  # halvings of a way on which shells would pass through each other
# of h: the penetration that shells which hit each other flat are meant to have
IMPACT_PENETRATION = 0.03
SAMPLES_OF_MOTION = 65  # places of supports on their way at which shells are compared
HALVINGS_OF_MOTION = 30  # halvings of the part of the way in which shells meet
RIGID_RATIO = 2.0  # displacement over penetration below which a body is rigid enough
MAX_DISPLACEMENT = 0.05  # of h: farther from it, an equilibrium is another one
MAX_STIFFENINGS = 4  # times that bodies become stiffer


def state_at_first_contact(stage: Stage, step: ProgrammeStep, state: State) -> State:
    """Return the state just after the body of a step first touches the shell; collective.

    The given state returns if the body touches already. If the step's target is nearer than the
    first contact, the state has the body at the target.

    Parameters
    ----------
    stage
        The scene with the solver of the step.
    step
        Step whose amplitude is the approach of a body, over h.

    Raises
    ------
    Stopped
        If the body never meets the shell, or the first contact has no equilibrium.
    """
    scene, name, h = stage.scene, step.name, stage.scene.problem.material.h
    # the target is a pair: what it prescribes, and the value
    target = step.load.end.goal
    end_of_approach = inf
    if target:
        prescribed, value = target
        if prescribed.quantity == "load":
            end_of_approach = value
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
        guess = stage.enter(state.with_(state.u, name, approach))
        outcome = stage.newton.solve(guess, name, PrescribedLoad(name, approach))
        if outcome.converged:
            return stage.leave(outcome.state)
        reason = outcome.reason
    raise Stopped(f"no equilibrium found at the first contact: {reason}")


def raised_stiffnesses(scene: Scene, state: State) -> dict[str, float]:
    """Return setting of a contact -> stiffness `STIFFENING` times as large, where it is too deep.

    A contact is too deep if it penetrates more than its bound at this state. A stiffness that the
    case gives stays, and so does one at its upper limit. Collective.
    """
    settings, evaluation = dict[str, float](), scene.model.system.at_state(state)
    for contact in scene.model.all_contacts:
        penalty = contact.options
        # a stiffness that was never changed has no setting in the state
        stiffness = state.mu.get(penalty.setting, penalty.stiffness)
        depth = evaluation.evaluate(contact.relative_penetration)
        is_too_deep = depth > contact.bound_at_points * penalty.max_penetration
        is_below_limit = stiffness < contact.max_stiffening * penalty.stiffness
        may_rise = is_below_limit and not penalty.has_given_stiffness
        if is_too_deep and may_rise:
            settings[penalty.setting] = STIFFENING * stiffness
    return settings


def stiff_for(pair: PenaltyOptions, speed: float, h: float) -> float:
    """Return a stiffness with which shells that hit each other flat penetrate little enough.

    At the penetration s of `IMPACT_PENETRATION` h the penalty has taken all kinetic energy of the
    relative motion with the speed v: k s^2 = m v^2 per area, where m is half the mass of one of two
    equal shells (in units where this mass is 1). The stiffness is the pair's own, raised by factors
    of `STIFFENING` until it is at least k.

    Parameters
    ----------
    pair
        The penalty of two shells that may touch.
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
    if not numbers:
        return
    evaluation = stage.scene.model.system.at_state(stage.leave(high.state))
    for shell_contact in _surface_contacts(stage.scene):
        if shell_contact.pair.cuts in numbers:
            number = numbers[shell_contact.pair.cuts]
            # the contact cuts its shells at this state and gives the cuts the number
            evaluation.evaluate(partial(shell_contact.recall_cuts, number))


def closer_points(stage: Stage, low: Point, high: Point) -> dict[str, float]:
    """Return setting of a pair's cuts -> number of cuts with closer points of contact.

    Points of contact are quadrature points of segments. Between the two points of the path there is
    an instability, which might come from too coarse a quadrature. So it is computed again with
    closer points, unless these hardly change the critical modes at both ends; then the result is
    empty. Collective.
    """
    scene, state = stage.scene, stage.leave(high.state)
    closer = _numbers_of_cuts(scene, state, lambda contact: contact.finer_cuts())
    # the instability is certain if closer points hardly change the modes beside it
    is_certain = not closer or all(_has_certain_mode(stage, point, closer) for point in (high, low))
    return {} if is_certain else closer


def _has_certain_mode(stage: Stage, point: Point, finer: Mapping[str, float]) -> bool:
    """Return whether closer points of contact hardly change the critical mode at a point.

    The critical mode has the eigenvalue of the tangent that is nearest to zero. This eigenvalue may
    change by less than `CERTAIN_STIFFNESS_CHANGE` times itself. The number of unstable directions
    may not change. Also True if a mode is not found: then nothing says that closer points would
    help.

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
    return _numbers_of_cuts(scene, state, lambda contact: contact.improved_cuts())


def with_cuts_here(scene: Scene, state: State) -> State:
    """Return a state of another model with cuts made at its own displacement; collective.

    Cuts belong to the mesh of a model, so numbers of another one mean nothing here.
    """
    numbers = _numbers_of_cuts(scene, state, lambda contact: contact.present_cuts())
    return State(state.u, {**state.mu, **numbers})


def _numbers_of_cuts(
    scene: Scene, state: State, make_cuts: "Callable[[SurfaceContact], float | None]"
) -> dict[str, float]:
    """Return setting of a pair's cuts -> number of cuts that are made at a state; collective.

    Pairs for which none are made, where `make_cuts` returns None, are left out.
    """
    evaluation, numbers = scene.model.system.at_state(state), dict[str, float]()
    for shell_contact in _surface_contacts(scene):
        number = evaluation.evaluate(partial(make_cuts, shell_contact))
        if number is not None:
            numbers[shell_contact.pair.cuts] = number
    return numbers


def _surface_contacts(scene: Scene) -> "list[SurfaceContact]":
    """Return the contacts between shells on surfaces, which have cuts; those of meridians do not.

    They are all contacts between shells of a model on a surface.
    """
    shell_contacts = scene.model.shell_contacts
    if not shell_contacts:
        return []
    from magshell_fenicsx.parts.contact.surface_contact import SurfaceContact

    return [contact for contact in shell_contacts if isinstance(contact, SurfaceContact)]


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


def touching_shells(scene: Scene, state: State) -> str:
    """Return words for the first pair of shells that touch at a state; "" if none; collective."""
    evaluation = scene.model.system.at_state(state)
    for shell_contact in scene.model.shell_contacts:
        if evaluation.evaluate(shell_contact.penetration) > 0:
            return shell_contact.pair.words
    return ""


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
    model = stage.scene.model
    if not model.shell_contacts:
        return
    begin, end = (stage.leave(point.state) for point in (low, high))
    if not model.axisymmetric:
        _refuse_touching_mirror_image(stage.scene, end, low)
    evaluations = [model.system.at_state(state) for state in (begin, end)]
    for shell_contact in model.shell_contacts:
        configuration = partial(getattr, shell_contact, "configuration")
        ends = [evaluation.evaluate(configuration) for evaluation in evaluations]
        if shell_contact.passes_through(*ends):
            raise StepTooLong(
                f"the shortest step passes {shell_contact.pair.words} through each other"
            )


def _refuse_touching_mirror_image(scene: Scene, end: State, low: Point) -> None:
    """Check that no node has come to a mirror plane that does not act as contact; collective.

    Parameters
    ----------
    end
        State of the model at the end of the way.
    low
        Point at the begin of the way, where a path that is refused ends.

    Raises
    ------
    PathStopped
        If a node has come within half the thickness of such a plane.
    """
    model, comm = scene.model, scene.comm
    assert not model.axisymmetric
    # places of this rank's own nodes
    undeformed_places = model.r0.x.array[: model.system.size].reshape(-1, 3)
    displacements = model.system.with_ghosts(end.u, end.mu)[: model.system.size].reshape(-1, 3)
    deformed_places = undeformed_places + displacements
    # half the thickness at all ranks' nodes, undeformed and at the state; equal for all contacts
    shell_contact, *_ = _surface_contacts(scene)
    halves = model.system.at_state(end).evaluate(shell_contact.halves)
    owned = slice(*model.V.dofmap.index_map.local_range)
    undeformed_half_thickness, half_thickness = (values[owned] for values in halves)
    half_thickness = np.minimum(half_thickness, undeformed_half_thickness)
    # across the mirror planes of a half model or a sector, contact sees the other part
    seen_through = [*model.mirror.planes.values()] if model.multiplicity > 1 else []
    for plane in model.planes:
        if plane in seen_through:
            continue
        distance_before = plane.signed_distance(undeformed_places)
        distance_after = plane.signed_distance(deformed_places)
        # 1 or -1: on which side of the plane the shell is
        side = np.sign(comm.allreduce(float(distance_before.sum())))
        # nodes that were farther than the thickness from the plane, and now are within half of it
        has_come_near = (side * distance_before > 2 * undeformed_half_thickness) & (
            side * distance_after < half_thickness
        )
        if comm.allreduce(int(np.sum(has_come_near))):
            raise PathStopped(
                "the shell touches its mirror image behind a plane of boundary: symmetry, which it "
                "does not feel: model both sides",
                low,
                final=True,
            )


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


def refuse_pressed_support(stage: Stage, low: Point, high: Point) -> None:
    """Check that no body has come through a held place of a shell between two points; collective.

    Nothing gives way there: no stiffness of the penalty would make the penetration smaller. Only
    nodes whose displacement is prescribed count, of shells with an even thickness that stays.

    Raises
    ------
    PathStopped
        If a body penetrates more than its bound there; the path must end.
    """
    scene, state = stage.scene, stage.leave(high.state)
    problem, model = scene.problem, scene.model
    is_even = problem.thickness is None and not problem.material.law.thins_somewhere
    bodies = [body for body in problem.loads.contacts if not body.has_given_stiffness]
    if problem.body or not is_even or not bodies:
        return
    h, nodes = problem.material.h, _prescribed_nodes(scene)
    if not len(nodes):
        return
    r0 = model.r0.x.array[: model.system.size]
    own_places = r0 + model.system.with_ghosts(state.u, state.mu)[: model.system.size]
    places = np.concatenate(model.system.comm.allgather(own_places))
    if model.axisymmetric:  # (rho, z) in the plane of e1 and e3
        places = np.insert(places.reshape(-1, 2), 1, 0.0, axis=1)
    held_places = places.reshape(-1, 3)[nodes]
    for body in bodies:
        gaps, _, _ = body.gap(held_places, state.mu[body.amplitude] * h, h / 2)
        if gaps.min() < -body.max_penetration * h:
            place = place_text(held_places[gaps.argmin()].round(9) + 0.0)  # + 0.0 makes -0 a 0
            raise PathStopped(
                f"the body {body.body} presses on a held place, {place}, over R, where nothing "
                "gives way: end its approach before, move it, or leave that place free",
                low,
                final=True,
            )


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
    tolerance = RETURN_TOLERANCE * distance_from_turn
    if _is_on_way(stage, name, points[: turn + 1], high, tolerance):
        message = (
            "the body goes back the way it came: at its fold the shell snaps under a given approach"
        )
        raise PathStopped(message, low, final=True)
    if max_abs(comm, high.du) == 0:  # the shell does not move with the body
        depth_low, depth_high = [
            model.region(stage.leave(point.state), name).penetration for point in (low, high)
        ]
        # they do not touch at `high`, and the gap has grown
        if depth_high < min(depth_low, 0.0):
            message = (
                "the body has left the shell: at its fold the shell snaps under a given approach"
            )
            raise PathStopped(message, high, final=True)


def _is_on_way(
    stage: Stage, name: str, way: Sequence[Point], point: Point, tolerance: float
) -> bool:
    """Return whether a later point of a path lies on the way that it took before; collective.

    It does so if the way has the displacement of the point, within the tolerance, at the same value
    of the amplitude `name`.
    """
    for earlier_point, later_point in pairwise(way):
        displacement_before = _displacement_at(
            name, point.state.mu[name], earlier_point, later_point
        )
        if displacement_before is None:  # this part of the way does not have the value
            continue
        if max_abs(stage.scene.comm, point.state.u - displacement_before) < tolerance:
            return True
    return False


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
    has_infinite_slope = not earlier_point.dmu or not later_point.dmu
    if is_outside or has_infinite_slope:
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
        Whether the state is one of a motion, where shells may hit each other and penetrate more.
    """
    evaluation = scene.model.system.at_state(state)
    for contact in scene.model.all_contacts:
        stiffness = state.mu.get(contact.options.setting, contact.options.stiffness)
        find_message = partial(contact.penetration_message, stiffness, moving=moving)
        if message := evaluation.evaluate(find_message):
            return message
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
    # without motion of supports, or without shells that may touch, nothing stops it
    if name not in scene.motions or not scene.model.shell_contacts:
        return end, ""
    prescribed_nodes = _prescribed_nodes(scene)
    begin = state.mu[name]

    def meeting_shells(part: float) -> str:
        """Return words for shells whose prescribed nodes overlap after a part of the way, or ""."""
        moved_state = state.with_(state.u, name, begin + part * (end - begin))
        return _overlapping_shells(scene, moved_state, prescribed_nodes)

    # sample the way, then halve the interval between the last free and the first overlapping sample
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


def _prescribed_nodes(scene: Scene) -> NDArray[np.int64]:
    """Return the global numbers of nodes with all components prescribed by supports; collective."""
    system, components = scene.model.system, 2 if scene.model.axisymmetric else 3
    is_prescribed = np.zeros(system.size, dtype=bool)  # this rank's own unknowns
    for bc in system.clamped:
        dofs = bc.dof_indices()[0]
        is_prescribed[dofs[dofs < len(is_prescribed)]] = True
    of_all_ranks = np.concatenate(system.comm.allgather(is_prescribed))
    return np.flatnonzero(of_all_ranks.reshape(-1, components).all(axis=1))


def _overlapping_shells(scene: Scene, state: State, nodes: NDArray[np.int64]) -> str:
    """Return words for the first pair of shells that overlap at some nodes; "" if none; collective.

    Shells overlap if their penetration exceeds the pair's bound. `nodes` have global numbers.
    """
    evaluation = scene.model.system.at_state(state)
    for shell_contact in scene.model.shell_contacts:
        largest_overlap = shell_contact.pair.max_penetration * scene.problem.material.h
        gap = evaluation.evaluate(partial(shell_contact.gap_at_supports, nodes))
        if gap < -largest_overlap:
            return shell_contact.pair.words
    return ""


def touching_bodies(scene: Scene, state: State) -> list[ContactBody]:
    """Return the contacts of the bodies that penetrate the shell at a state; collective."""
    evaluation = scene.model.system.at_state(state)
    return [
        body_contact.contact
        for body_contact in scene.model.contacts.values()
        if evaluation.evaluate(body_contact.penetration) > 0
    ]


def refuse_touching_shells(scene: Scene, state: State, result: str) -> None:
    """Check that no shells touch at a state; collective.

    Where shells touch, the second variation of a wave has no derivative, and so a result that
    depends on it has no gradient.

    Parameters
    ----------
    result
        Begin of the message: name of the result that has no gradient.

    Raises
    ------
    CaseError
        With the shells that touch.
    """
    if words := touching_shells(scene, state):
        raise CaseError(
            f"{result}: has no gradient where shells touch ({words}): take symmetry: half, where a "
            "wave is a mode as others are, or differences of runs"
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
        # the frozen contact has the active set of the state, and takes the place of the real one
        frozen_contact = evaluation.evaluate(shell_contact.freeze)
        shell_contact.hold(frozen_contact)
    try:
        yield
    finally:
        for shell_contact in scene.model.shell_contacts:
            shell_contact.hold(None)  # back to the real one


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
        if stiffer_state is None:  # no body may become stiffer, or there is no equilibrium near
            break
        # penetration before the change, and displacement by the change
        depth = max(scene.model.region(state, contact.amplitude).penetration for contact in bodies)
        state, displacement = stiffer_state, _largest_displacement(scene, state, stiffer_state)
        if displacement <= RIGID_RATIO * depth:
            break
    return state


def _largest_displacement(scene: Scene, state: State, other: State) -> float:
    """Return the largest component of the displacement between two states, over R; collective."""
    return max_abs(scene.model.system.comm, other.u - state.u)
