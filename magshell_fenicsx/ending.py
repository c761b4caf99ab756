"""How a command ends: messages of rank 0 and exit codes."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.platform.plain import typer

INVALID, STOPPED = 2, 3


def world() -> Any:
    """All ranks."""
    from mpi4py import MPI

    return MPI.COMM_WORLD


def print_line(line: str) -> None:
    if world().rank == 0:
        with suppress(ValueError):  # elsewhere than in the main thread
            signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # again: PETSc has taken it if it was imported since `main`
        print(line, flush=True)


def failure(message: str, code: int) -> typer.Exit:
    if world().rank:
        return typer.Exit()  # mpirun ends the job at the first failing rank, and may lose the message of rank 0
    print(message, file=sys.stderr, flush=True)
    return typer.Exit(code)


@contextmanager
def exit_codes(invalid: type[Exception] = CaseError, stopped: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Turn an invalid input (`CaseError` and `invalid`) or an early stop into a message and its exit code."""
    try:
        yield
    except (CaseError, invalid) as e:
        raise failure(str(e), INVALID) from None
    except stopped as e:
        raise failure(f"stopped early: {e}", STOPPED) from None
