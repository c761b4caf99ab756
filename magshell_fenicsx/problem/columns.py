"""The columns of path.csv that a case has besides those of every run, in one place, and that no two
have one name.
"""

from collections.abc import Collection
from dataclasses import replace
from math import isnan

import numpy as np

from magshell_fenicsx.input.section import given
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.registered import SEEN
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.quantities.quantity import TURN, WAY
from magshell_fenicsx.quantities.registry import IN_TIME, OF_EVERY_RUN, Sizes


def sizes_in_units(problem: Problem) -> Sizes:
    """The sizes of the case's units."""
    sizes = sizes_of(
        problem.context, {column for room in SEEN for column in room.moments(problem.loads)}
    )
    if sizes.given is None or isnan(sizes.given.R):
        return sizes
    ways = {name: way for room in SEEN for name, way in room.ways(problem.loads).items()}
    lengths = {
        name: (WAY, 1e3 * sizes.given.R * way)
        for name, (turns, way) in ways.items()
        if way and not turns
    }
    angles = {
        name: (TURN, float(np.degrees(way))) for name, (turns, way) in ways.items() if way and turns
    }
    return replace(sizes, ways=lengths | angles)


def own_amplitudes(loads: Loads) -> dict[str, float]:
    """Amplitudes that have columns of their own name, of rooms and of one's own energies, with
    initial values.
    """
    grown = {name: 0.0 for room in SEEN for name in room.named(loads)}
    terms = [term for term in loads.own if term.density]
    return (
        grown
        | {term.name: term.value for term in terms}
        | {p.name: p.value for term in terms for p in term.free}
    )


def extra_columns(problem: Problem) -> tuple[str, ...]:
    """The columns of a row besides those of every run; the last ones are those in the case's units."""
    loads = problem.loads
    named = tuple(f"{point}_u{axis}" for point in problem.context.points for axis in "xyz")
    own = (*own_amplitudes(loads), *(column for term in loads.own for column in term.observed))
    reported = problem.supports if problem.reactions else ()
    first = (
        column for room in SEEN if room.before_points for column in room.columns(loads, reported)
    )
    then = (
        column
        for room in SEEN
        if not room.before_points
        for column in room.columns(loads, reported)
    )
    moves = any(step.load.in_time or step.load.released_by for step in problem.programme)
    clock = tuple(q.name for q in IN_TIME) if moves else ()
    extra = (*first, *named, *own, *then, *clock)
    return (*extra, *sizes_in_units(problem).columns((*(q.name for q in OF_EVERY_RUN), *extra)))


def refuse_twice(problem: Problem) -> None:
    """See that no two columns of a run have the same name, and no two amplitudes.

    Raises
    ------
    CaseError
        With the name and the key that gives it.
    """
    loads = problem.loads
    varied = [*own_amplitudes(loads), *(name for room in SEEN for name in room.amplitudes(loads))]
    written = [*(q.name for q in OF_EVERY_RUN), *extra_columns(problem)]
    for names, what in ((varied, "amplitude"), (written, "column of path.csv")):
        if twice := next((name for name in names if names.count(name) > 1), None):
            steps = (
                f"{step.key}.name"
                for step in problem.programme
                if getattr(step.load, "name", None) == twice
            )
            key = next(steps, None) or next(
                (f"points.{point}" for point in problem.context.points if point in twice), "names"
            )
            raise CaseError(
                f"{key}: {twice}: another {what} of this case has this name; choose another"
            )


def sizes_of(context: Context, moments: Collection[str] = ()) -> Sizes:
    """The sizes of what a case gives with units; `moments` are columns of reactions that are
    moments.
    """
    shell = context.shell
    units = given(shell)
    for section in context.abilities:
        units = section.units(context, units)
    if shell.with_units and context.time_unit is not None:
        units = replace(units, second=1.0)
    return Sizes(units, moments)
