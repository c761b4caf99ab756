"""Dealing out work to the ranks of a communicator."""

from collections.abc import Iterator

import numpy as np
from mpi4py import MPI


def deal(count: int, comm: MPI.Intracomm) -> Iterator[int]:
    """Numbers 0 to count - 1, each to one rank, the next to whoever is free.

    A counter on rank 0 that all ranks increase without its help: every rank works.
    Collective; a rank's numbers come in increasing order.
    """
    if comm.size == 1:
        yield from range(count)
        return
    counter = np.zeros(1, dtype=np.int64)
    window = MPI.Win.Allocate(counter.nbytes if comm.rank == 0 else 0, counter.itemsize, comm=comm)
    if comm.rank == 0:
        window.tomemory()[:] = counter.tobytes()
    comm.Barrier()
    one, number = np.ones(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
    while True:
        window.Lock(0)
        window.Fetch_and_op(one, number, 0)
        window.Unlock(0)
        if number[0] >= count:
            break
        yield int(number[0])
    window.Free()
