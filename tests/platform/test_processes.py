"""An error of rank 0 is one of all ranks: none waits for a rank that has left."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from command import importing_environment
from conftest import CASES
from many import sweep
from mpi4py import MPI

import magshell_fenicsx as ms
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.output.store.checkpoint import Checkpoint
from magshell_fenicsx.output.store.durable import Damaged
from magshell_fenicsx.output.store.folder import DiskError, access_disk, prepare_folder
from magshell_fenicsx.platform.processes import on_first_rank, raise_on_all_ranks
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.public import Scene
from magshell_fenicsx.runs.files import AlreadyComplete

COMM = MPI.COMM_WORLD
PLATE = CASES / "clamped_plate.yaml"


class _Unsendable(Exception):
    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} and {two}")


def failing(error: Exception) -> Callable[..., Any]:
    def fail(*arguments: object) -> None:
        raise error

    return fail


@contextmanager
def raised(kind: type[Exception], said: str) -> Iterator[None]:
    """What all ranks raise; then they meet."""
    with pytest.raises(kind, match=said):
        yield
    COMM.Barrier()


def what_rank_0_gets() -> None:
    found = on_first_rank(COMM, lambda: COMM.rank + 7)
    assert found == 7
    assert access_disk(COMM, lambda: {"rank": COMM.rank}) == {"rank": 0}


def any_error() -> None:
    for error in (
        ValueError("a bug"),
        KeyError("a bug"),
        AlreadyComplete({"a bug": 1}),
        MeshError("a bug"),
    ):
        for share in (on_first_rank, access_disk):
            with raised(type(error), str(error)):
                share(COMM, failing(error))
    with raised(ValueError, "a bug"):
        prepare_folder(Path("nowhere"), COMM, failing(ValueError("a bug")))


def files() -> None:
    with raised(DiskError, "there cannot be written: No space"):
        access_disk(COMM, failing(OSError(28, "No space", "there")))
    with raised(DiskError, "there cannot be read: No space"):
        access_disk(COMM, failing(OSError(28, "No space", "there")), "cannot be read")


def what_cannot_be_sent() -> None:
    with raised(RuntimeError if COMM.rank else _Unsendable, "1 and 2"):
        on_first_rank(COMM, failing(_Unsendable(1, 2)))
    with raised(Exception, "local"):
        on_first_rank(COMM, lambda: lambda: None)


def what_one_rank_cannot() -> None:
    """All ranks raise, also where the first has no error."""
    with raised(OSError, "of the last"):
        raise_on_all_ranks(
            COMM, failing(OSError("of the last")) if COMM.rank == COMM.size - 1 else lambda: None
        )
    raise_on_all_ranks(COMM, lambda: None)


def reads() -> None:
    space = Scene(ms.Case.load(PLATE)).model.V
    with raised(DiskError, "nowhere/checkpoint cannot be read: No such file"):
        Checkpoint(Path("nowhere/checkpoint"), space, COMM)


def meshes() -> None:
    with (
        patch.object(Problem, "triangulated", failing(RuntimeError("gmsh has a bug"))),
        raised(RuntimeError, "gmsh"),
    ):
        Scene(ms.Case.load(CASES / "indentation.yaml"), COMM)


def a_folder(out: Path) -> None:
    with (
        patch("magshell_fenicsx.output.pictures.plot.draw", failing(RuntimeError("a bug"))),
        raised(RuntimeError, "a bug"),
    ):
        ms.run(ms.Case.load(PLATE), out / "run", COMM)
    on_first_rank(COMM, (out / "run" / "mesh.json").mkdir)
    case = ms.Case.load(PLATE, ["mesh={tolerance: 0.01}"])
    with (
        patch("magshell_fenicsx.runs.running.open_folder"),
        raised(Damaged, "mesh.json: is damaged: Is a directory"),
    ):
        ms.run(case, out / "run", COMM, resume=True)
    with (
        patch("magshell_fenicsx.studies.store.OutcomeStore.outcome", failing(KeyError("a bug"))),
        raised(KeyError, "a bug"),
    ):
        sweep(PLATE, ["shell.poisson_ratio=0.3,0.4"], out=out / "sweep", comm=COMM)


OF_ERRORS = (what_rank_0_gets, any_error, files, what_cannot_be_sent, what_one_rank_cannot)
OF_SCENES = (reads, meshes)


@pytest.mark.parametrize("asked", ["errors", pytest.param("scenes", marks=pytest.mark.slow)])
def test_every_rank_gets_what_the_first_does(asked: str, tmp_path: Path) -> None:
    """Where a rank would wait for ever, a timeout ends the test."""
    launcher = ["mpirun", "--map-by", ":OVERSUBSCRIBE", "-n", "2", sys.executable]
    environment = importing_environment()
    done = subprocess.run(
        [*launcher, __file__, asked, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("done") == 2


def test_a_bug_in_pictures_is_told_at_the_end(tmp_path: Path) -> None:
    """When all numbers are on disk."""
    case = ms.Case.load(PLATE)
    with (
        patch("magshell_fenicsx.output.pictures.plot.draw", failing(RuntimeError("a bug"))),
        pytest.raises(RuntimeError, match="bug"),
    ):
        ms.run(case, tmp_path)
    assert {"path.csv", "summary.json", "fields"} <= {file.name for file in tmp_path.iterdir()}


if __name__ == "__main__":
    for check in OF_ERRORS if sys.argv[1] == "errors" else OF_SCENES:
        check()
    if sys.argv[1] == "scenes":
        a_folder(Path(sys.argv[2]))
    print("done", flush=True)
