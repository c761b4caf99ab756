"""Accepted points of an equilibrium path, the journal of a run, and reports of progress.

A point is a state in equilibrium with the path's tangent and the numbers of unstable directions
there. By the journal an interrupted run resumes. `StepOptions` says how step lengths adapt.

mu are the amplitudes (load parameters) by name; the conjugate -dPi/dmu of one is the displacement
on which it does work. s is the quantity by which the path is controlled.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from magshell_fenicsx.continuation.system import Direction, State, Vector


@dataclass(frozen=True)
class Point:
    """An accepted point of an equilibrium path.

    Attributes
    ----------
    state
        Displacement and amplitudes, in equilibrium.
    s
        The controlled quantity: mu, the conjugate displacement -dPi/dmu, or the arc length.
    du, dmu
        Tangent of the path, d(u, mu)/ds.
    negative_pivots
        Number of unstable directions at fixed amplitudes.
    negative_pivots_held
        Number of unstable directions where the conjugate displacement is fixed and the amplitude is
        free.
    iterations, factorisations
        Work since the previous point.
    error
        Estimated error of u, over the system's length.
    load_error
        Estimated error of the amplitude of an instability.
    habit
        `Factorisation.habit` after this point, the choice between two factorisations: a resumed run
        continues with the same rounding.
    across
        The direction along which arc length is measured from this point; None: its tangent.
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
        """The direction along which arc length is measured from this point."""
        return self.across or (self.du, self.dmu)

    def with_tangent_per(self, rate: float) -> "Point":
        """Return the point with its tangent divided by `rate`, the change of s along it."""
        return replace(self, du=np.asarray(self.du / rate), dmu=self.dmu / rate)

    def has_instability_since(self, other: "Point") -> bool:
        """Return whether inertia or the sign of dmu shows an instability between two points."""
        return self.negative_pivots != other.negative_pivots or self.dmu * other.dmu < 0


class PathStopped(RuntimeError):
    """The path could not be continued.

    Attributes
    ----------
    point
        The last accepted point.
    final
        Whether no other way of continuation would help either.
    """

    def __init__(self, reason: str, point: Point, *, final: bool = False) -> None:
        super().__init__(reason)
        self.point, self.final = point, final


class StepTooLong(RuntimeError):
    """A step passed something that it must not pass: a shorter step is to be tried."""


@dataclass(frozen=True)
class RecordedValues:
    """Results computed at known points of a path that are as expensive as a solve.

    Attributes
    ----------
    values
        Values that JSON can hold; the same on all ranks.
    vector
        This rank's part of a vector; None without one.
    """

    values: Mapping[str, Any]
    vector: Vector | None = None


class SolverJournal(Protocol):
    """The results of `Path.recorded` and `Path.recorded_values`, in their order.

    A run is deterministic: from the same results it chooses the same steps, targets and brackets.
    So the results are a complete checkpoint. Recorded values follow from the results; they are
    stored because they are expensive.
    """

    def replay(self) -> Point | str | None:
        """Return the next recorded result; None if there is none and a solve is needed.

        Collective. It may raise an exception to stop the run before a new solve begins.
        """

    def record(self, result: Point | str) -> None:
        """Store a result: a point, or the reason why a solve failed. Collective."""

    def recorded_values(self, find: Callable[[], RecordedValues]) -> RecordedValues:
        """Return what `find` returns, or what it returned here in an interrupted run. Collective.

        The vector is None where that run had other ranks.
        """

    def begin(self, space: object) -> None:
        """Announce that the next results belong to another system, with unknowns in `space`.

        Collective.
        """

    def check(self, is_recorded: bool) -> None:
        """Allow the run to stop between two time steps of one result. Collective.

        It may raise an exception to stop the run.

        Parameters
        ----------
        is_recorded
            Whether the result of these steps is already recorded.
        """


class NoJournal:
    """A journal that stores nothing."""

    def replay(self) -> None:
        return None

    def record(self, result: Point | str) -> None:
        pass

    def recorded_values(self, find: Callable[[], RecordedValues]) -> RecordedValues:
        return find()

    def begin(self, space: object) -> None:
        pass

    def check(self, is_recorded: bool) -> None:
        pass


class Progress(Protocol):
    """Receives the next action of a run.

    No method is collective, and no result may depend on one.
    """

    def trying(self, current: Point, length: float) -> None:
        """Report that a step of a length in s from an accepted point begins."""

    def beginning(self, step: int) -> None:
        """Report that a step of the programme begins at the last accepted point; from 1."""

    def doing(self, what: str) -> None:
        """Report that some other long action begins; `what` describes it in a few words."""


class NoProgress:
    """A receiver that reports nothing."""

    def trying(self, current: Point, length: float) -> None:
        pass

    def beginning(self, step: int) -> None:
        pass

    def doing(self, what: str) -> None:
        pass


@dataclass(frozen=True)
class StepOptions:
    """Options of the adaptive step length.

    Attributes
    ----------
    first, largest, smallest
        Step lengths in units of s.
    easy_factorisations
        A step grows after at most this many factorisations ...
    easy_iterations
        ... or after at most this many iterations.
    hard_factorisations
        A step shrinks after at least this many factorisations.
    growth_cosine
        A step grows only if the cosine between the tangents of successive points is larger.
    min_cosine
        Smallest cosine between the tangents of successive points. A sharper turn counts as a jump
        to another branch, and a smaller step is tried.
    max_gap
        Largest fraction of a step that the tangents at its ends may leave unexplained. A larger one
        counts as a jump too.
    several
        The longest step that may pass more than one instability; 0: an eighth of the first.
    max_location_solves
        Number of solves, in the search for one instability and on the shorter steps towards it,
        after which it counts as located between the two points that are known.
    """

    first: float
    largest: float
    smallest: float
    easy_factorisations: int = 2
    hard_factorisations: int = 4
    easy_iterations: int = 4
    growth_cosine: float = 0.9
    min_cosine: float = 0.5
    max_gap: float = 0.1
    several: float = 0.0
    max_location_solves: int = 60

    @property
    def max_step_past_several(self) -> float:
        """The longest step that may pass more than one instability."""
        return self.several or self.first / 8
