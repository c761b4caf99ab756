"""One step in time of M a + c M v + D + dPi/du(u; mu(t)) = 0, by the generalised alpha method with
the exact tangent.

J. Chung and G. M. Hulbert, Journal of Applied Mechanics 60 (1993): second order; high frequencies
fade by the factor rho at each step. With rho = 1 the force is averaged along the step at Gauss
points, which conserves the energy (G. R. W. Quispel and D. I. McLaren, Journal of Physics A 41,
2008). PETSc's TSALPHA2 has the same formulas for rho < 1, but shows neither its acceleration,
without which a resumed run is another one, nor a place for that average.
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
    Averaged,
    Ground,
    Motion,
    Viscous,
    constrained,
    held_back,
)
from magshell_fenicsx.continuation.snes import MOTION
from magshell_fenicsx.continuation.system import (
    Amplitudes,
    Beside,
    Edged,
    Skewed,
    State,
    System,
    Tangent,
    Vector,
    dot,
    max_abs,
)

# of u in a step, over the system's length or, where that is longer, a tenth of the displacement
TOLERANCE = 1e-10
FLOOR = 1e-3  # of the length: energies below that of such a displacement count as none
STALLED = 1e-7  # steps below this that shrink no more, with new factors, may be rounding
ROUNDED = 10.0  # steps up to this many times the rounding error are
MOST = 20  # iterations
FAR = 3.0  # lengths: a step that is longer, and than the first one, does not come back
PATIENCE = 2  # steps with new factors that may grow beside a body: they find what touches
SLOW = 0.2  # new factors if a step is longer than this part of the one before
# error of the last step up to which the acceleration predicts the next: in stiff motions it
# alternates
SMOOTH = 1e-2
# changes of the acceleration times the square of the time step, from iterations that end at
# TOLERANCE
ROUNDING = 1e-8
OTHER = 0.05  # relative change of the time step after which factors are renewed
GAUSS = (
    (0.5 - np.sqrt(1 / 12), 0.5),
    (0.5 + np.sqrt(1 / 12), 0.5),
)  # exact for the membrane's energy, of degree 4
Array = NDArray[np.float64]
Loads = Callable[[float, bool], dict[str, float]]  # mu(t), at a jump before or after it


@dataclass(frozen=True)
class Rule:
    """The parameters of generalised alpha; forces are weighted sums at parts of the step."""

    alpha_m: float
    alpha_f: float
    beta: float
    gamma: float
    forces: tuple[tuple[float, float], ...]

    @classmethod
    def of(cls, rho: float) -> "Rule":
        """Of a spectral radius at infinite frequency, 0 to 1."""
        m, f = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
        at = GAUSS if rho == 1 else ((1 - f, 1.0),)
        return cls(m, f, (1 - m + f) ** 2 / 4, 0.5 - m + f, at)


@dataclass(frozen=True)
class Factored:
    """What the latest factors belong to, and the `Factorisation.habit` with which they were made."""

    u: Vector
    mu: dict[str, float]
    dt: float
    habit: int


class Integrator:
    """Makes steps in time; factors are kept while they serve.

    Parameters
    ----------
    mass
        Its pattern is part of that of the tangent; zero rows and columns at supports.
    loads
        All amplitudes; at a jump the step before it ends with the value before.
    drag
        c, force per mass and velocity.
    viscous
        Further forces.
    driven
        Amplitudes that are positions and move.
    ground
        Supports that move.
    averaged
        Contacts, beside which the balance of energy is checked in each step.
    device
        Amplitudes that are unknown, since their conjugates are held at the end of each step; None:
        all are loads.

    Attributes
    ----------
    steps, iterations
        Work so far.
    factored
        What the latest factors belong to; None if the next step makes new ones.
    """

    def __init__(
        self,
        system: System,
        mass: PETSc.Mat,
        loads: Loads,
        rho: float,
        drag: float = 0.0,
        viscous: Viscous | None = None,
        driven: Collection[str] = (),
        device: Device | None = None,
        ground: Ground | None = None,
        averaged: Averaged | None = None,
    ) -> None:
        self.system, self.mass, self.loads, self.drag, self.viscous = (
            system,
            mass,
            loads,
            drag,
            viscous,
        )
        self.rule = Rule.of(rho)
        self.ground, self.averaged, self._total = ground, averaged, np.nan
        self.device, self._free = device, tuple(device.names) if device else ()
        self._driven = frozenset({*driven, *self._free})
        self.factorisation = Factorisation(system.comm)
        self.steps = self.iterations = 0
        self._K: PETSc.Mat | None = (
            None  # of the pattern of another one, which contact of shells changes
        )
        self._like: PETSc.Mat | None = None
        self.factored: Factored | None = None
        self._x, self._y = mass.createVecs()
        # what a state has from its history: turns of edges under moments, whose work is counted on
        self._advance: Callable[[State, Amplitudes], State] = getattr(
            system, "advance", lambda state, before: state
        )

    def begin(self, t: float, u: Vector, v: Vector, before: Motion | None = None) -> Motion:
        """A motion with the acceleration that the loads after t give it; sums go on from those of
        `before`.

        What a device constrains is put where it must be, along the forces of the constraint, and so
        is its velocity.
        """
        mu = self.loads(t, False)
        work, dissipated = (before.work, before.dissipated) if before else (0.0, 0.0)
        if before:
            mu |= {name: before.mu[name] for name in self._free} | self._kept(before)
        inverse = self._inverse_mass()
        if (
            self.ground
        ):  # a jump of its velocity is an impulse, whose work is the change of the kinetic energy
            work -= self._kinetic(v, t, True)
            v = v - inverse(
                self._pulled(self.ground.velocity(t, False) - self.ground.velocity(t, True))
            )
            work += self._kinetic(v, t, False)
        if self.device:
            u, v, mu = constrained(self.system, self.device, inverse, u, v, mu)
        mu = self._advance(State(u, mu), before.mu if before else mu).mu
        if self.viscous:
            self.viscous.memory = before.memory if before else self.viscous.memory
            self.viscous.begin()
        r = self.system.residual(u, mu) + self.drag * self._times(v)
        if self.ground:
            r = r + self._pulled(
                self.ground.acceleration(t, False) + self.drag * self.ground.velocity(t, False)
            )
        if self.viscous:
            r = r + self.viscous.force(u, u, v, 1.0, 0.0)
        a = -inverse(r)
        if self.device:
            a, mu = held_back(self.system, self.device, inverse, Motion(t, u, v, a, mu))
        now = Motion(t, u, v, a, mu, work, dissipated, memory=self.viscous and self.viscous.memory)
        if self.averaged and not before:
            self._total = self.kinetic(now) + self.averaged.stored(u, mu)
        return self.balanced(replace(now, potentials=self._potentials(now, False)))

    def jumps(self, t: float) -> bool:
        """Whether a motion begins anew at a kink or jump of the loads.

        Beside a body it does not at a kink: the acceleration is continuous, and that of what is
        left of the residual would be large where the contact is stiff.
        """
        return (
            not self.averaged
            or self.ground is not None
            or self.loads(t, True) != self.loads(t, False)
        )

    def balanced(self, now: Motion) -> Motion:
        """The motion with its imbalance, where that is checked."""
        if not self.averaged:
            return now
        entries = self.kinetic(now), self.averaged.stored(now.u, now.mu), now.dissipated, -now.work
        return replace(
            now,
            imbalance=sum(entries) - self._total,
            turnover=sum(map(abs, entries)) + (FLOOR * self.system.length) ** 2,
        )

    def _inverse_mass(self) -> Callable[[Vector], Vector]:
        M = self.mass.copy()
        massless = M.getDiagonal()
        massless.setArray((massless.array_r == 0).astype(float))
        M.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
        M.setOption(PETSc.Mat.Option.IGNORE_ZERO_ENTRIES, False)
        M.setDiagonal(massless, PETSc.InsertMode.ADD_VALUES)
        M.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        factors = Factorisation(self.system.comm)
        factors.factor(M)
        return factors.solve

    def kinetic(self, now: Motion) -> float:
        """v . M v/2 on all ranks, with the velocity of supports."""
        return self._kinetic(now.v, now.t, True)

    def _kinetic(self, v: Vector, t: float, before: bool) -> float:
        if self.ground is None:
            return dot(self.system.comm, v, self._times(v)) / 2
        v = v + self.ground.velocity(t, before)
        return dot(self.system.comm, v, self.ground.times(v)) / 2

    def _pulled(self, x: Vector) -> Vector:
        """The mass times a vector of supports, at all other nodes."""
        assert self.ground
        return self.ground.held(self.ground.times(x))

    def step(self, now: Motion, dt: float) -> Motion | str:
        """The motion after a step; else the reason why there is none."""
        if self.averaged:
            v = now.v + self.ground.velocity(now.t, False) if self.ground else now.v
            now = replace(now, mu=now.mu | self.averaged.harder(State(now.u, now.mu), v))
        try:
            return self._step(now, dt)
        except np.linalg.LinAlgError:
            return "a body whose force is held has left the shell, and has no mass"
        finally:
            if self.averaged:
                self.averaged.present()

    def _step(self, now: Motion, dt: float) -> Motion | str:
        comm = self.system.comm
        if self.viscous:
            self.viscous.memory = now.memory
        u = now.u + dt * now.v
        if now.error < SMOOTH:
            u = u + dt**2 / 2 * now.a
        y = self.device.unknowns(now.mu) if self.device else np.empty(0)
        pull = self._pull(now, dt)
        last, first, fresh, grown = np.inf, np.inf, False, 0
        if self.factored is None or abs(dt - self.factored.dt) > OTHER * dt:
            self._factor(now, u, y, dt)
            fresh = True
        chord = self._chord()
        for _ in range(MOST):
            a, v = self._rates(now, u, dt)
            step = chord.step(pull + self._unbalanced(now, u, y, v, a, dt))
            chord.took(step)
            d, dy = split(step, y.size, comm)
            u, y = u - d, y - dy
            self.iterations += 1
            size = max_abs(comm, d) / self.system.length
            if not np.isfinite(size):
                return "the step is not a number"
            tolerance = TOLERANCE * max(1.0, MOTION * max_abs(comm, u) / self.system.length)
            stalled = size <= STALLED and size > last / 2 and fresh
            if size <= tolerance or (stalled and size <= ROUNDED * self._rounding(now, u, y, dt)):
                end = State(u, self._at(now, y, 1.0, dt))
                if self.averaged and (passed := self.averaged.passes(State(now.u, now.mu), end)):
                    return passed
                self.steps += 1
                return self._accepted(now, u, y, dt)
            if size > SLOW * last:
                grown = grown + 1 if fresh and size > last else 0
                if grown > (PATIENCE if self.averaged else 0) or (fresh and size > max(FAR, first)):
                    break
                self._factor(now, u, y, dt)
                fresh, chord = True, self._chord()
            last, first = size, size if first == np.inf else first
        self.factored = None
        return "Newton's method does not converge"

    def _chord(self) -> Chord[Vector]:
        """The latest factors, which Broyden's update carries from iterate to iterate."""
        comm = self.system.comm
        return Chord(
            self.factorisation.solve, partial(dot, comm), lambda a, factor, b: a + factor * b
        )

    def _pull(self, now: Motion, dt: float) -> Vector:
        """The forces of inertia and drag by moving supports in a step, with zeros for unknown
        amplitudes.
        """
        pull, ground, end = 0.0 * now.u, self.ground, now.t + dt
        if ground:
            m, f = self.rule.alpha_m, self.rule.alpha_f
            a = (1 - m) * ground.acceleration(end, True) + m * ground.acceleration(now.t, False)
            v = (1 - f) * ground.velocity(end, True) + f * ground.velocity(now.t, False)
            pull = self._pulled(a + self.drag * v)
        return self.device.padded(pull) if self.device else pull

    def _rates(self, now: Motion, u: Vector, dt: float) -> tuple[Vector, Vector]:
        """Acceleration and velocity at the end of a step to u (Newmark)."""
        beta, gamma = self.rule.beta, self.rule.gamma
        a = (u - now.u - dt * now.v) / (beta * dt**2) - (0.5 / beta - 1) * now.a
        return a, now.v + dt * ((1 - gamma) * now.a + gamma * a)

    def _at(self, now: Motion, y: Array, part: float, dt: float) -> dict[str, float]:
        """Amplitudes at a part of a step; unknown ones and places of supports grow evenly, as
        displacements do.
        """
        mu = self.loads(now.t + part * dt, True)
        ends = self.device.values(y) if self.device else {}
        if self.ground:
            last = self.loads(now.t + dt, True)
            ends |= {name: last[name] for name in self.ground.names & set(mu)}
        return (
            mu
            | self._kept(now)
            | {n: now.mu[n] + part * (end - now.mu[n]) for n, end in ends.items()}
        )

    def _kept(self, now: Motion) -> dict[str, float]:
        """The stiffnesses of contacts, which a motion raises and keeps."""
        return (
            {name: now.mu[name] for name in self.averaged.settings & set(now.mu)}
            if self.averaged
            else {}
        )

    def _unbalanced(
        self, now: Motion, u: Vector, y: Array, v: Vector, a: Vector, dt: float
    ) -> Vector:
        rule = self.rule
        m, f = rule.alpha_m, rule.alpha_f
        self._average(now, u, y, dt)
        r = self._times((1 - m) * a + m * now.a + self.drag * ((1 - f) * v + f * now.v))
        for part, weight in rule.forces:
            r = r + weight * self.system.residual(
                now.u + part * (u - now.u), self._at(now, y, part, dt)
            )
        if self.viscous:
            r = r + self.viscous.force(now.u, u, (1 - f) * v + f * now.v, 1 - f, dt)
        if self.device is None:
            return r
        if self.averaged:
            self.averaged.present()
        return join(r, (1 - f) * self.device.rows(u, self._at(now, y, 1.0, dt)), self.system.comm)

    def _average(self, now: Motion, u: Vector, y: Array, dt: float) -> None:
        if self.averaged:
            end = State(u, self._at(now, y, 1.0, dt))
            self.averaged.along(State(now.u, now.mu), end, 1 - self.rule.alpha_f)

    def _rounding(self, now: Motion, u: Vector, y: Array, dt: float) -> float:
        """The size of a step that rounding of the forces makes, from their change when u is rounded
        differently.
        """
        side = np.random.default_rng(self.system.comm.rank).choice([-1.0, 1.0], u.size)

        def unbalanced(u: Vector) -> Vector:
            a, v = self._rates(now, u, dt)
            return self._unbalanced(now, u, y, v, a, dt)

        change = unbalanced(u + side * np.spacing(u)) - unbalanced(u)
        d, _ = split(self.factorisation.solve(change), y.size, self.system.comm)
        return max_abs(self.system.comm, d) / self.system.length

    def _factor(self, now: Motion, u: Vector, y: Array, dt: float) -> None:
        """Factor the derivative of `_unbalanced` by u and y, with one tangent for all parts of the
        step.
        """
        part = 1 - self.rule.alpha_f
        between, mu = now.u + part * (u - now.u), self._at(now, y, part, dt)
        self._average(now, u, y, dt)
        self.factor(Factored(between, mu, dt, self.factorisation.habit))

    def factor(self, at: Factored) -> None:
        """Make these factors."""
        self.factorisation.habit = at.habit
        rule, part, u, mu, dt = self.rule, 1 - self.rule.alpha_f, at.u, at.mu, at.dt
        rate = rule.gamma / (rule.beta * dt)
        tangent = (
            self.viscous.tangent(u, mu, dt, rate) if self.viscous else self.system.tangent(u, mu)
        )
        assert not isinstance(tangent, Edged)
        K = tangent.K if isinstance(tangent, Skewed | Beside) else tangent
        if self._like is None or self._K is None or self._like.handle != K.handle:
            self._like, self._K = K, K.duplicate()
            self._K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        K.copy(self._K, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self._K.scale(part)
        inertia = (1 - rule.alpha_m) / (rule.beta * dt**2) + self.drag * part * rate
        self._K.axpy(inertia, self.mass, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        whole: Tangent = (
            Skewed(self._K, part * tangent.N) if isinstance(tangent, Skewed) else self._K
        )
        if isinstance(tangent, Beside):
            whole = Beside(self._K, tangent.D.scaled(part))
        if self.device:
            C, D = self.device.edge(u, mu)
            self.factorisation.factor(
                Edged(whole, [part * c for c in C], part * D, self.device.multipliers)
            )
        else:
            self.factorisation.factor(whole)
        self.factored = at

    def _accepted(self, now: Motion, u: Vector, y: Array, dt: float) -> Motion:
        comm, rule, t = self.system.comm, self.rule, now.t + dt
        a, v = self._rates(now, u, dt)
        mu = self._advance(State(u, self._at(now, y, 1.0, dt)), now.mu).mu
        after, mean = Motion(t, u, v, a, mu), dict[str, float]()
        beside = (
            self.averaged.names | (self.ground.names if self.ground else frozenset())
            if self.averaged
            else ()
        )
        if self.averaged and (moving := self._driven.intersection(beside)):
            self._average(now, u, y, dt)
            mean = {name: self._mean(name, now, after, y, dt) for name in moving}
            self.averaged.present()
        potentials, moved, w = (
            self._potentials(after, True),
            u - now.u,
            (1 - rule.alpha_f) * v + rule.alpha_f * now.v,
        )
        work = sum(self._work(name, now, mu, potentials, mean.get(name)) for name in potentials)
        if self.ground and self.drag:
            ends = self.ground.velocity(now.t, False), self.ground.velocity(t, True)
            along, w = (
                moved + dt / 2 * (ends[0] + ends[1]),
                w + (1 - rule.alpha_f) * ends[1] + rule.alpha_f * ends[0],
            )
            lost = self.drag * dot(comm, along, self.ground.times(w))
        else:
            lost = self.drag * dot(comm, moved, self._times(w)) if self.drag else 0.0
        error = self._error(now, after, dt)
        if self.viscous:
            lost += dot(comm, moved, self.viscous.accept(now.u, u, dt))
        memory, dissipated = self.viscous and self.viscous.memory, now.dissipated + lost
        after = replace(after, work=now.work + work, dissipated=dissipated, memory=memory)
        return self.balanced(replace(after, potentials=potentials, error=error))

    def _error(self, now: Motion, after: Motion, dt: float) -> float:
        """Estimated error of a step, over the system's length."""
        comm, of = self.system.comm, self.system.length
        change = max_abs(comm, after.a - now.a)
        error = abs(self.rule.beta - 1 / 6) * dt**2 * change / of
        if self.viscous is None:
            return error
        if (
            self.viscous.slowness > dt and dt**2 * change > ROUNDING * of
        ):  # errors add up in the motion's own time
            most = max(max_abs(comm, after.a), change)
            error *= max(
                1.0, min(self.viscous.slowness, max_abs(comm, after.v) / max(most, 1e-300)) / dt
            )
        doubt = self.viscous.doubt(now.u, after.u, dt)
        if doubt is not None:
            whole = self.device.padded(doubt) if self.device else doubt
            d = self.factorisation.solve((1 - self.rule.alpha_f) * whole)
            error = max(error, max_abs(comm, split(d, len(self._free), comm)[0]) / of)
        return error

    def _potentials(self, now: Motion, before: bool) -> dict[str, float]:
        """dPi/dmu of the loads; of supports that move with the forces of inertia and drag."""
        mu, still = now.mu, (self.system.coordinates - self._driven) | set(self._kept(now))
        potentials = {
            name: self.system.potential(now.u, mu, name) for name in mu if name not in still
        }
        if self.ground:
            a = now.a + self.ground.acceleration(now.t, before)
            forces = self.ground.times(
                a + self.drag * (now.v + self.ground.velocity(now.t, before))
            )
            for name in self._driven & self.ground.names:
                potentials[name] += dot(self.system.comm, forces, self.ground.along(mu, name))
        return potentials

    def _mean(self, name: str, now: Motion, after: Motion, y: Array, dt: float) -> float:
        """The force on what moves beside a contact in a step, as the step has it; of supports with
        that of inertia.
        """
        ground, m, f, force = self.ground, self.rule.alpha_m, self.rule.alpha_f, 0.0
        for part, weight in self.rule.forces:
            place = now.u + part * (after.u - now.u), self._at(now, y, part, dt)
            force += weight * self.system.potential(*place, name)
        if ground and name in ground.names:
            ends = (after, after.t, True), (now, now.t, False)
            a, before = (each.a + ground.acceleration(t, side) for each, t, side in ends)
            v, old = (each.v + ground.velocity(t, side) for each, t, side in ends)
            pull = (1 - m) * a + m * before + self.drag * ((1 - f) * v + f * old)
            along = ground.along(self._at(now, y, 1 - f, dt), name)
            force += dot(self.system.comm, ground.times(pull), along)
        return force

    def _work(
        self,
        name: str,
        now: Motion,
        mu: Mapping[str, float],
        potentials: Mapping[str, float],
        mean: float | None,
    ) -> float:
        """In a step: of a load on its displacement, of a position that moves on what it meets, with
        its mean force.
        """
        a, b = now.potentials[name], potentials[name]
        if name in self.system.coordinates:
            return ((a + b) / 2 if mean is None else mean) * (mu[name] - now.mu[name])
        return -(now.mu[name] + mu[name]) / 2 * (b - a)

    def _times(self, x: Vector) -> Vector:
        self._x.setArray(x)
        self.mass.mult(self._x, self._y)
        return np.array(self._y.array_r)
