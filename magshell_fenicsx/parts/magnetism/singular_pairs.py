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
# kind of a pair of elements: ("faces", ...), ("strip", edge, ...) or ("strips", edge, ...), with
# where they touch and the local sides or corners there
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
        (n, 2) coordinates of the points along and across a strip, in [0, 1]; None for faces.
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
    _pairs
        The sums over pairs of points, in C.
    _shape, _corners, _own, _copies, _include_uncharged
        The parameters `shape`, `corners`, `own_cells`, `copies` and `include_uncharged`.
    _strips
        (copies * cells, 3) whether each local edge has a charged strip.
    _boundary_sides
        (copies * cells, 3) whether each side belongs to no other cell.
    _scale
        Thickness over a typical side of a cell: on this scale rules are dense.
    _heights
        (layers,) heights of the layers of charges of a cell, from -1/2 to 1/2.
    _batches
        The pairs of elements with charges, by kinds.
    _on_faces
        Charges (modelled cells, nodes, layers) of the faces at the nodes `FACE_NODES`, per area of
        the reference triangle.
    _on_strips
        For each local edge, charges (modelled cells, nodes) of its strip at the Gauss points of
        `STRIP_NODES`, per area of the coordinates along and across the strip.
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
        self._scale = float(shape.h / np.median(side_lengths))
        self._heights = heights(
            ShellFaces(shape, np.arange(1), include_uncharged=include_uncharged)
        )
        self.neighbours = _cells_with_common_corner(corners)
        self._boundary_sides = self._at_boundary()
        # pairs of one kind share their rules
        pairs_of_kinds: dict[PairKind, list[tuple[int, int]]] = {}
        for c, neighbours_of_cell in enumerate(self.neighbours):
            for d in neighbours_of_cell:
                if c in own_cells or d in own_cells:
                    for kind in self._kinds_of_pair(c, d):
                        pairs_of_kinds.setdefault(kind, []).append((c, d))
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
            # `add` has left sums of derivatives at the points; `finish` brings them to the nodes
            self._pairs.finish(nodes, batch.pairs[:, 0], batch.left, gradient, stiffness)
            # a second element with points of its own for each first point has no such sums: `add`
            # has brought its derivatives to the nodes already
            is_shared = batch.right.tables.ndim == 3
            if is_shared:
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
        """Return the local number in cell d of the local side `edge` of cell c, and `flip`.

        `flip` is whether the side runs the other way in cell d. None if cell d does not have the
        side.
        """
        # the corners of both cells have the same numbers where they coincide
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
        own_corners = list(map(int, self._corners[c]))
        other_corners = list(map(int, self._corners[d]))
        yield self._kind_of_faces(c, d)
        for edge in map(int, np.flatnonzero(self._strips[c])):
            # the strip of the first cell with the faces of the second
            common_side, ends = self._common_side(c, edge, d), [own_corners[i] for i in ENDS[edge]]
            common_corners = [i for i, corner in enumerate(other_corners) if corner in ends]
            if common_side:
                yield "strip", edge, "side", *common_side
            elif common_corners:
                yield "strip", edge, "corner", common_corners[0]
            else:
                yield "strip", edge, "apart"
            # and with its strips
            for other_edge in map(int, np.flatnonzero(self._strips[d])):
                ends_of_other = [other_corners[i] for i in ENDS[other_edge]]
                common_ends = [i for i in range(2) if ends_of_other[i] in ends]
                if common_side and common_side[0] == other_edge:
                    yield "strips", edge, "side", other_edge, common_side[1]
                elif common_ends:
                    end_of_other = common_ends[0]
                    own_end = ends.index(ends_of_other[end_of_other])
                    yield "strips", edge, "end", other_edge, end_of_other, own_end
                else:
                    yield "strips", edge, "apart", other_edge

    def _kind_of_faces(self, c: int, d: int) -> PairKind:
        """Return the kind of the faces of two adjacent cells c and d.

        It is ("faces", boundary sides of c, where they touch, and there: local side in c, in d and
        `flip`, or the local corner of d).
        """
        boundary_sides = tuple(map(bool, self._boundary_sides[c]))
        if c == d:
            return "faces", boundary_sides, "self"
        for edge in range(3):  # two cells have at most one common side
            if common_side := self._common_side(c, edge, d):
                side_of_other, flip = common_side
                return "faces", boundary_sides, "side", edge, side_of_other, flip
        own_corners = [int(corner) for corner in self._corners[c]]
        other_corners = [int(corner) for corner in self._corners[d]]
        corner_of_other = next(i for i, corner in enumerate(other_corners) if corner in own_corners)
        return "faces", boundary_sides, "corner", corner_of_other

    def _charged_batches(self, kinds: dict[PairKind, list[tuple[int, int]]]) -> Iterator[Batch]:
        """Yield the batches of all kinds, without those whose elements have no charge.

        `kinds` gives the pairs of cells of each kind. Pairs with a first cell of this rank come
        first. Kinds are sorted by their text, so that sums have the same order in each run.
        """
        batches = []
        for kind, pairs in sorted(kinds.items(), key=lambda kind_and_pairs: str(kind_and_pairs[0])):
            own_first = sorted(pairs, key=lambda pair: pair[0] not in self._own)
            own_count = sum(c in self._own for c, _ in pairs)
            batches.append(self._batch(kind, np.array(own_first, dtype=np.int64), own_count))

        charges_of_batches = [_largest_charges(batch) for batch in batches]
        largest = max((charge for charges in charges_of_batches for charge in charges), default=0)
        for batch, charges in zip(batches, charges_of_batches, strict=True):
            is_charged = all(charge > CHARGE_TOLERANCE * largest for charge in charges)
            if self._include_uncharged or is_charged:
                yield batch

    def _batch(self, kind: PairKind, pairs: Ints, own_pairs: int) -> Batch:
        """Return the batch of all pairs (n, 2) of one kind, with their charged points.

        The first cells of the first `own_pairs` pairs are on this rank.
        """
        first, second, is_shared = self._rules_of_pair(kind)
        # a kind is ("faces", ...), ("strip", edge, ...) or ("strips", edge, touch, other edge, ...)
        edge = kind[1] if kind[0] != "faces" else None
        other_edge = kind[3] if kind[0] == "strips" else None
        # shape functions, heights, thickness and charges at the points of the first elements
        T, layer_heights, t, q = self._points(pairs[:, 0], first, edge)
        weight = 1.0 if kind[0] == "strip" else 0.5  # pairs of equal elements occur in both orders
        left = Points(T, layer_heights, t, weight * q)
        # and of the second ones
        T, layer_heights, t, q = self._points(pairs[:, 1], second, other_edge)
        if not is_shared:  # each of P points of the first element has its own on the second
            P, L = len(first.weights), layer_heights.shape[-1]
            T = T.reshape(P, -1, *T.shape[1:])
            layer_heights = layer_heights.reshape(P, -1, L)
            t = t.reshape(len(t), P, -1)
            q = q.reshape(len(q), P, -1, L)
        return Batch(
            pairs=pairs,
            own=own_pairs,
            left=left,
            right=Points(T, layer_heights, t, q),
            charges_of_left=(first, edge, weight),
            charges_of_right=(second, other_edge, 1.0),
        )

    def _rules_of_pair(self, kind: PairKind) -> tuple[Places, Places, bool]:
        """Return the points of both elements of a kind of pairs, and whether they are shared.

        If true, the second element has the same points for all points of the first one. Otherwise
        it has others for each, one group after the other. The first element of a kind is the faces
        ("faces") or a strip ("strip", "strips"), the second the faces or, in "strips", a strip.
        """
        if kind[0] == "faces":
            return self._rules_of_faces(kind)
        second, is_shared = (
            self._rule_of_faces_at_strip(kind)
            if kind[0] == "strip"
            else self._rule_of_strip_at_strip(kind)
        )
        edge, (t, eta, weights) = kind[1], strip()  # along and across the first strip
        return Places.of_strip(edge, t, eta, weights), second, is_shared

    def _rules_of_faces(self, kind: PairKind) -> tuple[Places, Places, bool]:
        """Return the points of the faces of both cells, and whether the second ones are shared.

        The points of the first cell are dense at its boundary sides. Where cells touch at a corner
        the second has one rule, dense at this corner. Else each first point has a polar rule of its
        own on the second cell.
        """
        _, boundary_sides, touch, *position = kind
        first = Places(*rule_along_sides(boundary_sides, self._scale))
        if touch == "corner":
            (corner_of_other,) = position
            return first, Places(*at_corner(corner_of_other)), True
        # pole of the polar rule: the point itself, or its continuation into the neighbour
        poles = first.X
        if touch == "side":
            side, side_of_other, flip = position
            poles = continued_across_side(first.X, (side, side_of_other), flip)
        return first, self._padded([polar(pole, self._scale) for pole in poles]), False

    def _rule_of_faces_at_strip(self, kind: PairKind) -> tuple[Places, bool]:
        """Return the points on the faces of a cell d for a strip, and whether they are shared.

        `kind` is ("strip", edge, where it touches d, and there: local side in d and `flip`, or the
        local corner of d).
        """
        _, _, touch, *position = kind
        if touch == "corner":
            (corner_of_other,) = position
            return Places(*at_corner(corner_of_other)), True
        if touch == "apart":
            return Places(*_quadrature(REGULAR_DEGREE)), True
        # the pole of each polar rule is the strip's point on the common side
        side_of_other, flip = position
        t, _, _ = strip()
        poles = on_edge(side_of_other, 1 - t if flip else t)
        return self._padded([polar(pole, STRIP_SCALE * self._scale) for pole in poles]), False

    def _rule_of_strip_at_strip(self, kind: PairKind) -> tuple[Places, bool]:
        """Return the points on a second strip for a first one, and whether they are shared.

        `kind` is ("strips", edge, where they touch, other edge, and there: `flip`, or the common
        end of the other edge and of the edge). A point of the first strip is at t along it and at
        eta across it. `positions` are the places of these points along the other edge.
        """
        _, _, touch, other_edge, *position = kind
        t, eta, w = strip()
        if touch == "apart":
            return Places.of_strip(other_edge, t, eta, w), True
        if touch == "side":
            (flip,) = position
            positions = 1 - t if flip else t
        else:
            # on the continuation of the other edge beyond the common end, as far from this end as
            # the point itself
            end_of_other, own_end = position
            distance_from_end = 1 - t if own_end else t
            positions = distance_from_end * (-1 if end_of_other == 0 else 1) + end_of_other
        rules = [
            strip_rule_seen_from(float(position), float(height), self._scale)
            for position, height in zip(positions, eta, strict=True)
        ]
        # one rule after the other: places along and across the strip, and weights
        along, across, weights = (np.concatenate(values) for values in zip(*rules, strict=True))
        return Places.of_strip(other_edge, along, across, weights), False

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

        Parameters
        ----------
        cells
            Numbers of the cells among all copies.
        points
            n points on the faces of each cell, or on a strip.
        edge
            Local edge of the strip; None for faces.

        Returns
        -------
        T
            (n, 3, k) shape functions and their derivatives by both reference coordinates.
        layer_heights
            (n, layers) heights of the layers of charges.
        t
            (cells, n) thickness, negative where a copy's normal is turned over.
        q
            (cells, n, layers) charges times the weights of the points.
        """
        shape, X = self._shape, points.X
        copy, cells = np.divmod(cells, len(shape.r0))
        normal_signs, charge_factors = (
            factors[copy][:, None]
            for factors in (self._copies.normal_signs, self._copies.charge_factors)
        )
        T = np.ascontiguousarray(shape.element.tabulate(1, X)[..., 0].transpose(1, 0, 2))
        t = normal_signs * shape.thickness(cells, np.broadcast_to(X, (len(cells), *X.shape)))[0]
        # charges at the points, from those at the nodes of faces or strips
        basis = _basis(points)
        if points.at is None:  # faces
            q = np.einsum("mj,njl->nml", basis, self._on_faces[cells], optimize=True)
            layer_heights = np.broadcast_to(self._heights, (len(X), len(self._heights)))
        else:
            assert edge is not None
            # a strip has one layer; its height is the coordinate across it, from -1/2 to 1/2
            q = (self._on_strips[edge][cells] @ basis.T)[..., None]
            layer_heights = points.at[:, 1:] - 0.5
        return (
            T,
            np.ascontiguousarray(layer_heights),
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

        With `nodal_derivatives`, the charges have a function `add_derivatives`: it turns
        derivatives by charges into those by nodal values, and adds them to `nodal_derivatives`.
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

        With `nodal_derivatives`, the charges have a function `add_derivatives`: it turns
        derivatives by charges into those by nodal values, and adds them to `nodal_derivatives`.
        """
        # Gauss points along and across a strip
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
        # derivatives by the charges at the nodes of faces and strips
        on_faces = np.zeros_like(self._on_faces)
        on_strips = [np.zeros_like(charges_of_edge) for charges_of_edge in self._on_strips]
        for batch in self._batches:
            # pairs whose first cell is on this rank
            pairs = batch.pairs[: batch.own]
            rows = np.arange(len(pairs))
            by_charges_of_both = pair_derivatives(
                moved_nodes, pairs, (batch.left, rows), (batch.right, rows), weights
            )
            if nodal_derivatives.by_thickness is not None:
                self._by_heights(batch, pairs, moved_nodes, weights, nodal_derivatives)
            # derivatives by charges of both elements, brought to the nodes of their charges: of the
            # faces (`edge` is None), or of the strip on a local edge
            for side, charges in enumerate((batch.charges_of_left, batch.charges_of_right)):
                points, edge, factor = charges
                copy, cells = np.divmod(pairs[:, side], len(self._shape.r0))
                charge_factors = self._copies.charge_factors[copy][:, None, None]
                by_charges = by_charges_of_both[side][: len(pairs)].reshape(
                    len(pairs), len(points.weights), -1
                )
                by_charges = factor * points.weights[:, None] * charge_factors * by_charges
                basis = _basis(points)
                if edge is None:
                    by_nodes = np.einsum("mj,nml->njl", basis, by_charges, optimize=True)
                    np.add.at(on_faces, cells, by_nodes)
                else:
                    np.add.at(on_strips[edge], cells, by_charges[..., 0] @ basis)
        # from derivatives by charges to those by nodal values
        for cells_of_chunk, face_charges in self._face_charges(nodal_derivatives):
            assert face_charges.add_derivatives
            face_charges.add_derivatives(np.zeros_like(face_charges.x), on_faces[cells_of_chunk])
        for edge, cells, strip_charges in self._strip_charges(nodal_derivatives):
            assert strip_charges.add_derivatives
            strip_charges.add_derivatives(
                np.zeros_like(strip_charges.x), on_strips[edge][cells][..., None]
            )

    def _by_heights(
        self,
        batch: Batch,
        pairs: Ints,
        moved_nodes: Complex,
        weights: Weights,
        nodal_derivatives: NodalDerivatives,
    ) -> None:
        """Add the derivatives by the thickness to `nodal_derivatives`.

        The thickness moves charges off the mid-surface. `pairs` are those of the batch whose first
        cell is on this rank. `moved_nodes` (cells, k, 3) are the nodes of all copies, with a small
        step along v as imaginary part; derivatives are those of `weights.energy` W +
        `weights.force` v . dW/du.
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


def _largest_charges(batch: Batch) -> list[float]:
    """Return the largest charge on the first and on the second elements of a batch."""
    return [float(np.abs(q).max(initial=0.0)) for q in (batch.left.q, batch.right.q)]


def _cells_with_common_corner(corners: Ints) -> list[list[int]]:
    """Return for each cell the cells with a common corner, itself included, in ascending order.

    `corners` (cells, 3) are the numbers of the cells' corners.
    """
    corner_numbers = [list(map(int, corners_of_cell)) for corners_of_cell in corners]
    cells_at_corner: dict[int, list[int]] = {}
    for cell, corners_of_cell in enumerate(corner_numbers):
        for corner in corners_of_cell:
            cells_at_corner.setdefault(corner, []).append(cell)
    neighbours_of_cells = list[list[int]]()
    for corners_of_cell in corner_numbers:
        neighbours = {cell for corner in corners_of_cell for cell in cells_at_corner[corner]}
        neighbours_of_cells.append(sorted(neighbours))
    return neighbours_of_cells


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
