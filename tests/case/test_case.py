"""Case files: what is accepted, and what the user reads when something is wrong."""

from pathlib import Path
from textwrap import dedent

import pytest
from conftest import CASES

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.case_variants import case_with_values
from magshell_fenicsx.input.source import CaseError, read_source
from magshell_fenicsx.parts.magnetism.fields import MU_0

GOOD = dedent("""\
    shell:
      geometry: hemisphere
      radius_to_thickness: 90
      poisson_ratio: 0.5
      defect: {kind: dimple, amplitude: 1.64, width: 3.2}
    boundary: {equator: clamped}
    magnetic: {lambda_m: 1e-3}
    loading:
      kind: indentation
      at: {polar: 45}
      depth: 20
    """)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "case.yaml"
    path.write_text(GOOD, encoding="utf-8")
    return path


def test_numbers_with_exponents_are_numbers(file: Path) -> None:
    assert Case.load(file).lambda_m == 1e-3


def test_words_that_yaml_reads_as_true_and_false_are_keys(file: Path) -> None:
    """`on` and `no` are true and false in YAML 1.1, and 1 is a number: as names of things they are
    themselves.
    """
    file.write_text(
        "base: &base {until: target, 1: a}\nloading: {<<: *base, on: {no: off}}\n", encoding="utf-8"
    )
    read = read_source(file, ["loading.hold={y: load}"])
    assert read.data["loading"] == {
        "until": "target",
        "1": "a",
        "on": {"no": False},
        "hold": {"y": "load"},
    }


