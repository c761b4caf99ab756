"""A matrix filled from cells and pairs of cells, against sums over all entries one by one."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
from dolfinx import fem, mesh
from mpi4py import MPI

from magshell_fenicsx.assembly.point_kernels import COMPONENTS, SKEW
from magshell_fenicsx.assembly.scatter import BlockMatrix
from magshell_fenicsx.platform.native import load_native


def space(degree: int) -> fem.FunctionSpace:
    return fem.functionspace(
        mesh.create_unit_square(MPI.COMM_SELF, 3, 2), ("Lagrange", degree, (3,))
    )


def neighbours(V: fem.FunctionSpace) -> tuple[np.ndarray, ...]:
    V.mesh.topology.create_connectivity(1, 2)
    links = V.mesh.topology.connectivity(1, 2)
    pairs = [links.links(facet) for facet in range(V.mesh.topology.index_map(1).size_local)]
    return tuple(np.array([pair for pair in pairs if len(pair) == 2]).T)


def dense(
    V: fem.FunctionSpace, same: np.ndarray, cells: tuple[np.ndarray, ...], cross: np.ndarray
) -> np.ndarray:
    """The definitions of `BlockMatrix.add_cells` and `add_coupling`, entry by entry."""
    dofs, size = 3 * V.dofmap.list, 3 * V.dofmap.index_map.size_local
    functions, K = dofs.shape[1], np.zeros((size, size))
    for cell, values in zip(dofs, same, strict=True):
        for p, (a, b) in enumerate(zip(*np.triu_indices(functions), strict=True)):
            block = np.zeros((3, 3))
            for (c, d), value in zip(COMPONENTS, values[:6, p], strict=True):
                block[c, d] = block[d, c] = value
            for (c, d), value in zip(SKEW, values[6:, p], strict=True):
                block[c, d] += value
                block[d, c] -= value
            K[cell[a] : cell[a] + 3, cell[b] : cell[b] + 3] += block
            if a != b:
                K[cell[b] : cell[b] + 3, cell[a] : cell[a] + 3] += block.T
    for here, there, values in zip(*(dofs[side] for side in cells), cross, strict=True):
        for a in range(functions):
            for b in range(functions):
                block = values[:, a * functions + b].reshape(3, 3)
                K[here[a] : here[a] + 3, there[b] : there[b] + 3] += block
                K[there[b] : there[b] + 3, here[a] : here[a] + 3] += block.T
    return K


@pytest.mark.telling
@pytest.mark.parametrize("degree", [1, 2, 4])
@pytest.mark.parametrize("held", ["nothing", "an edge", "a component"])
def test_every_entry(degree: int, held: str) -> None:
    V, rng = space(degree), np.random.default_rng(degree)
    cells, functions = V.dofmap.list.shape
    sides = neighbours(V)
    K = BlockMatrix(V, [tuple(np.int32(side) for side in sides)], conditions(V, held))
    same = rng.standard_normal((cells, 9, functions * (functions + 1) // 2))
    a, b = np.triu_indices(functions)
    same[:, 6:, a == b] = 0
    cross = rng.standard_normal((len(sides[0]), 9, functions**2))
    expected = dense(V, same, sides, cross)
    for bc in conditions(V, held):
        fixed = bc.dof_indices()[0]
        expected[fixed] = expected[:, fixed] = 0
        expected[fixed, fixed] = 1
    for _ in range(2):  # the second time nothing is left of the first
        K.clear()
        K.add_coupling(0, cross)
        K.add_cells(same)
        rows, columns, values = K.assemble().getValuesCSR()
        found = scipy.sparse.csr_array((values, columns, rows), shape=expected.shape).toarray()
        assert np.abs(found - expected).max() <= 1e-14 * np.abs(expected).max()


def conditions(V: fem.FunctionSpace, held: str) -> list[fem.DirichletBC]:
    facets = mesh.locate_entities_boundary(V.mesh, 1, lambda x: np.isclose(x[0], 0))
    if held == "an edge":
        return [fem.dirichletbc(np.zeros(3), fem.locate_dofs_topological(V, 1, facets), V)]
    if held == "a component":
        W = V.sub(1)
        return [fem.dirichletbc(0.0, fem.locate_dofs_topological(W, 1, facets), W)]
    return []


def test_code_that_cannot_be_compiled_is_named(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "wrong.c"
    source.write_text("int f(void) { return nothing; }")
    with pytest.raises(subprocess.CalledProcessError):
        load_native(source, "int f(void);", MPI.COMM_SELF)
    assert "wrong.c:1:" in capfd.readouterr().err


def test_changed_code_is_compiled_anew(tmp_path: Path) -> None:
    source, found = tmp_path / "number.c", []
    for number in (1, 2):
        source.write_text(f"int f(void) {{ return {number}; }}")
        found.append(load_native(source, "int f(void);", MPI.COMM_SELF)[1].f())
    assert found == [1, 2]
