"""A shell's own weight, against closed forms of discs, hanging strips and standing columns."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import jv

import magshell_fenicsx as ms
from magshell_fenicsx import Case
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError

CAP = {"geometry": "cap", "polar": 40, "radius": 1.0, "thickness": 0.01, "poisson_ratio": 0.3}


def made(**sections: Any) -> Case:
    return Case.from_source(sections)


def ended(case: Case) -> dict[str, float]:
    """The last row."""
    scene = ms.Scene(case)
    *_, record = ms.follow(scene)
    return scene.observe(record.point.state)


@pytest.mark.parametrize(
    ("model", "symmetry", "tolerance"),
    [
        ("shell", "auto", 1e-3),
        ("shell", "half", 1e-3),
        ("shell", "none", 1e-3),
        ("solid", "half", 0.01),
    ],
)
def test_disc(model: str, symmetry: str, tolerance: float) -> None:
    """A clamped plate under q = ρ g h: w = q R⁴/(64 D) at its centre."""
    R_over_h, nu, g = 50.0, 0.3, 1e-7
    case = made(
        model=model,
        shell={"geometry": "disc", "radius_to_thickness": R_over_h, "poisson_ratio": nu},
        boundary={"rim": "clamped"},
        loading={"kind": "gravity", "acceleration": g, "points": 1},
        symmetry=symmetry,
        **({"mesh": {"size": 0.25}} if symmetry != "auto" else {}),
    )
    assert make_problem(case).axisymmetric == (symmetry == "auto")
    row = ended(case)
    assert row["gravity"] == pytest.approx(g)
    assert row["w_pole_over_h"] == pytest.approx(
        g * 12 * (1 - nu**2) * R_over_h**3 / 64, rel=tolerance
    )


@pytest.mark.parametrize(
    ("model", "symmetry"), [("shell", "half"), ("shell", "none"), ("solid", "half")]
)
def test_hanging_strip(model: str, symmetry: str) -> None:
    """It hangs from its root: u = ρ g L²/(2 E) at its tip."""
    case = made(
        model=model,
        shell={
            "geometry": "strip",
            "width": 0.1,
            "radius_to_thickness": 50.0,
            "poisson_ratio": 0.0,
        },
        boundary={"root": "clamped"},
        points={"tip_middle": [1, 0, 0]},
        loading={"kind": "gravity", "direction": [2, 0, 0], "acceleration": 1e-3, "points": 1},
        symmetry=symmetry,
    )
    assert ended(case)["tip_middle_ux"] == pytest.approx(1e-3 / 2, rel=2e-3)


def test_thickness_that_varies() -> None:
    """h = h0 exp(-x): a hanging strip has the tension ρ g ∫ h, u' = ρ g (1 - exp(x - 1))/E."""
    case = made(
        shell={
            "geometry": "strip",
            "width": 0.1,
            "radius_to_thickness": 50.0,
            "poisson_ratio": 0.0,
            "thickness_factor": "exp(-x)",
        },
        boundary={"root": "clamped"},
        points={"tip_middle": [1, 0, 0]},
        loading={"kind": "gravity", "direction": [1, 0, 0], "acceleration": 1e-3, "points": 1},
    )
    assert ended(case)["tip_middle_ux"] == pytest.approx(1e-3 * np.exp(-1), rel=2e-3)


def test_greenhill() -> None:
    """A clamped column buckles at ρ g L³ 12/(E h²) = 9/4 of the squared first zero of J₋⅓
    (Greenhill 1881).
    """
    zero = brentq(lambda t: jv(-1 / 3, t), 1.5, 2.2)
    case = made(
        shell={
            "geometry": "strip",
            "width": 0.1,
            "radius_to_thickness": 100.0,
            "poisson_ratio": 0.0,
        },
        boundary={"root": "clamped"},
        loading={"kind": "gravity", "direction": [-1, 0, 0], "until": "bifurcation"},
    )
    assert ended(case)["gravity"] == pytest.approx(9 / 4 * zero**2 / 12 * 0.01**2, rel=1e-3)


@pytest.mark.slow
def test_fold_from_two_sides() -> None:
    """A heavy cap under pressure: the fold by the weight at p is the fold by the pressure at that
    weight.
    """
    pressed = {
        "kind": "pressure",
        "until": "target",
        "control": "load",
        "pressure": 0.2,
        "points": 2,
    }

    def fold(*steps: dict[str, Any]) -> dict[str, float]:
        scene = ms.Scene(
            made(
                shell=CAP, boundary={"rim": "hinged"}, symmetry="axisymmetric", loading=list(steps)
            )
        )
        (record,) = [each for each in ms.follow(scene) if each.label == "fold"]
        return scene.observe(record.point.state)

    found = fold(pressed, {"kind": "gravity", "until": "limit"})
    weight = {"kind": "gravity", "acceleration": found["gravity"], "points": 4}
    assert found["gravity"] > 0
    assert fold(weight, {"kind": "pressure", "until": "limit"})["p_over_pc"] == pytest.approx(
        0.2, rel=1e-4
    )


