"""The output folder: making it, locking it, and disk access through rank 0."""

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, TypeVar

from mpi4py import MPI

from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.platform.first import from_first

T = TypeVar("T")


class DiskError(RuntimeError):
    """A file could not be written or read; the message has its name and the reason."""


def given_folder(out: Path | str) -> Path:
    """The folder that a user names.

    Raises
    ------
    CaseError
        If the name is empty, as that of a variable which is not set: the working folder is `.`.
    """
    if out == "":
        raise CaseError("--out: is empty; give the name of a folder, . for the working folder")
    return Path(out)


def prepare_folder(out: Path, comm: MPI.Comm, make: Callable[[Path], None]) -> Path:
    """Let rank 0 prepare a folder; collective.

    Raises
    ------
    CaseError
        On every rank, if the folder cannot be made or written to.
    """

    def made() -> Path:
        try:
            make(out)
        except OSError as e:
            raise CaseError(f"--out {out}: cannot be written: {e.strerror}") from None
        return out

    return from_first(comm, made)


@contextmanager
def held_folder(out: Path, comm: MPI.Comm, make: bool) -> Iterator[None]:
    """Lock a folder against other runs inside `with`; ranks of a killed mpirun may still be writing.

    Parameters
    ----------
    make
        Whether to create a missing folder.

    Raises
    ------
    CaseError
        On every rank, if the folder cannot be made, or a run is writing to it.
    """
    number: list[int] = []

    def hold(folder: Path) -> None:
        if make:
            folder.mkdir(parents=True, exist_ok=True)
        number.append(os.open(folder, os.O_RDONLY))
        try:
            fcntl.flock(number[0], fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BlockingIOError(0, "another run is writing to it") from None
        except OSError:
            pass  # a file system without locks

    try:
        prepare_folder(out, comm, hold)
        yield
    finally:
        for n in number:
            os.close(n)


def by_first(
    comm: MPI.Comm, do: Callable[[], T], failed: Literal["cannot be written", "cannot be read"] = "cannot be written"
) -> T:
    """Let rank 0 write or read; return its result on every rank, see `from_first`. Collective.

    Raises
    ------
    DiskError
        On every rank, for instance if the disk is full.
    """

    def done() -> T:
        try:
            return do()
        except OSError as e:
            raise DiskError(f"{e.filename or 'the results'} {failed}: {e.strerror or e}") from e

    return from_first(comm, done)
