"""Work that rank 0 does for all ranks; if it fails, all ranks fail together."""

import pickle
from collections.abc import Callable
from typing import TypeVar

from mpi4py import MPI

T = TypeVar("T")


def from_first(comm: MPI.Comm, do: Callable[[], T]) -> T:
    """Call `do` on rank 0 and return its result on every rank; collective.

    Raises
    ------
    Exception
        On every rank, the exception that `do` raises on rank 0.
    """
    if comm.size == 1:
        return do()
    sent, failure = b"", None
    if comm.rank == 0:
        try:
            sent = pickle.dumps((do(), None))
        except Exception as e:
            failure, sent = e, _pickled(e)
    sent = comm.bcast(sent)
    if failure:
        raise failure  # with its traceback
    found: T
    found, failure = pickle.loads(sent)
    if failure:
        raise failure
    return found


def _pickled(e: Exception) -> bytes:
    """An error for the other ranks: the same one if it can be pickled."""
    try:
        sent = pickle.dumps((None, e))
        pickle.loads(sent)
    except Exception:
        return pickle.dumps((None, RuntimeError(f"on rank 0: {type(e).__name__}: {e}")))
    return sent
