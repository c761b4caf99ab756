"""What an imperfection brings to a plan."""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.deviation import Deviation
from magshell_fenicsx.mesh.frame import rotation

Array = NDArray[np.float64]
Values = TypeVar("Values")
Distance = Callable[[Array], Array]  # places (n, 3) over R -> distances (n,) over R, from one place


@dataclass(frozen=True)
class Flaw:
    """One imperfection; places, lengths and w0 are over R, in the frame of the case.

    Attributes
    ----------
    deviation
        Places (n, 3) of the perfect surface -> w0 (n,).
    size
        Largest element size that shows it, within `reach` of its centre.
    centre
        Its place (3,) on the perfect surface; None if it is everywhere.
    distance
        From its centre.
    reach
        How far it reaches from its centre, in the measure of `distance`.
    rim
        Whether the curvature jumps there.
    account
        What it was made from, for people.
    sizes
        Places (n, 3) -> element sizes (n,) that show it there, of one without a centre that varies more in some
        places; None where they are alike.
    """

    deviation: Deviation
    size: float = inf
    centre: Array | None = None
    distance: Distance | None = None
    reach: float = inf
    rim: bool = False
    account: str = ""
    sizes: Callable[[Array], Array] | None = None

    def inside(self, places: Array) -> NDArray[np.bool_]:
        """Whether places (n, 3) are within its rim."""
        assert self.distance
        return np.asarray(self.distance(places) < self.reach)


@dataclass(frozen=True)
class Turned(Generic[Values]):
    """A function of places (n, 3) in a frame whose axes are the rows of `axes`."""

    of_place: Callable[[Array], Values]
    axes: Array

    def __call__(self, places: Array) -> Values:
        return self.of_place(places @ self.axes)


def in_frame(of_place: Callable[[Array], Values], turn: float) -> Callable[[Array], Values]:
    """A function of places in a frame turned about e3 (rad)."""
    return Turned(of_place, rotation(turn)) if turn else of_place
