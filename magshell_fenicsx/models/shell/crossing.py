"""Whether the shell has passed through a magnet between two states, however thin that is."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
HALVINGS = 16  # of a way, whose parts are then shorter than rounding in the places of a path


def crossing(distance: Callable[[Array], Array], before: Array, after: Array) -> Array | None:
    """A place (3,) inside a body on the straight ways from some places (n, 3) to others; None if there is none.

    A distance changes by at most the length of a way. So no place of a way is inside if the distances at both ends
    add up to more than its length; the other ways are halved.
    """
    low, high = distance(before), distance(after)
    for _ in range(HALVINGS):
        near = low + high <= np.linalg.norm(after - before, axis=1)
        if not near.any():
            return None
        before, after, low, high = (values[near] for values in (before, after, low, high))
        middle = (before + after) / 2
        between = distance(middle)
        if (between < 0).any():
            return np.asarray(middle[between.argmin()])
        before, after = np.concatenate([before, middle]), np.concatenate([middle, after])
        low, high = np.concatenate([low, between]), np.concatenate([between, high])
    return None
