"""Two shells that do not touch, in time, in studies and with derivatives: each has the numbers that
it has alone.
"""

import csv
import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from command import magshell
from many import make_samples

from magshell_fenicsx import Case, CaseError
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.public import run
from magshell_fenicsx.studies.ensemble.samples import Sample

CAP = {
    "geometry": "cap",
    "radius": "25 mm",
    "polar": 25,
    "thickness": "0.5 mm",
    "youngs_modulus": "1.8 MPa",
    "poisson_ratio": 0.3,
    "density": "1000 kg/m**3",
}
TIP = {"tip": [0, 0, "25 mm"]}
FLAW = {"imperfections": [{"kind": "gaussian", "amplitude": 0.3, "width": 0.2}]}
MESH, COARSE = (
    {"degree": 3, "size": "4 mm"},
    {"degree": 3, "size": "8 mm"},
)  # on meridians, on surfaces
ON_MERIDIANS: dict[str, Any] = {"mesh": MESH}
ON_HALVES: dict[str, Any] = {"mesh": COARSE, "symmetry": "half"}
LOAD = {"kind": "pressure", "control": "load", "until": "target", "pressure": "300 Pa", "points": 1}
THICK = "shells.upper.shell.thickness"


def one(**shell: Any) -> dict[str, Any]:
    return {"shell": CAP | shell, "boundary": {"rim": "clamped"}, "points": TIP}


def two(**keys: Any) -> dict[str, Any]:
    """Caps one above the other: the lower one has an imperfection, the upper one is thicker."""
    upper = one(thickness="0.8 mm") | {"place": {"position": [0, 0, "10 mm"]}}
    shells = {"lower": one(**FLAW), "upper": upper}
    return {"shells": shells, "mesh": MESH, "loading": LOAD} | keys


def alone(loading: dict[str, Any] = LOAD, on: dict[str, Any] = ON_MERIDIANS, **shell: Any) -> float:
    """How far the tip of one cap moves at the end, in mm."""
    rows = run(Case.from_source(one(**shell) | {"loading": loading} | on)).rows
    return float(rows[-1]["tip_uz_mm"])


def written(folder: Path, **keys: Any) -> Path:
    file = folder / "case.yaml"
    file.write_text(str(two(**keys)).replace("'", '"'), encoding="utf-8")  # JSON, which is YAML
    return file


def drawn(case: dict[str, Any]) -> list[Sample]:
    """Two samples of a case."""
    return make_samples(Source("case", case), 1, range(2))


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_in_time() -> None:
    """After a sudden pressure each moves as it does alone, to the error of the steps, which adapt
    to both: 1e-2.
    """
    motion = {
        "kind": "time",
        "history": {"pressure": {"kind": "step", "to": "100 Pa"}},
        "duration": "1 ms",
        "points": 1,
    }
    rows = run(Case.from_source(two(loading=motion, mesh=COARSE, symmetry="half"))).rows
    assert rows[-1]["lower_tip_uz_mm"] == pytest.approx(alone(motion, ON_HALVES, **FLAW), rel=1e-2)
    assert rows[-1]["upper_tip_uz_mm"] == pytest.approx(
        alone(motion, ON_HALVES, thickness="0.8 mm"), rel=1e-2
    )


@pytest.mark.slow
def test_sweep(tmp_path: Path) -> None:
    """Over the thickness of one: this one as alone, the other as it was; 1e-9."""
    done = magshell(
        "sweep", written(tmp_path), "--over", f"{THICK}=0.7mm,0.9mm", "--out", tmp_path / "sweep"
    )
    assert done.returncode == 0, done.stderr
    ends = [row for row in rows_of(tmp_path / "sweep" / "curves.csv") if row["label"] == "target"]
    for row, thickness in zip(ends, ("0.7 mm", "0.9 mm"), strict=True):
        assert float(row["upper_tip_uz_mm"]) == pytest.approx(alone(thickness=thickness), rel=1e-9)
        assert float(row["lower_tip_uz_mm"]) == pytest.approx(alone(**FLAW), rel=1e-9)


def test_ensemble(tmp_path: Path) -> None:
    """Imperfections of one shell: each sample is the case with its number, and the severest defect
    is named.
    """
    key, draw = (
        "shells.lower.shell.imperfections.0.amplitude",
        {"kind": "uniform", "above": 0.1, "below": 0.8},
    )
    case = written(tmp_path, ensemble={"keys": {key: draw}})
    out = tmp_path / "out"
    done = magshell(
        "ensemble",
        case,
        "--samples",
        2,
        "--seed",
        1,
        "--result",
        "lower_tip_uz_mm@end",
        "--out",
        out,
    )
    assert done.returncode == 0, done.stderr
    for row in rows_of(out / "samples.csv"):
        amplitude = float(row[key])
        assert float(row["severest.amplitude"]) == amplitude
        flaw = {"imperfections": [FLAW["imperfections"][0] | {"amplitude": amplitude}]}
        assert float(row["result"]) == pytest.approx(alone(**flaw), rel=1e-9)


