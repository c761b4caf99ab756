"""A state of a system, evaluated: its energies, forces and tangent; for tests, with noise.

MAGSHELL_NOISE="1e-14 3" adds noise of relative size 1e-14 with the seed 3 to residual and tangent,
which imitates the rounding of another processor. Each evaluation draws new numbers. The noise of a
matrix is symmetric. No noise depends on the distribution of unknowns over ranks.
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
from magshell_fenicsx.continuation.system import Amplitudes, Beside, Skewed, Vector, Weighted

if TYPE_CHECKING:
    from magshell_fenicsx.assembly.problem import FiniteElementSystem


ASIDE = 1e-3  # the largest displacement of a difference, over h
CENTRAL = {
    1.0: 2 / 3,
    -1.0: -2 / 3,
    2.0: -1 / 12,
    -2.0: 1 / 12,
}  # multiple of a step -> weight over it of a slope

Given = TypeVar("Given")
VARIABLE = "MAGSHELL_NOISE"
Array = NDArray[np.float64]


class Evaluated:
    """A state of a system: its energies, forces and tangent.

    What is asked of it is a function of the state alone, whatever was evaluated before, and changes
    nothing that another evaluation sees. What terms find from displacement and amplitudes is shared
    by all that is asked of a state; see `following.Follows`.
    """

    def __init__(self, system: "FiniteElementSystem", u: Vector, mu: Amplitudes) -> None:
        self._system, self._u, self._mu = system, u, mu

    def of(self, function: Callable[[], Given]) -> Given:
        """What a function of the system's u, and of the placement and the numbers in forms, gives
        at the state.
        """
        self._system._put(self._u, self._mu)
        return function()

    def assembled(self, function: Callable[[], Given]) -> Given:
        """The same of a function that assembles compiled forms, which take the terms' fields as
        they are.
        """
        system = self._present
        for term in system.terms:
            if isinstance(term, FormTerm):
                term.renew()
        return function()

    def energies(self) -> dict[str, float]:
        """Each term's potential, without its amplitude."""
        system, mu = self._present, self._mu
        potentials = {t.name: float(system.comm.allreduce(t.energy())) for t in system.terms}
        if mu and system._pressed and system._pressed.load in potentials:
            potentials[system._pressed.load] += system._of_lids(mu, system._pressed.load)
        return potentials

    def stored(self) -> float:
        """The energy without the potentials of loads."""
        system, mu = self._present, self._mu
        own = (t for t in system.terms if t.amplitude is None or t.amplitude in system.coordinates)
        return float(
            system.comm.allreduce(sum(factor_of(t.amplitude, mu) * t.energy() for t in own))
        )

    def integral(self, form: fem.Form) -> float:
        """The value of a compiled form, summed over all ranks."""
        return float(self._system.comm.allreduce(self.assembled(lambda: fem.assemble_scalar(form))))

    def gradient(self, forms: Sequence[fem.Form]) -> Vector:
        """The sum of compiled linear forms over all ranks, zero at supports."""
        part: NDArray[np.float64] = np.zeros_like(self._system.u.x.array)

        def add() -> None:
            for form in forms:
                fem.assemble_vector(part, form)

        self.assembled(add)
        return self._system._summed(part)

    def summed(self, part: NDArray[np.float64]) -> Vector:
        """A vector at all nodes of this rank, ghosts too, summed over all ranks; zero at supports."""
        return self._system._summed(part)

    def residual(self, *, rough: bool = False) -> Vector:
        """dPi/du, and u itself along directions in which nodes on oblique planes are held; `rough`
        as in `Roughly`.

        The terms that are not numbers are noted in the system's `strange`.
        """
        system = self._present
        factors = system._factors(self._mu)
        if system.noise is None:
            whole = system._summed(system._gradient(factors, rough=rough))
            if not system._finite(whole.sum()):
                system.strange = self._not_numbers(factors)
        else:
            V = system.u.function_space.dofmap
            parts = [
                system._summed(system._gradient({name: factor})) for name, factor in factors.items()
            ]
            noisy = [
                system.noise.on_vector(part, V.index_map.local_range[0] * V.index_map_bs)
                for part in parts
            ]
            whole = np.asarray(np.sum(noisy, axis=0))
        return whole if system.projection is None else whole + system.projection.outside(self._u)

    def _not_numbers(self, factors: Mapping[str, float]) -> list[str]:
        """The terms whose energy or gradient is not a number, with why if they say so
        (`no_number`); collective.
        """
        system = self._system
        used = [t for t in system.terms if factors[t.name]]
        sizes = {t.name: t.energy() + system._gradient({t.name: 1.0}).sum() for t in used}
        why = {t.name: getattr(t, "no_number", "") for t in used}
        strange = [name + why[name] for name, size in sizes.items() if not system._finite(size)]
        return strange or ["the sum of all terms"]

    def forces(self, name: str = "") -> Vector:
        """dPi/du at all nodes, of all terms or of one: of all at supports the forces of these on
        the shell.
        """
        system, mu = self._present, self._mu
        part = system._gradient({name: 1.0} if name else system._factors(mu))
        if system.moving and system._pressed and not name:
            part += mu.get(system._pressed.load, 0.0) * system.moving.on_edges(system.u.x.array)
        return system._summed(part, held=False)

    def stiffness_along(self, v: Vector) -> Vector:
        """K v of all terms with the rows and columns of supports, by differences of fourth order."""
        system = self._system
        step, along = system.step_along(v, ASIDE), np.zeros(system.size)
        for way, weight in CENTRAL.items():
            system._put(self._u, self._mu)
            system.u.x.array[: system.size] += way * step * v
            system.u.x.scatter_forward()
            along += (
                weight
                / step
                * system._summed(system._gradient(system._factors(self._mu)), held=False)
            )
        return along

    def load(self, name: str, *, held: bool = True) -> Vector:
        """d2Pi/du dmu, zero at supports if `held`."""
        system = self._present
        part = system._column(self._mu, name)
        if system.moving and system._pressed and name == system._pressed.load and not held:
            part += system.moving.on_edges(system.u.x.array)
        return system._summed(part, held=held)

    def potential(self, name: str) -> float:
        """dPi/dmu, on every rank."""
        system, mu = self._present, self._mu
        if system.moving and name in system.moving.names:
            own = float(system._gradient(system._factors(mu)) @ system.moving.rate(mu, name))
            for edge, A in system.moving.turning(mu, name):
                own += float(
                    system._gradient({edge: 1.0}) @ system.moving.along(A, system.u.x.array)
                )
        else:
            slopes = system.parameters[name].slopes if name in system.parameters else ()
            own = sum(factor_of(slope.amplitude, mu) * slope.energy() for slope in slopes)
            own += sum(t.energy() for t in system.terms if t.amplitude == name)
        return float(system.comm.allreduce(own)) + system._of_lids(mu, name)

    def curvature(self, name: str, other: str) -> float:
        """d2Pi/dmu_i dmu_j of amplitudes of which one is a coordinate, on every rank."""
        system, mu = self._present, self._mu
        moving = system.moving
        if moving and {name, other} & moving.names:
            own = system._motion_curvature(
                moving, mu, *sorted((name, other), key=moving.names.__contains__)
            )
            return float(system.comm.allreduce(own)) + system._of_lids(mu, name, other)
        if name not in system.parameters:
            name, other = other, name
        parameter, own = system.parameters[name], 0.0
        own += sum(slope.energy() for slope in parameter.slopes if slope.amplitude == other)
        if other in system.parameters:
            second = system.parameters[other]
            bends = parameter.bends(second.constant)
            own += sum(factor_of(bend.amplitude, mu) * bend.energy() for bend in bends)
            own += sum(slope.energy() for slope in second.slopes if slope.amplitude == name)
        return float(system.comm.allreduce(own))

    def tangent(
        self,
        stress: Sequence[Weighted] = (),
        times: Mapping[str, float] | None = None,
        *,
        rough: bool = False,
    ) -> PETSc.Mat | Beside | Skewed:
        """d2Pi/du2, see `FiniteElementSystem.tangent`."""
        system = self._system
        with system.assembly:
            whole = [(weight, system.with_ghosts(v, self._mu)) for weight, v in stress]
            system._put(self._u, self._mu)
            factors = system._factors(self._mu)
            for name, size in (times or {}).items():
                factors[name] *= size
            return system._tangent(factors, whole, rough=rough)

    @property
    def _present(self) -> "FiniteElementSystem":
        """The system with the state's displacement and numbers in its forms."""
        self._system._put(self._u, self._mu)
        return self._system


