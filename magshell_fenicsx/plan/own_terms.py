"""One's own terms in the plan: their names, and a model that shares their symmetry."""

from collections.abc import Sequence
from dataclasses import replace

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.mesh.mirror import Y0
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.output.store.table import COLUMNS
from magshell_fenicsx.plan.plan import Plan
from magshell_fenicsx.plan.planner import make_plan

AMPLITUDES = ("pressure", "force", "load", "load_factor", "turn", "push", "lambda_m", "lambda_across")
ENERGIES = ("membrane", "couple")  # besides those with a column


def plan_with(case: Case, terms: Sequence[OwnTerm]) -> Plan:
    """Plan a case with one's own terms; what `symmetry: auto` takes is the smallest model that all of them allow.

    Raises
    ------
    CaseError
        As `make_plan`; if a term has the name of something else, if the symmetry that is asked for
        is not the terms', or if the case is of a solid.
    """
    if terms and case.model == "solid":
        raise CaseError("model: solid: one's own terms are energies of a mid-surface")
    names = [term.name for term in terms]
    for name in names:
        if name in (*AMPLITUDES, *ENERGIES, *COLUMNS) or names.count(name) > 1:
            raise CaseError(f"terms: {name}: something else has this name already")
    plan = make_plan(case)
    if wrong := _not_sharing(plan, terms):
        if case.symmetry != "auto":
            raise CaseError(f"symmetry: {case.symmetry}: the energy {wrong.name} does not share it")
        smaller = ("half", "none") if plan.axisymmetric else ("none",)
        plans = (make_plan(case.model_copy(update={"symmetry": symmetry})) for symmetry in smaller)
        plan = next(each for each in plans if not _not_sharing(each, terms))
    included = [*plan.included, *(f"own energy: {name}" for name in names)]
    return replace(plan, loads=replace(plan.loads, own=tuple(terms)), included=included)


def _not_sharing(plan: Plan, terms: Sequence[OwnTerm]) -> OwnTerm | None:
    """A term that a reduced model cannot have."""

    def shares(term: OwnTerm) -> bool:
        if plan.axisymmetric:
            return term.turns and term.mirrored(Y0)
        return not plan.mirror or (term.mirrored(plan.mirror) and (term.turns or plan.azimuth == 0))

    return next((term for term in terms if not shares(term)), None)
