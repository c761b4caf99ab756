"""A finite-element system at one state: its energies, forces and tangent; noise for tests.

MAGSHELL_NOISE="1e-14 3" adds noise of relative size 1e-14 with the seed 3 to residual and tangent,
which imitates the rounding of another processor. Each evaluation draws new numbers. The noise of a
matrix is symmetric. No noise depends on the distribution of unknowns over ranks.

The energy is a sum of terms mu_i Pi_i(u); mu_i are amplitudes (load parameters, and numbers as
prescribed positions) by name, factors their values. Coordinates are the amplitudes that do not just
multiply terms: `moving` ones move supports, free parameters p enter the terms, with dPi/dp as
`slopes`. A lid is a surface that closes a moving edge under a live pressure; the volume that it
sweeps belongs to the pressure's potential. Own nodes belong to this
rank, ghosts to others.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.terms import FormTerm, factor_of
from magshell_fenicsx.continuation.system import (
    Amplitudes,
    SkewedTangent,
    Vector,
    WeightedDisplacement,
)

if TYPE_CHECKING:
    from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem


# Largest displacement of a step for differences of forces, over the system's length.
DIFFERENCE_STEP = 1e-3

# Multiple of a step -> weight of the first derivative times the step, of fourth order.
DIFFERENCE_WEIGHTS = {1.0: 2 / 3, -1.0: -2 / 3, 2.0: -1 / 12, -2.0: 1 / 12}

Result = TypeVar("Result")
NOISE_VARIABLE = "MAGSHELL_NOISE"
Array = NDArray[np.float64]


class Evaluation:
    """Energies, forces and tangent of a system at one state.

    All values are functions of the state alone, whatever was evaluated before, and an evaluation
    changes nothing that another one sees. Results that terms compute from displacement and
    amplitudes are shared by all evaluations of a state; see `memo.Memo`.

    The system's private methods do the work on its local vectors, which have ghosts: `_put` writes
    a state into the forms, `_factors` gives each term's factor at some amplitudes, `_gradient` this
    rank's part of a weighted sum of dPi_i/du, and `_column` that of d2Pi/du dmu. `_summed` sums
    such parts over the ranks, and makes the result zero at supports unless told otherwise.

    Parameters
    ----------
    u, mu
        The state: displacement of own unknowns, and amplitudes by name.
    """

    def __init__(self, system: "FiniteElementSystem", u: Vector, mu: Amplitudes) -> None:
        self._system, self._u, self._mu = system, u, mu

    def evaluate(self, function: Callable[[], Result]) -> Result:
        """Return the result of a function, called with the system at the state.

        The function may read the system's u, the placement and the constants in forms.
        """
        self._system._put(self._u, self._mu)
        return function()

    def evaluate_forms(self, function: Callable[[], Result]) -> Result:
        """Return the result of a function that assembles compiled forms, called at the state.

        Compiled forms take the fields of terms as they are, so these are renewed before.
        """
        for term in self._system_at_state.terms:
            if isinstance(term, FormTerm):
                term.renew()
        return function()

    def energies(self) -> dict[str, float]:
        """Return the potential Pi_i of each term by name, without its amplitude. Collective.

        The potential of a live pressure includes the volume that lids sweep.
        """
        system, mu = self._system_at_state, self._mu
        potentials = {t.name: float(system.comm.allreduce(t.energy())) for t in system.terms}
        # with amplitudes supports move, and lids sweep a volume
        pressure = system.edge_pressure if mu else None
        if pressure and pressure.load in potentials:
            potentials[pressure.load] += system.lid_potential(mu, pressure.load)
        return potentials

    def stored_energy(self) -> float:
        """Return the energy without the potentials of loads, on every rank. Collective.

        It is the sum of the terms without an amplitude, or with one that is a coordinate.
        """
        system, mu = self._system_at_state, self._mu
        local = sum(
            factor_of(t.amplitude, mu) * t.energy()
            for t in system.terms
            if t.amplitude is None or t.amplitude in system.coordinates
        )
        return float(system.comm.allreduce(local))

    def integral(self, form: fem.Form) -> float:
        """Return the value of a compiled form, summed over all ranks. Collective."""
        local = self.evaluate_forms(lambda: fem.assemble_scalar(form))
        return float(self._system.comm.allreduce(local))

    def gradient(self, forms: Sequence[fem.Form]) -> Vector:
        """Return the sum of compiled linear forms at the state, zero at supports. Collective."""
        local: NDArray[np.float64] = np.zeros_like(self._system.u.x.array)

        def add() -> None:
            """Add this rank's part of each form."""
            for form in forms:
                fem.assemble_vector(local, form)

        self.evaluate_forms(add)
        return self._system._summed(local)

    def summed(self, local: NDArray[np.float64]) -> Vector:
        """Return a vector of local nodes, ghosts too, summed over all ranks; zero at supports.

        The result has own unknowns only. Collective.
        """
        return self._system._summed(local)

    def residual(self) -> Vector:
        """Return dPi/du at own unknowns, zero at supports. Collective.

        Along directions in which oblique supports hold nodes it is u itself, so that u is zero
        there in equilibrium. If the residual is not finite, the names of the terms to blame are put
        into the system's `nan_terms`.
        """
        system = self._system_at_state
        factors = system._factors(self._mu)
        if system.noise is None:
            residual = system._summed(system._gradient(factors))
            if not system._finite(residual.sum()):
                system.nan_terms = self._nan_terms(factors)
        else:
            residual = self._noisy_residual(system.noise, factors)
        if system.projection is None:
            return residual
        return residual + system.projection.constrained_part(self._u)

    def _noisy_residual(self, noise: "Noise", factors: Mapping[str, float]) -> Vector:
        """Return the residual as a sum of terms, each with noise of its own. Collective.

        So the noise is of the size of rounding in large terms, even where these cancel.

        Parameters
        ----------
        factors
            Term name -> its factor.
        """
        system = self._system
        dofmap = system.u.function_space.dofmap
        first_unknown = dofmap.index_map.local_range[0] * dofmap.index_map_bs
        gradients = [
            system._summed(system._gradient({name: factor})) for name, factor in factors.items()
        ]
        noisy_gradients = [noise.on_vector(gradient, first_unknown) for gradient in gradients]
        return np.asarray(np.sum(noisy_gradients, axis=0))

    def _nan_terms(self, factors: Mapping[str, float]) -> list[str]:
        """Return the names of the terms whose energy or gradient is not a number. Collective.

        A term may say why, in its attribute `no_number`, which follows its name.

        Parameters
        ----------
        factors
            Term name -> its factor; terms with the factor zero do not count.
        """
        system = self._system
        used = [t for t in system.terms if factors[t.name]]
        # this sum is not a number if the energy or an entry of the gradient is none
        sums = {t.name: t.energy() + system._gradient({t.name: 1.0}).sum() for t in used}
        reasons = {t.name: getattr(t, "no_number", "") for t in used}
        names = [name + reasons[name] for name, total in sums.items() if not system._finite(total)]
        return names or ["the sum of all terms"]

    def forces(self, name: str = "") -> Vector:
        """Return dPi/du at all own nodes, supports too. Collective.

        With all terms, its values at supports are the forces of the supports on the shell.

        Parameters
        ----------
        name
            Name of a single term, without its amplitude; "": all terms with their amplitudes.
        """
        system, mu = self._system_at_state, self._mu
        local = system._gradient({name: 1.0} if name else system._factors(mu))
        # the live pressure acts on moving edges, too
        edge_pressure = None if name else system.edge_pressure
        if system.moving and edge_pressure:
            pressure = mu.get(edge_pressure.load, 0.0)
            local += pressure * system.moving.edge_forces(system.u.x.array)
        return system._summed(local, constrained=False)

    def stiffness_along(self, v: Vector) -> Vector:
        """Return K v of all terms, not zero at supports, by differences of fourth order.

        Collective.
        """
        system = self._system
        step, product = system.step_along(v, DIFFERENCE_STEP), np.zeros(system.size)
        for multiple, weight in DIFFERENCE_WEIGHTS.items():
            # the state again, so that nodes that move have their displacement
            system._put(self._u, self._mu)
            system.u.x.array[: system.size] += multiple * step * v
            system.u.x.scatter_forward()
            gradient = system._gradient(system._factors(self._mu))
            product += weight / step * system._summed(gradient, constrained=False)
        return product

    def load(self, name: str, *, constrained: bool = True) -> Vector:
        """Return d2Pi/du dmu of the amplitude `name`. Collective.

        Parameters
        ----------
        constrained
            Whether it is zero at supports.
        """
        system = self._system_at_state
        column = system._column(self._mu, name)
        edge_pressure = None if constrained else system.edge_pressure
        acts_on_edges = edge_pressure and name == edge_pressure.load
        if system.moving and acts_on_edges:
            column += system.moving.edge_forces(system.u.x.array)
        return system._summed(column, constrained=constrained)

    def potential(self, name: str) -> float:
        """Return dPi/dmu of the amplitude `name`, on every rank. Collective.

        The amplitude moves supports, is a free parameter, or multiplies terms.
        """
        system, mu = self._system_at_state, self._mu
        moving = system.moving
        if moving and name in moving.names:
            local = float(system._gradient(system._factors(mu)) @ moving.rate(mu, name))
            # the normal of a clamped edge turns too, which acts like the displacement A r: the
            # forces of the edge's term, named `edge`, do work along it
            for edge, A in moving.turning(mu, name):
                spin = moving.spin_displacement(A, system.u.x.array)
                local += float(system._gradient({edge: 1.0}) @ spin)
        else:
            # the derivatives dPi_i/dp by a free parameter, then the terms that mu multiplies
            slopes = system.parameters[name].slopes if name in system.parameters else ()
            local = sum(factor_of(slope.amplitude, mu) * slope.energy() for slope in slopes)
            local += sum(t.energy() for t in system.terms if t.amplitude == name)
        return float(system.comm.allreduce(local)) + system.lid_potential(mu, name)

    def curvature(self, name: str, other: str) -> float:
        """Return d2Pi/dmu_i dmu_j of the amplitudes `name` and `other`, on every rank. Collective.

        One of the two is a coordinate of the system: it moves supports or is a free parameter.
        """
        system, mu = self._system_at_state, self._mu
        moving = system.moving
        if moving and {name, other} & moving.names:
            # an amplitude that moves supports comes last: False sorts first
            any_amplitude, motion = sorted((name, other), key=moving.names.__contains__)
            local = system._motion_curvature(moving, mu, any_amplitude, motion)
            return float(system.comm.allreduce(local)) + system.lid_potential(mu, name, other)
        # no amplitude moves supports. The two are exchanged if need be, so that `name` is a free
        # parameter; `other` is one too, or it multiplies terms
        if name not in system.parameters:
            name, other = other, name
        parameter, local = system.parameters[name], 0.0
        # terms whose amplitude is the other one
        local += sum(slope.energy() for slope in parameter.slopes if slope.amplitude == other)
        if other in system.parameters:
            # second derivatives d2Pi_i/dp dq by both parameters
            second = system.parameters[other]
            derivatives = parameter.second_derivatives(second.constant)
            local += sum(factor_of(d.amplitude, mu) * d.energy() for d in derivatives)
            # terms whose amplitude is the first parameter
            local += sum(slope.energy() for slope in second.slopes if slope.amplitude == name)
        return float(system.comm.allreduce(local))

    def tangent(
        self,
        stress: Sequence[WeightedDisplacement] = (),
        times: Mapping[str, float] | None = None,
    ) -> PETSc.Mat | SkewedTangent:
        """Assemble d2Pi/du2 at the state. Collective.

        Parameters
        ----------
        stress
            Weighted displacements of own nodes, whose stress replaces that of u.
        times
            Term name -> further factor of its tangent; None: no further factors.
        """
        system = self._system
        with system.assembly:
            # with ghosts, and with the displacement E(mu) of nodes that move
            local_stress = [(weight, system.with_ghosts(v, self._mu)) for weight, v in stress]
            system._put(self._u, self._mu)
            factors = system._factors(self._mu)
            for name, further_factor in (times or {}).items():
                factors[name] *= further_factor
            return system._tangent(factors, local_stress)

    @property
    def _system_at_state(self) -> "FiniteElementSystem":
        """The system with the state's displacement and numbers in its forms."""
        self._system._put(self._u, self._mu)
        return self._system


