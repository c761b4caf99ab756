"""What must not change the energy, and closed-form energies of a swelling sphere."""

from collections.abc import Callable

import numpy as np
import pytest
from conftest import hemisphere

from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.parts.imperfections.dimple import Dimple
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.shells.shell import ShellModel

Shells = Callable[..., ShellModel]


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    k = axis / np.linalg.norm(axis)
    W = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.eye(3) + np.sin(angle) * W + (1 - np.cos(angle)) * W @ W


@pytest.mark.parametrize("angle", [0.3, 2.5])
def test_rigid_motion_costs_nothing(shell: Shells, angle: float) -> None:
    """Every elastic term stays below 1e-20 of the membrane energy of a 1 % stretch."""
    model = shell(2, held=False)
    r0 = model.r0.x.array.reshape(-1, 3)
    stretch = model.system.energies(0.01 * r0.ravel())["membrane"]
    Q = rotation(np.array([0.3, -0.5, 0.8]), angle)
    moved = model.system.energies((r0 @ Q.T - r0 + [0.4, -0.2, 0.7]).ravel())
    for name in ("membrane", "bending", "interior edges"):
        assert abs(moved[name]) < 1e-20 * stretch


def test_swelling_sphere() -> None:
    """r = (1 + e) r0: E = (e + e^2/2) a0, K = e b0, so every energy has a closed form."""
    nu, h, e = 0.3, 0.05, 0.02
    Br, Ba = np.array([0.0, 0, 1]), np.array([0.6, 0.0, 0.8])
    model = ShellModel(
        hemisphere(0.35),
        Material(nu, h),
        4,
        {},
        Loads(pressure=True, magnetic=Magnetisation(Br, Ba)),
    )
    u = e * model.r0.x.array
    found = model.system.energies(u)
    area, both = 2 * np.pi, 2 * (1 - nu) + 4 * nu  # S:S = 2 s^2, tr S = 2 s
    assert found["membrane"] == pytest.approx(
        both * (e + e**2 / 2) ** 2 / (2 * (1 - nu**2)) * area, rel=1e-5
    )
    assert found["bending"] == pytest.approx(
        h**2 / (24 * (1 - nu**2)) * both * e**2 * area, rel=1e-3
    )
    assert model.volume_change(u) == pytest.approx(2 * np.pi / 3 * ((1 + e) ** 3 - 1), rel=1e-5)
    # -e Ba . (I - n n) Br integrated: the integral of n n over the hemisphere is 2 pi/3 I
    assert found["magnetic"] == pytest.approx(
        -e * (Ba @ Br) * (2 * np.pi - 2 * np.pi / 3), rel=1e-5
    )


def test_half_is_half_of_the_whole() -> None:
    """A mirror-symmetric displacement has half the energy on the half shell, edges included."""
    energies = []
    for half in (False, True):
        conditions = {"rim": "clamped", **({"symmetry": "symmetry"} if half else {})}
        surface = hemisphere(0.2, half=half, dimple=Dimple(0.02, 0.5))
        model = ShellModel(surface, Material(0.3, 0.05), 3, conditions, Loads())
        x, y, z = model.r0.x.array.reshape(-1, 3).T
        u = 0.05 * (z**2)[:, None] * np.column_stack([x * y**2, y * (1 + x), 0.3 + x + y**2])
        found = model.system.energies(u.ravel())
        edges = sum(v for k, v in found.items() if k.endswith("edges"))
        energies.append(
            model.multiplicity * np.array([found["membrane"], found["bending"] + edges])
        )
    assert energies[1] == pytest.approx(energies[0], rel=2e-4)
