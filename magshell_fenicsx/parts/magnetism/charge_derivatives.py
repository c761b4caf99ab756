"""Derivatives of the energy and the forces of charges by the charges and by their heights.

The energy W = sum of q_i q_j/|x_i - x_j| has dW/dq_i = sum of q_j/|x_i - x_j|. The derivative of
the force term v . dW/du is the rate of this sum along v. The rates v of nodes are the imaginary
parts of complex nodes, times a step so small that derivatives are exact to rounding (W. Squire, G.
Trapp, SIAM Review 40, 1998, 110).

- Left and right are the first and the second cell of a pair; q and x are charges and places on the
  left, p and y on the right.
- An element is a cell's face or edge with charged points (`Points`): P points, each with charges in
  several layers through the thickness. Heights are those of charges over the mid-surface.
- Arrays (n, 1 or P, charges) have n pairs of elements. Either all charges of both elements act on
  each other (1), or each of P points on the left has its own points on the right (P).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.magnetised_cells import COMPLEX_STEP
from magshell_fenicsx.parts.magnetism.pairs import Points

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Ints = NDArray[np.int64]
Elements = tuple[Points, Ints]  # points on elements of a kind, and the rows of these
# components (n, 1 or P, charges) of places and of normals
Components = tuple[list[Complex], list[Complex]]
MAX_CHARGE_PAIRS = 400_000  # computed at once


@dataclass(frozen=True)
class Weights:
    """Factors of the number that is differentiated: energy W + force v . dW/du."""

    energy: float
    force: float


def places(points: Points, rows: Ints, nodes: Complex) -> tuple[Complex, Complex, Complex]:
    """Return mid-surface places r, normals n and places x of the charges of elements.

    Places are over R. Shapes are (n, P, .., 3) for r and n, and (n, P, .., layers, 3) for x.

    Parameters
    ----------
    points
        Tables of shape functions, thickness and heights at P points of an element.
    rows
        (n,) rows of the elements in `points.t`.
    nodes
        (n, k, 3) nodes of their cells, with rates as imaginary parts.
    """
    T = np.moveaxis(points.tables, -2, 0)  # shape functions, and their two derivatives
    r, a1, a2 = _interpolated(T, nodes)  # places, and both tangents
    area_vector = np.cross(a1, a2)
    n = area_vector / np.sqrt(np.sum(area_vector * area_vector, axis=-1, keepdims=True))
    heights = points.t[rows][..., None] * points.heights
    return r, n, r[..., None, :] + heights[..., None] * n[..., None, :]


def _interpolated(T: Array, nodes: Complex) -> list[Complex]:
    """Return the values (n, P, .., 3) of nodal values (n, k, 3), for each table of T.

    A table (P, .., k) has the factors of the k nodes at each point, such as shape functions.
    """
    # real and imaginary parts side by side, so that a real matrix product interpolates both
    flat_nodes = (
        np.ascontiguousarray(nodes.transpose(1, 0, 2)).view(np.float64).reshape(nodes.shape[1], -1)
    )
    values = list[Complex]()
    for table in T:
        product = (table.reshape(-1, table.shape[-1]) @ flat_nodes).view(np.complex128)
        by_point = product.reshape(-1, *nodes.shape[::2])  # (points, n, 3)
        values.append(np.moveaxis(by_point, 1, 0).reshape(len(nodes), *table.shape[:-1], 3))
    return values


def pair_derivatives(
    nodes: Complex,
    cells: Ints,
    left: Elements,
    right: Elements,
    weights: Weights,
    *,
    heights: bool = False,
) -> tuple[Array, Array]:
    """Return derivatives of a sum over pairs of cells, by the charges on the left and on the right.

    The number that is differentiated is `weights.energy` W + `weights.force` v . dW/du, with the
    rates v of the nodes. Both arrays have the shape of `Points.q`. With `heights`, they are
    derivatives by the heights of the charges over the mid-surface instead.

    Parameters
    ----------
    nodes
        (cells, k, 3) with rates times `COMPLEX_STEP` as imaginary parts.
    cells
        (n, 2) the cells of each pair.
    left, right
        Points on each pair's first and second cell, and their rows (n,).
    """
    (left_points, _), (right_points, _) = left, right
    by_left, by_right = np.zeros_like(left_points.q), np.zeros_like(right_points.q)
    # all left points share the right points, or each left point has right points of its own
    is_shared = right_points.tables.ndim == 3
    right_charges = right_points.q[0].size if is_shared else right_points.q[0, 0].size
    charge_pairs = left_points.q[0].size * right_charges  # of one pair of elements
    # derivatives by heights need about four times the memory
    batch_size = max(1, MAX_CHARGE_PAIRS // (4 * charge_pairs if heights else charge_pairs))
    derivatives = _by_heights if heights else _by_charges
    for first in range(0, len(cells), batch_size):
        batch = slice(first, first + batch_size)
        # components of places and normals of the left charges (x) and of the right ones (y)
        x, y = (
            _components(points, rows[batch], nodes[cells[batch, side]], is_shared)
            for side, (points, rows) in enumerate((left, right))
        )
        # left and right charges, in the shape of a component of their places
        (first_of_x, *_), _ = x
        (first_of_y, *_), _ = y
        q, p = (
            points.q[rows[batch]].reshape(*first_component.shape)
            for (points, rows), first_component in ((left, first_of_x), (right, first_of_y))
        )
        # the derivatives of the batch are added to the rows of its elements, on both sides
        for total, (_, rows), derivative in zip(
            (by_left, by_right), (left, right), derivatives(x, y, q, p, weights), strict=True
        ):
            np.add.at(total, rows[batch], derivative.reshape(len(derivative), *total.shape[1:]))
    return by_left, by_right


def _values_and_rates(places: list[Complex]) -> list[tuple[Array, Array]]:
    """Return the value and the rate along v of each component of complex places."""
    return [
        (np.ascontiguousarray(values.real), np.asarray(values.imag / COMPLEX_STEP))
        for values in places
    ]


def _by_charges(
    x: Components, y: Components, q: Array, p: Array, weights: Weights
) -> tuple[Array, Array]:
    """Return derivatives (n, 1 or P, charges) by the left charges q and by the right charges p.

    `x` and `y` are components of places and normals of left and right charges. With d = x - y the
    kernel is 1/|d|; its rate along v is -d . d'/|d|³, with the rate d' of d.
    """
    # of each side the components of places, as pairs of value and rate along v
    (places_of_left, _), (places_of_right, _) = x, y
    left_pairs, right_pairs = _values_and_rates(places_of_left), _values_and_rates(places_of_right)

    def differences(i: int) -> list[Array]:
        """Return the components of d (i = 0) or d' (i = 1) of all left and right charges."""
        return [
            a[i][..., :, None] - b[i][..., None, :]
            for a, b in zip(left_pairs, right_pairs, strict=True)
        ]

    # each (n, 1 or P, left charges, right charges)
    separation, rate = differences(0), differences(1)
    inverse = 1 / np.sqrt(separation[0] ** 2 + separation[1] ** 2 + separation[2] ** 2)
    radial_rate = separation[0] * rate[0] + separation[1] * rate[1] + separation[2] * rate[2]
    kernel = weights.energy * inverse - weights.force * inverse**2 * inverse * radial_rate
    return (kernel @ p[..., None])[..., 0], (q[..., None, :] @ kernel)[..., 0, :]


