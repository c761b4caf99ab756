"""Chains of the points of a sweep, along which the fold of the pressure is followed.

A point is a case with a value for each axis of the sweep. The points along one axis are a chain,
whose members are links. The fold of one link is followed to the next; the first link, and every
link where this fails, computes the full path. A scene is the model of a case with its solver.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.continuation.fold import FoldLost
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.runs.running import Result, run
from magshell_fenicsx.simulate.gradients.instabilities import LostResult
from magshell_fenicsx.simulate.gradients.results import vibration_at_end
from magshell_fenicsx.simulate.scene_cache import SceneCache
from magshell_fenicsx.studies.folds import Continuation, has_knockdown, result_of_fold, scene_of
from magshell_fenicsx.studies.outcome import Outcome, outcome_of
from magshell_fenicsx.studies.points import Axis, Case, SweepPoint, last_numeric_axis

# a model with an earlier one of these symmetries can show what a model with a later one does
SYMMETRIES = "none", "half", "axisymmetric"
FREQUENCY_NOT_ESTIMATED = "a run with a section frequencies estimates its error, and no sweep"
MOST_UNKNOWNS = 200_000  # of the scenes that are kept: 1 GB with their factors


@dataclass(frozen=True)
class Link:
    """A point of a chain.

    Attributes
    ----------
    point
        The point of the sweep.
    at
        Its value on the axis of the chain, in the axis's unit.
    case
        The case that is computed: that of the point, with the symmetry of the whole chain.
    """

    point: SweepPoint
    at: float
    case: Case


Chain = list[Link]


def make_chains(
    axes: Sequence[Axis],
    points: Sequence[SweepPoint],
    missing: Sequence[SweepPoint],
    *,
    full_paths: bool,
) -> list[Chain]:
    """Arrange the missing points in chains along the last axis with numbers.

    Parameters
    ----------
    points
        All points of the sweep.
    missing
        Those of them to compute.
    full_paths
        Put each point into a chain of its own. The same happens if folds cannot be followed.
    """
    axis = last_numeric_axis(axes)
    if full_paths or axis is None:
        # each point alone, so its value on an axis does not matter
        return [[Link(point, at=0.0, case=point.case)] for point in missing]
    # values of the other axes -> points along the axis
    lines: dict[tuple[str, ...], list[SweepPoint]] = {}
    for point in points:
        other_values = tuple(v for key, v in point.values.items() if key not in axis.keys)
        lines.setdefault(other_values, []).append(point)
    missing_ids = {id(point) for point in missing}
    return [chain for line in lines.values() for chain in _chains_of(line, axis, missing_ids)]


def _chains_of(line: list[SweepPoint], axis: Axis, missing_ids: set[int]) -> list[Chain]:
    """Return the missing points of a line along the axis, as one chain if folds can be followed.

    All cases of a chain get the lowest symmetry among the points of the line, as a fold can only be
    followed in one kind of model.

    Parameters
    ----------
    line
        All points along the axis, with the same values on other axes.
    missing_ids
        `id` of each point to compute.
    """
    key = axis.keys[0]  # tied keys have the same values
    links = [
        Link(point, axis.number(point.values[key]), point.case)
        for point in line
        if id(point) in missing_ids
    ]
    # a fold is followed between cases that end at one; the state of a solid cannot be transferred
    # to another mesh
    one_mesh = key.startswith("magnetic.")

    def can_be_followed(link: Link) -> bool:
        """Return whether the fold of a case can be followed along the line."""
        if not has_knockdown(link.case):
            return False
        return one_mesh or link.case.model == "shell"

    if len(links) < 2 or not all(can_be_followed(link) for link in links):
        return [[link] for link in links]
    lowest_symmetry = min((_symmetry(point.case) for point in line), key=SYMMETRIES.index)
    chain = [
        replace(link, case=link.case.model_copy(update={"symmetry": lowest_symmetry}))
        for link in links
    ]
    return [sorted(chain, key=lambda link: link.at)]


def _symmetry(case: Case) -> str:
    """Return the symmetry of the model of a case, one of `SYMMETRIES`."""
    problem = case.problem()
    return "axisymmetric" if problem.axisymmetric else "half" if problem.is_half else "none"


@dataclass
class SweepCache:
    """Scenes and folds that the chains of one rank share.

    A scene is the model of a case with its solver.

    Attributes
    ----------
    columns
        Columns of path.csv that the outcomes of all runs keep.
    frequency
        Name of a natural frequency, such as "hertz_1", that the last point of each path gets; empty
        without.
    scenes
        The scenes that were used last.
    first
        Continuation from the first fold of the last chain. The first fold of the next chain is
        followed from it, if both have the same mesh.
    """

    columns: Sequence[str]
    frequency: str = ""
    scenes: SceneCache = field(
        default_factory=partial(SceneCache, MPI.COMM_SELF, max_unknowns=MOST_UNKNOWNS)
    )
    first: Continuation | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what makes an empty cache in another process: scenes belong to theirs."""
        return type(self), (self.columns, self.frequency)


