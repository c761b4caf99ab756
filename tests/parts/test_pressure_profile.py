"""A live pressure with a profile: a fluid's depth on closed shells and on a tank, and the way that
its energy, forces and tangent follow from each other.
"""

from dataclasses import replace
from math import cos, exp, sin, sqrt
from typing import Any

import numpy as np
import pytest
from along import check, csr

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.pressure.profile import PressureProfile, polynomial_degree
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.sensitivity import sensitivities
from magshell_fenicsx.simulate.steps import fold_at

MATERIAL = {"thickness": 0.01, "youngs_modulus": 1, "poisson_ratio": 0.3}
POLYNOMIAL = "1 - 0.7*z + 0.4*x*y - 0.3*x**2*z"


def made(**sections: Any) -> Case:
    return Case.from_source(sections)


def loaded(profile: str, **further: Any) -> dict[str, Any]:
    return {"kind": "pressure", "control": "load", "until": "target", "pressure": 1e-3,
            "points": 1, "profile": profile, **further}  # fmt: skip


@pytest.mark.parametrize(
    ("text", "degree"),
    [("1", 0), ("0", -1), ("z - z", -1), ("1 - z/0.3", 1), ("(x + y)**2*z - x**3", 3),
     ("sqrt(2)*x", 1), ("1e-20*z", 1), ("abs(z)", None), ("1/z", None), ("2**z", None),
     ("z**0.5", None)],
)  # fmt: skip
def test_degree_of_a_polynomial(text: str, degree: int | None) -> None:
    assert polynomial_degree(text) == degree


def pushed(hold: Any) -> dict[str, Any]:
    return {"kind": "indentation", "depth": 1, "hold": {"pressure": hold}}


def capped(**further: Any) -> Case:
    shell = {"geometry": "cap", "radius": 1, "polar": 40, **MATERIAL}
    return made(shell=shell, boundary={"rim": "clamped"}, **further)


def sphere() -> Case:
    """Two joined hemispheres, held at three points, in a fluid whose surface is at z = 2 R."""
    half = {"shell": {"geometry": "cap", "radius": 1, "polar": 90, **MATERIAL}}
    points = {"A": [0.6, 0, 0.8], "B": [0, 0.6, 0.8], "C": [-0.6, 0, 0.8]}
    held = {"points": points, "boundary": {name: {"held": ["x", "y", "z"]} for name in points}}
    upside_down = {**half, "place": {"position": [0, 0, 0], "axis": {"polar": 180}}}
    return made(
        shells={"upper": {**half, **held}, "lower": upside_down},
        joints=[{"edges": ["upper.rim", "lower.rim"]}],
        loading=loaded("2 - z"),
        mesh={"size": 0.45},
        symmetry="none",
        reactions=True,
    )


def test_lift_of_a_closed_sphere() -> None:
    """Archimedes: the fluid lifts a sphere by ρ g V, V the volume of the deformed one: 1e-6."""
    scene = Scene(sphere())
    *_, last = follow(scene)
    row, material = scene.observe(last.point.state), scene.model.material
    volume = 4 * np.pi / 3 + row["volume_change"]
    assert abs(row["volume_change"]) > 1e-5
    # pressures are over p_c, p_c over E; forces over E R²
    pressure_per_depth = row["p_over_pc"] * material.classical_pressure
    for axis, force in (("x", 0.0), ("y", 0.0), ("z", -pressure_per_depth * volume)):
        reaction = sum(row[f"upper_{point}_f{axis}"] for point in "ABC")
        assert reaction == pytest.approx(force, rel=1e-6, abs=1e-6 * pressure_per_depth)


