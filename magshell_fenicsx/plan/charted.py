"""From a case to what must be built for it, without building anything.

The plan decides the mirror plane, the mesh grading and the loads; `magshell check`
prints it, `Scene` builds it.
"""

from collections.abc import Sequence
from math import atan2, cos, degrees, hypot, pi, radians, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.fields import Direction
from magshell_fenicsx.case.loading import IndentationSection, PressureSection, RotationSection
from magshell_fenicsx.case.shell import ShellSection
from magshell_fenicsx.case.solid import SolidSection
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.mesh.grading import Disc, Feature, Grading, Ring
from magshell_fenicsx.mesh.msh import MeshFile
from magshell_fenicsx.mesh.patch import Embedding, MeshError, PatchMesh
from magshell_fenicsx.mesh.shapes import DiscShape, Shape, StripShape
from magshell_fenicsx.mesh.sphere import Dimple, SphereEmbedding, flat
from magshell_fenicsx.models.axisymmetric.meridian import graded_vertices
from magshell_fenicsx.models.shell.parameters import Force, Loads, Material
from magshell_fenicsx.models.solid.material import NeoHookean
from magshell_fenicsx.plan.limits import refuse_too_large, refuse_unbounded_fields, sample
from magshell_fenicsx.plan.magnetisation import magnetisation
from magshell_fenicsx.plan.plan import Plan
from magshell_fenicsx.plan.surfaces import edge_conditions, plan_surface

__all__ = ["Plan", "describe", "make_plan"]


def make_plan(case: Case) -> Plan:
    """Plan a case.

    Raises
    ------
    CaseError
        If the symmetry that is asked for is not there, or what is asked for cannot be built.
    """
    if not isinstance(case.shell, ShellSection):
        return plan_surface(case, case.shell)
    shell, loading, magnetic = case.shell, case.loading, case.magnetic
    material = Material(shell.poisson_ratio, 1 / shell.R_over_h)
    field_on = magnetic is not None and case.lambda_m != 0
    indentation = loading if isinstance(loading, IndentationSection) else None
    directions = [*magnetic.remanent.directions(), magnetic.applied] if magnetic and field_on else []
    to = loading.to if isinstance(loading, RotationSection) else None
    directions += [to] if to else []
    azimuth = common_azimuth([*directions, *([indentation.at] if indentation else [])])
    of_position = field_on and magnetic and (magnetic.remanent.kind == "expression" or magnetic.applied.gradient)
    if of_position and (case.symmetry != "half" or azimuth):
        azimuth = None  # only the user knows whether it is symmetric to the plane y = 0
    if shell.geometry == "strip" and azimuth is not None and abs(sin(azimuth)) > 1e-12:
        azimuth = None  # the strip's own mirror plane is y = 0
    if case.symmetry == "half" and azimuth is None:
        raise CaseError("symmetry: half: the shell, the fields and the load have no common mirror plane through e3")
    reason = _not_axisymmetric(case)
    if reason and case.symmetry == "axisymmetric":
        raise CaseError(f"symmetry: axisymmetric: {reason}")
    axisymmetric = reason is None and case.symmetry in ("auto", "axisymmetric") and case.model == "shell"
    half = azimuth is not None and not axisymmetric and case.symmetry in ("auto", "half")
    turn = azimuth if half and azimuth is not None else 0.0

    defect = Dimple(shell.defect.amplitude * material.h, shell.dimple_half_width) if shell.defect else None
    hemisphere = shell.geometry == "hemisphere"
    points: dict[str, NDArray[np.float64]] = {"pole": np.array([float(shell.geometry == "strip"), 0.0])}
    force = None
    if indentation:
        at, theta = radians(indentation.at.polar), radians(indentation.at.azimuth) - turn
        name = "load" if at else "pole"
        if 0 < at < material.h:
            raise CaseError(f"loading.at.polar: {indentation.at.polar:g}: 0, or more than a thickness from the pole")
        if at:  # else at the pole, which is the tip of a strip
            points[name] = at * np.array([cos(theta), 0.0 if half else sin(theta)])
        force = Force(name, indentation.patch * material.h)
        room = pi / 2 - at if hemisphere else min(1.0, shell.width or 1.0)
        if indentation.patch and not 0.3 <= indentation.patch <= room * shell.R_over_h:
            raise CaseError(
                f"loading.patch: {indentation.patch:g}: allowed are 0 for a point, or 0.3 to "
                f"{room * shell.R_over_h:.4g}, where it reaches the edge"
            )
    shape: Shape
    if shell.width is not None:
        shape = StripShape(shell.width, half)
    else:
        shape = DiscShape(pi / 2 if hemisphere else 1.0, half, defect.phi_o if defect else None)
    # the equator is the rim of the chart
    conditions = {"rim" if name == "equator" else name: c for name, c in edge_conditions(case.boundary).items()}
    if half:
        conditions["symmetry"] = "symmetry"
    loads = Loads(
        pressure=isinstance(loading, PressureSection),
        force=force,
        magnetic=magnetisation(magnetic, shell, turn, to) if magnetic and field_on else None,
    )
    size = _grading(case, material.h, defect, points)
    embedding: Embedding = SphereEmbedding(defect) if hemisphere else flat
    refuse_unbounded_fields(case, embedding(sample(shape)))
    if not axisymmetric:
        refuse_too_large(case, size, shape)
    model = "meridian" if axisymmetric else f"{'half' if half else 'full'} {case.model}"
    included, left_out = _account(case, loads, model, azimuth)
    return Plan(
        material=material,
        loads=loads,
        conditions=conditions,
        axisymmetric=axisymmetric,
        half=half,
        azimuth=turn,
        shape=shape,
        embedding=embedding,
        points=points,
        size=size,
        included=included,
        left_out=left_out,
    )


