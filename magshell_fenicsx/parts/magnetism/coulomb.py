"""The energy of magnetised parts in each other's field: sums over pairs, and derivatives.

The charges of `charges` stay with the material, so the energy of parts A and B is, over Br² R³/(4
pi mu_0),

    W = sum of q_i q_j/|x_i - x_j|, i in A, j in B,    x = r + zeta n,

and that of a part in its own field half of this, with both in A: functions of the displacement by
the places alone. Forces and stiffness are their derivatives, exact for the rule. Pairs of
cells have a Gauss rule whose error is below `PRECISION` at their distance (`least_distance`), the
same for both. Adjacent cells have the rules of `singular_pairs`, cells above each other those of
`stacked_faces`.

- A part is a set of connected cells; parts act on each other, or each also on itself.
- Copies are the modelled cells and their images under mirrors and rotations, which make the whole
  shell; arrays (copies * cells, ...) list one copy after the other. An image may have opposite
  charges, and its normals may be turned over.
- A kind (`ElementKind`) is either the faces of all cells, with the layers of charges inside, or the
  edges with one local number.
- A rule is a quadrature rule on the reference triangle or edge, by its position in `DEGREES`. The
  charged points of a rule (`Points`) move with the nodes; their charges stay.
- Own cells are those of this rank. Nodes are (copies * cells, k, 3), deformed and over R.
"""

from itertools import product
from math import log

import basix
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.charge_derivatives import Complex, Weights, pair_derivatives
from magshell_fenicsx.parts.magnetism.charges import Boxes, EdgeStrips, ShellFaces, gauss, heights
from magshell_fenicsx.parts.magnetism.magnetised_cells import (
    COMPLEX_STEP,
    MagnetisedShell,
    NodalDerivatives,
)
from magshell_fenicsx.parts.magnetism.pairs import (
    NO_IMAGES,
    Copies,
    PairLimits,
    Pairs,
    Points,
    Stiffness,
)
from magshell_fenicsx.parts.magnetism.singular_pairs import CHARGE_TOLERANCE, SingularPairs
from magshell_fenicsx.parts.magnetism.stacked_faces import StackedFaces

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
DEGREES = (4, 5, 6, 8, 10, 14, 20, 30)  # of the rules on triangles
PRECISION = 1e-5  # relative, of a pair of cells at their distance
DEGREE_OF_TOO_NEAR = (
    50  # degree of a rule for which cells are too wide: there is no number with that of 30
)
# distance over the radius of a cell: what is so near to its middle is above or below it
ABOVE_TOLERANCE = 0.5
# sine of the angle up to which a cell is beside another: the pole is then beyond the ellipse's end
BESIDE_SINE = 0.3
AREA_DIGITS = 9  # in which areas of parts are compared
MIN_DISTANCE = 1e-3  # that adjacent cells count to have, over their size


def least_distance(number: int) -> float:
    """Return the least distance, over the size of cells, at which a rule's error is `PRECISION`.

    `number` is the degree n of Gauss's rule. Its error falls as rho^-(n + 1). Here rho is the sum
    of the half axes of the largest ellipse around the cell in which the integrand has no pole
    (Trefethen, Approximation Theory, theorem 19.3).
    """
    # the short half axis of that ellipse is sinh(log rho), for a cell of the size 2
    return float(np.sinh(log(1 / PRECISION) / (number + 1)) / 2)


class PartsTooNear(ValueError):
    """Raised if two parts overlap, or are nearer than a seventh of the size of their cells."""


