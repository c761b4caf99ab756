"""Imperfections that grow while other loads are held.

Independent sources: shells that have the imperfection from the start, and central differences.
"""

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from interrupted import check_same_path

import magshell_fenicsx as ms
from magshell_fenicsx.continuation.fold import FoldGuess, find_fold
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.simulate.sensitivity import sensitivities
from magshell_fenicsx.simulate.steps import fold_at

PRESSED = {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.45, "points": 1}
DIMPLE = {"kind": "dimple", "amplitude": 1.64, "width": 3.2}
GROWS = {"kind": "imperfection"}


def case(*loading: dict[str, Any], imperfections: Any = (DIMPLE,), **others: Any) -> ms.Case:
    shell = {"geometry": "hemisphere", "radius_to_thickness": 20, "poisson_ratio": 0.5}
    data = {
        "shell": {**shell, "imperfections": list(imperfections)},
        "boundary": {"equator": "clamped"},
        "loading": list(loading),
        "mesh": {"refinement": 0.4},
    }
    return ms.Case.from_source(data | others)


@pytest.mark.parametrize("symmetry", ["axisymmetric", "half"])
def test_derivatives_and_the_shell_that_has_it_from_the_start(symmetry: str) -> None:
    """At any state in a field under pressure.

    A second imperfection, by formula, grows by itself.
    """
    smooth = {"kind": "formula", "w0": "0.5*(x**2 + y**2)"}
    common: dict[str, Any] = {
        "symmetry": symmetry,
        "mesh": {"degree": 3, "refinement": 0.3},
        "magnetic": {"lambda_m": 0.01},
    }
    steps = {"kind": "field", "until": "target"}, PRESSED, {**GROWS, "item": 0, "factor": 1}
    grown = ms.Scene(
        case(*steps, {**GROWS, "item": 1, "factor": 1}, imperfections=(DIMPLE, smooth), **common)
    )
    system, first, second = grown.model.system, "imperfection", "imperfection_2"
    x = grown.model.r0.x.array[: system.size]
    u = system.zero_at_supports(0.02 * np.sin(7 * x))
    mu = {**grown.unloaded().mu, "pressure": 0.3, "lambda_m": 0.01, first: 0.7, second: -0.4}
    other = {**mu, first: 0.2}
    size = 1e-3

    def slope(of: Any, name: str) -> Any:
        """By central differences of fourth order."""
        ahead = [of({**mu, name: mu[name] + i * size}) for i in (-2, -1, 1, 2)]
        return (ahead[0] - 8 * ahead[1] + 8 * ahead[2] - ahead[3]) / (12 * size)

    def total(at: dict[str, float]) -> float:
        energies = system.energies(u, at)
        return float(
            sum((at[t.amplitude] if t.amplitude else 1) * energies[t.name] for t in system.terms)
        )

    for name in (first, second):
        column = system.load(u, mu, name)
        assert (
            np.abs(column - slope(lambda at: system.residual(u, at), name)).max()
            < 1e-7 * np.abs(column).max()
        )
        assert system.potential(u, mu, name) == pytest.approx(slope(total, name), rel=1e-7)
        for beside in (first, second, "pressure", "lambda_m"):
            bend = slope(lambda at, beside=beside: system.potential(u, at, beside), name)
            assert system.curvature(u, mu, name, beside) == pytest.approx(bend, rel=1e-5)
            assert system.curvature(u, mu, beside, name) == pytest.approx(bend, rel=1e-5)
    assert (
        np.abs(system.load(u, other, first) - system.load(u, mu, first)).max()
        > 1e-3 * np.abs(column).max()
    )

    v = system.zero_at_supports(np.cos(5 * x))

    def along_v(of: Any) -> Any:
        ahead = [of(u + i * 1e-4 * v) for i in (-2, -1, 1, 2)]
        return (ahead[0] - 8 * ahead[1] + 8 * ahead[2] - ahead[3]) / 12e-4

    def energy(w: Any) -> float:
        found = system.energies(w, mu)
        return float(
            sum((mu[t.amplitude] if t.amplitude else 1) * found[t.name] for t in system.terms)
        )

    residual = system.residual(u, mu)
    assert residual @ v == pytest.approx(
        along_v(energy), rel=1e-7
    )  # forms, which take the placement itself
    K = system.tangent(u, mu)
    v_, Kv = K.createVecs()
    v_.array[:] = v
    K.mult(v_, Kv)
    by_residuals = along_v(lambda w: system.residual(w, mu))
    assert np.abs(Kv.array - by_residuals).max() < 1e-6 * np.abs(by_residuals).max()
    if symmetry == "half":  # its affine mesh is another one
        return
    whole = {**DIMPLE, "amplitude": 0.7 * 1.64}, {**smooth, "amplitude": -0.4}
    still = ms.Scene(case(*steps[:2], imperfections=whole, **common))
    there = {name: mu[name] for name in still.unloaded().mu}
    assert (
        np.abs(residual - still.model.system.residual(u, there)).max()
        < 1e-11 * np.abs(residual).max()
    )
    observed, known = grown.observe(State(u, mu)), still.observe(State(u, there))
    for column in ("stretching", "bending", "magnetic"):
        assert observed[column] == pytest.approx(known[column], rel=1e-10)


