"""Residual and tangent of the meridian's terms against finite differences of the energy."""

import numpy as np
import pytest
import scipy.sparse
from meridian_scenes import ALONG_AXIS, E3, hemisphere
from petsc4py import PETSc

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.axisymmetric.meridian import make_meridian
from magshell_fenicsx.models.shell.parameters import AreaForce, EdgeForce, EdgeMoment, Material
from magshell_fenicsx.models.shell.spatial_fields import tangential
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.shells.meridian import MeridianModel

TERMS = ["membrane", "bending", "interior edges", "clamped edges", "magnetic", "pressure"]
RING_TERMS = [
    "membrane",
    "bending",
    "interior edges",
    "mirror edges",
    "magnetic",
    "load",
    "load moment b 0",
]
FACTORS = {"lambda_m": 0.02, "pressure": 0.3, "load": 0.5}


def coarse() -> MeridianModel:
    loads = Loads(pressure=True, magnetic=ALONG_AXIS)
    return hemisphere(20, 0.3, loads, dimple=(1.0, 2.0), refinement=0.15)


def ring() -> MeridianModel:
    """A tube of varying thickness that opens like a trumpet, mirrored at its one end and loaded at
    the other.
    """

    def trumpet(chart: np.ndarray) -> np.ndarray:
        s = chart[:, 0]
        return np.column_stack([1 + 0.3 * s**2, 0 * s, -s])

    dead = (
        EdgeForce("b", np.array([0.0, 0.0, 0.1]), total=False),
        AreaForce(None, 0.02),
        EdgeMoment("b", 0.03),
    )
    meridian = make_meridian(trumpet, np.linspace(0, 1, 4), ("a", "b"), {"pole": (1.0, 0.0)})
    thickness = Thickness(lambda x, y, z: 1 + 0.5 * z**2)
    loads = Loads(magnetic=ALONG_AXIS, dead={"load": dead})
    return MeridianModel(
        meridian, Material(0.3, 0.05), 4, {"a": "plane"}, loads, thickness=thickness
    )


def turning() -> MeridianModel:
    """A remanence along the meridians that does not stretch, in a field that varies."""
    field = Magnetisation(tangential, E3, gradient=np.diag([0.5, 0.5, -1.0]), law="rotation")
    return hemisphere(20, 0.3, Loads(magnetic=field), dimple=(1.0, 2.0), refinement=0.15)


MODELS = {"hemisphere": coarse, "ring": ring, "turning": turning}
TURNING_TERMS = ["magnetic", "magnetic gradient"]


def check(system: FiniteElementSystem, u: np.ndarray, mu: dict[str, float]) -> None:
    v = np.random.default_rng(1).standard_normal(u.size)
    v[system._fixed] = 0

    def energy(x: np.ndarray) -> float:
        return sum(
            (mu[t.amplitude] if t.amplitude else 1) * system.energies(x)[t.name]
            for t in system.terms
        )

    def rate(f, e: float = 1e-5):  # type: ignore[no-untyped-def]
        return (8 * (f(u + e * v) - f(u - e * v)) - (f(u + 2 * e * v) - f(u - 2 * e * v))) / (
            12 * e
        )

    R = system.residual(u, mu)
    assert R @ v == pytest.approx(
        rate(energy), rel=1e-6, abs=1e-9 * np.linalg.norm(R) * np.linalg.norm(v)
    )
    rows, columns, values = system.tangent(u, mu).getValuesCSR()
    K = scipy.sparse.csr_array((values, columns, rows), shape=(u.size, u.size)).toarray()
    assert np.abs(K - K.T).max() <= 1e-12 * np.abs(K).max()
    difference = K @ v - rate(lambda x: system.residual(x, mu))
    assert np.linalg.norm(difference) <= 1e-6 * np.linalg.norm(K @ v)


@pytest.mark.parametrize(
    ("made", "name"),
    [
        (made, name)
        for made, names in (("hemisphere", TERMS), ("ring", RING_TERMS), ("turning", TURNING_TERMS))
        for name in names
    ],
)
def test_term_alone(made: str, name: str) -> None:
    model = MODELS[made]()
    terms = {t.name: t for t in model.system.terms}
    alone = FiniteElementSystem(
        model.u, [terms[name]], model.system.clamped, terms["interior edges"], 1.0
    )
    u = 1e-4 * np.random.default_rng(0).standard_normal(alone.size)
    u[alone._fixed] = 0
    check(alone, u, dict.fromkeys(FACTORS, 1.0))


@pytest.mark.parametrize("made", MODELS)
def test_terms_together(made: str) -> None:
    model = MODELS[made]()
    u = 1e-4 * np.random.default_rng(0).standard_normal(model.system.size)
    u[model.system._fixed] = 0
    check(model.system, u, FACTORS)


def test_waves_have_every_term_that_is_not_linear() -> None:
    """Of U and W alone and with m = 0, Q_m is the form of the tangent with pi in place of 2 pi."""
    model = ring()
    u = 1e-2 * np.random.default_rng(0).standard_normal(model.system.size)
    u[model.system._fixed] = 0
    v = np.random.default_rng(1).standard_normal(model.system.size)
    v[model.system._fixed] = 0
    wave = np.insert(v.reshape(-1, 2), 1, 0.0, axis=1).ravel()

    def form(K: PETSc.Mat, x: np.ndarray) -> float:
        given, out = K.createVecs()
        given.setArray(x)
        K.mult(given, out)
        return float(x @ out.array)

    whole = form(model.system.tangent(u, FACTORS), v)
    assert form(model.waves.tangent(State(u, FACTORS), 0), wave) == pytest.approx(
        whole / 2, rel=1e-10
    )
