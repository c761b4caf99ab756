"""The energy of charges far from each other, by multipoles of boxes of cells (the fast multipole
method).

The moments M of the charges in a box about its middle, which does not move, are polynomials of
their places, and the energy is a quadratic form of them, E = sum of M_A . G_AB M_B/2 over boxes far
from each other, with constant G. So forces and stiffness are its derivatives, without any sum over
pairs of charges: those by the moments are L = G M, and D = dM/du^T G dM/du + L . d2M/du2. Moments
go up to larger boxes and L comes down, so the cost grows like n.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array

from magshell_fenicsx.assembly.dense_tangent import SinglePrecisionBlocks
from magshell_fenicsx.parts.magnetism.charge_derivatives import Complex, Weights, places
from magshell_fenicsx.parts.magnetism.magnetised_cells import COMPLEX_STEP
from magshell_fenicsx.parts.magnetism.multipoles import COUNT, derivatives, ends, harmonics, shift
from magshell_fenicsx.parts.magnetism.pairs import Pairs, Points, Stiffness
from magshell_fenicsx.parts.magnetism.tree import Tree
from magshell_fenicsx.parts.magnetism.turned import Kept, Turning

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
SECOND = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # as in pairs.c


@dataclass(frozen=True)
class Surface:
    """Places, normals and dual bases (rows, P, 3) of points on the mid-surface."""

    r: Array
    n: Array
    up: tuple[Array, Array]

    @classmethod
    def of(cls, nodes: Array, tables: Array) -> "Surface":
        r, a1, a2 = np.tensordot(nodes, tables, axes=(1, 2)).transpose(3, 0, 2, 1)
        m = np.cross(a1, a2)
        size = np.linalg.norm(m, axis=-1, keepdims=True)
        n = m / size
        return cls(r, n, (np.cross(a2, n) / size, np.cross(n, a1) / size))


@dataclass(frozen=True)
class PlacedCharges:
    """Charges where they are.

    Attributes
    ----------
    Y
        (COUNT, charges) harmonics about the middles of their boxes, over their width; in the order
        of boxes.
    surfaces
        Of each kind.
    heights
        (rows, P, L) over the mid-surface, of each kind.
    """

    Y: Array
    surfaces: list[Surface]
    heights: list[Array]


class MultipoleExpansion:
    """The sum over pairs of boxes of a tree, for the charges of some kinds of elements.

    Parameters
    ----------
    kinds
        Cells (rows,) and points of each.
    own
        The cells of this rank.
    """

    def __init__(
        self, tree: Tree, kinds: Sequence[tuple[Ints, Points]], own: range, pairs: Pairs
    ) -> None:
        self._tree, self._kinds, self._pairs, self._leaf = tree, kinds, pairs, tree.levels[-1]
        self._own = [(cells >= own.start) & (cells < own.stop) for cells, _ in kinds]
        box = np.concatenate(
            [self._leaf.of_cell[cells].repeat(points.q[0].size) for cells, points in kinds]
        )
        self._order = np.argsort(box, kind="stable")
        self._filled, self._first = np.unique(box[self._order], return_index=True)
        self._middle = self._leaf.middle[box[self._order]]
        self._q = np.concatenate([points.q.ravel() for _, points in kinds])[self._order]
        self._octants = [list(_octants(level.keys)) for level in tree.levels]

    def placed(self, nodes: Array) -> PlacedCharges:
        """The charges on cells with nodes (cells, k, 3)."""
        surfaces = [Surface.of(nodes[cells], points.tables) for cells, points in self._kinds]
        heights = [points.t[..., None] * points.heights for _, points in self._kinds]
        both = zip(surfaces, heights, strict=True)
        x = [(s.r[:, :, None] + z[..., None] * s.n[:, :, None]).reshape(-1, 3) for s, z in both]
        return PlacedCharges(
            harmonics((np.concatenate(x)[self._order] - self._middle) / self._leaf.width),
            surfaces,
            heights,
        )

    def add(self, at: PlacedCharges, *, bent: bool) -> float:
        """The energy of own cells, half of each pair's; first and, if `bent`, second derivatives go
        to points' sums.
        """
        N, L = derivatives(), self.onto(self._summed(self._q * at.Y))[..., 0]
        slopes = [*N, *(N[i] @ N[j] for i, j in SECOND)] if bent else N
        of_box = np.stack([L, *(L @ each for each in slopes)], axis=-1)
        values = np.empty((len(self._q), of_box.shape[-1]))
        for box, first, end in zip(
            self._filled, self._first, [*self._first[1:], len(self._q)], strict=True
        ):
            values[self._order[first:end]] = at.Y[:, first:end].T @ of_box[box]
        values *= self._leaf.width ** -np.array([1.0] + [2.0] * 3 + [3.0] * 6)[: values.shape[1]]
        energy, start = 0.0, 0
        for (_, points), z, own in zip(self._kinds, at.heights, self._own, strict=True):
            stop = start + points.q.size
            each = points.q[own, ..., None] * values[start:stop].reshape(*points.q.shape, -1)[own]
            z, start, energy = z[own, ..., None], stop, energy + each[..., 0].sum() / 2
            f, K = each[..., 1:4], each[..., 4:]
            parts = [f, z * f, *([K, z * K, z * z * K] if bent else [])]
            sums = np.concatenate([part.sum(axis=2) for part in parts], axis=-1)
            points.sums[own, :, : sums.shape[-1]] += sums
        return float(energy)

    def by_charges(
        self,
        nodes: Array,
        moved: Complex,
        kinds: Sequence[tuple[Ints, Points]],
        weights: Weights,
        *,
        heights: bool = False,
    ) -> list[list[Array]]:
        """Derivatives of the energy of all, and of its rate, by the charges, of own cells: of each
        kind, like `q`.

        Beside each, if asked for, those by the `heights` of the charges over the mid-surface.

        Parameters
        ----------
        moved
            (cells, k, 3) the nodes, with rates times `COMPLEX_STEP` as imaginary parts.
        """
        Y, N, width = self.placed(nodes).Y, derivatives(), self._leaf.width
        at = [places(points, np.arange(len(points.q)), moved[cells]) for cells, points in kinds]

        def along(v: NDArray[np.floating[Any]], Y: Array) -> Array:
            return np.asarray(v[:, 0] * (N[0] @ Y) + v[:, 1] * (N[1] @ Y) + v[:, 2] * (N[2] @ Y))

        rate = (
            np.concatenate([x.reshape(-1, 3) for _, _, x in at])[self._order].imag
            / COMPLEX_STEP
            / width
        )
        dY = along(rate, Y)
        L, dL = (self.onto(self._summed(self._q * values))[..., 0] for values in (Y, dY))
        wanted: list[tuple[Array | float, Array, Array]] = [(1.0, Y, dY)]
        if heights:
            normals = [np.broadcast_to(n[..., None, :], x.shape).reshape(-1, 3) for _, n, x in at]
            upwards = np.concatenate(normals)[self._order] / width
            n, dn = upwards.real, upwards.imag / COMPLEX_STEP
            nY = along(n, Y)
            wanted.append((self._q, nY, np.asarray(along(rate, nY) + along(dn, Y))))
        split = np.cumsum([points.q.size for _, points in kinds])[:-1]
        found = list[list[Array]]()
        for factor, values, rates in wanted:
            by = np.empty(len(self._q))
            for box, first, end in zip(
                self._filled, self._first, [*self._first[1:], len(self._q)], strict=True
            ):
                y, dy = values[:, first:end], rates[:, first:end]
                of = weights.energy * (L[box] @ y) + weights.force * (L[box] @ dy + dL[box] @ y)
                by[self._order[first:end]] = of / width
            by[self._order] *= factor
            each = zip(np.split(by, split), kinds, self._own, strict=True)
            found.append(
                [
                    part.reshape(points.q.shape) * own[:, None, None]
                    for part, (_, points), own in each
                ]
            )
        return [list(each) for each in zip(*found, strict=True)]

    def _summed(self, values: Array) -> Array:
        """Moments (boxes, COUNT, 1) from what charges (COUNT, charges) have, in the order of
        boxes."""
        M = np.zeros((len(self._leaf.keys), COUNT, 1))
        M[self._filled, :, 0] = np.add.reduceat(values, self._first, axis=1).T
        return M

    def onto(self, M: Array) -> Array:
        """L = G M times the width, of the boxes (boxes, COUNT, n) of the finest level."""
        levels, moments = self._tree.levels, [M]
        for k, level in reversed(list(enumerate(levels))[1:]):
            up = np.zeros((len(levels[k - 1].keys), *M.shape[1:]))
            for Z, boxes in self._octants[k]:
                up[level.parent[boxes]] += _times(Z, moments[0][boxes])
            moments.insert(0, up)
        L = np.zeros_like(moments[0])
        for k, (level, of_level) in enumerate(zip(levels, moments, strict=True)):
            if k:
                down = np.empty_like(of_level)
                for Z, boxes in self._octants[k]:
                    down[boxes] = _times(Z.T, L[level.parent[boxes]]) / 2  # over half the width
                L = down
            self._pairs.translate(
                level.one, level.other, level.offset, ends(), self._tree.G, of_level, L
            )
        return L

    def beside(self, own: range) -> NDArray[np.bool_]:
        """(own, cells) whether two cells are in one box of the finest level, or in boxes that
        touch.
        """
        at = self._leaf.keys[self._leaf.of_cell, 2:]
        return np.asarray(np.abs(at[own.start : own.stop, None] - at).max(axis=-1) <= 1)

    def between(self, moments: Array) -> tuple[Ints, Array]:
        """The box of each cell, and G times the sums over boxes of what cells (cells, COUNT, n)
        have.
        """
        M = np.zeros((len(self._leaf.keys), *moments.shape[1:]))
        np.add.at(M, self._leaf.of_cell, moments)
        return self._leaf.of_cell, np.asarray(self.onto(M) / self._leaf.width, dtype=np.float64)

    def jacobian(self, at: PlacedCharges) -> Array:
        """(cells, COUNT, 3 k) derivatives of the moments of each cell's box by its nodes."""
        N, start, k = derivatives(), 0, self._kinds[0][1].tables.shape[-1]
        B = np.zeros((len(self._leaf.of_cell), COUNT, k, 3))
        slopes = np.empty((3, len(self._q), COUNT))
        for i in range(3):
            slopes[i, self._order] = (self._q * (N[i] @ at.Y)).T / self._leaf.width
        for (cells, points), z, surface in zip(self._kinds, at.heights, at.surfaces, strict=True):
            stop, T = start + points.q.size, points.tables
            each, start = slopes[:, start:stop].reshape(3, *points.q.shape, COUNT), stop
            B[cells] += np.einsum("pk,irpa->raki", T[:, 0], each.sum(axis=3), optimize=True)
            turned = np.einsum("rpl,irpla->irpa", z, each, optimize=True)
            for d in range(2):
                along = np.einsum("rpi,irpa->rpa", surface.up[d], turned, optimize=True)
                B[cells] -= np.einsum(
                    "pk,rpi,rpa->raki", T[:, 1 + d], surface.n, along, optimize=True
                )
        return B.reshape(len(B), COUNT, 3 * k)


