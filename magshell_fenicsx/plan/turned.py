"""The gradient of an applied field that turns as a whole: B(r) = Q b + Q G Q^T r.

With the rotation Q = P + cos t (1 - P) + sin t A about an axis a, P = a a^T and A = a x, the gradient Q G Q^T is a
sum of five matrices times 1, cos t, sin t, cos 2t and sin 2t.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from math import acos

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LEAST = 1e-10  # of the gradient's size: a smaller part is rounding


def harmonics(G: Array, before: Array, after: Array) -> Array:
    """The five matrices (5, 3, 3) where the direction (3,) `before` turns towards `after`."""
    axis = np.cross(before, after)
    axis = axis / np.linalg.norm(axis)
    P, A = np.outer(axis, axis), np.cross(np.eye(3), axis)
    M = np.eye(3) - P
    flat, turned = M @ G @ M, A @ G @ A
    mixed = A @ G @ M - M @ G @ A
    return np.array(
        [P @ G @ P + (flat - turned) / 2, P @ G @ M + M @ G @ P, A @ G @ P - P @ G @ A, (flat + turned) / 2, mixed / 2]
    )


def at_angle(parts: Array, t: float) -> Array:
    """Q G Q^T from its harmonics."""
    return np.asarray(np.tensordot([1.0, np.cos(t), np.sin(t), np.cos(2 * t), np.sin(2 * t)], parts, 1))


def along(G: Array, directions: Sequence[Array]) -> Iterator[tuple[Array, Array]]:
    """The gradient at each of the successive directions but the last, and its harmonics on the way to the next."""
    for before, after in pairwise(directions):
        if abs(before @ after) > 1 - LEAST:  # it does not turn
            parts = np.concatenate([G[None], np.zeros((4, 3, 3))])
        else:
            parts = harmonics(G, before, after)
        yield G, parts
        G = at_angle(parts, acos(float(np.clip(before @ after, -1, 1))))


def basis(G: Array, directions: Sequence[Array]) -> tuple[Array, ...]:
    """Orthonormal matrices of which all gradients on the way through some directions are sums."""
    found: list[Array] = []
    for part in (part for _, parts in along(G, directions) for part in parts):
        rest = part - sum((np.sum(part * B) * B for B in found), np.zeros((3, 3)))
        if (size := np.linalg.norm(rest)) > LEAST * np.linalg.norm(G):
            found.append(rest / size)
    return tuple(found)
