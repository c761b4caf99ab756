"""Which rank has which cells: the same of the same cells, whatever dolfinx's partitioner is."""

import json
import subprocess
import sys

import numpy as np
import pytest
from command import mpirun
from numpy.typing import NDArray

from magshell_fenicsx.mesh.partition import destinations

Longs = NDArray[np.int64]
PROGRAM = """
import json, sys
import basix.ufl, numpy as np
from mpi4py import MPI
from dolfinx import fem
from magshell_fenicsx.mesh.midsurface import create_mesh

cells, x = map(np.array, json.loads(sys.argv[1]))
element, comm, found = basix.ufl.element("Lagrange", "triangle", 1, shape=(3,)), MPI.COMM_WORLD, []
for _ in range(10):
    domain = create_mesh(comm, element, cells, x)
    V, count = fem.functionspace(domain, ("Lagrange", 2)), domain.topology.index_map(2).size_local
    nodes = V.dofmap.index_map.local_to_global(V.dofmap.list[:count].ravel())
    numbers = domain.topology.original_cell_index
    found.append([nodes.tolist(), numbers[:count].tolist(), numbers[count:].tolist()])
of_ranks = comm.gather(found)
if not comm.rank:
    print(json.dumps(of_ranks))
"""


def strips(count: int) -> tuple[Longs, NDArray[np.float64]]:
    """Two strips one over the other, of `count` squares each, without a node in common."""
    i = np.arange(count)
    one = np.concatenate(
        [
            np.column_stack([i, i + 1, i + count + 2]),
            np.column_stack([i, i + count + 2, i + count + 1]),
        ]
    )
    x, y, z = np.meshgrid(np.arange(count + 1.0), [0.0, 1.0], [0.0, 1.0], indexing="ij")
    nodes = np.stack([x, y, z], axis=-1).transpose(2, 1, 0, 3).reshape(-1, 3)
    return np.concatenate([one, one + 2 * (count + 1)]).astype(np.int64), nodes


def facets(cell: Longs) -> set[frozenset[int]]:
    return {frozenset(map(int, np.delete(cell, k))) for k in range(3)}


@pytest.mark.parametrize("ranks", [1, 2, 3, 7])
def test_ranks_of_about_the_same_size_with_one_layer_of_ghosts(ranks: int) -> None:
    """The neighbours by the definition of a facet, cell by cell; numbers of cells that differ by
    rounding in each division.
    """
    cells, _ = strips(20)
    wanted, offsets = destinations(cells, 2, ranks)
    of_cell = [each.tolist() for each in np.split(wanted, offsets[1:-1])]
    owner, on = [each[0] for each in of_cell], [facets(cell) for cell in cells]
    for each, mine in zip(of_cell, on, strict=True):
        beside = {rank for rank, other in zip(owner, on, strict=True) if mine & other}
        assert each[1:] == sorted(beside - {each[0]})
    sizes = np.bincount(owner, minlength=ranks)
    assert abs(sizes - len(cells) / ranks).max() <= np.log2(ranks)
    assert sum(map(len, of_cell)) - len(cells) <= 2 * ranks, "they are not scattered"


def test_more_ranks_than_cells() -> None:
    cells, _ = strips(1)
    wanted, _ = destinations(cells, 2, 9)
    assert len({*wanted}) == len(cells)


def test_same_numbers_in_each_mesh() -> None:
    """SCOTCH with threads divides some meshes in another way about once in ten times."""
    cells, nodes = strips(30)
    given = json.dumps([cells[:-10].tolist(), nodes.tolist()])
    command = [*mpirun(2), sys.executable, "-c", PROGRAM, given]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    wanted, offsets = destinations(cells[:-10], 2, 2)
    of_cell = np.split(wanted, offsets[1:-1])
    for rank, meshes in enumerate(json.loads(done.stdout)):
        assert all(each == meshes[0] for each in meshes)
        _, own, ghosts = meshes[0]
        assert sorted(own) == [cell for cell, (owner, *_) in enumerate(of_cell) if owner == rank]
        assert sorted(ghosts) == [cell for cell, (_, *to) in enumerate(of_cell) if rank in to] != []
