"""Walks by arc length on a toy with snap-through, snap-back and a pitchfork, all known in closed
form.
"""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from continuation.toys import Toy, closed_loop, column_of_modes, pitchfork, snap_back

from magshell_fenicsx.continuation.bifurcation import switch_branch
from magshell_fenicsx.continuation.continuation_run import (
    ContinuationGoal,
    ContinuationRun,
    Label,
    _InstabilityLocator,
    instabilities,
)
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import PathStopped, Point, StepOptions, StepTooLong
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.continuation.targets import TargetMissed, targets_between

K, C = 0.4, 1.9
FOLDS = 1 - 1 / np.sqrt(3), 1 + 1 / np.sqrt(3)


def f(x: float) -> float:
    return x**3 - 3 * x**2 + 2 * x


def begin(first: float = 0.05, largest: float = 0.2) -> tuple[Path, Point]:
    toy = snap_back(K, C)
    path = Path(BorderedNewton(toy), "load", "arc", StepOptions(first, largest, 1e-7))
    return path, path.start(State(np.zeros(3), {"load": 0.0}))


def walked(
    goal: ContinuationGoal, first: float = 0.05, largest: float = 0.2
) -> list[tuple[Label, Point]]:
    return list(ContinuationRun(*begin(first, largest), goal))


@pytest.mark.parametrize(("first", "largest"), [(0.01, 0.05), (0.05, 0.2), (0.3, 0.6)])
def test_all_events_of_the_path_are_located(first: float, largest: float) -> None:
    path = walked(ContinuationGoal("target", [4.0], "conjugate"), first, largest)
    events = [(label, point) for label, point in path if label in ("fold", "bifurcation")]
    assert [label for label, _ in events] == ["fold", "fold", "bifurcation"]
    assert [point.negative_pivots for _, point in events[:2]] == [0, 1]  # as before each
    for (_, point), x in zip(events, (*FOLDS, C), strict=True):
        assert point.state.mu["load"] == pytest.approx(f(x), rel=1e-8)
        assert point.state.u[1] == pytest.approx(x, abs=1e-4)
    assert path[-1][1].state.u[0] == pytest.approx(4.0, abs=1e-9)


def test_path_passes_the_snap_back_and_its_stability_is_told() -> None:
    turns = 1 - np.sqrt((1 - K) / 3), 1 + np.sqrt((1 - K) / 3)
    backwards = 0
    for label, point in walked(ContinuationGoal("target", [4.0], "conjugate")):
        if label == "step":
            q, x, _ = point.state.u
            assert point.state.mu["load"] == pytest.approx(f(x), abs=1e-8)
            assert q == pytest.approx(x + f(x) / K, abs=1e-8)
            assert point.negative_pivots == (FOLDS[0] < x < FOLDS[1]) + (x > C)
            assert point.negative_pivots_held == (turns[0] < x < turns[1]) + (x > C)
            backwards += turns[0] < x < turns[1]
    assert backwards > 2


@pytest.mark.parametrize("below", [0.2849, 1e-4, 1e-6])
def test_targets_are_met_on_every_part_of_the_path(below: float) -> None:
    """q = 1 is passed once; a load below the fold three times, twice in one step where it is just
    below.
    """
    target = f(FOLDS[0]) - below
    roots = np.sort(np.roots([1, -3, 2, -target]).real)
    loads = [
        p.state.u[1]
        for label, p in walked(ContinuationGoal("points", [target], "load", steps=60))
        if label == "target"
    ]
    assert np.sort(loads)[:3] == pytest.approx(roots, abs=1e-9)
    label, point = walked(ContinuationGoal("target", [target], "load"))[-1]
    assert (label, point.state.u[1]) == ("target", pytest.approx(roots[0], abs=1e-9))


