"""The residual from point gradients against that of FFCx's forms, the reference."""

import subprocess
import sys
from collections.abc import Callable, Mapping

import numpy as np
import pytest
from command import mpirun
from conftest import TILTED, hemisphere, random_displacement
from dolfinx import fem
from test_fast_tangent import RANKS as TANGENTS
from test_fast_tangent import pattern

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.models.shell import gradients
from magshell_fenicsx.models.shell.parameters import Condition, Force, Material
from magshell_fenicsx.models.shell.residual import FastResidual
from magshell_fenicsx.models.shell.spatial_fields import tangential
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.shells.shell import ShellModel

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
    "U1": "second_consistent",
    "Uq": "second_consistent",
    "Utau": "second_consistent",
    "couple": "second_consistent",
}
MU = {"lambda_m": 0.4, "lambda_across": -0.7, "pressure": 0.3, "force": 0.2}


def by_forms(system: FiniteElementSystem) -> FiniteElementSystem:
    """The same terms and conditions, with FFCx's residuals."""
    assert system.gradients
    return FiniteElementSystem(
        system.u, system.terms, system.clamped, pattern(system), 1.0, system._assembler
    )


def difference(system: FiniteElementSystem, u: np.ndarray, mu: Mapping[str, float]) -> float:
    """Largest difference of the residual, or of a load column, over the largest entry of the forms'
    one.
    """
    reference = by_forms(system)
    pairs = [(system.residual(u, mu), reference.residual(u, mu))]
    loads = {t.amplitude for t in system.terms if t.amplitude}
    pairs += [(system.load(u, {}, name), reference.load(u, {}, name)) for name in loads]
    return max(float(np.abs(here - there).max() / np.abs(there).max()) for here, there in pairs)


@pytest.mark.parametrize("name", TERMS)
def test_term_alone(shell: Shells, name: str) -> None:
    """To 1e-12 at random nodal values, nothing held; added to what is there. So is the energy."""
    model = shell(2, half=name == "mirror edges", energy=TERMS[name])
    term = next(t for t in model.system.terms if t.name == name)
    model.u.x.array[:] = random_displacement(model, 1e-3)
    reference, found = np.zeros_like(model.u.x.array), np.ones_like(model.u.x.array)
    term.add_residual(reference, -0.7)
    residual = FastResidual(model.r0, model.u, 2, [term], KernelLog())
    residual.add(found, {name: -0.7, "another": 1.0})
    assert residual.names == {name}
    assert np.abs(found - 1 - reference).max() <= 1e-12 * np.abs(reference).max()
    assert residual.energy(name) == pytest.approx(fem.assemble_scalar(term.energy_form), rel=1e-12)


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize(("energy", "half"), [("full", False), ("second_consistent", True)])
def test_terms_together(shell: Shells, half: bool, energy: str, degree: int) -> None:
    """And the load columns, of one amplitude's terms only."""
    model = shell(degree, half=half, energy=energy)
    for seed, amplitudes in enumerate(({"lambda_m": 0.0, "pressure": 0.0}, MU)):
        assert difference(model.system, random_displacement(model, 1e-3, seed), amplitudes) <= 1e-12


@pytest.mark.parametrize("condition", ["free", "simply supported", "clamped"])
def test_edge_conditions_and_dead_load(condition: Condition) -> None:
    loads = Loads(pressure=True, forces={"force": Force("load")})
    model = ShellModel(hemisphere(0.8), Material(0.3, 0.05), 2, {"rim": condition}, loads)
    assert difference(model.system, random_displacement(model, 1e-3), MU) <= 1e-12


def test_remanence_that_varies_field_that_varies_and_turns() -> None:
    """A pattern, a gradient (which needs u itself), and a field with a part across."""
    G = np.array([[0.5, 0.2, -0.1], [0.2, -0.7, 0.3], [0.1, 0.3, 1.2]])
    field = Magnetisation(
        tangential, np.array([0.0, 0.6, 0.8]), "full", G, (np.array([1.0, 0.0, 0.0]),)
    )
    model = ShellModel(hemisphere(0.8), Material(0.3, 0.05), 2, {}, Loads(magnetic=field))
    for mu in (
        MU,
        {"lambda_m": 0.0, "lambda_across": 1.0},
        {"lambda_m": 10.0, "lambda_across": 0.0},
    ):
        assert difference(model.system, random_displacement(model, 1e-3), mu) <= 1e-12


