"""The search for the places of other cells that the points of a surface face, at a displacement.

A tree finds the pairs of cells that are near each other. These pairs are kept while nodes move
little. Newton's method finds the closest point in each near cell (`projection`). Of these places
only those count from which the surface goes on to no nearer one. docs/theory.md, Contact.

- A contact point is a quadrature point: `cell` has its cell, `shape` the shape functions there.
- A place is a point's projection: the closest place in a cell, with coordinates X in that cell
  (`Projections`). `point` has the number of its contact point, `distance` the distance of the two.
- Free directions are those in which a place can move: two inside a cell, one on its side, none in
  its corner.
- The side of a cell is one of its three edges; `neighbours` (cells, 3) has the cell across each of
  them, or a negative number at an open side. But the number `side` of a place is that of the
  direction in which its point faces it: 0 for the direction of the nearest place.
- `firsts` has the row of the first place of each point and direction.
- Cells are near within the surface if the way between them along the undeformed surface is short.
  Such cells are the material around a point, and touch it only if folded.
- Cuts divide cells along the cells that they face (`segments`).
- The reach is the largest distance that is looked for. Lengths are over R.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.parts.contact.face_offsets import FaceOffsets
from magshell_fenicsx.parts.contact.projection import (
    CELL_RADIUS_FACTOR,
    LATTICE_RADIUS_FACTOR,
    MAX_DIRECTIONS,
    PLACE_SHAPES,
    SELF_CONTACT_DISTANCE,
    Cells,
    Longs,
    ProjectionLimits,
    Projections,
    UndeformedPairs,
    have_farther_places,
    jets,
    near_spheres,
    nearest_places,
    points_in_cells,
    polynomial_bound,
)
from magshell_fenicsx.parts.contact.segments import ContactPoints

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
TRACKING_MARGIN = 0.5  # cells' mean radii that nodes move before near pairs are sought again
MAX_DISTANCES_AT_ONCE = 2_000_000  # between nodes of cells that may be folded
BLUR_DISTANCE = 1e-6  # thicknesses over which places in neighbouring cells count as one
# thicknesses by which a place is farther than the nearest and still counts
DISTANCE_TOLERANCE = 40 * BLUR_DISTANCE
SAME_DIRECTION_COSINE = 0.5  # between the directions to places that are joined: folds are smaller
FOLD_SHRINKAGE = 0.9  # deformed over undeformed distance of corners, below which cells are folded
STEEP_COSINE = 0.87  # between normals of cells, below which an edge is no part of a face
FIRST_REACHES = 0.3, 0.5  # parts of a reach that are searched first, which costs less


class ClosestPointSearch:
    """The search for the closest points of a surface to its own points.

    Parameters
    ----------
    cells
        All cells of all ranks.
    rule
        Quadrature points on all cells of this rank.
    may_touch
        Of cell numbers i and j, (n,) each, returns flags (n,): whether points of cell i may touch
        cell j.
    h
        Thickness over R.
    r0
        (nodes, 3) undeformed places over R.
    offsets
        Half the thickness where it varies, or changes with the state; None where it is h/2.

    Attributes
    ----------
    half_thickness
        (nodes,) undeformed, over R.

    A key i * cells + j stands for the pair of cells i and j. The field `_near_keys` has those of
    cells that are near within the surface, in ascending order. `_undeformed_nodes` (nodes, 4) are
    the undeformed places of nodes with half the thickness. `_undeformed_points` has the contact
    points that were searched last, and their undeformed places. `_own_cells` are the modelled cells
    of this rank. `_tracked` has for each reach the displacement, the reach with its margin, and the
    pairs of near cells of the last search.
    """

    def __init__(
        self,
        cells: Cells,
        rule: ContactPoints,
        may_touch: Callable[[Longs, Longs], Flags],
        h: float,
        r0: Array,
        offsets: FaceOffsets | None,
        comm: MPI.Comm,
    ) -> None:
        """Find the cells that are near within the undeformed surface, and the undeformed points."""
        self._cells, self._rule, self._may_touch, self._h = cells, rule, may_touch, h
        self._r0, self._offsets, self._comm = r0, offsets, comm
        self.half_thickness: Array = np.full(len(r0), h / 2)
        if offsets:
            self.half_thickness = offsets.undeformed_half_thickness
        self._largest_thickness = 2 * self._bound(self.half_thickness)
        # a number of thicknesses, as a field at nodes
        distance = 2 * SELF_CONTACT_DISTANCE * self.half_thickness
        # numbers i * cells + j of the pairs of cells i and j that are near within the surface
        self._near_keys = cells.near_within_surface(r0, distance)
        self._undeformed_nodes = np.column_stack([r0, self.half_thickness])
        undeformed_points = self.places_of_points(rule, self._undeformed_nodes)
        self._undeformed_points: tuple[ContactPoints, Array] = rule, undeformed_points
        self._own_cells = np.unique(rule.cell)  # of this rank, that are modelled
        # reach -> displacement, reach with a margin, and near pairs of the last search
        self._tracked = dict[float, tuple[Array, float, tuple[Longs, Longs]]]()

    def places_of_nodes(self, u: Array, *, to_faces: bool = True) -> Array:
        """Return the places (nodes, 3) of all nodes at a displacement u (nodes, 3), over R.

        Where the thickness varies and `to_faces` is set, they are (nodes, 4). The fourth component
        is half the thickness less h/2: with it distances are those of faces, plus h.
        """
        r = self._r0 + u
        if not (to_faces and self._offsets):
            return r
        return np.column_stack([r, self._offsets.half_thickness(u) - self._h / 2])

    def _bound(self, nodal: Array) -> float:
        """Return an upper bound of the field with values `nodal` (nodes,) at nodes."""
        return polynomial_bound(nodal[self._cells.nodes], self._cells.lebesgue_constant)

    def places_of_points(self, points: ContactPoints, r: Array, which: Any = slice(None)) -> Array:
        """Return the places (n, 3 or 4) of some contact points, over R.

        A fourth component is minus half the thickness, plus h/2: of points it has the other sign.

        Parameters
        ----------
        points
            Contact points, of which `which` selects some.
        r
            (nodes, 3 or 4) places of nodes, from `places_of_nodes`.
        which
            Numbers or flags of these points, or a slice; by default all.
        """
        return points_in_cells(self._cells, r, points.cell[which], points.shape[which])

    def come_near(self, u: Array, v: Array) -> bool:
        """Return whether cells that may touch come near each other from u to v; collective.

        They do if spheres around the cells on the whole straight way are nearer than the largest
        thickness.

        Parameters
        ----------
        u, v
            (nodes, 3) displacements over R.
        """
        centres_at_u, radii_at_u = self._bounding_spheres(self._r0 + u)
        centres_at_v, radii_at_v = self._bounding_spheres(self._r0 + v)
        # one sphere around each cell's way: at the middle, larger by half of the motion
        centres = (centres_at_u + centres_at_v) / 2
        half_motion = np.linalg.norm(centres_at_v - centres_at_u, axis=1) / 2
        radii = np.maximum(radii_at_u, radii_at_v) + half_motion
        reach = self._largest_thickness
        sphere_pairs = near_spheres(centres, radii, reach, self._own_cells)
        pairs = self._select_pairs(*sphere_pairs, reach, self._r0 + u, self._r0 + v)
        return bool(self._comm.allreduce(len(pairs[0])))

    def _bounding_spheres(self, r: Array, cell: Any = slice(None)) -> tuple[Array, Array]:
        """Return centres (n, 3) and radii (n,) of spheres around cells at places r (nodes, 3).

        `cell` are the numbers of n cells; by default the spheres are those of all cells.
        """
        nodal = r[self._cells.nodes[cell]]
        centres = nodal.mean(axis=1)
        radii = np.linalg.norm(nodal - centres[:, None], axis=2).max(axis=1)
        return centres, CELL_RADIUS_FACTOR * radii

    def _select_pairs(
        self, i: Longs, j: Longs, reach: float, *surfaces: Array
    ) -> tuple[Longs, Longs]:
        """Return the pairs of cells i and j, (n,) each, that may touch.

        Cells that are near within the surface count only if they are folded onto each other.

        Parameters
        ----------
        reach
            Distance over R up to which folded cells count.
        surfaces
            Deformed places (nodes, 3); a fold in one of them is enough.
        """
        allowed = self._may_touch(i, j)
        i, j = i[allowed], j[allowed]
        is_selected = ~self.are_near_in_surface(i * len(self._cells.nodes) + j)
        near_pairs = np.flatnonzero(~is_selected)  # within the surface
        for r in surfaces:
            is_selected[near_pairs] |= self._are_folded(i[near_pairs], j[near_pairs], r, reach)
        return i[is_selected], j[is_selected]

    def are_near_in_surface(self, keys: Longs) -> Flags:
        """Return flags (n,): whether cells i and j are near within the undeformed surface.

        The keys (n,) are i * cells + j.
        """
        # where each key would stand among the ascending keys of near cells; a key beyond the last
        # of them is compared with the last one, from which it differs
        position = np.minimum(np.searchsorted(self._near_keys, keys), len(self._near_keys) - 1)
        return np.asarray(self._near_keys[position] == keys)

    def _are_folded(self, i: Longs, j: Longs, r: Array, reach: float) -> Flags:
        """Return flags (n,): whether cells i and j of one surface are folded onto each other.

        Places of both must be nearer than the reach at r, but not near within the undeformed
        surface. Nodes stand for all places of a cell, with a margin for the distance between nodes.

        Parameters
        ----------
        i, j
            (n,) cells that are near within the surface.
        r
            (nodes, 3) deformed places over R.
        reach
            Distance over R.
        """
        is_folded, nodes = np.zeros(len(i), dtype=bool), self._cells.nodes
        # no place of a cell is farther from all nodes than `spacing` times the cell's radius
        _, radii = self._bounding_spheres(r)
        _, undeformed_radii = self._bounding_spheres(self._r0)
        spacing = LATTICE_RADIUS_FACTOR / self._cells.element.degree
        chunks = 1 + len(i) * nodes.shape[1] ** 2 // MAX_DISTANCES_AT_ONCE  # which limits memory
        for chunk in np.array_split(np.arange(len(i)), chunks):
            # first the distances of corners alone, since a fold makes one of them shorter: most
            # pairs are left out here
            corners_of_i, corners_of_j = nodes[i[chunk], :3, None], nodes[j[chunk], None, :3]
            has_shrunk = _distances_of_nodes(r, corners_of_i, corners_of_j) < (
                FOLD_SHRINKAGE * _distances_of_nodes(self._r0, corners_of_i, corners_of_j)
            )
            pairs = chunk[has_shrunk.any(axis=(1, 2))]
            # then all nodes of the pairs that remain: whether two nodes are close now, and were
            # apart undeformed
            first, second = i[pairs], j[pairs]
            first_nodes, second_nodes = nodes[first, :, None], nodes[second, None, :]
            margin = spacing * (radii[first] + radii[second])[:, None, None]
            is_close = _distances_of_nodes(r, first_nodes, second_nodes) < reach + margin
            margin = spacing * (undeformed_radii[first] + undeformed_radii[second])[:, None, None]
            thickness = self.half_thickness[first_nodes] + self.half_thickness[second_nodes]
            least_separation = SELF_CONTACT_DISTANCE * thickness - margin
            was_apart = _distances_of_nodes(self._r0, first_nodes, second_nodes) > least_separation
            is_folded[pairs] = (is_close & was_apart).any(axis=(1, 2))
        return is_folded

    def _near_pairs(self, u: Array, reach: float) -> tuple[Longs, Longs]:
        """Return pairs (i, j) of cells that are near each other; i are modelled cells of this rank.

        The pairs are searched with a margin beyond the reach. They are kept for each reach until
        the nodes have moved so far that a pair from beyond this margin may be near. So the result
        may have pairs that are a little farther apart than the reach.

        Parameters
        ----------
        u
            (nodes, 3) displacement over R.
        reach
            Distance between the cells over R.
        """
        if reach in self._tracked:
            tracked_u, searched_reach, pairs = self._tracked[reach]
            # twice, since two cells may move towards each other
            motion = 2 * float(np.linalg.norm(u - tracked_u, axis=1).max(initial=0.0))
            if motion + reach <= searched_reach:
                return pairs
        centres, radii = self._bounding_spheres(self._r0 + u)
        searched_reach = reach + TRACKING_MARGIN * float(radii.mean())
        sphere_pairs = near_spheres(centres, radii, searched_reach, self._own_cells)
        pairs = self._select_pairs(*sphere_pairs, searched_reach, self._r0 + u)
        self._tracked[reach] = np.array(u), searched_reach, pairs
        return pairs

    def projections(
        self,
        u: Array,
        reach: float,
        points: ContactPoints | None = None,
        *,
        to_faces: bool = True,
        least_only: bool = False,
    ) -> Projections:
        """Return the closest places that contact points face at a displacement.

        Parameters
        ----------
        u
            (nodes, 3) displacement over R.
        reach
            Largest distance over R: between mid-surfaces, or with `to_faces` between faces plus h.
        points
            By default those of the rule.
        to_faces
            Whether a variable thickness counts in distances.
        least_only
            Whether only each point's nearest place is needed; the result may have some others.
        """
        points = points or self._rule
        r = self.places_of_nodes(u, to_faces=to_faces)
        # a point has one place in each near cell; those stay from which the surface goes on to no
        # nearer one
        places = self.projections_in_cells(points, u, r, reach, least_only=least_only)
        return self._select_nearest(points, places)

    def least_distance(
        self, u: Array, max_reach: float, points: ContactPoints | None = None
    ) -> float:
        """Return the least distance over R between any point and its place; collective.

        It is at most `max_reach`, which is returned where nothing is nearer. Small reaches are
        searched first, since they cost less.

        Parameters
        ----------
        u
            (nodes, 3) displacement over R.
        max_reach
            Largest distance over R that is looked for.
        points
            Contact points of this rank; by default all quadrature points.
        """
        for reach in (*(share * max_reach for share in FIRST_REACHES), max_reach):
            places = self.projections(u, reach, points, least_only=True)
            own_least = float(places.distance.min(initial=max_reach))
            least_distance = float(self._comm.allreduce(own_least, MPI.MIN))
            if least_distance < reach:
                return least_distance
        return max_reach

    @cached_property
    def _separate_surfaces(self) -> tuple[Longs, Flags]:
        """The number of each cell's connected surface, and which surfaces are separate.

        The numbers are (cells,). The flags (m, m) say of two of the m surfaces whether they are
        separate: each place of one may touch each place of the other, and no cell of one is near a
        cell of the other within the surface. Of a separate surface only the place that is nearest
        to a point counts.
        """
        # cells that share a side are connected; surfaces are the connected parts
        cell, side = np.nonzero(self._cells.neighbours >= 0)
        n, neighbour = len(self._cells.nodes), self._cells.neighbours[cell, side]
        adjacency = scipy.sparse.coo_array((np.ones(len(cell)), (cell, neighbour)), (n, n))
        count, surface_of_cell = scipy.sparse.csgraph.connected_components(
            adjacency, directed=False
        )
        # faced[a, b]: how many cells of surface b may be touched by surface a, for which its first
        # cell stands
        faced = np.zeros((count, count), dtype=np.int64)
        _, first_cells = np.unique(surface_of_cell, return_index=True)
        for surface, first_cell in enumerate(first_cells):
            faced_cells = self._may_touch(np.full(n, first_cell), np.arange(n))
            faced[surface] = np.bincount(surface_of_cell[faced_cells], minlength=count)
        # whether any cells of two surfaces are near within the surface
        is_near = np.zeros((count, count), dtype=bool)
        near_cells, other_cells = self._near_keys // n, self._near_keys % n  # from keys i * n + j
        is_near[surface_of_cell[near_cells], surface_of_cell[other_cells]] = True
        # whether surface a may touch all cells of surface b
        faces_all = faced == np.bincount(surface_of_cell)
        is_other = ~np.eye(count, dtype=bool)  # a surface is not separate from itself
        return surface_of_cell, faces_all & faces_all.T & ~is_near & is_other

    def _limits(
        self,
        searched: Longs,
        x: Array,
        r: Array,
        pairs: tuple[Longs, Longs],
        cell: Longs,
        max_distance: float,
    ) -> ProjectionLimits:
        """Return bounds of the distance from points to their nearest places on separate surfaces.

        The nearest node of such a surface bounds the distance, since it is a place of the surface.
        A surface is separate if all of it may touch the point's surface, and none of it is near
        within the surface; then only its nearest place counts.

        Parameters
        ----------
        searched, cell
            (m,) numbers of the points that are searched, and their cells.
        x, r
            (n, 3 or 4) places of all points, and (nodes, 3 or 4) of nodes.
        pairs
            (pairs,) cells i of points, and the cells j that are near them.
        max_distance
            Distance over R beyond which nodes are not looked for.

        Returns
        -------
        ProjectionLimits
            (pairs,) whether cell j is on a separate surface, and the bound (n,) of each point,
            which is infinite where there is none.
        """
        surface_of_cell, are_separate = self._separate_surfaces
        # the range of half the thickness, by which the distance of faces may exceed that of a node
        variation = 0.0
        if r.shape[1] > 3:
            variation = self._bound(r[:, 3]) + self._bound(-r[:, 3])
        own_cells, faced_cells = pairs
        is_near = np.zeros(len(self._cells.nodes), dtype=bool)
        is_near[faced_cells] = True
        # the points of each surface together: their distances from near nodes of all surfaces that
        # are separate from it
        bound, surface_of_point = np.full(len(x), np.inf), surface_of_cell[cell]
        for surface in np.unique(surface_of_point):
            near_separate_cells = is_near & are_separate[surface][surface_of_cell]
            nodes = np.unique(self._cells.nodes[near_separate_cells])
            if len(nodes):
                points_of_surface = searched[surface_of_point == surface]
                # a node beyond the largest distance has an infinite one: the point has no bound
                tree = scipy.spatial.cKDTree(r[nodes, :3])
                distance, _ = tree.query(
                    x[points_of_surface, :3], distance_upper_bound=max_distance
                )
                bound[points_of_surface] = distance + variation + 2 * DISTANCE_TOLERANCE * self._h
        is_bounded = are_separate[surface_of_cell[own_cells], surface_of_cell[faced_cells]]
        return ProjectionLimits(is_bounded, bound)

    def projections_in_cells(
        self, points: ContactPoints, u: Array, r: Array, reach: float, *, least_only: bool = False
    ) -> Projections:
        """Return the nearest place in each near cell to each point, within a distance.

        A point has one place in each cell near by, also where the surface goes on from there to a
        nearer place. `projections` leaves out such places.

        Parameters
        ----------
        points
            Contact points.
        u, r
            (nodes, 3) displacement, and (nodes, 3 or 4) the result of `places_of_nodes` at it.
        reach
            Largest distance over R: between mid-surfaces, or between faces plus h where r has a
            fourth component.
        least_only
            Whether only each point's nearest place is needed; the result may have some others.
        """
        largest_offset = self._bound(r[:, 3]) if r.shape[1] > 3 else 0.0
        # mid-surfaces may be farther apart than faces, by the offsets of both
        face_reach, reach = reach, reach + 2 * largest_offset
        i, j = self._near_pairs(u, reach)
        # contact points in the order of cells: those of cell i are
        # order[first_position : first_position + count]
        order, cell_in_order = points.by_cell
        first_position = np.searchsorted(cell_in_order, i)
        count = np.searchsorted(cell_in_order, i, "right") - first_position
        # places of the points that are searched, now and undeformed
        searched = order[np.isin(cell_in_order, i)]
        x = np.zeros((len(order), r.shape[1]))
        x[searched] = self.places_of_points(points, r, searched)
        if self._undeformed_points[0] is not points:  # undeformed places are kept for one set
            self._undeformed_points = points, self.places_of_points(points, self._undeformed_nodes)
        _, undeformed_x = self._undeformed_points
        is_near = self.are_near_in_surface(i * len(self._cells.nodes) + j)
        undeformed = UndeformedPairs(
            is_near, self._undeformed_nodes, undeformed_x, SELF_CONTACT_DISTANCE
        )
        limits = None
        if least_only:
            limits = self._limits(searched, x, r, (i, j), points.cell[searched], reach)
        # for each pair the cell j with the points of cell i; the numbers of the pairs to which the
        # places belong are not needed
        pairs_with_points = j, first_position, count, order
        _, places = nearest_places(
            self._cells,
            r,
            x,
            pairs_with_points,
            reach,
            max_distance=face_reach,
            undeformed=undeformed,
            limits=limits,
        )
        return places

    def select_distant_cells(self, points: ContactPoints, places: Projections) -> Projections:
        """Return the places whose cells are not near the point's own cell within the surface.

        Only such cells are cut along each other.
        """
        keys = points.cell[places.point] * len(self._cells.nodes) + places.cell
        return places.select(~self.are_near_in_surface(keys))

    def thickness(self, points: ContactPoints, places: Projections) -> Array:
        """Return the mean (n,) of the undeformed thicknesses at points and places, over R."""
        half = self.half_thickness[self._cells.nodes]
        nodal = half[places.cell][..., None]
        # values alone: no derivatives
        (_, half_at_places), *_ = jets(self._cells.element, places.X, nodal, order=0)
        shape, own_cell = points.shape[places.point], points.cell[places.point]
        half_at_points = np.sum(shape * half[own_cell], axis=1)
        # the mean of two thicknesses is the sum of their halves
        return np.asarray(half_at_points + half_at_places[:, 0])

    def _select_nearest(self, points: ContactPoints, places: Projections) -> Projections:
        """Return the places from which the surface goes on to no nearer place.

        A point has at most one such place in each direction: on both sides of its own surface, and
        before its edge. Places at the same distance in neighbouring cells all stay; they are joined
        as one later on. The result is in the order of points, directions and distances.
        """
        # in the order of points, then of cells, so that a point's place in a cell can be looked up
        cell_count = len(self._cells.nodes)
        keys = places.point * cell_count + places.cell
        order = np.argsort(keys, kind="stable")
        places, keys = places.select(order), keys[order]
        # a place on a side counts unless the surface goes on across the side to a nearer one;
        # barycentric coordinate k is zero on side k
        on_sides = np.column_stack([1 - places.X.sum(axis=1), places.X]) == 0.0
        is_nearest = np.ones(len(places.point), dtype=bool)
        for side in range(3):
            neighbour = self._cells.neighbours[places.cell, side]
            is_on_side = on_sides[:, side] & (neighbour >= 0)
            # whether the point has a place in the neighbour too, and that one is not nearer
            is_no_nearer_across = have_farther_places(
                keys,
                other_keys=places.point * cell_count + neighbour,
                distance=places.distance,
                tolerance=DISTANCE_TOLERANCE * self._h,
            )
            # the place also counts if the surface is folded at the side: the neighbour is then the
            # material around the point, in which no place is searched
            key_of_cells = points.cell[places.point] * cell_count + neighbour
            is_folded = places.is_above & self.are_near_in_surface(key_of_cells)
            is_nearest &= ~is_on_side | is_no_nearer_across | is_folded
        places = places.select(is_nearest)
        if not len(places.point):
            return places
        # in each direction the nearest place stays, with those at the same distance
        places = _number_directions(places.select(np.lexsort((places.distance, places.point))))
        first = places.firsts  # row of the nearest place of each point and direction
        least_distance = np.repeat(places.distance[first], np.diff([*first, len(places.point)]))
        return places.select(places.distance < least_distance + DISTANCE_TOLERANCE * self._h)

    def are_left_to_edges(
        self, points: ContactPoints, places: Projections, normals: Array
    ) -> Flags:
        """Return flags (n,): which places do not count, because points of an edge press there.

        They are places on an edge of another surface that a point inside a surface faces steeply.
        Points inside a surface see the edge as a line that is narrower than the distance of the
        points. The edge would catch at each of them as it slides. So only the edge's own points
        press. All places of one point and direction have the flag of the nearest.

        Parameters
        ----------
        points
            Contact points.
        places
            Their places, in the order of points, directions and distances.
        normals
            (cells, 3) unit normals at the displacement where the cuts were made.
        """
        first = places.firsts  # row of the nearest place of each point and direction
        nearest = places.select(first)
        is_on_edge, is_steep = self._edge_and_steepness(points, nearest, normals)
        is_left = is_on_edge & is_steep & ~points.is_on_edge[nearest.point]
        return np.asarray(np.repeat(is_left, np.diff([*first, len(places.point)])))

    def are_edges_alone(self, points: ContactPoints, nearest: Projections, normals: Array) -> Flags:
        """Return flags (n,): points on an edge that presses on a face whose own do not count.

        Such a point faces the inside of a surface that is steep to its own. The points of that
        surface do not count there, since an edge would catch at each of them as it slides.

        Parameters
        ----------
        points
            All contact points.
        nearest
            n places, each the nearest of its point; the result is in their order.
        normals
            (cells, 3) unit normals at the displacement where the cuts were made.
        """
        is_on_edge, is_steep = self._edge_and_steepness(points, nearest, normals)
        return np.asarray(is_steep & ~is_on_edge)

    def _edge_and_steepness(
        self, points: ContactPoints, nearest: Projections, normals: Array
    ) -> tuple[Flags, Flags]:
        """Return two flags (n,): whether places are on an edge, and steep to their point's cell.

        A place is on an edge if it moves along an open side, or is in a corner of one. Cells are
        steep to each other if their normals have a cosine below `STEEP_COSINE`.

        Parameters
        ----------
        nearest
            n places.
        normals
            (cells, 3) unit normals.
        """
        # (n, 3): a barycentric coordinate is zero on the side opposite to its corner
        on_side = np.column_stack([1 - nearest.X.sum(axis=1), nearest.X]) == 0.0
        # places that move along a side have one free direction: the second column of each matrix
        # is zero, and the first is not
        has_direction = nearest.free_directions.any(axis=(1, 2))
        has_no_second = (nearest.free_directions[:, :, 1] == 0).all(axis=1)
        is_open = self._cells.neighbours[nearest.cell] < 0  # (n, 3): no cell across the side
        is_on_edge = has_direction & has_no_second & (on_side & is_open).any(axis=1)
        # a place in a corner is on two sides, and on an edge if that corner is
        in_corner = on_side.sum(axis=1) == 2
        is_on_edge |= in_corner & (~on_side & self._cells.is_on_edge[nearest.cell]).any(axis=1)
        cosine = np.abs(np.sum(normals[points.cell[nearest.point]] * normals[nearest.cell], axis=1))
        return np.asarray(is_on_edge), np.asarray(cosine < STEEP_COSINE)


def _distances_of_nodes(r: Array, nodes: Longs, others: Longs) -> Array:
    """Return the distances between nodes and others, which are broadcast, at places (nodes, 3)."""
    return np.asarray(np.linalg.norm(r[nodes] - r[others], axis=3))


def _number_directions(places: Projections) -> Projections:
    """Return the places with the number of their direction from their point as `side`.

    Number 0 has the nearest place of a point, with all places in about the same direction. Number 1
    has the nearest of the others, with those in about its direction. The last number,
    `MAX_DIRECTIONS` - 1, has all that remain. The result is in the order of points, directions and
    distances.

    Parameters
    ----------
    places
        In the order of points and distances.
    """
    direction_numbers = np.full(len(places.point), MAX_DIRECTIONS - 1)
    remaining = np.arange(len(places.point))  # rows without a number
    for direction in range(MAX_DIRECTIONS - 1):
        # the nearest place of each point that remains, for each of that point's rows
        first = np.flatnonzero(np.diff(places.point[remaining], prepend=-1))
        nearest = np.repeat(remaining[first], np.diff([*first, len(remaining)]))
        cosine = np.sum(places.direction[remaining] * places.direction[nearest], axis=1)
        is_same = cosine > SAME_DIRECTION_COSINE
        direction_numbers[remaining[is_same]] = direction
        remaining = remaining[~is_same]
    places = replace(places, side=direction_numbers)
    return places.select(np.lexsort((places.distance, direction_numbers, places.point)))


def gap_between_supports(
    supported_nodes: Longs,
    nodes: Longs,
    r0: Array,
    u: Array,
    half_thickness: Array,
    may_touch: Callable[[Longs, Longs], Flags],
) -> float:
    """Return the least gap over R between faces at supported nodes, where faces overlap.

    It is negative where faces overlap, and infinite if none do. Only pairs of nodes count that are
    at least a thickness apart undeformed: other pairs are the same material.

    Parameters
    ----------
    supported_nodes
        Numbers (n,) of nodes that supports hold.
    nodes
        (cells, functions) nodes of all cells.
    r0, u
        (nodes, dim) undeformed places and displacement over R.
    half_thickness
        (nodes,) over R.
    may_touch
        Of cell numbers i and j, (n,) each, returns flags (n,): whether they may touch and are not
        near within the surface.
    """
    cell_of = np.zeros(len(r0), dtype=np.int64)  # one of the cells of each node
    cell_of[nodes.ravel()] = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    cells, undeformed = cell_of[supported_nodes], r0[supported_nodes]
    deformed, half = (r0 + u)[supported_nodes], half_thickness[supported_nodes]
    # (n, n) of each pair: the thickness between its mid-surfaces, and the undeformed distance
    thickness = half[:, None] + half
    distance = scipy.spatial.distance.cdist(undeformed, undeformed)
    i, j = np.nonzero(distance > (1 - DISTANCE_TOLERANCE) * thickness)
    gap = np.linalg.norm(deformed[i] - deformed[j], axis=1) - thickness[i, j]
    is_closed = gap < 0
    i, j, gap = i[is_closed], j[is_closed], gap[is_closed]
    return float(gap[may_touch(cells[i], cells[j])].min(initial=np.inf))


def no_projections() -> Projections:
    """Return an empty set of places."""
    no_numbers = np.zeros(0, dtype=np.int64)
    X, free_directions, distance, direction = (np.zeros((0, *shape)) for shape in PLACE_SHAPES)
    no_flags = no_numbers > 0
    return Projections(
        no_numbers, no_numbers, X, free_directions, distance, no_numbers, direction, no_flags
    )
