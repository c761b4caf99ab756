"""A switch for tests: relative noise in residual and tangent, which imitates the rounding of another processor.

MAGSHELL_NOISE="1e-14 3" adds noise of relative size 1e-14 with the seed 3. Each evaluation draws new numbers. The noise
of a matrix is symmetric. No noise depends on the distribution of unknowns over ranks.
"""

import os
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

VARIABLE = "MAGSHELL_NOISE"
Array = NDArray[np.float64]


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
        return b * self._factors(first + np.arange(len(b), dtype=np.uint64), np.zeros(1, dtype=np.uint64))

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
