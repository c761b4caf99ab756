"""The outcome of one sample, by the cheapest way that leads to it.

A knockdown is the fold of the nearest known sample on the same mesh, continued; else the fold at the end of the path of
degree 3, carried to the case's degree; else the fold at the end of the path. Each ends in Newton's method for the fold,
so that a knockdown is the same to 1e-9 by all ways. Every other result needs the path.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.fold import Fold, FoldLost, Guess
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.output.store.table import COLUMNS
from magshell_fenicsx.plan.planner import make_plan
from magshell_fenicsx.run.run import run
from magshell_fenicsx.run.summary import Result
from magshell_fenicsx.simulate.adapt.carry import NotCarried, carry
from magshell_fenicsx.simulate.adapt.ending import NoResult, by_path
from magshell_fenicsx.simulate.adapt.tolerance import CHEAP
from magshell_fenicsx.simulate.perfect import with_modes
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.studies.ensemble.known import KnownFolds
from magshell_fenicsx.studies.ensemble.samples import Sample
from magshell_fenicsx.studies.study.scalar import Scalar
from magshell_fenicsx.studies.sweep.chain import fold_row, has_knockdown
from magshell_fenicsx.studies.sweep.outcome import Found, Outcome, outcome_of

FAILED = "failed: "  # what `stopped` begins with if an error ended the sample

Way = Callable[[Sample, KnownFolds], Outcome]


def solve(sample: Sample, scalar: Scalar, known: KnownFolds) -> Outcome:
    """Compute a sample on this rank; an error ends the sample, not the ensemble."""
    start, cpu = time.perf_counter(), time.process_time()
    try:
        found = _first_found(_ways(sample.case, scalar), sample, known)
    except Exception as e:  # whatever it is, the other samples go on, and the table names it
        why = f"{FAILED}{'' if isinstance(e, MeshError) else f'{type(e).__name__}: '}{e}"
        found = Outcome(None, None, " ".join(why.split()), None, 0.0, [], "path", 0)
    spent: dict[str, Any] = {"wall_s": time.perf_counter() - start, "cpu_s": time.process_time() - cpu}
    return replace(found, **{key: round(seconds, 3) for key, seconds in spent.items()})


def serves(outcome: Outcome, scalar: Scalar) -> bool:
    """Whether an outcome has what a result needs: of a fold alone only the knockdown is known."""
    return outcome.found == "path" or scalar.name == "knockdown"


def _ways(case: Case, scalar: Scalar) -> list[Way]:
    if scalar.name != "knockdown" or not has_knockdown(case):
        return [_by_path]
    lower = case.model == "shell" and case.mesh.degree > CHEAP and not make_plan(case).axisymmetric
    return [_by_known_fold, *([_by_lower_degree] if lower else []), _by_path]


def _first_found(ways: list[Way], sample: Sample, known: KnownFolds) -> Outcome:
    *quick, last = ways
    with_modes(sample.case, MPI.COMM_SELF)
    for way in quick:
        try:
            return way(sample, known)
        except (FoldLost, NotCarried, NoResult):
            continue
    return last(sample, known)


def _by_known_fold(sample: Sample, known: KnownFolds) -> Outcome:
    if not known:
        raise FoldLost("no fold is known")
    scene = Scene(sample.case, MPI.COMM_SELF)
    return _of_fold(scene, known.follow(sample.values, scene))


def _by_lower_degree(sample: Sample, known: KnownFolds) -> Outcome:
    mesh = sample.case.mesh.model_copy(update={"degree": CHEAP})
    source = Scene(sample.case.model_copy(update={"mesh": mesh}), MPI.COMM_SELF)
    near = by_path(source)
    if near.kind != "fold" or near.name != "pressure":
        raise FoldLost("the path ends at another instability")
    scene = Scene(sample.case, MPI.COMM_SELF)
    u, phi = (carry(source, scene, v) for v in (near.state.u, near.tangent))
    found = _of_fold(scene, known.polished(sample.values, scene, Guess(State(u, dict(near.state.mu)), phi)))
    return replace(found, factorisations=found.factorisations + source.newton.factorisation.count)


def _by_path(sample: Sample, known: KnownFolds) -> Outcome:
    result = run(sample.case, comm=MPI.COMM_SELF)
    last, located = result.rows[-1], result.history.located
    if has_knockdown(sample.case) and located and last["label"] == "fold" and last["p_over_pc"] == result.knockdown:
        try:
            guess = Guess(result.last, located[-1].point.du)
            fold = known.polished(sample.values, result.scene, guess)
        except FoldLost:
            pass  # the path has located it to 1e-8
        else:
            result.rows[-1] = {**last, **fold_row(result.scene, fold)}
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
