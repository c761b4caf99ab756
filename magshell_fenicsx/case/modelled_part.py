"""Part of a shell that is modelled: its meridian, a half, a sector of waves, or all of it.

A shell, its imperfections, supports, fields and loads each preserve some symmetry, a
`SymmetryConstraint`. From these follows the smallest part that has the whole solution. The model's
frame is turned about e3 so that the part's symmetry plane is its plane y = 0.

An outline is the surface of a shell with its edges; it is round if it is a surface of revolution
about e3. A `Mirror` is a symmetry plane, a `Sector` the part between two planes through e3. An
imperfection grows if a load step multiplies it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import ROUNDING, Y0_PLANE, Mirror, Sector, rotation
from magshell_fenicsx.mesh.msh import MeshFile, read_msh
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import Condition, HeldComponents
from magshell_fenicsx.parts.forces.dead_load_step import DeadLoadSection, DeadSection
from magshell_fenicsx.parts.imperfections.imperfection import imperfection_geometries
from magshell_fenicsx.parts.imperfections.symmetry import imperfection_constraints
from magshell_fenicsx.parts.laminate import ShellLaminate
from magshell_fenicsx.parts.shell_outline import reference_shell_of
from magshell_fenicsx.parts.shell_sections import MeshSurface
from magshell_fenicsx.parts.supports.boundary import BoundarySection, EdgeCondition, HeldSection
from magshell_fenicsx.shape.outline import ANY_GRADING, Outline
from magshell_fenicsx.shape.symmetry_constraint import (
    SymmetryConstraint,
    common_mirror,
    common_sector,
    energy_without_mirror,
    points_constraint,
    shape_constraint,
    tilted,
    unit,
    why_not_axisymmetric,
)


@dataclass(frozen=True)
class ModelledPart:
    """The part of a shell that is modelled, and the frame of its model.

    Attributes
    ----------
    axisymmetric
        Whether the meridian is modelled.
    plane
        Symmetry plane of a half, or the sector, in the frame of the case; None for all of the shell
        or its meridian.
    turn
        Angle about e3 (rad) by which the model's frame is turned from that of the case.
    mirror
        The same plane or sector in the model's frame.
    """

    axisymmetric: bool
    plane: Mirror | None
    turn: float
    mirror: Mirror | None

    @property
    def is_symmetric(self) -> bool:
        """Whether a half or a sector is modelled."""
        return self.plane is not None

    @property
    def sector(self) -> Sector | None:
        """The sector in the model's frame; None if no sector is modelled."""
        return self.mirror if isinstance(self.mirror, Sector) else None

    def name(self, model: str) -> str:
        """Return the part in words, such as "half shell"; `model` is "shell" or "solid"."""
        return "meridian" if self.axisymmetric else f"{_fraction(self.plane)} {model}"

    def conditions(self, conditions: dict[str, Condition]) -> dict[str, Condition]:
        """Return name -> condition of the edges of the part, its planes of symmetry among them.

        Edges of the other half are left out.
        """
        if self.mirror is None:
            return conditions
        removed_edges = self.mirror.removed_edges
        of_part = {name: c for name, c in conditions.items() if name not in removed_edges}
        return of_part | dict.fromkeys(self.mirror.planes, "symmetry")


def modelled_part(
    case: Case, outline: Outline, constraints: list[SymmetryConstraint], plane: Mirror | None
) -> ModelledPart:
    """Return the smallest part of a shell that the case allows, or the one that it asks for.

    Parameters
    ----------
    outline
        The shell with the imperfections that do not grow.
    constraints
        Symmetry that each part of the case preserves.
    plane
        Symmetry plane of a half that is already chosen; None to look for one.

    Raises
    ------
    CaseError
        If the symmetry that the case asks for is not there.
    """
    is_axisymmetric = False
    if plane is None:  # whether the meridian is modelled, else the plane of a half or a sector
        is_axisymmetric, plane = _symmetry(case, outline, constraints)
    unturned = ModelledPart(is_axisymmetric, plane, turn=0.0, mirror=plane)
    if plane is None:
        return unturned
    # only a surface of revolution looks the same in a turned frame
    if not (outline.round and plane.through_e3):
        return unturned
    # the frame is turned by the azimuth of the plane, which becomes y = 0. Of a sector this is the
    # first of its two planes
    waves = plane.waves if isinstance(plane, Sector) else None
    mirror = Y0_PLANE if waves is None else Sector.from_azimuth(0.0, waves)
    return ModelledPart(is_axisymmetric, plane, plane.azimuth, mirror)


