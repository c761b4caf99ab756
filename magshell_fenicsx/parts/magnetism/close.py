"""The energy of the faces of cells of different parts that lie above each other, nearer than rules on cells resolve.

Each of Gauss's points of the first cell sees the second in polar coordinates about its foot on it, with r = s sinh v
and the gap s between the faces there: a rule that is exact at any gap, as in `touching`, but with the state it moves.
What it misses of a derivative is of the order of its error. Faces that press on each other count as just apart: so the
pull between them is that of a gap of `LEAST`, whatever the penetration of their contact is.
"""

from collections.abc import Iterator
from functools import cached_property

import basix
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.by_charges import Complex, Weights, add
from magshell_fenicsx.parts.magnetism.charged import Nodal, Shape, unit
from magshell_fenicsx.parts.magnetism.charges import Boxes, Faces, gauss, heights
from magshell_fenicsx.parts.magnetism.pairs import Copies, Pairs, Points, Stiffness
from magshell_fenicsx.parts.magnetism.touching import CORNERS, ENDS

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
DEGREE = 14  # of the rule on the first cell
RAYS, RADIAL = 7, 12  # points over a sector of rays, and along a ray
LEAST = 1e-3  # of the thickness: nearer faces count as so far apart
ABOVE = 0.6  # part of a distance that is along the normal: else cells are beside each other
INSIDE = 0.5  # of the thickness: mid-surfaces that are nearer are in each other
TINY = 1e-12
CHARGES = basix.create_element(
    basix.ElementFamily.P, basix.CellType.triangle, 4, basix.LagrangeVariant.gl_isaac, discontinuous=True
)


def fans(apex: Array, s: Array) -> tuple[Array, Array]:
    """Points (m, M, 2) and weights (m, M) of the reference triangle as seen from places (m, 2) with scales (m,).

    It is the sum of the three triangles between a place and a side; with a negative weight where that is behind it.
    """
    V, (v, wv), (x, wx) = CORNERS - apex[:, None], gauss(RADIAL), gauss(RAYS)
    points, weights = list[Array](), list[Array]()
    for i, j in ENDS:
        along = (CORNERS[j] - CORNERS[i]) / np.linalg.norm(CORNERS[j] - CORNERS[i])
        outward = np.array([along[1], -along[0]])
        p = V[:, i] @ outward
        side, p = np.where(p < 0, -1.0, 1.0), np.maximum(np.abs(p), TINY)
        first, last = (np.arcsinh(V[:, k] @ along / p) for k in (i, j))
        mu = first[:, None] + (last - first)[:, None] * x
        rays = (side[:, None, None] * outward + np.sinh(mu)[..., None] * along) / np.cosh(mu)[..., None]
        top = np.arcsinh(p[:, None] * np.cosh(mu) / s[:, None])
        r = s[:, None, None] * np.sinh(top[..., None] * v)
        dr = s[:, None, None] * np.cosh(top[..., None] * v) * top[..., None] * wv
        angle = (side * (last - first))[:, None] * wx / np.cosh(mu)
        points.append((apex[:, None, None] + r[..., None] * rays[:, :, None]).reshape(len(apex), -1, 2))
        weights.append((angle[..., None] * r * dr).reshape(len(apex), -1))
    return np.concatenate(points, axis=1), np.concatenate(weights, axis=1)


def to_triangle(x: Array, corners: Array) -> Array:
    """Vectors (n, m, 3) to places (n, m, 3) from the nearest ones of flat triangles (n, 3, 3)."""
    sides = corners[:, [1, 2, 0]] - corners
    normal = unit(np.asarray(np.cross(sides[:, 0], sides[:, 1]), dtype=np.float64))
    best, within = np.full(x.shape, np.inf), np.ones(x.shape[:2], dtype=bool)
    for k in range(3):
        off, side = x - corners[:, None, k], sides[:, None, k]
        t = np.clip(np.sum(off * side, axis=-1) / np.sum(side * side, axis=-1), 0.0, 1.0)
        rest = off - t[..., None] * side
        nearer = np.sum(rest * rest, axis=-1) < np.sum(best * best, axis=-1)
        best[nearer] = rest[nearer]
        within &= np.einsum("nmi,ni->nm", off, np.cross(normal, sides[:, k])) >= 0
    across = np.einsum("nmi,ni->nm", x - corners[:, None, 0], normal)
    return np.where(within[..., None], across[..., None] * normal[:, None], best)


