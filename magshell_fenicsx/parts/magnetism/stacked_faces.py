"""The energy of stacked faces: of cells above each other, nearer than rules on both resolve.

Each of Gauss's points of the first cell sees the second in polar coordinates about its foot on it,
with r = s sinh v, the gap s between the faces there, and t = sqrt(p² + s²) sinh w along each side
at a distance p: what is integrated has no pole nearer than pi/2 at any gap, so Gauss's rules
converge as fast at all (Trefethen, Approximation Theory, theorem 19.3). The places follow the
state; what that misses of a derivative is of the order of the error.

What all cells of a part make together is smooth above it, what one of them makes is not. So of two
parts it is always the smaller one whose points see the other. At free edges of the first cell they
are in rows, dense at the edge: there the force falls over a gap, and that of the other faces over a
thickness.

The face of the first cell that is near the other has its charges in three layers below it, from
which they are extrapolated: the sum of such charges is that of the face up to its third moment. So
nothing is singular where faces touch or press on each other, and energy, forces and tangent are one
smooth sum down to a penetration of `LAYER_DEPTH`.

Copies are the modelled cells and their images, which make the whole shell; cells of all copies are
numbered copy by copy. Own cells are those of this rank. A part is a set of connected cells. The
kind of a first cell tells which of its sides are at free edges. S layers of charges, faces first,
go through the thickness; heights are over the thickness, other lengths over R. Inward is the
direction away from the other cell. "Visible points" are the rule on the second cell as seen from a
point of the first.
"""

from functools import cached_property
from itertools import product

import basix
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.charge_derivatives import Complex, Weights, pair_derivatives
from magshell_fenicsx.parts.magnetism.charges import Boxes, ShellFaces, gauss, heights
from magshell_fenicsx.parts.magnetism.duffy_rules import CORNERS, ENDS, graded
from magshell_fenicsx.parts.magnetism.magnetised_cells import (
    MagnetisedShell,
    NodalDerivatives,
    unit,
)
from magshell_fenicsx.parts.magnetism.pairs import Copies, Pairs, Points, Stiffness

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
DEGREE = 14  # degree of the rule on the first cell
ROWS_AT_EDGE, POINTS_ALONG_ROWS = 10, 7  # of points at free edges
ROW_SCALE = 0.05  # distance of the first rows from the edge, over the thickness
PRECISION = 1e-9  # relative, of the field of the second cell at a point of the first
MAX_GAUSS_POINTS = 24  # of the longest rule, as in stacked_faces.c
MAX_VISIBLE_POINTS = 3 * MAX_GAUSS_POINTS**2  # of a cell for a point, as in stacked_faces.c
CHARGE_DEGREE = 5  # of the polynomial of charges on a cell
STACKED_DISTANCE = 0.25  # of faces, over the size of cells: nearer ones have a rule here
# between layers below a face, from which its charges are extrapolated, over the thickness
LAYER_DEPTH = 0.005
MIN_LAYER_DISTANCE = 0.00125  # of a layer from a face, over the thickness
OVERLAP_DISTANCE = 0.5  # of mid-surfaces, over the thickness: nearer cells overlap
EXTRAPOLATION_WEIGHTS = 3.0, -3.0, 1.0  # from three layers, as in stacked_faces.c
SIDE_TOLERANCE = 1e-7  # between the middles of a side that two cells share, over R
MIN_COSINE = 0.7  # of the angle between stacked cells
CHARGE_ELEMENT = basix.create_element(
    basix.ElementFamily.P,
    basix.CellType.triangle,
    CHARGE_DEGREE,
    basix.LagrangeVariant.gl_isaac,
    discontinuous=True,
)
# twelve places on the sides of the reference triangle
BORDER = np.concatenate(
    [CORNERS[i] + np.arange(4)[:, None] / 4 * (CORNERS[j] - CORNERS[i]) for i, j in ENDS]
)


def monomials(X: Array, degree: int) -> Array:
    """Return monomials (n, ..) at places X (n, 2), in the order of stacked_faces.c."""
    return np.stack(
        [X[:, 0] ** (n - j) * X[:, 1] ** j for n in range(degree + 1) for j in range(n + 1)], axis=1
    )


