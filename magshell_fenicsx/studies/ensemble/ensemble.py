"""Random samples of a case; the ranks share them, existing ones are kept.

A sample takes the cheapest way that leads to its result. A knockdown is the fold of the nearest
known sample on the same mesh, continued; else the fold that Newton's method finds from one of the
first points of the path; else the fold at its end. Each ends in Newton's method for the fold, so
that a knockdown is the same to 1e-9 by all ways. Every other result needs the path.

A knockdown is the pressure of the first fold over the classical one. A sample is a case with drawn
values; its key is a hash of its problem, and a variant of it lacks the weakest defects. A scalar is
the number of a run that is wanted, an outcome what a run leaves. A scene is the model of a case
with its solver; a record is a point of its path. A part is what one of several jobs computes.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.continuation.fold import FoldGuess, FoldLost, fold_ahead
from magshell_fenicsx.input.source import CaseError, read_source
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.output.store.durable import write_object, write_whole
from magshell_fenicsx.output.store.folder import access_disk, user_folder
from magshell_fenicsx.platform.environment import code_version
from magshell_fenicsx.platform.processes import on_first_rank
from magshell_fenicsx.platform.terminal import print_line
from magshell_fenicsx.quantities.quantity import number_with_error
from magshell_fenicsx.runs.rows import RowMaker
from magshell_fenicsx.runs.running import run
from magshell_fenicsx.runs.summary import Result
from magshell_fenicsx.simulate.follow import follow_alone
from magshell_fenicsx.simulate.perfect import with_modes
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.studies.ensemble.picture import draw_ensemble
from magshell_fenicsx.studies.ensemble.samples import Sample, make_samples
from magshell_fenicsx.studies.ensemble.statistics import (
    WITHOUT,
    Row,
    make_row,
    report,
    statistics,
    write_samples,
)
from magshell_fenicsx.studies.folds import KnownFolds, has_knockdown, result_of_fold
from magshell_fenicsx.studies.outcome import FAILED, Outcome, outcome_of
from magshell_fenicsx.studies.points import MakeCase
from magshell_fenicsx.studies.results import Scalar, parse_scalar
from magshell_fenicsx.studies.runner import Say, compute_points, part_of, say_on_first_rank
from magshell_fenicsx.studies.store import Folder, OutcomeStore

MOST_SAMPLES = 100_000
MOST_TRIES = 2  # points of the path from which the fold ahead is tried


@dataclass(frozen=True)
class Ensemble:
    """A finished ensemble of random samples.

    Attributes
    ----------
    rows
        Rows of samples.csv.
    content
        The content of summary.json.
    """

    rows: list[Row]
    content: dict[str, Any]

    @property
    def without_result(self) -> int:
        """Number of samples without the requested result."""
        return sum(row["status"] != "found" for row in self.rows)


def ensemble(  # noqa: PLR0913 - what a user gives
    file: Path | str,
    settings: Sequence[str] = (),
    *,
    samples: int,
    seed: int,
    make_case: MakeCase,
    result: str = "knockdown",
    out: Path | str = "results/ensemble",
    part: str | None = None,
    merge: Sequence[Path | str] = (),
    delete_weakest: int = 0,
    resume: bool = False,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    say: Say = print_line,
    executor: Executor | None = None,
) -> Ensemble:
    """Compute random samples of a case; collective, and every rank computes samples of its own.

    Parameters
    ----------
    samples
        Number of samples.
    seed
        Seed from which, with its number, each sample is drawn.
    make_case
        Makes a case of its source.
    result
        As of `magshell study`: knockdown, barrier, critical_field, COLUMN@COLUMN=VALUE or
        COLUMN@end.
    out
        Folder of samples.csv, summary.json, ensemble.png, report.md and points/; samples that are
        there are kept if these sources computed them.
    part
        "i/n": compute only every n-th sample, from the i-th; the files are then samples_i_of_n.csv
        and so on.
    merge
        Folders of parts: take their samples, compute none.
    delete_weakest
        Also compute each sample without so many of its defects, those with the least amplitudes.
    resume
        Require that the folder has samples of this ensemble.
    say
        Called with one line per finished sample, on the rank that finished it.
    executor
        Processes of another kind than ranks, which see the same files; see `concurrent.futures`.

    Raises
    ------
    CaseError
        Before the first sample: if a sample is no valid case, an argument is wrong, or `out` cannot
        be written.
    DiskError
        If the tables cannot be written.
    """
    scalar, numbers = parse_scalar(result), _numbers(samples, seed, part)
    ending = f"_{part.replace('/', '_of_')}" if part else ""

    def drawn_samples() -> list[list[Sample]]:
        """Draw all samples, and with `delete_weakest` their variants without weak defects."""
        source = read_source(Path(file), settings)
        return [
            make_samples(source, seed, numbers, make_case, deleted)
            for deleted in sorted({0, delete_weakest})
        ]

    # one list of samples, or two: without weak defects as well
    variants = on_first_rank(comm, drawn_samples)
    samples_by_key = {sample.key: sample for variant in variants for sample in variant}
    folder, name = user_folder(out), Path(file).name
    store, part_stores = _store(folder), [_store(Path(place)) for place in merge]
    if resume or merge:  # the folders must belong to this ensemble
        stores = part_stores or [store]
        access_disk(comm, lambda: _refuse_strange(stores, samples_by_key, merge=bool(merge)))
    tables = (
        f"summary{ending}.json",
        f"samples{ending}.csv",
        f"ensemble{ending}.png",
        f"report{ending}.md",
    )
    Folder("an ensemble", tables, ("seed", "samples")).prepare(folder, comm, name)
    if merge:
        access_disk(comm, lambda: _copy(samples_by_key, part_stores, store))
        _say_at_begin(len(samples_by_key), 0, comm, say)
    else:
        _compute_missing(samples_by_key, scalar, store, comm, say, executor)
    rows = [_row(sample_variants, store, scalar) for sample_variants in zip(*variants, strict=True)]
    content = {
        "case": name,
        "settings": list(settings),
        "seed": seed,
        "samples": samples,
        "part": part,
        "result": result,
        "deleted": delete_weakest,
        "sources": code_version(),
        **access_disk(comm, lambda: statistics(rows, seed)),
    }
    access_disk(comm, lambda: _write(rows, content, folder, ending))
    return Ensemble(rows, content)


def _compute_missing(
    samples_by_key: Mapping[str, Sample],
    scalar: Scalar,
    store: OutcomeStore[Outcome],
    comm: MPI.Intracomm,
    say: Say,
    executor: Executor | None = None,
) -> None:
    """Compute the samples whose outcome is not in the store; collective, each rank has its own.

    A sample that ended with an error is computed again: the error may have been one of the machine.
    """
    missing = store.missing(
        samples_by_key.values(),
        comm,
        lambda outcome: outcome.serves(scalar) and not outcome.is_error,
    )
    _say_at_begin(len(samples_by_key), len(missing), comm, say)
    compute_points(
        missing,
        partial(solve, scalar=scalar, folds=KnownFolds()),
        store,
        comm,
        say,
        words=partial(_words, scalar=scalar),
        executor=executor,
    )


def _say_at_begin(count: int, missing_count: int, comm: MPI.Intracomm, say: Say) -> None:
    """Say on rank 0 how many samples there are, and how many of them will be computed."""
    ranks = f"{comm.size} rank{'s' if comm.size > 1 else ''}"
    say_on_first_rank(say, comm)(f"{count} samples, {missing_count} to compute on {ranks}")


def _words(outcome: Outcome, scalar: Scalar) -> str:
    """Return the outcome of a sample in words: the number, why it ended early, and the CPU time."""
    value = outcome.value(scalar)
    outcome_text = (
        f"no {scalar.name}"
        if value is None
        else f"{scalar.name} = {number_with_error(value, outcome.error(scalar))} ({outcome.found})"
    )
    reason = f", {outcome.stopped}" if outcome.stopped else ""
    return f"{outcome_text}{reason}, {outcome.cpu_s:.1f} s CPU"


def _numbers(samples: int, seed: int, part: str | None) -> range:
    """Return the numbers of the samples of a part: every n-th, from the i-th on.

    Raises
    ------
    CaseError
        If the number of samples, the seed or the part is not allowed.
    """
    if not 1 <= samples <= MOST_SAMPLES:
        raise CaseError(f"--samples {samples}: must be 1 to {MOST_SAMPLES}")
    if seed < 0:
        raise CaseError(f"--seed {seed}: must not be negative")
    i, n = part_of(part, samples, "samples")
    return range(i - 1, samples, n)


def _store(folder: Path) -> OutcomeStore[Outcome]:
    """Return the outcomes of the samples in the folder of an ensemble."""
    return OutcomeStore(folder / "points", Outcome)


def _has_no_sample_yet(points: Path) -> bool:
    """Return whether the folder of an ensemble's samples is empty: killed before the first one."""
    return points.is_dir() and not any(points.glob("*.json"))


