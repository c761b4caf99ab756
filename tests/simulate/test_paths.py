"""Paths through folds and bifurcations of shells: each number with its source.

"axisymmetric": an independent solver of the meridian's equations, nine digits.
"""

from typing import Any

import numpy as np
import pytest
from scipy.special import ellipk
from solved import result

from magshell_fenicsx import Result


def events(found: Result) -> list[tuple[str, str, Any]]:
    return [
        (p["amplitude"], p["kind"], p["value"])
        for p in found.limit_points
        if not p["mode"].startswith("m =")
    ]


@pytest.mark.slow
def test_volume_snaps_back() -> None:
    """R/h = 1000, axisymmetric: k_d = 0.325723564, followed well past the snap-back in volume."""
    found = result("snap_back.yaml", "loading.points=17")
    assert found.stopped is None
    assert found.knockdown == pytest.approx(0.325723564, rel=1e-6)
    volume, w = (
        np.array([row[key] for row in found.rows], dtype=float)
        for key in ("volume_change", "w_pole_over_h")
    )
    smallest = int(np.argmin(volume[:12]))
    back = smallest + int(np.argmax(volume[smallest:]))
    assert volume[back] - volume[smallest] > 0.3 * abs(volume[smallest])
    assert volume[-2] < 2 * volume[smallest]
    assert w[-2] > 30


@pytest.mark.slow
def test_waves_before_the_fold() -> None:
    """Axisymmetric."""
    settings = "shell.radius_to_thickness=300", "magnetic.lambda_m=0.00184", "loading.control=arc"
    found = result("dimple_buckling.yaml", *settings)
    points = [found.limit_points[0], found.limit_points[-1]]
    assert [(p["kind"], p["mode"]) for p in points] == [("bifurcation", "m = 28"), ("fold", "")]
    assert points[0]["value"] == pytest.approx(1.0145, abs=1e-4)
    assert points[1]["value"] == pytest.approx(1.093385, abs=1e-6)
    assert found.knockdown == found.limit_points[0]["value"]


@pytest.mark.parametrize(
    ("settings", "critical"),
    [
        (
            (
                "shell.radius_to_thickness=300",
                "shell.poisson_ratio=0.3",
                "magnetic.lambda_m=-0.00184",
            ),
            -0.000946554,
        ),
        (("magnetic.lambda_m=-0.005",), -0.0033554),
        (("magnetic.lambda_m=-0.0034",), -0.0033554),
        (("magnetic.lambda_m=-0.02",), -0.0033554),
    ],
)
def test_field_that_destabilises_alone(settings: tuple[str, ...], critical: float) -> None:
    """Axisymmetric: the critical field is reported instead of a knockdown."""
    found = result("dimple_buckling.yaml", *settings)
    assert found.knockdown is None
    assert [(amplitude, kind) for amplitude, kind, _ in events(found)] == [("lambda_m", "fold")]
    assert found.limit_points[0]["value"] == pytest.approx(critical, rel=2e-5)
    assert found.stopped
    assert "the field alone makes the shell unstable" in found.stopped


@pytest.mark.parametrize("points", [1, 3])
def test_coarse_field_steps_do_not_jump_over_a_fold(points: int) -> None:
    """Axisymmetric: the critical field is -0.0033554; load control asks for -0.005 in one step."""
    loading = f"loading={{kind: field, control: load, until: target, points: {points}}}"
    found = result("dimple_buckling.yaml", "magnetic.lambda_m=-0.005", loading)
    assert found.stopped
    assert "load control cannot pass the fold at lambda_m = -0.00335" in found.stopped
    assert ", before its target, lambda_m = -0.005; " in found.stopped
    assert found.limit_points[-1]["value"] == pytest.approx(-0.0033554, rel=2e-5)


def test_target_beyond_the_fold_in_units() -> None:
    """p_c of R/h = 40, in pascals; a target without a control is reached by load control."""
    shell = (
        "shell={geometry: hemisphere, radius: 40 mm, thickness: 1 mm, youngs_modulus: 1.3 MPa, "
        "poisson_ratio: 0.5, "
    )
    shell += "defect: {kind: dimple, amplitude: 1, width: 3}}"
    found = result(
        "dimple_buckling.yaml",
        shell,
        "loading={kind: pressure, until: target, pressure: 900 Pa, points: 2}",
    )
    pascals = (found.knockdown or 0) * 1.3e6 * 4 / 3 / 40**2
    assert found.stopped
    assert (
        f"cannot pass the fold at pressure = {found.knockdown:.6g} ({pascals:.6g} Pa), before"
        in found.stopped
    )
    assert "(900 Pa); load control stopped" in found.stopped


@pytest.mark.slow
def test_indentation_through_its_fold_in_displacement() -> None:
    """Mixed reference (hybridised Hellan-Herrmann-Johnson): peak 2.10, 1.3149 at w/h = 5, w turns
    back at 5.9.
    """
    found = result("indentation_snap_back.yaml")
    assert found.stopped is None
    forces = [value for amplitude, kind, value in events(found) if kind == "fold"]
    assert forces[0] == pytest.approx(2.10, abs=0.01)
    rows = [row for row in found.rows if row["amplitude"] == "force"]
    w = np.array([row["w_over_h"] for row in rows], dtype=float)
    top = int(np.argmax(w[:25]))
    assert w[top] == pytest.approx(5.95, abs=0.05)
    assert w[top:].min() < 0.2 < 5 < w[-1]
    held = [int(row["negative_pivots_held"]) for row in rows]
    assert held[: top - 1] == [0] * (
        top - 1
    )  # a testing machine sees nothing before the fold in displacement
    assert held[top + 2] == 1


@pytest.mark.slow
def test_strip_bends_to_both_sides() -> None:
    """Elastica: q = pi^2/4, and at a tip angle of 90 degrees q = K(1/2)^2 and tip deflection 2 sin
    45/sqrt(q).
    """
    found = result("strip_buckling.yaml")
    assert found.stopped is None
    ((amplitude, kind, value),) = events(found)
    assert (amplitude, kind, found.limit_points[0]["mode"]) == (
        "lambda_m",
        "bifurcation",
        "symmetric",
    )
    assert 12 * value * 100**2 == pytest.approx(np.pi**2 / 4, rel=1e-4)
    K = ellipk(0.5)
    tips = []
    for branch in (0, 1, 2):
        last = [row for row in found.rows if row["branch"] == branch][-1]
        assert last["label"] == "target"
        assert 120000 * float(last["lambda_m"]) == pytest.approx(K**2, rel=1e-6)
        tips.append(float(last["w_pole_over_h"]) / 100)
    assert tips[0] == pytest.approx(0, abs=1e-6)
    straight = [row for row in found.rows if row["branch"] == 0 and row["label"] != "bifurcation"]
    assert [row["negative_pivots"] for row in straight] == [
        int(row["lambda_m"] > value) for row in straight
    ]
    assert sorted(tips[1:]) == pytest.approx([-np.sqrt(2) / K, np.sqrt(2) / K], rel=1e-3)
