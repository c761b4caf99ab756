"""What a user reads who makes the mistakes of the first day: one message with place, key, value and
what is allowed.
"""

from pathlib import Path

import pytest

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError

CAP = """\
shell:
  geometry: cap
  radius: 40 mm
  thickness: 0.5 mm
  polar: 45
  youngs_modulus: 1.3 MPa
  poisson_ratio: 0.49
boundary: {rim: clamped}
magnetic:
  remanent: {flux_density: 60 mT}
  applied:
    sources:
      - {kind: cylinder, diameter: 10 mm, height: 10 mm, polarization: 1.2 T, \
position: [0, 0, -60 mm]}
loading: {kind: pressure, control: arc, until: target, pressure: 100 Pa}
"""
MAGNET = "magnetic.applied.sources.0"
DEFECTS = "count: 1, amplitude: 1, width: 1, polar: [0, 10]"
MISTAKES = [
    # a wrong shell is no reason to complain of a target with a unit
    ("shell.polar=200", "shell.polar: 200: must be less than or equal to 179"),
    (
        "loading={kind: dead, loads: [{at: A, force: [0, 0, 1 mN]}], factor: 1}",
        "loading.loads.0.at: A: name it in points",
    ),
    (
        "loading={kind: indentation, at: {point: A}, depth: 1}",
        "loading.at.point: A: name it in points, with its place; ",
    ),
    (
        "bodies={ball: {kind: sphere, radius: 6 mm, at: {polar: 50}}}",
        "bodies.ball.at.polar: 50 is not on the shell",
    ),
    (
        "shell={geometry: disc, radius: 1, thickness: 0.02, poisson_ratio: 0.3}",
        "shell: radius and thickness: give each a unit, or radius_to_thickness: 50 in their place",
    ),
    (
        "shell.thickness=0.5",
        "cap.yaml:1: shell: give every length and youngs_modulus a unit, or none of them: thick",
    ),
    (
        "shell.youngs_modulus=1.3 mPa",
        "shell.youngs_modulus: '1.3 mPa': allowed are 1 Pa to 1e13 Pa (MPa: megapascal",
    ),
    (
        f"{MAGNET}.polarization=1.2",
        f'{MAGNET}.polarization: 1.2: needs a unit, for example "60 mT"',
    ),
    (
        f"{MAGNET}.polarization=[1 T, 2, 3 T]",
        f'{MAGNET}.polarization.1: 2: needs a unit, for example "60 mT"',
    ),
    (
        f"{MAGNET}.position=[60 mm, 0]",
        f"{MAGNET}.position: ['60 mm', 0]: must have at least 3 items, not 2",
    ),
    (
        "magnetic.applied.sources.1.height=1",
        "magnetic.applied.sources.1: the list has items 0 to 0",
    ),
    (
        "loading={kind: pressure, on: upper}",
        "loading.on: 'upper': must be a mapping, as {upper: outside} (Name of one",
    ),
    ("points=[tip]", "points: ['tip']: must be a mapping, as {tip: ...} (Name -> place"),
    (
        f"ensemble={{defects: {{{DEFECTS}, on: [upper]}}}}",
        "ensemble.defects.on: ['upper']: must be a valid string (Name of one of several",
    ),
    (
        "shell.thickness_factor=[2]",
        "shell.thickness_factor: [2]: must be a valid string (Multiplies h)",
    ),
    (
        'magnetic.remanent={kind: expression, flux_density: 60 mT, components: ["x", "y", "q"]}',
        "magnetic.remanent.components.2: 'q': allowed are numbers, x, y, z",
    ),
    (
        "loading={kind: pressure, control: volume, until: target, pressure: 100 Pa}",
        (
            "loading: until: target with control: volume needs volume_change (and nothing else) "
            "as target; control: arc"
        ),
    ),
    # the words of a key that a kind or a law has are not cut at the colon of the kind
    (
        "joints=[{edges: [a.rim, b.rim], kind: spring, stiffness: 1 N, angle: 60 deg}]",
        "angle: '60 deg': must be a valid number (the angle at which it rests, in degree)",
    ),
    (
        "shell.mu=30 kPa",
        "must be a list, in brackets (the modulus of each term (neo-Hookean takes youngs_modulus "
        "E = 3 mu))",
    ),
    ("shell.mooney=soft", "(C01/C10 of law: mooney-rivlin)"),
    # a missing key of a law is not a misplaced one
    ("shell.law=mooney-rivlin", "cap.yaml:1: shell: law: mooney-rivlin needs mooney"),
    ("shell.law=ogden", "cap.yaml:1: shell: law: ogden needs mu and alpha"),
    ("shell.mooney=0.1", "C01/C10 belongs to law: mooney-rivlin, and only to it"),
]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "cap.yaml"
    path.write_text(CAP, encoding="utf-8")
    return path


@pytest.mark.parametrize(("setting", "said"), MISTAKES)
def test_one_clear_message(file: Path, setting: str, said: str) -> None:
    with pytest.raises(CaseError) as error:
        Case.load(file, [setting])
    (line,) = str(error.value).splitlines()
    assert said in line
    assert "function-" not in line  # pydantic's own names


@pytest.mark.parametrize(
    ("magnetic", "key"),
    [
        ("{lambda_m: 0}", "magnetic.lambda_m"),
        (
            "{remanent: {flux_density: 60 mT}, applied: {flux_density: 0 mT}}",
            "magnetic.applied.flux_density",
        ),
    ],
)
def test_a_field_of_zero_names_its_key(file: Path, magnetic: str, key: str) -> None:
    with pytest.raises(CaseError, match=f"loading.kind: field needs {key}, not zero"):
        make_problem(Case.load(file, [f"magnetic={magnetic}", "loading={kind: field}"]))


@pytest.mark.parametrize(
    ("loading", "control"),
    [
        ("{kind: pressure, until: target, pressure: 100 Pa}", "load"),
        ("{kind: pressure, until: target, volume_change: -80 mm^3}", "volume"),
        ("{kind: pressure, until: limit}", "volume"),
        ("{kind: indentation, force: 1 mN}", "load"),
        ("{kind: indentation, depth: 1 mm}", "displacement"),
        ("{kind: indentation, control: arc, force: 1 mN}", "arc"),
    ],
)
def test_a_target_chooses_its_control(file: Path, loading: str, control: str) -> None:
    """A force at the pole needs no place either."""
    case = Case.load(file, [f"loading={loading}"])
    assert getattr(case.loading, "control") == control  # noqa: B009
