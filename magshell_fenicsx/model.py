"""The model of a problem at a state that a program sets: residual, tangent, mass, modes, solution.

A program that has its own solver (SNES, TAO, SLEPc, a time stepper, a coupled field) takes the
model's parts here. The solvers of this package, `follow` and `trace`, take the model too.

Words and units:

- An amplitude is a load parameter, by name: "pressure" (p/p_c), "lambda_m", that of an own energy.
- A state is a displacement with values of all amplitudes. Vectors are over R, in the numbering of
  the model's unknowns; they have as many entries on a rank as the rank owns unknowns.
- Energies are over E h R^2, residuals over E h R, tangents over E h, masses over rho h R^2. E, h,
  R and rho are Young's modulus, thickness, reference length and density.
- Functions are on the mesh that the program has given, in the lengths of its coordinates; without
  one on the model's own mesh, over R.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.case.open_problem import ProblemSource, problem_of, processes
from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import SkewedTangent, State, Vector, max_abs
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.shells.mass import mass
from magshell_fenicsx.shells.modes import ShellMode, ShellModes, mode_space
from magshell_fenicsx.simulate.contact_control import with_own_contact
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.trace import Amount, number_of_amount

SMALLEST_LOAD_STEP = 2.0**-8  # of the way from the last solution to the loads that are set
MAX_CONTACT_SOLVES = 12  # with changed stiffnesses and cuts of shells that touch


@dataclass(frozen=True)
class Mode:
    """A natural mode of the shell at a state.

    Attributes
    ----------
    omega2
        omega^2 rho R^2/E; negative for an unstable direction.
    label
        "" for a mode of the model; "m = 7" or "antisymmetric" for one that a model reduced by
        symmetry does not have.
    u
        The mode, with phi . M phi = 1 over the model's mass; None of a mode that the model does not
        have.
    """

    omega2: float
    label: str
    u: fem.Function | None = field(default=None, repr=False)


class Model(Scene):
    """The finite element model of a problem, at a state that `set`, `u` and `solve` change.

    The methods are collective.

    Parameters
    ----------
    given
        A problem, or a case, a mapping like a case file, or the path of a file.
    comm
        The processes; by default those of the mesh that a program gave, or all.
    terms
        Own energies besides those of the case.

    Raises
    ------
    CaseError, MeshError
        On every rank, if no model can be made.
    """

    def __init__(
        self,
        given: ProblemSource,
        comm: MPI.Comm | None = None,
        *,
        terms: Sequence[OwnTerm] = (),
    ) -> None:
        comm = processes(given, comm)
        super().__init__(problem_of(given, comm, terms), comm)
        self._state = self._solution = self.unloaded()
        # the function `u`, and its values when it was in agreement with the state; made when asked
        # for
        self._u: fem.Function | None = None
        self._values_of_u: NDArray[np.float64] = np.empty(0)

    @property
    def u(self) -> fem.Function:
        """The displacement, always the same function.

        A program may change its values: the next call of a method takes them. They follow the
        state at each access, and after `solve` and `put`.
        """
        self._show(self.state)
        assert self._u is not None
        return self._u

    @property
    def state(self) -> State:
        """The displacement as a vector, with the amplitudes by name."""
        if self._u is not None:
            has_changed = not np.array_equal(self._u.x.array, self._values_of_u)
            if self.comm.allreduce(has_changed, MPI.LOR):
                self._state = self._supported(State(self.unknowns_of(self._u), self._state.mu))
                self._values_of_u = self._u.x.array.copy()
        return self._state

    def _supported(self, state: State) -> State:
        """Return a state with its supports where they are: a program may have moved them."""
        system = self.model.system
        held_state = State(system.zero_at_supports(state.u), state.mu)
        return system.with_moved_supports(held_state)

    def _show(self, state: State) -> None:
        """Give the function `u` the values of a state; the first call makes it."""
        u = self.displacement(state)
        self._u = self._u or u
        self._u.x.array[:] = u.x.array
        self._values_of_u = u.x.array.copy()

    def _move_to(self, state: State) -> None:
        """Put the model into a state, and the function `u` if there is one."""
        self._state = state
        if self._u is not None:
            self._show(state)

    @property
    def amplitudes(self) -> Mapping[str, float]:
        """The loads by name, each in the unit of its amplitude; `set` changes them."""
        return MappingProxyType(dict(self._state.mu))

    @property
    def held_unknowns(self) -> NDArray[np.int32]:
        """Numbers of this rank's unknowns that supports hold or move.

        Supports in an oblique direction hold sums of unknowns, which are not among them.
        """
        return self.model.system.fixed_unknowns

    def set(self, **amplitudes: Amount) -> None:
        """Set amplitudes by name; the displacement stays.

        All begin at 0, also those of a field and of a natural shape; own energies at their values.

        Parameters
        ----------
        amplitudes
            Numbers in the unit of the amplitude, or texts such as "100 Pa" in a case with units.

        Raises
        ------
        ValueError
            If the model has no such amplitude, or it has no unit of that kind.
        """
        numbers = {}
        for name, amount in amplitudes.items():
            self.refuse_unknown_amplitude("set", name)
            numbers[name] = number_of_amount(self, name, f"set: {name}: {amount!r}", amount)
        self._state = State(self.state.u, self._state.mu | numbers)

    def put(self, state: State | Record | PETSc.Vec) -> None:
        """Put the model into a state.

        Parameters
        ----------
        state
            A state or a record of this model, with its amplitudes; or unknowns as a PETSc vector,
            at the amplitudes that are set.

        Raises
        ------
        ValueError
            If it is of another model.
        """
        if isinstance(state, PETSc.Vec):
            u = self._own_unknowns("put", state.array_r)
            state = self._supported(State(u, self._state.mu))
        if isinstance(state, Record):
            state = state.point.state
        if not isinstance(state, State):
            raise ValueError(
                f"put: a {type(state).__name__}: give a state, a record, or a PETSc vector such as "
                "model.unknowns()"
            )
        self.refuse_foreign(state)
        self._move_to(state)

    def unknowns(self) -> PETSc.Vec:
        """Return the displacement as a vector of its own."""
        return self._vector(self.state.u)

    def residual(self) -> PETSc.Vec:
        """Return R = dPi/du, zero at unknowns that are held; a vector of its own."""
        self.read_functions()
        return self._vector(self.model.system.residual(self.state.u, self._state.mu))

    def tangent(self) -> PETSc.Mat:
        """Return K = dR/du, a matrix of its own; not symmetric where a load has no potential.

        Rows and columns of held unknowns are those of the unit matrix.
        """
        self.read_functions()
        tangent = self.model.system.tangent(self.state.u, self._state.mu)
        if not isinstance(tangent, SkewedTangent):
            return tangent.copy()
        K = tangent.K.copy()
        K.setOption(PETSc.Mat.Option.SYMMETRIC, False)
        K.axpy(1.0, tangent.N, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        return K

    def mass(self) -> PETSc.Mat:
        """Return the consistent mass of the undeformed shell, a matrix of its own.

        Rows and columns of held unknowns are zero; there is no rotary inertia.
        """
        self.read_functions()
        return mass(self.model)

    def energies(self, state: State | None = None) -> dict[str, float]:
        """Return group of terms -> energy over E h R^2 of the whole shell.

        Parameters
        ----------
        state
            Another state than the present one.
        """
        self.read_functions()
        return super().energies(state or self.state)

    def solve(self) -> Record:
        """Find the equilibrium at the amplitudes that are set, and put the model there.

        Newton's method starts at the state. If it fails, it starts at the last solution, and the
        amplitudes go from there in steps that it manages. A warning says where no load is set.

        Returns
        -------
        Record
            The equilibrium, for `columns`, `picture`, `trace` and others. It counts the unstable
            directions of the model itself; `modes` has those that a model reduced by symmetry
            excludes.

        Raises
        ------
        Stopped
            If no equilibrium is found; the state stays.
        """
        self.read_functions()
        target = self.state
        self._warn_without_load(target)
        state, reason = self._equilibrium(target, self._solution)
        if state is None:
            state = self._step_by_step(target, reason)
        self._solution = state
        self._move_to(state)
        pivots = 0
        if not (self.allows_rigid_motion or self.free_in_time):
            pivots = self.newton.factor_at(state).negative_pivots
        point = Point(state, 0.0, 0.0 * state.u, 0.0, pivots, pivots)
        return Record("target", "", point).with_scene(self)

    def _warn_without_load(self, target: State) -> None:
        """Warn of a solve whose answer is the undeformed shell, as no load has been set."""
        is_loaded = any(target.mu.values()) or any(self._solution.mu.values())
        if not (is_loaded or max_abs(self.comm, target.u)) and target.mu:
            names = ", ".join(target.mu)
            warnings.warn(
                f"solve: all loads are 0 ({names}): give values first, such as "
                f"model.set({next(iter(target.mu))}=1)",
                stacklevel=3,
            )

    def modes(self, count: int = 6) -> list[Mode]:
        """Return the natural modes of lowest frequency at the state, ascending.

        Unstable directions are all among them, even if they are more than `count`.

        Raises
        ------
        ValueError
            If `count` is no number from 1 on.
        ModesNotFound
            If the iteration for the eigenvalues does not find them.
        """
        if not isinstance(count, int | np.integer) or count < 1:
            raise ValueError(f"modes: {count!r}: give a number from 1 on")
        self.read_functions()
        space = mode_space(self.model)  # of a sector another model
        shell_modes = ShellModes(space.model).vibrations(
            space.state(self.state), count, allows_rigid_motion=self.allows_rigid_motion
        )

        def function_of(mode: ShellMode) -> fem.Function | None:
            """Return a mode as a function; None if this model does not have it."""
            is_own = space.model is self.model and not mode.label
            return self.function(mode.vector) if is_own else None

        return [Mode(mode.eigenvalue, mode.label, function_of(mode)) for mode in shell_modes]

    def function(self, vector: PETSc.Vec | Vector) -> fem.Function:
        """Return a vector of the model's unknowns as a function, such as an eigenvector.

        Raises
        ------
        ValueError
            If the vector is of another model.
        """
        local = vector.array_r if isinstance(vector, PETSc.Vec) else vector
        return self.on_given_mesh(
            self.model.system.with_ghosts(self._own_unknowns("function", local))
        )

    def _own_unknowns(self, name: str, values: Vector) -> Vector:
        """Return a copy of this rank's values of unknowns.

        Parameters
        ----------
        name
            The method that got them, for a message.

        Raises
        ------
        ValueError
            If they are not as many as this rank owns.
        """
        size = self.model.system.size
        if np.shape(values) != (size,):
            raise ValueError(
                f"{name}: a vector of {np.size(values)} unknowns on this rank, where the model has "
                f"{size}: take one like model.unknowns()"
            )
        return np.array(values)

    def _vector(self, values: Vector) -> PETSc.Vec:
        """Return values of this rank's unknowns as a PETSc vector."""
        return PETSc.Vec().createWithArray(values.copy(), comm=self.comm)

    def _equilibrium(self, guess: State, previous_state: State) -> tuple[State | None, str]:
        """Return the equilibrium near a state at its amplitudes, or None and the reason.

        Parameters
        ----------
        previous_state
            The equilibrium before, whose history it continues.
        """
        if not guess.mu:
            raise Stopped("solve: the model has no load")
        name = next(iter(guess.mu))  # any of them, since it does not change
        system = self.model.system
        for _ in range(MAX_CONTACT_SOLVES):
            outcome = self.newton.solve(guess, name, PrescribedLoad(name, guess.mu[name]))
            if not outcome.converged:
                return None, outcome.reason
            # stiffnesses and cuts of shells that touch change until they are fit
            state_with_own_contact = with_own_contact(self, outcome.state)
            if state_with_own_contact is None:
                state = system.advance(outcome.state, previous_state.mu)
                return system.with_moved_supports(state), ""
            guess = state_with_own_contact
        return None, "the stiffness of shells that touch does not become fit"

    def _step_by_step(self, target: State, reason: str) -> State:
        """Return the equilibrium at the amplitudes of a state, from the last solution on.

        Parameters
        ----------
        reason
            Why Newton's method has failed at the target.
        """
        start = state = self._solution
        loads = self.unloaded().mu.keys()  # without the history that a state has as well
        solved_fraction, step = 0.0, 0.5
        while solved_fraction < 1.0:
            fraction = min(solved_fraction + step, 1.0)
            amplitudes = {
                name: start.mu[name] + fraction * (target.mu[name] - start.mu[name])
                for name in loads
            }
            next_state, reason_of_step = self._equilibrium(
                State(state.u, state.mu | amplitudes), previous_state=state
            )
            if next_state is not None:
                state, solved_fraction, step = next_state, fraction, 2 * step
                continue
            reason, step = reason_of_step, (fraction - solved_fraction) / 2
            if step < SMALLEST_LOAD_STEP:
                raise Stopped(
                    f"solve: no equilibrium beyond {solved_fraction:.4g} of the way from the last "
                    f"solution to the loads that are set: {reason}"
                )
        return state
