"""Derivatives of a contact's energy by the growth of its faces, the thickness and the placement.

The gap depends on the places r0 + u, and on half the thickness H at nodes: H = V/A, where V =
(h/2) sum t J0 and A = sum J are summed over the cells around the node. J0 and J are the undeformed
and the deformed area of a cell at the node, per area of its coordinates. The contact energy Pi is a
sum over points with the weights J0(X). The weighted sum of a functional is e Pi + f w . Pi,u, with
two numbers e and f and a displacement w (`EnergyWeights`). Its derivative is

    by t:  (h/2) J0 g_V,    g_V = g/A + f Pi,H (H,u w)/V,    g = e Pi,H + f (Pi,Hu w + Pi,HH H,u w),

and by r0 it is that by u, with what the weights and the undeformed areas in V and A add. The points
stay in their cells.

- t is the factor of the thickness.
- Growth is the natural stretch, an amplitude on which the thickness of a grown shell depends.
- Forces are derivatives of the energy by places, or by H as the last component; rates are
  derivatives along a motion.
- A place is the closest place that a point faces: `place.point` is the number of that point.
  Several places of a point in neighbouring cells are joined, and count as one (`ActiveSet`).
- beta are the shape functions of a point, and minus those of its place.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.free_parameters import Derivative, FreeParameter
from magshell_fenicsx.assembly.nonlocal_terms import Entries
from magshell_fenicsx.parts.contact.active_set import ActiveSet, Geometry
from magshell_fenicsx.parts.contact.face_offsets import CellsWithNodes, FaceOffsets
from magshell_fenicsx.parts.contact.gap_derivatives import forces_on_nodes
from magshell_fenicsx.parts.contact.meridian_projection import MeridianProjections
from magshell_fenicsx.parts.contact.projection import Longs, Projections

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ContactFields:
    """The fields that a gap depends on.

    Attributes
    ----------
    r0, thickness
        The undeformed placement over R, and the factor of h; None for 1.
    nodes
        (cells, functions) node numbers of all cells that are modelled.
    own
        Slice of this rank's cells among them.
    """

    r0: fem.Function
    thickness: fem.Function | None
    nodes: Longs
    own: slice

    def shared_by_cells(self, forces: Array) -> Array:
        """Return forces on nodes, split equally among the cells around each node.

        Derivatives by a field are wanted per cell; their sum over cells is the force again.

        Parameters
        ----------
        forces
            (nodes, d) on all nodes. The result is (own cells, functions, d).
        """
        count = np.bincount(self.nodes.ravel(), minlength=len(forces))
        shares = forces / np.maximum(count, 1)[:, None]
        return np.asarray(shares[self.nodes[self.own]])


@dataclass(frozen=True)
class ContactState:
    """A contact at one state, with this rank's contact points.

    Attributes
    ----------
    cells
        All cells with their element and nodes.
    r0, u
        (nodes, 3) undeformed places and displacement of all nodes.
    offsets
        Half the thickness where it varies; None where it is h/2.
    active
        The contact points, with the places in contact and the penalty there.
    forces
        (nodes, 3 or 4) derivatives of the energy by places and by H.
    find_entries_by_place_and_offset, find_entries
        Return entries of the second derivative by places and H, and by u.
    find_geometry
        Returns the geometry of the places in contact.
    weight_slopes
        Returns relative derivatives (n, functions, 3) of points' weights by undeformed nodes, from
        shape functions (n, functions) at the points and undeformed points (n, 3), both with their
        derivatives by the coordinates of the cell.

    On a meridian vectors have two components in place of three.
    """

    cells: CellsWithNodes
    r0: Array
    u: Array
    offsets: FaceOffsets | None
    active: ActiveSet[Projections] | ActiveSet[MeridianProjections]
    forces: Array
    find_entries_by_place_and_offset: Callable[[], Entries]
    find_entries: Callable[[], Entries]
    find_geometry: Callable[[], Geometry]
    weight_slopes: Callable[[Array, Array], Array]

    @cached_property
    def required_offsets(self) -> FaceOffsets:
        """The offsets, of a contact whose thickness varies."""
        assert self.offsets
        return self.offsets

    def force_rates(self, rates: Array) -> Array:
        """Return the rates (nodes, 4) of the forces for rates (nodes, 4) of places and H.

        They are the second derivative times these rates.
        """
        rows, columns, values = self.find_entries_by_place_and_offset()
        # all places come first, then H of all nodes, as in `unknown_numbers`
        flat_rates = np.concatenate([rates[:, :-1].ravel(), rates[:, -1]])
        product = np.bincount(rows, values * flat_rates[columns], len(flat_rates))
        by_place, by_offset = product[: self.r0.size], product[self.r0.size :]
        return np.column_stack([by_place.reshape(self.r0.shape), by_offset])

    def unknown_rates(self, w: Array) -> Array:
        """Return the rates (nodes, 3 or 4) of places and H along a motion w (nodes, 3).

        H is left out where the thickness is uniform.
        """
        return np.column_stack([w, self.offsets.change(self.u, w)]) if self.offsets else w

    def forces_on_nodes(self, forces: Array) -> Array:
        """Return the derivatives (nodes, 3) by u, from those by places and H (nodes, 3 or 4).

        H depends on u, so they are those by places, and those by H times H,u.
        """
        return forces_on_nodes(self.offsets, self.u, forces)

    def penetration_rates(self, w: Array) -> Array:
        """Return the rates (m,) of the joined places' penetrations along a motion w (nodes, 3)."""
        return self.active.closing_rates(self.find_geometry(), self.unknown_rates(w))


