"""The contact of a state where a number of the case is a little different, for differences by this
number.

What is pressed stays what it is at the state: the points, the cells that they face, whether places
are inside of these or on a side, and which places are joined as one. In those cells the places move
on. The penalty is its Taylor polynomial about the penetration of the state, whose stiffness grows
from zero within a far smaller way than that of a difference; the weights of joined places are
linear. So energies and forces are smooth in the number, with the exact first derivative.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.gap import SOFT, expanded, penalty
from magshell_fenicsx.parts.touching.facing import BLUR, Facing
from magshell_fenicsx.parts.touching.nearest import Cells, Joined, Places, distances, followed, jets
from magshell_fenicsx.parts.touching.segments import Points

Array = NDArray[np.float64]
Penalty = tuple[Array, Array, Array]


@dataclass(frozen=True)
class Expanded:
    """What is pressed at a state.

    Attributes
    ----------
    depth
        (m,) the penetration of joined places.
    area
        (points,) undeformed areas per area of the reference cell.
    """

    cells: Cells
    points: Points
    places: Places
    joined: Joined
    depth: Array
    area: Array

    @classmethod
    def of(
        cls, cells: Cells, r0: Array, h: float, points: Points, places: Places, joined: Joined
    ) -> "Expanded":
        """Those of a thickness, an undeformed surface (nodes, 3), and what is pressed there."""
        return cls(cells, points, places, joined, h - joined.distance, _area(cells, r0, points))

    def on(self, r0: Array) -> "Expanded":
        """The same where the undeformed surface is another one."""
        area = _area(self.cells, r0, self.points)
        return replace(
            self,
            points=replace(self.points, weight=self.points.weight * area / self.area),
            area=area,
        )

    def at(
        self, facing: Facing, u: Array, k: float, h: float, *, bends: bool
    ) -> tuple[Places, Joined, Penalty]:
        """The places at a displacement, how they are joined, and the penalty `expanded`; h is the
        mean thickness.
        """
        at, joined, cells = self.places, self.joined, self.cells
        if not len(at.point):
            return at, joined, penalty(self.depth, k, SOFT * h)
        r = facing.placed(u)
        x, nodal = facing.x_of(self.points, r, at.point), r[cells.nodes[at.cell]]
        X = followed(cells, x, nodal, at.X, at.free)
        (_, y), *_ = jets(cells.element, X, nodal, 0)
        off, distance = (x - y)[:, :3], distances(x - y)
        change = distance - at.distance
        mean = np.bincount(joined.group, joined.weight * change, len(joined.first))
        weight = joined.weight * (1 - (change - mean[joined.group]) / (BLUR * h))
        joined = replace(joined, distance=joined.distance + mean, weight=weight)
        at = replace(at, X=X, distance=distance, way=off / np.linalg.norm(off, axis=1)[:, None])
        return at, joined, expanded(h - joined.distance, self.depth, k, SOFT * h, bends=bends)


def _area(cells: Cells, r0: Array, points: Points) -> Array:
    if not len(points.cell):
        return np.zeros(0)
    X = points.shape @ cells.element.points
    a1, a2 = np.einsum(
        "dnk,nki->dni", cells.element.tabulate(1, X)[1:, ..., 0], r0[cells.nodes[points.cell]]
    )
    return np.asarray(np.linalg.norm(np.cross(a1, a2), axis=1))
