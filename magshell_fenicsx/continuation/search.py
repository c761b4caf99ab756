"""A search for further solutions at the amplitudes of a known one, by deflation from many guesses.

A guess is tried in two ways: by Newton's method with all known solutions deflated, and by the path on which a force
along its displacement that holds it is released. Each solution that is found gives two more guesses, along its softest
mode. A search for stable solutions first lets each guess go down in energy until it rests at one.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from petsc4py import PETSc

from magshell_fenicsx.continuation.branch import largest
from magshell_fenicsx.continuation.deflation import deflated
from magshell_fenicsx.continuation.inverse import NoEigenpair, nearest_to_zero
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.release import released
from magshell_fenicsx.continuation.system import State, Vector, max_abs

COPY = 1e-3  # solutions at a smaller distance, in lengths of the system, are one
MODE, DOWN = 1.0, 0.3  # size of a mode in a guess, and where a descent leaves an unstable solution, in lengths
DESCENTS = 20  # times that a guess goes on settling
OVER = "the time of the search is over"


@dataclass(frozen=True)
class Limits:
    """Where a search ends.

    Attributes
    ----------
    solutions, guesses
        Largest numbers of solutions and of guesses.
    over
        Whether the time is over; the same on all ranks.
    """

    solutions: int
    guesses: int
    over: Callable[[], bool] = lambda: False


class Guess:
    """A guess, made when it is needed, and the direction in which it is away from a known solution."""

    def __init__(self, make: Callable[[], State], base: State, displacement: Callable[[Vector], Vector]) -> None:
        self._make, self._base, self._displacement = make, base, displacement

    @cached_property
    def state(self) -> State:
        return self._make()

    @property
    def direction(self) -> Vector:
        return self._displacement(self.state.u - self._base.u)


def further(
    path: Path,
    start: State,
    guesses: Iterable[Callable[[], State]],
    limits: Limits,
    displacement: Callable[[Vector], Vector] = lambda u: u,
    descend: Callable[[State], State] | None = None,
) -> Iterator[Point]:
    """Solutions at the amplitudes of a known one, each accepted as a point of the path is.

    Parameters
    ----------
    path
        By load control, in any amplitude. Its journal gets the result of every attempt.
    start
        A solution.
    guesses
        Further guesses, which are tried first.
    displacement
        A vector of the system with zeros for unknowns that are no displacements.
    descend
        Lets a state go down in energy by some steps; then only stable solutions count. None: all count.
    """
    search = _Search(path, [start], descend, limits.over)
    queue = [Guess(make, start, displacement) for make in guesses]
    queue += search.along_mode(start, displacement)
    found = 0
    for number, guess in enumerate(queue, 1):  # the queue grows
        attempts = [*([search.by_descent] if descend else []), search.by_newton, search.by_release]
        while attempts:
            attempt = attempts.pop(0)
            path.progress.doing(f"searching: guess {number} of at most {limits.guesses}, solutions found: {found}")
            point = path.recorded(partial(_unless, limits.over, attempt, guess))
            if point == OVER:
                return
            if isinstance(point, str):
                continue
            search.known.append(point.state)
            queue += search.along_mode(point.state, displacement)
            found += not (descend and point.negative_pivots)
            yield point
            if found == limits.solutions:
                return
            attempts = [search.by_newton]  # which may find another one now
        if number == limits.guesses:
            return


def _unless(over: Callable[[], bool], attempt: Callable[[Guess], Point | str], guess: Guess) -> Point | str:
    """The result of an attempt; states without meaning, far from equilibrium, may have no factors."""
    try:
        return OVER if over() else attempt(guess)
    except (NoEigenpair, PETSc.Error, np.linalg.LinAlgError) as e:
        return str(e)


class _Search:
    """The attempts of a search.

    Attributes
    ----------
    known
        The solutions so far.
    """

    def __init__(
        self, path: Path, known: list[State], descend: Callable[[State], State] | None, over: Callable[[], bool]
    ) -> None:
        self._path, self.known, self._descend, self._over = path, known, descend, over
        self._system, self._newton = path.system, path.newton
        self._solver = Path(path.newton, path.name, "load", path.options)  # without a journal
        self._value = known[0].mu[path.name]
        self._row = path.given("load", self._value)

    def by_newton(self, guess: Guess) -> Point | str:
        """The solution that deflated Newton's method finds from a guess."""
        return self._accepted(guess.state)

    def by_descent(self, guess: Guess) -> Point | str:
        """The stable solution below a guess; from an unstable one on the way it goes on along the softest mode."""
        assert self._descend
        state, tried = guess.state, "it does not come to rest"
        for _ in range(DESCENTS):
            if self._over():
                return OVER
            state = self._descend(state)
            if self._newton.factor_at(state).negative_pivots:
                continue
            near = deflated(self._newton, state, self._path.name, self._row)
            found = self._solver.solve(self._row, self._value, near) if near else "no solution is near"
            if isinstance(found, str):
                tried = found
            elif self._is_known(found.state):
                return "the solution is a known one"
            else:
                point = self._solver.exact(found, found)
                if not point.negative_pivots:
                    return point
                state = _Mode(self._path, point.state).state(DOWN)
        return tried

    def by_release(self, guess: Guess) -> Point | str:
        """The first solution on the path of a force that holds the guess."""
        for state in released(self._newton, guess.state, guess.direction):
            found = self._accepted(state)
            if not isinstance(found, str):
                return found
        return "the force does not fall to zero"

    def along_mode(self, state: State, displacement: Callable[[Vector], Vector]) -> list[Guess]:
        """Guesses on both sides of a solution along its softest mode."""
        mode = _Mode(self._path, state)
        return [Guess(partial(mode.state, size), state, displacement) for size in (MODE, -MODE)]

    def _accepted(self, guess: State) -> Point | str:
        path = self._path
        near = deflated(self._newton, guess, path.name, self._row, [state.u for state in self.known])
        if near is None:
            return "Newton's method finds no other solution"
        found = self._solver.solve(self._row, self._value, near)
        if isinstance(found, str):
            return found
        if self._is_known(found.state):
            return "the solution is a known one"
        return self._solver.exact(found, found)

    def _is_known(self, found: State) -> bool:
        away = (max_abs(self._system.comm, found.u - state.u) for state in self.known)
        return min(away) <= COPY * self._system.length


@dataclass(frozen=True)
class _Mode:
    """The softest mode of a solution, computed when it is needed."""

    path: Path
    at: State

    @cached_property
    def vector(self) -> Vector:
        _, mode = nearest_to_zero(self.path.newton.factor_at(self.at))
        return np.asarray(mode * self.path.system.length / largest(self.path.system.comm, mode))

    def state(self, size: float) -> State:
        return State(self.at.u + size * self.vector, self.at.mu)
