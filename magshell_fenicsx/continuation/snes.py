"""PETSc's SNES on the bordered system: what it calls, its options, and the reasons why it ends.

SNES has the loop, the line search and the monitors. Its linear solver is the bordered matrix, which
is kept while the steps shrink. Its test of convergence is the next step, which measures the error
if its matrix is good (P. Deuflhard, Newton Methods for Nonlinear Problems, Springer 2004, sec.
2.1.4, QNERR). The residual does not measure it: rounding of the stiff part of a structure hides
errors of its soft part.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.continuation.control import Bordered, Chord, Row, plus
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.iterates import FULL, Iterates, Step, Verdict, foreseen
from magshell_fenicsx.continuation.system import (
    Direction,
    Roughly,
    State,
    System,
    Weighted,
    followed,
    max_abs,
)
from magshell_fenicsx.platform import compat

# this part of the largest displacement counts as the length where it exceeds the system's length
MOTION = 0.1
DOUBT = 1.0  # see `Factorisation.doubt`: up to this one D may be that of an earlier state
OLD = 3  # matrices of a solve after which an older part of them is made anew, once
AWAY = 1.0  # in lengths: after a longer step that part would soon be too old again
# a step with foreseen forces over those since they were computed: below it they are computed again
FORESEEN = 0.01
CERTAIN = (
    0.1  # part of the tolerance, for an error after computed forces that is not looked at again
)
SEARCHED = 12  # matrices after which the steps of a line search must have shrunk
PREFIX = "magshell_"  # options with this prefix are of this solver alone
DIVERGED, FAR = "the iteration diverged", "the first guess is too far away"
HIDDEN = "rounding hides the solution: the tangent is nearly singular"

Reason = PETSc.SNES.ConvergedReason
REASON_OF: dict[Verdict, Any] = {
    "go on": Reason.CONVERGED_ITERATING,
    "converged": Reason.CONVERGED_SNORM_RELATIVE,
    "diverged": Reason.DIVERGED_DTOL,
    "far": Reason.DIVERGED_LOCAL_MIN,
    "rounding": Reason.DIVERGED_INNER,
}
IN_WORDS = {
    Reason.DIVERGED_DTOL: DIVERGED,
    Reason.DIVERGED_LOCAL_MIN: FAR,
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
        largest displacement: a strip of 1000 thicknesses that rolls up is not known to 1e-12 of its
        length. PETSc's option `-snes_stol` replaces it.
    max_iterations
        Iterations after which a step is given up; `-snes_max_it` replaces it.
    contraction
        The first factors are kept while a step is shorter than this part of the one before.
    hard
        The same for later factors, and for all factors if the guess comes with a stress: old
        factors mislead there.
    cheap
        This many steps with old factors cost less than new factors. So old factors that halve the
        step are kept if that many steps reach the tolerance, but not if the guess comes with a
        stress.
    fresh
        Distance, in lengths, up to which factors are used for the tangent and the inertia of a
        solution.
    largest_step
        An iteration that moves u by more than this many lengths counts as divergence.
    patience
        Matrices after which the steps of a solve must have shrunk.
    stiffnesses
        Amplitudes that are the stiffness of faces between which forces set in within a step, as
        where shells touch, with their values in a state that has none.
    corners
        Whether a path has corners although full steps do not circle, as where points of rigid
        bodies touch.
    """

    tolerance: float = 1e-9
    max_iterations: int = 25
    contraction: float = 0.6
    hard: float = 0.1
    cheap: int = 8
    fresh: float = 0.05
    largest_step: float = 1e4
    patience: int = 4
    stiffnesses: Mapping[str, float] = field(default_factory=dict)
    corners: bool = False

    @property
    def kinks(self) -> bool:
        """Whether forces set in within a step: full steps then circle, and a path has corners."""
        return bool(self.stiffnesses)


