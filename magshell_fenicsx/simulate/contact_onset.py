"""First contact between shells, or with a body, on the way to a predicted state.

A prediction from before a contact knows nothing of it: shells would overlap deeply, and Newton's
method would not converge. So a step ends just before the first contact, and the next one just
behind.

A step event says at which part of its way a step has to end, 1 for its whole way, and whether this
is behind a contact; and whether contact forces are lost on the way. A gap is the distance of two
faces, negative where they overlap.
"""

from collections.abc import Callable
from functools import partial

from magshell_fenicsx.continuation.step_control import StepEvent
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.parts.penalty_contact import GapAlongStep
from magshell_fenicsx.simulate.scene import Scene

# of the thickness: how far before and past the first contact the predictions of two steps lead
CONTACT_DEPTH = 2e-3
NEAR_CONTACT = 4.0  # of `CONTACT_DEPTH`: from so near a step leads past the first contact
MAX_GAP_EVALUATIONS = 40  # on the way of a step
DEEP_RATIO = 4.0  # penetration at a prediction over that at its point, above which it is deep


def first_contact(
    scene: Scene, leave: Callable[[State], State], here: State, prediction: State
) -> StepEvent:
    """Return where shells, or a shell and a body, that are apart first meet on the way of a step.

    The way between the two states is straight. The step ends just behind the contact if the first
    state is near it, else just before. The event also says whether a contact that is closed at the
    begin opens. Collective.

    Parameters
    ----------
    leave
        State of the step's system -> state of the model.
    here, prediction
        States of the step's system at both ends of the step.
    """
    states, h = (leave(here), leave(prediction)), scene.problem.material.h
    at_begin, at_end = map(scene.model.system.at_state, states)
    # part of the way at which the step ends, and whether this is behind a contact
    first_event = 1.0, False
    # shells may lie anywhere in each other
    loses_forces, is_deep = False, bool(scene.model.shell_contacts)
    for contact in scene.model.all_contacts:
        if not contact.ends_steps:
            continue
        depth = at_begin.evaluate(contact.penetration)
        if depth:  # it touches already: does it come apart?
            depth_at_end = at_end.evaluate(contact.penetration)
            loses_forces |= not depth_at_end
            is_deep |= depth_at_end > DEEP_RATIO * depth
            continue
        # it is open: where does it close?
        configuration = partial(getattr, contact, "configuration")
        ends = at_begin.evaluate(configuration), at_end.evaluate(configuration)
        gap_along_step = contact.gap_along_step(*ends)
        onset = _onset(gap_along_step, CONTACT_DEPTH * h) if gap_along_step else (1.0, False)
        # the earliest; of equal ones that behind a contact
        first_event = min(first_event, onset, key=lambda event: (event[0], not event[1]))
    part, is_behind = first_event
    return StepEvent(part, is_behind, loses_forces, is_deep or is_behind)


def _onset(gap_along_step: GapAlongStep, depth: float) -> tuple[float, bool]:
    """Return where a step on a way ends for a contact that is open; collective.

    The gap is evaluated on the way, first in steps so short that no face passes through another
    one. Then a bracket of the contact is divided by interpolation.

    Parameters
    ----------
    depth
        How far before and past the first contact the two steps end, over R.

    Returns
    -------
    part, is_behind
        The part of the way, 1 without a contact; and whether the step ends behind the contact.
    """
    gap_at_low = gap_along_step.gap(0.0)
    if gap_at_low <= 0:
        return 1.0, False
    # from near the contact the step ends behind it, at the gap -depth, else before it, at +depth
    is_behind = gap_at_low < NEAR_CONTACT * depth
    aimed_gap = -depth if is_behind else depth
    # bracket: parts of the way before and behind the aimed gap. high is 0 while it is not known
    low, high, gap_at_high = 0.0, 0.0, 0.0
    for _ in range(MAX_GAP_EVALUATIONS):
        if high:  # linear interpolation of the gap
            part = low + (high - low) * (gap_at_low - aimed_gap) / (gap_at_low - gap_at_high)
        else:  # so far no face can pass through another one
            part = min(
                1.0,
                low
                + (gap_at_low + gap_along_step.crossing_distance) / gap_along_step.largest_approach,
            )
        gap = gap_along_step.gap(part)
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
