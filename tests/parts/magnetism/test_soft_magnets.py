"""Soft magnetism: derivatives by differences in every model, the energy by hand, Euler's elastica,
what is refused.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import ufl
from conftest import CASES
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from magshell_fenicsx import Case, Scene, gradient
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.magnetism.soft_magnet import Sheet
from magshell_fenicsx.public import follow, run

PLATE = {
    "geometry": "plate",
    "length": "30 mm",
    "width": "12 mm",
    "thickness": "1 mm",
    "youngs_modulus": "1 MPa",
}
STRIP = {
    "geometry": "strip",
    "radius": "30 mm",
    "width": 0.4,
    "thickness": "1 mm",
    "youngs_modulus": "1 MPa",
}
RING = {**PLATE, "geometry": "annulus", "radius": "30 mm", "inner_radius": "12 mm"}
RING = {key: value for key, value in RING.items() if key not in ("length", "width")}
MAGNET = {"kind": "cylinder", "diameter": "20 mm", "height": "10 mm", "polarization": "1.3 T"}
ASIDE = {**MAGNET, "position": [0.035, 0.006, -0.02], "axis": {"polar": 25.0}}
MOVED = [
    {"kind": "field"},
    {"kind": "source", "name": "turn", "turn": {"axis": [0, 1, 0.2], "angle": 50}},
    {"kind": "source", "name": "shift", "move": [-0.02, 0.0, -0.01]},
    {"kind": "source", "name": "power", "strength": 2.5},
]
TURNED = [{"kind": "field"}, {"kind": "rotation", "to": {"polar": 60, "azimuth": 40}}]
TURNED += [{"kind": "rotation", "to": {"polar": 120, "azimuth": 140}}]
FIELD = {"polar": 30, "flux_density": "200 mT"}
REMANENT = {"polar": 70, "azimuth": 20, "flux_density": "90 mT"}
G = {**FIELD, "gradient": [[0.3, 0.1, 0], [0.1, -0.7, 0.2], [0, 0.2, 0.4]]}


def test_fields_at_a_displacement_and_at_rest() -> None:
    """They are B + G x in a field with a gradient, at the place x0 + u and at x0."""
    field = SimpleNamespace(in_space=False, gradient=True)
    magnet = SimpleNamespace(amplitudes=["lambda_m"], field=field)
    B, G = np.array([0.1, -0.2, 0.3]), np.array([[0.3, 0.1, 0], [0.1, -0.7, 0.2], [0, 0.2, 0.4]])
    x0, u, load = np.array([1.0, 0.5, -0.3]), np.array([0.2, -0.1, 0.4]), 2.0
    given = [load, ufl.as_vector(list(B)), ufl.as_tensor(G.tolist())]
    displaced, at_rest = Sheet.fields(
        magnet, ufl.as_vector(list(x0)), ufl.as_vector(list(u)), given
    )
    for vector, place in ((displaced, x0 + u), (at_rest, x0)):
        values = [vector[i](()) for i in range(3)]
        assert values == pytest.approx(load * (B + G @ place))


def made(
    shell: dict[str, Any], boundary: dict[str, str], magnetic: dict[str, Any], **sections: Any
) -> Scene:
    shell = {"poisson_ratio": 0.3, **shell}
    given = {"loading": {"kind": "field"}, "mesh": {"degree": 2}, **sections}
    return Scene(
        Case.model_validate({"shell": shell, "boundary": boundary, "magnetic": magnetic, **given})
    )


LEFT, SIZED = {"left": "clamped"}, {"mesh": {"degree": 2, "size": 0.015}}
KINDS = {
    "uniform, turned": lambda: made(PLATE, LEFT, {"susceptibility": 2, "applied": FIELD},
                                    loading=TURNED, **SIZED),
    "graded, by formula, with remanence": lambda: made(
        PLATE, LEFT, {"susceptibility": "2 + x", "remanent": REMANENT, "applied": G}, **SIZED
    ),
    "sources, with remanence": lambda: made(
        PLATE, LEFT, {"susceptibility": 3, "remanent": REMANENT, "applied": {"sources": [ASIDE]}},
        loading=MOVED, **SIZED,
    ),
    "half, thickness": lambda: made(
        {**STRIP, "thickness_factor": "1 + x/2"}, {"root": "clamped"},
        {"susceptibility": 2, "applied": FIELD}, symmetry="half",
    ),
    "meridian, sources": lambda: made(
        RING, {"inner": "clamped"},
        {"susceptibility": "1 + z + x**2 + y**2",
         "applied": {"sources": [{**MAGNET, "position": [0, 0, -0.02]}]}},
        symmetry="axisymmetric", loading=[MOVED[0], MOVED[3]],
    ),
    "solid, graded": lambda: made(
        PLATE, LEFT, {"susceptibility": 2, "remanent": REMANENT, "applied": G}, model="solid",
        mesh={"size": 0.015}
    ),
    "solid, turned": lambda: made(
        PLATE, LEFT, {"susceptibility": "1 + x", "applied": FIELD}, model="solid", loading=TURNED,
        mesh={"size": 0.015}
    ),
    "saturating": lambda: made(
        PLATE, LEFT, {"susceptibility": 2, "saturation": "0.5 T", "applied": FIELD}, loading=TURNED,
        **SIZED
    ),
    "half, saturating, by formula, thickness": lambda: made(
        {**STRIP, "thickness_factor": "1 + x/2"}, {"root": "clamped"},
        {"susceptibility": "2 + x", "saturation": "0.5 T", "applied": FIELD}, symmetry="half",
    ),
    "meridian, saturating, sources": lambda: made(
        RING, {"inner": "clamped"},
        {"susceptibility": 2, "saturation": "0.1 T",
         "applied": {"sources": [{**MAGNET, "position": [0, 0, -0.02]}]}},
        symmetry="axisymmetric", loading=[MOVED[0], MOVED[3]],
    ),
    "solid, saturating": lambda: made(
        PLATE, LEFT,
        {"susceptibility": 2, "saturation": "0.5 T", "remanent": REMANENT, "applied": G},
        model="solid", mesh={"size": 0.015},
    ),
}  # fmt: skip
QUICK = ("uniform, turned", "half, saturating, by formula, thickness", "solid, graded")


@cache
def scene(kind: str) -> Scene:
    return KINDS[kind]()


def differences(of: Any, step: float) -> Any:
    a, b, c, d = (of(side * step) for side in (-2, -1, 1, 2))
    return (a - 8 * b + 8 * c - d) / (12 * step)


def rough(kind: str) -> tuple[Any, np.ndarray, dict[str, float]]:
    """A system at a rough state and at amplitudes none of which is zero."""
    system, mu = scene(kind).model.system, scene(kind).unloaded().mu
    u = system.zero_at_supports(2e-4 * np.random.default_rng(1).standard_normal(system.size))
    return system, u, {name: 0.3 + 0.1 * i for i, name in enumerate(sorted(mu))}


@pytest.mark.parametrize(
    "kind", [k if k in QUICK else pytest.param(k, marks=pytest.mark.slow) for k in KINDS]
)
def test_derivatives(kind: str) -> None:
    """Residual, tangent, load columns, conjugates and their derivatives by all amplitudes, by
    central differences.
    """
    system, u, mu = rough(kind)
    v = system.zero_at_supports(np.random.default_rng(2).standard_normal(system.size))

    def energy(u: np.ndarray, mu: dict[str, float]) -> float:
        return sum(scene(kind).energies(State(u, mu)).values()) / scene(kind).model.multiplicity

    slope = differences(lambda e: energy(u + e * v, mu), 1e-6)
    assert system.residual(u, mu) @ v == pytest.approx(slope, rel=1e-6)
    Kv = differences(lambda e: system.residual(u + e * v, mu), 1e-6)
    K = system.tangent(u, mu)
    x = K.createVecRight()
    x.array[:] = v
    assert np.linalg.norm(system.zero_at_supports((K * x).array) - Kv) <= 1e-6 * np.linalg.norm(Kv)
    for name in mu:

        def at(e: float, name: str = name) -> dict[str, float]:
            return {**mu, name: mu[name] + e}

        assert system.potential(u, mu, name) == pytest.approx(
            differences(lambda e: energy(u, at(e)), 1e-3), rel=1e-6
        )
        column = system.load(u, mu, name)
        by_difference = differences(lambda e: system.residual(u, at(e)), 1e-3)
        assert np.abs(column).max() > 0
        np.testing.assert_allclose(column, by_difference, atol=1e-6 * np.abs(column).max())
        for other in mu:
            bend = differences(lambda e, other=other: system.potential(u, at(e), other), 1e-3)
            scale = abs(bend) + 1e-3 * abs(system.potential(u, mu, other))
            assert system.curvature(u, mu, name, other) == pytest.approx(bend, abs=1e-5 * scale), (
                name,
                other,
            )


@pytest.mark.parametrize("model", ["shell", "solid"])
def test_a_plate_in_a_tilted_field(model: str) -> None:
    """A rigid turn changes the energy by -(chi h A/2mu0)(B_t² + B_n²/(1 + chi)), and the
    polarisation as by hand.
    """
    chi, angle, B = 2.0, np.radians(25.0), 0.2
    magnetic = {"susceptibility": chi, "applied": {"polar": 0, "flux_density": f"{B} T"}}
    mesh = {"size": 0.015} | ({"degree": 2} if model == "shell" else {})
    found = made(PLATE, LEFT, magnetic, model=model, mesh=mesh)
    c, s = np.cos(angle), np.sin(angle)
    Q = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    r0 = found.model.r0.x.array.reshape(-1, 3)
    state = State((r0 @ (Q.T - np.eye(3))).ravel(), {"lambda_m": found.problem.lambda_m})

    def energy(n: float, t: float) -> float:  # over E h R^2 = E h (30 mm)^2
        return -chi / (8e-7 * np.pi * 1e6) * (t**2 + n**2 / (1 + chi)) * B**2 * 0.012 / 0.03

    row = found.observe(state)
    assert row["magnetic"] == pytest.approx(energy(c, s) - energy(1, 0), rel=1e-9)
    n, t = np.array([-s, 0, c]), np.array([c, 0, s])
    J = chi * B * (s * t + c / (1 + chi) * n)
    np.testing.assert_allclose([row[f"induced_{axis}"] for axis in "xyz"], J, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("saturation", [None, "10 mT"])
def test_models_agree(saturation: str | None) -> None:
    """A soft disc in a graded field along its axis: meridian, half and full, and the polarisation
    of each.
    """
    shell: dict[str, Any] = {"geometry": "disc", "radius_to_thickness": 40, "poisson_ratio": 0.3}
    magnetic: dict[str, Any] = {
        "susceptibility": 2,
        "lambda_m": 0.02,
        "applied": {"polar": 0, "gradient": [[-0.5, 0, 0], [0, -0.5, 0], [0, 0, 1]]},
    }
    if saturation:
        shell = {
            "geometry": "disc",
            "radius": "30 mm",
            "thickness": "0.75 mm",
            "youngs_modulus": "1 MPa",
        }
        shell["poisson_ratio"] = 0.3
        applied = magnetic["applied"] | {"flux_density": "22 mT"}
        magnetic = {"susceptibility": 2, "saturation": saturation, "applied": applied}
    rows = []
    for symmetry in ("axisymmetric", "half", "none"):
        case = {
            "shell": shell,
            "boundary": {"rim": "clamped"},
            "magnetic": magnetic,
            "symmetry": symmetry,
        }
        rows.append(follow_last(case))
    keys = ("w_pole_over_h", "magnetic", "bending", "induced_z")
    for row in rows[1:]:
        for key in keys:
            assert row[key] == pytest.approx(rows[0][key], rel=5e-4), (
                key
            )  # bending 3e-4, of the mesh
        assert abs(row["induced_x"]) + abs(row["induced_y"]) < 1e-6 * abs(row["induced_z"])
    assert abs(rows[0]["w_pole_over_h"]) > 1e-3


def follow_last(case: dict[str, Any]) -> dict[str, float]:
    scene = Scene(
        Case.model_validate({**case, "loading": {"kind": "field", "points": 2}}).problem()
    )
    *_, last = follow(scene)
    return scene.observe(last.point.state)


def tip(ratio: float) -> tuple[float, float]:
    """Displacement of the tip along x and z over L at B = ratio B_c, by SciPy.

    theta'' + (ratio pi/2)² sin theta cos theta = 0, theta(0) = 0, theta'(1) = 0.
    """
    k = np.pi / 2 * ratio

    def end(slope: float) -> np.ndarray:
        def rates(_: float, y: np.ndarray) -> list[float]:
            return [y[1], -(k**2) * np.sin(2 * y[0]) / 2, np.cos(y[0]), np.sin(y[0])]

        return np.asarray(
            solve_ivp(rates, (0, 1), [0, slope, 0, 0], rtol=1e-11, atol=1e-12).y[:, -1]
        )

    slope = brentq(lambda slope: end(slope)[1], 0.1 * k, k * (1 - 1e-10), xtol=1e-13)
    x, z = end(float(slope))[2:]
    return float(x) - 1, float(z)


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1.2, 2.0])
def test_a_strip_across_a_field_is_an_elastica(ratio: float) -> None:
    """B_c in closed form, tips at 1.2 and 2 B_c of Euler's elastica in twice the angle: 1e-4."""
    B_c = np.pi / 2 / 200 * np.sqrt(3 / 48)
    found = run(Case.load(CASES / "soft_strip.yaml", [f"magnetic.lambda_m={ratio * B_c}"]))
    first = found.limit_points[0]
    assert first["kind"] == "bifurcation"
    assert first["value"] == pytest.approx(B_c, rel=1e-4)
    branches = {row["branch"]: row for row in found.rows if row["label"] == "target"}
    x, z = tip(ratio)
    for branch in (1, 2):
        assert branches[branch]["lambda_m"] == pytest.approx(ratio * B_c, rel=1e-9)
        assert branches[branch]["tip_ux"] == pytest.approx(x, abs=1e-4)
        assert abs(branches[branch]["tip_uz"]) == pytest.approx(z, abs=1e-4)
    assert branches[1]["tip_uz"] == pytest.approx(-branches[2]["tip_uz"], rel=1e-6)


