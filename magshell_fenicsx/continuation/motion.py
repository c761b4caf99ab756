"""A moving state, the forces that act on it, and its consistent start under a loading device.

A device holds the conjugates q of some amplitudes: g(u, mu) = dPi/dmu + q = 0. Where g depends on
its own amplitude (a gas, a body that is pressed on) that follows from u. Otherwise g constrains u:
C.v = 0 and C.a + v.(dC/du v) = 0 with the column C = dg/du, and the amplitude is the force of this
constraint.

A dot is the inner product over all ranks; y are the unknown amplitudes in units that make them like
displacements, and `device.border` returns the columns C and the matrix D = dg/dy, whose diagonal is
zero where g constrains u. v and a are velocity and acceleration, conjugates the displacements or
forces on which amplitudes do work.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any, Protocol

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.device import Device
from magshell_fenicsx.continuation.system import (
    Amplitudes,
    State,
    System,
    Tangent,
    Vector,
    dot,
    max_abs,
)

Array = NDArray[np.float64]
InverseMass = Callable[[Vector], Vector]
MAX_ITERATIONS = 20
ROUNDING = 1e-13  # of the unknowns: smaller steps are rounding
DIFFERENCE_STEP = 1e-3  # in lengths that a velocity moves the system by, for the change of C


@dataclass(frozen=True)
class Motion:
    """A moving state: displacement, velocity, acceleration and amplitudes at a time.

    Attributes
    ----------
    t
        Time.
    u, v, a
        Displacement, velocity and acceleration; this rank's parts.
    mu
        Amplitudes by name.
    work, dissipated
        Work of the loads, and of drag and viscosity, since the begin.
    potentials
        dPi/dmu of the loads, by name.
    error
        Estimated error of the last step, over the system's length.
    memory
        History variables of viscous forces: a step that is refused does not change them.
    imbalance, turnover
        Kinetic + stored + dissipated - work, less its value at the begin, and the sum of their
        magnitudes; nan where the balance is not checked.
    """

    t: float
    u: Vector
    v: Vector
    a: Vector
    mu: dict[str, float]
    work: float = 0.0
    dissipated: float = 0.0
    potentials: dict[str, float] = field(default_factory=dict)
    error: float = np.inf
    memory: Any = None
    imbalance: float = np.nan
    turnover: float = np.nan


class ViscousForces(Protocol):
    """Forces that depend on the strains along a time step. All methods are collective.

    Attributes
    ----------
    memory
        History variables of the steps up to u0; `accept` replaces them.
    creep_time
        Longest time in which the forces let a displacement creep to its end, so that errors of
        steps add up.
    """

    memory: Any
    creep_time: float

    def force(self, u0: Vector, u1: Vector, v: Vector, fraction: float, dt: float) -> Vector:
        """Return the viscous force at a fraction of the step from u0 to u1; zero at supports.

        Parameters
        ----------
        v
            The velocity at that fraction.
        fraction
            0 at the begin of the step, 1 at its end.
        dt
            Length of the step; 0 at the begin of a motion.
        """

    def tangent(self, u: Vector, mu: Amplitudes, dt: float, rate: float) -> Tangent:
        """Return the system's tangent with the derivative of the viscous force by u1.

        Parameters
        ----------
        u, mu
            The state within the step at which the tangent is taken.
        dt
            Length of the step.
        rate
            dv/du at the end of the step.
        """

    def begin(self) -> None:
        """Begin a motion, or continue it after a kink of a load."""

    def accept(self, u0: Vector, u1: Vector, dt: float) -> Vector:
        """Accept a step from u0 to u1: renew the history variables, and return the force there."""

    def error_force(self, u0: Vector, u1: Vector, dt: float) -> Vector | None:
        """Return the estimated error of the force after a step from u0 to u1; None without one."""


class AveragedContact(Protocol):
    """Contact forces, which begin and end within a step: each step takes their mean along it.

    All methods are collective.

    Attributes
    ----------
    names
        Amplitudes that are positions of touching bodies.
    settings
        Names of the stiffnesses that `stiffened_settings` may give.
    """

    names: frozenset[str]
    settings: frozenset[str]

    def stiffened_settings(self, begin: State, v: Vector) -> dict[str, float]:
        """Return the stiffnesses to raise before a step, by name.

        They belong to pairs that may meet too fast, and store no energy yet.

        Parameters
        ----------
        begin, v
            State and velocity at the begin of the step.
        """

    def average_along(self, begin: State, end: State, fraction: float) -> None:
        """Replace the system's contact forces by their mean along a step, until `use_state_forces`.

        Parameters
        ----------
        begin, end
            States at both ends of the step.
        fraction
            Fraction of the step at which the tangent of the mean forces is taken.
        """

    def use_state_forces(self) -> None:
        """Restore the contact forces of the present state, after `average_along`."""

    def penetration_message(self, begin: State, end: State) -> str:
        """Return which surfaces pass through each other in a step; empty if none do."""

    def stored_energy(self, u: Vector, mu: Amplitudes) -> float:
        """Return the energy without the potentials of loads."""


class MovingSupports(Protocol):
    """Supports that move in time as amplitudes prescribe.

    A time with `before_kink` is taken just before a kink or jump of the motion, else just after it.

    Attributes
    ----------
    names
        Amplitudes of the motions.
    """

    names: frozenset[str]

    def velocity(self, t: float, before_kink: bool) -> Vector:
        """Return the velocity at supports, zero elsewhere; at a kink before or after t."""

    def acceleration(self, t: float, before_kink: bool) -> Vector:
        """Return the acceleration at supports, zero elsewhere; at a kink before or after t."""

    def displacement_rate(self, mu: Amplitudes, name: str) -> Vector:
        """Return the derivative of the supports' displacement by an amplitude."""

    def times(self, x: Vector) -> Vector:
        """Return the mass of all nodes times a vector."""

    def zeroed_at_supports(self, x: Vector) -> Vector:
        """Return a vector with zeros at supports."""


