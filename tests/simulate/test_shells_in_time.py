"""Shells that hit each other in time: forces of a step, the balance of energy, and where a motion
ends.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.assembly.nonlocal_terms import times
from magshell_fenicsx.parts.contact.time_averaging import (
    StepSample,
    at_each_sample,
    samples_of_step,
)
from magshell_fenicsx.runs.rows import rows
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Stopped

Array = NDArray[np.float64]
DISC = {
    "geometry": "disc", "radius": "50 mm", "thickness": "1 mm",
    "poisson_ratio": 0.3, "youngs_modulus": "1 MPa", "density": "1000 kg/m^3",
}  # fmt: skip
DISCS: dict[str, Any] = {
    "shells": {
        "low": {"shell": DISC, "boundary": {"rim": "clamped"}},
        "high": {
            "shell": DISC,
            "boundary": {"rim": "clamped"},
            "place": {"position": ["0 mm", "0 mm", "1.5 mm"]},
        },
    },
    "contact": [["low", "high"]],
}
CLAP = "-0.05*(1 - (x**2 + y**2)/0.0025)**2*(z - 0.00075)/0.00075"  # towards each other
THROWN = {
    "kind": "time",
    "velocity": ["0", "0", CLAP],
    "rho_inf": 1.0,
    "step": 2e-3,
    "duration": 1e-2,
    "points": 5,
}
BULGED = {"thickness_factor": "1.1 - 0.4*(x**2 + y**2)"}
RUBBER = {"law": "neo-hookean", "poisson_ratio": 0.5}
MESHES = {
    "axisymmetric": {"degree": 3, "refinement": 0.3},
    "half": {"degree": 2, "refinement": 0.2},
}


def discs(**shell: Any) -> dict[str, Any]:
    """Both with other keys of their shell."""
    shells = {
        name: {**each, "shell": each["shell"] | shell} for name, each in DISCS["shells"].items()
    }
    return {**DISCS, "shells": shells}


def found_of(base: dict[str, Any]) -> list[dict[str, Any]]:
    scene = Scene(Case.from_source(base))
    return rows(scene, follow(scene))


@pytest.mark.parametrize("symmetry", MESHES)
@pytest.mark.parametrize(
    ("ends", "shell"),
    [
        *(((a, b), {}) for a, b in [(0.2, 0.29), (0.29, 0.24), (0.29, 0.2902), (0.24, 0.3)]),
        ((0.15, 0.26), BULGED),
    ],
)
def test_the_force_of_a_step_does_the_work_that_the_energy_changes_by(
    symmetry: str, ends: tuple[float, float], shell: dict[str, Any]
) -> None:
    """Where contact sets in, ceases and goes on: 1e-9 of the larger energy. Differences of the
    force are its tangent within 1e-3, as the tangent leaves out how factors at kinks change with
    the direction of the
    way.
    """
    steps = {"loading": [{"kind": "time", "duration": 1.0, "points": 1}], "symmetry": symmetry}
    scene = Scene(Case.from_source(discs(**shell) | steps | {"mesh": MESHES[symmetry]}))
    (contact,), h = scene.model.shell_contacts, scene.model.material.h
    r = contact._r0

    def clapped(w: float, seed: int) -> Array:
        u, bump = np.zeros_like(r), (1 - np.sum(r[:, :-1] ** 2, axis=1)) ** 2
        u[:, -1] = np.where(r[:, -1] > 0.75 * h, -1.0, 1.0) * w * h * bump
        return u + 1e-5 * h * np.random.default_rng(seed).standard_normal(u.shape)

    def force(end: Array, part: float) -> Array:
        contact.samples = ()
        contact.samples = samples_of_step(contact, begin, end, part)
        return np.sum(at_each_sample(contact, contact._gradient), axis=0)[:, : r.shape[1]]

    def energy(u: Array) -> float:
        contact.samples, contact.sample = (), StepSample(u)
        try:
            return contact.energy()
        finally:
            contact.sample = None

    begin, end = clapped(ends[0], 0), clapped(ends[1], 1)
    energies = energy(begin), energy(end)
    assert max(energies) > 0
    assert np.sum(force(end, 0.5) * (end - begin)) == pytest.approx(
        energies[1] - energies[0], abs=1e-9 * max(energies)
    )
    v = 1e-7 * h * np.random.default_rng(3).standard_normal(r.shape)
    force(end, 0.6)
    i, j, values = map(
        np.concatenate, zip(*at_each_sample(contact, contact._entries, tangent=True), strict=True)
    )
    expected = 0.6 * times([(1.0, (i, j, values))], v.ravel())
    change = (force(end + v / 2, 0.6) - force(end - v / 2, 0.6)).ravel()
    contact.samples = ()
    assert np.abs(change).max() > 0
    assert np.abs(change - expected).max() < 1e-3 * np.abs(change).max()


@pytest.mark.parametrize(
    ("symmetry", "shell"),
    [
        ("half", {}),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in (("half", BULGED), ("axisymmetric", RUBBER))
        ),
    ],
)
def test_two_plates_that_clap_conserve_energy(symmetry: str, shell: dict[str, Any]) -> None:
    """With rho_inf: 1 nothing is lost but by bending, whose energy is no quartic; both are in
    contact at a row.
    """
    found = found_of(
        discs(**shell) | {"loading": [THROWN], "symmetry": symmetry, "mesh": MESHES[symmetry]}
    )
    assert max(row["contact_force"] for row in found) > 0
    for row in found[1:]:
        assert abs(row["imbalance"]) < 1e-6 * (row["kinetic"] + row["stored"])


def test_the_work_of_a_rim_that_meets_the_other_plate() -> None:
    """A small plate is driven down by its rim onto the large one: the work of its mean force closes
    the balance.

    Drag acts on the motion of the rim too.
    """
    small = {
        "shell": DISC | {"radius": "20 mm"},
        **{key: DISCS["shells"]["high"][key] for key in ("boundary", "place")},
    }
    moves = [{"supports": ["high.rim"], "translation": ["0 mm", "0 mm", "-1 mm"]}]
    driven = {"kind": "edge", "name": "down", "moves": moves, "points": 1, "factor": 1e-4}
    history = {
        "history": {"down": "0.0001 + (t/0.02)**2"},
        "duration": 0.018,
        "points": 9,
        "drag": 20.0,
    }
    moving = {key: value for key, value in THROWN.items() if key != "velocity"} | history
    shells = DISCS["shells"] | {"high": small}
    found = found_of(
        DISCS
        | {
            "shells": shells,
            "loading": [driven, moving],
            "symmetry": "half",
            "mesh": MESHES["half"],
        }
    )
    assert max(row["contact_force"] for row in found) > 0
    assert abs(found[-1]["imbalance"]) < 1e-6 * found[-1]["work"]


def test_a_plane_with_a_position_beside_several_shells() -> None:
    """It needs no `at`: its front is where it is given."""
    floor = {"kind": "plane", "position": ["0 mm", "0 mm", "-0.7 mm"], "direction": [0, 0, 1]}
    (contact,) = (
        Case.from_source(DISCS | {"loading": [THROWN], "bodies": {"floor": floor}})
        .problem()
        .loads.contacts
    )
    assert contact.front == pytest.approx([0, 0, -0.7 / 50], abs=1e-12)


@pytest.mark.parametrize(
    ("symmetry", "mesh"), [("axisymmetric", MESHES["axisymmetric"]), ("half", {"degree": 2})]
)
def test_the_start_row_has_the_energy_of_the_initial_velocity(
    symmetry: str, mesh: dict[str, float]
) -> None:
    """m v^2/2 of two discs that move as (1 - r^2)^2, whose square's mean is 1/5; over E h R^2."""
    case = Case.from_source(DISCS | {"loading": [THROWN], "symmetry": symmetry, "mesh": mesh})
    v = 0.05 / np.sqrt(1e6 / 1000)  # over the speed of waves
    assert next(follow(Scene(case))).clock["kinetic"] == pytest.approx(
        2 * np.pi * v**2 / 2 / 5, rel=1e-3
    )


