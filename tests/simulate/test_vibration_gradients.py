"""Gradients of natural frequencies and of energy barriers, against differences of what is solved
again.
"""

from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import CASES
from test_field_gradients import (
    FIELDS,
    STRIP,
    Direction,
    by_difference,
    changed,
    directional,
    solved,
    state_with,
)

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.control import BorderedMatrix, PrescribedConjugate
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.public import Scene
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.simulate.adapt.ending import History
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.gradients.gradient import gradient
from magshell_fenicsx.simulate.gradients.vibration import frequency, vibration
from magshell_fenicsx.simulate.perturbation import perturbed_scene
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import barrier
from magshell_fenicsx.simulate.scene_cache import SceneCache

VOLUME = (
    "loading={kind: pressure, control: volume, until: target, volume_change: -0.004, points: 1}"
)


def omega2(scene: Scene, record: Record, name: str) -> float:
    return vibration(scene, record.point.state, name).value


@pytest.mark.parametrize("symmetry", ["auto", pytest.param("none", marks=pytest.mark.slow)])
def test_strip(tmp_path: Path, symmetry: str) -> None:
    """The first bending and, of the whole strip, the first torsion of a strip that a field has
    bent.
    """
    (tmp_path / "strip.yaml").write_text(STRIP)
    scene = Scene(Case.load(tmp_path / "strip.yaml", [f"symmetry={symmetry}"]))
    last = solved(scene)
    names = ["omega2_1"] if symmetry == "auto" else ["omega2_1", "omega2_2"]
    fields = FIELDS[:1] if symmetry == "auto" else FIELDS[1:]
    found = {name: gradient(scene, last, of=name, by=fields) for name in names}
    for seed, field in enumerate(fields, FIELDS.index(fields[0])):
        # by a deviation omega2 changes little: shorter steps show rounding, 1e-5 at 0.05
        along, step = (
            Direction(seed),
            {"thickness": 1e-2, "curvature": 5e-2, "deviation": 0.4}[field],
        )
        states = {c: state_with(scene, last, field, along, c * step) for c in (-2, -1, 1, 2)}
        for name in names:
            values = {c: vibration(*each, name).value for c, each in states.items()}
            expected = by_difference(values.__getitem__, 1) / step
            assert directional(scene, found[name][field], field, along) == pytest.approx(
                expected, rel=1e-5
            ), name


def at_volume(scene: Scene, near: State) -> State:
    """The equilibrium with the volume that the step prescribes, by Newton's method from a state
    near by.
    """
    volume = PrescribedConjugate(
        scene.model.system, "pressure", -0.004 * scene.conjugate_unit("pressure")
    )
    solution = scene.newton.solve(near, "pressure", volume)
    assert solution.converged
    system, state = scene.model.system, solution.state
    last = BorderedMatrix(
        system, scene.newton.factor_at(state), state, "pressure", volume
    )  # to rounding
    du, dp = last.solve(-system.residual(state.u, state.mu), -volume.residual(state))
    return state.with_(state.u + du, "pressure", state.mu["pressure"] + dp)


