"""Sensitivities from the null vector against finite differences of separately computed knockdown
factors.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from conftest import CASES

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.fold import Fold, FoldGuess, find_fold
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.models.shell.spatial_fields import WithinRims
from magshell_fenicsx.public import Scene, run
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.simulate.sensitivity import sensitivities

MERIDIAN = ["magnetic.lambda_m=0.001"]
HALF = [
    *MERIDIAN,
    "symmetry=half",
    "mesh.degree=3",
    "mesh.refinement=0.3",
    "magnetic.applied.polar=30",
]
SHELLS = [
    pytest.param(MERIDIAN, id="meridian"),
    pytest.param(HALF, id="half", marks=pytest.mark.slow),
]


def case(*settings: str) -> Case:
    return Case.load(CASES / "dimple_buckling.yaml", settings)


def fold_of(*settings: str) -> tuple[Scene, Fold]:
    result = run(case(*settings))
    return result.scene, find_fold(result.scene.newton, FoldGuess(result.last), "pressure")


def derivative(f: Callable[[float], float], step: float) -> float:
    """Central difference of fourth order."""
    return (8 * (f(step) - f(-step)) - (f(2 * step) - f(-2 * step))) / (12 * step)


@pytest.mark.slow
@pytest.mark.parametrize("settings", SHELLS)
def test_field_and_defect(settings: list[str]) -> None:
    scene, fold = fold_of(*settings)
    found = sensitivities(scene, fold)
    for name, key, value, step in (
        ("lambda_m", "magnetic.lambda_m", 0.001, 5e-5),
        ("defect.amplitude", "shell.defect.amplitude", 1.64, 0.02),
    ):

        def again(d: float, key: str = key, value: float = value) -> float:
            other = Scene(case(*settings, f"{key}={value + d}"))
            state = fold.state.with_(fold.state.u, "lambda_m", other.problem.lambda_m)
            return find_fold(other.newton, FoldGuess(state, fold.phi), "pressure").value

        assert found[name] == pytest.approx(derivative(again, step), rel=1e-4), name


@pytest.mark.parametrize(
    ("settings", "remanent"),
    [(MERIDIAN, "kind: radial"), pytest.param(HALF, "polar: 0", marks=pytest.mark.slow)],
)
def test_patches_add_up_to_the_field(settings: list[str], remanent: str) -> None:
    """The magnetic energy is linear in the remanence and in lambda_m alike."""
    scene, fold = fold_of(*settings, f"magnetic.remanent={{{remanent}}}")
    found = sensitivities(scene, fold)
    whole = scene.problem.lambda_m * found["lambda_m"]
    parts = [found["remanence dimple"], found["remanence rest"]]
    assert sum(parts) == pytest.approx(whole, rel=1e-9, abs=1e-12 * max(map(abs, parts)))
    assert min(map(abs, parts)) > 1e-3


def test_remanence_of_the_dimple() -> None:
    """The magnetisation of the dimple alone is made stronger, and the fold is found again."""
    scene, fold = fold_of(*MERIDIAN)
    model, field = scene.model, scene.model.loads.magnetic
    assert isinstance(model, MeridianModel)
    assert field
    rim, B = scene.problem.within["dimple"], np.array([0.0, 0.0, 1.0])

    def stronger(change: float) -> float:
        loads = replace(
            model.loads, magnetic=replace(field, remanent=WithinRims(((rim, (1 + change) * B),), B))
        )
        other = MeridianModel(model.meridian, model.material, model.degree, model.conditions, loads)
        return find_fold(
            BorderedNewton(other.system), FoldGuess(fold.state, fold.phi), "pressure"
        ).value

    expected = derivative(stronger, 0.02)
    assert sensitivities(scene, fold)["remanence dimple"] == pytest.approx(expected, rel=1e-6)


def test_without_a_field() -> None:
    """The derivative by the field is there, for its value see test_own_runs.py; that by a remanence
    is not.
    """
    scene, fold = fold_of("magnetic.lambda_m=0")
    assert list(sensitivities(scene, fold)) == ["lambda_m", "defect.amplitude", "defect.width"]
