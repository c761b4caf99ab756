"""Planner: make the `Problem` of a case, without building a mesh or a model.

A case has sections, units and a programme of load steps. The symmetry that all parts of the case
preserve chooses which part of the shell is modelled. Loads, bodies, imperfections and formulas
choose the element sizes. The contributions of all parts are added up to the loads of one model.
docs/theory.md has the sizes and the symmetry.

An ability is a section that adds something to a problem: a field, a joint, a support. An outline is
the surface of a shell with its edges, a chart (2 | 3,) the coordinates of a place on it (three for
a mesh file). An amplitude is a load parameter, by name; a step that drives it has its name, and of
steps with one name the last one counts. An imperfection has a deviation w0 from the perfect
surface, which grows if a step multiplies it, and may have a rim. The model's frame is turned about
e3 by an angle `turn` from that of the case. h and R are thickness and reference length; lengths are
over R.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.case_variants import case_with_values, perfect_case
from magshell_fenicsx.case.contact_mesh_size import ContactPlace
from magshell_fenicsx.case.modelled_part import (
    ModelledPart,
    edge_conditions,
    modelled_part,
    symmetry_constraints,
)
from magshell_fenicsx.case.shells import MemberCase
from magshell_fenicsx.case.vertices import Vertices, chart_of, named_points, on_features
from magshell_fenicsx.input.expressions import formula, formula_group
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grading import DiscFeature, Grading, SquaresFeature
from magshell_fenicsx.mesh.grid import Grid, RimmedGrid
from magshell_fenicsx.mesh.mirror import Mirror, Sector, rotation
from magshell_fenicsx.mesh.msh import MeshFile, cell_count
from magshell_fenicsx.mesh.multi_shell import MultiShellMesh
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.mesh.shapes import DiscShape, StripShape
from magshell_fenicsx.mesh.vertex_spacing import line_coordinates
from magshell_fenicsx.models.shell.adaptive_sampling import RefinedParts
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.parts.ability import Modelled
from magshell_fenicsx.parts.bodies.body_contact import ContactBody
from magshell_fenicsx.parts.bodies.body_setup import ContactZone, body_symmetry, contact_bodies
from magshell_fenicsx.parts.imperfections.growth import grown_by
from magshell_fenicsx.parts.imperfections.imperfection import (
    ImperfectionGeometry,
    imperfection_geometries,
    in_frame,
)
from magshell_fenicsx.parts.imperfections.modes import Mode, ModesSection
from magshell_fenicsx.parts.imperfections.symmetry import (
    MAX_RIMS,
    LocalImperfection,
    distinct_rims,
    imperfection_constraints,
    local_imperfections,
)
from magshell_fenicsx.parts.laminate import laminate_of
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.pressure.pressure import PressureSection
from magshell_fenicsx.parts.shell_outline import reference_shell_of
from magshell_fenicsx.parts.shell_sections import MeshSurface
from magshell_fenicsx.parts.step import ProgrammeStep, Step
from magshell_fenicsx.parts.step_course import ChartOfPlace
from magshell_fenicsx.parts.supports.boundary import inflation_warning
from magshell_fenicsx.problem.columns import refuse_duplicate_names
from magshell_fenicsx.problem.formulas import (
    PlacedFormulas,
    adaptive_cells,
    case_formulas,
    formula_refinements,
    imperfection_refinements,
    narrow_places,
    refuse_unfit_formulas,
)
from magshell_fenicsx.problem.memory import unknowns_of
from magshell_fenicsx.problem.mesh_sizes import Loaded, Refined, grading
from magshell_fenicsx.problem.model_description import describe_model
from magshell_fenicsx.problem.problem import Document, PendingModes, Problem, solid_body_of
from magshell_fenicsx.problem.surface_names import refuse_unfit_ends, surface_terms
from magshell_fenicsx.shape.outline import Chart, Outline
from magshell_fenicsx.shape.reference_shell import ReferenceShell
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint, why_not_axisymmetric

Array = NDArray[np.float64]
MIN_SIZE_AT_TIP = 0.05  # size of elements at the tip of a sector, over the largest
# times the radius, or a part of it: a surface as long as that hints at another unit
MAX_EXTENT_OVER_RADIUS = 50.0
StepsAtPlaces = Sequence[tuple[ProgrammeStep, str | ChartOfPlace]]  # see `Step.concentrated`


def make_problem(
    case: Case,
    terms: Sequence[OwnTerm] = (),
    plane: Mirror | None = None,
    smooth: Collection[str] = (),
    contact_places: Sequence[ContactPlace | ContactZone] = (),
) -> Problem:
    """Return the problem of a case: mesh, loads, supports and output, nothing of it built yet.

    Parameters
    ----------
    case
        The validated case.
    terms
        User-defined energies to add to those of the case.
    plane
        Mirror plane of the half to be modelled, in the frame of the case; None to find the smallest
        part that the symmetry of the case allows.
    smooth
        Keys of the case whose formulas are known to have no details between samples.
    contact_places
        Places (3,) over R where other shells or bodies touch this one; the mesh is refined there.

    Raises
    ------
    CaseError
        If the requested symmetry is not there, or the case asks for something that cannot be built.
    MeshError
        If a support or a load names an edge or a point that the meridian does not have.
    """
    if terms:
        case = case.with_terms([*case.own_terms, *terms])
    # the surface with its constant imperfections, and the places of loads on it
    shell = _ImperfectShell.of_case(case)
    load_places = _load_places(case, shell.outline)
    for section in case.context.abilities:
        section.refuse_unfit_values(case.context, shell.sample)
    # further samples of the surface, where formulas have narrow details
    formulas = _ResolvedFormulas.of_case(case, shell.outline, smooth)
    outline = formulas.sampled(shell.outline)
    refuse_unfit_formulas(
        formulas.formulas, outline.sample() if formulas.formulas else shell.sample
    )
    # the symmetry of all parts of the case decides which part of the shell is modelled
    energies = surface_terms(case.context, case.own_terms)
    constraints = _constraints(case, shell, outline, energies)
    part = modelled_part(case, outline, constraints, plane)
    # the mesh of that part, and the loads on it
    points = _VertexPoints.of_case(case, load_places, outline, part)
    mesh = _mesh_plan(case, shell, outline, part, points, formulas, contact_places)
    modelled = _modelled(case, shell, part, mesh, points)
    loads = replace(
        _loads(case, modelled),
        user_terms=tuple(term.turned(part.turn) for term in energies),
        contacts=mesh.bodies,
    )
    problem = _problem(case, shell, part, mesh, modelled, loads, constraints)
    refuse_duplicate_names(problem)
    return problem


def _modelled(
    case: Case,
    shell: "_ImperfectShell",
    part: ModelledPart,
    mesh: "_MeshPlan",
    points: "_VertexPoints",
) -> Modelled:
    """Return the modelled part in the form that abilities and load steps read.

    Its vertices are those of `points` at which load steps act. Its deviations and patch rims are
    functions of places in the frame of the model, which is turned about e3 from that of the case.
    """
    imperfections, turn = shell.imperfections, part.turn
    return Modelled(
        outline=mesh.outline,
        turn=turn,
        mirror=part.mirror,
        plane=part.plane,
        axisymmetric=part.axisymmetric,
        vertices=points.of_steps,
        patch_rims={
            name: in_frame(imperfections[key].is_within_rim, turn)
            for name, key in case.dimples.items()
        },
        deviations={
            key: in_frame(geometry.deviation, turn) for key, geometry in imperfections.items()
        },
    )


def _problem(
    case: Case,
    shell: "_ImperfectShell",
    part: ModelledPart,
    mesh: "_MeshPlan",
    modelled: Modelled,
    loads: Loads,
    constraints: list[SymmetryConstraint],
) -> Problem:
    """Return the `Problem`, put together from the results of the other functions of this module.

    Parameters
    ----------
    part
        Which part of the shell is modelled.
    mesh
        Shape to be meshed and element sizes.
    modelled
        The same part in the form that abilities read; its rims are those of patches of dimples.
    loads
        All loads of the model.
    constraints
        Symmetry of each part of the case; says whether the whole case is axisymmetric.

    Raises
    ------
    MeshError
        If supports or loads of a meridian name an edge or a point that it does not have.
    """
    context, outline = case.context, mesh.outline
    conditions = edge_conditions(case.boundary, part.turn)
    supports = tuple(name for name, condition in conditions.items() if condition != "free")
    # with planes of symmetry, and without edges of the half that is not modelled
    conditions = part.conditions(conditions)
    meridian = outline.meridian if part.axisymmetric else None
    if meridian:  # its ends are the only edges and points
        refuse_unfit_ends([name for name in meridian.names if name], mesh.points, conditions, loads)
    included, left_out = _contents_in_words(case, shell, part, loads, mesh.rim_count)
    # places all over the shell; for a mesh file, which is read here, they are those of the outline
    places = shell.sample if len(shell.sample) else outline.sample()
    unknowns = 0.0  # an estimate, for the memory; a meridian needs little
    if not meridian:
        unknowns = unknowns_of(context, _cells(mesh.shape, mesh.size, part.plane))
    return Problem(
        context=context,
        mesh=case.mesh,
        body=solid_body_of(context),
        material=replace(shell.material, laminate=laminate_of(case.shell, part.turn)),
        loads=loads,
        conditions=conditions,
        meridian=meridian,
        mirror=part.mirror,
        azimuth=part.turn,
        # whether all is axisymmetric, whatever is modelled
        turns=why_not_axisymmetric(constraints) is None,
        shape=mesh.shape,
        embedding=outline.embedding if meridian else outline.embedding_of(mesh.shape),
        normal=None if isinstance(case.shell, MeshSurface) else outline.normal,
        points=mesh.points,
        size=mesh.size,
        included=included,
        left_out=left_out,
        thickness=_thickness(case, part.turn),
        length=case.shell.reference,
        within=modelled.patch_rims,
        supports=supports,
        reactions=bool(loads.moves) if case.reactions is None else case.reactions,
        body_contacts=tuple((region.size, region.reach) for region in mesh.contact_regions),
        warnings=_warnings(case, places),
        unknowns=unknowns,
        patched=bool(case.patches),
        stability=case.stability,
        frequencies=case.frequencies,
        gradients=case.gradients,
        output=case.output,
        pending_modes=_pending_modes(case),
        document=document_of(case),
        remade=lambda values: make_problem(case_with_values(case, values)),
    )


def _contents_in_words(
    case: Case, shell: "_ImperfectShell", part: ModelledPart, loads: Loads, rim_count: int
) -> tuple[list[str], list[str]]:
    """Return what the model contains and what it leaves out: two lists of lines for people.

    Parameters
    ----------
    part, loads
        Which part of the shell is modelled, and all loads of the model.
    rim_count
        Number of different rims of imperfections.
    """
    included, left_out = describe_model(
        case.context, loads, part.name(case.model), part.plane, rim_count
    )
    # words on the origin of an imperfection, such as the draw of a random one
    included += [
        f"{key}: {imperfection.account}"
        for key, imperfection in shell.imperfections.items()
        if imperfection.account
    ]
    included += [f"own energy: {term.name}" for term in case.own_terms]
    return included, left_out


def document_of(case: Case) -> Document:
    """Return what a run writes down about its case: data, file name and the files that it names."""
    return Document(
        data=case.model_dump(mode="json", exclude_none=True),
        name=case.file_name,
        outside=case.outside,
        with_place=case.with_place,
    )


def _pending_modes(case: Case) -> PendingModes | None:
    """Return the buckling modes that imperfections take and that are not yet computed.

    They belong to the perfect shell, or to all perfect shells of a case together.

    Returns
    -------
    Their number, and two functions: one makes the problem of the perfect shell, which has these
    modes, the other takes the modes and makes the problem of the case. None if no imperfection
    waits for modes.
    """
    # (shell, key of the imperfection, its section)
    pending_sections = [
        (member, key, section)
        for member in case.members
        for key, section in member.case.imperfections.items()
        if isinstance(section, ModesSection) and section.pending_modes
    ]
    # zero without such sections, or if none of them asks for a mode
    count = max((len(section.amplitudes) for _, _, section in pending_sections), default=0)
    if not count:
        return None
    # their number, the problem that has the modes, and the problem that takes them
    return PendingModes(
        count,
        lambda: make_problem(perfect_case(case)),
        lambda modes: _problem_with_modes(case, pending_sections, modes),
    )


def _problem_with_modes(
    case: Case,
    pending_sections: Sequence[tuple[MemberCase, str, ModesSection]],
    modes: tuple[Mode, ...],
) -> Problem:
    """Put the modes into the imperfection sections of a case, and return the problem with them.

    Parameters
    ----------
    pending_sections
        Shell, key of the imperfection, and its section, which waits for modes.
    modes
        Buckling modes of the perfect shell, or of all perfect shells together.

    Raises
    ------
    CaseError
        If no mode with an amplitude moves one of several shells.
    """
    several = case.several
    for member, key, section in pending_sections:
        try:
            section.become(modes, member.name, several.place(member) if several else None)
        except ValueError as e:
            raise CaseError(member.refused(f"shell.{key}.{e}")) from None
    problem = make_problem(case.with_shells(several.parts) if several else case)

    def remade(values: Mapping[str, Any]) -> Problem:
        """Return the problem with other values of keys, and with the same modes.

        The modes are put in again if the change makes imperfections wait for them.
        """
        changed_problem = problem.with_values(values)
        if changed_problem.pending_modes:
            return changed_problem.pending_modes.with_modes(modes)
        return changed_problem

    return replace(problem, remade=remade)


@dataclass(frozen=True)
class _ImperfectShell:
    """The undeformed shell of a case with its imperfections, in the frame of the case.

    An imperfection grows if a load step multiplies its deviation; the others are constant.

    Attributes
    ----------
    reference
        The shell on which imperfections and bodies are placed. Its `imperfect` outline has the
        constant imperfections.
    imperfections
        Key of each imperfection below `shell` -> its geometry.
    constant
        Keys of the constant imperfections.
    material
        Material of the shell, or of several shells by patch; without plies.
    sample
        Places (n, 3) over R all over the shell; n = 0 for a mesh file, which is read later.
    """

    reference: ReferenceShell
    imperfections: Mapping[str, ImperfectionGeometry]
    constant: Collection[str]
    material: Material
    sample: Array

    @classmethod
    def of_case(cls, case: Case) -> "_ImperfectShell":
        """Return the shell of a case, with imperfections sorted into growing and constant ones."""
        # imperfections are placed on the perfect shell
        material, reference = _material(case), reference_shell_of(case.shell)
        imperfections = imperfection_geometries(case.imperfections, reference)
        # the keys of imperfections whose deviation a step multiplies
        grown_keys = grown_by(case.context.last_steps.values(), imperfections)
        constant = {*imperfections}.difference(*grown_keys.values())
        outline = _imperfect_outline(reference.perfect, imperfections, constant, turn=0.0)
        sample = np.zeros((0, 3)) if isinstance(case.shell, MeshSurface) else outline.sample()
        reference = replace(reference, imperfect=outline)
        return cls(reference, imperfections, constant, material, sample)

    @property
    def perfect(self) -> Outline:
        """Outline without imperfections."""
        return self.reference.perfect

    @property
    def outline(self) -> Outline:
        """Outline with the imperfections that do not grow."""
        return self.reference.imperfect

    def turned_outline(self, turn: float) -> Outline:
        """Return the outline with constant imperfections, in a frame turned about e3 (rad)."""
        return _imperfect_outline(self.perfect, self.imperfections, self.constant, turn)

    @property
    def without_centre(self) -> list[ImperfectionGeometry]:
        """Imperfections that are spread over the whole surface."""
        return [geometry for geometry in self.imperfections.values() if geometry.centre is None]


def _material(case: Case) -> Material:
    """Return Poisson's ratio, thickness over R and law of a case, without plies.

    Several shells have one material each, by patch.
    """
    nu, h = case.shell.poisson_ratio, 1 / case.shell.R_over_h
    material = Material(nu, h, case.shell.law_section.elastic_law(h, nu))
    if several := case.several:
        return replace(
            material, shells=several.materials, laws=several.laws, laminates=several.laminates
        )
    return material


def _imperfect_outline(
    perfect: Outline,
    imperfections: Mapping[str, ImperfectionGeometry],
    constant: Collection[str],
    turn: float,
) -> Outline:
    """Return an outline with the constant imperfections, in a frame turned about e3 (rad).

    The deviation is the sum of those imperfections whose keys are in `constant`. The element size
    of the outline follows all `imperfections`, because growing ones need small elements too.
    """
    if not imperfections:
        return perfect
    geometries = imperfections.values()
    # radii around the pole of a disc at which the curvature jumps: the rims of imperfections
    circles: tuple[float, ...] = ()
    if perfect.disc:
        circles = tuple(geometry.reach for geometry in geometries if geometry.rim)
    deviations = tuple(
        in_frame(geometry.deviation, turn)
        for key, geometry in imperfections.items()
        if key in constant
    )
    largest = min(geometry.size for geometry in geometries)
    return perfect.deviated(deviations, circles, largest)


def _load_places(case: Case, outline: Outline) -> StepsAtPlaces:
    """Return (step, place) for each place where a load is concentrated."""
    return [
        (step, place)
        for step in case.programme
        for place in step.load.concentrated(case.context.at_step(step), outline)
    ]


@dataclass(frozen=True)
class _ResolvedFormulas:
    """Formulas of a case, each with cells so small that samples in them show its narrow details.

    Attributes
    ----------
    formulas
        The keys of the case that have formulas of the undeformed place.
    cells
        For each element of `formulas` a division of the surface into cells, smaller where the
        formula varies more; None for a smooth formula.
    """

    formulas: Sequence[PlacedFormulas]
    cells: Sequence[RefinedParts | None]

    @classmethod
    def of_case(cls, case: Case, outline: Outline, smooth: Collection[str]) -> "_ResolvedFormulas":
        """Return the formulas of a case; those whose keys are in `smooth` get no cells."""
        formulas = case_formulas(case.context)
        cells = [
            None if placed.spec.key in smooth else adaptive_cells(placed.formulas, outline)
            for placed in formulas
        ]
        return cls(formulas, cells)

    def sampled(self, outline: Outline) -> Outline:
        """Return the outline with further samples, at places where formulas have narrow details."""
        if not self.formulas:
            return outline
        return outline.with_samples(narrow_places([cells for cells in self.cells if cells]))


def _constraints(
    case: Case, shell: _ImperfectShell, outline: Outline, energies: Sequence[OwnTerm]
) -> list[SymmetryConstraint]:
    """Return the symmetry that each part of a case preserves.

    The parts are shape, abilities, load steps, named points, `energies`, imperfections and bodies.
    """
    # if patches have names, each imperfection must be its own mirror image, not that of another
    one_by_one = bool(case.patches)
    constraints = symmetry_constraints(case, outline, energies)
    constraints += imperfection_constraints(
        shell.imperfections, shell.perfect, one_by_one=one_by_one
    )
    constraints += [body_symmetry(contact) for contact in _body_contacts(case, shell.reference)]
    return constraints


def _body_contacts(case: Case, reference: ReferenceShell) -> tuple[ContactBody, ...]:
    """Return the contacts of a case with rigid bodies, in the frame of a reference shell.

    A body whose amplitude has the name of a load step is moved by that step.
    """
    driven_names = {step.name for step in case.programme}
    return contact_bodies(case.bodies, case.approaches, driven_names, reference, case.shells or ())


@dataclass(frozen=True)
class _VertexPoints:
    """Points of a case at which its mesh must have vertices.

    Attributes
    ----------
    charts
        Name of a point -> its place (2 | 3,) in the chart.
    of_steps
        Name of a step that loads a place of its own -> name of the point in `charts` there.
    loads_at_points
        Named points of the case, each with a load that is concentrated there.
    """

    charts: dict[str, Array]
    of_steps: dict[str, str]
    loads_at_points: Sequence[tuple[str, Step]]

    @classmethod
    def of_case(
        cls, case: Case, load_places: StepsAtPlaces, outline: Outline, part: ModelledPart
    ) -> "_VertexPoints":
        """Return the named points of a case, and a point for each load at a single place.

        Parameters
        ----------
        load_places
            Steps and the places of their loads.
        outline, part
            The shell in the frame of the case, and the part that is modelled.

        Raises
        ------
        CaseError
            If a named point is not on the surface.
        """
        charts = named_points(case, outline, part.turn, part.mirror)
        of_steps = dict[str, str]()
        loads_at_points = list[tuple[str, Step]]()
        for step, place in load_places:
            if isinstance(place, str):
                loads_at_points.append((place, step.load))
                continue
            name, chart = step.name, place(part.turn, part.is_symmetric)
            chart = on_features(chart, outline, charts)
            # a load at the pole, or at the place of an earlier load, shares the point there. Else
            # it gets a point with the name of its step, in which "load" replaces "force"
            candidates = (point for point in ("pole", *of_steps.values()) if point in charts)
            at_same_place = (point for point in candidates if np.array_equal(charts[point], chart))
            of_steps[name] = next(at_same_place, name.replace("force", "load"))
            charts[of_steps[name]] = chart
        return cls(charts, of_steps, loads_at_points)

    def concentrated_loads(self, case: Case) -> list[Loaded]:
        """Return (chart, loads there) for each point with a concentrated load."""
        # loads that name a point of the case, then loads at a place of their own
        loads: list[Loaded] = [(self.charts[point], [load]) for point, load in self.loads_at_points]
        for point in dict.fromkeys(self.of_steps.values()):  # each point once, with all its loads
            loads_there = [
                step.load for step in case.programme if self.of_steps.get(step.name) == point
            ]
            loads.append((self.charts[point], loads_there))
        return loads


@dataclass(frozen=True)
class _MeshPlan:
    """Shape to be meshed and element sizes, in the frame of the model; lengths are over R.

    Attributes
    ----------
    outline
        The shell with the constant imperfections.
    shape
        The chart, or the grid with rims in it, that is triangulated.
    size
        Element sizes over the chart.
    points
        Name of a point -> chart (2 | 3,) of the vertex there.
    bodies
        Contacts with rigid bodies.
    contact_regions
        Zones in which the bodies press.
    rim_count
        Number of different rims of imperfections, besides a rim around the pole.
    """

    outline: Outline
    shape: Chart | RimmedGrid
    size: Grading
    points: dict[str, Array]
    bodies: tuple[ContactBody, ...]
    contact_regions: Sequence[ContactZone]
    rim_count: int


def _mesh_plan(
    case: Case,
    shell: _ImperfectShell,
    outline: Outline,
    part: ModelledPart,
    points: _VertexPoints,
    formulas: _ResolvedFormulas,
    contact_places: Sequence[ContactPlace | ContactZone],
) -> _MeshPlan:
    """Return the shape to be meshed and the element sizes, for the modelled part of a shell.

    Parameters
    ----------
    outline
        The shell in the frame of the case, with samples that show details of the formulas.
    part
        The part that is modelled, and the angle of its frame about e3.
    points
        Points at which there must be vertices.
    formulas
        Formulas of the case, with the cells that resolve them.
    contact_places
        Places (3,) over R, in the frame of the case, where other shells or bodies touch this one.

    Raises
    ------
    CaseError
        If a sector has T-junctions or rims beside the axis, or two vertices would be too close.
    """
    local: list[LocalImperfection] = []
    if not isinstance(case.shell, MeshSurface):
        local = local_imperfections(shell.imperfections.items(), shell.perfect, part.turn)
    # contacts are in the model's frame, zones of contact are found with the sampled outline
    bodies = _body_contacts(case, replace(shell.reference, turn=part.turn))
    contact_regions = _contact_regions(case, bodies, replace(shell.reference, imperfect=outline))
    # the charts of places where other shells touch this one, in the model's frame
    charted_places = [
        replace(
            contact_place,
            place=chart_of(
                rotation(part.turn) @ contact_place.place, outline, half=part.is_symmetric
            ),
        )
        for contact_place in contact_places
    ]
    # squares in which formulas or spread imperfections need small elements, and the largest size
    varying, largest = _size_limits(case, shell, outline, part, formulas)
    refined: list[Refined] = [*local, *contact_regions, *charted_places]
    size = grading(
        case.context,
        outline,
        shell.material.h,
        refined,
        largest,
        points.concentrated_loads(case),
        varying,
        local=bool(local),
    )
    turned_outline = shell.turned_outline(part.turn)
    shape, size = _shape(turned_outline, part, size, points.charts.values())
    rims = distinct_rims(local)
    _refuse_unfit_sector(case, part, rims)
    # with too many rims the mesh has no edges along them
    shape = _with_rims(shape, local, rims if len(rims) <= MAX_RIMS else (), size)
    if not part.axisymmetric:
        vertices = Vertices.of_case(case, points.charts, turned_outline, size, part.turn)
        vertices.refuse_near(shape, part.mirror)
    return _MeshPlan(turned_outline, shape, size, points.charts, bodies, contact_regions, len(rims))


def _contact_regions(
    case: Case, bodies: Sequence[ContactBody], shell: ReferenceShell
) -> list[ContactZone]:
    """Return for each rigid body the zone of a shell in which it presses.

    The zone follows from the load steps that move the body, those with the name of its amplitude.
    """

    def zone_of(contact: ContactBody) -> ContactZone:
        """Return the zone in which one body presses."""
        loads = (step.load for step in case.programme if step.name == contact.amplitude)
        return ContactZone.of_body(contact, loads, shell)

    return [zone_of(contact) for contact in bodies]


def _size_limits(
    case: Case,
    shell: _ImperfectShell,
    outline: Outline,
    part: ModelledPart,
    formulas: _ResolvedFormulas,
) -> tuple[list[SquaresFeature], float]:
    """Return where formulas and spread imperfections need small elements, and a global limit.

    Returns
    -------
    squares
        Places where elements must be small; empty if the element size is given or a meridian is
        modelled.
    largest
        The element size, over R, that resolves the spread imperfections everywhere.
    """
    if part.axisymmetric or case.mesh.size:
        return [], min((geometry.size for geometry in shell.without_centre), default=inf)
    h = shell.material.h
    squares, largest = imperfection_refinements(shell.without_centre, shell.perfect, part.turn, h)
    squares += formula_refinements(formulas.formulas, formulas.cells, outline, part.turn, h)
    return [feature.finer(case.mesh.refinement) for feature in squares], largest


def _shape(
    outline: Outline, part: ModelledPart, size: Grading, points: Collection[Array]
) -> tuple[Chart, Grading]:
    """Return the shape to be triangulated, and the element sizes on it.

    Parameters
    ----------
    outline, part
        The shell in the frame of the model, and the part of it that is modelled.
    size
        Element sizes before those at the tip of a sector are added.
    points
        Charts (2 | 3,) of the points that are vertices; a grid has movable lines through them.
    """
    shape = outline.chart(part.mirror, size)
    is_grid = isinstance(shape, Grid)
    # a sector has a tip at the axis, except in a grid, which is a part of a ring
    if part.sector and not is_grid:
        size = towards_tip(size, part.sector)
        shape = outline.chart(part.sector, size)
    mirror_of_half = None if part.sector else part.mirror
    if isinstance(shape, Grid) and mirror_of_half:
        # the grid has lines at a point, and at its mirror image on the other half
        images = []
        for chart in points:
            place = outline.embedding(chart[None])[0]
            images.append(outline.inverse(mirror_of_half.image(place)))
        x_lines, y_lines = shape.movable_lines
        x_of_images = [float(image[0]) for image in images]
        y_of_images = [float(image[1]) for image in images]
        movable_lines = ((*x_lines, *x_of_images), (*y_lines, *y_of_images))
        shape = replace(shape, movable_lines=movable_lines)
    return shape, size


def _refuse_unfit_sector(case: Case, part: ModelledPart, rims: Sequence[Array]) -> None:
    """Raise CaseError for a sector of a shell with a T-junction, or with rims beside the axis."""
    if part.sector is None:
        return
    # at a T-junction the second of the two names is that of a shell, not of an edge
    if any(joint.edges[1] in (case.shells or ()) for joint in case.joints):
        raise CaseError(f"symmetry: {case.symmetry}: not with a T-junction: take symmetry: half")
    if rims:
        raise CaseError(
            f"symmetry: {case.symmetry}: not with rims of dimples beside the axis: take symmetry: "
            "half"
        )


def towards_tip(size: Grading, sector: Sector) -> Grading:
    """Return element sizes that are at most the sector's width near its tip.

    Without that, triangles beside the axis of a disc would be thin.
    """
    # from a least size at the tip, sizes grow per distance by the sector's angle (rad), as its
    # width does
    least_size = MIN_SIZE_AT_TIP * size.largest
    tip = DiscFeature(centre=(0.0, 0.0), radius=0.0, size=least_size, growth=sector.angle)
    return replace(size, features=[*size.features, tip])


def _with_rims(
    shape: Chart, local: Sequence[LocalImperfection], rims: tuple[Array, ...], size: Grading
) -> Chart | RimmedGrid:
    """Return the shape with element edges along the rims of imperfections.

    Parameters
    ----------
    local
        The local imperfections in the chart; rims around the chart's origin are taken from here.
    rims
        Points (n, 2) of each closed rim beside the axis.
    size
        Element sizes; on a disc they choose which circles are drawn.
    """
    # radii around the origin at which the curvature jumps, each once
    circles = tuple(
        dict.fromkeys(
            local_imperfection.radius
            for local_imperfection in local
            if local_imperfection.circle and local_imperfection.jumps
        )
    )
    if isinstance(shape, Grid):
        return RimmedGrid(shape, rims) if rims else shape
    if isinstance(shape, DiscShape):
        # where circles are nearer to each other than an element, some are left out
        lines = line_coordinates(
            np.array(circles), lambda r: size(np.array([r, 0.0])), (0.0, shape.radius)
        )
        return replace(shape, circles=tuple(lines), rims=rims)
    return replace(shape, rims=rims) if isinstance(shape, StripShape) else shape


def _cells(shape: Chart | RimmedGrid, size: Grading, plane: Mirror | None) -> float:
    """Estimate the number of triangles of the modelled part.

    Parameters
    ----------
    shape, size
        The shape that is triangulated, and the element sizes on it.
    plane
        The symmetry plane of the part, in the frame of the case; None for a whole shell.
    """
    if isinstance(shape, MeshFile):
        # a mesh of several shells has the cells of the half alone, others those of the whole shell
        is_halved = isinstance(shape.in_memory, MultiShellMesh)
        return cell_count(shape) / (plane.copies if plane and not is_halved else 1)
    if isinstance(shape, Grid):
        return shape.cells * (0.5 if plane else 1.0)
    return size.cells(shape)  # such a shape is that of the modelled part


def _loads(case: Case, modelled: Modelled) -> Loads:
    """Return the loads of the model: the sum of what abilities and load steps contribute.

    Of several steps with one name the last one contributes.
    """
    context = case.context
    # amplitudes of steps, and others that a step drives or holds
    amplitudes = {name for step in context.steps for name in (step.name, *step.drives)}
    amplitudes.update(name for step in context.steps for name in step.load.hold)
    loads = Loads(pressure=PressureSection.amplitude in amplitudes)
    for contributor, view in context.contributors(last_steps=True):
        if contribution := contributor.contribution(view, modelled):
            loads += contribution
    if loads.pressure_profile and loads.moves:
        raise CaseError(
            "loading: a pressure with a profile: not beside supports that move (kind: edge): what "
            "it does on the lids that close moving edges is not known"
        )
    return loads


def _thickness(case: Case, turn: float) -> Thickness | None:
    """Return the thickness factor in a frame turned about e3 by `turn` (rad); None if it is 1."""
    if case.several:
        return case.several.thickness
    factor = case.thickness_factor
    if isinstance(factor, dict):
        return Thickness(patches=factor)
    if isinstance(factor, UserField):
        return Thickness(user_field=factor)
    if not factor:
        return None
    # the formula as a function of a place in the frame of the case
    in_case_frame, Q = formula(factor), rotation(turn)

    def in_model_frame(x: Array, y: Array, z: Array) -> Array:
        """Return the factor at places of the model, which are turned back into the case's frame."""
        if not turn:  # without rounding
            return in_case_frame(x, y, z)
        return in_case_frame(*np.tensordot(Q.T, np.stack([x, y, z]), 1))

    return Thickness(in_model_frame, formulas=formula_group([in_case_frame], Q))


