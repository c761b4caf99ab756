"""The plan of a case on any mid-surface: what is meshed, held and loaded, over the reference length R."""

from math import pi, radians, sqrt

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.boundary import BoundarySection, EdgeCondition, HeldSection
from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.expressions import formula
from magshell_fenicsx.case.loading import DeadLoadSection, DeadSection, PressureSection, RotationSection
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.case.surfaces import (
    AnnulusSurface,
    CapSurface,
    CylinderSurface,
    MeshSurface,
    PlateSurface,
    RevolutionSurface,
    RoundSection,
    Surface,
    SurfaceSection,
    TorusSurface,
)
from magshell_fenicsx.mesh.grading import Grading
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.mesh.msh import MeshFile, in_space
from magshell_fenicsx.mesh.patch import Embedding
from magshell_fenicsx.mesh.revolved import Arc, Capped, Profile, Revolved, Segment, Spline
from magshell_fenicsx.mesh.shapes import DiscShape, Shape
from magshell_fenicsx.mesh.sphere import flat
from magshell_fenicsx.models.shell.parameters import (
    AreaForce,
    Condition,
    DeadLoad,
    EdgeForce,
    EdgeMoment,
    Held,
    Loads,
    Material,
    PointForce,
)
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.plan.limits import refuse_too_large, refuse_too_many, refuse_unbounded_fields
from magshell_fenicsx.plan.magnetisation import magnetisation
from magshell_fenicsx.plan.plan import Plan

Array = NDArray[np.float64]
ON_SURFACE = 1e-6  # of R, within which a named point lies on the surface


