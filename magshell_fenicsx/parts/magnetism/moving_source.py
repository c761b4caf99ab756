"""The field of a moving source, with its derivatives by the amplitudes of its motions and factors.

A motion with the velocity w(x) = A x + v carries a field B along: dB/dmu = A B - G w, with the
gradient G of B. Its own gradient needs the second derivatives H of B. So place and angle of a
source need no derivatives but those of the field.

mu are the amplitudes, by name: load parameters that move a field (`motions`) or multiply it
(`factors`). A motion is a shift or a rotation in proportion to its amplitude; w is its velocity per
unit of the amplitude. Places and shifts are over R.
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
    """A field in space that amplitudes move and multiply.

    Attributes
    ----------
    at_rest
        The field where all amplitudes are zero: places (n, 3) over R to B with two derivatives.
    motions
        Translations and rotations by amplitudes, carried out one after the other. No motion is
        both.
    factors
        Amplitude -> change of the field's factor, from one, for an amplitude of one.
    """

    at_rest: FieldInSpace
    motions: Sequence[RigidMotion] = ()
    factors: Mapping[str, float] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the amplitudes."""
        return (*(motion.name for motion in self.motions), *self.factors)

    def field_at(self, x: Array, mu: Mapping[str, float]) -> "FieldAtPlaces":
        """Return the field at places x (n, 3) over R, for amplitudes mu.

        B, its gradient and its second derivatives are taken where the motions carry x back to, and
        turned with the source.
        """
        Q, t = combined_motion(self.motions, mu)
        B, G, H = self.at_rest((x - t) @ Q)
        rotated = (
            B @ Q.T,
            np.einsum("ai,bj,nij->nab", Q, Q, G, optimize=True),
            np.einsum("ai,bj,ck,nijk->nabc", Q, Q, Q, H, optimize=True),
        )
        return FieldAtPlaces(self, x, dict(mu), *rotated)


@dataclass(frozen=True)
class FieldAtPlaces:
    """A moving field at places, for given amplitudes, with its derivatives by these.

    Attributes
    ----------
    moving_field
        The field with its motions and factors.
    x
        (n, 3) places over R.
    mu
        Amplitude -> value.
    B, G, H
        (n, 3), (n, 3, 3) and (n, 3, 3, 3): field, gradient dB_i/dx_j and second derivatives,
        without the factors.
    """

    moving_field: MovingField
    x: Array
    mu: Mapping[str, float]
    B: Array
    G: Array
    H: Array

    @property
    def value(self) -> tuple[Array, Array, Array]:
        """B (n, 3) and its first and second derivatives, times the factors."""
        s = self._factor()
        return s * self.B, s * self.G, s * self.H

    def derivative(self, name: str) -> tuple[Array, Array]:
        """Return dB/dmu (n, 3) by the amplitude `name`, and its gradient (n, 3, 3)."""
        if name in self.moving_field.factors:
            s = self._factor(name)
            return s * self.B, s * self.G
        C, slope = self._motion_rate(name)
        return self._factor() * C, self._factor() * slope

    def second_derivative(self, name: str, other: str) -> Array:
        """Return d2B/dmu_i dmu_j (n, 3) by the amplitudes `name` and `other`."""
        # three cases: two factors, a factor and a motion, two motions (or one twice)
        factor_names = [
            amplitude for amplitude in (name, other) if amplitude in self.moving_field.factors
        ]
        motion_names = [
            motion.name for motion in self.moving_field.motions if motion.name in (name, other)
        ]
        if len(factor_names) == 2:
            return self._factor(*factor_names) * self.B
        # C = dB/dmu_i is the rate by the motion, of two motions by the one that is carried out
        # first; with its gradient
        C, slope = self._motion_rate(motion_names[0])
        if factor_names:
            return self._factor(*factor_names) * C
        # the other motion, or the same once more, has the velocity w = A x + v and carries C along
        # as any field: dC/dmu_j = A C - (grad C) w
        A, v = self._velocity(motion_names[-1])
        w = self.x @ A.T + v
        rate: Array = C @ A.T - np.einsum("nij,nj->ni", slope, w)
        return self._factor() * rate

    def _factor(self, *differentiated_by: str) -> float:
        """Return the product of all factors, differentiated by some amplitudes.

        A factor is 1 + change mu; its derivative by mu is the change.
        """
        if len(set(differentiated_by)) < len(differentiated_by):
            return 0.0  # a factor is linear in its amplitude
        return float(
            np.prod(
                [
                    change if name in differentiated_by else 1 + change * self.mu[name]
                    for name, change in self.moving_field.factors.items()
                ]
            )
        )

    def _motion_rate(self, name: str) -> tuple[Array, Array]:
        """Return dB/dmu (n, 3) by a motion, and its gradient (n, 3, 3), without the factors.

        With the velocity w = A x + v of the motion it is A B - G w.
        """
        A, v = self._velocity(name)
        w = self.x @ A.T + v
        C = self.B @ A.T - np.einsum("nij,nj->ni", self.G, w)
        # gradient of A B - G w, with dw/dx = A
        slope = (
            np.einsum("ij,njk->nik", A, self.G) - np.einsum("nijk,nj->nik", self.H, w) - self.G @ A
        )
        return C, slope

    def _velocity(self, name: str) -> Velocity:
        """Return A (3, 3) and v (3,) of the velocity w(x) = A x + v of a motion.

        A motion turns with the angular velocity `turn` about its centre, and shifts. Later motions
        carry this velocity along.
        """
        motions = self.moving_field.motions
        motion_number = next(i for i, motion in enumerate(motions) if motion.name == name)
        motion = motions[motion_number]
        # the matrix of the cross product: A x = turn x x
        A = np.asarray(np.cross(np.eye(3), motion.turn), dtype=np.float64)
        v = motion.shift - A @ motion.centre
        # later motions x -> Q x + t carry the velocity to Q A Q^T x + Q v - Q A Q^T t
        Q, t = combined_motion(motions[motion_number + 1 :], self.mu)
        A = Q @ A @ Q.T
        return A, np.asarray(Q @ v - A @ t)


def combined_motion(motions: Sequence[RigidMotion], mu: Mapping[str, float]) -> tuple[Array, Array]:
    """Return rotation Q (3, 3) and shift t (3,) of x -> Q x + t, all motions together."""
    # images of the origin and of the unit vectors
    origin, *ends = apply_motions(motions, mu, np.vstack([np.zeros(3), np.eye(3)])).x
    return np.column_stack(ends) - origin[:, None], np.asarray(origin)
