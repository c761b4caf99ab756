"""Time and memory of an iteration against unknowns."""

import pytest
from speed.scale import PIECES, Row, ScaleFailed, exponent, iteration, row, table


def made(dofs: float, seconds: float) -> Row:
    times = {f"{piece}_{kind}_s": seconds / 4 for piece in PIECES for kind in ("cpu", "wall")}
    return {"dofs": dofs, "ranks": 1, "peak_mb": 2048.0, **times}


def test_exponent_of_a_power() -> None:
    rows = [made(n, 3e-6 * n**1.4) for n in (1e4, 5e4, 1e6)]
    assert exponent(rows, "cpu") == pytest.approx(1.4, rel=1e-12)


def test_table() -> None:
    lines = table([made(1e4, 8.0)])
    assert lines[2] == "| 10000 | 1 | 2 | 2 | 2 | 2 | 8 | 8 | 2.00 |"
    assert {line.count("|") for line in lines} == {10}


@pytest.mark.slow
def test_two_ranks_measure_the_same_system() -> None:
    """The same tangent, positive definite, solved to rounding times its condition."""
    rows = [row(0.3, 2, ranks, 1) for ranks in (1, 2)]
    assert rows[0]["dofs"] == rows[1]["dofs"]
    for found in rows:
        assert found["negative_pivots"] == 0
        assert found["solve_error"] < 1e-8
        assert iteration(found, "wall") > 0
        assert found["peak_mb"] > 50


def test_failure_is_told() -> None:
    with pytest.raises(ScaleFailed, match="refinement 0 on 1 ranks: exit code"):
        row(0.0, 2, 1, 1)
