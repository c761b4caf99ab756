"""Energies that are no numbers: a run stops at once and names them."""

from pathlib import Path

import pytest
import ufl
from ufl.core.expr import Expr

from magshell_fenicsx import Case, Jet, OwnTerm
from magshell_fenicsx.public import run

CAP = {
    "shell": {
        "geometry": "cap",
        "polar": 30,
        "radius": 1.0,
        "thickness": 0.016,
        "poisson_ratio": 0.3,
    },
    "boundary": {"rim": "clamped"},
    "symmetry": "none",
    "mesh": {"degree": 2, "refinement": 0.2},
}
LOADED = {"kind": "pressure", "pressure": 0.5, "until": "target"}
MOVING = {
    "kind": "time",
    "duration": 20.0,
    "points": 4,
    "history": {"pressure": {"kind": "ramp", "to": 0.5, "over": 5}},
}


def on_a_part(r0: Jet, u: Jet) -> Expr:
    """A number near the pole alone."""
    return ufl.sqrt(r0.r[2] - 0.95) * ufl.dot(u.r, u.r)


def steep(r0: Jet, u: Jet) -> Expr:
    """A number, without a derivative where nothing has moved."""
    return ufl.sqrt(ufl.dot(u.r, u.r) ** 1.5)


def ended(r0: Jet, u: Jet) -> Expr:
    """A number until the shell has moved down by 0.005 R. No force there would hold it."""
    return 1e-4 * (0.005 + u.r[2]) ** 2.5


@pytest.mark.parametrize("energy", [on_a_part, steep])
def test_at_the_begin(energy: object, tmp_path: Path) -> None:
    """No step could be small enough: it never ended."""
    case = Case.from_source({**CAP, "loading": [LOADED]})
    found = run(case, tmp_path / "out", terms=[OwnTerm("own", energy, value=1.0)], pictures=False)  # type: ignore[arg-type]
    assert found.stopped == "own is not a number at its begin, in value or derivative"
    assert len(found.rows) == 1
    assert (tmp_path / "out" / "summary.json").exists()


@pytest.mark.parametrize("step", [pytest.param(LOADED, marks=pytest.mark.slow), MOVING])
def test_on_the_way(step: dict[str, object], tmp_path: Path) -> None:
    """Steps become small, then the run stops; its points are there."""
    case = Case.from_source({**CAP, "loading": [step]})
    found = run(case, tmp_path / "out", terms=[OwnTerm("own", ended, value=1.0)], pictures=False)
    assert found.stopped
    assert found.stopped.endswith("; where it was tried last, own was not a number")
    assert found.rows
