"""Every case of cases/extreme/ as it stands, and one physical number of each; `make extremes` runs
the variants.

"axisymmetric" is an independent solver of the meridian's equations, nine digits.
"""

from pathlib import Path

import numpy as np
import pytest
from conftest import CASES
from extreme.extremes import (
    ASPECTS,
    TIP,
    VARIANTS,
    Variant,
    condition_estimate,
    line,
    outcome,
    slivers,
)
from extreme.extremes_table import cells, write
from mpi4py import MPI
from petsc4py import PETSc
from solved import result

from magshell_fenicsx import Result
from magshell_fenicsx.continuation.factor import Factorisation


def first(found: Result) -> float:
    return float(found.limit_points[0]["value"])


@pytest.mark.parametrize(
    ("file", "k_d"),
    [
        ("extreme/thickness.yaml", 0.325723564),
        ("extreme/poisson.yaml", 0.326233289),
        ("extreme/penalty.yaml", 0.326233289),
        ("extreme/field.yaml", 0.552053778),
        ("extreme/critical_field.yaml", -0.000946554),
    ],
)
def test_first_instability(file: str, k_d: float) -> None:
    """Axisymmetric; for the critical field it is lambda_m."""
    assert first(result(file)) == pytest.approx(k_d, rel=2e-6)


@pytest.mark.parametrize("penalty", [10, 1e7])
def test_penalty_moves_nothing_over_six_decades(penalty: float) -> None:
    """Axisymmetric: k_d = 0.326233289."""
    assert first(result("extreme/penalty.yaml", f"mesh.penalty={penalty}")) == pytest.approx(
        0.326233289, rel=1e-6
    )


@pytest.mark.slow
def test_almost_perfect_dimple_buckles_like_the_perfect_shell() -> None:
    """delta/h = 0.01 moves the waves at the clamped edge of the perfect shell by less than 1e-4."""
    perfect = result("extreme/nothing.yaml", "loading={kind: pressure}")
    assert perfect.limit_points[0]["mode"] == "m = 14"
    assert first(result("extreme/dimple.yaml")) == pytest.approx(first(perfect), rel=1e-4)


@pytest.mark.slow
def test_beyond_the_fold() -> None:
    """The fold does not depend on R/h in a thin shell (0.325723564 at 1000, axisymmetric); the path
    goes on.
    """
    found = result("extreme/beyond.yaml", "loading.points=14")
    assert found.stopped is None
    assert first(found) == pytest.approx(0.325723564, rel=2e-3)
    assert max(float(row["w_pole_over_h"]) for row in found.rows) > 25


@pytest.mark.slow
def test_hemisphere_turned_inside_out() -> None:
    """Pogorelov's mirror buckling, F ~ sqrt(w), in the middle; at w = 2R the pole is as far below
    as it was above.
    """
    found = result("extreme/inside_out.yaml")
    assert found.stopped is None
    force = {
        round(float(row["w_over_h"])): float(row["force"])
        for row in found.rows
        if row["label"] == "target"
    }
    assert force[80] / force[40] == pytest.approx(2**0.5, rel=0.03)
    assert float(found.rows[-1]["w_over_h"]) == pytest.approx(180)


def test_nothing_happens_without_a_load() -> None:
    """No defect, no field, no load: the undeformed shell, and no error."""
    found = result("extreme/nothing.yaml")
    assert found.stopped is None
    assert [row["w_pole_over_h"] for row in found.rows] == [0.0]
    assert outcome(found) == "reached"


def test_too_small_a_penalty_is_told() -> None:
    """Below about 4 the form is not positive: the table has no number then."""
    row = line(Variant("penalty", ("mesh.penalty=1",), reference=0.326233289))
    assert row.value is None
    assert "undeformed shell" in row.outcome


def test_slivers() -> None:
    """Elastica, "extreme/slivers.yaml": the tip at aspect 50 is within 2e-3 of the rod's."""
    assert max(ASPECTS)[0] == 50
    long = slivers(50.0, "along")
    assert long.value == pytest.approx(TIP, rel=2e-3)
    assert long.condition_undeformed > 1e12


@pytest.mark.slow
def test_table(tmp_path: Path) -> None:
    """A row of numbers in both files; all variants name a case that is there."""
    row = line(Variant("nothing", ("magnetic={lambda_m: 0.00184}",), "w_pole_over_h"))
    assert row.source == "finer mesh"
    assert row.error is not None
    assert row.error < 1e-6
    write([row], tmp_path)
    assert " | ".join(cells(row)) in (tmp_path / "README.md").read_text(encoding="utf-8")
    assert (
        (tmp_path / "extremes.csv")
        .read_text(encoding="utf-8")
        .splitlines()[1]
        .startswith("nothing,")
    )
    assert {v.case for v in VARIANTS} | {"slivers"} == {
        file.stem for file in (CASES / "extreme").glob("*.yaml")
    }


def test_condition_of_a_known_spectrum() -> None:
    """Eigenvalues 1e-3 to 1e4, of both signs, in a random basis: condition 1e7."""
    rng = np.random.default_rng(0)
    values = np.array([1e-3, -0.5, 1.0, 2.0, -30.0, 1e4])
    Q = np.linalg.qr(rng.standard_normal((6, 6)))[0]
    K = (
        PETSc.Mat()
        .createDense((6, 6), array=Q @ np.diag(values) @ Q.T, comm=MPI.COMM_SELF)
        .convert("aij")
    )
    K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    factors = Factorisation(MPI.COMM_SELF)
    factors.factor(K)
    assert condition_estimate(factors, 6, MPI.COMM_SELF) == pytest.approx(1e7, rel=1e-6)
