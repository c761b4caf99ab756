"""Ensembles: every way to a sample gives the same number, ranks and parts do not matter, nothing is
dropped.
"""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import magshell
from conftest import CASES
from interrupted import kill, start, wait_until
from many import ensemble, make_samples

from magshell_fenicsx import CaseError
from magshell_fenicsx.continuation.fold import FoldLost
from magshell_fenicsx.input.source import override, read_source
from magshell_fenicsx.public import run
from magshell_fenicsx.studies.ensemble import ensemble as solving
from magshell_fenicsx.studies.ensemble.samples import Sample
from magshell_fenicsx.studies.ensemble.statistics import make_row
from magshell_fenicsx.studies.folds import KnownFolds
from magshell_fenicsx.studies.outcome import Outcome
from magshell_fenicsx.studies.results import parse_scalar

DIMPLE = CASES / "dimple_buckling.yaml"
RANDOM = (
    "ensemble={keys: {shell.defect.amplitude: {kind: lognormal, mean: 1, "
    "deviation: 0.3, below: 3}, "
    "magnetic.lambda_m: {kind: normal, mean: 5e-4, deviation: 1e-4}}}"
)
COARSE = ["mesh.degree=3", "mesh.refinement=0.5"]
THREE = ("--samples", 3, "--seed", 1, *(f"--set={s}" for s in (RANDOM, *COARSE)))
SMALL = (
    "symmetry=none",
    "mesh={degree: 3, refinement: 0.3}",
    "shell.radius_to_thickness=30",
    "shell.defect=null",
)
KNOCKDOWN = parse_scalar("knockdown")


def lost(*arguments: Any) -> Any:
    raise FoldLost("on purpose")


def drawn(*settings: str, numbers: range = range(4), deleted: int = 0) -> list[Sample]:
    source = read_source(DIMPLE)
    for setting in (RANDOM, *settings):
        override(source, setting)
    return make_samples(source, 1, numbers, deleted=deleted)


def read(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def same(one: list[dict[str, str]], two: list[dict[str, str]]) -> None:
    """The drawn values are equal, the results to 1e-9."""
    assert len(one) == len(two)
    for a, b in zip(one, two, strict=True):
        assert [a[key] for key in ("sample", "point", "status")] == [
            b[key] for key in ("sample", "point", "status")
        ]
        assert float(b["result"]) == pytest.approx(float(a["result"]), rel=1e-9)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, str]]:
    """The table of one rank."""
    folder = tmp_path_factory.mktemp("alone")
    assert magshell("ensemble", DIMPLE, *THREE, "--out", folder).returncode == 0
    return read(folder / "samples.csv")


