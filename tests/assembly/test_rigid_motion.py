"""Rigid motions against finite differences and against what makes them rigid."""

import numpy as np
import pytest

from magshell_fenicsx.assembly.rigid_motion import RigidMotion, apply_motions, total_rotation

RNG = np.random.default_rng(0)
X = RNG.standard_normal((5, 3))
SHIFT = RigidMotion("a", np.array([0.3, -0.2, 0.1]), np.zeros(3), np.zeros(3))
TURN = RigidMotion(
    "b", np.array([0.0, 0.4, 0.2]), np.array([0.5, -0.7, 1.1]), np.array([1.0, 0.0, -0.5])
)
OTHER = RigidMotion("c", np.zeros(3), np.array([-0.4, 0.9, 0.2]), np.array([0.2, 0.3, 0.0]))
MOTIONS = (SHIFT, TURN, OTHER)
STEP = 1e-5


@pytest.mark.parametrize("mu", [{"a": 0.0, "b": 0.0, "c": 0.0}, {"a": 0.7, "b": -1.3, "c": 2.0}])
def test_derivatives(mu: dict[str, float]) -> None:
    """Central differences of the places and their first derivatives, in all pairs of amplitudes."""
    here = apply_motions(MOTIONS, mu, X)
    for name in mu:
        low, high = (
            apply_motions(MOTIONS, {**mu, name: mu[name] + side * STEP}, X) for side in (-1, 1)
        )
        np.testing.assert_allclose(here.slopes[name], (high.x - low.x) / (2 * STEP), atol=1e-9)
        for other in mu:
            slope = (high.slopes[other] - low.slopes[other]) / (2 * STEP)
            np.testing.assert_allclose(here.curvatures[name, other], slope, atol=1e-9)


def test_rigid() -> None:
    """Distances stay, the arm of each place turns by the rotation of all motions, and a quarter
    turn is one.
    """
    mu = {"a": 0.7, "b": -1.3, "c": 2.0}
    here, Q = apply_motions(MOTIONS, mu, X).x, total_rotation(MOTIONS, mu).x.T
    np.testing.assert_allclose(here - here[0], (X - X[0]) @ Q.T, atol=1e-14)
    np.testing.assert_allclose(Q @ Q.T, np.eye(3), atol=1e-15)
    quarter = RigidMotion(
        "d", np.zeros(3), np.array([0.0, 0.0, np.pi / 2]), np.array([1.0, 0.0, 0.0])
    )
    np.testing.assert_allclose(
        apply_motions([quarter], {"d": 1.0}, np.array([[2.0, 0.0, 5.0]])).x, [[1.0, 1.0, 5.0]]
    )