@pytest.mark.slow
def test_random_defects(tmp_path: Path) -> None:
    """The first shell has the defects that it has alone, by the same seed; the other one has
    others: 1e-9.
    """
    draw = {"kind": "uniform", "above": 0.1, "below": 0.8}
    defects = {"count": 2, "amplitude": draw, "width": 1.5, "polar": [0, 10]}
    case = written(tmp_path, mesh=COARSE, symmetry="none", ensemble={"defects": defects})
    out = tmp_path / "out"
    done = magshell(
        "ensemble",
        case,
        "--samples",
        2,
        "--seed",
        1,
        "--result",
        "lower_tip_uz_mm@end",
        "--out",
        out,
    )
    assert done.returncode == 0, done.stderr
    bare = one() | {
        "mesh": COARSE,
        "loading": LOAD,
        "symmetry": "none",
        "ensemble": {"defects": defects},
    }
    for row, sample in zip(rows_of(out / "samples.csv"), drawn(bare), strict=True):
        values = {f"shells.lower.{key}": value for key, value in sample.values.items()}
        assert {key: float(row[key]) for key in values} == values
        tip = run(sample.case).rows[-1]["tip_uz_mm"]
        assert float(row["result"]) == pytest.approx(tip, rel=1e-9)
        other = [
            float(value)
            for key, value in row.items()
            if key.startswith("shells.upper.shell.imperfections")
        ]
        assert len(other) == len(values)
        assert not {*other} & {*values.values()} - {1.5}
    on_upper = [defects | {"on": "upper"}, defects | {"on": "upper", "kind": "dimple", "count": 1}]
    there = drawn(two(symmetry="none", ensemble={"defects": on_upper}))
    for sample, alone_there in zip(there, drawn(bare), strict=True):
        upper = {key.removeprefix("shells.upper."): value for key, value in sample.values.items()}
        assert alone_there.values.items() <= upper.items()
        assert [each.kind for each in sample.case.shells["upper"].shell.imperfections] == [
            *2 * ["gaussian"],
            "dimple",
        ]
    for name, case_of, said in (
        ("lowest", two, "lowest: there is no such shell, only lower, upper"),
        ("lower", lambda **keys: bare | keys, "names one of several shells: leave it out"),
    ):
        with pytest.raises(CaseError, match=f"ensemble.defects.on: {said}"):
            drawn(case_of(ensemble={"defects": defects | {"on": name}}))
    with pytest.raises(CaseError, match="defects take the place of shell"):
        drawn(
            two(
                ensemble={
                    "keys": {"shells.lower.shell.imperfections.0.amplitude": draw},
                    "defects": defects,
                }
            )
        )


def test_gradients(tmp_path: Path) -> None:
    """By numbers of one shell, at the load in its unit: differences of it alone, 1e-4; not of the
    other.
    """
    modulus = "shells.lower.shell.youngs_modulus"
    results = ["lower_tip_uz_mm", "upper_tip_uz_mm"]
    case = written(tmp_path, gradients={"of": results, "by": [modulus, THICK]})
    done = magshell("run", case, "--out", tmp_path / "out", "--no-pictures")
    assert done.returncode == 0, done.stderr
    gradients = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))[
        "gradients"
    ]
    found = {of: each["numbers"] for of, each in gradients.items()}
    stiffer = [alone(youngs_modulus=f"{E} MPa", **FLAW) for E in (1.799, 1.801)]
    thicker = [alone(thickness=f"{h} mm") for h in (0.799, 0.801)]
    assert found["lower_tip_uz_mm"][modulus] == pytest.approx(
        (stiffer[1] - stiffer[0]) / 2e3, rel=1e-4
    )
    assert found["upper_tip_uz_mm"][THICK] == pytest.approx(
        (thicker[1] - thicker[0]) / 2e-6, rel=1e-4
    )
    assert abs(found["upper_tip_uz_mm"][modulus] * 1.8e6) < 1e-9
    assert abs(found["lower_tip_uz_mm"][THICK] * 8e-4) < 1e-9
    case = written(tmp_path, gradients={"of": results, "by": ["shells.upper.shell.polar"]})
    done = magshell("run", case, "--out", tmp_path / "refused", "--no-pictures")
    assert done.returncode == 2
    assert "shells.upper.shell.polar: a number of the mesh, of the shape" in done.stderr


@pytest.mark.slow
def test_design(tmp_path: Path) -> None:
    """The thickness of the upper cap at which its tip sinks as that of a cap of 0.83 mm does, 1e-3;
    verified finer.
    """
    wanted = {"reach": "upper_tip_uz_mm", "value": alone(thickness="0.83 mm")}
    case = written(
        tmp_path,
        design={"objective": wanted, "numbers": {THICK: ["0.6 mm", "1 mm"]}, "iterations": 20},
    )
    done = magshell("design", case, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    best = yaml.safe_load((tmp_path / "out" / "best.yaml").read_text(encoding="utf-8"))
    thickness = best["shells"]["upper"]["shell"]["thickness"]
    assert float(str(thickness).split()[0]) == pytest.approx(0.83, rel=1e-3)
    assert "verified (mesh.refinement=1.5)" in done.stdout


def test_tolerance() -> None:
    """A mesh of both for a relative error of 5 %: the volume, which is conjugate to the load,
    against a fine mesh.
    """
    loose = run(Case.from_source(two(mesh={"tolerance": 0.05})))
    fine = run(Case.from_source(two(mesh={"degree": 4, "size": "5 mm"})))
    assert loose.rows[-1]["volume_change"] == pytest.approx(
        fine.rows[-1]["volume_change"], rel=0.05
    )
