"""One time step of M a + c M v + D + dPi/du(u; mu(t)) = 0 by the generalised alpha method.

Newton's method solves each step with the exact tangent. J. Chung and G. M. Hulbert, Journal of
Applied Mechanics 60 (1993): second order; high frequencies fade by the factor rho at each step.
With rho = 1 the force is averaged along the step at Gauss points, which conserves the energy
(G. R. W. Quispel and D. I. McLaren, Journal of Physics A 41, 2008). PETSc's TSALPHA2 has the same
formulas for rho < 1, but shows neither its acceleration, without which a resumed run is another
one, nor a place for that average.

u, v, a are displacement, velocity and acceleration; M is the mass, c the drag, D the viscous force,
mu are the amplitudes: load parameters and prescribed positions, by name. dPi/dmu of a load is minus
the displacement on which it works, of a position the force on it. A device makes some amplitudes
unknown, since it holds their conjugates: its unknowns y follow u on the last rank. A step averages
forces at `AlphaParameters.forces`, with the end weighted by 1 - alpha_f, inertia by 1 - alpha_m. At
a jump of the loads or of the supports' velocity a value before and one after exist. Contact forces
are averaged along a step and then restored. Lengths are displacements in units of the system's
length.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.continuation.control import Chord
from magshell_fenicsx.continuation.device import Device
from magshell_fenicsx.continuation.factor import Factorisation, join, split
from magshell_fenicsx.continuation.motion import (
    AveragedContact,
    Motion,
    MovingSupports,
    ViscousForces,
    consistent_state,
    constrained_acceleration,
)
from magshell_fenicsx.continuation.snes import LENGTH_PER_DISPLACEMENT
from magshell_fenicsx.continuation.system import (
    Amplitudes,
    BorderedTangent,
    SkewedTangent,
    State,
    System,
    Tangent,
    Vector,
    dot,
    max_abs,
    symmetric_part,
)

# of u in a step, over the system's length or, where that is longer, a tenth of the displacement
TOLERANCE = 1e-10
# of the length: energies below that of such a displacement count as none
MIN_ENERGY_DISPLACEMENT = 1e-3
# steps below this that shrink no more, with new factors, may be rounding
MAX_ROUNDING_STEP = 1e-7
ROUNDING_FACTOR = 10.0  # steps up to this many times the rounding error are rounding
MAX_ITERATIONS = 20
MAX_STEP = 3.0  # lengths: a step that is longer, and longer than the first one, diverges
# steps with new factors that may grow in contact with a body: they find what touches
CONTACT_PATIENCE = 2
REFACTOR_RATIO = 0.2  # new factors if a step is longer than this fraction of the previous one
# error of the last step up to which the acceleration predicts the next: in stiff motions it
# alternates
MAX_ERROR_FOR_PREDICTION = 1e-2
# changes of the acceleration times the square of the time step, from iterations that end at
# TOLERANCE
ACCELERATION_ROUNDING = 1e-8
MAX_STEP_CHANGE = 0.05  # relative change of the time step after which factors are renewed
# Gauss points of a step and their weights: exact for the membrane's energy, of degree 4
GAUSS_POINTS = ((0.5 - np.sqrt(1 / 12), 0.5), (0.5 + np.sqrt(1 / 12), 0.5))
Array = NDArray[np.float64]
Loads = Callable[[float, bool], dict[str, float]]  # (t, before a jump) -> mu


@dataclass(frozen=True)
class AlphaParameters:
    """The parameters of the generalised alpha method.

    Attributes
    ----------
    alpha_m, alpha_f, beta, gamma
        As in the paper of Chung and Hulbert.
    forces
        Fractions of the step at which forces are taken, with their weights.
    """

    alpha_m: float
    alpha_f: float
    beta: float
    gamma: float
    forces: tuple[tuple[float, float], ...]

    @classmethod
    def from_spectral_radius(cls, rho: float) -> "AlphaParameters":
        """Return the parameters for a spectral radius rho at infinite frequency, 0 to 1.

        Radius 1 dissipates nothing, and radius 0 damps the highest frequencies in one step.
        """
        alpha_m, alpha_f = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
        forces = GAUSS_POINTS if rho == 1 else ((1 - alpha_f, 1.0),)
        # second order, and the strongest damping of high frequencies for this rho
        beta, gamma = (1 - alpha_m + alpha_f) ** 2 / 4, 0.5 - alpha_m + alpha_f
        return cls(alpha_m, alpha_f, beta, gamma, forces)


@dataclass(frozen=True)
class FactoredState:
    """The state and time step of the latest factors.

    Attributes
    ----------
    u, mu
        Displacement and amplitudes at which the tangent was taken, within a step.
    dt
        Length of the step.
    habit
        `Factorisation.habit` with which the factors were made.
    """

    u: Vector
    mu: dict[str, float]
    dt: float
    habit: int


@dataclass(frozen=True)
class Surroundings:
    """What a moving shell is held by and touches.

    Attributes
    ----------
    moving_amplitudes
        Amplitudes that are positions and move.
    device
        Amplitudes that are unknown, since their conjugates are held at the end of each step; None:
        all are loads.
    supports
        Supports that move.
    contact
        Contacts, with which the balance of energy is checked in each step.
    """

    moving_amplitudes: Collection[str] = ()
    device: Device | None = None
    supports: MovingSupports | None = None
    contact: AveragedContact | None = None


class Integrator:
    """Integrator of the motion in time; factors are kept while they serve.

    All methods that solve or sum over unknowns are collective.

    Parameters
    ----------
    system
        The shell with its loads, without inertia.
    mass
        The mass matrix; its pattern is part of that of the tangent, with zero rows and columns at
        supports.
    loads
        Called with a time and whether a jump is still ahead; it returns all amplitudes. A step that
        ends at a jump takes the values before it.
    rho
        Spectral radius at infinite frequency, 0 to 1.
    drag
        c, force per mass and velocity.
    viscous
        Forces that depend on the history of the strain; None: there are none.
    surroundings
        What the shell is held by and touches.

    Attributes
    ----------
    steps, iterations
        Work so far.
    factored_state
        The state of the latest factors; None if the next step makes new ones.

    Private fields: `_free` are names of amplitudes that the device makes unknown, `_driven` those
    of all positions that move. `_total_energy` is the energy at the begin of the motion, from which
    an imbalance is counted. `_K` is the matrix of a step, with the pattern of the system's tangent
    `_tangent`. `_advance` returns a converged state with its history variables updated, from the
    state and the amplitudes before it. `_x` and `_y` are vectors for products with the mass.
    """

    def __init__(
        self,
        system: System,
        mass: PETSc.Mat,
        loads: Loads,
        rho: float,
        drag: float = 0.0,
        viscous: ViscousForces | None = None,
        surroundings: Surroundings | None = None,
    ) -> None:
        """Begin without factors."""
        surroundings = surroundings or Surroundings()
        device = surroundings.device
        self.system, self.mass, self.loads = system, mass, loads
        self.drag, self.viscous = drag, viscous
        self.parameters = AlphaParameters.from_spectral_radius(rho)
        self.supports, self.contact = surroundings.supports, surroundings.contact
        self._total_energy = np.nan
        self.device, self._free = device, tuple(device.names) if device else ()
        self._driven = frozenset({*surroundings.moving_amplitudes, *self._free})
        self.factorisation = Factorisation(system.comm)
        self.steps = self.iterations = 0
        # contact of shells may give another tangent with another pattern
        self._K: PETSc.Mat | None = None
        self._tangent: PETSc.Mat | None = None
        self.factored_state: FactoredState | None = None
        self._x, self._y = mass.createVecs()
        # history variables are turns of edges under moments, which are counted on beyond a full
        # turn; a system without them has no such function
        self._advance: Callable[[State, Amplitudes], State] = getattr(
            system, "advance", lambda state, previous: state
        )

    def begin(self, t: float, u: Vector, v: Vector, earlier: Motion | None = None) -> Motion:
        """Return a motion with the acceleration that the loads after t give it. Collective.

        Displacement and velocity are projected to what a device allows, along the forces of its
        constraints.

        Parameters
        ----------
        u, v
            Displacement and velocity at the time t.
        earlier
            An earlier motion whose sums of work and dissipation continue; None: they begin at zero.
        """
        mu = self.loads(t, False)
        work, dissipated = (earlier.work, earlier.dissipated) if earlier else (0.0, 0.0)
        # unknown amplitudes and stiffnesses of contacts go on from the earlier motion
        if earlier:
            mu |= {name: earlier.mu[name] for name in self._free} | self._contact_settings(earlier)
        inverse_mass = self._inverse_mass()
        # displacement, velocity and amplitudes, as supports and device demand
        if self.supports:
            # a jump of the supports' velocity is an impulse, whose work is the change of the
            # kinetic energy
            work -= self._kinetic_energy(v, t, before_jump=True)
            jump = self.supports.velocity(t, False) - self.supports.velocity(t, True)
            v = v - inverse_mass(self._mass_times_supports(jump))
            work += self._kinetic_energy(v, t, before_jump=False)
        if self.device:
            u, v, mu = consistent_state(self.system, self.device, inverse_mass, u, v, mu)
        mu = self._advance(State(u, mu), earlier.mu if earlier else mu).mu
        if self.viscous:
            self.viscous.memory = earlier.memory if earlier else self.viscous.memory
            self.viscous.begin()
        # the acceleration that all forces give
        a = -inverse_mass(self._forces_at_begin(t, u, v, mu))
        if self.device:
            motion = Motion(t, u, v, a, mu)
            a, mu = constrained_acceleration(self.system, self.device, inverse_mass, motion)
        motion = Motion(
            t, u, v, a, mu, work, dissipated, memory=self.viscous and self.viscous.memory
        )
        if self.contact and not earlier:
            self._total_energy = self.kinetic(motion) + self.contact.stored_energy(u, mu)
        potentials = self._potentials(motion, before_jump=False)
        return self.with_imbalance(replace(motion, potentials=potentials))

    def _forces_at_begin(self, t: float, u: Vector, v: Vector, mu: Amplitudes) -> Vector:
        """Return the residual at the begin of a motion without its inertia: M a is minus this.

        Inertia and drag by moving supports are part of it. At a jump the values after it count.
        """
        residual = self.system.residual(u, mu) + self.drag * self._times(v)
        if self.supports:
            acceleration = self.supports.acceleration(t, False)
            velocity = self.supports.velocity(t, False)
            residual = residual + self._mass_times_supports(acceleration + self.drag * velocity)
        if self.viscous:
            residual = residual + self.viscous.force(u, u, v, 1.0, 0.0)
        return residual

    def begins_anew(self, t: float) -> bool:
        """Return whether a motion begins anew at a kink or jump of the loads at time t.

        In contact with a body it begins anew only at a jump or with moving supports. At a kink the
        acceleration is continuous; a new one from the remaining residual would be large where the
        contact is stiff.
        """
        if not self.contact or self.supports is not None:
            return True
        return self.loads(t, True) != self.loads(t, False)

    def with_imbalance(self, motion: Motion) -> Motion:
        """Return a motion with its imbalance and turnover of energy. Collective.

        The imbalance is the kinetic, stored and dissipated energy less the work, and less this sum
        at the begin; the turnover is the sum of their magnitudes. Without contact the balance is
        not checked, and the motion is returned unchanged.
        """
        if not self.contact:
            return motion
        stored_energy = self.contact.stored_energy(motion.u, motion.mu)
        energies = self.kinetic(motion), stored_energy, motion.dissipated, -motion.work
        return replace(
            motion,
            imbalance=sum(energies) - self._total_energy,
            # not less than the energy of a small displacement, with a stiffness of one
            turnover=sum(map(abs, energies)) + (MIN_ENERGY_DISPLACEMENT * self.system.length) ** 2,
        )

    def _inverse_mass(self) -> Callable[[Vector], Vector]:
        """Return a function that solves with the mass matrix.

        Massless unknowns, as at supports, get ones on the diagonal, so the matrix is regular.
        """
        # the pattern of M need not have these entries: PETSc may add them
        M = self.mass.copy()
        massless_diagonal = M.getDiagonal()
        massless_diagonal.setArray((massless_diagonal.array_r == 0).astype(float))
        M.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
        M.setOption(PETSc.Mat.Option.IGNORE_ZERO_ENTRIES, False)
        M.setDiagonal(massless_diagonal, PETSc.InsertMode.ADD_VALUES)
        M.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        factors = Factorisation(self.system.comm)
        factors.factor(M)
        return factors.solve

    def kinetic(self, motion: Motion) -> float:
        """Return the kinetic energy v . M v/2, with the velocity of supports. Collective."""
        return self._kinetic_energy(motion.v, motion.t, before_jump=True)

    def _kinetic_energy(self, v: Vector, t: float, *, before_jump: bool) -> float:
        """Return the kinetic energy at time t of nodes with the velocities v, and of supports.

        Parameters
        ----------
        before_jump
            Whether supports have their velocity before or after a jump at t.
        """
        if self.supports is None:
            return dot(self.system.comm, v, self._times(v)) / 2
        v = v + self.supports.velocity(t, before_jump)
        return dot(self.system.comm, v, self.supports.times(v)) / 2

    def _mass_times_supports(self, x: Vector) -> Vector:
        """Return the mass times a vector at supports: the forces of inertia on all other nodes."""
        assert self.supports
        return self.supports.zeroed_at_supports(self.supports.times(x))

    def step(self, motion: Motion, dt: float) -> Motion | str:
        """Return the motion after a time step, or the reason why there is none. Collective.

        The step itself does not change `motion`. Contacts may become stiffer before it.

        Parameters
        ----------
        dt
            Length of the step.
        """
        if self.contact:
            # contacts that may meet too fast become stiffer before the step
            v = motion.v + self.supports.velocity(motion.t, False) if self.supports else motion.v
            settings = self.contact.stiffened_settings(State(motion.u, motion.mu), v)
            motion = replace(motion, mu=motion.mu | settings)
        try:
            return self._step(motion, dt)
        except np.linalg.LinAlgError:
            return "a body whose force is held has left the shell, and has no mass"
        finally:
            if self.contact:
                self.contact.use_state_forces()

    def _step(self, motion: Motion, dt: float) -> Motion | str:
        """Solve one time step by Newton's method with kept factors.

        The unknowns are u at its end and y, the device's amplitudes. Factors are renewed when the
        steps of the iteration do not shrink enough.

        Returns
        -------
        The motion at the end of the step, or the reason why there is none.
        """
        comm, length = self.system.comm, self.system.length
        if self.viscous:
            self.viscous.memory = motion.memory
        u = self._guessed_displacement(motion, dt)
        y = self.device.unknowns(motion.mu) if self.device else np.empty(0)
        support_forces = self._support_forces(motion, dt)
        # sizes of the last and the first step of the iteration; `growths`: number of successive
        # steps that have grown, of which a contact allows some
        last_size, first_size, growths = np.inf, np.inf, 0
        max_growths = CONTACT_PATIENCE if self.contact else 0
        # factors of an earlier time step serve if it was about as long
        has_new_factors = (
            self.factored_state is None or abs(dt - self.factored_state.dt) > MAX_STEP_CHANGE * dt
        )
        if has_new_factors:
            self._factor_step(motion, u, y, dt)
        chord = self._chord()
        for _ in range(MAX_ITERATIONS):
            a, v = self._rates(motion, u, dt)
            step = chord.step(support_forces + self._residual(motion, u, y, v, a, dt))
            chord.accept_step(step)
            du, dy = split(step, y.size, comm)
            u, y = u - du, y - dy
            self.iterations += 1
            step_size = max_abs(comm, du) / length
            if not np.isfinite(step_size):
                return "the step is not a number"
            # the tolerance is relative to a tenth of the displacement if that exceeds the length
            displacement = LENGTH_PER_DISPLACEMENT * max_abs(comm, u) / length
            # small steps that new factors do not shrink may be rounding
            stalled = has_new_factors and last_size / 2 < step_size <= MAX_ROUNDING_STEP
            has_converged = step_size <= TOLERANCE * max(1.0, displacement)
            if stalled and not has_converged:
                rounding_error = self._rounding_error(motion, u, y, dt)
                has_converged = step_size <= ROUNDING_FACTOR * rounding_error
            if has_converged:
                return self._end_of_step(motion, u, y, dt)
            # the step does not shrink enough: give up, or go on with new factors
            if step_size > REFACTOR_RATIO * last_size:
                growths = growths + 1 if has_new_factors and step_size > last_size else 0
                diverges = has_new_factors and step_size > max(MAX_STEP, first_size)
                if growths > max_growths or diverges:
                    break
                self._factor_step(motion, u, y, dt)
                has_new_factors, chord = True, self._chord()
            first_size = step_size if first_size == np.inf else first_size
            last_size = step_size
        self.factored_state = None
        return "Newton's method does not converge"

    def _guessed_displacement(self, motion: Motion, dt: float) -> Vector:
        """Return a guess of the displacement after a step of length dt.

        It is that of a constant velocity or, if the last step was accurate, of a constant
        acceleration.
        """
        u = motion.u + dt * motion.v
        if motion.error < MAX_ERROR_FOR_PREDICTION:
            u = u + dt**2 / 2 * motion.a
        return u

    def _end_of_step(self, motion: Motion, u: Vector, y: Array, dt: float) -> Motion | str:
        """Return the motion at the end of a step that has converged, if no surfaces pass through.

        Otherwise return the message about them.
        """
        end = State(u, self._amplitudes(motion, y, 1.0, dt))
        if self.contact:
            message = self.contact.penetration_message(State(motion.u, motion.mu), end)
            if message:
                return message
        self.steps += 1
        return self._accept(motion, u, y, dt)

    def _chord(self) -> Chord[Vector]:
        """Return Broyden's chord method for a residual (u, y), with the latest factors.

        From residuals it gives steps: with one matrix for several iterates, which Broyden's update
        corrects after each.
        """
        comm = self.system.comm
        return Chord(
            self.factorisation.solve, partial(dot, comm), lambda a, factor, b: a + factor * b
        )

    def _support_forces(self, motion: Motion, dt: float) -> Vector:
        """Return the forces of inertia and drag by moving supports in a step of length dt.

        The method's averages of accelerations and velocities at both ends are used. Unknown
        amplitudes have zeros. At the end, which may be a kink, the values before it count.
        """
        forces, supports, end = 0.0 * motion.u, self.supports, motion.t + dt
        if supports:
            alpha_m, alpha_f = self.parameters.alpha_m, self.parameters.alpha_f
            a = (1 - alpha_m) * supports.acceleration(end, True) + alpha_m * supports.acceleration(
                motion.t, False
            )
            v = (1 - alpha_f) * supports.velocity(end, True) + alpha_f * supports.velocity(
                motion.t, False
            )
            forces = self._mass_times_supports(a + self.drag * v)
        return self.device.padded(forces) if self.device else forces

    def _rates(self, motion: Motion, u: Vector, dt: float) -> tuple[Vector, Vector]:
        """Return acceleration and velocity at the end of a step of length dt to u (Newmark)."""
        beta, gamma = self.parameters.beta, self.parameters.gamma
        a = (u - motion.u - dt * motion.v) / (beta * dt**2) - (0.5 / beta - 1) * motion.a
        return a, motion.v + dt * ((1 - gamma) * motion.a + gamma * a)

    def _amplitudes(self, motion: Motion, y: Array, fraction: float, dt: float) -> dict[str, float]:
        """Return all amplitudes at a fraction of a step.

        Loads follow their functions of time. Unknown amplitudes and positions of supports grow
        linearly, as displacements do.

        Parameters
        ----------
        motion
            The begin of the step.
        y
            The device's unknowns at its end, (k,).
        fraction
            0 at the begin, 1 at the end.
        """
        mu = self.loads(motion.t + fraction * dt, True)
        ends = self.device.values(y) if self.device else {}
        if self.supports:
            loads_at_end = self.loads(motion.t + dt, True)
            ends |= {name: loads_at_end[name] for name in self.supports.names & set(mu)}
        # unknown amplitudes, and positions of supports
        linear = {
            name: motion.mu[name] + fraction * (end - motion.mu[name]) for name, end in ends.items()
        }
        return mu | self._contact_settings(motion) | linear

    def _contact_settings(self, motion: Motion) -> dict[str, float]:
        """Return the stiffnesses of contacts by name, which a motion raises and keeps."""
        if not self.contact:
            return {}
        return {name: motion.mu[name] for name in self.contact.settings & set(motion.mu)}

    def _residual(
        self, motion: Motion, u: Vector, y: Array, v: Vector, a: Vector, dt: float
    ) -> Vector:
        """Return the residual of a step to u and y, without the forces by moving supports.

        Inertia, drag and forces are averaged over the step by the weights of the method.

        Parameters
        ----------
        motion
            The begin of the step.
        u, y, v, a
            Displacement, the device's unknowns, velocity and acceleration at the end of the step.

        Returns
        -------
        The forces, followed by the device's rows on the last rank.
        """
        alpha_m, alpha_f = self.parameters.alpha_m, self.parameters.alpha_f
        mean_velocity = (1 - alpha_f) * v + alpha_f * motion.v
        # the system's residual has the contact forces of the whole step from here on
        self._average_contact(motion, u, y, dt)
        # inertia and drag, then the forces within the step
        residual = self._times((1 - alpha_m) * a + alpha_m * motion.a + self.drag * mean_velocity)
        for fraction, weight in self.parameters.forces:
            u_between = motion.u + fraction * (u - motion.u)
            mu_between = self._amplitudes(motion, y, fraction, dt)
            residual = residual + weight * self.system.residual(u_between, mu_between)
        if self.viscous:
            residual = residual + self.viscous.force(motion.u, u, mean_velocity, 1 - alpha_f, dt)
        if self.device is None:
            return residual
        # conjugates are held at the end of the step; (1 - alpha_f) keeps the matrix symmetric
        if self.contact:
            self.contact.use_state_forces()
        rows = (1 - alpha_f) * self.device.rows(u, self._amplitudes(motion, y, 1.0, dt))
        return join(residual, rows, self.system.comm)

    def _average_contact(self, motion: Motion, u: Vector, y: Array, dt: float) -> None:
        """Replace the contact forces by their mean along a step to u and y.

        They stay so until `contact.use_state_forces()`. Without contact nothing happens.
        """
        if self.contact:
            end = State(u, self._amplitudes(motion, y, 1.0, dt))
            self.contact.average_along(State(motion.u, motion.mu), end, 1 - self.parameters.alpha_f)

    def _rounding_error(self, motion: Motion, u: Vector, y: Array, dt: float) -> float:
        """Return the size of an iteration's step that rounding of the forces makes, in lengths.

        u is changed by one unit in the last place, up or down at random; the change of the residual
        gives the step.
        """
        signs = np.random.default_rng(self.system.comm.rank).choice([-1.0, 1.0], u.size)

        def residual(u: Vector) -> Vector:
            """Return the residual of the step to u."""
            a, v = self._rates(motion, u, dt)
            return self._residual(motion, u, y, v, a, dt)

        residual_change = residual(u + signs * np.spacing(u)) - residual(u)
        du, _ = split(self.factorisation.solve(residual_change), y.size, self.system.comm)
        return max_abs(self.system.comm, du) / self.system.length

    def _factor_step(self, motion: Motion, u: Vector, y: Array, dt: float) -> None:
        """Factor the derivative of `_residual` by u and y, at a guess of the end of a step.

        The tangent is taken at one place within the step, and serves all fractions.
        """
        fraction = 1 - self.parameters.alpha_f
        u_between = motion.u + fraction * (u - motion.u)
        mu = self._amplitudes(motion, y, fraction, dt)
        self._average_contact(motion, u, y, dt)
        self.factor(FactoredState(u_between, mu, dt, self.factorisation.habit))

    def factor(self, state: FactoredState) -> None:
        """Factor the matrix of a step at a state. Collective.

        The matrix is (1 - alpha_f) K + ((1 - alpha_m)/(beta dt^2) + drag (1 - alpha_f) gamma/(beta
        dt)) M, bordered by the device's rows. K is the tangent at the state.
        """
        # a resumed run factors with the same choice of method, and so the same rounding
        self.factorisation.habit = state.habit
        parameters, u, mu, dt = self.parameters, state.u, state.mu, state.dt
        fraction, rate = 1 - parameters.alpha_f, parameters.gamma / (parameters.beta * dt)
        viscous = self.viscous
        tangent = viscous.tangent(u, mu, dt, rate) if viscous else self.system.tangent(u, mu)
        assert not isinstance(tangent, BorderedTangent)
        K = symmetric_part(tangent)  # beside it a tangent may have a skew part N
        # the tangent is another object, for example after a change of contact: it may have another
        # pattern, so the matrix of the step is made anew
        is_other = self._tangent is None or self._tangent.handle != K.handle
        if is_other or self._K is None:
            self._tangent, self._K = K, K.duplicate()
            self._K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        K.copy(self._K, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self._K.scale(fraction)
        inertia = (1 - parameters.alpha_m) / (parameters.beta * dt**2) + self.drag * fraction * rate
        self._K.axpy(inertia, self.mass, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        matrix: Tangent = self._K
        if isinstance(tangent, SkewedTangent):
            matrix = SkewedTangent(self._K, fraction * tangent.N)
        if self.device:
            C, D = self.device.border(u, mu)
            columns = [fraction * column for column in C]
            matrix = BorderedTangent(matrix, columns, fraction * D, self.device.multipliers)
        self.factorisation.factor(matrix)
        self.factored_state = state

    def _accept(self, motion: Motion, u: Vector, y: Array, dt: float) -> Motion:
        """Return the motion at the end of a step that has converged.

        It has the new sums of work and dissipation, the potentials, and the estimated error.
        Viscous forces go on to the end of the step.

        Parameters
        ----------
        motion
            The begin of the step.
        u, y
            Displacement and the device's unknowns at its end.
        """
        comm, alpha_f, t = self.system.comm, self.parameters.alpha_f, motion.t + dt
        a, v = self._rates(motion, u, dt)
        mu = self._advance(State(u, self._amplitudes(motion, y, 1.0, dt)), motion.mu).mu
        end_motion = Motion(t, u, v, a, mu)
        mean_forces = self._mean_forces(motion, end_motion, y, dt)
        potentials = self._potentials(end_motion, before_jump=True)
        work = sum(
            self._work(name, motion, mu, potentials, mean_forces.get(name)) for name in potentials
        )
        step, mean_velocity = u - motion.u, (1 - alpha_f) * v + alpha_f * motion.v
        dissipated = self._dissipated_by_drag(motion, dt, step, mean_velocity)
        error = self._error(motion, end_motion, dt)
        if self.viscous:
            dissipated += dot(comm, step, self.viscous.accept(motion.u, u, dt))
        end_motion = replace(
            end_motion,
            work=motion.work + work,
            dissipated=motion.dissipated + dissipated,
            memory=self.viscous and self.viscous.memory,
        )
        return self.with_imbalance(replace(end_motion, potentials=potentials, error=error))

    def _dissipated_by_drag(
        self, motion: Motion, dt: float, step: Vector, mean_velocity: Vector
    ) -> float:
        """Return the work of the drag in a step: drag times mean velocity, along the displacement.

        Parameters
        ----------
        motion, dt
            The begin of the step, and its length.
        step, mean_velocity
            Displacement and mean velocity in the step, without those of moving supports; these are
            added here.
        """
        comm, alpha_f, t = self.system.comm, self.parameters.alpha_f, motion.t + dt
        if self.supports and self.drag:
            begin, end = self.supports.velocity(motion.t, False), self.supports.velocity(t, True)
            step_of_all = step + dt / 2 * (begin + end)
            mean_velocity = mean_velocity + (1 - alpha_f) * end + alpha_f * begin
            return self.drag * dot(comm, step_of_all, self.supports.times(mean_velocity))
        if self.drag:
            return self.drag * dot(comm, step, self._times(mean_velocity))
        return 0.0

    def _error(self, motion: Motion, end_motion: Motion, dt: float) -> float:
        """Return the estimated error of a step, over the system's length.

        The change of the acceleration gives it (Zienkiewicz and Xie, 1991). Viscous forces that let
        displacements creep increase it, since errors of steps then add up.
        """
        comm, length, viscous = self.system.comm, self.system.length, self.viscous
        acceleration_change = max_abs(comm, end_motion.a - motion.a)
        # Newmark's local error: (beta - 1/6) dt^2 times the change of the acceleration
        error = abs(self.parameters.beta - 1 / 6) * dt**2 * acceleration_change / length
        if viscous is None:
            return error
        # a motion that creeps: errors of the steps add up over the time |v|/|a| in which the
        # velocity changes, at most over the creep time. Changes of the acceleration by rounding do
        # not count
        is_significant = dt**2 * acceleration_change > ACCELERATION_ROUNDING * length
        if viscous.creep_time > dt and is_significant:
            acceleration = max(max_abs(comm, end_motion.a), acceleration_change)
            motion_time = max_abs(comm, end_motion.v) / max(acceleration, 1e-300)
            error *= max(1.0, min(viscous.creep_time, motion_time) / dt)
        # the displacement that an error of the viscous force causes
        force = viscous.error_force(motion.u, end_motion.u, dt)
        if force is not None:
            force = self.device.padded(force) if self.device else force
            step = self.factorisation.solve((1 - self.parameters.alpha_f) * force)
            du, _ = split(step, len(self._free), comm)
            error = max(error, max_abs(comm, du) / length)
        return error

    def _potentials(self, motion: Motion, *, before_jump: bool) -> dict[str, float]:
        """Return dPi/dmu of the amplitudes that do work, by name.

        For moving supports it includes the forces of inertia and drag.

        Parameters
        ----------
        before_jump
            Whether supports have their velocity and acceleration before or after a jump.
        """
        mu = motion.mu
        # positions that do not move, and stiffnesses of contacts
        without_work = (self.system.coordinates - self._driven) | set(
            self._contact_settings(motion)
        )
        potentials = {
            name: self.system.potential(motion.u, mu, name)
            for name in mu
            if name not in without_work
        }
        if self.supports:
            a = motion.a + self.supports.acceleration(motion.t, before_jump)
            v = motion.v + self.supports.velocity(motion.t, before_jump)
            forces = self.supports.times(a + self.drag * v)
            for name in self._driven & self.supports.names:
                rate = self.supports.displacement_rate(mu, name)
                potentials[name] += dot(self.system.comm, forces, rate)
        return potentials

    def _mean_forces(
        self, motion: Motion, end_motion: Motion, y: Array, dt: float
    ) -> dict[str, float]:
        """Return the mean forces in a step on moving positions, by name.

        Without contact the result is empty: the mean of both ends is enough there.
        """
        if not self.contact:
            return {}
        support_names = self.supports.names if self.supports else frozenset[str]()
        moving = self._driven.intersection(self.contact.names | support_names)
        if not moving:
            return {}
        self._average_contact(motion, end_motion.u, y, dt)
        forces = {name: self._mean_force(name, motion, end_motion, y, dt) for name in moving}
        self.contact.use_state_forces()
        return forces

    def _mean_force(
        self, name: str, motion: Motion, end_motion: Motion, y: Array, dt: float
    ) -> float:
        """Return the mean force in a step on the moving position `name`.

        It is the weighted mean of dPi/dmu within the step; for supports with inertia and drag.

        Parameters
        ----------
        motion, end_motion
            Begin and end of the step.
        y
            The device's unknowns at its end.
        """
        supports, alpha_m, alpha_f = self.supports, self.parameters.alpha_m, self.parameters.alpha_f
        force = 0.0
        for fraction, weight in self.parameters.forces:
            u = motion.u + fraction * (end_motion.u - motion.u)
            mu = self._amplitudes(motion, y, fraction, dt)
            force += weight * self.system.potential(u, mu, name)
        if supports and name in supports.names:
            # accelerations and velocities of all nodes at both ends; at a jump the end of the step
            # is before it (True), the begin after it (False)
            a_end = end_motion.a + supports.acceleration(end_motion.t, True)
            a_begin = motion.a + supports.acceleration(motion.t, False)
            v_end = end_motion.v + supports.velocity(end_motion.t, True)
            v_begin = motion.v + supports.velocity(motion.t, False)
            acceleration = (1 - alpha_m) * a_end + alpha_m * a_begin
            velocity = (1 - alpha_f) * v_end + alpha_f * v_begin
            rate = supports.displacement_rate(self._amplitudes(motion, y, 1 - alpha_f, dt), name)
            inertia = supports.times(acceleration + self.drag * velocity)
            force += dot(self.system.comm, inertia, rate)
        return force

    def _work(
        self,
        name: str,
        motion: Motion,
        mu: Mapping[str, float],
        potentials: Mapping[str, float],
        mean_force: float | None,
    ) -> float:
        """Return the work of the amplitude `name` in a step.

        A load times the change of its conjugate -dPi/dmu is work; for a position, the force dPi/dmu
        times the change of the position.

        Parameters
        ----------
        motion
            The begin of the step, with its potentials.
        mu, potentials
            Amplitudes and dPi/dmu at the end of the step.
        mean_force
            The mean force on a position; None: the mean of both ends.
        """
        begin, end = motion.potentials[name], potentials[name]
        if name in self.system.coordinates:
            force = (begin + end) / 2 if mean_force is None else mean_force
            return force * (mu[name] - motion.mu[name])
        return -(motion.mu[name] + mu[name]) / 2 * (end - begin)

    def _times(self, x: Vector) -> Vector:
        """Return the mass matrix times a vector. Collective."""
        self._x.setArray(x)
        self.mass.mult(self._x, self._y)
        return np.array(self._y.array_r)
