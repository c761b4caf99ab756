"""What is said of instabilities that a walk has passed without parting them, on modes whose loads
are known."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from continuation.toys import column_of_modes, pitchfork

from magshell_fenicsx.continuation.continuation_run import (
    ContinuationGoal,
    ContinuationRun,
    _InstabilityLocator,
)
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import StepOptions
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.simulate.path_records import cluster_remark
from magshell_fenicsx.simulate.scene import Scene

WITHOUT_UNITS = cast("Scene", SimpleNamespace(sizes=SimpleNamespace(column=lambda name: None)))


@pytest.mark.parametrize("count", [2, 5])
def test_one_sentence_names_directions_and_controls(count: int) -> None:
    toy = column_of_modes(1e-9, 1e-4, count)
    u = np.zeros(toy.size)
    u[0] = 0.9
    path = Path(BorderedNewton(toy), "load", "load", StepOptions(0.03, 0.03, 1e-6))
    walk = ContinuationRun(
        path, path.start(State(u, {"load": 0.9})), ContinuationGoal("target", [1.1])
    )
    sentences = [
        (point, said) for _, point in walk if (said := cluster_remark(WITHOUT_UNITS, walk, point))
    ]
    ((point, said),) = sentences
    first, last = (end.state.mu["load"] for end in walk.clusters[0])
    assert said == (
        f"instabilities in {count} directions between load = {first:.6g} and load = {last:.6g} "
        "are too close to be located one by one"
    )
    assert point.state.mu["load"] == first < 1 < last


def test_a_fold_that_no_step_resolves_is_told_between_two_branches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Koiter's fold at 1 - 3 (1e-6/2)^(2/3), beside the branch of the perfect column, whose
    bifurcation is not found."""
    monkeypatch.setattr(_InstabilityLocator, "solve_bifurcation", lambda *_: None)
    newton = BorderedNewton(pitchfork(1e-6, stiffening=-0.5))
    path = Path(newton, "load", "arc", StepOptions(0.03, 1.5, 0.01))
    start = path.start(State(np.array([0.0, 1e-6]), {"load": 0.0}))
    walk = ContinuationRun(path, start, ContinuationGoal("limit"))
    *_, (label, point) = walk
    ((low, high),) = walk.clusters
    first, last = (end.state.mu["load"] for end in (low, high))
    assert cluster_remark(WITHOUT_UNITS, walk, point) == (
        f"an instability between load = {first:.6g} and load = {last:.6g} cannot be located more "
        "closely: an imperfection parts the branches there, and they pass too near each other"
    )
    assert (label, low) == ("bifurcation", point)
    assert first < 1 - 3 * (1e-6 / 2) ** (2 / 3) < last < first + 0.01
    assert point.load_error == pytest.approx(last - first)
    assert path.solves < 30