def test_physical_input_gives_the_dimensionless_numbers(file: Path) -> None:
    """The paper's lengths: R/h = 78.75; lambda_m = |Br||Ba|/(mu_0 E)."""
    case = Case.load(
        file,
        [
            "shell={geometry: hemisphere, radius: 25.2 mm, thickness: 0.32 mm, "
            "youngs_modulus: 1.8 MPa, "
            "poisson_ratio: 0.5}",
            "magnetic={remanent: {flux_density: 60 mT}, applied: {flux_density: 0.05 T}}",
        ],
    )
    assert case.shell.R_over_h == pytest.approx(78.75)
    assert case.lambda_m == pytest.approx(0.060 * 0.05 / (MU_0 * 1.8e6))


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("shell.thicknes=3", "shell.thicknes: unknown key; did you mean thickness?"),
        ("shell.poisson_ratio=0.7", "shell.poisson_ratio: 0.7: must be less than or equal to 0.5"),
        ("shell.poisson_ratio=.nan", "finite"),
        ("shell.radius_to_thickness=0.5", "must be greater than or equal to 10"),
        ("shell.radius=3 mm", "not both"),
        ("shell.youngs_modulus=3 mm", "not convertible to pascal"),
        ("shell.youngs_modulus=3", 'needs a unit, for example "1.8 MPa"'),
        ("shell.youngs_modulus=soft", "not a number with a unit"),
        ("shell.defect.kind=bump", "'bump'"),
        ("shell.defect.width=40", "half-width"),
        ("shell=3", "must be a section"),
        ("boundary.rim=clamped", "no such edge, only equator"),
        ("magnetic.lambda_m=a lot", "'a lot'"),
        ("magnetic.energy=secnd", "must be 'full', 'first'"),
        ("magnetic.remanent.flux_density=60 mT", "not both"),
        (
            "magnetic={remanent: {flux_density: 1 T}, applied: {flux_density: 1 T}}",
            "youngs_modulus is needed",
        ),
        ("magnetic={remanent: {flux_density: 0 T}, applied: {flux_density: 1 T}}", "length zero"),
        ("magnetic.remanent.kind=radiall", "'radiall'"),
        ("magnetic.remanent={kind: radial, polar: 3}", "belong to kind: uniform"),
        ("magnetic.remanent={kind: expression}", "components belongs to kind: expression"),
        ("magnetic.remanent={kind: expression, components: [x, y, import]}", "is not a formula"),
        ("magnetic.remanent={kind: patches, patches: {dimple: {}}}", "needs the patch rest"),
        ("magnetic.remanent={kind: layers, layers: [{fraction: 0.5}]}", "add up to 1"),
        (
            (
                "magnetic.remanent={kind: layers, "
                "layers: [{fraction: 0.5}, {fraction: 0.5, polar: 180}]}"
            ),
            "remanence of length zero",
        ),
        ("magnetic.applied.gradient=[[1, 0], [0, 1], [0, 0]]", "three rows of three"),
        (
            (
                "magnetic={lambda_m: 1, energy: first, "
                "applied: {gradient: [[1,0,0],[0,0,0],[0,0,-1]]}}"
            ),
            "energy: full",
        ),
        ("loading={kind: field, control: load, until: points}", "goes with control: arc"),
        ("loading={kind: rotation, to: {polar: 180}}", "neither parallel nor opposite"),
        ("loading.kind=poke", "allowed: pressure, indentation, field, rotation"),
        ("loading.depht=3", "did you mean depth?"),
        ("loading.at.polar=95", "allowed 0 to 89"),
        ("loading.depth=0", "must not be zero"),
        ("loading.force=2", "nothing else"),
        ("loading={kind: pressure, until: target}", "needs volume_change"),
        ("loading={kind: pressure, pressure: 0.2}", "until: target"),
        ("mesh.degree=9", "less than or equal to 5"),
        ("mesh.degree='4'", "integer"),
        ("nonsense", "write it as key.path=value"),
        ("shell.poisson_ratio.x=3", "not a section"),
    ],
)
def test_mistakes_are_named(file: Path, setting: str, said: str) -> None:
    with pytest.raises(CaseError) as error:
        Case.load(file, [setting])
    assert said in str(error.value)
    assert "--set" in str(error.value) or str(file) in str(error.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            GOOD.replace("width", "widht"),
            ":5: shell.defect.widht: unknown key; did you mean width?",
        ),
        (GOOD.replace("90", "-90"), ":3: shell.radius_to_thickness: -90: must be"),
        (GOOD.replace("boundary", "loading"), ":8: loading is given twice"),
        (GOOD.replace("boundary: {equator: clamped}\n", ""), "boundary: is missing"),
        ("shell: [1", "not valid YAML"),
        ("- 1", "a case file is a mapping"),
        ("", "a case file is a mapping"),
        ("\x00", "not valid YAML"),
        ("? [1, 2]\n: 3", "a key must be a word"),
    ],
)
def test_mistakes_are_placed(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(CaseError) as error:
        Case.load(file)
    assert str(error.value).startswith(str(file))
    assert said in str(error.value)


def test_missing_file() -> None:
    with pytest.raises(CaseError, match=r"nowhere.yaml: cannot be read: No such file"):
        Case.load("nowhere.yaml")


def test_every_mistake_is_told_at_once(file: Path) -> None:
    with pytest.raises(CaseError) as error:
        Case.load(file, ["shell.poisson_ratio=0.7", "mesh.degree=9"])
    assert len(str(error.value).splitlines()) == 2


def test_a_copy_has_a_programme_of_its_own() -> None:
    case = Case.load(CASES / "probing.yaml")
    assert case.programme is case.programme
    assert len(case.programme) == 2
    assert case.model_copy(update={"loading": None}).programme == ()


def test_changes_of_several_numbers_keep_each_other() -> None:
    """Numbers of the shell and a target over one of them: all as in a case that has them from the
    start.
    """
    values = {
        "shell.poisson_ratio": 0.3,
        "loading.pressure": 0.2,
        "shell.thickness": 0.8e-3,
        "shell.youngs_modulus": 2e6,
    }
    shell = {
        "geometry": "cap",
        "radius": "20 mm",
        "polar": 45,
        "thickness": "0.7 mm",
        "youngs_modulus": "1 MPa",
    }
    loading = {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.1}
    data = {
        "shell": {**shell, "poisson_ratio": 0.5},
        "boundary": {"rim": "clamped"},
        "loading": loading,
    }
    found = case_with_values(Case.from_source(data), values)
    data["shell"] |= {"poisson_ratio": 0.3, "thickness": "0.8 mm", "youngs_modulus": "2 MPa"}
    data["loading"]["pressure"] = 0.2
    assert found.model_dump() == Case.from_source(data).model_dump()
