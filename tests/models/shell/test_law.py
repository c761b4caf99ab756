"""What a law of the material says of stresses and edges follows from its energies, for arrays and
for expressions.
"""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from plies import laminate, ply
from rubbers import NEO_HOOKEAN, TRELOAR, mooney, stiffening

from magshell_fenicsx.models.shell.laminate import Laminated
from magshell_fenicsx.models.shell.law import Koiter, Law, work
from magshell_fenicsx.models.shell.rubber import Rubber
from magshell_fenicsx.parts.laws.ogden import Ogden

COUPLED = Laminated.from_laminate(laminate(ply(20, 3.0, fraction=0.3), ply(-70, 0.7)), 0.05, 0.3)
LAWS: list[Law] = [
    Koiter(0.05, 0.3),
    Koiter(0.1, 0.5).thicker(1.3),
    Rubber(0.05, NEO_HOOKEAN),
    Rubber(0.1, mooney(0.3)).thicker(1.3),
    Rubber(0.1, stiffening(40.0, 0.3)).thicker(1.3),
    Ogden(0.1, TRELOAR[0], alpha=TRELOAR[1]).thicker(1.3),
    replace(COUPLED, direction=(0.3, -0.8)).thicker(1.3),
]
RNG, STEP = np.random.default_rng(4), 1e-30


def tensors(count: int) -> np.ndarray:
    """Symmetric (count, 2, 2), small."""
    S = 0.1 * RNG.standard_normal((count, 2, 2))
    return S + np.swapaxes(S, 1, 2)


E, K, T = tensors(5), tensors(5), tensors(5)
UP = np.linalg.inv(np.eye(2) + tensors(5) / 2)


@pytest.mark.parametrize("law", LAWS)
def test_stress_and_moment_are_derivatives(law: Law) -> None:
    """Along any strain, by complex steps: exact to rounding."""
    assert work(law.stress(E, UP), T) == pytest.approx(
        law.membrane(E + 1j * STEP * T, UP).imag / STEP
    )
    assert work(law.moment(E, K, UP), T) == pytest.approx(
        law.bending(E, K + 1j * STEP * T, UP).imag / STEP
    )


@pytest.mark.parametrize("law", LAWS)
def test_edges_see_the_moment_along_a_covector(law: Law) -> None:
    c = RNG.standard_normal((5, 2))
    raised = np.einsum("...ij,...j->...i", UP, c)
    edge = UP, tuple(raised.T), np.sum(raised * c, axis=-1)
    twice = c[:, :, None] * c[:, None, :]
    assert law.edge_moment(E, K, *edge) == pytest.approx(work(law.moment(E, K, UP), twice))
    changed = law.edge_moment(E, K + 1j * STEP * twice, *edge)
    assert law.edge_stiffness(E, *edge) == pytest.approx(changed.imag / STEP)


@pytest.mark.parametrize("law", LAWS)
def test_expressions_and_arrays_agree(law: Law) -> None:
    for e, k, up in zip(E, K, UP, strict=True):
        symbolic = [ufl.as_matrix(S.tolist()) for S in (e, k, up)]
        assert float(law.membrane(symbolic[0], symbolic[2])) == pytest.approx(law.membrane(e, up))
        assert float(law.bending(*symbolic)) == pytest.approx(law.bending(e, k, up))
        assert [float(M) for M in law.moment(*symbolic)] == pytest.approx(law.moment(e, k, up))


def test_a_bar_pulled_along_itself() -> None:
    """Hooke: its width shrinks by Poisson's ratio, its stress is Young's modulus times strain."""
    law = Koiter(0.05, 0.3)
    S11, S12, S22 = law.stress(np.diag([1e-3, -0.3e-3]), np.eye(2))
    assert pytest.approx((1e-3, 0, 0), abs=1e-18) == (S11, S12, S22)
    assert law.membrane(np.diag([1e-3, -0.3e-3]), np.eye(2)) == pytest.approx(0.5e-6)
