"""Recovery of strains, moments and stresses at nodes, in the smooth parts of a surface.

A polynomial is fitted to samples in the patch of cells around each vertex, as in the
superconvergent patch recovery of Zienkiewicz and Zhu. A surface is split into smooth parts, within
which prescribed fields and the normal are continuous. Each part is recovered on its own.

Samples are quadrature points inside cells. A vertex is at an edge if a cell's side there has no
neighbour; the first ring of cells around it are its own cells, the second ring those that share a
vertex with them. The patch of a vertex has the cells whose samples its polynomial is fitted to.

Shapes: m cells, q samples in each, v vertices, n nodes, d coordinates on a surface (1 on a
meridian, 2 on a shell), k coordinates of a place. A frame has unit vectors as rows, d of them in
the tangent plane. E and M are membrane strain and bending moment. Tensors in space are symmetric
matrices (3, 3), or their six different components, each times the root of how often it stands in
the matrix: so the sum of the six squares is that of all nine (`COMPONENT_WEIGHTS`).
"""

from collections.abc import Mapping

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.polynomial_fit import exponents, monomials, polynomial_fits
from magshell_fenicsx.models.shell.strains import TangentFrame
from magshell_fenicsx.output.fields.point_fields import in_frame, in_space, principal_fields

Array = NDArray[np.float64]
ROUNDING = {"E": 1e-13, "M": 1e-8}  # strains, moments over D/R: smaller ones are zero


def relative_jump(values: Array, continuous: Array, weight: Array, zero: float = 0.0) -> float:
    """Return the jump of values between cells, as an error relative to a continuous field.

    It is the weighted rms of `values - continuous` over the weighted rms of `values`.

    Parameters
    ----------
    values, continuous
        (cells, points, ...)
    weight
        (cells, points)
    zero
        Size of values up to which the jump is zero.

    Examples
    --------
    >>> values = np.array([[3.0, 5.0], [3.0, 5.0]])
    >>> round(relative_jump(values, np.full((2, 2), 4.0), np.ones((2, 2))), 3)
    0.243
    """

    def mean_square(f: Array) -> float:
        """Return the weighted mean of f squared; further axes are components, which are summed."""
        squared = (f**2).reshape(*weight.shape, -1).sum(axis=-1)
        return float((weight * squared).sum() / weight.sum())

    rms = np.sqrt(mean_square(values))
    return float(np.sqrt(mean_square(values - continuous)) / rms) if rms > zero else 0.0


Numbers = NDArray[np.int64]
# weight of the second ring of cells around a vertex at an edge, where the first ring has few
SECOND_RING_WEIGHT = 0.03


