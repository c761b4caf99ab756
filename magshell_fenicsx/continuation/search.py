"""A search for further solutions at the amplitudes of a known one, by deflation from many guesses.

A guess is tried in two ways: by Newton's method with all known solutions deflated, and by the path
on which a force along its displacement that holds it is released. Each solution that is found gives
two more guesses, along its softest mode. A search for stable solutions first lets each guess
settle: it follows a descent of the energy until it comes to rest.

**Release.** R(u) + t b = 0 with -b . u = q, first that of the guess; then the path is followed by
arc length, through folds, until the force t is zero: there is an equilibrium.

**Settling.** Every step solves (K + s K0) du = -R, with the tangent K0 of the unloaded system: one
implicit step of the flow K0 du/dt = -R, of length 1/s. Sharp folds relax, while soft directions
stay almost where they are. It goes down the energy, so its fixed points are stable equilibria.

R = dPi/du, K = dR/du; the guess's displacement b is counted from the known solution. Deflation
multiplies R by a factor that removes known solutions. The softest mode has the eigenvalue of K
nearest to zero; a stable solution has no negative pivots. Lengths are displacements in units of the
system's length.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from petsc4py import PETSc

from magshell_fenicsx.continuation.bifurcation import largest_entry
from magshell_fenicsx.continuation.control import PrescribedConjugate
from magshell_fenicsx.continuation.deflation import find_deflated
from magshell_fenicsx.continuation.device import FORCE, HoldingForceSystem
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

# steps along the path of a holding force: the first in the metric's length, others over the first
FIRST_STEP, MAX_STEP_RATIO, MIN_STEP_RATIO = 0.02, 1000.0, 1e-3
MAX_STEPS, MAX_FORCE_RATIO = 30, 10.0  # of that path; the force over the first one
MAX_BRACKETS = 4  # solves for the zero of the force
FORCE_TOLERANCE = 1e-2  # of the change of the force: less counts as zero
FORCE_SCALE = 1e6  # of the arc length: the force counts as nothing in it
MAX_SETTLING_FACTORISATIONS = 40
MAX_UNEXPLAINED = 0.7  # fraction of the residual that a step of settling may leave
EASY_UNEXPLAINED = 0.2  # where it leaves less, the next step is longer
# settling ends after a step that is shorter, in lengths of the system, with a shift so small
REST_STEP, REST_SHIFT = 0.05, 0.01
SAME_SOLUTION_DISTANCE = 1e-3  # in lengths of the system: nearer solutions are one
MODE_SIZE = 1.0  # in lengths: size of a mode in a guess
DESCENT_SIZE = 0.3  # in lengths: size of a mode by which a descent leaves an unstable solution
MAX_PARAMETER_CHANGES = 10  # times that a solution gets stiffer penalties or new cuts
MAX_DESCENTS = 20  # times that a guess goes on settling
TIME_IS_OVER = "the time of the search is over"


def released(newton: BorderedNewton, guess: State, b: Vector) -> Iterator[State]:
    """Yield guesses of equilibria on the path of a force along b that first holds a guess.

    Each is a state where the force is zero. The path begins in the direction in which the force
    falls in size. Collective.

    Parameters
    ----------
    guess
        A state out of equilibrium.
    b
        The direction of the force, of any length.
    """
    system = newton.system
    residual, square = system.residual(guess.u, guess.mu), dot(system.comm, b, b)
    # a multiple of b that is as large as the residual: the amplitude of the force is of order one
    scale = np.sqrt(dot(system.comm, residual, residual) / square) or 1.0
    b = np.asarray(b * scale)
    # the amplitude `FORCE` of this solver is t
    holder = newton.for_system(HoldingForceSystem(system, b))
    held_state = _held_state(holder, guess, b, residual)
    if held_state is None:
        return
    options = StepOptions(
        first=FIRST_STEP,
        largest=MAX_STEP_RATIO * FIRST_STEP,
        smallest=MIN_STEP_RATIO * FIRST_STEP,
    )
    path = Path(holder, FORCE, "arc", options, scale=FORCE_SCALE)
    first_force = held_state.mu[FORCE]
    max_force = MAX_FORCE_RATIO * abs(first_force)
    # the path of the force, to where it is zero; at first its size falls
    last_point = path.start(held_state, -float(np.copysign(1.0, first_force)))
    try:
        for count, (point, _) in enumerate(path.continue_to(last_point, [np.inf]), 1):
            force_before, force_after = (
                step_end.state.mu[FORCE] for step_end in (last_point, point)
            )
            # between two zero forces there is nothing to find
            if force_before * force_after <= 0 and force_before != force_after:
                state = _state_without_force(path, last_point, path.relative_to(last_point, point))
                yield State(state.u, dict(guess.mu))
            last_point = point
            if count == MAX_STEPS or abs(force_after) > max_force:
                return
    except PathStopped:
        return


def _held_state(holder: BorderedNewton, guess: State, b: Vector, residual: Vector) -> State | None:
    """Return the equilibrium near a guess with a force t b; None if it is not found. Collective.

    The component of u along b stays that of the guess.

    Parameters
    ----------
    holder
        Solver of the system with the force, whose amplitude `FORCE` is t.
    residual
        The residual at the guess without the force.
    """
    comm = holder.system.comm
    # the first t makes the residual as small as possible, by least squares
    force = -dot(comm, b, residual) / dot(comm, b, b)
    row = PrescribedConjugate(holder.system, FORCE, -dot(comm, b, guess.u))
    # no solutions are deflated here: the method only shortens its steps
    start = find_deflated(holder, State(guess.u, {**guess.mu, FORCE: force}), FORCE, row)
    result = holder.solve(start, FORCE, row) if start else None
    if result is None or not result.converged:
        return None
    return result.state


def _state_without_force(path: Path, base: Point, high: Point) -> State:
    """Return the state between two points of a path where the holding force is zero.

    Regula falsi is repeated until little of the force is left.

    Parameters
    ----------
    base, high
        Points with forces of opposite signs; arc length is measured from the first.
    """
    low, force_change = base, abs(base.state.mu[FORCE]) + abs(high.state.mu[FORCE])
    for _ in range(MAX_BRACKETS):
        low_force, high_force = low.state.mu[FORCE], high.state.mu[FORCE]
        # where the force, linear between both points, is zero
        s = low.s + (high.s - low.s) * low_force / (low_force - high_force)
        middle = path.correct_between(s, low, high, base)
        if isinstance(middle, str):
            return path.interpolated_state(s, low, high)
        if abs(middle.state.mu[FORCE]) <= FORCE_TOLERANCE * force_change:
            return middle.state
        low, high = (middle, high) if middle.state.mu[FORCE] * low_force > 0 else (low, middle)
    return min(low, high, key=lambda end: abs(end.state.mu[FORCE])).state


@dataclass
class Settling:
    """The flow of a system from any guess towards a stable equilibrium.

    Each step solves (K + s K0) du = -R with a shift s: one implicit step in time, of length 1/s, of
    the flow K0 du/dt = -R, which goes down the energy.

    Parameters
    ----------
    unloaded
        A state with a positive definite tangent K0.
    passes
        Called with the states before and after a step. It returns whether shells would pass through
        each other; the step is then refused.

    Private fields: `_K0` is the matrix K0, `_K0_factors` are its factors, and `_factors` those of
    the latest K + s K0.
    """

    system: System
    unloaded: State
    passes: Callable[[State, State], bool] = lambda here, ahead: False

    def __post_init__(self) -> None:
        K = symmetric_part(self.system.tangent(self.unloaded.u, self.unloaded.mu))
        self._K0 = K.copy()
        self._K0_factors = Factorisation(self.system.comm)
        self._factors = Factorisation(self.system.comm)
        self._K0_factors.factor(self._K0)

    def settled(self, guess: State) -> State:
        """Return the state after some steps, or near the stable equilibrium where they end.

        The shift s grows while K + s K0 is not positive definite or a step leaves much of the
        residual, and falls after good steps. Collective.
        """
        system, u, shift, factorisations = self.system, guess.u, 1.0, 0
        residual = system.residual(u, guess.mu)
        # outer loop: one tangent for each accepted step; inner loop: trials of the step
        while factorisations < MAX_SETTLING_FACTORISATIONS:
            K = symmetric_part(system.tangent(u, guess.mu)).copy()
            while factorisations < MAX_SETTLING_FACTORISATIONS:
                factorisations += 1
                self._factor_shifted(K, shift)
                # not positive definite: a shorter step in time
                if self._factors.negative_pivots:
                    shift *= 2
                    continue
                du = -self._factors.solve(residual)
                next_residual = system.residual(u + du, guess.mu)
                # a linear system would leave the residual -shift K0 du: what is left beside it
                unexplained_force = next_residual + shift * self._K0_factors.times(du)
                unexplained = self._size(unexplained_force) / self._size(residual)
                is_accepted = unexplained <= MAX_UNEXPLAINED and not self.passes(
                    State(u, guess.mu), State(u + du, guess.mu)
                )
                if not is_accepted:  # a shorter step in time
                    shift *= 3
                    continue
                u, residual = u + du, next_residual
                is_at_rest = (
                    shift < REST_SHIFT and max_abs(system.comm, du) <= REST_STEP * system.length
                )
                shift /= 4 if unexplained < EASY_UNEXPLAINED else 1
                if is_at_rest:
                    return State(u, guess.mu)
                break
        return State(u, guess.mu)

    def _factor_shifted(self, K: PETSc.Mat, shift: float) -> None:
        """Factor K + shift K0, whose factors are then in `_factors`. Collective."""
        shifted = K.copy()
        # K has entries of contacts too
        structure = PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN
        shifted.axpy(shift, self._K0, structure)
        self._factors.factor(shifted)

    def _size(self, residual: Vector) -> float:
        """Return the square root of R . K0^-1 R: the norm by K0 of the displacement K0^-1 R."""
        square = dot(self.system.comm, residual, self._K0_factors.solve(residual))
        return float(np.sqrt(abs(square))) or np.finfo(float).tiny


@dataclass(frozen=True)
class SearchLimits:
    """The end of a search.

    Attributes
    ----------
    solutions, guesses
        Largest numbers of solutions and of guesses.
    time_is_over
        Whether the time is over; the same on all ranks.
    """

    solutions: int
    guesses: int
    time_is_over: Callable[[], bool] = lambda: False


@dataclass(frozen=True)
class AcceptanceRules:
    """Conditions on solutions of shells in contact.

    Attributes
    ----------
    passes
        Called with two states. It returns whether shells pass through each other on the straight
        segment between them.
    with_own_parameters
        Called with a solution. It returns the solution with contact stiffnesses and with parts of
        cells in contact (cuts) that fit it, to be solved again; None if it has them already.
    """

    passes: Callable[[State, State], bool] = lambda here, there: False
    with_own_parameters: Callable[[State], State | None] = lambda state: None


class SearchGuess:
    """A guess of a solution, computed when it is needed, and its direction from a known solution.

    Parameters
    ----------
    make
        Returns the state of the guess.
    base
        The known solution.
    displacement
        Returns a vector of the system with zeros for unknowns that are no displacements.

    Attributes
    ----------
    reachable
        Whether a path leads there on which no shells pass through each other.
    """

    def __init__(
        self,
        make: Callable[[], State],
        base: State,
        displacement: Callable[[Vector], Vector],
        *,
        reachable: bool,
    ) -> None:
        self._make, self._base, self._displacement = make, base, displacement
        self.reachable = reachable

    @cached_property
    def state(self) -> State:
        """The state of the guess."""
        return self._make()

    @property
    def direction(self) -> Vector:
        """The displacement from the known solution."""
        return self._displacement(self.state.u - self._base.u)


def further_solutions(
    path: Path,
    start: State,
    guesses: Iterable[Callable[[], State]],
    limits: SearchLimits,
    displacement: Callable[[Vector], Vector] = lambda u: u,
    descend: Callable[[State], State] | None = None,
    rules: AcceptanceRules | None = None,
) -> Iterator[Point]:
    """Yield solutions at the amplitudes of a known one, each accepted like a point of a path.

    Each solution that is found adds two guesses along its softest mode. Collective.

    Parameters
    ----------
    path
        A path by load control, in any amplitude. Its journal stores the result of every attempt.
    start
        A solution.
    guesses
        Functions that return further guesses, which are tried first; paths lead there on which no
        shells pass through each other.
    limits
        The numbers of solutions and guesses, and the time, at which the search ends.
    displacement
        Returns a vector of the system with zeros for unknowns that are no displacements.
    descend
        Lets a state go down in energy by some steps; then only stable solutions count. None: all
        count.
    rules
        Conditions on shells in contact; None: there are none.
    """
    is_over, rules = limits.time_is_over, rules or AcceptanceRules()
    search = _SolutionSearch(path, [start], descend, is_over, rules)
    queue = [SearchGuess(make, start, displacement, reachable=True) for make in guesses]
    queue += search.guesses_along_mode(start, displacement)
    accepted = 0
    for number, guess in enumerate(queue, 1):  # the queue grows
        attempts = [*([search.by_descent] if descend else []), search.by_newton, search.by_release]
        while attempts:
            attempt = attempts.pop(0)
            _report(path, number, limits, accepted)
            point = path.recorded(partial(_unless_over, is_over, attempt, guess))
            if point == TIME_IS_OVER:
                return
            if not isinstance(point, str):
                point = search.accept_by_rules(guess, point)
            if isinstance(point, str):  # the reason of a failure
                continue
            search.known_solutions.append(point.state)
            queue += search.guesses_along_mode(point.state, displacement)
            # an unstable solution does not count where stable ones are searched for
            accepted += not (descend and point.negative_pivots)
            yield point
            if accepted == limits.solutions:
                return
            attempts = [search.by_newton]  # with this one deflated, it may find another one
        if number == limits.guesses:
            return


def _report(path: Path, number: int, limits: SearchLimits, accepted: int) -> None:
    """Report that a guess is tried: its number, and the number of solutions accepted so far."""
    path.progress.doing(
        f"searching: guess {number} of at most {limits.guesses}, solutions found: {accepted}"
    )


def _unless_over(
    time_is_over: Callable[[], bool],
    attempt: Callable[[SearchGuess], Point | str],
    guess: SearchGuess,
) -> Point | str:
    """Return the result of an attempt with a guess, or `TIME_IS_OVER`.

    States without meaning, far from equilibrium, may have no factors: such an error is returned as
    the reason of failure.
    """
    try:
        return TIME_IS_OVER if time_is_over() else attempt(guess)
    except (NoEigenpair, PETSc.Error, np.linalg.LinAlgError) as e:
        return str(e)


class _SolutionSearch:
    """The attempts of a search, each of which returns a point or the reason of its failure.

    Parameters
    ----------
    path
        The path by load control on which the solutions are points.
    known_solutions
        The solutions that are deflated; at least one.
    descend
        Lets a state go down in energy by some steps; None: the search is not for stable solutions.
    rules
        Conditions on solutions of shells in contact.
    time_is_over
        Whether the time of the search is over.

    Attributes
    ----------
    known_solutions
        The solutions so far.

    Private fields: `_solver` is a path like `_path`, but without a journal. `_value` is the
    amplitude of all solutions, and `_row` the equation that prescribes it. `_over`, `_descend` and
    `_rules` are the parameters `time_is_over`, `descend` and `rules`.
    """

    def __init__(
        self,
        path: Path,
        known_solutions: list[State],
        descend: Callable[[State], State] | None,
        time_is_over: Callable[[], bool],
        rules: AcceptanceRules,
    ) -> None:
        """Take the amplitude from the first known solution; a row holds it in every solve.

        Attempts use a solver without a journal: only their results are recorded.
        """
        self._path, self.known_solutions, self._descend = path, known_solutions, descend
        self._over, self._rules = time_is_over, rules
        self._system, self._newton = path.system, path.newton
        self._solver = Path(path.newton, path.name, "load", path.options)  # without a journal
        self._value = known_solutions[0].mu[path.name]
        self._row = path.prescribed("load", self._value)

    def accept_by_rules(self, guess: SearchGuess, point: Point) -> Point | str:
        """Return a solution that obeys the rules, or the reason why it is refused.

        The solution gets contact stiffnesses and cuts that fit it, and is solved again until they
        do. It must be new. From one known solution, or from the guess if a path leads there, the
        straight way to it must not lead shells through each other.
        """
        # `else`: the loop has ended without a point that keeps its stiffnesses and cuts
        for _ in range(MAX_PARAMETER_CHANGES):
            if (state := self._rules.with_own_parameters(point.state)) is None:
                break
            solved = self._path.recorded(partial(self._solve_from, state))
            if isinstance(solved, str):
                return solved
            point = solved
        else:
            return "the shells that touch have no cuts and penalties that last"
        if self._is_known(point.state):
            return "the solution is a known one"
        # one way without passage is enough
        states_before = [*self.known_solutions, *([guess.state] if guess.reachable else [])]
        if all(self._rules.passes(begin, point.state) for begin in states_before):
            return "shells have passed through each other"
        return point

    def _solve_from(self, state: State) -> Point | str:
        """Return the solution near a state with its own inertia, or the reason of failure."""
        point = self._solver.solve(self._row, self._value, state)
        return point if isinstance(point, str) else self._solver.with_own_inertia(point, point)

    def by_newton(self, guess: SearchGuess) -> Point | str:
        """Return the new solution that deflated Newton's method finds, or the reason of failure."""
        return self._new_solution(guess.state)

    def by_descent(self, guess: SearchGuess) -> Point | str:
        """Return the new stable solution below a guess, or the reason of failure.

        From an unstable solution it descends further along the softest mode.
        """
        assert self._descend
        state, reason = guess.state, "it does not come to rest"
        for _ in range(MAX_DESCENTS):
            if self._over():
                return TIME_IS_OVER
            state = self._descend(state)
            if self._newton.factor_at(state).negative_pivots:  # not near a stable solution yet
                continue
            start = find_deflated(self._newton, state, self._path.name, self._row)
            result: Point | str = "no solution is near"
            if start:
                result = self._solver.solve(self._row, self._value, start)
            if isinstance(result, str):  # the descent goes on
                reason = result
                continue
            if self._is_known(result.state):
                return "the solution is a known one"
            point = self._solver.with_own_inertia(result, result)
            if not point.negative_pivots:
                return point
            # beside an unstable solution the descent goes on
            state = _SoftestMode(self._path, point.state).displaced_state(DESCENT_SIZE)
        return reason

    def by_release(self, guess: SearchGuess) -> Point | str:
        """Return the first new solution on the path of a force that holds a guess.

        If there is none, return the reason of failure.
        """
        for state in released(self._newton, guess.state, guess.direction):
            point = self._new_solution(state)
            if not isinstance(point, str):
                return point
        return "the force does not fall to zero"

    def guesses_along_mode(
        self, state: State, displacement: Callable[[Vector], Vector]
    ) -> list[SearchGuess]:
        """Return two guesses, on both sides of a solution along its softest mode.

        Parameters
        ----------
        state
            The solution.
        displacement
            Returns a vector with zeros for unknowns that are no displacements.
        """
        mode = _SoftestMode(self._path, state)
        return [
            SearchGuess(partial(mode.displaced_state, size), state, displacement, reachable=False)
            for size in (MODE_SIZE, -MODE_SIZE)
        ]

    def _new_solution(self, guess: State) -> Point | str:
        """Return a solution near a guess that is none of the known ones, or the reason of failure.

        Newton's method with all known solutions deflated comes first, then the solver confirms.
        """
        path, known_solutions = self._path, [state.u for state in self.known_solutions]
        start = find_deflated(self._newton, guess, path.name, self._row, known_solutions)
        if start is None:
            return "Newton's method finds no other solution"
        point = self._solver.solve(self._row, self._value, start)
        if isinstance(point, str):
            return point
        # without deflation the solver may fall back to a known one
        if self._is_known(point.state):
            return "the solution is a known one"
        return self._solver.with_own_inertia(point, point)

    def _is_known(self, solution: State) -> bool:
        """Return whether a solution is nearly equal to a known one."""
        distances = (
            max_abs(self._system.comm, solution.u - state.u) for state in self.known_solutions
        )
        return min(distances) <= SAME_SOLUTION_DISTANCE * self._system.length


@dataclass(frozen=True)
class _SoftestMode:
    """The softest mode of a solution, computed when it is needed."""

    path: Path
    solution: State

    @cached_property
    def vector(self) -> Vector:
        """The mode; its largest entry is one length of the system."""
        _, mode = nearest_to_zero(self.path.newton.factor_at(self.solution))
        largest = largest_entry(self.path.system.comm, mode)
        return np.asarray(mode * self.path.system.length / largest)

    def displaced_state(self, size: float) -> State:
        """Return the solution displaced along the mode by a size in lengths."""
        return State(self.solution.u + size * self.vector, self.solution.mu)
