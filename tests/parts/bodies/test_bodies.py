"""Bodies of a case: their distances against differences and plain geometry, their places, and what
is refused.
"""

from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case, CaseError
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.problem.problem import Problem

SHELL = {"geometry": "hemisphere", "radius_to_thickness": 50, "poisson_ratio": 0.3}
BODIES: dict[str, dict[str, Any]] = {
    "plane": {"kind": "plane", "direction": [0.1, 0.2, -1]},
    "sphere": {"kind": "sphere", "radius": 0.3},
    "cylinder": {"kind": "cylinder", "radius": 0.3, "axis": [1, 0.5, 0.2]},
    "rod": {"kind": "rod", "radius": 0.3, "edge": 0.1, "direction": [0.3, 0, -1]},
    "box": {"kind": "box", "size": [0.4, 0.6, 0.8], "edge": 0.1, "axis": [1, 1, 0]},
}
ABOVE = [0, 0, 2.5]


def problem(bodies: dict[str, Any], **sections: Any) -> Problem:
    data = {
        "shell": SHELL,
        "boundary": {"equator": "clamped"},
        "bodies": bodies,
        "symmetry": "none",
        **sections,
    }
    return make_problem(Case.model_validate(data))


@pytest.mark.parametrize("kind", BODIES)
def test_distance(kind: str) -> None:
    """|grad g| = 1 outside, gradient and Hessian by central differences, and g grows along its
    gradient.
    """
    (contact,) = problem({"a": {**BODIES[kind], "position": ABOVE}}).loads.contacts
    x = np.random.default_rng(1).uniform([-1, -1, 0.5], [1, 1, 2.5], (200, 3))
    g, n, H = contact.distance(x)
    kept, step = g > 0.02, 1e-6
    x, g, n, H = x[kept], g[kept], n[kept], H[kept]
    assert len(x) > 100
    assert np.linalg.norm(n, axis=1) == pytest.approx(1)
    assert contact.distance(x + 0.1 * n)[0] == pytest.approx(
        g + 0.1
    )  # convex: the nearest place is the same
    low, high = (
        np.stack([contact.distance(x + s * e)[0] for e in np.eye(3)], -1) for s in (-step, step)
    )
    assert (high - low) / (2 * step) == pytest.approx(n, abs=1e-8)
    low, high = (
        np.stack([contact.distance(x + s * e)[1] for e in np.eye(3)], -1) for s in (-step, step)
    )
    smooth = np.abs((high - low) / (2 * step) - H).max(axis=(1, 2)) < 1e-6
    assert smooth.mean() > 0.97  # the curvature jumps where a rounding begins
    foot = x - g[:, None] * n
    centre = contact.front - (0.8 if kind == "box" else 0.6) / 2 * contact.direction
    if kind == "sphere":
        assert np.linalg.norm(foot - centre, axis=1) == pytest.approx(0.3)
    elif kind == "box":
        assert (np.abs(foot - centre) @ np.ones(3) < 2).all()
    elif kind == "plane":
        assert (foot - contact.front) @ contact.direction == pytest.approx(0, abs=1e-12)


def test_places() -> None:
    """By default the front touches the face at `at`, from its side; a frame that turns takes the
    body along.
    """
    h, at = 1 / 50, {"polar": 30, "azimuth": 50}
    normal = Case.model_validate(
        {"shell": SHELL, "boundary": {"equator": "clamped"},
         "bodies": {"a": {"kind": "plane", "at": at}}}
    ).bodies["a"].at.vector()  # fmt: skip
    (outside,) = problem({"a": {"kind": "sphere", "radius": 0.2, "at": at}}).loads.contacts
    (inside,) = problem(
        {"a": {"kind": "sphere", "radius": 0.2, "at": at, "side": "inside"}}
    ).loads.contacts
    assert outside.front == pytest.approx((1 + h / 2) * normal)
    assert outside.direction == pytest.approx(-normal)
    assert inside.front == pytest.approx((1 - h / 2) * normal)
    assert inside.direction == pytest.approx(normal)
    half = problem({"a": {"kind": "sphere", "radius": 0.2, "at": at}}, symmetry="half")
    assert half.is_half
    assert half.azimuth % np.pi == pytest.approx(np.radians(50))
    (turned,) = half.loads.contacts
    assert turned.direction[1] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("body", "model"),
    [
        ({"kind": "sphere", "radius": 0.2}, "meridian"),
        ({"kind": "rod", "radius": 0.2, "edge": 0.1}, "meridian"),
        ({"kind": "cylinder", "radius": 0.2, "axis": [1, 2, 0]}, "half"),
        ({"kind": "box", "size": [0.2, 0.3, 0.3], "edge": 0.05, "axis": [1, 0, 0]}, "half"),
        ({"kind": "box", "size": [0.2, 0.3, 0.3], "edge": 0.05, "axis": [1, 2, 0]}, "half"),
        ({"kind": "plane", "at": {"polar": 20}}, "half"),
        (
            {
                "kind": "box",
                "size": [0.2, 0.3, 0.3],
                "edge": 0.05,
                "axis": [1, 1, 0],
                "at": {"polar": 20},
            },
            "full",
        ),
    ],
)
def test_symmetry(body: dict[str, Any], model: str) -> None:
    """`symmetry: auto` finds the smallest model that a body leaves."""
    found = problem({"a": body}, symmetry="auto")
    assert ("meridian" if found.axisymmetric else "half" if found.is_half else "full") == model


