"""How sharply the cells of an undeformed surface meet."""

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from magshell_fenicsx.assembly.batches import interior_batches

FOLD = 0.02  # rad: below, the sine of an angle is the angle to 7e-5


def largest_fold(r0: fem.Function, degree: int) -> float:
    """Largest angle (rad) between the undeformed normals of two cells at their edge; collective."""
    V = r0.function_space
    nodes, largest = r0.x.array.reshape(-1, 3), 0.0
    for batch in interior_batches(V, degree):
        normals = []
        for table, cells in zip(batch.rule.tables, batch.cells, strict=True):
            jets = table.jets(nodes[V.dofmap.list[cells]])
            m = np.cross(jets[:, :, 1], jets[:, :, 2])
            normals.append(m / np.linalg.norm(m, axis=-1)[..., None])
        sine = np.linalg.norm(np.cross(*normals), axis=-1)
        angles = np.arctan2(sine, np.einsum("epi,epi->ep", *normals))
        largest = max(largest, float(angles.max()))
    return float(V.mesh.comm.allreduce(largest, MPI.MAX))
