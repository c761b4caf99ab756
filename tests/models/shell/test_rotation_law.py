"""A remanence that turns and does not stretch, R Br: against SciPy's polar decomposition and finite
differences.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import scipy.linalg
from along import difference as tangent_difference
from conftest import TILTED, disc, hemisphere, random_displacement
from test_derivatives import alone, check
from test_fast_residual import difference as residual_difference
from test_magnetic_energies import order, smooth

from magshell_fenicsx.mesh.mirror import Y0_PLANE
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.shell.spatial_fields import tangential
from magshell_fenicsx.models.shell.strains import TangentFrame
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism import laws
from magshell_fenicsx.parts.magnetism.magnetised import MagneticEnergy, Magnetisation, RemanenceLaw
from magshell_fenicsx.shells.shell import ShellModel

MATERIAL = Material(0.3, 0.05)
BR, BA, E3 = np.array([0.64, 0.48, 0.6]), np.array([0.36, -0.48, 0.8]), np.array([0.0, 0.0, 1.0])
G = np.array([[0.5, 0.2, -0.1], [0.2, -0.7, 0.3], [0.1, 0.3, 0.2]])
MU = {"lambda_m": 0.4, "lambda_across": -0.7, "pressure": 0.3}
TURN = scipy.linalg.expm(np.cross(np.eye(3), [0.3, -0.8, 0.5]))
DEFORMATIONS = {
    "none": np.eye(3),
    "turned": TURN,
    "uniaxial": np.diag([1.1, 1.0, 1.0]),
    "equal stretches": np.diag([1.1, 1.1, 1.0]),
    "sheared far": np.array([[1.0, 4.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "turned and stretched": TURN @ np.array([[1.2, 0.3, 0.0], [0.1, 0.7, 0.0], [0.0, 0.0, 1.0]]),
}


@pytest.mark.parametrize("name", DEFORMATIONS)
def test_homogeneous_deformations(name: str) -> None:
    """The energy per area is -Ba .

    (R - 1) Br, and -Ba . (F - 1) Br of the other law; at 10 % they differ by 10 %.
    """
    F = DEFORMATIONS[name]
    laws: dict[RemanenceLaw, np.ndarray] = {"deformation": F, "rotation": scipy.linalg.polar(F)[0]}
    for law, carrier in laws.items():
        model = ShellModel(
            disc(0.8), MATERIAL, 2, {}, Loads(magnetic=Magnetisation(BR, BA, law=law))
        )
        X = model.r0.x.array.reshape(-1, 3)
        area = 3 * model.volume_change(np.tile(E3, len(X)))
        found = model.system.potential((X @ (F - np.eye(3)).T).ravel(), {}, "lambda_m") / area
        assert found == pytest.approx(-BA @ (carrier - np.eye(3)) @ BR, abs=1e-13)
    if name == "uniaxial":
        assert BA @ (F - laws["rotation"]) @ BR == pytest.approx(0.1 * BA[0] * BR[0])


def test_as_it_is_drawn() -> None:
    """The same rotation at random points of any curvature."""
    jet, u = np.random.default_rng(0).standard_normal((2, 6, 50, 3))
    frame, v = TangentFrame.from_jet(jet), np.random.default_rng(1).standard_normal((50, 3))
    identity = np.stack(
        [frame.convected(np.broadcast_to(e, v.shape), u) for e in np.eye(3)], axis=-1
    )
    expected = np.array([scipy.linalg.polar(F)[0] @ w for F, w in zip(identity, v, strict=True)])
    assert frame.rotated(v, u) == pytest.approx(expected, abs=1e-12)


@pytest.fixture(scope="module")
def energy() -> Callable[[MagneticEnergy, float], float]:
    """The energy of `size` times a smooth displacement."""
    surface = hemisphere()
    models = {
        kind: ShellModel(
            surface, MATERIAL, 3, {}, Loads(magnetic=Magnetisation(BR, BA, kind, law="rotation"))
        )
        for kind in get_args(MagneticEnergy)
    }

    def value(kind: MagneticEnergy, size: float) -> float:
        model = models[kind]
        return float(model.system.potential(size * smooth(model.r0.x.array), {}, "lambda_m"))

    return value


@pytest.mark.parametrize(
    ("kind", "remainder"), [("second_consistent", 3), ("second", 1), ("first", 1), ("torque", 1)]
)
def test_remainder(
    energy: Callable[[MagneticEnergy, float], float], kind: MagneticEnergy, remainder: int
) -> None:
    found = order(lambda e: energy("full", e), lambda e: energy(kind, e))
    assert found == pytest.approx(remainder, abs=0.15)


def test_each_order_alone(energy: Callable[[MagneticEnergy, float], float]) -> None:
    """U1 is linear and U_q quadratic, and neither vanishes nor is that of the other law."""
    assert energy("first", 0.02) == pytest.approx(2 * energy("first", 0.01))
    assert energy("torque", 0.02) == pytest.approx(4 * energy("torque", 0.01))
    for kind in ("first", "torque"):
        other = ShellModel(
            hemisphere(), MATERIAL, 3, {}, Loads(magnetic=Magnetisation(BR, BA, kind))
        )
        of_deformation = other.system.potential(0.01 * smooth(other.r0.x.array), {}, "lambda_m")
        assert abs(energy(kind, 0.01) / of_deformation - 1) > 0.1


FIELD = replace(TILTED, gradient=G, across=(np.array([1.0, 0.0, 0.0]),), law="rotation")


@pytest.mark.parametrize("kind", ["full", "second_consistent"])
def test_derivatives(kind: MagneticEnergy) -> None:
    """Of each term, at a pattern: points against forms, and these against finite differences."""
    field = replace(FIELD, remanent=tangential, energy=kind, gradient=G if kind == "full" else None)
    model = ShellModel(hemisphere(0.8), MATERIAL, 2, {}, Loads(pressure=True, magnetic=field))
    u = random_displacement(model, 1e-3)
    for mu in (
        MU,
        {"lambda_m": 0.0, "lambda_across": 1.0, "pressure": 0.0},
        {**MU, "lambda_m": 10.0},
    ):
        assert tangent_difference(model.system, u, mu) <= 1e-12
        assert residual_difference(model.system, u, mu) <= 1e-12
    names = (
        ["magnetic", "magnetic across", "magnetic gradient"]
        if kind == "full"
        else ["U1", "Uq", "Utau", "couple"]
    )
    for name in names:
        check(alone(model, name), u / 5, {"lambda_m": 1.0, "lambda_across": 1.0})


@pytest.mark.parametrize("amplitude", ["lambda_m", "lambda_across"])
def test_tangent_changes_with_each_amplitude(amplitude: str) -> None:
    model = ShellModel(hemisphere(0.8), MATERIAL, 2, {}, Loads(magnetic=FIELD))
    u, zero = random_displacement(model, 1e-3), {"lambda_m": 0.0, "lambda_across": 0.0}
    norms = [model.system.tangent(u, {**zero, amplitude: mu}).norm() for mu in (0.0, 1.0)]
    assert abs(norms[1] / norms[0] - 1) > 1e-6


@pytest.mark.parametrize("name", ["magnetic", "magnetic_torque"])
def test_symmetry(name: str) -> None:
    """That of the other law: fields in the plane y = 0 mirror and do not turn."""
    term = OwnTerm("own", getattr(laws, name), (E3, np.eye(3)[0] + E3))
    assert (term.turns, term.mirrored(Y0_PLANE)) == (False, True)
