"""The section `gradients` of a case: numbers, fields and messages."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import magshell
from conftest import CAP, CASES
from scipy.spatial import cKDTree

import magshell_fenicsx as ms
from magshell_fenicsx.output.fields.vtu import read_vtu

WHERE = CASES / "where_to_magnetise.yaml"
STRIP = """
shell: {geometry: strip, radius_to_thickness: 100, width: 0.1, poisson_ratio: 0.2}
boundary: {root: clamped}
points: {tip: [1, 0, 0]}
magnetic: {lambda_m: 3.3e-5, remanent: {polar: 60}, applied: {polar: 0}}
mesh: {degree: 2}
gradients: {of: [tip_uz], by: [remanence, thickness, curvature, deviation, lambda_m]}
"""


def summary(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return content


@pytest.mark.slow
def test_fold_of_a_meridian(tmp_path: Path) -> None:
    """A stronger magnet everywhere is a larger lambda_m; interrupted and resumed, the run has the
    same gradients.
    """
    out = tmp_path / "out"
    assert magshell("run", WHERE, "--out", out, ranks=1).returncode == 0
    found = summary(out)["gradients"]["knockdown"]
    assert found["value"] == pytest.approx(0.44727601, rel=1e-7)
    assert found["fields"]["magnitude"]["alike"][0] == pytest.approx(
        0.001 * found["numbers"]["lambda_m"], rel=1e-8
    )
    surface, _ = read_vtu(out / "fields/gradients_knockdown.vtu")
    assert surface.fields["remanence"].shape == surface.r0.shape
    assert np.abs(surface.fields["thickness"]).max() == pytest.approx(
        found["fields"]["thickness"]["most_per_area"]
    )
    assert "most per area" in (out / "report.html").read_text(encoding="utf-8")
    again = tmp_path / "again"
    assert magshell("run", WHERE, "--out", again, "--time-limit", "0.01", ranks=1).returncode != 0
    assert not summary(again)["gradients"]
    assert magshell("run", WHERE, "--out", again, "--resume", ranks=1).returncode == 0
    assert summary(again)["gradients"]["knockdown"] == found


@pytest.mark.slow
def test_same_on_ranks(tmp_path: Path) -> None:
    """A half shell on 1 and 2 ranks."""
    (tmp_path / "strip.yaml").write_text(STRIP)
    found = {}
    for ranks in (1, 2):
        coarse = "--set=mesh.refinement=0.5"
        done = magshell(
            "run", tmp_path / "strip.yaml", coarse, "--out", tmp_path / f"{ranks}", ranks=ranks
        )
        assert done.returncode == 0, done.stderr
        surface, _ = read_vtu(tmp_path / f"{ranks}/fields/gradients_tip_uz.vtu")
        found[ranks] = summary(tmp_path / f"{ranks}")["gradients"]["tip_uz"], surface
    numbers, surface = found[1]
    other, there = found[2]
    assert other["numbers"]["lambda_m"] == pytest.approx(numbers["numbers"]["lambda_m"], rel=1e-7)
    order = cKDTree(there.r0).query(surface.r0)[1]
    for name, field in numbers["fields"].items():
        size = field["most_per_area"]
        assert other["fields"][name]["alike"] == pytest.approx(
            field["alike"], rel=1e-6, abs=1e-6 * size
        ), name
    for name, values in surface.fields.items():
        size = np.abs(values).max()
        here, other_half = (
            np.abs(values),
            np.abs(there.fields[name][order]),
        )  # on the mirror plane both images lie
        np.testing.assert_allclose(other_half, here, rtol=0, atol=1e-5 * size, err_msg=name)


@pytest.mark.parametrize(
    ("section", "message"),
    [
        (
            "{of: [sideways]}",
            (
                "gradients.of: sideways: has no gradient here; allowed are knockdown, "
                "buckling_pressure_Pa"
            ),
        ),
        ("{of: [force_N]}", "gradients.of: force_N: has no gradient here; allowed are"),
        (
            "{of: [buckling_pressure_Pa]}",
            "buckling_pressure_Pa: the case has no such unit; knockdown has none",
        ),
        ("{of: [tip_uz], by: [magnets]}", "gradients.by: magnets: the case has no such key"),
    ],
)
def test_mistakes(tmp_path: Path, section: str, message: str) -> None:
    """Said before the run."""
    (tmp_path / "strip.yaml").write_text(STRIP)
    done = magshell(
        "run",
        tmp_path / "strip.yaml",
        "--out",
        tmp_path / "out",
        f"--set=gradients={section}",
        ranks=1,
    )
    assert done.returncode == 2
    assert message in done.stderr
    assert not (tmp_path / "out/path.csv").exists()


@pytest.mark.slow
def test_one_key_without_a_gradient(tmp_path: Path) -> None:
    """A remanence across the mirror plane breaks the symmetry of the half that is modelled: that
    key is named, and the others have what they have without it.
    """
    (tmp_path / "strip.yaml").write_text(STRIP)
    coarse, found = "--set=mesh.refinement=0.5", dict[str, dict[str, Any]]()
    for out, by in (
        ("all", "[thickness, magnetic.remanent.azimuth, shell.poisson_ratio]"),
        ("some", "[thickness, shell.poisson_ratio]"),
    ):
        asked = f"--set=gradients={{of: [tip_uz], by: {by}}}"
        done = magshell(
            "run", tmp_path / "strip.yaml", coarse, asked, "--out", tmp_path / out, ranks=1
        )
        assert done.returncode == 0, done.stderr
        said = "warning: no gradient of tip_uz by magnetic.remanent.azimuth: "
        assert (said in done.stdout) == (out == "all")
        found[out] = summary(tmp_path / out)["gradients"]["tip_uz"]
    assert set(found["some"]["numbers"]) == {"shell.poisson_ratio"}
    assert found["all"] == found["some"]


IN_UNITS = (
    CAP
    + """
gradients: {of: [buckling_pressure_Pa, pressure_Pa, w_pole_mm], by: [shell.youngs_modulus]}
"""
)


def test_results_in_units(tmp_path: Path) -> None:
    """Against the difference of two runs; E changes k_d, by the field, and the classical pressure.

    The pressure where the path ends is that of the fold; the displacement there moves along the
    path, and it once had the derivative at the point before the fold.
    """
    (tmp_path / "cap.yaml").write_text(IN_UNITS, encoding="utf-8")
    done = magshell(
        "run", tmp_path / "cap.yaml", "--out", tmp_path / "out", "--no-pictures", ranks=1
    )
    assert "no gradient of w_pole_mm: the path ends at a fold, which moves" in done.stdout
    found = summary(tmp_path / "out")["gradients"]

    def buckling(modulus: float) -> float:
        result = ms.run(
            ms.Case.load(
                tmp_path / "cap.yaml", [f"shell.youngs_modulus={modulus} Pa", "gradients=null"]
            )
        )
        assert result.knockdown
        return result.knockdown * result.scene.sizes.by_unit["p_c"]

    slope = (buckling(1.301e6) - buckling(1.299e6)) / 2e3
    for name in ("buckling_pressure_Pa", "pressure_Pa"):
        assert found[name]["numbers"]["shell.youngs_modulus"] == pytest.approx(slope, rel=1e-4)
        assert found[name]["value"] == pytest.approx(buckling(1.3e6), rel=1e-6)
    assert "w_pole_mm" not in found
