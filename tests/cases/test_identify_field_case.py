"""The remanence of a strip as a field of numbers, from two shapes that were computed for a known
one.
"""

from pathlib import Path

import numpy as np
import pytest
from conftest import CASES

import magshell_fenicsx as ms


@pytest.mark.slow
def test_identify_field(tmp_path: Path) -> None:
    """The misfit is at the noise that was added (0.02 mm), and the bands hold the remanence that
    was put in.

    On a coarse mesh, of 12 points, from each third place.
    """
    head, *lines = (CASES / "identify_field.csv").read_text(encoding="utf-8").splitlines()
    data = tmp_path / "each_third.csv"
    data.write_text("\n".join([head, *lines[2::3]]) + "\n", encoding="utf-8")
    coarse = ["mesh={degree: 3, refinement: 0.3}", "identify.remanence.points=12"]
    found = ms.identify(CASES / "identify_field.yaml", data, coarse, tmp_path / "out")
    field = found.remanence
    assert field
    x = np.array(field["places"])[:, 0]
    polar, size = 1.3 + 0.5 * np.sin(4 * x), 1 + 0.3 * np.cos(5 * x)
    truth = size[:, None] * np.column_stack([np.sin(polar), np.cos(polar)])
    assert field["components"] == ["bx", "bz"]
    assert np.mean((np.array(field["low"]) < truth) & (truth < np.array(field["high"]))) > 0.85
    assert np.array(field["deviation"]).max() < 0.3
    for noise in found.content["noise"].values():
        assert noise["deviation"] == pytest.approx(
            0.02, rel=0.4
        )  # of some 15 degrees of freedom each
    assert 0.7 < found.content["misfit_over_noise"] < 1.1
    assert found.content["normal"]["difference"] < found.content["normal"]["within"]
