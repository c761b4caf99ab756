"""Where on the way to a first guess shells begin to touch: a step ends just before, and the next
one just behind.

A guess from before a contact knows nothing of it: shells would lie deep in each other, and Newton's
method circle.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.step_control import StepEvent
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.parts.touching.touching import NEARER, Touching
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]
# of the thickness: how far before and past the first contact the guesses of two steps lead
DEEP = 2e-3
CLOSE = 4.0  # of that: from so near a step leads past the first contact
MOST = 40  # looks at a way


def way_to_touch(
    scene: Scene, leave: Callable[[State], State], here: State, guess: State
) -> StepEvent:
    """Where shells meet that do not touch yet, and whether all that touch let go; collective.

    Of pairs that meet on the straight way between two states of a step the first one counts. A step
    ends just behind where it meets if the first state is near that, else just before.
    """
    touchings = [
        each for each in scene.model.touchings if isinstance(each, Touching)
    ]  # not those on meridians
    if not touchings:
        return StepEvent()
    ends = leave(here), leave(guess)
    here_at, guess_at = map(scene.model.system.at_state, ends)
    u, v = (of_all_nodes(scene, state) for state in ends)
    meets, loses_forces = (1.0, False), False
    for each in touchings:
        if here_at.evaluate(each.penetration):
            loses_forces |= not guess_at.evaluate(each.penetration)
        else:
            at = _onset(each, scene.problem.material.h, u, v)
            meets = min(meets, at, key=lambda each: (each[0], not each[1]))
    return StepEvent(*meets, loses_forces)


def of_all_nodes(scene: Scene, state: State) -> Array:
    """The displacement (nodes, 3) of all ranks; collective."""
    system = scene.model.system
    parts = scene.comm.allgather(system.with_ghosts(state.u, state.mu)[: system.size])
    return np.asarray(np.concatenate(parts).reshape(-1, 3))


def _onset(touching: Touching, h: float, u: Array, v: Array) -> tuple[float, bool]:
    """The same for a pair that does not touch, between two displacements."""
    most, deep = 2 * float(np.linalg.norm(v - u, axis=1).max()), DEEP * h
    if not most or not touching.meet(u, v) or (at_low := touching.gap(u)) <= 0:
        return 1.0, False
    sets_in, thinnest = at_low < CLOSE * deep, touching.thinnest()
    low, high, at_high, aim = 0.0, 0.0, 0.0, -deep if sets_in else deep
    for _ in range(MOST):
        if high:
            part = low + (high - low) * (at_low - aim) / (at_low - at_high)
        else:  # so far no face can pass through another one
            part = min(1.0, low + (at_low + NEARER * thinnest) / most)
        gap = touching.gap(u + part * (v - u))
        if gap < aim - deep:
            high, at_high = part, gap
        elif gap <= aim + deep:
            return part, sets_in
        elif part == 1.0:
            return 1.0, False
        else:
            low, at_low = part, gap
    return (high if sets_in else low) or low, sets_in
