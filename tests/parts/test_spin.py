"""A shell that spins, against closed forms of discs and blades under their centrifugal forces."""

from math import pi, sqrt
from typing import Any

import numpy as np
import pytest

import magshell_fenicsx as ms
from magshell_fenicsx import Case
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError

SMALL = 1e-3  # ρ ω² R²/E: strains of the same order


def made(**sections: Any) -> Case:
    return Case.from_source(sections)


def disc(model: str = "shell", symmetry: str = "auto", **further: Any) -> Case:
    """With a rim that does not move; R/h = 50."""
    further.setdefault("loading", {"kind": "spin", "speed": sqrt(SMALL), "points": 1})
    shell = {
        "geometry": "disc",
        "radius_to_thickness": 50.0,
        "poisson_ratio": 0.3,
        **further.pop("shell", {}),
    }
    mesh = {"size": 0.25} if symmetry != "auto" else {}
    return made(
        model=model, shell=shell, boundary={"rim": "hinged"}, points={"here": [0.5, 0, 0]},
        symmetry=symmetry, **({"mesh": mesh} if mesh else {}), **further,
    )  # fmt: skip


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
        ("solid", "half", 0.02),
    ],
)
def test_disc(model: str, symmetry: str, tolerance: float) -> None:
    """Plane stress: u = (1 - ν²) ρ ω²/(8 E) r (R² - r²) where the rim is fixed."""
    row = ended(disc(model, symmetry))
    assert row["spin"] == pytest.approx(SMALL)
    assert row["here_ux"] == pytest.approx(
        (1 - 0.3**2) * SMALL / 8 * 0.5 * (1 - 0.5**2), rel=tolerance
    )


@pytest.mark.parametrize(
    ("model", "symmetry"), [("shell", "half"), ("shell", "none"), ("solid", "half")]
)
def test_blade(model: str, symmetry: str) -> None:
    """The tension ∫ ρ ω² r of a narrow blade from its root: u = ρ ω² L³/(3 E) at its tip."""
    shell = {"geometry": "strip", "width": 0.1, "radius_to_thickness": 50.0, "poisson_ratio": 0.0}
    loading = {"kind": "spin", "speed": sqrt(SMALL), "points": 1}
    points = {"tip_middle": [1, 0, 0]}
    case = made(
        model=model,
        shell=shell,
        boundary={"root": "clamped"},
        loading=loading,
        symmetry=symmetry,
        points=points,
    )
    assert ended(case)["tip_middle_ux"] == pytest.approx(SMALL / 3, rel=2e-3)


def test_thickness_that_varies() -> None:
    """h = h0 exp(-r²): forces and stiffness fall together; u solves (r h u')' ... = -ρ ω² h r²
    numerically.
    """
    row = ended(disc(shell={"thickness_factor": "exp(-(x**2 + y**2))"}))
    nu, n = 0.3, 4000
    r = (np.arange(n) + 0.5) / n
    # energy of rings: E h/(2 (1 - ν²)) (u'² + 2 ν u' u/r + u²/r²) r - ρ ω² h r² u, linear elements
    nodes, step = np.linspace(0, 1, n + 1), 1 / n
    weight = np.exp(-(r**2)) * r * step
    K, f = np.zeros((3, n + 1)), np.zeros(n + 1)
    a = [np.full(n, -1 / step), np.full(n, 1 / step)]
    b = [0.5 / r, 0.5 / r]
    for i in range(2):
        f[i : n + i] += SMALL * weight * r * 0.5
        for j in range(2):
            entry = (
                weight
                / (1 - nu**2)
                * (a[i] * a[j] + nu * (a[i] * b[j] + b[i] * a[j]) + b[i] * b[j])
            )
            K[1 + i - j, j : n + j] += entry
    from scipy.linalg import solve_banded

    K[1, [0, n]], K[0, 1], K[2, 0], K[0, n], K[2, n - 1], f[[0, n]] = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
    u = solve_banded((1, 1), K, f)
    assert row["here_ux"] == pytest.approx(float(np.interp(0.5, nodes, u)), rel=2e-3)


CAP = {"geometry": "cap", "polar": 40, "radius": 1.0, "thickness": 0.01, "poisson_ratio": 0.3}


