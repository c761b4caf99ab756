"""Gradients by keys of a case against differences of whole runs of cases with another number, on
the same mesh.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
import yaml

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.section import si_size
from magshell_fenicsx.input.source import CaseError, Source, override
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.adapt.ending import History
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint
from magshell_fenicsx.simulate.gradients.gradient import derivative
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS, instabilities
from magshell_fenicsx.simulate.gradients.results import adjoint_at_end
from magshell_fenicsx.simulate.perturbation import number_at_key
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene_cache import problem_on_mesh_of

CAP = """
shell:
  geometry: cap
  radius: 20 mm
  thickness: 0.4 mm
  polar: 60
  youngs_modulus: 1 MPa
  poisson_ratio: 0.45
  density: 1200 kg/m^3
  imperfections: [{kind: dimple, amplitude: 0.2 mm, width: 5 mm}, \
{kind: gaussian, amplitude: -0.3, width: 4}]
boundary: {rim: clamped}
points: {A: [0, 0, 20 mm]}
mesh: {degree: 3}
"""
STATE = """
foundation: {stiffness: 20 kPa/mm}
natural: {curvature: 5/m}
magnetic: {remanent: {flux_density: 80 mT}, applied: {flux_density: 10 mT}}
loading:
  - {kind: natural, curvature: 1, points: 1}
  - {kind: field, points: 1}
  - {kind: pressure, control: load, until: target, pressure: 20 Pa, points: 1}
  - {kind: indentation, at: {polar: 0}, depth: 0.1 mm, points: 1}
