"""The columns of path.csv that a case has besides those of every run, in one place, and that no two have one name."""

from collections.abc import Collection
from dataclasses import replace
from math import isnan

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.input.targets import given
from magshell_fenicsx.models.shell.parameters import Loads
from magshell_fenicsx.parts.magnetism.fields import MU_0, MagneticSection, strength
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.registered import seen
from magshell_fenicsx.parts.supports.reacting import motion_columns, only_turns
from magshell_fenicsx.problem.problem import Plan
from magshell_fenicsx.quantities.registry import IN_TIME, OF_EVERY_RUN, Sizes


def sizes_in_units(plan: Plan) -> Sizes:
    """The sizes of the case's units."""
    moments = {column for name, column in motion_columns(plan.loads).items() if only_turns(plan.loads, name)}
    return sizes_of(plan.context, moments)


def own_amplitudes(loads: Loads) -> dict[str, float]:
    """The amplitudes of natural shape, imperfections, user-defined energies and parameters, with initial values."""
    grown = dict.fromkeys(loads.natural.amplitudes, 0.0) if loads.natural else {}
    grown |= dict.fromkeys(loads.growing, 0.0)
    terms = loads.own
    return grown | {term.name: term.value for term in terms} | {p.name: p.value for term in terms for p in term.free}


def extra_columns(plan: Plan) -> tuple[str, ...]:
    """The columns of a row besides those of every run; the last ones are those in the case's units."""
    loads = plan.loads
    named = tuple(f"{point}_u{axis}" for point in plan.context.points for axis in "xyz")
    own = (*own_amplitudes(loads), *(column for term in loads.own for column in term.observed))
    reported = plan.supports if plan.reactions else ()
    first = (column for room in seen() if room.before_points for column in room.columns(loads, reported))
    then = (column for room in seen() if not room.before_points for column in room.columns(loads, reported))
    moves = any(step.load.in_time or step.load.released_by for step in plan.programme)
    clock = tuple(q.name for q in IN_TIME) if moves else ()
    extra = (*first, *named, *own, *then, *clock)
    return (*extra, *sizes_in_units(plan).columns((*(q.name for q in OF_EVERY_RUN), *extra)))


def refuse_twice(plan: Plan) -> None:
    """See that no two columns of a run have the same name, and no two amplitudes.

    Raises
    ------
    CaseError
        With the name and the key that gives it.
    """
    loads = plan.loads
    varied = [*own_amplitudes(loads), *(name for room in seen() for name in room.amplitudes(loads))]
    written = [*(q.name for q in OF_EVERY_RUN), *extra_columns(plan)]
    for names, what in ((varied, "amplitude"), (written, "column of path.csv")):
        if twice := next((name for name in names if names.count(name) > 1), None):
            steps = (f"{step.key}.name" for step in plan.programme if getattr(step.load, "name", None) == twice)
            key = next(steps, None) or next(
                (f"points.{point}" for point in plan.context.points if point in twice), "names"
            )
            raise CaseError(f"{key}: {twice}: another {what} of this case has this name; choose another")


def sizes_of(context: Context, moments: Collection[str] = ()) -> Sizes:
    """The sizes of what a case gives with units; `moments` are columns of reactions that are moments."""
    shell, magnetic = context.shell, context.of(MagneticSection)
    units = given(shell)
    if magnetic and magnetic.remanent.flux_density and not isnan(units.E):
        if magnetic.applied.beside:
            units = replace(units, applied=1e3 * MU_0 * units.E / magnetic.remanent.flux_density)
        else:
            units = replace(units, strength=100 / strength(context))
    if shell.with_units and context.time_unit is not None:
        units = replace(units, second=1.0)
    return Sizes(units, moments)
