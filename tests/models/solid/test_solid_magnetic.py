"""A solid's remanence that does not stretch, and its field by formulas: against SciPy, forms and
finite differences.
"""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from along import along, csr, difference
from bodies import hemisphere, plate
from rubbers import NEO_HOOKEAN
from test_solid_derivatives import FIELD, MU, displacement

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.input.expressions import FormulasInSpace, formula_with_derivatives
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.shell.spatial_fields import radial
from magshell_fenicsx.models.solid.body_densities import CompressibleRubber
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation, RemanenceLaw
from magshell_fenicsx.shells.solid import SolidModel

H = 0.1
G = FIELD.gradient
assert G is not None
LINEAR = [f"{b} + {g[0]}*x + {g[1]}*y + {g[2]}*z" for b, g in zip(FIELD.applied, G, strict=True)]
MATERIAL, SOLID = Material(0.5, H), CompressibleRubber.from_poisson_ratio(NEO_HOOKEAN, 0.5, 100.0)
BR, BA = np.array([0.64, 0.48, 0.6]), np.array([0.36, -0.48, 0.8])
THIN = 1.1**-0.5
DEFORMATIONS = {
    "none": np.eye(3),
    "uniaxial": np.diag([1.1, THIN, THIN]),
    "equal stretches": np.diag([1.1, 1.1, 1.1**-2]),
    "swollen": 1.3 * np.eye(3),
    "sheared far": np.array([[1.0, 4.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "any": np.array([[0.9, 0.5, -0.1], [-0.6, 0.8, 0.4], [0.2, -0.3, 1.2]]),
}


def formulas(texts: list[str]) -> FormulasInSpace:
    return FormulasInSpace([formula_with_derivatives(text) for text in texts], np.eye(3))


def block(law: RemanenceLaw) -> SolidModel:
    return SolidModel(
        plate(0.8, H), MATERIAL, SOLID, {}, Loads(magnetic=Magnetisation(BR, BA, law=law))
    )


@pytest.mark.telling
@pytest.mark.parametrize("name", DEFORMATIONS)
def test_homogeneous_deformations(name: str) -> None:
    """The energy is -Ba . (R - 1) Br of the volume, and its tangent and residual have values at
    equal stretches too.

    The volume is that of the law that is linear; the energy of that under F is -Ba . (F - 1) Br.
    """
    F, models = DEFORMATIONS[name], {law: block(law) for law in ("deformation", "rotation")}  # type: ignore[arg-type]
    X = models["rotation"].r0.x.array.reshape(-1, 3)

    def energy(law: str, F: np.ndarray) -> float:
        return float(models[law].system.potential((X @ (F - np.eye(3)).T).ravel(), {}, "lambda_m"))

    volume = energy("deformation", np.diag([2.0, 1.0, 1.0])) / -(BA[0] * BR[0])
    assert energy("deformation", F) / volume == pytest.approx(-BA @ (F - np.eye(3)) @ BR, abs=1e-13)
    R = scipy.linalg.polar(F)[0]
    assert energy("rotation", F) / volume == pytest.approx(-BA @ (R - np.eye(3)) @ BR, abs=1e-13)


def test_derivatives_at_equal_stretches() -> None:
    """At u = 0 and where the solid swells, by central differences: -Ba .

    W Br with dF = W R for a small turn W.
    """
    model = block("rotation")
    X, v = model.r0.x.array, np.random.default_rng(3).standard_normal(model.system.size)
    magnetic = next(t for t in model.system.terms if t.name == "magnetic")
    system = FiniteElementSystem(
        model.u, [magnetic], [], model._pattern, 1.0, model.system._assembler
    )
    for u in (0 * X, 0.3 * X):
        e = 1e-5
        rate = (
            system.residual(u + e * v, {"lambda_m": 1.0})
            - system.residual(u - e * v, {"lambda_m": 1.0})
        ) / (2 * e)
        assert np.linalg.norm(
            along(system, u, {"lambda_m": 1.0}, v) - rate
        ) <= 1e-6 * np.linalg.norm(rate)
        w = np.cross([0.2, -0.5, 0.7], (X + u).reshape(-1, 3)).ravel()
        slope = system.residual(u, {"lambda_m": 1.0}) @ w
        # to first order R becomes (1 + W) R: the energy falls by Ba . (w x Br) of the volume
        turned = -2 * X * np.tile([0.0, 1.0, 1.0], len(X) // 3)  # by 180 degrees
        volume = system.energies(turned)["magnetic"] / (2 * BA[1:] @ BR[1:])
        assert slope == pytest.approx(-BA @ np.cross([0.2, -0.5, 0.7], BR) * volume, rel=1e-9)


def test_tangent_and_residual() -> None:
    """A pattern with gradient and a part across: points against forms, and these against finite
    differences.
    """
    field = replace(FIELD, law="rotation", remanent=radial)
    body = hemisphere(0.8, H, half=True)
    model = SolidModel(
        body,
        MATERIAL,
        SOLID,
        {"rim": "clamped", "symmetry": "symmetry"},
        Loads(magnetic=field),
    )
    u, fast = displacement(model), model.system
    assert difference(fast, u, MU) <= 1e-12
    v, e = fast.zero_at_supports(np.random.default_rng(2).standard_normal(fast.size)), 1e-5
    for term in (t for t in fast.terms if t.name.startswith("magnetic")):
        system = FiniteElementSystem(model.u, [term], [], model._pattern, 1.0, fast._assembler)
        alone = dict.fromkeys(MU, 1.0)

        def energy(step: float, system: FiniteElementSystem = system) -> float:
            return sum(system.energies(u + step * v).values())

        slope = (8 * (energy(e) - energy(-e)) - (energy(2 * e) - energy(-2 * e))) / (12 * e)
        assert system.residual(u, alone) @ v == pytest.approx(slope, rel=1e-6), term.name
        rate = (system.residual(u + e * v, alone) - system.residual(u - e * v, alone)) / (2 * e)
        assert np.linalg.norm(along(system, u, alone, v) - rate) <= 1e-6 * np.linalg.norm(rate), (
            term.name
        )


@pytest.mark.parametrize("law", ["deformation", "rotation"])
def test_field_known_by_values(law: RemanenceLaw) -> None:
    """A linear field equals the built-in gradient to 1e-10.

    The tangent of another field: finite differences.
    """
    known = replace(FIELD, law=law, across=(), gradient=None, in_space=formulas(LINEAR))
    body, built_in = hemisphere(0.8, H, half=True), replace(FIELD, law=law, across=())
    here, there = (
        SolidModel(body, MATERIAL, SOLID, {"symmetry": "symmetry"}, Loads(magnetic=field)).system
        for field in (known, built_in)
    )
    u = here.zero_at_supports(2e-3 * np.random.default_rng(0).standard_normal(here.size))
    assert here.potential(u, {}, "lambda_m") == pytest.approx(
        there.potential(u, {}, "lambda_m"), rel=1e-12
    )
    columns = [system.load(u, {}, "lambda_m") for system in (here, there)]
    assert np.abs(columns[0] - columns[1]).max() <= 1e-10 * np.abs(columns[1]).max()
    zero, one = {"lambda_m": 0.0}, {"lambda_m": 1.0}
    K = [
        csr(system.tangent(u, one).copy()) - csr(system.tangent(u, zero))
        for system in (here, there)
    ]
    assert abs(K[0] - K[1]).max() <= 1e-10 * abs(K[1]).max()
    wild = Loads(magnetic=replace(known, in_space=formulas(["x*exp(y)", "z**2*y", "1/(2 + x*z)"])))
    model = SolidModel(body, MATERIAL, SOLID, {}, wild)
    magnetic = next(t for t in model.system.terms if t.name == "magnetic")
    system, e = (
        FiniteElementSystem(model.u, [magnetic], [], model._pattern, 1.0, model.system._assembler),
        1e-5,
    )
    v = np.random.default_rng(2).standard_normal(system.size)
    slope = (
        system.potential(u + e * v, {}, "lambda_m") - system.potential(u - e * v, {}, "lambda_m")
    ) / (2 * e)
    assert system.residual(u, one) @ v == pytest.approx(slope, rel=1e-6)
    rate = (system.residual(u + e * v, one) - system.residual(u - e * v, one)) / (2 * e)
    assert np.linalg.norm(along(system, u, one, v) - rate) <= 1e-6 * np.linalg.norm(rate)
    fast = csr(model.system.tangent(u, one).copy()) - csr(model.system.tangent(u, zero))
    assert np.linalg.norm(fast @ v - rate) <= 1e-6 * np.linalg.norm(rate)
