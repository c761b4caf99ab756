"""Chains: points of a sweep along one axis, computed one after the other on one rank.

If the result is a knockdown, the fold of one point is followed to the next. The first point, and every point where
this fails, computes the full path.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.fold import Fold, FoldLost
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.parts.pressure.pressure import PressureSection
from magshell_fenicsx.problem.planner import make_plan
from magshell_fenicsx.runs.run import Result, run
from magshell_fenicsx.shape.sections import MeshSurface
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.studies.sweep.axes import Axis, along
from magshell_fenicsx.studies.sweep.continuation import Continuation
from magshell_fenicsx.studies.sweep.outcome import Outcome, outcome_of
from magshell_fenicsx.studies.sweep.points import SweepPoint
from magshell_fenicsx.studies.sweep.scenes import Scenes

Symmetry = Literal["none", "half", "axisymmetric"]
SYMMETRIES: tuple[Symmetry, ...] = (
    "none",
    "half",
    "axisymmetric",
)  # a model with an earlier symmetry covers the later ones


@dataclass(frozen=True)
class Link:
    """A point of a chain: its number in the sweep, its value on the axis, and its case."""

    number: int
    at: float
    case: Case


Chain = list[Link]


def make_chains(
    axes: Sequence[Axis], points: Sequence[SweepPoint], missing: Sequence[int], *, full_paths: bool
) -> list[Chain]:
    """Put the missing points into chains.

    Parameters
    ----------
    missing
        Numbers of the points to compute.
    full_paths
        Put each point into a separate chain, as also happens if folds cannot be followed.
    """
    axis = along(axes)
    if full_paths or axis is None:
        return [[Link(number, 0.0, points[number].case)] for number in missing]
    lines: dict[tuple[str, ...], list[int]] = {}
    for number, point in enumerate(points):
        lines.setdefault(tuple(v for key, v in point.values.items() if key not in axis.keys), []).append(number)
    return [chain for line in lines.values() for chain in _chains_of(line, axis, points, set(missing))]


def _chains_of(line: list[int], axis: Axis, points: Sequence[SweepPoint], missing: set[int]) -> list[Chain]:
    """The missing points along the axis, as one chain if their folds can be followed."""
    key = axis.keys[0]
    wanted = [Link(n, axis.number(points[n].values[key]), points[n].case) for n in line if n in missing]
    one_mesh = key.startswith("magnetic.")  # a solid's state cannot be transferred to another mesh
    followed = all(has_knockdown(link.case) and (one_mesh or link.case.model == "shell") for link in wanted)
    if len(wanted) < 2 or not followed:
        return [[link] for link in wanted]
    common = min((_symmetry(points[number].case) for number in line), key=SYMMETRIES.index)
    chain = [replace(link, case=link.case.model_copy(update={"symmetry": common})) for link in wanted]
    return [sorted(chain, key=lambda link: link.at)]


@dataclass
class Known:
    """What the chains of one rank share.

    Attributes
    ----------
    first
        The first fold of the last chain, from which that of the next one is followed if it has the same mesh.
    """

    scenes: Scenes = field(default_factory=Scenes)
    first: Continuation | None = None


def run_chain(chain: Chain, known: Known) -> Iterator[tuple[int, Outcome]]:
    """Compute a chain on this rank; number and outcome of each point."""
    continuation = known.first if len(chain) > 1 else None
    for link in chain:
        begun = link is chain[0]
        start, spent, outcome = time.perf_counter(), 0, None
        if continuation:
            outcome, spent = _by_fold(continuation, link, known.scenes, start, same_mesh=begun)
        if not outcome:
            outcome, continuation = _by_path(link, spent, start, go_on=link is not chain[-1])
        if begun:
            known.first = continuation = continuation and continuation.from_here()
        yield link.number, outcome


def _by_fold(
    continuation: Continuation, link: Link, scenes: Scenes, start: float, *, same_mesh: bool
) -> tuple[Outcome | None, int]:
    """The outcome, or None if the fold cannot be followed; and the number of factorisations."""
    try:
        scene = scenes.of(link.case)
    except MeshError:
        return None, 0
    if same_mesh and not continuation.has_mesh_of(scene):
        return None, 0
    factorisation = scene.newton.factorisation
    before = factorisation.count
    try:
        fold = continuation.follow(link.at, scene)
    except FoldLost:
        return None, factorisation.count - before
    result, work = Result(scene, fold.state, [fold_row(scene, fold)]), factorisation.count - before
    return outcome_of(result, "fold", work, time.perf_counter() - start), work


def _by_path(link: Link, spent: int, start: float, *, go_on: bool) -> tuple[Outcome, Continuation | None]:
    """The outcome of a full path, and the continuation from its fold if there is one."""
    try:
        result = run(link.case, comm=MPI.COMM_SELF)
    except MeshError as e:
        return Outcome(None, None, str(e), None, time.perf_counter() - start, [], "path", spent), None
    continuation = _begun(link.at, result) if go_on else None
    work = spent + result.scene.newton.factorisation.count
    return outcome_of(result, "path", work, time.perf_counter() - start), continuation


def _begun(at: float, result: Result) -> Continuation | None:
    last = result.rows[result.end]
    if last["label"] != "fold" or last["amplitude"] != "pressure" or last["p_over_pc"] != result.knockdown:
        return None
    try:
        return Continuation(at, result.scene, result.last)
    except FoldLost:
        return None


def fold_row(scene: Scene, fold: Fold) -> Row:
    """A fold as a row of path.csv."""
    row: Row = {
        "label": "fold",
        "amplitude": fold.name,
        **scene.observe(fold.state),
        "mode": "",
        "branch": 0,
        "load_error": 0.0,
    }
    return {**row, **scene.sizes.values(row)}


def has_knockdown(case: Case) -> bool:
    """Whether its result is a fold of the pressure that can be followed to another case."""
    loading = case.loading
    # with a tolerance each point has its own mesh; a mesh file has no chart in which states are transferred
    by_one_mesh = case.mesh.tolerance is None and not isinstance(case.shell, MeshSurface)
    return by_one_mesh and isinstance(loading, PressureSection) and loading.until == "limit" and not loading.branches


def _symmetry(case: Case) -> Symmetry:
    plan = make_plan(case)
    return "axisymmetric" if plan.axisymmetric else "half" if plan.half else "none"