@pytest.fixture
def analytic(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Samples whose knockdown is a formula of the amplitude; the numbers of those that were
    computed.
    """
    done: list[int] = []

    def solve(sample: Sample, scalar: Any, folds: KnownFolds) -> Outcome:
        done.append(sample.number)
        if sample.number == 7:
            raise KeyboardInterrupt
        amplitude = sample.values["shell.defect.amplitude"]
        return Outcome(
            1 / (1 + amplitude), None, None, 100, 0.1, [{"label": "fold"}], "fold", 3, None, 0.1
        )

    monkeypatch.setattr(solving, "solve", solve)
    return done


def test_a_known_fold_leads_to_the_knockdown_of_the_path() -> None:
    """Same numbers to 1e-9 from the fold of another sample and from the path, with fewer
    factorisations.
    """
    first, second = drawn(*COARSE, numbers=range(2))
    known = KnownFolds()
    solving.solve(first, KNOCKDOWN, known)
    near, alone = (
        solving.solve(second, KNOCKDOWN, known),
        solving.solve(second, KNOCKDOWN, KnownFolds()),
    )
    assert near.knockdown == pytest.approx(alone.knockdown, rel=1e-9)
    path = run(second.case)
    assert near.knockdown == pytest.approx(path.knockdown, rel=2e-8)  # located to 1e-8
    assert near.factorisations < path.scene.newton.factorisation.count / 3
    other = solving.solve(
        second, parse_scalar("w_pole_over_h@end"), known
    )  # every other result takes the path
    assert other.found == "path"


@pytest.mark.slow
def test_a_fold_ahead_is_the_fold_of_the_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two random defects on a full shell, to the digits; the path located its fold without any
    guess.
    """
    defects = "defects: {count: 2, amplitude: 1, width: 3, polar: [0, 50], distance: 40}"
    (sample,) = drawn(f"ensemble={{{defects}}}", *SMALL, numbers=range(1))
    ahead = solving.solve(sample, KNOCKDOWN, KnownFolds())
    monkeypatch.setattr(solving, "MOST_TRIES", 0)
    monkeypatch.setattr(KnownFolds, "refined", lost)
    path = solving.solve(sample, KNOCKDOWN, KnownFolds())
    assert (ahead.found, path.found) == ("fold", "path")
    assert ahead.knockdown == pytest.approx(path.knockdown, rel=1e-7)
    assert (
        ahead.factorisations <= path.factorisations + 1
    )  # 12 and 11: so near a fold neither saves much


def test_the_weakest_defects_are_deleted() -> None:
    """The others stay as they are."""
    defects = (
        "defects: {count: 4, amplitude: {kind: uniform, above: 0.5, below: 2}, width: 3, "
        "polar: [0, 60]}"
    )
    settings = (f"ensemble={{{defects}}}", *SMALL)
    (whole,), (less,) = (drawn(*settings, numbers=range(1), deleted=n) for n in (0, 2))
    every, kept = whole.case.shell.imperfections, less.case.shell.imperfections
    assert [item for item in every if item in kept] == kept
    assert sorted(item.amplitude for item in kept) == sorted(item.amplitude for item in every)[2:]
    assert whole.severest["amplitude"] == max(item.amplitude for item in every)


UNITS = (
    "shell={geometry: hemisphere, radius: 30 mm, thickness: 0.3 mm, youngs_modulus: 1 MPa, "
    "poisson_ratio: 0.5, "
    "imperfections: [{kind: gaussian, amplitude: 0.6, width: 2}, "
    "{kind: gaussian, amplitude: 0.15 mm, width: 2, at: {polar: 40}}]}"
)


def test_defects_with_and_without_units_are_compared() -> None:
    """0.15 mm is half of the thickness, and less than 0.6 h; a drawn value with a unit is a number
    of the table.
    """
    keys = (
        "keys: {shell.imperfections.1.amplitude: {kind: uniform, above: 0.1, "
        "below: 0.15, unit: mm}}"
    )
    (sample,) = drawn(f"ensemble={{{keys}}}", UNITS, numbers=range(1))
    assert sample.severest["amplitude"] == 0.6
    row = make_row(sample, None, KNOCKDOWN)
    assert 0.1 < row["shell.imperfections.1.amplitude_mm"] < 0.15


def test_interrupted_and_resumed(
    tmp_path: Path, analytic: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(KeyboardInterrupt):
        ensemble(DIMPLE, [RANDOM], samples=10, seed=1, out=tmp_path)
    assert len(list((tmp_path / "points").iterdir())) == 7
    with pytest.raises(CaseError, match="has no sample of this ensemble"):
        ensemble(DIMPLE, [RANDOM], samples=7, seed=2, out=tmp_path, resume=True)
    short = ensemble(DIMPLE, [RANDOM], samples=7, seed=1, out=tmp_path, resume=True)
    assert analytic == list(range(8))
    assert [row["sample"] for row in short.rows] == list(range(7))
    amplitudes = np.array(
        [float(row["shell.defect.amplitude"]) for row in read(tmp_path / "samples.csv")]
    )
    assert [row["result"] for row in short.rows] == pytest.approx(1 / (1 + amplitudes))
    assert short.content["mean"] == pytest.approx(np.mean(1 / (1 + amplitudes)))
    assert short.content["correlations"]["severest.amplitude"]["spearman"] == pytest.approx(-1)


def test_parts_make_the_whole(tmp_path: Path, analytic: list[int]) -> None:
    folders = [tmp_path / str(i) for i in (1, 2)]
    for i, folder in enumerate(folders, 1):
        part = ensemble(DIMPLE, [RANDOM], samples=7, seed=1, out=folder, part=f"{i}/2")
        assert [row["sample"] for row in part.rows] == list(range(i - 1, 7, 2))
        assert (folder / f"samples_{i}_of_2.csv").exists()
    whole = ensemble(DIMPLE, [RANDOM], samples=7, seed=1, out=tmp_path / "whole")
    del analytic[:]
    merged = ensemble(DIMPLE, [RANDOM], samples=7, seed=1, out=tmp_path / "merged", merge=folders)
    assert analytic == []
    assert merged.rows == whole.rows
    half = ensemble(DIMPLE, [RANDOM], samples=7, seed=1, out=tmp_path / "half", merge=folders[:1])
    assert half.content["counts"] == {"samples": 7, "found": 4, "missing": 3}
    assert half.without_result == 3


def test_failed_samples_are_counted_and_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In table, summary and report; an error may have been of the machine, and is tried again."""

    def unlucky(case: Any, comm: Any) -> Any:
        raise RuntimeError("out of luck")

    monkeypatch.setattr(solving, "run", unlucky)
    done = magshell(
        "ensemble",
        DIMPLE,
        "--samples",
        2,
        "--seed",
        1,
        "--out",
        tmp_path,
        *(f"--set={s}" for s in (RANDOM, *COARSE)),
        "--result",
        "energy@end",
    )
    assert done.returncode == 3
    assert "2 of 2 samples have no energy@end; samples.csv says why" in done.stderr
    rows = read(tmp_path / "samples.csv")
    assert [(row["status"], row["why"]) for row in rows] == [
        ("failed", "failed: RuntimeError: out of luck")
    ] * 2
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["counts"] == {"samples": 2, "failed": 2}
    assert summary["weibull"] is None
    assert "| 1 | failed | failed: RuntimeError: out of luck |" in (
        tmp_path / "report.md"
    ).read_text(encoding="utf-8")
    monkeypatch.undo()
    again = ensemble(
        DIMPLE, [RANDOM, *COARSE], samples=1, seed=1, out=tmp_path, result="energy@end"
    )
    assert again.rows[0]["status"] == "found"


def test_killed_before_the_first_sample(tmp_path: Path) -> None:
    """Only an unfinished file is there. `--resume` begins, finding nothing of another ensemble."""
    (tmp_path / "points").mkdir()
    (tmp_path / "points" / "key.unfinished").touch()
    settings = [RANDOM, *COARSE]
    again = ensemble(
        DIMPLE, settings, samples=1, seed=1, out=tmp_path, result="energy@end", resume=True
    )
    assert again.rows[0]["status"] == "found"
    with pytest.raises(CaseError, match="has no sample of this ensemble"):
        ensemble(
            DIMPLE, settings, samples=1, seed=2, out=tmp_path, result="energy@end", resume=True
        )


@pytest.mark.slow
def test_ranks_give_the_table_of_one(tmp_path: Path, alone: list[dict[str, str]]) -> None:
    """In any order, with other folds to begin with; on two ranks killed after a sample, resumed on
    three.
    """
    run, points = start("ensemble", DIMPLE, *THREE, "--out", tmp_path, ranks=2), tmp_path / "points"
    wait_until(lambda: points.is_dir() and any(points.glob("*.json")))
    kill(run, 2)
    assert not (tmp_path / "samples.csv").exists()
    done = magshell("ensemble", DIMPLE, *THREE, "--out", tmp_path, "--resume", ranks=3)
    assert done.returncode == 0, done.stderr
    same(alone, read(tmp_path / "samples.csv"))
    assert (tmp_path / "ensemble.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("settings", "options", "message"),
    [
        ([], {}, "dimple_buckling.yaml: ensemble: is missing: it says which keys are random"),
        (["ensemble={keys: {mesh.degre: 3}}"], {}, "mesh.degre: unknown key; did you mean degree?"),
        (
            ["ensemble={keys: {mesh.degree: 9}}"],
            {},
            "mesh.degree: 9: must be less than or equal to 5",
        ),
        (
            [
                "ensemble={keys: {shell.defect.amplitude: {kind: lognormal, mean: 50, "
                "deviation: 500}}}"
            ],
            {},
            "of seed 1; bounds keep a distribution in",
        ),
        ([RANDOM], {"part": "3/2"}, "--part 3/2: write it as i/n"),
        ([RANDOM], {"part": "1/9"}, "--part 1/9"),
        ([RANDOM], {"samples": 0}, "--samples 0: must be 1 to"),
        ([RANDOM], {"seed": -1}, "--seed -1: must not be negative"),
        ([RANDOM], {"result": "w"}, "--result w: w is no column"),
        ([RANDOM], {"merge": ["/nowhere"]}, "/nowhere: has no sample of this ensemble"),
        ([RANDOM], {"delete_weakest": 1}, "--delete-weakest 1: the sample has only 1 defect"),
    ],
)
def test_bad_input(
    settings: list[str], options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(CaseError) as e:
        ensemble(DIMPLE, settings, **{"samples": 4, "seed": 1, "out": tmp_path / "out", **options})
    assert message in str(e.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        (
            "{mesh.degre: 3, shell.poisson_ratio: 0.4}",
            "mesh.degre: unknown key; did you mean degree?",
        ),
        ("{mesg.degree: 3}", "mesg.degree: mesg: unknown key; did you mean mesh?"),
        (
            "{shell.imperfections.0.amplitude: 1}",
            "shell.imperfections.0.amplitude: shell.imperfections: must be a",
        ),
        (
            "{shell.poisson_ratio.x: 1}",
            "shell.poisson_ratio.x: poisson_ratio is a value, not a section",
        ),
    ],
)
def test_keys_that_no_case_has(keys: str, said: str, tmp_path: Path) -> None:
    """Found by `check` too, with the line of the distribution; a number out of bounds is a matter
    of the draw.
    """
    file = tmp_path / "random.yaml"
    file.write_text(
        f"{DIMPLE.read_text(encoding='utf-8')}ensemble:\n  keys: {keys}\n", encoding="utf-8"
    )
    line = len(file.read_text(encoding="utf-8").splitlines())
    for command in (
        ["check", file],
        ["ensemble", file, "--samples", "2", "--seed", "1", "--out", tmp_path / "out"],
    ):
        done = magshell(*command)
        assert done.returncode == 2
        assert f"{file}:{line}: ensemble.keys: {said}" in done.stderr
        assert "in sample" not in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_random_dimples(tmp_path: Path) -> None:
    """The case's mesh against one with elements half as large (0.350848)."""
    settings = ["--samples", 2, "--seed", 1, "--part", "2/2"]
    done = magshell("ensemble", CASES / "random_dimples.yaml", *settings, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    (row,) = read(tmp_path / "samples_2_of_2.csv")
    assert float(row["result"]) == pytest.approx(0.350848, rel=5e-3)
    assert float(row["severest.amplitude"]) == pytest.approx(1.1290330023384831)
    assert row["found"] == "fold"