class Recovery:
    """Piecewise polynomial fitted to samples: one around each vertex, blended in the cells.

    The blend weights are the barycentric coordinates in a cell. So the result is continuous where
    cells share vertices, and polynomials are reproduced. Around a vertex at an edge the second ring
    of cells also counts, with a small weight.

    Parameters
    ----------
    cells
        (m, d + 1) numbers of vertices, all of 0, 1, ...; cells of two smooth parts share none.
    samples, weight
        (m, q, k) places of the samples in each cell, and (m, q) their weights.
    vertices
        (v, k) places.
    frames
        (v, d, k) axes of the polynomial's d coordinates around each vertex.
    degree
        Degree of the polynomials.

    `_patch_size` (v,) has the extent of each vertex's patch, by which coordinates are divided.
    `_coefficient_count` is the number of coefficients of a polynomial. `_coefficients` is the
    sparse matrix from samples to the coefficients of all polynomials, vertex after vertex.
    """

    def __init__(
        self,
        cells: Numbers,
        samples: Array,
        weight: Array,
        vertices: Array,
        frames: Array,
        degree: int,
    ) -> None:
        """Set the sparse matrix from samples to the coefficients of all polynomials.

        A row of the matrix belongs to one coefficient of one vertex; its columns are the samples
        around that vertex. The matrix is filled directly in the form of `scipy.sparse.csr_matrix`:
        `values` and `columns` of all entries, row after row, and `starts`, where each row begins.
        """
        self._cells, self._vertices, self._frames, self._degree = cells, vertices, frames, degree
        self._coefficient_count = count = len(exponents(cells.shape[1] - 1, degree))
        self._patch_size = np.ones(len(vertices))  # set by the fits below
        samples_per_cell = weight.shape[1]
        # the cells around each vertex as a sparse pattern (v, m), and the weight of each entry
        patches, cell_weights = _patches(cells, len(vertices))
        cells_per_vertex = np.diff(patches.indptr)
        # a row for each coefficient of each vertex
        row_lengths = np.repeat(cells_per_vertex * samples_per_cell, count)
        starts = np.concatenate([[0], np.cumsum(row_lengths)])
        columns, values = np.zeros(starts[-1], np.int32), np.zeros(starts[-1])
        # vertices with equally many cells are fitted together, in one array
        for cell_count in np.unique(cells_per_vertex):
            vertices_alike = np.flatnonzero(cells_per_vertex == cell_count)
            patch_entries = patches.indptr[vertices_alike][:, None] + np.arange(cell_count)
            cells_around = patches.indices[patch_entries]  # (vertices, cells of each)
            sample_weights = weight[cells_around] * cell_weights[patch_entries][..., None]
            # (vertices, coefficients, samples): from values to coefficients
            fit_matrices = self._fit_matrices(vertices_alike, samples[cells_around], sample_weights)
            fits = fit_matrices.reshape(len(vertices_alike), -1)
            # (vertices, samples): the numbers of the samples around each vertex
            sample_numbers = _members(cells_around, samples_per_cell)
            sample_numbers = sample_numbers.reshape(len(vertices_alike), -1)
            # the rows of a vertex follow one another in `values` and `columns`
            first_entries = starts[vertices_alike * count][:, None]
            entries = first_entries + np.arange(count * sample_numbers[0].size)
            columns[entries] = np.tile(sample_numbers, count)
            # a polynomial of lower degree has fewer rows; the values of the others stay zero
            values[entries[:, : fit_matrices[0].size]] = fits
        shape = len(vertices) * count, weight.size
        self._coefficients = scipy.sparse.csr_matrix((values, columns, starts), shape)

    def coefficients(self, values: Array) -> Array:
        """Return the coefficients of all polynomials, from values at the samples.

        Parameters
        ----------
        values
            (m, q, ...) values in each cell.

        Returns
        -------
        (v c, ...) with c coefficients for each of the v vertices; further axes are made one.
        """
        return np.asarray(self._coefficients @ values.reshape(self._coefficients.shape[1], -1))

    def evaluation_matrix(
        self, cell: Numbers, places: Array, barycentric: Array
    ) -> "scipy.sparse.csr_matrix":
        """Return the sparse matrix from coefficients to values at places in the cells.

        Parameters
        ----------
        cell
            (n,) numbers of the cells.
        places
            (n, k) places in them.
        barycentric
            (n, d + 1) their barycentric coordinates.
        """
        # a row has an entry for each coefficient of each vertex of the cell
        vertices_of_cells = self._cells[cell]  # (n, d + 1)
        local_coordinates = np.einsum(
            "nvdk,nvk->nvd",
            self._frames[vertices_of_cells],
            places[:, None] - self._vertices[vertices_of_cells],
        )
        scaled_coordinates = local_coordinates / self._patch_size[vertices_of_cells][..., None]
        # monomials at the place, times the blend weight of the vertex
        values = monomials(scaled_coordinates, self._degree) * barycentric[..., None]
        columns = _members(vertices_of_cells, self._coefficient_count)  # numbers of coefficients
        starts = np.arange(len(cell) + 1) * columns[0].size  # where each row begins
        return scipy.sparse.csr_matrix(
            (values.ravel(), columns.ravel(), starts),
            (len(cell), len(self._vertices) * self._coefficient_count),
        )

    def _fit_matrices(self, vertex: Numbers, samples: Array, weight: Array) -> Array:
        """Return the least-squares fits around vertices, and set the sizes of their patches.

        Parameters
        ----------
        vertex
            (n,) numbers of vertices with equally many cells.
        samples, weight
            (n, cells, q, k) places and (n, cells, q) weights of the samples around them.

        Returns
        -------
        Matrices (n, coefficients, samples) from values to coefficients.
        """
        n = len(vertex)
        offsets = samples.reshape(n, -1, samples.shape[-1]) - self._vertices[vertex][:, None]
        local_coordinates = offsets @ np.swapaxes(self._frames[vertex], 1, 2)
        fits, self._patch_size[vertex] = polynomial_fits(
            local_coordinates, weight.reshape(n, -1), self._degree
        )
        return fits