@pytest.mark.parametrize("largest", [0.2, 0.6])
def test_a_walk_ends_close_behind_its_last_target(largest: float) -> None:
    """The factors of the step behind it serve there too, and the state is the toy's own."""
    label, point = walked(ContinuationGoal("target", [0.3], "load"), 0.05, largest)[-1]
    assert (label, point.factorisations) == ("target", 0)
    root = np.roots([1, -3, 2, -0.3]).real.min()
    assert point.state.u[1] == pytest.approx(root, abs=1e-9)
    assert (point.negative_pivots, point.negative_pivots_held) == (0, 0)


@pytest.mark.parametrize(("until", "x"), [("limit", FOLDS[0]), ("bifurcation", C)])
def test_walk_ends_where_it_shall(until: str, x: float) -> None:
    label, point = walked(ContinuationGoal(until))[-1]  # type: ignore[arg-type]
    assert label == ("fold" if until == "limit" else "bifurcation")
    assert point.state.mu["load"] == pytest.approx(f(x), rel=1e-8)


def test_number_of_steps() -> None:
    assert [label for label, _ in walked(ContinuationGoal("points", steps=7))].count("step") == 7


def test_too_long_a_walk_is_stopped() -> None:
    with pytest.raises(PathStopped, match="4 steps have not reached the bifurcation"):
        walked(ContinuationGoal("bifurcation", steps=4))


def test_both_branches_of_the_pitchfork() -> None:
    path, start = begin()
    *_, (_, point) = ContinuationRun(path, start, ContinuationGoal("bifurcation"))
    found = switch_branch(path, point)
    assert found is not None
    assert found.symmetric
    for first, sense in zip(found.starts, (1, -1), strict=True):
        sides = []
        for _, p in [
            ("step", first),
            *ContinuationRun(path, first, ContinuationGoal("points", steps=10)),
        ]:
            _, x, v = p.state.u
            assert v**2 == pytest.approx(x - C, abs=1e-8)
            assert p.state.mu["load"] == pytest.approx(f(x) - (x - C) / 2, abs=1e-8)
            sides.append(np.sign(v))
        assert len(set(sides)) == 1
        assert np.sign(found.starts[0].state.u[2]) * sides[0] == sense


def test_asymmetric_branch_is_told() -> None:
    """u^2/2 + (1 - u) v^2/2 + v^3/3: load = u - v^2/2 and v = u - 1 on the branch, which rises one
    way.
    """
    toy = pitchfork()
    base_gradient, base_hessian = toy.gradient, toy.hessian
    toy.gradient = lambda x: base_gradient(x) + np.array([0.0, x[1] ** 2 - x[1] ** 3])
    toy.hessian = lambda x: base_hessian(x) + np.diag([0.0, 2 * x[1] - 3 * x[1] ** 2])
    toy.length = 0.1
    path = Path(BorderedNewton(toy), "load", "arc", StepOptions(0.3, 0.5, 1e-6))
    *_, (label, point) = ContinuationRun(
        path, path.start(State(np.zeros(2), {"load": 0.0})), ContinuationGoal("limit")
    )
    assert label == "bifurcation"
    assert point.state.mu["load"] == pytest.approx(1.0, rel=1e-8)
    found = switch_branch(path, point)
    assert found is not None
    assert not found.symmetric
    for start in found.starts:
        u, v = start.state.u
        assert v == pytest.approx(u - 1, abs=1e-8)
        assert start.state.mu["load"] == pytest.approx(u - v**2 / 2, abs=1e-8)


def test_a_closed_loop_is_told() -> None:
    """Four folds on the circle; the walk ends at the first of them, met again."""
    path = Path(BorderedNewton(closed_loop()), "load", "arc", StepOptions(0.05, 0.1, 1e-7))
    walk, folds = (
        ContinuationRun(
            path,
            path.start(State(np.array([1.0, 0.0]), {"load": 0.0})),
            ContinuationGoal("points", steps=900),
        ),
        [],
    )
    with pytest.raises(PathStopped, match="come back to this fold: a closed loop"):  # noqa: PT012
        for label, point in walk:
            folds += [point.state.mu["load"]] if label == "fold" else []
    assert folds == pytest.approx([1, -1, 1, -1, 1], rel=1e-8)


