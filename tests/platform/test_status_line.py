"""The live line: at the foot of a terminal and nowhere else, gone when the run is over."""

import io
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command import started
from conftest import CASES

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.platform import terminal
from magshell_fenicsx.platform.terminal import LAUNCHER_VARIABLES, live_line
from magshell_fenicsx.quantities.quantity import DISTANCE
from magshell_fenicsx.quantities.registry import Sizes
from magshell_fenicsx.runs.status import PathEnd, RunProgress, time_left

QUICK = (CASES / "pole_indentation.yaml", "--set=mesh.degree=3", "--set=mesh.refinement=0.5")


class Terminal:
    """A process on a terminal of its own: what it wrote, and what is seen of it."""

    def __init__(self, *arguments: str | Path, launcher: tuple[str, ...] = ()) -> None:
        self._end, other = pty.openpty()
        command = [*launcher, sys.executable, "-m", "magshell_fenicsx", *map(str, arguments)]
        environment = os.environ | {"TERM": "xterm", "COLUMNS": "200"}
        found = signal.signal(
            signal.SIGINT, signal.default_int_handler
        )  # background jobs begin with SIGINT ignored
        self.process = subprocess.Popen(command, stdout=other, stderr=other, env=environment)
        signal.signal(signal.SIGINT, found)
        os.close(other)
        self.written = ""

    def read(self, until: Callable[[str], bool] = lambda written: False) -> None:
        """Read on until what was written is as wanted, or to the end."""
        latest = time.monotonic() + 120
        with suppress(OSError):  # the other end is closed
            while not until(self.written):
                assert time.monotonic() < latest
                if select.select([self._end], [], [], 0.1)[0]:
                    self.written += os.read(self._end, 65536).decode()
        if not until(self.written):
            self.process.wait()
            os.close(self._end)

    @property
    def screen(self) -> list[str]:
        """The lines that are left; knows carriage returns and the erasure of a line, and no other
        escape.
        """
        lines, place = [""], 0
        for piece in re.findall(r"\r|\n|\x1b\[K|[^\r\n\x1b]+|\x1b", self.written):
            if piece == "\r":
                place = 0
            elif piece == "\n":
                lines.append("")
                place = 0
            elif piece == "\x1b[K":
                lines[-1] = lines[-1][:place]
            else:
                assert piece != "\x1b"
                lines[-1] = lines[-1][:place] + piece + lines[-1][place + len(piece) :]
                place += len(piece)
        return lines

    @property
    def feet(self) -> list[str]:
        """Lines that were rewritten."""
        return re.findall(r"\r\x1b\[K([^\r\n]+)(?=\r\x1b)", self.written)


@pytest.mark.slow
def test_terminal_and_pipe(tmp_path: Path) -> None:
    """What stays on a terminal is what a pipe gets, which has no control characters.

    Where a run takes long, the pipe has statuses too, which end with the time.
    """
    terminal = Terminal("run", *QUICK, "--out", tmp_path)
    terminal.read()
    piped = started("run", *QUICK, "--out", tmp_path)
    assert terminal.process.returncode == piped.returncode == 0
    lines = piped.stdout.split("\n")
    assert terminal.screen == [line for line in lines if not re.search(r"  \d+:\d\d", line)]
    assert not set("\r\x1b") & set(piped.stdout)
    feet = terminal.feet
    assert re.fullmatch(r"mesh and kernels  \d:\d\d", feet[0])
    steps = [foot for foot in feet if " du/h " in foot]
    assert re.fullmatch(r"1 point  w/h 0 -> 6  \d:\d\d  du/h \d\.?\d*", steps[0])
    assert re.fullmatch(
        r"\d points  w/h \d\.?\d* -> 6  \d:\d\d, about \d:\d\d left  du/h .*", steps[-1]
    )
    assert [foot for foot in feet if "looking for modes that the model excludes" in foot]
    assert "modes and pictures" in feet[-1]


