"""Taylor tests of the magnetic energies: the order of what each approximation leaves out."""

from collections.abc import Callable
from typing import get_args

import numpy as np
import pytest
from conftest import hemisphere

from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import MagneticEnergy, Magnetisation
from magshell_fenicsx.shells.shell import ShellModel

UP, TILTED = np.array([0.0, 0, 1]), np.array([0.48, 0.36, 0.8])
ENERGIES: tuple[MagneticEnergy, ...] = get_args(MagneticEnergy)


def smooth(r0: np.ndarray) -> np.ndarray:
    x, y, z = r0.reshape(-1, 3).T
    return (np.column_stack([z * x + y, x - y * z, 0.5 + x * y - z**2 + x])).ravel()


@pytest.fixture(scope="module")
def energy() -> Callable[[MagneticEnergy, np.ndarray, float], float]:
    """The energy of `size` times a smooth displacement."""
    surface, models = hemisphere(), {}

    def value(kind: MagneticEnergy, applied: np.ndarray, size: float) -> float:
        key = kind, tuple(applied)
        if key not in models:
            loads = Loads(magnetic=Magnetisation(UP, applied, kind))
            models[key] = ShellModel(surface, Material(0.3, 0.05), 3, {}, loads)
        model = models[key]
        return float(model.system.potential(size * smooth(model.r0.x.array), {}, "lambda_m"))

    return value


def order(full: Callable[[float], float], other: Callable[[float], float]) -> float:
    """Order in the size of u of the difference of two energies."""
    a, b = (abs(full(e) - other(e)) for e in (2e-2, 1e-2))
    return float(np.log2(a / b))


@pytest.mark.parametrize(
    ("kind", "applied", "remainder"),
    [
        ("second_consistent", UP, 3),
        ("second_consistent", TILTED, 3),
        ("second", UP, 3),
        ("second", TILTED, 1),  # the couple is missing where Br is not parallel to Ba
        ("first", UP, 2),
        ("first", TILTED, 1),
        ("torque", UP, 1),
    ],
)
def test_remainder(
    energy: Callable[[MagneticEnergy, np.ndarray, float], float],
    kind: MagneticEnergy,
    applied: np.ndarray,
    remainder: int,
) -> None:
    found = order(lambda e: energy("full", applied, e), lambda e: energy(kind, applied, e))
    assert found == pytest.approx(remainder, abs=0.15)


def test_zero_displacement_has_zero_energy(
    energy: Callable[[MagneticEnergy, np.ndarray, float], float],
) -> None:
    for kind in ENERGIES:
        assert energy(kind, TILTED, 0.0) == pytest.approx(0.0, abs=1e-15)
