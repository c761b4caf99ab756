"""Contact of a shell with itself or of its patches with each other, on surfaces.

Each mid-surface has quadrature points. The gap of a point x is |x - y| - h with its projection y,
the closest point of the other mid-surface: the faces are half a thickness from both. The gap is a
function of the state alone, and has no sign of a side: see `PairContact.passes_through` for steps
across a surface. The points are those of a rule on each cell; where cells face others, they are on
segments, see `segments`.

With beta = (N_x, -N_y) of the nodes of both cells, n = (x - y)/d, d the distance and F = d^2/2:

    d,u = beta n,   d,uu = [beta beta (I - n n) - C^T A^-1 C]/d,   C_a = -beta y_a - d n (0, N_y,a),
    A = F,ab

where A is the Hessian of F by the place of y, which moves along. P. Wriggers, Computational Contact
Mechanics, Springer 2006, sec. 4.1 and 9; docs/theory.md, Contact.

Where the thickness varies, half of it H at nodes is a fourth unknown, the offset: d is then the
least of |x - y| - H(y), less H(x), plus h, so that |x - y| need not be the least. Of shells that
get thinner H follows from the displacement (`FaceOffsets`).

A place is a projection y: a cell with coordinates in it. Places of one point in neighbouring cells
are joined as one, with a smooth minimum of their distances (`JoinedPlaces`). Where an edge presses
on a face steeply, the places of the face's points on the edge do not count: they are left to the
edge's own points. Cuts are the segments made at one displacement, known by a number that is part of
a state. `PairContact` has the words of every contact of a pair.
"""

from dataclasses import dataclass, replace

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.global_mesh import add_to_owners, global_values
from magshell_fenicsx.assembly.nonlocal_terms import Entries
from magshell_fenicsx.parts.contact.active_set import ActiveSet, FrozenContact, Geometry
from magshell_fenicsx.parts.contact.closest_points import (
    BLUR_DISTANCE,
    DISTANCE_TOLERANCE,
    ClosestPointSearch,
    no_projections,
)
from magshell_fenicsx.parts.contact.contact_section import Pair
from magshell_fenicsx.parts.contact.face_offsets import unknown_numbers
from magshell_fenicsx.parts.contact.gap_derivatives import (
    distance_slopes,
    gap_geometry,
    gap_hessians,
    joint_entries,
)
from magshell_fenicsx.parts.contact.pair_contact import (
    SEARCH_REACH,
    ContactGeometry,
    PairContact,
    StateNumber,
)
from magshell_fenicsx.parts.contact.projection import (
    Cells,
    JoinedPlaces,
    Longs,
    Projections,
    distances,
    follow_places,
    jets,
)
from magshell_fenicsx.parts.contact.segments import ContactPoints, Cuts, Segments, divisions_of
from magshell_fenicsx.parts.contact.time_averaging import SampleCache
from magshell_fenicsx.parts.penalty_contact import PASS_THROUGH_DISTANCE, GapAlongStep

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
PATTERN_REACH = 1.0  # thicknesses: cells nearer than that have entries in the sparsity pattern
BLOCKS_PER_CHUNK = 1000  # pairs of cells whose blocks of the tangent are computed at a time
MAX_ASTRAY_FORCE = 0.1  # share of the force on points that left their cell, with the old cuts
MAX_DIVISIONS = 8  # of triangles in a zone of contact: each halves the distance of its points


@dataclass(frozen=True)
class SurfaceContactGeometry(ContactGeometry):
    """The cells of a model on a surface between which contact is sought.

    Attributes
    ----------
    segments
        Gives the quadrature points on the cells of this rank, also where these face others.
    owned_dofs
        Number of the first degree of freedom of this rank, and how many it has.
    """

    cells: Cells
    segments: Segments
    owned_dofs: tuple[int, int]


