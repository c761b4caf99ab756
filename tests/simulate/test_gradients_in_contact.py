"""Gradients of shells that press on each other, against differences of runs solved again."""

import json
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command import magshell
from numpy.typing import NDArray

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.assembly.field_gradient import FieldGradient
from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.multi_shell import ShellPose
from magshell_fenicsx.models.shell.thickness import PlacedFactor, Thickness
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.gradients.gradient import gradient
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.results import functional
from magshell_fenicsx.simulate.scene_cache import problem_on_mesh_of

Array = NDArray[np.float64]
h, GAP = 0.02, 1.001 * (0.02 + 0.025) / 2  # between mid-surfaces of 1 and 1.25 h
STEP = 1e-4  # of a number
CAP = {
    "geometry": "cap",
    "radius": 1,
    "polar": 30,
    "thickness": h,
    "youngs_modulus": 1,
    "poisson_ratio": 0.3,
}
LOWER = {"shell": CAP, "boundary": {"rim": "clamped"}, "points": {"top": [0, 0, 1]}}
CAPS: dict[str, Any] = {
    "shells": {
        "lower": LOWER,
        "upper": {
            **LOWER, "shell": CAP | {"youngs_modulus": 2.0, "thickness": 0.025},
            "place": {"position": [0, 0, 2 + GAP], "axis": {"polar": 180}},
        },
    },
    "contact": [["upper", "lower"]],
    "mesh": {"degree": 3, "refinement": 0.5},
    "loading": {
        "kind": "edge", "name": "w", "control": "load", "factor": 0.5, "points": 1,
        "moves": [{"supports": ["upper.rim"], "translation": [0, 0, -2 * h]}],
    },
}  # fmt: skip
ARCH = {
    "geometry": "cylinder", "radius": 1, "length": 0.12, "azimuth": [60, 120], "thickness": h,
    "youngs_modulus": 1, "poisson_ratio": 0.3,
}  # fmt: skip
ARCHES: dict[str, Any] = {
    "shells": {
        "lower": {"shell": ARCH, "boundary": {"left": "clamped", "right": "clamped"},
                  "points": {"top": [0, 1, 0.06]}},
        "upper": {
            "shell": ARCH | {"youngs_modulus": 2.0, "thickness": 0.025},
            "boundary": {"left": "clamped", "right": "clamped"},
            "remanent": {"polar": 90, "azimuth": 90},
            "place": {"position": [0, 2 + GAP, 0], "turn": 180},
        },
    },
    "contact": [["upper", "lower"]],
    "magnetic": {"lambda_m": 5e-3, "applied": {"polar": 90, "azimuth": -90}},
    "mesh": {"size": 0.12, "degree": 2},
    "loading": {"kind": "field", "points": 1},
}  # fmt: skip
THICKER = "'thickness': 0.025"
THICKNESS, MODULUS = "shells.upper.shell.thickness", "shells.lower.shell.youngs_modulus"


def case(data: dict[str, Any], values: Mapping[str, float]) -> Case:
    """A case with other numbers."""
    data = deepcopy(data)
    for key, value in values.items():
        *sections, name = key.split(".")
        at = data
        for section in sections:
            at = at[section]
        at[name] = value
    return Case.from_source(data)


def solved(scene: Scene) -> Record:
    *_, last = follow(scene)
    return last


def by_difference(
    scene: Scene, data: dict[str, Any], key: str, value: float, results: Sequence[str]
) -> Array:
    """Of whole runs with other numbers."""

    def run(change: float) -> Array:
        other = Scene(problem_on_mesh_of(scene, case(data, {key: value * (1 + change)}).problem()))
        state = solved(other).point.state
        return np.array([functional(other, state, of).value for of in results])

    return np.asarray((run(STEP) - run(-STEP)) / (2 * STEP * value))


def ends_of(
    scene: Scene, last: Record, key: str, value: float, change: float
) -> list[tuple[Scene, State]]:
    """Both caps with a number that is larger and smaller, at the same load."""
    cases = (case(CAPS, {key: value * (1 + way * change)}) for way in (1, -1))
    scenes = (Scene(problem_on_mesh_of(scene, each.problem())) for each in cases)
    return [(other, held_at(other, last)) for other in scenes]


