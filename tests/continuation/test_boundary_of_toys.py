"""Boundaries of stability of toys, known in closed form."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from continuation.toys import Toy
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.continuation.augmented import BoundaryPoint, Kind
from magshell_fenicsx.continuation.boundary import Boundary, Label
from magshell_fenicsx.continuation.critical import critical_boundary, first_mode
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import State


@dataclass
class OfToys:
    """Toys that differ by p."""

    toy: Callable[[float], Toy]
    costly: bool = False
    made: set[float] = field(default_factory=set)

    def solver_at(self, p: float) -> BorderedNewton:
        self.made.add(p)
        return BorderedNewton(self.toy(p))

    def amplitudes(self, p: float) -> dict[str, float]:
        return {}

    def difference_weights(self, p: float, *, low_order: bool = False) -> list[tuple[float, float]]:
        return (
            [(1e4, p + 1e-4), (-1e4, p)] if low_order else [(500.0, p + 1e-3), (-500.0, p - 1e-3)]
        )


def arch(rise: float) -> Toy:
    """A shallow pinned arch of rise e under a half-sine load (Fung and Kaplan, NACA TN 2840).

    Pi_0 = (a - e)^2 + 16 b^2 + (e^2 - a^2 - 4 b^2)^2/2 with a, b of the first two sines; the load
    is on -a.
    """

    def gradient(x: np.ndarray) -> np.ndarray:
        a, b = rise - x[0], x[1]
        m = rise**2 - a**2 - 4 * b**2
        return np.array([-2 * (a - rise) + 2 * a * m, 32 * b - 8 * b * m])

    def hessian(x: np.ndarray) -> np.ndarray:
        a, b = rise - x[0], x[1]
        m = rise**2 - a**2 - 4 * b**2
        return np.array(
            [[2 - 2 * m + 4 * a**2, -16 * a * b], [-16 * a * b, 32 - 8 * m + 64 * b**2]]
        )

    return Toy(gradient, hessian, 2)


def load_of(a: float, rise: float) -> float:
    return 2 * (rise - a) + 2 * a * (rise**2 - a**2)


def followed(
    kind: Kind,
    rise: float,
    a: float,
    phi: list[float],
    ends: tuple[float, float],
    toys: OfToys | None = None,
) -> list[tuple[Label, BoundaryPoint]]:
    boundary = Boundary(toys or OfToys(arch), "load", kind, (10.0, ends[1] - ends[0]))
    start = boundary.start(
        rise, State(np.array([rise - a, 0.0]), {"load": load_of(a, rise)}), np.array(phi)
    )
    return [("start", start), *boundary.follow(start, -1.0, ends, 20)]


@pytest.mark.parametrize("costly", [False, True])
def test_folds_through_a_cusp(costly: bool) -> None:
    """Folds at a^2 = (e^2 - 1)/3, born at e = 1, where the load is 2; no antisymmetric mode below
    e^2 = 5.5.

    Where each p costs a system, a point far from the cusp takes one of them, but for the first
    ones.
    """
    toys = OfToys(arch, costly)
    found = followed("fold", 2.2, np.sqrt((2.2**2 - 1) / 3), [1.0, 0.0], (0.5, 2.3), toys)
    for _, locus in found:
        a = locus.p - locus.state.u[0]
        assert 3 * a**2 == pytest.approx(locus.p**2 - 1, abs=1e-6)
        assert locus.state.mu["load"] == pytest.approx(load_of(a, locus.p), rel=1e-9)
    (cusp,) = (locus for label, locus in found if label == "cusp")
    assert cusp.p == pytest.approx(1.0, abs=1e-8)
    assert cusp.state.mu["load"] == pytest.approx(2.0, abs=1e-7)
    assert found[-1][0] == "end"
    assert found[-1][1].p == 2.3
    assert found[-1][1].state.u[0] > 2.3  # the lower fold
    assert sum(locus.factorisations for _, locus in found) < 4 * len(found)
    if costly:
        assert sum(p > 1.5 for p in toys.made) < 1.4 * sum(locus.p > 1.5 for _, locus in found) + 3


def test_a_fold_meets_a_bifurcation() -> None:
    """At e^2 = 5.5 the antisymmetric mode is neutral at the fold; its own boundary a^2 = e^2 - 4
    turns at e = 2.
    """
    fold = followed("fold", 2.6, np.sqrt((2.6**2 - 1) / 3), [1.0, 0.0], (2.1, 2.7))
    (met,) = (locus for label, locus in fold if label == "meeting")
    assert met.p == pytest.approx(np.sqrt(5.5), abs=1e-6)
    assert [locus.unstable for _, locus in fold][:1] == [1]
    assert fold[-1][1].unstable == 0


def test_bifurcations_turn() -> None:
    found = followed("bifurcation", 2.6, np.sqrt(2.6**2 - 4), [0.0, 1.0], (1.5, 2.7))
    for label, locus in found:
        if label != "meeting":
            a = locus.p - locus.state.u[0]
            assert a**2 == pytest.approx(locus.p**2 - 4, abs=1e-6)
            assert locus.state.mu["load"] == pytest.approx(load_of(a, locus.p), rel=1e-8)
    (turn,) = (locus for label, locus in found if label == "turn")
    assert turn.p == pytest.approx(2.0, abs=1e-7)
    assert not [label for label, _ in found if label == "cusp"]


@dataclass
class WithoutModes(OfToys):
    """The arch's first sine alone.

    It excludes the second one and another, neutral at thrusts of 4 and 2 e - 1.6.
    """

    def factored_tangent(self, p: float, state: State, m: int) -> Factorisation:
        matrix = PETSc.Mat().createAIJ([1, 1], nnz=1, comm=MPI.COMM_SELF)
        matrix.setValue(0, 0, self.quadratic_form(p, state, m, np.ones(1)))
        matrix.assemble()
        factors = Factorisation(MPI.COMM_SELF)
        factors.factor(matrix)
        return factors

    def quadratic_form(self, p: float, state: State, m: int, v: np.ndarray) -> float:
        return float(8 * (neutral(m, p) - p**2 + (p - state.u[0]) ** 2) * v @ v)

    def counts(self, p: float, state: State) -> list[int]:
        return [int(self.quadratic_form(p, state, m, np.ones(1)) < 0) for m in (1, 2)]


def neutral(m: int, rise: float) -> float:
    return 4.0 if m == 1 else 2 * rise - 1.6


@pytest.mark.parametrize("costly", [False, True])
@pytest.mark.parametrize(("m", "rise", "way"), [(1, 3.2, -1.0), (2, 2.45, 1.0)])
def test_two_families_of_excluded_modes_cross(
    costly: bool, m: int, rise: float, way: float
) -> None:
    """At a rise of 2.8; on its way each is the first one, up to there."""

    def first(rise: float) -> Toy:
        gradient, hessian = arch(rise).gradient, arch(rise).hessian
        return Toy(
            lambda x: gradient(np.append(x, 0.0))[:1],
            lambda x: hessian(np.append(x, 0.0))[:1, :1],
            1,
        )

    a = np.sqrt(rise**2 - neutral(m, rise))
    boundary = Boundary(WithoutModes(first, costly), "load", "bifurcation", (10.0, 1.0), m=m)
    start = boundary.start(
        rise, State(np.array([rise - a]), {"load": load_of(a, rise)}), np.ones(1)
    )
    found = [*boundary.follow(start, way, (2.42, 3.3), 20)]
    for label, locus in found:
        a = np.sqrt(locus.p**2 - neutral(m, locus.p))
        assert locus.state.mu["load"] == pytest.approx(load_of(a, locus.p), rel=1e-7)
        assert label == "crossing" or bool(locus.unstable) == (way * (locus.p - 2.8) > 0)
    (crossing,) = (locus for label, locus in found if label == "crossing")
    assert (crossing.met, crossing.p) == (3 - m, pytest.approx(2.8, abs=1e-8))
    assert found[-1][0] == "end"


class WithoutPairs(WithoutModes):
    """The same where both modes are of one family, to which they are unlike."""

    def factored_tangent(self, p: float, state: State, m: int) -> Factorisation:
        matrix = PETSc.Mat().createAIJ([2, 2], nnz=1, comm=MPI.COMM_SELF)
        for i, v in enumerate(np.eye(2)):
            matrix.setValue(i, i, self.quadratic_form(p, state, m, v))
        matrix.assemble()
        factors = Factorisation(MPI.COMM_SELF)
        factors.factor(matrix)
        return factors

    def quadratic_form(self, p: float, state: State, m: int, v: np.ndarray) -> float:
        return float(
            sum(super(WithoutPairs, self).quadratic_form(p, state, i, v[i - 1 : i]) for i in (1, 2))
        )

    def counts(self, p: float, state: State) -> list[int]:
        return [sum(self.quadratic_form(p, state, 1, v) < 0 for v in np.eye(2))]


@pytest.mark.parametrize(("rise", "way", "first"), [(3.2, -1.0, 1), (2.45, 1.0, 2)])
def test_two_modes_of_one_family_cross(rise: float, way: float, first: int) -> None:
    """At a rise of 2.8 again; the boundary goes on with the other mode, which is then the first
    one.
    """

    def alone(rise: float) -> Toy:
        gradient, hessian = arch(rise).gradient, arch(rise).hessian
        return Toy(
            lambda x: gradient(np.append(x, 0.0))[:1],
            lambda x: hessian(np.append(x, 0.0))[:1, :1],
            1,
        )

    a = np.sqrt(rise**2 - neutral(first, rise))
    mode = Boundary(WithoutPairs(alone), "load", "bifurcation", (10.0, 1.0), m=1)
    start = mode.start(
        rise, State(np.array([rise - a]), {"load": load_of(a, rise)}), np.eye(2)[first - 1]
    )
    found = [
        *critical_boundary(
            lambda *_: mode, lambda at, *_: at.phi[::-1], mode, start, way, (2.42, 3.3), 20
        )
    ]
    (crossing,) = (locus for label, locus, _ in found if label == "crossing")
    assert (crossing.met, crossing.p) == (1, pytest.approx(2.8, abs=1e-7))
    for label, locus, _ in found:
        own = first if way * (locus.p - 2.8) < 0 else 3 - first
        a = np.sqrt(locus.p**2 - neutral(own, locus.p))
        assert locus.state.mu["load"] == pytest.approx(load_of(a, locus.p), rel=1e-6)
        assert label == "crossing" or not locus.unstable
    assert found[-1][0] == "end"


def first_sine(rise: float) -> Toy:
    """The arch's first sine alone."""
    gradient, hessian = arch(rise).gradient, arch(rise).hessian
    return Toy(
        lambda x: gradient(np.append(x, 0.0))[:1], lambda x: hessian(np.append(x, 0.0))[:1, :1], 1
    )


