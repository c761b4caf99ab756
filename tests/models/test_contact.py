"""Bodies that press: derivatives of every model by u and the approach, and plate theory."""

from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import scipy.sparse.linalg
from numpy.typing import NDArray
from scipy.optimize import brentq

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.parts.gap import Penalty
from magshell_fenicsx.simulate.contacts_in_time import ContactsInTime
from magshell_fenicsx.simulate.follow import follow

Array = NDArray[np.float64]
HEMISPHERE = {"geometry": "hemisphere", "radius_to_thickness": 40, "poisson_ratio": 0.3}
BALL = {"kind": "sphere", "radius": 0.3, "stiffness": 1e3}
COARSE = {"degree": 2, "refinement": 0.3}
KINDS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "meridian": ({"rod": {"kind": "rod", "radius": 0.1, "edge": 0.05, "stiffness": 1e3}},
                 {"mesh": {"refinement": 0.5}}),
    "half": ({"ball": BALL}, {"symmetry": "half", "mesh": COARSE}),
    "full": (
        {"ball": {**BALL, "at": {"polar": 40, "azimuth": 70}}, "roller": {
            "kind": "cylinder", "radius": 0.3, "axis": [1, 0, 0], "stiffness": 1e3}},
        {"symmetry": "none", "mesh": COARSE},
    ),
    "varying thickness": (
        {"plate": {"kind": "plane", "at": {"point": [0, 0.1, 0]}, "stiffness": 1e3}},
        {"shell": {"geometry": "plate", "length": 1, "width": 0.2, "thickness": 0.02,
                   "youngs_modulus": 1,
                   "poisson_ratio": 0.3, "thickness_factor": "1 - x/2"},
         "boundary": {"left": "clamped"}, "symmetry": "none", "mesh": {"degree": 3, "size": 0.2}},
    ),
}  # fmt: skip


@cache
def scene(kind: str) -> Scene:
    bodies, sections = KINDS[kind]
    loading = [{"kind": "contact", "body": name, "approach": 1} for name in bodies]
    data = {
        "shell": HEMISPHERE,
        "boundary": {"equator": "clamped"},
        "bodies": bodies,
        "loading": loading,
    }
    return Scene(Case.model_validate(data | sections))


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives(kind: str) -> None:
    """Central differences of energy, residual and conjugate at a rough state: 1e-6; all change with
    the approach.
    """
    model = scene(kind).model
    system, h = model.system, model.material.h
    rng = np.random.default_rng(4)
    u, v = (
        system.zero_at_supports(size * h * rng.standard_normal(system.size))
        for size in (0.01, 1e-6)
    )
    changed = []
    for approach in (0.1, 0.2) if kind == "varying thickness" else (0.3, 0.5):
        mu = dict.fromkeys(scene(kind).unloaded().mu, approach)
        K = system.tangent(u, mu)
        given = K.createVecRight()
        given.array[:] = v
        Kv = (K * given).array * (system.zero_at_supports(np.ones(system.size)) != 0)
        low, high = (system.residual(u + side * v, mu) for side in (-0.5, 0.5))
        assert np.abs(high - low - Kv).max() < 1e-6 * np.abs(Kv).max()
        found = [np.array(Kv)]
        for name in model.contacts:
            down, up = ({**mu, name: approach + side} for side in (-5e-6, 5e-6))
            column = system.load(u, mu, name)
            difference = (system.residual(u, up) - system.residual(u, down)) / 1e-5
            assert np.abs(column).max() > 0
            assert np.abs(difference - column).max() < 1e-6 * np.abs(column).max()
            force, bend = system.potential(u, mu, name), system.curvature(u, mu, name, name)
            forces = [system.potential(u, at, name) for at in (down, up)]
            assert (forces[1] - forces[0]) / 1e-5 == pytest.approx(bend, rel=1e-6)
            energies = []
            for at in (down, up):
                energies.append(sum(system.energies(u, at).values()))
            assert (energies[1] - energies[0]) / 1e-5 == pytest.approx(force, rel=1e-5)
            found += [column, np.array([force, bend])]
        changed.append(found)
    for number, (first, second) in enumerate(zip(*changed, strict=True)):
        least = 1e-3 if number else 1e-7  # of the tangent the shell's own stiffness stays
        assert np.abs(first - second).max() > least * np.abs(first).max()


