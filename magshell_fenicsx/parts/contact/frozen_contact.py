"""A contact with its active set fixed, for differences by a number of the case.

What is pressed stays what it is at one state: the points, the cells that they face, whether places
are inside of these or on a side, and which places are joined as one. In those cells the places move
on. The penalty is its Taylor polynomial about the penetration of that state, since its stiffness
grows from zero within a far smaller way than that of a difference; the weights of joined places are
linear. So energies and forces are smooth in the number, with the exact first derivative.
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
    """The active set of a contact at a state.

    Attributes
    ----------
    penetration
        (m,) of joined places, over R.
    area_ratio
        (points,) undeformed areas per area of the reference cell.
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
        """Return the active set of a state on an undeformed surface r0 (nodes, 3)."""
        area_ratio = _area_ratio(cells, r0, points)
        return cls(cells, points, places, joined_places, h - joined_places.distance, area_ratio)

    def on_surface(self, r0: Array) -> "FrozenContact":
        """Return the same active set on another undeformed surface r0 (nodes, 3)."""
        area_ratio = _area_ratio(self.cells, r0, self.points)
        weight = self.points.weight * area_ratio / self.area_ratio
        return replace(self, points=replace(self.points, weight=weight), area_ratio=area_ratio)

    def evaluate(
        self, search: ClosestPointSearch, u: Array, k: float, h: float, *, with_third_order: bool
    ) -> tuple[Projections, JoinedPlaces, Penalty]:
        """Return the places at a displacement, how they are joined, and `expanded_penalty`.

        Parameters
        ----------
        k, h
            Stiffness of the penalty, and mean thickness.
        with_third_order
            See `expanded_penalty`.
        """
        places, joined_places, cells = self.places, self.joined_places, self.cells
        soft_penetration = SOFT_PENETRATION * h
        if not len(places.point):
            return places, joined_places, penalty(self.penetration, k, soft_penetration)
        r = search.places_of_nodes(u)
        x = search.places_of_points(self.points, r, places.point)
        nodal = r[cells.nodes[places.cell]]
        X = follow_places(cells, x, nodal, places.X, places.free_directions)
        (_, y), *_ = jets(cells.element, X, nodal, 0)
        off, distance = (x - y)[:, :3], distances(x - y)
        change = distance - places.distance
        mean = np.bincount(
            joined_places.group, joined_places.weight * change, len(joined_places.first)
        )
        weight = joined_places.weight * (
            1 - (change - mean[joined_places.group]) / (BLUR_DISTANCE * h)
        )
        joined_places = replace(
            joined_places, distance=joined_places.distance + mean, weight=weight
        )
        direction = off / np.linalg.norm(off, axis=1)[:, None]
        places = replace(places, X=X, distance=distance, direction=direction)
        penalties = expanded_penalty(
            h - joined_places.distance,
            self.penetration,
            k,
            soft_penetration,
            with_third_order=with_third_order,
        )
        return places, joined_places, penalties


def _area_ratio(cells: Cells, r0: Array, points: ContactPoints) -> Array:
    """Return undeformed areas (points,) per area of the reference cell, on a surface r0."""
    if not len(points.cell):
        return np.zeros(0)
    X = points.shape @ cells.element.points
    slopes = cells.element.tabulate(1, X)[1:, ..., 0]
    a1, a2 = np.einsum("dnk,nki->dni", slopes, r0[cells.nodes[points.cell]])
    return np.asarray(np.linalg.norm(np.cross(a1, a2), axis=1))