@pytest.mark.filterwarnings("ignore:.*encountered in")
def test_a_renewal_that_fails_shortens_the_step() -> None:
    """Far from the first of two points other amplitudes have no solution: nearer to it the walk
    goes on.
    """
    refused, wild = list[float](), State(np.full(3, 1e200), {"load": 0.0})

    def renew(low: Point, high: Point) -> State | None:
        if (length := abs(high.s - low.s)) <= 0.02:
            return None
        refused.append(length)
        return wild

    path, start = begin(0.1, 0.2)
    walk = ContinuationRun(path, start, ContinuationGoal("points", steps=5), renew)
    steps = [point for _, point in walk]
    assert len(steps) == 5
    assert refused[:4] == pytest.approx([0.1, 0.1, 0.025, 0.025])  # each is asked for again
    assert np.diff([start.s, *(point.s for point in steps)]).max() <= 0.02


@pytest.mark.filterwarnings("ignore:.*encountered in")
def test_a_renewal_that_need_not_be_leaves_the_steps() -> None:
    """Where other amplitudes have no solution, and are not asked for again, the point that was
    found counts.
    """
    asked, wild = list[float](), State(np.full(3, 1e200), {"load": 0.0})

    def renew(low: Point, high: Point) -> State | None:
        if low.s in asked:
            return None
        asked.append(low.s)
        return wild

    goal = ContinuationGoal("points", steps=5)
    steps = [point.s for _, point in ContinuationRun(*begin(0.1, 0.2), goal, renew)]
    assert len(asked) == 5
    assert steps == pytest.approx([point.s for _, point in walked(goal, 0.1, 0.2)], rel=1e-12)


def test_a_refused_target_is_approached_in_shorter_steps() -> None:
    """As where a body is too deep there, and its stiffness rises at the end of a step: the last
    accepted point is then near it. A target that is refused for ever ends the walk with the reason.
    """
    given = ContinuationGoal("target", [0.3], "load")
    walk = ContinuationRun(*begin(0.3, 0.6), given)
    assert len([*walk]) < 4
    near = ContinuationRun(*begin(0.3, 0.6), given, None, lambda point: refused(near, point, 0.05))

    def refused(run: ContinuationRun, point: Point, within: float) -> str:
        here = run.points[-1].state.mu["load"]
        return "too deep" if abs(point.state.mu["load"] - here) > within else ""

    *_, (label, last) = near
    assert label == "target"
    assert last.state.mu["load"] == pytest.approx(0.3, rel=1e-9)
    assert last.state.mu["load"] - near.points[-2].state.mu["load"] <= 0.05
    with pytest.raises(PathStopped, match="too deep"):
        list(ContinuationRun(*begin(0.3, 0.6), given, None, lambda point: "too deep"))


def test_targets_between_two_points_take_few_iterations_in_any_order() -> None:
    """Long steps with several targets within each, passed upwards and downwards: the polynomial is
    a good guess.
    """
    targets = [0.05, 0.1, 0.15, 0.2, 0.25, 0.3]
    found = [
        p
        for label, p in walked(ContinuationGoal("points", targets, "load", steps=14), 0.3, 0.6)
        if label == "target"
    ]
    x = np.array([p.state.u[1] for p in found])
    exact = [np.sort(np.roots([1, -3, 2, -mu]).real)[k] for mu in targets for k in range(2)]
    assert np.sort(x)[:12] == pytest.approx(np.sort(exact), abs=1e-9)
    assert np.mean([p.iterations for p in found]) < 4
    assert np.all(np.diff(x) > 0)  # in the order of the path


