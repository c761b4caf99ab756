"""Starting runs, stopping them in every way, and comparing what they leave."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from command import mpirun, read_path

SAME = ("label", "amplitude", "negative_pivots", "iterations", "factorisations", "mode", "branch")
NUMBERS = ("p_over_pc", "lambda_m", "force", "w_over_h", "w_pole_over_h", "volume_change", "energy")


def start(*arguments: str | Path, ranks: int = 0, size_limit: int = 0) -> subprocess.Popen[str]:
    """Start `magshell ...`; `size_limit` is the largest file that it can write, in bytes."""
    launcher = mpirun(ranks) if ranks else []
    program = ["-m", "magshell_fenicsx"]
    if size_limit:  # MPI itself needs larger files as it begins
        limit = f"resource.setrlimit(resource.RLIMIT_FSIZE, ({size_limit}, {size_limit}))"
        program = [
            "-c",
            f"import resource\nfrom mpi4py import MPI\n{limit}\n"
            "from magshell_fenicsx.__main__ import main\nmain()",
        ]
    command = [*launcher, sys.executable, *program, *map(str, arguments)]
    # mpirun loses lines of stderr where stdout is /dev/null
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for_rows(run: subprocess.Popen[str], out: Path, rows: int) -> None:
    """Wait until path.csv has so many rows, or the run has ended."""
    wait_until(lambda: whole_lines(out).count(b"\n") > rows or run.poll() is not None)


def wait_until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + 120
    while not true():
        assert time.monotonic() < end
        time.sleep(0.002)


def whole_lines(out: Path) -> bytes:
    """path.csv as it is now, without a torn last line."""
    try:
        content = (out / "path.csv").read_bytes()
    except FileNotFoundError:
        return b""
    return content[: content.rfind(b"\n") + 1]


def processes(run: subprocess.Popen[str], ranks: int) -> list[int]:
    """The ranks of a run."""
    if not ranks:
        return [run.pid]
    parents = {
        int(file.parent.name): int(
            re.sub(r".*\) . (\d+) .*", r"\1", file.read_text(), flags=re.DOTALL)
        )
        for file in Path("/proc").glob("[0-9]*/stat")
        if file.exists()
    }
    return sorted(number for number, parent in parents.items() if parent == run.pid)


def kill(run: subprocess.Popen[str], ranks: int) -> None:
    """kill -9 of every rank at once."""
    for number in processes(run, ranks):
        with suppress(ProcessLookupError):  # it has just ended by itself
            os.kill(number, signal.SIGKILL)
    run.wait()


def check_same_path(out: Path, reference: Path) -> None:
    """The same rows in the same order; numbers to 1e-9 of the largest of their column."""
    rows, wanted = read_path(out), read_path(reference)
    assert [row["point"] for row in rows] == [str(i) for i in range(len(wanted))]
    for key in SAME:
        assert [row[key] for row in rows] == [row[key] for row in wanted], key
    for key in NUMBERS:
        a, b = ([float(row[key]) for row in path] for path in (rows, wanted))
        assert a == pytest.approx(b, rel=0, abs=1e-9 * max(map(abs, b)) or 1e-15), key


def check_fields(out: Path) -> None:
    """A file for every row, all of them listed, none unfinished."""
    rows = len(read_path(out))
    names = {f"point_{i:04d}.vtu" for i in range(rows)}
    found = {file.name for file in (out / "fields").iterdir() if not file.name.startswith("mode_")}
    if drawn := {
        name for name in found if name.startswith("outlines_")
    }:  # a source or a body moves
        assert drawn == {f"outlines_{i:04d}.vtp" for i in range(rows)}
        names |= drawn
    assert found == names | {"path.pvd"}
    assert (
        set(re.findall(r'file="(.*?)"', (out / "fields" / "path.pvd").read_text(encoding="utf-8")))
        == names
    )
