"""From a case to what must be built for it, without building anything: the parts added up."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.meeting import Meeting
from magshell_fenicsx.case.opened import changed, perfect_case
from magshell_fenicsx.case.vertices import Vertices, chart_of, named_points, on_features
from magshell_fenicsx.input.expressions import formula, together
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.assembly import Assembly
from magshell_fenicsx.mesh.distinct import lines_of
from magshell_fenicsx.mesh.grading import Disc, Grading, Squares
from magshell_fenicsx.mesh.grid import Grid, RimmedGrid
from magshell_fenicsx.mesh.mirror import ROUNDING, Y0, Mirror, Sector, rotation
from magshell_fenicsx.mesh.msh import MeshFile, cell_count
from magshell_fenicsx.mesh.patch import GivenField
from magshell_fenicsx.mesh.shapes import DiscShape, StripShape
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import Condition, Held, Material
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.parts.bodies.standing import Pressed, body_leaves, contacts
from magshell_fenicsx.parts.imperfections.imperfection import Flaw, flaws, in_frame
from magshell_fenicsx.parts.imperfections.modes import Mode, ModesSection
from magshell_fenicsx.parts.imperfections.symmetry import MOST_RIMS, Spot, different, leaves, spots
from magshell_fenicsx.parts.laminate import Laminated, laminate_of
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.part import Modelled
from magshell_fenicsx.parts.registered import STEPS
from magshell_fenicsx.parts.supports.boundary import BoundarySection, EdgeCondition, HeldSection
from magshell_fenicsx.problem.account import account
from magshell_fenicsx.problem.columns import refuse_twice
from magshell_fenicsx.problem.formulas import (
    looked_at,
    narrow_places,
    of_imperfections,
    refinements,
    refuse_unfit_formulas,
    written,
)
from magshell_fenicsx.problem.limits import unknowns_of
from magshell_fenicsx.problem.names import refuse_unfit_ends, surface_terms
from magshell_fenicsx.problem.problem import Awaited, Document, Problem, body_of
from magshell_fenicsx.problem.sizes import Loaded, Shown, grading
from magshell_fenicsx.shape.outline import Chart, Outline, ground_of
from magshell_fenicsx.shape.sections import MeshSurface
from magshell_fenicsx.shape.symmetry import (
    Leaves,
    askew,
    mirror,
    of_points,
    of_shape,
    sector,
    unit,
    unmirrored,
)

Array = NDArray[np.float64]
SHORTEST = 0.05  # size of elements at the tip of a sector, over the largest
FAR_FROM_ONE = (
    50.0  # times the radius, or a part of it: a surface as long as that hints at another unit
)


def make_problem(
    case: Case,
    terms: Sequence[OwnTerm] = (),
    plane: Mirror | None = None,
    smooth: Collection[str] = (),
    met: Sequence[Array] = (),
) -> Problem:
    """The problem of a case, with its user-defined energies and `terms`; its half at a plane that
    is `kept`, if given.

    Formulas of the keys in `smooth` are known to have no details that samples do not show. Other
    shells touch it at the places `met` (3,), over R.

    Raises
    ------
    CaseError
        If the symmetry that is asked for is not there, or what is asked for cannot be built.
    MeshError
        If the meridian has no such edge or point.
    """
    case = case.with_terms([*case.own_terms, *terms]) if terms else case
    terms = case.own_terms
    material = Material(case.shell.poisson_ratio, 1 / case.shell.R_over_h, case.shell.rubber)
    if several := case.several:
        material = replace(
            material, shells=several.materials, laws=several.laws, laminates=several.laminates
        )
    ground = ground_of(case.shell)
    perfect = ground.perfect
    imperfections = flaws(case.imperfections, ground)
    context, last = case.context, {step.name: step for step in case.programme}
    still = {*imperfections} - {
        key for step in last.values() for key in step.load.multiplies(step, context)
    }
    drawn = imperfect(perfect, imperfections, 0.0, still)
    ground = replace(ground, drawn=drawn)
    standing = case.bodies, case.approaches, {step.name for step in case.programme}
    at_place = {
        name: (step, step.load.place_on(step, context, drawn)) for name, step in last.items()
    }
    places = {name: (step, place) for name, (step, place) in at_place.items() if place is not None}
    sample = np.zeros((0, 3)) if isinstance(case.shell, MeshSurface) else drawn.sample()
    for section in context.abilities:
        section.refuse_unfit_values(context, sample)
    formulas = written(context)
    narrow = [
        None if each.given.key in smooth else looked_at(each.formulas, drawn) for each in formulas
    ]
    drawn = (
        drawn.looked_at(narrow_places([leaves for leaves in narrow if leaves]))
        if formulas
        else drawn
    )
    refuse_unfit_formulas(formulas, drawn.sample() if formulas else sample)
    energies = surface_terms(context, terms)
    parts = _left(case, drawn, energies)
    parts += leaves(imperfections, perfect, each=bool(case.patches))
    parts += [body_leaves(contact) for contact in contacts(*standing, ground)]
    axisymmetric, plane = (False, plane) if plane else _symmetry(case, drawn, parts)
    half = plane is not None
    turn, beyond = 0.0, plane
    if plane and drawn.round and plane.through_e3:  # the frame is turned into the plane
        turn, beyond = (
            plane.azimuth,
            Sector.at(0.0, plane.waves) if isinstance(plane, Sector) else Y0,
        )
    points = named_points(case, drawn, turn, beyond)
    under = dict[str, str]()
    for name, (step, place) in places.items():
        chart = on_features(step.load.chart_of(place, drawn, turn, half=half), drawn, points)
        candidates = (point for point in ("pole", *under.values()) if point in points)
        same = (point for point in candidates if np.array_equal(points[point], chart))
        under[name] = next(same, name.replace("force", "load"))
        points[under[name]] = chart
    for step in case.programme:
        if step.name in under:
            step.load.refuse_unfit_place(step, context, drawn, points[under[step.name]])
    loaded: list[Loaded] = [
        (points[at], [step.load]) for step in case.programme for at in step.load.named_points()
    ]
    for point in dict.fromkeys(under.values()):
        loaded.append(
            (points[point], [step.load for step in case.programme if under.get(step.name) == point])
        )
    local = (
        [] if isinstance(case.shell, MeshSurface) else spots(imperfections.items(), perfect, turn)
    )
    wide = [flaw for flaw in imperfections.values() if flaw.centre is None]
    everywhere, varying = min((flaw.size for flaw in wide), default=inf), list[Squares]()
    bodies = contacts(*standing, replace(ground, turn=turn))
    stood = replace(ground, drawn=drawn)
    touched = [
        Pressed.by(c, (step.load for step in case.programme if step.name == c.amplitude), stood)
        for c in bodies
    ]
    if not (axisymmetric or case.mesh.size):
        varying, everywhere = of_imperfections(wide, perfect, turn, material.h)
        varying += refinements(formulas, narrow, drawn, turn, material.h)
        varying = [each.finer(case.mesh.refinement) for each in varying]
    facing = [Meeting(chart_of(rotation(turn) @ x, drawn, half=half)) for x in met]
    shown: list[Shown] = [*local, *touched, *facing]
    size = grading(
        context, drawn, material.h, shown, everywhere, loaded, varying, local=bool(local)
    )
    drawn = imperfect(perfect, imperfections, turn, still)
    shape = drawn.chart(beyond, size)
    if isinstance(beyond, Sector) and not isinstance(shape, Grid):  # a ring has no tip
        size = towards_tip(size, beyond)
        shape = drawn.chart(beyond, size)
    if (
        isinstance(shape, Grid) and beyond and not isinstance(beyond, Sector)
    ):  # what a point needs, its image needs too
        images = [drawn.inverse(beyond.image(drawn.embedding(x[None])[0])) for x in points.values()]
        x, y = ((*shape.movable[i], *(float(image[i]) for image in images)) for i in range(2))
        shape = replace(shape, movable=(x, y))
    rims = different(local)
    if isinstance(beyond, Sector) and any(
        joint.edges[1] in (case.shells or ()) for joint in case.joints
    ):
        raise CaseError(f"symmetry: {case.symmetry}: not with a T-junction: take symmetry: half")
    if rims and isinstance(beyond, Sector):
        raise CaseError(
            f"symmetry: {case.symmetry}: not with rims of dimples beside the axis: take symmetry: half"
        )
    shape = _matched(shape, local, rims if len(rims) <= MOST_RIMS else (), size)
    span = drawn.span if axisymmetric else None
    if not axisymmetric:
        Vertices.of(case, points, drawn, size, turn).refuse_near(shape, beyond)
    conditions = edge_conditions(case.boundary, turn)
    supports = tuple(name for name, condition in conditions.items() if condition != "free")
    if beyond:
        conditions = {name: c for name, c in conditions.items() if name not in beyond.lost}
        conditions |= dict.fromkeys(beyond.sides, "symmetry")
    within = {name: in_frame(imperfections[key].inside, turn) for name, key in case.dimples.items()}
    deviations = {key: in_frame(flaw.deviation, turn) for key, flaw in imperfections.items()}
    modelled = Modelled(drawn, turn, beyond, plane, axisymmetric, under, within, deviations)
    all_loads = replace(
        _loads(case, modelled), own=tuple(term.turned(turn) for term in energies), contacts=bodies
    )
    if span:
        refuse_unfit_ends([name for name in span.names if name], points, conditions, all_loads)
    model = "meridian" if axisymmetric else f"{part_of(plane)} {case.model}"
    included, left_out = account(context, all_loads, model, plane, len(rims))
    included += [f"{key}: {flaw.account}" for key, flaw in imperfections.items() if flaw.account]
    sample = sample if len(sample) else drawn.sample()
    problem = Problem(
        context=context,
        mesh=case.mesh,
        body=body_of(context),
        material=replace(material, laminate=laminate_of(case.shell, turn)),
        loads=all_loads,
        conditions=conditions,
        meridian=span,
        mirror=beyond,
        azimuth=turn,
        turns=askew(parts) is None,
        shape=shape,
        embedding=drawn.embedding if span else drawn.placed(shape),
        normal=None if isinstance(case.shell, MeshSurface) else drawn.normal,
        points=points,
        size=size,
        included=[*included, *(f"own energy: {term.name}" for term in terms)],
        left_out=left_out,
        thickness=_thickness(case, turn),
        length=case.shell.reference,
        within=within,
        supports=supports,
        reactions=bool(all_loads.moves) if case.reactions is None else case.reactions,
        pressed=tuple((each.size, each.reach) for each in touched),
        warnings=_warnings(case, sample, perfect),
        lambda_m=case.lambda_m,
        unknowns=0.0 if span else unknowns_of(context, _cells(shape, size, plane)),
        patched=bool(case.patches),
        stability=case.stability,
        frequencies=case.frequencies,
        gradients=case.gradients,
        output=case.output,
        awaited=_awaited(case),
        document=document_of(case),
        remade=lambda values: make_problem(changed(case, values)),
    )
    refuse_twice(problem)
    return problem


def document_of(case: Case) -> Document:
    """What a run writes of a case."""
    return Document(
        data=case.model_dump(mode="json", exclude_none=True),
        name=case.file_name,
        outside=case.outside,
        placed=case.placed,
    )


def _awaited(case: Case) -> Awaited | None:
    """The modes of the perfect shell, or of several perfect ones together, that are still to be
    computed.
    """
    several = case.several
    parts = list(several.parts) if several else []
    awaiting = [
        (i, key, section)
        for i, own in enumerate([part.case for part in parts] or [case])
        for key, section in own.imperfections.items()
        if isinstance(section, ModesSection) and section.awaited
    ]

    def given(modes: tuple[Mode, ...]) -> Problem:
        for i, key, section in awaiting:
            try:
                section.become(
                    modes, *((parts[i].name, several.place(parts[i])) if several else ())
                )
            except ValueError as e:
                raise CaseError(parts[i].refused(f"shell.{key}.{e}")) from None
        made = make_problem(case.with_shells(several.parts) if several else case)

        def again(values: Mapping[str, Any]) -> Problem:
            other = made.again(values)
            return other.awaited.given(modes) if other.awaited else other

        return replace(made, remade=again)

    count = max((len(section.amplitudes) for _, _, section in awaiting), default=0)
    return Awaited(count, lambda: make_problem(perfect_case(case)), given) if count else None


def _left(case: Case, drawn: Outline, energies: Sequence[OwnTerm]) -> list[Leaves]:
    """What each part of a case leaves of its symmetry."""
    context = case.context
    return [
        of_shape(case.shell, drawn),
        *(leaves for section in context.abilities for leaves in section.leaves(context, drawn)),
        *(leaves for step in case.programme for leaves in step.load.leaves(step, context, drawn)),
        of_points(case.points.values(), case.shell.reference, drawn),
        *(term.leaves(drawn) for term in energies),
    ]


def _loads(case: Case, modelled: Modelled) -> Loads:
    """What the parts of a case add to the loads of its model."""
    context, last = case.context, {step.name: step for step in case.programme}
    named = {
        *last,
        *(name for step in case.programme for name in (*step.load.drives, *step.load.hold)),
    }
    fields: dict[str, Any] = {}
    for added in (
        *(kind.implied() for kind in STEPS.values() if getattr(kind, "amplitude", None) in named),
        *(step.load.adds(step, context, modelled) for step in last.values()),
        *(section.adds(context, modelled) for section in context.abilities),
    ):
        for name, value in added.items():
            before = fields.get(name)
            if isinstance(value, dict):
                fields[name] = {**(before or {}), **value}
            else:
                fields[name] = (
                    (*(before or ()), *value) if isinstance(value, tuple) else before or value
                )
    return Loads(**fields)


def _warnings(case: Case, places: Array, outline: Outline) -> tuple[str, ...]:
    """What is unphysical at places (n, 3) of the undeformed shell, or often meant in another way,
    in words."""
    context = case.context
    abilities = (part.warning(context, places) for part in context.abilities)
    R = case.shell.reference
    steps = (step.load.warning(step, outline, R) for step in case.programme)
    return tuple(said for said in (*abilities, *steps, _wrong_unit(case, places)) if said)


def _wrong_unit(case: Case, places: Array) -> str | None:
    """What hints at another unit of a mesh file's coordinates, in words; None without."""
    extent = float(np.ptp(places, axis=0).max())
    if not isinstance(case.shell, MeshSurface) or 1 / FAR_FROM_ONE <= extent <= FAR_FROM_ONE:
        return None
    key = "unit" if case.shell.with_units else "radius"
    return f"the surface of the mesh file is {extent:.4g} times as long as shell.radius: is shell.{key} right?"