def test_the_depth_at_which_a_held_pressure_buckles_the_shell() -> None:
    """A shell with that depth from the start buckles at that pressure; the slopes of both are
    reciprocal.
    """
    scene = ms.Scene(case(PRESSED, {**GROWS, "until": "limit"}))
    *_, last = ms.follow(scene)
    assert last.label == "fold"
    factor = last.point.state.mu["imperfection"]
    grown = sensitivities(scene, fold_at(scene, last), last)
    buckled = ms.Scene(
        case({"kind": "pressure"}, imperfections=[{**DIMPLE, "amplitude": 1.64 * factor}])
    )
    *_, end = ms.follow(buckled)
    fold = find_fold(buckled.newton, FoldGuess(end.point.state), "pressure")
    assert fold.value == pytest.approx(0.45, abs=1e-8)
    slope = sensitivities(buckled, fold)["imperfections.0.amplitude"]
    assert grown["pressure"] * slope * 1.64 == pytest.approx(1.0, rel=1e-5)
    by_width = sensitivities(buckled, fold)["imperfections.0.width"]
    assert grown["imperfections.0.width"] == pytest.approx(
        by_width * grown["pressure"] * -1, rel=1e-4
    )


def test_a_sealed_shell_keeps_its_volume() -> None:
    """That under the undeformed shell, its imperfection among it: what the grown shell has lost is
    pressed back.
    """
    sealed = {**GROWS, "factor": 1, "points": 2, "hold": {"pressure": "conjugate"}}
    scene = ms.Scene(case({**PRESSED, "pressure": 0.2}, sealed))
    records = list(ms.follow(scene))
    table = ms.columns(scene, records)
    growing = np.array(table["step"]) == 2
    assert np.ptp(table["volume_change"][growing]) < 1e-10
    assert table["imperfection"][-1] == 1.0
    assert (
        table["p_over_pc"][-1] < 0.2
    )  # the dimple takes a part of the volume that the pressure has taken
    end = records[-1].point.state
    whole = ms.Scene(case({**PRESSED, "pressure": end.mu["pressure"]}))
    *_, same = ms.follow(whole)
    assert np.abs(same.point.state.u - end.u).max() < 1e-7 * np.abs(end.u).max()


@pytest.mark.slow
def test_stopped_and_resumed(no_pictures: None, tmp_path: Path) -> None:
    def stop(line: str) -> None:
        if line.lstrip().startswith("3 "):
            os.kill(os.getpid(), signal.SIGUSR1)

    asked, whole, out = (
        case(PRESSED, {**GROWS, "until": "limit"}),
        tmp_path / "whole",
        tmp_path / "out",
    )
    assert ms.run(asked, whole).stopped is None
    assert "SIGUSR1" in str(ms.run(asked, out, say=stop).stopped)
    assert ms.run(asked, out, resume=True).replayed
    check_same_path(out, whole)


@pytest.mark.parametrize(
    ("step", "others", "said"),
    [
        ({"item": 1, "factor": 1}, {}, "loading.0.item: 1: shell.imperfections has no such item"),
        ({"factor": 1}, {"imperfections": ()}, "kind: imperfection: the case has none"),
        ({"factor": 1}, {"model": "solid", "mesh": {}}, "needs a mid-surface; a solid has none"),
        ({"factor": 0}, {}, "the target must not be zero"),
    ],
)
def test_mistakes(step: dict[str, Any], others: dict[str, Any], said: str) -> None:
    with pytest.raises(CaseError, match=said):
        case({**GROWS, **step}, **others)
