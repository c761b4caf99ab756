"""The columns of path.csv that a case has besides those of every run, in one place, and that no two have one name."""

from collections.abc import Collection
from dataclasses import replace
from math import isnan

import numpy as np

from magshell_fenicsx.input.section import given
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.models.shell.parameters import Loads
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.registered import seen
from magshell_fenicsx.parts.supports.reacting import motion_columns, motion_size, only_turns
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.quantities.quantity import TURN, WAY, Unit
from magshell_fenicsx.quantities.registry import IN_TIME, OF_EVERY_RUN, Sizes


def sizes_in_units(problem: Problem) -> Sizes:
    """The sizes of the case's units."""
    moments = {column for name, column in motion_columns(problem.loads).items() if only_turns(problem.loads, name)}
    sizes = sizes_of(problem.context, moments)
    return replace(sizes, ways=_ways(problem.loads, sizes.given.R) if sizes.given else {})


def _ways(loads: Loads, R: float) -> dict[str, tuple[Unit, float]]:
    """How far the motion of each amplitude goes at one, in mm, or turns, in degrees; R in metres, nan without units."""
    if isnan(R):
        return {}
    turning = {name: only_turns(loads, name) for name in motion_columns(loads)}
    sizes = {name: motion_size(loads, name) for name in turning}
    for driven in loads.magnetic.driven if loads.magnetic else ():
        for motion in driven.motions:
            turning[motion.name] = not motion.shift.any()
            sizes[motion.name] = float(np.linalg.norm(motion.turn if turning[motion.name] else motion.shift))
    return {
        name: (TURN, float(np.degrees(size))) if turning[name] else (WAY, 1e3 * R * size)
        for name, size in sizes.items()
        if size
    }


def own_amplitudes(loads: Loads) -> dict[str, float]:
    """Amplitudes that have columns of their own name, of rooms and of one's own energies, with initial values."""
    grown, terms = {name: 0.0 for room in seen() for name in room.named(loads)}, loads.own
    return grown | {term.name: term.value for term in terms} | {p.name: p.value for term in terms for p in term.free}


def extra_columns(problem: Problem) -> tuple[str, ...]:
    """The columns of a row besides those of every run; the last ones are those in the case's units."""
    loads = problem.loads
    named = tuple(f"{point}_u{axis}" for point in problem.context.points for axis in "xyz")
    own = (*own_amplitudes(loads), *(column for term in loads.own for column in term.observed))
    reported = problem.supports if problem.reactions else ()
    first = (column for room in seen() if room.before_points for column in room.columns(loads, reported))
    then = (column for room in seen() if not room.before_points for column in room.columns(loads, reported))
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
    varied = [*own_amplitudes(loads), *(name for room in seen() for name in room.amplitudes(loads))]
    written = [*(q.name for q in OF_EVERY_RUN), *extra_columns(problem)]
    for names, what in ((varied, "amplitude"), (written, "column of path.csv")):
        if twice := next((name for name in names if names.count(name) > 1), None):
            steps = (f"{step.key}.name" for step in problem.programme if getattr(step.load, "name", None) == twice)
            key = next(steps, None) or next(
                (f"points.{point}" for point in problem.context.points if point in twice), "names"
            )
            raise CaseError(f"{key}: {twice}: another {what} of this case has this name; choose another")


def sizes_of(context: Context, moments: Collection[str] = ()) -> Sizes:
    """The sizes of what a case gives with units; `moments` are columns of reactions that are moments."""
    shell = context.shell
    units = given(shell)
    for section in context.abilities:
        units = section.units(context, units)
    if shell.with_units and context.time_unit is not None:
        units = replace(units, second=1.0)
    return Sizes(units, moments)
