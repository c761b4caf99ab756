"""The runner of many runs: what is kept and what is not, shares, the rest of the time, and one's
own study on it.
"""

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import CASES
from mpi4py import MPI
from pydantic import TypeAdapter

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import CaseError, read_source
from magshell_fenicsx.output.store.folder import DiskError
from magshell_fenicsx.output.store.table import write_csv
from magshell_fenicsx.platform import environment
from magshell_fenicsx.public import run
from magshell_fenicsx.studies import runner
from magshell_fenicsx.studies.results import parse_scalar
from magshell_fenicsx.studies.runner import (
    Folder,
    Outcome,
    compute,
    keep,
    keep_outcome,
    outcome_of,
    stored_outcome,
    stored_outcome_of_case,
)

PLATE = CASES / "clamped_plate.yaml"
OUTCOME = Outcome.failed("lost", 1.5, 3)


def test_an_outcome_is_kept_for_these_sources(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is missing, cut off, of other types or of other sources is none."""
    file, case = tmp_path / "a.json", Case.load(PLATE)
    assert stored_outcome_of_case(file) is None
    keep_outcome(OUTCOME, case, file)
    assert stored_outcome_of_case(file) == OUTCOME
    assert [each.name for each in tmp_path.iterdir()] == ["a.json"]
    content = json.loads(file.read_text(encoding="utf-8"))
    assert content["case"]["shell"]["geometry"] == "disc"
    for changed in ({"dofs": "many"}, {"curve": 3}, {"found": "guess"}, {"more": 1}):
        keep(file, {**content, "outcome": content["outcome"] | changed})
        assert (stored_outcome_of_case(file) is None) == ("more" not in changed)
    file.write_text(json.dumps(content)[:-20], encoding="utf-8")
    assert stored_outcome_of_case(file) is None
    keep_outcome(OUTCOME, case, file)
    monkeypatch.setattr(environment, "_RUNNING_VERSION", "0.1.0+anotherhash00000")
    assert stored_outcome_of_case(file) is None


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


def test_a_study_of_ones_own(tmp_path: Path) -> None:
    """Cases in, outcomes and a table out: the deflection of a plate over its load, which a second
    call only reads.
    """
    scalar, folder = (
        parse_scalar("w_from_field_over_h@end"),
        Folder("a line", ("line.json", "line.csv"), ("loads",)),
    )
    computed: list[float] = []

    def line(loads: list[float]) -> list[float | None]:
        folder.prepare(tmp_path, MPI.COMM_WORLD)
        files = {load: tmp_path / "points" / f"{load}.json" for load in loads}

        def load_computed(load: float) -> Iterator[str]:
            settings = [f"loading.pressure={load}", "mesh.degree=3", "mesh.refinement=0.5"]
            case = Case.from_source(read_source(PLATE, settings))
            result = run(case, comm=MPI.COMM_SELF)
            computed.append(load)
            keep_outcome(
                outcome_of(result, "path", result.scene.newton.factorisation.count),
                case,
                files[load],
            )
            yield f"{load}"

        compute(
            [load for load in loads if stored_outcome_of_case(files[load]) is None],
            load_computed,
            MPI.COMM_WORLD,
        )
        outcomes = [stored_outcome_of_case(file) for file in files.values()]
        values = [outcome.value(scalar) if outcome else None for outcome in outcomes]
        write_csv(
            [{"load": load, "w": w} for load, w in zip(loads, values, strict=True)],
            ("load", "w"),
            tmp_path / "t",
        )
        return values

    first = line([1e-5, 2e-5])
    assert line([1e-5, 2e-5, 3e-5])[:2] == first
    assert computed == [1e-5, 2e-5, 3e-5]
    assert first[1] == pytest.approx(2 * first[0], rel=1e-3)  # a plate under a small load is linear


def test_long_silence_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the rest of the time once it is known, and never beside a line that was just said;
    nested, once.
    """
    monkeypatch.setattr(runner, "SECONDS_BETWEEN_LINES", 0.2)
    said: list[str] = []

    def slow(number: int) -> Iterator[str]:
        time.sleep(0.5)
        yield f"{number} done"

    with runner.heard(MPI.COMM_SELF, said.append) as told:
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
    with runner.heard(MPI.COMM_SELF, said.append, lambda: ", about 2 h left"):
        time.sleep(0.35)
    assert said
    assert all(re.fullmatch(r"still computing, 0:00 so far, about 2 h left", line) for line in said)