def test_in_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """What varies from point to point is renewed with every chunk; the last one is shorter."""
    field = Magnetisation(tangential, np.array([0.0, 0.6, 0.8]))
    found = []
    for chunk in (gradients.CHUNK_POINTS, 50):
        monkeypatch.setattr(gradients, "CHUNK_POINTS", chunk)
        model = ShellModel(
            hemisphere(0.8), Material(0.3, 0.05), 2, {"rim": "clamped"}, Loads(magnetic=field)
        )
        found.append(
            np.array(
                [
                    model.system.residual(random_displacement(model, 1e-3, seed), MU)
                    for seed in range(2)
                ]
            )
        )
    assert np.abs(found[1] - found[0]).max() <= 1e-14 * np.abs(found[0]).max()


@pytest.mark.parametrize("aspect", [50, 500])
def test_slivers(aspect: float) -> None:
    """A hemisphere pressed flat, against forms whose Jacobian (3, 2) is inverted by way of its
    square.
    """
    model = ShellModel(
        hemisphere(0.8, half=True),
        Material(0.3, 0.05),
        4,
        {"rim": "clamped", "symmetry": "symmetry"},
        Loads(True),
    )
    model.V.mesh.geometry.x[:, 1] /= aspect
    model.r0.x.array.reshape(-1, 3)[:, 1] /= aspect
    model.u.x.array[:] = random_displacement(model, 1e-3) * np.tile(
        [1, 1 / aspect, 1], model.system.size // 3
    )
    for term in model.system.terms:
        residual = FastResidual(model.r0, model.u, 4, [term], KernelLog())
        reference, found = np.zeros_like(model.u.x.array), np.zeros_like(model.u.x.array)
        term.add_residual(reference, 1.0)
        residual.add(found, {term.name: 1.0})
        rounding = (
            20 * np.finfo(float).eps * aspect**2
        )  # of the forms' sums: 10.6 on the most unlike of processors
        assert np.abs(found - reference).max() <= rounding * np.abs(reference).max()


def test_no_residual_forms_are_compiled() -> None:
    """Nor for the modes that a half shell excludes."""
    model = ShellModel(
        hemisphere(0.8, half=True),
        Material(0.3, 0.05),
        2,
        {"symmetry": "symmetry"},
        Loads(magnetic=TILTED),
    )
    assert model.symmetry_breaking_modes
    names = model.kernels.names
    assert not [name for name in names if name.endswith("residual")]
    assert {"membrane, bending gradient", "magnetic gradient", "interior edges gradient"} <= set(
        names
    )
    by_forms(model.system)
    assert [name for name in names if name.endswith("residual")] == [
        f"{t.name} residual" for t in model.system.terms
    ]


RANKS = """
from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.continuation.system import dot, max_abs

system = model.system
form = next(t for t in system.terms if t.name == "interior edges")
forms = FiniteElementSystem(system.u, system.terms, system.clamped, form, 1.0, system._assembler)
for get in (
    lambda s: s.residual(u, mu),
    lambda s: s.load(u, mu, "pressure"),
    lambda s: s.load(u, mu, "lambda_m"),
):
    R, reference = get(system), get(forms)
    size = dot(scene.comm, R, R) ** 0.5
    error = max_abs(scene.comm, R - reference) / max_abs(scene.comm, reference)
    if scene.comm.rank == 0:
        print("result", repr(float(size)), repr(float(error)))
"""


@pytest.mark.slow
def test_ranks() -> None:
    """On 1 and 2 ranks tangents, residual and load columns are those of the forms, and equal."""
    found = []
    for ranks in (1, 2):
        command = [*(mpirun(ranks) if ranks > 1 else []), sys.executable, "-c", TANGENTS + RANKS]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        lines = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("result")]
        found.append([(float(size), float(error)) for size, error in lines])
    for each in found:
        assert len(each) == 2 + 3
        assert max(error for _, error in each) <= 1e-12
        assert [size for size, _ in each] == pytest.approx(
            [size for size, _ in found[0]], rel=1e-12
        )