def along_column(toy: Toy, control: str, goal: ContinuationGoal) -> ContinuationRun:
    path = Path(BorderedNewton(toy), "load", control, StepOptions(0.03, 0.03, 1e-6))
    u = np.zeros(toy.size)
    u[0] = 0.7013
    return ContinuationRun(path, path.start(State(u, {"load": u[0]})), goal)


@pytest.mark.parametrize("control", ["load", "arc"])
@pytest.mark.parametrize("count", [2, 6])
def test_a_cluster_of_modes_is_passed(control: str, count: int) -> None:
    """Modes 1e-9 apart, with no point within 1e-4 of them."""
    toy, solves = column_of_modes(1e-9, 1e-4, count), list[float]()
    tangent = toy.tangent
    toy.tangent = lambda u, mu, stress=(): (solves.append(u[0]), tangent(u, mu, stress))[1]  # type: ignore[method-assign]
    walk = along_column(toy, control, ContinuationGoal("target", [1.5]))
    labels = [label for label, _ in walk]
    assert labels[-1] == "target"
    assert labels.count("bifurcation") == 1
    assert walk.points[-1].negative_pivots == count
    ((low, high),) = walk.clusters
    assert low.state.mu["load"] < 1 - 1e-4
    assert high.state.mu["load"] > 1 + 1e-4
    assert high.negative_pivots - low.negative_pivots == count
    assert low.load_error == pytest.approx(high.state.mu["load"] - low.state.mu["load"])
    assert low.load_error < 0.004  # no step over several modes is longer
    assert len(solves) < 400


@pytest.mark.parametrize("control", ["load", "arc"])
def test_a_mode_behind_a_cluster_is_located_in_the_same_step(control: str) -> None:
    toy, u = column_of_modes(1e-9, 1e-4, 2, 1.005), np.zeros(4)
    u[0] = 0.9913
    path = Path(BorderedNewton(toy), "load", control, StepOptions(0.03, 0.03, 0.02, several=0.03))
    walk = ContinuationRun(
        path, path.start(State(u, {"load": u[0]})), ContinuationGoal("points", steps=1)
    )
    events = [point for label, point in walk if label == "bifurcation"]
    assert [point.negative_pivots for point in events] == [0, 2]
    assert events[0] is walk.clusters[0][0]
    assert events[1].state.mu["load"] == pytest.approx(1.005, rel=1e-8)


def test_a_cluster_that_must_not_be_passed_ends_the_walk() -> None:
    """No step over it is allowed once it is known as one: the end of an earlier step is tried once,
    not for ever."""
    walk = along_column(column_of_modes(1e-9, 1e-4), "load", ContinuationGoal("target", [1.5]))
    tried = list[float]()

    def refused(low: Point, high: Point) -> None:
        tried.append(high.s)
        if low.state.u[0] < 1 < high.state.u[0] and walk._budget.clustered:
            raise StepTooLong("too long")

    walk._renew = refused
    with pytest.raises(PathStopped):
        list(islice(walk, 1000))
    assert len(tried) < 200


@pytest.mark.parametrize("control", ["load", "arc"])
def test_modes_too_close_to_part_count_as_one(control: str) -> None:
    walk = along_column(column_of_modes(1e-9), control, ContinuationGoal("limit"))
    *_, (label, point) = walk
    assert label == "bifurcation"
    assert not walk.clusters
    assert point.state.mu["load"] == pytest.approx(1.0, abs=1e-5)


