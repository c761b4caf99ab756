"""Cases in which shells touch themselves."""

import numpy as np
import pytest
from conftest import CASES
from numpy.typing import NDArray
from scipy.integrate import solve_bvp

from magshell_fenicsx import Case, Result
from magshell_fenicsx.public import run

Array = NDArray[np.float64]


def touching_pressure(gap: float) -> float:
    """p R^3/D at which opposite places of an inextensible ring under live pressure are a gap (over
    R) apart.

    A quarter of the ring from the x to the y axis: position, angle of the tangent, curvature, force
    on the section.
    """

    def slopes(s: Array, z: Array) -> Array:
        _, _, angle, curvature, fx, fy, p = z
        t, n = (np.cos(angle), np.sin(angle)), (np.sin(angle), -np.cos(angle))
        return np.stack([*t, curvature, t[1] * fx - t[0] * fy, p * n[0], p * n[1], 0 * p])

    s = np.linspace(0, np.pi / 2, 401)
    bent = 0.05 * np.array([np.sin(2 * s), 2 * np.cos(2 * s)])
    z = np.stack(
        [
            np.cos(s),
            np.sin(s),
            np.pi / 2 + s + bent[0],
            1 + bent[1],
            -3 * np.sin(s),
            -3 * np.cos(s),
            3 + 0 * s,
        ]
    )
    for half in np.linspace(0.93, gap / 2, 40):

        def ends(a: Array, b: Array, half: float = half) -> Array:
            return np.array([a[1], a[2] - np.pi / 2, a[4], b[0], b[2] - np.pi, b[5], b[1] - half])

        found = solve_bvp(slopes, ends, s, z, tol=1e-8, max_nodes=20000)
        assert found.success
        s, z = found.x, found.y
    return float(z[6, 0])


def test_the_ring_of_the_comparison() -> None:
    """5.247 D/R^3 without thickness (Flaherty, Keller and Rubinow, SIAM Journal on Applied
    Mathematics 23, 1972).
    """
    assert touching_pressure(0.0) == pytest.approx(5.247, abs=1e-3)


@pytest.mark.slow
def test_collapsing_tube() -> None:
    """It touches itself where the elastica's walls are a thickness apart, 2e-3, and goes on to
    twice that pressure.
    """
    case = Case.load(CASES / "collapsing_tube.yaml")
    result = run(case)
    assert result.stopped is None
    h, unit = 0.02, 12 * 2 / np.sqrt(3) / 0.02  # p_c over D/R^3
    p, gap, force = (
        np.array([row[name] for row in result.rows], dtype=float)
        for name in ("p_over_pc", "contact_gap_over_h", "contact_force")
    )
    first = int(np.argmax(force > 0))
    near = slice(first - 4, first)  # the gap is smooth up to there
    meets = np.polynomial.Polynomial.fit(gap[near], p[near], 1)(0.0) * unit
    assert meets == pytest.approx(touching_pressure(h), rel=2e-3)
    assert (np.diff(force[first:]) > 0).all()
    assert p[-1] * unit > 2 * meets
    assert gap[first:].min() > -1e-3
    assert max(row["contact_penalty"] for row in result.rows) == pytest.approx(
        1e6 / 12
    )  # no need to be stiffer
    refuse_instabilities(result)


@pytest.mark.slow
def test_no_instability_of_the_points_of_contact() -> None:
    """On another mesh too: the softest mode of the ring in contact slides, with a stiffness of
    +0.005 D/R^3.

    The zone of contact is narrower than the distance of the points on cells, which would push the
    ring along with them.
    """
    refuse_instabilities(run(Case.load(CASES / "collapsing_tube.yaml", ["mesh.size=0.2"])))


def refuse_instabilities(result: Result) -> None:
    """See that a path has none."""
    assert result.stopped is None
    assert all(row["label"] not in ("fold", "bifurcation") for row in result.rows)
    assert all(row["negative_pivots"] == 0 for row in result.rows)