def test_one_rank_of_mpirun(tmp_path: Path) -> None:
    """It has a terminal between it and mpirun, which may write to a file."""
    terminal = Terminal(
        "run", *QUICK, "--time-limit", "0", "--out", tmp_path, launcher=("mpirun", "-n", "1")
    )
    terminal.read()
    assert "results in" in terminal.written
    assert "\x1b" not in terminal.written


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_stopped_on_the_way(tmp_path: Path, number: signal.Signals) -> None:
    """The run ends after the point, and only its message is left."""
    terminal = Terminal("run", *QUICK, "--set=loading.points=60", "--out", tmp_path)
    terminal.read(lambda written: "5 points" in written)
    terminal.process.send_signal(number)
    terminal.read()
    assert terminal.process.returncode == 3
    *_, results, message, last = terminal.screen
    assert results == f"results in {tmp_path}/"
    assert message.startswith(f"stopped early: interrupted by {number.name}; ")
    assert last == ""


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, -signal.SIGTERM, marks=pytest.mark.slow)],
)
def test_stopped_while_a_mesh_is_found(tmp_path: Path, number: signal.Signals, code: int) -> None:
    """Nothing can be resumed, so the process ends at once. The line about the mesh is gone."""
    case = CASES / "dimple_buckling.yaml"
    terminal = Terminal(
        "run", case, "--set=mesh.tolerance=1e-5", "--set=symmetry=half", "--out", tmp_path
    )
    terminal.read(
        lambda written: "a mesh for the tolerance 1e-05: the path on a coarse one" in written
    )
    terminal.process.send_signal(number)
    terminal.read()
    assert terminal.process.returncode == code
    assert not [line for line in terminal.screen if "tolerance" in line]
    assert terminal.screen[-1] == ""


def test_a_narrow_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """A line that wrapped could not be erased; what stays may wrap."""
    screen = io.StringIO()
    screen.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stdout", screen)
    monkeypatch.setenv("COLUMNS", "10")
    monkeypatch.setenv("TERM", "xterm")
    for name in LAUNCHER_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    with live_line(1, print) as (say, tell):
        assert tell
        tell("0123456789")
        say("0123456789")
    assert screen.getvalue() == "\r\x1b[K0123456\r\x1b[K0123456789\n0123456\r\x1b[K"


def test_a_pipe_is_never_silent_for_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last status where nothing else was printed for 9 s; no control characters; on several
    ranks too.
    """
    printed: list[str] = []
    clock = iter([0.0, 5.0, 9.5, 9.6, 16.0, 18.0, 19.0, 19.0])
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    with live_line(2, printed.append) as (say, tell):
        tell("at 5 s")
        tell("at 9.5 s")  # two looks at the clock: the second is of the line
        tell("at 16 s")
        say("a point at 18 s")
        tell("at 19 s")
    assert printed == ["at 9.5 s", "a point at 18 s"]
    assert terminal.STATUS_SECONDS < 10


def test_a_pipe_gets_the_last_status_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also while long work tells nothing new, such as 90 s for one point; nothing before the first
    status."""
    monkeypatch.setattr(terminal, "STATUS_SECONDS", 0.1)
    printed: list[str] = []
    with live_line(2, printed.append) as (say, tell):
        time.sleep(0.25)
        say("begin")
        tell("working")
        time.sleep(0.35)
    assert printed[0] == "begin"
    assert 2 <= len(printed[1:]) <= 4
    assert set(printed[1:]) == {"working  (for 0 s)"}
    count = len(printed)
    time.sleep(0.15)
    assert len(printed) == count


