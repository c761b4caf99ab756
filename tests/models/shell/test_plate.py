"""Clamped circular plate under pressure, w = p (R^2 - r^2)^2/(64 D): Timoshenko, Plates and Shells,
art. 16.
"""

import numpy as np
import pytest
import ufl
from conftest import disc
from dolfinx import fem
from ufl.core.expr import Expr

from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.shells.shell import ShellModel

MATERIAL = Material(0.3, 0.02)


def solve(size: float, degree: int, w0_over_h: float = 1e-4) -> tuple[float, float]:
    """Relative errors of the deflection at the centre and of the curvatures in the energy norm."""
    model = ShellModel(disc(size), MATERIAL, degree, {"rim": "clamped"}, Loads(pressure=True))
    h, D = MATERIAL.h, MATERIAL.bending_stiffness * MATERIAL.h  # D over E R^3
    p = 64 * D * w0_over_h * h  # over E
    amplitude = p / MATERIAL.classical_pressure
    found = BorderedNewton(model.system).solve(
        State(model.zero(), {"pressure": 0.0}), "pressure", PrescribedLoad("pressure", amplitude)
    )
    assert found.converged
    u = found.state.u
    w0 = model.deflection(u, "pole")
    model.u.x.array[:] = u
    jets = kin.jet(model.r0, model.V.mesh), kin.jet(model.u, model.V.mesh)
    r, c = jets[0].r, -p / (64 * D)
    H = c * (
        8 * ufl.outer(r, r) - 4 * (1 - ufl.dot(r, r)) * ufl.Identity(3)
    )  # Hessian of c (1 - r^2)^2
    basis = (jets[0].r1, jets[0].r2)
    exact = ufl.as_matrix([[ufl.dot(a, ufl.dot(H, b)) for b in basis] for a in basis])
    up = kin.inverse_metric(jets[0])
    dx = ufl.dx(metadata={"quadrature_degree": 2 * degree + 2})

    def square(K: Expr) -> float:
        return float(
            fem.assemble_scalar(
                fem.form(MATERIAL.law.bending(K, K, up) * kin.area_ratio(jets[0]) * dx)
            )
        )

    error = np.sqrt(square(kin.curvature_change(*jets) - exact) / square(exact))
    return abs(w0 / (w0_over_h * h) - 1), float(error)


def orders(sizes: list[float], degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors (sizes, 2) and their orders in h."""
    errors = np.array([solve(size, degree) for size in sizes])
    return errors, np.log(errors[:-1] / errors[1:]) / np.log(np.divide(sizes[:-1], sizes[1:]))[
        :, None
    ]


def test_deflection() -> None:
    assert solve(0.4, 4)[0] < 1e-4


def test_simply_supported_edge() -> None:
    """w0 = (5 + nu)/(64 (1 + nu)) p R^4/D: Timoshenko, art. 17.

    No bending term acts at the edge.
    """
    model = ShellModel(disc(0.2), MATERIAL, 3, {"rim": "simply supported"}, Loads(pressure=True))
    h, nu, D = MATERIAL.h, MATERIAL.nu, MATERIAL.bending_stiffness * MATERIAL.h
    p = 1e-4 * h * 64 * D * (1 + nu) / (5 + nu)
    start = State(model.zero(), {"pressure": 0.0})
    found = BorderedNewton(model.system).solve(
        start, "pressure", PrescribedLoad("pressure", p / MATERIAL.classical_pressure)
    )
    assert model.deflection(found.state.u, "pole") == pytest.approx(1e-4 * h, rel=1e-4)


@pytest.mark.parametrize("degree", [2, 3, pytest.param(4, marks=pytest.mark.slow)])
def test_order_of_convergence(degree: int) -> None:
    """O(h^(k-1)) in the energy norm (Brenner and Sung, J. Sci. Comput. 22, 2005).

    The deflection at the centre converges at least as h^2, h^(2k-2), h^4: the last is the order of
    the cubic rim.
    """
    errors, order = orders([0.4, 0.2, 0.1], degree)
    overall = np.log(errors[0] / errors[-1]) / np.log(4)
    assert overall[1] == pytest.approx(degree - 1, abs=0.1 if degree == 2 else 0.5)
    assert order[-1, 1] > degree - 1 - 0.15
    assert overall[0] > {2: 1.9, 3: 3.5, 4: 3.9}[degree]
