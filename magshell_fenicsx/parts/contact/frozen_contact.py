"""A contact with its active set fixed, for differences by a number of the case.

The active set of a contact has the places that are pressed. It stays as it is at one state, the
frozen state: the contact points, the cells that they face, whether places are inside these cells or
on a side, and which places are joined as one. Within their cells the places still move. The penalty
is replaced by its Taylor polynomial about the penetration of the frozen state: its stiffness grows
from zero over a penetration far smaller than the motion between the two states of a difference. The
weights of joined places are linear in distances. So energies and forces are smooth in the number,
with the exact first derivative.

A place is the closest place to a contact point, in coordinates X of a cell; `point` has the number
of its contact point. Joined places are those of one point in neighbouring cells. They count as one
place, whose distance is a smooth minimum of their distances d: -e log sum exp(-d/e), where the blur
e is a small length. `group` has the joined place of each place, `first` the first place of each
joined place. r0 and u are undeformed places and displacements of nodes. Lengths are over R,
stiffnesses over E h/R^2.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.contact.closest_points import BLUR_DISTANCE, ClosestPointSearch
from magshell_fenicsx.parts.contact.projection import (
    Cells,
    JoinedPlaces,
    Projections,
    distances,
    follow_places,
    jets,
)
from magshell_fenicsx.parts.contact.segments import ContactPoints
from magshell_fenicsx.parts.gap import SOFT_PENETRATION, expanded_penalty, penalty

Array = NDArray[np.float64]
Penalty = tuple[Array, Array, Array]


@dataclass(frozen=True)
class FrozenContact:
    """The active set of a contact at one state, which stays while numbers of the case change.

    Attributes
    ----------
    cells, points
        All cells, and the contact points.
    places, joined_places
        The places in contact, and which of them are joined as one.
    penetration
        (m,) penetrations of the joined places over R, about which the penalty is expanded.
    area_ratio
        (points,) undeformed area per area of the reference cell.
    """

    cells: Cells
    points: ContactPoints
    places: Projections
    joined_places: JoinedPlaces
    penetration: Array
    area_ratio: Array

    @classmethod
    def at_state(
        cls,
        cells: Cells,
        r0: Array,
        h: float,
        points: ContactPoints,
        places: Projections,
        joined_places: JoinedPlaces,
    ) -> "FrozenContact":
        """Return the active set of a state on an undeformed surface r0 (nodes, 3).

        The places are those of this state; h is the thickness over R.
        """
        area_ratio = _area_ratio(cells, r0, points)
        return cls(cells, points, places, joined_places, h - joined_places.distance, area_ratio)

    def on_surface(self, r0: Array) -> "FrozenContact":
        """Return the same active set on another undeformed surface r0 (nodes, 3).

        Weights of points change with the areas around them.
        """
        area_ratio = _area_ratio(self.cells, r0, self.points)
        weight = self.points.weight * area_ratio / self.area_ratio
        return replace(self, points=replace(self.points, weight=weight), area_ratio=area_ratio)

    def evaluate(
        self, search: ClosestPointSearch, u: Array, k: float, h: float, *, with_third_order: bool
    ) -> tuple[Projections, JoinedPlaces, Penalty]:
        """Return the places at a displacement, how they are joined, and the expanded penalty.

        Parameters
        ----------
        search
            Gives the places of nodes and points. No new closest points are searched.
        u
            (nodes, 3) displacement over R.
        k, h
            Stiffness of the penalty over E h/R^2, and thickness over R.
        with_third_order
            Whether the penalty is expanded to third order, as differences of tangents need.

        Returns
        -------
        places, joined_places
            The n places, and which of them are joined as m places.
        penalty
            Three arrays (m,): the penalty energy per area of each joined place, with its first and
            second derivative by the penetration.
        """
        places, joined_places, cells = self.places, self.joined_places, self.cells
        soft_penetration = SOFT_PENETRATION * h
        if not len(places.point):  # no contact at the frozen state, nor now
            return places, joined_places, penalty(self.penetration, k, soft_penetration)
        # where the points project now, each in the same cell
        r = search.places_of_nodes(u)
        x = search.places_of_points(self.points, r, places.point)
        nodal = r[cells.nodes[places.cell]]
        X = follow_places(cells, x, nodal, places.X, places.free_directions)
        (_, y), *_ = jets(cells.element, X, nodal, order=0)  # the places y at X, no derivatives
        off, distance = (x - y)[:, :3], distances(x - y)
        direction = off / np.linalg.norm(off, axis=1)[:, None]
        moved_places = replace(places, X=X, distance=distance, direction=direction)
        # joined places: their distances change by the weighted mean of those of their places
        change = distance - places.distance
        mean_change = np.bincount(
            joined_places.group, joined_places.weight * change, len(joined_places.first)
        )
        # weights are exp(-d/e) over their sum, here to first order in the changes of distances d
        weight = joined_places.weight * (
            1 - (change - mean_change[joined_places.group]) / (BLUR_DISTANCE * h)
        )
        moved_joined = replace(
            joined_places, distance=joined_places.distance + mean_change, weight=weight
        )
        penalties = expanded_penalty(
            h - moved_joined.distance,
            self.penetration,
            k,
            soft_penetration,
            with_third_order=with_third_order,
        )
        return moved_places, moved_joined, penalties


def _area_ratio(cells: Cells, r0: Array, points: ContactPoints) -> Array:
    """Return the undeformed area at contact points, (points,), per area of the reference cell.

    The undeformed surface has the places r0 (nodes, 3).
    """
    if not len(points.cell):
        return np.zeros(0)
    X = points.shape @ cells.element.points  # places in the reference cell, from shape functions
    slopes = cells.element.tabulate(1, X)[1:, ..., 0]
    a1, a2 = np.einsum("dnk,nki->dni", slopes, r0[cells.nodes[points.cell]])
    return np.asarray(np.linalg.norm(np.cross(a1, a2), axis=1))
