"""The model that a program takes apart: residual, tangent and mass in the program's own solvers.

PETSc's SNES and SLEPc's eigensolvers, as a program sets them up, find the equilibria and the modes
that the package finds by its own ways.
"""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import basix.ufl
import numpy as np
import pytest
import ufl
from command import importing_environment, mpirun
from conftest import CASES
from dolfinx import fem, mesh
from mpi4py import MPI
from petsc4py import PETSc
from slepc4py import SLEPc

import magshell_fenicsx as ms
from magshell_fenicsx.assembly.field_gradient import FieldGradient

# a small rectangle with x in mm and a height that is a quarter of a wave
LENGTH, WIDTH, HEIGHT = 40.0, 15.0, 4.0


def strip(comm: MPI.Intracomm = MPI.COMM_SELF) -> tuple[mesh.Mesh, dict[str, Any]]:
    """A curved strip of triangles in mm, and the arguments of its `ms.Shell`."""
    flat = mesh.create_rectangle(
        MPI.COMM_SELF, [(0.0, 0.0), (LENGTH, WIDTH)], (4, 2), mesh.CellType.triangle
    )
    nodes = flat.geometry.x
    nodes[:, 2] = HEIGHT * np.sin(np.pi * nodes[:, 0] / (2 * LENGTH))
    cells = flat.geometry.dofmap.astype(np.int64)
    is_first = comm.rank == 0  # which gives all cells
    surface = mesh.create_mesh(
        comm,
        cells if is_first else cells[:0],
        nodes if is_first else nodes[:0],
        basix.ufl.element("Lagrange", "triangle", 1, shape=(3,)),
    )
    surface.topology.create_connectivity(1, 2)
    facets = mesh.exterior_facet_indices(surface.topology)
    ends = mesh.compute_midpoints(surface, 1, facets)[:, 0]
    edges = {"root": facets[ends < 1e-9], "rest": facets[ends >= 1e-9]}
    return surface, {
        "edges": edges,
        "unit": "mm",
        "radius": "40 mm",
        "thickness": "1 mm",
        "youngs_modulus": "1 MPa",
        "poisson_ratio": 0.4,
    }


def model_of_strip(comm: MPI.Intracomm = MPI.COMM_SELF) -> ms.Model:
    """A strip under its weight."""
    surface, arguments = strip(comm)
    return model_of_weight(ms.Shell(surface, **arguments))


def model_of_weight(shell: ms.Shell) -> ms.Model:
    """A shell with an edge `root` under its weight."""
    problem = ms.Problem(
        shell,
        ms.Clamped("root"),
        ms.Step("dead", loads=[{"over": "all", "per_area": ["0 Pa", "0 Pa", "-1 Pa"]}], factor=1),
        degree=3,
    )
    return ms.Model(problem)


def model_of_case(file: str, settings: Sequence[str]) -> ms.Model:
    """The model of a file of cases/."""
    return ms.Model(ms.Case.load(CASES / file, settings), MPI.COMM_SELF)


COARSE = "mesh.refinement=0.5"
MODELS = {
    "surface": (model_of_strip, {"load": 2.0}),
    "meridian": (lambda: model_of_case("dimple_buckling.yaml", [COARSE]), {"pressure": 0.2}),
    "rubber": (lambda: model_of_case("balloon.yaml", [COARSE]), {"pressure": -1.0}),
    "contact": (lambda: model_of_case("plate_contact.yaml", [COARSE]), {"approach": 0.5}),
    "own field": (
        lambda: model_of_case("own_field.yaml", ["mesh.refinement=0.15"]),
        {"pressure": 0.2},
    ),
}
SLOW = ("own field", "rubber")


@pytest.fixture(
    params=[pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in MODELS],
    scope="module",
)
def solved(request: pytest.FixtureRequest) -> ms.Model:
    """A model at an equilibrium under load."""
    make, loads = MODELS[request.param]
    model = make()
    model.set(**loads)
    model.solve()
    return model


