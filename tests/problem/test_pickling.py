"""Problems and records that go to another process, as executors and MPI pools send them."""

import pickle
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import basix.ufl
import numpy as np
import pytest
from conftest import CASES
from dolfinx import fem, mesh
from mpi4py import MPI

import magshell_fenicsx as ms
from magshell_fenicsx.problem.problem import Problem

COARSE = ["mesh.refinement=0.5"]


def knockdown(problem: Problem) -> float | None:
    """The knockdown factor of a problem, in the process that calls this."""
    return ms.run(problem).knockdown


def test_a_problem_in_another_process() -> None:
    problem = ms.Case.load(CASES / "dimple_buckling.yaml", COARSE).problem()
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        assert pool.submit(knockdown, problem).result() == knockdown(problem)


def test_a_problem_of_python() -> None:
    shell = ms.Shell("hemisphere", radius_to_thickness=90, poisson_ratio=0.5)
    problem = ms.Problem(shell, ms.Clamped("equator"), ms.Pressure(until="limit"))
    copy = pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(problem))))
    assert copy.document.data == problem.document.data
    assert repr(copy) == repr(problem)


def test_a_changed_problem_is_refused() -> None:
    """Else its pickle would be that of the unchanged one."""
    problem = ms.Case.load(CASES / "dimple_buckling.yaml").problem()
    with pytest.raises(TypeError, match="a problem that was changed since its case made it"):
        pickle.dumps(replace(problem, azimuth=0.1))


def test_a_dolfinx_mesh_is_refused() -> None:
    surface = mesh.create_rectangle(MPI.COMM_SELF, [(0, 0), (1, 1)], (2, 2))
    in_space = mesh.create_mesh(
        MPI.COMM_SELF,
        surface.geometry.dofmap.astype(np.int64),
        surface.geometry.x,
        basix.ufl.element("Lagrange", "triangle", 1, shape=(3,)),
    )
    in_space.topology.create_connectivity(1, 2)
    rim = mesh.exterior_facet_indices(in_space.topology)
    shell = ms.Shell(in_space, edges={"rim": rim}, thickness=0.01, poisson_ratio=0.3)
    problem = ms.Problem(shell, ms.Clamped("rim"), ms.Pressure())
    with pytest.raises(TypeError, match="a dolfinx mesh belongs to its process"):
        pickle.dumps(problem)


def test_a_record() -> None:
    model = ms.Model(ms.Case.load(CASES / "dimple_buckling.yaml", COARSE))
    *_, record = ms.follow(model)
    copy = pickle.loads(pickle.dumps(record))
    assert copy.point.state.mu == record.point.state.mu
    assert np.array_equal(copy.point.state.u, record.point.state.u)
    with pytest.raises(ValueError, match="comes from another process"):
        _ = copy.u
    model.put(copy)
    assert np.array_equal(model.u.x.array, record.u.x.array)


def test_texts_are_short() -> None:
    """Texts of a problem, a model, a record and a result have a few lines."""
    result = ms.run(ms.Case.load(CASES / "dimple_buckling.yaml", COARSE))
    for value in (result, result.record, result.scene, result.scene.problem, result.history):
        assert len(repr(value)) < 800
    assert result._repr_html_().startswith("<table>")
    assert isinstance(result.record.u, fem.Function)


def test_public_names_alone() -> None:
    assert dir(ms) == sorted(ms.__all__)
