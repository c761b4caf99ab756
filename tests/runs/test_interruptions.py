"""Signals, a time limit, a full disk, a lost rank: a clear message, readable files, and the run can
go on.
"""

import json
import os
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import pyvista
from command import magshell, read_path
from conftest import CASES, draw_nothing
from interrupted import check_fields, check_same_path, processes, start, wait_for_rows, whole_lines
from mpi4py import MPI

from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.table import COLUMNS, PathTable
from magshell_fenicsx.runs.running import Interrupted, Watch

LONG = (CASES / "pole_indentation.yaml", "--set=loading.points=30", "--set=mesh.refinement=0.5")
# of a surface the checkpoint soon is larger than a file of fields
SURFACE = (
    CASES / "pole_indentation.yaml",
    *(
        f"--set={key}"
        for key in ("loading.points=40", "mesh.degree=3", "mesh.refinement=0.2", "symmetry=half")
    ),
)
GOES_ON = "; the results so far are in {out}/, and --resume continues from there\n"


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as undrawn:
        draw_nothing(undrawn)
        assert magshell("run", *LONG, "--out", out).returncode == 0
    return out


def check_goes_on(out: Path, reference: Path, case: tuple[Path | str, ...] = LONG) -> None:
    """The files are readable and the run can be finished."""
    rows = read_path(out)
    assert [row["point"] for row in rows] == [str(i) for i in range(len(rows))]
    assert whole_lines(out) == (out / "path.csv").read_bytes()
    for file in (out / "fields").glob("*.vtu"):
        assert pyvista.read(file).n_points
    done = magshell("run", *case, "--out", out, "--resume")
    assert done.returncode == 0, done.stderr
    check_same_path(out, reference)
    check_fields(out)
    assert not (out / "checkpoint").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("ranks", "number"), [(0, signal.SIGINT), (2, signal.SIGUSR1)])
def test_signal(
    tmp_path: Path, reference: Path, no_pictures: None, ranks: int, number: signal.Signals
) -> None:
    """mpirun passes SIGUSR1 to all; one rank of two is stopped below, and a hang-up is obeyed or
    not.
    """
    out = tmp_path / "out"
    run = start("run", *LONG, "--out", out, ranks=ranks)
    wait_for_rows(run, out, 3)
    os.kill(run.pid, number)
    said = run.communicate()[1]
    assert run.returncode == 3
    if not ranks:  # mpirun may lose the last line of a job that fails; the summary has it
        assert f"stopped early: interrupted by {number.name}" + GOES_ON.format(out=out) in said
    assert "Traceback" not in said
    assert 3 <= len(read_path(out)) < len(read_path(reference))
    assert (
        json.loads((out / "summary.json").read_text(encoding="utf-8"))["stopped"]
        == f"interrupted by {number.name}"
    )
    check_goes_on(out, reference)