class LatestTangent:
    """The factors of the latest tangent of a system, and the state to which they belong."""

    def __init__(self, system: System, factorisation: Factorisation) -> None:
        self.system, self._factorisation = system, factorisation
        self._made: tuple[State | None, int] = (
            None,
            0,
        )  # the state that was factored last, and its number
        self._stressed = False  # whether it was factored with another stress than its own
        self.rough = False  # whether a small part of it is that of an earlier state

    @property
    def state(self) -> State | None:
        """The state to which the latest factors belong; None if another solver made them."""
        state, count = self._made
        return state if count == self._factorisation.count else None

    @property
    def latest(self) -> Factorisation:
        """The latest factors."""
        return self._factorisation

    def near(self, state: State, most: float) -> bool:
        """Whether the latest factors belong to a state less than so many lengths from another one;
        of any load.
        """
        mine, system = self.state, self.system
        return mine is not None and max_abs(system.comm, state.u - mine.u) < most * system.length

    def at(
        self,
        state: State,
        stress: Sequence[Weighted] = (),
        *,
        rough: bool = False,
        sure: bool = True,
    ) -> Factorisation:
        """See `BorderedNewton.factor_at`; if `rough`, a small part of the tangent may be that of an
        earlier state.

        If also `sure`, it is so only where that cannot change the number of unstable directions.
        """
        near, factors = self.state, self._factorisation
        other = near is not state and (
            near is None or self._stressed or not near.equals(state, self.system.comm)
        )
        if other or (self.rough and not rough) or (sure and not self.certain):
            self.rough = rough and factored_roughly(self.system, factors, state, stress, sure=sure)
            if not self.rough:
                factors.factor(self.system.tangent(state.u, state.mu, stress))
            self._made, self._stressed = (state, factors.count), bool(stress)
        return factors

    @property
    def foresees(self) -> bool:
        """Whether a part of the forces may be foreseen from states before: it is small, and was so
        far.
        """
        return isinstance(self.system, Roughly) and self.system.dear and self._factorisation.knows

    @property
    def certain(self) -> bool:
        """Whether the number of unstable directions is known, of the latest factors, in spite of an
        older part.
        """
        factors = self._factorisation
        known = factors.counted or factors.count_beside()
        return known and (not self.rough or factors.doubt <= DOUBT)


def factored_roughly(
    system: System,
    factors: Factorisation,
    state: State,
    stress: Sequence[Weighted] = (),
    *,
    sure: bool = True,
) -> bool:
    """Factor a tangent whose small part is that of an earlier state; False if it is not small, now
    or before.
    """
    if not (isinstance(system, Roughly) and system.dear and (factors.knows or sure)):
        return False
    factors.factor(system.tangent(state.u, state.mu, stress, rough=True), counted=sure)
    return not sure or factors.doubt <= DOUBT