def edge_conditions(boundary: BoundarySection, turn: float) -> dict[str, Condition]:
    """The conditions of a case in the model's terms, in a frame turned about e3 (rad)."""
    terms: dict[EdgeCondition, Condition] = {
        "hinged": "simply supported",
        "symmetry": "plane",
        "clamped": "clamped",
        "simply supported": "simply supported",
        "free": "free",
    }
    return {
        name: Held(tuple(_turned(c.components, turn))) if isinstance(c, HeldSection) else terms[c]
        for name, c in boundary.conditions().items()
    }


def imperfect(
    perfect: Outline, imperfections: Mapping[str, Flaw], turn: float, still: Collection[str]
) -> Outline:
    """The shell with the imperfections that do not grow, in a frame turned about e3 (rad); all have
    their cells.
    """
    if not imperfections:
        return perfect
    circles = (
        tuple(flaw.reach for flaw in imperfections.values() if flaw.rim) if perfect.disc else ()
    )
    shown = min((flaw.size for flaw in imperfections.values()), default=inf)
    return perfect.deviated(
        tuple(
            in_frame(imperfections[key].deviation, turn) for key in imperfections if key in still
        ),
        circles,
        shown,
    )


def _matched(
    shape: Chart, local: Sequence[Spot], rims: tuple[Array, ...], size: Grading
) -> Chart | RimmedGrid:
    """The shape with element edges along the rims."""
    circles = tuple(dict.fromkeys(spot.radius for spot in local if spot.circle and spot.jumps))
    if isinstance(shape, Grid):
        return RimmedGrid(shape, rims) if rims else shape
    if isinstance(shape, DiscShape):
        lines = lines_of(np.array(circles), lambda r: size(np.array([r, 0.0])), (0.0, shape.radius))
        return replace(shape, circles=tuple(lines), rims=rims)
    return replace(shape, rims=rims) if isinstance(shape, StripShape) else shape


