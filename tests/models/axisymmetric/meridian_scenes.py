"""Meridian models that several tests share, and their paths up to the axisymmetric instability."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from conftest import spherical

from magshell_fenicsx.continuation.continuation_run import Instability, instabilities
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import Point, StepOptions
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.axisymmetric.meridian import graded_vertices, make_meridian
from magshell_fenicsx.models.shell.parameters import Condition, Force, Material
from magshell_fenicsx.parts.imperfections.dimple import Dimple
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.shells.meridian import MeridianModel

E3 = np.array([0.0, 0.0, 1.0])
ALONG_AXIS = Magnetisation(E3, E3)
DIMPLE = (1.64, 3.2)  # delta/h and the width of the paper


def hemisphere(
    R_over_h: float,
    nu: float,
    loads: Loads,
    *,
    dimple: tuple[float, float] | None = None,
    condition: Condition = "clamped",
    degree: int = 4,
    refinement: float = 1.0,
    sigma: float | None = None,
) -> MeridianModel:
    """A hemisphere with a dimple of depth (over h) and dimensionless width."""
    h = 1 / R_over_h
    phi_o = dimple[1] * np.sqrt(h) / (12 * (1 - nu**2)) ** 0.25 if dimple else None
    placed = spherical(Dimple(dimple[0] * h, phi_o) if dimple and phi_o else None)
    vertices = graded_vertices(np.pi / 2, [phi_o] if phi_o else [], h, refinement=refinement)
    return MeridianModel(
        make_meridian(placed, vertices), Material(nu, h), degree, {"rim": condition}, loads, sigma
    )


def unloaded(model: MeridianModel) -> State:
    return State(model.zero(), {t.amplitude: 0.0 for t in model.system.terms if t.amplitude})


@dataclass(frozen=True)
class Buckling:
    """The path under pressure, whose last point is the axisymmetric instability."""

    path: Path
    points: list[Point]
    instability: Instability


def buckle(model: MeridianModel, lambda_m: float) -> Buckling:
    """The field first, then the pressure, as a case does it."""
    newton, state = BorderedNewton(model.system), unloaded(model)
    if lambda_m:
        field = Path(
            newton,
            "lambda_m",
            "load",
            StepOptions(abs(lambda_m) / 2, abs(lambda_m), abs(lambda_m) * 1e-4),
        )
        for point, _ in field.continue_to(field.start(state), [lambda_m]):
            assert point.negative_pivots == 0
            state = point.state
    path = Path(newton, "pressure", "conjugate", StepOptions(1.0, 1.0, 1.0))
    points = [path.start(state)]
    first = abs(0.1 / points[0].dmu)
    path.options = StepOptions(first, 2 * first, 1e-5 * first)
    for point, _ in path.continue_to(points[0], [np.inf]):
        if point.negative_pivots:
            found = next(instabilities(path, points[-1], point))
            return Buckling(path, [*points, found.point], found)
        points.append(point)
    raise AssertionError("towards infinity there is always a next point")


def dimpled(R_over_h: float, lambda_m: float) -> MeridianModel:
    """The paper's dimple under pressure, nu = 0.5."""
    loads = Loads(pressure=True, magnetic=ALONG_AXIS if lambda_m else None)
    return hemisphere(R_over_h, 0.5, loads, dimple=DIMPLE)


@cache
def buckled(R_over_h: float, lambda_m: float) -> tuple[MeridianModel, Buckling]:
    """Return the model of the dimple and its buckling, once in a process."""
    model = dimpled(R_over_h, lambda_m)
    return model, buckle(model, lambda_m)


def indent(model: MeridianModel, depths: list[float]) -> list[float]:
    """F R/(2 pi D) at depths w/h of the pole."""
    unit = model.force_unit * model.material.h
    path = Path(
        BorderedNewton(model.system), "force", "conjugate", StepOptions(unit, 2 * unit, 1e-3 * unit)
    )
    points = path.continue_to(path.start(unloaded(model)), [unit * depth for depth in depths])
    return [point.state.mu["force"] for point, reached in points if reached]


POLE_FORCE = Loads(forces={"force": Force("pole")})
