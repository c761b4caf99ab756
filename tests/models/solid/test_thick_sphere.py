"""A thick sphere under pressure against the radial equilibrium of the same law."""

import numpy as np
import pytest
from bodies import hemisphere
from dolfinx import fem
from rubbers import mooney
from scipy.integrate import solve_bvp

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import StepOptions
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.solid.body_densities import CompressibleRubber
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.shells.solid import SolidModel
from magshell_fenicsx.shells.solid_terms import TermFactory

THICKNESS = 0.4


def radial(material: CompressibleRubber, pressure: float) -> tuple[float, float]:
    """Displacement of the inner and the outer face of the sphere; outside acts a pressure over E.

    dP_R/dR + 2 (P_R - P_T)/R = 0 with the principal stretches r' and r/R; the unknowns
    are r and P_R, and r' is found from P_R.
    """
    inner, outer = 1 - THICKNESS / 2, 1 + THICKNESS / 2
    mu, kappa, (share,) = material.shear, material.bulk, material.energy.constants

    def stresses(a: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """P_R and P_T: W by each principal stretch, radial a, tangential t."""
        J, I1, I2 = a * t**2, a**2 + 2 * t**2, t**2 * (2 * a**2 + t**2)
        one, two = (1 - share) * mu * J ** (-2 / 3), share * mu * J ** (-4 / 3)
        shared = kappa * (J - 1) * J - one * I1 / 3 - two * 2 / 3 * I2
        return one * a + two * 2 * a * t**2 + shared / a, one * t + two * t * (
            a**2 + t**2
        ) + shared / t

    def stretch(P: np.ndarray, t: np.ndarray) -> np.ndarray:
        a = t**-2.0
        for _ in range(50):
            e = 1e-7
            value = stresses(a, t)[0]
            slope = (stresses(a + e, t)[0] - stresses(a - e, t)[0]) / (2 * e)
            a = a - (value - P) / slope
        return np.asarray(a)

    def equations(R: np.ndarray, y: np.ndarray) -> np.ndarray:
        r, P = y
        a = stretch(P, r / R)
        return np.vstack([a, -2 / R * (P - stresses(a, r / R)[1])])

    def ends(y0: np.ndarray, y1: np.ndarray) -> np.ndarray:
        return np.array([y0[1], y1[1] + pressure * (y1[0] / outer) ** 2])  # a live pressure

    R = np.linspace(inner, outer, 41)
    found = solve_bvp(equations, ends, R, np.vstack([R, 0 * R]), tol=1e-8)
    assert found.success
    return float(found.y[0, 0] - inner), float(found.y[0, -1] - outer)


def test_inflation() -> None:
    """Drawn outwards until the inner radius has grown by an eighth: each face to 1e-3 of its
    displacement.
    """
    material, pressure = CompressibleRubber.from_poisson_ratio(mooney(0.6), 0.5, 100.0), -0.1
    body = hemisphere(0.35, THICKNESS, layers=2, half=True)
    model = SolidModel(body, Material(0.5, THICKNESS), material, {}, Loads())
    factory = TermFactory(body, model.u, material, THICKNESS, model.kernels)
    V, across = model.V, 1
    planes = [(V.sub(across), body.faces["symmetry"]), (V.sub(2), body.faces["rim"])]
    held = [
        fem.dirichletbc(0.0, fem.locate_dofs_topological(W, 2, facets), W) for W, facets in planes
    ]
    W, _ = V.sub(0).collapse()
    axis, _ = fem.locate_dofs_geometrical((V.sub(0), W), lambda x: np.hypot(x[0], x[1]) < 1e-9)
    held.append(fem.dirichletbc(0.0, axis, V.sub(0)))  # else the sphere drifts along e1
    system = FiniteElementSystem(
        model.u, [*model._terms, *factory.pressure(1.0)], held, model._pattern, THICKNESS
    )
    path = Path(BorderedNewton(system), "pressure", "load", StepOptions(0.05, 0.1, 1e-3))
    *_, (last, _) = path.continue_to(path.start(State(model.zero(), {"pressure": 0.0})), [pressure])
    X, u = (f.reshape(-1, 3) for f in (model.r0.x.array, last.state.u))
    radius = np.linalg.norm(X, axis=1)
    outwards = np.sum(u * X, axis=1) / radius
    for face, exact in zip(
        (1 - THICKNESS / 2, 1 + THICKNESS / 2), radial(material, pressure), strict=True
    ):
        on_face = np.abs(radius - face) < 5e-3 * THICKNESS
        assert on_face.sum() > 50
        assert outwards[on_face] == pytest.approx(exact, rel=1e-3)
