"""The loads of a case in the model's terms: over E h R and in the model's frame, on the part that is modelled."""

from collections.abc import Mapping
from math import radians

import numpy as np
import ufl
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.by_formula import ByFormula, Inwards, function
from magshell_fenicsx.input.expressions import symbolic
from magshell_fenicsx.input.source import CaseError
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
from magshell_fenicsx.models.shell.patterns import Inside, Pattern
from magshell_fenicsx.parts.forces.dead import DeadLoadSection, DeadSection
from magshell_fenicsx.parts.forces.indentation import IndentationSection, Place
from magshell_fenicsx.parts.magnetism.field_step import RotationSection
from magshell_fenicsx.parts.magnetism.magnetisation import magnetisation
from magshell_fenicsx.parts.motion.step import TimeSection
from magshell_fenicsx.parts.natural.planned import natural
from magshell_fenicsx.parts.supports.moves import moves
from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
SYMBOLIC = {name: getattr(ufl, name) for name in ("sin", "cos", "tan", "exp", "sqrt", "sign")}
SYMBOLIC |= {"log": ufl.ln, "abs": abs, "arctan2": ufl.atan2}


def loads(
    case: Case,
    under: Mapping[str, str],
    turn: float,
    mirror: Mirror | None,
    own: tuple[OwnTerm, ...],
    within: Mapping[str, Inside],
) -> Loads:
    """What loads the shell.

    Parameters
    ----------
    under
        Amplitude of an indentation -> name of the vertex under it.
    turn
        Azimuth of the model's frame (rad).
    mirror
        Of the half that is modelled; None for all. A force on the plane, or on an edge across it, is shared by the
        halves; the loads of an edge of the other half are left out.
    own
        See `surface_terms`.
    within
        Of `Plan`.
    """
    steps, magnetic = {step.name: step.load for step in case.programme}, case.magnetic
    forces, dead = dict[str, Force](), dict[str, tuple[DeadLoad, ...]]()
    for name, load in steps.items():
        if isinstance(load, IndentationSection):
            forces[name] = Force(under[name], load.patch / case.shell.R_over_h)
        elif isinstance(load, DeadSection):
            here = (one for one in load.loads if not mirror or one.edge not in mirror.lost)
            dead[name] = tuple(_dead(one, f"{name}_potential_{i}", case, turn, mirror) for i, one in enumerate(here))
    driven = {*steps, *(name for load in case.loads_of(TimeSection) for name in load.drives)}
    turned = [load.to for load in case.loads_of(RotationSection)]
    field = magnetisation(magnetic, case, turn, within, turned) if magnetic and "lambda_m" in driven else None
    pressure = "pressure" in driven or any("pressure" in step.load.hold for step in case.programme)
    return Loads(pressure, forces, field, dead, own, natural=natural(case, turn, within), moves=moves(case, turn))


def indented(case: Case, outline: Outline) -> dict[str, Array]:
    """Amplitude of an indentation -> its place (3,), over R.

    Raises
    ------
    CaseError
        If a direction does not say where it is on this geometry, or it is too near to the pole.
    """
    steps = {step.name: step for step in case.programme}
    return {
        name: _indented(case, outline, step.load.at, step.key)
        for name, step in steps.items()
        if isinstance(step.load, IndentationSection)
    }


def _indented(case: Case, outline: Outline, at: Place, key: str) -> Array:
    if at.point is not None:
        return np.asarray(np.array(case.points[at.point]) / case.shell.reference)
    polar = radians(at.polar)
    if not outline.sphere and polar:
        where = "at its centre or tip, polar: 0, or at a point of points"
        raise CaseError(f"{key}.at.polar: {at.polar:g}: a {case.shell.geometry} is loaded {where}")
    if outline.highest is None or not (outline.disc or case.shell.geometry == "strip"):
        raise CaseError(f"{key}.at: a {case.shell.geometry} has no pole: give {{point: NAME}}, of points")
    if not outline.sphere:
        return np.asarray(outline.embedding(outline.highest[None])[0])
    if 0 < polar < 1 / case.shell.R_over_h:
        raise CaseError(f"{key}.at.polar: {at.polar:g}: 0, or more than a thickness from the pole")
    chart = polar * at.vector()[:2] / max(np.hypot(*at.vector()[:2]), 1e-300)
    return np.asarray(outline.embedding(chart[None])[0])


def refuse_wide_patch(case: Case, outline: Outline, at: Mapping[str, Array]) -> None:
    """See that the patches of forces are no wider than the shell around their places in the chart.

    Parameters
    ----------
    at
        Amplitude -> place.

    Raises
    ------
    CaseError
        With the radii that are allowed.
    """
    for step in case.programme:
        if not isinstance(step.load, IndentationSection):
            continue
        room = outline.edge - float(np.hypot(*at[step.name][:2])) if outline.sphere else min(1.0, case.width or 1.0)
        patch, most = step.load.patch, room * case.shell.R_over_h
        if patch and not 0.3 <= patch <= most:
            raise CaseError(
                f"{step.key}.patch: {patch:g}: allowed are 0 for a point, or 0.3 to {most:.4g}, where it "
                "reaches the edge"
            )


def _dead(load: DeadLoadSection, name: str, case: Case, turn: float, mirror: Mirror | None) -> DeadLoad:
    shared = mirror is not None and (load.edge is None or mirror.other(load.edge) == load.edge)
    Q, scales = rotation(turn), case.scales
    E, t, R = scales.E, scales.h, scales.R
    if load.potential is not None:
        return Potential(_potential(name, load.potential, Q, case))
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
        return EdgeForce(load.edge, np.asarray(Q @ np.array(load.per_length, dtype=float) / (E * t)), total=False)
    if load.pressure is not None:
        assert isinstance(load.pressure, float | int)
        return AreaForce(_over(load), load.pressure * R / (E * t))
    assert load.per_area is not None
    return AreaForce(_over(load), np.asarray(Q @ np.array(load.per_area, dtype=float) * R / (E * t)))


def _over(load: DeadLoadSection) -> str | None:
    return None if load.over == "all" else load.over


def _pattern(load: DeadLoadSection, Q: Array, length: float, factor: float) -> Pattern:
    """The load of a formula in the model's frame; a pressure is against the normal."""
    if load.vector is not None:
        return ByFormula([function(v) for v in load.vector], Q, length, factor, vectors=True)
    assert load.pressure is not None
    return Inwards(ByFormula([function(load.pressure)], Q, length, factor))


def potentials(case: Case) -> list[OwnTerm]:
    """The energies of loads that depend on the deformed place."""
    texts = [load.potential for step in case.loads_of(DeadSection) for load in step.loads if load.potential]
    return [_potential(f"potential_{i}", text, np.eye(3), case) for i, text in enumerate(texts)]


def _potential(name: str, text: str, Q: Array, case: Case) -> OwnTerm:
    """Zero where nothing has moved."""
    scales = case.scales

    def at(r: Expr, scale: Expr, size: Expr) -> Expr:
        x = [scale * sum(float(Q[j, i]) * r[j] for j in range(3) if Q[j, i]) for i in range(3)]
        return size * symbolic(text, SYMBOLIC, *x)

    def density(r0: Jet, u: Jet, scale: Expr, size: Expr) -> Expr:
        return at(r0.r + u.r, scale, size) - at(r0.r, scale, size)

    return OwnTerm(name, density, (scales.R, 1 / (scales.E * scales.h)))
