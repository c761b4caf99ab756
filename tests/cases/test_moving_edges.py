"""Cases whose supports move: the shortened strip against a beam, the magnetic arch against its
measured ramp.
"""

import numpy as np
import pytest
from benchmarks import arch
from conftest import CASES
from scipy.integrate import solve_bvp
from solved import result_of_whole_path

from magshell_fenicsx import Case

EULER, EPS = 4 * np.pi**2, 1e-4 / 12  # over EI/L^2; EI/(EA L^2)


def elastica(shortening: float) -> tuple[float, float, float]:
    """Reaction, deflection of the middle and moment at the ends of an extensible elastica, by
    SciPy.

    x' = s cos(a), w' = s sin(a), a' = m, m' = -s F sin(a) with the stretch s = 1 - F EPS cos(a), on
    half the length.
    """

    def rates(t: np.ndarray, y: np.ndarray, p: np.ndarray) -> np.ndarray:
        stretch = 1 - EPS * p[0] * np.cos(y[2])
        return np.vstack(
            [stretch * np.cos(y[2]), stretch * np.sin(y[2]), y[3], -stretch * p[0] * np.sin(y[2])]
        )

    def ends(a: np.ndarray, b: np.ndarray, p: np.ndarray) -> np.ndarray:
        return np.array([a[0], a[1], a[2], b[2], b[0] - 0.5 * (1 - shortening)])

    t, height = np.linspace(0, 0.5, 101), np.sqrt(shortening - EULER * EPS) / np.pi
    wave = 2 * np.pi * t
    guess = [
        t,
        height * (1 - np.cos(wave)),
        height * 2 * np.pi * np.sin(wave),
        height * EULER * np.cos(wave),
    ]
    found = solve_bvp(rates, ends, t, np.array(guess), p=[EULER], tol=1e-10, max_nodes=20000)
    assert found.success
    return float(found.p[0]), float(found.y[1, -1]), float(found.y[3, 0])


@pytest.mark.slow
def test_shortened_strip() -> None:
    """Euler's load at the located bifurcation; the beam at 0.5 and 1 % on both branches; reactions
    in equilibrium.
    """
    rows = result_of_whole_path("shortened_strip.yaml").rows
    onset = next(row for row in rows if row["label"] == "bifurcation")
    assert onset["mode"] == "symmetric"
    assert float(onset["reaction"]) == pytest.approx(EULER, rel=1e-3)
    assert float(onset["shortening"]) == pytest.approx(EULER * EPS, rel=1e-3)
    assert float(onset["load_error"]) < 1e-4 * float(onset["shortening"])
    for branch in (1, 2):
        for shortening in (0.005, 0.01):
            force, deflection, moment = elastica(shortening)
            (row,) = [
                row
                for row in rows
                if row["branch"] == branch and abs(float(row["shortening"]) - shortening) < 1e-12
            ]
            assert float(row["reaction"]) == pytest.approx(force, rel=1e-3)
            assert float(row["left_fx"]) == pytest.approx(force, rel=1e-3)
            assert abs(float(row["middle_uz"])) == pytest.approx(deflection, rel=1e-3)
            assert abs(float(row["right_my"])) == pytest.approx(moment, rel=1e-3)
            assert float(row["left_fx"]) + float(row["right_fx"]) == pytest.approx(
                0, abs=1e-9 * force
            )
            assert row["negative_pivots"] == row["excluded_pivots"] == 0


@pytest.mark.slow
def test_arch() -> None:
    """The first instability is the symmetric path's fold; measured points before it lie within 0.25
    mm of the curve.

    Stable until the fold, and antisymmetric modes become unstable right behind it. Half the element
    size moves it by 4e-4. The distance to the measured snap is that of a quasi-static path to a
    ramp of 6.5 mT/s.
    """
    found = result_of_whole_path("arch.yaml")
    case, rows = Case.load(CASES / "arch.yaml"), found.rows
    curve, points, fold = arch.ramp(rows, case), arch.measured(), arch.first_fold(rows)
    assert rows[fold]["mode"] == ""
    assert all(row["negative_pivots"] == row["excluded_pivots"] == 0 for row in rows[:fold])
    assert rows[fold + 1]["mode"] == "antisymmetric"
    field, height = curve[fold - len(rows)]
    assert field == pytest.approx(5.534, rel=1e-3)  # elements of 5 mm; degree 5 with 10 mm: 5.5351
    assert height == pytest.approx(1.59, abs=0.01)
    before = points[points[:, 0] < field]
    assert len(before) == 20
    way = curve[: fold - len(rows) + 1]
    assert np.abs(before[:, 1] - np.interp(before[:, 0], *way.T)).max() < 0.25
    after = points[points[:, 0] > 9]
    assert np.abs(after[:, 1] - np.interp(after[:, 0], *curve[-40:].T)).max() < 0.25
    snap = points[(points[:, 1] > 3) & (points[:, 1] < 5)][:, 0]
    assert 0.5 < snap.min() - field < snap.max() - field < 0.9
