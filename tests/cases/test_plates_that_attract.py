"""Two magnetised plates that may touch: before they do, contact changes nothing of their path."""

from pathlib import Path

import pytest
from command import magshell, read_path

PLATE = "{geometry: plate, length: 20 mm, width: 2 mm, thickness: 0.5 mm, youngs_modulus: 1 MPa, poisson_ratio: 0.3}"
CASE = f"""
shells:
  lower:
    shell: {PLATE}
    boundary: {{left: clamped, right: clamped}}
    remanent: {{polar: 0, flux_density: 100 mT}}
  upper:
    shell: {PLATE}
    boundary: {{left: clamped}}
    remanent: {{polar: 0, flux_density: 100 mT}}
    place: {{position: [0 mm, 0 mm, 1.5 mm]}}
magnetic: {{interaction: others}}
mesh: {{size: 2 mm}}
loading: {{kind: interaction, until: limit, points: 5}}
"""


@pytest.mark.slow
def test_contact_ahead_does_not_move_a_fold(tmp_path: Path) -> None:
    """The fold with contact is that without: 1e-6."""
    folds = []
    for name, contact in (("apart", ""), ("contact", "contact: [[upper, lower]]\n")):
        (tmp_path / f"{name}.yaml").write_text(CASE + contact)
        magshell("run", tmp_path / f"{name}.yaml", "--no-pictures", "--out", tmp_path / name)
        last = read_path(tmp_path / name)[-1]
        assert last["label"] == "fold"
        folds.append(float(last["interaction"]))
    assert folds[1] == pytest.approx(folds[0], rel=1e-6)