class Linearised:
    """What SNES calls in a solve: function, Jacobian, linear solver and test of convergence.

    It knows no SNES, which knows it: PETSc would keep both in memory for ever.
    """

    def __init__(self, tangent: LatestTangent, options: NewtonOptions) -> None:
        self._tangent, self._system, self._options = tangent, tangent.system, options
        comm = self._system.comm
        self._last = comm.rank == comm.size - 1
        self.matrix: Bordered | None = None  # of the present solve, or of the last
        self._chord: Chord[Direction] | None = None
        self._state: State | None = None
        self._ahead: Direction | None = None

    def begin(
        self,
        guess: State,
        name: str,
        row: Row,
        stress: Sequence[Weighted],
        tolerance: float,
        *,
        searched: bool = False,
        near: float = 0.0,
        most: float = np.inf,
        foreseeing: bool = False,
        rough: float = 0.0,
    ) -> None:
        """Begin a solve, with a line search or without, with foreseen forces or not; as
        `BorderedNewton.solve`.

        See `Iterates` for `rough`.
        """
        self.foreseeing, self._foreseen, self._ventured = foreseeing, False, 0.0
        self._computed = list[float]()  # steps with computed forces
        self._tolerance, self._near = tolerance, near
        self._guess, self._name, self._row, self._stress, self._followed = (
            guess,
            name,
            row,
            stress,
            bool(stress),
        )
        patience = SEARCHED if searched else self._options.patience
        o = self._options
        kinks = (
            o.kinks or foreseeing or bool(self._system.coordinates)
        )  # the force of a body is stiff
        self._iterates = Iterates(
            min(o.largest_step, most), patience, searched, kinks, most < np.inf, rough
        )
        self.matrix = self._chord = self._state = self._ahead = None
        self._at = (
            self._residual
        ) = -1  # PETSc's numbers of the vectors' contents for which `_ahead` is the step

    @property
    def error(self) -> float:
        """The estimated error of the solution."""
        return self._iterates.error

    def step_at(self, x: PETSc.Vec) -> Direction | None:
        """The next step at an iterate, to be subtracted; None where none was computed."""
        return self._ahead if x.stateGet() == self._at else None

    def function(self, snes: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        """R and g."""
        self._foreseen = self.foreseeing
        self._compute(self._state_of(x), f)

    def _compute(self, state: State, f: PETSc.Vec) -> None:
        if self._foreseen:
            assert isinstance(self._system, Roughly)
            R = self._system.residual(state.u, state.mu, rough=True)
        else:
            R = self._system.residual(state.u, state.mu)
        self.join((R, self._row.residual(state)), f)

    def jacobian(self, snes: PETSc.SNES, x: PETSc.Vec, J: PETSc.Mat, P: PETSc.Mat) -> None:
        """The matrix for an iterate: that of an earlier one while the steps shrink."""
        self._linearise(x, snes.getFunction()[0])
        J.assemble()

    def mult(self, J: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The matrix times a vector."""
        assert self.matrix
        self.join(self.matrix.times(*self.split(x)), y)

    def apply(self, pc: PETSc.PC, f: PETSc.Vec, y: PETSc.Vec) -> None:
        """The inverse of the matrix times a vector; for the iterate's residual it is known since
        the test.
        """
        assert self._chord
        assert self._ahead
        solved = f.stateGet() == self._residual and f.handle == self._handle
        self.join(self._ahead if solved else self._chord.solve(self.split(f), self._ahead), y)

    def test(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> Any:
        """Whether the next step is small enough, or will never be."""
        x, f = snes.getSolution(), snes.getFunction()[0]
        state = self._linearise(x, f)
        return REASON_OF[self._iterates.judge(self._least(state), lambda: self._rounding(state, f))]

    def _least(self, state: State) -> float:
        """The size of a step that counts as converged."""
        return self._tolerance * max(
            1.0, MOTION * max_abs(self._system.comm, state.u) / self._system.length
        )

    def _linearise(self, x: PETSc.Vec, f: PETSc.Vec) -> State:
        """Choose the matrix for an iterate, and compute its next step; once for each iterate."""
        if self._state is not None and x.stateGet() == self._at:
            return self._state
        state, before = self._state_of(x), self._state
        if before is not None:
            self._go_on(before, state)
        self._at, self._state = x.stateGet(), state
        self._ahead = self._next_step(state, self.split(f))
        size = self._iterates.steps[-1].size
        if self._foreseen and not size > self._foreseeable(state):
            self._foreseen = False
            self._compute(state, f)
            self._ahead = self._again(self.split(f))
            size = self._iterates.steps[-1].size
            self._computed.append(size)
            self._ventured = size
        self._ventured = max(self._ventured, size)
        self._handle, self._residual = f.handle, f.stateGet()
        return state

    def _foreseeable(self, state: State) -> float:
        """A step with foreseen forces that is not larger has forces computed in its place; negative
        if it need not.
        """
        least = self._least(state)
        if foreseen(self._computed, 1) <= CERTAIN * least:  # one ratio: each costs much
            return -1.0
        return max(least, float(FORESEEN ** (1 + len(self._computed) / 2)) * self._ventured)

    def misled(self) -> bool:
        """Whether the last step is much shorter with computed forces than with foreseen ones; also
        if nobody knows.
        """
        if not (self._foreseen and self._state and self._chord and self.matrix):
            return True  # nothing is known of it
        state, before = self._state, self._iterates.steps[-1].size
        R = self._system.residual(state.u, state.mu), self._row.residual(state)
        return not self.matrix.size(self._chord.step(R)) > FULL * before

    def _again(self, f: Direction) -> Direction:
        """The next step by the same matrix, in place of one with foreseen forces."""
        assert self.matrix
        assert self._chord
        step = self._chord.step(f)
        self._iterates.steps[-1] = replace(self._iterates.steps[-1], size=self.matrix.size(step))
        return step

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
        # the stress after the step is extrapolated linearly from before it (MIP Newton: Magisano,
        # Leonetti, Garcea, Computer Methods in Applied Mechanics and Engineering 313, 2017)
        self._stress = followed(before.u, -self._ahead[0] if full else state.u - before.u)

    def _next_step(self, state: State, f: Direction) -> Direction:
        """The next step, which SNES subtracts: from the latest matrix, or from a new one at this
        iterate.
        """
        steps = self._iterates.steps
        if self._chord and self.matrix:
            step = self._chord.step(f)
            size = self.matrix.size(step)
            if self._serves(size):
                steps.append(Step(size, own=False))
                return step
        own = bool(steps) or not self._tangent.near(state, self._near)
        anew = sum(step.own for step in steps) == OLD and not self.foreseeing
        factors = (
            self._tangent.at(state, self._stress, rough=not anew, sure=False)
            if own
            else self._tangent.latest
        )
        matrix, step = self._stepped(factors, state, f)
        if own and self._too_old(matrix, step):
            factors = self._tangent.at(state, self._stress, sure=False)
            matrix, step = self._stepped(factors, state, f)
        self.matrix = matrix
        self._chord = Chord(lambda f: matrix.solve(*f, rough=True), matrix.inner, plus)
        steps.append(Step(matrix.size(step), own=own, pivots=factors.negative_pivots))
        return step

    def _stepped(
        self, factors: Factorisation, state: State, f: Direction
    ) -> tuple[Bordered, Direction]:
        """Return a matrix from some factors, and its step."""
        matrix = Bordered(
            self._system, factors, state, self._name, self._row, rough=self._tangent.rough
        )
        return matrix, matrix.solve(*f, rough=True)

    def _too_old(self, matrix: Bordered, step: Direction) -> bool:
        """Return whether steps do not shrink because a part of the matrix is of an earlier state,
        as is foreseen.

        It is small beside the rest at that state, but need not be so now. After the step the
        residual is what the matrix lacks, times the step.
        """
        before, size, hard = (
            [s.size for s in self._iterates.steps if s.own],
            matrix.size(step),
            self._options.hard,
        )
        if not (self._tangent.rough and before and hard * before[-1] < size < AWAY):
            return False
        lacks = self._tangent.latest.change(step[0])
        return not matrix.size(matrix.solve(lacks, 0.0, rough=True)) <= hard * size

    def _serves(self, size: float) -> bool:
        """Whether a kept matrix serves that makes a next step of this size."""
        steps, o = self._iterates.steps, self._options
        ratio = size / steps[-1].size
        first = sum(step.own for step in steps) <= 1 and not self._followed
        ends = ratio <= 0.5 and size * ratio**o.cheap <= self._tolerance and not self._followed
        late = (
            first and len(steps) > 1 and size <= o.contraction**2 * steps[-2].size
        )  # Broyden's steps shrink unevenly
        return ends or late or ratio <= (o.contraction if first else o.hard)

    def _rounding(self, state: State, f: PETSc.Vec) -> float:
        """The error from rounding of the residual, estimated from its change when u is rounded
        differently.
        """
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


def make_snes(
    linearised: Linearised, x: PETSc.Vec, options: NewtonOptions, search: str = "basic"
) -> PETSc.SNES:
    """A SNES for vectors like `x`, with a line search, full steps if `basic`; PETSc's options may
    set another.
    """
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
