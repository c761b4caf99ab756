"""Work of rank 0 for all ranks; a command in a separate process, with its wall time, CPU time and
peak memory.

If the work of rank 0 fails, all ranks fail together.

`python3 -m magshell_fenicsx.platform.processes FOLDER MODULE ARGUMENT...` runs a module as `python3
-m` does, and writes the peak memory of this rank to a folder. The peak is the kernel's VmHWM.
getrusage is no substitute: a process inherits the peak of its parent, and the parent of several
ranks gets only the largest.
"""

import os
import pickle
import re
import runpy
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeVar

from magshell_fenicsx.platform.terminal import LAUNCHERS

if TYPE_CHECKING:
    from mpi4py import MPI


T = TypeVar("T")


@dataclass(frozen=True)
class Alone:
    """What a process without others has of a communicator, before it needs MPI."""

    rank: int = 0
    size: int = 1


def world() -> Any:
    """All ranks.

    A process that no launcher started has `Alone` until MPI is imported, which takes 0.1 s.
    """
    if not LAUNCHERS & os.environ.keys() and "mpi4py.MPI" not in sys.modules:
        return Alone()
    from mpi4py import MPI

    return MPI.COMM_WORLD


@dataclass(frozen=True)
class Usage:
    """The resources that a process used.

    Attributes
    ----------
    code
        Exit code.
    wall_s, cpu_s
        Times of the whole process; CPU seconds are summed over ranks and their child processes.
    peak_mb
        Peak resident memory (2^20 bytes), summed over the ranks; None if a rank died.
    output, errors
        Standard output and standard error.
    """

    code: int
    wall_s: float
    cpu_s: float
    peak_mb: float | None
    output: str
    errors: str

    @property
    def last_error(self) -> str:
        """The last line of its errors; empty without."""
        return (self.errors.strip().splitlines() or [""])[-1]


@cache
def mpirun_itself() -> str | None:
    """The launcher of ranks: that beside this Python, as PyPI's MPI has it, or that of the system;
    None without.
    """
    beside = Path(sys.executable).parent
    return shutil.which("mpirun", path=f"{beside}{os.pathsep}{os.environ.get('PATH', os.defpath)}")


@cache
def mpirun(ranks: int) -> tuple[str, ...]:
    """The words that start so many ranks, even if there are fewer cores; Open MPI must be told
    that.
    """
    launcher = mpirun_itself() or "mpirun"
    about = subprocess.run(
        [launcher, "--version"], capture_output=True, text=True, check=False
    ).stdout
    return (
        launcher,
        *(("--map-by", ":OVERSUBSCRIBE") if "Open MPI" in about else ()),
        "-n",
        str(ranks),
    )


def measure(
    module: str,
    arguments: Sequence[str],
    ranks: int = 1,
    environment: Mapping[str, str] | None = None,
) -> Usage:
    """Run `python3 -m MODULE ARGUMENT...` and wait for it; one thread per rank.

    Parameters
    ----------
    ranks
        Number of ranks; mpirun starts more than one.
    environment
        Additional environment variables.
    """
    launcher = mpirun(ranks) if ranks > 1 else []
    with TemporaryDirectory() as scratch:
        command = [
            *launcher,
            sys.executable,
            "-m",
            "magshell_fenicsx.platform.processes",
            scratch,
            module,
            *arguments,
        ]
        output, errors = Path(scratch) / "output", Path(scratch) / "errors"
        with output.open("wb") as stdout, errors.open("wb") as stderr:
            start = time.perf_counter()
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
                env={**os.environ, "OMP_NUM_THREADS": "1", **(environment or {})},
            )
            try:
                _, status, usage = os.wait4(process.pid, 0)
            except BaseException:
                process.terminate()
                process.wait()
                raise
            wall_s = time.perf_counter() - start
        # wait4 has reaped the process, so Popen must not wait for it
        process.returncode = os.waitstatus_to_exitcode(status)
        peaks = [int(file.read_text(encoding="utf-8")) for file in Path(scratch).glob("peak.*")]
        return Usage(
            code=process.returncode,
            wall_s=wall_s,
            cpu_s=usage.ru_utime + usage.ru_stime,
            peak_mb=sum(peaks) / 1024 if len(peaks) == ranks else None,
            output=output.read_text(encoding="utf-8", errors="replace"),
            errors=errors.read_text(encoding="utf-8", errors="replace"),
        )


def main() -> None:
    folder, module, *arguments = sys.argv[1:]
    sys.argv = [module, *arguments]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    finally:
        status = Path("/proc/self/status").read_text(encoding="utf-8")
        peak = re.search(r"^VmHWM:\s*(\d+) kB$", status, re.MULTILINE)
        if peak:
            (Path(folder) / f"peak.{os.getpid()}").write_text(peak[1], encoding="utf-8")


if __name__ == "__main__":
    main()


def from_first(comm: "MPI.Comm", do: Callable[[], T]) -> T:
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
    result: T
    result, failure = pickle.loads(sent)
    if failure:
        raise failure
    return result


def raised_by_all(comm: "MPI.Comm", do: Callable[[], object]) -> None:
    """Call `do` on every rank; collective.

    Raises
    ------
    Exception
        On every rank, the exception of the first rank where `do` raises one; there its own.
    """
    own = None
    try:
        do()
    except Exception as e:
        if comm.size == 1:
            raise
        own = e
    for sent in comm.allgather(_pickled(own) if own else b"") if comm.size > 1 else ():
        if sent:
            raise own or pickle.loads(sent)[1]


def _pickled(e: Exception) -> bytes:
    """An error for the other ranks: the same one if it can be pickled."""
    try:
        sent = pickle.dumps((None, e))
        pickle.loads(sent)
    except Exception:
        return pickle.dumps((None, RuntimeError(f"on rank 0: {type(e).__name__}: {e}")))
    return sent
