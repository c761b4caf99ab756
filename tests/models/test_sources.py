"""Sources of the field in every model: derivatives by u, place, angle and strength; force and torque on a rigid cap."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case, Scene

MM = 1e-3
PLATE = {"geometry": "plate", "length": "30 mm", "width": "12 mm", "thickness": "1 mm", "youngs_modulus": "1 MPa"}
RING = {"geometry": "annulus", "radius": "30 mm", "inner_radius": "12 mm", "thickness": "1 mm", "youngs_modulus": "1 MPa"}
MAGNET = {"kind": "cylinder", "diameter": "20 mm", "height": "10 mm", "polarization": "1.3 T"}
ASIDE = {**MAGNET, "position": [0.035, 0.006, -0.02], "axis": {"polar": 25.0}, "name": "magnet"}
COIL = {"kind": "coil", "diameter": "30 mm", "current": "500 A", "position": [0.01, 0.0, 0.03], "axis": {"polar": 60.0}}
BELOW = {**MAGNET, "position": [0.0, 0.0, -0.02]}
STEPS = [
    {"kind": "field"},
    {"kind": "source", "name": "turn", "source": "magnet", "turn": {"axis": [0, 1, 0.2], "angle": 50}},
    {"kind": "source", "name": "shift", "source": "magnet", "move": [-0.02, 0.0, -0.01]},
    {"kind": "source", "name": "power", "source": "magnet", "strength": 2.5},
    {"kind": "source", "name": "current", "source": 1, "strength": 0.3},
]
UP = [
    {"kind": "field"},
    {"kind": "source", "name": "shift", "move": [0, 0, -0.02]},
    {"kind": "source", "name": "power", "strength": 0.0},
]


def field(sources: list[dict[str, Any]], **applied: Any) -> dict[str, Any]:
    return {"remanent": {"polar": 90, "flux_density": "100 mT"}, "applied": {"sources": sources, **applied}}


def made(shell: dict[str, Any], boundary: dict[str, str], **sections: Any) -> Scene:
    return Scene(Case.model_validate({"shell": {"poisson_ratio": 0.3, **shell}, "boundary": boundary, **sections}))


HALF = {**ASIDE, "position": [0.035, 0.0, -0.02]}
KINDS = {
    "shell": lambda: made(PLATE, {"left": "clamped"}, magnetic=field([ASIDE, COIL], flux_density="20 mT", polar=30),
                          loading=STEPS, mesh={"degree": 3, "size": 0.012}),
    "rotation law": lambda: made(PLATE, {"left": "clamped"}, loading=STEPS, mesh={"degree": 2, "size": 0.015},
                                 magnetic={**field([ASIDE, COIL]), "remanence": "rotation"}),
    "half": lambda: made({"geometry": "strip", "radius": "30 mm", "width": 0.4, "thickness": "1 mm",
                          "youngs_modulus": "1 MPa"}, {"root": "clamped"}, symmetry="half", mesh={"degree": 3},
                         magnetic=field([HALF, COIL]),
                         loading=[s for s in STEPS if s.get("name") != "turn"]),
    "meridian": lambda: made(RING, {"inner": "clamped"}, symmetry="axisymmetric",
                             magnetic={**field([BELOW]), "remanent": {"kind": "radial", "flux_density": "100 mT"}},
                             loading=UP),
    "solid": lambda: made(PLATE, {"left": "clamped"}, model="solid", magnetic=field([ASIDE, COIL]), loading=STEPS,
                          mesh={"size": 0.015}),
}  # fmt: skip


@cache
def scene(kind: str) -> Scene:
    return KINDS[kind]()


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_by_the_amplitudes(kind: str) -> None:
    """Central differences of energy, residual and conjugates at a rough state; all change with the amplitude."""
    system, step = scene(kind).model.system, 1e-4
    u = system.held(2e-4 * np.random.default_rng(1).standard_normal(system.size))
    start = scene(kind).unloaded().mu
    driven, found = list(scene(kind).sources), []
    for size in (0.05, 0.4):
        mu = {**dict.fromkeys(start, 0.0), "lambda_m": 0.05}
        mu |= {name: size * (1 + i / 2) * (-1) ** i for i, name in enumerate(driven)}

        def energy(mu: dict[str, float]) -> float:
            return mu["lambda_m"] * system.potential(u, mu, "lambda_m")

        for name in driven:
            near = [{**mu, name: mu[name] + side * step} for side in (-2, -1, 1, 2)]

            def rate(of: Any, near: Any = near) -> Any:
                a, b, c, d = (of(each) for each in near)
                return (a - 8 * b + 8 * c - d) / (12 * step)

            slope = system.potential(u, mu, name)
            assert slope == pytest.approx(rate(energy), rel=1e-6)
            column = system.load(u, mu, name)
            difference = rate(lambda mu: system.residual(u, mu))
            np.testing.assert_allclose(column, difference, atol=1e-6 * np.abs(column).max())
            if name in ("turn", "shift"):  # in a factor alone the energy is linear
                found.append((slope, np.abs(column).max()))
            for other in ("lambda_m", *driven):
                bend = system.curvature(u, mu, name, other)
                mixed = rate(lambda mu, other=other: system.potential(u, mu, other))
                assert bend == pytest.approx(mixed, rel=1e-6, abs=1e-8 * abs(slope))
                assert bend == pytest.approx(system.curvature(u, mu, other, name), rel=1e-9, abs=1e-12 * abs(slope))
    first, second = np.array(found).reshape(2, -1)
    assert (np.abs(second / first - 1) > 1e-2).all()


@pytest.mark.parametrize("kind", KINDS)
def test_tangent(kind: str) -> None:
    """Central differences of the energy and of the residual along a direction; the tangent changes with a magnet."""
    system, rng, e = scene(kind).model.system, np.random.default_rng(2), 1e-5
    u, v = (system.held(size * rng.standard_normal(system.size)) for size in (1e-4, 1.0))
    moved = []
    for size in (0.1, 0.7):
        mu = {name: size for name in scene(kind).unloaded().mu} | {"lambda_m": 2.0}
        none = {**mu, "lambda_m": 0.0}

        def rate(of: Any) -> Any:
            a, b, c, d = (of(u + side * e * v) for side in (-2, -1, 1, 2))
            return (a - 8 * b + 8 * c - d) / (12 * e)

        slope = rate(lambda u, mu=mu: 2.0 * system.potential(u, mu, "lambda_m"))
        assert 2.0 * system.load(u, mu, "lambda_m") @ v == pytest.approx(slope, rel=1e-6)
        whole = _times(system.tangent(u, mu), v) - _times(system.tangent(u, none), v)
        difference = rate(lambda u, mu=mu: 2.0 * system.load(u, mu, "lambda_m"))
        whole, difference = system.held(whole), system.held(difference)
        assert np.linalg.norm(whole - difference) <= 1e-6 * np.linalg.norm(difference)
        moved.append(whole)
    assert np.linalg.norm(moved[1] - moved[0]) > 1e-2 * np.linalg.norm(moved[0])


def _times(K: Any, v: np.ndarray) -> np.ndarray:
    x = K.createVecRight()
    x.array[:] = v
    return np.array((K * x).array)
