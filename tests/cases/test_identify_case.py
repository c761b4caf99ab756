"""The measured arch: its modulus and remanence from its ramp."""

import csv
from pathlib import Path

import numpy as np
import pytest
from conftest import CASES

import magshell_fenicsx as ms


@pytest.mark.slow
def test_identify_arch(tmp_path: Path) -> None:
    """Both are as published (67.5 mT, 4.2 MPa) within their bands, their ratio to three deviations;
    data in theirs.

    On a coarse mesh, from each third datum.
    """
    head, *lines = (CASES / "identify_arch.csv").read_text(encoding="utf-8").splitlines()
    data = tmp_path / "each_third.csv"
    data.write_text("\n".join([head, *lines[::3]]), encoding="utf-8")
    coarse = [
        "mesh={size: 20 mm, degree: 3}",
        "loading.1.points=5",
        "identify.candidates=[]",
        "identify.predict={}",
    ]
    found = ms.identify(CASES / "identify_arch.yaml", data, coarse, tmp_path / "out")
    keys = ("shell.youngs_modulus", "magnetic.remanent.flux_density")
    modulus, remanence = (found.parameters[key] for key in keys)
    assert modulus["low"] < 4.2 < modulus["high"]
    assert remanence["low"] < 67.5 < remanence["high"]
    ratio = remanence["value"] / modulus["value"]
    slope = ratio * np.array([-1 / modulus["value"], 1 / remanence["value"]])
    assert ratio == pytest.approx(67.5 / 4.2, abs=3 * float(found.fit.spread(slope[None])[0]))
    rows = found.content["rows"]
    assert len(rows) == len(list(csv.DictReader(data.open())))
    inside = sum(row["low_measured"] < row["measured"] < row["high_measured"] for row in rows)
    assert inside >= len(rows) - 1
