"""The outcome of one sample, by the cheapest way that leads to it.

A knockdown is the fold of the nearest known sample on the same mesh, continued; else the fold that Newton's method
finds from one of the first points of the path; else the fold at its end. Each ends in Newton's method for the fold, so
that a knockdown is the same to 1e-9 by all ways. Every other result needs the path.
"""

import time
from dataclasses import replace
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.continuation.ahead import fold_ahead
from magshell_fenicsx.continuation.fold import Fold, FoldLost, Guess
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.output.store.table import COLUMNS
from magshell_fenicsx.runs.rows import RowMaker
from magshell_fenicsx.runs.run import run
from magshell_fenicsx.runs.summary import Result
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.perfect import with_modes
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.studies.ensemble.known import KnownFolds
from magshell_fenicsx.studies.ensemble.samples import Sample
from magshell_fenicsx.studies.study.scalar import Scalar
from magshell_fenicsx.studies.sweep.chain import fold_row, has_knockdown
from magshell_fenicsx.studies.sweep.outcome import Found, Outcome, outcome_of

MOST_TRIES = 2  # points of the path from which the fold ahead is tried
FAILED = "failed: "  # what `stopped` begins with if an error ended the sample


def solve(sample: Sample, scalar: Scalar, known: KnownFolds) -> Outcome:
    """Compute a sample on this rank; an error ends the sample, not the ensemble."""
    start, cpu = time.perf_counter(), time.process_time()
    try:
        found = _found(sample, scalar, known)
    except Exception as e:  # whatever it is, the other samples go on, and the table names it
        why = f"{FAILED}{'' if isinstance(e, MeshError) else f'{type(e).__name__}: '}{e}"
        found = Outcome(None, None, " ".join(why.split()), None, 0.0, [], "path", 0)
    spent: dict[str, Any] = {"wall_s": time.perf_counter() - start, "cpu_s": time.process_time() - cpu}
    return replace(found, **{key: round(seconds, 3) for key, seconds in spent.items()})


def serves(outcome: Outcome, scalar: Scalar) -> bool:
    """Whether an outcome has what a result needs: of a fold alone only the knockdown is known."""
    return outcome.found == "path" or scalar.name == "knockdown"


def _found(sample: Sample, scalar: Scalar, known: KnownFolds) -> Outcome:
    with_modes(sample.case, MPI.COMM_SELF)
    if scalar.name != "knockdown" or not has_knockdown(sample.case):
        return _outcome(run(sample.case, comm=MPI.COMM_SELF), "path")
    scene = Scene(sample.case, MPI.COMM_SELF)
    try:
        return _of_fold(scene, known.follow(sample.values, scene))
    except FoldLost:
        return _along_path(sample, scene, known)


def _along_path(sample: Sample, scene: Scene, known: KnownFolds) -> Outcome:
    """The fold from the first point of the path that leads to it, or the end of the path."""
    result, made, tries = Result(scene, scene.unloaded()), RowMaker(scene), MOST_TRIES
    try:
        for record in follow(scene, remark=result.remarks.append):
            result.rows.append(made.row(record, 0.0))
            if record.amplitude != "pressure" or record.mode or record.label == "bifurcation":
                continue
            guess = Guess(record.point.state, record.point.du) if record.label == "fold" else None
            if record.label == "step" and tries and not record.point.negative_pivots:
                guess = fold_ahead(scene.newton, record.point, "pressure")
                tries -= guess is not None
            if guess is None:
                continue
            try:
                fold = known.polished(sample.values, scene, guess)
            except FoldLost:
                continue
            if record.label == "fold" or fold.value > record.point.state.mu["pressure"]:
                return _of_fold(scene, fold)
    except Stopped as e:
        result.stopped = str(e)
    return _outcome(result, "path")


def _of_fold(scene: Scene, fold: Fold) -> Outcome:
    return _outcome(Result(scene, fold.state, [fold_row(scene, fold)]), "fold")


def _outcome(result: Result, found: Found) -> Outcome:
    """With all columns of path.csv that every run has."""
    outcome = outcome_of(result, found, result.scene.newton.factorisation.count, 0.0)
    curve = [
        {key: v if isinstance(v := row[key], str | int) else float(v) for key in COLUMNS if key in row}
        for row in result.rows
    ]
    return replace(outcome, curve=curve)
