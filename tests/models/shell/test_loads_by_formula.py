"""Dead loads whose components are formulas of the undeformed place."""

from typing import Any

import numpy as np
import pytest

import magshell_fenicsx as ms
from magshell_fenicsx.case.planner import make_problem

PLATE = {
    "geometry": "plate",
    "length": 2,
    "width": 1,
    "thickness": 0.02,
    "youngs_modulus": 3.0,
    "poisson_ratio": 0.3,
}
COARSE = {"refinement": 0.5}
CAP = {
    "geometry": "cap",
    "polar": 60,
    "radius": 2,
    "thickness": 0.04,
    "youngs_modulus": 3.0,
    "poisson_ratio": 0.3,
}


def load(shell: dict[str, Any], *loads: dict[str, Any], **sections: Any) -> ms.Case:
    loading = {"kind": "dead", "control": "load", "factor": 1, "points": 1, "loads": list(loads)}
    return ms.Case.from_source({"shell": shell, "loading": loading, **sections})


def end(case: ms.Case) -> dict[str, float]:
    scene = ms.Scene(case)
    *_, last = ms.follow(scene)
    return scene.observe(last.point.state)


def test_sine_on_a_plate() -> None:
    """Navier: q = q0 sin(pi x/a) sin(pi y/b) bends a simply supported plate to w = q / (pi^4 D
    (1/a^2 + 1/b^2)^2).
    """
    q0, D = 1e-12, 3.0 * 0.02**3 / (12 * 0.91)
    boundary = dict.fromkeys(("left", "right", "bottom", "top"), "hinged")
    q = f"{q0}*sin(pi*x/2)*sin(pi*y)"
    for here in ({"per_area": [0, 0, q]}, {"pressure": f"-{q}"}):
        found = end(
            load(
                PLATE,
                {"over": "all", **here},
                boundary=boundary,
                points={"middle": [1, 0.5, 0]},
                mesh={"degree": 4, "size": 0.25},
            )
        )
        assert found["middle_uz"] == pytest.approx(q0 / (np.pi**4 * D * (1 / 4 + 1) ** 2), rel=2e-5)


@pytest.mark.parametrize(
    ("load_", "refinement"),
    [
        ({"pressure": "1e-6*(1 + z)"}, 1.0),
        pytest.param({"per_area": ["1e-6*x", "1e-6*y", "-1e-6*z**2"]}, 1.5, marks=pytest.mark.slow),
    ],
)
def test_meridian_half_and_solid(load_: dict[str, Any], refinement: float) -> None:
    """What is the same around the axis leaves the meridian; half and solid agree with it."""

    def of(**sections: Any) -> ms.Case:
        return load(CAP, {"over": "all", **load_}, boundary={"rim": "clamped"}, **sections)

    assert make_problem(of()).included[0] == "meridian"
    meridian, half = (
        end(of()),
        end(of(symmetry="half", mesh={"degree": 4, "refinement": refinement})),
    )
    assert half["w_pole_over_h"] == pytest.approx(meridian["w_pole_over_h"], rel=2e-4)
    assert half["energy"] == pytest.approx(meridian["energy"], rel=2e-4)
    solid = end(of(symmetry="half", model="solid", mesh={"refinement": 0.6}))
    assert solid["w_pole_over_h"] == pytest.approx(meridian["w_pole_over_h"], rel=0.03)


def test_what_a_formula_leaves() -> None:
    """cos(2 theta) is left by the planes through e3 at 0 and 90 degrees, x by one, x + y**3 by
    none.
    """
    for text, model in (
        ("cos(2*arctan2(y, x))", "half shell"),
        ("x", "half shell"),
        ("x + y**3", "full shell"),
        ("1", "meridian"),
    ):
        case = load(CAP, {"over": "all", "pressure": text}, boundary={"rim": "clamped"})
        assert make_problem(case).included[0] == model, text


def test_on_an_edge() -> None:
    """sin(pi y) per length of an edge has the resultant 2/pi."""
    force = 1e-9
    case = load(
        PLATE,
        {"edge": "right", "per_length": [f"{force}*sin(pi*y)", 0, 0]},
        boundary={"left": {"held": ["x", "y", "z"]}, "top": {"held": ["z"]}},
        mesh={"degree": 2, "size": 0.25},
    )
    scene = ms.Scene(case)
    unit = 3.0 * 0.02 * 2  # E h R
    column = (
        scene.model.system.load(scene.model.zero(), scene.unloaded().mu, "load")
        .reshape(-1, 3)
        .sum(axis=0)
    )
    assert -column[0] * unit == pytest.approx(force * 2 / np.pi, rel=1e-4)


