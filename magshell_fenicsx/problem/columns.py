"""The columns of path.csv that a case has besides those of every run, in one place, and that no two have one name."""

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.units import sizes_of
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.models.shell.parameters import Loads
from magshell_fenicsx.parts.registered import seen
from magshell_fenicsx.parts.supports.reacting import motion_columns, only_turns
from magshell_fenicsx.problem.problem import Plan
from magshell_fenicsx.quantities.registry import IN_TIME, OF_EVERY_RUN, Sizes


def sizes_in_units(case: Case, plan: Plan) -> Sizes:
    """The sizes of the case's units."""
    moments = {column for name, column in motion_columns(plan.loads).items() if only_turns(plan.loads, name)}
    return sizes_of(case, moments)


def own_amplitudes(loads: Loads) -> dict[str, float]:
    """The amplitudes of natural shape, imperfections, user-defined energies and parameters, with initial values."""
    grown = dict.fromkeys(loads.natural.amplitudes, 0.0) if loads.natural else {}
    grown |= dict.fromkeys(loads.growing, 0.0)
    terms = loads.own
    return grown | {term.name: term.value for term in terms} | {p.name: p.value for term in terms for p in term.free}


def extra_columns(case: Case, plan: Plan) -> tuple[str, ...]:
    """The columns of a row besides those of every run; the last ones are those in the case's units."""
    loads = plan.loads
    named = tuple(f"{point}_u{axis}" for point in case.points for axis in "xyz")
    own = (*own_amplitudes(loads), *(column for term in loads.own for column in term.observed))
    reported = plan.supports if plan.reactions else ()
    first = (column for room in seen() if room.before_points for column in room.columns(loads, reported))
    then = (column for room in seen() if not room.before_points for column in room.columns(loads, reported))
    moves = any(step.load.in_time or step.load.released_by for step in case.programme)
    clock = tuple(q.name for q in IN_TIME) if moves else ()
    extra = (*first, *named, *own, *then, *clock)
    return (*extra, *sizes_in_units(case, plan).columns((*(q.name for q in OF_EVERY_RUN), *extra)))


def refuse_twice(case: Case, plan: Plan) -> None:
    """See that no two columns of a run have the same name, and no two amplitudes.

    Raises
    ------
    CaseError
        With the name and the key that gives it.
    """
    loads = plan.loads
    varied = [*own_amplitudes(loads), *(name for room in seen() for name in room.amplitudes(loads))]
    written = [*(q.name for q in OF_EVERY_RUN), *extra_columns(case, plan)]
    for names, what in ((varied, "amplitude"), (written, "column of path.csv")):
        if twice := next((name for name in names if names.count(name) > 1), None):
            steps = (f"{step.key}.name" for step in case.programme if getattr(step.load, "name", None) == twice)
            key = next(steps, None) or next((f"points.{point}" for point in case.points if point in twice), "names")
            raise CaseError(f"{key}: {twice}: another {what} of this case has this name; choose another")