@pytest.fixture
def without_perfect_bifurcation(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bifurcation that a small force restores is not found, as in shells with many modes: the
    search goes on by points of the path alone."""
    monkeypatch.setattr(_InstabilityLocator, "solve_bifurcation", lambda *_: None)


@pytest.mark.usefixtures("without_perfect_bifurcation")
def test_two_paths_of_an_imperfect_pitchfork_hold_no_instability_between_them() -> None:
    """(1 - load) v + v^3 = 1e-5: one path is stable; the other, with one unstable direction, ends
    at a fold."""
    imperfection = 1e-5
    newton = BorderedNewton(pitchfork(imperfection))
    path, ends = Path(newton, "load", "load", StepOptions(0.4, 0.4, 1e-6)), []
    for load in (0.8, 1.2):
        v = min(np.roots([1, 0, 1 - load, -imperfection]), key=abs).real
        ends.append(path.start(State(np.array([load + v**2 / 2, v]), {"load": load})))
    assert [end.negative_pivots for end in ends] == [0, 1]
    before = newton.factorisation.count
    with pytest.raises(PathStopped, match="another branch"):
        list(instabilities(path, *ends))
    assert newton.factorisation.count - before < 400


def along_imperfect_column(
    imperfection: float, stiffening: float, goal: ContinuationGoal, max_solves: int = 60
) -> ContinuationRun:
    newton = BorderedNewton(pitchfork(imperfection, stiffening))
    options = StepOptions(0.03, 1.5, 3e-7, max_location_solves=max_solves)
    path = Path(newton, "load", "arc", options)
    start = path.start(State(np.array([0.0, imperfection]), {"load": 0.0}))
    return ContinuationRun(path, start, goal)


@pytest.mark.usefixtures("without_perfect_bifurcation")
def test_the_fold_of_a_perturbed_bifurcation_is_found_between_two_branches() -> None:
    """Koiter's fold at 1 - 3 (imperfection/2)^(2/3), where the perfect column would bifurcate at 1:
    the step has jumped to the other branch, from which it is not located."""
    imperfection = 1e-6
    walk = along_imperfect_column(imperfection, -0.5, ContinuationGoal("limit"))
    *_, (label, point) = walk
    assert label == "fold"
    assert point.state.mu["load"] == pytest.approx(1 - 3 * (imperfection / 2) ** (2 / 3), rel=1e-8)
    assert walk.path.solves < 35
    assert not walk.clusters


@pytest.mark.usefixtures("without_perfect_bifurcation")
def test_the_stable_branch_of_a_perturbed_bifurcation_is_followed() -> None:
    """v^3 + (1 - load) v = 1e-7 has a stable path to any load, which turns sharply at 1."""
    walk = along_imperfect_column(1e-7, 1.0, ContinuationGoal("target", [1.6]))
    labels = [label for label, _ in walk]
    assert "bifurcation" not in labels
    assert walk.points[-1].negative_pivots == 0


@pytest.mark.usefixtures("without_perfect_bifurcation")
def test_a_search_that_may_not_go_on_tells_what_it_knows() -> None:
    """After so many solves the last point before the instability stands for it, with the width that
    is left as its error."""
    imperfection = 1e-6
    walk = along_imperfect_column(imperfection, -0.5, ContinuationGoal("limit"), max_solves=4)
    *_, (label, point) = walk
    assert label == "bifurcation"
    fold = 1 - 3 * (imperfection / 2) ** (2 / 3)
    load = point.state.mu["load"]
    assert load < fold < load + point.load_error < load + 0.1
    assert walk.path.solves < 20


def test_a_target_on_another_branch_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Newton's method at a prescribed load may jump to where the tangents of the path do not lead,
    as through a body: the step is then repeated in shorter ones."""
    path, start = begin()
    (_, low), (_, high) = islice(ContinuationRun(path, start, ContinuationGoal("points")), 2)
    load = (low.state.mu["load"] + high.state.mu["load"]) / 2
    ((_, point),) = targets_between(path, "load", [load], 1.0, [low, high])
    assert low.state.u[1] < point.state.u[1] < high.state.u[1]
    far_state = State(point.state.u + 5.0, point.state.mu)
    monkeypatch.setattr(path, "solve", lambda *_, **__: replace(point, state=far_state))
    with pytest.raises(TargetMissed, match="another branch"):
        list(targets_between(path, "load", [load], 1.0, [low, high]))
