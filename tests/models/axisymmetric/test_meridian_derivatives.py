"""Residual and tangent of the meridian's terms against finite differences of the energy."""

import numpy as np
import pytest
import scipy.sparse
from meridian_scenes import ALONG_AXIS, hemisphere

from magshell_fenicsx.assembly.problem import FiniteElementSystem
from magshell_fenicsx.models.axisymmetric.model import MeridianModel
from magshell_fenicsx.models.shell.parameters import Loads

TERMS = ["membrane", "bending", "interior edges", "clamped edges", "magnetic", "pressure"]


def coarse() -> MeridianModel:
    loads = Loads(pressure=True, magnetic=ALONG_AXIS)
    return hemisphere(20, 0.3, loads, dimple=(1.0, 2.0), refinement=0.15)


def check(system: FiniteElementSystem, u: np.ndarray, mu: dict[str, float]) -> None:
    v = np.random.default_rng(1).standard_normal(u.size)
    v[system._fixed] = 0

    def energy(x: np.ndarray) -> float:
        return sum((mu[t.amplitude] if t.amplitude else 1) * system.energies(x)[t.name] for t in system.terms)

    def rate(f, e: float = 1e-5):  # type: ignore[no-untyped-def]
        return (8 * (f(u + e * v) - f(u - e * v)) - (f(u + 2 * e * v) - f(u - 2 * e * v))) / (12 * e)

    R = system.residual(u, mu)
    assert R @ v == pytest.approx(rate(energy), rel=1e-6, abs=1e-9 * np.linalg.norm(R) * np.linalg.norm(v))
    rows, columns, values = system.tangent(u, mu).getValuesCSR()
    K = scipy.sparse.csr_array((values, columns, rows), shape=(u.size, u.size)).toarray()
    assert np.abs(K - K.T).max() <= 1e-12 * np.abs(K).max()
    difference = K @ v - rate(lambda x: system.residual(x, mu))
    assert np.linalg.norm(difference) <= 1e-6 * np.linalg.norm(K @ v)


@pytest.mark.parametrize("name", TERMS)
def test_term_alone(name: str) -> None:
    model = coarse()
    terms = {t.name: t for t in model.system.terms}
    alone = FiniteElementSystem(model.u, [terms[name]], model.system.clamped, terms["interior edges"], 1.0)
    u = 1e-4 * np.random.default_rng(0).standard_normal(alone.size)
    u[alone._fixed] = 0
    check(alone, u, {"lambda_m": 1.0, "pressure": 1.0})


def test_terms_together() -> None:
    model = coarse()
    u = 1e-4 * np.random.default_rng(0).standard_normal(model.system.size)
    u[model.system._fixed] = 0
    check(model.system, u, {"lambda_m": 0.02, "pressure": 0.3})