def run_chain(chain: Chain, folds: SweepCache) -> Iterator[tuple[SweepPoint, Outcome]]:
    """Compute a chain on this rank; yield each point with its outcome.

    The fold of a point is followed from the point before. Where this fails, the full path is
    computed.

    Parameters
    ----------
    folds
        Scenes and folds of the chains on this rank; it gets the first fold of this chain.
    """
    # None: there is no fold to follow, so the path is computed
    continuation = folds.first if len(chain) > 1 else None
    for link in chain:
        is_first, is_last = link is chain[0], link is chain[-1]
        start_time, factorisations, outcome = time.perf_counter(), 0, None
        if continuation:
            # the first point takes the fold of another chain, which serves only on the same mesh
            outcome, factorisations = _by_fold(
                continuation, link, folds, start_time, same_mesh=is_first
            )
        if not outcome:
            outcome, continuation = _by_path(
                link, folds, factorisations, start_time, go_on=not is_last
            )
        if is_first:
            # a continuation without earlier folds, for this chain and for the begin of the next
            continuation = continuation.from_here() if continuation else None
            folds.first = continuation
        yield link.point, outcome


def _by_fold(
    continuation: Continuation, link: Link, folds: SweepCache, start: float, *, same_mesh: bool
) -> tuple[Outcome | None, int]:
    """Follow a known fold to a point of a chain.

    Parameters
    ----------
    continuation
        Follows the known fold.
    link
        The point.
    folds
        Gives the scene of the point.
    start
        Time at which the point was begun, of `time.perf_counter`.
    same_mesh
        Whether the fold is followed only if the point has the mesh of the continuation.

    Returns
    -------
    outcome
        The outcome; None if the fold cannot be followed.
    work
        Number of factorisations, of failed attempts too.
    """
    try:
        scene = scene_of(link.case, folds.scenes)
    except MeshError:  # `_by_path` will report it
        return None, 0
    if same_mesh and not continuation.has_mesh_of(scene):
        return None, 0
    factorisation = scene.newton.factorisation
    count_before = factorisation.count
    try:
        fold = continuation.follow(link.at, scene)
    except FoldLost:
        return None, factorisation.count - count_before
    work = factorisation.count - count_before
    result = result_of_fold(scene, fold)
    estimates, wall_s = result.error_estimates, time.perf_counter() - start
    return outcome_of(result, "fold", work, wall_s, folds.columns, estimates), work


def _by_path(
    link: Link, folds: SweepCache, factorisations: int, start: float, *, go_on: bool
) -> tuple[Outcome, Continuation | None]:
    """Compute the full path of a point of a chain.

    Parameters
    ----------
    folds
        Says what the outcome keeps.
    factorisations
        Number of factorisations that earlier attempts at the point took.
    start
        Time at which the point was begun, of `time.perf_counter`.
    go_on
        Whether a continuation from the fold is wanted.

    Returns
    -------
    outcome
        The outcome; a failed one if the case cannot be meshed.
    continuation
        Continuation from the fold; None if not wanted or without a fold to follow.
    """
    try:
        result = run(link.case.problem(), comm=MPI.COMM_SELF)
    except MeshError as e:
        return Outcome.failed(str(e), time.perf_counter() - start, factorisations), None
    continuation = _continuation_from(link.at, result) if go_on else None
    work = factorisations + result.scene.newton.factorisation.count
    estimates, wall_s = result.error_estimates, time.perf_counter() - start
    outcome = outcome_of(result, "path", work, wall_s, folds.columns, estimates)
    if folds.frequency:
        outcome.curve[result.end] |= _frequency_at_end(result, folds.frequency)
        outcome.errors_not_estimated[f"{folds.frequency}@end"] = FREQUENCY_NOT_ESTIMATED
    return outcome, continuation


def _frequency_at_end(result: Result, name: str) -> dict[str, float]:
    """Return a natural frequency where a run ended, by its name; empty if it has none."""
    if result.stopped:
        return {}
    try:
        value = vibration_at_end(result.scene, result.path_history, name)
    except LostResult:
        return {}
    return {} if value is None else {name: value}


def _continuation_from(parameter: float, result: Result) -> Continuation | None:
    """Return a continuation from the fold at which a run ended.

    None if the run has not ended at the fold of its knockdown, or the fold is not found again.

    Parameters
    ----------
    parameter
        Value of the chain's axis for this run.
    """
    last_row = result.rows[result.end]
    is_pressure_fold = last_row["label"] == "fold" and last_row["amplitude"] == "pressure"
    if not is_pressure_fold or last_row["p_over_pc"] != result.knockdown:
        return None
    try:
        return Continuation(parameter, result.scene, result.last)
    except FoldLost:
        return None