def test_units_and_refusals() -> None:
    """Text is a number with a unit or a formula; a formula without a value is refused where it has
    none.
    """
    assert load(PLATE, {"over": "all", "pressure": "2*x"}, boundary={"left": "clamped"})
    for value, said in (
        ("5 furlongs", "is not convertible to pascal"),
        ("import os", "is not"),
        ("5 Pa", "has a unit"),
    ):
        with pytest.raises(ms.CaseError, match=said):
            load(PLATE, {"over": "all", "pressure": value}, boundary={"left": "clamped"})
    with pytest.raises(Exception, match=r"loading.loads.0.*: is .* at"):
        ms.Scene(
            load(PLATE, {"over": "all", "pressure": "1/(x - x)"}, boundary={"left": "clamped"})
        )


@pytest.mark.parametrize(
    "model",
    [
        {},
        {"symmetry": "half", "mesh": {"degree": 3, "size": 0.6}},
        pytest.param(
            {"model": "solid", "symmetry": "half", "mesh": COARSE}, marks=pytest.mark.slow
        ),
    ],
    ids=["meridian", "half", "solid"],
)
def test_potential_is_a_dead_load_where_it_is_linear(model: dict[str, Any]) -> None:
    """V = g z is the weight -g e3; it leaves the meridian, V = g x a half."""
    weight = [{"per_area": [0, 0, -1e-6]}, {"potential": "1e-6*z"}]
    dead, place = (
        end(load(CAP, {"over": "all", **w}, boundary={"rim": "clamped"}, **model)) for w in weight
    )
    rel = 0.03 if "model" in model else 1e-9  # of the outer face of a solid
    assert place["w_pole_over_h"] == pytest.approx(dead["w_pole_over_h"], rel=rel)
    assert place["energy"] == pytest.approx(dead["energy"], rel=2 * rel)
    problems = [
        make_problem(load(CAP, {"over": "all", "potential": v}, boundary={"rim": "clamped"}))
        for v in ("z", "x")
    ]
    assert [problem.included[0] for problem in problems] == ["meridian", "half shell"]


def test_springs_to_a_wall() -> None:
    """A plate on a foundation k that springs c draw to z = a, V = c (z - a)^2/2: it moves by a c/(k
    + c).
    """
    case = load(
        PLATE,
        {"over": "all", "potential": "3e-3*(z - 0.1)**2/2"},
        boundary={"left": {"held": ["x"]}, "bottom": {"held": ["y"]}},
        foundation={"stiffness": 1e-3},
        points={"middle": [1, 0.5, 0]},
        mesh={"degree": 2, "size": 0.5},
        symmetry="none",
    )
    assert end(case)["middle_uz"] == pytest.approx(0.075, rel=1e-9)


def test_potential_is_refused_where_it_is_none() -> None:
    """It has no displacement of its own, and no patch."""
    for more, said in (
        ({"over": "lid"}, "goes with over: all"),
        ({"over": "all"}, "a potential has none"),
    ):
        loading = {
            "kind": "dead",
            "control": "displacement",
            "displacement": 1,
            "loads": [{"potential": "z", **more}],
        }
        with pytest.raises(ms.CaseError, match=said):
            ms.Case.from_source({"shell": CAP, "loading": loading, "boundary": {"rim": "clamped"}})


@pytest.mark.parametrize(
    ("load_", "warned"),
    [
        ({"pressure": "1e-6*(1 + 0*z)"}, True),
        ({"pressure": 1e-6}, False),
        ({"per_area": [0, 0, "1e-6*x"]}, False),
        ({"per_area": ["-1e-6*z*x", "-1e-6*z*y", "-1e-6*z*z"]}, True),
        ({"per_area": ["-1e-6*z*x", "-1e-6*z*y", 0]}, False),
    ],
)
def test_warning_of_a_dead_pressure_by_formula(load_: dict[str, Any], warned: bool) -> None:
    """A fluid's pressure turns with the surface: a long tube buckles at 3 D/R³ under it, at 4 D/R³
    under a dead one."""
    case = load(
        CAP,
        {"at": "top", "force": [0, 0, -1e-6]},
        {"over": "all", **load_},
        boundary={"rim": "clamped"},
        points={"top": [0, 0, 2]},
    )
    warnings = make_problem(case).warnings
    assert len(warnings) == warned
    assert all(
        said.startswith(f"loading.loads.1.{key}: dead: per undeformed area")
        for said in warnings
        for key in load_
    )
