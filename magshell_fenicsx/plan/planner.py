"""From a case to what must be built for it, without building anything: the parts added up."""

from collections.abc import Sequence
from math import radians

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.boundary import BoundarySection, EdgeCondition, HeldSection
from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.expressions import formula
from magshell_fenicsx.case.loading import DeadSection, IndentationSection
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.mesh.frame import rotation
from magshell_fenicsx.mesh.grading import Grading
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.mesh.shapes import DiscShape, StripShape
from magshell_fenicsx.mesh.sphere import Dimple
from magshell_fenicsx.models.axisymmetric.meridian import graded_vertices
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import Condition, Held, Material
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.plan.account import account
from magshell_fenicsx.plan.limits import refuse_too_large, refuse_too_many, refuse_unbounded_fields, sample
from magshell_fenicsx.plan.loads import indented, loads, refuse_wide_patch
from magshell_fenicsx.plan.names import refuse_unfit_ends
from magshell_fenicsx.plan.outline import Chart, Outline, outline, refuse_beside
from magshell_fenicsx.plan.own_terms import surface_terms
from magshell_fenicsx.plan.plan import Plan, Span
from magshell_fenicsx.plan.sizes import grading
from magshell_fenicsx.plan.symmetry import Leaves, askew, left, mirror, unmirrored

Array = NDArray[np.float64]
Points = dict[str, Array]


def make_plan(case: Case, terms: Sequence[OwnTerm] = ()) -> Plan:
    """Plan a case, with one's own energies.

    Raises
    ------
    CaseError
        If the symmetry that is asked for is not there, or what is asked for cannot be built.
    MeshError
        If the meridian has no such edge or point.
    """
    material = Material(case.shell.poisson_ratio, 1 / case.shell.R_over_h)
    defect = Dimple(case.defect.amplitude * material.h, case.dimple_half_width) if case.defect else None
    drawn = outline(case, defect)
    place = indented(case, drawn)
    energies = surface_terms(case, terms)
    axisymmetric, azimuth = _symmetry(case, drawn, left(case, drawn, place, energies))
    half = azimuth is not None
    turn = (azimuth or 0.0) if drawn.round else 0.0  # a strip lies along e1 whichever way the field points
    points = _points(case, drawn, place, turn, half)
    under = "load" if "load" in points else "pole"
    if place is not None:
        refuse_wide_patch(case, drawn, points[under])
    loading = case.loading
    at = [load.at for load in loading.loads if load.at] if isinstance(loading, DeadSection) else []
    names = [under] if isinstance(loading, IndentationSection) else at
    size = grading(case, drawn, material.h, defect, [points[name] for name in names])
    shape = drawn.chart(half, size.largest)
    span = drawn.span if axisymmetric else None
    _refuse_unreasonable(case, drawn, shape, size, span)
    conditions = edge_conditions(case.boundary)
    if half:
        conditions["symmetry"] = "symmetry"
    loaded = loads(case, under, turn, 0.5 if half else 1.0, energies)
    if span:
        refuse_unfit_ends([name for name in span.names if name], points, conditions, loaded)
    model = "meridian" if axisymmetric else f"{'half' if half else 'full'} {case.model}"
    included, left_out = account(case, loaded, model, turn)
    return Plan(
        material=material,
        loads=loaded,
        conditions=conditions,
        meridian=span,
        half=half,
        azimuth=turn,
        shape=shape,
        embedding=drawn.embedding,
        points=points,
        size=size,
        included=[*included, *(f"own energy: {term.name}" for term in terms)],
        left_out=left_out,
        thickness=_thickness(case),
        length=case.shell.reference,
        own=tuple(terms),
    )


def edge_conditions(boundary: BoundarySection) -> dict[str, Condition]:
    """The conditions of a case in the model's terms."""
    terms: dict[EdgeCondition, Condition] = {
        "hinged": "simply supported",
        "symmetry": "plane",
        "clamped": "clamped",
        "simply supported": "simply supported",
        "free": "free",
    }
    return {
        name: Held(c.components) if isinstance(c, HeldSection) else terms[c]
        for name, c in boundary.conditions().items()
    }


