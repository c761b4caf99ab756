"""Closest-point projection of points on meridians onto other meridians.

A point is a quadrature point of a cell, a place its projection: a cell with a coordinate X from 0
to 1 in it. Vectors have rho, z, and half the thickness less h/2, with the other sign for points.
The distance of x and y is the length of the first two components of x - y, plus the third: that of
the faces, plus h. A place is free if it is inside its cell, so that it can move along the curve.
Cells are near along the curve if they are the material around a point, which it does not touch. In
go points and nodes, out come `MeridianProjections`. docs/theory.md, Contact.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.contact.closest_points import FOLD_SHRINKAGE, SAME_DIRECTION_COSINE
from magshell_fenicsx.parts.contact.projection import (
    CELL_RADIUS_FACTOR,
    LEBESGUE_FACTOR,
    SELF_CONTACT_DISTANCE,
    have_farther_places,
    near_along_surface,
)
from magshell_fenicsx.parts.contact.quadrature_rules import EDGE_OFFSET, line_rule

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
Flags = NDArray[np.bool_]
MAX_NEWTON_ITERATIONS = 30  # of a projection
STEP_TOLERANCE = 1e-10  # a place is exact after a smaller step, in the reference cell
MIN_CURVATURE_RATIO = 1e-3  # over the squared speed, which a step takes below that
STARTS_PER_DEGREE = 4  # parts of a cell, from whose ends Newton's method may begin
DISTANCE_TOLERANCE = 1e-9  # thicknesses by which distances of two cells differ at one place
AXIS_TOLERANCE = 1e-9  # rho over R of a node on the axis
COMPONENT_SIGNS = np.array([1.0, 1.0, -1.0])  # of the squares of components in A
ABOVE_SINE = 0.5  # of the angle between a curve and the direction to a point that is above it


@dataclass(frozen=True)
class MeridianPoints:
    """The quadrature points on the cells of two shells.

    Attributes
    ----------
    cell
        (n,) number of the point's cell.
    shape
        (n, functions) shape functions of that cell at the point.
    weight
        (n,) undeformed area over R^2, all around the axis.
    is_first
        (n,) whether the point is on the first shell.
    normal
        (n, 2) undeformed unit normal (rho, z).
    is_on_edge
        (n,) whether the point is next to a free end.
    """

    cell: Longs
    shape: Array
    weight: Array
    is_first: Flags
    normal: Array
    is_on_edge: Flags


@dataclass(frozen=True)
class MeridianProjections:
    """Places of a meridian that are nearest to points: one row for each pair of point and place.

    Attributes
    ----------
    point, cell
        (n,) numbers of the points, and of the cells of the places.
    X
        (n,) place in the reference cell, from 0 to 1.
    is_free
        (n,) whether the place may move along the curve.
    distance
        (n,) over R.
    """

    point: Longs
    cell: Longs
    X: Array
    is_free: Flags
    distance: Array

    def select(self, selection: Flags | Longs) -> "MeridianProjections":
        """Return the selected places: numbers or flags."""
        return MeridianProjections(
            *(getattr(self, attribute.name)[selection] for attribute in fields(self))
        )


def neighbours_of(nodes: Longs) -> Longs:
    """Return the cell beyond each end of each cell (cells, 2); -1 where there is none.

    Parameters
    ----------
    nodes
        (cells, functions) node numbers, those of the ends first.
    """
    neighbours = np.full((len(nodes), 2), -1, dtype=np.int64)
    end_at_vertex = dict[int, tuple[int, int]]()  # vertex -> cell and end that came to it last
    for cell, end in np.ndindex(len(nodes), 2):
        vertex = int(nodes[cell, end])
        earlier_end = end_at_vertex.get(vertex)
        if earlier_end:  # two cells end there, and are beyond each other's ends
            earlier_cell, _ = earlier_end
            neighbours[cell, end] = earlier_cell
            neighbours[earlier_end] = cell
        end_at_vertex[vertex] = cell, end
    return neighbours


class NeighbouringMaterial:
    """The material around a point, which the point does not touch; see `projection`.

    Parameters
    ----------
    points
        (n, 3) undeformed points: rho, z, and minus half the thickness.
    cells
        (cells, functions, 3) undeformed nodes of all cells: rho, z, and half the thickness.
    nodes
        (cells, functions) node numbers of all cells, those of the ends first.
    cells_of_points
        (n,) number of each point's cell.

    The field `_near` (cells, cells) says whether the way along the undeformed curve between two
    cells is short. `_points` and `_nodal` are the undeformed points and nodes.
    """

    def __init__(self, points: Array, cells: Array, nodes: Longs, cells_of_points: Longs) -> None:
        """Find the cells that are near each other along the undeformed curve."""
        self._points, self._nodal, self.cells_of_points = points, cells, cells_of_points
        count = len(nodes)
        r0 = np.zeros((int(nodes.max()) + 1, 3))
        r0[nodes] = cells
        is_near: Flags = np.zeros(count * count, dtype=bool)
        reach = 2 * SELF_CONTACT_DISTANCE * r0[:, 2]  # a number of thicknesses
        # the numbers of near pairs are cell * count + other cell
        is_near[near_along_surface(nodes[:, :2], r0[:, :2], reach)] = True
        self._near = is_near.reshape(count, count)

    def are_near(self, cell: Longs, other: Longs) -> Flags:
        """Return flags (n,): whether the way along the curve from cells to others is short.

        Another cell of -1 stands for none, and is not near.
        """
        return np.asarray(self._near[cell, other] & (other >= 0))

    def may_touch(self, cell: Longs, other: Longs, nodal: Array) -> Flags:
        """Return flags (n,): whether cells may touch others.

        Cells that are near along the curve may if the curve is folded between them: two of their
        nodes are then much nearer than undeformed. A cell does not touch itself.

        Parameters
        ----------
        nodal
            (cells, functions, 2) deformed places of nodes.
        """
        may_touch = ~self._near[cell, other]
        near_pairs = np.flatnonzero(~may_touch & (cell != other))
        i, j = cell[near_pairs], other[near_pairs]
        # (pairs, functions, functions): distances between the nodes of both cells
        deformed, undeformed = (
            np.linalg.norm(r[i][:, :, None] - r[j][:, None], axis=3)
            for r in (nodal, self._nodal[..., :2])
        )
        may_touch[near_pairs] = (deformed < FOLD_SHRINKAGE * undeformed).any(axis=(1, 2))
        return may_touch

    def are_distinct(self, places: MeridianProjections, shape: Array, is_above: Flags) -> Flags:
        """Return flags (n,): which places count, as they are not the material around their point.

        A place counts if its cell is far from the point's cell along the curve. It also counts if
        the place was far from the point undeformed, and the point is now above or below it.

        Parameters
        ----------
        shape
            (n, functions) shape functions at the places.
        is_above
            (n,) whether points are above or below their places, not beside them.
        """
        is_near = self.are_near(self.cells_of_points[places.point], places.cell)
        undeformed_places = np.einsum("nk,nki->ni", shape, self._nodal[places.cell])
        off = self._points[places.point] - undeformed_places
        distance = np.linalg.norm(off[:, :2], axis=1)
        # the third component is minus the sum of both halves of the thickness
        is_far = distance > SELF_CONTACT_DISTANCE * np.abs(off[:, 2])
        return np.asarray(~is_near | (is_above & is_far))


class CandidateSearch:
    """The search for cells of the other shell that points may be near to.

    Cells are searched first by circles around them, then by their chords.

    Parameters
    ----------
    points
        The quadrature points of both shells, in the order of cells.
    nodes
        (cells, functions) node numbers of all cells, those of the ends first.
    sides
        (cells,) flags of the cells of the first shell, and of the second.
    element
        The basix element of the curves.
    material
        For a shell that may touch itself; both sides are then the same. Else None.

    The fields `_first_cells` and `_second_cells` are the numbers of the cells of both shells.
    `_starts` and `_counts` (cells,) are the number of the first point of each cell, and how many it
    has. A curve bulges from its chord at most `_bulge` times as far as the farthest of its inner
    nodes, which have the parameters `_inner_nodes` from 0 to 1.
    """

    def __init__(
        self,
        points: MeridianPoints,
        nodes: Longs,
        sides: tuple[Flags, Flags],
        element: Any,
        material: NeighbouringMaterial | None,
    ) -> None:
        """Count the points of each cell, and bound the bulge of curves over their chords."""
        self._first_cells, self._second_cells = (np.flatnonzero(side) for side in sides)
        self._material = material
        self._counts = np.bincount(points.cell, minlength=len(nodes))
        # points of a cell follow each other; in reversed order its first one is set last, and stays
        self._starts = np.zeros_like(self._counts)
        self._starts[points.cell[::-1]] = np.arange(len(points.cell))[::-1]
        # shape functions of inner nodes at a fine lattice; the factor covers places between those
        # of the lattice
        X = np.linspace(0.0, 1.0, 20 * element.degree + 1, dtype=np.float64)[:, None]
        inner_shapes = np.abs(element.tabulate(0, X)[0, :, 2:, 0])
        self._bulge = CELL_RADIUS_FACTOR * float(inner_shapes.sum(axis=1).max(initial=0.0))
        self._inner_nodes = element.points[2:, :1]

    def __call__(self, x: Array, nodal: Array, reach: float) -> tuple[Longs, Longs]:
        """Return pairs of points and cells, among them all that are nearer than a reach.

        Parameters
        ----------
        x
            (n, 2) places of all points over R.
        nodal
            (cells, functions, 2) places of the nodes of all cells.
        reach
            Distance over R.

        Returns
        -------
        point, cell
            (m,) numbers.
        """
        # pairs whose circles are near; of these the pairs are kept that are near by the chords
        point, cell = self._in_circles(nodal, reach)
        # of each cell: how far its curve is at most from its chord, by its inner nodes less the
        # places of the chord at the same parameters
        begins, chord = nodal[:, 0], nodal[:, 1] - nodal[:, 0]
        off_chord = nodal[:, 2:] - begins[:, None] - self._inner_nodes * chord[:, None]
        bulge = self._bulge * np.linalg.norm(off_chord, axis=2).max(axis=1, initial=0.0)
        # of each pair: the distance of the point from the chord, whose nearest place is at a share
        # of its length
        offset, chord_of_pair = x[point] - begins[cell], chord[cell]
        squares = np.sum(chord * chord, axis=1)
        chord_share = np.clip(np.sum(offset * chord_of_pair, axis=1) / squares[cell], 0.0, 1.0)
        distance = np.linalg.norm(offset - chord_share[:, None] * chord_of_pair, axis=1)
        is_near = distance - bulge[cell] < reach
        return point[is_near], cell[is_near]

    def _in_circles(self, nodal: Array, reach: float) -> tuple[Longs, Longs]:
        """Return pairs of points and cells whose circles are nearer than the reach.

        The circle of a point is that of its cell. Points of each shell are paired with cells of the
        other. For a shell and itself both sides are the same: they have each pair of cells in both
        orders already.
        """
        # circles around all cells
        first, second, centres = self._first_cells, self._second_cells, nodal.mean(axis=1)
        squares = np.sum((nodal - centres[:, None]) ** 2, axis=2)
        radii = CELL_RADIUS_FACTOR * np.sqrt(squares.max(axis=1))
        # pairs of cells of the first and the second side that are near
        offset = centres[first][:, None] - centres[second]
        limit = (radii[first][:, None] + radii[second] + reach) ** 2
        i, j = np.nonzero(np.sum(offset * offset, axis=2) < limit)
        # cells of the points, and cells that these may face
        own_cell, cell = first[i], second[j]
        if self._material:
            may_touch = self._material.may_touch(own_cell, cell, nodal)
            own_cell, cell = own_cell[may_touch], cell[may_touch]
        else:
            own_cell, cell = np.concatenate([own_cell, cell]), np.concatenate([cell, own_cell])
        # from pairs of cells to pairs of points and cells. The points of an own cell have the
        # numbers start, start + 1, ..., while `np.arange` counts on from pair to pair: the shift of
        # each pair is the difference
        count = self._counts[own_cell]
        count_before = np.cumsum(count) - count
        shift = np.repeat(self._starts[own_cell] - count_before, count)
        return np.arange(len(shift)) + shift, np.repeat(cell, count)


def no_projections() -> MeridianProjections:
    """Return an empty set of places."""
    no_numbers = np.zeros(0, dtype=np.int64)
    return MeridianProjections(
        no_numbers, no_numbers, np.zeros(0), np.zeros(0, dtype=bool), np.zeros(0)
    )


def slopes(x: Array, jets: Array) -> tuple[Array, Array, Array]:
    """Return derivatives of the distance by the coordinate X of the place, times |x - y|.

    Parameters
    ----------
    x
        (n, 3) the points.
    jets
        (3, n, 3) the places and their two derivatives by X.

    Returns
    -------
    descent
        (n,) minus the first derivative.
    curvature
        (n,) the second derivative, which is A in the formulas of `meridian_contact`.
    squared_speed
        (n,) the second derivative on a straight line, without the second derivative of the places.
    """
    y, first, second = jets
    # the third component |x - y| multiplies the derivatives of half the thickness
    offset = (x - y)[:, :2]
    off = np.column_stack([offset, np.linalg.norm(offset, axis=1)])
    descent = np.sum(off * first, axis=1)
    squared_speed = np.sum(first * first * COMPONENT_SIGNS, axis=1)
    curvature = squared_speed - np.sum(off * second, axis=1)
    return descent, curvature, squared_speed


def distances(off: Array) -> Array:
    """Return the distances (...,) of the differences (..., 3) between points and places."""
    return np.asarray(np.linalg.norm(off[..., :2], axis=-1) + off[..., 2])


class MeridianCurves:
    """The meridians of all shells as curves.

    Parameters
    ----------
    element
        The basix element of places, whose nodes are points.
    nodes
        (cells, functions) node numbers, those of the ends first.
    r0
        (nodes, 2) undeformed places over R.
    h
        Thickness over R.

    Attributes
    ----------
    neighbours
        (cells, 2) the cell beyond each end; -1 where there is none.
    lebesgue_constant
        A bound of the element's Lebesgue constant, see `projection.polynomial_bound`.
    slopes_at_nodes
        (nodes of a cell, functions) derivatives of shape functions at the nodes.

    The field `_starts` has the places in a cell, from 0 to 1, at which Newton's method may begin.
    """

    def __init__(self, element: Any, nodes: Longs, r0: Array, h: float) -> None:
        """Tabulate the starts of Newton's method and the slopes at nodes."""
        self.element, self.nodes, self._r0, self._h = element, nodes, r0, h
        self.neighbours = neighbours_of(nodes)
        starts = STARTS_PER_DEGREE * element.degree
        self._starts = np.linspace(0.0, 1.0, starts + 1, dtype=np.float64)
        self.slopes_at_nodes = self.table(1, element.points.ravel())[1]
        sums = np.abs(self.table(0, self._starts)[0]).sum(axis=1)
        self.lebesgue_constant = LEBESGUE_FACTOR * float(sums.max())

    def table(self, order: int, X: Array) -> Array:
        """Return shape functions and derivatives (order + 1, n, functions) at X (n,)."""
        if not len(X):  # which basix does not take
            return np.zeros((order + 1, 0, self.nodes.shape[1]))
        return np.asarray(self.element.tabulate(order, X[:, None])[..., 0])

    def jets(self, X: Array, nodal: Array) -> Array:
        """Return places and their first two derivatives (3, n, 3) along curves.

        Parameters
        ----------
        X
            (n,) places in the reference cell.
        nodal
            (n, functions, 3) nodes of each place's cell.
        """
        return np.asarray(np.einsum("dnk,nki->dni", self.table(2, X), nodal))

    def rule(self, count: int, sides: tuple[Flags, Flags]) -> MeridianPoints:
        """Return the quadrature points in the cells of both shells.

        They are Gauss's, or of a rule with a point next to each free end of the cell.

        Parameters
        ----------
        count
            Number of points in a cell.
        sides
            (cells,) flags of the cells of the first shell, and of the second.
        """
        # an end on the axis is a pole, where the surface goes on
        off_axis = np.abs(self._r0[self.nodes[:, :2], 0]) > AXIS_TOLERANCE
        is_free_end = (self.neighbours < 0) & off_axis
        point_groups = list[MeridianPoints]()
        # cells are in groups: with a free end at neither side, at one, or at both
        for begins, ends in ((False, False), (True, False), (False, True), (True, True)):
            has_ends = (is_free_end == [begins, ends]).all(axis=1)
            cells = np.flatnonzero(np.any(sides, axis=0) & has_ends)
            point_groups.append(
                self._points_of_cells(cells, count, begins, ends, is_first=sides[0])
            )
        # the points of all groups as one set
        arrays = list[Any]()
        for attribute in fields(MeridianPoints):
            arrays_of_groups = [getattr(group, attribute.name) for group in point_groups]
            arrays.append(np.concatenate(arrays_of_groups))
        return MeridianPoints(*arrays)

    def _points_of_cells(
        self, cells: Longs, count: int, begins: bool, ends: bool, is_first: Flags
    ) -> MeridianPoints:
        """Return the quadrature points in some cells, whose free ends are at the same sides.

        Parameters
        ----------
        cells
            Numbers of the cells.
        count
            Number of points in a cell.
        begins, ends
            Whether the begin of these cells is a free end, and their end.
        is_first
            Flags of the cells of the first shell, among all.
        """
        X, w = line_rule(count, begins, ends)
        table = self.table(1, X)
        # (cells, points, 2): the points, and the derivative r' there
        x, tangent = np.einsum("dqk,cki->dcqi", table, self._r0[self.nodes[cells]])
        speed = np.linalg.norm(tangent, axis=2)
        area = 2 * np.pi * x[..., 0] * speed * w
        normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1) / speed[..., None]
        # the rule's point next to an end is `EDGE_OFFSET` from it
        at_begin, at_end = (X < 2 * EDGE_OFFSET) & begins, (X > 1 - 2 * EDGE_OFFSET) & ends
        cell = np.repeat(cells, len(X))
        return MeridianPoints(
            cell=cell,
            shape=np.tile(table[0], (len(cells), 1)),
            weight=area.ravel(),
            is_first=is_first[cell],
            normal=normal.reshape(-1, 2),
            is_on_edge=np.tile(at_begin | at_end, len(cells)),
        )

    def project(self, x: Array, nodal: Array, point: Longs, cell: Longs) -> MeridianProjections:
        """Return the closest place in each cell to its point, by Newton's method.

        Parameters
        ----------
        x
            (n, 3) places of all points.
        nodal
            (cells, functions, 3) places of the nodes of all cells.
        point, cell
            (m,) numbers of points and cells to pair.
        """
        # each place begins at the nearest of some starts in its cell
        shape = self.table(0, self._starts)[0]
        start_offsets = x[point][:, None] - np.einsum("mk,nki->nmi", shape, nodal[cell])
        X = self._starts[distances(start_offsets).argmin(axis=1)]
        moving = np.arange(len(X))  # rows of the places that are not exact yet
        for _ in range(MAX_NEWTON_ITERATIONS):
            jets = self.jets(X[moving], nodal[cell[moving]])
            descent, curvature, squared_speed = slopes(x[point[moving]], jets)
            # Newton's step; where the distance is not convex in X, a step as on a straight line
            # still goes downhill
            is_convex = curvature > MIN_CURVATURE_RATIO * squared_speed
            step = descent / np.where(is_convex, curvature, squared_speed)
            previous = X[moving]
            # no step is longer than a quarter of the cell, and none leaves the cell
            X[moving] = np.clip(previous + np.clip(step, -0.25, 0.25), 0.0, 1.0)
            moving = moving[np.abs(X[moving] - previous) >= STEP_TOLERANCE]
            if not len(moving):
                break
        jets = self.jets(X, nodal[cell])
        descent, *_ = slopes(x[point], jets)  # minus the derivative of the distance by X
        # a place at an end is fixed if the distance falls on beyond the cell
        is_fixed = ((X == 0.0) & (descent <= 0)) | ((X == 1.0) & (descent >= 0))
        return MeridianProjections(point, cell, X, ~is_fixed, distances(x[point] - jets[0]))

    def select_nearest(
        self,
        places: MeridianProjections,
        x: Array,
        nodal: Array,
        material: NeighbouringMaterial | None,
    ) -> MeridianProjections:
        """Return the places that count: from which the curve goes on to no nearer place.

        A point keeps its nearest place, and at most one on its other side. Places in the material
        around a point do not count.

        Parameters
        ----------
        x, nodal
            (n, 3) places of all points, and (cells, functions, 3) of the nodes of all cells.
        material
            The material around points of a shell that may touch itself; else None.
        """
        # in the order of points, then of cells, so that a point's place in a cell can be looked up
        places = places.select(np.argsort(places.point * len(self.nodes) + places.cell))
        is_above: Flags = np.ones(len(places.point), dtype=bool)
        if material:
            is_above = self._are_above(places, x, nodal)
            shape = self.table(0, places.X)[0]
            is_distinct = material.are_distinct(places, shape, is_above)
            places, is_above = places.select(is_distinct), is_above[is_distinct]
        # a place at an end of its cell counts if the point's place in the cell beyond is no nearer,
        # or if that cell is not searched, as where the curve is folded there
        keys = places.point * len(self.nodes) + places.cell
        is_nearest: Flags = np.ones(len(places.point), dtype=bool)
        for end, X in enumerate((0.0, 1.0)):
            neighbour = self.neighbours[places.cell, end]
            is_at_end = (places.X == X) & (neighbour >= 0)
            is_no_nearer_beyond = have_farther_places(
                keys,
                places.point * len(self.nodes) + neighbour,
                places.distance,
                DISTANCE_TOLERANCE * self._h,
            )
            is_folded = self._are_folded(places, neighbour, is_above, material)
            is_nearest &= ~is_at_end | is_no_nearer_beyond | is_folded
        places = places.select(is_nearest)
        # in the order of points, then of distances
        places = places.select(np.lexsort((places.distance, places.point)))
        if not len(places.point):
            return places
        return places.select(self._are_nearest_of_sides(places, x, nodal))

    def _are_nearest_of_sides(self, places: MeridianProjections, x: Array, nodal: Array) -> Flags:
        """Return flags (n,): the nearest place of each point, and the nearest on its other side.

        Parameters
        ----------
        places
            In the order of points and distances.
        x, nodal
            (n, 3) all points, and (cells, functions, 3) the nodes of all cells.
        """
        # unit vectors from places to points
        y, _, _ = self.jets(places.X, nodal[places.cell])
        offset = (x[places.point] - y)[:, :2]
        direction = offset / np.maximum(np.linalg.norm(offset, axis=1), 1e-300)[:, None]
        # the nearest place of each point is its first one; then its row for each place
        first_of_point = np.flatnonzero(np.diff(places.point, prepend=-1))
        nearest = np.repeat(first_of_point, np.diff([*first_of_point, len(direction)]))
        is_chosen = np.zeros(len(direction), dtype=bool)
        is_chosen[first_of_point] = True
        # places in another direction than the nearest; the first such place of each point is chosen
        # too
        is_opposite = np.sum(direction * direction[nearest], axis=1) < SAME_DIRECTION_COSINE
        opposite = np.flatnonzero(is_opposite)
        first_opposite = np.flatnonzero(np.diff(places.point[opposite], prepend=-1))
        is_chosen[opposite[first_opposite]] = True
        return is_chosen

    def _are_folded(
        self,
        places: MeridianProjections,
        neighbour: Longs,
        is_above: Flags,
        material: NeighbouringMaterial | None,
    ) -> Flags | bool:
        """Return flags (n,): whether the curve goes on into a cell that is not searched.

        That is the cell beyond a place, if it is near the point's own cell along the curve: the
        curve is folded there. Between two different shells the result is False for all places.

        Parameters
        ----------
        neighbour
            (n,) cells beyond the places; -1 for none.
        is_above
            (n,) whether points are above or below their places.
        material
            The material around points of a shell that may touch itself; else None.
        """
        if not material:
            return False
        own_cell = material.cells_of_points[places.point]
        return np.asarray(is_above & material.are_near(own_cell, neighbour))

    def _are_above(self, places: MeridianProjections, x: Array, nodal: Array) -> Flags:
        """Return flags (n,): whether points are above or below their places.

        The others are beside their places, as in one straight curve. Points x and the nodes of all
        cells are those of `project`.
        """
        y, tangent, _ = self.jets(places.X, nodal[places.cell])[..., :2]
        offset = x[places.point, :2] - y
        # over the product of the lengths it is the sine of the angle between offset and curve
        cross_product = np.abs(offset[:, 0] * tangent[:, 1] - offset[:, 1] * tangent[:, 0])
        product_of_lengths = np.linalg.norm(offset, axis=1) * np.linalg.norm(tangent, axis=1)
        return np.asarray(cross_product > ABOVE_SINE * product_of_lengths)

    def cell_normals(self) -> Array:
        """Return the undeformed unit normals (cells, 2) of the lines between the ends."""
        a, b = self._r0[self.nodes[:, 0]], self._r0[self.nodes[:, 1]]
        n = np.column_stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]])
        return np.asarray(n / np.linalg.norm(n, axis=1)[:, None])
