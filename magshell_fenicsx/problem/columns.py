"""Columns of path.csv that a case has besides those of every run, and the sizes of its units.

No two columns and no two amplitudes may have one name. An amplitude is a load parameter; its value
is a column. Observables are what parts read from a state; `OBSERVABLES` has all of them. Moments
are columns of reactions that are moments, not forces. R is the reference length.
"""

from collections.abc import Collection
from dataclasses import replace
from math import isnan

import numpy as np

from magshell_fenicsx.input.section import case_sizes
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.fields import MagneticSection
from magshell_fenicsx.parts.motion.motion_step import TimeSection
from magshell_fenicsx.parts.registered import OBSERVABLES
from magshell_fenicsx.parts.supports.reacting import moment_columns
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.quantities.quantity import DISTANCE, TURN, Unit
from magshell_fenicsx.quantities.registry import IN_TIME, OF_EVERY_RUN, Sizes


def sizes_in_units(problem: Problem) -> Sizes:
    """Return the sizes of the units of a case, by which columns of path.csv are given in units.

    Prescribed motions have sizes of their own: the way in mm, or the angle in degrees, at a factor
    1.
    """
    sizes = sizes_of(problem.context, moment_columns(problem.loads))
    # nan: the case has no unit of length
    if sizes.case_sizes is None or isnan(sizes.case_sizes.R):
        return sizes
    lengths, angles = dict[str, tuple[Unit, float]](), dict[str, tuple[Unit, float]]()
    for registered in OBSERVABLES:
        for name, (is_rotation, amount) in registered.motions(problem.loads).items():
            if amount and is_rotation:
                angles[name] = (TURN, float(np.degrees(amount)))
            elif amount:  # R in metres, the way in mm
                lengths[name] = (DISTANCE, 1e3 * sizes.case_sizes.R * amount)
    return replace(sizes, distances=lengths | angles)


def own_amplitudes(loads: Loads) -> dict[str, float]:
    """Return the amplitudes that have columns of their own name -> their initial values.

    They are those of parts, of user-defined energies, and of the parameters of these.
    """
    amplitudes = dict[str, float]()
    for registered in OBSERVABLES:
        amplitudes |= registered.free_amplitudes(loads)
    return amplitudes


def extra_columns(problem: Problem) -> tuple[str, ...]:
    """Return the columns of path.csv besides those of every run; those in units come last.

    The order is that of the file: parts, named points, amplitudes, observed integrals, further
    parts, time.
    """
    loads = problem.loads
    columns_of_points = [f"{point}_u{axis}" for point in problem.context.points for axis in "xyz"]
    reported_supports = problem.supports if problem.reactions else ()
    columns_of_rank: tuple[list[str], ...] = ([], [], [])
    for registered in OBSERVABLES:
        columns_of_rank[registered.column_rank].extend(registered.columns(loads, reported_supports))
    # a shell that is released at the end of a step moves in time too
    is_in_time = any(
        isinstance(step.load, TimeSection) or step.load.end.snap for step in problem.programme
    )
    columns_in_time = [q.name for q in IN_TIME] if is_in_time else []
    amplitudes = own_amplitudes(loads)
    before_points, integrals, behind = columns_of_rank
    own_columns = (
        *before_points,
        *columns_of_points,
        *amplitudes,
        *integrals,
        *behind,
        *columns_in_time,
    )
    standard_columns = [q.name for q in OF_EVERY_RUN]
    return (*own_columns, *sizes_in_units(problem).columns((*standard_columns, *own_columns)))


def refuse_duplicate_names(problem: Problem) -> None:
    """Refuse a problem in which two columns of path.csv, or two amplitudes, have the same name.

    Raises
    ------
    CaseError
        With the name and the key that gives it.
    """
    loads = problem.loads
    amplitudes_of_parts = [
        name for registered in OBSERVABLES for name in registered.amplitudes(loads)
    ]
    amplitudes = [*own_amplitudes(loads), *amplitudes_of_parts]
    columns = [*(q.name for q in OF_EVERY_RUN), *extra_columns(problem)]
    for names, kind_of_name in ((amplitudes, "amplitude"), (columns, "column of path.csv")):
        duplicate = next((name for name in names if names.count(name) > 1), None)
        if duplicate is not None:
            raise CaseError(
                f"{_key_of_name(problem, duplicate)}: {duplicate}: "
                f"another {kind_of_name} of this case has this name; choose another"
            )


def _key_of_name(problem: Problem, name: str) -> str:
    """Return the key of the case that gives a name of a column or amplitude, or "names"."""
    for step in problem.programme:
        if getattr(step.load, "name", None) == name:
            return f"{step.key}.name"
    for point in problem.context.points:
        if point in name:  # a column of a point begins with its name
            return f"points.{point}"
    return "names"


def sizes_of(context: Context, moments: Collection[str] = ()) -> Sizes:
    """Return the sizes of the units of a case, as the shell and other sections determine them.

    Parameters
    ----------
    moments
        Columns of reactions that are moments.
    """
    shell = context.shell
    units = case_sizes(shell)
    if magnetic := context.section_of(MagneticSection):
        units = magnetic.with_field(context, units)
    if shell.with_units and context.time_unit is not None:  # times of motions are in seconds
        units = replace(units, second=1.0)
    return Sizes(units, moments)