def _members(groups: Numbers, group_size: int) -> Numbers:
    """Return the numbers (..., group_size) of the members of groups, numbered group after group.

    A group is a cell with its samples, or a vertex with its coefficients. Of three members each,
    group 2 has the members 6, 7 and 8.
    """
    return np.asarray(groups[..., None] * group_size + np.arange(group_size))


def _patches(cells: Numbers, count: int) -> tuple["scipy.sparse.csr_matrix", Array]:
    """Return the cells around each vertex, and their weights.

    Parameters
    ----------
    cells
        (m, d + 1) numbers of vertices.
    count
        Number v of vertices.

    Returns
    -------
    patches
        Sparse pattern (v, m) of the first ring of cells around each vertex. For a vertex at an edge
        it also has the second ring.
    weights
        (entries,) weight of each entry, in the order of `patches.indices`.
    """
    m, corners = cells.shape
    first_ring = scipy.sparse.csr_matrix(
        (np.ones(cells.size), (cells.ravel(), np.repeat(np.arange(m), corners))), (count, m)
    )
    # a side has all vertices of a cell but one; a side of a single cell is at an edge
    sides = np.concatenate([np.delete(cells, i, axis=1) for i in range(corners)])
    sides, cells_per_side = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    is_at_edge = np.zeros(count)
    is_at_edge[sides[cells_per_side == 1]] = 1.0
    # cells that share a vertex with the first ring, around vertices at an edge alone
    second_ring = scipy.sparse.diags(is_at_edge) @ (first_ring @ (first_ring.T @ first_ring))
    second_ring.data[:] = SECOND_RING_WEIGHT  # in place of numbers of shared vertices
    patches = (first_ring + second_ring).tocsr()
    # entries of the first ring are at least one
    return patches, np.where(patches.data > SECOND_RING_WEIGHT, 1.0, SECOND_RING_WEIGHT)


SYMMETRIC_COMPONENTS = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])  # indices of a symmetric tensor
COMPONENT_NUMBERS = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]  # (3, 3) numbers of its six components
COMPONENT_WEIGHTS = np.sqrt([1.0, 2, 2, 1, 2, 1])  # the sum of six squares is that of all nine


