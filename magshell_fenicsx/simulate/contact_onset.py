"""First contact between shells on the way to a predicted state.

A prediction from before a contact knows nothing of it: shells would overlap deeply, and Newton's
method would not converge. So a step ends just before the first contact, and the next one just
behind.

A step event says at which part of its way a step has to end, 1 for its whole way, and whether this
is behind a contact; and whether contact forces are lost on the way. A gap is the distance of two
faces, negative where they overlap.
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
    """Return where shells that are apart first meet on the way of a step; collective.

    The way between the two states is straight. The step ends just behind the contact if the first
    state is near it, else just before. The event also says whether a pair that touches at the begin
    comes apart.

    Parameters
    ----------
    leave
        State of the step's system -> state of the model.
    here, prediction
        States of the step's system at both ends of the step.
    """
    # contacts of surfaces alone: steps of a meridian do without this
    contacts = [
        contact for contact in scene.model.shell_contacts if isinstance(contact, SurfaceContact)
    ]
    if not contacts:
        return StepEvent()
    states = leave(here), leave(prediction)
    at_begin, at_end = map(scene.model.system.at_state, states)
    begin_displacement, end_displacement = (gathered_displacement(scene, state) for state in states)
    # part of the way at which the step ends, and whether this is behind a contact
    first_event = 1.0, False
    loses_forces = False
    for contact in contacts:
        if at_begin.evaluate(contact.penetration):  # it touches already: does it come apart?
            loses_forces |= not at_end.evaluate(contact.penetration)
        else:  # it is open: where does it close?
            onset = _onset(contact, scene.problem.material.h, begin_displacement, end_displacement)
            # the earliest; of equal ones that behind a contact
            first_event = min(first_event, onset, key=lambda event: (event[0], not event[1]))
    return StepEvent(*first_event, loses_forces)


def gathered_displacement(scene: Scene, state: State) -> Array:
    """Return the displacement (nodes, 3) of all ranks' nodes, over R; collective."""
    system = scene.model.system
    displacements_of_ranks = scene.comm.allgather(
        system.with_ghosts(state.u, state.mu)[: system.size]
    )
    return np.asarray(np.concatenate(displacements_of_ranks).reshape(-1, 3))


def _onset(contact: SurfaceContact, h: float, u: Array, v: Array) -> tuple[float, bool]:
    """Return where a step between two displacements ends for a contact that is open; collective.

    The gap is evaluated on the way, first in steps so short that no face passes through another
    one. Then a bracket of the contact is divided by interpolation.

    Parameters
    ----------
    h
        Thickness over R.
    u, v
        Displacements (nodes, 3) of all ranks at both ends of the step.

    Returns
    -------
    part, is_behind
        The part of the way, 1 without a contact; and whether the step ends behind the contact.
    """
    # two nodes come nearer to each other by at most twice the largest displacement
    largest_approach = 2 * float(np.linalg.norm(v - u, axis=1).max())
    depth = CONTACT_DEPTH * h
    if not largest_approach or not contact.come_near(u, v):
        return 1.0, False
    gap_at_low = contact.gap(u)
    if gap_at_low <= 0:
        return 1.0, False
    # from near the contact the step ends behind it, at the gap -depth, else before it, at +depth
    is_behind = gap_at_low < NEAR_CONTACT * depth
    aimed_gap = -depth if is_behind else depth
    least_thickness = contact.least_thickness()
    # bracket: parts of the way before and behind the aimed gap. high is 0 while it is not known
    low, high, gap_at_high = 0.0, 0.0, 0.0
    for _ in range(MAX_GAP_EVALUATIONS):
        if high:  # linear interpolation of the gap
            part = low + (high - low) * (gap_at_low - aimed_gap) / (gap_at_low - gap_at_high)
        else:  # so far no face can pass through another one
            part = min(
                1.0, low + (gap_at_low + CROSSING_DISTANCE * least_thickness) / largest_approach
            )
        gap = contact.gap(u + part * (v - u))
        if gap < aimed_gap - depth:  # too far
            high, gap_at_high = part, gap
        elif gap <= aimed_gap + depth:  # exact enough
            return part, is_behind
        elif part == 1.0:  # the whole way is free
            return 1.0, False
        else:  # not far enough
            low, gap_at_low = part, gap
    # not exact enough after all evaluations: the end of the bracket on the wanted side, if known
    return (high if is_behind else low) or low, is_behind
