"""PETSc SNES on the bordered system for (u, mu):

    R(u) + mu R_mu(u) = 0      K du + R_mu dmu = -R
    g(u, mu)          = 0      c.du + d    dmu = -g

One factorisation of K and two back-solves make a Newton step, whatever the last row. The bordered
matrix is kept while the steps shrink, with Broyden's update on top (C. T. Kelley, Iterative
Methods for Linear and Nonlinear Equations, SIAM 1995, algorithm brsol).
The unknown vector is u with mu appended on the last rank.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from petsc4py import PETSc

from magshell_fenicsx.continuation.bordered import Bordered, plus
from magshell_fenicsx.continuation.control import Row
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.iterates import Iterates, Step, Verdict
from magshell_fenicsx.continuation.refine import refined_tangent
from magshell_fenicsx.continuation.snes import REASON_OF, in_words, make_snes
from magshell_fenicsx.continuation.system import Direction, State, System, Vector, Weighted, dot, followed, max_abs
from magshell_fenicsx.platform import compat

LEAST_REST = 0.3  # Broyden's update divides the step by a number; below this one it is not trusted
MOTION = 0.1  # this part of the largest displacement counts as the length where it exceeds the system's length


@dataclass(frozen=True)
class NewtonOptions:
    """When an iterate counts as converged, and when factors are kept.

    Attributes
    ----------
    tolerance
        Estimated error of u, over the system's length or, where that is longer, a tenth of the
        largest displacement: a strip of 1000 thicknesses that rolls up is not known to 1e-12 of its length.
    max_iterations
        Iterations after which a step is given up.
    contraction
        The first factors are kept while a step is shorter than this part of the one before.
    hard
        The same for later factors, and for all factors if the guess comes with a stress: old factors mislead there.
    cheap
        This many steps with old factors cost less than new factors. So old factors that halve the step are kept
        if that many steps reach the tolerance, but not if the guess comes with a stress.
    fresh
        Distance, in lengths, up to which factors are used for the tangent and the inertia of a solution.
    largest_step
        An iteration that moves u by more than this many lengths counts as divergence.
    patience
        Matrices after which the steps of a solve must have shrunk.
    """

    tolerance: float = 1e-9
    max_iterations: int = 25
    contraction: float = 0.6
    hard: float = 0.1
    cheap: int = 8
    fresh: float = 0.05
    largest_step: float = 1e4
    patience: int = 4


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


@dataclass
class _Progress:
    """The status of one solve.

    Attributes
    ----------
    taken
        The steps since the matrix was made.
    ahead
        The next step, computed at the present iterate.
    """

    iterates: Iterates = field(default_factory=Iterates)
    verdict: Verdict = "go on"
    taken: list[Direction] = field(default_factory=list)
    matrix: Bordered | None = None
    ahead: Direction | None = None


@dataclass
class _Work:
    iterations: int = 0


class BorderedNewton:
    """Solves R(u, mu) = 0 with one more row; reusable for every amplitude and row of a system.

    Attributes
    ----------
    factorisation
        Factors of the latest tangent.
    """

    def __init__(
        self, system: System, options: NewtonOptions | None = None, factorisation: Factorisation | None = None
    ) -> None:
        self.system = system
        self.options = options or NewtonOptions()
        self.factorisation = factorisation or Factorisation(system.comm)
        self._work = _Work()
        self._made: tuple[State | None, int] = None, 0  # the state that was factored last, and its number
        self._stressed = False  # whether it was factored with another stress than its own
        self._progress = _Progress()
        comm = system.comm
        self._last = comm.rank == comm.size - 1
        n = system.size + self._last
        self._x = PETSc.Vec().createMPI((n, PETSc.DETERMINE), comm=comm)
        self._snes = make_snes(self, self._x, self.options.max_iterations)

    def on(self, system: System) -> "BorderedNewton":
        """A solver for another system whose tangent contains this one's; factors and counts of work are shared."""
        other = BorderedNewton(system, self.options, self.factorisation)
        other._work = self._work
        return other

    @property
    def iterations(self) -> int:
        """The iterations of all solves so far."""
        return self._work.iterations

    def solve(self, guess: State, name: str, row: Row, stress: Sequence[Weighted] = ()) -> Outcome:
        """Find the equilibrium near `guess` on which `row` holds, with mu the amplitude `name`.

        `stress` is as that of `System.tangent`, of the guess.
        """
        self._guess, self._name, self._row = guess, name, row
        self._stress: Sequence[Weighted] = stress
        self._followed = bool(stress)
        o = self.options
        self._progress = progress = _Progress(Iterates(o.largest_step, o.max_iterations, o.patience))
        self._join(guess.u, guess.mu[name], self._x)
        self._snes.solve(None, self._x)
        u, mu = self._split(self._x)
        converged = self._snes.getConvergedReason() > 0
        if converged and progress.ahead:  # the last step is known already
            u, mu = plus((u, mu), -1.0, progress.ahead)
        iterations = self._snes.getIterationNumber()
        self._work.iterations += iterations
        ended = self._snes.getConvergedReason()
        reason = in_words(progress.verdict, ended)
        error = progress.iterates.steps[-1].size if progress.iterates.steps else np.inf
        return Outcome(guess.with_(u, name, mu), converged, iterations, reason, error)

    def factor_at(self, state: State, stress: Sequence[Weighted] = ()) -> Factorisation:
        """Factor the tangent at a state, unless its factors are known."""
        near = self._factored
        if near is not state and (near is None or self._stressed or not near.equals(state, self.system.comm)):
            self.factorisation.factor(self.system.tangent(state.u, state.mu, stress))
            self._made, self._stressed = (state, self.factorisation.count), bool(stress)
        return self.factorisation

    @property
    def _factored(self) -> State | None:
        """The state to which the latest factors belong; None if another solver made them."""
        state, count = self._made
        return state if count == self.factorisation.count else None

    def response(self, state: State, name: str, row: Row, *, exact: bool = False) -> Response:
        """The path's tangent at a solution: K du + R_mu dmu = 0, c.du + d dmu = 1.

        If the latest factors belong to a state near by, they are used, and the tangent is refined with
        differences of the residual; `exact` factors K at the solution itself.
        """
        comm, near = self.system.comm, self._factored
        moved = np.inf if near is None else max_abs(comm, state.u - near.u) / self.system.length
        fresh = moved <= self.options.fresh and not exact
        matrix = self._bordered(near if fresh and near else state, name, row)
        tangent, load = matrix.tangent, self.system.load(state.u, state.mu, name)
        if moved and fresh:
            refined = refined_tangent(self.system, matrix, tangent, state, load, row)
            if refined is None:
                return self.response(state, name, row, exact=True)
            tangent = refined
        du, dmu = tangent
        softness = -dot(comm, load, du) / dmu - self.system.curvature(state.u, state.mu, name, name)
        return Response(du, dmu, softness, self.factorisation.negative_pivots)

    def _bordered(self, state: State, name: str, row: Row) -> Bordered:
        """The bordered matrix at a state; the one of the last solve if it has the same state and row."""
        last = self._progress.matrix
        if last and last.row is row and last.state is state is self._factored:  # the same object, not only equal
            return last
        return Bordered(self.system, self.factor_at(state), state, name, row)

    def function(self, x: PETSc.Vec, f: PETSc.Vec) -> None:
        """Called by SNES for R and g."""
        u, mu = self._split(x)
        state = self._guess.with_(u, self._name, mu)
        self._join(self.system.residual(u, state.mu), self._row.residual(state), f)

    def test(self, snes: PETSc.SNES, norm: float) -> Any:
        """Called by SNES to test convergence."""
        progress, o = self._progress, self.options
        if not np.isfinite(norm):
            return compat.NOT_A_NUMBER
        u, mu = self._split(snes.getSolution())
        f = self._split(snes.getFunction()[0])
        state = self._guess.with_(u, self._name, mu)
        progress.ahead = self._ahead(state, f)
        length = self.system.length
        scale = max(1.0, MOTION * max_abs(self.system.comm, u) / length)
        progress.verdict = progress.iterates.judge(o.tolerance * scale, lambda: self._rounding(state, f[0]))
        return REASON_OF[progress.verdict]

    def _ahead(self, state: State, f: Direction) -> Direction:
        """The next step, which SNES subtracts: from the latest matrix, or from a new one at this iterate."""
        progress, steps = self._progress, self._progress.iterates.steps
        if progress.matrix is not None:
            ahead = self._updated(progress.matrix.solve(*f))
            size = progress.matrix.size(ahead)
            first, o = sum(step.own for step in steps) == 1 and not self._followed, self.options
            ratio = size / steps[-1].size
            ends = ratio <= 0.5 and size * ratio**o.cheap <= o.tolerance and not self._followed
            if ends or ratio <= (o.contraction if first else o.hard):
                steps.append(Step(size, own=False))
                return ahead
        factors = self.factor_at(state, self._stress)
        progress.matrix = matrix = Bordered(self.system, factors, state, self._name, self._row)
        progress.taken.clear()
        ahead = matrix.solve(*f)
        steps.append(Step(matrix.size(ahead), own=True))
        return ahead

    def _updated(self, step: Direction) -> Direction:
        """A step of the latest matrix, with Broyden's update."""
        taken, matrix = self._progress.taken, self._progress.matrix
        assert matrix is not None
        for before, after in pairwise(taken):
            part = matrix.inner(before, step) / matrix.inner(before, before)
            step = plus(step, part, after)
        if taken:
            rest = 1 - matrix.inner(taken[-1], step) / matrix.inner(taken[-1], taken[-1])
            if rest > LEAST_REST:
                return plus(step, 1 / rest - 1, step)
            taken.clear()
        return step

    def _rounding(self, state: State, R: Vector) -> float:
        """The error from rounding of the residual, estimated from its change when u is rounded differently."""
        matrix = self._progress.matrix
        assert matrix is not None
        side = np.random.default_rng(self.system.comm.rank).choice([-1.0, 1.0], state.u.size)
        other = state.u + side * np.spacing(state.u)
        change = self.system.residual(other, state.mu) - R
        f = change - matrix.times(other - state.u, 0.0)[0]
        return matrix.size(matrix.solve(f, 0.0))

    def apply(self, y: PETSc.Vec) -> None:
        """Called by SNES for the step."""
        assert self._progress.ahead is not None
        self._progress.taken.append(self._progress.ahead)
        # the stress after the step is extrapolated linearly from before it (MIP Newton: Magisano, Leonetti, Garcea,
        # Computer Methods in Applied Mechanics and Engineering 313, 2017)
        self._stress = followed(self._split(self._snes.getSolution())[0], -self._progress.ahead[0])
        self._join(*self._progress.ahead, y)

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The bordered matrix times a vector, for SNES's line searches and monitors."""
        assert self._progress.matrix is not None
        self._join(*self._progress.matrix.times(*self._split(x)), y)

    def _join(self, u: Vector, mu: float, x: PETSc.Vec) -> None:
        x.setArray(np.append(u, mu) if self._last else u)

    def _split(self, x: PETSc.Vec) -> Direction:
        local = x.array_r
        mu = self.system.comm.bcast(float(local[-1]) if self._last else None, root=self.system.comm.size - 1)
        return local[: self.system.size].copy(), mu
