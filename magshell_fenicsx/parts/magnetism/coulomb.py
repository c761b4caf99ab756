"""The energy of magnetised parts in each other's field: pairs of charges, their forces and their
stiffness.

The charges of `charges` stay with the material, so the energy of parts A and B is, over Br² R³/(4
pi mu_0),

    W = sum of q_i q_j/|x_i - x_j|, i in A, j in B,    x = r + zeta n,

and that of a part in its own field half of this, with both in A: functions of the displacement by
the places alone. Forces and stiffness are their derivatives, exact for the rule. Cells far from
each other act by multipoles (`far`). Each other pair of cells has a Gauss rule whose error is below
`PRECISION` at their distance (`rate`), the same for both; for those that touch see `near`.
"""

from itertools import product
from math import log

import basix
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.charge_derivatives import Weights, add
from magshell_fenicsx.parts.magnetism.charges import Boxes, Faces, Sides, gauss, heights
from magshell_fenicsx.parts.magnetism.magnetised_cells import STEP, Nodal, Shape
from magshell_fenicsx.parts.magnetism.multipole_expansion import Far
from magshell_fenicsx.parts.magnetism.pairs import ALL, Copies, Pairs, Points, Stiffness
from magshell_fenicsx.parts.magnetism.singular_pairs import NOTHING, Near
from magshell_fenicsx.parts.magnetism.stacked_faces import Close
from magshell_fenicsx.parts.magnetism.tree import Octree

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
DEGREES = (4, 5, 6, 8, 10, 14, 20, 30)  # of the rules on triangles that there are
FAR = 2  # the rule for multipoles
GROWN = 1.25  # the radius of a cell counts as a power of this times that of the undeformed cell
PRECISION = 1e-5  # of a pair of cells at their distance
BEYOND = 50  # degree of a rule for which cells are too wide: there is no number with that of 30
ABOVE = 0.5  # of the radius of a cell: what is so near to its middle is above or below it
# sine of the angle up to which a cell is beside another: the pole is then beyond the ellipse's end
FLAT = 0.3
ROUNDED = 9  # digits in which areas of parts are compared
SPACE = 1e-3  # of cells that touch, over their size


def rate(number: int) -> float:
    """The distance over the size of cells from which a rule of a degree reaches `PRECISION`.

    The error of Gauss's rule of degree n falls as rho^-(n + 1), with the sum of half axes rho of
    the largest ellipse around the cell in which the integrand has no pole (Trefethen, Approximation
    Theory, theorem 19.3).
    """
    return float(np.sinh(log(1 / PRECISION) / (number + 1)) / 2)


class Touching(ValueError):
    """Two parts are in each other, or nearer than a seventh of the size of their cells."""