def _refuse_strange(
    stores: Sequence[OutcomeStore[Outcome]], keys: Iterable[str], *, merge: bool
) -> None:
    """Check that stores have samples of this ensemble.

    An ensemble that was killed before its first sample may begin again.

    Parameters
    ----------
    keys
        Keys of the samples of this ensemble.
    merge
        Whether the stores are those of parts to be merged.

    Raises
    ------
    CaseError
        If a folder has none of the samples.
    """
    for store in stores:
        if not merge and _has_no_sample_yet(store.folder):
            continue
        if not any(store.outcome(key) for key in keys):
            raise CaseError(
                f"{store.folder.parent}: has no sample of this ensemble that these sources "
                "computed: look at case, --seed and --set"
            )


def _copy(
    keys: Iterable[str],
    part_stores: Sequence[OutcomeStore[Outcome]],
    store: OutcomeStore[Outcome],
) -> None:
    """Copy the outcomes of samples from the stores of parts into a store; called on rank 0.

    Parameters
    ----------
    keys
        Keys of the samples.
    """
    for key in keys:
        # the first part that has a usable outcome
        part_store = next((part for part in part_stores if part.outcome(key)), None)
        # one of the parts may be in the folder itself
        if part_store and part_store.file(key).resolve() != store.file(key).resolve():
            write_whole(store.file(key), part_store.file(key).read_bytes())


