"""A case file with every kind of imperfection that is not drawn by hand: data, modes, random fields
and dimples.
"""

from pathlib import Path

import numpy as np
import pytest
from command import magshell, read_path, started

CASE = """
shell:
  geometry: hemisphere
  radius_to_thickness: 20
  poisson_ratio: 0.3
  imperfections:
    - {kind: modes, amplitudes: [0.1, 0.05]}
    - {kind: random, seed: 1, amplitude: 0.05, length: 4}
    - {kind: data, file: scan.csv, amplitude: 0.5}
    - {kind: random, seed: 2, dimples: {count: 2, amplitude: 0.3, width: 3, polar: [10, 60], \
distance: 30}}
boundary: {equator: clamped}
loading: {kind: pressure, control: load, until: target, pressure: 0.1}
mesh: {degree: 2, size: 0.4}
"""


@pytest.fixture
def case(tmp_path: Path) -> Path:
    z, theta = np.linspace(1, 0, 400), np.pi * (1 + 5**0.5) * np.arange(400)
    x = np.column_stack([np.sqrt(1 - z * z) * np.cos(theta), np.sqrt(1 - z * z) * np.sin(theta), z])
    rows = np.column_stack([x, np.sin(3 * x[:, 0])])
    np.savetxt(tmp_path / "scan.csv", rows, header="x,y,z,w0", comments="", delimiter=",")
    file = tmp_path / "case.yaml"
    file.write_text(CASE)
    return file


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_all_kinds_checked_and_run(case: Path) -> None:
    said = magshell("check", case).stdout
    for words in (
        "full shell",
        "0.1 h of mode 1 (m = 6), 0.05 h of mode 2 (m = 7)",
        "random field of 0.05 h, seed 1",
    ):
        assert words in said
    assert "scan.csv: 400 values, w0 from -" in said
    one, three = case.parent / "one", case.parent / "three"
    assert magshell("run", case, "--out", one).returncode == 0
    assert started("run", case, "--out", three, ranks=3, pictures=False).returncode == 0
    here, there = (
        [float(read_path(folder)[-1][key]) for key in ("w_over_h", "energy")]
        for folder in (one, three)
    )
    assert there == pytest.approx(here, abs=1e-8)
    membrane = 0.1 * (1 - 0.3) / np.sqrt(3 * (1 - 0.3**2))  # w/h of a perfect sphere
    assert membrane < here[0] < 1.5 * membrane