def langevin(chi: float, J: float, normal: float, along: float) -> tuple[float, float]:
    """mu0 M across and along a sheet in the field B; B_n = mu0 (H_n + M_n) by bisection."""

    def size(b: float) -> float:
        x = 3 * chi * b / J
        return J * (1 / np.tanh(x) - 1 / x) if x > 1e-4 else chi * b

    def left(b: float) -> float:
        total = np.hypot(b, along)
        return abs(normal) - b - size(total) * b / (total or 1.0)

    b = float(brentq(left, 0, abs(normal), xtol=1e-16)) * np.sign(normal)
    total = np.hypot(b, along)
    return size(total) * b / total, size(total) * along / total


def saturated_tip(
    chi: float, J: float, B: float, slender: float, angle: float
) -> tuple[float, float]:
    """Displacement of the tip along x and z over L, by SciPy; J and B over sqrt(mu0 E)."""

    def torque(theta: float) -> float:
        normal, along = B * np.cos(angle + theta), B * np.sin(angle + theta)
        Jn, Jt = langevin(chi, J, normal, along)
        return 12 * slender**2 * (Jt * normal - Jn * along)

    smooth = np.polynomial.Chebyshev.interpolate(np.vectorize(torque), 120, [-0.5, np.pi])

    def rates(_: float, y: np.ndarray) -> list[float]:
        return [y[1], -smooth(y[0]), np.cos(y[0]), np.sin(y[0])]

    def end(slope: float) -> np.ndarray:
        return np.asarray(
            solve_ivp(rates, (0, 1), [0, slope, 0, 0], rtol=1e-9, atol=1e-11).y[:, -1]
        )

    slope = brentq(lambda slope: end(slope)[1], 0.01, 2.0, xtol=1e-10)
    x, z = end(float(slope))[2:]
    return float(x) - 1, float(z)


