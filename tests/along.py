"""The second derivatives of a system's forms along a direction, the reference of every tangent.

A form with one argument compiles up to ten times faster than that of a matrix.
"""

from collections.abc import Mapping

import numpy as np
import pytest
import scipy.sparse
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx import Scene
from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.assembly.nonlocal_terms import times
from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.continuation.system import SkewedTangent, State
from magshell_fenicsx.models.shell.energy import HessianTerm

Direction = tuple[fem.Function, fem.Form]


def csr(K: PETSc.Mat | SkewedTangent) -> scipy.sparse.csr_array:
    if isinstance(K, SkewedTangent):
        return csr(K.K) + csr(K.N)
    rows, columns, values = K.getValuesCSR()
    return scipy.sparse.csr_array((values, columns, rows), shape=K.size)


def _compiled(term: FormTerm | HessianTerm) -> Direction:
    """The term's second derivative along a function; compiled once."""
    if "along" not in vars(term):
        of = term._u if isinstance(term, FormTerm) else term._v
        test = ufl.TestFunction(of.function_space)
        gradient = (
            term._gradient if isinstance(term, FormTerm) else ufl.derivative(term._energy, of, test)
        )
        direction = fem.Function(of.function_space)
        vars(term)["along"] = (
            direction,
            term._log.compile("along", ufl.derivative(gradient, of, direction)),
        )
    found: Direction = vars(term)["along"]
    return found


def along(
    system: FiniteElementSystem, u: np.ndarray, mu: Mapping[str, float], v: np.ndarray
) -> np.ndarray:
    """d2Pi/du2 . v without supports."""

    def total() -> np.ndarray:
        total = np.zeros_like(system.u.x.array)
        for term in system.terms:
            if isinstance(term, FormTerm | HessianTerm) and not term.linear:
                direction, form = _compiled(term)
                direction.x.array[: system.size] = v
                direction.x.scatter_forward()
                if isinstance(term, FormTerm):
                    term.renew()
                part = np.zeros_like(total)
                fem.assemble_vector(part, form)
                total += (mu[term.amplitude] if term.amplitude else 1.0) * part
        return total

    return np.asarray(
        system._summed(system.at_state(State(u, dict(mu))).evaluate(total), constrained=False)
    )


def difference(system: FiniteElementSystem, u: np.ndarray, mu: Mapping[str, float]) -> float:
    """Largest relative difference of the tangent from the forms, along three directions; supports
    have unit rows.
    """
    K, worst = csr(system.tangent(u, dict(mu))), 0.0
    for seed in range(3):
        v = np.random.default_rng(seed).standard_normal(system.size)
        free = system.zero_at_supports(v)
        expected = system.zero_at_supports(along(system, u, mu, free))
        error = K @ v - (expected + (v - free))
        worst = max(worst, float(np.abs(error).max() / np.abs(expected).max()))
    return worst


def check(system: FiniteElementSystem, u: np.ndarray, mu: Mapping[str, float]) -> None:
    """Compare residual and tangent with finite differences of the energy."""
    rng = np.random.default_rng(1)
    v = rng.standard_normal(u.size)
    v[system._fixed] = 0

    def energy(x: np.ndarray) -> float:
        return sum(
            (mu[t.amplitude] if t.amplitude else 1) * system.energies(x, mu)[t.name]
            for t in system.terms
        )

    e = 1e-5
    slope = (
        8 * (energy(u + e * v) - energy(u - e * v))
        - (energy(u + 2 * e * v) - energy(u - 2 * e * v))
    ) / (12 * e)
    R = system.residual(u, mu)
    assert R @ v == pytest.approx(slope, rel=1e-6, abs=1e-9 * np.linalg.norm(R) * np.linalg.norm(v))
    K = csr(system.tangent(u, mu))
    assert abs(K - K.T).max() <= 1e-12 * abs(K).max()
    rate = (
        8 * (system.residual(u + e * v, mu) - system.residual(u - e * v, mu))
        - (system.residual(u + 2 * e * v, mu) - system.residual(u - 2 * e * v, mu))
    ) / (12 * e)
    Kv = K @ v
    free = np.setdiff1d(np.arange(u.size), system._fixed)
    assert np.linalg.norm((Kv - rate)[free]) <= 1e-6 * np.linalg.norm(Kv)


def check_derivatives(
    scene: Scene,
    flat: NDArray[np.float64],
    deep: tuple[float, float],
    h: float,
    seed: int = 0,
    far: float = 100.0,
) -> None:
    """Those of the only contact at a displacement (nodes, 3) that is made rough, by differences;
    `deep` are bounds.

    `far` is the step of the energy's difference over that of the forces'.
    """
    system, (term,), mu = scene.model.system, scene.model.shell_contacts, scene.unloaded().mu
    rough, moved, other = (
        system.zero_at_supports(
            np.random.default_rng([seed, k]).standard_normal(flat.size)[: system.size]
        )
        for k in range(3)
    )
    u, v = (
        system.zero_at_supports(flat.ravel()[: system.size]) + 0.002 * h * rough,
        1e-7 * h * moved,
    )
    at = system.at_state(State(u, mu))
    entries = at.evaluate(term.entries)
    assert deep[0] < at.evaluate(term.penetration) < deep[1]
    Kv = times([(1.0, entries)], v)
    low, high = (system.forces(u + side * v, mu, term.name) for side in (-0.5, 0.5))
    assert np.abs(high - low - Kv).max() < 1e-6 * np.abs(Kv).max()
    energies = [system.energies(u + side * far * v, mu)[term.name] for side in (-0.5, 0.5)]
    assert energies[1] - energies[0] == pytest.approx(
        far * system.forces(u, mu, term.name) @ v, rel=1e-6
    )
    assert other @ Kv == pytest.approx(v @ times([(1.0, entries)], other), rel=1e-9)
