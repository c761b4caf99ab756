"""Contact of a shell with itself or of its patches with each other: the penalty of the gap between
their faces.

Each mid-surface has quadrature points. The gap of a point x is |x - y| - h with its projection y,
the closest point of the other mid-surface: the faces are half a thickness from both. Both surfaces
have points, so that each has half of the penalty. The gap is a function of the state alone, and has
no sign of a side: see `SurfaceContact.passes_through` for steps across a surface. The points are
those of a rule on each cell; where cells face others, they are on segments, see `segments`.

With beta = (N_x, -N_y) of the nodes of both cells, n = (x - y)/d, d the distance and F = d^2/2:

    d,u = beta n,   d,uu = [beta beta (I - n n) - C^T A^-1 C]/d,   C_a = -beta y_a - d n (0, N_y,a),
    A = F,ab

where A is the Hessian of F by the place of y, which moves along. P. Wriggers, Computational Contact
Mechanics, Springer 2006, sec. 4.1 and 9; docs/theory.md, Contact.

Where the thickness varies, half of it H at nodes is a fourth unknown, the offset: d is then the
least of |x - y| - H(y), less H(x), plus h, so that |x - y| need not be the least. Of shells that
get thinner H follows from the displacement (`FaceOffsets`).

A place is a projection y: a cell with coordinates in it. Sides are the two members of a pair. The
active set has the places in contact. Places of one point in neighbouring cells are joined as one,
with a smooth minimum of their distances (`JoinedPlaces`). Where an edge presses on a face steeply,
the places of the face's points on the edge do not count: they are left to the edge's own points.
Cuts are the segments made at one displacement, known by a number that is part of a state. A sample
is a displacement within a step in time. A frozen contact keeps the active set of one state.
Energies are over E h R^2, forces over E h R, pressures over E h/R.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.global_mesh import add_to_owners, global_values
from magshell_fenicsx.assembly.nonlocal_terms import Entries, pairs_of
from magshell_fenicsx.parts.contact.closest_points import (
    BLUR_DISTANCE,
    DISTANCE_TOLERANCE,
    ClosestPointSearch,
    no_projections,
)
from magshell_fenicsx.parts.contact.contact_section import Pair
from magshell_fenicsx.parts.contact.face_offsets import FaceOffsets, unknown_numbers
from magshell_fenicsx.parts.contact.field_derivatives import (
    ContactFields,
    ContactState,
    EnergyWeights,
    by_factor,
    by_place,
)
from magshell_fenicsx.parts.contact.frozen_contact import FrozenContact
from magshell_fenicsx.parts.contact.gap_derivatives import (
    distance_slopes,
    gap_geometry,
    gap_hessians,
    joint_entries,
)
from magshell_fenicsx.parts.contact.projection import Cells, JoinedPlaces, Longs, Projections
from magshell_fenicsx.parts.contact.segments import ContactPoints, Cuts, Segments, divisions_of
from magshell_fenicsx.parts.contact.time_averaging import (
    ContactTerm,
    SampleCache,
    SampleRates,
    StateNumber,
)
from magshell_fenicsx.parts.gap import SOFT_PENETRATION, penalty

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Penalty = tuple[Array, Array, Array]  # (m,) psi, psi' and psi'' of joined places, by penetrations
SEARCH_REACH = 4.0  # thicknesses: places farther than that are not looked for
PATTERN_REACH = 1.0  # thicknesses: cells nearer than that have entries in the sparsity pattern
FULL_CONTACT_SHARE = 1 - 1e-9  # of a cell's area, but for rounding
BLOCKS_PER_CHUNK = 1000  # pairs of cells whose blocks of the tangent are computed at a time
MAX_ASTRAY_FORCE = 0.1  # share of the force on points that left their cell, with the old cuts
MAX_DIVISIONS = 8  # of triangles in a zone of contact: each halves the distance of its points
MAX_MOTION_PER_SAMPLE = 0.25  # thicknesses that points move between two samples of a step
CROSSING_DISTANCE = 0.5  # thicknesses: mid-surfaces nearer than that pass through each other


@dataclass(frozen=True)
class ContactGeometry:
    """The cells of a model between which contact is sought, and their places.

    Attributes
    ----------
    cells
        All cells of all ranks, with the images of a half or a sector.
    r0
        (nodes, 3) undeformed places of their nodes, over R.
    displacement
        Returns the present displacement (nodes, 3) of these nodes; collective.
    h
        Thickness over R: that of the penalty, and of the search where the thickness varies.
    segments
        Gives the quadrature points on the cells of this rank, also where these face others.
    fields
        The fields that gaps depend on.
    offsets
        Half the thickness at nodes where it varies or changes with the state; None where it is h/2.
    owned_dofs
        Number of the first degree of freedom of this rank, and how many it has.
    local_cells
        Number of the first cell of this rank, and how many it has, ghosts included.
    comm
        Communicator of the mesh.
    """

    cells: Cells
    r0: Array
    displacement: Callable[[], Array]
    h: float
    segments: Segments
    fields: ContactFields
    offsets: FaceOffsets | None
    owned_dofs: tuple[int, int]
    local_cells: tuple[int, int]
    comm: MPI.Comm


class SurfaceContact(ContactTerm):
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

    Private fields of the model: `_cells` are the cells of all ranks and images, `_r0` (nodes, 3)
    their undeformed places, and `_h` the thickness. `_nodes_of_pair` are the numbers of the nodes
    of both members. `_components` is the number of unknowns of a node: 3, or 4 with the offset H.
    `_rule` has the contact points of uncut cells, `_segments` gives those of cut cells, and `_cuts`
    remembers the cuts of each number. `_search` finds the places of points, up to the distance
    `_reach`. `_frozen` is a frozen contact that replaces the search.

    Private fields of the last active set: `_at` is its displacement, `_growth` the natural stretch
    there, and `_points` are the contact points with the present cuts. `_places` and `_joined` have
    the places in contact, and `_places_left_to_edges` those that do not count. Of joined places
    `first` (m,) is the row of the nearest place of each, and `group` (n,) is the number of the
    joined place to which each place belongs. `_active_sets`, `_cell_values` and `_cached_entries`
    are caches.
    """

    def __init__(self, pair: Pair, geometry: ContactGeometry, sides: tuple[Flags, Flags]) -> None:
        """Prepare the search and the cuts; places are looked for at the first evaluation."""
        super().__init__(pair, geometry.fields, geometry.offsets)
        self.cuts = StateNumber(0.0)
        self._cells, self._segments, self._h = geometry.cells, geometry.segments, geometry.h
        self._rule = geometry.segments.rule
        self._r0, self._find_displacement = geometry.r0, geometry.displacement
        self._owned_dofs, self._local_cells = geometry.owned_dofs, geometry.local_cells
        self._comm = geometry.comm
        self._components = 4 if geometry.offsets else 3  # of vectors, see `projection`
        self._sides = sides
        self._search = ClosestPointSearch(
            self._cells, self._rule, self._may_touch, self._h, self._r0, self._offsets, self._comm
        )
        self._nodes_of_pair = np.unique(self._cells.nodes[sides[0] | sides[1]])
        thickest = 2 * float(self._search.half_thickness[self._nodes_of_pair].max())
        self._reach = self._h + (SEARCH_REACH - 1) * thickest
        self._at = np.full_like(self._r0, np.nan)  # of the active set; nan: none has been found
        self._growth = 0.0  # the natural stretch at that displacement
        self._cuts = Cuts(self._segments, self._near, self._gaps, self._r0)
        self._points, self._places = self._rule, no_projections()
        self._places_left_to_edges = no_projections()
        self._joined = JoinedPlaces.join(self._places, blur=1.0)  # of no places: any blur
        self._active_sets = SampleCache[tuple[Projections, Projections, JoinedPlaces]]()
        self._cell_values = SampleCache[tuple[Array, Array, Flags]]()
        self._frozen: FrozenContact | None = None
        self._cached_entries: tuple[Projections | None, float, Entries] = None, 0.0, no_entries()

    def _may_touch(self, cell: Longs, other: Longs) -> Flags:
        """Return flags (n,): whether points of cells (n,) may touch the other cells (n,)."""
        first, second = self._sides
        return np.asarray((first[cell] & second[other]) | (second[cell] & first[other]))

    # as a term

    @property
    def history(self) -> dict[str, tuple[StateNumber, float]]:
        """The numbers that a state sets, with defaults: penalty stiffness and number of the cuts.

        A state without a number of its own has the cuts of the undeformed surfaces.
        """
        return super().history | {self.pair.cuts: (self.cuts, 0.0)}

    def energy(self) -> float:
        """Return the energy of this rank's points over E h R^2."""
        places, joined_places, (value, _, _) = self._active_set()
        # the area of each joined place is that of its point; half, since the points of the other
        # surface have the same contact
        return float(self._points.weight[places.point[joined_places.first]] @ value) / 2

    def _entries(self) -> Entries:
        """Return this rank's entries of the tangent by the displacement; collective.

        Those of the present state are cached. Those of a sample of a step in time are not.
        """
        places, *_ = self._active_set()
        cached_places, cached_stiffness, cached = self._cached_entries
        is_current = cached_places is places and cached_stiffness == self.stiffness.value
        if is_current and not self.sample:
            return cached
        entries = self._entries_by_place_and_offset()
        if self._offsets:
            # offsets depend on the displacement: by the chain rule, which needs the derivative of
            # the energy by offsets, the entries become those by the displacement alone
            by_offset = self._forces()[:, 3]
            entries = self._offsets.entries(self._at, entries, by_offset)
        if not self.sample:
            self._cached_entries = places, self.stiffness.value, entries
        return entries

    @property
    def pattern_key(self) -> float:
        """The number of the cuts: where it changes, the sparsity pattern is made again."""
        return self.cuts.value

    def coupled_pairs(self) -> tuple[Longs, Longs]:
        """Return pairs of nodes between which the tangent may have entries; collective.

        They are the nodes of cells that touched, or nearly did, where the cuts were made.
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
        cell, faced_cell = np.divmod(keys, len(self._cells.nodes))
        # the nodes of both cells, and each of them with each
        nodes = np.concatenate([self._cells.nodes[cell], self._cells.nodes[faced_cell]], axis=1)
        rows, columns = pairs_of(nodes)
        if not self._offsets:
            return rows, columns
        # an offset depends on the nodes of all cells around it, which are then coupled too
        return self._offsets.coupled_pairs(rows, columns)

    def by_field(
        self, name: str, direction: fem.Function, energy: float, force: float
    ) -> tuple[fem.Function, Array] | None:
        """Return derivatives of a weighted sum by a field; collective.

        The sum is `energy` Pi + `force` w . dPi/du, with the contact energy Pi.

        Parameters
        ----------
        name
            Name of the field: "thickness" or "r0".
        direction
            The displacement w.
        energy, force
            The weights of both terms.

        Returns
        -------
        field, values
            The field and derivatives (own cells, functions, components) by its values; None for any
            other name, and for a thickness that does not vary.
        """
        field = {"thickness": self._fields.thickness, "r0": self._fields.r0}.get(name)
        if field is None:
            return None
        state = self._state()
        weights = EnergyWeights(self._of_copies(global_values(direction)), energy, force)
        if name == "thickness":
            # derivatives (cells, functions) by the thickness in all cells, added to those in
            # modelled cells, and summed over all ranks; then those of this rank's own cells
            by_thickness = self._comm.allreduce(self._in_modelled(by_factor(state, weights)))
            return field, by_thickness[self._fields.own, :, None]
        # derivatives (nodes, 3) by undeformed places, in the same way; then each node's derivative
        # is shared out among the cells that have the node
        forces = self._comm.allreduce(self._on_modelled(by_place(state, weights)))
        return field, self._fields.shared_by_cells(forces)

    def _state(self) -> ContactState:
        """Return the contact at the present state, for derivatives by fields; collective."""
        places, joined_places, penalties = self._active_set()
        return ContactState(
            cells=self._cells,
            r0=self._r0,
            u=self._at,
            offsets=self._offsets,
            points=self._points,
            places=places,
            joined_places=joined_places,
            penalties=penalties,
            forces=self._forces(),
            find_entries_by_place_and_offset=self._entries_by_place_and_offset,
            find_entries=self._entries,
            geometry=self._geometry,
        )

    def _add(self, b: Array, forces: Array) -> None:
        """Add forces (nodes, 3) of this rank's points to the vectors of all ranks; collective."""
        add_to_owners(b, forces, self._owned_dofs, self._comm)

    def _entries_by_place_and_offset(self) -> Entries:
        """Return this rank's entries of the second derivative by places and offsets H of nodes.

        With the distance d of a place the penalty psi(h - d) has the second derivative
        psi'' d,u d,u - psi' d,uu. Blocks of places in the same pair of cells are summed.
        Collective.
        """
        active_set = self._active_set()
        places, joined_places, (_, slope, curvature) = active_set
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
        # half, since the points of the other surface have the same contact
        weight = joined_places.weight * self._points.weight[places.point] / 2
        # places in the same pair of cells follow one another
        order = np.argsort(self._pair_keys(places), kind="stable")
        blocks = self._blocks(places.select(order), weight[order], first[order], second[order])
        if joined_places.several.any():
            blocks.append(self._entries_of_joints(*active_set))
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
            geometry = self._geometry(chunk_places)
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

    def _entries_of_joints(
        self, places: Projections, joined_places: JoinedPlaces, penalties: Penalty
    ) -> Entries:
        """Return the entries of joined places, besides those of each place alone.

        They are (psi'' - psi'/e) D,u D,u, with the joined distance D and the blur e of its smooth
        minimum. The members of the active set are arguments: to find it is collective, and this is
        called only on ranks that have joined places.
        """
        _, slope, curvature = penalties
        # only joined places of several places matter; a place's share in D,u is its weight times
        # the derivative of its own distance
        is_blurred = joined_places.several[joined_places.group]
        _, n, beta, nodes = self._geometry(places.select(is_blurred))
        slopes = joined_places.weight[is_blurred, None, None] * distance_slopes(
            n, beta, self._components
        )
        # half, since the points of the other surface have the same contact
        weight = self._points.weight[places.point[joined_places.first]] / 2
        joint_weight = weight * (curvature - slope / (BLUR_DISTANCE * self._h))
        return joint_entries(
            slopes, nodes, joined_places.group[is_blurred], joint_weight, len(self._r0)
        )

    def _pair_keys(self, places: Projections) -> Longs:
        """Return a number (n,) that identifies the cells of each place and its point."""
        return np.asarray(self._points.cell[places.point] * len(self._cells.nodes) + places.cell)

    # what is observed

    def force(self) -> float:
        """Return the integral of the contact pressure, over E h R; collective."""
        places, joined_places, (_, slope, _) = self._active_set()
        # areas of the points times pressures psi' of their joined places; half, since the points of
        # both surfaces have the same force
        weight = self._points.weight[places.point[joined_places.first]]
        return float(self._comm.allreduce(float(weight @ slope / 2)))

    def least_gap(self) -> float:
        """Return the least gap over R; nan where no faces are within the reach. Collective."""
        self._active_set()  # which sets `_points` to those of the present cuts
        least_distance = self._search.least_distance(
            self._displacement(), self._reach, self._points
        )
        return least_distance - self._h if least_distance < self._reach else np.nan

    def penetration(self) -> float:
        """Return the largest penetration over R, 0 without contact; collective."""
        places, *_ = self._active_set()
        own_largest = float((self._h - places.distance).max(initial=0.0))
        return float(self._comm.allreduce(own_largest, MPI.MAX))

    def relative_penetration(self) -> float:
        """Return the largest penetration over the undeformed thickness there; collective.

        It is 0 without contact. The thickness is the mean of those at the point and at its place.
        """
        places, *_ = self._active_set()
        own_largest = 0.0  # of this rank
        if len(places.point):
            # the mean undeformed thickness (n,) of each point and its place
            thickness = self._search.thickness(self._points, places)
            own_largest = float(((self._h - places.distance) / thickness).max(initial=0.0))
        return float(self._comm.allreduce(own_largest, MPI.MAX))

    def deepest_penetration(self) -> tuple[float, Array]:
        """Return the largest penetration over R, and the place (3,) of its point; collective.

        Without contact they are 0 and the origin.
        """
        places, *_ = self._active_set()
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

    def cell_pressures_and_gaps(self) -> tuple[Array, Array, Flags]:
        """Return pressure, gap and full contact of each local cell; collective.

        They are computed once for a state.

        Returns
        -------
        pressure
            (cells,) the mean over E h/R; 0 of ghosts.
        gap
            (cells,) the least over R; the reach less h where nothing is nearer, and of ghosts.
        is_full
            (cells,) whether all of the cell is pressed.

        Notes
        -----
        Where an edge alone presses on a face, half of its points' forces acts on each, as in the
        energy.
        """
        self._active_set()
        if self._frozen:
            return self._compute_pressures_and_gaps()
        state = self._at, self.cuts.value, self._growth, self.stiffness.value
        return self._cell_values.get(state, self._compute_pressures_and_gaps)

    def _compute_pressures_and_gaps(self) -> tuple[Array, Array, Flags]:
        """Compute `cell_pressures_and_gaps` at the present state; collective."""
        places, joined_places, (_, slope, _) = self._active_set()
        points, (first_cell, count) = self._points, self._local_cells
        nearest = places.select(joined_places.first)
        force = points.weight[nearest.point] * slope  # in full: the mean pressure of this face
        # whether each of these points is one of an edge that presses on a face alone, judged by
        # the normals of cells where the cuts were made
        _, normals = self._cuts.points(self.cuts.value, self._displacement())
        is_edge_alone = self._search.are_edges_alone(points, nearest, normals)
        force_on_faced = self._force_on_faced_cells(nearest, force / 2 * is_edge_alone)
        # local numbers of the points' cells: own cells come first, then ghosts, without points
        local_cell = points.cell - first_cell
        # the area of each cell is the sum of its points; ghosts, which have none, get 1 as divisor
        area = np.ones(count)
        np.add.at(area, local_cell, points.weight)
        area[: len(np.unique(points.cell))] -= 1.0
        # the forces on each cell: from edges that press on it, and of its own points
        force_on_cells = np.zeros(count)
        force_on_cells[: len(force_on_faced)] = force_on_faced
        own_force = force * (1 - is_edge_alone / 2)
        np.add.at(force_on_cells, local_cell[nearest.point], own_force)
        # the least gap in each cell
        gap = np.full(count, self._reach - self._h)
        near_places = self._search.projections(
            self._displacement(), self._reach, points, least_only=True
        )
        np.minimum.at(gap, local_cell[near_places.point], near_places.distance - self._h)
        # the area that belongs to the points in contact
        pressed_area, pressed_points = np.zeros(count), np.unique(nearest.point)
        np.add.at(pressed_area, local_cell[pressed_points], points.weight[pressed_points])
        return force_on_cells / area, gap, pressed_area > FULL_CONTACT_SHARE * area

    def _force_on_faced_cells(self, nearest: Projections, force_of_edges: Array) -> Array:
        """Return the forces (own cells,) that edges exert on the cells that they face; collective.

        Such a cell may be on another rank, or an image of one: forces are summed over all ranks and
        images.

        Parameters
        ----------
        nearest
            Nearest places of this rank's points.
        force_of_edges
            (n,) force at each place; 0 where no edge presses alone.
        """
        force_on_cells = np.bincount(nearest.cell, force_of_edges, len(self._cells.nodes))
        force_on_modelled = self._in_modelled(force_on_cells.astype(np.float64)[:, None])[:, 0]
        return np.asarray(self._comm.allreduce(force_on_modelled)[self._fields.own])

    def halves(self) -> tuple[Array, Array]:
        """Return half the thickness (nodes,) over R, undeformed and at present; collective."""
        undeformed = self._search.half_thickness
        if not self._offsets:
            return undeformed, undeformed
        return undeformed, self._offsets.half_thickness(self._displacement())

    def least_thickness(self, *displacements: Array) -> float:
        """Return the least thickness of the pair over R, undeformed and at some displacements.

        These are (nodes, 3), of all cells.
        """
        halves = [self._search.half_thickness]
        if self._offsets:
            halves += [self._offsets.half_thickness(u) for u in displacements]
        return 2 * min(float(half[self._nodes_of_pair].min()) for half in halves)

    def come_near(self, u: Array, v: Array) -> bool:
        """Return whether cells that may touch come near each other from u to v; collective.

        Displacements (nodes, 3) are those of the modelled nodes.
        """
        return self._search.come_near(self._of_copies(u), self._of_copies(v))

    def gap(self, u: Array) -> float:
        """Return the least gap over R of the uncut cells at a displacement; collective.

        It is at most the reach of the search, less h.
        """
        return self._search.least_distance(self._of_copies(u), self._reach) - self._h

    def gap_at_supports(self, supported_nodes: Longs, u: Array) -> float:
        """Return the least gap over R at nodes that supports hold, at a displacement u (nodes, 3).

        It is infinite if no faces overlap at these nodes, or if the thickness depends on the
        displacement.
        """
        return self._search.gap_at_supports(supported_nodes, self._of_copies(u))

    def passes_through(self, u: Array, v: Array) -> bool:
        """Return whether points pass through a surface on the straight way from u to v; collective.

        Mid-surfaces are looked at in samples of the way. Between two samples no point moves,
        relative to another, by more than a part of the least thickness.

        Parameters
        ----------
        u, v
            (nodes, 3) displacements of the modelled nodes.
        """
        return self.images_pass_through(self._of_copies(u), self._of_copies(v))

    def images_pass_through(self, u: Array, v: Array) -> bool:
        """Return whether points pass through a surface on the straight way from u to v; collective.

        Displacements (nodes, 3) are those of all cells, images included. Mid-surfaces are looked at
        in samples of the way, between which no point moves by more than a part of the thickness.
        """
        least_thickness = self.least_thickness(u, v)
        # motions that are the same for all points do not count
        motion = (v - u) - (v - u).mean(axis=0)
        # number of parts of the way; twice the motion, since two points may move in opposite
        # directions
        farthest = 2 * np.linalg.norm(motion, axis=1).max()
        count = int(np.ceil(farthest / (MAX_MOTION_PER_SAMPLE * least_thickness)))
        if not self._search.come_near(u, v):
            return False
        # points pass through if mid-surfaces are very near at a sample between the parts; both ends
        # of the way are states, where surfaces have not passed through each other
        for k in range(1, count):
            near_places = self._search.projections(
                u + k / count * (v - u), CROSSING_DISTANCE * least_thickness, to_faces=False
            )
            if self._comm.allreduce(len(near_places.point)):
                return True
        return False

    # in a step in time, see `TimeAveragedContact`

    @property
    def displacement(self) -> Array:
        """The present displacement (nodes, 3) of all cells; collective."""
        return np.array(self._displacement())

    def sample_rates(self, motion: Array) -> SampleRates:
        """Return the penalty of the points at the present sample, with its rates along a motion.

        Parameters
        ----------
        motion
            (nodes, 3) displacement of the whole step, of all nodes.
        """
        places, joined_places, _ = self._active_set()
        if self._offsets:  # faces also move as the thickness changes, the last component
            motion = np.column_stack([motion, self._offsets.change(self._at, motion)])
        # derivatives of the distances by the unknowns of nodes
        _, n, beta, nodes = self._geometry(places)
        slopes = distance_slopes(n, beta, self._components)
        # increase of the penetration over the step: of each place, then the weighted mean of the
        # places that are joined
        closing_of_places = -np.einsum("nki,nki->n", slopes, motion[nodes])
        closing = np.bincount(
            joined_places.group, joined_places.weight * closing_of_places, len(joined_places.first)
        ).astype(np.float64)
        return SampleRates.sum_over_points(
            count=len(self._points.weight),
            point=places.point[joined_places.first],
            penetration=self._h - joined_places.distance,
            closing=closing,
            k=self.stiffness.value,
            soft_penetration=SOFT_PENETRATION * self._h,
        )

    # the cuts of cells

    def improved_cuts(self) -> float | None:
        """Return the number of cuts at the present displacement if these are better; else None.

        Cuts are better if a smaller share of the force is on points that have gone astray. A point
        is astray if it no longer faces the cell that it faced where the cuts were made. It is also
        astray if it faces an edge that was steep there and is not now, or the other way round.
        Collective.
        """
        u = self._displacement()
        places, *_ = self._active_set()
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
        places, *_ = self._active_set()
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
        soft_penetration = SOFT_PENETRATION * self._h
        penetrations = self._h - nearest.distance
        _, pressures, _ = penalty(penetrations, self.stiffness.value, soft_penetration)
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

    def _displacement(self) -> Array:
        """Return the displacement (nodes, 3), at present or at the sample; collective."""
        return self.sample.u if self.sample else self._find_displacement()

    def _of_copies(self, u: Array) -> Array:
        """Return the displacement of all cells for that of the modelled nodes.

        Here all are modelled; a subclass adds the copies of a half or a sector.
        """
        return u

    def _in_modelled(self, values: Array) -> Array:
        """Return derivatives by values in modelled cells, from those by values in all cells."""
        return values

    def _on_modelled(self, forces: Array) -> Array:
        """Return the forces on modelled nodes (nodes, 3), from those on all nodes."""
        return forces

    def _forces(self) -> Array:
        """Return derivatives (nodes, 3 or 4) of this rank's energy by the places of all nodes.

        Where the thickness varies, the fourth component is the derivative by the offset H.
        Collective.
        """
        places, joined_places, (_, slope, _) = self._active_set()
        forces = np.zeros((len(self._r0), self._components))
        if len(places.point):
            _, n, beta, nodes = self._geometry(places)
            # half, since the points of the other surface have the same contact
            weight = joined_places.weight * self._points.weight[places.point] / 2
            force_of_places = weight * slope[joined_places.group]
            # derivatives of the distances by the unknowns of nodes
            slopes = distance_slopes(n, beta, self._components)
            np.add.at(forces, nodes, -force_of_places[:, None, None] * slopes)
        return forces

    def _active_set(self) -> tuple[Projections, JoinedPlaces, Penalty]:
        """Return the places in contact, how they are joined, and the penalty of each joined place.

        The penalty (m,) comes with its two derivatives by the penetration. All are at the present
        state, or at the sample of a step. They are cached while the state stays. Collective.
        """
        soft_penetration = SOFT_PENETRATION * self._h
        # a frozen contact replaces the search
        if self._frozen:
            self._at, self._points = np.array(self._displacement()), self._frozen.points
            # a contact that is held at one state (`hold` of the base class) serves differences of
            # tangents, which need the penalty to the third order
            is_held = self.held is not None
            return self._frozen.evaluate(
                self._search, self._at, self.stiffness.value, self._h, with_third_order=is_held
            )
        # the places are found again where the displacement, the growth or the cuts have changed
        u, growth = self._displacement(), self._offsets.growth if self._offsets else 0.0
        points, normals = self._cuts.points(self.cuts.value, u)
        has_moved = growth != self._growth or not np.array_equal(u, self._at)
        # the same cuts have the same object: `Cuts` keeps the points of the last numbers
        if points is not self._points or has_moved:
            self._points, self._growth, self._at = points, growth, np.array(u)
            self._places, self._places_left_to_edges, self._joined = self._active_sets.get(
                (u, self.cuts.value, growth), lambda: self._find_places(points, normals, u)
            )
        # the penalty also changes with the stiffness, and with the sample of a step in time
        joined_places = self._joined
        penalties = penalty(
            self._h - joined_places.distance, self.stiffness.value, soft_penetration
        )
        if self.sample:
            point_of_joined = self._places.point[joined_places.first]
            penalties = self.sample.weigh(point_of_joined, penalties)
        return self._places, joined_places, penalties

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

    def freeze(self) -> FrozenContact:
        """Return this contact with the active set of the present state fixed; collective."""
        self._active_set()
        return FrozenContact.at_state(
            self._cells, self._r0, self._h, self._points, self._places, self._joined
        )

    def expand_about(self, frozen: FrozenContact) -> None:
        """Use the frozen contact of another scene on the same mesh for all later states.

        Its weights become those of this scene's undeformed surface.
        """
        self._cached_entries = None, 0.0, self._cached_entries[2]  # None: these count no more
        self._frozen = frozen.on_surface(self._r0)

    def _geometry(self, places: Projections) -> tuple[Array, Array, Array, Longs]:
        """Return the distances (n,), normals (n, 3), and beta with its nodes, for n places.

        Beta (n, functions of both cells) are the point's shape functions, minus those of its place.
        """
        return gap_geometry(self._cells, self._points, self._r0 + self._at, places)


def no_entries() -> Entries:
    """Return a matrix without entries."""
    return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