def test_a_status_that_stays_says_for_how_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a terminal, where long work tells nothing new, the line is not still either."""
    screen = io.StringIO()
    screen.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stdout", screen)
    monkeypatch.setattr(terminal, "STATUS_SECONDS", 0.1)
    monkeypatch.setenv("TERM", "xterm")
    for name in LAUNCHER_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    with live_line(1, print) as (_, tell):
        tell("working")
        time.sleep(0.25)
    assert screen.getvalue().startswith("\r\x1b[Kworking\r\x1b[Kworking  (for 0 s)")
    assert screen.getvalue().endswith("(for 0 s)\r\x1b[K")


def test_time_left_of_a_resumed_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Known points took no time, so only new ones tell how long the rest takes; the field has no
    part in it.
    """
    case = Case.load(CASES / "indentation.yaml")
    problem = replace(make_problem(case), material=Material(0.5, 0.01))
    told: list[str] = []
    clock = iter(range(0, 1000, 10))
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    model = SimpleNamespace(contacts={})
    scene = SimpleNamespace(
        case=case, problem=problem, model=model, extra_columns=(), motions=(), sizes=Sizes()
    )
    progress = RunProgress(scene, told.append, -30.0)  # type: ignore[arg-type]
    here = SimpleNamespace(du=np.array([0.0, -0.5]))
    row = {"lambda_m": 0.0, "w_over_h": 0.0}
    progress.accepted({**row, "label": "start"}, is_known=True)
    progress.beginning(1)
    progress.accepted({**row, "label": "field", "lambda_m": 0.00092}, is_known=True)
    progress.trying(here, 0.02)  # type: ignore[arg-type]
    progress.beginning(2)
    for w, known in ((8.0, True), (12.0, False), (14.0, False)):
        progress.accepted({**row, "label": "step", "w_over_h": w}, is_known=known)
        progress.trying(here, 0.02)  # type: ignore[arg-type]
    assert told == [
        "2 points  lambda_m 0.00092 -> 0.00184  0:50  du/h 1",
        "3 points  w/h 8 -> 20  1:10  du/h 1",
        # 4 of 12 took 20 s: 40 s, 10 s ago
        "4 points  w/h 12 -> 20  1:30, about 0:30 left  du/h 1",
        "5 points  w/h 14 -> 20  1:50, about 0:30 left  du/h 1",
    ]


@pytest.mark.parametrize(
    ("until", "labels", "goal"),
    [
        ("limit", ("step", "fold"), "instability"),
        ("bifurcation", ("fold", "bifurcation"), "bifurcation"),  # past a fold
    ],
)
def test_a_snap_is_no_search_for_an_instability(
    until: str, labels: tuple[str, str], goal: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From its instability on, where it may be rehearsed for minutes, it is called what it is."""
    changes = [f"loading.until={until}", "loading.then=snap", "magnetic=null"]
    case = Case.load(CASES / "dimple_buckling.yaml", changes)
    told: list[str] = []
    monkeypatch.setattr(time, "perf_counter", lambda: 0.0)
    model = SimpleNamespace(contacts={})
    problem = replace(make_problem(case), material=Material(0.5, 0.01))
    scene = SimpleNamespace(
        case=case, problem=problem, model=model, extra_columns=(), motions=(), sizes=Sizes()
    )
    progress = RunProgress(scene, told.append, 0.0)  # type: ignore[arg-type]
    here = SimpleNamespace(du=np.array([0.0, -0.5]))
    progress.beginning(1)
    for label in labels:
        progress.accepted(
            {"label": label, "amplitude": "pressure", "p_over_pc": 0.3}, is_known=False
        )
        progress.trying(here, 0.02)  # type: ignore[arg-type]
    assert told == [
        f"1 point  p/pc 0.3 -> the first {goal}  0:00  du/h 1",
        "2 points  the snap  0:00  du/h 1",
    ]


def test_where_a_path_leads() -> None:
    """To a value, through a number of steps, or nobody knows how far."""
    row = {"p_over_pc": 0.25, "w_over_h": 5.0}
    moved = PathEnd("motion", 1.0, sizes=Sizes(distances={"motion": (DISTANCE, 2.0)}))
    assert moved.text({"motion": 0.5, "motion_mm": 1.0}) == "motion 1 -> 2 mm"
    assert PathEnd("w_over_h", 21.0).completed_part({"w_over_h": 1.0}, row, 7) == 0.2
    assert PathEnd("w_over_h", words="28 steps", steps=28).completed_part(row, row, 7) == 0.25
    assert PathEnd("p_over_pc", words="the first instability").completed_part(row, row, 7) is None
    assert (
        PathEnd("p_over_pc", words="the first instability").text(row)
        == "p/pc 0.25 -> the first instability"
    )
    assert time_left((0.0, 10.0), (0.25, 20.0)) == 30.0
    assert time_left((0.2, 10.0), (0.4, 20.0)) == pytest.approx(30.0)
    assert time_left((0.0, 10.0), (1.0, 20.0)) is None
    assert time_left((0.5, 10.0), (0.4, 20.0)) is None
