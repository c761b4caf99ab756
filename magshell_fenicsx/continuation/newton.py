"""Newton's method on the bordered system for (u, mu), by PETSc's SNES:

    R(u) + mu R_mu(u) = 0      K du + R_mu dmu = -R
    g(u, mu)          = 0      c.du + d    dmu = -g

One factorisation of K and two back-solves make a step, whatever the last row.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magshell_fenicsx.continuation.control import Bordered, Row, plus, refined_tangent
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.snes import (
    DIVERGED,
    FAR,
    HIDDEN,
    IN_WORDS,
    LatestTangent,
    Linearised,
    NewtonOptions,
    make_snes,
)
from magshell_fenicsx.continuation.system import State, System, Vector, Weighted, dot, max_abs

SOFT = (
    1e-6,
    1e-5,
    1e-4,
    1e-3,
    1e-2,
    1e-1,
)  # of the stiffness of faces that touch: the first is that of a shell
# of the first step between soft faces: their error need not fall below it, for harder ones move
# less
ROUGH = 0.1


@dataclass(frozen=True)
class Outcome:
    """The result of Newton's method, and its work.

    Attributes
    ----------
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
    """The tangent of a path at a solution, per unit of its row.

    Attributes
    ----------
    softness
        dq/dmu of the conjugate displacement q.
    """

    du: Vector
    dmu: float
    softness: float
    negative_pivots: int


