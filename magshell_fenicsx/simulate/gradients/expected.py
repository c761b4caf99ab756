"""What results and parameters a case will have, by its plan alone: for `magshell check`, which builds nothing."""

from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.shell.parameters import ACROSS, EdgeMoment, Potential
from magshell_fenicsx.problem.planner import make_plan
from magshell_fenicsx.problem.problem import Plan
from magshell_fenicsx.shape.sections import MeshSurface
from magshell_fenicsx.simulate.gradients.mass import MASS
from magshell_fenicsx.simulate.gradients.results import refuse_no_result
from magshell_fenicsx.simulate.numbers import refuse_unknown_parameters
from magshell_fenicsx.simulate.scene import Scene


class Expected(Scene):
    """A scene as far as names go."""

    def __init__(self, case: Case, plan: Plan) -> None:
        loads = plan.loads
        size = {
            name: 1.0
            for name, several in loads.dead.items()
            if not all(isinstance(load, EdgeMoment | Potential) for load in several)
        }
        highest = ["pole"] if isinstance(case.shell, MeshSurface) else []
        model = SimpleNamespace(
            loads=loads,
            normals=dict.fromkeys([*plan.points, *highest]),
            contacts=dict.fromkeys(contact.amplitude for contact in loads.contacts),
            load_size=size,
            force_unit=1.0,
            system=SimpleNamespace(history={}),
        )
        vars(self).update(case=case, plan=plan, model=model)

    def unloaded(self) -> State:
        """The amplitudes, of no displacement."""
        loads = self.plan.loads
        field = loads.magnetic
        across = ACROSS[: len(field.across)] if field else ()
        driven = ("lambda_m", *across, *(motion.name for motion in field.turns)) if field else ()
        names = [*(["pressure"] if loads.pressure else []), *driven, *loads.forces, *loads.dead, *self._own_amplitudes]
        names += [*self.motions, *self.sources, *self.model.contacts]
        return State(np.zeros(0), dict.fromkeys(names, 0.0))

    def conjugate_unit(self, name: str) -> float:
        """Of nothing that is built."""
        return 1.0


def refuse_unknown_results(case: Case, designed: Mapping[str, str]) -> None:
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
    if not (case.gradients or designed):
        return
    scene = Expected(case, make_plan(case))
    if case.gradients:
        refuse_no_result(scene, case.gradients.of, "gradients.of")
        refuse_unknown_parameters(case, case.gradients.by, scene.unloaded())
    for result, key in designed.items():
        if result != MASS:
            refuse_no_result(scene, [result], key, more=[MASS])