@pytest.mark.slow
def test_a_saturating_strip_is_an_elastica() -> None:
    """The tip in a field beyond saturation, of SciPy's elastica with the same law: 1e-4."""
    unit = np.sqrt(4e-7 * np.pi * 1e6)
    x, z = saturated_tip(5.0, 4e-3 / unit, 6e-3 / unit, 200, np.radians(20))
    shell = {
        "geometry": "strip",
        "radius": "30 mm",
        "width": 0.1,
        "thickness": "0.15 mm",
        "youngs_modulus": "1 MPa",
    }
    magnetic = {"susceptibility": 5.0, "saturation": "4 mT"}
    magnetic["applied"] = {"polar": 20, "azimuth": 0, "flux_density": "6 mT"}
    case = {
        "shell": {**shell, "poisson_ratio": 0},
        "boundary": {"root": "clamped"},
        "magnetic": magnetic,
    }
    row = run(
        Case.model_validate(
            {**case, "points": {"tip": ["30 mm", 0, 0]}, "loading": {"kind": "field"}}
        )
    ).rows[-1]
    assert z > 0.2
    assert [row["tip_ux_mm"] / 30, row["tip_uz_mm"] / 30] == pytest.approx([x, z], abs=1e-4)


@pytest.mark.slow
def test_a_strip_that_saturates_stands_straight_again() -> None:
    """Tips at 150 and 300 mT of SciPy's elastica, 1e-4; it buckles where (mu0 M)² B/b is (pi/2L)²
    mu0 D/h, 2e-5.
    """
    chi, J, unit = 5.0, 0.1, np.sqrt(4e-7 * np.pi * 580e6)
    file = CASES / "saturated_strip.yaml"
    rows = [
        row for row in run(Case.load(file, ["loading.points=8"])).rows if row["label"] == "target"
    ]
    for row, B in zip(rows[3::4], (0.15, 0.3), strict=True):
        x, z = saturated_tip(chi, J / unit, B / unit, 100, np.radians(0.5))
        assert row["applied_mT"] == pytest.approx(1e3 * B, rel=1e-9)
        assert [row["tip_ux_mm"] / 30, row["tip_uz_mm"] / 30] == pytest.approx([x, z], abs=1e-4)

    def left(B: float) -> float:
        M = langevin(chi, J, B, 0.0)[0]
        return float(M**2 * B / (B - M) - (np.pi / 2 * unit / 100) ** 2 / 12)

    critical = [1e3 * float(brentq(left, *bounds)) for bounds in ((0.05, 0.1), (0.12, 0.3))]
    found = run(Case.load(file, ["magnetic.applied.polar=0", "loading.points=3"])).rows
    assert [row["applied_mT"] for row in found if row["label"] == "bifurcation"] == pytest.approx(
        critical, rel=2e-5
    )


