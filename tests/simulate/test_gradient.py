"""Gradients against central differences of states and folds that are solved again, along random
directions.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import CASES
from numpy.typing import NDArray
from test_field_gradients import neutral

from magshell_fenicsx.assembly.field_gradient import FieldGradient
from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.fold import FoldGuess, find_fold
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.input.tables import write_vectors
from magshell_fenicsx.models.shell.control_points import ControlledPattern
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.gradients.gradient import gradient
from magshell_fenicsx.simulate.perturbation import perturbed_scene
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import functional
from magshell_fenicsx.simulate.scene_cache import SceneCache
from magshell_fenicsx.simulate.steps import fold_at

Array = NDArray[np.float64]
ALONG = np.linspace(0, 1, 5)
PLACES = np.column_stack([ALONG, 0 * ALONG, 0 * ALONG])
VECTORS = np.column_stack([np.cos(2 * ALONG), 0 * ALONG, np.sin(2 * ALONG)])
CHANGE = np.random.default_rng(0).standard_normal((5, 3)) * [1, 0, 1]
STRIP = """
shell: {geometry: strip, radius_to_thickness: 100, width: 0.1, poisson_ratio: 0.2}
boundary: {root: clamped}
points: {tip: [1, 0, 0]}
magnetic:
  lambda_m: 3.3e-5
  remanent: {kind: points, file: B.csv, filter: 0.3}
  applied: {polar: 0}
mesh: {degree: 2}
"""


def by_difference(f: Callable[[float], float], step: float) -> float:
    """Of fourth order."""
    return (8 * (f(step) - f(-step)) - (f(2 * step) - f(-2 * step))) / (12 * step)


def with_values(scene: Scene, change: Array) -> Scene:
    """The scene with other vectors at the points of its remanence."""
    loads = scene.problem.loads
    assert loads.magnetic
    assert isinstance(loads.magnetic.remanent, ControlledPattern)
    other = replace(loads.magnetic.remanent, values=loads.magnetic.remanent.values + change)
    problem = replace(
        scene.problem, loads=replace(loads, magnetic=replace(loads.magnetic, remanent=other))
    )
    return Scene(problem)


def of_points(scene: Scene, found: object) -> Array:
    assert isinstance(found, FieldGradient)
    assert scene.problem.loads.magnetic
    remanent = scene.problem.loads.magnetic.remanent
    assert isinstance(remanent, ControlledPattern)
    return remanent.transposed(found.places, found.forces)


def solved(scene: Scene) -> Record:
    *_, last = follow(scene)
    return last


def at(scene: Scene, near: State) -> State:
    """The equilibrium at the amplitudes of a state near by, to rounding."""
    solution = scene.newton.solve(near, "lambda_m", PrescribedLoad("lambda_m", near.mu["lambda_m"]))
    assert solution.converged
    u, mu = solution.state.u, solution.state.mu
    return State(
        u - scene.newton.factor_at(solution.state).solve(scene.model.system.residual(u, mu)), mu
    )


def circle(x: Array) -> Array:
    """Half of one, of the strip's length."""
    return (
        np.column_stack([np.sin(np.pi * x[:, 0]), np.pi * x[:, 1], 1 - np.cos(np.pi * x[:, 0])])
        / np.pi
    )


@pytest.fixture
def strip(tmp_path: Path) -> Path:
    write_vectors(tmp_path / "B.csv", PLACES, VECTORS)
    (tmp_path / "strip.yaml").write_text(STRIP)
    return tmp_path / "strip.yaml"


