"""The folder that results go to."""

from collections.abc import Callable
from pathlib import Path

from mpi4py import MPI

from magshell_fenicsx.case.source import CaseError


def prepare_folder(out: Path, comm: MPI.Comm, make: Callable[[Path], None]) -> Path:
    """Let rank 0 make a folder ready, and tell all ranks if it cannot.

    Raises
    ------
    CaseError
        On every rank, if the folder cannot be made or written to.
    """
    error = None
    if comm.rank == 0:
        try:
            make(out)
        except OSError as e:
            error = f"--out {out}: cannot be written: {e.strerror}"
    error = comm.bcast(error)
    if error:
        raise CaseError(error)
    return out