@dataclass
class Noise:
    """Random factors 1 + level x with x between -1 and 1; each call draws the next ones."""

    level: float
    seed: int = 0
    _calls: int = field(default=0, init=False)

    @classmethod
    def from_environment(cls) -> "Noise | None":
        """The noise that the environment variable sets; None if it is not set."""
        words = os.environ.get(VARIABLE, "").split()
        return cls(float(words[0]), int(words[1]) if len(words) > 1 else 0) if words else None

    def on_vector(self, b: Array, first: int) -> Array:
        """A vector whose entries on this rank begin with the number `first`, with noise."""
        return b * self._factors(
            first + np.arange(len(b), dtype=np.uint64), np.zeros(1, dtype=np.uint64)
        )

    def on_matrix(self, K: PETSc.Mat) -> None:
        """Put noise on an assembled matrix."""
        start, columns, values = K.getValuesCSR()
        first = K.getOwnershipRange()[0]
        rows = np.repeat(np.arange(first, first + len(start) - 1), np.diff(start))
        low, high = (f(rows, columns).astype(np.uint64) for f in (np.minimum, np.maximum))
        K.setValuesCSR(start, columns, values * self._factors(low, high))
        K.assemble()

    def _factors(self, i: NDArray[np.uint64], j: NDArray[np.uint64]) -> Array:
        """Factors from a hash of the indices, the seed and the number of the call."""
        self._calls += 1
        x = i * np.uint64(0x9E3779B97F4A7C15) ^ j * np.uint64(0xC2B2AE3D27D4EB4F)
        x ^= np.uint64((self.seed * 0x165667B19E3779F9 + self._calls * 0x27D4EB2F165667C5) % 2**64)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):  # splitmix64
            x = (x ^ (x >> np.uint64(shift))) * np.uint64(factor)
        x ^= x >> np.uint64(31)
        return 1 + self.level * (x.astype(float) / 2**63 - 1)