def _not_axisymmetric(case: Case) -> str | None:
    """What keeps a case from being a meridian turned about e3; None if nothing does."""
    if case.shell.geometry == "strip":
        return "a strip is no surface of revolution"
    if isinstance(case.loading, IndentationSection) and case.loading.at.polar:
        return "the force is not at the pole"
    if isinstance(case.loading, RotationSection):
        return "the field turns"
    magnetic = case.magnetic
    if magnetic is None or not case.lambda_m:
        return None
    if any(hypot(*d.vector()[:2]) > 1e-12 for d in (*magnetic.remanent.directions(), magnetic.applied)):
        return "a field is not along e3"
    if magnetic.remanent.kind == "expression":
        return "only the user knows whether the remanence's formula is"
    gradient = np.array(magnetic.applied.gradient or np.zeros((3, 3)))
    if np.abs(gradient - np.diag([gradient[0, 0], gradient[0, 0], gradient[2, 2]])).max() > 1e-12:
        return "the gradient of the applied field is not diag(a, a, b)"
    return None


def common_azimuth(directions: Sequence[Direction]) -> float | None:
    """Azimuth (rad) of the plane through e3 that holds all directions; None if there is none.

    0 if every direction is along e3.
    """
    horizontal = [d.vector()[:2] for d in directions]
    tilted = [v for v in horizontal if hypot(*v) > 1e-12]
    if not tilted:
        return 0.0
    x, y = tilted[0]
    if any(abs(x * v[1] - y * v[0]) > 1e-10 * hypot(x, y) * hypot(*v) for v in tilted):
        return None
    return atan2(y, x)


def _grading(case: Case, h: float, defect: Dimple | None, points: dict[str, NDArray[np.float64]]) -> Grading:
    """Element sizes for 1e-4 in k_d and 1e-3 in F at degree 4, in units of the shell's length sqrt(Rh)."""
    length, refine = sqrt(h), case.mesh.refinement
    loading = case.loading
    indentation = loading if isinstance(loading, IndentationSection) else None
    solid = case.model == "solid"  # of degree 2, which far from the ridge needs more than degree 4
    growth = (0.5 if solid else 0.6) if indentation else 0.4
    if case.shell.geometry != "hemisphere":
        features: list[Feature] = []
        largest = min(0.25, 0.5 * (case.charted.width or 1.0))
    else:
        # the equator is far from a dent
        features = [Ring(pi / 2, ((2.0 if solid else 2.8) if indentation else 1.4) * length / refine, growth)]
        # without a dimple the sphere buckles anywhere, in waves of about 3.6 sqrt(Rh)
        largest = 1.2 * length if defect is None and isinstance(loading, PressureSection) else 0.35
    if defect:
        features.append(Disc((0.0, 0.0), defect.phi_o + 0.7 * length, 0.45 * length / refine, growth))
    if indentation:
        x, y = points.get("load", points["pole"])
        depth = abs(indentation.depth) if indentation.depth else 10.0
        # mirror buckling: the ridge's radius is about sqrt(2 R w)
        dent = (1.0 if solid else 0.85) * sqrt(2 * depth * h) + 0.5 * length
        features.append(Disc((x, y), dent, length / refine, growth))
        # finer than h the point force's logarithmic stretch would be resolved, which has no limit
        centre = max(indentation.patch * h / 2, h) if indentation.patch else h
        features.append(Disc((x, y), indentation.patch * h, centre, growth))
    return Grading(features, largest / refine)


