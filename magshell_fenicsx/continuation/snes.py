"""PETSc's SNES on the bordered system: its callbacks, options, and the reasons why it ends.

SNES has the loop, the line search and the monitors. Its linear solver is the bordered matrix, which
is kept while the steps shrink. Its test of convergence is the next step, which measures the error
if its matrix is good (P. Deuflhard, Newton Methods for Nonlinear Problems, Springer 2004, sec.
2.1.4, QNERR). The residual does not measure it: rounding of the stiff part of a structure hides
errors of its soft part.

R = dPi/du is the residual of equilibrium, K its derivative by u, g the residual of the row: the
scalar equation that is solved together with equilibrium for u and the amplitude (load parameter)
mu. A direction is a pair (du, dmu). A kept matrix gets Broyden's updates (`Chord`), and is an
iterate's own if it was computed there. The argument `stress` is a list of displacements with
weights: the weighted sum of their stresses replaces the stress of u in K, since small errors of a
guess u change its own stress much. Lengths are displacements in units of the system's length.

`Iterates` has the steps of a solve with their sizes and judges by these whether it has converged. A
step is `is_own` if the matrix of that iterate made it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.continuation.control import BorderedMatrix, Chord, ConstraintRow, add_scaled
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.iterates import Iterates, NewtonStep, Verdict
from magshell_fenicsx.continuation.system import (
    Direction,
    State,
    System,
    WeightedDisplacement,
    extrapolated_stress,
    max_abs,
)
from magshell_fenicsx.platform import compat

# this fraction of the largest displacement counts as the length where it exceeds the system's
LENGTH_PER_DISPLACEMENT = 0.1
LINE_SEARCH_PATIENCE = 12  # matrices after which the steps of a line search must have shrunk
PREFIX = "magshell_"  # options with this prefix belong to this solver alone
DIVERGED, GUESS_TOO_FAR = "the iteration diverged", "the first guess is too far away"
HIDDEN_BY_ROUNDING = "rounding hides the solution: the tangent is nearly singular"

Reason = PETSc.SNES.ConvergedReason
REASON_OF_VERDICT: dict[Verdict, Any] = {
    "go on": Reason.CONVERGED_ITERATING,
    "converged": Reason.CONVERGED_SNORM_RELATIVE,
    "diverged": Reason.DIVERGED_DTOL,
    "far": Reason.DIVERGED_LOCAL_MIN,
    "rounding": Reason.DIVERGED_INNER,
}
REASON_MESSAGES = {
    Reason.DIVERGED_DTOL: DIVERGED,
    Reason.DIVERGED_LOCAL_MIN: GUESS_TOO_FAR,
    Reason.DIVERGED_INNER: HIDDEN_BY_ROUNDING,
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
        The first factors are kept while a step is shorter than this fraction of the previous one.
    late_contraction
        The same for later factors, and for all factors if the guess comes with a stress: old
        factors mislead there.
    chord_steps_per_factorisation
        This many steps with old factors cost less than new factors. So old factors that halve the
        step are kept if that many steps reach the tolerance, but not if the guess comes with a
        stress.
    reuse_distance
        Distance, in lengths, up to which factors are used for the tangent and the inertia of a
        solution.
    largest_step
        An iteration that moves u by more than this many lengths counts as divergence.
    patience
        Number of matrices after which the steps of a solve must have shrunk.
    stiffnesses
        Amplitudes that are the stiffness of faces between which contact forces begin within a step,
        with their values in a state that has none.
    """

    tolerance: float = 1e-9
    max_iterations: int = 25
    contraction: float = 0.6
    late_contraction: float = 0.1
    chord_steps_per_factorisation: int = 8
    reuse_distance: float = 0.05
    largest_step: float = 1e4
    patience: int = 4
    stiffnesses: Mapping[str, float] = field(default_factory=dict)

    @property
    def has_onsets(self) -> bool:
        """Whether forces begin within a step: full steps then circle, and a path has kinks."""
        return bool(self.stiffnesses)


