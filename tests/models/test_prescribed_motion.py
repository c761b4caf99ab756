"""Supports that move: derivatives by their amplitudes, and rigid motions of everything."""

from functools import cache

import numpy as np
import pytest
from models.moving_scenes import CLAMPED, PLATE, RING, move, moving_scene

from magshell_fenicsx import Scene
from magshell_fenicsx.assembly.prescribed_motion import vectors_in_space
from magshell_fenicsx.continuation.system import State

SHORT = {**PLATE, "width": 0.4}
PUSH = move("push", "right", shift=[-0.8, 0, 0.1])
TURN = move("turn", "right", shift=[0, 0, 0.3], turn=[0, -0.7, 0], centre=[1, 0, 0])
TWIST = move("twist", "left", turn=[0.9, 0.2, 0.1], centre=[0, 0.2, 0])
SMALL = {"mesh": {"degree": 3, "size": 0.4}}
SOLID = {"model": "solid", "mesh": {"size": 0.4}}
UP = move("up", "inner", shift=[0, 0, 0.3])
FIELD = {"magnetic": {"lambda_m": 1.0, "remanent": {"polar": 90}, "applied": {"polar": 0}}}
TIP = {"left": "clamped", "right": {"held": ["z"]}}
CAP = {"geometry": "cap", "radius": 1.0, "thickness": 0.1, "polar": 60, "youngs_modulus": 1.0}
TUBE = {
    "geometry": "cylinder",
    "radius": 1.0,
    "length": 1.0,
    "thickness": 0.1,
    "youngs_modulus": 1.0,
}
ROLL = move("roll", "rim", shift=[0.1, 0.2, 0.3], turn=[0.4, -0.7, 0.2], centre=[0, 0.1, 0.2])
FALL = move("fall", "rim", shift=[0, 0, -0.3], turn=[0, 0.5, 0])
RIM = {"rim": "clamped"}
PRESSURE = {"loading": {"kind": "pressure"}}
KINDS = {
    "shell": lambda: moving_scene((PUSH, TURN, TWIST), SHORT, **SMALL, **FIELD),
    "half": lambda: moving_scene((PUSH, TURN),
                                 {"geometry": "strip", "radius_to_thickness": 100, "width": 0.4},
                                 {"root": "clamped", "tip": "clamped"}, symmetry="half", **SMALL),
    "varying thickness": lambda: moving_scene((PUSH, TURN),
                                              {**SHORT, "thickness_factor": "1 + x/2"}, **SMALL),
    "one component": lambda: moving_scene((move("lift", "right", shift=[0, 0, 0.4]),), SHORT, TIP,
                                          **SMALL),
    "solid": lambda: moving_scene((PUSH, TURN), {**SHORT, "thickness": 0.1}, CLAMPED, **SOLID,
                                  **FIELD),
    "meridian": lambda: moving_scene((UP,), RING, {"inner": "clamped", "outer": "clamped"},
                                     symmetry="axisymmetric"),
    "ring that rolls": lambda: moving_scene(
        (move("up", "inner", shift=[0.1, 0, 0.3]),
         move("roll", "inner", turn=[0, 0.8, 0], centre=[0.4, 0, 0])),
        RING, {"inner": "clamped", "outer": "clamped"}, symmetry="axisymmetric",
    ),
    "under pressure": lambda: moving_scene((ROLL, FALL), CAP, RIM, mesh={"degree": 3, "size": 1},
                                           **PRESSURE),
    "meridian under pressure": lambda: moving_scene(
        (move("up", "top", shift=[0, 0, 0.3]),), TUBE, {"bottom": "clamped", "top": "clamped"},
        symmetry="axisymmetric", **PRESSURE,
    ),
    "solid under pressure": lambda: moving_scene((ROLL,), CAP, RIM, model="solid", mesh={"size": 1},
                                                 **PRESSURE),
}  # fmt: skip


@cache
def scene(kind: str) -> Scene:
    return KINDS[kind]()


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_by_the_amplitudes(kind: str) -> None:
    """Central differences of energy, residual and conjugates at a rough state; all change with the
    amplitude.
    """
    system, step = scene(kind).model.system, 1e-5
    rng = np.random.default_rng(1)
    u = system.zero_at_supports(1e-3 * rng.standard_normal(system.size))
    start = scene(kind).unloaded().mu
    moving, found = [name for name in start if name in system.coordinates], []
    for size in (0.02, 0.05 if "solid" in kind else 0.4):  # coarse hexahedra turn inside out
        mu = {name: size * (1 + i) * (-1) ** i for i, name in enumerate(start)}

        def energy(mu: dict[str, float]) -> float:
            placed = system.with_moved_supports(State(u, mu)).u
            return sum(
                (mu[t.amplitude] if t.amplitude else 1.0) * system.energies(placed, mu)[t.name]
                for t in system.terms
            )

        for name in moving:
            low, high = ({**mu, name: mu[name] + side * step} for side in (-1, 1))
            slope = system.potential(u, mu, name)
            assert slope == pytest.approx((energy(high) - energy(low)) / (2 * step), rel=1e-5)
            column = system.load(u, mu, name)
            difference = (system.residual(u, high) - system.residual(u, low)) / (2 * step)
            np.testing.assert_allclose(column, difference, atol=1e-6 * np.abs(column).max())
            np.testing.assert_array_equal(column, system.zero_at_supports(column))
            found.append((slope, np.abs(column).max()))
            for other in mu:
                bend = system.curvature(u, mu, name, other)
                mixed = (system.potential(u, high, other) - system.potential(u, low, other)) / (
                    2 * step
                )
                assert bend == pytest.approx(mixed, rel=1e-5, abs=1e-8 * abs(slope))
                assert bend == pytest.approx(
                    system.curvature(u, mu, other, name), rel=1e-9, abs=1e-12 * abs(slope)
                )
    first, second = np.array(found).reshape(2, -1)
    assert (np.abs(second / first - 1) > 1e-2).all()


@pytest.mark.parametrize("kind", ["shell", "solid"])
def test_rigid_motion_of_everything(kind: str) -> None:
    """Both ends and all other nodes carried along by a rotation of 130 degrees: no energy, no
    force, no conjugate.
    """
    both = move(
        "turn", "left", "right", shift=[0.2, 0.1, -0.4], turn=[1.0, -1.5, 1.4], centre=[0.3, 0, 0]
    )
    sections = SMALL if kind == "shell" else SOLID
    model = moving_scene(
        (both,), SHORT if kind == "shell" else {**SHORT, "thickness": 0.1}, **sections
    ).model
    places, mu = vectors_in_space(model.r0.x.array, 3), {"turn": 1.0}
    Q = both.motion.rotation(1.0)[0]
    u = (
        (places - both.motion.centre) @ Q.T + both.motion.centre + both.motion.shift - places
    ).ravel()
    state = model.system.with_moved_supports(State(u, mu))
    np.testing.assert_allclose(state.u, u, atol=1e-14)
    bent = model.system.with_moved_supports(State(0.0 * u, mu))
    energy = sum(model.system.energies(bent.u, mu).values())
    assert abs(sum(model.system.energies(u, mu).values())) < 1e-12 * energy
    assert np.abs(model.system.forces(u, mu)).max() < 1e-11
    assert abs(model.system.potential(u, mu, "turn")) < 1e-11