class BorderedNewton:
    """Solves R(u, mu) = 0 with one more row; reusable for every amplitude and row of a system.

    Attributes
    ----------
    factorisation
        Factors of the latest tangent.
    """

    def __init__(
        self,
        system: System,
        options: NewtonOptions | None = None,
        factorisation: Factorisation | None = None,
    ) -> None:
        self.system = system
        self.options = options or NewtonOptions()
        self.factorisation = factorisation or Factorisation(system.comm)
        self._work = _Work()
        self._tangent = LatestTangent(system, self.factorisation)
        self._linear = Linearised(self._tangent, self.options)
        self._x = self._linear.vector()
        self._snes = make_snes(self._linear, self._x, self.options)
        kinks = self.options.kinks
        self._searching = make_snes(self._linear, self._x, self.options, "bt") if kinks else None

    def on(self, system: System) -> "BorderedNewton":
        """A solver for another system whose tangent contains this one's; factors and counts of work
        are shared.
        """
        other = BorderedNewton(system, self.options, self.factorisation)
        other._work = self._work
        return other

    @property
    def iterations(self) -> int:
        """The iterations of all solves so far."""
        return self._work.iterations

    def solve(
        self,
        guess: State,
        name: str,
        row: Row,
        stress: Sequence[Weighted] = (),
        *,
        search: bool = True,
        near: float = 0.0,
        most: float = np.inf,
    ) -> Outcome:
        """Find the equilibrium near `guess` on which `row` holds, with mu the amplitude `name`.

        Parameters
        ----------
        stress
            As that of `System.tangent`, of the guess.
        search
            Whether softer faces and a line search are tried where full steps fail and forces set in
            within a step.
        near
            Distance from the guess, in lengths, up to which the factors of another state begin the
            solve.
        most
            A longer step, in lengths, ends the solve early, and so do steps that lead astray: see
            `Iterates.hasty`.
        """
        outcome = self._solved(
            self._snes, guess, name, row, stress, near, most, foreseeing=self._tangent.foresees
        )
        far = outcome.reason in (DIVERGED, FAR)
        if (
            not outcome.converged
            and self._linear.foreseeing
            and not (far and not self._linear.misled())
        ):
            outcome = self._solved(self._snes, guess, name, row, stress, near, most)
        if search and self._searching and not outcome.converged and outcome.reason != HIDDEN:
            again = self._hardened(guess, name, row) or self._solved(
                self._searching, guess, name, row, stress
            )
            return again if again.converged else outcome
        return outcome

    def _hardened(self, guess: State, name: str, row: Row) -> Outcome | None:
        """The solution that is found between faces that are soft at first, and harder time by time;
        None if none is.

        Faces that lie deep in each other at a guess push shells far away, from where full steps do
        not come back. Soft ones, as stiff as the shells, show where these touch.
        """
        state, iterations = guess, 0
        for part in SOFT:
            softer = {
                key: part * guess.mu.get(key, k) for key, k in self.options.stiffnesses.items()
            }
            outcome = self._solved(
                self._snes, State(state.u, {**state.mu, **softer}), name, row, rough=ROUGH
            )
            state, iterations = outcome.state, iterations + outcome.iterations
            if not outcome.converged:
                return None
        outcome = self._solved(self._snes, guess.with_(state.u, name, state.mu[name]), name, row)
        return (
            replace(outcome, iterations=iterations + outcome.iterations)
            if outcome.converged
            else None
        )

    def _solved(
        self,
        snes: Any,
        guess: State,
        name: str,
        row: Row,
        stress: Sequence[Weighted] = (),
        near: float = 0.0,
        most: float = np.inf,
        *,
        foreseeing: bool = False,
        rough: float = 0.0,
    ) -> Outcome:
        linear, searched, at_most = self._linear, snes is self._searching, snes.getTolerances()[2]
        of = guess, name, row, stress, at_most
        linear.begin(
            *of, searched=searched, near=near, most=most, foreseeing=foreseeing, rough=rough
        )
        linear.join((guess.u, guess.mu[name]), self._x)
        snes.solve(None, self._x)
        ended, iterations = snes.getConvergedReason(), snes.getIterationNumber()
        solution = linear.split(self._x)
        if ended > 0 and (step := linear.step_at(self._x)):  # the last step is known already
            solution = plus(solution, -1.0, step)
        self._work.iterations += iterations
        reason = "converged" if ended > 0 else IN_WORDS.get(ended, f"SNES reason {ended}")
        return Outcome(
            guess.with_(solution[0], name, solution[1]), ended > 0, iterations, reason, linear.error
        )

    def stand_at(self, state: State, most: float = np.inf) -> None:
        """Factor the tangent at a state if no factors stand within so many lengths of it, as in a
        resumed run.
        """
        if not self._tangent.near(state, most):
            self._tangent.at(state, sure=False)

    def corrected(self, guess: State, name: str, row: Row, most: float) -> State | None:
        """A guess after one step, of at most so many lengths, with the factors that stand; None if
        it is longer.
        """
        system = self.system
        matrix = Bordered(system, self.factorisation, guess, name, row)
        step = matrix.solve(system.residual(guess.u, guess.mu), row.residual(guess), rough=True)
        if not matrix.size(step) <= most:
            return None
        u, mu = plus((guess.u, guess.mu[name]), -1.0, step)
        return guess.with_(u, name, mu)

    def factor_at(self, state: State, stress: Sequence[Weighted] = ()) -> Factorisation:
        """Factor the tangent at a state, unless its factors are known."""
        return self._tangent.at(state, stress)

    def response(
        self,
        state: State,
        name: str,
        row: Row,
        *,
        exact: bool = False,
        anew: bool = False,
        counted: bool = True,
    ) -> Response:
        """The path's tangent at a solution: K du + R_mu dmu = 0, c.du + d dmu = 1.

        Factors of a state near by are used if they serve; the tangent is then refined by
        differences of the residual.

        Parameters
        ----------
        exact
            Whether K is factored at the solution itself; a small part of it may be older.
        anew
            Whether no part may be older.
        counted
            If not, the number of negative pivots means nothing.
        """
        comm, near = self.system.comm, self._tangent.state
        moved = np.inf if near is None else max_abs(comm, state.u - near.u) / self.system.length
        serves = moved <= self.options.fresh and not (exact or anew)
        fresh = serves and (not counted or self._tangent.certain)
        matrix = self._bordered(
            near if fresh and near else state, name, row, rough=not anew, sure=counted
        )
        tangent, load = matrix.tangent, self.system.load(state.u, state.mu, name)
        if (moved and fresh) or self._tangent.rough:
            refined = refined_tangent(
                self.system, matrix, tangent, state, load, row, foreseeing=self._tangent.foresees
            )
            if refined is None:
                return self.response(state, name, row, anew=True)
            tangent = refined
        du, dmu = tangent
        softness = -dot(comm, load, du) / dmu - self.system.curvature(state.u, state.mu, name, name)
        return Response(du, dmu, softness, self.factorisation.negative_pivots)

    def _bordered(self, state: State, name: str, row: Row, *, rough: bool, sure: bool) -> Bordered:
        """The bordered matrix at a state; the one of the last solve if it has the same state and
        row.
        """
        last, count = self._linear.matrix, self.factorisation.count
        factors = self._tangent.at(state, rough=rough, sure=sure)
        kept = (
            count == factors.count and last and last.row is row and last.state is state
        )  # the same object
        return (
            last
            if kept and last
            else Bordered(self.system, factors, state, name, row, rough=self._tangent.rough)
        )


@dataclass
class _Work:
    iterations: int = 0