class RecoveredShell:
    """Recover tensors at the nodes of a shell from samples in its cells.

    Parameters
    ----------
    numbers
        (m, s) nodes of all cells, corners first; cells of two smooth parts share none.
    reference
        (s, 2) places of a cell's nodes in the reference triangle.
    nodes, normals
        (m, s, 3) places and undeformed normals at the nodes.
    samples, weight
        (m, q, 3) places of the samples, and (m, q) their weights.
    table
        (q, s) values of the nodes' shape functions at the samples.
    degree
        Degree of the displacement, and of the polynomials that are fitted.

    The field `_recovery` fits polynomials around vertices, and `_to_nodes` is the matrix from their
    coefficients to values at the nodes (n,). `_numbers`, `_weight` and `_table` are the parameters.
    """

    def __init__(
        self,
        numbers: NDArray[np.int64],
        reference: Array,
        nodes: Array,
        normals: Array,
        samples: Array,
        weight: Array,
        table: Array,
        degree: int,
    ) -> None:
        """Set the recovery around the vertices, and its evaluation at all nodes.

        Vertices are the corners of cells, renumbered; the normal at a vertex is the sum of the
        cells' normals there.
        """
        # the first three nodes of a cell are its corners: (m, 3) numbers of vertices
        vertices, corners = np.unique(numbers[:, :3], return_inverse=True)
        corners = corners.reshape(-1, 3)
        vertex_places, vertex_normals = np.zeros((2, len(vertices), 3))
        vertex_places[corners] = nodes[:, :3]
        np.add.at(vertex_normals, corners, normals[:, :3])
        self._recovery = Recovery(
            corners, samples, weight, vertex_places, frames_across(vertex_normals), degree
        )
        # each node is evaluated once, in the first cell that has it; `node_in_cell` is its number
        # in that cell
        _, first_entry = np.unique(numbers, return_index=True)
        cell, node_in_cell = np.divmod(first_entry, numbers.shape[1])
        barycentric = np.column_stack([1 - reference.sum(axis=1), reference])[node_in_cell]
        self._to_nodes = self._recovery.evaluation_matrix(
            cell, nodes[cell, node_in_cell], barycentric
        )
        self._numbers, self._weight, self._table = numbers, weight, table

    def fields(
        self, tensors: Mapping[str, Array], n0: Array
    ) -> tuple[dict[str, Array], dict[str, float]]:
        """Return recovered tensors with their principal values, and the jumps of the samples.

        Tensors are projected onto the tangent planes of the nodes.

        Parameters
        ----------
        tensors
            Name, such as "E" and "M" -> (m, q, 6) components in space at the samples, times
            `COMPONENT_WEIGHTS`.
        n0
            (n, 3) normals at the nodes.

        Returns
        -------
        fields
            Name -> (n, 3, 3) E, M, ..., and (n,) E_1, E_2, ....
        jumps
            "E" and "M" -> rms of the samples' difference from the recovered field, over their rms.
        """
        # all tensors are fitted together, side by side, and then split again
        coefficients = self._recovery.coefficients(np.concatenate(list(tensors.values()), axis=-1))
        values_at_nodes = np.split(self._to_nodes @ coefficients, len(tensors), axis=-1)
        at_nodes = dict(zip(tensors, values_at_nodes, strict=True))
        jumps = {}
        for name, zero in ROUNDING.items():
            smooth_at_samples = self._table @ at_nodes[name][self._numbers]
            jumps[name] = relative_jump(tensors[name], smooth_at_samples, self._weight, zero)
        # from weighted components to tensors (n, 3, 3), then to components 11, 12, 22 in tangent
        # frames t, which projects them
        t = frames_across(n0)
        components = {
            name: in_frame((values / COMPONENT_WEIGHTS)[..., COMPONENT_NUMBERS], t)
            for name, values in at_nodes.items()
        }
        recovered = {name: in_space(S, t) for name, S in components.items()}
        return recovered | principal_fields(components), jumps


def components_in_space(frame: TangentFrame) -> Array:
    """Return the linear map from S_11, S_12, S_22 in a tangent frame to components in space.

    Returns
    -------
    (..., 6, 3) matrices; the six components are those at `SYMMETRIC_COMPONENTS`, times
    `COMPONENT_WEIGHTS`.
    """
    return np.asarray(frame.in_space[..., *SYMMETRIC_COMPONENTS, :] * COMPONENT_WEIGHTS[:, None])


