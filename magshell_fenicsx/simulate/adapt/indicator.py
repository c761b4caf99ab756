"""Error indicators: the contribution of each cell to the error of a result.

The result J of a run is an amplitude on a path of stationary points, or its conjugate displacement. Its first
variation with the residual is therefore the path's tangent z: J - J_h = a(e_u, e_z) up to higher order, with the
tangent stiffness a and the errors e of u and z (dual weighted residuals: R. Becker, R. Rannacher, Acta Numerica 10,
2001). In each cell this is at most sqrt(|e_u|^2 |e_z|^2) in the energy norm. The errors are estimated with a solution
of higher degree on the same mesh.
"""

import basix
import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import Vector, dot
from magshell_fenicsx.models.shell.law import work
from magshell_fenicsx.simulate.adapt.ending import CellFields, Ending, carry, gathered
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]
STEP = 1e-30  # along the imaginary axis: the derivative is exact


def indicators(coarse: tuple[Scene, Ending], fine: tuple[Scene, Ending]) -> tuple[Array, Array]:
    """Share of each cell in the error of the result, up to a common factor; collective.

    Parameters
    ----------
    coarse, fine
        Scenes on one mesh with their ends; the second has a higher degree.

    Returns
    -------
    Centres of the cells (n, 2) in the chart, in an order independent of the number of ranks, and shares (n,).
    """
    (scene, low), (richer, high) = coarse, fine
    cells, comm = CellFields.of(richer), richer.newton.system.comm
    u, z = (carry(scene, richer, v) for v in (low.state.u, low.tangent))
    scale = dot(comm, z, high.tangent) / dot(comm, z, z)  # null vectors have no scale
    energy = _TangentEnergy(richer, cells, high.state.u)
    shares = np.sqrt(energy(high.state.u - u) * energy(high.tangent - scale * z))
    order = np.lexsort(cells.centres.round(9).T)
    return cells.centres[order], shares[order]


class _TangentEnergy:
    """Membrane and bending energy of the linearised strains of a variation, cell by cell: half the second derivative.

    With the deformed a_i, n and a_i,j: dE_ij = sym(a_i . v,_j), dK_ij = n . (v,_ij - G^k_ij v,_k).
    """

    def __init__(self, scene: Scene, cells: CellFields, u: Vector) -> None:
        model, self._scene = scene.model, scene
        points, self._weights = basix.make_quadrature(basix.CellType.triangle, 2 * model.degree)
        self._table = cells.table(2, points)
        r0 = self._derivatives(model.r0.x.array[: model.system.size])
        first, second = (a + b for a, b in zip(r0, self._derivatives(u), strict=True))
        metric0, metric = (np.einsum("...ic,...jc->...ij", a, a) for a in (r0[0], first))
        normal = np.cross(first[..., 0, :], first[..., 1, :])
        self._normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        self._a, self._raise, self._strain = first, np.linalg.inv(metric0), (metric - metric0) / 2
        self._gamma = np.einsum("...ijc,...kc->...ijk", second, np.linalg.solve(metric, first))
        self._area = np.sqrt(np.linalg.det(metric0))

    def __call__(self, v: Vector) -> Array:
        """(cells,), over E h R^2."""
        law = self._scene.problem.material.law
        first, second = self._derivatives(v)
        E = np.einsum("...ic,...jc->...ij", self._a, first)
        bent = second - np.einsum("...ijk,...kc->...ijc", self._gamma, first)
        K = np.einsum("...c,...ijc->...ij", self._normal, bent)
        E, K = ((S + np.swapaxes(S, -1, -2)) / 2 for S in (E, K))
        slope = work(law.stress(self._strain + 1j * STEP * E, self._raise), E).imag / STEP
        density = slope / 2 + law.bending(self._strain, K, self._raise)
        return np.asarray((density * self._area) @ self._weights)

    def _derivatives(self, v: Vector) -> tuple[Array, Array]:
        """First (cells, points, i, 3) and second (cells, points, i, j, 3) in the reference cell."""
        d = np.einsum("jqp,npc->jnqc", self._table, gathered(self._scene, v))
        second = np.stack([np.stack([d[3], d[4]], axis=-2), np.stack([d[4], d[5]], axis=-2)], axis=-3)
        return np.stack([d[1], d[2]], axis=-2), second