def test_two_directions_add_up() -> None:
    """Two steps along e1 and -e3 end where one along their sum does; the first is held, and each
    has its unit.
    """
    disc = {"geometry": "disc", "radius": "0.1 m", "thickness": "1 mm", "youngs_modulus": "2 GPa"}
    disc |= {"poisson_ratio": 0.3, "density": "1100 kg/m^3"}
    common: dict[str, Any] = {
        "shell": disc,
        "boundary": {"rim": "clamped"},
        "points": {"here": ["50 mm", 0, 0]},
    }

    def step(direction: list[float], acceleration: str) -> dict[str, Any]:
        return {
            "kind": "gravity",
            "direction": direction,
            "acceleration": acceleration,
            "points": 1,
        }

    apart = made(**common, loading=[step([3, 0, 0], "3 m/s^2"), step([0, 0, -1], "4 m/s^2")])
    scene = ms.Scene(apart)
    *_, record = ms.follow(scene)
    row = scene.observe(record.point.state)
    at_once = ended(made(**common, loading=step([3, 0, -4], "5 m/s^2")))
    assert row["gravity"] == pytest.approx(1100 * 3 * 0.1 / 2e9)
    in_si = scene.sizes.values(row)
    assert (in_si["gravity_m_per_s2"], in_si["gravity_2_m_per_s2"]) == pytest.approx((3, 4))
    for column in ("here_ux", "here_uz"):
        assert row[column] == pytest.approx(at_once[column], rel=1e-6)
    assert "the shell's weight along [1, 0, 0]" in describe(apart)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"acceleration": "9.81 m/s^2"}, "needs density, youngs_modulus and lengths"),
        ({"acceleration": "9.81 m/s"}, "not convertible to metre/second"),
        ({"acceleration": 1.0, "direction": [0, 0, 0]}, "must not be zero"),
        ({"acceleration": 1.0, "direction": "down"}, "must be a list, in brackets"),
    ],
)
def test_mistakes(keys: dict[str, Any], words: str) -> None:
    with pytest.raises(CaseError, match=words):
        made(shell=CAP, boundary={"rim": "clamped"}, loading={"kind": "gravity", **keys})


def test_history() -> None:
    """It may be shaken: an acceleration in time, as a target is."""
    steps = [
        {"kind": "gravity", "acceleration": 1e-6, "points": 1},
        {
            "kind": "time",
            "duration": 10.0,
            "points": 2,
            "history": {"gravity": {"kind": "ramp", "to": 3e-6, "over": 10.0}},
        },
    ]
    scene = ms.Scene(made(shell=CAP, boundary={"rim": "clamped"}, loading=steps))
    rows = [scene.observe(record.point.state)["gravity"] for record in ms.follow(scene)]
    assert rows[-2:] == pytest.approx([2e-6, 3e-6])


@pytest.mark.parametrize(
    "factor", [None, pytest.param("exp(0.6*x + 0.8*y)", marks=pytest.mark.slow)]
)
def test_a_half_beside_the_first_axis(factor: str | None) -> None:
    """Gravity across the axis of a disc chooses the plane of the half, also on a bed that varies in
    this plane.
    """
    sections: dict[str, Any] = {
        "shell": {"geometry": "disc", "radius_to_thickness": 50.0, "poisson_ratio": 0.3},
        "boundary": {"rim": "hinged"},
        "loading": {
            "kind": "gravity",
            "direction": [0.6, 0.8, -1],
            "acceleration": 1e-5,
            "points": 1,
        },
        "points": {"here": [0.3, 0.4, 0], "there": [0.0, 0.0, 0.0]},
        "mesh": {"size": 0.25},
        "foundation": {
            "stiffness": 1e-4,
            "tangential": 0.01,
            **({"factor": factor} if factor else {}),
        },
    }
    half, whole = (made(**sections, symmetry=symmetry) for symmetry in ("auto", "none"))
    assert make_problem(half).is_half
    row, known = ended(half), ended(whole)
    assert row["here_ux"] > 0
    assert row["here_uy"] > 0
    for column in ("here_ux", "here_uy", "here_uz", "there_uz", "foundation_force", "energy"):
        assert row[column] == pytest.approx(known[column], rel=1e-4)
