"""A case with units: its columns, its sentence, and that every number of its report stands in a
file.
"""

import csv
import json
import re
from collections.abc import Iterator
from html import unescape
from math import pi, sqrt
from pathlib import Path
from typing import Any

import pytest
from command import magshell, read_path
from conftest import CASES

from magshell_fenicsx import Case, CaseError
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.output.fields.vtu import read_point
from magshell_fenicsx.output.report.interactive import interactive
from magshell_fenicsx.problem.columns import sizes_of
from magshell_fenicsx.quantities.registry import axes_of

R, H, E, NU = 25.2e-3, 0.32e-3, 1.8e6, 0.5
P_C = 2 * E / sqrt(3 * (1 - NU**2)) * (H / R) ** 2
SHELL = (
    "{geometry: hemisphere, radius: 25.2 mm, thickness: 0.32 mm, youngs_modulus: 1.8 MPa, "
    "poisson_ratio: 0.5, %s}"
)
DIMPLE = "defect: {kind: dimple, amplitude: 1.64, width: 3.2}"
FIELD = "{remanent: {flux_density: %s}, applied: {flux_density: %s}}"
NUMBER = r"[−-]?\d+(?:\.\d+)?(?:e[−-]?\d+)?"


def written(folder: Path, shell: str, magnetic: str, loading: str) -> Path:
    file = folder / "case.yaml"
    boundary, mesh = "boundary: {equator: clamped}", "mesh: {degree: 3, refinement: 0.5}"
    parts = (
        f"shell: {SHELL % shell}",
        boundary,
        f"magnetic: {magnetic}",
        f"loading: {loading}",
        mesh,
    )
    file.write_text("\n".join(parts) + "\n", encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def buckled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a run with field and pressure in units, and what the command has printed."""
    folder = tmp_path_factory.mktemp("buckled")
    file = written(folder, DIMPLE, FIELD % ("63 mT", "-20 mT"), "{kind: pressure, until: limit}")
    done = magshell("run", file, "--out", folder / "out", "--no-pictures")
    assert done.returncode == 0, done.stderr
    return folder / "out", done.stdout


def test_columns_in_units(buckled: tuple[Path, str]) -> None:
    """Against p_c, h and R³ by hand; the dimensionless columns stay."""
    folder, _ = buckled
    last = {
        key: float(v)
        for key, v in read_path(folder)[-1].items()
        if key not in ("label", "amplitude", "mode")
    }
    assert last["pressure_Pa"] == pytest.approx(last["p_over_pc"] * P_C, rel=1e-12)
    assert last["applied_mT"] == pytest.approx(-20, rel=1e-12)
    assert last["w_mm"] == pytest.approx(last["w_over_h"] * 0.32, rel=1e-12)
    assert last["volume_change_mm3"] == pytest.approx(last["volume_change"] * 25.2**3, rel=1e-12)
    assert last["energy_mJ"] == pytest.approx(last["energy"] * 1e3 * E * H * R**2, rel=1e-12)


def test_summary_and_final_line_in_units(buckled: tuple[Path, str]) -> None:
    folder, printed = buckled
    found = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert found["in_units"]["classical_pressure_Pa"] == pytest.approx(P_C, rel=1e-12)
    buckling = found["in_units"]["buckling_pressure_Pa"]
    assert buckling == pytest.approx(found["knockdown"] * P_C, rel=1e-12)
    assert found["limit_points"][0]["pressure_Pa"] == pytest.approx(buckling, rel=1e-12)
    *_, results, sentence = printed.splitlines()
    assert results.startswith("results in ")
    said = (
        r"The shell buckles .* k_d = p/p_c = [\d.]+\(\d\) \([\d.]+ Pa\): "
        r"a fold, w = .* mm at the pole\."
    )
    assert re.fullmatch(said, sentence)
    assert float(sentence.split("(")[2].split(" Pa")[0]) == pytest.approx(buckling, rel=1e-5)
    assert not re.search(
        r"(?<![\w/])-0(\.0*)?(?![.\d])", printed
    )  # a folder may be called pytest-0


def test_the_part_to_play_with_is_in_units(buckled: tuple[Path, str]) -> None:
    """Displacements in mm, the couple and the pressure of the field by hand."""
    folder, _ = buckled
    case = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["case"]
    part = interactive(folder, case)
    if part is None:
        pytest.skip("needs Plotly")
    about = json.loads(part.about)
    fields = {field["name"]: field for field in about["fields"]}
    assert {name: fields[name]["label"] for name in ("w_over_h", "M_1", "couple", "p_mag")} == {
        "w_over_h": "inward normal displacement w (mm)",
        "M_1": "larger principal moment M<sub>1</sub> (µN)",
        "couple": "couple (mN/m)",
        "p_mag": "magnetic pressure p<sub>mag</sub> (Pa)",
    }
    shells = [read_point(folder / "fields", i)[0] for i in range(len(read_path(folder)))]
    highest = max(float(shell.w.max()) for shell in shells)
    assert fields["w_over_h"]["high"] == pytest.approx(1e3 * R * highest, rel=0.01)
    # at the equator of a sphere that hardly deforms, remanence and field are along one line
    strength = 63e-3 * 20e-3 / (4e-7 * pi)
    assert 0 < fields["couple"]["high"] < 1e3 * strength * H
    assert fields["p_mag"]["low"] == pytest.approx(-strength * H / R, rel=0.02)
    assert {step["varied"] for step in about["steps"]} == {"applied_mT", "pressure_Pa"}


def numbers_in(part: Any) -> Iterator[float]:
    """All numbers of a file's content, those within texts too."""
    if isinstance(part, dict | list):
        for each in part.values() if isinstance(part, dict) else part:
            yield from numbers_in(each)
    elif isinstance(part, str):
        yield from (float(x) for x in re.findall(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?", part))
    elif isinstance(part, int | float):
        yield float(part)


def is_there(text: str, known: set[float], exponent: int = 0) -> bool:
    """Whether a number as it is written is one of those known, rounded to its digits."""
    mantissa, _, power = text.replace("−", "-").partition("e")
    exponent += int(power or 0)
    half = 0.5001 * 10.0 ** (exponent - len(mantissa.partition(".")[2]))
    # %g leaves out zeros at the end, so fewer digits than six may be meant exactly
    return any(abs(float(mantissa) * 10.0**exponent - value) <= half for value in known)


def test_every_number_of_the_report_stands_in_a_file(buckled: tuple[Path, str]) -> None:
    assert whole_report(buckled[0]) > 30


SPHERE = (
    "{geometry: hemisphere, radius: 25.2 mm, thickness: 0.8 mm, youngs_modulus: 1.8 MPa, "
    "poisson_ratio: 0.3, %s}"
)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        pytest.param(
            "arch",
            ["mesh={degree: 2}", "frequencies={at: end, count: 2}", "shell.density=1000 kg/m^3"],
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "cylinder_waves",
            ["mesh.refinement=0.4", "symmetry=half", "stability={modes: 2}"],
            marks=pytest.mark.slow,
        ),
        ("gripper", ["mesh={degree: 2}"]),
        pytest.param("rod_contact", ["mesh={degree: 2, refinement: 0.4}"], marks=pytest.mark.slow),
        (
            "dimple_buckling",
            [f"shell={SPHERE % DIMPLE}", "symmetry=half", "mesh={degree: 2, refinement: 0.4}"],
        ),
        pytest.param(
            "dimple_buckling",
            [
                f"shell={SPHERE % DIMPLE}",
                *("mesh={degree: 3, refinement: 0.5}", "loading.sensitivities=true"),
                (
                    "gradients={of: [buckling_pressure_Pa, knockdown], "
                    "by: [shell.poisson_ratio, thickness]}"
                ),
            ],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_numbers_of_other_reports(name: str, settings: list[str], tmp_path: Path) -> None:
    """A field, waves, a mesh from a file, contact, places of modes, sensitivities and gradients."""
    done = magshell(
        "run",
        CASES / f"{name}.yaml",
        *(w for s in settings for w in ("--set", s)),
        "--out",
        tmp_path,
        "--no-pictures",
    )
    assert done.returncode == 0, done.stderr
    assert whole_report(tmp_path) > 15


def whole_report(folder: Path) -> int:
    """See that numbers of the path table are in path.csv, in the row of the point, all others in
    summary.json too.

    Returns the number of these others.
    """
    page = (folder / "report.html").read_text(encoding="utf-8").replace(" · 10<sup>", "e")
    for tag in ("style", "script", "title", "sub", "pre"):
        page = re.sub(rf"<{tag}\b.*?</{tag}>", "", page, flags=re.DOTALL)
    page = re.sub(r"<p>This run has no error estimate.*?</p>", "", page, flags=re.DOTALL)
    head, table, rest = re.split(r'<table class="path">|</table></div>', page, maxsplit=2)
    with (folder / "path.csv").open(encoding="utf-8", newline="") as stream:
        rows = [set(numbers_in(row)) for row in csv.DictReader(stream)]
    summary = set(numbers_in(json.loads((folder / "summary.json").read_text(encoding="utf-8"))))
    heads = re.findall(r"<th.*?</th>", table, flags=re.DOTALL)
    powers = [
        int(p[1].replace("−", "-")) if (p := re.search(r"10<sup>(−?\d+)</sup>", each)) else 0
        for each in heads
    ]
    lines = [re.findall(r"<td.*?>(.*?)</td>", line) for line in table.split("<tr>")[2:]]
    assert len(lines) == len(rows) > 1
    for cells, known in zip(lines, rows, strict=True):
        for cell, power in zip(cells, powers, strict=True):
            if re.fullmatch(NUMBER, cell):
                assert is_there(cell, known, power), (cell, power)
    text = unescape(re.sub(r"<[^>]*>", " ", (head + rest).replace("10<sup>", "1e")))
    found = re.findall(rf"(?<![\w.]){NUMBER}(?![\w.])", text)
    strange = [each for each in found if not is_there(each, summary | {2.0})]  # the two of 2πD/R
    assert not [each for each in strange if not is_there(each, set().union(*rows))]
    return len(found)


def test_forces_and_their_axes(tmp_path: Path) -> None:
    """2πD/R by hand; the curve is drawn in newtons over millimetres."""
    file = written(tmp_path, "", "null", "{kind: indentation, at: {polar: 0}, depth: 1, points: 1}")
    done = magshell("run", file, "--out", tmp_path / "out", "--no-pictures")
    last = read_path(tmp_path / "out")[-1]
    unit = 2 * pi * E * H**3 / (12 * (1 - NU**2)) / R
    assert float(last["force_N"]) == pytest.approx(float(last["force"]) * unit, rel=1e-12)
    assert [axis.label for axis in axes_of("force", last)] == [
        "displacement at the load  $w$  (mm)",
        "force  $F$  (N)",
    ]
    assert done.stdout.splitlines()[-1].endswith(" N), w = 0.32 mm at the load.")


def test_sign_of_the_field_and_strength_of_sources() -> None:
    """A remanence of the other sign turns lambda_m, not the applied field; magnets have a strength
    of 100 %.
    """

    def full(magnetic: dict[str, Any]) -> tuple[float, str]:
        shell = {
            "geometry": "hemisphere",
            "radius": "25.2 mm",
            "thickness": "0.32 mm",
            "youngs_modulus": "1.8 MPa",
        }
        data = {
            "shell": shell | {"poisson_ratio": 0.5},
            "boundary": {"equator": "clamped"},
            "magnetic": magnetic,
        }
        case = Case.from_source(Source("units", data))
        sizes = sizes_of(case.context)
        return case.lambda_m * sizes.by_unit["λ_m"], sizes.field

    value, unit = full(
        {"remanent": {"flux_density": "-63 mT"}, "applied": {"flux_density": "20 mT"}}
    )
    assert (pytest.approx(value), unit) == (20, "mT")
    magnet = {
        "kind": "sphere",
        "diameter": "10 mm",
        "polarization": "1 T",
        "position": ["0 mm", "0 mm", "-40 mm"],
    }
    value, unit = full({"remanent": {"flux_density": "63 mT"}, "applied": {"sources": [magnet]}})
    assert (pytest.approx(value), unit) == (100, "%")


def test_names_of_columns_in_units_are_taken() -> None:
    data = {
        "shell": {"geometry": "hemisphere", "radius_to_thickness": 90, "poisson_ratio": 0.5},
        "boundary": {"equator": "clamped"},
        "bodies": {"N": {"kind": "plane"}},
        "loading": {"kind": "contact", "approach": 1},
    }
    with pytest.raises(
        CaseError, match=r"bodies\.N: is taken, by columns in this unit; choose another name"
    ):
        Case.from_source(Source("units", data))
