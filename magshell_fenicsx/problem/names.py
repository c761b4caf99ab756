"""The energies of a problem, each with its own name; its edges, points and patches, which the
surface must have.
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError, PatchMesh
from magshell_fenicsx.models.shell.kinematics import SECOND
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import Condition, Held
from magshell_fenicsx.models.shell.thickness import Thickness, patch_of
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.pressure.openings import moving, without_potential
from magshell_fenicsx.parts.registered import SEEN, parts_of
from magshell_fenicsx.parts.supports.supports import refuse_unknown
from magshell_fenicsx.quantities.registry import TAKEN

LEAST, MOST = (
    1e-12,
    1e9,
)  # of a part's amplitude, in E h/R^2: rounding, and what no mesh of a shell resolves


def surface_terms(context: Context, own: Sequence[OwnTerm]) -> tuple[OwnTerm, ...]:
    """The terms of parts and of steps, then one's own.

    Raises
    ------
    CaseError
        If a part's amplitude is out of bounds, a name is taken, or a solid cannot have a term.
    """
    terms = []
    for key, part in parts_of(context).items():
        for term in part.terms(context.scales):
            if term.density and not LEAST <= abs(term.value) <= MOST:
                raise CaseError(
                    f"{key}: {term.name} is {term.value:.4g} E h/R²; allowed are {LEAST:g} to {MOST:g}"
                )
            terms.append(term)
    for step in {step.name: step for step in context.steps}.values():
        terms += step.load.terms(step, context)
    terms += own
    names = [
        name
        for term in terms
        for name in ((term.name,) if term.density else ()) + tuple(term.observed)
    ]
    names += {p.name for term in terms for p in term.free}
    for name in names:
        if name in TAKEN or names.count(name) > 1:
            raise CaseError(f"terms: {name}: something else has this name already")
    for term in terms if context.solid else []:
        if term.on is not None:
            raise CaseError(
                f"model: solid: {term.name} is an energy of an edge, which only a shell has"
            )
        if curved := [f"r0.{name}" for name in term.placed_parts if name in SECOND]:
            raise CaseError(
                f"model: solid: {term.name} depends on {', '.join(curved)}, which only a shell has"
            )
    return tuple(terms)


def refuse_unfit(
    patch: PatchMesh, conditions: Mapping[str, Condition], loads: Loads, thickness: Thickness | None
) -> None:
    """See that every name is there.

    Raises
    ------
    MeshError
        With the name.
    """
    refuse_unknown(patch.edges, patch.points, patch.patches, conditions, loads)
    _refuse_ambiguous(patch.edges, patch.points, conditions)
    for room in SEEN:
        room.refuse_unfit(loads, patch)
    for name in (thickness and thickness.patches) or {}:
        patch_of(patch.patches, name, "shell.thickness_factor")


def refuse_unfit_ends(
    ends: Collection[str],
    points: Collection[str],
    conditions: Mapping[str, Condition],
    loads: Loads,
) -> None:
    """The same of a meridian, which has ends and points.

    Raises
    ------
    MeshError
        With the name.
    """
    refuse_unknown(ends, points, [], conditions, loads)
    _refuse_ambiguous(ends, points, conditions)


def _refuse_ambiguous(
    edges: Collection[str], points: Collection[str], conditions: Mapping[str, Condition]
) -> None:
    for name, condition in conditions.items():
        if isinstance(condition, Held) and name in edges and name in points:
            raise MeshError(f"boundary.{name}: is an edge and a point; give the point another name")


def open_edges(
    patch: PatchMesh, conditions: Mapping[str, Condition], on: Collection[str] = ()
) -> tuple[str, ...]:
    """The edges at which a live pressure has no potential; `on` are the patches that it acts on,
    all without.
    """
    sides = {
        name: {(int(a), int(b)) for a, b in np.sort(edge, axis=1)}
        for name, edge in patch.edges.items()
    }
    if on:
        inside = np.logical_or.reduce([patch.patches[name] for name in on])
        vertices = set(map(int, patch.corners[inside].ravel()))
        sides = {
            name: {pair for pair in pairs if vertices.issuperset(pair)}
            for name, pairs in sides.items()
        }
    return without_potential(
        moving(sides, conditions),
        conditions,
        lambda name: patch.embedding(patch.nodes[np.unique(patch.edges[name])]),
    )
