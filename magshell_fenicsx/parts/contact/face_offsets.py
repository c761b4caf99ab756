"""Offsets of faces: how far they are from a mid-surface whose thickness varies or changes.

The offset H is half the thickness, continuous from cell to cell. At node k it is the undeformed
volume of the cells around, over their deformed area; between nodes it is the polynomial of these
values:

    H_k = (h/2) sum V / sum A,   V = t J0,   A = J where the shell keeps its volume, else J0,

with t h the undeformed thickness, J = |a_1 x a_2| of the cell at the node, and J0 this undeformed.
Of a shell that has grown V is the natural volume, a polynomial of the amplitude "natural_stretch".
The derivatives by the displacement and by this amplitude are exact. docs/theory.md, Contact.

- Half volumes are (h/2) sum V at a node. The thickness factor is t. The growth is the value of the
  amplitude.
- In shapes of arrays (cells, places) are values of each cell at its own nodes, and dofs are the
  3 * places components of its nodes.
- The images of a half or a sector are copies of its nodes. Copies at one place share one H.
- The unknowns of a node are its displacement.
- `by_...` is a derivative by the thing that is named; the slope of J is that by all dofs.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.assembly.free_parameters import SettableNumber
from magshell_fenicsx.assembly.nonlocal_terms import Entries
from magshell_fenicsx.parts.contact.projection import Longs

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _AreaVectors:
    """Area vectors a_1 x a_2 of some cells at their nodes.

    Attributes
    ----------
    J
        (cells, places) their lengths.
    normal
        (cells, places, 3) their directions.
    by_node
        (cells, places, 3 nodes, 3) derivatives of a_1 x a_2 by the components of all nodes.
    """

    J: Array
    normal: Array
    by_node: Array

    @property
    def slope(self) -> Array:
        """The derivatives (cells, places, 3 nodes) of J."""
        return np.asarray(np.einsum("cqmi,cqi->cqm", self.by_node, self.normal))


class CellsWithNodes(Protocol):
    """Cells with a basix element, and (cells, functions) the numbers of their nodes."""

    @property
    def element(self) -> Any: ...
    @property
    def nodes(self) -> Longs: ...


class FaceOffsets:
    """Half the thickness H at all nodes of a mid-surface, over R, with its derivatives.

    Parameters
    ----------
    cells
        All cells with their element.
    r0
        (nodes, 3) undeformed places over R.
    h
        Thickness over R.
    volume_factors
        (powers, cells, functions) V over J0 at the nodes of each cell, by powers of the amplitude.
        Without growth it is the thickness factor t.
    keeps_volume
        (cells,) whether the thickness follows from the area.
    same_place
        (nodes,) for each node the first node at its place: images share the nodes on their planes.
    amplitude
        The natural stretch, on which V depends; None without.

    Attributes
    ----------
    undeformed_half_thickness
        (nodes,) over R, before anything grows.

    The field `_same_place` is the parameter `same_place`; `_place_numbers` (cells, functions) has
    for each node of each cell the node that stands for all copies at its place. `_thinning_cells`
    are the numbers of the cells that keep their volume. `_volume_coefficients` (powers, nodes) are
    (h/2) sum V at nodes by powers of the growth; `_fixed_area` (nodes,) is the part of sum A that
    does not change. `_thickness_factor` (cells, functions) is t. `_volume_per_factor` (powers,
    cells, functions) is (h/2) V over t J0, by powers of the growth.
    """

    def __init__(
        self,
        cells: CellsWithNodes,
        r0: Array,
        h: float,
        volume_factors: Array,
        keeps_volume: NDArray[np.bool_],
        same_place: Longs,
        amplitude: SettableNumber | None = None,
    ) -> None:
        """Sum the volumes and the undeformed areas at nodes."""
        self._cells, self._r0, self._keeps_volume = cells, r0, keeps_volume
        self._thinning_cells = np.flatnonzero(keeps_volume)
        self._same_place, self.amplitude = same_place, amplitude
        self._place_numbers = same_place[cells.nodes]  # of each cell's nodes, one for all copies
        self._components = r0.shape[1]  # of a displacement
        all_cells = slice(None)
        J0 = self._areas(r0, all_cells)
        volumes = [self._sum_at_nodes(all_cells, factor * J0) for factor in volume_factors]
        self._volume_coefficients = h / 2 * np.array(volumes)
        self._thickness_factor = volume_factors[0]  # t: the power zero, without growth
        self._volume_per_factor = h / 2 * volume_factors / volume_factors[0]
        self._fixed_area = self._sum_at_nodes(~keeps_volume, J0[~keeps_volume])
        # the volumes without growth, which are those of the power zero, over undeformed areas
        self.undeformed_half_thickness = np.asarray(
            self._volume_coefficients[0] / self._sum_at_nodes(all_cells, J0)
        )

    @property
    def is_constant(self) -> bool:
        """Whether the thickness does not depend on the displacement."""
        return not len(self._thinning_cells)

    @property
    def growth(self) -> float:
        """The present value of the natural stretch; 0 without."""
        return float(self.amplitude.value) if self.amplitude is not None else 0.0

    def half_thickness(self, u: Array) -> Array:
        """Return H (nodes,) over R at a displacement (nodes, 3)."""
        return np.asarray(self._half_volumes() / self._areas_at_nodes(u))

    def growth_derivative(self, u: Array, order: int = 1) -> Array:
        """Return the derivative (nodes,) of H by the natural stretch, of some order, at u.

        The areas do not depend on the stretch, so it is that of the half volumes over the areas.
        """
        return np.asarray(self._half_volumes(order) / self._areas_at_nodes(u))

    def slope(self, u: Array, f: Array) -> Array:
        """Return the gradient (nodes, 3) by u (nodes, 3) of the sum of f H over nodes.

        The weights f are (nodes,).
        """
        if self.is_constant:
            return np.zeros_like(u)
        jacobian = self.jacobian(u, is_needed=f != 0)
        return np.asarray((jacobian.T @ f).reshape(len(u), -1))

    def jacobian(self, u: Array, is_needed: NDArray[np.bool_]) -> Any:
        """Return the sparse derivative (nodes, 3 nodes) of H by the displacement u (nodes, 3).

        Rows of nodes that are not needed, by the flags (nodes,), are zero. As H = V/A with a fixed
        V, the derivative is -V/A^2 times that of A.
        """
        area = self._areas_at_nodes(u)
        return scipy.sparse.diags_array(
            np.where(is_needed, -self._half_volumes() / area**2, 0.0)
        ) @ self._area_jacobian(u, is_needed)

    def change(self, u: Array, w: Array) -> Array:
        """Return the derivative (nodes,) of H at u along a motion w (nodes, 3)."""
        if self.is_constant:
            return 0 * u[:, 0]
        return np.asarray(self.jacobian(u, np.ones(len(u), dtype=bool)) @ w.ravel())

    def volumes_and_areas(self, u: Array) -> tuple[Array, Array]:
        """Return (h/2) sum V and sum A at nodes (nodes,), whose ratio is H, at u (nodes, 3)."""
        return self._half_volumes(), self._areas_at_nodes(u)

    def by_factor(self, by_volume: Array) -> Array:
        """Return derivatives (cells, functions) of a function by t at the nodes of each cell.

        t is the thickness factor, and V is proportional to it: so the result is the derivative by
        (h/2) V, times (h/2) V/t.

        Parameters
        ----------
        by_volume
            (nodes,) derivatives of the function by the half volumes (h/2) sum V at nodes.
        """
        # copies of a node share its volume, so their derivatives are added
        by_place_volume = np.bincount(self._same_place, by_volume, len(by_volume))[
            self._place_numbers
        ]
        # (h/2) V over t J0 at the present growth
        volume_per_factor = np.polynomial.polynomial.polyval(self.growth, self._volume_per_factor)
        return np.asarray(by_place_volume * volume_per_factor * self._areas(self._r0, slice(None)))

    def by_area(self, by_volume: Array, by_area: Array) -> Array:
        """Return derivatives (nodes, 3) of a function by undeformed places, through the areas J0.

        J0 is in the volumes V, and in the areas A of cells that do not keep their volume. The
        deformed areas J also depend on the undeformed place, in the same way as on u: the caller
        adds that part as a derivative by u.

        Parameters
        ----------
        by_volume, by_area
            (nodes,) derivatives of the function by the half volumes and by the areas at nodes.
        """
        # (cells, functions): copies of a node share volume and area, so derivatives are added
        by_place_volume, by_place_area = (
            np.bincount(self._same_place, f, len(f))[self._place_numbers]
            for f in (by_volume, by_area)
        )
        # derivatives by J0 of each cell: (h/2) V is volume_per_factor times t J0, and A is J0 where
        # the cell does not keep its volume
        volume_per_factor = np.polynomial.polynomial.polyval(self.growth, self._volume_per_factor)
        by_J0 = by_place_volume * volume_per_factor * self._thickness_factor
        by_J0 += by_place_area * ~self._keeps_volume[:, None]
        # derivatives by places, in the cells where those by J0 are not zero; at the displacement
        # zero J is J0
        loaded_cells = np.flatnonzero((by_J0 != 0).any(axis=1))
        forces = np.zeros(self._r0.size)
        by_place = np.einsum(
            "cq,cqm->cm", by_J0[loaded_cells], self._area_slopes(0 * self._r0, loaded_cells)
        )
        np.add.at(forces, self._unknowns_of_cells(loaded_cells), by_place)
        return forces.reshape(self._r0.shape)

    def slope_by_growth(self, u: Array, f: Array) -> Array:
        """Return the gradient (nodes, 3) of sum f H_g by u, with H_g = dH/d(natural stretch).

        The weights f are (nodes,), the displacement u (nodes, 3). As H_g = V_g/A, the gradient is
        the sum of -f V_g/A^2 A,u.
        """
        weight = -f * self._half_volumes(1) / self._areas_at_nodes(u) ** 2
        return np.asarray((self._area_jacobian(u, f != 0).T @ weight).reshape(len(u), -1))

    def hessian(self, u: Array, f: Array) -> Any:
        """Return the sparse Hessian (3 nodes, 3 nodes) by u of the sum of f H over nodes.

        The weights f are (nodes,). As H = V/A at each node, it is the sum of f (2 V/A^3) A,u A,u
        and of -f V/A^2 times the Hessian of A.
        """
        loaded_cells, areas = self._cells_around(f != 0), self._areas_at_nodes(u)
        area_jacobian = self._area_jacobian(u, f != 0)
        weight = -f * self._half_volumes() / areas**2
        # the products A,u A,u with their factor f 2 V/A^3
        of_slopes = area_jacobian.T @ scipy.sparse.diags_array(-2 * weight / areas) @ area_jacobian
        # the Hessian of A: a block for each cell, where copies of a node have the sum of weights
        weight_of_places = np.bincount(self._same_place, weight, len(weight)).astype(float)
        weight_in_cells = weight_of_places[self._place_numbers[loaded_cells]]
        H = self._area_hessians(u, loaded_cells, weight_in_cells)
        dofs = self._unknowns_of_cells(loaded_cells)
        rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
        blocks = H.ravel(), (rows.ravel(), columns.ravel())
        return of_slopes + scipy.sparse.coo_array(blocks, of_slopes.shape).tocsr()

    def entries(self, u: Array, entries: Entries, f: Array) -> Entries:
        """Return the entries of a second derivative by the displacement u alone.

        The given entries are those of K, the second derivative by places and by offsets H of
        nodes: two kinds of unknowns. With the derivative T of both by u, the result is T^T K T plus
        the Hessian of sum f H (the chain rule).

        Parameters
        ----------
        u
            (nodes, 3) displacement over R.
        entries
            Rows, columns and values of K. The components of all places have the first numbers, then
            come the offsets, one for each node.
        f
            (nodes,) the first derivative of the energy by H.
        """
        rows, columns, values = entries
        place_count = self._components * len(f)
        size = place_count + len(f)
        if self.is_constant:  # H does not depend on u: entries by places remain
            is_of_places = (rows < place_count) & (columns < place_count)
            return rows[is_of_places], columns[is_of_places], values[is_of_places]
        # only offsets that have entries need a derivative
        has_entries = np.zeros(size, dtype=bool)
        has_entries[rows] = True
        # T: of places it is the identity, below which the rows of offsets follow
        T = scipy.sparse.vstack(
            [scipy.sparse.eye_array(place_count), self.jacobian(u, has_entries[place_count:])]
        ).tocsr()
        K = scipy.sparse.coo_array((values, (rows, columns)), (size, size)).tocsr()
        i, j, v = scipy.sparse.find(T.T @ K @ T + self.hessian(u, f))
        return i.astype(np.int64), j.astype(np.int64), v

    def coupled_pairs(self, rows: Longs, columns: Longs) -> tuple[Longs, Longs]:
        """Return the pairs of nodes whose displacements are coupled in the tangent matrix.

        H at a node depends on the displacement of all nodes of the cells around. So where places
        and offsets of two nodes are coupled, the displacements of all nodes around the one are
        coupled with those of all nodes around the other.

        Parameters
        ----------
        rows, columns
            Pairs (n,) of nodes whose places and offsets are coupled.

        Returns
        -------
        rows, columns
            Pairs (m,) of nodes whose displacements are coupled.
        """
        if self.is_constant:
            return rows, columns
        places, count = self._place_numbers, len(self._r0)
        # sparse flags: at which place a node is, and which places and nodes a cell has
        cell_rows = np.repeat(np.arange(len(places)), places.shape[1])
        has_place = _sparse_flags(np.arange(count), self._same_place, (count, count))
        cell_has_place = _sparse_flags(cell_rows, places.ravel(), (len(places), count))
        cell_has_node = _sparse_flags(cell_rows, self._cells.nodes.ravel(), (len(places), count))
        # (nodes, nodes), not zero where the place or H of the first node depends on the
        # displacement of the second: that is itself, or a node of the cells around its place
        depends_on = scipy.sparse.eye_array(count) + has_place @ cell_has_place.T @ cell_has_node
        couplings = _sparse_flags(rows, columns, (count, count))
        i, j = (depends_on.T @ couplings @ depends_on).nonzero()
        return i.astype(np.int64), j.astype(np.int64)

    def _half_volumes(self, order: int = 0) -> Array:
        """Return (h/2) sum V (nodes,), or its derivative of an order by the natural stretch."""
        powers = np.polynomial.polynomial  # NumPy's functions of ascending powers
        coefficients = powers.polyder(self._volume_coefficients, order)
        return np.asarray(powers.polyval(self.growth, coefficients))

    def _areas_at_nodes(self, u: Array) -> Array:
        """Return the sums of A (nodes,) over the cells around nodes, at u (nodes, 3)."""
        return self._fixed_area + self._sum_at_nodes(
            self._thinning_cells, self._areas(self._r0 + u, self._thinning_cells)
        )

    def _sum_at_nodes(self, cells: Any, values: Array) -> Array:
        """Return sums (nodes,) over the cells around each node, all copies of it included.

        Parameters
        ----------
        cells
            Numbers or flags of the cells that count, or a slice.
        values
            (cells, functions) values of these cells at their nodes.
        """
        sums = np.bincount(self._place_numbers[cells].ravel(), values.ravel(), len(self._r0))
        return np.asarray(sums[self._same_place], dtype=float)

    def _cells_around(self, is_needed: NDArray[np.bool_]) -> Longs:
        """Return the numbers of cells that keep their volume and have a needed node.

        The flags are (nodes,). A node stands for all copies at its place.
        """
        needs_place = np.bincount(self._same_place, is_needed, len(is_needed)) > 0
        return np.flatnonzero(needs_place[self._place_numbers].any(axis=1) & self._keeps_volume)

    def _area_jacobian(self, u: Array, is_needed: NDArray[np.bool_]) -> Any:
        """Return sparse derivatives (nodes, 3 nodes) by u of the areas at nodes.

        Rows of nodes that are not needed, by the flags (nodes,), may lack terms.
        """
        cells = self._cells_around(is_needed)
        slope, places = self._area_slopes(u, cells), self._place_numbers[cells]
        # (cells, places, dofs): the area at each place by all displacements of the cell
        rows, columns = np.broadcast_arrays(
            places[:, :, None], self._unknowns_of_cells(cells)[:, None, :]
        )
        shape = len(self._r0), self._components * len(self._r0)
        entries = slope.ravel(), (rows.ravel(), columns.ravel())
        by_place = scipy.sparse.coo_array(entries, shape).tocsr()
        return by_place[self._same_place]  # each copy of a node has the row of its place

    def _unknowns_of_cells(self, cells: Longs) -> Longs:
        """Return numbers (n, dofs) of the displacement's unknowns in n cells."""
        return unknown_numbers(
            self._cells.nodes[cells],
            count=len(self._r0),
            components=self._components,
            dim=self._components,
        )

    @cached_property
    def _slope_table(self) -> Array:
        """The derivatives (2, places, functions) of shape functions at the nodes."""
        return np.asarray(self._cells.element.tabulate(1, self._cells.element.points)[1:, :, :, 0])

    def _areas(self, r: Array, cells: Any) -> Array:
        """Return the areas J (cells, places) at the nodes of cells, at places r (nodes, 3)."""
        a1, a2 = np.einsum("dqk,cki->dcqi", self._slope_table, r[self._cells.nodes[cells]])
        return np.asarray(np.linalg.norm(np.cross(a1, a2), axis=-1))

    def _area_slopes(self, u: Array, cells: Longs) -> Array:
        """Return derivatives (cells, places, dofs) of areas by the unknowns of their cells."""
        return self._area_vectors(u, cells).slope

    def _area_hessians(self, u: Array, cells: Longs, w: Array) -> Array:
        """Return Hessians (cells, dofs, dofs) of the sums of w J over each cell's nodes.

        J is the length of the area vector a = a_1 x a_2, n its direction. Its Hessian is
        (a,u . a,u - J,u J,u)/J + n . a,uu, where a,uu is antisymmetric in the components of nodes.

        Parameters
        ----------
        u, w
            (nodes, 3) displacement, and weights (cells, places).
        """
        vectors = self._area_vectors(u, cells)
        by_node, slope = vectors.by_node, vectors.slope
        # a,u . a,u and J,u J,u: sums over the places q of a cell, by its unknowns m and n
        H = np.einsum("cqmi,cqni->cmn", by_node * (w / vectors.J)[..., None, None], by_node)
        H -= np.einsum("cqm,cqn->cmn", slope * (w / vectors.J)[..., None], slope)
        # n . a,uu: the second derivative of a by component i of node m and component j of node n is
        # along e_k, with the factor N_m,1 N_n,2 - N_n,1 N_m,2 of shape functions
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # even permutations
            twist = np.einsum("cq,qm,qn->cmn", w * vectors.normal[..., k], *self._slope_table)
            twist -= np.swapaxes(twist, 1, 2)
            H[:, i::3, j::3] += twist
            H[:, j::3, i::3] -= twist
        return np.asarray(H)

    def _area_vectors(self, u: Array, cells: Longs) -> _AreaVectors:
        """Return the area vectors of cells at their nodes, with derivatives, at u (nodes, 3)."""
        a1, a2 = np.einsum(
            "dqk,cki->dcqi", self._slope_table, (self._r0 + u)[self._cells.nodes[cells]]
        )
        area_vectors = np.cross(a1, a2)
        J = np.linalg.norm(area_vectors, axis=-1)
        # where a node moves along e, with its shape function N, a_1 x a_2 changes by
        # e x (N,1 a_2 - N,2 a_1)
        slopes1, slopes2 = self._slope_table[..., None]
        factors = slopes1 * a2[:, :, None] - slopes2 * a1[:, :, None]
        by_node = np.cross(np.eye(3), factors[..., None, :])
        by_unknowns = by_node.reshape(*J.shape, 3 * J.shape[1], 3)
        return _AreaVectors(J, area_vectors / J[..., None], by_unknowns)


def _sparse_flags(rows: Longs, columns: Longs, shape: tuple[int, int]) -> Any:
    """Return a sparse matrix that is not zero at the given entries."""
    return scipy.sparse.coo_array((np.ones(len(rows)), (rows, columns)), shape).tocsr()


def unknown_numbers(nodes: Longs, count: int, components: int = 3, dim: int = 3) -> Longs:
    """Return the numbers (n, components * functions) of the unknowns at nodes (n, functions).

    In the numbering of all unknowns the components of places come first, `dim` for each of `count`
    nodes. The offsets H come after all of them, one for each node. The result has the offsets if
    `components` is dim + 1.
    """
    of_place = dim * nodes[:, :, None] + np.arange(dim)
    of_offset = dim * count + nodes[:, :, None]
    dofs = np.concatenate([of_place, of_offset], axis=2)[..., :components]
    return np.asarray(dofs.reshape(len(nodes), components * nodes.shape[1]))