def frames_across(normals: Array) -> Array:
    """Return two orthogonal unit vectors (n, 2, 3) across each of n vectors (n, 3).

    The first is across e1 too, or across e2 where the vector is nearly along e1.
    """
    n = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    t1 = np.cross(n, np.where(np.abs(n[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    t1 /= np.linalg.norm(t1, axis=-1, keepdims=True)
    return np.stack([t1, np.cross(n, t1)], axis=1)


FIELD_JUMP = 1e-3  # jump of a prescribed field over its largest value, that splits the surface
KINK = 0.5  # jump of the unit normal that splits the surface, some 30 degrees: less is a facet


def smooth_parts(
    corners: Numbers, sides: Numbers, prescribed_fields: list[Array], normals: Array
) -> Numbers:
    """Return (m,) the number of the smooth part to which each cell belongs.

    Two neighbours are in one part if neither a prescribed field nor the normal jumps at their
    common side. A part has all cells that such sides connect.

    Parameters
    ----------
    corners
        (m, s) numbers of the nodes of the cells.
    sides
        (e, j) which of these nodes are on each side.
    prescribed_fields
        Fields (m, s, ...) at the nodes.
    normals
        (m, s, 3) unit normals at the nodes.
    """
    count = len(corners)
    # a side of two cells is listed twice, once with each cell
    nodes_of_sides = corners[:, sides].reshape(-1, sides.shape[1])  # cell after cell
    # sorted node numbers identify a side from both of its cells: pairs of rows of one side
    order = np.argsort(nodes_of_sides, axis=1)
    shared_sides = _equal_rows(np.take_along_axis(nodes_of_sides, order, axis=1))

    def jumps(field: Array) -> Array:
        """Return the largest jump of a field at the nodes of each shared side."""
        values_of_cells = field.reshape(count, corners.shape[1], -1)
        values = values_of_cells[:, sides].reshape(*nodes_of_sides.shape, -1)
        values_in_order = np.take_along_axis(values, order[..., None], axis=1)
        values_here, values_there = values_in_order[shared_sides.T]
        return np.asarray(np.abs(values_here - values_there).max(axis=(1, 2)))

    kink = jumps(normals)
    is_split = kink > KINK
    for field in prescribed_fields:
        largest = np.abs(field).max() or 1.0
        # on a surface of flat cells the normal jumps a little, and with it a field along the
        # normal: such a jump does not count
        is_split |= jumps(field) > largest * (FIELD_JUMP + 2 * kink)
    # sides are listed cell after cell, so division gives the cells on both sides
    first_cells, second_cells = (shared_sides[~is_split] // len(sides)).T
    adjacency = scipy.sparse.coo_matrix(
        (np.ones(len(first_cells)), (first_cells, second_cells)), (count, count)
    )
    _, part_numbers = scipy.sparse.csgraph.connected_components(adjacency, directed=False)
    return np.asarray(part_numbers, np.int64)


def _equal_rows(rows: Numbers) -> Numbers:
    """Return the pairs (e, 2) of row numbers whose rows are equal.

    Only rows that occur exactly twice are in a pair.
    """
    _, first_with_key, key_numbers, rows_with_key = np.unique(
        rows, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    key_numbers = key_numbers.ravel()  # of each row the number of its content
    occurs_twice = rows_with_key[key_numbers] == 2
    is_later = first_with_key[key_numbers] != np.arange(len(rows))
    second_rows = np.flatnonzero(occurs_twice & is_later)
    return np.column_stack([first_with_key[key_numbers[second_rows]], second_rows])


def split(numbers: Numbers, parts: Numbers) -> Numbers:
    """Return the nodes (m, s) of cells, renumbered so that cells of different parts share none.

    `parts` (m,) is the number of each cell's part. If there is one part, nothing changes.

    Examples
    --------
    >>> split(np.array([[0, 1], [1, 2]]), np.array([0, 1])).tolist()
    [[0, 1], [2, 3]]
    """
    if not parts.any():
        return numbers
    key = np.column_stack([np.repeat(parts, numbers.shape[1]), numbers.ravel()])
    _, new_numbers = np.unique(key, axis=0, return_inverse=True)
    return new_numbers.reshape(numbers.shape).astype(np.int64)