@pytest.mark.parametrize("kind", ["meridian", "full"])
def test_derivative_of_the_mean_force_of_a_step_in_time(kind: str) -> None:
    """Central differences by the displacement within the step at which forces are taken: 2e-4. The
    tangent is symmetric: it takes the mean normal of the step for that at its end.
    """
    model = scene(kind).model
    system, part = model.system, 0.6
    contacts = ContactsInTime(model)
    mu = dict.fromkeys(scene(kind).unloaded().mu, 0.4)
    rng = np.random.default_rng(5)
    begin, u, v = (
        system.zero_at_supports(size * model.material.h * rng.standard_normal(system.size))
        for size in (0.01, 0.01, 1e-6)
    )

    def average_with(displacement: Array) -> None:
        end = begin + (displacement - begin) / part
        contacts.average_along(State(begin, mu), State(end, mu), part)

    average_with(u)
    K = system.tangent(u, mu)
    direction = K.createVecRight()
    direction.array[:] = v
    Kv = (K * direction).array * (system.zero_at_supports(np.ones(system.size)) != 0)
    residuals = []
    for displacement in (u - v / 2, u + v / 2):
        average_with(displacement)
        residuals.append(system.residual(displacement, mu))
    contacts.use_state_forces()
    low, high = residuals
    assert np.abs(high - low - Kv).max() < 2e-4 * np.abs(Kv).max()


@pytest.mark.parametrize("kind", ["meridian", "full"])
def test_newton_is_quadratic(kind: str) -> None:
    """Full steps with the tangent at each iterate: each error is at most a fixed multiple of the
    last one squared.
    """
    system = scene(kind).model.system
    mu = dict.fromkeys(scene(kind).unloaded().mu, 0.2)
    u, sizes = np.zeros(system.size), list[float]()
    for _ in range(25):
        rows, columns, values = system.tangent(u, mu).getValuesCSR()
        K = scipy.sparse.csc_array(
            scipy.sparse.csr_array((values, columns, rows), shape=(u.size, u.size))
        )
        du = scipy.sparse.linalg.spsolve(K, system.residual(u, mu))
        u = u - du
        sizes.append(float(np.abs(du).max()) / system.length)
        if sizes[-1] < 1e-10:
            break
    near = [size for size in sizes if size < 1e-2]
    assert len(near) >= 3
    assert all(after <= 200 * before**2 + 1e-11 for before, after in pairwise(near))
    assert near[-1] < 1e-10


def test_penalty() -> None:
    """Zero where the gap is open; its derivatives by central differences, also across the end of
    the soft part.
    """
    s = np.array([-1e-3, 2e-4, 8e-4, 9.99e-4, 1.001e-3, 5e-3])
    value, first, second = Penalty(3.0, 1e-3).derivatives(s)
    low, high = (Penalty(3.0, 1e-3).derivatives(s + side) for side in (-1e-7, 1e-7))
    assert value[0] == first[0] == second[0] == 0
    assert (high[0] - low[0]) / 2e-7 == pytest.approx(first, rel=1e-6, abs=1e-12)
    assert (high[1] - low[1]) / 2e-7 == pytest.approx(second, rel=1e-6, abs=1e-9)


def disc_on_ball(w0: float, bend: float) -> tuple[float, float]:
    """Radius c of the ring and force P/(8 pi D) of a clamped disc of radius 1 that a ball of radius
    1/bend lifts by w0.

    Kirchhoff's plate under a ring load is a paraboloid within the ring: it fits the ball there
    (Timoshenko and Woinowsky-Krieger, Theory of Plates and Shells, art. 19).
    """

    def force(c: float) -> float:
        return bend / (-2 * np.log(c) - 1 + c**2)

    c = brentq(lambda c: force(c) * (c**2 * np.log(c) + (1 - c**2) / 2) - w0, 1e-3, 0.9)
    return float(c), float(force(c))


def test_disc_against_plate_theory() -> None:
    """A ball so large that a flat disc rests on a ring of it: the ring's force and radius, 2e-3."""
    h, bend = 1 / 100, 1.2e-3
    data = {
        "shell": {"geometry": "disc", "radius_to_thickness": 1 / h, "poisson_ratio": 0.3},
        "boundary": {"rim": "clamped"},
        "bodies": {"ball": {"kind": "sphere", "radius": 1 / bend, "stiffness": 1e4}},
        "loading": {"kind": "contact", "approach": 0.03, "points": 2},
        "mesh": {"refinement": 2},
    }
    scene = Scene(Case.model_validate(data))
    last = list(follow(scene))[-1].point.state
    row = scene.observe(last)
    c, force = disc_on_ball(row["w_pole_over_h"] * h, bend)
    assert c > 0.2
    assert row["force"] == pytest.approx(4 * force, rel=2e-3)  # F R/(2 pi D)
    assert row["contact_radius"] == pytest.approx(c, rel=1e-2)
    assert row["contact_inner"] < c < row["contact_outer"]
