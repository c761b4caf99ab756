"""An applied field by formulas: against the built-in ones, finite differences, and the force on a
rigid magnet.
"""

from dataclasses import replace

import numpy as np
import pytest
from along import csr
from along import difference as tangent_difference
from conftest import disc, hemisphere, random_displacement
from test_derivatives import alone, check
from test_fast_residual import difference as residual_difference

from magshell_fenicsx.input.expressions import FormulasInSpace, formula_with_derivatives
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.shell.spatial_fields import tangential
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation, RemanenceLaw
from magshell_fenicsx.shells.shell import ShellModel

MATERIAL, MU, LAWS = Material(0.3, 0.05), {"lambda_m": 0.4}, ["deformation", "rotation"]
BR, BA = np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.28, 0.96])
G = np.array([[0.5, 0.2, -0.1], [0.2, -0.7, 0.3], [0.1, 0.3, 0.2]])
# of a dipole along e3 at (0, 0, -d), over that in its middle: 3 (m . s) s/s^5 - m/s^3
S = "(x**2 + y**2 + (z + {d})**2)"
DIPOLE = [
    f"3*x*(z + {{d}})/{S}**2.5",
    f"3*y*(z + {{d}})/{S}**2.5",
    f"3*(z + {{d}})**2/{S}**2.5 - {S}**-1.5",
]


def formulas(*texts: str, turn: float = 0.0, d: float = 2.0) -> FormulasInSpace:
    return FormulasInSpace(
        [formula_with_derivatives(text.format(d=d)) for text in texts], rotation(turn)
    )


def linear() -> FormulasInSpace:
    return formulas(*(f"{b} + {g[0]}*x + {g[1]}*y + {g[2]}*z" for b, g in zip(BA, G, strict=True)))


def shell(field: Magnetisation) -> ShellModel:
    return ShellModel(hemisphere(0.8), MATERIAL, 2, {}, Loads(magnetic=field))


@pytest.mark.parametrize("law", LAWS)
def test_linear_field_is_that_of_its_gradient(law: RemanenceLaw) -> None:
    """Energies, residuals and tangents to 1e-12, at a pattern; the second displacement after the
    first.
    """
    built_in = Magnetisation(tangential, BA, gradient=G, law=law)
    known, other = shell(replace(built_in, gradient=None, in_space=linear())), shell(built_in)
    for seed in range(2):
        u = random_displacement(other, 1e-2, seed)
        energies = [model.system.potential(u, MU, "lambda_m") for model in (known, other)]
        assert energies[0] == pytest.approx(energies[1], rel=1e-12, abs=1e-14)
        residuals = [model.system.load(u, MU, "lambda_m") for model in (known, other)]
        assert np.abs(residuals[0] - residuals[1]).max() <= 1e-12 * np.abs(residuals[1]).max()
        magnetic = [
            csr(model.system.tangent(u, MU))
            - csr(model.system.tangent(u, {"lambda_m": 0.0}).copy())
            for model in (known, other)
        ]
        assert abs(magnetic[1]).max() > 1e-3
        assert abs(magnetic[0] - magnetic[1]).max() <= 1e-10 * abs(magnetic[1]).max()


@pytest.mark.parametrize("law", LAWS)
def test_derivatives_in_a_field_of_a_dipole(law: RemanenceLaw) -> None:
    """Points against forms, and these against finite differences: the field is not a polynomial."""
    model = shell(
        Magnetisation(tangential, BA, law=law, in_space=formulas(*DIPOLE, turn=0.4, d=1.0))
    )
    for seed, size in ((0, 1e-3), (1, 1e-2)):
        u = random_displacement(model, size, seed)
        assert tangent_difference(model.system, u, MU) <= 1e-12
        assert residual_difference(model.system, u, MU) <= 1e-12
    check(alone(model, "magnetic"), random_displacement(model, 2e-4), MU)
    # quadratic parts are there: the tangent alone changes where the whole shell moves rigidly
    moved = np.tile([0.3, -0.2, 0.1], model.system.size // 3)
    K = [csr(alone(model, "magnetic").tangent(u, MU).copy()) for u in (0 * moved, moved)]
    assert abs(K[1] - K[0]).max() > 0.05 * abs(K[0]).max()


@pytest.mark.parametrize("law", LAWS)
def test_force_and_torque_on_a_small_rigid_magnet(law: RemanenceLaw) -> None:
    """V grad(Br .

    B) and Br x B at its middle, to (size/distance)^2, wherever it moves and turns.
    """
    d = 100.0
    field = formulas(*DIPOLE, d=d)
    model = ShellModel(
        disc(0.8), MATERIAL, 2, {}, Loads(magnetic=Magnetisation(BR, BA, law=law, in_space=field))
    )
    X = model.r0.x.array.reshape(-1, 3)
    area = 3 * model.volume_change(np.tile([0.0, 0.0, 1.0], len(X)))
    for middle, angle in (
        ([0.0, 0.0, 0.0], 0.0),
        ([60.0, -20.0, 30.0], 0.0),
        ([-40.0, 10.0, 50.0], 1.2),
    ):
        Q = np.array(
            [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
        )
        turned = X @ Q.T
        load = model.system.load((turned + middle - X).ravel(), {}, "lambda_m").reshape(-1, 3)
        B, slope, _ = (a[0] for a in field(np.array([middle])))
        force, torque = -load.sum(axis=0), -np.cross(turned, load).sum(axis=0)
        expected = area * slope.T @ (Q @ BR)
        assert np.linalg.norm(force - expected) <= 2e-3 * np.linalg.norm(expected)
        moment = area * np.cross(Q @ BR, B)
        assert np.linalg.norm(torque - moment) <= 2e-3 * np.linalg.norm(moment)
        # the same in closed form, of the derivatives' own source
        distance = np.array(middle) + d * np.eye(3)[2]
        s, m, M = np.linalg.norm(distance), np.array([0.0, 0.0, 1.0]), Q @ BR
        e = distance / s
        dipoles = 3 / s**4 * ((M @ e) * m + (m @ e) * M + (m @ M) * e - 5 * (m @ e) * (M @ e) * e)
        assert expected / area == pytest.approx(dipoles, abs=1e-12)


def test_without_a_derivative_at_a_point() -> None:
    """The root has none at zero, where no other number warns of it."""
    with pytest.raises(MeshError, match=r"magnetic.applied: has no finite value"):
        shell(Magnetisation(BR, BA, in_space=formulas("sqrt(x - x)", "0", "1")))
