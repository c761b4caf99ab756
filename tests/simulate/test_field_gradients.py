"""Thickness, natural curvature and deviation as fields: against differences of states and folds
solved again.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import CASES
from numpy.typing import NDArray
from scipy.optimize import newton

from magshell_fenicsx.assembly.field_gradient import FieldGradient
from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.fold import FoldGuess, find_fold
from magshell_fenicsx.continuation.modes import nearest_to_zero
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.parts.natural.planned import frame
from magshell_fenicsx.parts.natural.shape import Natural
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.gradients.gradient import gradient
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import functional
from magshell_fenicsx.simulate.sensitivity import with_deviation
from magshell_fenicsx.simulate.steps import fold_at

Array = NDArray[np.float64]
FIELDS = ("thickness", "curvature", "deviation")
STRIP = """
shell:
  geometry: strip
  radius_to_thickness: 100
  width: 0.1
  poisson_ratio: 0.2
  imperfections: [{kind: formula, w0: x**2*(1 - x)}]
boundary: {root: clamped}
points: {tip: [1, 0, 0]}
magnetic: {lambda_m: 3.3e-5, remanent: {polar: 60}, applied: {polar: 0}}
natural: {curvature: [0.2*x, 0.1, 0]}
mesh: {degree: 2, refinement: 0.4}
"""


def by_difference(f: Callable[[float], float], step: float) -> float:
    """Of fourth order."""
    return (8 * (f(step) - f(-step)) - (f(2 * step) - f(-2 * step))) / (12 * step)


class Direction:
    """A random smooth change of a field; even in y, as halves are, and the same along every
    meridian.
    """

    def __init__(self, seed: int, *, around: bool = False) -> None:
        self._a, self._around = np.random.default_rng(seed).standard_normal((3, 4)), around

    def __call__(self, x: Array, component: int = 0) -> Array:
        a, b, c, d = self._a[component]
        s = np.hypot(x[..., 0], x[..., 1]) ** 2 if self._around else x[..., 0]
        return np.asarray(a + b * s + c * np.sin(4 * s) + d * x[..., 2] ** 2)


def changed(scene: Scene, name: str, along: Direction, c: float) -> Scene:
    """The scene with another field, on the same mesh."""
    problem = scene.problem
    if name == "deviation":
        return with_deviation(scene, lambda x: c * along(x) * problem.material.h)
    if name == "thickness":
        one = Thickness(lambda x, y, z: 1 + c * along(np.stack([x, y, z], axis=-1)))
        return Scene(replace(problem, thickness=one))
    natural = problem.loads.natural or Natural(
        np.zeros(3), None, frame(scene.problem.context, problem.azimuth)
    )
    drawn = natural.curvature

    def curvature(r0: Array, n0: Array) -> Array:
        known = drawn(r0, n0) if callable(drawn) else np.asarray(drawn)
        return np.asarray(
            known + c * np.stack([along(r0, i) for i in range(3)], axis=-1) * [1, 1, 0]
        )

    other = Natural(curvature, natural.stretch, natural.along)
    return Scene(replace(problem, loads=replace(problem.loads, natural=other)))


def directional(scene: Scene, found: object, name: str, along: Direction) -> float:
    assert isinstance(found, FieldGradient)
    if name == "curvature":
        return found.along(
            np.stack([along(found.places, i) for i in range(3)], axis=-1) * [1, 1, 0]
        )
    unit = scene.problem.material.h if name == "deviation" else 1.0
    return found.along(unit * along(found.places)[..., None])


def solved(scene: Scene) -> Record:
    *_, last = follow(scene)
    return last


def state_with(
    scene: Scene, last: Record, name: str, along: Direction, c: float
) -> tuple[Scene, State]:
    """The state at the same loads with another field, by Newton's method from that without."""
    other = changed(scene, name, along, c)
    near = State(last.point.state.u, {"natural_curvature": 1.0, **last.point.state.mu})
    solution = other.newton.solve(near, "lambda_m", PrescribedLoad("lambda_m", near.mu["lambda_m"]))
    assert solution.converged
    return other, solution.state


@pytest.mark.slow
@pytest.mark.parametrize("symmetry", ["auto", "none"])
def test_state(tmp_path: Path, symmetry: str) -> None:
    """The displacement and the energy of a strip in a field, of half and whole shells."""
    (tmp_path / "strip.yaml").write_text(STRIP)
    scene = Scene(Case.load(tmp_path / "strip.yaml", [f"symmetry={symmetry}"]))
    last = solved(scene)
    assert scene.problem.is_half == (symmetry == "auto")
    found = {of: gradient(scene, last, of=of, by=FIELDS) for of in ("tip_uz", "energy")}
    for seed, name in enumerate(FIELDS):
        along = Direction(seed)
        step = {"thickness": 2e-3, "curvature": 1e-2, "deviation": 1e-2}[name]
        states = {c: state_with(scene, last, name, along, c * step) for c in (-2, -1, 1, 2)}
        for of, by in found.items():
            values = {c: functional(*each, of).value for c, each in states.items()}
            expected = by_difference(values.__getitem__, 1) / step
            assert directional(scene, by[name], name, along) == pytest.approx(expected, rel=1e-5), (
                name,
                of,
            )