def test_tank_filled_with_a_fluid() -> None:
    """Timoshenko and Woinowsky-Krieger (1959), section 118: w of a wall clamped at its foot: 1e-3.

    The top moves freely, so that the pressure has no potential. Near the foot w is M x²/(2 D): the
    moment there is that of the closed form too.
    """
    beta = (3 * (1 - 0.3**2)) ** 0.25 / sqrt(0.01)
    heights = {"foot": 0.2 / beta, "low": 0.8 / beta, "middle": 3 / beta}
    scene = Scene(
        made(
            shell={"geometry": "cylinder", "radius": 1, "length": 1, **MATERIAL},
            boundary={"bottom": "clamped"},
            points={name: [1, 0, z] for name, z in heights.items()},
            loading=loaded("1 - z", pressure=-1e-4),
        )
    )
    assert scene.model.without_potential == ("top",)
    *_, last = follow(scene)
    row = scene.observe(last.point.state)
    specific_weight = -row["p_over_pc"] * scene.model.material.classical_pressure
    for name, x in heights.items():
        b = beta * x
        edge_effect = exp(-b) * (cos(b) + (1 - 1 / beta) * sin(b))
        expected = specific_weight / 0.01 * (1 - x - edge_effect)
        assert row[f"{name}_ux"] == pytest.approx(expected, rel=1e-3)


PANEL = {"geometry": "cylinder", "radius": 1, "length": 0.6, "azimuth": [20, 60], **MATERIAL}


@pytest.mark.parametrize("held", [("left", "right", "bottom", "top"), ("left", "bottom")])
def test_derivatives(held: tuple[str, ...]) -> None:
    """Energy, forces and tangent by differences, beside free edges those of the virtual work."""
    boundary = dict.fromkeys(held, "clamped")
    mesh = {"size": 0.4, "degree": 2}
    scene = Scene(
        made(shell=PANEL, boundary=boundary, loading=loaded(POLYNOMIAL), mesh=mesh, symmetry="none")
    )
    system, rng = scene.model.system, np.random.default_rng(1)
    u, v = (system.zero_at_supports(rng.standard_normal(system.size)) for _ in range(2))
    u, mu, step = 0.02 * u, {"pressure": 3.0}, 1e-5
    if not scene.model.without_potential:
        check(system, u, mu)
    low, high = (system.residual(u + side * step * v, mu) for side in (-0.5, 0.5))
    Kv = csr(system.tangent(u, mu)) @ v
    difference = system.zero_at_supports((high - low) / step - Kv)
    assert np.linalg.norm(difference) < 1e-6 * np.linalg.norm(Kv)
    # a uniform pressure does the same work where the profile is one
    profile = PressureProfile("1 + 0*z")
    one = Scene(replace(scene.problem, loads=replace(scene.problem.loads, pressure_profile=None)))
    same = Scene(
        replace(scene.problem, loads=replace(scene.problem.loads, pressure_profile=profile))
    )
    forces = [s.model.system.forces(u, mu, "pressure") for s in (one, same)]
    assert np.array_equal(*forces)


def test_half_of_a_turned_profile() -> None:
    """A half between the mirror planes of a profile has the displacements of the whole shell."""
    case = {
        "shell": {"geometry": "cylinder", "radius": 1, "length": 1, **MATERIAL},
        "boundary": {"bottom": "clamped", "top": "clamped"},
        "points": {"here": [cos(0.5), sin(0.5), 0.5]},
        "loading": loaded(f"1 + ({cos(0.5)}*x + {sin(0.5)}*y)", pressure=1e-2),
        "mesh": {"size": 0.35, "degree": 3},
    }
    displacements = []
    for symmetry, part in (("auto", "half"), ("none", "full")):
        scene = Scene(made(**case, symmetry=symmetry))
        assert scene.model.multiplicity == {"half": 2, "full": 1}[part]
        *_, last = follow(scene)
        row = scene.observe(last.point.state)
        displacements.append([row[f"here_u{axis}"] for axis in "xyz"])
    assert displacements[0] == pytest.approx(displacements[1], rel=1e-3, abs=1e-9)


@pytest.mark.slow
def test_waves_under_a_fluid() -> None:
    """A cylinder buckles in waves where a sector of a surface buckles; it is the inertia there."""
    case = {
        "shell": {"geometry": "cylinder", "radius": 1, "length": 1, **MATERIAL},
        "boundary": {"bottom": "clamped", "top": "clamped"},
        "loading": {"kind": "pressure", "until": "bifurcation", "profile": "1 - z"},
    }
    *_, wave = follow(Scene(made(**case)))
    assert wave.mode.startswith("m = ")
    waves = int(wave.mode.split()[-1])
    sector = Scene(made(**case, symmetry=waves, mesh={"size": 0.2, "degree": 4}))
    *_, found = follow(sector)
    pressures = [record.point.state.mu["pressure"] for record in (wave, found)]
    assert pressures[0] == pytest.approx(pressures[1], rel=2e-3)