@pytest.mark.parametrize("symmetry", ["auto", pytest.param("none", marks=pytest.mark.slow)])
def test_state_by_remanence_amplitude_and_number(strip: Path, symmetry: str) -> None:
    """Displacement, distance to a target and energy of a strip in a field, on half and whole
    shells.
    """
    case = Case.load(strip, [f"symmetry={symmetry}"])
    scene = Scene(case)
    last, before = solved(scene), scene.newton.factorisation.count
    one = with_values(scene, 0 * CHANGE)
    near, step = last.point.state, 1e-4
    others = {
        c: (moved, at(moved, near))
        for c in (-step, step)
        for moved in [with_values(scene, c * CHANGE)]
    }
    assert one.problem.is_half == scene.problem.is_half == (symmetry == "auto")
    for of in ("tip_uz", circle, "energy"):
        found = gradient(scene, last, of=of, by=["remanence"])["remanence"]

        back, ahead = (functional(*each, of).value for each in others.values())
        expected = (ahead - back) / (2 * step)
        assert np.sum(of_points(scene, found) * CHANGE) == pytest.approx(expected, rel=1e-6)
    assert scene.newton.factorisation.count <= before + 1  # for all results together
    key, ratio = "shell.poisson_ratio", 0.2
    found_numbers = gradient(scene, last, of="tip_ux", by=["lambda_m", key])

    def in_field(c: float) -> float:
        state = at(scene, near.with_(near.u, "lambda_m", 3.3e-5 * (1 + c)))
        return functional(scene, state, "tip_ux").value

    def softer(c: float) -> float:
        there = perturbed_scene(SceneCache(base=scene), key, ratio * (1 + c))
        return functional(there, at(there, near), "tip_ux").value

    assert found_numbers["lambda_m"] == pytest.approx(
        by_difference(in_field, 1e-2) / 3.3e-5, rel=1e-5
    )
    by_ratio = (softer(1e-3) - softer(-1e-3)) / (2e-3 * ratio)
    assert found_numbers[key] == pytest.approx(by_ratio, rel=1e-5)


def turning(a: Array) -> tuple[Array, Array]:
    return np.sin(3 * a), np.cos(2 * a)


def folded(
    tmp_path: Path, *settings: str, polar: Callable[[Array], tuple[Array, Array]] = turning
) -> Scene:
    """The dimpled hemisphere with a remanence that varies along its meridians."""
    angles = np.radians(np.linspace(0, 90, 7))
    places = np.column_stack([np.sin(angles), np.cos(angles)])
    write_vectors(tmp_path / "B.csv", places, np.column_stack(polar(angles)))
    remanent = f"{{kind: points, file: {tmp_path / 'B.csv'}, filter: 0.3}}"
    return Scene(
        Case.load(
            CASES / "dimple_buckling.yaml",
            [f"magnetic.remanent={remanent}", "magnetic.lambda_m=0.001", *settings],
        )
    )


HALF = ["symmetry=half", "mesh.degree=3", "mesh.refinement=0.3"]


@pytest.mark.parametrize(
    "settings",
    [pytest.param([], id="meridian"), pytest.param(HALF, id="half", marks=pytest.mark.slow)],
)
def test_fold_by_remanence_and_thickness(tmp_path: Path, settings: list[str]) -> None:
    """The knockdown factor; no factorisation but those of the fold."""
    scene = folded(tmp_path, *settings)
    last = solved(scene)
    fold = fold_at(scene, last)
    before = scene.newton.factorisation.count
    found = gradient(scene, last, of="instability", by=["remanence", "thickness"], fold=fold)
    assert scene.newton.factorisation.count == before
    change = np.random.default_rng(1).standard_normal((7, 2))

    def again(other: Scene) -> float:
        return find_fold(other.newton, FoldGuess(fold.state, fold.phi), "pressure").value

    expected = by_difference(lambda c: again(with_values(scene, c * change)), 0.02)
    assert np.sum(of_points(scene, found["remanence"]) * change) == pytest.approx(
        expected, rel=1e-5
    )

    def thicker(c: float) -> Scene:
        return Scene(replace(scene.problem, thickness=Thickness(lambda x, y, z: 1 + c * z**2)))

    thickness = found["thickness"]
    assert isinstance(thickness, FieldGradient)
    expected = by_difference(lambda c: again(thicker(c)), 0.01)
    assert thickness.along(thickness.places[..., 2:] ** 2) == pytest.approx(expected, rel=1e-5)