def test_on_meridians() -> None:
    """By the thickness of one shell, on which the gap and the penalty depend, and by a modulus.

    One factorisation for both.
    """
    scene = Scene(case(CAPS, {}))
    last = solved(scene)
    assert scene.model.axisymmetric
    assert scene.observe(last.point.state)["contact_force"] > 1
    before = scene.newton.factorisation.count
    found = gradient(scene, last, of="lower_top_uz", by=[THICKNESS, MODULUS])
    assert scene.newton.factorisation.count <= before + 1
    for key, value in ((THICKNESS, 0.025), (MODULUS, 1.0)):
        ahead, back = (
            functional(*end, "lower_top_uz").value for end in ends_of(scene, last, key, value, STEP)
        )
        assert found[key] == pytest.approx((ahead - back) / (2 * STEP * value), rel=1e-6), key


@pytest.mark.slow
def test_frequency_on_meridians() -> None:
    """By a modulus; a wave has no gradient where shells touch."""
    scene = Scene(case(CAPS, {}))
    last = solved(scene)
    with pytest.raises(
        CaseError, match=r"omega2_1: m = 1: has no gradient where shells touch \(upper and lower\)"
    ):
        gradient(scene, last, of="omega2_1", by="w")
    found = gradient(scene, last, of="omega2_2", by=[MODULUS])
    ahead, back = (lowest(*end) for end in ends_of(scene, last, MODULUS, 1.0, 1e-3))
    assert found[MODULUS] == pytest.approx((ahead - back) / 2e-3, rel=2e-5)


def with_remanence(scene: Scene, along: Callable[[Array], Array], c: float) -> Scene:
    """The scene whose remanence has a further part."""
    loads = scene.problem.loads
    assert loads.magnetic

    def remanent(r0: Array, n0: Array) -> Array:
        return np.asarray(np.array([0.0, -1.0, 0.0]) * np.cos(r0[..., :1]) + c * along(r0))

    magnetic = replace(loads.magnetic, remanent=remanent, patches=None)
    return Scene(replace(scene.problem, loads=replace(loads, magnetic=magnetic)))


def even(x: Array) -> Array:
    """As halves are in x, and on a meridian."""
    return np.asarray(np.cos(3 * x[..., 0]))


def smooth(x: Array) -> Array:
    """As halves are in x."""
    even = np.cos(3 * x[..., 0]) - 0.5 * x[..., 1]
    return np.stack([np.sin(2 * x[..., 0]), even, 0 * even], axis=-1)


@pytest.mark.slow
def test_half_of_two_arches() -> None:
    """By a thickness, the field and the remanence: displacements of the shell that is pressed, and
    the energy.
    """
    scene = Scene(case(ARCHES, {}))
    last = solved(scene)
    assert scene.problem.is_half
    assert scene.observe(last.point.state)["contact_force"] > 0.01
    results = ("lower_top_uy", "energy")
    found = [gradient(scene, last, of=of, by=[THICKNESS, "lambda_m"]) for of in results]
    for key, name, value in (
        (THICKNESS, THICKNESS, 0.025),
        ("magnetic.lambda_m", "lambda_m", 5e-3),
    ):
        expected = by_difference(scene, ARCHES, key, value, results)
        assert [each[name] for each in found] == pytest.approx(expected, rel=1e-6), name
    magnet = with_remanence(scene, smooth, 0.0)
    pressed = solved(magnet)
    assert magnet.observe(pressed.point.state)["contact_force"] > 0.01
    by_field = gradient(magnet, pressed, of="lower_top_uy", by="remanence")["remanence"]
    assert isinstance(by_field, FieldGradient)
    ahead, back = (with_remanence(scene, smooth, way * 1e-3) for way in (1, -1))
    values = [
        functional(each, solved(each).point.state, "lower_top_uy").value for each in (ahead, back)
    ]
    expected = (values[0] - values[1]) / 2e-3
    assert by_field.along(smooth(by_field.places)) == pytest.approx(expected, rel=1e-5)