@pytest.mark.parametrize(
    ("speed", "harder"), [pytest.param(5.0, 1, marks=pytest.mark.slow), (20.0, 16)]
)
def test_equal_plates_that_meet_flat_exchange_their_velocities(speed: float, harder: int) -> None:
    """One flies (the foundation is 1e-9 of what its inertia needs), one rests: afterwards it is the
    other one.

    A pair as fast as this goes sqrt(m/(2k)) v deep, 0.15 h at 20 m/s with the penalty of shells at
    rest.
    """
    rim = {"boundary": {"rim": {"held": ["x", "y"]}}}
    shells = {name: {**shell, **rim} for name, shell in DISCS["shells"].items()}
    thrown = {
        "kind": "time",
        "velocity": ["0", "0", f"-{speed}*z/0.0015"],
        "rho_inf": 1.0,
        "points": 2,
    }
    thrown["duration"] = 1e-3 / speed  # twice the time to the impact
    base = DISCS | {
        "shells": shells,
        "foundation": {"stiffness": 1.0},
        "symmetry": "none",
        "mesh": MESHES["half"],
    }
    scene = Scene(Case.from_source(base | {"loading": [thrown]}))
    start, *_, end = follow(scene)
    high = scene.model.r0.x.array.reshape(-1, 3)[:, 2] > 0.01
    v = end.point.du.reshape(-1, 3)[:, 2] * np.sqrt(1e6 / 1000)
    assert np.abs(v[high]).max() < 1e-6 * speed
    assert np.abs(v[~high] + speed).max() < 1e-6 * speed
    assert end.clock["kinetic"] == pytest.approx(start.clock["kinetic"], rel=1e-6)
    assert abs(end.clock["imbalance"]) < 1e-9 * start.clock["kinetic"]
    pair = scene.model.shell_contacts[0].pair
    assert end.point.state.mu.get(pair.setting, pair.stiffness) == harder * pair.stiffness


@pytest.mark.slow
def test_a_given_stiffness_stays_and_a_motion_says_what_to_give() -> None:
    """The same discs as above, clapping at 20 m/s: without a stiffness they end, see the balance
    there.
    """
    thrown = THROWN | {
        "velocity": ["0", "0", CLAP.replace("0.05", "20")],
        "step": 2e-6,
        "duration": 3e-5,
        "points": 3,
    }
    base = DISCS | {"loading": [thrown], "symmetry": "axisymmetric", "mesh": MESHES["axisymmetric"]}
    own = found_of(base)
    assert own[-1]["contact_penalty"] > own[0]["contact_penalty"]
    assert own[-1]["contact_force"] > 0
    assert abs(own[-1]["imbalance"]) < 1e-6 * own[0]["kinetic"]
    with pytest.raises(Stopped, match=r"contact: stiffness: is 1e.05: give four times as much"):
        found_of(base | {"contact": [{"between": ["low", "high"], "stiffness": 1e5}]})
    given = found_of(base | {"contact": [{"between": ["low", "high"], "stiffness": 4e6}]})
    assert {row["contact_penalty"] for row in given} == {4e6}
