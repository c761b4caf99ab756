"""Near incompressibility must not stiffen thin elements: a clamped plate of one layer, kappa/mu
from 10 to 10 000.
"""

from dataclasses import replace

import numpy as np
import pytest
from bodies import plate
from rubbers import NEO_HOOKEAN

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.solid.body_densities import CompressibleRubber
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.shells.solid import SolidModel
from magshell_fenicsx.shells.solid_terms import QUADRATURE_DEGREE, SolidTerm, TermFactory

H = 0.05


def deflection_over_theory(bulk_to_shear: float, *, whole: bool = False) -> float:
    """Of the centre under a small pressure p, over w0 = p R^4/(64 D) (Timoshenko) with the solid's
    own E and nu.

    With `whole`, compression takes all 27 quadrature points.
    """
    material = CompressibleRubber.from_poisson_ratio(NEO_HOOKEAN, 0.5, bulk_to_shear)
    loads = Loads(pressure=True)
    model = SolidModel(plate(0.3, H, half=True), Material(0.5, H), material, CONDITIONS, loads)  # type: ignore[arg-type]
    system = model.system
    if whole:
        factory = TermFactory(model.body, model.u, material, H, model.kernels)
        density = replace(factory.compression().density, degree=QUADRATURE_DEGREE)
        terms = [
            factory._bulk(t.name, density)
            if isinstance(t, SolidTerm) and t.name == "compression"
            else t
            for t in system.terms
        ]
        system = FiniteElementSystem(model.u, terms, system.clamped, model._pattern, H)
    zero, factors = model.zero(), Factorisation(system.comm)
    factors.factor(system.tangent(zero, {"pressure": 0.0}))
    u = factors.solve(-system.load(zero, {}, "pressure"))  # to first order in p/p_c
    D = material.youngs_modulus * H**3 / (12 * (1 - material.nu**2))
    return model.deflection(u, "pole") / (Material(0.5, H).classical_pressure / (64 * D))


CONDITIONS = {"rim": "clamped", "symmetry": "symmetry"}


def test_deflection_does_not_depend_on_kappa() -> None:
    """The coarse mesh is stiff by 2 %, alike for all."""
    found = [deflection_over_theory(ratio) for ratio in (100.0, 1000.0, 10000.0)]
    assert found == pytest.approx(np.ones(3), abs=0.02)
    assert max(found) - min(found) < 0.002


def test_whole_quadrature_locks() -> None:
    """What the reduced rule is for: with all points the deflection falls as kappa grows."""
    soft, stiff = (deflection_over_theory(ratio, whole=True) for ratio in (10.0, 10000.0))
    assert stiff < 0.92 * soft