def thicker(scene: Scene, c: float) -> Scene:
    """The scene with another thickness on the same mesh."""
    given = scene.problem.thickness or Thickness(patches={"lower": 1.0, "upper": 1.0})
    assert given.patches
    own = Thickness(lambda x, y, z: 1 + c * even(np.stack([x, y, z], axis=-1)))
    space = ShellPose(np.eye(3), np.zeros(3), 1.0)
    patches = {
        name: PlacedFactor(own, space, float(times)) for name, times in given.patches.items()
    }  # type: ignore
    return Scene(replace(scene.problem, thickness=replace(given, patches=patches)))


def deviated(scene: Scene, c: float, data: dict[str, Any]) -> Scene:
    """A new case on the same mesh: both shells deviate more, along their normals."""
    return Scene(problem_on_mesh_of(scene, Case.from_source(imperfect(data, c)).problem()))


def imperfect(data: dict[str, Any], c: float = 0.0) -> dict[str, Any]:
    """With deviations that are zero where the shells touch but for c, and a thickness that follows
    from them.
    """
    data = deepcopy(data)
    x, square = (
        ("x", "x**2 + y**2") if "magnetic" in data else ("sqrt(x**2 + y**2)", "x**2 + y**2 + z**2")
    )
    for each in data["shells"].values():
        flaws = [f"0.5*cos(5*{x}) - 0.5", f"{c!r}*cos(3*{x})"]
        each["shell"] |= {"imperfections": [{"kind": "formula", "w0": w0} for w0 in flaws]}
    data["shells"]["lower"]["shell"]["thickness_factor"] = f"1.5 - 0.5*({square})"
    return data


def with_same_cuts(scene: Scene, last: Record, other: Scene) -> State:
    """The equilibrium of another scene, whose points are those of the state of the first one."""
    (one,), (same,), state = (
        scene.model.shell_contacts,
        other.model.shell_contacts,
        last.point.state,
    )
    number = state.mu.get(one.pair.cuts, 0.0)
    points, normals = scene.model.system.at_state(state).evaluate(
        lambda: one._cuts.points(number, one._displacement())
    )
    area, its = (one._area_ratio(points, each._r0) for each in (one, same))
    same._cuts._latest_points[number] = replace(points, weight=points.weight * its / area), normals
    return held_at(other, last, "lambda_m")


def agrees(scene: Scene, last: Record, by: str, ends: list[tuple[Scene, State]]) -> None:
    """The derivatives of a displacement and the energy along `even`, by a difference: 1e-5."""
    for of in ("lower_top_uz" if scene.model.axisymmetric else "lower_top_uy", "energy"):
        found = gradient(scene, last, of=of, by=by)[by]
        assert isinstance(found, FieldGradient)
        upper = found.places[..., 2 if scene.model.axisymmetric else 1] > 1 + GAP / 3
        times = np.where(upper & (THICKER in str(scene.problem.document.data)), 1.25, 1.0)
        along = even(found.places) * times * (h if by == "deviation" else 1.0)
        values = [functional(*each, of).value for each in ends]
        assert found.along(along[..., None]) == pytest.approx(
            (values[0] - values[1]) / (2 * STEP), rel=1e-5
        ), (by, of)


@pytest.mark.slow
def test_by_fields_of_the_shape() -> None:
    """By the thickness of both arches, on which the gap depends, and by their place; the lower one
    is of rubber.
    """
    data = deepcopy(ARCHES)
    data["shells"]["lower"]["shell"] |= {"law": "neo-hookean", "poisson_ratio": 0.5}
    makes = {
        "thickness": (data, thicker),
        "deviation": (imperfect(data), partial(deviated, data=data)),
    }
    for name, (given, make) in makes.items():
        scene = Scene(Case.from_source(given))
        last = solved(scene)
        assert scene.observe(last.point.state)["contact_force"] > 0.01
        ends = [
            (made, with_same_cuts(scene, last, made))
            for made in (make(scene, way * STEP) for way in (1, -1))
        ]
        agrees(scene, last, name, ends)