def coefficients_of_nodes(element: basix.finite_element.FiniteElement) -> Array:
    """Return (monomials, nodes): coefficients of monomials of a Lagrange element's basis."""
    return np.ascontiguousarray(
        np.linalg.inv(monomials(np.asarray(element.points), element.degree))
    )


def corner_distances(x: Array, corners: Array) -> tuple[Array, Array]:
    """Return the least distance (n,) of places x (n, m, 3) from flat triangles.

    The triangles have the given `corners` (n, 3, 3).

    Returns
    -------
    distance
        Least over the m places of each triangle.
    normal_distance
        Its part across the triangle's plane, at the nearest place.
    """
    # sides begin at the corners, in turn
    sides = corners[:, [1, 2, 0]] - corners
    normal = unit(np.asarray(np.cross(sides[:, 0], sides[:, 1]), dtype=np.float64))
    separations = x[:, :, None] - corners[:, None]
    normal_distance = np.einsum("nmi,ni->nm", separations[:, :, 0], normal)
    # positive on the inner side of each side
    side_heights = np.einsum("nmki,nki->nmk", separations, np.cross(normal[:, None], sides))
    square = np.sum(sides * sides, axis=-1)
    t = np.clip(np.einsum("nmki,nki->nmk", separations, sides) / square[:, None], 0.0, 1.0)
    to_sides = np.linalg.norm(separations - t[..., None] * sides[:, None], axis=-1).min(axis=-1)
    # places above a triangle have the distance of its plane
    distance = np.where((side_heights >= 0).all(axis=-1), np.abs(normal_distance), to_sides)
    rows, nearest = np.arange(len(x)), distance.argmin(axis=1)
    return distance[rows, nearest], np.abs(normal_distance[rows, nearest])


FreeSides = tuple[bool, bool, bool]  # whether each side of a cell is at a free edge


def graded_at(free_sides: FreeSides, s: float) -> tuple[Array, Array]:
    """Return a rule of the reference triangle with rows of points along its free sides.

    Rows are dense there on the scale s, over the side of a cell. Points are (n, 2), weights (n,).
    The triangle is divided into one triangle for each free side, with a common tip.
    """
    sides = [side for side, is_free in zip(ENDS, free_sides, strict=True) if is_free]
    if not sides:
        X, w = basix.make_quadrature(basix.CellType.triangle, DEGREE)
        return np.array(X), np.array(w)
    # the common tip: with three free sides the centre, with one the opposite corner, with two the
    # middle of the third side
    apex = CORNERS.mean(axis=0)
    if len(sides) == 1:
        (apex,) = (CORNERS[i] for i in range(3) if i not in sides[0])
    elif len(sides) == 2:
        first_side, second_side = sides
        ends_of_third = [i for i in range(3) if i not in first_side or i not in second_side]
        apex = CORNERS[ends_of_third].mean(axis=0)
    # coordinates and weights: a from a side to the apex, dense at the side, and b along the side
    (a, wa), (b, wb) = graded(ROWS_AT_EDGE, s), gauss(POINTS_ALONG_ROWS)  # both on [0, 1]
    points, weights = list[Array](), list[Array]()
    # a triangle between each free side and the apex: X = (1 - a) (place on the side) + a apex
    for i, j in sides:
        A, B = CORNERS[i], CORNERS[j]
        from_side = (1 - a)[:, None, None] * (A + b[:, None] * (B - A))
        points.append((from_side + a[:, None, None] * apex).reshape(-1, 2))
        area = (B - A)[0] * (apex - A)[1] - (B - A)[1] * (apex - A)[0]
        weights.append(area * np.outer(wa * (1 - a), wb).ravel())
    return np.concatenate(points), np.concatenate(weights)


