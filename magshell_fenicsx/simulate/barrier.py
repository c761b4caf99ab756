"""The energy barrier that a probing force passes: its work from zero, over its largest value, back to zero."""

import scipy

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.steps import held_by


def barrier(scene: Scene, step: ProgrammeStep, begin: State, end: State) -> float:
    """The work of a step's load between two states without this load, over E h R^2; collective.

    It is the change of the energy under the other loads as they are held: that of Pi, plus the integral of q dmu for
    each amplitude whose conjugate q is held.
    """
    held = held_by(scene, step, begin)
    before, after = (sum(scene.energies(state).values()) for state in (begin, end))
    change = after - before
    for name, q in held.items():
        a, b = begin.mu[name], end.mu[name]
        work = scipy.integrate.quad(lambda mu, q=q: q(mu)[0], a, b)[0] if callable(q) else q * (b - a)
        change += scene.model.multiplicity * work
    return float(change)