class ElementKind:
    """Charged points of the faces of cells, or of edges with one local number, for each rule.

    Points and charges are computed for the undeformed cells, at the first use of a rule.

    Parameters
    ----------
    shape
        All modelled cells.
    cells
        (n,) numbers of the cells whose faces, or edges, are meant.
    copies
        The modelled cells and their images.
    edge
        Local number of the edges; None for faces.
    include_uncharged
        Whether interior layers without a charge are kept.

    Attributes
    ----------
    faces
        Whether the charges are those of faces.
    family
        The charged elements of the modelled cells: their faces, or strips along their edges.
    cells
        (copies * n,) numbers of the cells, with images.
    number
        (copies * all cells,) row of each cell in `cells`, or -1.
    _modelled, _edge, _shape, _copies
        The parameters `cells` (without images), `edge`, `shape` and `copies`.
    _rules
        Position of a rule in `DEGREES` -> its charged points.
    """

    def __init__(
        self,
        shape: MagnetisedShell,
        cells: Ints,
        copies: Copies,
        edge: int | None = None,
        *,
        include_uncharged: bool = False,
    ) -> None:
        """Number the elements of all copies: cells of copy c follow after c times all cells."""
        self._modelled, self._edge, self._shape, self._copies = cells, edge, shape, copies
        self.faces = edge is None
        self.family = (
            ShellFaces(shape, cells, include_uncharged=include_uncharged)
            if edge is None
            else EdgeStrips(shape, cells, np.full(len(cells), edge))
        )
        count = len(copies.images)
        self.cells = np.concatenate([cells + copy * len(shape.r0) for copy in range(count)])
        self.number = np.full(count * len(shape.r0), -1)
        self.number[self.cells] = np.arange(len(self.cells))
        self._rules: dict[int, Points] = {}

    def rule(self, which: int) -> Points:
        """Return the charged points of a rule on the elements of all copies; computed once.

        `which` is the position of the rule's degree in `DEGREES`.
        """
        if which not in self._rules:
            self._rules[which] = (
                self._face_rule(which) if self._edge is None else self._strip_rule(which)
            )
        return self._rules[which]

    def largest_charge(self, which: int) -> float:
        """Return the largest charge of a rule, over Br R²."""
        return float(np.abs(self.rule(which).q).max(initial=0.0))

    def _face_rule(self, which: int) -> Points:
        """Return the charged points of a rule on faces, and on layers inside."""
        # points in the reference triangle, their coordinates (a, b), and weights by these
        X, ab, weights = self._face_points(which)
        q = self.family.charges_at(Boxes.undivided(self.family.count), ab, weights).q
        assert isinstance(self.family, ShellFaces)
        return self._charged_points(X, heights(self.family), q)

    def _face_points(self, which: int) -> tuple[Array, Array, Array]:
        """Return a rule on faces: points, their coordinates (a, b), and weights.

        Points (P, 2) are in the reference triangle, which the square of (a, b) covers by X = a, Y =
        (1 - a) b. The weights (P,) are those of an integral over this square, so they are over the
        Jacobian 1 - a.
        """
        X, w = basix.make_quadrature(basix.CellType.triangle, DEGREES[which])
        ab = np.stack([X[:, 0], X[:, 1] / (1 - X[:, 0])], axis=-1)
        return X, ab, np.array(w / (1 - X[:, 0]), dtype=np.float64)

    def _strip_rule(self, which: int) -> Points:
        """Return the charged points of a rule on edges, whose points across are layers."""
        # coordinates along the edge and across it, all pairs of both, and the weights of pairs
        s, eta, points, weights = self._strip_points(which)
        q = self.family.charges_at(Boxes.undivided(self.family.count), points, weights).q.reshape(
            -1, len(s), len(eta)
        )
        return self._charged_points(self._points_on_edge(s), eta - 0.5, q)

    def _points_on_edge(self, s: Array) -> Array:
        """Return points (n, 2) of the reference triangle on the kind's edge, s (n,) along it.

        The edges run around the triangle with the surface on their left.
        """
        points_on_edges = [
            np.stack([1 - s, s], -1),
            np.stack([0 * s, 1 - s], -1),
            np.stack([s, 0 * s], -1),
        ]
        return points_on_edges[self._edge or 0]

    def _strip_points(self, which: int) -> tuple[Array, Array, Array, Array]:
        """Return a rule on an edge strip.

        Returns
        -------
        s, eta
            Coordinates in [0, 1] along the edge (P,) and through the thickness (L,).
        points, weights
            (P L, 2) all pairs of these, and their weights (P L,).
        """
        s, ws = gauss((DEGREES[which] + 2) // 2)  # exact at least at the faces' degree
        eta, we = gauss(2 + which)  # more points across for a finer rule
        points = np.stack(np.meshgrid(s, eta, indexing="ij"), axis=-1).reshape(-1, 2)
        return s, eta, points, np.asarray(np.outer(ws, we).ravel(), dtype=np.float64)

    def add_derivatives(
        self, which: int, by_charges: Array, nodal_derivatives: NodalDerivatives
    ) -> None:
        """Add a number's derivatives by nodal values to `nodal_derivatives`, by the chain rule.

        `by_charges` are the number's derivatives by the charges of the rule `which`, in the shape
        of `Points.q`. Charges of images are modelled ones times 1 or -1, so that their derivatives
        add up. Places are fixed here.
        """
        boxes = Boxes.undivided(self.family.count)
        # the sum over all copies, with the factors 1 or -1 of their charges
        count = len(self._copies.images)
        by_charges_of_copies = by_charges.reshape(count, -1, *by_charges.shape[1:])
        by_modelled_charges = np.einsum(
            "c,c...->...", self._copies.charge_factors, by_charges_of_copies
        )
        if self._edge is None:
            _, points, weights = self._face_points(which)  # coordinates (a, b)
        else:
            _, _, points, weights = self._strip_points(which)  # along and across the edge
        charges = self.family.charges_at(boxes, points, weights, nodal_derivatives)
        assert charges.add_derivatives
        charges.add_derivatives(
            np.zeros_like(charges.x), by_modelled_charges.reshape(charges.q.shape)
        )

    def add_height_derivatives(
        self, which: int, by_heights: Array, nodal_derivatives: NodalDerivatives
    ) -> None:
        """Add a number's derivatives by the nodal thickness to `nodal_derivatives`.

        `by_heights` are its derivatives by the heights of charges over the mid-surface, in the
        shape of `Points.q` for the rule `which`. A height is the thickness times a fixed ratio. An
        image whose normals are turned over has opposite heights.
        """
        # the rule's points (P, 2) in the reference triangle
        if self._edge is None:
            X, _, _ = self._face_points(which)
        else:
            s, *_ = self._strip_points(which)
            X = self._points_on_edge(s)
        # (copies, cells, P): the sum over the layers of each point
        by_thickness = np.sum(self.rule(which).heights * by_heights, axis=-1).reshape(
            len(self._copies.normal_signs), -1, len(X)
        )
        self._shape.add_thickness_derivatives(
            self._modelled,
            X,
            np.einsum("c,cnm->nm", self._copies.normal_signs, by_thickness),
            nodal_derivatives,
        )

    def _charged_points(self, X: Array, eta: Array, q: Array) -> Points:
        """Return the charged points of all copies, from those of the modelled cells.

        They have charges q (cells, P, L) at reference points X (P, 2), in layers at the heights
        `eta` (L,) over the thickness.
        """
        # (P, 3, k) shape functions with their derivatives, and (cells, P) the thickness
        T = self._shape.element.tabulate(1, X)[..., 0].transpose(1, 0, 2)
        X_of_cells = np.broadcast_to(X, (len(self._modelled), *X.shape))
        thickness, *_ = self._shape.thickness(self._modelled, X_of_cells)
        # where normals are turned over the thickness is negative, so that heights are opposite
        t_of_copies = np.concatenate([side * thickness for side in self._copies.normal_signs])
        q_of_copies = np.concatenate([factor * q for factor in self._copies.charge_factors])
        return Points(T, np.broadcast_to(eta, (len(X), len(eta))), t_of_copies, q_of_copies)


class InteractingCharges:
    """All charges of a shell: their energy, its gradient and its second derivatives.

    Either charges of different parts alone act on each other, or all charges do. The constructor is
    collective.

    Parameters
    ----------
    shape
        All modelled cells.
    parts
        (copies * cells,) number of the part that each cell belongs to.
    cells, edges
        Cell and local number of each edge that may be charged.
    singular_pairs
        The pairs of adjacent cells, if each part acts on itself too; None if it does not.
    copies
        The modelled cells and their images.
    include_uncharged
        Whether elements without a charge are kept, as derivatives by the remanence need them.

    Attributes
    ----------
    _kinds
        The kinds of elements that are charged, faces first.
    _of_different_parts
        (copies * cells, copies * cells) whether two cells are in different parts.
    _acts_by_rule
        Flags of the same shape: pairs that Gauss's rules serve. A cell with itself and adjacent
        cells are no such pairs.
    _pairs
        The compiled sums over pairs.
    _singular_pairs, _stacked_faces
        Adjacent cells (None if parts do not act on themselves), and cells that lie above each
        other.
    _shape, _h, _parts
        The cells, their thickness over R, and the parameter `parts`.
    """

    def __init__(
        self,
        shape: MagnetisedShell,
        parts: Ints,
        cells: Ints,
        edges: Ints,
        comm: MPI.Comm,
        singular_pairs: SingularPairs | None = None,
        copies: Copies = NO_IMAGES,
        *,
        include_uncharged: bool = False,
    ) -> None:
        """Collect the charged elements, and find out which pairs of cells act on each other."""
        self._pairs, self._shape, self._h = Pairs(comm), shape, shape.h
        self._singular_pairs = singular_pairs
        # faces first, then the edges with the same local number
        faces = ElementKind(
            shape, np.arange(len(shape.r0)), copies, include_uncharged=include_uncharged
        )
        kinds = [faces] + [
            ElementKind(shape, cells[edges == edge], copies, edge)
            for edge in range(3)
            if (edges == edge).any()
        ]
        # kinds whose charges are rounding are left out; the coarsest rule, 0, shows that
        largest_charges = [element_kind.largest_charge(0) for element_kind in kinds]
        self._kinds = [
            element_kind
            for element_kind, charge in zip(kinds, largest_charges, strict=True)
            if include_uncharged or charge > CHARGE_TOLERANCE * max(largest_charges)
        ]
        self._of_different_parts = np.asarray(parts[:, None] != parts)  # pairs of different parts
        # pairs that a Gauss rule may serve: not a cell with itself or an adjacent one
        self._acts_by_rule = self._of_different_parts.astype(np.uint8)
        for cell, adjacent_cells in enumerate(singular_pairs.neighbours if singular_pairs else ()):
            self._acts_by_rule[cell] = 1
            self._acts_by_rule[cell, adjacent_cells] = 0
        self._parts = parts
        assert isinstance(faces.family, ShellFaces)
        # (copies * cells,) position of each cell in an order by the areas of parts
        order = _order_of_cells(shape, parts, len(copies.images))
        self._stacked_faces = StackedFaces(shape, faces.family, copies, parts, order, comm)

    def rules(self, nodes: Array, own_cells: range) -> tuple[NDArray[np.int8], NDArray[np.bool_]]:
        """Return the rule of each pair of cells, and which pairs have stacked faces.

        Both arrays are (own cells, copies * cells). A rule is a position in `DEGREES`, or -1 for a
        pair that is adjacent, or does not act. Stacked faces are those of cells
        of two parts that lie above each other; `StackedFaces` integrates them, and their edges have
        the finest rule.

        Parameters
        ----------
        nodes
            (copies * cells, k, 3) deformed nodes.
        own_cells
            Cells of this rank.

        Raises
        ------
        PartsTooNear
            If two parts overlap, or are too near for the size of their cells.
        """
        least_distances = np.array([least_distance(degree) for degree in DEGREES])
        too_near = least_distance(DEGREE_OF_TOO_NEAR)
        own_rows = slice(own_cells.start, own_cells.stop)
        has_rule = self._acts_by_rule[own_rows]
        # of these, the pairs of different parts that lie above each other
        is_stacked = self._stacked_faces.find_stacked(
            nodes, own_cells, has_rule & self._of_different_parts[own_rows]
        )
        has_rule = has_rule & ~is_stacked
        limits = PairLimits(
            h=self._h,
            space=MIN_DISTANCE,
            above_tolerance=ABOVE_TOLERANCE,
            flat=BESIDE_SINE,
            worst=too_near,
        )
        # the number of each pair's rule; None if two cells are too near
        rules = self._pairs.rules(nodes, own_cells, has_rule, least_distances, limits)
        if rules is None:
            raise PartsTooNear
        rules[is_stacked] = len(DEGREES) - 1  # the finest, for their edges
        return rules, is_stacked

    def evaluate(
        self, nodes: Array, own_cells: range, stiffness: Stiffness | None = None
    ) -> tuple[float, Array]:
        """Return this rank's part of the energy, and its gradient (own cells, k, 3) by nodes.

        The energy is over Br² R³/(4 pi mu_0). It is the sum over pairs with an own cell. A pair of
        an own cell with a cell of another rank or with an image counts half, as the other cell's
        side counts the other half.

        Parameters
        ----------
        nodes
            (copies * cells, k, 3) deformed nodes; own cells are among the first copy.
        own_cells
            Cells of this rank.
        stiffness
            Matrix to which second derivatives by nodes of own cells and nodes of all cells are
            added; None if they are not wanted.

        Raises
        ------
        PartsTooNear
            If two parts overlap, or are too near for the size of their cells.
        """
        (rules, is_stacked), gradient = self.rules(nodes, own_cells), np.zeros_like(nodes)
        energy = 0.0
        first, second, rule_of_pair = _pairs_with_rules(rules, own_cells)
        # a pair of own cells stands in both orders, of which one is counted, wholly
        is_own_pair = (second >= own_cells.start) & (second < own_cells.stop)
        shares = (is_own_pair & (first < second), 1.0), (~is_own_pair, 0.5)
        # pairs by rule, then by kind of elements (faces or edges) on the first and second cell
        for number, (counted, share) in product(np.unique(rule_of_pair), shares):
            is_counted = counted & (rule_of_pair == number)
            cells = np.column_stack([first[is_counted], second[is_counted]])
            for kinds in product(self._kinds, self._kinds):
                charged_cells, left, right = _charged_pairs(
                    cells, kinds, int(number), is_stacked, own_cells
                )
                count = len(charged_cells)
                energy += share * self._pairs.add(
                    nodes, charged_cells, count, left, right, gradient, stiffness
                )
        # derivatives by points, which the sums have collected, are taken to the nodes
        for number, kind in product(np.unique(rule_of_pair), self._kinds):
            self._pairs.finish(nodes, kind.cells, kind.rule(int(number)), gradient, stiffness)
        # adjacent cells, and faces above each other
        if self._singular_pairs:
            energy += self._singular_pairs.add(nodes, gradient, stiffness)
        if is_stacked.any() and self._kinds[0].faces:
            energy += self._stacked_faces.add(nodes, own_cells, is_stacked, gradient, stiffness)
            if np.isnan(energy):
                raise PartsTooNear
        if stiffness:
            stiffness.finish()
        return energy, gradient[own_cells.start : own_cells.stop]

    def field_derivatives(
        self,
        nodes: Array,
        rates: Array,
        own_cells: range,
        weights: Weights,
        *,
        of_shape: bool = False,
    ) -> NodalDerivatives:
        """Return derivatives of energy and forces by the remanence, at fixed deformed nodes.

        The number that is differentiated is `weights.energy` W + `weights.force` v . dW/du. W is
        this rank's part of the energy, v are the rates of nodes. With `of_shape`, derivatives by
        the undeformed place and by the thickness are included.

        Parameters
        ----------
        nodes, rates
            (copies * cells, k, 3) deformed nodes and their rates.
        own_cells
            Cells of this rank.
        weights
            The factors of W and of v . dW/du.

        Raises
        ------
        PartsTooNear
            If two parts overlap, or are too near for the size of their cells.
        """
        rules, is_stacked = self.rules(nodes, own_cells)
        # complex nodes: imaginary parts of results are rates along v
        moved_nodes = nodes + COMPLEX_STEP * 1j * rates
        nodal_derivatives = self._shape.zero_derivatives(of_shape=of_shape)
        self._add_rule_derivatives(
            moved_nodes, own_cells, rules, is_stacked, weights, nodal_derivatives, of_shape=of_shape
        )
        # adjacent cells, and faces above each other
        if self._singular_pairs:
            self._singular_pairs.field_derivatives(moved_nodes, weights, nodal_derivatives)
        if is_stacked.any() and self._kinds[0].faces:
            self._stacked_faces.field_derivatives(
                nodes, own_cells, is_stacked, moved_nodes, weights, nodal_derivatives
            )
        return nodal_derivatives

    def _add_rule_derivatives(
        self,
        moved_nodes: Complex,
        own_cells: range,
        rules: NDArray[np.int8],
        is_stacked: NDArray[np.bool_],
        weights: Weights,
        nodal_derivatives: NodalDerivatives,
        *,
        of_shape: bool,
    ) -> None:
        """Add derivatives of the pairs of cells with a Gauss rule to `nodal_derivatives`.

        Each pair of cells comes in both orders, so that the derivatives by the charges of the first
        cell are enough.

        Parameters
        ----------
        moved_nodes
            Deformed nodes, with rates as imaginary parts.
        rules, is_stacked
            (own cells, copies * cells) position of each pair's rule in `DEGREES`, negative without
            one; and whether two cells have stacked faces, which are left out.
        weights
            The factors of the energy and of its rate.
        of_shape
            Whether derivatives by the heights of the charges are added too.
        """
        first, second, rule_of_pair = _pairs_with_rules(rules, own_cells)
        for number in map(int, np.unique(rule_of_pair)):
            cells = np.column_stack([first, second])[rule_of_pair == number]
            for kinds in product(self._kinds, self._kinds):
                charged_cells, left, right = _charged_pairs(
                    cells, kinds, number, is_stacked, own_cells
                )
                first_kind, _ = kinds
                by_charges, _ = pair_derivatives(moved_nodes, charged_cells, left, right, weights)
                first_kind.add_derivatives(number, by_charges, nodal_derivatives)
                if of_shape:
                    by_heights, _ = pair_derivatives(
                        moved_nodes, charged_cells, left, right, weights, heights=True
                    )
                    first_kind.add_height_derivatives(number, by_heights, nodal_derivatives)


def _pairs_with_rules(
    rules: NDArray[np.int8], own_cells: range
) -> tuple[Ints, Ints, NDArray[np.int8]]:
    """Return both cells of each pair that has a Gauss rule, and the position of the rule, (n,).

    `rules` (own cells, copies * cells) are negative for pairs without one.
    """
    first, second = np.nonzero(rules >= 0)
    return first + own_cells.start, second, rules[first, second]


def _charged_pairs(
    cells: Ints,
    kinds: tuple[ElementKind, ElementKind],
    rule: int,
    is_stacked: NDArray[np.bool_],
    own_cells: range,
) -> tuple[Ints, tuple[Points, Ints], tuple[Points, Ints]]:
    """Return the pairs of cells that have charged elements of two kinds, with their points.

    Stacked faces are left out, as `StackedFaces` integrates them.

    Parameters
    ----------
    cells
        (n, 2) pairs of cells, the first ones own cells.
    kinds
        The kinds of elements on the first and on the second cell.
    rule
        Position of the rule in `DEGREES`.
    is_stacked
        (own cells, copies * cells) whether two cells have stacked faces.
    own_cells
        Cells of this rank.

    Returns
    -------
    charged_cells
        (m, 2) pairs of cells.
    left, right
        The charged points of the first and of the second kind, and the row (m,) of each cell's
        element in them.
    """
    first_kind, second_kind = kinds
    first_rows, second_rows = first_kind.number[cells[:, 0]], second_kind.number[cells[:, 1]]
    is_charged = (first_rows >= 0) & (second_rows >= 0)
    if first_kind.faces and second_kind.faces:
        is_charged &= ~is_stacked[cells[:, 0] - own_cells.start, cells[:, 1]]
    left = first_kind.rule(rule), first_rows[is_charged]
    right = second_kind.rule(rule), second_rows[is_charged]
    return cells[is_charged], left, right


def _order_of_cells(shape: MagnetisedShell, parts: Ints, copies: int) -> Ints:
    """Return the position (copies * cells,) of each cell in the order for stacked faces.

    Cells are ordered by the area of their part, then by the number of the part, then by their own
    number. `parts` (copies * cells,) are the numbers of the parts, `copies` is the number of
    copies.
    """
    areas_of_parts = np.bincount(parts, weights=np.tile(_areas(shape.r0), copies))
    number = np.tile(np.arange(len(shape.r0)), copies)
    order = np.empty(len(parts), dtype=np.intp)
    order[np.lexsort([number, parts[number], areas_of_parts[parts].round(AREA_DIGITS)])] = (
        np.arange(len(parts))
    )
    return order


def _areas(r0: Array) -> Array:
    """Return the areas (cells,) of flat triangles with corners r0 (cells, 3 or more, 3)."""
    return np.asarray(
        np.linalg.norm(np.cross(r0[:, 1] - r0[:, 0], r0[:, 2] - r0[:, 0]), axis=-1) / 2
    )
