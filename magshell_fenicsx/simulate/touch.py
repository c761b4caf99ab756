"""Contact of bodies: the first one, a free flight that arc length could not measure, and how stiff
bodies must be.
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
from magshell_fenicsx.parts.bodies.contact import Contact
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.parts.touching.on_meridian import MeridianTouching
from magshell_fenicsx.parts.touching.section import Pair
from magshell_fenicsx.parts.touching.touching import Touching
from magshell_fenicsx.simulate.onset import DEEP, of_all_nodes
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage

TRIED = tuple(
    DEEP / 4**i for i in range(7)
)  # of h: how far past the first contact the path begins, at the first try
NEAR = 1e-7  # of h: a smaller gap is none
FALLEN, ALIKE = (
    0.1,
    0.02,
)  # of h, how far a path that returns is from its turn; of that, how far from the way there
MOST = 1000  # approaches by the least gap
STIFFER, MOST_STIFF = 4.0, 1e4  # how much stiffer a body becomes at once, and at most
NEARLY = 0.75  # of the bound, at points: between them, with other cuts, shells may be deeper
CERTAIN = 0.5  # of a critical mode's stiffness: what closer points of contact may change of it
PASSED = 8  # halvings of a way on which shells would pass through each other
HIT = 0.03  # of h: the penetration that shells which hit each other flat are meant to have
IMPACT = 100.0  # times the bound: a penetration that lasts for a moment
AT_A_CORNER = (
    1e6  # how much stiffer a shell becomes at most: the point of a corner has a small weight
)
WAYS, HALVINGS = (
    65,
    30,
)  # places on the way of supports that are looked at, and halvings of the part they meet in
RIGID, MOVED, MOST_RAISED = 2.0, 0.05, 4  # penetrations, thicknesses, times: see `rigid`


def touched(scene: Scene, step: ProgrammeStep, state: State) -> State:
    """The state just after the body of a step first touches; the given one if it touches, or its
    target is nearer.

    Raises
    ------
    Stopped
        If the body never meets the shell, or the first contact has no equilibrium.
    """
    goal, name, h = step.load.target or step.load.bound, step.name, scene.problem.material.h
    end = goal[1] if goal and goal[0].quantity == "load" else inf  # of the approach
    region = scene.model.region(state, name)
    if region.penetration > NEAR * h or end <= state.mu[name]:
        return state
    for _ in range(MOST):
        gap = -scene.model.region(state, name).penetration / h
        if gap <= NEAR:
            break
        state = state.with_(state.u, name, state.mu[name] + gap)
        if state.mu[name] + DEEP >= end:
            return state.with_(state.u, name, end)
    else:
        raise Stopped("the body does not meet the shell")
    reason = ""
    for deep in TRIED:
        a = state.mu[name] + deep
        outcome = scene.newton.solve(state.with_(state.u, name, a), name, PrescribedLoad(name, a))
        if outcome.converged:
            return outcome.state
        reason = outcome.reason
    raise Stopped(f"no equilibrium found at the first contact: {reason}")


def stiffnesses(scene: Scene, state: State) -> dict[str, float]:
    """The settings of what penetrates too much at a state, `STIFFER` times as stiff; of a given
    stiffness none.
    """
    h, raised = scene.problem.material.h, dict[str, float]()
    for contact in scene.problem.loads.contacts:
        k = state.mu.get(contact.setting, contact.stiffness)
        deep = scene.model.region(state, contact.amplitude).penetration
        if deep > contact.bound * h and not contact.given and k < MOST_STIFF * contact.stiffness:
            raised[contact.setting] = STIFFER * k
    for pair, deep in between(scene, state):
        k = state.mu.get(pair.setting, pair.stiffness)
        if deep > NEARLY * pair.bound and not pair.given and k < AT_A_CORNER * pair.stiffness:
            raised[pair.setting] = STIFFER * k
    return raised


def stiff_for(pair: Pair, speed: float, h: float) -> float:
    """The stiffness of a pair that meets flat with this speed, over that of waves, and goes `HIT`
    deep; h is over R.

    The energy of both about their common velocity is then that of the penalty: m v^2 = k s^2, with
    half the mass per area of the first shell.
    """
    wanted, k = (speed / (HIT * h)) ** 2 / 2, pair.stiffness
    while k < wanted:
        k *= STIFFER
    return k


def recall_cuts(stage: Stage, high: Point, numbers: Mapping[str, float]) -> None:
    """Let numbers of cuts stand for those at a point of a step, as they did in an interrupted run;
    collective."""
    at = stage.scene.model.system.at_state(stage.leave(high.state)) if numbers else None
    for each in _with_cuts(stage.scene):
        if at and each.pair.cuts in numbers:
            at.evaluate(partial(each.recall, numbers[each.pair.cuts]))


def closer_points(stage: Stage, low: Point, high: Point) -> dict[str, float]:
    """Return the numbers of cuts with closer points of contact, for two points with an
    instability between them.

    Empty if closer points change neither the number of unstable directions of both nor much of
    their critical modes' stiffness: of an instability that they move, nobody knows whether it is
    one.
    """
    scene, state = stage.scene, stage.leave(high.state)
    at = scene.model.system.at_state(state)
    numbers = {each.pair.cuts: at.evaluate(each.finer) for each in _with_cuts(scene)}
    closer = {name: number for name, number in numbers.items() if number is not None}
    certain = not closer or all(_is_certain(stage, point, closer) for point in (high, low))
    return {} if certain else closer


def _is_certain(stage: Stage, point: Point, finer: Mapping[str, float]) -> bool:
    """Return whether closer points change no critical mode's stiffness at a point by `CERTAIN` of
    it.

    True as well if a mode is not found: then nothing says that closer points would help.
    """
    given, other = point.state, State(point.state.u, {**point.state.mu, **finer})
    try:
        mode, compared = (critical_mode(stage.newton, state) for state in (given, other))
    except NoEigenpair:
        return True
    error = abs(compared.eigenvalue - mode.eigenvalue)
    return compared.negative_pivots == mode.negative_pivots and error < CERTAIN * abs(
        mode.eigenvalue
    )


def better_cuts(scene: Scene, state: State) -> dict[str, float]:
    """The numbers of cuts at a state that are much better than those it has; collective."""
    at = scene.model.system.at_state(state)
    numbers = {each.pair.cuts: at.evaluate(each.recut) for each in _with_cuts(scene)}
    return {name: number for name, number in numbers.items() if number is not None}


def with_cuts_here(scene: Scene, state: State) -> State:
    """A state, as one that another model gives, with the cuts of shells at its own displacement;
    collective.
    """
    at = scene.model.system.at_state(state)
    return State(
        state.u,
        {**state.mu, **{each.pair.cuts: at.evaluate(each.numbered) for each in _with_cuts(scene)}},
    )


def _with_cuts(scene: Scene) -> list[Touching]:
    return [
        each for each in scene.model.touchings if isinstance(each, Touching)
    ]  # on meridians are no cuts


def of_its_own(scene: Scene, state: State) -> State | None:
    """A state with penalties that are stiffer where shells or bodies are too deep in each other, and with cuts of its
    own; None if it needs none of these. Collective."""
    changed = (
        {**stiffnesses(scene, state), **better_cuts(scene, state)} if scene.model.touchings else {}
    )
    return State(state.u, {**state.mu, **changed}) if changed else None


def between(scene: Scene, state: State) -> list[tuple[Pair, float]]:
    """The pairs of shells that may touch, with their penetrations over the thickness there;
    collective.
    """
    at = scene.model.system.at_state(state)
    return [(each.pair, at.evaluate(each.depth)) for each in scene.model.touchings]


def refuse_passing(stage: Stage, low: Point, high: Point) -> None:
    """See that no shell passes through another one, or itself, on the straight way between two
    points.

    Raises
    ------
    StepTooLong
        If one does.
    """
    model, comm = stage.scene.model, stage.scene.comm
    if not model.touchings:
        return
    if model.axisymmetric:
        places = [
            model.system.with_ghosts(s.u, s.mu).reshape(-1, 2)
            for s in map(stage.leave, (low.state, high.state))
        ]
        _refuse_through(model.touchings, places)
        return
    end = stage.leave(high.state)
    whole = [of_all_nodes(stage.scene, state) for state in (stage.leave(low.state), end)]
    x0 = model.r0.x.array[: model.system.size].reshape(-1, 3)
    x = x0 + model.system.with_ghosts(end.u, end.mu)[: model.system.size].reshape(-1, 3)
    at, touchings = (
        model.system.at_state(end),
        [t for t in model.touchings if isinstance(t, Touching)],
    )
    own = slice(*model.V.dofmap.index_map.local_range)
    undeformed, half = (each[own] for each in at.evaluate(touchings[0].halves))
    half = np.minimum(half, undeformed)
    seen_through = [*model.mirror.planes.values()] if model.multiplicity > 1 else []
    for plane in (each for each in model.planes if each not in seen_through):
        before, after = plane.signed_distance(x0), plane.signed_distance(x)
        side = np.sign(comm.allreduce(float(before.sum())))
        if comm.allreduce(int(np.sum((side * before > 2 * undeformed) & (side * after < half)))):
            raise PathStopped(
                "the shell touches its mirror image behind a plane of boundary: symmetry, which it does not feel: "
                "model both sides",
                low,
                final=True,
            )
    _refuse_through(touchings, whole)


def passes(stage: Stage, low: Point | State, high: Point | State) -> bool:
    """Whether a shell passes through another one, itself or a mirror plane on the straight way
    between two points.
    """
    ends = (
        end if isinstance(end, Point) else Point(end, 0.0, 0.0 * end.u, 0.0, 0, 0)
        for end in (low, high)
    )
    try:
        refuse_passing(stage, *ends)
    except (StepTooLong, PathStopped):
        return True
    return False


def _refuse_through(
    touchings: Sequence[Touching] | Sequence[MeridianTouching], ends: Sequence[NDArray[np.float64]]
) -> None:
    for each in touchings:
        if each.through(*ends):
            raise StepTooLong(f"the shortest step passes {each.pair.words} through each other")


def refuse_crossing(stage: Stage, low: Point, high: Point) -> None:
    """See that the shell passes through no magnet between two points.

    Raises
    ------
    PathStopped
        With the magnet.
    """
    model, states = stage.scene.model, [stage.leave(point.state) for point in (low, high)]
    for field in model.fields:
        ends = list[tuple[NDArray[np.float64], Mapping[str, float]]]()
        for state in states:
            ends.append(
                (model.system.at_state(state).evaluate(partial(getattr, field, "places")), state.mu)
            )
        if said := [
            each for each in model.system.comm.allgather(field.passed_through(*ends)) if each
        ]:
            raise PathStopped(said[0], low, final=True)


def before_passing(stage: Stage, low: State, high: State) -> State:
    """The second of two states of a stage, or one on the straight way to it, before shells pass
    through each other.
    """
    if not stage.scene.model.touchings or not passes(stage, low, high):
        return high
    part, beyond, way = 0.0, 1.0, high.u - low.u
    for _ in range(PASSED):
        middle = (part + beyond) / 2
        through = passes(stage, low, State(low.u + middle * way, high.mu))
        part, beyond = (part, middle) if through else (middle, beyond)
    return State(low.u + part * way, high.mu)


def refuse_return(stage: Stage, name: str, points: Sequence[Point], high: Point) -> None:
    """See that a body does not go back the way it came, as behind a fold at which it holds the
    shell in place no more.

    Parameters
    ----------
    name
        The amplitude that varies.
    points
        The path up to here.
    high
        The next point.

    Raises
    ------
    PathStopped
        If it does, or if it no longer touches the shell and moves away from it.
    """
    model, comm, low = stage.scene.model, stage.scene.comm, points[-1]
    if name not in model.contacts:
        return
    mu, h = [point.state.mu[name] for point in (*points, high)], stage.newton.system.length
    top = int(np.argmax(np.abs(np.subtract(mu, mu[0]))))
    fallen = max_abs(comm, high.state.u - points[min(top, len(points) - 1)].state.u)
    if top == len(points) or fallen < FALLEN * h:
        return
    for a, b in pairwise(points[: top + 1]):
        x, y = a.state.mu[name], b.state.mu[name]
        if (mu[-1] - x) * (mu[-1] - y) > 0 or not a.dmu or not b.dmu:
            continue
        t = scipy.interpolate.CubicHermiteSpline(
            [x, y], [a.state.u, b.state.u], [a.du / a.dmu, b.du / b.dmu]
        )(mu[-1])
        if max_abs(comm, high.state.u - t) < ALIKE * fallen:
            said = "the body goes back the way it came: at its fold the shell snaps under a given approach"
            raise PathStopped(said, low, final=True)
    if max_abs(comm, high.du) == 0:
        depths = [model.region(stage.leave(point.state), name).penetration for point in (low, high)]
        if depths[1] < min(depths[0], 0.0):
            said = "the body has left the shell: at its fold the shell snaps under a given approach"
            raise PathStopped(said, high, final=True)


def penetration_refused(scene: Scene, state: State, *, moving: bool = False) -> str:
    """How a body penetrates more than its bound, or a shell, and the stiffness that would halve it;
    "" if none does.

    Where shells hit each other in a motion, their bound is `IMPACT` times as large. Collective.
    """
    h = scene.problem.material.h
    for contact in scene.problem.loads.contacts:
        deep = scene.model.region(state, contact.amplitude).penetration / h
        if deep > contact.bound:
            k = state.mu.get(contact.setting, contact.stiffness)
            return (
                f"the penetration of the body {contact.body} is {deep:.3g} h, more than bodies.{contact.body}."
                f"penetration: {contact.bound:g}; its stiffness is {k:.4g}: give four times as much"
            )
    for pair, deep in between(scene, state):
        bound = pair.bound * (IMPACT if moving else 1.0)
        if deep > bound:
            what = f"the penetration between {pair.words} is {deep:.3g} h, more than {bound:g} h"
            k = state.mu.get(pair.setting, pair.stiffness)
            if moving or pair.given:
                return f"{what}; contact: stiffness: is {k:.4g}: give four times as much"
            return f"{what} even with the stiffest penalty: take smaller elements where they touch"
    return ""


def blocked(scene: Scene, state: State, name: str, end: float) -> tuple[float, str]:
    """How far supports can move before what they hold meets, and why no farther: the end, and no
    words, if they can.

    What two supports hold does not give way. Nodes stand for it, so that edges which cross are not
    seen.
    """
    model, comm, dim = scene.model, scene.model.system.comm, 2 if scene.model.axisymmetric else 3
    if name not in scene.motions or not model.touchings:
        return end, ""
    fixed = np.zeros(model.system.size, dtype=bool)
    for bc in model.system.clamped:
        dofs = bc.dof_indices()[0]
        fixed[dofs[dofs < len(fixed)]] = True
    held = np.flatnonzero(np.concatenate(comm.allgather(fixed)).reshape(-1, dim).all(axis=1))
    begin = state.mu[name]

    def met(part: float) -> str:
        at = state.with_(state.u, name, begin + part * (end - begin))
        u = np.concatenate(
            comm.allgather(model.system.with_ghosts(at.u, at.mu)[: model.system.size])
        ).reshape(-1, dim)
        for each in model.touchings:
            if each.held_gap(held, u) < -each.pair.bound * scene.problem.material.h:
                return each.pair.words
        return ""

    parts = np.linspace(0.0, 1.0, WAYS)
    first = next((i for i in range(1, WAYS) if met(parts[i])), None)
    if first is None or met(0.0):
        return end, ""
    low, high = parts[first - 1 : first + 1]
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if met(middle) else (middle, high)
    return float(begin + low * (end - begin)), met(high)


def pressing(scene: Scene, state: State) -> list[Contact]:
    """The bodies that touch."""
    contacts = scene.problem.loads.contacts
    return [
        contact
        for contact in contacts
        if scene.model.region(state, contact.amplitude).penetration > 0
    ]


def refuse_meeting(scene: Scene, state: State, of: str) -> None:
    """See that no shells touch where the second variation of a wave is differentiated; collective.

    Raises
    ------
    CaseError
        With the shells that do.
    """
    for pair, deep in between(scene, state):
        if deep > 0:
            raise CaseError(
                f"{of}: has no gradient where shells touch ({pair.words}): take symmetry: half, where a wave is a mode "
                "as others are, or differences of runs"
            )


@contextmanager
def pressed_as_at(scene: Scene, state: State | None) -> Iterator[None]:
    """Contact between shells as polynomials about a state, for what is evaluated beside it; None:
    as it is.
    """
    if state is None:
        yield
        return
    at = scene.model.system.at_state(state)
    for each in scene.model.touchings:
        each.hold(at.evaluate(each.pressed))
    try:
        yield
    finally:
        for each in scene.model.touchings:
            each.hold(None)


def hardened(scene: Scene, state: State, bodies: list[Contact]) -> State | None:
    """The equilibrium near a state with these bodies `STIFFER` times as stiff; None if there is
    none within `MOVED`.
    """
    k = {
        contact.setting: STIFFER * state.mu.get(contact.setting, contact.stiffness)
        for contact in bodies
    }
    name = bodies[0].amplitude
    outcome = scene.newton.solve(
        State(state.u, {**state.mu, **k}), name, PrescribedLoad(name, state.mu[name])
    )
    if (
        not outcome.converged
        or _moved(scene, state, outcome.state) > MOVED * scene.problem.material.h
    ):
        return None
    return outcome.state


def rigid(scene: Scene, state: State) -> State:
    """The state between bodies so stiff that their stiffness does not decide where the shell
    touches; collective.

    A shell that a soft body lets go lies flat on a harder one. So the bodies that touch become
    stiffer, until the shell moves by at most `RIGID` times the penetration. A given stiffness
    stays.
    """
    for _ in range(MOST_RAISED):
        bodies = [contact for contact in pressing(scene, state) if not contact.given]
        harder = hardened(scene, state, bodies) if bodies else None
        if harder is None:
            break
        deep = max(scene.model.region(state, contact.amplitude).penetration for contact in bodies)
        state, moved = harder, _moved(scene, state, harder)
        if moved <= RIGID * deep:
            break
    return state


def _moved(scene: Scene, state: State, other: State) -> float:
    return max_abs(scene.model.system.comm, other.u - state.u)
