"""Where a body is at approach zero, and which way it goes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.bodies.body import BodySection

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Placed:
    """A body's place, dimensionless and in the model's frame.

    Attributes
    ----------
    key
        Of the case file, for messages.
    front, centre
        The place (3,) of its surface that goes ahead, and its reference point behind that.
    direction
        Unit vector (3,) of the approach.
    Q
        Turns vectors of the case into the model's frame.
    R
        The length that lengths are over.
    """

    key: str
    front: Array
    centre: Array
    direction: Array
    Q: Array
    R: float

    def across(self, axis: list[float]) -> Array:
        """The unit vector along the part of an axis that is across the approach.

        Raises
        ------
        CaseError
            If there is none.
        """
        v = self.Q @ np.array(axis, dtype=float)
        v = v - (v @ self.direction) * self.direction
        if (size := float(np.linalg.norm(v))) < 1e-6 * np.linalg.norm(axis):
            raise CaseError(f"{self.key}.axis: is along the approach; give an axis across it")
        return np.asarray(v / size)


def place_body(section: BodySection, key: str, place: Array, normal: Array, half: float, Q: Array, R: float) -> Placed:
    """Where a body is.

    Parameters
    ----------
    place, normal
        Of the undeformed mid-surface where it touches first, in the case's frame over R.
    half
        Half the thickness over R.
    """
    out = normal if section.side == "outside" else -normal
    d = -out if section.direction is None else np.array(section.direction, dtype=float)
    d = d / np.linalg.norm(d)
    d, ahead = Q @ d, section.ahead / R
    front = Q @ (place + half * out)
    if section.position is not None:
        front = Q @ (np.array(section.position) / R) + ahead * d
    return Placed(key, front, front - ahead * d, d, Q, R)
