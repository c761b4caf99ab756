"""The runner of many runs: what is kept and what is not, shares, the rest of the time, and one's
own study on it.
"""

import csv
import json
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from conftest import CASES
from mpi4py import MPI
from pydantic import TypeAdapter

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.durable import write_object
from magshell_fenicsx.output.store.folder import DiskError, access_disk
from magshell_fenicsx.platform import environment
from magshell_fenicsx.platform.processes import on_first_rank
from magshell_fenicsx.runs.gradients import gradients_after
from magshell_fenicsx.runs.running import run
from magshell_fenicsx.studies import runner
from magshell_fenicsx.studies.figures import PointNumbers, draw_points
from magshell_fenicsx.studies.outcome import Outcome
from magshell_fenicsx.studies.points import (
    SweepPoint,
    make_points,
    parse_axes,
    point_columns,
    swept_source,
)
from magshell_fenicsx.studies.runner import Say, compute, compute_points
from magshell_fenicsx.studies.store import Folder, OutcomeStore, keep, stored_outcome, write_table

PLATE = CASES / "clamped_plate.yaml"
OUTCOME = Outcome.failed("lost", 1.5, 3)


def test_an_outcome_is_kept_for_these_sources(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is missing, cut off, of other types or of other sources is none."""
    store, case = OutcomeStore(tmp_path, Outcome), Case.load(PLATE)
    file = store.file("a")
    assert store.outcome("a") is None
    store.keep("a", OUTCOME, case)
    assert store.outcome("a") == OUTCOME
    assert [each.name for each in tmp_path.iterdir()] == ["a.json"]
    content = json.loads(file.read_text(encoding="utf-8"))
    assert content["case"]["shell"]["geometry"] == "disc"
    for changed in ({"dofs": "many"}, {"curve": 3}, {"found": "guess"}, {"more": 1}):
        keep(file, {**content, "outcome": content["outcome"] | changed})
        assert (store.outcome("a") is None) == ("more" not in changed)
    file.write_text(json.dumps(content)[:-20], encoding="utf-8")
    assert store.outcome("a") is None
    store.keep("a", OUTCOME)
    assert store.outcome("a") == OUTCOME
    assert OutcomeStore(tmp_path, Outcome, {"design": "one"}).outcome("a") is None
    monkeypatch.setattr(environment, "_RUNNING_VERSION", "0.1.0+anotherhash00000")
    assert store.outcome("a") is None


@dataclass(frozen=True)
class Named:
    """A point whose case does not matter."""

    key: str
    label: str
    case: None = None


def test_points_without_an_outcome_are_computed(tmp_path: Path) -> None:
    """Of equal points the first, those with a number that does not serve too; each is kept."""
    store, said = OutcomeStore(tmp_path, dict[str, int]), list[str]()
    points = [Named(*names) for names in (("a", "A"), ("b", "B"), ("a", "again"), ("c", "C"))]
    store.keep("b", {"n": 1})
    missing = store.missing(points, MPI.COMM_SELF)
    assert [point.label for point in missing] == ["A", "C"]
    assert len(store.missing(points, MPI.COMM_SELF, lambda outcome: outcome["n"] > 1)) == 3
    compute_points(
        missing, lambda point: {"n": ord(point.key)}, store, MPI.COMM_SELF, said.append, str
    )
    assert said == ["    1/2  A: {'n': 97}", "    2/2  C: {'n': 99}"]
    assert store.missing(points, MPI.COMM_SELF) == []
    assert store.outcome("c") == {"n": 99}


def test_a_file_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(DiskError, match=r"nowhere/a\.json cannot be written: No such file"):
        keep(tmp_path / "nowhere" / "a.json", {})


def test_only_what_has_the_same_beside_it(tmp_path: Path) -> None:
    keep(tmp_path / "a.json", {"design": "one", "numbers": [1, 2]})
    numbers = TypeAdapter(list[float])
    assert stored_outcome(tmp_path / "a.json", numbers, "numbers", design="one") == [1, 2]
    assert stored_outcome(tmp_path / "a.json", numbers, "numbers", design="two") is None
    assert stored_outcome(tmp_path / "a.json", numbers, "numbers", other="one") is None


@pytest.mark.parametrize("part", ["0/2", "3/2", "1", "a/b", "1/9", "1/2/3"])
def test_a_part_that_is_none(part: str) -> None:
    with pytest.raises(
        CaseError,
        match=f"--part {part}: write it as i/n with 1 <= i <= n, and n at most the number of",
    ):
        runner.part_of(part, 8, "points")


def test_the_rest_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four tasks of a minute each, by one's own clock. What is left is said until it is short."""
    now = [0.0]
    monkeypatch.setattr(runner.time, "perf_counter", lambda: now[0])
    said: list[str] = []

    def waited(task: str) -> Iterator[str]:
        now[0] += 60
        yield task

    compute("abcd", waited, MPI.COMM_SELF, said.append)
    assert said == ["a, about 3 min left", "b, about 2 min left", "c, about 60 s left", "d"]


SLOPES = Folder("a map of slopes", ("slopes.json", "slopes.csv", "slopes.png"), ("slope_of", "by"))


@dataclass(frozen=True)
class Slope:
    """The derivative of a result at a point; None if it has none."""

    slope: float | None


def slope_map(
    file: Path, over: list[str], settings: list[str], out: Path, comm: MPI.Intracomm, say: Say
) -> list[Slope | None]:
    """The study of CONTRIBUTING: dw/dp of a plate, over two keys."""
    result, by = "w_pole_over_h", "pressure"
    axes, asked = parse_axes(over), f"gradients={{of: [{result}], by: [{by}]}}"
    source = on_first_rank(comm, lambda: swept_source(file, axes, [*settings, asked]))
    points = on_first_rank(comm, lambda: make_points(source, axes, Case.from_source))

    def slope_at(point: SweepPoint) -> Slope:
        run_result = run(point.case.problem(), comm=MPI.COMM_SELF)
        gradients_after(run_result, None, say=lambda line: None)
        return Slope(run_result.gradients.get(result, {}).get("numbers", {}).get(by))

    def write(slopes: list[Slope | None]) -> None:
        values = [slope.slope if slope else None for slope in slopes]
        rows = [
            {**point_columns(axes, point), "slope": value}
            for point, value in zip(points, values, strict=True)
        ]
        write_object(out / "slopes.json", {"case": file.name, "slope_of": result, "by": by})
        write_table(rows, out / "slopes.csv")
        label = f"d {result} / d {by}"
        draw_points(axes, points, PointNumbers(values, label), out / "slopes.png")

    with SLOPES.locked(out, comm, file.name):
        store = OutcomeStore(out / "points", Slope)
        compute_points(store.missing(points, comm), slope_at, store, comm, say)
        slopes = access_disk(comm, lambda: [store.outcome(point.key) for point in points])
        access_disk(comm, lambda: write(slopes))
    return slopes


def test_a_study_of_ones_own(tmp_path: Path) -> None:
    """A plate under a small load is linear, w = p R^4/(64 D) at its centre (Timoshenko), where p is
    over the pressure of a sphere. A second call computes what is missing alone.
    """
    over = ["loading.pressure=1e-5,2e-5", "shell.poisson_ratio=0,0.3"]
    said, settings = list[str](), ["mesh.degree=3", "mesh.refinement=0.5"]
    slopes = slope_map(PLATE, over, settings, tmp_path, MPI.COMM_WORLD, said.append)
    values = [slope.slope for slope in slopes if slope]
    exact = [12 * (1 - nu**2) ** 0.5 * 2 / 3**0.5 * 50**2 / 64 for nu in (0.0, 0.3)]
    assert values == pytest.approx(2 * exact, rel=3e-3)
    assert len(said) == 4
    assert said[0].startswith(f"    1/4  pressure=1e-5, poisson_ratio=0: {slopes[0]}")
    with (tmp_path / "slopes.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == ["loading.pressure", "shell.poisson_ratio", "point", "slope"]
    assert [float(row["slope"]) for row in rows] == values
    assert (tmp_path / "slopes.png").stat().st_size > 10_000
    over[1] = "shell.poisson_ratio=0,0.2,0.3"
    assert len(slope_map(PLATE, over, settings, tmp_path, MPI.COMM_WORLD, said.append)) == 6
    assert len(said) == 6


def test_long_silence_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the rest of the time once it is known, and never beside a line that was just said;
    nested, once.
    """
    monkeypatch.setattr(runner, "SECONDS_BETWEEN_LINES", 0.2)
    said: list[str] = []

    def slow(number: int) -> Iterator[str]:
        time.sleep(0.5)
        yield f"{number} done"

    with runner.reporting_progress(MPI.COMM_SELF, said.append) as told:
        compute([1, 2], slow, MPI.COMM_SELF, told)
    reminders = [line for line in said if line.startswith("still computing, 0:0")]
    assert 2 <= len(reminders) <= 4
    assert [line for line in said if line not in reminders] == ["1 done", "2 done"]
    assert said[0] in reminders
    before = len(said)
    time.sleep(0.5)
    assert len(said) == before, "it ends with the work"


def test_reminders_have_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "SECONDS_BETWEEN_LINES", 0.1)
    said: list[str] = []
    with runner.reporting_progress(MPI.COMM_SELF, said.append, lambda: ", about 2 h left"):
        time.sleep(0.35)
    assert said
    assert all(re.fullmatch(r"still computing, 0:00 so far, about 2 h left", line) for line in said)
