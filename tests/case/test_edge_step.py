"""Steps of kind: edge: what may move, and the messages."""

from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case
from magshell_fenicsx.case.source import CaseError, Source
from magshell_fenicsx.plan.planner import make_plan

PUSH = {"supports": ["right"], "translation": [-0.01, 0, 0]}
TURN = {"axis": [0, 2, 0], "angle": 90, "point": [1, 0, 0]}


def case(*moves: Any, boundary: Any = None, **step: Any) -> Case:
    """A plate with one step."""
    shell = {"geometry": "plate", "length": 2.0, "width": 0.5, "thickness": 0.02, "poisson_ratio": 0.3}
    held = boundary or {"left": "clamped", "right": "clamped", "bottom": "free"}
    data = {"shell": shell, "boundary": held, "loading": {"kind": "edge", "moves": list(moves), **step}}
    return Case.from_source(Source("test", data))


def test_in_the_model() -> None:
    """Lengths over R, the axis a unit vector times the angle."""
    (move,) = make_plan(case({**PUSH, "rotation": {**TURN, "point": [1, 0, 0]}})).loads.moves
    np.testing.assert_allclose(move.motion.shift, [-0.005, 0, 0])
    np.testing.assert_allclose(move.motion.turn, [0, np.pi / 2, 0], atol=1e-16)
    np.testing.assert_allclose(move.motion.centre, [0.5, 0, 0])


@pytest.mark.parametrize(
    ("moves", "normal"),
    [
        ([PUSH], [0, 1, 0]),
        ([PUSH, {"supports": ["left"], "translation": [0.01, 0, 0]}], [1, 0, 0]),
        ([{"supports": ["right"], "rotation": TURN}], [0, 1, 0]),
        ([{"supports": ["right"], "rotation": {**TURN, "axis": [1, 0, 0]}}], None),
        ([{"supports": ["right"], "translation": [0, 0.01, 0]}], None),
    ],
)
def test_symmetry_that_a_motion_leaves(moves: list[Any], normal: list[float] | None) -> None:
    mirror = make_plan(case(*moves)).mirror
    assert (mirror is None) == (normal is None)
    if mirror and normal:
        np.testing.assert_allclose(np.abs(mirror.normal), normal)


@pytest.mark.parametrize(
    ("moves", "step", "words"),
    [
        ([{"supports": ["bottom"], "translation": [0, 0, 1]}], {}, "supports: bottom: only what boundary holds"),
        (
            [{"supports": ["right"], "translation": [0, 0, 0]}],
            {},
            "a translation that is not zero, a rotation, or both",
        ),
        ([{"supports": ["right"], "rotation": {**TURN, "angle": 0}}], {}, "axis and angle must not be zero"),
        ([PUSH, PUSH], {}, "right: moves twice in one step"),
        ([PUSH], {"name": "lambda_m"}, "name: lambda_m: is taken"),
        ([PUSH], {"name": "a b"}, "name"),
        ([PUSH], {"control": "reaction"}, "needs reaction"),
        ([{**PUSH, "translation": ["1 mm", 0, 0]}], {}, "has a unit, but the shell's lengths have none"),
    ],
)
def test_messages(moves: list[Any], step: dict[str, Any], words: str) -> None:
    with pytest.raises(CaseError, match=words):
        case(*moves, **step)