def test_a_signal_within_a_solve(
    tmp_path: Path, reference: Path, no_pictures: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a large shell a solve takes minutes: it ends before the next tangent is factored."""
    checks, own_check = list[None](), Watch.check_within_solve

    def check(watch: Watch) -> None:
        checks.append(None)
        if len(checks) == 8:
            signal.raise_signal(signal.SIGTERM)
        own_check(watch)

    monkeypatch.setattr(Watch, "check_within_solve", check)
    out = tmp_path / "out"
    done = magshell("run", *LONG, "--out", out)
    assert (done.returncode, len(checks)) == (3, 8)
    assert "stopped early: interrupted by SIGTERM" + GOES_ON.format(out=out) in done.stderr
    check_goes_on(out, reference)


@pytest.mark.slow
def test_stiff_motion(tmp_path: Path) -> None:
    """A row that would take hours ends at the next step in time, by a signal to one rank or the
    time limit.
    """
    case, out = tmp_path / "case.yaml", tmp_path / "out"
    case.write_text(
        "shell: {geometry: hemisphere, radius_to_thickness: 20, poisson_ratio: 0.3}\n"
        "boundary: {equator: clamped}\n"
        'loading: {kind: time, duration: 1, history: {pressure: "exp(1000*t)"}}\n'
        "mesh: {refinement: 0.5, degree: 3}\n"
    )
    run = start("run", case, "--out", out, ranks=2)
    wait_for_rows(run, out, 2)
    os.kill(processes(run, 2)[-1], signal.SIGTERM)
    run.communicate(timeout=20)
    assert run.returncode == 3
    rows = read_path(out)
    assert (
        json.loads((out / "summary.json").read_text(encoding="utf-8"))["stopped"]
        == "interrupted by SIGTERM"
    )
    again = start("run", case, "--out", out, "--resume", "--time-limit", "3", ranks=2)
    again.communicate(timeout=40)
    assert again.returncode == 3
    assert (
        "time limit of 3 s"
        in json.loads((out / "summary.json").read_text(encoding="utf-8"))["stopped"]
    )
    assert read_path(out) == rows


def test_second_interrupt_stops_at_once() -> None:
    """The first only has the next check stop the run; afterwards signals do again what they did."""
    found = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # background jobs begin with SIGINT ignored
    with Watch(MPI.COMM_SELF, 0.0, None, signals=True) as watch:
        watch.check()
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(Interrupted, match="SIGINT"):
            watch.check()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.signal(signal.SIGINT, found) is signal.default_int_handler


def test_nohup_is_obeyed() -> None:
    """A hang-up that was ignored at the start stays so, though PETSc takes it; else it stops the
    run.
    """
    found = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Watch(MPI.COMM_SELF, 0.0, None, signals=True) as watch:
            signal.raise_signal(signal.SIGHUP)
            watch.check()
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        with Watch(MPI.COMM_SELF, 0.0, None, signals=True) as watch:
            signal.raise_signal(signal.SIGHUP)
            with pytest.raises(Interrupted, match="SIGHUP"):
                watch.check()
    finally:
        signal.signal(signal.SIGHUP, found or signal.SIG_DFL)


def test_time_limit(tmp_path: Path, reference: Path, no_pictures: None) -> None:
    done = magshell("run", *LONG, "--out", tmp_path, "--time-limit", 0)
    assert done.returncode == 3
    assert done.stderr == "stopped early: interrupted by the time limit of 0 s" + GOES_ON.format(
        out=tmp_path
    )
    assert [row["label"] for row in read_path(tmp_path)] == ["start"]
    said = "The run stopped early, after 1 point: interrupted by the time limit of 0 s."
    assert said in (tmp_path / "report.html").read_text(encoding="utf-8")
    check_goes_on(tmp_path, reference)
    assert "stopped early" not in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_full_disk(tmp_path: Path) -> None:
    """Files may only become so large: one message, all ranks leave, nothing is torn."""
    out, whole = tmp_path / "out", tmp_path / "whole"
    assert magshell("run", *SURFACE, "--out", whole).returncode == 0
    run = start("run", *SURFACE, "--out", out, ranks=2, size_limit=300_000)
    said = run.communicate(timeout=60)[1]
    assert run.returncode == 3
    message = f"stopped early: {out}/checkpoint cannot be written: File too large" + GOES_ON.format(
        out=out
    )
    assert (
        said.count(message) <= 1
    )  # mpirun may lose the last line of a job that fails; the summary has it
    assert "Traceback" not in said
    assert 5 < len(read_path(out)) < len(read_path(whole))
    assert (
        "checkpoint cannot be written"
        in json.loads((out / "summary.json").read_text(encoding="utf-8"))["stopped"]
    )
    check_goes_on(out, whole, SURFACE)


@pytest.mark.slow
def test_full_disk_at_the_first_field(tmp_path: Path, reference: Path) -> None:
    run = start("run", *LONG, "--out", tmp_path, size_limit=100_000)
    said = run.communicate(timeout=60)[1]
    message = f"stopped early: {tmp_path}/fields/point_0000.vtu cannot be written: File too large"
    assert (run.returncode, said) == (3, message + GOES_ON.format(out=tmp_path))
    assert list((tmp_path / "fields").iterdir()) == []
    check_goes_on(tmp_path, reference)


@pytest.mark.slow
def test_no_room_for_pictures(tmp_path: Path) -> None:
    """The summary is there without one, and resuming draws it."""
    case = (CASES / "clamped_plate.yaml", "--set=mesh.degree=3", "--set=mesh.refinement=0.1")
    run = start("run", *case, "--out", tmp_path, size_limit=70_000)
    said = run.communicate(timeout=60)[1]
    message = f"stopped early: {tmp_path}/shell.png cannot be written: File too large"
    assert (run.returncode, said) == (3, message + GOES_ON.format(out=tmp_path))
    assert json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["points"] == len(
        read_path(tmp_path)
    )
    assert [file.name for file in tmp_path.glob("*.png")] == ["curve.png"]
    assert magshell("run", *case, "--out", tmp_path, "--resume").returncode == 0
    assert (tmp_path / "shell.png").stat().st_size > 10_000
    assert not (tmp_path / "checkpoint").exists()


def test_rows_and_files_are_written_whole_or_not(tmp_path: Path) -> None:
    """A full disk in the middle of a row or a file: what was there stays as it was."""
    file, row = tmp_path / "path.csv", dict.fromkeys(COLUMNS, 0.1)
    table = PathTable(file)
    table.write({**row, "point": 0})
    before = file.read_bytes()
    with largest_file(len(before) + 10), pytest.raises(OSError, match="File too large") as e:
        table.write({**row, "point": 1})
    assert e.value.filename == str(file)
    assert file.read_bytes() == before
    table.write({**row, "point": 1})
    assert [row["point"] for row in read_path(tmp_path)] == ["0", "1"]
    whole = tmp_path / "summary.json"
    write_whole(whole, b"old")
    with largest_file(10), pytest.raises(OSError, match="File too large"):
        write_whole(whole, b"new and longer")
    assert whole.read_bytes() == b"old"
    assert sorted(f.name for f in tmp_path.iterdir()) == ["path.csv", "summary.json"]


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file can become larger inside; stands for a full disk."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


@pytest.mark.slow
def test_lost_rank(tmp_path: Path, reference: Path) -> None:
    """mpirun says so and ends the others."""
    out = tmp_path / "out"
    run = start("run", *LONG, "--out", out, ranks=2)
    wait_for_rows(run, out, 3)
    os.kill(processes(run, 2)[-1], signal.SIGKILL)
    said = run.communicate()[1]
    assert run.returncode not in (0, 2, 3)
    assert "signal 9" in said
    assert len(read_path(out)) >= 3
    check_goes_on(out, reference)
