"""The edge of a sheet pressed on the face of another one: it does not sink in, and the force is
that of a beam.
"""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from along import csr
from numpy.typing import NDArray
from scipy.integrate import solve_bvp
from scipy.sparse.linalg import spsolve
from sheets import Sheet, write

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.assembly.nonlocal_terms import times
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.simulate.follow import follow

Array = NDArray[np.float64]
h, WIDTH, GAP, DOWN = 0.02, 0.1, 0.1, 0.02
STEEP = np.radians(80)
BOUND = 1e-3  # of h, the penetration that is allowed


def standing(folder: Path, angle: float, floor_at: float = -0.3) -> dict[str, Any]:
    """A strip that stands on a floor, inclined by an angle, and is pressed down at its upper end.

    The floor's cells are larger than h, and the strip's edge lies inside them, or along a side of
    them where the floor begins at -0.35.
    """
    up = np.array([np.cos(angle), 0, np.sin(angle)])
    floor = Sheet("floor", (floor_at, -0.05, 0), (0.7, 0, 0), (0, 0.2, 0), (4, 1))
    strip = Sheet("strip", (0, 0, (1 + GAP) * h), tuple(up), (0, WIDTH, 0), (8, 1))
    return {
        "shell": {
            "geometry": "mesh", "file": str(write(folder / "two.msh", [floor, strip])), "radius": 1,
            "thickness": h, "youngs_modulus": 1, "poisson_ratio": 0,
        },
        "boundary": {"floor": "clamped", "strip_2": "clamped"},
        "points": {"tip": [0, 0, (1 + GAP) * h], "end": [0, WIDTH, (1 + GAP) * h]},
        "contact": [["strip", "floor"]],
        "mesh": {"degree": 3},
        "loading": {
            "kind": "edge", "control": "load", "points": 1, "factor": 1,
            "moves": [{"supports": ["strip_2"], "translation": [0, 0, -DOWN]}],
        },
    }  # fmt: skip


def beam() -> dict[str, float]:
    """Force over width and D, and place of the tip, of a beam that stretches, clamped above, on a
    smooth floor.

    D theta' = N x from the tip, which has moved to x = 0; along it the strain is -N sin(theta)/(E
    h).
    """
    D = h**3 / 12

    def slopes(s: Array, z: Array, p: Array) -> Array:
        stretch = 1 - p[0] * D * np.sin(z[2]) / h
        return np.asarray(np.stack([stretch * np.cos(z[2]), stretch * np.sin(z[2]), p[0] * z[0]]))

    def ends(z0: Array, z1: Array, p: Array) -> Array:
        return np.array([z0[0], z0[1], z1[1] - (np.sin(STEEP) + GAP * h - DOWN), z1[2] - STEEP])

    s = np.linspace(0, 1, 41)
    start = np.stack([np.cos(STEEP) * s, np.sin(STEEP) * s, 0 * s + STEEP])
    found = solve_bvp(slopes, ends, s, start, [0.5], tol=1e-9)
    assert found.success
    return {"force": float(found.p[0]), "tip": float(np.cos(STEEP) - found.y[0, -1])}


