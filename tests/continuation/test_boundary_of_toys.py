"""Boundaries of stability of toys, known in closed form."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from continuation.toys import Toy

from magshell_fenicsx.continuation.augmented import Kind, Locus
from magshell_fenicsx.continuation.boundary import Boundary, Label
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import State


@dataclass
class OfToys:
    """Toys that differ by p."""

    toy: Callable[[float], Toy]
    costly: bool = False
    made: set[float] = field(default_factory=set)

    def at(self, p: float) -> BorderedNewton:
        self.made.add(p)
        return BorderedNewton(self.toy(p))

    def amplitudes(self, p: float) -> dict[str, float]:
        return {}

    def beside(self, p: float, *, rough: bool = False) -> list[tuple[float, float]]:
        return [(1e4, p + 1e-4), (-1e4, p)] if rough else [(500.0, p + 1e-3), (-500.0, p - 1e-3)]


def arch(rise: float) -> Toy:
    """A shallow pinned arch of rise e under a half-sine load (Fung and Kaplan, NACA TN 2840).

    Pi_0 = (a - e)^2 + 16 b^2 + (e^2 - a^2 - 4 b^2)^2/2 with a, b of the first two sines; the load is on -a.
    """

    def gradient(x: np.ndarray) -> np.ndarray:
        a, b = rise - x[0], x[1]
        m = rise**2 - a**2 - 4 * b**2
        return np.array([-2 * (a - rise) + 2 * a * m, 32 * b - 8 * b * m])

    def hessian(x: np.ndarray) -> np.ndarray:
        a, b = rise - x[0], x[1]
        m = rise**2 - a**2 - 4 * b**2
        return np.array([[2 - 2 * m + 4 * a**2, -16 * a * b], [-16 * a * b, 32 - 8 * m + 64 * b**2]])

    return Toy(gradient, hessian, 2)


def load_of(a: float, rise: float) -> float:
    return 2 * (rise - a) + 2 * a * (rise**2 - a**2)


def followed(
    kind: Kind, rise: float, a: float, phi: list[float], ends: tuple[float, float], toys: OfToys | None = None
) -> list[tuple[Label, Locus]]:
    boundary = Boundary(toys or OfToys(arch), "load", kind, (10.0, ends[1] - ends[0]))
    start = boundary.start(rise, State(np.array([rise - a, 0.0]), {"load": load_of(a, rise)}), np.array(phi))
    return [("start", start), *boundary.followed(start, -1.0, ends, 20)]


@pytest.mark.parametrize("costly", [False, True])
def test_folds_through_a_cusp(costly: bool) -> None:
    """Folds at a^2 = (e^2 - 1)/3, born at e = 1, where the load is 2; no antisymmetric mode below e^2 = 5.5.

    Where each p costs a system, a point far from the cusp takes two of them.
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
        assert sum(p > 1.5 for p in toys.made) < 2.6 * sum(locus.p > 1.5 for _, locus in found)


def test_a_fold_meets_a_bifurcation() -> None:
    """At e^2 = 5.5 the antisymmetric mode is neutral at the fold; its own boundary a^2 = e^2 - 4 turns at e = 2."""
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
