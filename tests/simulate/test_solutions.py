"""Searches find what paths by arc length reach: the same states, without the way there."""

import os
import signal
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from conftest import CASES
from interrupted import check_same_path

import magshell_fenicsx as ms
from magshell_fenicsx.continuation.continuation_run import ContinuationGoal, ContinuationRun
from magshell_fenicsx.continuation.path import Quantity
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.output.pictures.plot import plot
from magshell_fenicsx.output.store.table import read_rows
from magshell_fenicsx.runs.summary import solutions
from magshell_fenicsx.simulate.search import dented_states
from magshell_fenicsx.simulate.stage import load_stage

ROOF = [
    "mesh.degree=3",
    "loading.control=load",
    "loading.factor=0.3",
    "loading.points=1",
    "loading.search={solutions: 2}",
]


def roof(*overrides: str) -> ms.Case:
    return ms.Case.load(CASES / "benchmarks/hinged_roof_12.7.yaml", [*ROOF, *overrides])


def apart(scene: ms.Scene, a: State, b: State) -> float:
    """The largest difference, over h."""
    return float(np.abs(a.u - b.u).max()) / scene.model.system.length


def crossings(
    scene: ms.Scene, name: str, start: State, first: float, most: int, quantity: Quantity = "load"
) -> Sequence[State]:
    """The first states on a path by arc length at which an amplitude, or its conjugate, is as at
    the start again.
    """
    path, here = load_stage(scene).begin(name, "arc", start, first, 10 * first)
    walk = ContinuationRun(
        path, here, ContinuationGoal("points", [path.value(quantity, start)], quantity)
    )
    return [
        point.state
        for _, (_, point) in zip(
            range(most), (it for it in walk if it[0] == "target"), strict=False
        )
    ]


def test_a_roof_has_snapped_through() -> None:
    """Sze's roof has three equilibria between its folds. The path by arc length passes them all."""
    result = ms.run(roof("mesh.size=127"))
    scene, found = result.scene, list(result.found.values())
    assert [row["negative_pivots"] for row in result.rows[-2:]] == [1, 0]
    for here, there in zip(found, crossings(scene, "load", result.last, 0.05, 2), strict=True):
        assert apart(scene, here, there) < 1e-8
    for it in solutions(result):
        assert it["residual"] < 1e-9
        assert it["error_over_h"] < 1e-9
    assert [it["stable"] for it in solutions(result)] == [False, True]
    by_hand = list(ms.solutions(scene, result.last, most=2))
    assert [apart(scene, a.point.state, b) < 1e-8 for a, b in zip(by_hand, found, strict=True)] == [
        True,
        True,
    ]
    back = list(by_hand[1].solutions(most=1, guesses=8))  # from the snapped roof
    assert min(apart(scene, back[0].point.state, other) for other in (result.last, found[0])) < 1e-8


@pytest.mark.slow
def test_a_search_for_stable_solutions() -> None:
    """It ends at the snapped roof: the equilibrium between, which is unstable, does not count."""
    result = ms.run(roof("mesh.size=127", "loading.search={solutions: 1, stable: true}"))
    *_, state = result.found.values()
    pivots = [row["negative_pivots"] for row in result.rows if row["label"] == "solution"]
    assert pivots[-1] == 0 < min([*pivots[:-1], 1])
    _, snapped = crossings(result.scene, "load", result.last, 0.05, 2)
    assert apart(result.scene, state, snapped) < 1e-8


@pytest.mark.slow
def test_what_a_step_holds_stays_held() -> None:
    """Sze's thin roof snaps back: under one displacement of its middle it has three equilibria, the
    second unstable.
    """
    push, more = (
        f"{{kind: dead, loads: [{{at: C, force: [-{size}, 0, 0]}}], " for size in (750, 7.5)
    )
    first = push + "control: displacement, until: target, displacement: 15.875, points: 4}"
    second = more + (
        "control: load, until: target, factor: 1, points: 1, hold: {load: conjugate}, "
        "search: {solutions: 2}}"
    )
    settings = ["mesh={degree: 3, size: 127}", f"loading=[{first}, {second}]"]
    result = ms.run(ms.Case.load(CASES / "benchmarks/hinged_roof_6.35.yaml", settings))
    scene, found = result.scene, list(result.found.values())
    assert [row["w_over_h"] for row in result.rows[-3:]] == pytest.approx([2.5] * 3, rel=1e-9)
    assert [row["negative_pivots"] for row in result.rows[-3:]] == [0, 1, 0]
    alone = State(result.last.u, {"load": result.last.mu["load"] + 0.01, "load_2": 0.0})
    on_path = crossings(scene, "load", alone, -0.05, 2, "conjugate")
    for here, there in zip(found, on_path, strict=True):
        assert apart(scene, here, there) < 1e-8
        assert here.mu["load"] + 0.01 == pytest.approx(there.mu["load"], rel=1e-8)