@pytest.mark.slow
def test_ranks(tmp_path: Path) -> None:
    """A run's section `gradients` on 1 and 2 ranks, of a displacement and a frequency, by numbers
    and the shape.
    """
    asked = {"of": ["lower_top_uy", "omega2_1"], "by": [THICKNESS, "lambda_m", "deviation"]}
    data = imperfect(ARCHES) | {"gradients": asked, "symmetry": "none"}
    (tmp_path / "arches.yaml").write_text(yaml.safe_dump(data))
    found = list[dict[str, dict[str, Any]]]()
    for ranks in (1, 2):
        out = tmp_path / str(ranks)
        done = magshell("run", tmp_path / "arches.yaml", "--no-pictures", "--out", out, ranks=ranks)
        assert done.returncode == 0, done.stderr
        found.append(json.loads((out / "summary.json").read_text())["gradients"])
    for of in asked["of"]:
        one, two = (each[of] for each in found)
        assert two["numbers"] == pytest.approx(one["numbers"], rel=1e-6)
        assert two["fields"]["deviation"]["alike"] == pytest.approx(
            one["fields"]["deviation"]["alike"], rel=1e-6
        )


@pytest.mark.slow
@pytest.mark.parametrize("upper", [{}, {"thickness": h}])
def test_by_fields_on_meridians(upper: dict[str, Any]) -> None:
    """The same of two caps on their meridians, also where the thickness is no field in what was
    solved.
    """
    data = deepcopy(CAPS)
    data["shells"]["upper"]["shell"] |= upper
    makes = {
        "thickness": (data, thicker),
        "deviation": (imperfect(data), partial(deviated, data=data)),
    }
    for name, (given, make) in makes.items():
        scene = Scene(Case.from_source(given))
        last = solved(scene)
        ends = [
            (made, held_at(made, last)) for made in (make(scene, way * STEP) for way in (1, -1))
        ]
        agrees(scene, last, name, ends)


def held_at(scene: Scene, last: Record, name: str = "w") -> State:
    """The equilibrium of another scene at the same load."""
    state = last.point.state
    solution = scene.newton.solve(state, name, PrescribedLoad(name, state.mu[name]))
    assert solution.converged
    state = solution.state
    for _ in range(2):  # to rounding, for differences
        correction = scene.newton.factor_at(state).solve(
            -scene.model.system.residual(state.u, state.mu)
        )
        state = State(state.u + correction, state.mu)
    return state


def lowest(scene: Scene, state: State) -> float:
    """The lowest frequency that the model sees itself."""
    return next(
        mode.eigenvalue for mode in ShellModes(scene.model).vibrations(state, 6) if not mode.label
    )


@pytest.mark.slow
def test_frequencies_of_two_arches() -> None:
    """By a modulus, a thickness and a deviation: modes of solutions with the same cuts."""
    scene = Scene(Case.from_source(imperfect(ARCHES)))
    last = solved(scene)
    found = gradient(scene, last, of="omega2_2", by=[MODULUS, THICKNESS, "deviation"])
    of_shape = found["deviation"]
    assert isinstance(of_shape, FieldGradient)
    times = np.where(of_shape.places[..., 1] > 1 + GAP / 3, 1.25, 1.0)

    def at(change: float, key: str = "", value: float = 0.0) -> float:
        data = imperfect(ARCHES, 0.0 if key else change)
        made = Scene(
            problem_on_mesh_of(scene, case(data, {key: value + change} if key else {}).problem())
        )
        return lowest(made, with_same_cuts(scene, last, made))

    expected = (at(1e-4, MODULUS, 1.0) - at(-1e-4, MODULUS, 1.0)) / 2e-4
    assert found[MODULUS] == pytest.approx(expected, rel=1e-5)
    expected = (at(1e-6, THICKNESS, 0.025) - at(-1e-6, THICKNESS, 0.025)) / 2e-6
    assert found[THICKNESS] == pytest.approx(expected, rel=1e-5)
    along = (h * times * even(of_shape.places))[..., None]
    assert of_shape.along(along) == pytest.approx(
        (at(1e-5) - at(-1e-5)) / 2e-5, rel=3e-4
    )  # it nearly cancels
