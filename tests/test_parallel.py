"""The same path on 1, 2 and 3 ranks."""

from pathlib import Path

import pytest
from command import magshell, read_path
from conftest import CASES

DEGREE = "--set=mesh.degree=3"
COARSE = ["--set=mesh.refinement=0.5"]
SCENES = {
    "half shell, force": ("pole_indentation.yaml", [DEGREE, "--set=symmetry=half"]),
    "meridian": ("pole_indentation.yaml", [DEGREE]),
    "half solid, field, force": (
        "solid_indentation.yaml",
        ["--set=loading.depth=1", "--set=loading.points=1", "--set=mesh.refinement=0.3"],
    ),
    "full shell, field, pressure": (
        "dimple_buckling.yaml",
        [DEGREE, "--set=magnetic={lambda_m: 1e-3, remanent: {polar: 45}, applied: {polar: 45, azimuth: 90}}"],
    ),
}
COMPARED = ("p_over_pc", "lambda_m", "force", "w_over_h", "w_pole_over_h", "volume_change", "energy")


@pytest.mark.parametrize("scene", SCENES)
def test_same_path(tmp_path: Path, scene: str) -> None:
    """Every column to 1e-8 of its largest value; the same steps, pivots and iterations."""
    file, settings = SCENES[scene]
    paths = []
    for ranks in (1, 2, 3):
        out = tmp_path / str(ranks)
        done = magshell("run", CASES / file, *COARSE, *settings, "--out", out, ranks=ranks)
        assert done.returncode == 0, done.stderr
        paths.append(read_path(out))
    for other in paths[1:]:
        assert len(other) == len(paths[0])
        for key in ("label", "negative_pivots"):
            assert [row[key] for row in other] == [row[key] for row in paths[0]]
        for key in COMPARED:
            a, b = ([float(row[key]) for row in path] for path in (paths[0], other))
            assert b == pytest.approx(a, rel=0, abs=1e-8 * max(map(abs, a), default=0.0) or 1e-15)
