"""What a support stops: rigid motions and the energy that resists them, of springs in a row."""

import numpy as np
import pytest
from continuation.toys import matrix
from mpi4py import MPI

from magshell_fenicsx.parts.supports.supports import unresisted


@pytest.mark.parametrize("stiffer", [1.0, 1e6, 1e12])
@pytest.mark.parametrize("held", [True, False])
def test_a_soft_piece_is_held_by_its_own_stiffness(stiffer: float, held: bool) -> None:
    """Four nodes in a row, tied to the ground by a spring of 1e-6 of the others, are held beside
    any stiffer row."""
    row = np.diag([1.0, 2.0, 2.0, 1.0]) - np.eye(4, k=1) - np.eye(4, k=-1)
    K = np.kron(np.diag([1.0, stiffer]), row)
    K[0, 0] += 1e-6 * held
    motion = np.array([[1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]])
    free = unresisted(motion, lambda v: v, lambda: matrix(K), MPI.COMM_SELF)
    assert len(free) == (not held)
