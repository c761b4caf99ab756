"""The energy barrier that a probing force passes, as a result with gradients.

Both its ends are in equilibrium without the force, so that the energy changes by p alone,

    dJ/dp = Pi_p(end) - Pi_p(begin) + sum_i (mu_i(end) - mu_i(begin)) dq_i/dp,

with the conjugates q_i that the probing holds: they are those of its begin, where one solve is for them.
"""

import numpy as np

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.simulate.gradients.adjoint import NONE, Adjoint, Begins, Place, held_at, solved, with_begins
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import Functional, barrier
from magshell_fenicsx.simulate.scene import Scene

BARRIER = "barrier"


def refuse_no_barrier(problem: Problem) -> None:
    """See that a case ends where a probing force is zero again.

    Raises
    ------
    CaseError
        If it does not.
    """
    if not problem.programme or problem.programme[-1].until != "zero":
        raise CaseError("barrier: needs a last step with until: zero")


def adjoint_of_barrier(scene: Scene, begin: Record | None, end: Record, begins: Begins = NONE) -> Adjoint:
    """The adjoint of the barrier between the begin and the end of the last step.

    Raises
    ------
    CaseError
        If the last step passes none, or holds a gas.
    """
    refuse_no_barrier(scene.problem)
    if begin is None:
        raise CaseError("barrier: give the record before the last step")
    system, step, whole = scene.model.system, scene.problem.programme[-1], scene.model.multiplicity
    before, after = (system.placed(record.point.state) for record in (begin, end))
    held, change = held_at(scene, end, after), dict[str, float]()
    for name, conjugate in held.items():
        if callable(conjugate):
            raise CaseError(f"barrier: {name}: no gradient while a gas is held")
        change[name] = whole * (after.mu[name] - before.mu[name])
    slope = -np.sum([c * system.load(before.u, before.mu, name) for name, c in change.items()], axis=0)
    q = {name: -c for name, c in change.items()}
    w, rows = 0.0 * before.u, dict[str, float]()
    if change:
        w, rows = solved(scene, before, Functional(0.0, slope, potentials=q), held_at(scene, begin, before))
    at_begin = Place(before, w, rows, -whole, q, steps=begin.step)
    earlier = with_begins(Adjoint(scene, [at_begin]), begin, begins)
    still, unknown = 0.0 * after.u, dict.fromkeys(held, 0.0)
    ends = [Place(after, still, unknown, whole), Place(before, still, unknown, -whole)]
    left = with_begins(Adjoint(scene, ends), end, begins)  # loads as earlier steps have left them
    places = [ends[0], *earlier.places, *left.places[2:]]
    value, names = barrier(scene, step, before, after), earlier.left | left.left
    return Adjoint(scene, places, value=value, left=names)
