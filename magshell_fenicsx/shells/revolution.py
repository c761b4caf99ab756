"""The surface that a meridian sweeps, as flat triangles for pictures and for ParaView.

In go a model on a meridian and fields on it, with components (U, W) along e_rho and e_z; out come
values at the nodes of the triangles. A circle is what one vertex of the meridian sweeps; a band
lies between the two circles of a cell. At a kink two circles are at one place, so that fields may
jump. Cells are counted along the meridian (`order`); a cell has two ends. A jet is a field's value
with its first and second derivatives. Lengths are over R.
"""

from collections.abc import Sequence

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import Vector
from magshell_fenicsx.models.shell.spatial_fields import positions_and_normals
from magshell_fenicsx.shells.meridian import MeridianModel

Array = NDArray[np.float64]
OFF_POLE = 1e-3  # distance from the pole, over the first cell
ENDS = np.array([[0.0], [1.0]])  # ends of the reference cell


class Revolution:
    """Surface that a meridian sweeps, as flat triangles.

    Each vertex of the meridian is turned into `sectors` equal angles, a circle of nodes; a pole is
    one node.

    Parameters
    ----------
    kinks
        Numbers of the cells along the meridian that share no circle of nodes with the one before,
        so that fields may jump there.

    Attributes
    ----------
    order
        Numbers of the cells, in their order along the meridian.
    ends
        (cells, 2) numbers of the circles at the ends of the cells along the meridian.
    r0, n0
        (n, 3) undeformed placement and unit normal, lengths in R.
    cells
        (m, 3) node numbers of triangles with the outer side up.
    _model
        The parameter `model`.
    _at_ends
        (2, circles) a cell that has each circle at an end, and this end's number, 0 or 1.
    _poles
        Mask of the circles that are one point on the axis.
    _basis
        (sectors, 3, 3) e_rho, e_theta and e_z at each sector, as rows.
    """

    def __init__(self, model: MeridianModel, sectors: int = 96, kinks: Sequence[int] = ()) -> None:
        """Number the circles and nodes of the swept surface; parameters are those of the class."""
        self._model, V = model, model.V
        self.order = order = model.meridian.order
        vertices = V.dofmap.list[order][:, :2]
        # a new circle begins where cells share no vertex, and at kinks
        is_apart = vertices[1:, 0] != vertices[:-1, 1]
        is_apart[np.asarray(kinks, dtype=np.int64) - 1] = True
        # circle at the begin of each cell: one further for each cell, two where cells are apart
        begin = np.arange(len(vertices)) + np.cumsum([0, *is_apart])
        self.ends = np.column_stack([begin, begin + 1])
        self._at_ends = np.empty((2, self.ends.max() + 1), dtype=np.int64)
        self._at_ends[0, self.ends] = np.arange(len(vertices))[:, None]
        self._at_ends[1, self.ends] = np.arange(2)
        # parameter of each circle, compared with those of the places on the axis
        s = model.meridian.cells[tuple(self._at_ends)]
        is_pole = np.isclose(s[:, None], model.meridian.poles).any(axis=1)
        self._poles = np.asarray(is_pole)
        theta = np.arange(sectors) * 2 * np.pi / sectors
        cos, sin, zero = np.cos(theta), np.sin(theta), 0 * theta
        basis = np.array([[cos, sin, zero], [-sin, cos, zero], [zero, zero, zero + 1]])
        self._basis = np.moveaxis(basis, -1, 0)
        normals = nodal_normals(model.r0)
        self.r0 = self._swept(model.r0.x.array.reshape(-1, 2))
        self.n0 = self._swept(normals[:, [0, 2]])
        self.cells = self._triangles(sectors)

    def displacement(self, u: Vector) -> Array:
        """Return the displacement (n, 3) of the nodes over R from a meridian's unknowns."""
        return self._swept(u.reshape(-1, 2))

    def jets(self, f: fem.Function) -> Array:
        """Return the jets (6, cells, 2, 3) of a field at both ends of all cells.

        `f` has components (U, W). Jets are the value and the first and second derivatives, along
        (e_rho, e_theta, e_z). At a pole the surface has no second direction, so the jet there is
        taken a little off it.
        """
        # at both ends, then a little within
        values = self._derivatives(f, np.array([[0.0], [1.0], [OFF_POLE], [1 - OFF_POLE]]))
        at_pole = self._poles[self.ends][..., None]
        return revolved(np.where(at_pole, values[:, :, 2:], values[:, :, :2]))

    def inner_jets(self, f: fem.Function, points: Array) -> Array:
        """Return the jets (6, cells, q, 3) of a field at reference points (q, 1) of all cells.

        `f` has components (U, W). Jets are the value and the first and second derivatives, along
        (e_rho, e_theta, e_z). No point may be on the axis.
        """
        return revolved(self._derivatives(f, points))

    def scalars(self, f: fem.Function, points: Array = ENDS) -> Array:
        """Return the values (cells, q) of a field (1,) at reference points (q, 1) of all cells."""
        return self._derivatives(f, points)[0, :, :, 0]

    def vertices(self, V: fem.FunctionSpace) -> NDArray[np.int64]:
        """Return for each circle the node of the space on the meridian that sweeps it."""
        cells, ends = self._at_ends
        return np.asarray(V.dofmap.list[self.order[cells], ends], dtype=np.int64)

    def at_nodes(self, circles: Array) -> Array:
        """Return values (n, ...) at the nodes from values (circles, sectors, ...) on all circles.

        A pole takes the value of its first sector.
        """
        # a pole is one node
        is_node = np.ones(circles.shape[:2], dtype=bool)
        is_node[self._poles, 1:] = False
        return np.asarray(circles[is_node])

    def _derivatives(self, f: fem.Function, points: Array) -> Array:
        """Return values and two derivatives of a field at reference points (q, 1) of all cells.

        The shape is (3, cells, q, components), in the order of cells along the meridian.
        """
        V = f.function_space
        nodes_of_cells, components = V.dofmap.list[self.order], V.dofmap.bs
        table = V.element.basix_element.tabulate(2, points)[:, :, :, 0]
        nodal_values = f.x.array.reshape(-1, components)[nodes_of_cells]
        return np.asarray(np.einsum("dvk,cki->dcvi", table, nodal_values))

    def on_parallels(self, ends: Array, weight: Array) -> Array:
        """Return values (n, ...) at the nodes from values at the ends of all cells.

        Parameters
        ----------
        ends
            Scalars (cells, 2), vectors (cells, 2, 3) or tensors (cells, 2, 3, 3) along (e_rho,
            e_theta, e_z).
        weight
            (cells, 2) weight of a cell's value in the mean over the two cells that meet.
        """
        means = self._means(ends, weight)  # one value for each circle
        circles = np.repeat(means[:, None], len(self._basis), axis=1)
        # from components along (e_rho, e_theta, e_z) to those in space, at each sector
        if means.ndim == 2:  # vectors
            circles = (circles[:, :, None] @ self._basis)[:, :, 0]
            circles[self._poles] *= [0.0, 0.0, 1.0]  # a pole has no direction but e_z
        elif means.ndim == 3:  # tensors
            circles = np.swapaxes(self._basis, 1, 2) @ circles @ self._basis
        return self.at_nodes(circles)

    def _means(self, ends: Array, weight: Array) -> Array:
        """Return the weighted mean, at each circle, of the cells that meet there: (circles, ...).

        `ends` are values (cells, 2, ...) at their ends, `weight` is (cells, 2).
        """
        weight = weight.reshape(*weight.shape, *(1,) * (ends.ndim - 2))  # one for all components

        def sums(values: Array) -> Array:
            """Return the sum of values (cells, 2, ...) at each circle."""
            total = np.zeros((len(self._poles), *values.shape[2:]))
            np.add.at(total, self.ends, values)
            return total

        return np.asarray(sums(weight * ends) / sums(weight))

    def _swept(self, nodal: Array) -> Array:
        """Return vectors (n, 3) at the nodes from (rho, z) components at the meridian's nodes."""
        components = nodal[self.vertices(self._model.V)]  # (circles, 2)
        # on the axis there is no component along e_rho
        components = np.where(self._poles[:, None], components * [0.0, 1.0], components)[:, None]
        # vectors (circles, sectors, 3)
        e_rho, e_z = self._basis[:, 0], self._basis[:, 2]
        return self.at_nodes(components[:, :, :1] * e_rho + components[:, :, 1:] * e_z)

    def _triangles(self, sectors: int) -> NDArray[np.int64]:
        """Return the node numbers (m, 3) of the triangles.

        There are two for each cell and sector, one beside a pole.
        """
        # number of the first node of each circle
        first = np.cumsum([0, *np.where(self._poles, 1, sectors)])
        sector = np.arange(sectors)
        # nodes (circles, sectors) at the begin and at the end of each sector
        nodes = np.where(self._poles[:, None], 0, sector) + first[:-1, None]
        next_nodes = np.roll(nodes, -1, axis=1)
        # corners (cells, sectors) of each quadrilateral: a, b at a cell's first end, c, d at its
        # last; b and d are in the next sector
        a, c = np.moveaxis(nodes[self.ends], 1, 0)
        b, d = np.moveaxis(next_nodes[self.ends], 1, 0)
        # a triangle with two corners at a pole is left out
        begins_off_axis, ends_off_axis = (~self._poles[circles] for circles in self.ends.T)
        bands = [(ends_off_axis, (a, c, d)), (begins_off_axis, (a, d, b))]
        return np.concatenate(
            [np.stack(corners, axis=-1)[is_kept].reshape(-1, 3) for is_kept, corners in bands]
        )


def revolved(values: Array) -> Array:
    """Return jets (6, cells, q, 3) of an axisymmetric field along (e_rho, e_theta, e_z).

    `values` are its value and derivatives (3, cells, q, 2) along the meridian.
    """
    (U, W), (Us, Ws), (Uss, Wss) = np.moveaxis(values, -1, 1)
    o = np.zeros_like(U)
    # value; derivatives by s and by theta; second derivatives by ss, by s theta, by theta theta
    jet = [(U, o, W), (Us, o, Ws), (o, U, o), (Uss, o, Wss), (o, Us, o), (-U, o, o)]
    return np.stack([np.stack(v, axis=-1) for v in jet])


def nodal_normals(r0: fem.Function) -> Array:
    """Return unit normals (nodes, 3) at the azimuth 0, averaged over the cells that meet."""
    sums = np.zeros((len(r0.x.array) // 2, 3))
    _, normals_of_cells = positions_and_normals(r0)  # at the nodes of each cell
    np.add.at(sums, r0.function_space.dofmap.list, normals_of_cells)
    return np.asarray(sums / np.linalg.norm(sums, axis=1)[:, None])
