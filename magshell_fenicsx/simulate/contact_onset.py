"""First contact between shells on the way to a predicted state.

A prediction from before a contact knows nothing of it: shells would lie deep in each other, and
Newton's method circle. So a step ends just before the first contact, and the next one just behind.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.step_control import StepEvent
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.parts.contact.surface_contact import CROSSING_DISTANCE, SurfaceContact
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]
# of the thickness: how far before and past the first contact the predictions of two steps lead
CONTACT_DEPTH = 2e-3
NEAR_CONTACT = 4.0  # of `CONTACT_DEPTH`: from so near a step leads past the first contact
MAX_GAP_EVALUATIONS = 40  # on the way of a step


def first_contact(
    scene: Scene, leave: Callable[[State], State], here: State, prediction: State
) -> StepEvent:
    """Return where shells that are apart first meet, and whether all that touch open; collective.

    Of pairs that meet on the straight way between the two states of a step the first one counts. A
    step ends just behind where it meets if the first state is near that, else just before.

    Parameters
    ----------
    leave
        State of the step's system -> state of the model.
    here, prediction
        The states at both ends of the step.
    """
    # contacts on meridians are no part of it
    contacts = [
        contact for contact in scene.model.shell_contacts if isinstance(contact, SurfaceContact)
    ]
    if not contacts:
        return StepEvent()
    states = leave(here), leave(prediction)
    at_begin, at_end = map(scene.model.system.at_state, states)
    u, v = (gathered_displacement(scene, state) for state in states)
    meets, loses_forces = (1.0, False), False
    for contact in contacts:
        if at_begin.evaluate(contact.penetration):
            loses_forces |= not at_end.evaluate(contact.penetration)
        else:
            onset = _onset(contact, scene.problem.material.h, u, v)
            meets = min(meets, onset, key=lambda event: (event[0], not event[1]))
    return StepEvent(*meets, loses_forces)


def gathered_displacement(scene: Scene, state: State) -> Array:
    """Return the displacement (nodes, 3) of all ranks; collective."""
    system = scene.model.system
    parts = scene.comm.allgather(system.with_ghosts(state.u, state.mu)[: system.size])
    return np.asarray(np.concatenate(parts).reshape(-1, 3))


def _onset(contact: SurfaceContact, h: float, u: Array, v: Array) -> tuple[float, bool]:
    """Return where a step between displacements u and v ends for a contact that is open.

    The result is the part of the way, 1 without a contact, and whether the step ends behind it.
    """
    fastest = 2 * float(np.linalg.norm(v - u, axis=1).max())  # relative to each other
    depth = CONTACT_DEPTH * h
    if not fastest or not contact.come_near(u, v):
        return 1.0, False
    gap_at_low = contact.gap(u)
    if gap_at_low <= 0:
        return 1.0, False
    sets_in, least_thickness = gap_at_low < NEAR_CONTACT * depth, contact.least_thickness()
    low, high, gap_at_high, aim = 0.0, 0.0, 0.0, -depth if sets_in else depth
    for _ in range(MAX_GAP_EVALUATIONS):
        if high:
            part = low + (high - low) * (gap_at_low - aim) / (gap_at_low - gap_at_high)
        else:  # so far no face can pass through another one
            part = min(1.0, low + (gap_at_low + CROSSING_DISTANCE * least_thickness) / fastest)
        gap = contact.gap(u + part * (v - u))
        if gap < aim - depth:
            high, gap_at_high = part, gap
        elif gap <= aim + depth:
            return part, sets_in
        elif part == 1.0:
            return 1.0, False
        else:
            low, gap_at_low = part, gap
    return (high if sets_in else low) or low, sets_in
