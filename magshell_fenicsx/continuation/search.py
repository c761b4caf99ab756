"""A search for further solutions at the amplitudes of a known one, by deflation from many guesses.

A guess is tried in two ways: by Newton's method with all known solutions deflated, and by the path
on which a force along its displacement that holds it is released. Each solution that is found gives
two more guesses, along its softest mode. A search for stable solutions first lets each guess
settle: go down in energy until it rests at one.

**Release.** R(u) + t b = 0 with -b . u = q, first that of the guess; then the path is followed by
arc length, through folds, until the force t is zero: there is an equilibrium.

**Settling.** Every step solves (K + s K0) du = -R, with the tangent K0 of the unloaded system: one
implicit step of the flow K0 du/dt = -R, of length 1/s. Sharp folds relax, while soft directions
stay almost where they are. It goes down the energy, so its fixed points are stable equilibria.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from petsc4py import PETSc

from magshell_fenicsx.continuation.bifurcation import largest
from magshell_fenicsx.continuation.control import GivenConjugate
from magshell_fenicsx.continuation.deflated import deflated
from magshell_fenicsx.continuation.device import FORCE, HeldAlong
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.modes import NoEigenpair, nearest_to_zero
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import PathStopped, Point, StepOptions
from magshell_fenicsx.continuation.system import (
    State,
    System,
    Vector,
    dot,
    max_abs,
    symmetric_part,
)

FIRST, LONGEST, SHORTEST = (
    0.02,
    1000.0,
    1e-3,
)  # steps: the first in the metric's length, others over the first
MOST_STEPS, MOST_FORCE = 30, 10.0  # the force over the first one
MOST_BRACKETS, LITTLE = (
    4,
    1e-2,
)  # solves for the zero of the force; this part of its change counts as zero
SCALE = 1e6  # the force counts as nothing in the arc length
MOST_FACTORS = 40
UNEXPLAINED = 0.7  # part of the residual that a step towards rest may leave
EASY = 0.2  # where it leaves less, the next is longer
RESTED = 0.05  # in lengths of the system: a shorter step with so small a shift ends
SMALL = 0.01
COPY = 1e-3  # solutions at a smaller distance, in lengths of the system, are one
MODE, DOWN = (
    1.0,
    0.3,
)  # size of a mode in a guess, and where a descent leaves an unstable solution, in lengths
MOST_CHANGED = 10  # times that a solution gets stiffer penalties or new cuts
DESCENTS = 20  # times that a guess goes on settling
OVER = "the time of the search is over"


def released(newton: BorderedNewton, guess: State, b: Vector) -> Iterator[State]:
    """Guesses of equilibria on the path of a force along b that holds a guess, each where the force
    is zero.

    The path begins in the direction in which the force falls in size.
    """
    system = newton.system
    residual, size = system.residual(guess.u, guess.mu), dot(system.comm, b, b)
    b = np.asarray(
        b * (np.sqrt(dot(system.comm, residual, residual) / size) or 1.0)
    )  # a force of order one
    holder = newton.on(HeldAlong(system, b))
    first = -dot(system.comm, b, residual) / dot(system.comm, b, b)
    row = GivenConjugate(holder.system, FORCE, -dot(system.comm, b, guess.u))
    near = deflated(holder, State(guess.u, {**guess.mu, FORCE: first}), FORCE, row)
    outcome = holder.solve(near, FORCE, row) if near else None
    if outcome is None or not outcome.converged:
        return
    path = Path(holder, FORCE, "arc", StepOptions(FIRST, LONGEST * FIRST, SHORTEST * FIRST), SCALE)
    largest = MOST_FORCE * abs(outcome.state.mu[FORCE])
    reached = path.start(outcome.state, -float(np.copysign(1.0, outcome.state.mu[FORCE])))
    try:
        for count, (point, _) in enumerate(path.towards(reached, [np.inf]), 1):
            before, after = (p.state.mu[FORCE] for p in (reached, point))
            if before * after <= 0 and before != after:
                yield State(
                    _at_rest(path, reached, path.seen_from(reached, point)).u, dict(guess.mu)
                )
            reached = point
            if count == MOST_STEPS or abs(after) > largest:
                return
    except PathStopped:
        return


def _at_rest(path: Path, base: Point, high: Point) -> State:
    """Where the holding force is zero between two points, by regula falsi until little of it is
    left.
    """
    low, most = base, abs(base.state.mu[FORCE]) + abs(high.state.mu[FORCE])
    for _ in range(MOST_BRACKETS):
        first, last = low.state.mu[FORCE], high.state.mu[FORCE]
        s = low.s + (high.s - low.s) * first / (first - last)
        middle = path.inside(s, low, high, base)
        if isinstance(middle, str):
            return path.between(s, low, high)
        if abs(middle.state.mu[FORCE]) <= LITTLE * most:
            return middle.state
        low, high = (middle, high) if middle.state.mu[FORCE] * first > 0 else (low, middle)
    return min(low, high, key=lambda end: abs(end.state.mu[FORCE])).state


@dataclass
class Settling:
    """The flow of a system from any guess.

    Parameters
    ----------
    unloaded
        A state with a positive definite tangent K0.
    passes
        Whether a step must not be gone, as shells would pass through each other.
    """

    system: System
    unloaded: State
    passes: Callable[[State, State], bool] = lambda here, ahead: False

    def __post_init__(self) -> None:
        K = symmetric_part(self.system.tangent(self.unloaded.u, self.unloaded.mu))
        self._K0 = K.copy()
        self._stiff, self._factors = (
            Factorisation(self.system.comm),
            Factorisation(self.system.comm),
        )
        self._stiff.factor(self._K0)

    def settled(self, guess: State) -> State:
        """The state after a number of steps, or near the stable equilibrium where they end."""
        system, u, shift, spent = self.system, guess.u, 1.0, 0
        residual = system.residual(u, guess.mu)
        while spent < MOST_FACTORS:
            K = symmetric_part(system.tangent(u, guess.mu)).copy()
            while spent < MOST_FACTORS:
                spent += 1
                shifted = K.copy()
                shifted.axpy(
                    shift, self._K0, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN
                )  # K has what touches too
                self._factors.factor(shifted)
                if self._factors.negative_pivots:
                    shift *= 2
                    continue
                du = -self._factors.solve(residual)
                ahead = system.residual(u + du, guess.mu)
                left = self._size(ahead + shift * self._stiff.times(du)) / self._size(residual)
                if left <= UNEXPLAINED and not self.passes(
                    State(u, guess.mu), State(u + du, guess.mu)
                ):
                    u, residual = u + du, ahead
                    ends = shift < SMALL and max_abs(system.comm, du) <= RESTED * system.length
                    shift /= 4 if left < EASY else 1
                    if ends:
                        return State(u, guess.mu)
                    break
                shift *= 3
        return State(u, guess.mu)

    def _size(self, residual: Vector) -> float:
        """The size of a residual: of the displacement that it causes, in the norm of K0."""
        return (
            float(np.sqrt(abs(dot(self.system.comm, residual, self._stiff.solve(residual)))))
            or np.finfo(float).tiny
        )


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


@dataclass(frozen=True)
class Rules:
    """What solutions of shells that may touch have to keep.

    Attributes
    ----------
    passes
        Whether shells pass through each other on the straight way between two states.
    own
        A solution with penalties and cuts of its own, to be solved again; None if it has them.
    """

    passes: Callable[[State, State], bool] = lambda here, there: False
    own: Callable[[State], State | None] = lambda state: None


class Guess:
    """A guess, made when it is needed, and the direction in which it is away from a known solution.

    Attributes
    ----------
    reached
        Whether a way without shells that pass through each other leads there.
    """

    def __init__(
        self,
        make: Callable[[], State],
        base: State,
        displacement: Callable[[Vector], Vector],
        *,
        reached: bool,
    ) -> None:
        self._make, self._base, self._displacement, self.reached = make, base, displacement, reached

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
    rules: Rules | None = None,
) -> Iterator[Point]:
    """Solutions at the amplitudes of a known one, each accepted as a point of the path is.

    Parameters
    ----------
    path
        By load control, in any amplitude. Its journal gets the result of every attempt.
    start
        A solution.
    guesses
        Further guesses, which are tried first; ways lead there on which no shells pass through each
        other.
    displacement
        A vector of the system with zeros for unknowns that are no displacements.
    descend
        Lets a state go down in energy by some steps; then only stable solutions count. None: all
        count.
    rules
        Of shells that may touch.
    """
    search = _Search(path, [start], descend, limits.over, rules or Rules())
    queue = [Guess(make, start, displacement, reached=True) for make in guesses]
    queue += search.along_mode(start, displacement)
    accepted = 0
    for number, guess in enumerate(queue, 1):  # the queue grows
        attempts = [*([search.by_descent] if descend else []), search.by_newton, search.by_release]
        while attempts:
            attempt = attempts.pop(0)
            path.progress.doing(
                f"searching: guess {number} of at most {limits.guesses}, solutions found: {accepted}"
            )
            point = path.recorded(partial(_unless, limits.over, attempt, guess))
            if point == OVER:
                return
            if isinstance(point, str) or isinstance(point := search.kept(guess, point), str):
                continue
            search.known.append(point.state)
            queue += search.along_mode(point.state, displacement)
            accepted += not (descend and point.negative_pivots)
            yield point
            if accepted == limits.solutions:
                return
            attempts = [search.by_newton]  # which may find another one now
        if number == limits.guesses:
            return


def _unless(
    over: Callable[[], bool], attempt: Callable[[Guess], Point | str], guess: Guess
) -> Point | str:
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
        self,
        path: Path,
        known: list[State],
        descend: Callable[[State], State] | None,
        over: Callable[[], bool],
        rules: Rules,
    ) -> None:
        self._path, self.known, self._descend, self._over, self._rules = (
            path,
            known,
            descend,
            over,
            rules,
        )
        self._system, self._newton = path.system, path.newton
        self._solver = Path(path.newton, path.name, "load", path.options)  # without a journal
        self._value = known[0].mu[path.name]
        self._row = path.given("load", self._value)

    def kept(self, guess: Guess, point: Point) -> Point | str:
        """A solution as the rules ask for it, or why it is none: every known one is reached without
        passing through.
        """
        for _ in range(MOST_CHANGED):
            if (own := self._rules.own(point.state)) is None:
                break
            again = self._path.recorded(partial(self._again, own))
            if isinstance(again, str):
                return again
            point = again
        else:
            return "the shells that touch have no cuts and penalties that last"
        if self._is_known(point.state):
            return "the solution is a known one"
        begins = [*self.known, *([guess.state] if guess.reached else [])]
        if all(self._rules.passes(begin, point.state) for begin in begins):
            return "shells have passed through each other"
        return point

    def _again(self, state: State) -> Point | str:
        point = self._solver.solve(self._row, self._value, state)
        return point if isinstance(point, str) else self._solver.exact(point, point)

    def by_newton(self, guess: Guess) -> Point | str:
        """The solution that deflated Newton's method finds from a guess."""
        return self._accepted(guess.state)

    def by_descent(self, guess: Guess) -> Point | str:
        """The stable solution below a guess; from an unstable one on the way it goes on along the
        softest mode.
        """
        assert self._descend
        state, tried = guess.state, "it does not come to rest"
        for _ in range(DESCENTS):
            if self._over():
                return OVER
            state = self._descend(state)
            if self._newton.factor_at(state).negative_pivots:
                continue
            near = deflated(self._newton, state, self._path.name, self._row)
            outcome = (
                self._solver.solve(self._row, self._value, near) if near else "no solution is near"
            )
            if isinstance(outcome, str):
                tried = outcome
            elif self._is_known(outcome.state):
                return "the solution is a known one"
            else:
                point = self._solver.exact(outcome, outcome)
                if not point.negative_pivots:
                    return point
                state = _Mode(self._path, point.state).state(DOWN)
        return tried

    def by_release(self, guess: Guess) -> Point | str:
        """The first solution on the path of a force that holds the guess."""
        for state in released(self._newton, guess.state, guess.direction):
            accepted = self._accepted(state)
            if not isinstance(accepted, str):
                return accepted
        return "the force does not fall to zero"

    def along_mode(self, state: State, displacement: Callable[[Vector], Vector]) -> list[Guess]:
        """Guesses on both sides of a solution along its softest mode."""
        mode = _Mode(self._path, state)
        return [
            Guess(partial(mode.state, size), state, displacement, reached=False)
            for size in (MODE, -MODE)
        ]

    def _accepted(self, guess: State) -> Point | str:
        path = self._path
        near = deflated(
            self._newton, guess, path.name, self._row, [state.u for state in self.known]
        )
        if near is None:
            return "Newton's method finds no other solution"
        point = self._solver.solve(self._row, self._value, near)
        if isinstance(point, str):
            return point
        if self._is_known(point.state):
            return "the solution is a known one"
        return self._solver.exact(point, point)

    def _is_known(self, solution: State) -> bool:
        away = (max_abs(self._system.comm, solution.u - state.u) for state in self.known)
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
