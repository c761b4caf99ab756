"""Two domes: the upper one pushes the lower one."""

from typing import Any

import pytest
from conftest import CASES

from magshell_fenicsx import Case
from magshell_fenicsx.input.source import read_source
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
    """In contact the force is the sum of those of each alone at its own displacement, 1e-2; both snap at one fold."""
    source = read_source(CASES / "stacked_domes.yaml")
    shells = source.data["shells"]
    rows = run(Case.from_source(source)).rows
    (touching,) = (row for row in rows if row["label"] == "target" and abs(row["w_over_h"] - 3) < 1e-6)
    parts = [alone(shells[name], -touching[f"{name}_top_uz"]) for name in ("lower", "upper")]
    assert touching["load_factor"] == pytest.approx(sum(parts), rel=1e-2)
    (fold,) = (row for row in rows if row["label"] == "fold")
    assert fold["load_factor"] == pytest.approx(1.970e-6, rel=2e-3)
    assert fold["load_factor"] == max(row["load_factor"] for row in rows)
    assert fold["contact_force"] > 0
