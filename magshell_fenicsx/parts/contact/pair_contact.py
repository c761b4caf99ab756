"""Contact of a pair of shells: the energy of its penalty at contact points, on every geometry.

Both members of a pair have contact points, quadrature points of their cells. A point faces places,
its closest places on the other member; on surfaces and on meridians these come from projections of
their own. The distance d of a place is the gap of the faces plus h: the gap is d - h, and the
penetration h - d. Both members have points, so that each has half of the penalty. Of the energy

    Pi = 1/2 sum area psi(h - d)   over places in contact

the gradient, minus the forces on the shells, is -1/2 sum area psi' d,u, and the tangent is
1/2 sum area (psi'' d,u d,u - psi' d,uu). docs/theory.md, Contact.

Where the thickness varies, half of it H at nodes is one more unknown, the offset (`FaceOffsets`).
A sample is a displacement within a step in time. A frozen contact keeps the active set of one state
(`active_set`). Images are the copies of a half or a sector that make the whole. Energies are over
E h R^2, forces over E h R, pressures over E h/R, lengths over R.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.free_parameters import FreeParameter
from magshell_fenicsx.assembly.nonlocal_terms import Entries, pairs_of
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.parts.contact.active_set import (
    ActiveSet,
    FrozenContact,
    Geometry,
    Places,
)
from magshell_fenicsx.parts.contact.closest_points import BLUR_DISTANCE, gap_between_supports
from magshell_fenicsx.parts.contact.contact_section import Pair
from magshell_fenicsx.parts.contact.face_offsets import CellsWithNodes, FaceOffsets
from magshell_fenicsx.parts.contact.field_derivatives import (
    ContactFields,
    ContactState,
    EnergyWeights,
    by_factor,
    by_place,
    with_growth,
)
from magshell_fenicsx.parts.contact.gap_derivatives import distance_slopes, forces_on_nodes
from magshell_fenicsx.parts.contact.meridian_projection import MeridianPoints
from magshell_fenicsx.parts.contact.projection import JoinedPlaces, Longs
from magshell_fenicsx.parts.contact.segments import ContactPoints
from magshell_fenicsx.parts.contact.time_averaging import (
    SampleCache,
    SampleRates,
    StepSample,
    at_each_sample,
    samples_of_step,
)
from magshell_fenicsx.parts.penalty_contact import (
    PASS_THROUGH_DISTANCE,
    PenaltyContact,
    PressedPoints,
)

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
SEARCH_REACH = 4.0  # thicknesses: places farther than that are not looked for
FULL_CONTACT_SHARE = 1 - 1e-9  # of a cell's area, but for rounding
MAX_MOTION_PER_SAMPLE = 0.25  # thicknesses that points move between two samples of a step
PENETRATION_TOLERANCE = 1e-6  # over h: an undeformed penetration below that is rounding
IMPACT_BOUND_RATIO = 100.0  # times the bound: a penetration that lasts for a moment


@dataclass
class StateNumber:
    """A number that a state sets."""

    value: float


@dataclass(frozen=True)
class ContactGeometry:
    """The cells of a model between which contact is sought.

    Attributes
    ----------
    cells
        All cells of all ranks, with the images of a half or a sector.
    r0
        (nodes, dim) undeformed places of their nodes, over R.
    u
        The displacement over R of the modelled nodes.
    h
        Thickness over R: that of the penalty, and of the search where the thickness varies.
    fields
        The fields that gaps depend on.
    offsets
        Half the thickness at nodes where it varies or changes with the state; None where it is h/2.
    local_cells
        Number of the first cell of this rank, and how many it has, ghosts included.
    comm
        Communicator over which contact points are shared out.
    """

    cells: CellsWithNodes
    r0: Array
    u: fem.Function
    h: float
    fields: ContactFields
    offsets: FaceOffsets | None
    local_cells: tuple[int, int]
    comm: MPI.Comm


class PairContact(PenaltyContact[Array, FrozenContact[Places]], Generic[Places]):
    """The contact energy of a pair; a `Term` and a `NonlocalTerm` of `assembly`.

    Subclasses give what depends on the geometry: the contact points and the places that they face,
    the derivatives of distances, and which numbers of a vector the nodes have.

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
    stiffness
        Stiffness k of the penalty, over E h/R^2.
    samples
        The samples of a step in time; empty while the contact has the force of the present state.
    sample
        The sample at which the contact is evaluated now; None for the present state.
    held
        The frozen contact of one state that replaces the search in all states; None without. It is
        set by `hold`.
    pair, name, group
        The two members, and the name of the term, which is also that of its group.
    amplitude, column
        None and "": no load parameter multiplies the energy, which has no column in results.

    Private fields of the model: `_nodes` (cells, functions) are the nodes of cells, `_r0` (nodes,
    dim) their undeformed places, `_half` (nodes,) half the undeformed thickness and `_h` the
    thickness. `_nodes_of_pair` are the numbers of the nodes of both members. `_components` is the
    number of unknowns of a node: dim, or dim + 1 with the offset H. `_fields` are the fields of the
    case on which gaps depend, and `_offsets` is H at nodes; None where it is h/2. `_reach` is the
    distance up to which places are looked for.

    Private fields of the last active set: `_at` is its displacement, `_growth` the natural stretch
    there, and `_points` are the contact points. `_frozen` is a frozen contact that replaces the
    search. `_cell_values` is a cache.
    """

    amplitude = None
    column = ""
    max_stiffening = 1e6  # high: a point at a corner has a small weight, and so a small force
    bound_at_points = 0.75  # shells may be deeper between the points
    # along which components all cells can move without a change of gaps
    common_translations: Sequence[float] = (1.0, 1.0, 1.0)
    _points: ContactPoints | MeridianPoints

    def __init__(self, pair: Pair, geometry: ContactGeometry, sides: tuple[Flags, Flags]) -> None:
        """Begin outside a step in time, with the pair's stiffness, and with no contact held."""
        self.pair, self.name = pair, f"contact{pair.suffix}"
        self.group = self.name
        self.stiffness = StateNumber(pair.stiffness)
        self.samples: Sequence[StepSample] = ()
        self.sample: StepSample | None = None
        self.held: FrozenContact[Places] | None = None
        self._frozen: FrozenContact[Places] | None = None
        self._geometry, self._sides, self._comm = geometry, sides, geometry.comm
        self._nodes, self._r0, self._h = geometry.cells.nodes, geometry.r0, geometry.h
        self._fields, self._offsets = geometry.fields, geometry.offsets
        self._components = self._r0.shape[1] + bool(self._offsets)
        self._half: Array = np.full(len(self._r0), self._h / 2)
        if self._offsets:
            self._half = self._offsets.undeformed_half_thickness
        self._nodes_of_pair = np.unique(self._nodes[sides[0] | sides[1]])
        thickest = 2 * float(self._half[self._nodes_of_pair].max())
        self._reach = self._h + (SEARCH_REACH - 1) * thickest
        self._at = np.full_like(self._r0, np.nan)  # of the active set; nan: none has been found
        self._growth = 0.0  # the natural stretch at that displacement
        self._cell_values = SampleCache[tuple[Array, Array, Flags]]()

    def _is_of_pair(self, cell: Longs, other: Longs) -> Flags:
        """Return flags (n,): whether cells (n,) and other cells (n,) are of different members."""
        first, second = self._sides
        return np.asarray((first[cell] & second[other]) | (second[cell] & first[other]))

    # the active set

    def _active_set(self) -> ActiveSet[Places]:
        """Return the places in contact and the penalty there; collective.

        They are those of the present state, or of the sample of a step in time.
        """
        if self._frozen:
            return self._moved_frozen_set(self._frozen)
        places, joined_places = self._places_in_contact()
        penalties = self.penalty.derivatives(self._h - joined_places.distance)
        if self.sample:
            penalties = self.sample.weigh(places.point[joined_places.first], penalties)
        return ActiveSet(self._points, places, joined_places, penalties)

    def _moved_frozen_set(self, frozen: FrozenContact[Places]) -> ActiveSet[Places]:
        """Return the active set of a frozen contact with its places moved to the present state.

        The penalty is its Taylor polynomial about the frozen penetrations. A contact that is held
        at one state (`hold`) serves differences of tangents, which need the third order.
        """
        self._at, self._points = np.array(self._displacement()), frozen.points
        places, joined_places = frozen.places, frozen.joined_places
        if len(places.point):  # else no contact at the frozen state, nor now
            places = self._follow(frozen.places)
            change = places.distance - frozen.places.distance
            joined_places = joined_places.moved_by(change, BLUR_DISTANCE * self._h)
        penetration = self._h - joined_places.distance
        penalties = self.penalty.expanded(
            penetration, frozen.penetration, with_third_order=self.held is not None
        )
        return ActiveSet(self._points, places, joined_places, penalties)

    def freeze(self) -> FrozenContact[Places]:
        """Return this contact with the active set of the present state fixed; collective."""
        active = self._active_set()
        joined_places = active.joined_places
        penetration = self._h - joined_places.distance
        return FrozenContact(active.points, active.places, joined_places, penetration, self._r0)

    def expand_about(self, frozen: FrozenContact[Places]) -> None:
        """Use the frozen contact of another scene on the same mesh for all later states.

        Its weights become those of this scene's undeformed shell.
        """
        self._frozen = replace(frozen, points=self._own_points(frozen), r0=self._r0)

    def hold(self, frozen: FrozenContact[Places] | None) -> None:
        """Fix the active set for all states by a frozen contact, or release it with None.

        Parameters
        ----------
        frozen
            The result of `freeze` at one state.
        """
        self.held = self._frozen = None
        self._at = np.full_like(self._r0, np.nan)  # no active set: that of the search is another
        # `expand_about` sets `_frozen`; called by itself it serves another scene's contact, and
        # then `held` stays None
        if frozen is not None:
            self.expand_about(frozen)
            self.held = frozen

    # as a term

    @property
    def options(self) -> Pair:
        return self.pair

    @property
    def history(self) -> dict[str, tuple[StateNumber, float]]:
        """The numbers that a state sets, with defaults; see `FiniteElementSystem`."""
        return {self.pair.setting: (self.stiffness, self.pair.stiffness)}

    def energy(self) -> float:
        """Return the energy of this rank's points over E h R^2."""
        active = self._active_set()
        value, _, _ = active.penalties
        # half, since the points of the other member have the same contact
        return float(active.area @ value) / 2

    def add_residual(self, b: Array, factor: float) -> None:
        """Add factor dPi/du to the vector b; collective."""
        forces = at_each_sample(self, self._gradient_by_displacement)
        self._add(b, factor * np.sum(forces, axis=0))

    def compile_residual(self) -> None:
        """Do nothing: the term has no forms."""

    compile_tangent = compile_residual

    def add_tangent(self, K: object, factor: float, clamped: object) -> None:
        """Add nothing: the tangent's assembly takes `entries`."""

    def entries(self) -> Entries:
        """Return this rank's entries of the tangent, summed over the samples of a step; collective.

        See `NonlocalTerm`.
        """
        # a position in the matrix may come several times: such entries are added
        samples = at_each_sample(self, self._entries, tangent=True)
        rows, columns, values = zip(*samples, strict=True)
        return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)

    def coupled_pairs(self) -> tuple[Longs, Longs]:
        """Return pairs of nodes between which the tangent may have entries; collective."""
        # the nodes of both cells, and each of them with each
        nodes = np.concatenate([self._nodes[cells] for cells in self._coupled_cells()], axis=1)
        rows, columns = pairs_of(nodes)
        if not self._offsets:
            return rows, columns
        # an offset depends on the nodes of all cells around it, which are then coupled too
        return self._offsets.coupled_pairs(rows, columns)

    def growth_parameters(
        self, parameters: Mapping[str, FreeParameter]
    ) -> dict[str, FreeParameter]:
        """Return those parameters that move faces, with the derivatives of contact added.

        Only the natural stretch moves faces, through the thickness of a shell that has grown. The
        result has this parameter alone, with the contact forces added to its derivatives; it is
        empty where nothing grows.

        Parameters
        ----------
        parameters
            Name -> number that varies in the energies.
        """
        amplitude = self._offsets.amplitude if self._offsets else None  # the natural stretch
        return {
            name: with_growth(p, self._state, self._add)
            for name, p in parameters.items()
            if p.constant is amplitude
        }

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
        weights = EnergyWeights(self._nodal_values(direction), energy, force)
        if name == "thickness":
            # derivatives (cells, functions) by the thickness in all cells, added to those in
            # modelled cells, and summed over all ranks; then those of this rank's own cells
            by_thickness = self._comm.allreduce(self._in_modelled(by_factor(state, weights)))
            return field, by_thickness[self._fields.own, :, None]
        # derivatives (nodes, dim) by undeformed places, in the same way; then each node's
        # derivative is shared out among the cells that have the node
        forces = self._comm.allreduce(self._on_modelled(by_place(state, weights)))
        return field, self._fields.shared_by_cells(forces)

    def _state(self) -> ContactState:
        """Return the contact at the present state, for derivatives by fields; collective."""
        active = self._active_set()
        return ContactState(
            cells=self._geometry.cells,
            r0=self._r0,
            u=self._at,
            offsets=self._offsets,
            active=active,
            forces=self._gradient(),
            find_entries_by_place_and_offset=self._entries_by_place_and_offset,
            find_entries=self._entries,
            find_geometry=lambda: self._gap_geometry(active.places),
            weight_slopes=self.weight_slopes,
        )

    # forces and tangent at one sample

    def _gradient(self) -> Array:
        """Return the derivative (nodes, dim) of this rank's energy by the places of all nodes.

        Where the thickness varies, one more component is the derivative by the offset H.
        Collective.
        """
        active = self._active_set()
        forces = np.zeros((len(self._r0), self._components))
        if len(active.places.point):
            _, pressure, _ = active.penalties
            # half, since the points of the other member have the same contact
            force_of_places = active.weight / 2 * pressure[active.joined_places.group]
            # derivatives of the distances by the unknowns of nodes
            _, n, beta, nodes = self._gap_geometry(active.places)
            slopes = distance_slopes(n, beta, self._components)
            np.add.at(forces, nodes, -force_of_places[:, None, None] * slopes)
        return forces

    def _gradient_by_displacement(self) -> Array:
        """Return the derivative (nodes, dim) by the displacement, on which H depends; collective.

        It is that of this rank's energy.
        """
        forces = self._gradient()  # which sets `_at` to its displacement
        return forces_on_nodes(self._offsets, self._at, forces)

    def _entries(self) -> Entries:
        """Return this rank's entries of the tangent by the displacement; collective."""
        entries = self._entries_by_place_and_offset()
        if not self._offsets:
            return entries
        # offsets depend on the displacement: by the chain rule, which needs the derivative of the
        # energy by offsets, the entries become those by the displacement alone
        by_offset = self._gradient()[:, -1]
        return self._offsets.entries(self._at, entries, by_offset)

    # what is observed

    def force(self) -> float:
        """Return the integral of the contact pressure, over E h R; collective."""
        active = self._active_set()
        _, pressure, _ = active.penalties
        # half, since the points of both members have the same force
        return float(self._comm.allreduce(float(active.area @ pressure / 2)))

    def penetration(self) -> float:
        """Return the largest penetration over R, 0 without contact; collective."""
        active = self._active_set()
        own_largest = float((self._h - active.places.distance).max(initial=0.0))
        return float(self._comm.allreduce(own_largest, MPI.MAX))

    def relative_penetration(self) -> float:
        """Return the largest penetration over the undeformed thickness there; collective.

        It is 0 without contact. The thickness is the mean of those at the point and at its place.
        """
        active = self._active_set()
        own_largest = 0.0  # of this rank
        if len(active.places.point):
            depth = (self._h - active.places.distance) / self._mean_thickness(active.places)
            own_largest = float(depth.max(initial=0.0))
        return float(self._comm.allreduce(own_largest, MPI.MAX))

    def penetration_message(self, stiffness: float, *, moving: bool) -> str:
        depth, limit = self.relative_penetration(), self.pair.max_penetration
        limit *= IMPACT_BOUND_RATIO if moving else 1.0
        if depth <= limit:
            return ""
        finding = (
            f"the penetration between {self.pair.words} is {depth:.3g} h, more than {limit:g} h"
        )
        if moving or self.pair.has_given_stiffness:
            return f"{finding}; contact: stiffness: is {stiffness:.4g}: give four times as much"
        return f"{finding} even with the stiffest penalty: take smaller elements where they touch"

    def refuse_overlap(self) -> None:
        """Check that the members do not overlap undeformed; collective.

        Raises
        ------
        MeshError
            On every rank if they do, with the depth and the place.
        """
        penetration, x = self.deepest_penetration()
        if penetration > PENETRATION_TOLERANCE * self._h:
            place = ", ".join(f"{coordinate:.4g}" for coordinate in x + 0.0)  # no -0
            raise MeshError(
                f"contact: {self.pair.words} overlap undeformed, by {penetration / self._h:.4g} h "
                f"at ({place}) R: move them apart"
            )

    def gap_at_supports(self, supported_nodes: Longs) -> float:
        """Return the least gap over R of overlapping faces at supported nodes; inf if none overlap.

        It is negative. Only nodes count that may touch and are not the same material. Where the
        thickness depends on the displacement nothing is checked, and the result is inf. Collective.

        Parameters
        ----------
        supported_nodes
            Numbers (n,) of modelled nodes that supports hold.
        """
        if self._offsets and not self._offsets.is_constant:
            return np.inf
        u = self._displacement()
        return gap_between_supports(
            supported_nodes, self._nodes, self._r0, u, self._half, self._may_touch
        )

    def cell_pressures(self) -> Array:
        pressures, _, _ = self.cell_pressures_and_gaps()
        return pressures

    def evenly_pressed(self) -> Flags:
        _, _, is_full = self.cell_pressures_and_gaps()
        return is_full

    def pressed_points(self) -> PressedPoints:
        active = self._active_set()
        points, (first_cell, count) = active.points, self._geometry.local_cells
        _, pressures, _ = active.penalties
        is_pressed = pressures > 0
        joined_points = active.places.point[active.joined_places.first][is_pressed]
        cell = points.cell[joined_points]
        nodal = (self._r0 + self._displacement())[self._nodes[cell]]
        places = np.einsum("nf,nfi->ni", points.shape[joined_points], nodal)
        if places.shape[1] == 2:  # of a meridian
            places = np.insert(places, 1, 0.0, axis=1)
        area_of_cells = np.bincount(points.cell - first_cell, points.weight, count)
        cell_area = np.asarray(area_of_cells[cell - first_cell], np.float64)
        # half, since the points of both members have the same force
        area = active.area[is_pressed] / 2
        return PressedPoints(places, pressures[is_pressed], area, cell_area)

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
        numbers = np.array([number.value for number, _ in self.history.values()])
        state = self._at, self._growth, numbers
        return self._cell_values.get(state, self._compute_pressures_and_gaps)

    def _compute_pressures_and_gaps(self) -> tuple[Array, Array, Flags]:
        """Compute `cell_pressures_and_gaps` at the present state; collective."""
        active = self._active_set()
        points, (first_cell, count) = active.points, self._geometry.local_cells
        nearest = active.places.select(active.joined_places.first)
        _, pressure, _ = active.penalties
        force = active.area * pressure  # in full: the mean pressure of this face
        # whether each of these points is one of an edge that presses on a face alone: half of its
        # force is on that face
        is_edge_alone = self._are_edges_alone(nearest)
        force_on_faced = self._force_on_faced_cells(nearest, force / 2 * is_edge_alone)
        # local numbers of the points' cells: own cells come first, then ghosts, without points
        cell = points.cell - first_cell
        area = np.bincount(cell, points.weight, count)
        own_force = force * (1 - is_edge_alone / 2)
        force_on_cells = np.bincount(cell[nearest.point], own_force, count).astype(np.float64)
        force_on_cells[: len(force_on_faced)] += force_on_faced
        # the least gap in each cell
        gap = np.full(count, self._reach - self._h)
        near_places = self._places_within_reach()
        np.minimum.at(gap, cell[near_places.point], near_places.distance - self._h)
        # the area that belongs to the points in contact
        pressed_points = np.unique(nearest.point)
        pressed_area = np.bincount(cell[pressed_points], points.weight[pressed_points], count)
        is_full = (area > 0) & (pressed_area > FULL_CONTACT_SHARE * area)
        return force_on_cells / np.where(area > 0, area, 1.0), gap, is_full

    def _force_on_faced_cells(self, nearest: Places, force_of_edges: Array) -> Array:
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
        force_on_cells = np.bincount(nearest.cell, force_of_edges, len(self._nodes))
        force_on_modelled = self._in_modelled(force_on_cells.astype(np.float64)[:, None])[:, 0]
        return np.asarray(self._comm.allreduce(force_on_modelled)[self._fields.own])

    def least_thickness(self, *displacements: Array) -> float:
        """Return the least thickness of the pair over R, undeformed and at some displacements.

        These are (nodes, dim), of all cells.
        """
        halves = [self._half]
        if self._offsets:
            halves += [self._offsets.half_thickness(u) for u in displacements]
        return 2 * min(float(half[self._nodes_of_pair].min()) for half in halves)

    def passes_through(self, u: Array, v: Array) -> bool:
        """Return whether points pass through a member on the straight way from u to v; collective.

        Mid-surfaces are looked at in samples of the way, between which no point moves, relative to
        another, by more than a part of the least thickness.

        Parameters
        ----------
        u, v
            (nodes, dim) displacements of all cells, as `configuration` has them.
        """
        least_thickness = self.least_thickness(u, v)
        # motions that are the same for all points do not count
        motion = (v - u) - (v - u).mean(axis=0) * self.common_translations
        # number of parts of the way; twice the motion, since two points may move in opposite
        # directions
        farthest = 2 * np.linalg.norm(motion, axis=1).max()
        count = int(np.ceil(farthest / (MAX_MOTION_PER_SAMPLE * least_thickness)))
        # points pass through if mid-surfaces are very near at a sample between the parts; both ends
        # of the way are states, where no member has passed through another
        reach = PASS_THROUGH_DISTANCE * least_thickness
        for k in range(1, count):
            near_places = self._projections_of_midsurfaces(u + k / count * (v - u), reach)
            if self._comm.allreduce(len(near_places.point)):
                return True
        return False

    # in a step in time, see `time_averaging`

    @property
    def configuration(self) -> Array:
        """The present displacement (nodes, dim) of all cells; collective."""
        return np.array(self._displacement())

    def average(self, begin: Array, end: Array, part: float) -> None:
        self.samples = ()  # old ones must not be in use while new ones are computed
        self.samples = samples_of_step(self, begin, end, part)

    def use_present_force(self) -> None:
        self.samples = ()

    def sample_rates(self, motion: Array) -> SampleRates:
        """Return the penalty of the points at the present sample, with its rates along a motion.

        Parameters
        ----------
        motion
            (nodes, dim) displacement of the whole step, of all nodes.
        """
        active = self._active_set()
        if self._offsets:  # faces also move as the thickness changes, the last component
            motion = np.column_stack([motion, self._offsets.change(self._at, motion)])
        return SampleRates.sum_over_points(
            count=len(active.points.weight),
            point=active.places.point[active.joined_places.first],
            penetration=self._h - active.joined_places.distance,
            closing=active.closing_rates(self._gap_geometry(active.places), motion),
            penalty=self.penalty,
        )

    # nodes and their images

    def _displacement(self) -> Array:
        """Return the displacement (nodes, dim), at present or at the sample; collective."""
        return self.sample.u if self.sample else self._nodal_values(self._geometry.u)

    def _in_modelled(self, values: Array) -> Array:
        """Return derivatives by values in modelled cells, from those by values in all cells."""
        return values

    def _on_modelled(self, forces: Array) -> Array:
        """Return the forces on modelled nodes (nodes, dim), from those on all nodes."""
        return forces

    # what depends on the geometry

    @abstractmethod
    def _places_in_contact(self) -> tuple[Places, JoinedPlaces]:
        """Return the places in contact at the present state or sample, and how they are joined.

        They are cached while the state stays. `_at`, `_growth` and `_points` become those of this
        state. Collective.
        """

    @abstractmethod
    def _follow(self, places: Places) -> Places:
        """Return places of a frozen contact moved, in their cells, to where points project now."""

    @abstractmethod
    def _own_points(self, frozen: FrozenContact[Places]) -> ContactPoints | MeridianPoints:
        """Return the points of a frozen contact with the weights of this undeformed shell."""

    @abstractmethod
    def _gap_geometry(self, places: Places) -> Geometry:
        """Return distances, normals, beta and nodes of n places at the last active set's state."""

    @abstractmethod
    def _entries_by_place_and_offset(self) -> Entries:
        """Return this rank's entries of the second derivative by places and offsets; collective."""

    @abstractmethod
    def _coupled_cells(self) -> Longs:
        """Return pairs (2, n) of cells whose nodes the tangent may couple; collective."""

    @abstractmethod
    def _add(self, b: Array, forces: Array) -> None:
        """Add forces (nodes, dim) of this rank's points to the vector b; collective."""

    @abstractmethod
    def _nodal_values(self, function: fem.Function) -> Array:
        """Return the values (nodes, dim) at the nodes of all cells; collective."""

    @abstractmethod
    def _may_touch(self, cell: Longs, other: Longs) -> Flags:
        """Return flags (n,): whether cells (n,) may touch others, which are not their material."""

    @abstractmethod
    def _mean_thickness(self, places: Places) -> Array:
        """Return the mean (n,) of the undeformed thicknesses over R at points and places."""

    @abstractmethod
    def _are_edges_alone(self, nearest: Places) -> Flags:
        """Return flags (n,): points on an edge that presses on a face whose own do not count."""

    @abstractmethod
    def _places_within_reach(self) -> Places:
        """Return the places that points face within the reach; at least the nearest of each."""

    @abstractmethod
    def _projections_of_midsurfaces(self, u: Array, reach: float) -> Places:
        """Return the places nearer than a distance between mid-surfaces at u; collective."""

    @abstractmethod
    def least_gap(self) -> float:
        """Return the least gap over R; nan where no faces are within the reach. Collective."""

    @abstractmethod
    def deepest_penetration(self) -> tuple[float, Array]:
        """Return the largest penetration, and the point (3,) where it is, both over R; collective.

        Without contact they are 0 and the origin.
        """

    @abstractmethod
    def weight_slopes(self, tables: Array, places: Array) -> Array:
        """Return relative derivatives (n, functions, dim) of points' weights by undeformed nodes.

        They are the derivatives of a weight over the weight.

        Parameters
        ----------
        tables, places
            Shape functions (n, functions) at points and the undeformed points (n, dim), each with
            its derivatives by the coordinates of the cell.
        """
