"""The energy of the charges of cells that touch each other, and of each cell with itself.

The charges of one cell act on those of its neighbours, of the same part of a shell, at distances
from zero on. As they stay with the material, energy, forces and stiffness are derivatives of one
sum over pairs of points; only their rules are others than far away (`touching`), the same for all
pairs of one kind.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import basix
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.charge_derivatives import Complex, Weights, add
from magshell_fenicsx.parts.magnetism.charges import Boxes, Faces, Found, Sides, gauss, heights
from magshell_fenicsx.parts.magnetism.duffy_rules import (
    APART,
    ENDS,
    SPLIT,
    along_strip,
    around,
    at_corner,
    beyond,
    on_edge,
    polar,
    strip,
)
from magshell_fenicsx.parts.magnetism.magnetised_cells import Nodal, Shape
from magshell_fenicsx.parts.magnetism.pairs import ALL, Copies, Pairs, Points, Stiffness

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
NOTHING = 1e-13  # of the largest charge: elements without any
CHUNK = 40_000  # points at which charges are found at once
ON_STRIP = (
    8,
    4,
)  # nodes along and across a strip at which charges are found; between them they are polynomials
NODES = basix.create_element(
    basix.ElementFamily.P,
    basix.CellType.triangle,
    8,
    lagrange_variant=basix.LagrangeVariant.gl_isaac,
    discontinuous=True,
)
Kind = tuple[
    Any, ...
]  # of a pair of elements: the first one with its sides, the second, and where they touch


@dataclass(frozen=True)
class Places:
    """Points of elements of one kind.

    Attributes
    ----------
    X
        (n, 2) on the reference triangle.
    weights
        (n,)
    at
        Coordinates (n, 2) of a strip, in [0, 1]; None of faces.
    """

    X: Array
    weights: Array
    at: Array | None = None

    @classmethod
    def of_strip(cls, edge: int, t: Array, eta: Array, weights: Array) -> "Places":
        return cls(on_edge(edge, t), weights, np.column_stack([t, eta]))


@dataclass(frozen=True)
class Batch:
    """Pairs of cells with elements of one kind each.

    Attributes
    ----------
    own
        How many of the first pairs have their first cell on this rank.
    of_left, of_right
        Where the charges are found, with the local edges of strips, and what these are multiplied
        by.
    """

    pairs: Ints
    own: int
    left: Points
    right: Points
    of_left: tuple[Places, int | None, float]
    of_right: tuple[Places, int | None, float]


class Near:
    """All pairs of cells with a common node.

    Parameters
    ----------
    shape
        All cells that are modelled.
    corners
        (copies * cells, 3) numbers of the corners of all copies.
    cells, edges
        Edges that may be charged, by cell and local number.
    own
        The cells of this rank; pairs without one of them are left to others.
    may
        Whether what has no charge may get one.
    """

    def __init__(
        self,
        shape: Shape,
        corners: Ints,
        cells: Ints,
        edges: Ints,
        own: range,
        comm: MPI.Comm,
        copies: Copies = ALL,
        *,
        may: bool = False,
    ) -> None:
        self._pairs, self._copies, self._may = Pairs(comm), copies, may
        self._shape, self._corners, self._own = shape, corners, own
        strips = np.zeros((len(shape.r0), 3), dtype=bool)
        strips[cells, edges] = True
        self._strips = np.tile(strips, (len(copies.images), 1))
        sides = [np.linalg.norm(shape.r0[:, i] - shape.r0[:, j], axis=-1) for i, j in ENDS]
        self._scale = float(shape.h / np.median(sides))
        self._heights = heights(Faces(shape, np.arange(1), may=may))
        meeting: dict[int, list[int]] = {}
        numbers = [[int(each) for each in corners[cell]] for cell in range(len(corners))]
        for cell, three in enumerate(numbers):
            for each in three:
                meeting.setdefault(each, []).append(cell)
        self.touching = [
            sorted({other for each in three for other in meeting[each]}) for three in numbers
        ]
        self._free = self._at_boundary()
        kinds: dict[Kind, list[tuple[int, int]]] = {}
        for c, others in enumerate(self.touching):
            for d in others:
                if c in own or d in own:
                    for kind in self._kinds(c, d):
                        kinds.setdefault(kind, []).append((c, d))
        self._most = 0.0
        self._batches = list(self._charged(kinds))

    def add(self, nodes: Array, gradient: Array, stiffness: Stiffness | None = None) -> float:
        """The energy of pairs whose first cell is here; their gradient (cells, k, 3) is added,
        right for own cells.
        """
        energy = 0.0
        for batch in self._batches:
            rows = np.arange(len(batch.pairs))
            left, right = (batch.left, rows), (batch.right, rows)
            energy += self._pairs.add(
                nodes, batch.pairs, batch.own, left, right, gradient, stiffness
            )
            self._pairs.finish(nodes, batch.pairs[:, 0], batch.left, gradient, stiffness)
            if batch.right.tables.ndim == 3:
                self._pairs.finish(nodes, batch.pairs[:, 1], batch.right, gradient, stiffness)
        return energy

    def _at_boundary(self) -> NDArray[np.bool_]:
        """(cells, 3) sides that no other cell has."""
        at_boundary = np.ones((len(self._corners), 3), dtype=bool)
        for c, others in enumerate(self.touching):
            for d in others:
                for edge in range(3):
                    if c != d and self._shared(c, edge, d):
                        at_boundary[c, edge] = False
        return at_boundary

    def _shared(self, c: int, edge: int, d: int) -> tuple[int, bool] | None:
        """The local number in d of a side of c, and whether it runs the other way."""
        a, b = (int(self._corners[c, i]) for i in ENDS[edge])
        for side, (i, j) in enumerate(ENDS):
            ends = int(self._corners[d, i]), int(self._corners[d, j])
            if ends in ((a, b), (b, a)):
                return side, ends == (b, a)
        return None

    def _kinds(self, c: int, d: int) -> Iterator[Kind]:
        """Of all elements of two cells that touch."""
        mine, theirs = ([int(each) for each in self._corners[cell]] for cell in (c, d))
        mask = tuple(map(bool, self._free[c]))
        sides = [(e, shared) for e in range(3) if c != d and (shared := self._shared(c, e, d))]
        if c == d:
            yield "faces", mask, "self"
        elif sides:
            e, (side_of_other, flip) = sides[0]
            yield "faces", mask, "side", e, side_of_other, flip
        else:
            yield "faces", mask, "corner", next(i for i, each in enumerate(theirs) if each in mine)
        for e in np.flatnonzero(self._strips[c]):
            e = int(e)
            common, ends = self._shared(c, e, d), [mine[i] for i in ENDS[e]]
            met = [i for i, each in enumerate(theirs) if each in ends]
            if common:
                yield "strip", e, "side", *common
            else:
                yield ("strip", e, "corner", met[0]) if met else ("strip", e, "apart")
            for f in np.flatnonzero(self._strips[d]):
                f = int(f)
                other = [theirs[i] for i in ENDS[f]]
                if common and common[0] == f:
                    yield "strips", e, "side", f, common[1]
                elif at := [i for i in range(2) if other[i] in ends]:
                    yield "strips", e, "end", f, at[0], ends.index(other[at[0]])
                else:
                    yield "strips", e, "apart", f

    def _charged(self, kinds: dict[Kind, list[tuple[int, int]]]) -> Iterator[Batch]:
        made = []
        for kind, pairs in sorted(kinds.items(), key=lambda each: str(each[0])):
            order = sorted(pairs, key=lambda pair: pair[0] not in self._own)
            made.append(
                self._batch(
                    kind, np.array(order, dtype=np.int64), sum(c in self._own for c, _ in pairs)
                )
            )
        most = max(
            (
                float(np.abs(q).max(initial=0.0))
                for each in made
                for q in (each.left.q, each.right.q)
            ),
            default=0,
        )
        for each in made:
            if self._may or all(
                np.abs(q).max(initial=0.0) > NOTHING * most for q in (each.left.q, each.right.q)
            ):
                yield each

    def _batch(self, kind: Kind, pairs: Ints, own: int) -> Batch:
        first, second, same = self._rules(kind)
        on_strips = kind[0] == "strips"
        left = self._points(pairs[:, 0], first, kind[1] if kind[0] != "faces" else None)
        right = self._points(pairs[:, 1], second, kind[3] if on_strips else None)
        T, h, t, q = right
        if not same:
            count = len(first.weights)
            T = T.reshape(count, -1, *T.shape[1:])
            h, t, q = (
                h.reshape(count, -1, h.shape[-1]),
                t.reshape(len(t), count, -1),
                q.reshape(len(q), count, -1, h.shape[-1]),
            )
        share = 1.0 if kind[0] == "strip" else 0.5  # where the pair stands in both orders
        left_points = Points(left[0], left[1], left[2], share * left[3])
        of = (
            (first, kind[1] if kind[0] != "faces" else None, share),
            (second, kind[3] if on_strips else None, 1.0),
        )
        return Batch(pairs, own, left_points, Points(T, h, t, q), *of)

    def _rules(self, kind: Kind) -> tuple[Places, Places, bool]:
        """Points of both elements; of the second one those for each of the first, or, if true, the
        same for all.
        """
        s = self._scale
        if kind[0] == "faces":
            first = Places(*around(kind[1], s))
            if kind[2] == "corner":
                return first, Places(*at_corner(kind[3])), True
            apex = first.X if kind[2] == "self" else beyond(first.X, kind[3:5], kind[5])
            return first, self._each([polar(each, s) for each in apex]), False
        t, eta, w = strip()
        first = Places.of_strip(kind[1], t, eta, w)
        if kind[0] == "strip":
            if kind[2] == "corner":
                return first, Places(*at_corner(kind[3])), True
            if kind[2] == "apart":
                return first, Places(*_quadrature(APART)), True
            foot = on_edge(kind[3], 1 - t if kind[4] else t)
            return first, self._each([polar(each, SPLIT * s) for each in foot]), False
        if kind[2] in ("side", "end"):
            at = 1 - t if kind[4] else t
            if kind[2] == "end":  # as far from the common end as the place is, beyond it
                at = (1 - t if kind[5] else t) * (-1 if kind[4] == 0 else 1) + kind[4]
            strips = [along_strip(float(a), float(b), s) for a, b in zip(at, eta, strict=True)]
            return (
                first,
                Places.of_strip(
                    kind[3], *(np.concatenate(each) for each in zip(*strips, strict=True))
                ),
                False,
            )
        return first, Places.of_strip(kind[3], t, eta, w), True

    def _each(self, rules: list[tuple[Array, Array]]) -> Places:
        """Rules for each of some points, made as long as the longest with points of weight zero."""
        longest = max(len(w) for _, w in rules)
        X = [np.concatenate([X, np.repeat(X[:1], longest - len(X), axis=0)]) for X, _ in rules]
        w = [np.concatenate([w, np.zeros(longest - len(w))]) for _, w in rules]
        return Places(np.concatenate(X), np.concatenate(w))

    def _points(
        self, cells: Ints, points: Places, edge: int | None
    ) -> tuple[Array, Array, Array, Array]:
        """Tables (n, 3, k), heights (n, layers), thickness (cells, n), and charges (cells, n,
        layers).
        """
        shape, X = self._shape, points.X
        copy, cells = np.divmod(cells, len(shape.r0))
        up, charge = (each[copy][:, None] for each in (self._copies.up, self._copies.charges))
        T = np.ascontiguousarray(shape.element.tabulate(1, X)[..., 0].transpose(1, 0, 2))
        t = up * shape.thickness(cells, np.broadcast_to(X, (len(cells), *X.shape)))[0]
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
            points.weights[:, None] * charge[..., None] * q,
        )

    @cached_property
    def _on_faces(self) -> Array:
        """(cells, n, layers) charges per area of the reference triangle at nodes of what is
        modelled.
        """
        return np.concatenate([found.q for _, found in self._found_on_faces(None)])

    def _found_on_faces(self, into: Nodal | None) -> Iterator[tuple[Ints, Found]]:
        X, cells = NODES.points, np.arange(len(self._shape.r0))
        ab, weights = np.column_stack([X[:, 0], X[:, 1] / (1 - X[:, 0])]), 1 / (1 - X[:, 0])
        each = max(1, CHUNK // len(X))
        for part in (cells[first : first + each] for first in range(0, len(cells), each)):
            yield (
                part,
                Faces(self._shape, part, may=self._may).at(
                    Boxes.whole(len(part)), ab, weights, into
                ),
            )

    @cached_property
    def _on_strips(self) -> list[Array]:
        """(cells, n) charges per area of the coordinates of strips at their nodes; of each local
        edge.
        """
        charges: list[Array] = [
            np.zeros((len(self._shape.r0), int(np.prod(ON_STRIP)))) for _ in range(3)
        ]
        for edge, cells, found in self._found_on_strips(None):
            charges[edge][cells] = found.q[..., 0]
        return charges

    def _found_on_strips(self, into: Nodal | None) -> Iterator[tuple[int, Ints, Found]]:
        (a, _), (b, _) = (gauss(n) for n in ON_STRIP)
        at = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
        for edge in range(3):
            cells = np.flatnonzero(self._strips[: len(self._shape.r0), edge])
            if len(cells):
                sides = Sides(self._shape, cells, np.full(len(cells), edge))
                yield edge, cells, sides.at(Boxes.whole(len(cells)), at, np.ones(len(at)), into)

    def by_fields(self, moved: Complex, weights: Weights, into: Nodal) -> None:
        """Add the derivatives that `into` has: see `Charged.by_fields`."""
        on_faces, on_strips = (
            np.zeros_like(self._on_faces),
            [np.zeros_like(each) for each in self._on_strips],
        )
        for batch in self._batches:
            pairs = batch.pairs[: batch.own]
            rows = np.arange(len(pairs))
            sides = zip((0, 1), (batch.of_left, batch.of_right), strict=True)
            on_q = add(moved, pairs, (batch.left, rows), (batch.right, rows), weights)
            if into.by_thickness is not None:
                self._by_heights(batch, pairs, moved, weights, into)
            for i, (points, edge, share) in sides:
                copy, cells = np.divmod(pairs[:, i], len(self._shape.r0))
                on = on_q[i][: len(pairs)].reshape(len(pairs), len(points.weights), -1)
                on = (
                    share * points.weights[:, None] * self._copies.charges[copy][:, None, None] * on
                )
                if edge is None:
                    np.add.at(
                        on_faces, cells, np.einsum("mj,nml->njl", _basis(points), on, optimize=True)
                    )
                else:
                    np.add.at(on_strips[edge], cells, on[..., 0] @ _basis(points))
        for part, found in self._found_on_faces(into):
            assert found.back
            found.back(np.zeros_like(found.x), on_faces[part])
        for edge, cells, found in self._found_on_strips(into):
            assert found.back
            found.back(np.zeros_like(found.x), on_strips[edge][cells][..., None])

    def _by_heights(
        self, batch: Batch, pairs: Ints, moved: Complex, weights: Weights, into: Nodal
    ) -> None:
        rows, both = np.arange(len(pairs)), (batch.left, batch.right)
        on = add(moved, pairs, (batch.left, rows), (batch.right, rows), weights, heights=True)
        for i, (places, _, _) in enumerate((batch.of_left, batch.of_right)):
            copy, cells = np.divmod(pairs[:, i], len(self._shape.r0))
            shape = len(pairs), len(places.weights), -1
            heights = both[i].heights.reshape(shape[1:])
            on_t = self._copies.up[copy][:, None] * np.sum(
                heights * on[i][: len(pairs)].reshape(shape), axis=-1
            )
            self._shape.back_of_thickness(cells, places.X, on_t, into)


def _basis(points: Places) -> Array:
    """(m, n) values at points of the polynomials that are one at one of the nodes each at which
    charges are found.
    """
    if points.at is None:
        return np.asarray(NODES.tabulate(0, points.X)[0, :, :, 0])
    basis = np.einsum(
        "ma,mb->mab", *(_lagrange(n, points.at[:, i]) for i, n in enumerate(ON_STRIP))
    )
    return np.asarray(basis.reshape(len(points.X), -1))


def _lagrange(n: int, x: Array) -> Array:
    """(m, n) values at places of the polynomials that are one at one of Gauss's points each."""
    V = np.polynomial.legendre.legvander
    return np.asarray(np.linalg.solve(V(2 * gauss(n)[0] - 1, n - 1).T, V(2 * x - 1, n - 1).T).T)


def _quadrature(degree: int) -> tuple[Array, Array]:
    X, w = basix.make_quadrature(basix.CellType.triangle, degree)
    return np.asarray(X), np.asarray(w)
