"""Two domes that snap one after the other: the upper one falls on the lower one and pushes it."""

from typing import Any

import numpy as np
import pytest
from conftest import CASES

from magshell_fenicsx import Case
from magshell_fenicsx.input.source import Source, read_source
from magshell_fenicsx.public import run

FIRST = 2.286e-6  # the force of the first fold on a sector of 10 degrees


def alone(shell: dict[str, Any], w: float) -> float:
    """The force on the rim of its hole that moves down by w."""
    load = {"kind": "dead", "control": "displacement", "displacement": w, "points": 1}
    data = {
        "shell": shell["shell"],
        "boundary": shell["boundary"],
        "mesh": {"size": 0.03},
        "loading": load | {"loads": [{"edge": "hole", "force": [0, 0, -1]}]},
    }
    return float(run(Case.from_source(data)).rows[-1]["load_factor"])


@pytest.mark.slow
def test_coaxial_domes() -> None:
    """One after the other: the upper one snaps as it does alone, 1e-3, and at its own force falls
    on the lower one; both snap where the force is the sum of those of each alone at its
    displacement, 2e-2. On
    meridians.
    """
    source = read_source(CASES / "coaxial_domes.yaml")
    upper, lower = (source.data["shells"][name] for name in ("upper", "lower"))
    points = {"points": {"top": [np.sin(np.radians(2)), 0, np.cos(np.radians(2))]}}
    shells = {"shells": {"lower": lower | points, "upper": upper | points}}
    result = run(Case.from_source(Source("coaxial", source.data | shells)))
    assert result.scene.model.axisymmetric
    first, touch, last = (row for row in result.rows if row["label"] == "fold")
    assert first["contact_force"] == 0
    assert abs(first["lower_top_uz"]) < 1e-12
    assert first["load_factor"] / 36 == pytest.approx(FIRST, rel=1.5e-3)
    for row in (first, touch):
        assert row["load_factor"] == pytest.approx(alone(upper, -row["upper_top_uz"]), rel=1e-3)
    both = alone(upper, -last["upper_top_uz"]) + alone(lower, -last["lower_top_uz"])
    assert last["load_factor"] == pytest.approx(both, rel=2e-2)
    assert last["load_factor"] / 36 == pytest.approx(1.934e-5, rel=1.5e-3)
    assert last["contact_force"] > 0


@pytest.mark.slow
def test_stacked_domes() -> None:
    """A sector of 10 degrees on surfaces: the first fold is that of the meridians."""
    settings = ["loading.until=limit", "loading.displacement=null", "loading.points=2"]
    (fold,) = run(Case.load(CASES / "stacked_domes.yaml", settings)).limit_points
    assert fold["value"] == pytest.approx(FIRST, rel=1e-3)


@pytest.mark.slow
def test_a_dome_lands() -> None:
    """It snaps, hits the other dome and comes to rest where the path by arc length has the load of
    the fold, 1e-5; the balance of energy lacks less than 1e-3 of it.
    """
    mesh, domes = (
        {"mesh": {"size": 0.03}},
        [read_source(CASES / name).data for name in ("dome_lands.yaml", "coaxial_domes.yaml")],
    )
    landed = run(Case.from_source(Source("landed", domes[0] | mesh))).rows
    (fold,), rest = (row for row in landed if row["label"] == "fold"), landed[-1]
    assert rest["contact_force"] > 0
    assert rest["kinetic"] == 0
    assert (
        max(abs(row["imbalance"]) for row in landed if "imbalance" in row) < 1e-3 * rest["stored"]
    )
    loading = domes[1]["loading"] | {"displacement": rest["w_over_h"] * 0.036}
    still = run(Case.from_source(Source("still", domes[1] | mesh | {"loading": loading}))).rows[-1]
    assert still["load_factor"] == pytest.approx(fold["load_factor"], rel=1e-5)