def test_reaction(tmp_path: Path) -> None:
    """The forces of a strip's two supports: against states again, and no load but theirs lets them
    sum to zero.
    """
    (tmp_path / "strip.yaml").write_text(STRIP.replace("tip:", "end:"))
    settings = [
        "boundary={root: clamped, tip: {held: [z]}}",
        "reactions=true",
        "magnetic.remanent.polar=75",
    ]
    scene, along, step = Scene(Case.load(tmp_path / "strip.yaml", settings)), Direction(0), 2e-3
    last = solved(scene)
    fields = ("thickness", "deviation")
    found = {
        of: gradient(scene, last, of=of, by=[*fields, "lambda_m"]) for of in ("root_fz", "tip_fz")
    }
    states = {c: state_with(scene, last, "thickness", along, c * step) for c in (-2, -1, 1, 2)}
    for of, by in found.items():
        assert functional(scene, last.point.state, of).value == pytest.approx(
            scene.observe(last.point.state)[of]
        )
        expected = (
            by_difference(
                {c: functional(*each, of).value for c, each in states.items()}.__getitem__, 1
            )
            / step
        )
        assert directional(scene, by["thickness"], "thickness", along) == pytest.approx(
            expected, rel=1e-6
        ), of
    for name in fields:
        root, tip = (directional(scene, by[name], name, Direction(3)) for by in found.values())
        assert root == pytest.approx(-tip, rel=1e-6), name
    assert found["root_fz"]["lambda_m"] == pytest.approx(-found["tip_fz"]["lambda_m"], rel=1e-6)


def test_cost(tmp_path: Path) -> None:
    """At most one factorisation more than the state's own, for all of a thousand parameters."""
    (tmp_path / "strip.yaml").write_text(STRIP)
    scene = Scene(Case.load(tmp_path / "strip.yaml", ["mesh.refinement=1.2"]))
    last = solved(scene)
    before = scene.newton.factorisation.count
    found = gradient(scene, last, of="tip_uz", by=["remanence"])["remanence"]
    assert isinstance(found, FieldGradient)
    assert found.forces.size > 1000
    assert scene.newton.factorisation.count <= before + 1


FIELD = "magnetic.lambda_m=0.001"
HALF = [FIELD, "symmetry=half", "mesh.degree=3", "mesh.refinement=0.3"]


@pytest.mark.parametrize(
    "settings",
    [pytest.param([FIELD], id="meridian"), pytest.param(HALF, id="half", marks=pytest.mark.slow)],
)
def test_fold(settings: list[str]) -> None:
    """The knockdown factor of the dimpled hemisphere; no factorisation but those of the fold."""
    scene = Scene(Case.load(CASES / "dimple_buckling.yaml", settings))
    last = solved(scene)
    fold = fold_at(scene, last)
    before = scene.newton.factorisation.count
    found = gradient(
        scene, last, of="instability", by=(*FIELDS, "remanence", "magnitude", "lambda_m"), fold=fold
    )
    assert scene.newton.factorisation.count == before
    mu = {"natural_curvature": 1.0, **fold.state.mu}
    for seed, name in enumerate(FIELDS):
        along = Direction(seed, around=True)
        step = {"thickness": 5e-3, "curvature": 2e-2, "deviation": 5e-3}[name]

        def again(c: float, name: str = name, along: Direction = along) -> float:
            other = changed(scene, name, along, c)
            return find_fold(
                other.newton, FoldGuess(State(fold.state.u, mu), fold.phi), "pressure"
            ).value

        expected = by_difference(again, step)
        assert directional(scene, found[name], name, along) == pytest.approx(expected, rel=1e-4), (
            name
        )
    factor = found["magnitude"]
    assert isinstance(factor, FieldGradient)
    assert factor.along(np.ones_like(factor.forces)) == pytest.approx(
        0.001 * found["lambda_m"], rel=1e-8
    )


def neutral(scene: Scene, wave: Record) -> float:
    """The pressure at which the wave of a record near by is neutral, by the secant's rule."""
    m, near = int(wave.mode.removeprefix("m = ")), wave.point.state

    def stiffness(pressure: float) -> float:
        solution = scene.newton.solve(near, "pressure", PrescribedLoad("pressure", pressure))
        assert solution.converged
        return nearest_to_zero(scene.model.waves.factor_at(solution.state, m))[0]

    first = near.mu["pressure"]
    return float(newton(stiffness, first, x1=1.0001 * first, tol=1e-11))


@pytest.mark.slow
def test_neutral_wave() -> None:
    """A wave around the axis, found again where all fields change together."""
    path = "loading={kind: pressure, until: bifurcation, control: arc}"
    settings = [
        FIELD,
        path,
        "shell.radius_to_thickness=20",
        "shell.defect.amplitude=0.005",
        "mesh.degree=3",
    ]
    settings += ["natural={curvature: 0.02}"]
    scene = Scene(Case.load(CASES / "dimple_buckling.yaml", settings))
    wave = solved(scene)
    assert wave.mode.startswith("m = ")
    found = gradient(scene, wave, of="instability", by=FIELDS)
    along = {name: Direction(seed, around=True) for seed, name in enumerate(FIELDS)}

    def again(c: float) -> float:
        other = scene
        for name in FIELDS:
            other = changed(other, name, along[name], c)
        return neutral(other, wave)

    expected = (again(1e-3) - again(-1e-3)) / 2e-3
    total = sum(directional(scene, found[name], name, along[name]) for name in FIELDS)
    assert total == pytest.approx(expected, rel=1e-4)
