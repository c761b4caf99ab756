"""An accepted point of an equilibrium path, the record of points for a resumed run, and reports on
the way.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from magshell_fenicsx.continuation.system import Direction, State, Vector


@dataclass(frozen=True)
class Point:
    """An accepted point of a path.

    Attributes
    ----------
    s
        The controlled quantity: mu, the conjugate displacement -Pi_i(u), or the arc length.
    du, dmu
        Tangent of the path, d(u, mu)/ds.
    negative_pivots
        Number of unstable directions at fixed amplitudes.
    negative_pivots_held
        Number of unstable directions with the conjugate displacement held instead of the amplitude.
    iterations, factorisations
        Work since the point before.
    error
        Estimated error of u, over the system's length.
    load_error
        The estimated error of the amplitude of an instability.
    habit
        That of the factorisation after it, by which a resumed run goes on with the same rounding.
    across
        The direction along which arc length is measured from it, if that is not its tangent.
    """

    state: State
    s: float
    du: Vector = field(repr=False)
    dmu: float
    negative_pivots: int
    negative_pivots_held: int
    iterations: int = 0
    factorisations: int = 0
    error: float = 0.0
    load_error: float = 0.0
    habit: int = -1
    across: Direction | None = field(default=None, repr=False)

    @property
    def normal(self) -> Direction:
        """The direction along which arc length is measured from it."""
        return self.across or (self.du, self.dmu)

    def per(self, rate: float) -> "Point":
        """The point with its tangent divided by `rate`."""
        return replace(self, du=np.asarray(self.du / rate), dmu=self.dmu / rate)

    def turned_from(self, other: "Point") -> bool:
        """Whether an instability lies between two points of a path, as far as they show."""
        return self.negative_pivots != other.negative_pivots or self.dmu * other.dmu < 0


class PathStopped(RuntimeError):
    """The path could not be followed further; `point` is the last accepted one.

    Attributes
    ----------
    final
        Whether it could not be followed in another way either.
    """

    def __init__(self, reason: str, point: Point, *, final: bool = False) -> None:
        super().__init__(reason)
        self.point, self.final = point, final


class StepTooLong(RuntimeError):
    """What lies between two points must not be: the step between them is to be shorter."""


@dataclass(frozen=True)
class Finding:
    """What a history has seen at points that it has, where that costs as much as a solve.

    Attributes
    ----------
    values
        The same on all ranks: what JSON can hold.
    vector
        This rank's part of a vector; None without one.
    """

    values: Mapping[str, Any]
    vector: Vector | None = None


class Journal(Protocol):
    """The results of `Path.recorded` and the findings of a history, in their order.

    A history is deterministic: from the same results it chooses the same steps, targets and
    brackets. So the results are a complete checkpoint. What is found at these results follows from
    them, and is kept for its cost.
    """

    def replay(self) -> Point | str | None:
        """The next recorded result; None if there is none and a solve is needed.

        Collective. It may raise an exception to stop the history before a new solve begins.
        """

    def record(self, result: Point | str) -> None:
        """Keep a result. Collective."""

    def noted(self, find: Callable[[], Finding]) -> Finding:
        """What `find` returns, or has returned here in an interrupted run. Collective.

        The vector is None where that run had other ranks.
        """

    def begin(self, space: object) -> None:
        """The results from here on are of another system, with the unknowns of that space.

        Collective.
        """

    def check(self, known: bool) -> None:
        """Between two steps in time towards one result, which may be `known` already. Collective.

        It may raise an exception to stop the history.
        """


class NoJournal:
    """Keeps nothing."""

    def replay(self) -> None:
        return None

    def record(self, result: Point | str) -> None:
        pass

    def noted(self, find: Callable[[], Finding]) -> Finding:
        return find()

    def begin(self, space: object) -> None:
        pass

    def check(self, known: bool) -> None:
        pass


class Progress(Protocol):
    """Receives the next action of a history.

    No method is collective, and no result may depend on it.
    """

    def trying(self, here: Point, length: float) -> None:
        """A step of a length in s from an accepted point begins."""

    def beginning(self, step: int) -> None:
        """A step of the programme begins at the last accepted point; its number is from 1."""

    def doing(self, what: str) -> None:
        """Some other long action begins; `what` describes it in a few words."""


class NoProgress:
    """Reports nothing."""

    def trying(self, here: Point, length: float) -> None:
        pass

    def beginning(self, step: int) -> None:
        pass

    def doing(self, what: str) -> None:
        pass


@dataclass(frozen=True)
class StepOptions:
    """Adaptive step length.

    Attributes
    ----------
    first, largest, smallest
        Step lengths in units of s.
    easy, hard
        A step grows after at most `easy` factorisations, and shrinks after at least `hard`.
    few
        A step also grows after at most so many iterations.
    straight
        A step grows only if the cosine between the tangents of successive points is larger.
    turn
        Least cosine between the tangents of successive points. A sharper turn counts as a jump to
        another branch, and a smaller step is tried.
    gap
        Largest part of a step that the tangents at its ends may leave unexplained. A larger one
        counts as a jump too.
    several
        The longest step that may pass more than one instability; 0: an eighth of the first.
    """

    first: float
    largest: float
    smallest: float
    easy: int = 2
    hard: int = 4
    few: int = 4
    straight: float = 0.9
    turn: float = 0.5
    gap: float = 0.1
    several: float = 0.0

    @property
    def passes_several(self) -> float:
        """The longest step that may pass more than one instability."""
        return self.several or self.first / 8