def kept(case: Case, plane: Mirror, *, loosely: bool = False) -> Mirror | None:
    """A plane in which the mid-surface with its thickness, plies and imperfections is its own
    image, with the edges that are lost; else None.

    Parameters
    ----------
    loosely
        See `mesh_mirrors`.
    """
    ground = ground_of(case.shell)
    perfect = ground.perfect
    parts = [
        of_shape(case.shell, perfect),
        *leaves(flaws(case.imperfections, ground), perfect, each=bool(case.patches)),
        *(plies.leaves(case.context, perfect) if (plies := Laminated.of(case.context)) else ()),
    ]
    vectors = [unit(v) for part in parts for v in part.vectors]
    planes = (
        [plane] if perfect.round and plane.through_e3 else perfect.mirrors(plane.in_plane, loosely)
    )
    for one in planes:
        along = all(abs(one.normal @ v) < ROUNDING for v in vectors)
        if one.is_plane_of(plane) and along and all(part.mirrors(one) for part in parts):
            return one
    return None


def part_of(plane: Mirror | None) -> str:
    """What of the shell is modelled, in words."""
    if isinstance(plane, Sector):
        return f"sector of {180 / plane.waves:.4g} degrees of the"
    return "half" if plane else "full"


def towards_tip(size: Grading, sector: Sector) -> Grading:
    """Sizes at most as large as a sector is wide, so that triangles are not thin beside the axis of
    a disc.
    """
    tip = Disc((0.0, 0.0), 0.0, SHORTEST * size.largest, sector.angle)
    return replace(size, features=[*size.features, tip])


