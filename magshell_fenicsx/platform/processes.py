"""Ranks and processes: work of rank 0 for all ranks, and the cost of a command.

If the work of rank 0 fails, all ranks fail together. A command is run in a separate process, and
its wall time, CPU time and peak memory are measured.

`python3 -m magshell_fenicsx.platform.processes FOLDER MODULE ARGUMENT...` runs a module as `python3
-m` does, and writes the peak memory of this rank to a folder. The peak is the kernel's VmHWM.
getrusage is no substitute: a process inherits the peak of its parent, and the parent of several
ranks gets only the largest.

Ranks are the processes of one run, numbered from 0; a launcher (mpirun) starts them. A collective
function must be called on all of them.
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

from magshell_fenicsx.platform.terminal import LAUNCHER_VARIABLES

if TYPE_CHECKING:
    from mpi4py import MPI


Result = TypeVar("Result")


@dataclass(frozen=True)
class SerialComm:
    """A communicator of one process, which stands for MPI's as long as MPI is not needed."""

    rank: int = 0
    size: int = 1


def world() -> Any:
    """Return the communicator of all ranks.

    A process that no launcher started gets a `SerialComm` until MPI is imported: the import takes
    0.1 s.
    """
    if not LAUNCHER_VARIABLES & os.environ.keys() and "mpi4py.MPI" not in sys.modules:
        return SerialComm()
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
        """The last line of standard error; empty without."""
        return (self.errors.strip().splitlines() or [""])[-1]


@cache
def mpirun_path() -> str | None:
    """Return the path of the launcher of ranks; None if there is none.

    A launcher in the folder of this Python, where PyPI's MPI puts it, is preferred to the system's.
    """
    python_folder = Path(sys.executable).parent
    folders = f"{python_folder}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
    return shutil.which("mpirun", path=folders)


@cache
def mpirun_command(ranks: int) -> tuple[str, ...]:
    """Return the command that starts a number of ranks, even if there are fewer cores.

    Open MPI needs an option for more ranks than cores.
    """
    launcher = mpirun_path() or "mpirun"
    version = subprocess.run(
        [launcher, "--version"], capture_output=True, text=True, check=False
    ).stdout
    options = ("--map-by", ":OVERSUBSCRIBE") if "Open MPI" in version else ()
    return launcher, *options, "-n", str(ranks)


def measure(
    module: str,
    arguments: Sequence[str],
    ranks: int = 1,
    environment: Mapping[str, str] | None = None,
) -> Usage:
    """Run `python3 -m MODULE ARGUMENT...`, wait for its end, and return the resources that it used.

    Each rank has one thread.

    Parameters
    ----------
    module, arguments
        Name of the module, and its arguments.
    ranks
        Number of ranks; mpirun starts more than one.
    environment
        Additional environment variables.
    """
    launcher = mpirun_command(ranks) if ranks > 1 else []
    with TemporaryDirectory() as scratch:
        # this module runs the other one, see `main`, and writes its peak memory into the folder
        command = [
            *launcher,
            sys.executable,
            "-m",
            "magshell_fenicsx.platform.processes",
            scratch,
            module,
            *arguments,
        ]
        # run it, with its output in files
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
            try:  # wait4 also tells the CPU time of the process and its children
                _, status, usage = os.wait4(process.pid, 0)
            except BaseException:
                process.terminate()
                process.wait()
                raise
            wall_s = time.perf_counter() - start
        # what it has used; wait4 has reaped the process, so Popen must not wait for it
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
    """Run a module as `python3 -m` does, and write the peak memory (kB) of this process.

    The arguments of the command line are a folder, the module and its arguments. The file is
    peak.PROCESS in the folder.
    """
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


def on_first_rank(comm: "MPI.Comm", do: Callable[[], Result]) -> Result:
    """Call `do` on rank 0 and return its result on every rank; collective.

    The result must be picklable if there are several ranks.

    Raises
    ------
    Exception
        On every rank, the exception that `do` raises on rank 0.
    """
    if comm.size == 1:
        return do()
    # rank 0 sends a pair of result and error, one of which is None
    pickled, failure = b"", None
    if comm.rank == 0:
        try:
            pickled = pickle.dumps((do(), None))
        except Exception as e:
            failure, pickled = e, _pickled(e)
    pickled = comm.bcast(pickled)
    # rank 0 raises the error itself, with its traceback; the others raise the one that was sent
    if failure:
        raise failure
    result: Result
    result, failure = pickle.loads(pickled)
    if failure:
        raise failure
    return result


def raise_on_all_ranks(comm: "MPI.Comm", do: Callable[[], object]) -> None:
    """Call `do` on every rank, and raise on all ranks if it raises on one; collective.

    Raises
    ------
    Exception
        On a rank where `do` fails its own exception; on the others that of the first such rank.
    """
    failure = None
    try:
        do()
    except Exception as e:
        if comm.size == 1:
            raise
        failure = e
    if comm.size == 1:
        return
    # errors of all ranks in order, empty where there is none; a rank raises its own, or else the
    # first one
    pickled_errors = comm.allgather(_pickled(failure) if failure else b"")
    first_error = next(filter(None, pickled_errors), None)
    if first_error:
        raise failure or pickle.loads(first_error)[1]


def _pickled(e: Exception) -> bytes:
    """Return an error as bytes for other ranks: itself, or its text as a RuntimeError."""
    try:
        sent = pickle.dumps((None, e))
        pickle.loads(sent)  # some errors can be written, but not read again
    except Exception:
        return pickle.dumps((None, RuntimeError(f"on rank 0: {type(e).__name__}: {e}")))
    return sent
