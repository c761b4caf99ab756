"""Which rank has which cells: the same ones in each mesh of the same cells."""

import subprocess
import sys

from command import mpirun

PROGRAM = """
import basix.ufl, numpy as np
from mpi4py import MPI
from dolfinx import fem
from magshell_fenicsx.mesh.midsurface import create_mesh

i, j = (each.ravel() for each in np.meshgrid(np.arange(20), np.arange(10), indexing="ij"))
first = 11 * i + j
lower, upper = [first, first + 1, first + 12], [first, first + 12, first + 11]
cells = np.concatenate([np.column_stack(lower), np.column_stack(upper)])
x = np.array([(i, j, 0.0) for i in range(21) for j in range(11)])
element = basix.ufl.element("Lagrange", "triangle", 1, shape=(3,))
comm, numberings = MPI.COMM_WORLD, set()
for _ in range(40):
    domain = create_mesh(comm, element, cells, x)
    V = fem.functionspace(domain, ("Lagrange", 2))
    numberings.add((domain.topology.original_cell_index.tobytes(), V.dofmap.list.tobytes()))
counts = comm.gather(len(numberings))
if not comm.rank:
    print(*counts)
"""


def test_same_numbers_in_each_mesh() -> None:
    """SCOTCH with threads divides this grid in another way about once in five times."""
    command = [*mpirun(2), sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["1", "1"], done.stderr