def test_own_snes(solved: ms.Model) -> None:
    """Newton's method of SNES, from a displacement that is 1 % off, finds the same equilibrium."""
    model, state = solved, solved.state
    model.put(type(state)(0.99 * state.u, state.mu))

    def residual(snes: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        model.put(x)
        model.residual().copy(f)

    def tangent(snes: PETSc.SNES, x: PETSc.Vec, J: PETSc.Mat, P: PETSc.Mat) -> None:
        model.put(x)
        model.tangent().copy(P, structure=PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)

    x, snes = model.unknowns(), PETSc.SNES().create(model.comm)
    snes.setOptionsPrefix("own_")
    PETSc.Options()["own_snes_linesearch_type"] = "basic"
    snes.setFunction(residual, model.residual())
    snes.setJacobian(tangent, model.tangent())
    snes.getKSP().setType("preonly")
    snes.getKSP().getPC().setType("lu")
    snes.setFromOptions()
    snes.setTolerances(rtol=0, atol=0, stol=1e-13, max_it=12)
    snes.solve(None, x)
    model.put(state)
    assert np.abs(x.array - state.u).max() <= 1e-12  # over R


def test_own_slepc(solved: ms.Model) -> None:
    """The natural modes of least frequency by shift and invert."""
    model = solved
    own_modes = [mode for mode in model.modes(4) if not mode.label]
    solver = SLEPc.EPS().create(model.comm)
    solver.setOperators(model.tangent(), model.mass())
    solver.setProblemType(SLEPc.EPS.ProblemType.GHEP)
    solver.setDimensions(len(own_modes))
    solver.setTarget(0.0)
    solver.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_MAGNITUDE)
    solver.getST().setType("sinvert")
    solver.getST().getKSP().setType("preonly")
    solver.getST().getKSP().getPC().setType("lu")
    solver.setTolerances(tol=1e-13)
    solver.solve()
    for number, mode in enumerate(own_modes):
        assert solver.getEigenvalue(number).real == pytest.approx(mode.omega2, rel=1e-8)
        assert mode.u is not None


def test_tangent_is_the_derivative_of_the_residual(solved: ms.Model) -> None:
    """By central differences, along a displacement that supports allow."""
    model, state = solved, solved.state
    direction = np.random.default_rng(0).normal(size=state.u.shape) * 1e-6 * np.abs(state.u).max()
    direction[model.held_unknowns] = 0.0
    product, residuals = model.unknowns(), []
    vector = model.unknowns()
    vector.array[:] = direction
    model.tangent().mult(vector, product)
    for sign in (1, -1):
        model.put(type(state)(state.u + sign * direction, state.mu))
        residuals.append(model.residual().array.copy())
    model.put(state)
    difference = (residuals[0] - residuals[1]) / 2
    assert np.linalg.norm(product.array - difference) < 1e-5 * np.linalg.norm(difference)


def test_displacement_is_one_function() -> None:
    """Its values are those of the state, and a state is that of changed values."""
    model = model_of_strip()
    model.set(load=1.0)
    model.solve()
    u, state = model.u, model.state
    assert u is model.u
    assert u.function_space.mesh.geometry.x[:, 0].max() == pytest.approx(LENGTH)
    tip = np.abs(u.x.array).max()
    assert tip == pytest.approx(LENGTH * np.abs(state.u).max(), rel=1e-12)
    u.x.array[:] *= 0.5
    assert model.state.u == pytest.approx(0.5 * state.u, rel=1e-14, abs=1e-18)
    assert np.abs(model.residual().array).max() > 0
    model.solve()
    assert np.abs(u.x.array).max() == pytest.approx(tip, rel=1e-9)


def test_gradient_along_functions_of_other_degrees() -> None:
    """A thickness of degree 1 or 2, the displacement of degree 3: differences of solutions."""
    surface, arguments = strip()
    V = fem.functionspace(surface, ("Lagrange", 1))
    thickness, waves = fem.Function(V), fem.Function(V)
    bump = fem.Function(fem.functionspace(surface, ("DG", 2)))
    thickness.interpolate(lambda x: 1 + 0.2 * np.sin(x[0] / 15))
    waves.interpolate(lambda x: np.cos(x[0] / 2))  # another function than the formula at all nodes
    model = model_of_weight(ms.Shell(surface, thickness_factor=thickness, **arguments))
    model.set(load=1)
    record = model.solve()
    gradient = ms.gradient(model, record, of="energy", by="thickness")["thickness"]
    assert isinstance(gradient, FieldGradient)
    mean, energies = thickness.x.array.copy(), list[float]()
    for side in (1, -1):
        thickness.x.array[:] = mean + side * 1e-3 * waves.x.array
        energies.append(model.observe(model.solve().point.state)["energy"])
    expected = (energies[0] - energies[1]) / 2e-3
    assert gradient.along(waves) == pytest.approx(expected, rel=1e-5)
    bump.interpolate(waves)
    assert gradient.along(bump) == pytest.approx(gradient.along(waves), rel=1e-12)
    with pytest.raises(ValueError, match=r"shape \(16, 10\): give \(16, 10, 1\)"):
        gradient.along(gradient.forces[..., 0])
    finer = fem.Function(fem.functionspace(surface, ("DG", 4)))
    with pytest.raises(ms.MeshError, match="along: is a function of degree 4; allowed is at most"):
        gradient.along(finer)


