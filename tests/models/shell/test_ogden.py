"""Ogden's rubber: energies of principal stretches, its terms that are neo-Hookean, and equal
stretches.

The references are the sum over three stretches, Rubber's laws, finite differences, and the energy
of layers.
"""

import numpy as np
import pytest
from along import check
from conftest import hemisphere, random_displacement
from rubbers import TRELOAR, mooney
from scipy.optimize import brentq

from magshell_fenicsx.models.shell.parameters import Condition, Material
from magshell_fenicsx.models.shell.rubber import Rubber
from magshell_fenicsx.parts.laws.ogden import Ogden
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.shells.shell import ShellModel

H, UP, RNG = 0.1, np.eye(2), np.random.default_rng(7)
STEEP = (1 / 12, 1 / 3), (5.0, 0.75)  # mu/E and alpha
LAWS = [
    Ogden(H, mu, alpha=alpha)
    for mu, alpha in (TRELOAR, STEEP, ((-1 / 3,), (-2.0,)), ((-2 / 3,), (-1.0,)))
]


def by_stretches(law: Ogden, E: np.ndarray) -> np.ndarray:
    first, second = np.moveaxis(np.sqrt(1 + 2 * np.linalg.eigvalsh(E)), -1, 0)
    third = 1 / (first * second)
    return np.asarray(sum(mu / a * (first**a + second**a + third**a - 3) for mu, a in law.terms))


def strains(count: int, size: float) -> np.ndarray:
    """(C - 1)/2 of random stretches, whose logarithms are of that size; (count, 2, 2)."""
    logarithm = RNG.standard_normal((count, 2, 2)) * size
    values, axes = np.linalg.eigh(logarithm + np.swapaxes(logarithm, 1, 2))
    return np.asarray((axes * np.exp(values)[:, None]) @ np.swapaxes(axes, 1, 2) - np.eye(2)) / 2


def near_equal() -> np.ndarray:
    """Strains whose principal stretches are equal, and less and less so, through what is a series
    and what is none.
    """
    apart = np.array([0.0, 1e-12, 1e-8, 1e-4, 0.01, 0.1, 0.17, 0.18, 0.185, 0.19, 0.2, 0.3, 0.5])
    return np.asarray(0.3 * np.eye(2) + apart[:, None, None] * np.array([[0.6, 0.8], [0.8, -0.6]]))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("E", [strains(50, 0.5), near_equal()])
def test_energy_of_three_stretches(law: Ogden, E: np.ndarray) -> None:
    assert law.membrane(E, UP) == pytest.approx(by_stretches(law, E), rel=1e-12, abs=1e-15)


@pytest.mark.parametrize(
    ("mu", "alpha", "share"), [((1 / 3,), (2.0,), 0.0), ((0.7 / 3, -0.1), (2.0, -2.0), 0.3)]
)
def test_neo_hookean_and_mooney_rivlin_terms(
    mu: tuple[float, ...], alpha: tuple[float, ...], share: float
) -> None:
    """alpha = 2 is neo-Hookean in all; 2 and -2 are Mooney-Rivlin, in bending where stretches are
    equal.
    """
    law, rubber = Ogden(H, mu, alpha=alpha), Rubber(H, mooney(share))
    E, K = strains(50, 0.5), strains(50, 0.3)
    assert law.membrane(E, UP) == pytest.approx(rubber.membrane(E, UP), rel=1e-12)
    assert np.array(law.stress(E, UP)) == pytest.approx(
        np.array(rubber.stress(E, UP)), rel=1e-12, abs=1e-15
    )
    bent = E if not share else np.linspace(-0.3, 4, 50)[:, None, None] * np.eye(2)
    assert law.bending(bent, K, UP) == pytest.approx(rubber.bending(bent, K, UP), rel=1e-12)


@pytest.mark.parametrize("law", LAWS)
def test_no_bending_is_free(law: Ogden) -> None:
    """The energy of bending is positive at every stretch, though W'' is not for alpha below 2."""
    E = strains(2000, 0.6)
    basis = np.array([[[1, 0], [0, 0]], [[0, 1], [1, 0]], [[0, 0], [0, 1]]], dtype=float)
    stiff = np.array([np.stack(law.moment(E, K, UP), axis=-1) for K in basis])
    stiff[:, :, 1] *= 2  # the work of M_12
    assert np.all(np.linalg.eigvalsh(np.moveaxis(stiff, 1, 0)) > 0)


@pytest.mark.parametrize("s", [1.0, 1.3, 2.0])
def test_bending_across_a_pull_is_that_of_the_layers(s: float) -> None:
    """A strip pulled to s along its axis and bent about it, without stress across: the mean energy
    of its layers.
    """
    law, K, e = LAWS[0], np.diag([1.0, 0.0]), 1e-3

    def pulled(square: float) -> np.ndarray:
        return np.diag([square - 1, s**2 - 1]) / 2

    square = brentq(lambda square: law.stress(pulled(square), UP)[0], 0.05, 2)
    at = [by_stretches(law, pulled(square) + n * e * K) for n in (-2, -1, 0, 1, 2)]
    twice = (-at[0] + 16 * at[1] - 30 * at[2] + 16 * at[3] - at[4]) / (12 * e**2)
    assert law.bending(pulled(square), K, UP) == pytest.approx(
        H**2 / (24 * square * s**2) * twice, rel=1e-6
    )


@pytest.mark.parametrize("law", LAWS)
def test_small_strains_are_koiters(law: Ogden) -> None:
    """The difference from Koiter's energies is of the order of the strain, over two decades."""
    koiter, K, E1 = law.linear, strains(1, 0.3)[0], strains(1, 0.3)[0]
    sizes = np.array([1e-3, 1e-4, 1e-5])
    for of, known in (
        (lambda E: law.membrane(E, UP), lambda E: koiter.membrane(E, UP)),
        (lambda E: law.bending(E, K, UP), lambda E: koiter.bending(E, K, UP)),
    ):
        off = [abs(of(size * E1) / known(size * E1) - 1) for size in sizes]
        assert np.diff(np.log(off)) / np.diff(np.log(sizes)) == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("stretch", [0.0, 0.3])
def test_residual_and_tangent(stretch: float) -> None:
    """By differences of the energy: about no stretch, where both are equal, and about 1.3."""
    edges: dict[str, Condition] = {"rim": "clamped", "symmetry": "symmetry"}
    mu, alpha = TRELOAR
    material = Material(0.5, 0.05, Ogden(0.05, mu, alpha=alpha))
    model = ShellModel(hemisphere(0.8, half=True), material, 3, edges, Loads(pressure=True))
    u = random_displacement(model, 2e-3) + model.system.zero_at_supports(
        stretch * model.r0.x.array[: model.system.size]
    )
    check(model.system, u, {"pressure": 0.3})