@dataclass(frozen=True)
class GrowthDerivative:
    """A derivative of the contact energy by the natural stretch, on which the faces depend.

    Attributes
    ----------
    find_state
        Returns the contact at the present state; collective.
    add
        Adds forces (nodes, 3) to a vector, its first argument; collective.
    order
        Order of the derivative, 1 or 2.
    amplitude
        The amplitude that multiplies it; None without.

    In the methods Pi,H are the derivatives of the contact energy by H at nodes, and H,g and H,gg
    are those of H by the natural stretch g.
    """

    find_state: Callable[[], ContactState]
    add: Callable[[Array, Array], None]
    order: int = 1
    amplitude: str | None = None

    def energy(self) -> float:
        """Return the derivative of this rank's contact energy by the natural stretch g.

        The first is Pi,H H,g. The second is H,g Pi,HH H,g + Pi,H H,gg.
        """
        state = self.find_state()
        offsets, u = state.required_offsets, state.u
        by_H = state.forces[:, -1]  # Pi,H, the last component of forces
        curvature_part = 0.0  # H,g Pi,HH H,g
        if self.order == 2:
            by_H_and_growth = _growth_forces(state)[:, -1]  # Pi,HH H,g
            curvature_part = float(by_H_and_growth @ offsets.growth_derivative(u))
        return curvature_part + float(by_H @ offsets.growth_derivative(u, self.order))

    def add_residual(self, b: Array, factor: float) -> None:
        """Add `factor` times the gradient by u of the energy's first derivative to b; collective.

        The first derivative by the stretch g is Pi,H H,g: both factors depend on u.
        """
        state = self.find_state()
        # the factor Pi,H varies: its derivative by u, times H,g
        forces = state.forces_on_nodes(_growth_forces(state))
        # the factor H,g varies: its derivative by u, times Pi,H
        forces = forces + state.required_offsets.slope_by_growth(state.u, state.forces[:, -1])
        self.add(b, factor * forces)


def with_growth(
    growth: FreeParameter,
    find_state: Callable[[], ContactState],
    add: Callable[[Array, Array], None],
) -> FreeParameter:
    """Return the parameter of growth with a contact's derivatives added to its own.

    A free parameter is a number in the energies, with their derivatives by it.

    Parameters
    ----------
    growth
        The natural stretch as a free parameter. Its `slopes` are the terms of the energy's first
        derivative; `differentiate_slopes` gives their derivatives by a second number.
    find_state
        Returns the contact at the present state; collective.
    add
        Adds forces (nodes, 3) to a vector, its first argument; collective.
    """

    def second_derivatives(q: object) -> Sequence[Derivative]:
        # the contact has a second derivative by growth twice; no other parameter is in it
        of_contact = [GrowthDerivative(find_state, add, order=2)] if q is growth.constant else []
        return [*growth.differentiate_slopes(q), *of_contact]

    slopes = [*growth.slopes, GrowthDerivative(find_state, add)]
    return replace(growth, slopes=slopes, differentiate_slopes=second_derivatives)