@dataclass
class Noise:
    """Random factors 1 + level x with x between -1 and 1; each call draws the next ones.

    Attributes
    ----------
    level
        Relative size of the noise.
    seed
        Runs with the same seed draw the same factors.

    The private field `_calls` counts the calls, each of which draws other factors.
    """

    level: float
    seed: int = 0
    _calls: int = field(default=0, init=False)

    @classmethod
    def from_environment(cls) -> "Noise | None":
        """Return the noise that the environment variable sets; None if it is not set."""
        words = os.environ.get(NOISE_VARIABLE, "").split()  # the level and the seed
        if not words:
            return None
        return cls(float(words[0]), int(words[1]) if len(words) > 1 else 0)

    def on_vector(self, b: Array, first: int) -> Array:
        """Return a vector of own entries with noise.

        Parameters
        ----------
        first
            Global number of this rank's first entry.
        """
        # factors follow from global numbers of rows, whatever the distribution; the column is 0
        rows = first + np.arange(len(b), dtype=np.uint64)
        return b * self._factors(rows, np.zeros(1, dtype=np.uint64))

    def on_matrix(self, K: PETSc.Mat) -> None:
        """Multiply the entries of an assembled matrix by random factors, in place. Collective.

        Entries at i, j and j, i get the same factor.
        """
        starts, columns, values = K.getValuesCSR()
        first_row = K.getOwnershipRange()[0]
        rows = np.repeat(np.arange(first_row, first_row + len(starts) - 1), np.diff(starts))
        low, high = (choose(rows, columns).astype(np.uint64) for choose in (np.minimum, np.maximum))
        K.setValuesCSR(starts, columns, values * self._factors(low, high))
        K.assemble()

    def _factors(self, i: NDArray[np.uint64], j: NDArray[np.uint64]) -> Array:
        """Return random factors from a hash of the indices, the seed and the number of the call.

        Parameters
        ----------
        i, j
            Indices of the entries; arrays that broadcast.
        """
        self._calls += 1
        x = i * np.uint64(0x9E3779B97F4A7C15) ^ j * np.uint64(0xC2B2AE3D27D4EB4F)
        x ^= np.uint64((self.seed * 0x165667B19E3779F9 + self._calls * 0x27D4EB2F165667C5) % 2**64)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):  # splitmix64
            x = (x ^ (x >> np.uint64(shift))) * np.uint64(factor)
        x ^= x >> np.uint64(31)
        # the 64 bits as a number from -1 to 1
        return 1 + self.level * (x.astype(float) / 2**63 - 1)