@pytest.mark.slow
def test_a_search_that_is_stopped_goes_on(no_pictures: None, tmp_path: Path) -> None:
    def stop(line: str) -> None:
        if " solution " in line:
            os.kill(os.getpid(), signal.SIGUSR1)

    case, whole, out = roof("mesh.size=127"), tmp_path / "whole", tmp_path / "out"
    assert ms.run(case, whole).stopped is None
    assert "SIGUSR1" in str(ms.run(case, out, say=stop).stopped)
    assert [row["label"] for row in read_rows(out / "path.csv")][-1] == "solution"
    assert len(read_rows(out / "path.csv")) < len(read_rows(whole / "path.csv"))
    resumed = ms.run(case, out, resume=True)
    assert resumed.replayed
    assert len(resumed.found) == 2
    check_same_path(out, whole)
    assert {"curve.png", "solutions.png", "report.html"} <= set(plot(out))
    report = (out / "report.html").read_text(encoding="utf-8")
    assert "A search has found 2 further solutions, 1 of them stable." in report
    assert "unstable in 1 direction<" in report


def test_a_search_whose_time_is_over_ends_the_run_well() -> None:
    result = ms.run(roof("mesh.size=127", "loading.search={seconds: 1e-6}"))
    assert result.stopped is None
    assert not result.found


@pytest.mark.slow
def test_solid_roof() -> None:
    """The solid has three equilibria near those of the shell; shear and the hinges in the middle
    line make 2 %.
    """
    shell, solid = (
        ms.run(roof("mesh={size: 127}", *more)).rows[-2:]
        for more in ([], ["model=solid", "solid={layers: 1}"])
    )
    for a, b in zip(solid, shell, strict=True):
        assert a["label"] == b["label"] == "solution"
        assert a["w_over_h"] == pytest.approx(b["w_over_h"], rel=0.03)
        assert a["negative_pivots"] == b["negative_pivots"]


def test_dents_are_mirror_images() -> None:
    """Above the fold the dented shell is the shell mirrored in a plane, below it is the shell
    itself.
    """
    half, meridian = (
        ms.Scene(
            ms.Case.load(
                CASES / "snapped.yaml",
                ["mesh.refinement=0.4", "mesh.degree=3", f"symmetry={symmetry}"],
            )
        )
        for symmetry in ("half", "axisymmetric")
    )
    depths = []
    for scene in (half, meridian):
        size = scene.model.V.dofmap.bs
        r0, dents = (
            scene.model.r0.x.array.reshape(-1, size),
            list(dented_states(scene, scene.unloaded())),
        )
        for guess in dents:
            u = guess.u.reshape(-1, size)
            assert not u[:, :-1].any()  # along e3
            top = np.argmax(r0[:, -1])
            plane = r0[top, -1] + u[top, -1] / 2
            high, low = (side * (r0[:, -1] - plane) > 0.15 for side in (1, -1))
            assert u[high, -1] == pytest.approx(2 * (plane - r0[high, -1]), abs=1e-3)
            assert u[low, -1] == pytest.approx(0.0, abs=1e-3)
        depths.append([-guess.u.min() for guess in dents])
    assert len(depths[0]) == 4
    assert depths[0] == pytest.approx(depths[1], rel=1e-2)


@pytest.mark.slow
def test_dimpled_shell_at_a_fifth_of_the_classical_pressure() -> None:
    """The dent that is the barrier, and two everted shells, are on the path far beyond the fold at
    0.326 p_c.
    """
    result = ms.run(ms.Case.load(CASES / "snapped.yaml"))
    scene = result.scene
    assert [row["label"] for row in result.rows[-4:]] == ["solution"] * 4
    on_path = crossings(scene, "pressure", result.last, 0.05, 3)
    depths = [scene.observe(state)["w_pole_over_h"] for state in on_path]
    assert depths[:2] == pytest.approx([8.2274, 155.3407], abs=1e-3)
    found = [min(apart(scene, there, here) for here in result.found.values()) for there in on_path]
    assert max(found) < 1e-8
    everted = result.rows[-4]
    assert everted["w_pole_over_h"] > 150
    assert everted["negative_pivots"] == 0 < everted["excluded_pivots"]  # waves along the edge
    assert everted["energy"] < min(scene.observe(state)["energy"] for state in on_path)