class LatestTangent:
    """The factors of the latest tangent of a system, and the state to which they belong.

    Private fields: `_factored` has the state that was factored last and the number of its
    factorisation; `_has_other_stress` tells whether the stress was not that of the state.
    """

    def __init__(self, system: System, factorisation: Factorisation) -> None:
        self.system, self._factorisation = system, factorisation
        self._factored: tuple[State | None, int] = None, 0
        self._has_other_stress = False

    @property
    def state(self) -> State | None:
        """The state to which the latest factors belong; None if another solver made them."""
        state, count = self._factored
        return state if count == self._factorisation.count else None

    @property
    def latest(self) -> Factorisation:
        """The latest factors."""
        return self._factorisation

    def forget(self) -> None:
        """Forget to which state the factors belong, as if another solver had made them."""
        self._factored = None, 0

    def is_near(self, state: State, distance: float) -> bool:
        """Return whether the factored state is near another one, at any load. Collective.

        Parameters
        ----------
        distance
            Largest difference of an entry of u, in lengths of the system.
        """
        factored, system = self.state, self.system
        if factored is None:
            return False
        return max_abs(system.comm, state.u - factored.u) < distance * system.length

    def factor_at(self, state: State, stress: Sequence[WeightedDisplacement] = ()) -> Factorisation:
        """Factor the tangent at a state, unless its factors are known. Collective.

        Parameters
        ----------
        stress
            Weighted displacements whose stress replaces that of the state; empty: its own.

        Returns
        -------
        The factors, which the next call overwrites.
        """
        factors = self._factorisation
        if self._is_of_other_state(state):
            factors.factor(self.system.tangent(state.u, state.mu, stress))
            self._factored, self._has_other_stress = (state, factors.count), bool(stress)
        return factors

    def _is_of_other_state(self, state: State) -> bool:
        """Return whether the tangent that is factored is not that of a state. Collective."""
        factored = self.state
        if factored is state:
            return False
        if factored is None or self._has_other_stress:
            return True
        return not factored.equals(state, self.system.comm)


@dataclass(frozen=True)
class SolveOptions:
    """How one solve runs.

    Attributes
    ----------
    stress
        Weighted displacements whose stress replaces that of the guess in the first matrix.
    reuse_distance
        Distance from the guess, in lengths, up to which the factors of another state begin the
        solve.
    max_step
        A longer step, in lengths, ends the solve early.
    searched
        Whether a line search shortens the steps.
    relative_tolerance
        An error of this fraction of the first step is accepted.
    """

    stress: Sequence[WeightedDisplacement] = ()
    reuse_distance: float = 0.0
    max_step: float = np.inf
    searched: bool = False
    relative_tolerance: float = 0.0


