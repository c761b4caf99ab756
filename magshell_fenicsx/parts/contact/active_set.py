"""Active sets: the places in contact at a state with the penalty there, and such a set that stays.

A place is the closest place to a contact point, in coordinates X of a cell; `point` has the number
of its contact point. Joined places are those of one point in neighbouring cells, which count as one
(`JoinedPlaces`). psi is the penalty energy per area of a penetration.

A frozen contact keeps the active set of one state, the frozen state, for differences by a number of
the case: the contact points, the cells that they face, whether places are inside these cells or on
a side, and which places are joined as one. Within their cells the places still move. The penalty is
replaced by its Taylor polynomial about the penetration of the frozen state: its stiffness grows
from zero over a penetration far smaller than the motion between the two states of a difference. The
weights of joined places are linear in distances. So energies and forces are smooth in the number,
with the exact first derivative. Lengths are over R, stiffnesses over E h/R^2.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.contact.gap_derivatives import distance_slopes
from magshell_fenicsx.parts.contact.meridian_projection import MeridianPoints, MeridianProjections
from magshell_fenicsx.parts.contact.projection import JoinedPlaces, Longs, Projections
from magshell_fenicsx.parts.contact.segments import ContactPoints

Array = NDArray[np.float64]
Geometry = tuple[Array, Array, Array, Longs]
"""Of n places the distances (n,) of mid-surfaces, the normals (n, dim) from places to points, beta
(n, functions of both cells): the shape functions of the point, minus those of the place, and the
numbers of the nodes of these functions."""
Places = TypeVar("Places", Projections, MeridianProjections)


@dataclass(frozen=True)
class ActiveSet(Generic[Places]):
    """The places in contact at a state, with the penalty there.

    Attributes
    ----------
    points
        All contact points of this rank.
    places
        The n places in contact.
    joined_places
        Which of these are joined as one: m joined places.
    penalties
        (m,) psi of each joined place, with its two derivatives by the penetration: the pressure,
        and the stiffness of the contact.
    """

    points: ContactPoints | MeridianPoints
    places: Places
    joined_places: JoinedPlaces
    penalties: tuple[Array, Array, Array]

    @cached_property
    def area(self) -> Array:
        """(m,) undeformed areas over R^2 of the points of joined places."""
        return np.asarray(self.points.weight[self.places.point[self.joined_places.first]])

    @property
    def weight(self) -> Array:
        """(n,) the area of each place: that of its point, times its weight among joined places."""
        return np.asarray(self.joined_places.weight * self.points.weight[self.places.point])

    def closing_rates(self, geometry: Geometry, rates: Array) -> Array:
        """Return the rates (m,) of the penetrations of joined places along a motion.

        Parameters
        ----------
        geometry
            That of the places.
        rates
            (nodes, dim) rates of the places of nodes; (nodes, dim + 1) with the offsets H where
            they vary.
        """
        _, n, beta, nodes = geometry
        # derivatives of the places' distances by the unknowns of nodes, times the rates of these; a
        # penetration grows as the distance decreases
        slopes = distance_slopes(n, beta, rates.shape[1])
        closing = -np.einsum("nki,nki->n", slopes, rates[nodes])
        # the distance of a joined place changes by the weighted mean of its places' changes
        groups = self.joined_places
        return np.bincount(groups.group, groups.weight * closing, len(groups.first)).astype(float)


@dataclass(frozen=True)
class FrozenContact(Generic[Places]):
    """The active set of a contact at one state, which stays while numbers of the case change.

    Attributes
    ----------
    points
        The contact points.
    places, joined_places
        The places in contact, and which of them are joined as one.
    penetration
        (m,) penetrations of the joined places over R, about which the penalty is expanded.
    r0
        (nodes, dim) undeformed places of nodes, on which the weights of the points depend.
    """

    points: ContactPoints | MeridianPoints
    places: Places
    joined_places: JoinedPlaces
    penetration: Array
    r0: Array
