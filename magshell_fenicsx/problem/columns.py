"""The columns of path.csv that a case has besides those of every run, in one place, and that no two have one name."""

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.units import sizes_of
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.models.shell.parameters import Loads
from magshell_fenicsx.parts.supports.reacting import columns, motion_columns, source_columns
from magshell_fenicsx.problem.problem import Plan
from magshell_fenicsx.quantities.registry import IN_TIME, OF_EVERY_RUN, Sizes, amplitude, contact_columns


def sizes_in_units(case: Case, plan: Plan) -> Sizes:
    """The sizes of the case's units."""
    moments = {column for name, column in motion_columns(plan.loads).items() if only_turns(plan.loads, name)}
    return sizes_of(case, moments)


def only_turns(loads: Loads, name: str) -> bool:
    """Whether a motion has rotations alone, so that its reaction is a moment."""
    return not any(m.motion.shift.any() for m in loads.moves if m.motion.name == name)


def own_amplitudes(loads: Loads) -> dict[str, float]:
    """The amplitudes of natural shape, imperfections, user-defined energies and parameters, with initial values."""
    grown = dict.fromkeys(loads.natural.amplitudes, 0.0) if loads.natural else {}
    grown |= dict.fromkeys(loads.growing, 0.0)
    terms = loads.own
    return grown | {term.name: term.value for term in terms} | {p.name: p.value for term in terms for p in term.free}


def also_displaced(loads: Loads) -> tuple[str, ...]:
    """Amplitudes with a displacement besides the one of the column w_over_h."""
    return tuple(name for name in (*loads.forces, *loads.dead) if name != loads.displaced)


def support_columns(plan: Plan) -> tuple[str, ...]:
    """The factors of motions, their reactions, and those of all supports."""
    motions = motion_columns(plan.loads)
    return (*motions, *motions.values(), *(columns(plan.supports) if plan.reactions else ()))


def extra_columns(case: Case, plan: Plan) -> tuple[str, ...]:
    """The columns of a row besides those of every run; the last ones are those in the case's units."""
    loads = plan.loads
    named = tuple(f"{point}_u{axis}" for point in case.points for axis in "xyz")
    own = (*own_amplitudes(loads), *(column for term in loads.own for column in term.observed))
    factors = (amplitude(name).column for name in (*loads.forces, *loads.dead) if name != "force")
    displaced = (f"w_{name}_over_h" for name in also_displaced(loads))
    moves = any(step.load.in_time or step.load.released_by for step in case.programme)
    clock = tuple(q.name for q in IN_TIME) if moves else ()
    sources = source_columns(loads)
    contacts = (column for c in loads.contacts for column in contact_columns(c.amplitude) if column != "force")
    extra = (*factors, *displaced, *named, *own, *support_columns(plan), *sources, *sources.values(), *contacts, *clock)
    return (*extra, *sizes_in_units(case, plan).columns((*(q.name for q in OF_EVERY_RUN), *extra)))


def refuse_twice(case: Case, plan: Plan) -> None:
    """See that no two columns of a run have the same name, and no two amplitudes.

    Raises
    ------
    CaseError
        With the name and the key that gives it.
    """
    loads = plan.loads
    varied = [*own_amplitudes(loads), *motion_columns(loads), *source_columns(loads), *loads.forces, *loads.dead]
    varied += [name for c in loads.contacts for name in (c.amplitude, c.setting)]
    written = [*(q.name for q in OF_EVERY_RUN), *extra_columns(case, plan)]
    for names, what in ((varied, "amplitude"), (written, "column of path.csv")):
        if twice := next((name for name in names if names.count(name) > 1), None):
            steps = (f"{step.key}.name" for step in case.programme if getattr(step.load, "name", None) == twice)
            key = next(steps, None) or next((f"points.{point}" for point in case.points if point in twice), "names")
            raise CaseError(f"{key}: {twice}: another {what} of this case has this name; choose another")
