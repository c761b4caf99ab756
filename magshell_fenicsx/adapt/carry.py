"""Fields of a scene as the polynomials that they are on its cells, and their values on another mesh of the same case.

`transfer` smooths, and scales between shells of different shape. Here source and target have one
chart: to a higher degree on the same mesh a displacement is carried without any loss.
"""

import basix
import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.scene import Scene
from magshell_fenicsx.solve.system import Vector
from magshell_fenicsx.transfer import chart

Array = NDArray[np.float64]
CANDIDATES = 12  # cells with the nearest centres, among which the one that holds a point is sought
NEWTON_STEPS = 4  # for the place in a cell with a curved edge


def carry(source: Scene, target: Scene, u: Vector) -> Vector:
    """A displacement of `source` in the unknowns of `target`, zero where that is held; collective."""
    return target.model.system.held(CellFields(source).at(gathered(source, u), chart(target)).ravel())


def gathered(scene: Scene, u: Vector) -> Array:
    """Values (cells, nodes, components) of a displacement on the cells of all ranks, on every rank; collective."""
    system, V = scene.model.system, scene.model.V
    system.set(u)
    topology = V.mesh.topology
    here = V.dofmap.list[: topology.index_map(topology.dim).size_local]
    return np.concatenate(system.comm.allgather(system.u.x.array.reshape(-1, V.dofmap.bs)[here]))


class CellFields:
    """The cells of all ranks in the chart, to find points in them; collective.

    Attributes
    ----------
    nodes
        (cells, nodes, 1 or 2) in the chart; with them the element maps its reference cell to the chart.
    """

    def __init__(self, scene: Scene) -> None:
        x = chart(scene)
        dim, bs = x.shape[1], scene.model.V.dofmap.bs
        self.nodes = gathered(scene, np.pad(x, ((0, 0), (0, bs - dim))).ravel())[..., :dim]
        self._element: basix.finite_element.FiniteElement = scene.model.V.element.basix_element
        self._near = scipy.spatial.cKDTree(self.centres)

    @property
    def centres(self) -> Array:
        """(cells, 1 or 2)."""
        return np.asarray(self._corners.mean(axis=1))

    def at(self, values: Array, x: Array) -> Array:
        """Of `gathered` values, those (n, components) at points x (n, 1 or 2) of the chart."""
        count = min(CANDIDATES, len(self.nodes))
        candidates = self._near.query(x, count)[1].reshape(len(x), count)
        places = np.stack([self._as_if_straight(x, cells) for cells in candidates.T])
        best = np.minimum(places.min(axis=2), 1 - places.sum(axis=2)).argmax(axis=0)
        rows = np.arange(len(x))
        cells, xi = candidates[rows, best], places[best, rows]
        for _ in range(NEWTON_STEPS):
            table = self.table(1, xi)
            rest = x - np.einsum("np,npd->nd", table[0], self.nodes[cells])
            xi = xi + _solve(np.einsum("jnp,npd->ndj", table[1:], self.nodes[cells]), rest)
        return np.asarray(np.einsum("np,npc->nc", self.table(0, xi)[0], values[cells]))

    def table(self, derivatives: int, xi: Array) -> Array:
        """Shape functions and derivatives (derivative, n, nodes) at points of the reference cell."""
        return np.asarray(self._element.tabulate(derivatives, xi)[..., 0])

    @property
    def _corners(self) -> Array:
        return self.nodes[:, : self.nodes.shape[2] + 1]

    def _as_if_straight(self, x: Array, cells: NDArray[np.int64]) -> Array:
        """Places in the reference cell if the cells had straight edges."""
        corners = self._corners[cells]
        return _solve(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2), x - corners[:, 0])


def _solve(matrices: Array, right: Array) -> Array:
    return np.asarray(np.linalg.solve(matrices, right[..., None])[..., 0])