reactions: true
"""
PRESSED = """
magnetic:
  remanent: {flux_density: 80 mT}
  applied:
    sources: [{kind: cylinder, diameter: 20 mm, height: 10 mm, polarization: 1.2 T, \
position: [0, 0, -15 mm]}]
bodies: {ball: {kind: sphere, radius: 8 mm, at: {polar: 0}, stiffness: 1.0e+6}}
loading: [{kind: field, points: 1}, {kind: contact, approach: 0.6 mm, points: 1}]
"""
HELD = PRESSED.replace("approach: 0.6 mm", "force: 5 mN")  # by arc length to a target of the force
BUCKLED = """
magnetic: {remanent: {flux_density: 80 mT}, applied: {flux_density: 10 mT}}
loading: {kind: pressure, until: limit}
"""
SEALED = STATE.replace(
    "depth: 0.1 mm, points: 1}", "depth: 0.1 mm, points: 1, hold: {pressure: conjugate}}"
)
GAS = SEALED.replace("pressure: conjugate", "pressure: {gas: {ambient: 100 Pa}}")
AGAIN = (
    "  - {kind: field, factor: 1.5, points: 1, hold: {pressure: HELD, force: conjugate}}\n"
    "reactions: true\n"
)
CHAIN = SEALED.replace("reactions: true\n", AGAIN.replace("HELD", "conjugate"))
LEFT = """
magnetic: {remanent: {flux_density: 80 mT}, applied: {flux_density: 10 mT}}
loading: [{kind: indentation, at: {polar: 0}, depth: 0.1 mm, points: 1}, {kind: field, points: 1}]
"""  # the force of the first step stays, which follows from its depth
CASES = {
    "left": LEFT,
    "chain": CHAIN,
    "gas": GAS,
    "state": STATE,
    "pressed": PRESSED,
    "held": HELD,
    "buckled": BUCKLED,
}
RESULTS = {
    "left": ("A_uz", "energy"),
    "chain": ("force_N", "pressure_Pa", "rim_fz"),
    "gas": ("force_N", "pressure_Pa"),
    "state": ("force_N", "energy", "rim_fz"),
    "pressed": ("force_N", "A_uz", "energy"),
    "held": ("A_uz", "approach"),
    "buckled": ("knockdown", "buckling_pressure_Pa"),
}
KEYS = {
    "left": {"shell.poisson_ratio": ""},
    "chain": {"shell.poisson_ratio": "", "shell.thickness_factor": ""},
    "gas": {"magnetic.remanent.flux_density": "mT", "shell.thickness_factor": ""},
    "state": {"shell.poisson_ratio": "", "shell.thickness": "mm", "foundation.stiffness": "kPa/mm"},
    "pressed": {
        "shell.poisson_ratio": "",
        "shell.thickness": "mm",
        "shell.thickness_factor": "",
        "bodies.ball.radius": "mm",
    },
    "held": {"shell.poisson_ratio": ""},
    "buckled": {"shell.poisson_ratio": "", "shell.thickness": "mm"},
}
EXACT = {
    "left": 1e-5,
    "chain": 5e-6,
    "gas": 5e-6,
    "state": 1e-6,
    "buckled": 1e-5,
    "pressed": 2e-4,
    "held": 2e-4,
}  # a penalty has kinks where points begin to press
FIELD, STEP = "shell.thickness_factor", 1e-4  # of a number


def case_of(name: str, settings: Sequence[str] = ()) -> Case:
    source = Source(name, yaml.safe_load(CAP + CASES[name]))
    if name in ("pressed", "held"):  # the edge of a dimple would be a further kink
        source.data["shell"]["imperfections"] = [{"kind": "gaussian", "amplitude": 0.5, "width": 2}]
    for setting in settings:
        override(source, setting)
    return Case.from_source(source)


def run(scene: Scene) -> tuple[Scene, list[Record], History]:
    records, history = list(follow(scene)), History()
    for record in records:
        history.add(record)
    return scene, records, history


def adjoint(ran: tuple[Scene, list[Record], History], of: str) -> Adjoint:
    scene, records, history = ran
    return (
        instabilities(scene, records, of, 1, history.begins)[0][1]
        if of in FOLDS
        else adjoint_at_end(scene, history, of)[1]
    )


@cache
def given(name: str) -> tuple[tuple[Scene, list[Record], History], dict[str, Adjoint]]:
    """The run of a case, and the adjoints of its results."""
    ran = run(Scene(case_of(name)))
    return ran, {of: adjoint(ran, of) for of in RESULTS[name]}


@pytest.mark.slow
@pytest.mark.parametrize("name", KEYS)
def test_numbers(name: str) -> None:
    """Imperfections in both kinds of units, targets with units, stiffnesses of parts, and bodies
    follow their numbers.

    All change together, each by its own part.
    """
    (scene, *_), found = given(name)
    values = {
        key: 1.0 if key == FIELD else number_at_key(scene.problem.context, key)
        for key in KEYS[name]
    }
    parts = dict(zip(values, (1.0, -0.7, 0.5, 1.3), strict=False))
    results = dict[int, dict[str, float]]()
    for way in (-1, 1):
        settings = list[str]()
        for key, unit in KEYS[name].items():
            number = values[key] * (1 + way * parts[key] * STEP) / si_size(unit)
            quoted = unit or key == FIELD
            settings.append(
                f'{key}="{number!r}{" " * bool(unit)}{unit}"' if quoted else f"{key}={number!r}"
            )
        ran = run(Scene(problem_on_mesh_of(scene, case_of(name, settings).problem()), scene.comm))
        results[way] = {of: adjoint(ran, of).value_in_unit for of in found}
    for of, each in found.items():
        total = 0.0
        for key, value in values.items():
            slope = derivative(each, "thickness" if key == FIELD else key)
            if not isinstance(slope, float):
                slope = float(slope.within(np.ones(len(slope.forces), dtype=bool))[0])
            total += slope * value * parts[key]
        expected = (results[1][of] - results[-1][of]) / (2 * STEP)
        assert total == pytest.approx(
            expected, rel=EXACT[name], abs=1e-6 * abs(each.value_in_unit)
        ), of


@pytest.mark.slow
def test_frequencies_where_a_body_touches() -> None:
    """They have no gradient there; where the body is apart they have one."""
    apart = [
        "bodies.ball={kind: sphere, radius: 8 mm, position: [0, 0, 40 mm]}",
        "loading=[{kind: field, points: 1}]",
    ]
    ran = {settings: run(Scene(case_of("pressed", settings))) for settings in ((), tuple(apart))}
    with pytest.raises(
        CaseError, match=r"omega2_1: has no gradient where a body touches the shell \(ball\)"
    ):
        adjoint(ran[()], "omega2_1")
    assert adjoint(ran[tuple(apart)], "omega2_1").value > 0


@pytest.mark.slow
def test_a_conjugate_held_beside_a_body() -> None:
    """The volume is held from the first contact on, which is not the state before the step."""
    pressed = "{kind: pressure, control: load, until: target, pressure: 20 Pa, points: 1}"
    steps = (
        f"[{pressed}, {{kind: contact, approach: 0.3 mm, points: 1, "
        "hold: {pressure: conjugate}}]"
    )
    of_volume = adjoint(run(Scene(case_of("pressed", [f"loading={steps}"]))), "A_uz")
    with pytest.raises(
        CaseError, match=r"shell\.poisson_ratio: has no derivative where a conjugate is held beside"
    ):
        derivative(of_volume, "shell.poisson_ratio")
    assert derivative(of_volume, "bodies.ball.radius") != 0


def test_modes_of_the_perfect_shell_change() -> None:
    """They are found again in every run."""
    case = case_of("buckled", ["shell.imperfections=[{kind: modes, amplitudes: [0.1]}]"])
    with pytest.raises(CaseError, match=r"shell\.poisson_ratio: the modes of the perfect shell"):
        number_at_key(case.context, "shell.poisson_ratio")
