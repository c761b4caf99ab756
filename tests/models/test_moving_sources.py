"""Sources of the field in every model: derivatives by u, place, angle and strength; force and
torque on a rigid cap.
"""

from functools import cache
from itertools import pairwise
from typing import Any

import magpylib
import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.system import State

MM = 1e-3
PLATE = {
    "geometry": "plate",
    "length": "30 mm",
    "width": "12 mm",
    "thickness": "1 mm",
    "youngs_modulus": "1 MPa",
}
RING = {
    "geometry": "annulus",
    "radius": "30 mm",
    "inner_radius": "12 mm",
    "thickness": "1 mm",
    "youngs_modulus": "1 MPa",
}
MAGNET = {"kind": "cylinder", "diameter": "20 mm", "height": "10 mm", "polarization": "1.3 T"}
ASIDE = {**MAGNET, "position": [0.035, 0.006, -0.02], "axis": {"polar": 25.0}, "name": "magnet"}
COIL = {
    "kind": "coil",
    "diameter": "30 mm",
    "current": "500 A",
    "position": [0.01, 0.0, 0.03],
    "axis": {"polar": 60.0},
}
BELOW = {**MAGNET, "position": [0.0, 0.0, -0.02]}
STEPS = [
    {"kind": "field"},
    {
        "kind": "source",
        "name": "turn",
        "source": "magnet",
        "turn": {"axis": [0, 1, 0.2], "angle": 50},
    },
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
    return {
        "remanent": {"polar": 90, "flux_density": "100 mT"},
        "applied": {"sources": sources, **applied},
    }


def made(shell: dict[str, Any], boundary: dict[str, str], **sections: Any) -> Scene:
    return Scene(
        Case.model_validate(
            {"shell": {"poisson_ratio": 0.3, **shell}, "boundary": boundary, **sections}
        )
    )


KINDS = {
    "shell": lambda: made(PLATE, {"left": "clamped"},
                          magnetic=field([ASIDE, COIL], flux_density="20 mT", polar=30),
                          loading=STEPS, mesh={"degree": 3, "size": 0.03}),
    "rotation law": lambda: made(PLATE, {"left": "clamped"}, loading=STEPS,
                                 mesh={"degree": 2, "size": 0.03},
                                 magnetic={**field([ASIDE, COIL]), "remanence": "rotation"}),
    "meridian": lambda: made(RING, {"inner": "clamped"}, symmetry="axisymmetric",
                             magnetic={**field([BELOW]),
                                       "remanent": {"kind": "radial", "flux_density": "100 mT"}},
                             loading=UP),
    "solid": lambda: made(PLATE, {"left": "clamped"}, model="solid", magnetic=field([ASIDE, COIL]),
                          loading=STEPS,
                          mesh={"size": 0.03}),
}  # fmt: skip


@cache
def scene(kind: str) -> Scene:
    return KINDS[kind]()


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_by_the_amplitudes(kind: str) -> None:
    """Central differences of energy, residual and conjugates at a rough state; all change with the
    amplitude.
    """
    system, step = scene(kind).model.system, 1e-4
    u = system.zero_at_supports(2e-4 * np.random.default_rng(1).standard_normal(system.size))
    start = scene(kind).unloaded().mu
    driven, found = list(scene(kind).sources), []
    others = ("lambda_m", *driven)
    for size in (0.05, 0.4):
        mu = {**dict.fromkeys(start, 0.0), "lambda_m": 0.05}
        mu |= {name: size * (1 + i / 2) * (-1) ** i for i, name in enumerate(driven)}

        def known(mu: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
            """The residual, and all potentials: that of lambda_m times it is the energy that the
            amplitudes change.
            """
            return system.residual(u, mu), np.array(
                [system.potential(u, mu, name) for name in others]
            )

        for name in driven:
            a, b, c, d = (known({**mu, name: mu[name] + side * step}) for side in (-2, -1, 1, 2))
            rates = [
                (p - 8 * q + 8 * r - s) / (12 * step) for p, q, r, s in zip(a, b, c, d, strict=True)
            ]
            slope, column = system.potential(u, mu, name), system.load(u, mu, name)
            assert slope == pytest.approx(mu["lambda_m"] * rates[1][0], rel=1e-6)
            np.testing.assert_allclose(column, rates[0], atol=1e-6 * np.abs(column).max())
            if name in ("turn", "shift"):  # in a factor alone the energy is linear
                found.append((slope, np.abs(column).max()))
            bends = [system.curvature(u, mu, name, other) for other in others]
            np.testing.assert_allclose(bends, rates[1], rtol=1e-6, atol=1e-8 * abs(slope))
    first, second = np.array(found).reshape(2, -1)
    assert (np.abs(second / first - 1) > 1e-2).all()


@pytest.mark.parametrize("kind", KINDS)
def test_tangent(kind: str) -> None:
    """Central differences of the energy and of the residual along a direction; the tangent changes
    with a magnet.
    """
    system, rng, e = scene(kind).model.system, np.random.default_rng(2), 1e-5
    u, v = (
        system.zero_at_supports(size * rng.standard_normal(system.size)) for size in (1e-4, 1.0)
    )
    moved = []
    for size in (0.1, 0.7):
        mu = dict.fromkeys(scene(kind).unloaded().mu, size) | {"lambda_m": 2.0}
        none = {**mu, "lambda_m": 0.0}

        def rate(of: Any) -> Any:
            a, b, c, d = (of(u + side * e * v) for side in (-2, -1, 1, 2))
            return (a - 8 * b + 8 * c - d) / (12 * e)

        slope = rate(lambda u, mu=mu: 2.0 * system.potential(u, mu, "lambda_m"))
        assert 2.0 * system.load(u, mu, "lambda_m") @ v == pytest.approx(slope, rel=1e-6)
        whole = _times(system.tangent(u, mu), v) - _times(system.tangent(u, none), v)
        difference = rate(lambda u, mu=mu: 2.0 * system.load(u, mu, "lambda_m"))
        whole, difference = system.zero_at_supports(whole), system.zero_at_supports(difference)
        assert np.linalg.norm(whole - difference) <= 1e-6 * np.linalg.norm(difference)
        moved.append(whole)
    assert np.linalg.norm(moved[1] - moved[0]) > 1e-2 * np.linalg.norm(moved[0])


def _times(K: Any, v: np.ndarray) -> np.ndarray:
    x = K.createVecRight()
    x.array[:] = v
    return np.array((K * x).array)


def test_force_and_torque_on_a_magnetised_cap() -> None:
    """Those of magpylib, of the magnet on the dipoles of a rigid cap: 20 x 40 of them, by Gauss's
    rule.
    """
    R, h, polar, J = 25 * MM, 0.25 * MM, np.pi / 6, np.array([0.06, 0.0, 0.08])
    here = np.array([6 * MM, -3 * MM, 40 * MM])
    axes = {"x": [1, 0, 0], "y": [0, 1, 0], "z": [0, 0, 1]}
    steps = [{"kind": "field"}]
    steps += [
        {"kind": "source", "name": f"move_{k}", "move": [5e-3 * x for x in e]}
        for k, e in axes.items()
    ]
    steps += [
        {"kind": "source", "name": f"turn_{k}", "turn": {"axis": e, "angle": 20}}
        for k, e in axes.items()
    ]
    magnet = {**MAGNET, "position": here.tolist(), "axis": {"polar": 35, "azimuth": 70}}
    cap = made(
        {
            "geometry": "cap",
            "radius": "25 mm",
            "polar": 30,
            "thickness": "0.25 mm",
            "youngs_modulus": "1 TPa",
        },
        {"rim": "clamped"},
        magnetic={
            "remanent": {
                "polar": float(np.degrees(np.arctan2(0.6, 0.8))),
                "flux_density": "100 mT",
            },
            "applied": {"sources": [magnet]},
        },
        loading=steps,
        mesh={"degree": 3, "refinement": 0.3},
    )
    mu = {**cap.unloaded().mu, "lambda_m": cap.problem.lambda_m}
    found = cap.observe(State(cap.model.zero(), mu))
    force = [found[f"source_force_move_{k}"] for k in axes]
    torque = [found[f"source_torque_turn_{k}"] for k in axes]

    s, weights = np.polynomial.legendre.leggauss(20)
    theta, weight = (s + 1) * polar / 2, weights * polar / 2
    phi = 2 * np.pi * np.arange(40) / 40
    places = R * np.array(
        [[np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)] for t in theta for p in phi]
    )
    volumes = np.repeat(h * R**2 * np.sin(theta) * weight * 2 * np.pi / 40, 40)
    body = [
        magpylib.misc.Dipole(moment=v * J / magpylib.mu_0, position=x)
        for v, x in zip(volumes, places, strict=True)
    ]
    own = magpylib.magnet.Cylinder(
        dimension=(20 * MM, 10 * MM), polarization=(0, 0, 1.3), position=here
    )
    own.orientation = Rotation.from_euler("ZY", [70, 35], degrees=True)
    F, T = np.sum(magpylib.getFT(own, body, pivot=here), axis=1)
    assert np.linalg.norm(force + F) <= 1e-3 * np.linalg.norm(F)
    assert np.linalg.norm(torque + T) <= 1e-3 * np.linalg.norm(T)


@pytest.mark.parametrize("kind", ["shell", "solid"])
def test_newton_is_quadratic(kind: str) -> None:
    """Full steps with the tangent at each iterate: each error is at most a fixed multiple of the
    last one squared.
    """
    system = scene(kind).model.system
    mu = dict.fromkeys(scene(kind).unloaded().mu, 0.3) | {"lambda_m": 3e-4}
    u, sizes = np.zeros(system.size), list[float]()
    for _ in range(30):
        rows, columns, values = system.tangent(u, mu).getValuesCSR()
        K = scipy.sparse.csr_array((values, columns, rows), shape=(u.size, u.size))
        du = scipy.sparse.linalg.spsolve(K.tocsc(), system.residual(u, mu))
        u = u - du
        sizes.append(float(np.abs(du).max()))
        if sizes[-1] < 1e-12:
            break
    near = [size for size in sizes if size < 2e-3]
    assert len(near) >= 4
    assert all(after <= 1e4 * before**2 + 1e-14 for before, after in pairwise(near))
    assert near[-1] < 1e-12


def test_models_agree() -> None:
    """A magnet below a rigid disc, moved: meridian and half shell have the same force on it; a
    solid is thick.
    """
    disc = {"geometry": "disc", "radius": "25 mm", "thickness": "0.5 mm", "youngs_modulus": "1 MPa"}
    coarse = {"mesh": {"degree": 3, "refinement": 0.5}}
    found = []
    for symmetry, sections in (
        ("axisymmetric", {}),
        ("half", coarse),
        ("half", {"model": "solid", "mesh": {"refinement": 0.5}}),
    ):
        one = made(
            disc,
            {"rim": "clamped"},
            symmetry=symmetry,
            magnetic={"remanent": {"flux_density": "60 mT"}, "applied": {"sources": [BELOW]}},
            loading=[
                {"kind": "field", "points": 1},
                {"kind": "source", "move": [0, 0, -0.01], "points": 1},
            ],
            **sections,
        )
        mu = dict.fromkeys(one.unloaded().mu, 0.5) | {"lambda_m": one.problem.lambda_m}
        found.append(one.observe(State(one.model.zero(), mu))["source_force"])
    assert found[1] == pytest.approx(found[0], rel=1e-5)
    assert found[2] == pytest.approx(found[0], rel=2e-3)