@pytest.mark.parametrize(("B", "error"), [(1e-3, 1e-4), (10.0, 1e-2)])
def test_limits_of_saturation(B: float, error: float) -> None:
    """A weak field has the linear law to O(B²); a strong one J, but for O(J/3 chi b), along the
    field b within.
    """
    magnetic = {
        "susceptibility": 2,
        "saturation": "0.5 T",
        "applied": {"polar": 40, "flux_density": f"{B} T"},
    }
    found = made(PLATE, LEFT, magnetic, **SIZED)
    row = found.observe(State(found.model.zero(), {"lambda_m": found.problem.lambda_m}))
    s, c = np.sin(np.radians(40)), np.cos(np.radians(40))
    along, across = 2 * B * s, 2 / 3 * B * c
    for _ in range(20 if B > 1 else 0):
        along, across = 0.5 * np.array([B * s, B * c - across]) / np.hypot(B * s, B * c - across)
    assert [row["induced_x"], row["induced_z"]] == pytest.approx([along, across], rel=error)


@pytest.mark.parametrize(("chi", "R_over_h"), [(0.5, 50), (5.0, 200)])
def test_a_sphere_in_a_uniform_field(chi: float, R_over_h: float) -> None:
    """The moment of a spherical shell (Jackson, Classical Electrodynamics, equation 5.121), but for
    O(chi h/R).
    """
    shell = {"geometry": "hemisphere", "radius_to_thickness": R_over_h}
    magnetic = {"susceptibility": chi, "lambda_m": 1e-3, "applied": {"polar": 0}}
    found = made(shell, {"equator": "clamped"}, magnetic, symmetry="axisymmetric")
    row = found.observe(State(found.model.zero(), {"lambda_m": 1e-3}))
    mu, a, b = 1 + chi, 1 - 0.5 / R_over_h, 1 + 0.5 / R_over_h
    alpha = (
        (2 * mu + 1)
        * (mu - 1)
        / ((2 * mu + 1) * (mu + 2) - 2 * (a / b) ** 3 * (mu - 1) ** 2)
        * (b**3 - a**3)
    )
    exact = 3 * alpha / (b**3 - a**3) * 1e-3  # mu0 M, mean over the shell
    assert row["induced_z"] == pytest.approx(exact, rel=chi / R_over_h)