def consistent_state(
    system: System, device: Device, inverse_mass: InverseMass, u: Vector, v: Vector, mu: Amplitudes
) -> tuple[Vector, Vector, dict[str, float]]:
    """Return the nearest displacement and velocity that a device allows, with its amplitudes.

    Newton's method solves g = 0. Where g constrains u, u moves along the mass's inverse times C, so
    that the change is the smallest in the norm of the mass; elsewhere the amplitude itself changes.
    The velocity loses its components that violate C . v = 0. Collective.

    Parameters
    ----------
    system
        The inner system, without the device.
    inverse_mass
        Solves with the mass.
    u, v, mu
        Displacement, velocity and amplitudes that need not be consistent.

    Returns
    -------
    Displacement, velocity and all amplitudes.
    """
    # each amplitude is of one of two kinds: `is_spring` where g depends on the amplitude itself,
    # else g constrains u
    y, comm = device.unknowns(mu), system.comm
    for _ in range(MAX_ITERATIONS):
        amplitudes = {**mu, **device.values(y)}
        C, D = device.border(u, amplitudes)
        X, is_spring = [inverse_mass(c) for c in C], np.diag(D) != 0
        # derivatives of g: by y for springs, for constraints by a displacement along X
        S = np.where(is_spring, D, _products(comm, C, X))
        correction = np.linalg.solve(S, device.rows(u, amplitudes))
        # y changes by the springs, u by the constraints
        y = y - np.where(is_spring, correction, 0.0)
        du = _combination(np.where(is_spring, 0.0, correction), X)
        u = u - du
        u_size = max_abs(comm, du) / system.length
        y_size = np.abs(correction[is_spring]).max(initial=0.0)
        if u_size <= ROUNDING and y_size <= ROUNDING * (1 + np.abs(y).max()):
            break
    # the component of v along each constraint, which is removed
    normal_velocity = np.where(is_spring, 0.0, [dot(comm, c, v) for c in C])
    v = v - _combination(np.where(is_spring, 0.0, np.linalg.solve(S, normal_velocity)), X)
    return u, v, {**mu, **device.values(y)}


def _products(comm: MPI.Comm, C: Sequence[Vector], X: Sequence[Vector]) -> Array:
    """Return the inner products (len(C), len(X)) of the columns C with vectors X. Collective."""
    products = [dot(comm, c, x) for c, x in product(C, X)]
    return np.array(products).reshape(len(C), len(X))


def _combination(coefficients: Array, vectors: list[Vector]) -> Vector:
    """Return the linear combination of vectors with the coefficients."""
    terms = [c * x for c, x in zip(coefficients, vectors, strict=True)]
    return np.asarray(np.sum(terms, axis=0))


def constrained_acceleration(
    system: System, device: Device, inverse_mass: InverseMass, motion: Motion
) -> tuple[Vector, dict[str, float]]:
    """Return the acceleration with the forces of a device's constraints, and all amplitudes.

    The amplitudes of constraints are their forces. They are chosen so that C . a + v . (dC/du v) =
    0 for each constraint with the column C. Collective.

    Parameters
    ----------
    system
        The inner system, without the device.
    inverse_mass
        Solves with the mass.
    motion
        The motion with the acceleration that its present amplitudes give.
    """
    C, D = device.border(motion.u, motion.mu)
    is_constraint, speed = np.diag(D) == 0, max_abs(system.comm, motion.v)
    # C a little later and earlier along the velocity; at rest it does not change
    forward, backward, dt = C, C, 1.0
    if speed:
        dt = DIFFERENCE_STEP * system.length / speed
        forward, backward = (
            device.border(motion.u + sign * dt * motion.v, motion.mu)[0] for sign in (1, -1)
        )
    X = [inverse_mass(c) for c in C]
    # rows of amplitudes with a spring stay out: identity on the left, zero on the right
    S = np.where(is_constraint, _products(system.comm, C, X), np.eye(len(C)))
    # v . (dC/du v) by a central difference along the velocity
    curvature = [
        dot(system.comm, a - b, motion.v) / (2 * dt) for a, b in zip(forward, backward, strict=True)
    ]
    violation = np.array([dot(system.comm, c, motion.a) for c in C]) + curvature
    dy = np.linalg.solve(S, np.where(is_constraint, violation, 0.0))
    dy = np.where(is_constraint, dy, 0.0)
    amplitudes = device.values(device.unknowns(motion.mu) + dy)
    return motion.a - _combination(dy, X), motion.mu | amplitudes