def _account(case: Case, loads: Loads, model: str, azimuth: float | None) -> tuple[list[str], list[str]]:
    included = [model, "membrane and bending energy" if case.model == "shell" else _elastic(case)]
    left_out = []
    if loads.magnetic:
        included.append(f"magnetic energy ({loads.magnetic.energy}), lambda_m = {case.lambda_m:g}")
    else:
        left_out.append("magnetic energy: " + ("lambda_m is zero" if case.magnetic else "no magnetic section"))
    if loads.pressure:
        included.append("live pressure" if case.model == "shell" else "live pressure on the outer face")
    else:
        left_out.append("pressure: not loaded by it (the volume is only reported)")
    if loads.force:
        patch = loads.force.patch * case.shell.R_over_h
        included.append(f"force on a patch of radius {patch:g} h" if patch else "force at a point")
    else:
        left_out.append("force: none")
    if model == "meridian":
        left_out.append("waves around the axis (they are looked for at the end of each path)")
    if model.startswith("half"):
        left_out.append(
            f"the other half: mirror plane through e3 at azimuth {degrees(azimuth or 0.0):g} degrees "
            "(modes antisymmetric to it are looked for at the end of each path)"
        )
    return included, left_out


def neo_hookean(case: Case) -> NeoHookean:
    """The solid's material."""
    return NeoHookean.of(case.shell.poisson_ratio, (case.solid or SolidSection()).bulk_to_shear)


def _elastic(case: Case) -> str:
    material, layers = neo_hookean(case), (case.solid or SolidSection()).layers
    ratio = material.bulk / material.shear
    small_strains = f"E = {material.youngs_modulus:.5g}, nu = {material.nu:.5g} for small strains"
    return f"neo-Hookean energy, kappa/mu = {ratio:.5g} ({small_strains}), {layers} layer{'s' * (layers > 1)}"


def describe(case: Case) -> str:
    """What `magshell check` prints: dimensionless numbers, what is built, what is left out.

    Raises
    ------
    CaseError
        If the case cannot be built, or nothing is held.
    """
    plan = make_plan(case)
    if all(condition == "free" for condition in plan.conditions.values()):
        raise CaseError("boundary: nothing is held: clamp an edge or a patch, or hold points, for instance")
    numbers = {
        "R/h": 1 / plan.material.h,
        "nu": plan.material.nu,
        "p_c/E": plan.material.classical_pressure,
        "lambda_m": case.lambda_m,
        "Lambda_m = lambda_m R/h": case.lambda_m / plan.material.h,
    }
    lines = [f"{name} = {value:.6g}" for name, value in numbers.items()]
    if case.mesh.tolerance is None:
        patch = None if plan.axisymmetric else _meshed(plan)
        cells, unknowns = _count(case, plan, patch)
        lines.append(f"mesh: {cells} cells of degree {case.degree}, {unknowns} unknowns")
        if patch and isinstance(plan.shape, MeshFile):
            lines += _surface(patch)
    else:
        lines.append(f"mesh: found by the run, for a relative error of its result below {case.mesh.tolerance:g}")
    left_out = plan.left_out or ["nothing"]
    lines += ["built:", *(f"  {item}" for item in plan.included), "left out:", *(f"  {item}" for item in left_out)]
    return "\n".join(lines)


def _meshed(plan: Plan) -> PatchMesh:
    try:
        return plan.triangulated()
    except MeshError as e:
        raise CaseError(str(e)) from None


def _surface(patch: PatchMesh) -> list[str]:
    """What a mesh file holds, for its author to see that it was read as it was meant."""
    places = patch.embedding(patch.nodes)
    a, b, c = places[patch.cells[0, :3]]
    normal = np.cross(b - a, c - a)
    extent, at, n = np.ptp(places, axis=0), (a + b + c) / 3, normal / np.linalg.norm(normal)
    return [
        f"extent over the radius: {' x '.join(f'{x:.4g}' for x in extent)}",
        f"edges: {', '.join(patch.edges) or 'none'}; patches: {', '.join(patch.patches) or 'none'}",
        f"outside: the normal at {_told(at)}, over the radius, is {_told(n)}",
    ]


def _told(vector: NDArray[np.float64]) -> str:
    return f"({', '.join(f'{x + 0.0:.4g}' for x in np.round(vector, 9))})"


def _count(case: Case, plan: Plan, patch: PatchMesh | None) -> tuple[int, int]:
    """Cells and unknowns of the mesh, or of the meridian."""
    k = case.degree
    if patch is None:
        return (count := len(meridian_vertices(plan, case.mesh.refinement)) - 1), 2 * (k * count + 1)
    cells, corners = patch.corners, len(np.unique(patch.corners))
    sides = len(np.unique(np.sort(cells[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0))
    if case.model == "solid":  # three hexahedra a layer above each triangle
        layers = (case.solid or SolidSection()).layers
        return 3 * len(cells) * layers, 3 * (2 * layers + 1) * (corners + 3 * sides + 7 * len(cells))
    return len(cells), 3 * (corners + (k - 1) * sides + (k - 1) * (k - 2) // 2 * len(cells))


def meridian_vertices(plan: Plan, refinement: float) -> NDArray[np.float64]:
    """Vertices of the meridian's mesh, in the chart."""
    assert isinstance(plan.shape, DiscShape)
    return graded_vertices(plan.shape.radius, plan.shape.circle, plan.material.h, refinement=refinement)
