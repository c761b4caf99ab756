"""What rank 0 does for all ranks: nobody waits for a rank that has failed."""

import pickle
from collections.abc import Callable
from typing import TypeVar

from mpi4py import MPI

T = TypeVar("T")


def from_first(comm: MPI.Comm, do: Callable[[], T]) -> T:
    """What rank 0 gets from `do`, on every rank; where it raises there, every rank raises the same. Collective.

    Raises
    ------
    Exception
        On every rank, whatever `do` raises on rank 0.
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
        raise failure  # with the place where it came from
    found: T
    found, failure = pickle.loads(sent)
    if failure:
        raise failure
    return found


def _pickled(e: Exception) -> bytes:
    """An error that other ranks can raise: the same if it can be sent."""
    try:
        sent = pickle.dumps((None, e))
        pickle.loads(sent)
    except Exception:
        return pickle.dumps((None, RuntimeError(f"on rank 0: {type(e).__name__}: {e}")))
    return sent