def _by_heights(
    x: Components, y: Components, q: Array, p: Array, weights: Weights
) -> tuple[Array, Array]:
    """Return derivatives (n, 1 or P, charges) by the heights of the left and the right charges.

    A charge moves along its normal n with its height, so that q p/|d|, d = x - y, has the
    derivative -q p n . d/|d|³. `x` and `y` are components of places and normals of left and right
    charges.
    """
    (left_places, left_normals), (right_places, right_normals) = x, y
    d = [a[..., :, None] - b[..., None, :] for a, b in zip(left_places, right_places, strict=True)]
    square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    inverse_cube = 1 / (square * np.sqrt(square))
    by_left_heights, by_right_heights = np.zeros(q.shape, complex), np.zeros(p.shape, complex)
    for separation, n, m in zip(d, left_normals, right_normals, strict=True):  # components
        force = inverse_cube * separation
        by_left_heights -= n * (force @ p[..., None])[..., 0]
        by_right_heights += m * (q[..., None, :] @ force)[..., 0, :]
    # real parts are derivatives of the energy, imaginary parts their rates along v
    by_left, by_right = (
        weights.energy * derivative.real + weights.force * derivative.imag / COMPLEX_STEP
        for derivative in (q * by_left_heights, p * by_right_heights)
    )
    return by_left, by_right


def _components(points: Points, rows: Ints, nodes: Complex, is_shared: bool) -> Components:
    """Return the three components of the charges' places, and the three of their normals.

    If `is_shared`, all charges of the element act on all of the other one: (n, 1, charges). Else
    they are (n, P, charges), with the charges that belong to each of P points.
    """
    _, n, x = places(points, rows, nodes)
    shape = len(x), 1 if is_shared else x.shape[1], -1, 3
    charge_places = x.reshape(shape)
    charge_normals = np.broadcast_to(n[..., None, :], x.shape).reshape(shape)
    return [charge_places[..., i] for i in range(3)], [charge_normals[..., i] for i in range(3)]