def plan_surface(case: Case, shell: Surface) -> Plan:
    """Plan a case on a surface other than a hemisphere, disc or strip.

    Raises
    ------
    CaseError
        If what is asked for cannot be built.
    """
    R, loading, magnetic = shell.reference, case.loading, case.magnetic
    material = Material(shell.poisson_ratio, 1 / shell.R_over_h)
    size = _size(case, shell)
    shape, embedding = _chart(shell, size)
    points = {name: _charted(name, np.array(x) / R, shell, shape, embedding) for name, x in case.points.items()}
    if points:
        points["pole"] = next(iter(points.values()))
    elif not isinstance(shape, MeshFile):  # the reader takes the highest vertex
        points["pole"] = _somewhere(shape)
    to = loading.to if isinstance(loading, RotationSection) else None
    field_on = magnetic is not None and case.lambda_m != 0
    dead = tuple(_dead(load, shell) for load in loading.loads) if isinstance(loading, DeadSection) else ()
    loads = Loads(
        pressure=isinstance(loading, PressureSection),
        magnetic=magnetisation(magnetic, shell, 0.0, to) if magnetic and field_on else None,
        dead=dead,
    )
    if isinstance(shape, Grid):
        refuse_too_many(case, shape.cells)
    elif isinstance(shape, DiscShape):
        refuse_too_large(case, Grading([], size), shape)
    refuse_unbounded_fields(case, np.zeros((0, 3)))
    included = ["the surface as described", "membrane and bending energy"]
    left_out = [] if magnetic else ["magnetic energy: no magnetic section"]
    if loads.magnetic:
        included.append(f"magnetic energy ({loads.magnetic.energy}), lambda_m = {case.lambda_m:g}")
    included += ["live pressure"] if loads.pressure else []
    included += [f"{len(dead)} dead load{'s' * (len(dead) > 1)}"] if dead else []
    return Plan(
        material=material,
        loads=loads,
        conditions=edge_conditions(case.boundary),
        axisymmetric=False,
        half=False,
        azimuth=0.0,
        shape=shape,
        embedding=embedding,
        points=points,
        size=Grading([], size),
        included=included,
        left_out=left_out,
        thickness=_thickness(shell),
        length=R,
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


def _size(case: Case, shell: Surface) -> float:
    """Element size over R: by default twice the shell's own length sqrt(Rh), within reason."""
    size = case.mesh.size / shell.reference if case.mesh.size else min(2 / sqrt(shell.R_over_h), 0.35)
    return size / case.mesh.refinement


def _chart(shell: Surface, size: float) -> tuple[Shape | Grid | MeshFile, Embedding]:
    R = shell.reference
    if isinstance(shell, MeshSurface):
        return MeshFile(shell.path, (shell.unit or 1.0) / R), in_space
    if isinstance(shell, PlateSurface):
        return Grid((0.0, 0.0), (1.0, shell.width / R), size), flat
    profile, names = _profile(shell)
    if names[1] is None:
        return DiscShape(profile.length, half=False, edge=names[0]), Capped(profile)
    first, last = shell.turn
    along = np.linspace(0, profile.length, 101, dtype=np.float64)
    rho = float(profile(along)[:, 0].max())
    closed = shell.azimuth is None
    tube = isinstance(shell, TorusSurface) and shell.tube is None
    sides = ("left", "right", names[0], names[1])
    grid = Grid((first * rho, 0.0), (last * rho, profile.length), size, sides, (closed, tube))
    return grid, Revolved(profile, rho)


def _profile(shell: Surface) -> tuple[Profile, tuple[str, str | None]]:
    """The curve that is turned about e3, over R, and the names of its ends; no second one for the pole."""
    if isinstance(shell, CapSurface):
        top = pi / 2 if shell.hole is None else pi / 2 - radians(shell.hole)
        return Arc(1.0, pi / 2 - radians(shell.polar), top), ("rim", "hole" if shell.hole else None)
    if isinstance(shell, CylinderSurface):
        return Segment((1.0, 0.0), (1.0, shell.length / shell.radius)), ("bottom", "top")
    if isinstance(shell, AnnulusSurface):
        return Segment((1.0, 0.0), (shell.inner_radius / shell.radius, 0.0)), ("outer", "inner")
    if isinstance(shell, TorusSurface):
        first, last = shell.tube or (0.0, 360.0)
        return Arc(shell.tube_radius / shell.radius, radians(first), radians(last), 1.0), ("bottom", "top")
    assert isinstance(shell, RevolutionSurface)
    curve = shell.profile.curve / shell.reference
    straight = len(curve) == 2
    ends = tuple(map(float, curve[0])), tuple(map(float, curve[1]))
    profile: Profile = Segment(*ends) if straight else Spline(curve)  # type: ignore[arg-type]
    return profile, ("bottom", None if curve[-1, 0] == 0 else "top")


def _charted(name: str, x: Array, shell: Surface, shape: Shape | Grid | MeshFile, embedding: Embedding) -> Array:
    """Where a named point is in the chart (in space, for a mesh).

    Raises
    ------
    CaseError
        If it is not on the surface.
    """
    if isinstance(shape, MeshFile):
        return x
    if isinstance(embedding, Revolved):
        assert isinstance(shell, RoundSection | RevolutionSurface)
        found = embedding.inverse(x, shell.turn[0])
        if isinstance(shape, Grid):
            found = np.clip(found, shape.low, shape.high)
    else:
        found = embedding.inverse(x) if isinstance(embedding, Capped) else np.clip(x[:2], 0.0, shape.high)  # type: ignore[union-attr]
    there = embedding(found[None])[0]
    if np.linalg.norm(there - x) > ON_SURFACE:
        R = shell.reference
        near = ", ".join(f"{c * R:.8g}" for c in there)
        raise CaseError(f"points.{name}: is not on the surface; a place near it that is: [{near}]")
    return found


def _somewhere(shape: Shape | Grid) -> Array:
    """A vertex that every such mesh has: the end of a grid, the centre of a disc."""
    if isinstance(shape, Grid):
        return np.array(shape.high) if not any(shape.glued) else np.array(shape.low)
    return np.zeros(2)


def _dead(load: DeadLoadSection, shell: SurfaceSection) -> DeadLoad:
    E, t, R = shell.youngs_modulus, shell.thickness, shell.reference
    assert E is not None
    if load.at is not None:
        assert load.force is not None
        return PointForce(load.at, np.array(load.force) / (E * t * R))
    if load.edge is not None and load.moment is not None:
        return EdgeMoment(load.edge, load.moment / (E * t * R))
    if load.edge is not None and load.force is not None:
        return EdgeForce(load.edge, np.array(load.force) / (E * t * R), total=True)
    if load.edge is not None:
        assert load.per_length is not None
        return EdgeForce(load.edge, np.array(load.per_length) / (E * t), total=False)
    patch = None if load.over == "all" else load.over
    if load.pressure is not None:
        return AreaForce(patch, load.pressure * R / (E * t))
    assert load.per_area is not None
    return AreaForce(patch, np.asarray(np.array(load.per_area) * R / (E * t)))


def _thickness(shell: SurfaceSection) -> Thickness | None:
    if isinstance(shell.thickness_factor, dict):
        return Thickness(patches=shell.thickness_factor)
    return Thickness(formula(shell.thickness_factor)) if shell.thickness_factor else None
