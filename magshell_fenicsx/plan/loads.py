"""The loads of a case in the model's terms: over E h R and in the model's frame, on the part that is modelled."""

from math import radians

import numpy as np
import ufl
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.expressions import symbolic
from magshell_fenicsx.case.loading import (
    DeadLoadSection,
    DeadSection,
    IndentationSection,
    PressureSection,
    RotationSection,
)
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.mesh.frame import rotation
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import (
    AreaForce,
    DeadLoad,
    EdgeForce,
    EdgeMoment,
    Force,
    Loads,
    PointForce,
    Potential,
)
from magshell_fenicsx.plan.magnetisation import magnetisation
from magshell_fenicsx.models.shell.patterns import Pattern
from magshell_fenicsx.plan.by_formula import ByFormula, function
from magshell_fenicsx.plan.natural import natural
from magshell_fenicsx.plan.outline import Outline

Array = NDArray[np.float64]
SYMBOLIC = {name: getattr(ufl, name) for name in ("sin", "cos", "tan", "exp", "sqrt", "sign")}
SYMBOLIC |= {"log": ufl.ln, "abs": abs, "arctan2": ufl.atan2}


def loads(case: Case, under: str, turn: float, mirror: Mirror | None, own: tuple[OwnTerm, ...]) -> Loads:
    """What loads the shell.

    Parameters
    ----------
    under
        Name of the vertex under an indentation.
    turn
        Azimuth of the model's frame (rad).
    mirror
        Of the half that is modelled; None for all. A force on the plane, or on an edge across it, is shared by the
        halves; the loads of an edge of the other half are left out.
    own
        See `surface_terms`.
    """
    loading, magnetic = case.loading, case.magnetic
    force = None
    if isinstance(loading, IndentationSection):
        force = Force(under, loading.patch / case.shell.R_over_h)
    to = loading.to if isinstance(loading, RotationSection) else None
    field = magnetisation(magnetic, case, turn, to) if magnetic and case.lambda_m else None
    listed = loading.loads if isinstance(loading, DeadSection) else []
    dead = tuple(_dead(load, case, turn, mirror) for load in listed if not mirror or load.edge not in mirror.lost)
    return Loads(isinstance(loading, PressureSection), force, field, dead, own, natural(case, turn))


def indented(case: Case, outline: Outline) -> Array | None:
    """The place (3,) of an indentation, over R; None without one.

    Raises
    ------
    CaseError
        If a direction does not say where it is on this geometry, or it is too near to the pole.
    """
    loading = case.loading
    if not isinstance(loading, IndentationSection):
        return None
    if loading.at.point is not None:
        return np.asarray(np.array(case.points[loading.at.point]) / case.shell.reference)
    polar = radians(loading.at.polar)
    if not outline.sphere and polar:
        where = "at its centre or tip, polar: 0, or at a point of points"
        raise CaseError(f"loading.at.polar: {loading.at.polar:g}: a {case.shell.geometry} is loaded {where}")
    if outline.highest is None or not (outline.disc or case.shell.geometry == "strip"):
        raise CaseError(f"loading.at: a {case.shell.geometry} has no pole: give {{point: NAME}}, of points")
    if not outline.sphere:
        return np.asarray(outline.embedding(outline.highest[None])[0])
    if 0 < polar < 1 / case.shell.R_over_h:
        raise CaseError(f"loading.at.polar: {loading.at.polar:g}: 0, or more than a thickness from the pole")
    chart = polar * loading.at.vector()[:2] / max(np.hypot(*loading.at.vector()[:2]), 1e-300)
    return np.asarray(outline.embedding(chart[None])[0])


def refuse_wide_patch(case: Case, outline: Outline, at: Array) -> None:
    """See that the patch of a force is no wider than the shell around its place `at` in the chart.

    Raises
    ------
    CaseError
        With the radii that are allowed.
    """
    assert isinstance(case.loading, IndentationSection)
    room = outline.edge - float(np.hypot(*at[:2])) if outline.sphere else min(1.0, case.width or 1.0)
    patch, most = case.loading.patch, room * case.shell.R_over_h
    if patch and not 0.3 <= patch <= most:
        raise CaseError(
            f"loading.patch: {patch:g}: allowed are 0 for a point, or 0.3 to {most:.4g}, where it reaches the edge"
        )


def _dead(load: DeadLoadSection, case: Case, turn: float, mirror: Mirror | None) -> DeadLoad:
    shared = mirror is not None and (load.edge is None or mirror.other(load.edge) == load.edge)
    Q, scales = rotation(turn), case.scales
    E, t, R = scales.E, scales.h, scales.R
    if load.potential is not None:
        return Potential(_potential(load.potential, Q, R, 1 / (E * t)))
    if load.varies:
        unit = E * t if load.edge else E * t / R
        pattern = _pattern(load, Q, R, 1 / unit)
        return EdgeForce(load.edge, pattern, total=False) if load.edge else AreaForce(_over(load), pattern)
    force = np.asarray((0.5 if shared else 1.0) * (Q @ (load.force or np.zeros(3))) / (E * t * R))
    if load.at is not None:
        return PointForce(load.at, force)
    if load.edge is not None and load.moment is not None:
        return EdgeMoment(load.edge, load.moment / (E * t * R))
    if load.edge is not None and load.force is not None:
        return EdgeForce(load.edge, force, total=True)
    if load.edge is not None:
        assert load.per_length is not None
        return EdgeForce(load.edge, np.asarray(Q @ load.per_length / (E * t)), total=False)
    if load.pressure is not None:
        assert isinstance(load.pressure, float | int)
        return AreaForce(_over(load), load.pressure * R / (E * t))
    assert load.per_area is not None
    return AreaForce(_over(load), np.asarray(Q @ load.per_area * R / (E * t)))


def _over(load: DeadLoadSection) -> str | None:
    return None if load.over == "all" else load.over


def _pattern(load: DeadLoadSection, Q: Array, length: float, factor: float) -> Pattern:
    """The load of a formula in the model's frame; a pressure is against the normal."""
    if load.vector is not None:
        return ByFormula([function(v) for v in load.vector], Q, length, factor, vectors=True)
    assert load.pressure is not None
    p = ByFormula([function(load.pressure)], Q, length, factor)
    return lambda r0, n0: -p(r0, n0) * n0


def potentials(case: Case, turn: float = 0.0) -> list[OwnTerm]:
    """The energies of loads that depend on the deformed place, in a frame turned about e3 (rad)."""
    listed = case.loading.loads if isinstance(case.loading, DeadSection) else []
    s, Q = case.scales if listed else None, rotation(turn)
    return [_potential(load.potential, Q, s.R, 1 / (s.E * s.h)) for load in listed if s and load.potential]


def _potential(text: str, Q: Array, length: float, factor: float) -> OwnTerm:
    """Zero where nothing has moved."""

    def at(r: Expr, scale: Expr, size: Expr) -> Expr:
        x = [scale * sum(float(Q[j, i]) * r[j] for j in range(3) if Q[j, i]) for i in range(3)]
        return size * symbolic(text, SYMBOLIC, *x)

    def density(r0: Jet, u: Jet, scale: Expr, size: Expr) -> Expr:
        return at(r0.r + u.r, scale, size) - at(r0.r, scale, size)

    return OwnTerm("potential", density, (length, factor))
