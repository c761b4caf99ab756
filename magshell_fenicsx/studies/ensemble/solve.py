"""The outcome of one sample: its fold continued from a known one, or its path."""

import time
from dataclasses import replace

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.fold import FoldLost
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.output.store.table import COLUMNS
from magshell_fenicsx.run.run import run
from magshell_fenicsx.run.summary import Result
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.studies.ensemble.known import KnownFolds
from magshell_fenicsx.studies.ensemble.samples import Values
from magshell_fenicsx.studies.sweep.chain import fold_row, has_knockdown
from magshell_fenicsx.studies.sweep.outcome import Outcome, outcome_of

FAILED = "failed: "  # what `stopped` begins with if an error ended the sample


def solve(case: Case, values: Values, known: KnownFolds) -> Outcome:
    """Compute a sample on this rank; an error ends the sample, not the ensemble."""
    start, cpu = time.perf_counter(), time.process_time()
    try:
        found = (_by_fold(case, values, known) if has_knockdown(case) else None) or _by_path(case, values, known)
    except Exception as e:  # whatever it is, the other samples go on, and the table names it
        why = f"{FAILED}{'' if isinstance(e, MeshError) else f'{type(e).__name__}: '}{e}"
        found = Outcome(None, None, " ".join(why.split()), None, 0.0, [], "path", 0)
    spent = {"wall_s": round(time.perf_counter() - start, 3), "cpu_s": round(time.process_time() - cpu, 3)}
    return replace(found, **spent)


def _by_fold(case: Case, values: Values, known: KnownFolds) -> Outcome | None:
    """The outcome from the nearest known fold on the same mesh; None if there is none, or it leads nowhere."""
    if not known:
        return None
    scene = Scene(case, MPI.COMM_SELF)
    try:
        fold = known.follow(values, scene)
    except FoldLost:
        return None
    return _outcome(Result(scene, fold.state, [fold_row(scene, fold)]), "fold")


def _by_path(case: Case, values: Values, known: KnownFolds) -> Outcome:
    """The outcome of the path; a fold at its end is polished, so that it is the same from any side."""
    result = run(case, comm=MPI.COMM_SELF)
    last = result.rows[-1]
    if has_knockdown(case) and last["label"] == "fold" and last["p_over_pc"] == result.knockdown:
        try:
            fold = known.begin(values, result)
        except FoldLost:
            pass  # the path has located it to 1e-8
        else:
            result.rows[-1] = {**last, **fold_row(result.scene, fold)}
    return _outcome(result, "path")


def _outcome(result: Result, found: str) -> Outcome:
    work = result.scene.newton.factorisation.count
    outcome = outcome_of(result, "fold" if found == "fold" else "path", work, 0.0)
    curve = [
        {key: v if isinstance(v := row[key], str) else float(v) for key in COLUMNS if key in row} for row in result.rows
    ]
    return replace(outcome, curve=curve)