def _symmetry(case: Case, drawn: Outline, parts: list[Leaves]) -> tuple[bool, Mirror | None]:
    """Whether to model the meridian, and else the mirror plane of a half, None for a full model."""
    reason = askew(parts)
    if reason and case.symmetry == "axisymmetric":
        raise CaseError(f"symmetry: axisymmetric: {reason}")
    if reason is None and case.symmetry in ("auto", "axisymmetric") and case.model == "shell":
        return True, None
    if isinstance(case.symmetry, int):
        places = [np.array(x) for x in case.points.values()]
        if sector_of_waves := sector(parts, drawn, case.symmetry, places):
            return False, sector_of_waves
        hint = ""
        if case.several:
            hint = "; each shell is held, and its own image in both"
        elif isinstance(case.shell, MeshSurface):
            hint = (
                "; the mesh file must be its own image in both, with each of its edges and patches"
            )
        raise CaseError(
            f"symmetry: {case.symmetry}: shell, supports, fields and load have no two mirror planes through e3 at an "
            f"angle of {180 / case.symmetry:g} degrees with all named points between them{hint}"
        )
    if case.symmetry not in ("auto", "half"):
        return False, None
    plane = mirror(parts, drawn, loosely=case.symmetry == "half")
    if case.symmetry == "half" and plane is None:
        if name := unmirrored(parts, drawn):
            raise CaseError(f"symmetry: half: the energy {name} does not share it")
        made = "; edges of a mesh file must lie in it: mesh a half, mirror the nodes and triangles, join them"
        hint = made if isinstance(case.shell, MeshSurface) else ""
        hint = "; each shell is held, and its own image in it" if case.several else hint
        raise CaseError(
            f"symmetry: half: shell, supports, fields and load have no common mirror plane{hint}"
        )
    return False, plane


def _cells(shape: Chart | RimmedGrid, size: Grading, plane: Mirror | None) -> float:
    """About how many triangles there will be."""
    if isinstance(shape, MeshFile):
        halved = isinstance(shape.given, Assembly)  # it has the cells of its half
        return cell_count(shape) / (plane.copies if plane and not halved else 1)
    return shape.cells * (0.5 if plane else 1.0) if isinstance(shape, Grid) else size.cells(shape)


def _turned(components: tuple[int, ...], turn: float) -> list[int]:
    """The components in a frame into which they turn as a whole."""
    held = np.eye(3)[list(components)] @ rotation(turn).T
    return [i for i in range(3) if held[:, i] @ held[:, i] > 0.5]


def _thickness(case: Case, turn: float) -> Thickness | None:
    if case.several:
        return case.several.thickness
    factor = case.thickness_factor
    if isinstance(factor, dict):
        return Thickness(patches=factor)
    if isinstance(factor, GivenField):
        return Thickness(given=factor)
    if not factor:
        return None
    told, Q = formula(factor), rotation(turn)
    return Thickness(
        lambda x, y, z: told(*np.tensordot(Q.T, np.stack([x, y, z]), 1)) if turn else told(x, y, z),
        formulas=together([told], Q),
    )
