"""A field that rigid motions carry and factors multiply, with its derivatives by their amplitudes.

A motion with the velocity w(x) = A x + v carries a field B along: dB/dmu = A B - G w, with the
gradient G of B. Its own gradient needs the second derivatives H of B. So place and angle of a
source need no derivatives but those of the field.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.rigid_motion import RigidMotion, apply_motions

Array = NDArray[np.float64]
Velocity = tuple[Array, Array]  # A, v of w(x) = A x + v
# places (n, 3) over R -> B (n, 3), dB_i/dx_j (n, 3, 3), d2B_i/dx_j dx_k (n, 3, 3, 3), over the
# field's magnitude
FieldInSpace = Callable[[Array], tuple[Array, Array, Array]]


@dataclass(frozen=True)
class MovingField:
    """A field that some amplitudes drive.

    Attributes
    ----------
    of
        The field where all amplitudes are zero.
    motions
        Translations and rotations, carried out one after the other; none is both.
    factors
        Amplitude -> change of the factor of the field for an amplitude of one.
    """

    of: FieldInSpace
    motions: Sequence[RigidMotion] = ()
    factors: Mapping[str, float] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The amplitudes."""
        return (*(motion.name for motion in self.motions), *self.factors)

    def at(self, x: Array, mu: Mapping[str, float]) -> "FieldAtPlaces":
        """The field at places."""
        Q, t = combined_motion(self.motions, mu)
        B, G, H = self.of((x - t) @ Q)
        turned = (
            B @ Q.T,
            np.einsum("ai,bj,nij->nab", Q, Q, G, optimize=True),
            np.einsum("ai,bj,ck,nijk->nabc", Q, Q, Q, H, optimize=True),
        )
        return FieldAtPlaces(self, x, dict(mu), *turned)


@dataclass(frozen=True)
class FieldAtPlaces:
    """A driven field at some places x, for some amplitudes; B, G and H are without the factors."""

    driven: MovingField
    x: Array
    mu: Mapping[str, float]
    B: Array
    G: Array
    H: Array

    @property
    def value(self) -> tuple[Array, Array, Array]:
        """B and its derivatives."""
        s = self._factor()
        return s * self.B, s * self.G, s * self.H

    def by(self, name: str) -> tuple[Array, Array]:
        """dB/dmu (n, 3) and its gradient."""
        if name in self.driven.factors:
            s = self._factor(name)
            return s * self.B, s * self.G
        C, slope = self._along(name)
        return self._factor() * C, self._factor() * slope

    def twice(self, name: str, other: str) -> Array:
        """d2B/dmu_i dmu_j (n, 3)."""
        scaled = [each for each in (name, other) if each in self.driven.factors]
        moving = [motion.name for motion in self.driven.motions if motion.name in (name, other)]
        if len(scaled) == 2:
            return self._factor(*scaled) * self.B
        if scaled:
            return self._factor(*scaled) * self._along(moving[0])[0]
        C, slope = self._along(moving[0])  # the motion that is carried out first, or the only one
        A, v = self._velocity(moving[-1])
        rate: Array = C @ A.T - np.einsum("nij,nj->ni", slope, self.x @ A.T + v)
        return self._factor() * rate

    def _factor(self, *by: str) -> float:
        """The product of all factors, differentiated by some amplitudes."""
        if len(set(by)) < len(by):
            return 0.0  # each is linear
        changes = self.driven.factors.items()
        return float(
            np.prod(
                [change if name in by else 1 + change * self.mu[name] for name, change in changes]
            )
        )

    def _along(self, name: str) -> tuple[Array, Array]:
        A, v = self._velocity(name)
        w = self.x @ A.T + v
        C = self.B @ A.T - np.einsum("nij,nj->ni", self.G, w)
        slope = (
            np.einsum("ij,njk->nik", A, self.G) - np.einsum("nijk,nj->nik", self.H, w) - self.G @ A
        )
        return C, slope

    def _velocity(self, name: str) -> Velocity:
        """That of a motion, which later ones carry along."""
        motions = self.driven.motions
        number = next(i for i, motion in enumerate(motions) if motion.name == name)
        own = motions[number]
        A = np.asarray(np.cross(np.eye(3), own.turn), dtype=np.float64)
        v = own.shift - A @ own.centre
        Q, t = combined_motion(motions[number + 1 :], self.mu)
        A = Q @ A @ Q.T
        return A, np.asarray(Q @ v - A @ t)


def combined_motion(motions: Sequence[RigidMotion], mu: Mapping[str, float]) -> tuple[Array, Array]:
    """x -> Q x + t of all motions together."""
    origin, *ends = apply_motions(motions, mu, np.vstack([np.zeros(3), np.eye(3)])).x
    return np.column_stack(ends) - origin[:, None], np.asarray(origin)