class Kind:
    """The faces of all cells, or their edges with one local number that are charged."""

    def __init__(
        self,
        shape: Shape,
        cells: Ints,
        copies: Copies,
        edge: int | None = None,
        *,
        may: bool = False,
    ) -> None:
        self._modelled, self._edge, self._shape, self._copies = cells, edge, shape, copies
        self.faces = edge is None
        self.family = (
            Faces(shape, cells, may=may)
            if edge is None
            else Sides(shape, cells, np.full(len(cells), edge))
        )
        count = len(copies.images)
        self.cells = np.concatenate([cells + copy * len(shape.r0) for copy in range(count)])
        self.number = np.full(count * len(shape.r0), -1)
        self.number[self.cells] = np.arange(len(self.cells))
        self._rules: dict[int, Points] = {}

    def rule(self, which: int) -> Points:
        """That with a number in `DEGREES`."""
        if which not in self._rules:
            self._rules[which] = self._face(which) if self._edge is None else self._side(which)
        return self._rules[which]

    def charged(self, which: int) -> float:
        return float(np.abs(self.rule(which).q).max(initial=0.0))

    def _face(self, which: int) -> Points:
        X, ab, weights = self._on_face(which)
        q = self.family.at(Boxes.whole(self.family.count), ab, weights).q
        assert isinstance(self.family, Faces)
        return self._made(X, heights(self.family), q)

    def _on_face(self, which: int) -> tuple[Array, Array, Array]:
        """Points of the reference triangle, their coordinates (a, b), and weights."""
        X, w = basix.make_quadrature(basix.CellType.triangle, DEGREES[which])
        ab = np.stack([X[:, 0], X[:, 1] / (1 - X[:, 0])], axis=-1)
        return X, ab, np.array(w / (1 - X[:, 0]), dtype=np.float64)

    def _side(self, which: int) -> Points:
        s, eta, points, weights = self._on_side(which)
        q = self.family.at(Boxes.whole(self.family.count), points, weights).q.reshape(
            -1, len(s), len(eta)
        )
        return self._made(self._along(s), eta - 0.5, q)

    def _along(self, s: Array) -> Array:
        """Points of the reference triangle on the edge."""
        return [np.stack([1 - s, s], -1), np.stack([0 * s, 1 - s], -1), np.stack([s, 0 * s], -1)][
            self._edge or 0
        ]

    def _on_side(self, which: int) -> tuple[Array, Array, Array, Array]:
        """Coordinates along the edge and through the thickness, all pairs of these, and weights."""
        s, ws = gauss((DEGREES[which] + 2) // 2)
        eta, we = gauss(2 + which)
        points = np.stack(np.meshgrid(s, eta, indexing="ij"), axis=-1).reshape(-1, 2)
        return s, eta, points, np.asarray(np.outer(ws, we).ravel(), dtype=np.float64)

    def back(self, which: int, on_q: Array, into: Nodal) -> None:
        """From derivatives by the charges of a rule, those by what `into` has: all that they follow
        from.
        """
        count, boxes = len(self._copies.images), Boxes.whole(self.family.count)
        on = np.einsum(
            "c,c...->...", self._copies.charges, on_q.reshape(count, -1, *on_q.shape[1:])
        )
        at = self._on_face(which)[1:] if self._edge is None else self._on_side(which)[2:]
        made = self.family.at(boxes, *at, into)
        assert made.back
        made.back(np.zeros_like(made.x), on.reshape(made.q.shape))

    def back_of_heights(self, which: int, on: Array, into: Nodal) -> None:
        """From derivatives by the heights of the charges of a rule, those by the thickness."""
        X = self._on_face(which)[0] if self._edge is None else self._along(self._on_side(which)[0])
        on_t = np.sum(self.rule(which).heights * on, axis=-1).reshape(
            len(self._copies.up), -1, len(X)
        )
        self._shape.back_of_thickness(
            self._modelled, X, np.einsum("c,cnm->nm", self._copies.up, on_t), into
        )

    def _made(self, X: Array, eta: Array, q: Array) -> Points:
        T = self._shape.element.tabulate(1, X)[..., 0].transpose(1, 0, 2)
        t = self._shape.thickness(
            self._modelled, np.broadcast_to(X, (len(self._modelled), *X.shape))
        )[0]
        t = np.concatenate([side * t for side in self._copies.up])
        q = np.concatenate([factor * q for factor in self._copies.charges])
        return Points(T, np.broadcast_to(eta, (len(X), len(eta))), t, q)


class Charged:
    """All charges of a shell, of which those of different parts act on each other, or all.

    Parameters
    ----------
    shape
        All cells that are modelled.
    parts
        (copies * cells,) the number of each one's part.
    cells, edges
        Edges that may be charged, by cell and local number.
    near
        The pairs of cells that touch, where each part acts on itself too; None where it does not.
    may
        Whether what has no charge may get one.
    """

    def __init__(
        self,
        shape: Shape,
        parts: Ints,
        cells: Ints,
        edges: Ints,
        comm: MPI.Comm,
        near: Near | None = None,
        copies: Copies = ALL,
        *,
        may: bool = False,
    ) -> None:
        self._pairs, self._h, self._near, self._shape = Pairs(comm), shape.h, near, shape
        kinds = [Kind(shape, np.arange(len(shape.r0)), copies, may=may)]
        kinds += [
            Kind(shape, cells[edges == edge], copies, edge)
            for edge in range(3)
            if (edges == edge).any()
        ]
        sizes = [kind.charged(0) for kind in kinds]
        self._kinds = [
            kind
            for kind, size in zip(kinds, sizes, strict=True)
            if may or size > NOTHING * max(sizes)
        ]
        self._others = np.asarray(parts[:, None] != parts)  # pairs of different parts
        self._apart = self._others.astype(np.uint8)
        for cell, others in enumerate(near.touching if near else ()):
            self._apart[cell] = 1
            self._apart[cell, others] = 0
        self._parts = parts
        assert isinstance(kinds[0].family, Faces)
        sizes_of_parts = np.bincount(parts, weights=np.tile(_areas(shape.r0), len(copies.images)))
        number = np.tile(np.arange(len(shape.r0)), len(copies.images))
        order = np.empty(len(parts), dtype=np.intp)
        order[np.lexsort([number, parts[number], sizes_of_parts[parts].round(ROUNDED)])] = (
            np.arange(len(parts))
        )
        self._close = Close(shape, kinds[0].family, copies, parts, order, comm)
        along_axes = all(np.allclose(np.abs(image.Q).max(axis=0), 1) for image in copies.images)
        self._groups = np.repeat(np.arange(len(copies.images)) * (not along_axes), len(shape.r0))
        self._places, self._radii = _balls(copies.of(shape.r0))
        self._octree: Octree | None = None
        self._boxes: tuple[Ints, Far, NDArray[np.bool_]] | None = None

    def rules(self, nodes: Array, own: range) -> tuple[NDArray[np.int8], NDArray[np.bool_]]:
        """(own, copies * cells) the number in `DEGREES` of the rule of each pair; -1 of a pair that
        has none here.

        And the pairs whose faces are close: they have a rule of their own.

        Raises
        ------
        Touching
            If two parts are closer than their thickness.
        """
        least, worst = np.array([rate(each) for each in DEGREES]), rate(BEYOND)
        apart = self._apart[own.start : own.stop] & self.boxes(nodes, own)[1]
        close = self._close.of(nodes, own, apart & self._others[own.start : own.stop])
        apart &= ~close
        rules = self._pairs.rules(
            nodes, own, apart, least, h=self._h, space=SPACE, above=ABOVE, flat=FLAT, worst=worst
        )
        if rules is None:
            raise Touching
        rules[close] = len(DEGREES) - 1
        return rules, close

    def boxes(self, nodes: Array, own: range) -> tuple[Far, NDArray[np.bool_]]:
        """Cells far from each other by boxes, and the pairs (own, copies * cells) that are too near
        for that.

        They follow from where the cells are, not from where they have been.
        """
        near = self._near is not None
        self._octree = self._octree or Octree(
            self._places, self._parts, self._groups, own, itself=near
        )
        places, radii = _balls(nodes)
        grown = np.maximum(0, np.ceil(np.log(radii / self._radii) / np.log(GROWN) - 0.5)).astype(
            np.int64
        )
        key = np.column_stack([self._octree.moved(places), grown])
        if self._boxes is None or not np.array_equal(key, self._boxes[0]):
            tree = self._octree.tree(key[:, :3], self._radii * GROWN ** key[:, 3] + self._h / 2)
            kinds = [(kind.cells, kind.rule(FAR)) for kind in self._kinds]
            self._boxes = key, Far(tree, kinds, own, self._pairs), tree.near
        return self._boxes[1:]

    def evaluate(
        self, nodes: Array, own: range, stiffness: Stiffness | None = None
    ) -> tuple[float, Array]:
        """The energy of the pairs that own cells are in, each half, and its gradient (own, k, 3) by
        their nodes.

        Parameters
        ----------
        nodes
            (copies * cells, k, 3) the deformed ones; own cells are among the first copy.
        stiffness
            Gets the second derivatives by the nodes of own cells and those of all cells.

        Raises
        ------
        Touching
            See `rules`.
        """
        (rules, close), gradient = self.rules(nodes, own), np.zeros_like(nodes)
        far = self.boxes(nodes, own)[0]
        energy = far.add(far.placed(nodes), bent=stiffness is not None)
        first, second = np.nonzero(rules >= 0)
        which, first = rules[first, second], first + own.start
        both_own = (second >= own.start) & (second < own.stop)  # such a pair stands in both orders
        shares = (both_own & (first < second), 1.0), (~both_own, 0.5)
        for number, (counted, share) in product(np.unique(which), shares):
            chosen = counted & (which == number)
            cells = np.column_stack([first[chosen], second[chosen]])
            for one, other in product(self._kinds, self._kinds):
                one_row, other_row = one.number[cells[:, 0]], other.number[cells[:, 1]]
                charged = (one_row >= 0) & (other_row >= 0)
                if one.faces and other.faces:
                    charged &= ~close[cells[:, 0] - own.start, cells[:, 1]]
                left, right = (
                    (one.rule(int(number)), one_row[charged]),
                    (other.rule(int(number)), other_row[charged]),
                )
                count = int(charged.sum())
                energy += share * self._pairs.add(
                    nodes, cells[charged], count, left, right, gradient, stiffness
                )
        for number, kind in product({FAR, *np.unique(which)}, self._kinds):
            self._pairs.finish(nodes, kind.cells, kind.rule(int(number)), gradient, stiffness)
        if self._near:
            energy += self._near.add(nodes, gradient, stiffness)
        if close.any() and self._kinds[0].faces:
            energy += self._close.add(nodes, own, close, gradient, stiffness)
            if np.isnan(energy):
                raise Touching
        if stiffness:
            stiffness.finish()
        return energy, gradient[own.start : own.stop]

    def by_fields(
        self, nodes: Array, rates: Array, own: range, weights: Weights, *, of_shape: bool = False
    ) -> Nodal:
        """Derivatives of a part of the energy and of its rate along `rates` by the remanence and,
        if `of_shape`, by the undeformed place and the thickness, where the deformed nodes stay.

        The energy is that of `evaluate`, of this rank; `rates` (copies * cells, k, 3) are those of
        the nodes.

        Raises
        ------
        Touching
            See `rules`.
        """
        (rules, close), moved = self.rules(nodes, own), nodes + STEP * 1j * rates
        into = self._shape.nothing(of_shape=of_shape)
        far, cells_far = (
            self.boxes(nodes, own)[0],
            [(kind.cells, kind.rule(FAR)) for kind in self._kinds],
        )
        on_far = far.by_charges(nodes, moved, cells_far, weights, heights=of_shape)
        for kind, (on_q, *on_heights) in zip(self._kinds, on_far, strict=True):
            kind.back(FAR, on_q, into)
            for on in on_heights:
                kind.back_of_heights(FAR, on, into)
        first, second = np.nonzero(rules >= 0)
        which, first = rules[first, second], first + own.start
        for number in map(int, np.unique(which)):
            cells = np.column_stack([first, second])[which == number]
            for one, other in product(self._kinds, self._kinds):
                one_row, other_row = one.number[cells[:, 0]], other.number[cells[:, 1]]
                charged = (one_row >= 0) & (other_row >= 0)
                if one.faces and other.faces:
                    charged &= ~close[cells[:, 0] - own.start, cells[:, 1]]
                left, right = (
                    (one.rule(number), one_row[charged]),
                    (other.rule(number), other_row[charged]),
                )
                one.back(
                    number, add(moved, cells[charged], left, right, weights)[0], into
                )  # the other order is there
                if of_shape:
                    one.back_of_heights(
                        number,
                        add(moved, cells[charged], left, right, weights, heights=True)[0],
                        into,
                    )
        if self._near:
            self._near.by_fields(moved, weights, into)
        if close.any() and self._kinds[0].faces:
            self._close.by_fields(nodes, own, close, moved, weights, into)
        return into


def _areas(r0: Array) -> Array:
    """(cells,) of flat triangles."""
    return np.asarray(
        np.linalg.norm(np.cross(r0[:, 1] - r0[:, 0], r0[:, 2] - r0[:, 0]), axis=-1) / 2
    )


def _balls(nodes: Array) -> tuple[Array, Array]:
    """Middles (cells, 3) and radii of cells with nodes (cells, k, 3)."""
    middle = nodes.mean(axis=1)
    return middle, np.linalg.norm(nodes - middle[:, None], axis=-1).max(axis=1)