def _growth_forces(state: ContactState) -> Array:
    """Return the rates of the forces (nodes, 4) by the natural stretch, at fixed displacement.

    They are Pi,rH H,g by places r, and Pi,HH H,g by H in the last component.
    """
    rates = state.required_offsets.growth_derivative(state.u)
    return state.force_rates(np.column_stack([0 * state.u, rates]))


@dataclass(frozen=True)
class EnergyWeights:
    """Weights of the sum e Pi + f w . Pi,u: e is `energy`, f is `force`, and w is (nodes, 3)."""

    w: Array
    energy: float
    force: float


def by_factor(state: ContactState, weights: EnergyWeights) -> Array:
    """Return derivatives (cells, functions) of the weighted sum by the thickness factor.

    The thickness factor is only in the volumes V; the areas do not depend on it.
    """
    by_volume, _ = _by_volumes_and_areas(state, weights)
    return state.required_offsets.by_factor(by_volume)


def by_place(state: ContactState, weights: EnergyWeights) -> Array:
    """Return derivatives (nodes, 3) of the weighted sum by the undeformed places.

    They are those by u, and those through the areas in weights of points and in offsets.
    """
    rows, columns, values = state.find_entries()
    # the tangent times w: the derivative of w . Pi,u by u
    rates = np.bincount(rows, values * weights.w.ravel()[columns], state.r0.size)
    forces = weights.energy * state.forces_on_nodes(state.forces)
    forces = forces + weights.force * rates.reshape(state.r0.shape) + _by_weights(state, weights)
    if not state.offsets:  # a uniform thickness depends on no area
        return forces
    by_volume, by_area = _by_volumes_and_areas(state, weights)
    return forces + state.offsets.by_area(by_volume, by_area)


def _by_volumes_and_areas(state: ContactState, weights: EnergyWeights) -> tuple[Array, Array]:
    """Return derivatives (nodes,) of the weighted sum by the volumes V and by the areas A.

    By V they are g_V of the module's formula. As H = V/A and H,u w = -V A,u w/A^2, those by A are
    -(V/A^2) g - 2 f Pi,H (H,u w)/A.
    """
    H_w = state.required_offsets.change(state.u, weights.w)  # H,u w
    # the last component of forces is by H: Pi,H, and its rate Pi,Hu w + Pi,HH H,u w
    force_rates = state.force_rates(np.column_stack([weights.w, H_w]))
    g = weights.energy * state.forces[:, -1] + weights.force * force_rates[:, -1]
    volume, area = state.required_offsets.volumes_and_areas(state.u)
    along_w = weights.force * state.forces[:, -1] * H_w  # f Pi,H (H,u w)
    return g / area + along_w / volume, -(g * volume / area + 2 * along_w) / area


def _by_weights(state: ContactState, weights: EnergyWeights) -> Array:
    """Return derivatives (nodes, 3) of the weighted sum by places, through the points' weights.

    A weight is the undeformed area that belongs to a point; gaps do not change here.
    """
    forces = np.zeros_like(state.r0)
    active = state.active
    if not len(active.places.point):
        return forces
    value, pressure, _ = active.penalties
    # the number of the contact point of each joined place
    points, point = active.points, active.places.point[active.joined_places.first]
    # the weighted sum per area: along w the penalty changes by the pressure times the rate of the
    # penetration. It is halved, since both surfaces have points
    rates = state.penetration_rates(weights.w)
    value_of_joined = (weights.energy * value + weights.force * pressure * rates) / 2
    per_weight = np.bincount(point, value_of_joined, len(points.cell))
    # relative derivatives of the weights of points in contact, times their part of the sum
    pressed_points = np.unique(point)
    element, nodes = state.cells.element, state.cells.nodes[points.cell[pressed_points]]
    X = points.shape[pressed_points] @ element.points  # places in the reference cell
    tables = element.tabulate(1, X)[..., 0]
    undeformed_places = np.einsum("dnk,nki->dni", tables, state.r0[nodes])
    slopes = state.weight_slopes(tables, undeformed_places)
    value_of_points = per_weight[pressed_points] * points.weight[pressed_points]
    np.add.at(forces, nodes, value_of_points[:, None, None] * slopes)
    return forces