def test_fold_from_two_sides() -> None:
    """A spinning cap under pressure: the fold by the spin at p is the fold by the pressure at that
    spin.
    """
    pressed = {
        "kind": "pressure",
        "until": "target",
        "control": "load",
        "pressure": 0.4,
        "points": 2,
    }

    def fold(*steps: dict[str, Any]) -> dict[str, float]:
        scene = ms.Scene(made(shell=CAP, boundary={"rim": "hinged"}, loading=list(steps)))
        (record,) = [each for each in ms.follow(scene) if each.label == "fold"]
        return scene.observe(record.point.state)

    found = fold(pressed, {"kind": "spin", "until": "limit"})
    again = fold(
        {"kind": "spin", "speed": sqrt(found["spin"]), "points": 4},
        {"kind": "pressure", "until": "limit"},
    )
    assert found["spin"] > 0
    assert again["p_over_pc"] == pytest.approx(0.4, rel=1e-4)


def test_units() -> None:
    """The speed in rpm, and the square of it as a column; ρ ω² R²/E by hand."""
    shell = {"geometry": "disc", "radius": "0.1 m", "thickness": "1 mm", "youngs_modulus": "2 GPa"}
    case = made(
        shell={**shell, "poisson_ratio": 0.3, "density": "1100 kg/m^3"},
        boundary={"rim": "hinged"},
        loading={"kind": "spin", "speed": "3000 rpm", "points": 1},
    )
    omega = 2 * pi * 50
    scene = ms.Scene(case)
    *_, record = ms.follow(scene)
    row = scene.observe(record.point.state)
    assert row["spin"] == pytest.approx(1100 * omega**2 * 0.1**2 / 2e9)
    assert scene.sizes.values(row)["spin_per_s2"] == pytest.approx(omega**2)
    assert "spin_per_s2" in scene.extra_columns
    assert "centrifugal forces" in describe(case)
    assert make_problem(case).axisymmetric


@pytest.mark.parametrize(
    ("speed", "words"),
    [
        ("50 Hz", "give rpm or rad/s"),
        ("300 rad/s", "needs density, youngs_modulus and lengths"),
        (0.0, "not be zero"),
    ],
)
def test_mistakes(speed: Any, words: str) -> None:
    with pytest.raises(CaseError, match=words):
        disc(loading={"kind": "spin", "speed": speed})


def test_held_in_a_step() -> None:
    """A load after it finds the spin where it was."""
    shell = {"shell": {"geometry": "disc", "radius_to_thickness": 50.0, "poisson_ratio": 0.3}}
    spin = {"kind": "spin", "speed": sqrt(SMALL), "points": 1}
    pressure = {"kind": "pressure", "pressure": 0.01, "until": "target", "points": 1}
    case = made(**shell, boundary={"rim": "clamped"}, loading=[spin, pressure])
    scene = ms.Scene(case)
    *_, record = ms.follow(scene)
    state: State = record.point.state
    assert state.mu["spin"] == pytest.approx(SMALL)
    alone = made(**shell, boundary={"rim": "clamped"}, loading=pressure)
    assert abs(scene.observe(state)["w_pole_over_h"]) < abs(ended(alone)["w_pole_over_h"])


def test_a_history_is_of_the_speed() -> None:
    """As the target is: half of the time of a ramp from 0.02 to 0.04 is 0.03, and the amplitude its
    square.
    """
    spin = {"kind": "spin", "speed": 0.02, "points": 1}

    def spun(history: Any) -> list[float]:
        time = {"kind": "time", "duration": 10.0, "points": 2, "history": {"spin": history}}
        scene = ms.Scene(made(shell=CAP, boundary={"rim": "clamped"}, loading=[spin, time]))
        return [scene.observe(record.point.state)["spin"] for record in ms.follow(scene)][-2:]

    assert spun({"kind": "ramp", "to": 0.04, "over": 10.0}) == pytest.approx([0.03**2, 0.04**2])
    assert spun("0.02 + 0.001*t") == pytest.approx([0.025**2, 0.03**2])


def test_a_history_with_a_unit() -> None:
    """As a target of the load; where the case has no units it says what it needs."""
    time = {"kind": "time", "duration": 1.0, "history": {"spin": {"kind": "step", "to": "200 rpm"}}}
    with pytest.raises(
        CaseError, match=r"history.spin: 200 rpm: has a unit: that needs density, youngs_modulus"
    ):
        made(
            shell=CAP, boundary={"rim": "clamped"}, loading=[{"kind": "spin", "speed": 0.02}, time]
        )