@dataclass(frozen=True)
class Cells:
    """Nodes of cells.

    Attributes
    ----------
    nodes
        (cells, k) global numbers, of what is modelled.
    own
        The cells of this rank.
    rows
        (own cells, k) local numbers.
    numbers
        (local nodes,) global ones.
    turn
        (copies, 3, 3) the change of a copy's nodes by that of the modelled ones.
    """

    nodes: NDArray[np.intp]
    own: range
    rows: Ints
    numbers: Ints
    turn: Array

    def of_copies(self, v: Array, sign: float) -> Array:
        """Changes (3 nodes, n) as those of the nodes of all copies' cells (copies * cells, 3 k,
        n)."""
        n, moved = v.shape[-1], v.reshape(-1, 3, v.shape[-1])
        each = [
            sign ** (i > 0) * np.tensordot(Q, moved, axes=(1, 1)) for i, Q in enumerate(self.turn)
        ]
        return np.concatenate(
            [x[:, self.nodes].transpose(1, 2, 0, 3).reshape(len(self.nodes), -1, n) for x in each]
        )

    def summed(self, f: Array) -> Array:
        """What own cells (own, 3 k, n) add up to (3 local nodes, n)."""
        summed_up = np.zeros((len(self.numbers), 3, f.shape[-1]))
        np.add.at(summed_up, self.rows, f.reshape(*self.rows.shape, 3, -1))
        return summed_up.reshape(3 * len(self.numbers), -1)