def symmetry_constraints(
    case: Case, outline: Outline, energies: Sequence[OwnTerm]
) -> list[SymmetryConstraint]:
    """Return the symmetry that each part of a case preserves, imperfections and bodies left out.

    The parts are the shape, abilities, load steps, named points and `energies`.
    """
    context, shell = case.context, case.shell
    constraints = [shape_constraint(shell.geometry, shell.thickness_factor, outline)]
    for contributor, view in context.contributors():
        constraints += contributor.symmetry_constraints(view, outline)
    constraints.append(points_constraint(case.points.values(), case.shell.reference, outline))
    constraints += [term.symmetry_constraint(outline) for term in energies]
    return [*constraints, *_inner_line_constraints(case, outline)]


def _dead_loads(case: Case) -> list[DeadLoadSection]:
    """Return the dead loads of all steps of a case."""
    steps = [step.load for step in case.context.steps if isinstance(step.load, DeadSection)]
    return [load for step in steps for load in step.loads]


def _inner_line_constraints(case: Case, outline: Outline) -> list[SymmetryConstraint]:
    """Return the symmetry that lines within the surface preserve which are held or loaded.

    A meridian has no such lines. A plane mirrors joined edges, but it may map a curve of a mesh
    file onto no other, or contain it.
    """
    names = {*case.boundary.conditions(), *(load.edge for load in _dead_loads(case) if load.edge)}
    joined_edges = set[str]()
    if case.several:
        shells = {member.name for member in case.several.parts}
        # the edge of a T-junction, on a shell, stays an edge
        pairs_of_edges = [edges for edges in case.several.joints if edges[1] not in shells]
        joined_edges = {name for edges in pairs_of_edges for name in edges}
    curves = cache(lambda: _curves_of_mesh_files(case, outline))  # reads files, once

    def names_no_curve(plane: Mirror) -> bool:
        """Return whether no curve within a mesh file is held or loaded, whatever the plane."""
        return names.isdisjoint(curves())

    reason = None
    if joined := sorted(names & joined_edges):
        reason = f"{joined[0]}: is a joined edge that is held or loaded, which needs a surface"
    may_have_lines = case.several is not None or isinstance(case.shell, MeshSurface)
    words = "a line within a mesh file that is held or loaded"
    return [SymmetryConstraint(reason, (), names_no_curve, words)] if may_have_lines else []


def _curves_of_mesh_files(case: Case, outline: Outline) -> set[str]:
    """Return the names of the curves within mesh files; empty if a file cannot be read."""
    if case.several:
        members = [m for m in case.several.parts if isinstance(m.case.shell, MeshSurface)]
        return {
            f"{member.name}_{name}"
            for member in members
            for name in _curves_of_mesh_files(
                member.case, reference_shell_of(member.case.shell).perfect
            )
        }
    shape = outline.chart(None, ANY_GRADING)
    try:
        return set(read_msh(shape, {}).inner_lines) if isinstance(shape, MeshFile) else set()
    except MeshError:  # it is reported when the mesh is built
        return set()


def own_mirror(case: Case, plane: Mirror, *, loosely: bool = False) -> Mirror | None:
    """Return a plane in which the shell is its own image, with the edges that the half loses.

    The mid-surface, its thickness, plies and imperfections must all be their own images. The result
    is None if `plane` is no such plane of the shell.

    Parameters
    ----------
    plane
        The plane to look for, in the frame of the case.
    loosely
        Whether a plane of a mesh file counts too that maps areas and centres onto each other, but
        not the triangles.
    """
    reference_shell = reference_shell_of(case.shell)
    perfect = reference_shell.perfect
    imperfections = imperfection_geometries(case.imperfections, reference_shell)
    # if patches have names, each imperfection must be its own image, not that of another
    one_by_one = bool(case.patches)
    constraints = [
        shape_constraint(case.shell.geometry, case.shell.thickness_factor, perfect),
        *imperfection_constraints(imperfections, perfect, one_by_one=one_by_one),
    ]
    if plies := ShellLaminate.from_context(case.context):
        constraints += plies.symmetry_constraints(case.context, perfect)
    # directions that must lie in the plane, such as that of an imperfection
    vectors = [unit(v) for constraint in constraints for v in constraint.vectors]
    if perfect.round and plane.through_e3:  # then the surface allows every such plane
        candidates: Sequence[Mirror] = [plane]
    else:
        candidates = perfect.mirrors(plane.in_plane_vectors, loosely)
    for candidate in candidates:
        has_vectors = all(abs(candidate.normal @ v) < ROUNDING for v in vectors)
        if not candidate.is_plane_of(plane) or not has_vectors:
            continue
        if all(constraint.mirrors(candidate) for constraint in constraints):
            return candidate
    return None