@dataclass
class WithoutThree(WithoutModes):
    """The arch's first sine alone. The third family that it excludes touches the second one where
    the first crosses it.

    There it is neutral at a thrust that is lower by `gap`.
    """

    gap: float = 0.0

    def neutral(self, m: int, rise: float) -> float:
        return neutral(m, rise) if m < 3 else neutral(2, rise) - 0.1 * (rise - 2.8) ** 2 - self.gap

    def quadratic_form(self, p: float, state: State, m: int, v: np.ndarray) -> float:
        return float(8 * (self.neutral(m, p) - p**2 + (p - state.u[0]) ** 2) * v @ v)

    def counts(self, p: float, state: State) -> list[int]:
        return [int(self.quadratic_form(p, state, m, np.ones(1)) < 0) for m in (1, 2, 3)]


@pytest.mark.parametrize(
    ("gap", "missed"),
    [
        (0.0, False),
        (-1e-9, False),
        (-1e-6, False),
        (1e-6, False),
        (1e-3, False),
        (0.0, True),
        (-1e-6, True),
    ],
)
def test_the_first_of_three_modes_that_meet_is_followed(
    gap: float, missed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two of them differ by their gap alone where all meet, at a rise of 2.8; the third is the
    first one beyond.

    It is so as well where crossings with it cannot be located.
    """

    toys = WithoutThree(first_sine, gap=gap)
    meeting = Boundary._locate_meeting
    if missed:
        monkeypatch.setattr(
            Boundary,
            "_locate_meeting",
            lambda self, *args, family=0, **others: (
                None if family == 3 else meeting(self, *args, family=family, **others)
            ),
        )

    def curve(m: int, *_: object) -> Boundary:
        return Boundary(toys, "load", "bifurcation", (10.0, 1.0), m=m)

    a = np.sqrt(3.2**2 - 4)
    mode = curve(1)
    start = mode.start(3.2, State(np.array([3.2 - a]), {"load": load_of(a, 3.2)}), np.ones(1))
    found = [*critical_boundary(curve, lambda *_: np.ones(1), mode, start, -1.0, (2.42, 3.3), 20)]
    assert [locus.p for label, locus, _ in found if label == "end"] == [2.42]
    assert found[-1][2].m == 3
    for label, locus, on in found:
        first = min(toys.neutral(m, locus.p) for m in (1, 2, 3))
        assert toys.neutral(on.m, locus.p) == pytest.approx(first, abs=1e-6)
        assert locus.state.mu["load"] == pytest.approx(
            load_of(np.sqrt(locus.p**2 - first), locus.p), rel=1e-6
        )
        assert not locus.unstable - (locus.unstable_of(locus.met) if label == "crossing" else 0)


@pytest.mark.parametrize(("gap", "taken"), [(1e-4, 3), (-1e-3, 2), (0.5, 2)])
def test_a_start_is_that_of_the_first_of_two_modes_that_are_near(gap: float, taken: int) -> None:
    """The second mode is named, the third is first by a gap; one that comes long before is another
    instability."""
    toys, rise = WithoutThree(first_sine, gap=gap), 2.75

    def curve(m: int, *_: object) -> Boundary:
        return Boundary(toys, "load", "bifurcation", (10.0, 1.0), m=m)

    a = np.sqrt(rise**2 - neutral(2, rise))
    start = curve(2).start(
        rise, State(np.array([rise - a]), {"load": load_of(a, rise)}), np.ones(1)
    )
    mode, begun = first_mode(curve, lambda *_: np.ones(1), curve(2), start)
    thrust = rise**2 - (rise - begun.state.u[0]) ** 2
    assert mode.m == taken
    assert thrust == pytest.approx(toys.neutral(taken, rise), abs=1e-9)
