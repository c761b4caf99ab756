"""Quadrature points on contact segments: a cell is cut along the sides of the cells that it faces.

The forces of a pressure on the other surface are integrals of its shape functions, which have kinks
at the sides of its cells. A rule on the cells of one surface integrates across them: the forces of
a uniform pressure are then not those of one. So the corners of what a cell faces are projected on
its plane, and each part of the cell that faces one other cell is cut into triangles with a rule of
their own. M. A. Puso and T. A. Laursen, Computer Methods in Applied Mechanics and Engineering 193
(2004) 601-629; docs/theory.md, Contact.

The cuts are those at an earlier state, whose number is part of the history of a state. So the
points stay where they are on their surface while a state is solved: energy, forces and tangent are
exact derivatives of each other, and need none of the cuts. Where surfaces slide,
`SurfaceContact.improved_cuts` makes the cuts anew.

Two curved surfaces touch in a zone that may be narrower than the distance of the points. Its force
then sits on single points and goes along with their material, so that a mode which slides there
seems to be unstable. For such states the triangles in the zone are divided, as often as the number
of the cuts says: see `Cuts`.

A segment is a part of a cell that faces one other cell; cuts are all segments made at one
displacement. Places in cells are in coordinates of the reference triangle, whose area is 1/2. An
open side of a cell is one on an edge of the surface; an edge turns at its corners. A place of
`Projections` is the closest place of another cell to a point. Lengths are over R.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.parts.contact.projection import (
    CELL_RADIUS_FACTOR,
    CORNERS,
    Cells,
    Longs,
    Projections,
)
from magshell_fenicsx.parts.contact.quadrature_rules import (
    EDGE_OFFSET,
    cover_distance,
    edge_rule,
    triangle_rule,
)

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
REFERENCE_AREA = 0.5  # of the reference cell
AREA_TOLERANCE = 1e-12  # an area in the reference cell up to which there is none
LARGE_AREA = 0.1  # an area in the reference cell from which the rule is that of a whole cell
# barycentric coordinates up to which a corner is on a side, so that sides that nearly meet leave no
# slivers
SNAP_TOLERANCE = 0.01
SAME_CORNER_TOLERANCE = 1e-9  # distance in the reference cell of corners that are one
# distance of a corner's point from it, over the thickness: cells that meet opposite do not share it
CORNER_OFFSET = 0.01
NOT_ON_EDGE = -1  # the `ends` of a triangle that is not on an edge
TURN_COSINE = 0.97  # of the angle by which an edge turns at corners that have points
NO_CELL = -1  # the cell that a part of a cell faces where none is
# a direction in which no two corners are level: it orders them, on any ranks
ORDERING_DIRECTION = np.array([1.0, 2**0.5, 3**0.5])
HASH_BYTES = 6  # of the hash of a displacement in the number of its cuts
DIVISION_LEVELS = 16  # of a number of cuts: a float has these and the hash exactly
# in the reference triangle
CORNERS_AND_CENTROID = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1 / 3, 1 / 3]])


def _joined_arrays(parts: Sequence[Any], names: Sequence[str]) -> list[Any]:
    """Return the arrays that are attributes of several sets, each joined from all sets."""
    arrays = list[Any]()
    for name in names:
        arrays_of_parts = [getattr(part, name) for part in parts]
        arrays.append(np.concatenate(arrays_of_parts))
    return arrays


@dataclass(frozen=True)
class ContactPoints:
    """The quadrature points of this rank at which gaps are measured.

    Attributes
    ----------
    cell
        (n,) global number of the cell.
    shape
        (n, functions) shape functions of that cell at the point.
    weight
        (n,) undeformed area over R^2.
    faces
        (n,) the cell that the point faced where the cuts were made; `NO_CELL` where it faced none.
    is_on_edge
        (n,) whether the point is on an edge of the surface.
    divisions
        (n,) how often the point's triangle was divided.
    """

    cell: Longs
    shape: Array
    weight: Array
    faces: Longs
    is_on_edge: Flags
    divisions: Longs

    @cached_property
    def by_cell(self) -> tuple[Longs, Longs]:
        """The order (n,) of the points by cells, and the cells (n,) of points in this order."""
        order = np.argsort(self.cell, kind="stable")
        return order, self.cell[order]

    def select(self, is_selected: Flags) -> "ContactPoints":
        """Return the selected points."""
        return ContactPoints(
            *(getattr(self, attribute.name)[is_selected] for attribute in fields(self))
        )

    @classmethod
    def concatenate(cls, parts: Sequence["ContactPoints"]) -> "ContactPoints":
        """Return the points of several sets as one set."""
        return cls(*_joined_arrays(parts, [attribute.name for attribute in fields(cls)]))


@dataclass(frozen=True)
class Triangles:
    """Triangles in reference cells.

    Attributes
    ----------
    cell, faces
        (n,) their cells, and the cells that they face.
    first, e1, e2
        (n, 2) the first corner, and the two sides from there.
    ends
        (n,) `NOT_ON_EDGE` if the third side, opposite to the first corner, is not on an edge of the
        surface. Otherwise a sum of flags that says where the edge turns: 0 nowhere, 1 at the side's
        begin, 2 at its end, 3 at both.
    """

    cell: Longs
    faces: Longs
    first: Array
    e1: Array
    e2: Array
    ends: Longs

    @classmethod
    def concatenate(cls, parts: Sequence["Triangles"]) -> "Triangles":
        """Return the triangles of several sets as one set."""
        return cls(*_joined_arrays(parts, [attribute.name for attribute in fields(cls)]))

    @property
    def size(self) -> Array:
        """Twice their areas (n,) in the reference cell: 1 for a whole cell."""
        return np.asarray(self.e1[:, 0] * self.e2[:, 1] - self.e1[:, 1] * self.e2[:, 0])

    def select(self, is_selected: Flags) -> "Triangles":
        """Return the selected triangles."""
        return Triangles(
            *(getattr(self, attribute.name)[is_selected] for attribute in fields(self))
        )

    def divide(self) -> "Triangles":
        """Return the four quarters of each triangle.

        They are at the first corner, at both ends of the third side, and in the middle. Only the
        quarters at the third side can be on an edge.
        """
        half1, half2 = self.e1 / 2, self.e2 / 2
        middle = self.first + (self.e1 + self.e2) / 2  # of the third side
        # `ends` of the quarters: a quarter at one end of the third side has the turn at that end
        # alone, which is flag 1 of its begin or flag 2 of its end
        not_on_edge = np.full_like(self.ends, NOT_ON_EDGE)
        at_begin, at_end = (
            np.where(self.ends == NOT_ON_EDGE, NOT_ON_EDGE, self.ends & flag) for flag in (1, 2)
        )
        # first corner, both sides from there, and `ends` of each quarter
        quarters = (
            (self.first, half1, half2, not_on_edge),
            (self.first + half1, half1, half2, at_begin),
            (self.first + half2, half1, half2, at_end),
            (middle, -half1, -half2, not_on_edge),
        )
        first, e1, e2, ends = (np.concatenate(arrays) for arrays in zip(*quarters, strict=True))
        return Triangles(np.tile(self.cell, 4), np.tile(self.faces, 4), first, e1, e2, ends)


@dataclass(frozen=True)
class Polygons:
    """Convex polygons in reference cells.

    Attributes
    ----------
    cell, faces
        (n,) their cells, and the cells that they face.
    corners
        (n, m, 2) counterclockwise, some of them repeated.
    """

    cell: Longs
    faces: Longs
    corners: Array

    @classmethod
    def cells(cls, cell: Longs) -> "Polygons":
        """Return whole cells with numbers (n,) as polygons; they face no cell."""
        return cls(
            cell, np.full(len(cell), NO_CELL), np.array(np.broadcast_to(CORNERS, (len(cell), 3, 2)))
        )

    def select(self, selection: Longs | Flags) -> "Polygons":
        """Return the selected polygons."""
        return Polygons(self.cell[selection], self.faces[selection], self.corners[selection])

    def with_faces(self, faces: Longs) -> "Polygons":
        """Return these polygons, facing the cells with numbers (n,)."""
        return Polygons(self.cell, faces, self.corners)

    def with_area(self) -> "Polygons":
        """Return the polygons that have an area."""
        return self.select(area(self.corners) > AREA_TOLERANCE)

    def concatenate_with(self, other: "Polygons") -> "Polygons":
        """Return these polygons followed by others; missing corners repeat the last one."""
        corner_count = max(self.corners.shape[1], other.corners.shape[1])
        corners = list[Array]()
        for polygons in (self, other):
            missing = corner_count - polygons.corners.shape[1]
            corners.append(np.pad(polygons.corners, ((0, 0), (0, missing), (0, 0)), "edge"))
        return Polygons(
            np.concatenate([self.cell, other.cell]),
            np.concatenate([self.faces, other.faces]),
            np.concatenate(corners),
        )

    def triangles(self, open_sides: Flags, edge_turns: Flags) -> Triangles:
        """Return triangles: each polygon is cut from its centroid to its corners.

        The third side of a triangle is then a side of its polygon, which may be on an edge of the
        surface. A polygon of three sides with at most one on an edge stays whole. So the triangles
        do not depend on which corner is the first.

        Parameters
        ----------
        open_sides
            (cells, 3) whether the side opposite to each corner is on an edge of the surface.
        edge_turns
            (cells, 3) whether the edge turns in the corner.
        """
        corners, next_corners = self.corners, np.roll(self.corners, -1, axis=1)
        # a repeated corner begins a side of no length, which does not count
        has_side = np.linalg.norm(corners - next_corners, axis=2) > SAME_CORNER_TOLERANCE
        # of each side whether it is on an edge, and at which ends this turns: see `Triangles.ends`
        ends = self._ends_of_sides(has_side, open_sides, edge_turns)
        edge_count = (ends != NOT_ON_EDGE).sum(axis=1)
        is_whole = (has_side.sum(axis=1) == 3) & (edge_count <= 1)
        single = self.select(is_whole)._single_triangles(has_side[is_whole], ends[is_whole])
        # the other polygons become fans: one triangle from the centroid to each side
        centre = np.zeros((len(corners), 2))
        centre[~is_whole] = centroid(corners[~is_whole])
        polygon, side = np.nonzero(has_side & ~is_whole[:, None])
        fans = Triangles(
            cell=self.cell[polygon],
            faces=self.faces[polygon],
            first=centre[polygon],
            e1=corners[polygon, side] - centre[polygon],
            e2=next_corners[polygon, side] - centre[polygon],
            ends=ends[polygon, side],
        )
        return Triangles.concatenate([single, fans])

    def _ends_of_sides(self, has_side: Flags, open_sides: Flags, edge_turns: Flags) -> Longs:
        """Return the `ends` (n, m) of all sides of the polygons.

        They are `NOT_ON_EDGE` of a side that is not on an edge of the surface. Otherwise they are
        the sum of 1 if the edge turns at the side's begin, and of 2 if it turns at its end. Side k
        goes from corner k to the next one.

        Parameters
        ----------
        has_side
            (n, m) whether the side that begins at a corner has a length.
        open_sides, edge_turns
            (cells, 3) whether the side opposite to a corner of a cell is on an edge, and whether
            the edge turns in this corner.
        """
        # barycentric coordinates: number k is zero on side k of the cell, opposite to its corner k
        x, y = self.corners[..., 0], self.corners[..., 1]
        coordinates = np.stack([1 - self.corners.sum(axis=2), x, y], axis=2)
        on_side = np.abs(coordinates) < SAME_CORNER_TOLERANCE
        # a polygon's side is on an edge if both its ends are on the same open side of the cell
        on_open_side = on_side & np.roll(on_side, -1, axis=1) & open_sides[self.cell][:, None]
        is_edge = has_side & on_open_side.any(axis=2)
        # a corner of the cell is on the two sides that are not opposite to it
        at_cell_corner = on_side[..., [1, 2, 0]] & on_side[..., [2, 0, 1]]
        turns_at_begin = (at_cell_corner & edge_turns[self.cell][:, None]).any(axis=2)
        turns_at_end = np.roll(turns_at_begin, -1, axis=1)
        return np.where(is_edge, turns_at_begin + 2 * turns_at_end, NOT_ON_EDGE)

    def _single_triangles(self, has_side: Flags, ends: Longs) -> Triangles:
        """Return these polygons of three sides as triangles; a side on an edge becomes the third.

        They have at most one side on an edge.

        Parameters
        ----------
        has_side, ends
            (n, m) whether a side of finite length begins at a corner, and the `ends` of that side:
            `NOT_ON_EDGE`, or 0 to 3 for a side on an edge.
        """
        # the three sides of finite length, in their order; repeated corners begin the others
        side_numbers = np.argsort(~has_side, axis=1, kind="stable")[:, :3]
        corners = np.take_along_axis(self.corners, side_numbers[..., None], axis=1)
        side_ends = np.take_along_axis(ends, side_numbers, axis=1)
        has_edge = (side_ends != NOT_ON_EDGE).any(axis=1)
        # the side on an edge, if there is one, has the largest of the three `ends`
        edge_side = side_ends.argmax(axis=1)
        # the corner opposite to that side becomes the first: side k goes from corner k to k + 1
        apex = np.where(has_edge, (edge_side + 2) % 3, 0)[:, None]
        first, second, third = (
            np.take_along_axis(corners, ((apex + i) % 3)[..., None], axis=1)[:, 0] for i in range(3)
        )
        return Triangles(
            self.cell,
            self.faces,
            first,
            e1=second - first,
            e2=third - first,
            ends=side_ends.max(axis=1),
        )

    def clip(self, a: Array, b: Array) -> "Polygons":
        """Return the parts of the polygons to the left of lines from a (n, 2) to b (n, 2).

        Each polygon has a line of its own (the algorithm of Sutherland and Hodgman). The result may
        have polygons without an area.
        """
        # heights of corners to the left of the line, times its length; the line crosses a side
        # whose two corners have heights of different signs
        normal = np.stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]], axis=1)
        height = np.einsum("nki,ni->nk", self.corners - a[:, None], normal)
        height[np.abs(height) < AREA_TOLERANCE] = 0.0
        next_height, next_corner = np.roll(height, -1, axis=1), np.roll(self.corners, -1, axis=1)
        is_crossed = height * next_height < 0
        # where the line crosses a side: its share of the way to the next corner
        crossing_share = height / np.where(is_crossed, height - next_height, 1.0)
        crossing = self.corners + crossing_share[..., None] * (next_corner - self.corners)
        # candidates: each corner, followed by the crossing on the side that begins there
        count, m = height.shape
        candidates = np.stack([self.corners, crossing], axis=2).reshape(count, 2 * m, 2)
        has_side = (next_corner != self.corners).any(axis=2)  # the corner is not a repeated one
        is_kept_corner = (height >= 0) & has_side
        is_kept = np.stack([is_kept_corner, is_crossed], axis=2).reshape(count, 2 * m)
        # kept candidates move to the front, in their order; a polygon with fewer of them than the
        # others repeats its first one
        corner_count = max(3, int(is_kept.sum(axis=1).max(initial=0)))
        kept_first = np.argsort(~is_kept, axis=1, kind="stable")[:, :corner_count]
        corners = np.take_along_axis(candidates, kept_first[..., None], axis=1)
        is_corner = np.take_along_axis(is_kept, kept_first, axis=1)
        corners = np.where(is_corner[..., None], corners, corners[:, :1])
        return Polygons(self.cell, self.faces, corners)


def area(corners: Array) -> Array:
    """Return the areas (n,) of polygons (n, m, 2), positive counterclockwise."""
    off = corners - corners[:, :1]
    x, y = off[..., 0], off[..., 1]
    return np.asarray(np.sum(x * np.roll(y, -1, 1) - np.roll(x, -1, 1) * y, axis=1) / 2)


def centroid(corners: Array) -> Array:
    """Return the centroids (n, 2) of polygons (n, m, 2) that have an area."""
    off = corners - corners[:, :1]
    next_off = np.roll(off, -1, 1)
    # the mean of the centroids of triangles at the first corner, weighted by their areas
    doubled_areas = off[..., 0] * next_off[..., 1] - next_off[..., 0] * off[..., 1]
    from_first_corner = (
        np.einsum("nk,nki->ni", doubled_areas, off + next_off)
        / (3 * doubled_areas.sum(axis=1))[:, None]
    )
    return np.asarray(corners[:, 0] + from_first_corner)


class Segments:
    """The quadrature points on the cells of this rank, where these are cut along facing cells.

    Parameters
    ----------
    cells
        All cells of all ranks.
    own_cells
        Numbers of the cells of this rank.
    r0
        (nodes, 3) undeformed places over R.
    degrees
        Degrees of the rules on whole cells and large parts, and on small parts.
    h
        Thickness over R.
    planes
        Planes of symmetry: an edge goes on in its image, and does not turn there.

    Attributes
    ----------
    rule
        The points of this rank's cells, uncut.
    cover_distance
        (cells,) over R: no place of a cell is farther than that from the nearest of its points of
        the rule.

    The field `_edge_turns` (cells, 3) says whether the edge turns at each corner. `_corner_offset`
    is the distance of a point next to such a turn from it. `_cells`, `_r0` and `_degrees` are the
    arguments.
    """

    def __init__(
        self,
        cells: Cells,
        own_cells: Longs,
        r0: Array,
        degrees: tuple[int, int],
        h: float,
        planes: Sequence[Mirror] = (),
    ) -> None:
        """Find turning edges, the cover distances and the uncut points."""
        self._cells, self._r0, self._degrees = cells, r0, degrees
        self._corner_offset = CORNER_OFFSET * h
        corners = self._corners(r0, np.arange(len(cells.nodes)))
        self._edge_turns = cells.edge_turns(r0, TURN_COSINE)
        # no corner on a plane of symmetry counts: the edge goes on in the image
        for plane in planes:
            self._edge_turns &= np.abs(plane.signed_distance(corners)) > SAME_CORNER_TOLERANCE
        # cover distances of both rules in an equilateral triangle of side one; whole cells have the
        # first degree
        (inner_points, _), (points_at_edge, _) = triangle_rule(degrees[0]), edge_rule(degrees[0])
        inner_cover, edge_cover = cover_distance(inner_points), cover_distance(points_at_edge)
        has_edge = (cells.neighbours < 0).any(axis=1)
        relative_cover = np.where(has_edge, max(inner_cover, edge_cover), inner_cover)
        longest_side = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        self.cover_distance: Array = CELL_RADIUS_FACTOR * longest_side * relative_cover
        self.rule = ContactPoints.concatenate(
            self._points_on(self._triangles(Polygons.cells(own_cells)))
        )

    def points(
        self,
        near_places: Projections,
        r: Array,
        divisions: int,
        gaps: Callable[[ContactPoints], Array],
    ) -> ContactPoints:
        """Return all contact points of this rank, with cells cut along the cells that they face.

        Parameters
        ----------
        near_places
            Places in all cells that are near the rule's points.
        r
            (nodes, 3) places of nodes where the cuts are made.
        divisions
            How often triangles in which the gap may be closed are divided into four.
        gaps
            Returns the gaps (n,) over R of n points at r.
        """
        cell_count, rule = len(self._cells.nodes), self.rule
        if not len(near_places.point):
            return rule  # no cell faces another
        # each pair of a cell and a cell that it faces once
        keys = np.unique(rule.cell[near_places.point] * cell_count + near_places.cell)
        cell, faced_cell = keys // cell_count, keys % cell_count
        # an order of faced cells by undeformed places: rounding is the same on any ranks
        centres = self._corners(self._r0, faced_cell).mean(axis=1)
        order = np.argsort(centres @ ORDERING_DIRECTION, kind="stable")
        cell, faced_cell = cell[order], faced_cell[order]
        # the faced cells as triangles in the reference cells; then all parts of the cells, cut
        # along the sides of these triangles, as triangles
        faced_triangles = Polygons(cell, faced_cell, self._projected_corners(cell, faced_cell, r))
        triangles = self._triangles(cut_by_triangles(faced_triangles))
        # cells that face none are not cut, and keep the points of the rule
        points = [rule.select(~np.isin(rule.cell, cell))]
        # triangles with an open gap have their points now; the others are divided further
        for level in range(divisions):
            is_closing = self._may_close(triangles, gaps)
            points += self._points_on(triangles.select(~is_closing), level)
            triangles = triangles.select(is_closing).divide()
        return ContactPoints.concatenate([*points, *self._points_on(triangles, divisions)])

    def _may_close(self, triangles: Triangles, gaps: Callable[[ContactPoints], Array]) -> Flags:
        """Return flags (n,): whether the gap in each triangle may be closed somewhere.

        The gap is taken at the corners and the centroid. It is assumed to be nowhere lower than the
        least of these values by more than their range (the largest less the least).
        """
        X = CORNERS_AND_CENTROID
        # weights and divisions of these points have no meaning: only their gaps are needed
        sample_points = self._points_by_rule(triangles, X, weights=np.ones(len(X)), divisions=0)
        gap = gaps(sample_points).reshape(-1, len(X))  # (triangles, 4)
        return np.asarray(gap.min(axis=1) < np.ptp(gap, axis=1))

    def _triangles(self, polygons: Polygons) -> Triangles:
        """Return the triangles of polygons, without those that have no area."""
        triangles = polygons.triangles(self._cells.neighbours < 0, self._edge_turns)
        return triangles.select(triangles.size > AREA_TOLERANCE)

    def _points_on(self, triangles: Triangles, divisions: int = 0) -> list[ContactPoints]:
        """Return the contact points on triangles that have been divided a number of times.

        Triangles of one kind have one rule: kinds differ in whether they are small, in `ends`, and
        in how far the point next to a turn of the edge is from the turn.
        """
        # the kind of each triangle has three numbers. First: whether it is small, by the size that
        # it had before divisions; the size is twice the area. Second: its `ends`. Third: the
        # distance of a point from a turn of the edge
        is_small = triangles.size * 4**divisions <= 2 * LARGE_AREA
        has_turn = triangles.ends > 0
        turn_distance = np.where(has_turn, self._corner_shares(triangles), 0)
        keys = np.stack([is_small, triangles.ends, turn_distance], axis=1)
        kinds, kind_of_triangle = np.unique(keys, axis=0, return_inverse=True)
        # all triangles of a kind have their points together
        points = list[ContactPoints]()
        for k, (is_small_kind, ends, distance_from_turn) in enumerate(kinds):
            degree = self._degrees[int(is_small_kind)]  # the second one for small triangles
            # (points of a triangle, 2) and their weights; a triangle on an edge has points next to
            # its third side, and next to the ends of this side where the edge turns
            X, weights = (
                triangle_rule(degree)
                if ends == NOT_ON_EDGE
                else edge_rule(degree, turning_ends=int(ends), corner=float(distance_from_turn))
            )
            same_kind = triangles.select(kind_of_triangle.ravel() == k)
            points.append(self._points_by_rule(same_kind, X, weights, divisions))
        return points

    def _corner_shares(self, triangles: Triangles) -> Array:
        """Return how far a point is from a turn of the edge, (n,) over the third side's length.

        The share is limited on short sides, and rounded to a power of two so that there are few
        rules.
        """
        corners, third_side = self._corners(self._r0, triangles.cell), triangles.e2 - triangles.e1
        side_length = np.linalg.norm(
            np.einsum("na,nai->ni", third_side, corners[:, 1:] - corners[:, :1]), axis=1
        )
        rounded_share = np.exp2(np.round(np.log2(self._corner_offset / side_length)))
        return np.asarray(np.minimum(rounded_share, 1 / 64))

    def _points_by_rule(
        self, triangles: Triangles, X: Array, weights: Array, divisions: int
    ) -> ContactPoints:
        """Return the contact points of a rule on each triangle.

        Parameters
        ----------
        X, weights
            (m, 2) points of the rule in the reference triangle, and (m,) weights.
        divisions
            How often the triangles have been divided.
        """
        # (n, m, 2): the rule's points in the reference cell of each triangle; then the cell of each
        # of these n m points, and the cell that it faces
        X_in_cells = triangles.first[:, None] + X[:, :1] * triangles.e1[:, None]
        X_in_cells = X_in_cells + X[:, 1:] * triangles.e2[:, None]
        cell, faces = (np.repeat(numbers, len(X)) for numbers in (triangles.cell, triangles.faces))
        # undeformed area per area of the reference cell, |a_1 x a_2|
        table = self._cells.element.tabulate(1, X_in_cells.reshape(-1, 2))[..., 0]
        a1, a2 = np.einsum("dnk,nki->dni", table[1:], self._r0[self._cells.nodes[cell]])
        area_ratio = np.linalg.norm(np.cross(a1, a2), axis=1)
        weight = np.outer(triangles.size, weights).ravel() * area_ratio
        # points of an edge are next to the third side, not on it
        is_on_third_side = X.sum(axis=1) > 1 - 2 * EDGE_OFFSET
        is_on_edge = np.outer(triangles.ends != NOT_ON_EDGE, is_on_third_side).ravel()
        return ContactPoints(
            cell, table[0], weight, faces, is_on_edge, np.full(len(cell), divisions)
        )

    def normals(self, r: Array) -> Array:
        """Return the unit normals (cells, 3) of the planes through the corners of each cell.

        Parameters
        ----------
        r
            (nodes, 3) places of nodes.
        """
        corners = self._corners(r, np.arange(len(self._cells.nodes)))
        n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return np.asarray(n / np.linalg.norm(n, axis=1)[:, None])

    def _corners(self, r: Array, cell: Longs) -> Array:
        """Return the corners (n, 3, 3) of cells at places r (nodes, 3)."""
        return np.asarray(self._cells.at_corners @ r[self._cells.nodes[cell]])

    def _projected_corners(self, cell: Longs, other: Longs, r: Array) -> Array:
        """Return the corners (n, 3, 2) of other cells, projected on the planes of cells.

        They are in the coordinates of the reference cells, along the cells' normals. Their order
        does not depend on the ranks.

        Parameters
        ----------
        cell, other
            (n,) cells, and the cells whose corners are projected on them.
        r
            (nodes, 3) places of nodes.
        """
        corners, other_corners = self._corners(r, cell), self._corners(r, other)
        # both sides of each cell from its first corner
        sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1)
        # the pseudoinverse projects along the normal; then barycentric coordinates
        X = (other_corners - corners[:, :1]) @ np.linalg.pinv(sides)
        coordinates = np.concatenate([1 - X.sum(axis=2, keepdims=True), X], axis=2)
        # corners near a side are moved onto it, so that no slivers are cut
        coordinates[np.abs(coordinates) < SNAP_TOLERANCE] = 0.0
        X = np.asarray((coordinates / coordinates.sum(axis=2, keepdims=True))[..., 1:])
        # a fixed order of the corners, so that rounding is the same on any ranks
        order = np.argsort(self._corners(self._r0, other) @ ORDERING_DIRECTION, axis=1)
        return np.take_along_axis(X, order[..., None], axis=1)


class Cuts:
    """The contact points with cells cut at given displacements, which are known by numbers.

    The number 0 stands for the undeformed surfaces, without divisions. Any other number is
    `DIVISION_LEVELS` times a hash of the displacement, plus how often triangles in a zone of
    contact are divided.

    Parameters
    ----------
    segments
        Gives the points for places near each other.
    near_places
        Returns the places in all cells that are near the rule's points at a displacement (nodes,
        3).
    gaps
        Returns the gaps (n,) over R of points at a displacement.
    r0
        (nodes, 3) undeformed places over R.

    The field `_displacements` has number -> displacement (nodes, 3) at which the cuts are made, for
    all numbers that are known. `_latest_points` has number -> points and normals, for the last two
    numbers that were computed. `_find_near` and `_find_gaps` are the arguments `near_places` and
    `gaps`.
    """

    def __init__(
        self,
        segments: Segments,
        near_places: Callable[[Array], Projections],
        gaps: Callable[[ContactPoints, Array], Array],
        r0: Array,
    ) -> None:
        """Begin with the number 0, of the undeformed surfaces."""
        self._segments, self._find_near, self._find_gaps, self._r0 = segments, near_places, gaps, r0
        self._displacements = {0.0: np.zeros_like(r0)}
        self._latest_points = dict[float, tuple[ContactPoints, Array]]()

    def points(self, number: float, u: Array) -> tuple[ContactPoints, Array]:
        """Return the points with the cuts of a number, and the cells' normals (cells, 3) there.

        The points of the last two numbers are kept in memory. A number that is not known yet, as in
        a state of another run, is given the present displacement u (nodes, 3) for its cuts.
        """
        if number not in self._latest_points:
            cut_u = self._displacements.setdefault(number, np.array(u))
            # of the numbers in memory the latest stays, and the new one comes after it
            latest_item = [*self._latest_points.items()][-1:]
            points_and_normals = self.points_at(cut_u, divisions_of(number))
            self._latest_points = {**dict(latest_item), number: points_and_normals}
        return self._latest_points[number]

    def displacement(self, number: float) -> Array:
        """Return the displacement (nodes, 3) at which the cuts of a known number are made."""
        return self._displacements[number]

    def points_at(self, u: Array, divisions: int) -> tuple[ContactPoints, Array]:
        """Return the points with cuts at a displacement, and the normals (cells, 3) there."""
        r = self._r0 + u
        points = self._segments.points(
            self._find_near(u), r, divisions, lambda points: self._find_gaps(points, u)
        )
        return points, self._segments.normals(r)

    def number_of_displacement(self, u: Array, divisions: int) -> float:
        """Return the number of the cuts at a displacement, with a number of divisions.

        The number is remembered. It is the same whenever displacement and divisions are.
        """
        digest = hashlib.blake2b(np.array(u).tobytes(), digest_size=HASH_BYTES).digest()
        number = float(DIVISION_LEVELS * int.from_bytes(digest) + divisions)
        self.recall(number, u)
        return number

    def recall(self, number: float, u: Array) -> None:
        """Let a number stand for the cuts at a displacement u (nodes, 3)."""
        self._displacements[number] = np.array(u)


def divisions_of(number: float) -> int:
    """Return how often triangles in a zone of contact are divided for a number of cuts."""
    return int(number) % DIVISION_LEVELS


def oriented_sides(triangles: Array) -> tuple[Array, Array]:
    """Return begins and ends (n, 3, 2) of the sides of triangles (n, 3, 2).

    Sides are directed so that the triangle is on their left.
    """
    a, b = triangles, np.roll(triangles, -1, axis=1)
    is_clockwise = (area(triangles) < 0)[:, None, None]
    return np.where(is_clockwise, b, a), np.where(is_clockwise, a, b)


def cut_by_triangles(triangles: Polygons) -> Polygons:
    """Return reference cells cut along the sides of the triangles that they face.

    Each polygon is the common part of a cell and a triangle, or a part of the cell that faces
    nothing (`NO_CELL`). Where triangles overlap, a later one has only the part outside the earlier
    ones. First all triangles are cut at once. Only cells that these do not cover exactly are cut
    again, by one triangle after the other, which takes longer.

    Parameters
    ----------
    triangles
        For each pair of a cell and a cell that it faces, the latter's corners in the reference
        cell.
    """
    cells, row_of_cell = np.unique(triangles.cell, return_inverse=True)
    # the common part of each pair of a cell and a triangle; pairs without an area do not count
    common = _common_parts(Polygons.cells(triangles.cell), triangles)
    is_common = np.abs(area(triangles.corners)) > AREA_TOLERANCE
    is_common &= area(common.corners) > AREA_TOLERANCE
    common, row_of_cell = common.select(is_common), row_of_cell[is_common]
    # the sum of the parts is the cell's area if triangles cover it without an overlap
    covered = np.bincount(row_of_cell, area(common.corners), len(cells))
    is_inexact = np.abs(covered - REFERENCE_AREA) > AREA_TOLERANCE
    if not is_inexact.any():
        return common
    # the other cells are cut again: into parts in which what several triangles cover is counted
    # once, and a remainder that none covers
    inexact_triangles = triangles.select(is_common).select(is_inexact[row_of_cell])
    common_once, remainder = _cut_one_by_one(inexact_triangles, cells[is_inexact])
    # common parts and the remainder make the whole cell if no triangles overlap
    uncovered = np.bincount(
        np.searchsorted(cells, remainder.cell), area(remainder.corners), len(cells)
    )
    is_complete = np.abs(covered + uncovered - REFERENCE_AREA) <= AREA_TOLERANCE
    # only cells in which triangles overlap take the parts of the second cutting
    overlapped = cells[is_inexact & ~is_complete]
    without_overlap = common.select(~np.isin(common.cell, overlapped))
    with_overlap = common_once.select(np.isin(common_once.cell, overlapped))
    return without_overlap.concatenate_with(with_overlap).concatenate_with(remainder)


def _common_parts(polygons: Polygons, triangles: Polygons) -> Polygons:
    """Return what each of n polygons has in common with the triangle in the same row.

    The parts face the cells of the triangles. Some may have no area.
    """
    common = polygons.with_faces(triangles.faces)
    a, b = oriented_sides(triangles.corners)
    for k in range(3):  # what is to the left of each side of the triangle
        common = common.clip(a[:, k], b[:, k])
    return common


def _cut_one_by_one(triangles: Polygons, cells: Longs) -> tuple[Polygons, Polygons]:
    """Return the common parts of cells and triangles, and the rest of the cells.

    The rest faces no cell (`NO_CELL`). Each triangle is cut out of what the earlier triangles have
    left of its cell.

    Parameters
    ----------
    triangles
        For each pair of a cell and a cell that it faces, the latter's corners in the reference
        cell.
    cells
        Numbers of the cells, ascending.
    """
    # triangles of row k of `cells` are first[k], first[k] + 1, ... as many as the count says
    triangles = triangles.select(np.argsort(triangles.cell, kind="stable"))
    first = np.searchsorted(triangles.cell, cells)
    triangle_count = np.searchsorted(triangles.cell, cells, "right") - first
    remainder = Polygons.cells(cells)  # all that is left of the cells: at first whole cells
    common_parts = remainder.select(np.zeros(0, dtype=np.int64))  # at first none
    # in each round one more triangle of each cell cuts all that is left of the cell
    for triangle_number in range(int(triangle_count.max(initial=0))):
        cell_row = np.searchsorted(cells, remainder.cell)
        has_triangle = triangle_count[cell_row] > triangle_number
        cutting = triangles.select(first[cell_row[has_triangle]] + triangle_number)
        cut_polygons = remainder.select(has_triangle)
        common = _common_parts(cut_polygons, cutting)
        is_cut = area(common.corners) > AREA_TOLERANCE
        common_parts = common_parts.concatenate_with(common.select(is_cut))
        # what no triangle of this round cuts remains as it is
        remainder = remainder.select(~has_triangle).concatenate_with(cut_polygons.select(~is_cut))
        # of the others the parts outside the triangle remain: one outside its first side, one
        # inside that but outside the second, one inside both but outside the third. The inside is
        # to the left of the way from a to b
        a, b = oriented_sides(cutting.corners[is_cut])
        inside = cut_polygons.select(is_cut)
        for k in range(3):
            outer_part = inside.clip(b[:, k], a[:, k])
            remainder = remainder.concatenate_with(outer_part.with_area())
            inside = inside.clip(a[:, k], b[:, k])
    return common_parts, remainder