@pytest.mark.slow
def test_critical_field_as_a_solid() -> None:
    """The body's strip of L/h = 20 buckles at the same field, but for what shear and thickness
    change: O((h/L)²).
    """
    case = {
        "model": "solid",
        "shell": {"geometry": "strip", "radius_to_thickness": 20, "width": 0.1, "poisson_ratio": 0},
        "boundary": {"root": "clamped"},
        "magnetic": {"susceptibility": 2, "lambda_m": 0.03, "applied": {"polar": 0}},
        "loading": {"kind": "field", "until": "limit"},
    }
    found = run(Case.model_validate(case))
    assert found.limit_points[0]["value"] == pytest.approx(
        np.pi / 2 / 20 * np.sqrt(3 / 48), rel=5e-3
    )


@pytest.mark.slow
def test_gradient_by_susceptibility() -> None:
    """The critical field B_c ~ sqrt((1 + chi)/chi²): d ln B_c/d chi in closed form; tip by
    differences of two runs.
    """
    case = {
        "shell": {
            "geometry": "strip",
            "radius_to_thickness": 100,
            "width": 0.1,
            "poisson_ratio": 0,
        },
        "boundary": {"root": "clamped"},
        "points": {"tip": [1, 0, 0]},
        "magnetic": {"susceptibility": 2.0, "lambda_m": 3e-3, "applied": {"polar": 20}},
        "loading": {"kind": "field", "points": 1},
        "mesh": {
            "degree": 3
        },  # at degree 4 the tangent's rounding alone changes the gradient by 1e-6
        "gradients": {"of": ["tip_uz"], "by": ["magnetic.susceptibility", "lambda_m"]},
    }

    def at(chi: float, lambda_m: float = 3e-3) -> tuple[Scene, Any]:
        magnetic = {**case["magnetic"], "susceptibility": chi, "lambda_m": lambda_m}  # type: ignore[dict-item]
        scene = Scene(Case.model_validate({**case, "magnetic": magnetic}).problem())
        *_, last = follow(scene)
        return scene, last

    def value(*numbers: float) -> float:
        scene, last = at(*numbers)
        return scene.observe(last.point.state)["tip_uz"]

    scene, last = at(2.0)
    found = gradient(scene, last, of="tip_uz", by=["magnetic.susceptibility", "lambda_m"])
    by_chi = differences(lambda e: value(2.0 + e), 1e-3)
    by_field = differences(lambda e: value(2.0, 3e-3 + e), 1e-6)
    assert found["magnetic.susceptibility"] == pytest.approx(by_chi, rel=1e-6)
    assert found["lambda_m"] == pytest.approx(by_field, rel=1e-6)


