"""Other histories predicted from a posterior: bands against slopes, data in them, resume, and what
is refused.
"""

import csv
import json
from pathlib import Path

import pytest
from command import magshell, started

import magshell_fenicsx as ms
from magshell_fenicsx.input.source import CaseError

CAP = """
shell: {geometry: cap, radius: 40 mm, thickness: 0.8 mm, polar: 45, youngs_modulus: 900 kPa, \
poisson_ratio: 0.49}
boundary: {rim: clamped}
points: {tip: [0 mm, 0 mm, 40 mm]}
magnetic: {remanent: {flux_density: 143 mT}, applied: {flux_density: 20 mT}}
mesh: {degree: 2, refinement: 0.3}
loading: {kind: field, points: 2}
"""  # its meridian
LOOKED_FOR = """
identify:
  parameters: {shell.youngs_modulus: {}}
  noise: {tip_uz: 3 um}
  candidates: [{of: tip_uz_mm, at: 20 mT, noise: 1 um}]
  predict:
    turned:
      settings: [magnetic.applied.flux_density=-20 mT, magnetic.remanent.flux_density=-143 mT]
      data: turned.csv
      of: [w_pole_mm, "tip_uz_mm@end"]
      samples: 20
"""
BEGIN = "shell.youngs_modulus=950 kPa"


def written(folder: Path) -> tuple[Path, Path]:
    """The case and its data, of a cap of 900 kPa."""
    case, data = folder / "cap.yaml", folder / "measured.csv"
    case.write_text(CAP + LOOKED_FOR)
    middle, last = (row for row in ms.run(ms.Case.load(case)).rows if row["label"] == "target")
    end = last["tip_uz_mm"]
    data.write_text(
        f"applied [mT],tip_uz [mm]\n{middle['applied_mT']!r},{middle['tip_uz_mm']!r}\n20,{end!r}\n"
    )
    (folder / "turned.csv").write_text(f"applied [mT],tip_uz [um]\n-20,{1e3 * end!r}\n-5,0\n")
    return case, data


@pytest.mark.slow
def test_bands_of_another_history(tmp_path: Path) -> None:
    """Those of slopes, with field and remanence reversed, which changes nothing; of two data one is
    inside.
    """
    case, data = written(tmp_path)
    words = ["identify", case, "--data", data, "--set", BEGIN]
    done = magshell(*words, "--out", tmp_path / "one")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "one" / "identify.json").read_text())
    (by_slopes,) = content["predicted"]
    turned = content["programmes"]["turned"]
    number = turned["numbers"]["tip_uz_mm@end"]
    assert number["value"] == pytest.approx(by_slopes["value"], rel=1e-6)
    width = by_slopes["high"] - by_slopes["low"]
    assert number["high"] - number["low"] == pytest.approx(
        width, rel=0.03
    )  # of 20 runs: their quantiles are exact where slopes are
    assert number["low"] < by_slopes["value"] < number["high"]
    assert (turned["measured"], turned["inside"]) == (2, 1)
    assert "turned: 1 of 2 data within their predicted bands" in done.stdout
    rows = list(csv.DictReader((tmp_path / "one" / "identify_turned.csv").open()))
    assert {row["result"] for row in rows} == {"tip_uz_mm", "w_pole_mm"}
    (end,) = (
        row for row in rows if row["result"] == "tip_uz_mm" and float(row["applied_mT"]) == -20
    )
    assert float(end["low"]) == pytest.approx(number["low"], rel=1e-6)
    assert float(end["high_measured"]) > float(end["high"])
    assert (tmp_path / "one" / "identify_turned.png").stat().st_size > 10_000
    points = {
        file: file.stat().st_mtime_ns for file in (tmp_path / "one" / "points").glob("*.json")
    }
    other = [
        "--set",
        "identify.predict.turned.changes=[w_pole_mm]",
    ]  # makes neither fit nor runs new
    again = started(*words, *other, "--out", tmp_path / "one", ranks=2)
    assert again.returncode == 0, again.stderr
    assert "turned: 21 runs, 0 to compute" in again.stdout
    assert {file: file.stat().st_mtime_ns for file in points} == points


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("identify.predict.turned.case=nowhere.yaml", "identify.predict.turned: .*nowhere.yaml"),
        (
            "identify.predict.turned.case=other.yaml",
            "other.yaml has no shell.youngs_modulus, which is looked for",
        ),
        (
            "identify.predict.turned.settings=[magnetic.nope=1]",
            "identify.predict.turned: .*magnetic.nope",
        ),
        (
            "identify.predict.turned.of=[nope]",
            "identify.predict.turned.of: nope: nope is no column with numbers",
        ),
        (
            "identify.predict.turned.changes=[tip_uy]",
            "identify.predict.turned.changes: tip_uy: is no column that",
        ),
        (
            "identify.predict.turned.data=none.csv",
            "identify.predict.turned.data: none.csv: cannot be read",
        ),
        (
            "identify.predict.turned.data=no_unit.csv",
            "no_unit.csv: tip_uz: has no unit: write tip_uz",
        ),
        (
            "identify.predict.turned.data=step.csv",
            "step.csv: line 2: a row has no place, or no step of 1 to 1",
        ),
        (
            "identify.predict={a b: {of: [knockdown]}}",
            "a b: a name has letters, digits and _ alone",
        ),
        ("identify.predict.turned={samples: 30}", "give data, of, or both: nothing is predicted"),
    ],
)
def test_what_predicts_nothing(tmp_path: Path, setting: str, said: str) -> None:
    """Before anything is computed."""
    case, data = tmp_path / "cap.yaml", tmp_path / "measured.csv"
    case.write_text(CAP + LOOKED_FOR)
    for name, text in (
        ("measured", "applied [mT],tip_uz [mm]\n5,9\n10,12\n"),
        ("turned", "applied [mT],tip_uz [mm]\n-5,9\n"),
        ("no_unit", "applied [mT],tip_uz\n-5,9\n"),
        ("step", "step,applied [mT],tip_uz [mm]\n3,-5,9\n"),
    ):
        (tmp_path / f"{name}.csv").write_text(text)
    (tmp_path / "other.yaml").write_text(
        "shell: {geometry: strip, radius: 1, width: 0.2, thickness: 0.01}\n"
    )
    with pytest.raises(CaseError, match=said):
        ms.identify(case, data, [setting], tmp_path / "out")
