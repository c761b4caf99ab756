"""Sensitivities to the numbers of imperfections, against folds that are found again."""

import pytest
from conftest import CASES

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.fold import FoldGuess, find_fold
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.sensitivity import (
    DeviationDifference,
    _deviation,
    sensitivities,
    with_changed_number,
    with_deviation,
)
from magshell_fenicsx.simulate.steps import fold_at
from magshell_fenicsx.simulate.transfer import transfer


@pytest.mark.parametrize("kind", [pytest.param("dimple", marks=pytest.mark.slow), "gaussian"])
def test_of_the_meridian(kind: str) -> None:
    """On meshes that follow the rim; off the pole the derivative is zero by symmetry, and is not
    asked for there.
    """
    one = (
        f"[{{kind: {kind}, amplitude: 1.2, width: 2.5}}, "
        "{kind: formula, w0: x**2 + y**2, amplitude: 0.1}]"
    )
    scene = Scene(Case.load(CASES / "dimple_buckling.yaml", [f"shell.imperfections={one}"]))
    *_, last = follow(scene)
    found = sensitivities(scene, fold := fold_at(scene, last))
    numbers = ["imperfections.0.amplitude", "imperfections.0.width", "imperfections.1.amplitude"]
    assert list(found) == ["lambda_m", *numbers]
    for name in numbers:
        derivative = found[name]
        key, _, number = name.rpartition(".")

        def value(change: float, key: str = key, number: str = number) -> float:
            value = getattr(scene.problem.imperfections[key], number) + change
            other = Scene(scene.problem.with_values({f"shell.{key}.{number}": value}))
            u, phi = (transfer(scene, other, v) for v in (fold.state.u, fold.phi))
            return find_fold(
                other.newton, FoldGuess(State(u, fold.state.mu), phi), "pressure"
            ).value

        by_folds = (8 * (value(0.005) - value(-0.005)) - (value(0.01) - value(-0.01))) / 0.06
        assert derivative == pytest.approx(by_folds, rel=1e-4), name


@pytest.mark.slow
def test_beside_the_pole() -> None:
    """Depth, width and both angles of the deeper of two dimples, on the same mesh with the dimple
    itself changed.
    """
    flaws = (
        "amplitude: 1, width: 2.5, at: {polar: 20, azimuth: 70}",
        "amplitude: 0.7, width: 3, at: {polar: 45}",
    )
    several = ", ".join(f"{{kind: gaussian, {numbers}}}" for numbers in flaws)
    sets = [
        f"shell.imperfections=[{several}]",
        "shell.radius_to_thickness=30",
        "mesh.degree=3",
        "mesh.refinement=0.4",
    ]
    scene = Scene(Case.load(CASES / "dimple_buckling.yaml", [*sets, "symmetry=none"]))
    *_, last = follow(scene)
    found = sensitivities(scene, fold := fold_at(scene, last))
    key, old = "imperfections.0", _deviation(scene, scene.problem.imperfections, "imperfections.0")
    for number, step in (
        ("amplitude", 0.004),
        ("width", 0.01),
        ("at.polar", 0.1),
        ("at.azimuth", 0.1),
    ):

        def value(change: float, number: str = number) -> float:
            sections = with_changed_number(scene.problem.imperfections, key, number, change)
            other = with_deviation(
                scene, DeviationDifference(_deviation(scene, sections, key), old, 1.0)
            )
            u, phi = (transfer(scene, other, v) for v in (fold.state.u, fold.phi))
            return find_fold(
                other.newton, FoldGuess(State(u, fold.state.mu), phi), "pressure"
            ).value

        ends = [value(n * step) for n in (-2, -1, 1, 2)]
        by_folds = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)
        assert found[f"{key}.{number}"] == pytest.approx(by_folds, rel=2e-5), number
