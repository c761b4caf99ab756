"""What results and parameters a problem will have, by names alone: for `magshell check`, which builds nothing."""

from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.shell.parameters import ACROSS, EdgeMoment, Potential
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.shape.sections import MeshSurface
from magshell_fenicsx.simulate.gradients.mass import MASS
from magshell_fenicsx.simulate.gradients.results import refuse_no_result
from magshell_fenicsx.simulate.numbers import refuse_unknown_parameters
from magshell_fenicsx.simulate.scene import Scene


class Expected(Scene):
    """A scene as far as names go."""

    def __init__(self, problem: Problem) -> None:
        loads = problem.loads
        size = {
            name: 1.0
            for name, several in loads.dead.items()
            if not all(isinstance(load, EdgeMoment | Potential) for load in several)
        }
        highest = ["pole"] if isinstance(problem.context.shell, MeshSurface) else []
        model = SimpleNamespace(
            loads=loads,
            normals=dict.fromkeys([*problem.points, *highest]),
            contacts=dict.fromkeys(contact.amplitude for contact in loads.contacts),
            load_size=size,
            force_unit=1.0,
            system=SimpleNamespace(history={}),
        )
        vars(self).update(problem=problem, model=model)

    def unloaded(self) -> State:
        """The amplitudes, of no displacement."""
        loads = self.problem.loads
        field = loads.magnetic
        across = ACROSS[: len(field.across)] if field else ()
        driven = ("lambda_m", *across, *(motion.name for motion in field.turns)) if field else ()
        names = [*(["pressure"] if loads.pressure else []), *driven, *loads.forces, *loads.dead, *self._own_amplitudes]
        names += [*self.motions, *self.sources, *self.model.contacts]
        return State(np.zeros(0), dict.fromkeys(names, 0.0))

    def conjugate_unit(self, name: str) -> float:
        """Of nothing that is built."""
        return 1.0


def refuse_unknown_results(problem: Problem, designed: Mapping[str, str]) -> None:
    """See that the results and parameters of gradients, and the results of a design, are there, by the names alone.

    Parameters
    ----------
    designed
        Results of the design, and the keys that name them.

    Raises
    ------
    CaseError
        If one is not.
    """
    if not (problem.gradients or designed):
        return
    scene = Expected(problem)
    if asked := problem.gradients:
        refuse_no_result(scene, asked.of, "gradients.of")
        refuse_unknown_parameters(problem.context, asked.by, scene.unloaded())
    for result, key in designed.items():
        if result != MASS:
            refuse_no_result(scene, [result], key, more=[MASS])
