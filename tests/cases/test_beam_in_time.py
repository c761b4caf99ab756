"""An arch that snaps in time, against SciPy's integration of a beam in the plane."""

import numpy as np
import pytest
from benchmarks import beam_in_time
from conftest import CASES

from magshell_fenicsx import Case
from magshell_fenicsx.public import run


@pytest.mark.slow
def test_snaps_when_the_beam_does() -> None:
    """A strip of a shell; the beam is `beam_in_time.py`, whose time changes by 1e-6 with finer
    elements and steps.
    """
    times, w = beam_in_time.deflections()
    settings = ["mesh.size=0.08", "loading.0.tolerance=1e-5"]
    rows = run(Case.load(CASES / "benchmarks" / "beam_in_time.yaml", settings)).rows
    at, found = (np.array([float(row[column]) for row in rows]) for column in ("time", "middle_ux"))
    assert beam_in_time.snapped(at, -found) == pytest.approx(
        beam_in_time.snapped(times, w), abs=1e-3
    )
    assert -found == pytest.approx(np.interp(at, times, w), abs=3e-3 * beam_in_time.h)