def find_free_sides(corners: Array, parts: Ints) -> list[FreeSides]:
    """Return which sides of flat triangles (n, 3, 3) no other cell of their part shares.

    `parts` (n,) is the part of each cell. Cells share a side where the middles coincide.
    """
    from scipy.spatial import cKDTree  # takes long to import

    middles = np.stack([corners[:, [i, j]].mean(axis=1) for i, j in ENDS], axis=1).reshape(-1, 3)
    # the nearest middle but the side's own; without any, the number of sides, whose part is -1
    _, nearest_two = cKDTree(middles).query(middles, 2, distance_upper_bound=SIDE_TOLERANCE)
    neighbours = nearest_two[:, 1]
    part_of_side = np.append(np.repeat(parts, 3), -1)
    is_free = (part_of_side[neighbours] != part_of_side[:-1]).reshape(-1, 3)
    return [(bool(first), bool(second), bool(third)) for first, second, third in is_free]


class StackedFaces:
    """Charges of the faces of all cells, for pairs of cells with stacked faces.

    Construction compiles C functions and is collective.

    Parameters
    ----------
    shape
        All modelled cells.
    faces
        Their charged faces.
    copies
        Images that make the whole shell, the modelled cells first.
    parts
        (copies * cells,) part of each cell.
    order
        (copies * cells,) number of each cell: the first cell of a pair has the lower one.

    Attributes
    ----------
    _shape, _faces, _copies, _order
        The parameters of these names.
    _kinds
        The kinds of first cells: which of their sides are free.
    _kind
        (copies * cells,) position in `_kinds` of each cell's kind.
    _border
        (12, k) shape functions at the places `BORDER`.
    _pairs
        The functions in C.
    _rules_of_kinds
        Points (n, 2) and weights (n,) on the first cell, for each of `_kinds`.
    _structs
        The cells with these rules for the functions in C, for each of `_kinds`.
    _heights
        (S,) heights of the layers of charges, those of both faces first.
    _nodal_charges
        Charges (modelled cells, nodes, layers) at the nodes of `CHARGE_ELEMENT`, per area of the
        reference triangle.
    """

    def __init__(
        self,
        shape: MagnetisedShell,
        faces: ShellFaces,
        copies: Copies,
        parts: Ints,
        order: Ints,
        comm: MPI.Comm,
    ) -> None:
        """Sort the cells by their free sides; parameters are those of the class."""
        self._shape, self._faces, self._copies, self._order = shape, faces, copies, order
        self._pairs = Pairs(comm)
        free_sides = find_free_sides(copies.nodes_of_all(shape.r0)[:, :3], parts)
        self._kinds = sorted(set(free_sides))  # kinds of first cells, by their free sides
        self._kind = np.array([self._kinds.index(sides) for sides in free_sides])
        self._border = shape.element.tabulate(0, BORDER)[0, :, :, 0]

    def find_stacked(
        self, nodes: Array, own_cells: range, has_rule: NDArray[np.uint8]
    ) -> NDArray[np.bool_]:
        """Return a mask (own cells, cells) of pairs with stacked faces, among those of `has_rule`.

        Faces are stacked if cells are nearly parallel, nearer than `STACKED_DISTANCE` of their size
        and above each other, not in one plane. `has_rule` (own cells, cells) is 1 for the pairs
        that count. `nodes` (cells, k, 3) are present places over R of all copies.
        """
        is_stacked, h = np.zeros(has_rule.shape, dtype=bool), self._shape.h
        first, second, pair_size = self._candidates(nodes, own_cells, has_rule)
        if not len(first):
            return is_stacked
        first_cell = first + own_cells.start
        # twelve places on the sides of each cell stand for it
        border = np.einsum("mk,nki->nmi", self._border, nodes)
        # distance, and its part along the normal, of the first cell's border from the second cell;
        # then of the second cell's border from the first cell
        distance_of_first, height_of_first = corner_distances(border[first_cell], nodes[second, :3])
        distance_of_second, height_of_second = corner_distances(
            border[second], nodes[first_cell, :3]
        )
        # those of the border that is nearer count
        first_is_nearer = distance_of_first < distance_of_second
        distance = np.where(first_is_nearer, distance_of_first, distance_of_second)
        height = np.where(first_is_nearer, height_of_first, height_of_second)
        is_near = distance - h < STACKED_DISTANCE * pair_size
        is_stacked[first, second] = is_near & (height > OVERLAP_DISTANCE * h)
        return is_stacked

    def _candidates(
        self, nodes: Array, own_cells: range, has_rule: NDArray[np.uint8]
    ) -> tuple[Ints, Ints, Array]:
        """Return the pairs of `has_rule` that are nearly parallel and may be near each other.

        `nodes` (cells, k, 3) are present places, `has_rule` (own cells, cells) marks the pairs.

        Returns
        -------
        first
            (n,) first cell of each pair, counted from the first own cell.
        second
            (n,) second cell of each pair.
        pair_size
            (n,) diameter of a ball around the larger of both cells.
        """
        # a ball around each cell, and its normal
        middle = nodes.mean(axis=1)
        radius = np.linalg.norm(nodes - middle[:, None], axis=-1).max(axis=1)
        normal = unit(
            np.asarray(
                np.cross(nodes[:, 1] - nodes[:, 0], nodes[:, 2] - nodes[:, 0]), dtype=np.float64
            )
        )
        first, second = np.nonzero(has_rule)
        first_cell = first + own_cells.start
        pair_size = 2 * np.maximum(radius[first_cell], radius[second])
        # a lower bound of the distance, to leave out most pairs
        ball_distance = (
            np.linalg.norm(middle[first_cell] - middle[second], axis=-1)
            - radius[first_cell]
            - radius[second]
        )
        cosine = np.abs(np.sum(normal[first_cell] * normal[second], axis=-1))
        may_be_near = ball_distance < self._shape.h + STACKED_DISTANCE * pair_size
        is_candidate = may_be_near & (cosine > MIN_COSINE)
        return first[is_candidate], second[is_candidate], pair_size[is_candidate]

    def add(
        self,
        nodes: Array,
        own_cells: range,
        is_stacked: NDArray[np.bool_],
        gradient: Array,
        stiffness: Stiffness | None = None,
    ) -> float:
        """Return the energy of stacked pairs with own cells, and add derivatives.

        Of a pair with one own cell it is half the energy, since two ranks count the pair. It is nan
        if two cells overlap. Derivatives are added to `gradient` (cells, k, 3) and `stiffness`.
        `nodes` (cells, k, 3) are present places over R of all copies, and `is_stacked` (own cells,
        cells) is the mask of the stacked pairs.
        """
        pairs, is_own_pair = self._ordered(own_cells, is_stacked)
        energy, kinds_of_first_cells = 0.0, self._kind[pairs[:, 0]]
        # first the pairs with one own cell, then those with two
        for kind, both_are_own in product(np.unique(kinds_of_first_cells), (False, True)):
            is_of_kind = kinds_of_first_cells == kind
            counted_pairs = pairs[is_of_kind & (is_own_pair == both_are_own)]
            counted_share = 1.0 if both_are_own else 0.5
            energy += counted_share * self._pairs.add_stacked(
                self._structs[kind], nodes, counted_pairs, gradient, stiffness
            )
        return energy

    def field_derivatives(
        self,
        nodes: Array,
        own_cells: range,
        is_stacked: NDArray[np.bool_],
        moved_nodes: Complex,
        weights: Weights,
        nodal_derivatives: NodalDerivatives,
    ) -> None:
        """Add derivatives by nodal values of own cells to `nodal_derivatives`.

        The number that is differentiated is `weights.energy` W + `weights.force` v . dW/du, with
        the energy W and a change v of the nodes. `nodes` (cells, k, 3) are present places of all
        copies, `moved_nodes` the same with v times a small step as imaginary part. `is_stacked`
        (own cells, cells) is the mask of the stacked pairs.
        """
        on_charges = np.zeros_like(self._nodal_charges)  # derivatives by nodal charges
        row = np.zeros(1, dtype=np.int64)  # of the only pair, in its charged points
        stacked_pairs, _ = self._ordered(own_cells, is_stacked)
        for first_cell, second_cell in stacked_pairs:
            first_points, first_weights = self._rules_of_kinds[self._kind[first_cell]]
            struct = self._structs[self._kind[first_cell]]
            rule = self._pairs.visible_points(
                struct, nodes, first_cell, second_cell, MAX_VISIBLE_POINTS
            )
            if rule is None:  # overlapping cells have no energy
                continue
            # charged points of both cells
            X, w, inward, shift = rule
            left, layer_factors, heights_of_layers = self._extrapolated_charges(
                first_cell, inward, shift
            )
            right = self._visible_charges(second_cell, X, w)
            # derivatives by charges, and by heights if the thickness counts, of both cells
            pairs, sides = np.array([[first_cell, second_cell]]), ((left, row), (right, row))
            on_layers = pair_derivatives(moved_nodes, pairs, *sides, weights)
            on_heights = None
            if nodal_derivatives.by_thickness is not None:
                on_heights = pair_derivatives(moved_nodes, pairs, *sides, weights, heights=True)
            # those of own cells, brought from the points to nodal charges and nodal values
            first = first_cell, first_points, first_weights
            second = second_cell, X.reshape(-1, 2), w.ravel()
            for side, (cell, points, point_weights) in enumerate((first, second)):
                if cell not in own_cells:
                    continue
                by_charges = on_layers[side].reshape(len(points), -1)
                cell_heights = self._heights
                if side == 0:  # from charges of the moved layers back to those of the cell's layers
                    by_charges = np.einsum("pls,pl->ps", layer_factors, by_charges)
                    cell_heights = heights_of_layers
                on_charges[cell % len(self._shape.r0)] += self._by_nodal_charges(
                    cell, points, point_weights, by_charges
                )
                if on_heights:
                    by_heights = on_heights[side].reshape(len(points), -1)
                    self._add_by_thickness(
                        cell, points, by_heights, cell_heights, nodal_derivatives
                    )
        # from derivatives by charges to those by nodal values
        charges = self._faces.charges_at(*self._nodes_of_charges, nodal_derivatives)
        assert charges.add_derivatives
        charges.add_derivatives(np.zeros_like(charges.x), on_charges)

    def _by_nodal_charges(
        self, cell: int, points: Array, weights: Array, by_charges: Array
    ) -> Array:
        """Return derivatives (nodes, S) by the nodal charges of the modelled cell behind a cell.

        `by_charges` (n, S) are derivatives by the charges of layers at `points` (n, 2) of the cell,
        where charges are multiplied by `weights` (n,).
        """
        copy = cell // len(self._shape.r0)
        by_charges = self._copies.charge_factors[copy] * weights[:, None] * by_charges
        shape_functions = monomials(points, CHARGE_DEGREE) @ self._charge_basis
        return np.asarray(shape_functions.T @ by_charges)

    @cached_property
    def _charge_basis(self) -> Array:
        """Coefficients (monomials, nodes) of the basis functions of `CHARGE_ELEMENT`."""
        return coefficients_of_nodes(CHARGE_ELEMENT)

    def _add_by_thickness(
        self,
        cell: int,
        points: Array,
        by_heights: Array,
        cell_heights: Array,
        nodal_derivatives: NodalDerivatives,
    ) -> None:
        """Add derivatives by the thickness of a cell to `nodal_derivatives`.

        The thickness moves the cell's layers of charges.

        Parameters
        ----------
        points
            (n, 2) charged points of the cell.
        by_heights
            (n, layers) derivatives by the distances of layers from the mid-surface.
        cell_heights
            (layers,) or (n, layers) derivatives of these distances by the thickness.
        """
        copy, modelled_cell = divmod(cell, len(self._shape.r0))
        by_thickness = self._copies.normal_signs[copy] * np.sum(by_heights * cell_heights, axis=-1)
        self._shape.add_thickness_derivatives(
            np.array([modelled_cell]), points, by_thickness[None], nodal_derivatives
        )

    def _extrapolated_charges(
        self, cell: int, inward: Array, shift: Array
    ) -> tuple[Points, Array, Array]:
        """Return the charged points of a first cell, with its near face's charges in three layers.

        Parameters
        ----------
        inward
            (n,) 1 where the normal leads away from the second cell, else -1.
        shift
            (n,) distance over R by which charges are moved inward.

        Returns
        -------
        charged_points
            The n points of the rule on the cell, with L layers of charges at each.
        layer_factors
            (n, L, S) charges of these layers from those of the S layers of the cell.
        heights_of_layers
            (n, L) the part of the layers' heights that grows with the thickness.
        """
        points, weights = self._rules_of_kinds[self._kind[cell]]
        t, q = self._thickness_and_charges(cell, points)
        layer_heights, layer_factors, heights_of_layers = self._extrapolated_layers(
            t, inward, shift
        )
        q = weights[:, None] * np.einsum("pls,ps->pl", layer_factors, q)
        charged_points = Points(self._tabulated(points), layer_heights, t[None], q[None])
        return charged_points, layer_factors, heights_of_layers

    def _visible_charges(self, cell: int, X: Array, w: Array) -> Points:
        """Return the charged points of a second cell, as seen from P points of the first cell.

        Each first point has M points of its own: X (P, M, 2) and w (P, M) are places and weights.
        """
        t, q = self._thickness_and_charges(cell, X.reshape(-1, 2))
        q = w.reshape(1, *w.shape, 1) * q.reshape(1, *w.shape, -1)
        tables = self._tabulated(X.reshape(-1, 2)).reshape(*w.shape, 3, -1)
        layer_heights = np.broadcast_to(self._heights, q.shape[1:])
        return Points(tables, layer_heights, t.reshape(1, *w.shape), q)

    def _extrapolated_layers(
        self, t: Array, inward: Array, shift: Array
    ) -> tuple[Array, Array, Array]:
        """Return the layers into which the charges at points of the first cell are moved.

        The function `layered` of stacked_faces.c does the same.

        Parameters
        ----------
        t
            (n,) thickness over R.
        inward
            (n,) 1 where the normal leads away from the other cell, else -1.
        shift
            (n,) distance over R by which charges are moved inward.

        Returns
        -------
        heights
            (n, L) heights of the layers over t.
        layer_factors
            (n, L, S) charges of the layers from those of the S layers of the cell.
        heights_of_layers
            (n, L) the part of the heights that grows with the thickness.
        """
        # the charges of the near face go into three layers: one in the place of that face, and two
        # that follow the S layers of the cell
        S, n = len(self._heights), np.arange(len(t))
        # number of the face that is near the other cell: 0 outer, 1 inner
        near_face = np.where(inward * t < 0, 0, 1)
        layer_factors = np.broadcast_to(np.eye(S + 2, S), (len(t), S + 2, S)).copy()
        layer_factors[n, near_face] = 0.0
        heights_of_layers = np.pad(np.tile(self._heights, (len(t), 1)), ((0, 0), (0, 2)))
        depths = np.zeros((len(t), S + 2))  # of the layers below the near face, over R
        for j, weight in enumerate(EXTRAPOLATION_WEIGHTS):
            # the first layer has the near face's number, the others have the numbers S and S + 1
            layer = np.full_like(near_face, S - 1 + j) if j else near_face
            layer_factors[n, layer, near_face] = weight
            heights_of_layers[n, layer] = self._heights[near_face]
            depths[n, layer] = (j + 1) * LAYER_DEPTH * self._shape.h
        # moved inward by `shift`, and the three layers by their depths too
        shifted_heights = heights_of_layers + (inward / t)[:, None] * (shift[:, None] + depths)
        return shifted_heights, layer_factors, heights_of_layers

    def _ordered(
        self, own_cells: range, is_stacked: NDArray[np.bool_]
    ) -> tuple[Ints, NDArray[np.bool_]]:
        """Return the stacked pairs, each once, with the cell of the lower `order` first.

        Returns
        -------
        pairs
            (n, 2) first and second cells.
        is_own_pair
            (n,) whether both are own cells, of this rank.
        """
        # rows of `is_stacked` are own cells: pairs of two own cells are there in both orders
        first, second = np.nonzero(is_stacked)
        first = first + own_cells.start
        is_own_pair = (second >= own_cells.start) & (second < own_cells.stop)
        is_counted = ~is_own_pair | (first < second)
        pairs, is_own_pair = np.column_stack([first, second])[is_counted], is_own_pair[is_counted]
        # the cell with the lower order is the first one
        swap = self._order[pairs[:, 0]] > self._order[pairs[:, 1]]
        pairs[swap] = pairs[swap, ::-1]
        return pairs, is_own_pair

    def _tabulated(self, X: Array) -> Array:
        """Return values and derivatives (n, 3, k) of shape functions at places X (n, 2)."""
        return np.asarray(self._shape.element.tabulate(1, X)[..., 0].transpose(1, 0, 2))

    def _thickness_and_charges(self, cell: int, X: Array) -> tuple[Array, Array]:
        """Return thickness (n,) and charges (n, layers) of a cell at places X (n, 2).

        Charges are per area of the reference triangle.
        """
        values = monomials(X, CHARGE_DEGREE)
        return values @ self._thickness[cell], values @ self._charge_polynomials[cell]

    @cached_property
    def _rules_of_kinds(self) -> list[tuple[Array, Array]]:
        """Points (n, 2) and weights (n,) on the first cell, for each kind of free sides."""
        # the scale of rows is over a typical side of a cell
        side_lengths = [
            np.linalg.norm(self._shape.r0[:, i] - self._shape.r0[:, j], axis=-1) for i, j in ENDS
        ]
        return [
            graded_at(free_sides, ROW_SCALE * self._shape.h / float(np.median(side_lengths)))
            for free_sides in self._kinds
        ]

    @cached_property
    def _structs(self) -> list[object]:
        """For each kind of first cells, all cells as the C functions take them (struct `Cells`).

        The structs differ in the rule on the first cell alone.
        """
        rules = [np.column_stack(gauss(n)).ravel() for n in range(1, MAX_GAUSS_POINTS + 1)]
        shared_arrays = {
            "shape": coefficients_of_nodes(self._shape.element),
            "charges": self._charge_polynomials,
            "thickness": self._thickness,
            "heights": self._heights,
            "gauss": np.concatenate(rules),
        }
        struct_numbers = {
            "k": shared_arrays["shape"].shape[1],  # nodes of a cell
            "degree": self._shape.element.degree,
            "of_charges": CHARGE_DEGREE,
            "S": len(self._heights),  # layers
            "h": self._shape.h,
            "depth": LAYER_DEPTH,
            "least": MIN_LAYER_DISTANCE,
            "inside": OVERLAP_DISTANCE,
        }
        # the rule on the first cell, with the shape functions T at its points X
        structs = list[object]()
        for X, w in self._rules_of_kinds:
            arrays = shared_arrays | {
                "T": np.ascontiguousarray(self._tabulated(X)),
                "X": X,
                "weights": w,
            }
            structs.append(
                self._pairs.cells(arrays, **struct_numbers, P=len(w), precision=PRECISION)
            )
        return structs

    @cached_property
    def _heights(self) -> Array:
        """Heights (S,) of the layers of charges, over the thickness; faces first."""
        return heights(self._faces)

    @cached_property
    def _nodal_charges(self) -> Array:
        """Charges (modelled cells, nodes, layers) per area of the reference triangle."""
        return self._faces.charges_at(*self._nodes_of_charges).q

    @cached_property
    def _charge_polynomials(self) -> Array:
        """Coefficients (copies * cells, monomials, layers) of charges."""
        q = coefficients_of_nodes(CHARGE_ELEMENT) @ self._nodal_charges
        return np.concatenate([factor * q for factor in self._copies.charge_factors])

    @cached_property
    def _thickness(self) -> Array:
        """Coefficients (copies * cells, monomials) of the thickness.

        They are negative for images that turn normals over.
        """
        cells, X = np.arange(len(self._shape.r0)), np.asarray(CHARGE_ELEMENT.points)
        t = (
            self._shape.thickness(cells, np.broadcast_to(X, (len(cells), *X.shape)))[0]
            @ coefficients_of_nodes(CHARGE_ELEMENT).T
        )
        return np.concatenate([normal_sign * t for normal_sign in self._copies.normal_signs])

    @property
    def _nodes_of_charges(self) -> tuple[Boxes, Array, Array]:
        """Arguments of `charges_at` that give charges at the nodes: boxes, points and weights.

        A box is a part of the unit square that is folded onto the triangle of a cell: here the
        undivided square of each cell. The points are those of the square at the nodes, and the
        weights the inverse of the Jacobian, so that charges are per area of the triangle.
        """
        a, b = CHARGE_ELEMENT.points.T
        return Boxes.undivided(self._faces.count), np.column_stack([a, b / (1 - a)]), 1 / (1 - a)
