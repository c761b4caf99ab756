"""What a model excludes, on the path load = x^3 - 3 x^2 + 2 x, in families whose eigenvalues are
functions of x.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest
from continuation.toys import snap_through
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.continuation.continuation_run import ContinuationGoal, ContinuationRun
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Control, Path
from magshell_fenicsx.continuation.point import PathStopped, StepOptions
from magshell_fenicsx.continuation.stability_monitor import Crossing, StabilityMonitor
from magshell_fenicsx.continuation.system import State

Eigenvalues = Callable[[float], list[float]]


@dataclass
class Diagonal:
    """A family with a diagonal tangent; `looks` are the places at which it was factored."""

    label: str
    eigenvalues: Eigenvalues
    looks: list[float] = field(default_factory=list)

    def factor_at(self, state: State) -> Factorisation:
        x = float(state.u[0])
        self.looks.append(x)
        values = self.eigenvalues(x)
        K = PETSc.Mat().createAIJ([len(values)] * 2, nnz=1, comm=MPI.COMM_SELF)
        K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        for i, value in enumerate(values):
            K.setValue(i, i, value)
        K.assemble()
        factors = Factorisation(MPI.COMM_SELF)
        factors.factor(K)
        return factors


@dataclass
class Several:
    families: Sequence[Diagonal]

    def counts(self, state: State) -> list[int]:
        return [family.factor_at(state).negative_pivots for family in self.families]

    @property
    def tangents(self) -> "Together | None":
        return Together(self.families) if len(self.families) > 1 else None


@dataclass
class Together:
    """Eigenvalues, as many of each family."""

    families: Sequence[Diagonal]

    def sampled_tangents(self, state: State) -> np.ndarray:
        x = float(state.u[0])
        for family in self.families:
            family.looks.append(x)
        return np.array([family.eigenvalues(x) for family in self.families])

    def counts_from(self, numbers: np.ndarray) -> list[int]:
        return [int((of < 0).sum()) for of in numbers]

    def indefinite(self, numbers: np.ndarray) -> set[int]:
        return {i for i, of in enumerate(numbers) if of.min() <= 0}


def watched(
    families: Sequence[Diagonal],
    control: Control = "arc",
    step: float = 0.05,
    points: int = 60,
    start: float = 0.0,
) -> tuple[list[Crossing], list[tuple[float, int]]]:
    """All crossings, and the number of unstable directions that was told at every x."""
    toy, load = snap_through(), start**3 - 3 * start**2 + 2 * start
    path = Path(BorderedNewton(toy), "load", control, StepOptions(step, step, 1e-7))
    watch, first = (
        StabilityMonitor(Several(families)),
        path.start(State(np.array([start]), {"load": load})),
    )
    watch.begin(path, first)
    found, told = list[Crossing](), list[tuple[float, int]]()
    for _, point in ContinuationRun(path, first, ContinuationGoal("points", steps=points)):
        found += watch.pass_to(point)
        told.append((float(point.state.u[0]), watch.unstable))
    return found + watch.end(), told


def places(found: Sequence[Crossing]) -> list[tuple[str, float, int]]:
    return [(c.label, round(float(c.point.state.u[0]), 7), c.unstable) for c in found]


@pytest.mark.parametrize("control", ["arc", "conjugate"])
def test_what_becomes_unstable_and_stable_again_is_located(control: Control) -> None:
    """Neutral at x = 0.7 and 1.3, on both sides of which it is stable."""
    family = Diagonal("excluded", lambda x: [(x - 0.7) * (x - 1.3), 5.0])
    found, told = watched([family], control)
    assert places(found) == [("excluded", 0.7, 0), ("excluded", 1.3, 0)]
    assert all(unstable == (0.7 < x < 1.3) for x, unstable in told)
    assert told[-1][0] > 2


def test_far_from_neutral_it_is_not_looked_at_everywhere() -> None:
    family = Diagonal("excluded", lambda x: [3.0 - x / 10])
    found, told = watched([family])
    assert not found
    assert len(family.looks) < len(told) / 3


def test_what_was_passed_over_is_looked_at_when_the_next_look_is_another() -> None:
    """It softens slowly up to x = 1, then all at once: what was foretold is wrong, no crossing is
    missed.
    """
    family = Diagonal("excluded", lambda x: [1.0 - 0.01 * x if x < 1 else 0.99 - 40 * (x - 1)])
    found, told = watched([family])
    assert places(found) == [("excluded", 1 + 0.99 / 40, 0)]
    assert sum(1.0 < x < 1.4 and not unstable for x, unstable in told) <= 5


def test_several_crossings_in_one_step_come_in_their_order() -> None:
    """Two of a family, one of another between them, one that becomes stable; all families are
    looked at everywhere.
    """
    families = [
        Diagonal("a", lambda x: [0.501 - x, 0.509 - x]),
        Diagonal("b", lambda x: [0.505 - x, 5.0]),
        Diagonal("c", lambda x: [x - 0.507, 5.0]),
    ]
    found, told = watched(families, step=0.2, points=8)
    assert places(found) == [
        ("c", 0.0, 1),
        ("a", 0.501, 1),
        ("b", 0.505, 2),
        ("c", 0.507, 2),
        ("a", 0.509, 2),
    ]
    assert [unstable for x, unstable in told if x > 0.51] == [3] * sum(x > 0.51 for x, _ in told)


@pytest.mark.parametrize("width", [0.03, 0.08])
def test_what_softens_and_recovers_within_a_step(width: float) -> None:
    """Unstable only between two points of the path, which is stable at each of them, as is another
    family.
    """
    families = [
        Diagonal("a", lambda x: [(x - 1) ** 2 - (width / 2) ** 2]),
        Diagonal("b", lambda x: [1.0 - x / 10]),
    ]
    found, told = watched(families, step=0.4, points=8)
    assert not any(unstable for _, unstable in told)
    assert places(found) == [("a", 1 - width / 2, 0), ("a", 1 + width / 2, 0)]
    assert len(families[1].looks) < 2 * len(told)


def test_a_mode_of_another_symmetry_is_seen() -> None:
    """The softest mode at first is no part of the one that softens later."""
    family = Diagonal("excluded", lambda x: [0.5, 2.0, 1.2 - x])
    found, _ = watched([family])
    assert places(found) == [("excluded", 1.2, 0)]


def test_what_was_unstable_before_is_no_crossing() -> None:
    """A path that begins with the instabilities with which another one ended, elsewhere."""
    family = Several([Diagonal("a", lambda x: [0.2 - x]), Diagonal("b", lambda x: [5.0])])
    path = Path(BorderedNewton(snap_through()), "load", "arc", StepOptions(0.05, 0.05, 1e-7))
    watch, found = StabilityMonitor(family), list[Crossing]()
    for x in (0.0, 0.4):
        start = path.start(State(np.array([x]), {"load": x**3 - 3 * x**2 + 2 * x}))
        watch.begin(path, start)
        for _, point in ContinuationRun(path, start, ContinuationGoal("points", steps=20)):
            found += watch.pass_to(point)
    assert [c.label for c in found] == ["a"]
    assert found[0].point.state.u[0] == pytest.approx(0.2)
    assert watch.unstable == 1


def test_crossing_that_cannot_be_located_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """And the path goes on."""

    def lost(*args: object) -> None:
        raise PathStopped("the iteration diverged", args[1])  # type: ignore[arg-type]

    monkeypatch.setattr("magshell_fenicsx.continuation.stability_monitor.locate_bifurcation", lost)
    toy = snap_through()
    path = Path(BorderedNewton(toy), "load", "arc", StepOptions(0.05, 0.05, 1e-7))
    watch, first = (
        StabilityMonitor(Several([Diagonal("excluded", lambda x: [0.7 - x])])),
        path.start(State(np.zeros(1), {"load": 0.0})),
    )
    watch.begin(path, first)
    for _, point in ContinuationRun(path, first, ContinuationGoal("points", steps=20)):
        assert watch.pass_to(point) == []
    assert watch.unlocated == "the iteration diverged"
    assert watch.unstable == 1
