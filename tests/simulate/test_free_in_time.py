"""Shells that nothing holds, in time: their rigid motions cost inertia."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.runs.rows import columns
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.scene import NOT_COUNTED

MU0 = 4e-7 * np.pi
LENGTH, DENSITY, REMANENCE, FIELD, ANGLE = 10e-3, 2000.0, 10e-3, 1e-3, 5.0  # SI, degrees
MAGNET = {
    "shell": {
        "geometry": "plate",
        "length": f"{LENGTH} m",
        "width": f"{LENGTH} m",
        "thickness": "1 mm",
        "youngs_modulus": "100 MPa",
        "poisson_ratio": 0.3,
        "density": f"{DENSITY} kg/m^3",
    },
    "boundary": {"left": "free", "right": "free", "bottom": "free", "top": "free"},
    "points": {"tip": [f"{LENGTH} m", f"{LENGTH / 2} m", 0]},
    "magnetic": {
        "remanent": {"polar": 90, "azimuth": 0, "flux_density": f"{REMANENCE} T"},
        "applied": {"polar": 90 - ANGLE, "azimuth": 0, "flux_density": f"{FIELD} T"},
    },
    "mesh": {"degree": 2, "size": f"{LENGTH / 2} m"},
}
SWING = {
    "kind": "time",
    "duration": "0.096 s",
    "points": 16,
    "rho_inf": 1,
    "tolerance": 1e-4,
    "history": {"field": [[0, 1], [1, 1]]},
}


def case_of(**sections: Any) -> Case:
    return Case.from_source({**MAGNET, **sections})


def test_a_magnetised_plate_is_a_compass_needle() -> None:
    """omega = sqrt(m B/I) of a thin rigid plate. The period has the pendulum's 1 + angle^2/16."""
    case = case_of(loading=SWING)
    assert "nothing is held" not in describe(case)
    scene = Scene(case)
    found = columns(scene, follow(scene))
    omega = np.sqrt(REMANENCE * FIELD / MU0 / (DENSITY * LENGTH**2 / 12))
    quarter = np.pi / 2 / omega * (1 + np.radians(ANGLE) ** 2 / 16)
    height = CubicSpline(found["time"][1:], found["tip_uz"][1:])
    along_field = (
        LENGTH
        / 2
        * np.sin(np.radians(ANGLE))
        * found["tip_uz"].max()
        / np.abs(found["tip_uz"]).max()
    )
    reached = brentq(lambda t: height(t) - along_field, 0.05, 0.09)
    assert reached == pytest.approx(quarter, rel=1e-4)
    assert NOT_COUNTED in scene.warnings
    assert not found["negative_pivots"].any()


@pytest.mark.parametrize(
    "change", [{"until": "rest"}, {"push": {"velocity": 1.0}}, {"until": "instability"}]
)
def test_what_needs_a_shell_that_is_held(change: dict[str, Any]) -> None:
    with pytest.raises(MeshError, match="not held"):
        Scene(case_of(loading={**SWING, **change}))


def test_a_field_before_the_motion_needs_a_support() -> None:
    """The message says how the plate may stay free."""
    still = {"kind": "time", "duration": "0.1 s", "points": 2}
    hint = "need not be held: let a field, for instance, act in the history"
    with pytest.raises(CaseError, match=f"nothing is held: .*{hint}"):
        describe(case_of(loading=still))
    with pytest.raises(MeshError, match=f"not held: .*{hint}"):
        Scene(case_of(loading=still))


@pytest.mark.slow
def test_two_free_magnets_attract() -> None:
    """The equation of motion of two rigid coaxial current loops, force by Maxwell's elliptic
    integrals.
    """
    radius, thickness, density, remanence, distance, duration = (
        5e-3,
        0.4e-3,
        2000.0,
        0.1,
        10e-3,
        0.01,
    )
    sizes = {"radius": f"{radius} m", "thickness": f"{thickness} m", "density": f"{density} kg/m^3"}
    disc = {
        "shell": {"geometry": "disc", "youngs_modulus": "10 MPa", "poisson_ratio": 0.3, **sizes},
        "boundary": {"rim": "free"},
        "remanent": {"polar": 0, "flux_density": f"{remanence} T"},
    }
    upper = {**disc, "place": {"position": [0, 0, f"{distance} m"]}}
    fall = {"kind": "time", "duration": duration, "points": 5, "rho_inf": 1}
    case = {
        "shells": {"upper": upper, "lower": disc},
        "magnetic": {"interaction": "others"},
        "loading": {**fall, "history": {"interaction": [[0, 1], [1, 1]]}},
        "mesh": {"refinement": 0.6},
    }
    scene = Scene(Case.from_source(case))
    *_, end = columns(scene, follow(scene))["w_over_h"]

    current = remanence / MU0 * thickness

    def force(z: float) -> float:
        square = 4 * radius**2 / (4 * radius**2 + z**2)
        K, E = ellipk(square), ellipe(square)
        root = np.sqrt(square)
        slope = MU0 * z * root / (4 * radius) * (2 * K - (2 - square) / (1 - square) * E)
        return float(current**2 * slope)

    mass = density * np.pi * radius**2 * thickness
    motion = solve_ivp(
        lambda t, y: [y[1], 2 * force(y[0]) / mass], (0, duration), [distance, 0], rtol=1e-9
    )
    fallen = (distance - motion.y[0, -1]) / 2 / thickness
    assert end == pytest.approx(fallen, rel=3e-3)  # the discs are 0.4 mm thick, the loops are not
