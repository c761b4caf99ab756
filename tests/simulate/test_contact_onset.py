"""Where a step of a path ends before shells touch."""

from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import StepOptions
from magshell_fenicsx.continuation.step_control import StepEvent
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.simulate.contact_onset import first_contact

h = 0.01
MOVES = [{"supports": ["upper.left"], "translation": [0, 0, h]}]
EDGE = {"kind": "edge", "name": "w", "control": "load", "factor": 1, "points": 1, "moves": MOVES}


def strip(z: float) -> dict[str, Any]:
    """A clamped strip at a height."""
    shell = {
        "geometry": "plate",
        "length": 1,
        "width": 0.2,
        "thickness": h,
        "youngs_modulus": 1,
        "poisson_ratio": 0,
    }
    return {"shell": shell, "boundary": {"left": "clamped"}, "place": {"position": [0, 0, z]}}


@pytest.fixture(scope="module")
def stack() -> Scene:
    """Three strips, with gaps of h between them."""
    shells = {"lower": strip(-2 * h), "middle": strip(0), "upper": strip(2 * h)}
    pairs = [["upper", "middle"], ["lower", "middle"]]
    mesh = {"degree": 2, "size": 0.2}
    return Scene(
        Case.from_source({"shells": shells, "contact": pairs, "mesh": mesh, "loading": EDGE})
    )


def lifted(scene: Scene, **up: float) -> State:
    """Shells moved up as they are, by so many h."""
    u = np.zeros((len(scene.model.r0.x.array) // 3, 3))
    for name, by in up.items():
        u[np.unique(scene.model.V.dofmap.list[scene.model.midsurface.patches[name]]), 2] = by * h
    return State(u.ravel(), scene.unloaded().mu)


def test_another_pair_meets_where_one_lets_go(stack: Scene) -> None:
    """The gap of the other pair, from h to -h, is 0.002 h left at 0.499 of the way; with nothing
    else alike.
    """
    here, guess = lifted(stack, upper=-1.001), lifted(stack, lower=2)
    ahead = first_contact(stack, lambda state: state, here, guess)
    assert ahead.loses_forces
    assert not ahead.ends_behind
    assert ahead.fraction == pytest.approx(0.499, abs=1e-3)
    alone = first_contact(stack, lambda state: state, lifted(stack), guess)
    assert (alone.fraction, alone.loses_forces) == (ahead.fraction, False)
    assert first_contact(stack, lambda state: state, here, lifted(stack)) == StepEvent(
        loses_forces=True, is_deep=True
    )


def test_a_step_on_which_one_lets_go_ends_before_another_meets(
    stack: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tangent alone foresees it, and is looked along again."""
    asked = list[State]()

    def ahead(here: State, guess: State) -> StepEvent:
        asked.append(guess)
        return StepEvent(0.5 if len(asked) == 2 else 1.0, loses_forces=len(asked) <= 2)

    stage_path = Path(stack.newton, "w", "load", StepOptions(0.1, 0.1, 1e-4), step_event=ahead)
    point, _ = next(stage_path.continue_to(stage_path.start(stack.unloaded()), [0.1]))
    assert point.s == pytest.approx(0.05, rel=1e-12)


CAP = {
    "geometry": "cap",
    "radius": 1,
    "polar": 30,
    "thickness": 2 * h,
    "youngs_modulus": 1,
    "poisson_ratio": 0.3,
}


@pytest.mark.parametrize("symmetry", ["auto", "half"])
def test_check_says_by_how_much_shells_overlap(symmetry: str) -> None:
    """A gap of 0.75 of the thickness is an overlap by 0.25; in the words of a run, which may see
    another place.
    """
    lower, upper = (
        {"shell": CAP | {"radius": r}, "boundary": {"rim": "clamped"}} for r in (1, 1.4)
    )
    upper["place"] = {"position": [0, 0, 2.4 + 0.75 * 2 * h], "axis": {"polar": 180}}
    shells = {
        "shells": {"lower": lower, "upper": upper},
        "contact": [["upper", "lower"]],
        "symmetry": symmetry,
    }
    case = Case.from_source(
        shells | {"loading": {"kind": "pressure", "pressure": 0.1, "until": "target", "points": 1}}
    )
    said = (
        r"contact: upper and lower overlap undeformed, by 0.2[45]\d* h at \(.*\) R: move them apart"
    )
    with pytest.raises(CaseError, match=said):
        describe(case)
    with pytest.raises(MeshError, match=said):
        Scene(case)
