"""Two domes that snap one after the other: the upper one falls on the lower one and pushes it."""

from typing import Any

import pytest
from conftest import CASES

from magshell_fenicsx import Case
from magshell_fenicsx.input.source import Source, read_source
from magshell_fenicsx.public import run


def alone(shell: dict[str, Any], w: float) -> float:
    """The force on the rim of its hole that moves down by w."""
    load = {"kind": "dead", "control": "displacement", "displacement": w, "points": 1}
    data = {
        "shell": shell["shell"],
        "boundary": shell["boundary"],
        "mesh": {"degree": 3, "size": 0.06},
        "loading": load | {"loads": [{"edge": "hole", "force": [0, 0, -1]}]},
        "symmetry": "none",
    }
    return float(run(Case.from_source(data)).rows[-1]["load_factor"])


@pytest.mark.slow
def test_stacked_domes() -> None:
    """One after the other: the upper one snaps as it does alone, 1e-3, and at its own force falls on the lower one;
    both snap where the force is the sum of those of each alone at its displacement, 2e-2."""
    source = read_source(CASES / "stacked_domes.yaml")
    upper, lower = (source.data["shells"][name] for name in ("upper", "lower"))
    first, touch, last = (row for row in run(Case.from_source(source)).rows if row["label"] == "fold")
    assert first["contact_force"] == 0
    assert abs(first["lower_top_uz"]) < 1e-12
    assert first["load_factor"] == pytest.approx(2.286e-6, rel=1e-3)
    for row in (first, touch):
        assert row["load_factor"] == pytest.approx(alone(upper, -row["upper_top_uz"]), rel=1e-3)
    both = alone(upper, -last["upper_top_uz"]) + alone(lower, -last["lower_top_uz"])
    assert last["load_factor"] == pytest.approx(both, rel=2e-2)
    assert last["load_factor"] == pytest.approx(1.934e-5, rel=2e-3)
    assert last["contact_force"] > 0


@pytest.mark.slow
def test_coaxial_domes() -> None:
    """All around, on the meridians: both folds have the force of 36 sectors of 10 degrees, with their error, 1.5e-3."""
    result = run(Case.load(CASES / "coaxial_domes.yaml"))
    assert result.scene.model.axisymmetric
    first, _, last = (row for row in result.rows if row["label"] == "fold")
    assert first["load_factor"] / 36 == pytest.approx(2.286e-6, rel=1.5e-3)
    assert last["load_factor"] / 36 == pytest.approx(1.934e-5, rel=1.5e-3)


@pytest.mark.slow
def test_a_dome_lands() -> None:
    """It snaps, hits the other dome and comes to rest where the path by arc length has the load of the fold, 1e-5; the
    balance of energy lacks less than 1e-3 of it."""
    mesh, domes = (
        {"mesh": {"size": 0.03}},
        [read_source(CASES / name).data for name in ("dome_lands.yaml", "coaxial_domes.yaml")],
    )
    landed = run(Case.from_source(Source("landed", domes[0] | mesh))).rows
    (fold,), rest = (row for row in landed if row["label"] == "fold"), landed[-1]
    assert rest["contact_force"] > 0
    assert rest["kinetic"] == 0
    assert max(abs(row["imbalance"]) for row in landed if "imbalance" in row) < 1e-3 * rest["stored"]
    loading = domes[1]["loading"] | {"displacement": rest["w_over_h"] * 0.036}
    still = run(Case.from_source(Source("still", domes[1] | mesh | {"loading": loading}))).rows[-1]
    assert still["load_factor"] == pytest.approx(fold["load_factor"], rel=1e-5)