class Close:
    """Pairs of the faces of all cells that are close.

    Parameters
    ----------
    shape
        All cells that are modelled.
    reach
        The distance of faces, over the size of cells, up to which they are.
    """

    def __init__(self, shape: Shape, faces: Faces, copies: Copies, comm: MPI.Comm, reach: float) -> None:
        self._shape, self._faces, self._copies, self._reach = shape, faces, copies, reach
        self._pairs = Pairs(comm)
        X, w = basix.make_quadrature(basix.CellType.triangle, DEGREE)
        self._X, self._w = np.asarray(X), np.asarray(w)
        self._tables = np.ascontiguousarray(self._tabulated(self._X))

    def of(self, nodes: Array, own: range, apart: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """(own, cells) which of the pairs that are `apart` lie above each other, close."""
        middle = nodes.mean(axis=1)
        radius = np.linalg.norm(nodes - middle[:, None], axis=-1).max(axis=1)
        part = slice(own.start, own.stop)
        size = 2 * np.maximum(radius[part, None], radius)
        ball = np.linalg.norm(middle[part, None] - middle, axis=-1) - radius[part, None] - radius
        near = (apart != 0) & (ball < self._shape.h + self._reach * size)
        first, second = np.nonzero(near)
        if not len(first):
            return np.asarray(near)
        c, d = first + own.start, second
        least: Array = np.full(len(c), np.inf)
        along: Array = np.zeros(len(c))
        for one, other in ((c, d), (d, c)):
            corners = np.asarray(nodes[one, :3], dtype=np.float64)
            normal = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
            away = to_triangle(nodes[other], corners)
            distance = np.linalg.norm(away, axis=-1)
            at = distance.argmin(axis=1)
            rows, nearest = np.arange(len(one)), distance.min(axis=1)
            up = np.abs(np.sum(away[rows, at] * normal, axis=-1))
            along = np.where(nearest < least, up, along)
            least = np.minimum(least, nearest)
        near[first, second] = (least - self._shape.h < self._reach * size[first, second]) & (along > ABOVE * least)
        return np.asarray(near)

    def add(
        self, nodes: Array, own: range, near: NDArray[np.bool_], gradient: Array, stiffness: Stiffness | None = None
    ) -> float | None:
        """The energy of pairs that own cells are in, each half; their gradient (cells, k, 3) is added.

        None if two cells are in each other.
        """
        energy, row = 0.0, np.zeros(1, dtype=np.int64)
        for one, other, both in self._ordered(own, near):
            found = self._points(nodes, one, other)
            if found is None:
                return None
            left, right, _ = found
            cells = np.array([[one, other]])
            share = 1.0 if both else 0.5
            energy += share * self._pairs.add(nodes, cells, 1, (left, row), (right, row), gradient, stiffness)
            self._pairs.finish(nodes, cells[:, 0], left, gradient, stiffness)
        return energy

    def by_fields(
        self, nodes: Array, own: range, near: NDArray[np.bool_], moved: Complex, weights: Weights, into: Nodal
    ) -> None:
        """Add the derivatives that `into` has, of own cells: see `Charged.by_fields`."""
        on_charges, row = np.zeros_like(self._charges), np.zeros(1, dtype=np.int64)
        for one, other, _ in self._ordered(own, near):
            found = self._points(nodes, one, other)
            if found is None:
                continue
            left, right, X = found
            pair, sides = np.array([[one, other]]), ((left, row), (right, row))
            on_q = add(moved, pair, *sides, weights)
            on_heights = None if into.by_thickness is None else add(moved, pair, *sides, weights, heights=True)
            for i, (cell, places, weight) in enumerate(((one, self._X, self._w), (other, X[0], X[1]))):
                if cell not in own:
                    continue
                copy, at = divmod(cell, len(self._shape.r0))
                basis, layers = CHARGES.tabulate(0, places)[0, :, :, 0], self._charges.shape[-1]
                on = self._copies.charges[copy] * weight[:, None] * on_q[i].reshape(-1, layers)
                on_charges[at] += basis.T @ on
                if on_heights:
                    on_t = self._copies.up[copy] * (on_heights[i].reshape(-1, layers) @ self._heights)
                    self._shape.back_of_thickness(np.array([at]), places, on_t[None], into)
        made = self._faces.at(*self._nodes_of_charges, into)
        assert made.back
        made.back(np.zeros_like(made.x), on_charges)

    def _ordered(self, own: range, near: NDArray[np.bool_]) -> Iterator[tuple[int, int, bool]]:
        """The pairs, the same cell first in both orders and of images, each once; and whether both are own cells."""
        count = len(self._shape.r0)
        for c, d in zip(*np.nonzero(near), strict=True):
            one, other = int(c) + own.start, int(d)
            both = other in own
            if not (both and one > other):
                yield *((one, other) if one % count <= other % count else (other, one)), both

    def _points(self, nodes: Array, one: int, other: int) -> tuple[Points, Points, tuple[Array, Array]] | None:
        """Those of two cells, with places and weights on the second; None if these are in each other."""
        h, T = self._shape.h, self._tables
        r, a1, a2 = (T[:, i] @ nodes[one] for i in range(3))
        n, corners = unit(np.cross(a1, a2)), nodes[other, :3]
        J = np.stack([corners[1] - corners[0], corners[2] - corners[0]], axis=-1)
        back, element = np.linalg.pinv(J), self._shape.element
        apex = (r - corners[0]) @ back.T
        for _ in range(2):
            apex = apex + (r - element.tabulate(0, apex)[0, :, :, 0] @ nodes[other]) @ back.T
        off = r - element.tabulate(0, apex)[0, :, :, 0] @ nodes[other]
        across = np.sum(off * n, axis=-1)
        gap = np.abs(across) - h
        over = np.min(np.column_stack([apex, 1 - apex.sum(axis=1)]), axis=1) > 0
        if np.any(over & (gap < -INSIDE * h)):
            return None
        shift = np.where(gap > -INSIDE * h, np.sign(across) * np.maximum(0.0, LEAST * h - gap), 0.0)
        s = np.maximum(gap, LEAST * h) / np.sqrt(np.linalg.norm(np.cross(J[:, 0], J[:, 1])))
        X, weights = fans(apex, s)
        t, q = self._of_first
        (t_of, q_of), shape = self._of(other, X.reshape(-1, 2)), X.shape[:2]
        eta = self._heights + (shift / t[one])[:, None]
        left = Points(T, eta, t[one : one + 1], q[one : one + 1])
        q_of = q_of.reshape(*shape, -1) * weights[..., None]
        tables = self._tabulated(X.reshape(-1, 2)).reshape(*shape, 3, -1)
        layers = np.broadcast_to(self._heights, q_of.shape)
        return left, Points(tables, layers, t_of.reshape(1, *shape), q_of[None]), (X.reshape(-1, 2), weights.ravel())

    def _tabulated(self, X: Array) -> Array:
        """(n, 3, k)"""
        return np.asarray(self._shape.element.tabulate(1, X)[..., 0].transpose(1, 0, 2))

    @cached_property
    def _heights(self) -> Array:
        return heights(self._faces)

    @cached_property
    def _of_first(self) -> tuple[Array, Array]:
        """Thickness (cells, n) and charges (cells, n, layers) at points of the first cells, of all copies."""
        each = [self._of(cell, self._X) for cell in range(len(self._shape.r0) * len(self._copies.images))]
        t, q = (np.stack(part) for part in zip(*each, strict=True))
        return t, self._w[:, None] * q

    def _of(self, cell: int, X: Array) -> tuple[Array, Array]:
        """Thickness (n,) and charges (n, layers) per area of the reference triangle at places X (n, 2) of a cell."""
        copy, at = divmod(cell, len(self._shape.r0))
        t = self._copies.up[copy] * self._shape.thickness(np.array([at]), X[None])[0, 0]
        basis = CHARGES.tabulate(0, X)[0, :, :, 0]
        return t, self._copies.charges[copy] * (basis @ self._charges[at])

    @cached_property
    def _charges(self) -> Array:
        """(cells, n, layers) charges per area of the reference triangle at nodes of what is modelled."""
        return self._faces.at(*self._nodes_of_charges).q

    @property
    def _nodes_of_charges(self) -> tuple[Boxes, Array, Array]:
        a, b = CHARGES.points.T
        return Boxes.whole(self._faces.count), np.column_stack([a, b / (1 - a)]), 1 / (1 - a)
