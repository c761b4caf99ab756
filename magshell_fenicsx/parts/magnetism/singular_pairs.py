"""The energy of the charges of adjacent cells, and of each cell with itself: singular pairs.

The charges of one cell act on those of its neighbours, of the same part of a shell, at distances
from zero on. As they stay with the material, energy, forces and stiffness are derivatives of one
sum over pairs of points, whose rules (`duffy_rules`) are the same for all pairs of one kind.

Elements are what has charges: the faces of a cell (both, with layers of charges between them), or
the strip along one local edge, of the height of the thickness. Copies are the modelled cells and
their images, which make the whole shell; cells of all copies are numbered copy by copy. The kind of
a pair of elements tells which elements they are and where they touch: they are one and the same
("self"), have a common side, corner or end of an edge, or touch elsewhere in their cells ("apart").
`flip` says that a common side runs the other way in the second cell. A rule is a set of quadrature
points and weights; it is shared if the second element has the same points for all points of the
first one. Lengths are over R, charges over Br R², heights over the thickness.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import basix
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.charge_derivatives import Complex, Weights, pair_derivatives
from magshell_fenicsx.parts.magnetism.charges import (
    Boxes,
    EdgeStrips,
    PointCharges,
    ShellFaces,
    gauss,
    heights,
)
from magshell_fenicsx.parts.magnetism.duffy_rules import (
    ENDS,
    REGULAR_DEGREE,
    STRIP_SCALE,
    at_corner,
    continued_across_side,
    on_edge,
    polar,
    rule_along_sides,
    strip,
    strip_rule_seen_from,
)
from magshell_fenicsx.parts.magnetism.magnetised_cells import MagnetisedShell, NodalDerivatives
from magshell_fenicsx.parts.magnetism.pairs import NO_IMAGES, Copies, Pairs, Points, Stiffness

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
CHARGE_TOLERANCE = 1e-13  # over the largest charge: elements with smaller ones count as uncharged
MAX_POINTS_AT_ONCE = 40_000  # points at which charges are computed together
# nodes along and across a strip at which charges are computed; between them they are polynomials
STRIP_NODES = (8, 4)
FACE_NODES = basix.create_element(
    basix.ElementFamily.P,
    basix.CellType.triangle,
    8,
    lagrange_variant=basix.LagrangeVariant.gl_isaac,
    discontinuous=True,
)
# kind of a pair of elements, see `SingularPairs._kinds_of_pair`
PairKind = tuple[Any, ...]


@dataclass(frozen=True)
class Places:
    """Quadrature points of elements of one kind.

    Attributes
    ----------
    X
        (n, 2) on the reference triangle.
    weights
        (n,)
    at
        (n, 2) coordinates along and across a strip, in [0, 1]; None for faces.
    """

    X: Array
    weights: Array
    at: Array | None = None

    @classmethod
    def of_strip(cls, edge: int, t: Array, eta: Array, weights: Array) -> "Places":
        """Return points of a strip on a local edge, at t (n,) along it and eta (n,) across it."""
        return cls(on_edge(edge, t), weights, np.column_stack([t, eta]))


@dataclass(frozen=True)
class Batch:
    """Pairs of cells with one kind of element on each.

    Attributes
    ----------
    pairs
        (n, 2) cells.
    own
        Number of pairs, the first ones, whose first cell is on this rank.
    left, right
        Charged points on the first and on the second element of each pair.
    charges_of_left, charges_of_right
        Of each element: places of the charges, the local edge of a strip (None for faces), and the
        factor of the charges.
    """

    pairs: Ints
    own: int
    left: Points
    right: Points
    charges_of_left: tuple[Places, int | None, float]
    charges_of_right: tuple[Places, int | None, float]


class SingularPairs:
    """Charges of all pairs of cells with a common node.

    Parameters
    ----------
    shape
        All modelled cells.
    corners
        (copies * cells, 3) numbers of the corners of all copies.
    cells, edges
        Edges that may be charged, by cell and local number.
    own_cells
        The cells of this rank; pairs without an own cell are left to other ranks.
    copies
        Images that make the whole shell, the modelled cells first.
    include_uncharged
        Whether elements without a charge are kept.

    Attributes
    ----------
    neighbours
        For each cell of all copies, the cells with a common corner, itself included.
    """

    def __init__(
        self,
        shape: MagnetisedShell,
        corners: Ints,
        cells: Ints,
        edges: Ints,
        own_cells: range,
        comm: MPI.Comm,
        copies: Copies = NO_IMAGES,
        *,
        include_uncharged: bool = False,
    ) -> None:
        """Find all singular pairs of cells and compute the charges of each."""
        self._pairs, self._copies, self._include_uncharged = Pairs(comm), copies, include_uncharged
        self._shape, self._corners, self._own = shape, corners, own_cells
        strips = np.zeros((len(shape.r0), 3), dtype=bool)
        strips[cells, edges] = True
        self._strips = np.tile(strips, (len(copies.images), 1))
        side_lengths = [np.linalg.norm(shape.r0[:, i] - shape.r0[:, j], axis=-1) for i, j in ENDS]
        # thickness over a typical side: on this scale rules are dense
        self._scale = float(shape.h / np.median(side_lengths))
        self._heights = heights(
            ShellFaces(shape, np.arange(1), include_uncharged=include_uncharged)
        )
        cells_at_corner: dict[int, list[int]] = {}
        corner_numbers = [[int(corner) for corner in corners[cell]] for cell in range(len(corners))]
        for cell, corners_of_cell in enumerate(corner_numbers):
            for corner in corners_of_cell:
                cells_at_corner.setdefault(corner, []).append(cell)
        self.neighbours = [
            sorted(
                {neighbour for corner in corners_of_cell for neighbour in cells_at_corner[corner]}
            )
            for corners_of_cell in corner_numbers
        ]
        self._boundary_sides = self._at_boundary()
        # pairs of one kind share their rules
        pairs_of_kinds: dict[PairKind, list[tuple[int, int]]] = {}
        for c, neighbours_of_cell in enumerate(self.neighbours):
            for d in neighbours_of_cell:
                if c in own_cells or d in own_cells:
                    for kind in self._kinds_of_pair(c, d):
                        pairs_of_kinds.setdefault(kind, []).append((c, d))
        self._largest_charge = 0.0
        self._batches = list(self._charged_batches(pairs_of_kinds))

    def add(self, nodes: Array, gradient: Array, stiffness: Stiffness | None = None) -> float:
        """Return the energy of pairs whose first cell is on this rank, and add derivatives.

        They are added to `gradient` (cells, k, 3), which is complete for own cells, and to
        `stiffness`. `nodes` (cells, k, 3) are the nodes of all copies.
        """
        energy = 0.0
        for batch in self._batches:
            # each pair of a batch has a row of thickness and charges of its own
            rows = np.arange(len(batch.pairs))
            left, right = (batch.left, rows), (batch.right, rows)
            energy += self._pairs.add(
                nodes, batch.pairs, batch.own, left, right, gradient, stiffness
            )
            self._pairs.finish(nodes, batch.pairs[:, 0], batch.left, gradient, stiffness)
            # where the second element's points differ from point to point, `Pairs.add` has done it
            if batch.right.tables.ndim == 3:
                self._pairs.finish(nodes, batch.pairs[:, 1], batch.right, gradient, stiffness)
        return energy

    def _at_boundary(self) -> NDArray[np.bool_]:
        """Return a mask (cells, 3) of sides that no other cell has."""
        at_boundary = np.ones((len(self._corners), 3), dtype=bool)
        for c, neighbours_of_cell in enumerate(self.neighbours):
            for d in neighbours_of_cell:
                for edge in range(3):
                    if c != d and self._common_side(c, edge, d):
                        at_boundary[c, edge] = False
        return at_boundary

    def _common_side(self, c: int, edge: int, d: int) -> tuple[int, bool] | None:
        """Return the local number in cell d of a side of cell c, and whether it runs back there.

        None if cell d does not have the side.
        """
        a, b = (int(self._corners[c, i]) for i in ENDS[edge])
        for side, (i, j) in enumerate(ENDS):
            ends = int(self._corners[d, i]), int(self._corners[d, j])
            if ends in ((a, b), (b, a)):
                return side, ends == (b, a)
        return None

    def _kinds_of_pair(self, c: int, d: int) -> Iterator[PairKind]:
        """Yield the kinds of all pairs of elements of two adjacent cells c and d.

        Elements are the faces of a cell and the strips of its charged edges. Kinds are tuples:

        - ("faces", boundary sides of c, where they touch, and there: local side in c, in d and
          `flip`, or the local corner of d);
        - ("strip", edge of c, where it touches the faces of d, and there: local side in d and
          `flip`, or the local corner of d);
        - ("strips", edge of c, where they touch, edge of d, and there: `flip`, or the common end of
          the edge of d and of c, 0 or 1).
        """
        own_corners, other_corners = (
            [int(corner) for corner in self._corners[cell]] for cell in (c, d)
        )
        boundary_sides = tuple(map(bool, self._boundary_sides[c]))
        common_sides = [
            (edge, side_in_other)
            for edge in range(3)
            if c != d and (side_in_other := self._common_side(c, edge, d))
        ]
        if c == d:
            yield "faces", boundary_sides, "self"
        elif common_sides:
            # two cells have at most one common side
            edge, (side_of_other, flip) = common_sides[0]
            yield "faces", boundary_sides, "side", edge, side_of_other, flip
        else:
            yield (
                "faces",
                boundary_sides,
                "corner",
                next(i for i, corner in enumerate(other_corners) if corner in own_corners),
            )
        for edge in np.flatnonzero(self._strips[c]):
            edge = int(edge)
            common_side, ends = self._common_side(c, edge, d), [own_corners[i] for i in ENDS[edge]]
            common_corners = [i for i, corner in enumerate(other_corners) if corner in ends]
            if common_side:
                yield "strip", edge, "side", *common_side
            else:
                yield (
                    ("strip", edge, "corner", common_corners[0])
                    if common_corners
                    else ("strip", edge, "apart")
                )
            for other_edge in np.flatnonzero(self._strips[d]):
                other_edge = int(other_edge)
                ends_of_other = [other_corners[i] for i in ENDS[other_edge]]
                if common_side and common_side[0] == other_edge:
                    yield "strips", edge, "side", other_edge, common_side[1]
                elif common_ends := [i for i in range(2) if ends_of_other[i] in ends]:
                    yield (
                        "strips",
                        edge,
                        "end",
                        other_edge,
                        common_ends[0],
                        ends.index(ends_of_other[common_ends[0]]),
                    )
                else:
                    yield "strips", edge, "apart", other_edge

    def _charged_batches(self, kinds: dict[PairKind, list[tuple[int, int]]]) -> Iterator[Batch]:
        """Yield the batches of all kinds, without those whose elements have no charge.

        `kinds` gives the pairs of cells of each kind. Pairs with a first cell of this rank come
        first. Kinds are sorted by their text, so that sums have the same order in each run.
        """
        batches = []
        for kind, pairs in sorted(kinds.items(), key=lambda batch: str(batch[0])):
            order = sorted(pairs, key=lambda pair: pair[0] not in self._own)
            batches.append(
                self._batch(
                    kind, np.array(order, dtype=np.int64), sum(c in self._own for c, _ in pairs)
                )
            )
        largest = max(
            (
                float(np.abs(q).max(initial=0.0))
                for batch in batches
                for q in (batch.left.q, batch.right.q)
            ),
            default=0,
        )
        for batch in batches:
            if self._include_uncharged or all(
                np.abs(q).max(initial=0.0) > CHARGE_TOLERANCE * largest
                for q in (batch.left.q, batch.right.q)
            ):
                yield batch

    def _batch(self, kind: PairKind, pairs: Ints, own_pairs: int) -> Batch:
        """Return the batch of all pairs (n, 2) of one kind, with their charged points.

        The first cells of the first `own_pairs` pairs are on this rank.
        """
        first, second, is_shared = self._rules_of_pair(kind)
        on_strips = kind[0] == "strips"
        # local edges of the strips, see `_kinds_of_pair`; None for faces
        left = self._points(pairs[:, 0], first, kind[1] if kind[0] != "faces" else None)
        right = self._points(pairs[:, 1], second, kind[3] if on_strips else None)
        T, heights_of_points, t, q = right  # shape functions, heights, thickness, charges
        # each point of the first element has points of its own on the second
        if not is_shared:
            points_of_first = len(first.weights)
            T = T.reshape(points_of_first, -1, *T.shape[1:])
            heights_of_points, t, q = (
                heights_of_points.reshape(points_of_first, -1, heights_of_points.shape[-1]),
                t.reshape(len(t), points_of_first, -1),
                q.reshape(len(q), points_of_first, -1, heights_of_points.shape[-1]),
            )
        weight = 1.0 if kind[0] == "strip" else 0.5  # pairs of equal elements occur in both orders
        left_points = Points(left[0], left[1], left[2], weight * left[3])
        sides = (
            (first, kind[1] if kind[0] != "faces" else None, weight),
            (second, kind[3] if on_strips else None, 1.0),
        )
        return Batch(pairs, own_pairs, left_points, Points(T, heights_of_points, t, q), *sides)

    def _rules_of_pair(self, kind: PairKind) -> tuple[Places, Places, bool]:
        """Return the points of both elements of a kind of pairs, and whether they are shared.

        If true, the second element has the same points for all points of the first one. Otherwise
        it has others for each, one group after the other. Indices of `kind` are as in
        `_kinds_of_pair`.
        """
        s = self._scale
        if kind[0] == "faces":
            first = Places(*rule_along_sides(kind[1], s))
            if kind[2] == "corner":
                return first, Places(*at_corner(kind[3])), True
            # pole of the polar rule: the point itself, or its continuation into the neighbour
            apex = (
                first.X if kind[2] == "self" else continued_across_side(first.X, kind[3:5], kind[5])
            )
            return first, self._padded([polar(point, s) for point in apex]), False
        # a strip is the first element: t along it, eta across it
        t, eta, w = strip()
        first = Places.of_strip(kind[1], t, eta, w)
        if kind[0] == "strip":
            if kind[2] == "corner":
                return first, Places(*at_corner(kind[3])), True
            if kind[2] == "apart":
                return first, Places(*_quadrature(REGULAR_DEGREE)), True
            # the pole of each polar rule is the strip's point on the common side
            foot = on_edge(kind[3], 1 - t if kind[4] else t)
            return first, self._padded([polar(point, STRIP_SCALE * s) for point in foot]), False
        if kind[2] in ("side", "end"):
            positions = 1 - t if kind[4] else t
            # continue the other edge beyond the common end, as far as the place is from it
            if kind[2] == "end":
                positions = (1 - t if kind[5] else t) * (-1 if kind[4] == 0 else 1) + kind[4]
            strips = [
                strip_rule_seen_from(float(position), float(height), s)
                for position, height in zip(positions, eta, strict=True)
            ]
            return (
                first,
                Places.of_strip(
                    kind[3], *(np.concatenate(point) for point in zip(*strips, strict=True))
                ),
                False,
            )
        return first, Places.of_strip(kind[3], t, eta, w), True

    def _padded(self, rules: list[tuple[Array, Array]]) -> Places:
        """Return rules as one, one after the other.

        Each is padded to the length of the longest one with points of weight zero.
        """
        count = max(len(w) for _, w in rules)
        X = [np.concatenate([X, np.repeat(X[:1], count - len(X), axis=0)]) for X, _ in rules]
        w = [np.concatenate([w, np.zeros(count - len(w))]) for _, w in rules]
        return Places(np.concatenate(X), np.concatenate(w))

    def _points(
        self, cells: Ints, points: Places, edge: int | None
    ) -> tuple[Array, Array, Array, Array]:
        """Return shape functions, heights, thickness and charges at points of cells.

        They are (n, 3, k), (n, layers), (cells, n) and (cells, n, layers). `cells` are numbers
        among all copies. `edge` is the local edge of strips, None for faces. Thickness is negative
        where a copy's normal is turned over; charges are times the weights of the points.
        """
        shape, X = self._shape, points.X
        copy, cells = np.divmod(cells, len(shape.r0))
        normal_signs, charge_factors = (
            factors[copy][:, None]
            for factors in (self._copies.normal_signs, self._copies.charge_factors)
        )
        T = np.ascontiguousarray(shape.element.tabulate(1, X)[..., 0].transpose(1, 0, 2))
        t = normal_signs * shape.thickness(cells, np.broadcast_to(X, (len(cells), *X.shape)))[0]
        basis = _basis(points)
        if points.at is None:
            q = np.einsum("mj,njl->nml", basis, self._on_faces[cells], optimize=True)
            layers = np.broadcast_to(self._heights, (len(X), len(self._heights)))
        else:
            assert edge is not None
            q, layers = (self._on_strips[edge][cells] @ basis.T)[..., None], points.at[:, 1:] - 0.5
        return (
            T,
            np.ascontiguousarray(layers),
            np.ascontiguousarray(t),
            points.weights[:, None] * charge_factors[..., None] * q,
        )

    @cached_property
    def _on_faces(self) -> Array:
        """Charges (modelled cells, nodes, layers) per area of the reference triangle."""
        return np.concatenate([point_charges.q for _, point_charges in self._face_charges(None)])

    def _face_charges(
        self, nodal_derivatives: NodalDerivatives | None
    ) -> Iterator[tuple[Ints, PointCharges]]:
        """Yield cells, some at a time, with their charges at the nodes `FACE_NODES`.

        With `nodal_derivatives` the charges can add derivatives to them; see `PointCharges`.
        """
        X, cells = FACE_NODES.points, np.arange(len(self._shape.r0))
        # coordinates (a, b) of the square that is folded onto the triangle: X = (a, (1 - a) b). The
        # weights are the inverse of its Jacobian: charges come per area of the triangle.
        ab, weights = np.column_stack([X[:, 0], X[:, 1] / (1 - X[:, 0])]), 1 / (1 - X[:, 0])
        cells_at_once = max(1, MAX_POINTS_AT_ONCE // len(X))
        for first in range(0, len(cells), cells_at_once):
            cells_of_chunk = cells[first : first + cells_at_once]
            faces = ShellFaces(
                self._shape, cells_of_chunk, include_uncharged=self._include_uncharged
            )
            boxes = Boxes.undivided(len(cells_of_chunk))
            yield cells_of_chunk, faces.charges_at(boxes, ab, weights, nodal_derivatives)

    @cached_property
    def _on_strips(self) -> list[Array]:
        """Charges (cells, nodes) per area of the coordinates of strips, for each local edge."""
        charges: list[Array] = [
            np.zeros((len(self._shape.r0), int(np.prod(STRIP_NODES)))) for _ in range(3)
        ]
        for edge, cells, point_charges in self._strip_charges(None):
            charges[edge][cells] = point_charges.q[..., 0]
        return charges

    def _strip_charges(
        self, nodal_derivatives: NodalDerivatives | None
    ) -> Iterator[tuple[int, Ints, PointCharges]]:
        """Yield local edge, cells and charges at the nodes of strips, for each local edge.

        With `nodal_derivatives` the charges can add derivatives to them; see `PointCharges`.
        """
        (a, _), (b, _) = (gauss(n) for n in STRIP_NODES)
        points = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
        for edge in range(3):
            cells = np.flatnonzero(self._strips[: len(self._shape.r0), edge])
            if len(cells):
                sides = EdgeStrips(self._shape, cells, np.full(len(cells), edge))
                yield (
                    edge,
                    cells,
                    sides.charges_at(
                        Boxes.undivided(len(cells)), points, np.ones(len(points)), nodal_derivatives
                    ),
                )

    def field_derivatives(
        self, moved_nodes: Complex, weights: Weights, nodal_derivatives: NodalDerivatives
    ) -> None:
        """Add derivatives by nodal values to `nodal_derivatives`.

        Nodal values are the displacement, the remanence and perhaps the thickness. The number
        that is differentiated is `weights.energy` W + `weights.force` v . dW/du, with the energy W
        and a change v of the nodes. `moved_nodes` (cells, k, 3) are the nodes of all copies, with v
        times a small step as imaginary part.
        """
        on_faces, on_strips = (
            np.zeros_like(self._on_faces),
            [np.zeros_like(charges_of_edge) for charges_of_edge in self._on_strips],
        )
        for batch in self._batches:
            # pairs whose first cell is on this rank
            pairs = batch.pairs[: batch.own]
            rows = np.arange(len(pairs))
            sides = zip((0, 1), (batch.charges_of_left, batch.charges_of_right), strict=True)
            by_charges_of_both = pair_derivatives(
                moved_nodes, pairs, (batch.left, rows), (batch.right, rows), weights
            )
            if nodal_derivatives.by_thickness is not None:
                self._by_heights(batch, pairs, moved_nodes, weights, nodal_derivatives)
            # derivatives by charges of both elements, brought to the nodes of their charges
            for side, (points, edge, factor) in sides:
                copy, cells = np.divmod(pairs[:, side], len(self._shape.r0))
                by_charges = by_charges_of_both[side][: len(pairs)].reshape(
                    len(pairs), len(points.weights), -1
                )
                by_charges = (
                    factor
                    * points.weights[:, None]
                    * self._copies.charge_factors[copy][:, None, None]
                    * by_charges
                )
                if edge is None:
                    np.add.at(
                        on_faces,
                        cells,
                        np.einsum("mj,nml->njl", _basis(points), by_charges, optimize=True),
                    )
                else:
                    np.add.at(on_strips[edge], cells, by_charges[..., 0] @ _basis(points))
        # from derivatives by charges to those by nodal values
        for cells_of_chunk, charges in self._face_charges(nodal_derivatives):
            assert charges.add_derivatives
            charges.add_derivatives(np.zeros_like(charges.x), on_faces[cells_of_chunk])
        for edge, cells, charges in self._strip_charges(nodal_derivatives):
            assert charges.add_derivatives
            charges.add_derivatives(np.zeros_like(charges.x), on_strips[edge][cells][..., None])

    def _by_heights(
        self,
        batch: Batch,
        pairs: Ints,
        moved_nodes: Complex,
        weights: Weights,
        nodal_derivatives: NodalDerivatives,
    ) -> None:
        """Add the derivatives by the thickness, which moves charges off the mid-surface.

        `pairs` are those of the batch whose first cell is on this rank. Other arguments are those
        of `field_derivatives`.
        """
        rows, points_of_both = np.arange(len(pairs)), (batch.left, batch.right)
        by_heights = pair_derivatives(
            moved_nodes, pairs, (batch.left, rows), (batch.right, rows), weights, heights=True
        )
        for side, (places, _, _) in enumerate((batch.charges_of_left, batch.charges_of_right)):
            copy, cells = np.divmod(pairs[:, side], len(self._shape.r0))
            shape = len(pairs), len(places.weights), -1
            heights = points_of_both[side].heights.reshape(shape[1:])
            by_thickness = self._copies.normal_signs[copy][:, None] * np.sum(
                heights * by_heights[side][: len(pairs)].reshape(shape), axis=-1
            )
            self._shape.add_thickness_derivatives(cells, places.X, by_thickness, nodal_derivatives)


def _basis(points: Places) -> Array:
    """Return values (m, n) at m points of the Lagrange basis of the n nodes of charges.

    Nodes of faces are `FACE_NODES`, nodes of strips the Gauss points of `STRIP_NODES`.
    """
    if points.at is None:
        return np.asarray(FACE_NODES.tabulate(0, points.X)[0, :, :, 0])
    basis = np.einsum(
        "ma,mb->mab", *(_lagrange(n, points.at[:, i]) for i, n in enumerate(STRIP_NODES))
    )
    return np.asarray(basis.reshape(len(points.X), -1))


def _lagrange(n: int, x: Array) -> Array:
    """Return values (m, n) at places x (m,) of the Lagrange basis of n Gauss points on [0, 1]."""
    # both points and places in Legendre polynomials, on [-1, 1]
    legendre = np.polynomial.legendre.legvander
    points, _ = gauss(n)
    return np.asarray(
        np.linalg.solve(legendre(2 * points - 1, n - 1).T, legendre(2 * x - 1, n - 1).T).T
    )


def _quadrature(degree: int) -> tuple[Array, Array]:
    """Return Gauss's rule of a degree on the reference triangle: points (n, 2), weights (n,)."""
    X, w = basix.make_quadrature(basix.CellType.triangle, degree)
    return np.asarray(X), np.asarray(w)