@dataclass(frozen=True)
class InteractionHessian:
    """Second derivatives of the energy of all charges: an `assembly.dense_tangent.DenseHessian`.

    Attributes
    ----------
    B
        See `MultipoleExpansion.jacobian`.
    sign
        -1 of additions to u that are opposite in the images.
    beside
        Which of the stored blocks are of nodes of cells in boxes that touch.
    """

    near: Stiffness
    far: MultipoleExpansion
    B: Array
    scale: float
    cells: Cells
    sign: float
    beside: NDArray[np.bool_]
    turning: Turning

    @cached_property
    def near_blocks(self) -> bsr_array:
        """See `assembly.dense_tangent.DenseHessian`."""
        return self.near.matrix(self.sign)

    def turned(self, q: Array) -> SinglePrecisionBlocks | None:
        """The blocks `beside` where nodes are turned by q (nodes, 4); None of several images."""
        return self.turning.turned(self.near, self.sign, self.cells.numbers, q, self._kept)

    @cached_property
    def _kept(self) -> Kept:
        return self.turning.kept(self.near, self.beside)

    def times_far(self, v: Array) -> Array:
        """See `assembly.dense_tangent.DenseHessian`."""
        own_cells = slice(self.cells.own.start, self.cells.own.stop)
        of_cell, onto = self.far.between(_each(self.B, self.cells.of_copies(v, self.sign)))
        return self.scale * self.cells.summed(
            _each(self.B[own_cells].transpose(0, 2, 1), onto[of_cell[own_cells]])
        )


def _each(B: Array, v: Array) -> Array:
    """Products of matrices (cells, m, n) with columns (cells, n, columns)."""
    return np.asarray(
        np.einsum("cmn,cn->cm", B, v[..., 0])[..., None] if v.shape[-1] == 1 else B @ v
    )


def _times(Z: Array, M: Array) -> Array:
    return (M[..., 0] @ Z.T)[..., None] if M.shape[-1] == 1 else np.asarray(Z @ M)


def _octants(keys: Ints) -> Iterator[tuple[Array, Ints]]:
    """Boxes that are the same of the eight in their parents, and the shift to these."""
    bits = keys[:, 2:] & 1
    number = bits @ np.array([4, 2, 1])
    for k in map(int, np.unique(number)):
        yield shift((k >> 2, k >> 1 & 1, k & 1)), np.flatnonzero(number == k)