@pytest.mark.slow
def test_sensitivity_of_a_fold() -> None:
    """The fold of a shell with a flaw, by the size of the flaw: against two folds found again."""

    def scene(amplitude: float) -> Scene:
        flaw = {"kind": "gaussian", "amplitude": amplitude, "width": 2.5}
        return Scene(
            made(
                shell={"geometry": "cap", "radius": 1, "polar": 40, "imperfections": [flaw],
                       **MATERIAL},
                boundary={"rim": "clamped"},
                loading={"kind": "pressure", "until": "limit", "profile": "2 - z**2"},
            )
        )  # fmt: skip

    def fold(amplitude: float) -> float:
        one = scene(amplitude)
        *_, last = follow(one)
        return fold_at(one, last).value

    base = scene(1.2)
    *_, last = follow(base)
    found = sensitivities(base, fold_at(base, last))["imperfections.0.amplitude"]
    assert found == pytest.approx((fold(1.21) - fold(1.19)) / 0.02, rel=1e-3)


@pytest.mark.parametrize(
    ("loading", "message"),
    [
        ({"profile": "abs(z)"}, "allowed are polynomials of x, y, z up to degree 8, not zero"),
        ({"profile": "z - z"}, "allowed are polynomials"),
        ({"profile": "z", "control": "volume"}, "no change of volume is conjugate"),
        ({"profile": "z", "volume_change": -0.1, "until": "target"}, "no change of volume"),
    ],
)
def test_refused(loading: dict[str, Any], message: str) -> None:
    with pytest.raises(CaseError, match=message):
        make_problem(capped(loading={"kind": "pressure", **loading}))


@pytest.mark.parametrize(
    ("profile", "symmetry"), [("2 - z + x*y**2 + x**2*y", "half"), ("2 - x", "axisymmetric")]
)
def test_a_profile_without_the_symmetry_is_named(profile: str, symmetry: str) -> None:
    with pytest.raises(CaseError, match=rf"{symmetry}: loading\.profile does not share it"):
        make_problem(capped(loading=loaded(profile), symmetry=symmetry))


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (pushed({"gas": {"ambient_over_pc": 2}}), "to a pressure with a profile; allowed: load"),
        (pushed("conjugate"), "allowed: load"),
        (loaded("1"), "another profile"),
        ({"kind": "edge", "moves": [{"supports": ["rim"], "translation": [0, 0, 1]}]}, "lids"),
    ],
)  # fmt: skip
def test_refused_beside_a_profile(step: dict[str, Any], message: str) -> None:
    with pytest.raises(CaseError, match=message):
        make_problem(capped(loading=[loaded("z"), step]))


def test_a_pressed_part_that_ends_within_the_surface() -> None:
    """The vertical force on the lower one of two joined tubes is p pi (rho_top^2 - 1), whatever its
    shape: at its moving border a live pressure has no potential, and is a follower load."""
    tube = {
        "geometry": "cylinder", "radius": 1, "length": 0.6, "thickness": 0.02,
        "youngs_modulus": 1, "poisson_ratio": 0.3,
    }  # fmt: skip
    scene = Scene(
        Case.from_source({
            "shells": {
                "lower": {"shell": tube, "boundary": {"bottom": "clamped"},
                          "points": {"border": [1, 0, 0.6]}},
                "upper": {"shell": tube, "place": {"position": [0, 0, 0.6]}},
            },
            "joints": [{"edges": ["lower.top", "upper.bottom"]}],
            "loading": {"kind": "pressure", "on": {"lower": "inside"}, "control": "load",
                        "pressure": 4, "until": "target", "points": 1},
            "reactions": True,
            "mesh": {"degree": 4, "refinement": 0.5},
        })
    )  # fmt: skip
    *_, record = follow(scene)
    row = scene.observe(record.point.state)
    rho = 1 + row["lower_border_ux"]
    pressure = row["p_over_pc"] * scene.model.material.classical_pressure
    assert rho > 1.001
    assert row["lower_bottom_fz"] == pytest.approx(pressure * np.pi * (rho**2 - 1), rel=1e-6)