def meridian_vertices(plan: Plan, refinement: float) -> Array:
    """Vertices of the meridian's mesh, in the chart."""
    span = plan.meridian
    assert span
    pole = span.names[0] is None
    h = plan.material.h / span.curvature
    return graded_vertices(span.length, span.circle, h, refinement=refinement, axis=pole)


def _symmetry(case: Case, drawn: Outline, parts: list[Leaves]) -> tuple[bool, float | None]:
    """Whether to model the meridian, and else the azimuth of the mirror plane of a half, None for a full model."""
    reason, azimuth = askew(parts), mirror(parts)
    if case.symmetry == "half" and azimuth is None:
        if name := unmirrored(parts):
            raise CaseError(f"symmetry: half: the energy {name} does not share it")
        if not drawn.round and case.shell.geometry != "strip":
            raise CaseError(
                f"symmetry: half: not with a {case.shell.geometry}; describe a part of it and give its edges "
                "boundary: {name: symmetry}"
            )
        raise CaseError("symmetry: half: the shell, the fields and the load have no common mirror plane through e3")
    if reason and case.symmetry == "axisymmetric":
        raise CaseError(f"symmetry: axisymmetric: {reason}")
    axisymmetric = reason is None and case.symmetry in ("auto", "axisymmetric") and case.model == "shell"
    half = not axisymmetric and case.symmetry in ("auto", "half")
    return axisymmetric, azimuth if half else None


def _points(case: Case, drawn: Outline, place: Array | None, turn: float, half: bool) -> Points:
    """Named vertices in the chart, "pole" and "load" among them."""
    Q, R = rotation(turn), case.shell.reference

    def chart(name: str, x: Array) -> Array:
        refuse_beside(name, x, drawn, R)
        found = drawn.inverse(Q @ x)
        return drawn.on_half(found) if half else found

    points = {name: chart(name, np.array(x) / R) for name, x in case.points.items()}
    if points:
        points["pole"] = next(iter(points.values()))
    elif drawn.highest is not None:
        points["pole"] = drawn.highest
    if place is None:
        return points
    load = _place(case, drawn, place, turn, half)
    if "pole" not in points or not np.array_equal(load, points["pole"]):
        points["load"] = load
    return points


def _place(case: Case, drawn: Outline, place: Array, turn: float, half: bool) -> Array:
    loading = case.loading
    assert isinstance(loading, IndentationSection)
    if loading.at.point is None and drawn.sphere:
        polar, theta = radians(loading.at.polar), radians(loading.at.azimuth) - turn
        return polar * np.array([np.cos(theta), 0.0 if half else np.sin(theta)]) if polar else np.zeros(2)
    found = drawn.inverse(rotation(turn) @ place)
    return drawn.on_half(found) if half else found


def _refuse_unreasonable(case: Case, drawn: Outline, shape: Chart, size: Grading, span: Span | None) -> None:
    if span:
        refuse_unbounded_fields(case, span.sample())
        return
    if isinstance(shape, DiscShape | StripShape):
        refuse_unbounded_fields(case, drawn.embedding(sample(shape)))
        refuse_too_large(case, size, shape)
        return
    refuse_unbounded_fields(case, np.zeros((0, 3)))
    if case.mesh.tolerance is not None:
        raise CaseError(f"mesh.tolerance: not with a {case.shell.geometry}; magshell study compares meshes and degrees")
    if isinstance(shape, Grid):
        refuse_too_many(case, shape.cells)


def _thickness(case: Case) -> Thickness | None:
    factor = case.thickness_factor
    if isinstance(factor, dict):
        return Thickness(patches=factor)
    return Thickness(formula(factor)) if factor else None
