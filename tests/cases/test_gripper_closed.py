"""The case "gripper_closed.yaml" against an elastica on a circle, by SciPy.

Each arm is inextensible, with the angle t(s) of its tangent to the plane of the hub, from which its
remanence makes -60 degrees: the energy is D t'^2/2 - lambda_m E h cos(t - 150 degrees). Its points
stay R + h/2 from the ball's centre.
"""

import numpy as np
import pytest
from conftest import CASES
from numpy.typing import NDArray
from scipy.optimize import minimize

from magshell_fenicsx import Case
from magshell_fenicsx.public import run

Array = NDArray[np.float64]
H, BALL, HUB, LENGTH, WIDTH = 0.1, 1.02, 0.5, 3.0, 0.5  # mm
E_H = 1.2 * H * WIDTH  # N: E h times the width
N, INWARDS = 120, np.radians(150)
DS, SUMS = LENGTH / N, np.tril(np.ones((N, N)))


def elastica(strength: float) -> tuple[float, Array]:
    """The force along e3 of four arms on the ball (N), and (rho, z) of a tip (mm)."""
    D, r = H**2 / 12, BALL + H / 2

    def energy(t: Array) -> tuple[float, Array]:
        bends = D * np.diff(t, prepend=-t[0]) / DS  # it is clamped half a part before
        value = (bends[1:] @ bends[1:] + bends[0] ** 2 / 2) * DS / (2 * D) - strength * np.cos(
            t - INWARDS
        ).sum() * DS
        slope = strength * np.sin(t - INWARDS) * DS
        slope[1:] += bends[1:]
        slope[:-1] -= bends[1:]
        slope[0] += bends[0]
        return float(value / strength), slope / strength

    def places(t: Array) -> tuple[Array, Array]:
        return HUB + np.cumsum(np.cos(t)) * DS, np.cumsum(np.sin(t)) * DS

    def gaps(t: Array) -> Array:
        x, z = places(t)
        return np.asarray(np.hypot(x, z - r) - r)

    def slopes(t: Array) -> Array:
        x, z = places(t)
        far, dx, dz = np.hypot(x, z - r), -SUMS * np.sin(t) * DS, SUMS * np.cos(t) * DS
        return np.asarray((x / far)[:, None] * dx + ((z - r) / far)[:, None] * dz)

    held = {"type": "ineq", "fun": gaps, "jac": slopes}
    options = {"maxiter": 500, "ftol": 1e-13}
    found = minimize(
        energy, np.linspace(0, 1, N), jac=True, method="SLSQP", constraints=[held], options=options
    )
    assert found.success
    (x, z), active = places(found.x), gaps(found.x) < 1e-6
    sizes = (
        np.linalg.lstsq(slopes(found.x)[active].T, energy(found.x)[1], rcond=None)[0]
        * strength
        * E_H
    )
    upwards = ((z - r) / np.hypot(x, z - r))[active]
    return 4 * float(sizes @ upwards), np.array([x[-1], z[-1]])


@pytest.mark.slow
def test_gripper_closed() -> None:
    """Tips and force on the ball until the arms meet, 2e-2; their corners are then h apart.

    The ball presses on the middle of an arm, which bends across too: that is left out of an
    elastica. The corners are seen by the points on their edges, the nearest of which are 0.1 h
    away.
    """
    found = run(Case.load(CASES / "gripper_closed.yaml"))
    assert found.stopped is None
    columns = ("lambda_m", "force_N", "hub_fz_N", "contact_force_N", "tip_ux_mm", "tip_uz_mm")
    rows = [{name: float(row[name]) for name in columns} for row in found.rows]
    before = [row for row in rows if row["force_N"] < 0 and row["contact_force_N"] == 0]
    for row in (before[len(before) // 2], before[-1]):
        force, tip = elastica(row["lambda_m"])
        assert -row["force_N"] == pytest.approx(force, rel=2e-2)
        assert np.array([HUB + LENGTH + row["tip_ux_mm"], row["tip_uz_mm"]]) == pytest.approx(
            tip, abs=2e-3
        )
    last = rows[-1]
    assert last["contact_force_N"] > 0
    assert last["hub_fz_N"] == pytest.approx(
        last["force_N"], rel=1e-6
    )  # the arms need no hub to hold each other
    assert HUB + LENGTH + last["tip_ux_mm"] == pytest.approx(
        WIDTH / 2 + H / np.sqrt(2), abs=0.1 * H
    )
