"""Supports that move in time: an accelerated frame, impulses, the balance of energy."""

from typing import Any

import numpy as np
import pytest
from test_in_time import BEAM, STRIP, case_of, columns_of

from magshell_fenicsx.input.source import CaseError

LIFT = {"kind": "edge", "name": "lift", "moves": [{"supports": ["root"], "translation": [0, 0, 1]}]}
SHAKEN = STRIP | {"mesh": {"degree": 2, "size": 0.5}, "points": {"tip": [1, 0, 0]}}
PERIOD, SMALL = 2 * np.pi / BEAM, 1e-9
ACCELERATION = 0.02 / PERIOD**2


def moved(history: Any, **keys: Any) -> dict[str, Any]:
    """The columns of the motion, after a first step that names the support."""
    time = {
        "kind": "time",
        "duration": PERIOD,
        "points": 10,
        "step": PERIOD / 50,
        "history": {"lift": history},
        **keys,
    }
    static = LIFT | {"factor": SMALL, "points": 1, "control": "load"}
    found = columns_of(case_of(SHAKEN, static, time, symmetry="half"))
    return {key: values[found["step"] == 2] for key, values in found.items()}


def test_accelerated_support() -> None:
    """An evenly accelerated root bends a strip as a sudden load does: its mass times that."""
    found = moved(f"{SMALL} + {ACCELERATION / 2}*t**2")
    area = {"kind": "dead", "loads": [{"over": "all", "per_area": [0, 0, -ACCELERATION / 50]}]}
    sudden = {
        "kind": "time",
        "duration": PERIOD,
        "points": 10,
        "step": PERIOD / 50,
        "history": {"load": "1"},
    }
    first = area | {"control": "load", "factor": SMALL, "points": 1, "until": "target"}
    loaded = columns_of(case_of(SHAKEN, first, sudden, symmetry="half"))
    bent = loaded["tip_uz"][loaded["step"] == 2]
    assert found["tip_uz"] - found["lift"] == pytest.approx(bent, abs=1e-6 * np.abs(bent).max())
    assert np.abs(bent).max() > 1e-3
    energy = found["kinetic"] + found["stored"] - found["work"]
    assert np.ptp(energy) < 1e-3 * found["work"].max()


@pytest.mark.slow
def test_a_kink_is_an_impulse() -> None:
    """A root that starts and stops at once: the energies add up over both impulses."""
    found = moved(
        [[0, SMALL], [PERIOD / 4, 0.05], [PERIOD / 2, 0.05]],
        duration=PERIOD / 2,
        step=PERIOD / 200,
        rho_inf=1.0,
    )
    energy = found["kinetic"] + found["stored"] - found["work"]
    assert np.ptp(energy) < 1e-3 * found["work"].max()
    assert found["work"].max() > 0


def test_drag_and_sine() -> None:
    history = f"{SMALL} + 0.01*(1 - cos(6*pi*t/{PERIOD}))"
    found = moved(history, drag=0.05 * BEAM, duration=PERIOD / 2, step=PERIOD / 300)
    energy = found["kinetic"] + found["stored"] + found["dissipated"] - found["work"]
    assert np.ptp(energy) < 2e-3 * found["work"].max()


@pytest.mark.parametrize(
    ("history", "message"),
    [
        ({"kind": "step", "to": 0.1}, "a support cannot jump"),
        ([[0, 0], [1, 0], [1, 0.1]], "a support cannot jump"),
        ("0.1 + t", "history.lift: begins at 0.1, but the support is at"),
    ],
)
def test_jumps(history: Any, message: str) -> None:
    with pytest.raises(CaseError) as error:
        moved(history)
    assert message in str(error.value)
