"""The cases with programmes run. Their numbers agree with what energy and order imply."""

import numpy as np
import pytest
from conftest import CASES
from scipy.interpolate import CubicSpline

from magshell_fenicsx import Case, run


def test_programme() -> None:
    """The volume is sealed while the force pokes; in the end the pressure alone is left."""
    rows = run(Case.load(CASES / "programme.yaml", ["mesh.refinement=0.5"])).rows
    sealed = [row["volume_change"] for row in rows if row["step"] == 3]
    before = [row for row in rows if row["step"] == 2][-1]
    assert sealed == pytest.approx([before["volume_change"]] * len(sealed), rel=1e-7)
    last = rows[-1]
    pressure = (
        "loading={kind: pressure, control: load, until: target, "
        f"pressure: {last['p_over_pc']}, points: 1}}"
    )
    alone = run(
        Case.load(CASES / "programme.yaml", ["mesh.refinement=0.5", "magnetic=null", pressure])
    ).rows[-1]
    assert last["w_over_h"] == pytest.approx(alone["w_over_h"], rel=1e-7)
    assert (last["step"], last["force"], last["lambda_m"]) == (5, 0.0, 0.0)


def test_probing() -> None:
    """The barrier is the area under the force; it falls to zero where the pressure has its fold
    (its own run).
    """
    found, file = [], CASES / "probing.yaml"
    coarse = ["mesh.refinement=0.5", "shell.defect={kind: dimple, amplitude: 0.5, width: 3.2}"]
    k_d = run(Case.load(file, [*coarse, "loading={kind: pressure, until: limit}"])).knockdown
    assert k_d
    for part in (0.5, 0.8, 0.99, 0.998):
        result = run(Case.load(file, [*coarse, f"loading.0.pressure={part * k_d}"]))
        assert result.stopped is None
        assert result.barrier
        found.append(result.barrier)
        if part == 0.5:
            poked = [
                row for row in result.rows if row["step"] == 2 and row["label"] != "bifurcation"
            ]
            w, F = ([0.0, *(row[name] for row in poked)] for name in ("w_over_h", "force"))
            w[0] = next(row["w_over_h"] for row in reversed(result.rows) if row["step"] == 1)
            unit = result.scene.model.force_unit * result.scene.problem.material.h
            assert CubicSpline(w, F).integrate(w[0], w[-1]) * unit == pytest.approx(
                result.barrier, rel=1e-3
            )
    assert np.all(np.diff(found) < 0)
    # near the fold the barrier grows with the distance to the power of 3/2
    assert np.log(found[2] / found[3]) / np.log(5) == pytest.approx(1.5, abs=0.1)


@pytest.mark.slow
def test_arch_snap() -> None:
    """Measured: the middle snaps through 5 mm at 6.1 to 6.4 mT, above the static fold at 5.53 mT;
    here coarse.
    """
    mesh = "mesh={degree: 3, size: 30 mm}"
    time = ["loading.3.duration=1.0 s", "loading.3.points=50", "loading.3.tolerance=1e-2"]
    rows = run(Case.load(CASES / "arch_snap.yaml", [mesh, "loading.1.points=3", *time])).rows
    moving = [row for row in rows if row["step"] == 4]
    w = np.array([moving[0]["middle_uz"] - row["middle_uz"] for row in moving])
    at = int(np.argmax(w > 5e-3))
    field = (
        16.25
        / 2.5
        * np.interp(5e-3, w[at - 1 : at + 1], [row["time"] for row in moving[at - 1 : at + 1]])
    )
    assert 5.9 < field < 6.4
    energy = [row["kinetic"] + row["stored"] + row["dissipated"] - row["work"] for row in moving]
    assert np.ptp(energy) < 0.05 * max(row["work"] for row in moving)
