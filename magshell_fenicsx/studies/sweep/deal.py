"""Distribution of work to the ranks of a communicator."""

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.folder import DiskError


def deal(count: int, comm: MPI.Intracomm) -> Iterator[int]:
    """Distribute the numbers 0 to count - 1; the next free rank gets the next number. Collective.

    All ranks increase a counter in the memory of rank 0, which works like the others.
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


@contextmanager
def together(comm: MPI.Intracomm) -> Iterator[None]:
    """Wait at the end for all ranks; an error on one of several ends all, which would wait for it for ever."""
    try:
        yield
    except BaseException as e:
        if comm.size == 1:
            raise
        code = 2 if isinstance(e, CaseError) else 3 if isinstance(e, DiskError) else 1
        print(f"rank {comm.rank}: {e if code > 1 else traceback.format_exc()}", file=sys.stderr, flush=True)
        comm.Abort(code)
    comm.Barrier()