def test_plane_of_an_oblique_box() -> None:
    """It holds the axis or is normal to it. A body that is not in the one leaves the other."""
    box = {"kind": "box", "size": [0.2, 0.3, 0.3], "edge": 0.05, "axis": [1, 2, 0]}
    found = problem({"a": box}, symmetry="half")
    along = np.degrees(np.arctan2(2, 1))
    assert np.degrees(found.azimuth) % 90 == pytest.approx(along)
    across = np.array([-2, 1]) / np.sqrt(5)
    ball = {
        "kind": "sphere",
        "radius": 0.1,
        "position": [*(0.6 * across), 2.0],
        "direction": [0, 0, -1],
    }
    found = problem({"a": box, "b": ball}, symmetry="auto")
    assert found.is_half
    assert np.degrees(found.azimuth) % 180 == pytest.approx((along + 90) % 180)


APART = {"kind": "sphere", "radius": 0.2, "position": [0.3, 0, 1.5]}


@pytest.mark.parametrize(
    ("bodies", "words"),
    [
        (
            {"a": {"kind": "plane", "position": [0, 0, 0.9]}},
            "penetrates the undeformed shell by 5.5 h",
        ),
        (
            {"a": {"kind": "sphere", "radius": 1.2, "side": "inside"}},
            "bodies.a.at: the body penetrates",
        ),
        (
            {"a": APART, "b": {**APART, "position": [0, 0, 1.5]}},
            "bodies.b.position: overlaps bodies.a",
        ),
        (
            {"a": {"kind": "cylinder", "radius": 0.1, "axis": [0, 0, 1]}},
            "bodies.a.axis: is along the approach",
        ),
    ],
)
def test_refused(bodies: dict[str, Any], words: str) -> None:
    """Bodies that begin within the shell, or in the way of each other."""
    with pytest.raises(CaseError, match=words):
        problem(bodies, loading={"kind": "contact", "body": "a", "approach": 1})


def test_two_obstacles_may_overlap() -> None:
    """If neither moves."""
    assert len(problem({"a": APART, "b": {**APART, "position": [0, 0, 1.5]}}).loads.contacts) == 2


PART = {"geometry": "cap", "radius": 1, "thickness": 0.03, "polar": 85, "hole": 15}
PART |= {"azimuth": [-10, 10], "youngs_modulus": 1, "poisson_ratio": 0.3}
BALL = {"kind": "sphere", "radius": 0.5, "position": [0, 0, 0], "direction": [0, 0, 1]}


@pytest.mark.parametrize(
    ("ball", "message"),
    [
        ({"direction": None},
         r"bodies.ball.at: is not given, and the pole is in the hole of the shell: give"),
        ({"at": {"polar": 10}},
         r"bodies.ball.at.polar: 10: is not on the shell: allowed 15 to 85, beside its hole"),
        ({"at": {"polar": 40, "azimuth": 90}},
         r"bodies.ball.at.azimuth: 90: is not on the shell: allowed -10 to 10"),
    ],
)  # fmt: skip
def test_a_ball_beside_a_hole(ball: dict[str, Any], message: str) -> None:
    """A place and a direction say where it is: the pole, which is in the hole, is not asked for."""
    (contact,) = problem({"ball": BALL}, shell=PART, boundary={"hole": "clamped"}).loads.contacts
    assert contact.distance(np.array([[0, 0, 1.0]]))[0] == pytest.approx(0.5)
    with pytest.raises(CaseError, match=message):
        problem({"ball": {**BALL, **ball}}, shell=PART, boundary={"hole": "clamped"})


def test_a_bar_that_stays_needs_no_direction() -> None:
    """Above a plate, which has no pole: the bar is at its position, across the nearest normal."""
    plate = {"geometry": "plate", "length": 1, "width": 0.5, "thickness": 0.02}
    bar = {"kind": "cylinder", "radius": 0.2, "axis": [0, 1, 0], "position": [0.7, 0, 0.3]}
    shell = plate | {"poisson_ratio": 0, "youngs_modulus": 1}
    (contact,) = problem({"a": bar}, shell=shell, boundary={"left": "clamped"}).loads.contacts
    assert contact.distance(np.array([[0.7, 0.2, 0]]))[0] == pytest.approx(0.1)
    assert contact.direction == pytest.approx([0, 0, -1])