def edge_conditions(boundary: BoundarySection, turn: float) -> dict[str, Condition]:
    """Return edge -> condition in the model's terms, in a frame turned about e3 (rad)."""
    # the word of the case file -> that of the model, which calls "symmetry" the plane of a half
    terms: dict[EdgeCondition, Condition] = {
        "hinged": "simply supported",
        "symmetry": "plane",
        "clamped": "clamped",
        "simply supported": "simply supported",
        "free": "free",
    }
    return {
        name: HeldComponents(tuple(_turned_components(condition.components, turn)))
        if isinstance(condition, HeldSection)
        else terms[condition]
        for name, condition in boundary.conditions().items()
    }


def _turned_components(components: tuple[int, ...], turn: float) -> list[int]:
    """Return the components (0, 1, 2 for e1, e2, e3) that are held in a turned frame.

    The frame is turned about e3 by `turn` (rad), into which the components turn as a whole.
    """
    # the held directions (held, 3), by their components in the turned frame
    directions = np.eye(3)[list(components)] @ rotation(turn).T
    # a turned axis is spanned by them, or is normal to them: the sum of the squares of its
    # components is 1 or 0, up to rounding
    return [i for i in range(3) if directions[:, i] @ directions[:, i] > 0.5]


def _fraction(plane: Mirror | None) -> str:
    """Return the fraction of the shell that is modelled, in words."""
    if isinstance(plane, Sector):
        return f"sector of {180 / plane.waves:.4g} degrees of the"
    return "half" if plane else "full"


def _symmetry(
    case: Case, outline: Outline, constraints: list[SymmetryConstraint]
) -> tuple[bool, Mirror | None]:
    """Return whether to model the meridian, and the plane of a half or the sector otherwise.

    The plane is None for a meridian and for a full model. Raises CaseError if the symmetry that the
    case asks for is not there; the message says why.
    """
    # the meridian
    reason = why_not_axisymmetric(constraints)  # None if all constraints are axisymmetric
    if reason and case.symmetry == "axisymmetric":
        raise CaseError(f"symmetry: axisymmetric: {reason}")
    may_be_meridian = case.symmetry in ("auto", "axisymmetric") and case.model == "shell"
    if reason is None and may_be_meridian:
        return True, None
    # a sector for a number of waves; or all of the shell
    if isinstance(case.symmetry, int):
        return False, _sector(case, outline, constraints, case.symmetry)
    if case.symmetry not in ("auto", "half"):
        return False, None
    # a half. If the case asks for it, its plane need not map the triangles of a mesh file onto each
    # other
    plane = common_mirror(constraints, outline, loosely=case.symmetry == "half")
    if case.symmetry == "half" and plane is None:
        if words := energy_without_mirror(constraints, outline):
            raise CaseError(f"symmetry: half: {words} does not share it")
        hint = ""
        if case.several:
            hint = "; each shell is held, and its own image in it"
        elif isinstance(case.shell, MeshSurface):
            hint = (
                "; edges of a mesh file must lie in it: mesh a half, mirror the nodes and "
                "triangles, join them"
            )
        raise CaseError(
            "symmetry: half: shell, supports, fields and load have no common mirror plane" + hint
        )
    return False, plane


def _sector(
    case: Case, outline: Outline, constraints: list[SymmetryConstraint], waves: int
) -> Sector:
    """Return the sector of 180/`waves` degrees between two planes of symmetry.

    Raises CaseError if there are no such planes.
    """
    # named points must lie in the sector, because the mesh has no other vertices for them
    places = [np.array(x) for x in case.points.values()]
    if sector := common_sector(constraints, outline, waves, places):
        return sector
    hint = ""
    names = {*case.boundary.conditions(), *(load.at for load in _dead_loads(case) if load.at)}
    if any(tilted(np.array(case.points[name])) for name in names & set(case.points)):
        hint = (
            "; a force or a held point off e3 has no images there: model a part of the shell "
            "alone, azimuth: [0, 90] with boundary: {left: symmetry, right: symmetry}, with half "
            "of a force that is on one of these edges"
        )
    elif case.several:
        hint = "; each shell is held, and its own image in both"
    elif isinstance(case.shell, MeshSurface):
        hint = "; the mesh file must be its own image in both, with each of its edges and patches"
    raise CaseError(
        f"symmetry: {waves}: shell, supports, fields and load have no two mirror planes through e3 "
        f"at an angle of {180 / waves:g} degrees with all named points between them{hint}"
    )