@pytest.mark.slow
def test_meridian() -> None:
    """A wave and m = 0 of the dimpled hemisphere in a field, its volume held, by thickness,
    amplitude and number.
    """
    coarse = ["mesh.refinement=0.5"]
    settings = ["magnetic.lambda_m=0.001", "shell.poisson_ratio=0.45", VOLUME, *coarse]
    scene, along = (
        Scene(Case.load(CASES / "dimple_buckling.yaml", settings)),
        Direction(3, around=True),
    )
    last = solved(scene)
    labels = [mode.label for mode in ShellModes(scene.model).vibrations(last.point.state, 12)]
    key, step = "shell.poisson_ratio", 4e-3
    thicker = {c: changed(scene, "thickness", along, c * step) for c in (-2, -1, 1, 2)}
    softer = {
        c: perturbed_scene(SceneCache(base=scene), key, 0.45 + c * step) for c in (-2, -1, 1, 2)
    }
    states = {
        id(one): at_volume(one, last.point.state) for one in (*thicker.values(), *softer.values())
    }
    for label in ("m = 1", ""):
        name = f"omega2_{labels.index(label) + 1}"
        found = gradient(
            scene, last, of=name, by=["thickness", "lambda_m", "magnetic.lambda_m", key]
        )

        def differences(scenes: dict[int, Scene], name: str = name) -> float:
            values = {c: vibration(one, states[id(one)], name).value for c, one in scenes.items()}
            return by_difference(values.__getitem__, 1) / step

        assert directional(scene, found["thickness"], "thickness", along) == pytest.approx(
            differences(thicker), rel=1e-5
        )
        assert found[key] == pytest.approx(differences(softer), rel=1e-5), label
        assert found["lambda_m"] == pytest.approx(found["magnetic.lambda_m"], rel=1e-7), label


def test_hertz(tmp_path: Path) -> None:
    """Of a strip of silicone: a frequency is inversely proportional to the root of the density."""
    (tmp_path / "strip.yaml").write_text(STRIP)
    shell = {
        "radius": "30 mm",
        "thickness": "0.3 mm",
        "youngs_modulus": "1.2 MPa",
        "density": "1100 kg/m^3",
    }
    settings = [f"shell.{key}={value}" for key, value in shell.items()]
    scene = Scene(
        Case.load(
            tmp_path / "strip.yaml",
            [
                "shell.radius_to_thickness=null",
                "points.tip=[30 mm, 0, 0]",
                "shell.imperfections=[]",
                *settings,
            ],
        )
    )
    last = solved(scene)
    found = gradient(scene, last, of="hertz_1", by=["shell.density", "lambda_m"])
    hertz = frequency(scene.problem, "hertz_1", omega2(scene, last, "omega2_1"))
    assert found["shell.density"] == pytest.approx(-hertz / 2 / 1100, rel=1e-7)
    by_square = gradient(scene, last, of="omega2_1", by=["lambda_m"])["lambda_m"]
    assert found["lambda_m"] == pytest.approx(
        by_square * hertz / (2 * omega2(scene, last, "omega2_1")), rel=1e-9
    )


@pytest.mark.slow
@pytest.mark.parametrize("hold", ["load", "conjugate"])
def test_barrier(hold: str) -> None:
    """The barrier of a probed spherical shell, at its pressure or its volume, by thickness and
    Poisson's ratio.
    """
    file = CASES / "probing.yaml"
    case = Case.load(
        file,
        ["shell.radius_to_thickness=40", f"loading.1.hold.pressure={hold}", "loading.0.points=1"],
    )
    scene, along, step = Scene(case), Direction(3, around=True), 3e-4
    history = history_of(scene)
    begin, end = history.begin, history.last
    assert end
    key = "shell.poisson_ratio"
    found = gradient(scene, end, of="barrier", by=["thickness", key], begin=begin)

    def differences(scene_of: Callable[[float], Scene]) -> float:
        return (barrier_of(scene_of(step)) - barrier_of(scene_of(-step))) / (2 * step)

    by_thickness = directional(scene, found["thickness"], "thickness", along)
    expected = differences(lambda c: changed(scene, "thickness", along, c))
    assert by_thickness == pytest.approx(expected, rel=1e-5)
    assert found[key] == pytest.approx(
        differences(lambda c: perturbed_scene(SceneCache(base=scene), key, 0.3 + c)), rel=1e-5
    )


def history_of(scene: Scene) -> History:
    found = History()
    for record in follow(scene):
        found.add(record)
    return found


def barrier_of(scene: Scene) -> float:
    found = history_of(scene)
    assert found.begin
    assert found.last
    return barrier(
        scene, scene.problem.programme[-1], found.begin.point.state, found.last.point.state
    )
