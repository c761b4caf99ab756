"""The modes that a half shell excludes, against the full shell."""

import numpy as np
import pytest
from conftest import hemisphere

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.modes import critical_mode
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.parts.imperfections.dimple import Dimple
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.shells.shell import ShellModel
from magshell_fenicsx.simulate.follow import follow


def second_variation(size: float, half: bool) -> float:
    """v . K . v of a smooth antisymmetric v at a smooth symmetric state, of the whole shell."""
    conditions = {"rim": "clamped", **({"symmetry": "symmetry"} if half else {})}
    surface = hemisphere(size, half=half, dimple=Dimple(0.02, 0.5))
    model = ShellModel(surface, Material(0.3, 0.05), 3, conditions, Loads(pressure=True))
    x, y, z = model.r0.x.array.reshape(-1, 3).T
    edge = (z**2)[:, None]  # vanishes with its slope at the clamped edge
    u = (0.05 * edge * np.column_stack([x * y**2, y * (1 + x), 0.3 + x + y**2])).ravel()
    v = (edge * np.column_stack([x * y, 0.5 + x + y**2, y * (1 - x)])).ravel()
    state = State(u, {"pressure": 0.3})
    if half:
        modes = model.symmetry_breaking_modes
        assert modes is not None
        K = modes.factor_at(state).matrix
    else:
        K = model.system.tangent(state.u, state.mu)
    right, left = K.createVecs()
    right.setArray(v)
    K.mult(right, left)
    return float(model.multiplicity * left.array @ v)


def test_second_variation_is_that_of_the_full_shell() -> None:
    half, full = (second_variation(0.2, half) for half in (True, False))
    assert half == pytest.approx(full, rel=2e-5)


def test_waves_come_in_pairs() -> None:
    """A perfect sphere is axisymmetric: cos(m theta), seen by the half, and sin(m theta), excluded,
    soften together.
    """
    data = {
        "shell": {"geometry": "hemisphere", "radius_to_thickness": 20, "poisson_ratio": 0.3},
        "boundary": {"equator": "clamped"},
        "loading": {
            "kind": "pressure",
            "until": "target",
            "control": "load",
            "pressure": 0.75,
            "points": 3,
        },
        "mesh": {"degree": 3, "refinement": 1.5},
        "symmetry": "half",
    }
    scene = Scene(Case.from_source(Source("pairs", data)))
    modes = scene.model.symmetry_breaking_modes
    assert modes is not None
    states = [record.point.state for record in follow(scene) if record.label == "target"]
    seen, excluded = (
        [critical_mode(stability, state).eigenvalue for state in states]
        for stability in (scene.newton, modes)
    )
    assert excluded == pytest.approx(seen, rel=0.03)
    assert seen[2] < 0.4 * seen[1]
