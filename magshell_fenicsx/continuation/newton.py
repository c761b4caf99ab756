"""Newton's method on the bordered system for (u, mu), by PETSc's SNES:

    R(u) + mu R_mu(u) = 0      K du + R_mu dmu = -R
    g(u, mu)          = 0      c.du + d    dmu = -g

One factorisation of K and two back-solves make a step, whatever the last row. `BorderedNewton` is
the corrector of a path, and computes the path's tangent at a solution.

mu is the one amplitude (load parameter) that varies; the others are fixed. A row is the scalar
equation g = 0: a prescribed load, conjugate displacement (on which mu does work) or arc length.
The argument `stress` is a list of displacements with weights: K takes the weighted sum of their
stresses in place of the stress of u, since small errors of a guess u change its own stress much.
Lengths are displacements in units of the system's length. Negative pivots of K count unstable
directions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from petsc4py import PETSc

from magshell_fenicsx.continuation.control import (
    BorderedMatrix,
    ConstraintRow,
    add_scaled,
    refined_tangent,
)
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.snes import (
    HIDDEN_BY_ROUNDING,
    REASON_MESSAGES,
    LatestTangent,
    NewtonOptions,
    SnesCallbacks,
    SolveOptions,
    make_snes,
)
from magshell_fenicsx.continuation.system import (
    State,
    System,
    Vector,
    WeightedDisplacement,
    dot,
    max_abs,
)
from magshell_fenicsx.platform.interrupt import first_cause

# successive stiffnesses of touching faces, over the final ones; the first is about that of a shell
STIFFNESS_FRACTIONS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
# error between soft faces, over the first step: harder faces move less, so a smaller one is wasted
SOFT_FACES_TOLERANCE = 0.1


@dataclass(frozen=True)
class NewtonResult:
    """The result of Newton's method, and its work.

    Attributes
    ----------
    state
        The last iterate, which is the solution if `converged`.
    reason
        "converged", or why the iteration ended.
    error
        Estimated error of u, over the system's length.
    """

    state: State
    converged: bool
    iterations: int
    reason: str
    error: float


@dataclass(frozen=True)
class Response:
    """The tangent (du, dmu) of a path at a solution, per unit of its row.

    Attributes
    ----------
    softness
        dq/dmu of the conjugate displacement q.
    negative_pivots
        Number of unstable directions at the fixed amplitude.
    """

    du: Vector
    dmu: float
    softness: float
    negative_pivots: int


class BorderedNewton:
    """Newton's method for R(u, mu) = 0 with one more row, by PETSc's SNES.

    One solver serves every amplitude and row of a system.

    Parameters
    ----------
    options
        Tolerance and rules of convergence; None: the defaults.
    factorisation
        Shared factors of another solver; None: this solver has factors of its own.

    Attributes
    ----------
    factorisation
        Factors of the latest tangent.

    Private fields: `_full_steps` and `_line_search` are two SNES, the second only where forces
    begin within a step. `_callbacks` are what both call, `_x` is their vector (u, mu), `_tangent`
    the latest tangent with its state, `_work` the count of iterations, which several solvers share.
    """

    def __init__(
        self,
        system: System,
        options: NewtonOptions | None = None,
        factorisation: Factorisation | None = None,
    ) -> None:
        """Create a SNES with full steps, and one with a line search where forces have onsets."""
        self.system = system
        self.options = options or NewtonOptions()
        self.factorisation = factorisation or Factorisation(system.comm)
        self._work = _Work()
        self._tangent = LatestTangent(system, self.factorisation)
        self._callbacks = SnesCallbacks(self._tangent, self.options)
        self._x = self._callbacks.new_vector()
        self._full_steps = make_snes(self._callbacks, self._x, self.options)
        self._line_search: Any = None
        if self.options.has_onsets:
            self._line_search = make_snes(self._callbacks, self._x, self.options, "bt")

    def for_system(self, system: System) -> "BorderedNewton":
        """Return a solver for another system that shares the factors and the counts of work.

        The tangent of that system is the one of this system, or has it as a block.
        """
        solver = BorderedNewton(system, self.options, self.factorisation)
        solver._work = self._work
        return solver

    @property
    def iterations(self) -> int:
        """The number of iterations of all solves so far."""
        return self._work.iterations

    def solve(
        self,
        guess: State,
        name: str,
        row: ConstraintRow,
        stress: Sequence[WeightedDisplacement] = (),
        *,
        search: bool = True,
        reuse_distance: float = 0.0,
        max_step: float = np.inf,
    ) -> NewtonResult:
        """Find the equilibrium near `guess` on which `row` holds, with mu the amplitude `name`.

        If full steps fail, softer faces and a line search are tried. Collective.

        Parameters
        ----------
        stress
            Weighted displacements whose stress replaces that of the guess in the first matrix.
        search
            Whether softer faces and a line search are tried where full steps fail and forces begin
            within a step.
        reuse_distance
            Distance from the guess, in lengths, up to which the factors of another state begin the
            solve.
        max_step
            A longer step, in lengths, ends the solve early. If it is finite, steps that lead astray
            end the solve early too, and nothing else is tried: a shorter step of the path then
            costs less.
        """
        options = SolveOptions(stress, reuse_distance, max_step)
        result = self._run_snes(self._full_steps, guess, name, row, options)
        # rounding hides the solution whatever the steps
        if result.converged or result.reason == HIDDEN_BY_ROUNDING:
            return result
        is_patient = search and max_step == np.inf
        if not (is_patient and self._line_search):
            return result
        # soft faces that become harder, then a line search
        second_result = self._solve_by_stiffening(guess, name, row) or self._run_snes(
            self._line_search, guess, name, row, SolveOptions(stress, searched=True)
        )
        return second_result if second_result.converged else result

    def solve_roughly(
        self, guess: State, name: str, row: ConstraintRow, fraction: float
    ) -> NewtonResult:
        """Find the equilibrium near a good guess, to a fraction of the error of the guess.

        If full steps fail, it is found as by `solve`. Collective.
        """
        options = SolveOptions(relative_tolerance=fraction)
        result = self._run_snes(self._full_steps, guess, name, row, options)
        return result if result.converged else self.solve(guess, name, row)

    def _solve_by_stiffening(
        self, guess: State, name: str, row: ConstraintRow
    ) -> NewtonResult | None:
        """Solve between touching faces that are soft at first and then harder.

        Faces that penetrate each other deeply at a guess push shells far away, from where full
        steps do not come back. Soft ones, as stiff as the shells, show where these touch. The
        stiffnesses are amplitudes, which grow from solve to solve.

        Returns
        -------
        The result with the final stiffnesses; None if a solve on the way fails.
        """
        state, iterations = guess, 0
        options = SolveOptions(relative_tolerance=SOFT_FACES_TOLERANCE)
        for fraction in STIFFNESS_FRACTIONS:
            # a fraction of the final stiffnesses: of those of the guess, or the default ones
            softer = {
                stiffness: fraction * guess.mu.get(stiffness, default)
                for stiffness, default in self.options.stiffnesses.items()
            }
            soft_guess = State(state.u, {**state.mu, **softer})
            result = self._run_snes(self._full_steps, soft_guess, name, row, options)
            state, iterations = result.state, iterations + result.iterations
            if not result.converged:
                return None
        # the amplitudes of the guess again, with the stiffnesses that it had
        hard_guess = guess.with_(state.u, name, state.mu[name])
        result = self._run_snes(self._full_steps, hard_guess, name, row, SolveOptions())
        if not result.converged:
            return None
        return replace(result, iterations=iterations + result.iterations)

    def _run_snes(
        self,
        snes: Any,
        guess: State,
        name: str,
        row: ConstraintRow,
        options: SolveOptions,
    ) -> NewtonResult:
        """Run SNES from a guess, and return its result.

        Parameters
        ----------
        snes
            PETSc's SNES with full steps or with a line search.
        options
            The way this one solve runs.
        """
        callbacks = self._callbacks
        # the tolerance of steps, which an option of PETSc may have replaced
        _, _, step_tolerance, _ = snes.getTolerances()
        callbacks.begin(guess, name, row, step_tolerance, options)
        callbacks.join((guess.u, guess.mu[name]), self._x)
        try:
            snes.solve(None, self._x)
        except PETSc.Error as e:
            # the error of a callback, such as an interrupt, hides behind PETSc's own
            raise first_cause(e) from None
        code, iterations = snes.getConvergedReason(), snes.getIterationNumber()
        converged = code > 0
        u, mu = callbacks.split(self._x)
        # the test of convergence has computed one more step, which is taken as well
        if converged and (step := callbacks.step_at(self._x)):
            u, mu = add_scaled((u, mu), -1.0, step)  # (u, mu) less the step
        self._work.iterations += iterations
        reason = "converged" if converged else REASON_MESSAGES.get(code, f"SNES reason {code}")
        state = guess.with_(u, name, mu)
        return NewtonResult(state, converged, iterations, reason, callbacks.error)

    def forget_factors(self) -> None:
        """Forget to which state the factors belong: the energies have changed."""
        self._tangent.forget()

    def ensure_factors_near(self, state: State, distance: float = np.inf) -> None:
        """Factor the tangent at a state unless factors of a near state are known. Collective.

        A resumed run may have none.

        Parameters
        ----------
        distance
            Largest difference of an entry of u, in lengths of the system.
        """
        if not self._tangent.is_near(state, distance):
            self._tangent.factor_at(state)

    def correct_once(
        self, guess: State, name: str, row: ConstraintRow, max_step: float
    ) -> State | None:
        """Return a guess after one Newton step with the present factors. Collective.

        Parameters
        ----------
        max_step
            Largest size of the step, in lengths of the system.

        Returns
        -------
        The corrected state; None if the step is longer.
        """
        system = self.system
        matrix = BorderedMatrix(system, self.factorisation, guess, name, row)
        step = matrix.solve(system.residual(guess.u, guess.mu), row.residual(guess))
        if not matrix.size(step) <= max_step:
            return None
        u, mu = add_scaled((guess.u, guess.mu[name]), -1.0, step)
        return guess.with_(u, name, mu)

    def factor_at(self, state: State, stress: Sequence[WeightedDisplacement] = ()) -> Factorisation:
        """Factor the tangent at a state, unless its factors are known. Collective.

        Parameters
        ----------
        stress
            Weighted displacements whose stress replaces that of the state.
        """
        return self._tangent.factor_at(state, stress)

    def response(
        self,
        state: State,
        name: str,
        row: ConstraintRow,
        *,
        exact: bool = False,
    ) -> Response:
        """Return the path's tangent at a solution: K du + R_mu dmu = 0, c . du + d dmu = 1.

        Factors of a nearby state are used if they serve; the tangent is then refined by differences
        of the residual. Collective.

        Parameters
        ----------
        state
            The solution.
        name
            The amplitude mu.
        row
            The last row, whose gradient is (c, d).
        exact
            Whether K is factored at the solution itself, not at a nearby state.
        """
        factored = self._tangent.state  # None if no factors are known
        distance = self._distance(state, factored)
        reuses_factors = distance <= self.options.reuse_distance and not exact
        matrix_state = factored if reuses_factors and factored else state
        matrix = self._bordered_matrix(matrix_state, name, row)
        tangent, load = matrix.tangent, self.system.load(state.u, state.mu, name)
        # the matrix is not quite that of the solution: its tangent is refined by differences
        if distance != 0 and reuses_factors:
            refined = refined_tangent(self.system, matrix, tangent, state, load, row)
            if refined is None:  # too far: with a matrix of the solution itself
                return self.response(state, name, row, exact=True)
            tangent = refined
        du, dmu = tangent
        # q = -dPi/dmu: dq = -R_mu . du - Pi_mumu dmu
        softness = -dot(self.system.comm, load, du) / dmu - self.system.curvature(
            state.u, state.mu, name, name
        )
        return Response(du, dmu, softness, self.factorisation.negative_pivots)

    def _distance(self, state: State, factored: State | None) -> float:
        """Return the largest difference of an entry of u of two states, in lengths.

        It is infinite if the second state is None. Collective.
        """
        if factored is None:
            return np.inf
        return max_abs(self.system.comm, state.u - factored.u) / self.system.length

    def _bordered_matrix(self, state: State, name: str, row: ConstraintRow) -> BorderedMatrix:
        """Return the bordered matrix at a state.

        It is that of the last solve, if this had the same state and row.
        """
        last_matrix, count = self._callbacks.matrix, self.factorisation.count
        factors = self._tangent.factor_at(state)
        if last_matrix and count == factors.count:
            # the same objects, not equal ones
            has_same_border = last_matrix.row is row and last_matrix.state is state
            if has_same_border:
                return last_matrix
        return BorderedMatrix(self.system, factors, state, name, row)


@dataclass
class _Work:
    """Count of the iterations of all solves, which several solvers share."""

    iterations: int = 0
