"""The surface that a meridian sweeps, as flat triangles for pictures and for ParaView."""

from collections.abc import Sequence

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import Vector
from magshell_fenicsx.models.shell.patterns import places
from magshell_fenicsx.shells.meridian import MeridianModel

Array = NDArray[np.float64]
OFF_POLE = 1e-3  # of the first cell
ENDS = np.array([[0.0], [1.0]])  # of the reference cell


class Revolution:
    """The vertices of a meridian turned into `sectors` equal angles.

    Parameters
    ----------
    kinks
        Numbers of the inner vertices along the meridian that have a circle of nodes for each of their two cells, so
        that fields may jump there.

    Attributes
    ----------
    ends
        (cells, 2) numbers of the circles at the ends of the cells along the meridian.
    r0, n0
        (n, 3) undeformed placement and unit normal, lengths in R; a pole comes first.
    cells
        (m, 3) node numbers of triangles with the outer side up.
    """

    def __init__(self, model: MeridianModel, sectors: int = 96, kinks: Sequence[int] = ()) -> None:
        self._model, V = model, model.V
        vertices = np.argsort(V.tabulate_dof_coordinates()[:, 0])[:: model.degree]
        cells = np.arange(len(vertices) - 1)
        begin = cells + np.searchsorted(np.sort(kinks), cells, side="right")
        self.ends = np.column_stack([begin, begin + 1])
        self._vertices = np.repeat(vertices, 1 + np.isin(np.arange(len(vertices)), kinks))
        theta = np.arange(sectors) * 2 * np.pi / sectors
        cos, sin, zero = np.cos(theta), np.sin(theta), 0 * theta
        basis = np.array([[cos, sin, zero], [-sin, cos, zero], [zero, zero, zero + 1]])  # e_rho, e_theta, e_z
        self._basis = np.moveaxis(basis, -1, 0)
        self._first = min(len(model.meridian.axis), 1)  # circle: all sectors meet in the pole
        normals = nodal_normals(model.r0)
        self.r0, self.n0 = self._turned(model.r0.x.array.reshape(-1, 2)), self._turned(normals[:, [0, 2]])
        self.cells = self._triangles(sectors)

    def displacement(self, u: Vector) -> Array:
        """The displacement of the nodes, (n, 3) over R."""
        return self._turned(u.reshape(-1, 2))

    def jets(self, f: fem.Function) -> Array:
        """The jet of a field at the ends of all cells, along (e_rho, e_theta, e_z): (6, cells, 2, 3).

        At the pole, where the surface has no second direction, a little off it.
        """
        values = self._at(f, np.array([[0.0], [1.0], [OFF_POLE]]))
        if self._first:
            values[:, 0, 0] = values[:, 0, 2]
        return _revolved(values[:, :, :2])

    def inner_jets(self, f: fem.Function, points: Array) -> Array:
        """The same at reference points (q, 1) inside all cells: (6, cells, q, 3)."""
        return _revolved(self._at(f, points))

    def scalars(self, f: fem.Function, points: Array = ENDS) -> Array:
        """The values of a field (1,) at the ends of all cells, or other reference points (q, 1): (cells, q)."""
        return self._at(f, points)[0, :, :, 0]

    @property
    def order(self) -> NDArray[np.int64]:
        """The cells along the meridian."""
        V = self._model.V
        return np.argsort(V.tabulate_dof_coordinates()[V.dofmap.list].mean(axis=1)[:, 0])

    def _at(self, f: fem.Function, points: Array) -> Array:
        """(3, cells, q, components) values, first and second derivatives at reference points (q, 1)."""
        V = f.function_space
        cells, bs = V.dofmap.list, V.dofmap.bs
        order = np.argsort(V.tabulate_dof_coordinates()[cells].mean(axis=1)[:, 0])
        table = V.element.basix_element.tabulate(2, points)[:, :, :, 0]
        return np.asarray(np.einsum("dvk,cki->dcvi", table, f.x.array.reshape(-1, bs)[cells[order]]))

    def around(self, ends: Array, weight: Array) -> Array:
        """Values at the nodes, of those at the ends of all cells.

        Parameters
        ----------
        ends
            Scalars (cells, 2), vectors (cells, 2, 3) or tensors (cells, 2, 3, 3) along (e_rho, e_theta, e_z).
        weight
            (cells, 2) of a cell's value in the mean over the two that meet.
        """
        at = self._means(ends, weight)
        circles = at[self._first :, None]
        if at.ndim == 1:
            circles = np.repeat(circles, len(self._basis), axis=1)
        elif at.ndim == 2:
            circles, at = (circles[:, :, None] @ self._basis)[:, :, 0], at * [0.0, 0.0, 1.0]
        else:
            circles = np.swapaxes(self._basis, 1, 2) @ circles @ self._basis
        return np.concatenate([at[: self._first], circles.reshape(-1, *at.shape[1:])])

    def _means(self, ends: Array, weight: Array) -> Array:
        """The weighted mean of the cells that meet at each circle, of values (cells, 2, ...) at their ends."""
        weight = weight.reshape(*weight.shape, *(1,) * (ends.ndim - 2))

        def sums(values: Array) -> Array:
            total = np.zeros((len(self._vertices), *values.shape[2:]))
            np.add.at(total, self.ends, values)
            return total

        return np.asarray(sums(weight * ends) / sums(weight))

    def _turned(self, nodal: Array) -> Array:
        """(rho, z) components at the meridian's nodes -> vectors at the pole and on the circles."""
        along = nodal[self._vertices]
        turning = along[self._first :, None]
        circles = turning[:, :, :1] * self._basis[:, 0] + turning[:, :, 1:] * self._basis[:, 2]
        pole = along[: self._first] * [0.0, 1.0]
        return np.concatenate([np.insert(pole, 1, 0.0, axis=1), circles.reshape(-1, 3)])

    def _triangles(self, sectors: int) -> NDArray[np.int64]:
        sector = np.arange(sectors)
        next_sector = (sector + 1) % sectors
        cap = np.column_stack([0 * sector, 1 + sector, 1 + next_sector])[: sectors * self._first]
        inner = self._first + sectors * (self.ends[self._first :, :1] - self._first)
        a, b, c, d = inner + sector, inner + next_sector, inner + sectors + sector, inner + sectors + next_sector
        bands = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, c, d), (a, d, b))]
        return np.concatenate([cap, *bands])


def _revolved(values: Array) -> Array:
    """Jets (6, cells, q, 3) along (e_rho, e_theta, e_z) from derivatives (3, cells, q, 2) along the meridian."""
    (U, W), (Us, Ws), (Uss, Wss) = np.moveaxis(values, -1, 1)
    o = np.zeros_like(U)
    jet = [(U, o, W), (Us, o, Ws), (o, U, o), (Uss, o, Wss), (o, Us, o), (-U, o, o)]
    return np.stack([np.stack(v, axis=-1) for v in jet])


def nodal_normals(r0: fem.Function) -> Array:
    """Unit normals (nodes, 3) at the azimuth 0, averaged over the cells that meet."""
    normals = np.zeros((len(r0.x.array) // 2, 3))
    np.add.at(normals, r0.function_space.dofmap.list, places(r0)[1])
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])
