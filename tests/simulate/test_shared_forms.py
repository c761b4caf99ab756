"""Scenes of a meridian that share forms, against scenes that were made for their numbers alone."""

from typing import Any

import numpy as np
import pytest

import magshell_fenicsx as ms
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.simulate.scene_cache import SceneCache

CASE: dict[str, Any] = {
    "shell": {
        "geometry": "cap",
        "radius": 1,
        "thickness": 0.02,
        "polar": 30,
        "poisson_ratio": 0.3,
        "youngs_modulus": 1,
    },
    "boundary": {"rim": "clamped"},
    "magnetic": {"lambda_m": 0.002},
    "foundation": {"stiffness": 1e-3},
    "loading": {"kind": "pressure"},
    "symmetry": "axisymmetric",
}


def _case(**keys: float) -> ms.Case:
    data = {
        name: dict(section) if isinstance(section, dict) else section
        for name, section in CASE.items()
    }
    for key, value in keys.items():
        section, name = key.split("_", 1)
        data[section][name] = value
    return ms.Case.model_validate(data)


def test_scenes_that_share_forms_are_those_of_their_numbers() -> None:
    """Residual, load, tangent and numbers of waves; one after the other, and again after that."""
    first = ms.Scene(_case())
    cases = (
        _case(),
        _case(
            shell_thickness=0.022,
            shell_polar=32,
            shell_poisson_ratio=0.4,
            foundation_stiffness=2e-3,
        ),
    )
    cache = SceneCache(base=first, moves_mesh=True)
    alone = [cache.scene_for(case.problem()) for case in cases]
    assert cache.share_forms()
    scenes = [cache.scene_for(case.problem()) for case in cases]
    assert all(scene.model.kernels is first.model.kernels for scene in scenes)
    u = 1e-3 * np.sin(np.arange(first.model.system.size))
    for number in (0, 1, 0):
        scene, own = scenes[number], alone[number]
        state = State(
            own.model.system.zero_at_supports(u),
            {**own.unloaded().mu, "pressure": 0.8, "lambda_m": 0.002},
        )
        mine, theirs = (
            [
                each.model.system.residual(state.u, state.mu),
                each.model.system.load(state.u, state.mu, "pressure"),
                each.newton.factor_at(state).times(state.u),
                np.array(each.model.waves.counts(state), dtype=float),
            ]
            for each in (scene, own)
        )
        for one, other in zip(mine, theirs, strict=True):
            assert one == pytest.approx(other, rel=1e-9, abs=1e-9 * np.abs(other).max())


def test_what_is_more_than_numbers_is_not_shared() -> None:
    """The force at a pole is known by its form."""
    data = {**CASE, "loading": {"kind": "indentation", "depth": 1}}
    assert not SceneCache(base=ms.Scene(ms.Case.model_validate(data))).share_forms()
