"""The distance from what is rounded: from a convex corner in two or three coordinates, less a radius."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rounded(q: Array, edge: float) -> tuple[Array, Array, Array]:
    """The signed distance with its derivatives by q.

    Parameters
    ----------
    q
        (n, m) coordinates from the corner of the core, which is where all are negative.
    edge
        Radius that rounds the core.
    """
    m = np.maximum(q, 0.0)
    far = np.linalg.norm(m, axis=1)
    outside = far > 0
    nearest = np.eye(q.shape[1])[q.argmax(axis=1)]
    n = np.where(outside[:, None], m / np.maximum(far, 1e-300)[:, None], nearest)
    active = (m > 0)[:, :, None] * np.eye(q.shape[1])
    H = (active - n[:, :, None] * n[:, None, :]) / np.maximum(far, 1e-300)[:, None, None]
    return np.where(outside, far, q.max(axis=1)) - edge, n, np.where(outside[:, None, None], H, 0.0)