class SnesCallbacks:
    """The callbacks of SNES in a solve: function, Jacobian, linear solver, test of convergence.

    PETSc calls them on all ranks. The object holds no reference to the SNES, which refers to it:
    PETSc would keep both in memory for ever.

    Parameters
    ----------
    tangent
        The factors of the system, which serve successive solves.

    Attributes
    ----------
    matrix
        The bordered matrix of the present solve, or of the last one; None before the first.

    Private fields: `_state` is the present iterate and `_next` the next step there, to be
    subtracted. `_x_counter`, `_f_counter` and `_f_handle` identify PETSc's vectors x and f to which
    that step belongs. `_chord` applies the matrix with Broyden's updates: its `step` is the next
    step for a residual. `_iterates` has the steps of the solve so far. `_stress` are the weighted
    displacements for the next matrix, and `_has_stress` tells whether the guess came with some.
    The other ones are the arguments of `begin`.
    """

    def __init__(self, tangent: LatestTangent, options: NewtonOptions) -> None:
        self._tangent, self._system, self._options = tangent, tangent.system, options
        comm = self._system.comm
        self._is_last_rank = comm.rank == comm.size - 1
        self.matrix: BorderedMatrix | None = None
        self._chord: Chord[Direction] | None = None
        self._state: State | None = None
        self._next: Direction | None = None  # the next step at the present iterate

    def begin(
        self,
        guess: State,
        name: str,
        row: ConstraintRow,
        tolerance: float,
        options: SolveOptions,
    ) -> None:
        """Begin a solve from a guess to a state on which `row` holds, with mu the amplitude `name`.

        Parameters
        ----------
        tolerance
            Estimated error of u at which the solve ends, over the system's length.
        options
            The way this one solve runs.
        """
        self._tolerance, self._reuse_distance = tolerance, options.reuse_distance
        self._guess, self._name, self._row = guess, name, row
        self._stress, self._has_stress = options.stress, bool(options.stress)
        newton, has_coordinates = self._options, bool(self._system.coordinates)
        self._iterates = Iterates(
            largest=min(newton.largest_step, options.max_step),
            patience=LINE_SEARCH_PATIENCE if options.searched else newton.patience,
            searched=options.searched,
            # the force of a body is stiff
            kinks=newton.has_onsets or has_coordinates,
            stops_early=options.max_step < np.inf,
            relative_tolerance=options.relative_tolerance,
        )
        self.matrix = self._chord = self._state = self._next = None
        self._x_counter = self._f_counter = -1  # PETSc counts from 0

    @property
    def error(self) -> float:
        """The estimated error of the solution, over the system's length."""
        return self._iterates.error

    def step_at(self, x: PETSc.Vec) -> Direction | None:
        """Return the next step at an iterate, to be subtracted; None where none was computed."""
        return self._next if x.stateGet() == self._x_counter else None

    def function(self, snes: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        """Write the residuals R of equilibrium and g of the row into f; PETSc's callback.

        `snes` is not used here: PETSc passes it to every callback.
        """
        state = self._state_of(x)
        R = self._system.residual(state.u, state.mu)
        self.join((R, self._row.residual(state)), f)

    def jacobian(self, snes: PETSc.SNES, x: PETSc.Vec, J: PETSc.Mat, P: PETSc.Mat) -> None:
        """Choose the matrix for an iterate; PETSc's callback, which needs J marked as assembled.

        While the steps shrink it is the matrix of an earlier iterate.
        """
        self._linearise(x, snes.getFunction()[0])
        J.assemble()

    def mult(self, J: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write the bordered matrix times a vector into y; PETSc's callback."""
        assert self.matrix
        self.join(self.matrix.times(*self.split(x)), y)

    def apply(self, pc: PETSc.PC, f: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write the inverse of the bordered matrix times f into y; PETSc's callback.

        If f is the residual of the iterate, the result is known from the test of convergence.
        """
        assert self._chord
        assert self._next
        is_known = f.stateGet() == self._f_counter and f.handle == self._f_handle
        self.join(self._next if is_known else self._chord.solve(self.split(f), self._next), y)

    def test(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> Any:
        """Return PETSc's reason to end or go on; PETSc's callback after each iteration.

        The size of the next step decides, not the norms that PETSc passes.
        """
        x, f = snes.getSolution(), snes.getFunction()[0]
        state = self._linearise(x, f)
        verdict = self._iterates.judge(
            self._converged_size(state), lambda: self._rounding_error(state, f)
        )
        return REASON_OF_VERDICT[verdict]

    def _converged_size(self, state: State) -> float:
        """Return the size of a step that counts as converged, in lengths of the system.

        The tolerance counts relative to a tenth of the largest displacement, where that exceeds the
        length.
        """
        displacement = max_abs(self._system.comm, state.u)
        return self._tolerance * max(
            1.0, LENGTH_PER_DISPLACEMENT * displacement / self._system.length
        )

    def _linearise(self, x: PETSc.Vec, f: PETSc.Vec) -> State:
        """Choose the matrix for an iterate, and compute its next step; once for each iterate.

        Parameters
        ----------
        x, f
            The iterate, and its residual.

        Returns
        -------
        The state of the iterate.
        """
        if self._state is not None and x.stateGet() == self._x_counter:
            return self._state
        state, previous = self._state_of(x), self._state
        if previous is not None:
            self._go_on(previous, state)
        self._x_counter, self._state = x.stateGet(), state
        self._next = self._next_step(state, self.split(f))
        self._f_handle, self._f_counter = f.handle, f.stateGet()
        return state

    def _go_on(self, previous: State, state: State) -> None:
        """Go on from the previous iterate to a new one.

        After a full step the chord method keeps its matrix. A line search may have shortened the
        step; then the next step takes a new matrix. The stress for the next tangent is
        extrapolated.
        """
        assert self._chord
        assert self._next
        # where a full step would lead; on all ranks the new iterate must be that place
        u_after, mu_after = add_scaled((previous.u, previous.mu[self._name]), -1.0, self._next)
        is_full = mu_after == state.mu[self._name] and np.array_equal(u_after, state.u)
        is_full = bool(self._system.comm.allreduce(is_full, MPI.LAND))
        if is_full:
            self._chord.accept_step(self._next)
        else:
            self._chord = None  # no chord: the next step takes a new matrix
        # the stress after the step is extrapolated linearly from before it (MIP Newton: Magisano,
        # Leonetti, Garcea, Computer Methods in Applied Mechanics and Engineering 313, 2017)
        du = -self._next[0] if is_full else state.u - previous.u
        self._stress = extrapolated_stress(previous.u, du)

    def _next_step(self, state: State, f: Direction) -> Direction:
        """Return the next step (du, dmu), which SNES subtracts, at the residual `f` of a state.

        It comes from the latest matrix while that serves, else from a new one at this iterate. Its
        size is appended to the steps of the solve.
        """
        steps = self._iterates.steps
        # the latest matrix, with Broyden's updates
        if self._chord and self.matrix:
            step = self._chord.step(f)
            size = self.matrix.size(step)
            if self._matrix_serves(size):
                steps.append(NewtonStep(size, is_own=False))
                return step
        # a new matrix of this iterate; at the first one factors of a near state may serve
        is_own = bool(steps) or not self._tangent.is_near(state, self._reuse_distance)
        factors = self._tangent.factor_at(state, self._stress) if is_own else self._tangent.latest
        matrix = BorderedMatrix(self._system, factors, state, self._name, self._row)
        step = matrix.solve(*f)
        self.matrix = matrix
        self._chord = Chord(lambda f: matrix.solve(*f), matrix.inner, add_scaled)
        steps.append(NewtonStep(matrix.size(step), is_own=is_own, pivots=factors.negative_pivots))
        return step

    def _matrix_serves(self, size: float) -> bool:
        """Return whether to keep the matrix, whose next step has this size in lengths.

        It is kept if the steps shrink fast enough, or if few more of them reach the tolerance.
        """
        steps, options = self._iterates.steps, self._options
        ratio = size / steps[-1].size
        # old factors mislead after a guess with a stress
        is_first = sum(step.is_own for step in steps) <= 1 and not self._has_stress
        if not self._has_stress and ratio <= 0.5:
            # the size after as many chord steps as cost one factorisation
            size_at_end = size * ratio**options.chord_steps_per_factorisation
            if size_at_end <= self._tolerance:
                return True
        # Broyden's steps shrink unevenly: two of them count together
        counts_two_steps = is_first and len(steps) > 1
        if counts_two_steps and size <= options.contraction**2 * steps[-2].size:
            return True
        return ratio <= (options.contraction if is_first else options.late_contraction)

    def _rounding_error(self, state: State, f: PETSc.Vec) -> float:
        """Return the error of u from rounding of the residual, in lengths of the system.

        u is changed by one unit in the last place, up or down at random. What the change of the
        residual has more than K times this change is rounding; its step is the error.

        Parameters
        ----------
        f
            The residual at the state.
        """
        matrix = self.matrix
        assert matrix
        signs = np.random.default_rng(self._system.comm.rank).choice([-1.0, 1.0], state.u.size)
        rounded_u = state.u + signs * np.spacing(state.u)
        rounded_residual = self._system.residual(rounded_u, state.mu)
        R, _ = self.split(f)
        residual_change = rounded_residual - R
        K_du, _ = matrix.times(rounded_u - state.u, 0.0)
        return matrix.size(matrix.solve(residual_change - K_du, 0.0))

    def new_vector(self) -> PETSc.Vec:
        """Return a new vector (u, mu); mu is on the last rank."""
        size = self._system.size + self._is_last_rank  # one more on the last rank
        return PETSc.Vec().createMPI((size, PETSc.DETERMINE), comm=self._system.comm)

    def join(self, values: Direction, x: PETSc.Vec) -> None:
        """Write this rank's u, and mu on the last rank, into a vector."""
        x.setArray(np.append(*values) if self._is_last_rank else values[0])

    def split(self, x: PETSc.Vec) -> Direction:
        """Return copies of u on this rank, and of mu on every rank. Collective."""
        local, comm = x.array_r, self._system.comm
        mu = comm.bcast(float(local[-1]) if self._is_last_rank else None, root=comm.size - 1)
        return local[: self._system.size].copy(), mu

    def _state_of(self, x: PETSc.Vec) -> State:
        """Return the state of an iterate x, with the fixed amplitudes of the guess. Collective."""
        u, mu = self.split(x)
        return self._guess.with_(u, self._name, mu)


def make_snes(
    callbacks: SnesCallbacks, x: PETSc.Vec, options: NewtonOptions, line_search: str = "basic"
) -> PETSc.SNES:
    """Create a SNES for vectors like `x`, whose matrix and linear solver are the callbacks.

    Parameters
    ----------
    line_search
        PETSc's type of line search; `basic` takes full steps. PETSc's options may set another.
    """
    sizes = x.getSizes()
    J = PETSc.Mat().createPython((sizes, sizes), context=callbacks, comm=x.comm)
    J.setUp()
    snes = PETSc.SNES().create(x.comm)
    snes.setType("newtonls")
    snes.setFunction(callbacks.function, x.duplicate())
    snes.setJacobian(callbacks.jacobian, J)
    snes.setConvergenceTest(callbacks.test)
    snes.setTolerances(stol=options.tolerance, max_it=options.max_iterations)
    snes.getKSP().setType("preonly")
    petsc_options = PETSc.Options(PREFIX)
    # an option of the user has priority; PETSc's default does not take full steps
    sets_line_search = not petsc_options.hasName("snes_linesearch_type")
    if sets_line_search:
        petsc_options["snes_linesearch_type"] = line_search
    for prefix in (PREFIX, ""):  # options with our prefix, then those without
        snes.setOptionsPrefix(prefix)
        snes.setFromOptions()
    # the options are global: ours would count for other solvers too
    if sets_line_search:
        petsc_options.delValue("snes_linesearch_type")
    pc = snes.getKSP().getPC()
    pc.setType("python")
    pc.setPythonContext(callbacks)
    return snes