class SurfaceContact(PairContact[Projections]):
    """The contact energy of a pair on surfaces; a `Term` and a `NonlocalTerm` of `assembly`.

    Parameters
    ----------
    pair
        The two members, with the stiffness of their penalty.
    geometry
        The cells of the model.
    sides
        (cells,) flags of the cells of the first member of the pair, and of the second.

    Attributes
    ----------
    cuts
        The number of the cuts at present; 0 stands for those of the undeformed surfaces.

    Private fields of the model, besides those of `PairContact`: `_cells` are the cells of all ranks
    and images. `_rule` has the contact points of uncut cells, `_segments` gives those of cut cells,
    and `_cuts` remembers the cuts of each number. `_search` finds the places of points.

    Private fields of the last active set: `_points` are the contact points with the present cuts.
    `_places` and `_joined` have the places in contact, and `_places_left_to_edges` those that do
    not count. Of joined places `first` (m,) is the row of the nearest place of each, and `group`
    (n,) is the number of the joined place to which each place belongs. `_active_sets` and
    `_cached_entries` are caches.
    """

    _points: ContactPoints

    def __init__(
        self, pair: Pair, geometry: SurfaceContactGeometry, sides: tuple[Flags, Flags]
    ) -> None:
        """Prepare the search and the cuts; places are looked for at the first evaluation."""
        super().__init__(pair, geometry, sides)
        self.cuts = StateNumber(0.0)
        self._cells, self._segments = geometry.cells, geometry.segments
        self._owned_dofs = geometry.owned_dofs
        self._rule = geometry.segments.rule
        self._search = ClosestPointSearch(
            self._cells, self._rule, self._is_of_pair, self._h, self._r0, self._offsets, self._comm
        )
        self._cuts = Cuts(self._segments, self._near, self._gaps, self._r0)
        self._points, self._places = self._rule, no_projections()
        self._places_left_to_edges = no_projections()
        self._joined = JoinedPlaces.join(self._places, blur=1.0)  # of no places: any blur
        self._active_sets = SampleCache[tuple[Projections, Projections, JoinedPlaces]]()
        self._cached_entries: tuple[Projections | None, float, Entries] = None, 0.0, no_entries()

    def _may_touch(self, cell: Longs, other: Longs) -> Flags:
        """Return flags (n,): whether cells (n,) may touch others, which are not their material."""
        is_same_material = self._search.are_near_in_surface(cell * len(self._nodes) + other)
        return self._is_of_pair(cell, other) & ~is_same_material

    # as a term

    @property
    def history(self) -> dict[str, tuple[StateNumber, float]]:
        """The numbers that a state sets, with defaults: penalty stiffness and number of the cuts.

        A state without a number of its own has the cuts of the undeformed surfaces.
        """
        return super().history | {self.pair.cuts: (self.cuts, 0.0)}

    def _entries(self) -> Entries:
        """Return this rank's entries of the tangent by the displacement; collective.

        Those of the present state are cached. Those of a sample of a step in time are not.
        """
        places = self._active_set().places
        cached_places, cached_stiffness, cached = self._cached_entries
        is_current = cached_places is places and cached_stiffness == self.stiffness.value
        if is_current and not self.sample:
            return cached
        entries = super()._entries()
        if not self.sample:
            self._cached_entries = places, self.stiffness.value, entries
        return entries

    @property
    def pattern_key(self) -> float:
        """The number of the cuts: where it changes, the sparsity pattern is made again."""
        return self.cuts.value

    def _coupled_cells(self) -> Longs:
        """Return pairs (2, n) of cells whose nodes the tangent may couple; collective.

        They are those that touched, or nearly did, where the cuts were made.
        """
        self._active_set()  # which sets `_points` to those of the present cuts
        u = self._cuts.displacement(self.cuts.value)
        # `_reach` is h plus (`SEARCH_REACH` - 1) times the largest thickness of the pair: from that
        # a smaller reach is computed
        reach = self._h + PATTERN_REACH * (self._reach - self._h) / (SEARCH_REACH - 1)
        positions = self._search.places_of_nodes(u)
        places = self._search.projections_in_cells(self._points, u, positions, reach)
        # each pair of a point's cell and the cell of its place once
        keys = np.unique(self._pair_keys(places))
        return np.array(np.divmod(keys, len(self._nodes)))

    def _add(self, b: Array, forces: Array) -> None:
        """Add forces (nodes, 3) of this rank's points to the vectors of all ranks; collective."""
        add_to_owners(b, forces, self._owned_dofs, self._comm)

    def _entries_by_place_and_offset(self) -> Entries:
        """Return this rank's entries of the second derivative by places and offsets H of nodes.

        With the distance d of a place the penalty psi(h - d) has the second derivative
        psi'' d,u d,u - psi' d,uu. Blocks of places in the same pair of cells are summed.
        Collective.
        """
        active = self._active_set()
        places, joined_places, (_, slope, curvature) = (
            active.places,
            active.joined_places,
            active.penalties,
        )
        if not len(places.point):
            return no_entries()
        # psi' and psi'' for each place. Where several places are joined by a smooth minimum with
        # the blur e, psi'/e stands in place of psi''; the products of different places that are
        # joined come below, from `_entries_of_joints`
        is_blurred = joined_places.several[joined_places.group]
        first = slope[joined_places.group]
        second = np.where(
            is_blurred, first / (BLUR_DISTANCE * self._h), curvature[joined_places.group]
        )
        weight = active.weight / 2  # half, since the points of the other surface have the same
        # places in the same pair of cells follow one another
        order = np.argsort(self._pair_keys(places), kind="stable")
        blocks = self._blocks(places.select(order), weight[order], first[order], second[order])
        if joined_places.several.any():
            blocks.append(self._entries_of_joints(active))
        # all rows, all columns and all values of these entries
        rows, columns, values = zip(*blocks, strict=True)
        return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)

    def _blocks(
        self, places: Projections, weight: Array, first: Array, second: Array
    ) -> list[Entries]:
        """Return the entries of places by places and offsets of nodes, in chunks of limited memory.

        Parameters
        ----------
        places
            Places in an order in which those of the same pair of cells follow one another; a pair
            has the point's cell and the place's cell.
        weight, first, second
            (n,) weights, and first and second derivatives of the penalty by the penetration.
        """
        keys = self._pair_keys(places)
        starts = np.flatnonzero(np.diff(keys, prepend=-1))  # first row of each pair of cells
        positions = self._search.places_of_nodes(self._at)
        blocks = list[Entries]()
        for starts_of_chunk in np.array_split(starts, max(1, len(keys) // BLOCKS_PER_CHUNK)):
            if not len(starts_of_chunk):
                continue
            # a chunk ends where the first pair of cells of the next one begins
            later = starts[np.searchsorted(starts, starts_of_chunk[-1]) + 1 :]
            chunk = slice(starts_of_chunk[0], later[0] if len(later) else len(keys))
            # a Hessian (dofs, dofs) for each place of the chunk, by the nodes of both cells
            chunk_places = places.select(chunk)
            geometry = self._gap_geometry(chunk_places)
            *_, nodes = geometry
            penalties = weight[chunk], first[chunk], second[chunk]
            H = gap_hessians(self._cells, chunk_places, geometry, positions, penalties)
            # their sum for each pair of cells, whose places follow one another; `begins` are the
            # rows of the first ones. Then the numbers of the unknowns of rows and columns
            begins = starts_of_chunk - starts_of_chunk[0]
            sums = np.add.reduceat(H, begins, axis=0)
            dofs = unknown_numbers(nodes[begins], len(self._r0), self._components)
            i, j = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
            blocks.append((i.ravel(), j.ravel(), sums.ravel()))
        return blocks

    def _entries_of_joints(self, active: ActiveSet[Projections]) -> Entries:
        """Return the entries of joined places, besides those of each place alone.

        They are (psi'' - psi'/e) D,u D,u, with the joined distance D and the blur e of its smooth
        minimum. The active set is an argument: to find it is collective, and this is called only
        on ranks that have joined places.
        """
        joined_places, (_, slope, curvature) = active.joined_places, active.penalties
        # only joined places of several places matter; a place's share in D,u is its weight times
        # the derivative of its own distance
        is_blurred = joined_places.several[joined_places.group]
        _, n, beta, nodes = self._gap_geometry(active.places.select(is_blurred))
        slopes = joined_places.weight[is_blurred, None, None] * distance_slopes(
            n, beta, self._components
        )
        # half, since the points of the other surface have the same contact
        joint_weight = active.area / 2 * (curvature - slope / (BLUR_DISTANCE * self._h))
        return joint_entries(
            slopes, nodes, joined_places.group[is_blurred], joint_weight, len(self._r0)
        )

    def _pair_keys(self, places: Projections) -> Longs:
        """Return a number (n,) that identifies the cells of each place and its point."""
        return np.asarray(self._points.cell[places.point] * len(self._cells.nodes) + places.cell)

    # what is observed

    def least_gap(self) -> float:
        """Return the least gap over R; nan where no faces are within the reach. Collective."""
        self._active_set()  # which sets `_points` to those of the present cuts
        least_distance = self._search.least_distance(
            self._displacement(), self._reach, self._points
        )
        return least_distance - self._h if least_distance < self._reach else np.nan

    def deepest_penetration(self) -> tuple[float, Array]:
        """Return the largest penetration over R, and the place (3,) of its point; collective.

        Without contact they are 0 and the origin.
        """
        places = self._active_set().places
        own_deepest = (0.0, np.zeros(3))  # penetration and place of the point, on this rank
        if len(places.point):
            deepest = int(places.distance.argmin())
            nodes = self._r0 + self._displacement()
            point = places.point[[deepest]]
            (x,) = self._search.places_of_points(self._points, nodes, point)
            own_deepest = (float(self._h - places.distance[deepest]), x)
        # the deepest of all ranks
        penetration, x = max(self._comm.allgather(own_deepest), key=lambda candidate: candidate[0])
        return float(penetration), np.asarray(x)

    def halves(self) -> tuple[Array, Array]:
        """Return half the thickness (nodes,) over R, undeformed and at present; collective."""
        if not self._offsets:
            return self._half, self._half
        return self._half, self._offsets.half_thickness(self._displacement())

    def come_near(self, u: Array, v: Array) -> bool:
        """Return whether cells that may touch come near each other from u to v; collective.

        Displacements (nodes, 3) are those of all cells, as `configuration` has them.
        """
        return self._search.come_near(u, v)

    def passes_through(self, u: Array, v: Array) -> bool:
        return self.come_near(u, v) and super().passes_through(u, v)

    def gap_along_step(self, begin: Array, end: Array) -> GapAlongStep | None:
        """Return the gap between two displacements (nodes, 3) of all cells; None if it stays open.

        Collective.
        """
        # two nodes come nearer to each other by at most twice the largest displacement
        largest_approach = 2 * float(np.linalg.norm(end - begin, axis=1).max())
        if not largest_approach or not self.come_near(begin, end):
            return None

        def gap(part: float) -> float:
            """Return the least gap after a part of the way."""
            return self.gap(begin + part * (end - begin))

        return GapAlongStep(gap, largest_approach, PASS_THROUGH_DISTANCE * self.least_thickness())

    def gap(self, u: Array) -> float:
        """Return the least gap over R of the uncut cells at a displacement of all; collective.

        It is at most the reach of the search, less h.
        """
        return self._search.least_distance(u, self._reach) - self._h

    # the cuts of cells

    def improved_cuts(self) -> float | None:
        """Return the number of cuts at the present displacement if these are better; else None.

        Cuts are better if a smaller share of the force is on points that have gone astray. A point
        is astray if it no longer faces the cell that it faced where the cuts were made. It is also
        astray if it faces an edge that was steep there and is not now, or the other way round.
        Collective.
        """
        u = self._displacement()
        places = self._active_set().places
        left_places = self._places_left_to_edges
        # steepness is judged by the normals where the cuts were made. With the present normals
        # some places would no longer count, and some that are left to edges would: their force is
        # astray
        normals = self._segments.normals(self._r0 + u)
        is_left = self._search.are_left_to_edges(self._points, places, normals)
        stays_left = self._search.are_left_to_edges(self._points, left_places, normals)
        changed_force = self._force(self._points, places.select(is_left))
        changed_force += self._force(self._points, left_places.select(~stays_left))
        astray = self._astray_share(self._points, places, changed_force)
        if astray <= MAX_ASTRAY_FORCE:
            return None
        # new cuts here are better if they at least halve the share
        points, counted = self._with_cuts_at(u, self._divisions)
        is_better = self._astray_share(points, counted) < astray / 2
        return self._cuts.number_of_displacement(u, self._divisions) if is_better else None

    def finer_cuts(self) -> float | None:
        """Return the number of cuts at the present displacement, divided once more; collective.

        Triangles in contact are then divided once more than at present. The result is None without
        contact, and after `MAX_DIVISIONS`.
        """
        u, divisions = self._displacement(), self._divisions
        places = self._active_set().places
        if divisions == MAX_DIVISIONS or not self._comm.allreduce(len(places.point)):
            return None
        return self._cuts.number_of_displacement(u, divisions + 1)

    def present_cuts(self) -> float:
        """Return the number of cuts at the present displacement; collective."""
        return self._cuts.number_of_displacement(self._displacement(), self._divisions)

    @property
    def _divisions(self) -> int:
        """How often triangles in contact are divided with the present cuts."""
        return divisions_of(self.cuts.value)

    def _with_cuts_at(self, u: Array, divisions: int) -> tuple[ContactPoints, Projections]:
        """Return the points with cuts at a displacement, and their places that count; collective.

        Parameters
        ----------
        u
            (nodes, 3) displacement over R.
        divisions
            How often triangles in a zone of contact are divided.
        """
        points, normals = self._cuts.points_at(u, divisions)
        places = self._search.projections(u, self._h, points)
        # places on edges that a face's points see steeply do not count
        is_left = self._search.are_left_to_edges(points, places, normals)
        return points, places.select(~is_left)

    def recall_cuts(self, number: float) -> None:
        """Let a number stand for cuts at the present displacement; collective.

        The number may come from a run on another number of ranks.
        """
        self._cuts.recall(number, self._displacement())

    def _astray_share(
        self, points: ContactPoints, places: Projections, changed: float = 0.0
    ) -> float:
        """Return the share of the force on points that went astray; collective.

        Such points face another cell than where the cuts were made, or their triangle is divided
        less often than those in the zone of contact. Without any force on the places the share is
        1 if some force is astray, else 0.

        Parameters
        ----------
        points, places
            Contact points of this rank, and their places that count.
        changed
            Further force of this rank that counts as astray, in the measure of `_force`.
        """
        faces_another = points.faces[places.point] != places.cell
        is_coarse = points.divisions[places.point] < self._divisions
        astray_force = self._force(points, places.select(faces_another | is_coarse)) + changed
        total_force, astray_force = self._comm.allreduce(
            np.array([self._force(points, places), astray_force])
        )
        return float(astray_force / total_force) if total_force else float(astray_force > 0)

    def _force(self, points: ContactPoints, places: Projections) -> float:
        """Return twice the force of this rank's points on their nearest places, over E h R.

        It is a measure to compare forces, in which each surface counts in full and not by half.
        """
        nearest = places.select(places.firsts)  # one place of each point and direction
        _, pressures, _ = self.penalty.derivatives(self._h - nearest.distance)
        return float(points.weight[nearest.point] @ pressures)

    def _near(self, u: Array) -> Projections:
        """Return the places in all cells that may press on this rank's cells, at a displacement.

        Cells that are near within the surface are left out, as they are not cut.
        """
        # every place of a cell is within its cover distance of one of the cell's points
        reach = self._h + self._segments.cover_distance  # (cells,)
        positions = self._search.places_of_nodes(u)
        near_places = self._search.projections_in_cells(
            self._rule, u, positions, float(reach.max())
        )
        is_near = near_places.distance < reach[self._rule.cell[near_places.point]]
        return self._search.select_distant_cells(self._rule, near_places.select(is_near))

    def _gaps(self, points: ContactPoints, u: Array) -> Array:
        """Return the gaps (n,) over R of points at a displacement, at most the reach less h."""
        places = self._search.projections(u, self._reach, points)
        distance = np.full(len(points.cell), self._reach)
        np.minimum.at(distance, places.point, places.distance)
        return np.asarray(distance - self._h)

    # geometry

    def _nodal_values(self, function: fem.Function) -> Array:
        return self._of_copies(global_values(function))

    def _of_copies(self, u: Array) -> Array:
        """Return the displacement of all cells for that of the modelled nodes.

        Here all are modelled; a subclass adds the copies of a half or a sector.
        """
        return u

    def _places_in_contact(self) -> tuple[Projections, JoinedPlaces]:
        u, growth = self._displacement(), self._offsets.growth if self._offsets else 0.0
        # the places are found again where the displacement, the growth or the cuts have changed
        points, normals = self._cuts.points(self.cuts.value, u)
        has_moved = growth != self._growth or not np.array_equal(u, self._at)
        # the same cuts have the same object: `Cuts` keeps the points of the last numbers
        if points is not self._points or has_moved:
            self._points, self._growth, self._at = points, growth, np.array(u)
            self._places, self._places_left_to_edges, self._joined = self._active_sets.get(
                (u, self.cuts.value, growth), lambda: self._find_places(points, normals, u)
            )
        return self._places, self._joined

    def _find_places(
        self, points: ContactPoints, normals: Array, u: Array
    ) -> tuple[Projections, Projections, JoinedPlaces]:
        """Return the places that count, those left to edges, and the joined places of the former.

        Parameters
        ----------
        points
            Points with the present cuts.
        normals
            (cells, 3) where the cuts were made.
        u
            (nodes, 3) displacement over R.
        """
        places = self._search.projections(u, (1 + DISTANCE_TOLERANCE) * self._h, points)
        # whether a point inside a face sees its place, on an edge, steeply
        is_left = self._search.are_left_to_edges(points, places, normals)
        counted = places.select(~is_left)
        joined_places = JoinedPlaces.join(counted, BLUR_DISTANCE * self._h)
        return counted, places.select(is_left), joined_places

    def _follow(self, places: Projections) -> Projections:
        r = self._search.places_of_nodes(self._at)
        x = self._search.places_of_points(self._points, r, places.point)
        nodal = r[self._nodes[places.cell]]
        X = follow_places(self._cells, x, nodal, places.X, places.free_directions)
        (_, y), *_ = jets(self._cells.element, X, nodal, order=0)  # the places y, no derivatives
        off = (x - y)[:, :3]
        direction = off / np.linalg.norm(off, axis=1)[:, None]
        return replace(places, X=X, distance=distances(x - y), direction=direction)

    def _own_points(self, frozen: FrozenContact[Projections]) -> ContactPoints:
        self._cached_entries = None, 0.0, no_entries()  # those of the search count no more
        assert isinstance(frozen.points, ContactPoints)
        # the weights change with the areas around the points
        area_ratio = self._area_ratio(frozen.points, self._r0)
        weight = frozen.points.weight * area_ratio / self._area_ratio(frozen.points, frozen.r0)
        return replace(frozen.points, weight=weight)

    def _area_ratio(self, points: ContactPoints, r0: Array) -> Array:
        """Return the area at contact points, (points,), per area of the reference cell.

        The surface has the places r0 (nodes, 3).
        """
        if not len(points.cell):
            return np.zeros(0)
        X = points.shape @ self._cells.element.points  # places in the reference cell
        slopes = self._cells.element.tabulate(1, X)[1:, ..., 0]
        a1, a2 = np.einsum("dnk,nki->dni", slopes, r0[self._nodes[points.cell]])
        return np.asarray(np.linalg.norm(np.cross(a1, a2), axis=1))

    def _gap_geometry(self, places: Projections) -> Geometry:
        return gap_geometry(self._cells, self._points, self._r0 + self._at, places)

    def _mean_thickness(self, places: Projections) -> Array:
        return self._search.thickness(self._points, places)

    def _are_edges_alone(self, nearest: Projections) -> Flags:
        # judged by the normals of cells where the cuts were made
        _, normals = self._cuts.points(self.cuts.value, self._displacement())
        return self._search.are_edges_alone(self._points, nearest, normals)

    def _places_within_reach(self) -> Projections:
        return self._search.projections(
            self._displacement(), self._reach, self._points, least_only=True
        )

    def _projections_of_midsurfaces(self, u: Array, reach: float) -> Projections:
        return self._search.projections(u, reach, to_faces=False)

    def weight_slopes(self, tables: Array, places: Array) -> Array:
        """Return relative derivatives (n, functions, 3) of points' weights by undeformed nodes.

        A weight is proportional to the undeformed area J0 = |a_1 x a_2|.

        Parameters
        ----------
        tables
            (3, n, functions) shape functions at points, and their two derivatives.
        places
            (3, n, 3) the undeformed places, and their derivatives a_1 and a_2.
        """
        _, a1, a2 = places
        _, first_slopes, second_slopes = tables
        area_vector = np.cross(a1, a2)
        n = area_vector / np.sum(area_vector * area_vector, axis=1)[:, None]  # the normal over J0
        # relative derivatives of J0 by a_1 and by a_2
        by_first = np.cross(a2, n)[:, None]
        by_second = np.cross(n, a1)[:, None]
        return np.asarray(first_slopes[..., None] * by_first + second_slopes[..., None] * by_second)


def no_entries() -> Entries:
    """Return a matrix without entries."""
    return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
