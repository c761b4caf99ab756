"""The tangent from point Hessians against that of FFCx's forms, the reference."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import ufl
from along import csr, difference
from conftest import hemisphere, random_displacement
from dolfinx import fem

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.continuation.system import extrapolated_stress
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.models.shell import densities, kinematics
from magshell_fenicsx.models.shell.energy import cell_quadrature
from magshell_fenicsx.models.shell.fast_tangent import FastTangent, hessian_integrals
from magshell_fenicsx.models.shell.parameters import Condition, Material
from magshell_fenicsx.models.shell.spatial_fields import tangential
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.shells.shell import ShellModel
from magshell_fenicsx.simulate.follow import follow

Shells = Callable[..., ShellModel]
DEGREES = [2, 5]
TERMS = {
    "membrane": "full",
    "bending": "full",
    "interior edges": "full",
    "clamped edges": "full",
    "mirror edges": "full",
    "magnetic": "full",
    "pressure": "full",
    "Uq": "second_consistent",
    "Utau": "second_consistent",
}
MU = {"lambda_m": 0.4, "lambda_across": -0.7, "pressure": 0.3}


def pattern(system: FiniteElementSystem) -> FormTerm:
    found = next(t for t in system.terms if t.name == "interior edges")
    assert isinstance(found, FormTerm)
    return found


@pytest.mark.parametrize("name", TERMS)
def test_term_alone(shell: Shells, name: str) -> None:
    """To 1e-12 at random nodal values, nothing held."""
    model = shell(2, half=name == "mirror edges", energy=TERMS[name])
    term = next(t for t in model.system.terms if t.name == name)
    assembler = FastTangent(model.u, hessian_integrals(model.r0, 2, [term], KernelLog()), [])
    system = FiniteElementSystem(model.u, [term], [], pattern(model.system), 1.0, assembler)
    assert difference(system, random_displacement(model, 1e-3), MU) <= 1e-12


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize(("energy", "half"), [("full", False), ("second_consistent", True)])
def test_terms_together(shell: Shells, half: bool, energy: str, degree: int) -> None:
    model = shell(degree, half=half, energy=energy)
    for seed, amplitudes in enumerate(({"lambda_m": 0.0, "pressure": 0.0}, MU)):
        assert difference(model.system, random_displacement(model, 1e-3, seed), amplitudes) <= 1e-12


def test_excluded_modes(shell: Shells) -> None:
    model = shell(2, half=True)
    modes = model.symmetry_breaking_modes
    assert modes is not None
    # the interior edges' form has the widest coupling here too
    assert difference(modes.system, random_displacement(model, 1e-3), MU) <= 1e-12


@pytest.mark.telling
@pytest.mark.parametrize("condition", ["free", "simply supported", "clamped"])
def test_edge_conditions(condition: Condition) -> None:
    model = ShellModel(
        hemisphere(0.8), Material(0.3, 0.05), 2, {"rim": condition}, Loads(pressure=True)
    )
    assert difference(model.system, random_displacement(model, 1e-3), MU) <= 1e-12


def test_remanence_that_varies_field_that_varies_and_turns() -> None:
    """A pattern, a gradient, and a field with a part across."""
    G = np.array([[0.5, 0.2, -0.1], [0.2, -0.7, 0.3], [0.1, 0.3, 1.2]])
    across = np.array([1.0, 0.0, 0.0])
    field = Magnetisation(tangential, np.array([0.0, 0.6, 0.8]), "full", G, (across,))
    model = ShellModel(hemisphere(0.8), Material(0.3, 0.05), 2, {}, Loads(magnetic=field))
    system, u = model.system, random_displacement(model, 1e-3)
    for mu in (
        MU,
        {"lambda_m": 0.0, "lambda_across": 1.0},
        {"lambda_m": 10.0, "lambda_across": 0.0},
    ):
        assert difference(system, u, mu) <= 1e-12


def test_matrix_is_reused_and_follows_state_and_amplitudes(shell: Shells) -> None:
    """One Mat, as the factorisation expects; what it held before leaves no trace."""
    system = shell(2).system
    u = [random_displacement(shell(2), 1e-3, seed) for seed in range(2)]
    K = system.tangent(u[0], MU)
    first = csr(K)
    assert system.tangent(u[1], MU) is K
    assert abs(csr(K) - first).max() > 1e-3 * abs(first).max()
    system.tangent(u[0], MU)
    assert abs(csr(K) - first).max() == 0
    assert K.isSymmetricKnown() == (True, True)
    assert abs(first - first.T).max() <= 1e-14 * abs(first).max()


def test_stress_of_other_displacements(shell: Shells) -> None:
    """v . K v changes by twice the integral of `densities.prestress` with the change of the strain,
    by a form.
    """
    model = shell(2)
    system, u, step, v = (
        model.system,
        *(random_displacement(model, 1e-2, seed) for seed in range(3)),
    )
    K = csr(system.tangent(u, MU))
    assert abs(csr(system.tangent(u, MU, [(1.0, u)])) - K).max() <= 1e-14 * abs(K).max()
    changed = csr(system.tangent(u, MU, extrapolated_stress(u - step, step)))

    fields = [fem.Function(model.V) for _ in range(2)]
    for field, values in zip(fields, (step, v), strict=True):
        field.x.array[:] = values
    r0, d, w = (kinematics.jet(field, model.V.mesh) for field in (model.r0, *fields))
    square = kinematics.metric(d)
    E = -ufl.as_vector([square[0, 0], square[0, 1], square[1, 1]]) / 2
    density = densities.prestress(r0, d, w, E, law=model.material.law) * kinematics.area_ratio(r0)
    free = system.zero_at_supports(np.ones_like(v))
    form = density * ufl.dx(metadata={"quadrature_degree": cell_quadrature(2)})
    fields[1].x.array[:] = v * free
    expected = 2 * fem.assemble_scalar(fem.form(form))
    found = (v * free) @ ((changed - K) @ (v * free))
    assert found == pytest.approx(expected, rel=1e-10)
    assert abs(expected) > 1e-6 * abs((v * free) @ (K @ (v * free)))


HALF_SHELL = {
    "shell": {"geometry": "hemisphere", "radius_to_thickness": 20, "poisson_ratio": 0.3},
    "boundary": {"equator": "clamped"},
    "magnetic": {"lambda_m": 1e-3},
    "loading": {
        "kind": "pressure",
        "until": "target",
        "control": "load",
        "pressure": 0.2,
        "points": 1,
    },
    "mesh": {"degree": 2, "refinement": 0.6},
    "symmetry": "half",
}


def test_run_compiles_no_forms_but_energies() -> None:
    """Nor do the modes that a half shell excludes."""
    scene = Scene(Case.from_source(Source("half", HALF_SHELL)))
    states = [record.point.state for record in follow(scene)]
    assert scene.model.symmetry_breaking_modes
    scene.model.symmetry_breaking_modes.factor_at(states[-1])
    names = scene.model.kernels.names
    assert len(names) == len(set(names))
    assert [name for name in names if name.endswith(("tangent", "residual"))] == []
    assert {"interior edges", "antisymmetric edges"} <= set(names), "their Hessians at points"


RANKS = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parents[2])!r})
import numpy as np
from along import along
from mpi4py import MPI
from magshell_fenicsx import Case, Scene
from magshell_fenicsx.input.source import Source

scene = Scene(Case.from_source(Source("half", {HALF_SHELL!r})))
model, mu = scene.model, dict(pressure=0.3, lambda_m=0.4)
# each node's own place makes the same u on all ranks
x = model.r0.x.array[: model.system.size].reshape(-1, 3)
u = (1e-2 * np.sin(40 * x @ np.array([[3, 1, 2], [1, -2, 5], [-4, 2, 1]]))).ravel()
for fast in (model.system, model.symmetry_breaking_modes.system):
    K, v = fast.tangent(u, mu), fast.zero_at_supports(np.roll(u, 3))
    given, found = K.createVecs()
    given.array[:] = v
    K.mult(given, found)
    expected = fast.zero_at_supports(along(fast, u, mu, v))
    largest = [
        scene.comm.allreduce(np.abs(a).max(), MPI.MAX)
        for a in (fast.zero_at_supports(found.array) - expected, expected)
    ]
    size = K.norm()
    if scene.comm.rank == 0:
        print("result", repr(size), repr(float(largest[0] / largest[1])))
"""  # continued in test_fast_residual.py
