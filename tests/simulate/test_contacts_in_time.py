"""Contacts in time: the balance of energy through impact and release. Runs that stay together."""

from typing import Any

import numpy as np
import pytest
from benchmarks.contacts_in_time import CASES, SMALL, apart, imbalance, moved

from magshell_fenicsx import Case
from magshell_fenicsx.parts.gap import Penalty
from magshell_fenicsx.public import Scene
from magshell_fenicsx.runs.rows import imbalances, rows
from magshell_fenicsx.simulate.follow import follow

PLATE = {
    "shell": {"geometry": "disc", "radius_to_thickness": 50, "poisson_ratio": 0.3},
    "boundary": {"rim": "clamped"},
    "bodies": {"ball": {"kind": "sphere", "radius": 0.5, "at": {"polar": 0}}},
    "mesh": {"degree": 3, "refinement": 0.3},
}
APART = {"kind": "contact", "approach": -0.5, "points": 1}
THROWN = {"kind": "time", "points": 10, "velocity": ["0", "0", "0.01*(1-x**2-y**2)**2"]}


def found_of(
    base: dict[str, Any], *steps: dict[str, Any], **sections: Any
) -> tuple[Case, list[dict[str, Any]]]:
    case = Case.from_source({**base, **sections, "loading": list(steps)})
    scene = Scene(case)
    return case, rows(scene, follow(scene))


def test_the_mean_pressure_times_the_change_of_penetration_is_that_of_the_energy() -> None:
    """Across the kinks of psi'' too; its derivative by differences."""
    penalty = Penalty(5.0, 0.1)
    s0, s1 = (
        x.ravel() for x in np.meshgrid(np.linspace(-0.31, 0.42, 12), np.linspace(-0.3, 0.4, 11))
    )
    mean, slope = penalty.mean_pressure(s0, s1)
    assert mean * (s1 - s0) == pytest.approx(
        penalty.derivatives(s1)[0] - penalty.derivatives(s0)[0], abs=1e-15
    )
    ahead, behind = (penalty.mean_pressure(s0, s1 + step)[0] for step in (1e-6, -1e-6))
    assert slope == pytest.approx((ahead - behind) / 2e-6, abs=1e-5)


@pytest.mark.parametrize("symmetry", ["axisymmetric", pytest.param("half", marks=pytest.mark.slow)])
def test_an_impact_conserves_energy(symmetry: str) -> None:
    """A plate thrown at a ball: with rho_inf: 1 nothing is lost but by bending, whose energy is no
    quartic.
    """
    coarse = {"degree": 2, "refinement": 0.2} if symmetry == "half" else PLATE["mesh"]
    moving = THROWN | {"duration": 2.0, "step": 0.05, "rho_inf": 1.0}
    _, found = found_of(PLATE, APART, moving, symmetry=symmetry, mesh=coarse)
    assert max(row["force"] for row in found) > 0
    for row in found[2:]:
        assert abs(row["imbalance"]) < 1e-7 * (row["kinetic"] + row["stored"])


@pytest.mark.slow
def test_an_impact_of_rubber_conserves_energy() -> None:
    """Whose face comes nearer to its middle while the ball presses."""
    rubber = PLATE | {"shell": PLATE["shell"] | {"poisson_ratio": 0.5, "law": "neo-hookean"}}
    moving = THROWN | {"duration": 2.0, "step": 0.05, "rho_inf": 1.0}
    _, found = found_of(rubber, APART, moving, symmetry="axisymmetric")
    assert max(row["force"] for row in found) > 0
    for row in found[2:]:
        assert abs(row["imbalance"]) < 1e-7 * (row["kinetic"] + row["stored"])


@pytest.mark.slow
def test_steps_see_the_balance() -> None:
    """Numerical damping after an impact loses less than was asked; fixed long steps lose more, and
    the run says so.
    """
    case, found = found_of(PLATE, APART, THROWN | {"duration": 2.0}, symmetry="axisymmetric")
    assert not list(imbalances(case.programme, found, 0.02))
    assert found[-1]["imbalance"] < 0
    case, found = found_of(
        PLATE, APART, THROWN | {"duration": 2.0, "step": 0.2, "rho_inf": 0}, symmetry="axisymmetric"
    )
    (said,) = imbalances(case.programme, found, 0.02)
    assert said.startswith("step 2: its steps in time lose 0.")


HELD = {
    "shell": {
        "geometry": "cap",
        "polar": 30,
        "radius": 1.0,
        "thickness": 0.016,
        "poisson_ratio": 0.3,
    },
    "boundary": {"rim": "clamped"},
    "symmetry": "axisymmetric",
    "bodies": PLATE["bodies"],
    "mesh": {"degree": 3, "refinement": 0.3},
}


def test_a_viscous_cap_stays_on_its_ball() -> None:
    """Under a small ramp: in balance, in few iterations, and a viscosity changed by 1e-12 changes
    nothing.
    """
    ramp = {"history": {"pressure": {"kind": "ramp", "to": 1e-3, "over": 1.0}}}
    moving = {"kind": "time", "duration": 3.0, "points": 3, "drag": 0.05, **ramp}
    ends = []
    for viscosity in (1.0, 1.0 + 1e-12):
        shell = HELD["shell"] | {"viscosity": viscosity}
        _, found = found_of(
            HELD, {"kind": "contact", "approach": 0.5, "points": 1}, moving, shell=shell
        )
        ends.append(found[-1])
        assert all(row["force"] > 0 for row in found if row["step"] == 2)
        assert all(
            abs(row["imbalance"]) < 1e-4 * row["stored"] for row in found if row["step"] == 2
        )
        assert sum(row["iterations"] for row in found if row["step"] == 2) < 300
    for column in ("w_pole_over_h", "stored", "force"):
        assert ends[1][column] == pytest.approx(ends[0][column], rel=1e-8)


def test_a_driven_ball_does_the_work() -> None:
    """Driven out of a cap, which is released: the work of the mean force closes the balance with
    rho_inf: 1.
    """
    out = {"history": {"approach": {"kind": "ramp", "to": -0.5, "over": 1.0}}}
    moving = {"kind": "time", "duration": 2.0, "points": 4, "step": 0.05, "rho_inf": 1.0, **out}
    _, found = found_of(HELD, {"kind": "contact", "approach": 0.5, "points": 1}, moving)
    assert found[-1]["force"] == 0
    assert abs(found[-1]["imbalance"]) < 1e-5 * abs(found[-1]["work"])


SHOWN_ABOVE = (
    "the same, fixed step",  # an impact that conserves energy
    "plate thrown at a ball",  # its steps see the balance
    "cap released", "ball driven in",  # a driven ball does the work
    "viscous cap on a ball",  # which stays
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CASES if name not in SHOWN_ABOVE])
def test_contacts_are_in_balance_and_two_runs_stay_together(name: str) -> None:
    """Impact, release, rest, a held gas: within the default `balance`, and beside a Poisson's ratio
    that is changed.

    For a quarter of the time of docs/accuracy.md, which has two more.
    """
    base, bodies, (*before, motion) = CASES[name]
    steps = [
        *before,
        motion | {"duration": motion["duration"] / 4, "points": motion["points"] // 4},
    ]
    once, again = (moved(base, bodies, steps, change) for change in (0.0, SMALL))
    assert len(CASES) == 10
    assert imbalance(once) < 0.01
    assert apart(once, again) < 1e-8