def test_neutral_wave(tmp_path: Path) -> None:
    """A wave around the axis that is neutral before the fold; its pressure found again."""
    settings = [
        "loading={kind: pressure, until: bifurcation, control: arc}",
        "shell.defect.amplitude=0.005",
    ]
    settings += ["shell.radius_to_thickness=20", "mesh.degree=3"]  # a short path
    scene = folded(tmp_path, *settings, polar=lambda a: (0.2 * np.sin(3 * a), 1 + 0 * a))
    change = np.random.default_rng(3).standard_normal((7, 2))
    wave = solved(scene)
    assert wave.mode.startswith("m = ")
    found = gradient(
        scene, wave, of="instability", by=["remanence", "lambda_m", "magnetic.lambda_m"]
    )
    back, ahead = (neutral(with_values(scene, c * change), wave) for c in (-1e-3, 1e-3))
    expected = (ahead - back) / 2e-3
    assert np.sum(of_points(scene, found["remanence"]) * change) == pytest.approx(
        expected, rel=1e-4
    )
    whole = np.sum(
        of_points(scene, found["remanence"]) * scene.problem.loads.magnetic.remanent.values
    )  # type: ignore[union-attr]
    assert found["lambda_m"] == pytest.approx(
        whole / 0.001, rel=1e-9
    )  # the energy is linear in both
    assert found["magnetic.lambda_m"] == pytest.approx(found["lambda_m"], rel=1e-6)


def test_force_at_a_depth(tmp_path: Path) -> None:
    """The depth stays, as the step controls it, and the force changes."""
    load = "{kind: indentation, at: {polar: 0}, depth: 1, points: 2}"
    scene = folded(tmp_path, f"loading={load}", "shell.radius_to_thickness=40")
    last, change = solved(scene), np.random.default_rng(2).standard_normal((7, 2))
    found = gradient(scene, last, of="force", by=["remanence"])["remanence"]
    expected = by_difference(
        lambda c: solved(with_values(scene, c * change)).point.state.mu["force"], 0.02
    )
    assert np.sum(of_points(scene, found) * change) == pytest.approx(expected, rel=1e-5)
    fixed = gradient(scene, last, of="w_over_h", by=["remanence"], hold={"force": "load"})[
        "remanence"
    ]
    soft = (
        np.sum(of_points(scene, fixed) * change) / -expected
    )  # dw/dp at F over -dF/dp at w: dw/dF
    assert soft == pytest.approx(
        gradient(scene, last, of="w_over_h", by=["force"], hold={})["force"], rel=1e-6
    )


@pytest.mark.parametrize(
    ("of", "by", "message"),
    [
        ("sideways", "remanence", "sideways: has no gradient here; allowed are energy, tip_ux"),
        ("lambda_m", "remanence", "lambda_m: is a load here"),
        (
            "tip_ux",
            "shell.width",
            "shell.width: a number of the mesh, of the shape, of a target or of the output",
        ),
        ("tip_ux", "magnetic.remanence", "magnetic.remanence: is no number"),
        ("tip_ux", "magnetic.lambda", r"magnetic.lambda: the case has no such key \(lambda\)"),
    ],
)
def test_mistakes(strip: Path, of: str, by: str, message: str) -> None:
    scene = Scene(Case.load(strip))
    start = next(iter(follow(scene)))
    with pytest.raises(CaseError, match=message):
        gradient(scene, start, of=of, by=[by])


def test_a_gas_has_numbers_of_its_own() -> None:
    """Its law has the classical pressure, which depends on Poisson's ratio; by other amplitudes
    there is a slope.
    """
    steps = [
        "{kind: pressure, control: load, until: target, pressure: 0.1, points: 1}",
        (
            "{kind: indentation, at: {polar: 0}, depth: 0.5, points: 1, "
            "hold: {pressure: {gas: {ambient_over_pc: 2}}}}"
        ),
    ]
    settings = [
        "shell.defect=null",
        f"loading=[{', '.join(steps)}]",
        "magnetic=null",
        "natural={curvature: 0.01}",
    ]
    scene = Scene(Case.load(CASES / "dimple_buckling.yaml", settings))
    *_, begin, last = follow(scene)
    assert (
        gradient(scene, last, of="force", by=["natural_curvature"], begin=begin)[
            "natural_curvature"
        ]
        != 0
    )
    with pytest.raises(
        CaseError, match=r"shell\.poisson_ratio: has no derivative while a gas is held"
    ):
        gradient(scene, last, of="force", by=["shell.poisson_ratio"], begin=begin)
