"""The energy of charges far from each other by the fast multipole method.

The moments M of the charges in a box about its middle, which does not move, are polynomials of
their places, and the energy is a quadratic form of them, E = sum of M_A . G_AB M_B/2 over boxes far
from each other, with constant G. So forces and stiffness are its derivatives, without any sum over
pairs of charges: those by the moments are L = G M, and D = dM/du^T G dM/du + L . d2M/du2. Moments
go up to larger boxes and L comes down, so the cost grows like n.

Y are the COUNT regular solid harmonics of a place about the middle of its box, M the sums of
charges times Y, L the local expansions: the potential of distant charges at a place is Y . L. N_i
are the matrices with dY/dx_i = N_i Y. Y, M and L take lengths over the width of the box; so each
derivative divides by the width, and so does the potential. A kind of elements (faces, or strips of
edges) has P points with `layers` charges each, at heights over the mid-surface; "rows" are its
elements. Copies are the modelled cells and their images. Cells near each other interact without
multipoles. Lengths are over R.
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
from magshell_fenicsx.parts.magnetism.corotated_stiffness import BlockRotation, StoredBlocks
from magshell_fenicsx.parts.magnetism.magnetised_cells import COMPLEX_STEP
from magshell_fenicsx.parts.magnetism.multipoles import COUNT, derivatives, ends, harmonics, shift
from magshell_fenicsx.parts.magnetism.pairs import Pairs, Points, Stiffness
from magshell_fenicsx.parts.magnetism.tree import Tree

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
SECOND_DERIVATIVES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # as in pairs.c


@dataclass(frozen=True)
class SurfacePoints:
    """Points on the mid-surface: places r, unit normals n and dual bases, each (rows, P, 3).

    The dual basis (a^1, a^2) is that of the tangents: a^1 . a_1 = 1, a^1 . a_2 = 0.
    """

    r: Array
    n: Array
    dual_basis: tuple[Array, Array]

    @classmethod
    def from_nodes(cls, nodes: Array, tables: Array) -> "SurfacePoints":
        """Return the points from nodes (rows, k, 3) and tables (P, 3, k) of shape functions."""
        r, a1, a2 = np.tensordot(nodes, tables, axes=(1, 2)).transpose(3, 0, 2, 1)
        m = np.cross(a1, a2)
        size = np.linalg.norm(m, axis=-1, keepdims=True)
        n = m / size
        return cls(r, n, (np.cross(a2, n) / size, np.cross(n, a1) / size))


@dataclass(frozen=True)
class PlacedCharges:
    """Charges at their present places.

    Attributes
    ----------
    Y
        (COUNT, charges) harmonics about the middles of boxes, lengths over the boxes' width;
        charges are in the order of boxes.
    surfaces
        Points of the mid-surface under the charges, for each kind of elements.
    heights
        (rows, P, L) heights of the charges over the mid-surface, for each kind.
    """

    Y: Array
    surfaces: list[SurfacePoints]
    heights: list[Array]


class MultipoleExpansion:
    """The sum over pairs of boxes of a tree, for the charges of some kinds of elements.

    Parameters
    ----------
    tree
        Boxes, and which of them act on each other by multipoles.
    kinds
        Cells (rows,) and charged points of each kind of elements.
    own_cells
        The cells of this rank.
    pairs
        Compiled functions.

    Attributes
    ----------
    _leaf
        The finest level of boxes.
    _own_rows
        For each kind, a mask of the elements of own cells.
    _order
        Numbers of the charges in the order of boxes; the charges are those of all kinds, one after
        the other.
    _filled, _first
        Boxes with charges, and the first charge of each in that order.
    _middle, _q
        Middle of the box of each charge, and the charges, in that order.
    _octants
        For each level, matrices that move moments to the larger box, and the boxes they serve.
    _tree, _kinds, _pairs
        The parameters.
    """

    def __init__(
        self, tree: Tree, kinds: Sequence[tuple[Ints, Points]], own_cells: range, pairs: Pairs
    ) -> None:
        """Order the charges by boxes of the finest level; parameters are those of the class."""
        self._tree, self._kinds, self._pairs, self._leaf = tree, kinds, pairs, tree.levels[-1]
        self._own_rows = [
            (cells >= own_cells.start) & (cells < own_cells.stop) for cells, _ in kinds
        ]
        # box of each charge, that of its cell; `points.q[0].size` charges belong to an element
        box = np.concatenate(
            [self._leaf.of_cell[cells].repeat(points.q[0].size) for cells, points in kinds]
        )
        # charges in the order of boxes, so that each box has one slice
        self._order = np.argsort(box, kind="stable")
        self._filled, self._first = np.unique(box[self._order], return_index=True)
        self._middle = self._leaf.middle[box[self._order]]
        self._q = np.concatenate([points.q.ravel() for _, points in kinds])[self._order]
        self._octants = [list(_octants(level.keys)) for level in tree.levels]

    def place_charges(self, nodes: Array) -> PlacedCharges:
        """Return the charges at their places on cells with nodes (cells, k, 3)."""
        surfaces = [
            SurfacePoints.from_nodes(nodes[cells], points.tables) for cells, points in self._kinds
        ]
        # thickness times heights over the thickness
        heights = [points.t[..., None] * points.heights for _, points in self._kinds]
        x = []  # places of the charges of each kind
        for surface, heights_of_kind in zip(surfaces, heights, strict=True):
            x_of_kind = surface.r[:, :, None] + heights_of_kind[..., None] * surface.n[:, :, None]
            x.append(x_of_kind.reshape(-1, 3))
        in_boxes = (np.concatenate(x)[self._order] - self._middle) / self._leaf.width
        return PlacedCharges(harmonics(in_boxes), surfaces, heights)

    def add(self, charges: PlacedCharges, *, with_second_derivatives: bool) -> float:
        """Add derivatives of the energy to points' sums, and return the energy of own cells.

        The energy counts half of each pair. First derivatives by places and normals are added, and
        second ones if `with_second_derivatives`: only their part at one point, L . d2M/du2. See
        `Points.sums` for the sums at points.
        """
        # rows of the charges of all kinds: potential, and its first and perhaps second derivatives
        values = self._values_at_charges(charges, with_second_derivatives=with_second_derivatives)
        energy, start = 0.0, 0
        for (_, points), all_heights, own_rows in zip(
            self._kinds, charges.heights, self._own_rows, strict=True
        ):
            # of the own elements of this kind: charge times potential and its derivatives
            stop = start + points.q.size
            values_of_kind = values[start:stop].reshape(*points.q.shape, -1)
            weighted = points.q[own_rows, ..., None] * values_of_kind[own_rows]
            heights = all_heights[own_rows, ..., None]
            start = stop
            energy = energy + weighted[..., 0].sum() / 2
            # first and second derivatives by the charge's place
            f, K = weighted[..., 1:4], weighted[..., 4:]
            # derivatives by places and, times heights, by normals
            columns = [f, heights * f]
            if with_second_derivatives:
                columns += [K, heights * K, heights * heights * K]
            sums = np.concatenate([column.sum(axis=2) for column in columns], axis=-1)
            points.sums[own_rows, :, : sums.shape[-1]] += sums
        return float(energy)

    def _values_at_charges(self, charges: PlacedCharges, *, with_second_derivatives: bool) -> Array:
        """Return the potential of distant charges at all charges, with its derivatives.

        The columns are the potential, its 3 first derivatives and, `with_second_derivatives`, its 6
        second ones in the order of `SECOND_DERIVATIVES`. Rows are the charges of all kinds, one
        kind after the other.
        """
        # local expansions (boxes, COUNT), of which the matrices N give those of derivatives
        N, L = derivatives(), self.local_expansions(self._moments(self._q * charges.Y))[..., 0]
        matrices = [*N]
        if with_second_derivatives:
            matrices += [N[i] @ N[j] for i, j in SECOND_DERIVATIVES]
        # expansions of these columns in each box, evaluated at its charges
        expansion_of_boxes = np.stack([L, *(L @ matrix for matrix in matrices)], axis=-1)
        values = np.empty((len(self._q), expansion_of_boxes.shape[-1]))
        for box, first, last in zip(
            self._filled, self._first, [*self._first[1:], len(self._q)], strict=True
        ):
            values[self._order[first:last]] = charges.Y[:, first:last].T @ expansion_of_boxes[box]
        # expansions take lengths over the width: powers of it for each column
        powers = -np.array([1.0] + [2.0] * 3 + [3.0] * 6)[: values.shape[1]]
        values *= self._leaf.width**powers
        return values

    def charge_derivatives(
        self,
        nodes: Array,
        moved_nodes: Complex,
        kinds: Sequence[tuple[Ints, Points]],
        weights: Weights,
        *,
        heights: bool = False,
    ) -> list[list[Array]]:
        """Return derivatives of the energy and of its rate by the charges of own cells.

        The result has one list for each kind, of arrays like `q`: derivatives by charges and, with
        `heights`, by the heights of the charges over the mid-surface. The number that is
        differentiated is `weights.energy` W + `weights.force` times the rate of the energy W.

        Parameters
        ----------
        nodes
            (cells, k, 3) nodes.
        moved_nodes
            (cells, k, 3) the nodes, with rates times `COMPLEX_STEP` as imaginary parts.
        kinds
            Cells and points of each kind, as in the constructor.
        weights
            Factors of the energy and of its rate.
        """
        Y, width = self.place_charges(nodes).Y, self._leaf.width
        # of each kind: mid-surface places, normals and places x of the charges, complex
        places_of_kinds = [
            places(points, np.arange(len(points.q)), moved_nodes[cells]) for cells, points in kinds
        ]
        # rates of the charges in the order of boxes, and of their harmonics
        x_of_charges = np.concatenate([x.reshape(-1, 3) for _, _, x in places_of_kinds])
        rate = x_of_charges[self._order].imag / COMPLEX_STEP / width
        dY = _directional_derivatives(rate, Y)
        # local expansions of the potential, and of its rate due to the distant charges
        L, dL = (
            self.local_expansions(self._moments(self._q * harmonics_or_rates))[..., 0]
            for harmonics_or_rates in (Y, dY)
        )
        by_variables = [self._from_expansions((L, dL), (Y, dY), weights)]
        # a height moves a charge q along the normal: the derivative by it is q times that of Y
        if heights:
            normals = [
                np.broadcast_to(n[..., None, :], x.shape).reshape(-1, 3)
                for _, n, x in places_of_kinds
            ]
            upwards = np.concatenate(normals)[self._order] / width
            n, dn = upwards.real, upwards.imag / COMPLEX_STEP
            nY = _directional_derivatives(n, Y)
            dnY = np.asarray(_directional_derivatives(rate, nY) + _directional_derivatives(dn, Y))
            by_heights = self._from_expansions((L, dL), (nY, dnY), weights)
            by_heights[self._order] *= self._q
            by_variables.append(by_heights)
        # for each kind its derivatives by charges, and perhaps by heights
        by_kinds = [self._split_by_kind(by_variable, kinds) for by_variable in by_variables]
        return [list(of_kind) for of_kind in zip(*by_kinds, strict=True)]

    def _split_by_kind(
        self, by_charges: Array, kinds: Sequence[tuple[Ints, Points]]
    ) -> list[Array]:
        """Return derivatives by all charges as one array (rows, P, L) for each kind.

        Elements of cells of other ranks get zero.
        """
        split = np.cumsum([points.q.size for _, points in kinds])[:-1]
        parts = zip(np.split(by_charges, split), kinds, self._own_rows, strict=True)
        return [
            of_kind.reshape(points.q.shape) * own_rows[:, None, None]
            for of_kind, (_, points), own_rows in parts
        ]

    def _from_expansions(
        self, expansions: tuple[Array, Array], harmonics: tuple[Array, Array], weights: Weights
    ) -> Array:
        """Return `weights.energy` times Y . L plus `weights.force` times its rate, at charges.

        Parameters
        ----------
        expansions
            (boxes, COUNT) local expansions L, and their rates.
        harmonics
            (COUNT, charges) harmonics Y in the order of boxes, and their rates.

        Returns
        -------
        Array
            (charges,) in the order of kinds, with the width divided out.
        """
        (L, dL), (Y, dY) = expansions, harmonics
        values = np.empty(len(self._q))
        for box, first, last in zip(
            self._filled, self._first, [*self._first[1:], len(self._q)], strict=True
        ):
            y, dy = Y[:, first:last], dY[:, first:last]
            by_moments = weights.energy * (L[box] @ y) + weights.force * (L[box] @ dy + dL[box] @ y)
            values[self._order[first:last]] = by_moments / self._leaf.width
        return values

    def _moments(self, values: Array) -> Array:
        """Return moments (boxes, COUNT, 1), the sums over each box of values (COUNT, charges).

        Charges are in the order of boxes.
        """
        M = np.zeros((len(self._leaf.keys), COUNT, 1))
        M[self._filled, :, 0] = np.add.reduceat(values, self._first, axis=1).T
        return M

    def local_expansions(self, M: Array) -> Array:
        """Return L = G M times the width, for moments M (boxes, COUNT, n) of the finest level.

        L is that of the finest level too.
        """
        levels, moments = self._tree.levels, [M]  # moments of levels, the present one first
        # moments go up to larger boxes
        for k, level in reversed(list(enumerate(levels))[1:]):
            moments_of_parents = np.zeros((len(levels[k - 1].keys), *M.shape[1:]))
            for Z, boxes in self._octants[k]:
                moments_of_parents[level.parent[boxes]] += _matrix_products(Z, moments[0][boxes])
            moments.insert(0, moments_of_parents)
        L = np.zeros_like(moments[0])
        # expansions come down, and each level adds its own pairs of boxes
        for k, (level, level_moments) in enumerate(zip(levels, moments, strict=True)):
            if k:
                expansions = np.empty_like(level_moments)
                for Z, boxes in self._octants[k]:
                    # expansions are over the width, which halves
                    expansions[boxes] = _matrix_products(Z.T, L[level.parent[boxes]]) / 2
                L = expansions
            self._pairs.translate(
                level.one, level.other, level.offset, ends(), self._tree.G, level_moments, L
            )
        return L

    def adjacent_cells(self, own_cells: range) -> NDArray[np.bool_]:
        """Return a mask (own cells, cells) of pairs of cells in one box or in boxes that touch."""
        grid_places = self._leaf.keys[self._leaf.of_cell, 2:]
        return np.asarray(
            np.abs(grid_places[own_cells.start : own_cells.stop, None] - grid_places).max(axis=-1)
            <= 1
        )

    def local_expansions_of_cells(self, moments: Array) -> tuple[Ints, Array]:
        """Return the box of each cell (cells,), and the local expansions (boxes, COUNT, n).

        `moments` (cells, COUNT, n) are first summed over boxes. The width is divided out, so that
        expansions times moments are energies.
        """
        M = np.zeros((len(self._leaf.keys), *moments.shape[1:]))
        np.add.at(M, self._leaf.of_cell, moments)
        return self._leaf.of_cell, np.asarray(
            self.local_expansions(M) / self._leaf.width, dtype=np.float64
        )

    def jacobian(self, charges: PlacedCharges) -> Array:
        """Return derivatives (cells, COUNT, 3 k) of moments by the nodes of each cell.

        The moments are those of the cell's charges about the middle of the cell's box. A charge
        moves with its mid-surface place, and at a height with the normal too.
        """
        _, points_of_first_kind = self._kinds[0]
        N, start, k = derivatives(), 0, points_of_first_kind.tables.shape[-1]
        B = np.zeros((len(self._leaf.of_cell), COUNT, k, 3))
        slopes = np.empty((3, len(self._q), COUNT))
        # derivatives of moments by the places of charges, in the order of kinds again
        for i in range(3):
            slopes[i, self._order] = (self._q * (N[i] @ charges.Y)).T / self._leaf.width
        for (cells, points), heights, surface in zip(
            self._kinds, charges.heights, charges.surfaces, strict=True
        ):
            # indices: row r, point p, layer l, moment a, node k, component i of a place
            stop, T = start + points.q.size, points.tables
            slopes_of_kind = slopes[:, start:stop].reshape(3, *points.q.shape, COUNT)
            start = stop
            # by the places of the mid-surface: the sum over the layers of each point
            B[cells] += np.einsum(
                "pk,irpa->raki", T[:, 0], slopes_of_kind.sum(axis=3), optimize=True
            )
            moments_by_normal = np.einsum("rpl,irpla->irpa", heights, slopes_of_kind, optimize=True)
            for d in range(2):
                # a charge at a height moves with the normal: dn = -(n . da_d) a^d
                moments_by_tangent = np.einsum(
                    "rpi,irpa->rpa", surface.dual_basis[d], moments_by_normal, optimize=True
                )
                B[cells] -= np.einsum(
                    "pk,rpi,rpa->raki", T[:, 1 + d], surface.n, moments_by_tangent, optimize=True
                )
        return B.reshape(len(B), COUNT, 3 * k)


def _directional_derivatives(v: NDArray[np.floating[Any]], Y: Array) -> Array:
    """Return the derivatives (COUNT, charges) of harmonics Y along v (charges, 3).

    Harmonics take lengths over the width of the box, and so must v.
    """
    N = derivatives()
    return np.asarray(v[:, 0] * (N[0] @ Y) + v[:, 1] * (N[1] @ Y) + v[:, 2] * (N[2] @ Y))


@dataclass(frozen=True)
class CellNodes:
    """Numbers of the nodes of cells.

    Attributes
    ----------
    nodes
        (modelled cells, k) global numbers of nodes.
    own
        The cells of this rank.
    rows
        (own cells, k) local numbers of nodes.
    numbers
        (local nodes,) global numbers of nodes.
    turn
        (copies, 3, 3) the change of a copy's nodes from a change of the modelled nodes.
    """

    nodes: NDArray[np.intp]
    own: range
    rows: Ints
    numbers: Ints
    turn: Array

    def changes_of_copies(self, v: Array, sign: float) -> Array:
        """Return changes (copies * cells, 3 k, n) of all copies' cells from nodal changes v.

        v is (3 nodes, n); `sign` is -1 for changes that are opposite in the images. The first copy,
        the modelled part itself, has no sign.
        """
        n, moved = v.shape[-1], v.reshape(-1, 3, v.shape[-1])
        # (3, nodes, n) of each copy, with the factor `sign` for all but the first
        changes = [
            sign ** (i > 0) * np.tensordot(Q, moved, axes=(1, 1)) for i, Q in enumerate(self.turn)
        ]
        cells = len(self.nodes)
        return np.concatenate(
            [
                # from (3, cells, k, n)
                change_of_copy[:, self.nodes].transpose(1, 2, 0, 3).reshape(cells, -1, n)
                for change_of_copy in changes
            ]
        )

    def sum_at_nodes(self, f: Array) -> Array:
        """Return sums (3 local nodes, n) at nodes of values f (own cells, 3 k, n) in cells."""
        sums = np.zeros((len(self.numbers), 3, f.shape[-1]))
        np.add.at(sums, self.rows, f.reshape(*self.rows.shape, 3, -1))
        return sums.reshape(3 * len(self.numbers), -1)


@dataclass(frozen=True)
class InteractionHessian:
    """Second derivatives of the energy of all charges: an `assembly.dense_tangent.DenseHessian`.

    Attributes
    ----------
    near
        Blocks between nodes of cells near each other.
    far
        Multipole expansion of all others.
    B
        (cells, COUNT, 3 k) derivatives of the multipole moments of a cell's charges by its nodes.
    scale
        Factor of the far part.
    cells
        Numbers of nodes.
    sign
        1 if additions to u move the images as mirror images, -1 if they move them oppositely.
    is_adjacent
        Which of the stored blocks are of nodes of cells in boxes that touch.
    block_rotation
        Rotation of blocks with their nodes.
    """

    near: Stiffness
    far: MultipoleExpansion
    B: Array
    scale: float
    cells: CellNodes
    sign: float
    is_adjacent: NDArray[np.bool_]
    block_rotation: BlockRotation

    @cached_property
    def near_blocks(self) -> bsr_array:
        """Blocks of near nodes, see `assembly.dense_tangent.DenseHessian`."""
        return self.near.matrix(self.sign)

    def rotated_blocks(self, q: Array) -> SinglePrecisionBlocks | None:
        """Return the blocks `is_adjacent`, each rotated with its nodes; None with several images.

        So blocks of an earlier state serve a later one. q (nodes, 4) are unit quaternions, scalar
        last.
        """
        return self.block_rotation.rotated_blocks(
            self.near, self.sign, self.cells.numbers, q, self._stored_blocks
        )

    @cached_property
    def _stored_blocks(self) -> StoredBlocks:
        return self.block_rotation.stored_blocks(self.near, self.is_adjacent)

    def times_far(self, v: Array) -> Array:
        """Return products of the multipoles' part with vectors v (3 nodes, n); collective.

        The rows (3 local nodes, n) are those of this rank's cells; v has all nodes.
        """
        own_cells = slice(self.cells.own.start, self.cells.own.stop)
        # changes of the nodes of all cells, and of their moments: dM = B du
        changes = self.cells.changes_of_copies(v, self.sign)
        changes_of_moments = _cellwise_products(self.B, changes)
        # the box of each cell, and local expansions of boxes: L = G dM; then forces B^T L
        box_of_cell, local_expansions = self.far.local_expansions_of_cells(changes_of_moments)
        forces_on_cells = _cellwise_products(
            self.B[own_cells].transpose(0, 2, 1), local_expansions[box_of_cell[own_cells]]
        )
        return self.scale * self.cells.sum_at_nodes(forces_on_cells)


def _cellwise_products(B: Array, v: Array) -> Array:
    """Return products (cells, m, columns) of matrices B (cells, m, n) and v (cells, n, columns)."""
    return np.asarray(
        np.einsum("cmn,cn->cm", B, v[..., 0])[..., None] if v.shape[-1] == 1 else B @ v
    )


def _matrix_products(Z: Array, M: Array) -> Array:
    """Return products (boxes, m, n) of a matrix Z (m, COUNT) with moments M (boxes, COUNT, n)."""
    return (M[..., 0] @ Z.T)[..., None] if M.shape[-1] == 1 else np.asarray(Z @ M)


def _octants(keys: Ints) -> Iterator[tuple[Array, Ints]]:
    """Yield, for each of the eight octants, the shift to the parent and the boxes in that octant.

    `keys` (boxes, 5) end with the place in the grid, whose last bits tell the octant.
    """
    bits = keys[:, 2:] & 1
    octant = bits @ np.array([4, 2, 1])
    for octant_number in map(int, np.unique(octant)):
        yield (
            shift((octant_number >> 2, octant_number >> 1 & 1, octant_number & 1)),
            np.flatnonzero(octant == octant_number),
        )