def _warnings(case: Case, places: Array) -> tuple[str, ...]:
    """Return warnings about input that is unphysical, or that is often meant in another way.

    `places` (n, 3) over R are all over the undeformed shell.
    """
    contributors = case.context.contributors()
    warnings = [contributor.warning(context, places) for contributor, context in contributors]
    warnings += [_unit_warning(case, places), _warning_of_landing(case)]
    for member in case.members:
        own_context = replace(member.case.context, steps=case.context.steps)
        warning = inflation_warning(own_context, member.name)
        warnings.append(warning and member.refused(warning))
    return tuple(warning for warning in warnings if warning)


def _warning_of_landing(case: Case) -> str | None:
    """Return a warning that the snap of a shell onto a shell takes long; None without one."""
    snaps = [step.load.end.snap for step in case.programme if step.load.end.snap]
    if not case.contact or not any(snap.errors == "motion" for snap in snaps):
        return None
    return (
        "then: snap, where shells may touch: a landing takes minutes; "
        "snap: {damping: 1, errors: step} comes to rest in a part of that time, and control: arc, "
        "until: points, without then, has the equilibria alone"
    )


def _unit_warning(case: Case, places: Array) -> str | None:
    """Return a warning that the coordinates of a mesh file may be in another unit; None if not.

    The hint is an extent of `places` (n, 3) that is far from the radius, which is their unit.
    """
    extent = float(np.ptp(places, axis=0).max())  # over the radius
    is_usual = 1 / MAX_EXTENT_OVER_RADIUS <= extent <= MAX_EXTENT_OVER_RADIUS
    if not isinstance(case.shell, MeshSurface) or is_usual:
        return None
    key = "unit" if case.shell.with_units else "radius"
    return (
        f"the surface of the mesh file is {extent:.4g} times as long as shell.radius: "
        f"is shell.{key} right?"
    )
