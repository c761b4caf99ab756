"""The energies of the mid-surface in a problem: those of registered parts and one's own."""

from collections.abc import Sequence

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.models.shell.kinematics import SECOND
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.registered import parts_of
from magshell_fenicsx.quantities.registry import TAKEN

LEAST, MOST = 1e-12, 1e9  # of a part's amplitude, in E h/R^2: rounding, and what no mesh of a shell resolves


def surface_terms(context: Context, own: Sequence[OwnTerm]) -> tuple[OwnTerm, ...]:
    """The terms of parts and of steps, then one's own.

    Raises
    ------
    CaseError
        If a part's amplitude is out of bounds, a name is taken, or a solid cannot have a term.
    """
    found = []
    for key, part in parts_of(context).items():
        for term in part.terms(context.scales):
            if not LEAST <= abs(term.value) <= MOST:
                raise CaseError(f"{key}: {term.name} is {term.value:.4g} E h/R²; allowed are {LEAST:g} to {MOST:g}")
            found.append(term)
    for step in {step.name: step for step in context.steps}.values():
        found += step.load.terms(step, context)
    found += own
    names = [name for term in found for name in (term.name, *term.observed)]
    names += {p.name for term in found for p in term.free}
    for name in names:
        if name in TAKEN or names.count(name) > 1:
            raise CaseError(f"terms: {name}: something else has this name already")
    for term in found if context.solid else []:
        if term.on is not None:
            raise CaseError(f"model: solid: {term.name} is an energy of an edge, which only a shell has")
        if curved := [f"r0.{name}" for name in term.placed_parts if name in SECOND]:
            raise CaseError(f"model: solid: {term.name} depends on {', '.join(curved)}, which only a shell has")
    return tuple(found)
