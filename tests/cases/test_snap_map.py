"""The map of a dimple's depth and a field: knockdowns as those of runs."""

from pathlib import Path

import pytest
from conftest import CASES

import magshell_fenicsx as ms


@pytest.mark.slow
def test_snap_map(tmp_path: Path) -> None:
    """At a depth of 1.64 without a field 0.32624, as dimple_buckling; in a field as a run of its
    own.
    """
    file, key = CASES / "snap_map.yaml", "shell.defect.amplitude"
    found = ms.boundary(
        file, [f"{key}=1.5:1.64:1", "magnetic.lambda_m=0,0.002"], [f"{key}=1.5"], tmp_path / "map"
    )
    ends = {row["second"]: row["load"] for row in found.rows if row["key"] == 1.64}
    assert ends[0.0] == pytest.approx(0.32624, abs=2e-4)
    own = ms.run(ms.Case.load(file, [f"{key}=1.64", "magnetic.lambda_m=0.002"])).knockdown
    assert ends[0.002] == pytest.approx(own, rel=1e-3)  # on the mesh of the other depth
    assert ends[0.002] > ends[0.0]
