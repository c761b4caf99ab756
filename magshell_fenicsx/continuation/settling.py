"""A guess far from equilibrium settles: its sharp folds relax, while its soft directions stay almost where they are.

Every step solves (K + s K0) du = -R, with the tangent K0 of the unloaded system: one implicit step of the flow
K0 du/dt = -R, of length 1/s. It goes down the energy, so its fixed points are stable equilibria.
"""

from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc

from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import State, System, Vector, dot, max_abs, symmetric_part

MOST_FACTORS = 40
BENT, EASY = 0.7, 0.2  # part of the residual that a step may leave unexplained; below the second the next is longer
CLOSE = 0.05  # in lengths of the system: a shorter step with so small a shift ends
SMALL = 0.01


@dataclass
class Settling:
    """The flow of a system from any guess.

    Parameters
    ----------
    unloaded
        A state with a positive definite tangent K0.
    """

    system: System
    unloaded: State

    def __post_init__(self) -> None:
        K = symmetric_part(self.system.tangent(self.unloaded.u, self.unloaded.mu))
        self._K0, self._shifted = K.copy(), K.copy()
        self._stiff, self._factors = Factorisation(self.system.comm), Factorisation(self.system.comm)
        self._stiff.factor(self._K0)

    def settled(self, guess: State) -> State:
        """The state after a number of steps, or near the stable equilibrium where they end."""
        system, u, shift, spent = self.system, guess.u, 1.0, 0
        residual = system.residual(u, guess.mu)
        while spent < MOST_FACTORS:
            K = symmetric_part(system.tangent(u, guess.mu)).copy()
            while spent < MOST_FACTORS:
                spent += 1
                K.copy(self._shifted, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
                self._shifted.axpy(shift, self._K0, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
                self._factors.factor(self._shifted)
                if self._factors.negative_pivots:
                    shift *= 2
                    continue
                du = -self._factors.solve(residual)
                ahead = system.residual(u + du, guess.mu)
                left = self._size(ahead + shift * self._stiff.times(du)) / self._size(residual)
                if left <= BENT:
                    u, residual = u + du, ahead
                    ends = shift < SMALL and max_abs(system.comm, du) <= CLOSE * system.length
                    shift /= 4 if left < EASY else 1
                    if ends:
                        return State(u, guess.mu)
                    break
                shift *= 3
        return State(u, guess.mu)

    def _size(self, residual: Vector) -> float:
        """The size of a residual: of the displacement that it causes, in the norm of K0."""
        return float(np.sqrt(abs(dot(self.system.comm, residual, self._stiff.solve(residual))))) or np.finfo(float).tiny
