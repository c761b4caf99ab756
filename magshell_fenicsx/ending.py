"""How a command ends: messages of rank 0 and exit codes."""

import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.platform import terminal
from magshell_fenicsx.platform.kept import UnsafeCache
from magshell_fenicsx.platform.plain import typer

INVALID, STOPPED = 2, 3
FAILED = 32101  # tag of the messages between ranks that fail
PATIENCE = 5.0  # s in which an error of all ranks reaches the last of them
DELIVERED = 0.2  # s in which a message is on its way to the terminal
UNWRITTEN = "kernels cannot be compiled into"


def world() -> Any:
    """All ranks."""
    from mpi4py import MPI

    return MPI.COMM_WORLD


def print_line(line: str) -> None:
    if world().rank == 0:
        with suppress(ValueError):  # elsewhere than in the main thread
            signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # again: PETSc has taken it if it was imported since `main`
        terminal.print_line(line)


def failure(message: str, code: int) -> typer.Exit:
    """Print the message of an error once, and return the end of this rank; ends all if the others have no error."""
    comm = world()
    if comm.size > 1 and not _all_fail(comm):
        print(f"rank {comm.rank}: {message}", file=sys.stderr, flush=True)
        time.sleep(DELIVERED)
        comm.Abort(code)  # the other ranks would wait for this one for ever
    if comm.rank:
        return typer.Exit()  # mpirun ends the job at the first failing rank, and may lose the message of rank 0
    with suppress(OSError):  # a full disk: the exit code says it
        print(message, file=sys.stderr, flush=True)
    return typer.Exit(code)


def _all_fail(comm: Any) -> bool:
    """Whether all ranks come here, as they do with an error of all, before those that have come lose patience."""
    from mpi4py import MPI

    others, end = [rank for rank in range(comm.size) if rank != comm.rank], time.monotonic() + PATIENCE
    for rank in others:
        comm.Isend(bytearray(1), rank, FAILED)
    came = [comm.Irecv(bytearray(1), rank, FAILED) for rank in others]  # no collective: others may be in one
    while not MPI.Request.Testall(came):
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


def refuse_lost() -> None:
    """End a command whose only result is what it prints, if that was not written."""
    if terminal.lost:
        raise failure(f"stopped early: {terminal.lost[0]}", STOPPED)


@contextmanager
def exit_codes(invalid: type[Exception] = CaseError, stopped: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Turn an invalid input (`CaseError` and `invalid`) or an early stop into a message and its exit code.

    An early stop is also a kernel that cannot be written, for which dolfinx raises the same on all ranks.
    """
    try:
        yield
    except (CaseError, UnsafeCache, invalid) as e:
        raise failure(str(e), INVALID) from None
    except stopped as e:
        raise failure(f"stopped early: {e}", STOPPED) from None
    except RuntimeError as e:
        if UNWRITTEN in str(e) or (world().rank and "Failed just-in-time compilation" in str(e)):
            raise failure(f"stopped early: {str(e)[str(e).find(UNWRITTEN) :]}", STOPPED) from None
        raise
