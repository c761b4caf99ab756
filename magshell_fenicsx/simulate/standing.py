"""A scene that stands, with the fields of another case: nothing is meshed, compiled or made a form again."""

from collections.abc import Mapping
from dataclasses import dataclass

from mpi4py import MPI

from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.models.axisymmetric.model import MeridianModel
from magshell_fenicsx.models.shell import patterns
from magshell_fenicsx.models.shell.model import ShellModel
from magshell_fenicsx.models.shell.thickness import thickness_field
from magshell_fenicsx.parts.natural.shape import natural_field
from magshell_fenicsx.problem.planner import make_plan
from magshell_fenicsx.problem.problem import Plan
from magshell_fenicsx.simulate.scene import Scene

FIELDS = {"magnetic": {"remanent"}, "shell": {"thickness_factor"}, "natural": {"curvature"}}


@dataclass
class Standing:
    """The scene of the case before, to be used again."""

    scene: Scene | None = None

    def of(self, case: Case, comm: MPI.Comm) -> Scene:
        """The scene of a case; collective.

        Raises
        ------
        MeshError
            If it cannot be made.
        """
        known, self.scene = self.scene, None
        if known is None or not refilled(known, case):
            known = Scene(case, comm)
        self.scene = known
        return known


def refilled(scene: Scene, case: Case) -> bool:
    """Give a scene the remanence, thickness and natural curvature of a case; collective.

    Returns
    -------
    Whether they are all that differs and the scene has them as fields; otherwise it stays as it is.

    Raises
    ------
    MeshError
        If a field has no fit value somewhere; the scene is unfit then.
    """
    model = scene.model
    same = scene.case.model_dump(exclude=FIELDS) == case.model_dump(exclude=FIELDS)
    if not same or not model.thin or model.contacts or scene.plan.loads.dead:
        return False
    plan, old = make_plan(case, scene.plan.own), scene.plan
    if (old.axisymmetric, old.mirror, old.azimuth) != (plan.axisymmetric, plan.mirror, plan.azimuth):
        return False
    if _fields(plan) != _fields(old) or _patches(plan) or _patches(old):
        return False
    _put(model, plan)
    model.loads = plan.loads
    scene.case, scene.plan = case, plan
    scene.newton = BorderedNewton(model.system, scene.newton.options)
    scene.__dict__.pop("watch", None)
    return True


def _fields(plan: Plan) -> tuple[bool | str, ...]:
    """Which there are in the terms."""
    magnetic, natural = plan.loads.magnetic, plan.loads.natural
    grown = natural.amplitudes if natural else ()
    return callable(magnetic and magnetic.remanent), plan.thickness is not None, *grown


def _patches(plan: Plan) -> bool:
    """Whether one is given by patches of a mesh."""
    magnetic, natural, thickness = plan.loads.magnetic, plan.loads.natural, plan.thickness
    drawn = natural is not None and any(isinstance(v, Mapping) for v in (natural.curvature, natural.stretch))
    return drawn or bool((magnetic and magnetic.patches) or (thickness and thickness.patches))


def _put(model: ShellModel | MeridianModel, plan: Plan) -> None:
    magnetic, natural, r0 = plan.loads.magnetic, plan.loads.natural, model.r0
    there = {c.name: c for t in model.system.terms if isinstance(t, FormTerm) for c in t.form.coefficients()}
    if magnetic and callable(magnetic.remanent):
        there["Br"].x.array[:] = patterns.pattern_field(magnetic.remanent, r0)[0].x.array
    if plan.thickness and model.thickness:
        patches = model.midsurface.patches if model.midsurface else {}
        model.thickness.x.array[:] = thickness_field(plan.thickness, r0, patches).x.array
    if natural:
        there["natural"].x.array[:] = natural_field(natural, patterns.cells_of(r0), model.V).x.array
