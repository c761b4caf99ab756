"""What happens on one rank alone: it reads nothing itself, and its errors end all ranks."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from command import mpirun
from conftest import CASES

PROGRAM = """
import pathlib, sys
from mpi4py import MPI
mode, rank, *words = sys.argv[1:]
import magshell_fenicsx.case.planner as planner  # on all ranks: PETSc begins on them together
if MPI.COMM_WORLD.rank == int(rank):
    from magshell_fenicsx.platform import input_files
    if mode == "unreadable":
        def refused(file, largest=0):
            raise PermissionError(13, "Permission denied", str(file))
        input_files.read_bounded = refused
        import magshell_fenicsx.input.source as source
        source.read_bounded = refused
    if mode == "another":
        words += ["--set", "shell.poisson_ratio=0.31"]
    if mode == "alone":
        from magshell_fenicsx.input.source import CaseError
        def make_problem(*arguments, **others):
            raise CaseError("mesh: only here")
        planner.make_problem = make_problem
sys.argv = ["magshell", *words]
from magshell_fenicsx.cli import main
main()
"""
QUICK = [
    "--set",
    "mesh.degree=2",
    "--set",
    "loading.factor=0.01",
    "--set",
    "loading.points=1",
    "--no-pictures",
]


def done(mode: str, rank: int, *words: str | Path) -> subprocess.CompletedProcess[str]:
    """A command on two ranks, one of which is not like the other; a timeout ends what hangs."""
    command = [*mpirun(2), sys.executable, "-c", PROGRAM, mode, str(rank), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.parametrize("mode", ["unreadable", pytest.param("another", marks=pytest.mark.slow)])
def test_rank_0_reads_for_all(tmp_path: Path, mode: str) -> None:
    """The case, its settings and its mesh file: the run is that of rank 0 alone."""
    ended = done(mode, 1, "run", CASES / "bracket.yaml", *QUICK, "--out", tmp_path)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "The run reached its target" in ended.stdout


@pytest.mark.parametrize("rank", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_an_error_of_one_rank_ends_all(tmp_path: Path, rank: int) -> None:
    """With its message, the exit code of a user's error, and in seconds."""
    start = time.monotonic()
    ended = done("alone", rank, "run", CASES / "bracket.yaml", *QUICK, "--out", tmp_path)
    assert ended.returncode == 2
    assert ended.stderr.count(f"rank {rank}: ") == 1
    assert "mesh: only here" in ended.stderr
    assert time.monotonic() - start < 90
