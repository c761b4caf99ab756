"""A killed run goes on from there, on another number of ranks, as if nothing had happened."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest
from command import magshell
from conftest import CASES
from interrupted import check_fields, check_same_path, kill, start, wait_for_rows, whole_lines
from mpi4py import MPI

from magshell_fenicsx.output.store.folder import locked_folder
from magshell_fenicsx.output.store.table import read_rows

INDENTATION, BUCKLING = CASES / "pole_indentation.yaml", CASES / "dimple_buckling.yaml"
MERIDIAN = (BUCKLING, "--set=magnetic.lambda_m=0.00184", "--set=mesh.refinement=0.5")
LONG = (INDENTATION, "--set=loading.points=16", "--set=mesh.refinement=0.5")
SOLID = (
    CASES / "solid_indentation.yaml",
    *("--set=shell.radius_to_thickness=20", "--set=mesh.refinement=0.4"),
    *("--set=loading.depth=3", "--set=loading.points=6"),
)
PROGRAMME = (
    CASES / "programme.yaml",
    "--set=symmetry=half",
    "--set=mesh.degree=2",
    "--set=mesh.refinement=0.4",
)
MAGNET = (
    CASES / "magnet_past_strip.yaml",
    "--set=mesh={degree: 2, refinement: 0.3}",
    "--set=loading=[{kind: field, points: 1}, {kind: source, move: [0, 0, 20 mm], points: 6}]",
)
CASE = {"magnet": MAGNET, "meridian": MERIDIAN, "programme": PROGRAMME, "solid": SOLID}


@dataclass(frozen=True)
class Whole:
    """A run that nobody interrupted."""

    case: tuple[str | Path, ...]
    out: Path


@pytest.fixture(scope="module")
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Whole:
    case, out = (*CASE[request.param], "--no-pictures"), tmp_path_factory.mktemp("whole") / "out"
    done = magshell("run", *case, "--out", out)
    assert done.returncode == 0, done.stderr
    return Whole(case, out)


@pytest.mark.slow
@pytest.mark.parametrize("whole", ["solid", "magnet", "programme"], indirect=True)
def test_killed_and_resumed(whole: Whole, tmp_path: Path) -> None:
    """kill -9 on two ranks, and once more on one; resumed on one, a programme that holds a volume
    on three.
    """
    out = tmp_path / "out"
    steps = [row["step"] for row in read_rows(whole.out / "path.csv")]
    rows = steps.index(3) + 2 if 3 in steps else 3
    run = start("run", *whole.case, "--out", out, ranks=2)
    wait_for_rows(run, out, rows)
    kill(run, 2)
    seen = whole_lines(out)
    assert seen.count(b"\n") > rows
    assert not (out / "summary.json").exists()
    again = start("run", *whole.case, "--out", out, "--resume")
    wait_for_rows(again, out, rows + 1)
    kill(again, 0)
    check_goes_on_as(whole, out, seen, ranks=3 if 3 in steps else 1)


def check_goes_on_as(whole: Whole, out: Path, seen: bytes, ranks: int = 1) -> None:
    """Resumed, a run has a whole one's rows and files. What was known is not computed again."""
    done = magshell("run", *whole.case, "--out", out, "--resume", ranks=ranks)
    assert done.returncode == 0, done.stderr
    assert (out / "path.csv").read_bytes().startswith(seen)
    check_same_path(out, whole.out)
    check_fields(out)
    assert {file.name for file in out.iterdir()} == {file.name for file in whole.out.iterdir()}
    a, b = (
        json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        for folder in (out, whole.out)
    )
    assert b["replayed"] == 0 < a["replayed"]
    assert a["factorisations"] < b["factorisations"]
    assert a["knockdown"] == pytest.approx(b["knockdown"], rel=1e-9)


@pytest.mark.parametrize("whole", ["meridian"], indirect=True)
def test_torn_files(whole: Whole, tmp_path: Path) -> None:
    """After kill -9 half a row and half an entry, as a crash of the machine leaves them, are cut
    off.
    """
    out = tmp_path / "out"
    run = start("run", *whole.case, "--out", out)
    wait_for_rows(run, out, 4)
    kill(run, 0)
    seen = whole_lines(out)
    (out / "path.csv").write_bytes(seen[:-9])
    entries = (out / "checkpoint").read_bytes()
    (out / "checkpoint").write_bytes(entries[:-100])
    check_goes_on_as(whole, out, seen[: seen[:-1].rfind(b"\n") + 1])


@pytest.mark.telling
@pytest.mark.parametrize("whole", ["meridian"], indirect=True)
def test_complete_already(whole: Whole) -> None:
    before = (whole.out / "summary.json").stat()
    done = magshell("run", *whole.case, "--out", whole.out, "--resume")
    assert done.returncode == 0
    assert done.stdout.startswith("complete already: ")
    assert (whole.out / "summary.json").stat().st_mtime_ns == before.st_mtime_ns
    done = magshell("run", *whole.case, "--set=mesh.degree=3", "--out", whole.out, "--resume")
    assert done.returncode == 2
    assert "mesh.degree is 4 there and 3 here" in done.stderr


def test_another_case(tmp_path: Path, no_pictures: None) -> None:
    """And a run that was stopped keeps its checkpoint."""
    assert magshell("run", *MERIDIAN, "--out", tmp_path, "--time-limit", 0).returncode == 3
    said = (
        f"--resume: {tmp_path} belongs to another run: shell.radius_to_thickness is 90.0 there "
        "and 100.0 here"
    )
    other = (*MERIDIAN, "--set=shell.radius_to_thickness=100")
    for ranks in (0, 2):
        done = magshell("run", *other, "--out", tmp_path, "--resume", ranks=ranks)
        assert done.returncode == 2
        assert done.stderr.count(said) == 1
        assert "Traceback" not in done.stderr
        assert (tmp_path / "checkpoint").exists()


def test_nothing_to_resume(tmp_path: Path) -> None:
    done = magshell("run", INDENTATION, "--out", tmp_path, "--resume")
    assert done.returncode == 2
    assert done.stderr == f"--resume: {tmp_path} holds no checkpoint; run without --resume\n"
    nowhere = tmp_path / "nowhere"
    assert magshell("run", INDENTATION, "--out", nowhere, "--resume").returncode == 2
    assert not nowhere.exists()


def test_one_run_at_a_time(tmp_path: Path) -> None:
    """A run that still writes to the folder, such as ranks that outlive mpirun, is not joined by
    another.
    """
    with locked_folder(tmp_path, MPI.COMM_SELF, make=False):
        second = magshell("run", *LONG, "--out", tmp_path)
    assert second.returncode == 2
    assert second.stderr == f"--out {tmp_path}: cannot be written: another run is writing to it\n"
    assert list(tmp_path.iterdir()) == []
