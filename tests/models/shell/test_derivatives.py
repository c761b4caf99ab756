"""Residual and tangent of every term against finite differences of the energy."""

from collections.abc import Callable

import numpy as np
import pytest
from along import check, csr
from conftest import hemisphere, random_displacement

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.models.shell.fast_tangent import FastTangent, hessian_integrals
from magshell_fenicsx.models.shell.parameters import Force, Material
from magshell_fenicsx.models.shell.spatial_fields import tangential
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.shells.shell import ShellModel

Shells = Callable[..., ShellModel]
TERMS = [
    "membrane",
    "bending",
    "interior edges",
    "clamped edges",
    "mirror edges",
    "magnetic",
    "pressure",
    "U1",
    "Uq",
    "Utau",
    "couple",
]


def alone(model: ShellModel, name: str) -> FiniteElementSystem:
    """The model with one term only, nothing held."""
    pattern = next(t for t in model.system.terms if t.name == "interior edges")
    assert isinstance(pattern, FormTerm)
    term = next(t for t in model.system.terms if t.name == name)
    degree = model.V.element.basix_element.degree
    tangent = FastTangent(model.u, hessian_integrals(model.r0, degree, [term], KernelLog()), [])
    return FiniteElementSystem(model.u, [term], [], pattern, 1.0, tangent)


@pytest.mark.parametrize("name", TERMS)
def test_term_alone(shell: Shells, name: str) -> None:
    model = shell(
        2, half=name == "mirror edges", energy="full" if name in TERMS[:-4] else "second_consistent"
    )
    u = random_displacement(model, 5e-4)
    check(alone(model, name), u, {"lambda_m": 1.0, "pressure": 1.0})


@pytest.mark.parametrize("half", [False, True])
def test_terms_together(shell: Shells, half: bool) -> None:
    model = shell(2, half=half)
    u = random_displacement(model, 5e-4)
    u[model.system._fixed] = 0
    check(model.system, u, {"lambda_m": 0.02, "pressure": 0.3})


def test_field_gradient_and_pattern() -> None:
    """Br varying over the surface in a field linear in space."""
    G = np.array([[-0.5, 0.2, 0.1], [0.2, -0.7, 0.3], [0.1, 0.3, 1.2]])
    field = Magnetisation(tangential, np.array([0.0, 0.6, 0.8]), "full", G)
    model = ShellModel(hemisphere(), Material(0.3, 0.05), 2, {}, Loads(magnetic=field))
    u = random_displacement(model, 2e-4)
    for name in ("magnetic", "magnetic gradient"):
        check(alone(model, name), u, {"lambda_m": 1.0})


@pytest.mark.parametrize("amplitude", ["lambda_m", "pressure"])
def test_tangent_changes_with_each_amplitude(shell: Shells, amplitude: str) -> None:
    """K(mu) - K(0) = mu K_mu, and K_mu is not zero."""
    model = shell(2)
    u = random_displacement(model, 1e-3)
    zero = {"lambda_m": 0.0, "pressure": 0.0}
    K = [csr(model.system.tangent(u, {**zero, amplitude: mu})) for mu in (0.0, 0.5, 1.0)]
    change = abs(K[2] - K[0]).max()
    assert change > 1e-4 * abs(K[0]).max() * model.material.h
    assert abs(K[2] - 2 * K[1] + K[0]).max() <= 1e-10 * abs(K[0]).max()


def test_force_has_the_load_vector_of_its_work() -> None:
    """Pi_F = -F w, and its column is minus the gradient of w."""
    surface = hemisphere()
    for force in (Force("load"), Force("load", patch=0.7)):
        model = ShellModel(surface, Material(0.3, 0.05), 2, {}, Loads(forces={"force": force}))
        u = random_displacement(model, 1e-3)
        load = model.system.load(u, {}, "force")
        assert -load @ u == pytest.approx(
            model.force_unit * model.loaded_deflection(u, "force"), rel=1e-12
        )
        # a unit translation along the inward normal has w = 1, so the total force is F along it
        inward = -model.normals["load"]
        assert -load.reshape(-1, 3).sum(axis=0) == pytest.approx(
            model.force_unit * inward, rel=1e-12, abs=1e-15
        )


def test_the_force_of_a_patch_is_within_its_radius() -> None:
    """The weight (1 - d²/a²)² has the mean square distance a²/4, on a sphere too, where the area
    within a distance d of a point is pi d².
    """
    model = ShellModel(
        hemisphere(), Material(0.3, 0.05), 2, {}, Loads(forces={"force": Force("load", patch=0.7)})
    )
    inward = -model.normals["load"]
    forces = -model.system.load(model.zero(), {}, "force").reshape(-1, 3) @ inward
    square_distances = 2 + 2 * model.r0.x.array.reshape(-1, 3) @ inward  # from the point -inward
    assert forces @ square_distances / forces.sum() == pytest.approx(0.7**2 / 4, rel=1e-2)
