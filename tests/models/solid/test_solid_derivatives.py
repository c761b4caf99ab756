"""Residual and tangent of the solid against finite differences and FFCx's tangent forms."""

from dataclasses import replace

import numpy as np
import pytest
from along import csr, difference
from bodies import body_of, hemisphere
from dolfinx import fem
from rubbers import mooney, stiffening

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.mesh.hexahedra import OUTER_FACE, face_measure
from magshell_fenicsx.models.shell.parameters import EdgeMoment, Material
from magshell_fenicsx.models.shell.spatial_fields import radial
from magshell_fenicsx.models.solid.body_densities import CompressibleRubber
from magshell_fenicsx.parts.imperfections.dimple import Dimple
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.shells.solid import SolidModel

MU = {"pressure": 0.3, "lambda_m": 0.4, "lambda_across": -0.7, "load": 0.2}
EVERYWHERE = {
    "distortion",
    "compression",
    "magnetic",
    "magnetic across",
    "magnetic gradient",
    "pressure",
}
AT_ENDS = {"pressure whole", "pressure upper", "load moment rim 0"}
FIELD = Magnetisation(
    np.array([0.6, 0.0, 0.8]),
    np.array([0.0, 0.28, 0.96]),
    gradient=np.array([[1.0, 0.2, 0.0], [0.2, 0.5, 0.3], [0.0, 0.3, -1.5]]),
    across=(np.array([1.0, 0.0, 0.0]),),
)


@pytest.fixture(scope="module", params=["uniform", "varying"])
def model(request: pytest.FixtureRequest) -> SolidModel:
    """A coarse dimpled half with every load: clamped and of Mooney and Rivlin's rubber, or of three
    layers and Gent's, hinged and bent at its edge.
    """
    dimple, h, uniform = Dimple(0.05, 0.5), 0.1, request.param == "uniform"
    body = hemisphere(
        0.6 if uniform else 0.9, h, layers=1 if uniform else 3, half=True, dimple=dimple
    )
    conditions = {"rim": "clamped" if uniform else "simply supported", "symmetry": "symmetry"}
    field = FIELD if uniform else replace(FIELD, remanent=radial)
    loads = Loads(
        pressure=True, magnetic=field, dead={} if uniform else {"load": (EdgeMoment("rim", 0.7),)}
    )
    energy = mooney(0.4) if uniform else stiffening(20.0, 0.4)
    material = CompressibleRubber.from_poisson_ratio(energy, 0.5, 100.0)
    return SolidModel(body, Material(0.5, h), material, conditions, loads)  # type: ignore[arg-type]


def displacement(model: SolidModel) -> np.ndarray:
    return model.system.zero_at_supports(
        2e-3 * np.random.default_rng(0).standard_normal(model.system.size)
    )


def test_tangent_is_that_of_the_forms_and_symmetric(model: SolidModel) -> None:
    u, fast = displacement(model), model.system
    assert difference(fast, u, MU) <= 1e-12
    K = csr(fast.tangent(u, MU))
    assert abs(K - K.T).max() <= 1e-13 * abs(K).max()


def test_residuals_are_derivatives_of_energies(model: SolidModel) -> None:
    u, v, e = displacement(model), np.random.default_rng(1).standard_normal(model.system.size), 1e-5
    terms = [t for t in model.system.terms if t.name != "load"]
    assert {t.name for t in terms} >= (EVERYWHERE | AT_ENDS if model.loads.dead else EVERYWHERE)
    for term in terms:
        system = FiniteElementSystem(
            model.u, [term], [], model._pattern, 1.0, model.system._assembler
        )

        def energy(step: float, system: FiniteElementSystem = system) -> float:
            return sum(system.energies(u + step * v).values())

        slope = (8 * (energy(e) - energy(-e)) - (energy(2 * e) - energy(-2 * e))) / (12 * e)
        alone = dict.fromkeys(MU, 1.0)
        assert system.residual(u, alone) @ v == pytest.approx(slope, rel=1e-6), term.name


def test_tangent_is_the_derivative_of_the_residual(model: SolidModel) -> None:
    u, system = displacement(model), model.system
    v = system.zero_at_supports(np.random.default_rng(2).standard_normal(system.size))
    e = 1e-6
    rate = (system.residual(u + e * v, MU) - system.residual(u - e * v, MU)) / (2 * e)
    Kv = system.zero_at_supports(csr(system.tangent(u, MU)) @ v)
    assert np.linalg.norm(Kv - rate) <= 1e-6 * np.linalg.norm(rate)


def test_pressure_is_conservative_and_its_conjugate_is_the_enclosed_volume(
    model: SolidModel,
) -> None:
    """A uniform stretch s that keeps the planes of the mirror and of the equator: V grows by s^3 -
    1.

    V/R^3 of the half under the outer face is pi/3 (1 + h/2)^3 without the dimple; here the whole's
    by the same form.
    """
    stretched = model.r0.x.array[: model.system.size].copy()
    V, s = model.volume_change(-stretched), 1.1  # -X brings the face to the origin: -V
    assert model.volume_change((s - 1) * stretched) == pytest.approx(-V * (s**3 - 1), rel=1e-10)
    assert pytest.approx(2 * np.pi / 3 * 1.05**3, rel=0.02) == -V  # the dimple takes 1 %


def test_the_outer_face_of_an_annulus() -> None:
    """It is not the end above the edge that is named outer: the area is that of the ring, pi (1 -
    0.25).
    """
    body = body_of(
        {"geometry": "annulus", "radius": 1.0, "inner_radius": 0.5, "thickness": 0.1}, 0.3
    )
    area = fem.form(
        fem.Constant(body.mesh, 1.0) * face_measure(body.mesh, [body.faces[OUTER_FACE]])(1)
    )
    assert fem.assemble_scalar(area) == pytest.approx(0.75 * np.pi, rel=1e-3)
