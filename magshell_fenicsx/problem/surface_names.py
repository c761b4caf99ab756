"""Names that a problem uses: of its energies, and of edges, points and patches of the surface.

Each energy has a name of its own; edges, points and patches must be on the surface. A term is an
energy with an amplitude (its factor, a load parameter) of the same name. Parts are sections of a
case, a step is a load of its programme. A condition is a support. A live pressure follows the
surface, and may have no potential where an edge is free to move.
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError, PatchMesh, as_set
from magshell_fenicsx.models.shell.kinematics import SECOND_DERIVATIVES
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import Condition, HeldComponents
from magshell_fenicsx.models.shell.thickness import Thickness, patch_of
from magshell_fenicsx.parts.ability import Ability, Context
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.pressure.openings import moving_edges, without_potential
from magshell_fenicsx.parts.registered import OBSERVABLES
from magshell_fenicsx.parts.supports.supports import refuse_unknown
from magshell_fenicsx.quantities.registry import RESERVED_NAMES

# bounds of a part's amplitude, in E h/R^2: rounding, and what no mesh of a shell resolves
MIN_AMPLITUDE, MAX_AMPLITUDE = 1e-12, 1e9


def surface_terms(context: Context, user_terms: Sequence[OwnTerm]) -> tuple[OwnTerm, ...]:
    """Return the energies that follow from densities: those of parts, of steps, and of the user.

    Raises
    ------
    CaseError
        If a part's amplitude is out of bounds, a name is taken, or a solid cannot have a term.
    """
    terms = list[OwnTerm]()
    # several steps may drive one amplitude, which has its energy once
    for contributor, view in context.contributors(last_steps=True):
        contributed_terms = contributor.terms(view)
        if view.current_step is None:  # the amplitude of a step is what the step makes of it
            _refuse_unfit_amplitudes(context, contributor, contributed_terms)
        terms += contributed_terms
    terms += user_terms
    _refuse_taken_names(terms)
    if context.solid:
        _refuse_unfit_for_solid(terms)
    return tuple(terms)


def _refuse_unfit_amplitudes(context: Context, ability: Ability, terms: Sequence[OwnTerm]) -> None:
    """Refuse amplitudes of an ability's energies that are out of bounds, by a CaseError."""
    for term in terms:
        if term.density and not MIN_AMPLITUDE <= abs(term.value) <= MAX_AMPLITUDE:
            key = next(key for key, section in context.sections.items() if section is ability)
            raise CaseError(
                f"{key}: {term.name} is {term.value:.4g} E h/R²; "
                f"allowed are {MIN_AMPLITUDE:g} to {MAX_AMPLITUDE:g}"
            )


def _refuse_taken_names(terms: Sequence[OwnTerm]) -> None:
    """Refuse energies, reported integrals and parameters whose names are taken, by a CaseError."""
    names = list[str]()
    for term in terms:
        # a term without a density is only observed
        names += [term.name, *term.observed] if term.density else [*term.observed]
    # parameters may be shared by terms: a set has each once
    names += {p.name for term in terms for p in term.free_parameters}
    for name in names:
        if name in RESERVED_NAMES:
            owner = "an amplitude or a column of the package"
        elif names.count(name) > 1:
            owner = "another energy, integral or parameter of these terms"
        else:
            continue
        raise CaseError(
            f"terms: {name}: something else has this name already: {owner}; give another one, such "
            f"as own_{name}"
        )


def _refuse_unfit_for_solid(terms: Sequence[OwnTerm]) -> None:
    """Refuse terms that a solid cannot have, by a CaseError.

    These are energies of edges, and those that depend on second derivatives of the placement.
    """
    for term in terms:
        if term.on is not None:
            raise CaseError(
                f"model: solid: {term.name} is an energy of an edge, which only a shell has"
            )
        second_derivatives = [
            f"r0.{name}" for name in term.placement_parts if name in SECOND_DERIVATIVES
        ]
        if second_derivatives:
            raise CaseError(
                f"model: solid: {term.name} depends on {', '.join(second_derivatives)}, "
                "which only a shell has"
            )


def refuse_unfit(
    patch: PatchMesh, conditions: Mapping[str, Condition], loads: Loads, thickness: Thickness | None
) -> None:
    """Refuse a triangulation that lacks an edge, a point or a patch that the problem names.

    Parameters
    ----------
    conditions
        Name of an edge, a point or a patch -> its support.

    Raises
    ------
    MeshError
        With the missing name.
    """
    names = patch.edges, patch.points, patch.patches
    refuse_unknown(*names, conditions, loads, patch.inner_lines)
    _refuse_ambiguous(patch.edges, patch.points, conditions)
    for registered in OBSERVABLES:
        registered.refuse_unfit(loads, patch)
    # patches with a thickness of their own: `patch_of` raises if there is no such patch
    thickness_patches = thickness.patches if thickness else None
    for name in thickness_patches or {}:
        patch_of(patch.patches, name, "shell.thickness_factor")


def refuse_unfit_ends(
    ends: Collection[str],
    points: Collection[str],
    conditions: Mapping[str, Condition],
    loads: Loads,
) -> None:
    """Refuse a meridian that lacks an end or a point that the problem names.

    Parameters
    ----------
    ends, points
        Names that the meridian has.
    conditions
        Name of an end or a point -> its support.

    Raises
    ------
    MeshError
        With the missing name.
    """
    refuse_unknown(ends, points, [], conditions, loads)
    _refuse_ambiguous(ends, points, conditions)


def _refuse_ambiguous(
    edges: Collection[str], points: Collection[str], conditions: Mapping[str, Condition]
) -> None:
    """Refuse the support of a name that both an edge and a point have, by a MeshError."""
    for name, condition in conditions.items():
        is_ambiguous = name in edges and name in points
        if isinstance(condition, HeldComponents) and is_ambiguous:
            raise MeshError(f"boundary.{name}: is an edge and a point; give the point another name")


def _pairs_among(vertices: set[int], pairs: set[tuple[int, int]]) -> set[tuple[int, int]]:
    """Return the pairs of which both vertices are among some vertices."""
    return {pair for pair in pairs if vertices.issuperset(pair)}


def open_edges(
    patch: PatchMesh, conditions: Mapping[str, Condition], patch_names: Collection[str] = ()
) -> tuple[str, ...]:
    """Return the names of the edges at which a live pressure has no potential.

    Parameters
    ----------
    conditions
        Name of an edge -> its support.
    patch_names
        Patches that the pressure acts on; empty if it acts on the whole surface.
    """
    # name -> sides of triangles, as pairs of vertices
    pairs_of_edges = {name: as_set(pairs) for name, pairs in patch.edges.items()}
    # only sides with both vertices on patches under pressure count
    if patch_names:
        under_pressure = np.logical_or.reduce([patch.patches[name] for name in patch_names])
        vertices = set(map(int, patch.corners[under_pressure].ravel()))
        pairs_of_edges = {
            name: _pairs_among(vertices, pairs) for name, pairs in pairs_of_edges.items()
        }

    def places_of(name: str) -> NDArray[np.float64]:
        """Return the places (n, 3) of the vertices of an edge."""
        return patch.embedding(patch.nodes[np.unique(patch.edges[name])])

    return without_potential(moving_edges(pairs_of_edges, conditions), conditions, places_of)
