"""Viscous meridians in motion: an exact damped vibration, and a curved shell against triangles."""

from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case, Scene, follow
from magshell_fenicsx.runs.rows import columns

OMEGA = 10.2158 * np.sqrt(1 / 12) / 50  # of a clamped disc (Leissa 1969), R/h = 50, nu = 0
DISC = {"geometry": "disc", "radius_to_thickness": 50, "poisson_ratio": 0.0}
CAP = {"geometry": "cap", "polar": 40, "radius": 1, "thickness": 0.02, "poisson_ratio": 0.3}


def found(shell: dict[str, Any], step: dict[str, Any], **others: Any) -> dict[str, Any]:
    """The columns of a motion."""
    data = {
        "shell": shell,
        "boundary": {"rim": "clamped"},
        "mesh": {"degree": 3, "refinement": 0.5},
    } | others
    scene = Scene(Case.from_source(data | {"loading": [{"kind": "time", **step}]}))
    return columns(scene, follow(scene))


@pytest.mark.parametrize(
    ("viscous", "polynomial"),
    [
        ({"viscosity": 0.1 / OMEGA}, [1, 0.1, 1]),
        (
            {"relaxation": [{"modulus": 0.3, "time": 1 / OMEGA}]},
            [1, 1, 1.3, 1],
        ),  # (s^2 + 1)(s + 1) + 0.3 s
    ],
)
def test_damped_vibration(viscous: dict[str, Any], polynomial: list[float]) -> None:
    """A mode of a clamped disc is an oscillator of one freedom; the energies add up."""
    period = 2 * np.pi / OMEGA
    push = {"mode": 1, "displacement": 0.01}
    step = {"duration": period / 2, "points": 2, "step": period / 80, "rho_inf": 1.0, "push": push}
    disc = found(DISC | viscous, step)
    roots = np.roots(polynomial)
    weights = np.linalg.solve(
        np.vander(roots, len(roots), increasing=True).T, [1, 0, -1][: len(roots)]
    )
    exact = np.real(np.exp(np.outer(OMEGA * disc["time"][1:], roots)) @ weights)
    assert disc["w_over_h"][1:] / 0.01 == pytest.approx(exact, abs=2e-3)
    energy = (disc["kinetic"] + disc["stored"] + disc["dissipated"])[1:]
    assert np.ptp(energy) < 1e-7 * energy[0]
    assert disc["dissipated"][-1] > 0.1 * energy[0]


@pytest.mark.slow
def test_curved_shell_as_on_triangles() -> None:
    """A cap that a slow pressure presses, with both kinds of viscosity: membrane, bending and
    edges.
    """
    viscous = {"viscosity": 5.0, "relaxation": [{"modulus": 0.5, "time": 20.0}]}
    load = {"pressure": {"kind": "ramp", "to": 0.2, "over": 60.0}}
    step = {"duration": 60.0, "points": 3, "step": 5.0, "rho_inf": 0.0, "history": load}
    meridian, half = (
        found(CAP | viscous, step),
        found(CAP | viscous, step, symmetry="half", mesh={"degree": 3}),
    )
    for key in ("w_pole_over_h", "dissipated"):
        assert meridian[key][1:] == pytest.approx(half[key][1:], rel=1e-2), key