def _row(variants: Sequence[Sample], store: OutcomeStore[Outcome], scalar: Scalar) -> Row:
    """Return the row of a sample in samples.csv.

    Parameters
    ----------
    variants
        The sample; and if wanted its variant without the weakest defects, whose result is a further
        column.
    """
    rows = [make_row(sample, store.outcome(sample.key), scalar) for sample in variants]
    row, *further_rows = rows
    for variant_row in further_rows:  # at most one
        row[WITHOUT] = variant_row["result"]
        # a sample counts only if both results are there
        if row["status"] == "found" and row[WITHOUT] is None:
            row |= {
                "status": variant_row["status"],
                "why": f"without the weakest defects: {variant_row['why']}",
            }
    return row


def _write(rows: Sequence[Row], content: Mapping[str, Any], folder: Path, ending: str) -> None:
    """Write table, summary, picture and report, with an ending in their names."""
    write_samples(rows, folder / f"samples{ending}.csv")
    write_object(folder / f"summary{ending}.json", content)
    draw_ensemble(rows, content["result"], folder / f"ensemble{ending}.png")
    write_whole(folder / f"report{ending}.md", report(content, rows, ending).encode())


def solve(sample: Sample, scalar: Scalar, folds: KnownFolds) -> Outcome:
    """Compute a sample on this rank; an error ends the sample, not the ensemble.

    Parameters
    ----------
    folds
        Folds of earlier samples on this rank, from which the fold of this sample may be found.
    """
    start_wall, start_cpu = time.perf_counter(), time.process_time()
    try:
        outcome = _solved(sample, scalar, folds)
    except Exception as e:  # whatever it is, the other samples go on, and the table names it
        reason = f"{FAILED}{'' if isinstance(e, MeshError) else f'{type(e).__name__}: '}{e}"
        outcome = Outcome.failed(" ".join(reason.split()))
    wall_s, cpu_s = time.perf_counter() - start_wall, time.process_time() - start_cpu
    return replace(outcome, wall_s=round(wall_s, 3), cpu_s=round(cpu_s, 3))


def _solved(sample: Sample, scalar: Scalar, folds: KnownFolds) -> Outcome:
    """Compute a sample; its errors are those of the run.

    A knockdown is found from the fold of an earlier sample. If that fails, the path is followed, as
    for every other result.

    Parameters
    ----------
    scalar
        The wanted number.
    folds
        Folds of earlier samples on this rank.
    """
    # imperfections may be modes of the perfect shell, which are computed first
    problem = with_modes(sample.case.problem(), MPI.COMM_SELF)
    if scalar.name != "knockdown" or not has_knockdown(sample.case):
        result = run(problem, comm=MPI.COMM_SELF)
        return outcome_of(result, estimates=result.error_estimates)
    scene = Scene(problem, MPI.COMM_SELF)
    try:
        # from the nearest known fold on the same mesh
        # without an estimate of its error, which would take as long as the fold
        return outcome_of(result_of_fold(scene, folds.follow(sample.values, scene)), "fold")
    except FoldLost:
        return _outcome_along_path(sample, scene, folds)


def _outcome_along_path(sample: Sample, scene: Scene, folds: KnownFolds) -> Outcome:
    """Follow the path of a sample to its fold, or to the end.

    The fold is tried from the first points of the path that lead to it. So the rest of the path
    is not needed.
    """
    result, row_maker, tries_left = Result(scene, scene.unloaded()), RowMaker(scene), MOST_TRIES
    try:
        for record in follow_alone(scene, search=True, remark=result.remarks.append):
            result.rows.append(row_maker.row(record, wall_s=0.0))
            # points of the pressure's path alone lead to its fold
            if record.amplitude != "pressure":
                continue
            if record.mode or record.label == "bifurcation":
                continue
            # the guess is the point itself if it is a fold; a stable point may show the fold ahead
            point, guess = record.point, None
            is_stable_step = record.label == "step" and not point.negative_pivots
            if record.label == "fold":
                guess = FoldGuess(point.state, point.du)
            elif is_stable_step and tries_left:
                guess = fold_ahead(scene.newton, point, "pressure")
                tries_left -= guess is not None  # only a guess costs a try
            if guess is None:
                continue
            try:
                fold = folds.refined(sample.values, scene, guess)
            except FoldLost:
                continue
            # a fold that was found from a stable point must lie ahead on this path
            if record.label == "fold" or fold.value > point.state.mu["pressure"]:
                fold_result = result_of_fold(scene, fold)
                return outcome_of(fold_result, "fold", estimates=fold_result.error_estimates)
    except Stopped as e:
        result.stopped = str(e)
    return outcome_of(result)