@pytest.mark.parametrize(
    ("magnetic", "said"),
    [
        ({"susceptibility": -1, "lambda_m": 1e-3}, "allowed are numbers from 0"),
        ({"susceptibility": "1 +", "lambda_m": 1e-3}, "1 +"),
        ({"susceptibility": {}, "lambda_m": 1e-3}, "at least one patch"),
        ({"susceptibility": 2, "lambda_m": 1e-3, "remanent": {}}, "beside a remanence"),
        ({"susceptibility": 2, "lambda_m": 1e-3, "energy": "second"}, "susceptibility needs full"),
        ({"susceptibility": 2, "lambda_m": 1e-3, "applied": {"flux_density": "0.1 T"}}, "not both"),
        ({"susceptibility": 2, "applied": {"polar": 1}}, "give lambda_m, or applied.flux_density"),
        (
            {"susceptibility": 2, "lambda_m": 1e-3, "remanence": "rotation"},
            "which this shell has not",
        ),
        ({"susceptibility": 2, "saturation": "0.5 T", "lambda_m": 1e-3}, "in a field in tesla"),
        (
            {"saturation": "0.5 T", "remanent": {}, "lambda_m": 1e-3},
            "of a shell with a susceptibility",
        ),
        (
            {"susceptibility": 2, "saturation": "-1 T", "applied": {"flux_density": "1 T"}},
            "saturation",
        ),
        ({"remanent": None, "lambda_m": 1e-3}, "shell with a susceptibility"),
        ({"susceptibility": {"dimple": 2}, "lambda_m": 1e-3}, "no dimple"),
        ({"susceptibility": "x - 0.5", "lambda_m": 1e-3}, "magnetic.susceptibility: 'x - 0.5': is"),
    ],
)
def test_what_is_refused(magnetic: dict[str, Any], said: str) -> None:
    case = {
        "shell": {**STRIP, "poisson_ratio": 0.3},
        "boundary": {"root": "clamped"},
        "magnetic": magnetic,
        "loading": {"kind": "field"},
    }
    with pytest.raises((ValueError, CaseError), match=said.replace("+", r"\+").replace("(", r"\(")):
        Case.model_validate(case).problem()
