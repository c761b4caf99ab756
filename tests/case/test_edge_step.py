"""Steps of kind: edge: what may move, and the messages."""

from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError

PUSH = {"supports": ["right"], "translation": [-0.01, 0, 0]}
TURN = {"axis": [0, 2, 0], "angle": 90, "point": [1, 0, 0]}


def case(*moves: Any, boundary: Any = None, **step: Any) -> Case:
    """A plate with one step."""
    shell = {
        "geometry": "plate",
        "length": 2.0,
        "width": 0.5,
        "thickness": 0.02,
        "poisson_ratio": 0.3,
    }
    held = boundary or {"left": "clamped", "right": "clamped", "bottom": "free"}
    data = {
        "shell": shell,
        "boundary": held,
        "loading": {"kind": "edge", "moves": list(moves), **step},
    }
    return Case.from_source(data)


def test_in_the_model() -> None:
    """Lengths over R, the axis a unit vector times the angle."""
    (move,) = make_problem(case({**PUSH, "rotation": {**TURN, "point": [1, 0, 0]}})).loads.moves
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
    mirror = make_problem(case(*moves)).mirror
    assert (mirror is None) == (normal is None)
    if mirror and normal:
        np.testing.assert_allclose(np.abs(mirror.normal), normal)


@pytest.mark.parametrize(
    ("moves", "step", "words"),
    [
        (
            [{"supports": ["bottom"], "translation": [0, 0, 1]}],
            {},
            "supports: bottom: only what boundary holds",
        ),
        (
            [{"supports": ["right"], "translation": [0, 0, 0]}],
            {},
            "a translation that is not zero, a rotation, or both",
        ),
        (
            [{"supports": ["right"], "rotation": {**TURN, "angle": 0}}],
            {},
            "axis and angle must not be zero",
        ),
        ([PUSH, PUSH], {}, "right: moves twice in one step"),
        ([PUSH], {"name": "lambda_m"}, "name: lambda_m: is taken"),
        ([PUSH], {"name": "a b"}, "name"),
        ([PUSH], {"control": "reaction"}, "needs reaction"),
        (
            [{**PUSH, "translation": ["1 mm", 0, 0]}],
            {},
            "has a unit, but the shell's lengths have none",
        ),
    ],
)
def test_messages(moves: list[Any], step: dict[str, Any], words: str) -> None:
    with pytest.raises(CaseError, match=words):
        case(*moves, **step)


BODY = {"plate": {"kind": "plane", "at": {"point": [1.0, 0.25, 0.0]}, "direction": [0, 0, -1]}}


@pytest.mark.parametrize(
    ("name", "more", "words"),
    [
        ("left_fx", {}, r"loading\.name: left_fx: another column of path\.csv"),
        (
            "tip_uz",
            {"points": {"tip": [1, 0.25, 0]}},
            r"loading\.name: tip_uz: another column of path\.csv",
        ),
        ("stiffness_plate", {"bodies": BODY}, r"loading\.name: stiffness_plate: another amplitude"),
        ("left_uz", {"points": {"tip": [1, 0.25, 0]}}, None),
    ],
)
def test_names_that_other_columns_have(name: str, more: dict[str, Any], words: str | None) -> None:
    """Of reactions, points and bodies; what no other column has is a name."""
    given = case(PUSH, name=name)
    asked = Case.from_source(given.model_dump(mode="json", exclude_none=True) | more)
    if words is None:
        assert make_problem(asked).reactions
        return
    with pytest.raises(CaseError, match=words):
        make_problem(asked)


def test_names_that_columns_in_units_have() -> None:
    """`left_fx_N` is the reaction of the clamped edge in newtons."""
    shell = {
        "geometry": "plate",
        "length": "100 mm",
        "width": "20 mm",
        "thickness": "1 mm",
        "youngs_modulus": "1 MPa",
    }
    move = {"supports": ["right"], "translation": ["0 mm", "0 mm", "1 mm"]}
    data = {
        "shell": shell | {"poisson_ratio": 0.3},
        "boundary": {"left": "clamped", "right": "clamped"},
    }
    data |= {"loading": {"kind": "edge", "name": "left_fx_N", "moves": [move], "points": 1}}
    with pytest.raises(
        CaseError, match=r"left_fx_N: another column of path\.csv of this case has this name"
    ):
        make_problem(Case.from_source(data))