@pytest.mark.parametrize(("angle", "floor_at"), [(80, -0.3), (90, -0.3), (90, -0.35), (60, -0.35)])
def test_derivatives(tmp_path: Path, angle: float, floor_at: float) -> None:
    """Central differences of energy and forces where an edge has sunk in, on a side of cells too:
    1e-6.
    """
    scene = Scene(Case.model_validate(standing(tmp_path, np.radians(angle), floor_at)))
    model, (term,), mu = scene.model, scene.model.shell_contacts, scene.unloaded().mu
    system, rng = model.system, np.random.default_rng(angle)
    u = 1e-4 * h * rng.standard_normal((system.size // 3, 3))
    u[:, 2] -= (GAP + 3e-3) * h * (model.r0.x.array.reshape(-1, 3)[:, 2] > 0)
    u = system.zero_at_supports(u.ravel())
    v = system.zero_at_supports(1e-8 * h * rng.standard_normal(system.size))
    at = system.at_state(State(u, mu))
    Kv = times([(1.0, at.evaluate(term.entries))], v)
    low, high = (system.forces(u + side * v, mu, term.name) for side in (-0.5, 0.5))
    assert at.evaluate(term.penetration) > 2e-3 * h
    assert np.abs(high - low - Kv).max() < 1e-6 * np.abs(Kv).max()
    energies = [system.energies(u + side * 100 * v, mu)[term.name] for side in (-0.5, 0.5)]
    assert energies[1] - energies[0] == pytest.approx(
        100 * system.forces(u, mu, term.name) @ v, rel=1e-5
    )


def test_a_corner(tmp_path: Path) -> None:
    """A strip turned in its plane onto a corner, as a rigid body: the corner is as deep as it is,
    0.01 h times the slope, and differences are as those of an edge.
    """
    scene = Scene(Case.model_validate(standing(tmp_path, STEEP)))
    model, (term,), mu = scene.model, scene.model.shell_contacts, scene.unloaded().mu
    system, rng = model.system, np.random.default_rng(3)
    r, deep, tilt = model.r0.x.array.reshape(-1, 3), 0.1 * h, np.radians(30)
    along, up = np.array([0, 1.0, 0]), np.array([np.cos(STEEP), 0, np.sin(STEEP)])
    of_strip, off = r[:, 2] > 0, r - [0, 0, (1 + GAP) * h]
    u = np.zeros_like(r)
    for way, to in (
        (along, np.cos(tilt) * along + np.sin(tilt) * up),
        (up, np.cos(tilt) * up - np.sin(tilt) * along),
    ):
        u[of_strip] += np.outer(off[of_strip] @ way, to - way)
    u[of_strip, 2] -= GAP * h + deep
    assert (r + u)[of_strip, 2].min() == pytest.approx(h - deep)
    u, v = u.ravel()[: system.size], 1e-8 * h * rng.standard_normal(system.size)
    at = system.at_state(State(u, mu))
    assert at.evaluate(term.penetration) == pytest.approx(deep, abs=0.015 * h * np.sin(tilt))
    Kv = times([(1.0, at.evaluate(term.entries))], v)
    low, high = (system.forces(u + side * v, mu, term.name) for side in (-0.5, 0.5))
    assert np.abs(high - low - Kv).max() < 1e-6 * np.abs(Kv).max()


def test_a_steep_edge(tmp_path: Path) -> None:
    """The strip's ends sink in by less than the bound; force and sliding are those of the beam,
    2e-3.

    Newton's method is quadratic there: each error is of the order of the square of the one before.
    """
    scene = Scene(Case.model_validate(standing(tmp_path, STEEP)))
    *_, last = follow(scene)
    seen, expected, D = scene.observe(last.point.state), beam(), h**3 / 12
    for name in ("tip", "end"):
        assert -BOUND < GAP + seen[f"{name}_uz"] / h < BOUND
    assert seen["contact_gap_over_h"] > -BOUND
    assert seen["strip_2_fz"] / (D * WIDTH) == pytest.approx(-expected["force"], rel=2e-3)
    assert 2 * np.pi * seen["contact_force"] / WIDTH == pytest.approx(expected["force"], rel=2e-3)
    assert seen["tip_ux"] == pytest.approx(expected["tip"], rel=2e-3)
    system, exact, mu = scene.model.system, last.point.state.u, last.point.state.mu
    rough = system.zero_at_supports(np.random.default_rng(0).standard_normal(system.size))
    u, errors = exact + 1e-5 * h * rough, list[float]()
    for _ in range(5):
        u = u - spsolve(csr(system.tangent(u, mu)).tocsc(), system.residual(u, mu))
        errors.append(float(np.abs(u - exact).max()) / h)
    below = [(a, b) for a, b in pairwise(errors) if b > 1e-11]
    assert errors[-1] < 1e-11
    assert below
    assert all(b < 1e4 * a**2 for a, b in below), errors
