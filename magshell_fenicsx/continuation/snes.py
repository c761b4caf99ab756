"""PETSc's SNES on the bordered system: what it calls, its options, and the reasons why it ends.

SNES has the loop, the line search and the monitors. Its linear solver is the bordered matrix, which is kept while the
steps shrink. Its test of convergence is the next step, which measures the error if its matrix is good (P. Deuflhard,
Newton Methods for Nonlinear Problems, Springer 2004, sec. 2.1.4, QNERR). The residual does not measure it: rounding of
the stiff part of a structure hides errors of its soft part.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.continuation.control import Bordered, Chord, Row, plus
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import Direction, Roughly, State, System, Weighted, followed, max_abs
from magshell_fenicsx.platform import compat

MOTION = 0.1  # this part of the largest displacement counts as the length where it exceeds the system's length
FULL = 0.5  # a step longer than this part of the one before shows no quadratic convergence
SMALL = 1e-3  # full Newton steps below this size shrink, unless they are rounding
GAIN = 0.1  # of the first step, to which steps must have shrunk after `patience` matrices
DOUBT = 1.0  # see `Factorisation.doubt`: up to this one D may be that of an earlier state
OLD = 3  # matrices of a solve after which an older part of them is made anew, once
ROUNDING = 10.0  # steps up to this many times the rounding error count as rounding
SEARCHED = 12  # matrices after which the steps of a line search must have shrunk
PREFIX = "magshell_"  # options with this prefix are of this solver alone
HIDDEN = "rounding hides the solution: the tangent is nearly singular"

Verdict = Literal["go on", "converged", "diverged", "rounding"]
Reason = PETSc.SNES.ConvergedReason
REASON_OF: dict[Verdict, Any] = {
    "go on": Reason.CONVERGED_ITERATING,
    "converged": Reason.CONVERGED_SNORM_RELATIVE,
    "diverged": Reason.DIVERGED_DTOL,
    "rounding": Reason.DIVERGED_INNER,
}
IN_WORDS = {
    Reason.DIVERGED_DTOL: "the iteration diverged",
    Reason.DIVERGED_INNER: HIDDEN,
    Reason.DIVERGED_MAX_IT: "too many iterations",
    Reason.DIVERGED_LINE_SEARCH: "the line search failed",
    Reason.DIVERGED_LINEAR_SOLVE: "the tangent could not be factored",
    compat.NOT_A_NUMBER: "the residual is not a number",
}


@dataclass(frozen=True)
class NewtonOptions:
    """When an iterate counts as converged, and when factors are kept.

    Attributes
    ----------
    tolerance
        Estimated error of u, over the system's length or, where that is longer, a tenth of the
        largest displacement: a strip of 1000 thicknesses that rolls up is not known to 1e-12 of its length.
        PETSc's option `-snes_stol` replaces it.
    max_iterations
        Iterations after which a step is given up; `-snes_max_it` replaces it.
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
    penalties
        The amplitudes that are stiffnesses of shells that touch: forces then set in within a step, full steps circle,
        and a path has corners.
    """

    tolerance: float = 1e-9
    max_iterations: int = 25
    contraction: float = 0.6
    hard: float = 0.1
    cheap: int = 8
    fresh: float = 0.05
    largest_step: float = 1e4
    patience: int = 4
    penalties: tuple[str, ...] = ()

    @property
    def kinks(self) -> bool:
        """Whether forces set in within a step."""
        return bool(self.penalties)


class Tangents:
    """The factors of the latest tangent of a system, and the state to which they belong."""

    def __init__(self, system: System, factorisation: Factorisation) -> None:
        self.system, self._factorisation = system, factorisation
        self._made: tuple[State | None, int] = None, 0  # the state that was factored last, and its number
        self._stressed = False  # whether it was factored with another stress than its own
        self.rough = False  # whether a small part of it is that of an earlier state

    @property
    def state(self) -> State | None:
        """The state to which the latest factors belong; None if another solver made them."""
        state, count = self._made
        return state if count == self._factorisation.count else None

    def at(
        self, state: State, stress: Sequence[Weighted] = (), *, rough: bool = False, sure: bool = True
    ) -> Factorisation:
        """See `BorderedNewton.factor_at`; if `rough`, a small part of the tangent may be that of an earlier state.

        If also `sure`, it is so only where that cannot change the number of unstable directions.
        """
        near, factors = self.state, self._factorisation
        other = near is not state and (near is None or self._stressed or not near.equals(state, self.system.comm))
        if other or (self.rough and not rough) or (sure and not self.certain):
            self.rough = rough and factored_roughly(self.system, factors, state, stress, sure=sure)
            if not self.rough:
                factors.factor(self.system.tangent(state.u, state.mu, stress))
            self._made, self._stressed = (state, factors.count), bool(stress)
        return factors

    @property
    def certain(self) -> bool:
        """Whether the number of unstable directions is known, of the latest factors, in spite of an older part."""
        factors = self._factorisation
        known = factors.counted or factors.count_beside()
        return known and (not self.rough or factors.doubt <= DOUBT)


def factored_roughly(
    system: System, factors: Factorisation, state: State, stress: Sequence[Weighted] = (), *, sure: bool = True
) -> bool:
    """Factor a tangent whose small part is that of an earlier state; False if it is not small, now or before."""
    if not (isinstance(system, Roughly) and system.dear and (factors.knows or sure)):
        return False
    if sure and factors.knows and factors.counted and factors.doubt > DOUBT:
        return False
    factors.factor(system.tangent(state.u, state.mu, stress, rough=True), counted=sure)
    return not sure or factors.doubt <= DOUBT


@dataclass(frozen=True)
class Step:
    """The next step at an iterate.

    Attributes
    ----------
    size
        Size of the step, see `Bordered.size`.
    own
        Whether the matrix was computed at this iterate.
    """

    size: float
    own: bool


@dataclass
class Iterates:
    """The steps of one solve, in lengths of the system, from which alone its convergence is judged.

    Parameters
    ----------
    largest
        A longer step counts as divergence.
    patience
        Matrices after which steps must have shrunk.
    searched
        Whether a line search shortens them: then they may grow.
    """

    largest: float = np.inf
    patience: int = 4
    searched: bool = False
    steps: list[Step] = field(default_factory=list)

    def judge(self, tolerance: float, rounding: Callable[[], float]) -> Verdict:
        """The verdict on the iterate, from the last step.

        Parameters
        ----------
        tolerance
            Of the iterate's error.
        rounding
            Computes the error from rounding of the residual.
        """
        step, before = self.steps[-1], self.steps[:-1]
        if not step.size <= self.largest:
            return "diverged"
        if step.size <= tolerance:
            return "converged"
        full = [s.size for s in before if s.own]
        stalled = step.own and before and before[-1].own and FULL * before[-1].size < step.size < SMALL
        if stalled and step.size <= ROUNDING * rounding():
            return "rounding"
        if step.own and len(before) > 2 and step.size > 2 * full[-1] and not self.searched:
            return "diverged"
        if step.own and len(full) >= self.patience and step.size > GAIN * full[0]:
            return "diverged"
        return "go on"


class Linearised:
    """What SNES calls in a solve: function, Jacobian, linear solver and test of convergence.

    It knows no SNES, which knows it: PETSc would keep both in memory for ever.
    """

    def __init__(self, tangents: Tangents, options: NewtonOptions) -> None:
        self._tangents, self._system, self._options = tangents, tangents.system, options
        comm = self._system.comm
        self._last = comm.rank == comm.size - 1
        self.matrix: Bordered | None = None  # of the present solve, or of the last
        self._chord: Chord[Direction] | None = None
        self._state: State | None = None
        self._ahead: Direction | None = None

    def begin(
        self, guess: State, name: str, row: Row, stress: Sequence[Weighted], tolerance: float, *, searched: bool = False
    ) -> None:
        """Begin a solve, with a line search or without; as `BorderedNewton.solve`."""
        self._tolerance = tolerance
        self._guess, self._name, self._row, self._stress, self._followed = guess, name, row, stress, bool(stress)
        patience = SEARCHED if searched else self._options.patience
        self._iterates = Iterates(self._options.largest_step, patience, searched)
        self.matrix = self._chord = self._state = self._ahead = None
        self._at = self._residual = -1  # PETSc's numbers of the vectors' contents for which `_ahead` is the step

    @property
    def error(self) -> float:
        """The estimated error of the last iterate."""
        return self._iterates.steps[-1].size if self._iterates.steps else np.inf

    def step_at(self, x: PETSc.Vec) -> Direction | None:
        """The next step at an iterate, to be subtracted; None where none was computed."""
        return self._ahead if x.stateGet() == self._at else None

    def function(self, snes: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        """R and g."""
        state = self._state_of(x)
        self.join((self._system.residual(state.u, state.mu), self._row.residual(state)), f)

    def jacobian(self, snes: PETSc.SNES, x: PETSc.Vec, J: PETSc.Mat, P: PETSc.Mat) -> None:
        """The matrix for an iterate: that of an earlier one while the steps shrink."""
        self._linearise(x, snes.getFunction()[0])
        J.assemble()

    def mult(self, J: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The matrix times a vector."""
        assert self.matrix
        self.join(self.matrix.times(*self.split(x)), y)

    def apply(self, pc: PETSc.PC, f: PETSc.Vec, y: PETSc.Vec) -> None:
        """The inverse of the matrix times a vector; for the iterate's residual it is known since the test."""
        assert self._chord
        assert self._ahead
        solved = f.stateGet() == self._residual and f.handle == self._handle
        self.join(self._ahead if solved else self._chord.solve(self.split(f), self._ahead), y)

    def test(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> Any:
        """Whether the next step is small enough, or will never be."""
        x, f = snes.getSolution(), snes.getFunction()[0]
        state = self._linearise(x, f)
        length = self._system.length
        scale = max(1.0, MOTION * max_abs(self._system.comm, state.u) / length)
        return REASON_OF[self._iterates.judge(self._tolerance * scale, lambda: self._rounding(state, f))]

    def _linearise(self, x: PETSc.Vec, f: PETSc.Vec) -> State:
        """Choose the matrix for an iterate, and compute its next step; once for each iterate."""
        if self._state is not None and x.stateGet() == self._at:
            return self._state
        state, before = self._state_of(x), self._state
        if before is not None:
            self._go_on(before, state)
        self._at, self._state = x.stateGet(), state
        self._handle, self._residual = f.handle, f.stateGet()
        self._ahead = self._next_step(state, self.split(f))
        return state

    def _go_on(self, before: State, state: State) -> None:
        """The iterate has moved, by the whole step unless a line search has made it shorter."""
        assert self._chord
        assert self._ahead
        whole = plus((before.u, before.mu[self._name]), -1.0, self._ahead)
        full = whole[1] == state.mu[self._name] and np.array_equal(whole[0], state.u)
        full = bool(self._system.comm.allreduce(full, MPI.LAND))
        if full:
            self._chord.took(self._ahead)
        else:
            self._chord = None
        # the stress after the step is extrapolated linearly from before it (MIP Newton: Magisano, Leonetti, Garcea,
        # Computer Methods in Applied Mechanics and Engineering 313, 2017)
        self._stress = followed(before.u, -self._ahead[0] if full else state.u - before.u)

    def _next_step(self, state: State, f: Direction) -> Direction:
        """The next step, which SNES subtracts: from the latest matrix, or from a new one at this iterate."""
        steps = self._iterates.steps
        if self._chord and self.matrix:
            step = self._chord.step(f)
            size = self.matrix.size(step)
            if self._serves(size):
                steps.append(Step(size, own=False))
                return step
        anew = sum(step.own for step in steps) == OLD
        factors = self._tangents.at(state, self._stress, rough=not anew, sure=False)
        matrix = Bordered(self._system, factors, state, self._name, self._row)
        self.matrix, step = matrix, matrix.solve(*f, rough=True)
        self._chord = Chord(lambda f: matrix.solve(*f, rough=True), matrix.inner, plus)
        steps.append(Step(matrix.size(step), own=True))
        return step

    def _serves(self, size: float) -> bool:
        """Whether a kept matrix serves that makes a next step of this size."""
        steps, o = self._iterates.steps, self._options
        ratio = size / steps[-1].size
        first = sum(step.own for step in steps) == 1 and not self._followed
        ends = ratio <= 0.5 and size * ratio**o.cheap <= self._tolerance and not self._followed
        return ends or ratio <= (o.contraction if first else o.hard)

    def _rounding(self, state: State, f: PETSc.Vec) -> float:
        """The error from rounding of the residual, estimated from its change when u is rounded differently."""
        matrix = self.matrix
        assert matrix
        side = np.random.default_rng(self._system.comm.rank).choice([-1.0, 1.0], state.u.size)
        other = state.u + side * np.spacing(state.u)
        change = self._system.residual(other, state.mu) - self.split(f)[0]
        rest = change - matrix.times(other - state.u, 0.0)[0]
        return matrix.size(matrix.solve(rest, 0.0))

    def vector(self) -> PETSc.Vec:
        """A new vector (u, mu)."""
        size = self._system.size + self._last
        return PETSc.Vec().createMPI((size, PETSc.DETERMINE), comm=self._system.comm)

    def join(self, whole: Direction, x: PETSc.Vec) -> None:
        """Write (u, mu) into a vector."""
        x.setArray(np.append(*whole) if self._last else whole[0])

    def split(self, x: PETSc.Vec) -> Direction:
        """Copies of u on this rank, and mu on every rank."""
        local, comm = x.array_r, self._system.comm
        mu = comm.bcast(float(local[-1]) if self._last else None, root=comm.size - 1)
        return local[: self._system.size].copy(), mu

    def _state_of(self, x: PETSc.Vec) -> State:
        u, mu = self.split(x)
        return self._guess.with_(u, self._name, mu)


def make_snes(linearised: Linearised, x: PETSc.Vec, options: NewtonOptions, search: str = "basic") -> PETSc.SNES:
    """A SNES for vectors like `x`, with a line search, full steps if `basic`; PETSc's options may set another."""
    sizes = x.getSizes()
    J = PETSc.Mat().createPython((sizes, sizes), context=linearised, comm=x.comm)
    J.setUp()
    snes = PETSc.SNES().create(x.comm)
    snes.setType("newtonls")
    snes.setFunction(linearised.function, x.duplicate())
    snes.setJacobian(linearised.jacobian, J)
    snes.setConvergenceTest(linearised.test)
    snes.setTolerances(stol=options.tolerance, max_it=options.max_iterations)
    snes.getKSP().setType("preonly")
    given = PETSc.Options(PREFIX)
    ours = not given.hasName("snes_linesearch_type")
    if ours:  # full steps are not PETSc's default; if they fail, the path takes a smaller step
        given["snes_linesearch_type"] = search
    for prefix in (PREFIX, ""):
        snes.setOptionsPrefix(prefix)
        snes.setFromOptions()
    if ours:
        given.delValue("snes_linesearch_type")
    pc = snes.getKSP().getPC()
    pc.setType("python")
    pc.setPythonContext(linearised)
    return snes