def test_function_of_an_own_energy_in_a_loop() -> None:
    """One model follows springs whose stiffness changes, and keeps its deformed state."""
    surface, arguments = strip()
    stiffness = fem.Function(fem.functionspace(surface, ("Lagrange", 1)))
    bed = ms.OwnTerm("bed", lambda r0, u, k: k * ufl.dot(u.r, u.r) / 2, (stiffness,), value=1.0)
    problem = ms.Problem(
        ms.Shell(surface, **arguments),
        ms.Clamped("root"),
        ms.Step("dead", loads=[{"over": "all", "per_area": ["0 Pa", "0 Pa", "-1 Pa"]}], factor=1),
        bed,
        degree=3,
    )
    model = ms.Model(problem, MPI.COMM_SELF)
    model.set(load=2.0)
    heights = []
    for value in (0.0, 1e-6, 1e-5):
        stiffness.x.array[:] = value
        record = model.solve()
        heights.append(np.abs(record.u.x.array).max())
    assert heights[0] > heights[1] > heights[2] > 0
    stiffness.x.array[:] = 0.0
    model.solve()
    assert np.abs(model.u.x.array).max() == pytest.approx(heights[0], rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("use", ["thickness", "remanence"])
def test_functions_in_the_own_field(use: str) -> None:
    """A model whose function has changed gives the numbers of a new one."""
    surface, arguments = strip()
    thickness = fem.Function(fem.functionspace(surface, ("Lagrange", 1)))
    remanence = fem.Function(fem.functionspace(surface, ("Lagrange", 1, (3,))))
    thickness.x.array[:], remanence.x.array[:] = 1.0, 0.06

    def model() -> ms.Model:
        problem = ms.Problem(
            ms.Shell(surface, thickness_factor=thickness, **arguments),
            ms.Clamped("root"),
            ms.Field(remanence, [0, 0, -0.002], interaction="all"),
            degree=3,
        )
        return ms.Model(problem, MPI.COMM_SELF)

    def tip(model: ms.Model) -> float:
        """The largest displacement under the field."""
        model.set(lambda_m=1e-5)
        return float(np.abs(model.solve().u.x.array).max())

    first_model = model()
    before = tip(first_model)
    function = thickness if use == "thickness" else remanence
    function.x.array[: len(function.x.array) // 2] *= 0.9
    after = tip(first_model)
    assert after == pytest.approx(tip(model()), rel=1e-9)
    assert after != pytest.approx(before, rel=1e-4)


def test_loads_in_units_and_unknown_loads() -> None:
    model = model_of_case("balloon.yaml", [COARSE])
    model.set(pressure="-1 kPa")
    p_c = 2 * 1.5e6 * (0.5 / 50) ** 2 / np.sqrt(3 * (1 - 0.5**2))  # Zoelly's pressure, in Pa
    assert model.amplitudes["pressure"] == pytest.approx(-1000 / p_c)
    with pytest.raises(ValueError, match="presure: the scene has no such amplitude, only"):
        model.set(presure=1)


def test_far_loads_are_reached_step_by_step() -> None:
    """Newton's method from the undeformed shell fails at this load."""
    model = model_of_strip()
    model.set(load=400.0)
    record = model.solve()
    assert record.point.negative_pivots == 0
    assert np.abs(model.residual().array).max() < 1e-9


def test_supports_stay_where_they_are() -> None:
    """A displacement that a program sets at held unknowns is not taken."""
    model = model_of_strip()
    model.set(load=1.0)
    model.solve()
    u = model.unknowns()
    model.u.x.array[:] += 0.1
    assert np.abs(model.state.u[model.held_unknowns]).max() == 0.0
    u.array[model.held_unknowns] = 1.0
    model.put(u)
    assert np.abs(model.state.u[model.held_unknowns]).max() == 0.0


def test_modes_of_a_sector_are_those_of_the_shell() -> None:
    """A sector leaves out modes that its half has."""
    whole, sector = (
        model_of_case("dimple_buckling.yaml", ["mesh.refinement=0.3", f"symmetry={symmetry}"])
        for symmetry in ("half", "4")
    )
    lowest = [model.modes(1)[0].omega2 for model in (whole, sector)]
    assert lowest[1] == pytest.approx(lowest[0], rel=1e-2)


@pytest.mark.slow
def test_state_on_two_ranks(tmp_path: Path) -> None:
    """A program on two ranks that sets its own values alone gets the state of these values."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    command = [*mpirun(2), sys.executable, str(program)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=importing_environment()
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[-1]) < 1e-12


PROGRAM = """
import numpy as np
from mpi4py import MPI
import test_model
import magshell_fenicsx as ms

model = test_model.model_of_strip(MPI.COMM_WORLD)
model.set(load=1.0)
model.solve()
state, u = model.state, model.u
own = u.function_space.dofmap.index_map.size_local * 3
u.x.array[:own] *= 0.5
difference = MPI.COMM_WORLD.allreduce(np.abs(model.state.u - 0.5 * state.u).max(), MPI.MAX)
if MPI.COMM_WORLD.rank == 0:
    print(difference / np.abs(state.u).max())
"""
