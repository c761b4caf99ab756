"""The second variation of an axisymmetric shell's energy along waves around its axis.

In: the energies of a meridian with their densities. Out: for each wave number m, the entries of the
symmetric matrix Q_m of the second variation, from Hessians of the densities at quadrature points.

- A wave is v = U cos(m theta) e_rho + V sin(m theta) e_theta + W cos(m theta) e_z; its coefficients
  along the meridian are (P, V, W) with P = U + V.
- A jet is a vector field with its first and second derivatives by the coordinates of the surface.
- r0 is the placement, u the axisymmetric displacement, both with components along e_rho and e_z.
- Entities are what densities are integrated over: cells (one side), vertices between two cells (two
  sides) or ends. A batch has entities with the same quadrature rule.
- A block is the matrix of one entity; a pair is a row and a column node of an entry.
- An amplitude is a load parameter, by name, that multiplies an energy.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from itertools import combinations_with_replacement

import basix
import numpy as np
import ufl
from dolfinx import fem, mesh
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.batches import EntityBatch, EntityRule
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.memo import Memo
from magshell_fenicsx.assembly.point_kernels import PointKernel, PointStorage, full_hessian
from magshell_fenicsx.models.domains import Energy, IntegrationDomain, revolved_jet_of, wave_jets_of
from magshell_fenicsx.models.shell.element_hessians import fill, on_batches, parameters_at
from magshell_fenicsx.models.shell.energy import Density
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.platform import compat

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
DERIVATIVES = 3  # value, first and second derivative along the meridian
PLANE, WAVE = 2, 3  # components of axisymmetric fields and of a wave's coefficients
_UPPER = tuple(
    combinations_with_replacement(range(WAVE), 2)
)  # pairs of components; the others follow by symmetry


class WaveHessians:
    """The matrices of the second variations Q_m along waves m, without supports.

    Parameters
    ----------
    domain
        The meridian with its placement.
    u
        The axisymmetric displacement.
    energies
        Energies that are not linear in the displacement.
    log
        Log of compiled kernels.

    Attributes
    ----------
    rows, columns
        (pairs,) of the nodes of the entries, sorted by rows, rows <= columns: the matrices are
        symmetric.
    _batches, _sums
        The batches of entities, and for each the matrix that adds its blocks up into entries.
    _nodes
        (cells, functions) node of each shape function of a cell.
    """

    def __init__(
        self,
        domain: IntegrationDomain,
        u: fem.Function,
        energies: Sequence[Energy],
        log: KernelLog,
    ) -> None:
        """Sort energies into batches of points, and find the pairs of nodes that they couple."""
        self._nodes = u.function_space.dofmap.list.astype(np.int64)  # (cells, functions)
        # energies on the same points, which share one batch
        energies_by_support = dict[tuple[int, int, tuple[int, ...]], list[Energy]]()
        for e in energies:
            energies_by_support.setdefault(_support_of(e), []).append(e)
        self._batches = [
            _WaveBatch(domain, u, batch, energies_here, log)
            for energies_here in energies_by_support.values()
            for batch in _batches(domain, energies_here[0].density)
        ]
        nodes = [batch.nodes(self._nodes) for batch in self._batches]
        # a pair of nodes as one number, its code: rows * count + columns
        count = int(self._nodes.max()) + 1
        codes_of_batches = [rows * count + columns for rows, columns in nodes]
        # the matrices are symmetric: only rows <= columns are assembled
        upper_of_batches = [rows <= columns for rows, columns in nodes]
        upper_codes = [
            codes[is_upper]
            for codes, is_upper in zip(codes_of_batches, upper_of_batches, strict=True)
        ]
        all_codes = np.unique(np.concatenate(upper_codes))
        self.rows, self.columns = all_codes // count, all_codes % count
        # a pair's number is the position of its code
        self._sums = [
            _sum_of_blocks(np.searchsorted(all_codes, codes), is_upper, len(all_codes))
            for codes, is_upper in zip(codes_of_batches, upper_of_batches, strict=True)
        ]

    def entries(self, factors: Mapping[str | None, float], waves: Sequence[float]) -> Array:
        """Return the entries (waves, pairs, 3, 3) of the matrices at the present u.

        Parameters
        ----------
        factors
            Amplitude -> its value, which multiplies energies; the key None is that of energies
            without an amplitude.
        waves
            Numbers m of circumferential waves.
        """
        total = np.zeros((len(waves), 9 * len(self.rows)))
        for batch, sums in zip(self._batches, self._sums, strict=True):
            if (blocks := batch.blocks(factors, waves)) is not None:
                for entries, wave_blocks in zip(total, blocks, strict=True):
                    entries += sums @ wave_blocks.ravel()
        return total.reshape(len(waves), -1, 3, 3)


class _WaveBatch:
    """Second variation of energies at the points of one batch of entities.

    The entities are the cells, the vertices between them, or an end.

    Parameters
    ----------
    domain
        The meridian with its placement.
    u
        The axisymmetric displacement.
    batch
        The entities, with their points and geometry.
    energies
        Energies that are all integrated there.
    log
        Log of compiled kernels.

    Attributes
    ----------
    _at_u, _at_r0, _at_initial
        Point fields: jets of the displacement, the placement and the initial placement, on all
        sides.
    _wave
        Point field: the coefficients of the wave with their derivatives, on all sides.
    _geometry
        Point field: covector and length of the cell on each side.
    _placed
        Memo whose renewal fills in the jets of the placements.
    _m
        The wave number.
    _given, _varying
        For each energy: its parameters at points; the point fields among these, with their values.
    _kernels
        For each energy the kernel of its Hessian by the wave's coefficients and their derivatives,
        whose entries are the upper triangle at each point.
    _scales
        (points, entries) factors of the Hessians: weights of the quadrature, and factors that turn
        derivatives by the reference coordinate into those by the meridian's.
    _order, _products
        Positions of the Hessians' entries at all points of an entity, sorted as the rows of
        `_products`: the products of derivatives of two shape functions at these points. The sorted
        entries times the products give the matrix of the entity.
    """

    def __init__(
        self,
        domain: IntegrationDomain,
        u: fem.Function,
        batch: EntityBatch,
        energies: Sequence[Energy],
        log: KernelLog,
    ) -> None:
        """Declare the inputs of the kernels: point fields of u, r0, wave and geometry."""
        self._batch, self._energies, self._log, self._u = batch, energies, log, u
        self._domain, self._sides = domain, range(len(batch.cells))
        self._points = points = PointStorage(batch.size)
        sides = len(self._sides)
        self._at_u, self._at_r0, self._at_initial = (
            points.field(PLANE * DERIVATIVES * sides) for _ in range(3)
        )
        self._wave = points.field(WAVE * DERIVATIVES * sides)
        self._geometry = points.field(2 * sides)
        fill(self._geometry, batch.geometry)
        if domain.initial_placement is None:
            placements = [domain.r0]
        else:
            placements = [domain.r0, domain.initial_placement]
        self._placed = Memo(self._place, lambda: tuple(field.x.array for field in placements))
        self._m = fem.Constant(points._mesh, 1.0)
        self._given = [
            parameters_at(points, e.density.parameters, sides) for e in energies if e.density
        ]

        def on_batch(
            varying: Sequence[tuple[fem.Function, fem.Function]],
        ) -> list[tuple[fem.Function, Memo[list[Array]]]]:
            """Return point fields, each with the field of its values at the points."""
            return [(target, on_batches(field, [batch], sides)) for target, field in varying]

        self._varying = [on_batch(varying) for _, varying in self._given]

    def nodes(self, nodes: Ints) -> tuple[Ints, Ints]:
        """Return the nodes of the rows and of the columns of each entity's matrix.

        Both are (entities, functions, functions), with the functions of all cells at the entity.
        `nodes` (cells, functions) are those of the cells.
        """
        entity_nodes = np.hstack([nodes[cells] for cells in self._batch.cells])
        rows, columns = np.broadcast_arrays(entity_nodes[:, :, None], entity_nodes[:, None])
        return rows, columns

    def blocks(self, factors: Mapping[str | None, float], waves: Sequence[float]) -> Array | None:
        """Return the matrices of the entities for each wave; None if all factors are zero.

        The array is (waves, entities, pairs of components, pairs of functions). The pairs of
        components are those in `_UPPER`; functions are the shape functions of all cells at an
        entity. `factors` are the values of amplitudes (key None: of no amplitude), `waves` the
        numbers m.
        """
        active_energies = [
            number for number, e in enumerate(self._energies) if factors[e.amplitude]
        ]
        if not active_energies:
            return None
        # the kernels' inputs: jets of u and of the placements, and fields of the densities
        fill(self._at_u, self._derivatives(self._u))
        self._placed.renew()
        for number in active_energies:
            for target, values in self._varying[number]:
                (values_on_batch,) = values.renew()
                fill(target, values_on_batch)
        # upper triangles of the Hessians by the wave's jets; pi is the integral of cos² around e3,
        # as of sin²
        upper = np.zeros((len(waves), *self._scales.shape))
        for wave_index, m in enumerate(waves):
            self._m.value = m
            for number in active_energies:
                factor = np.pi * factors[self._energies[number].amplitude]
                upper[wave_index] += factor * self._points.evaluate(
                    self._kernels[number], self._batch.size
                )
        # (waves, entities, entries of all points of the entity)
        upper = (upper * self._scales).reshape(len(waves), len(self._batch.cells[0]), -1)
        # a body touches few cells: the matrices of others are zero
        has_stiffness = upper.any(axis=(0, 2))
        blocks = np.zeros((*upper.shape[:2], len(_UPPER), self._products.shape[1]))
        # one row for each wave, entity and pair of components; it is multiplied with the products
        # of shape functions at the points
        hessian_rows = upper[:, has_stiffness][..., self._order].reshape(-1, len(self._products))
        matrices = hessian_rows @ self._products
        blocks[:, has_stiffness] = matrices.reshape(len(waves), -1, *blocks.shape[2:])
        return blocks

    def _place(self) -> None:
        """Fill in the jets of the placement and of the initial placement."""
        fill(self._at_r0, self._derivatives(self._domain.r0))
        if self._domain.initial_placement is not None:
            fill(self._at_initial, self._derivatives(self._domain.initial_placement))

    @cached_property
    def _kernels(self) -> list[PointKernel]:
        """A kernel for each energy: the Hessian at zero wave, by the wave's coefficients.

        It is the Hessian by (P, V, W) and their first and second derivatives at a point. The jets
        of a wave have a cosine and a sine part. Integrated around e3 the product of both vanishes,
        so the second variation is the sum of those along each part.
        """
        waves = [self._of_sides(self._wave, WAVE, side) for side in self._sides]
        jets_of_waves = [wave_jets_of(side_jets, self._m) for side_jets in waves]
        u, r0, initial_jets = map(self._revolved_jets, (self._at_u, self._at_r0, self._at_initial))
        kernels = []
        for energy, (parameters, _) in zip(self._energies, self._given, strict=True):
            assert energy.density
            # `start` is the placement from which the energy counts, `shift` leads from there to r0
            if self._counts_from_initial(energy):
                start = initial_jets
                shift = [a - b for a, b in zip(r0, initial_jets, strict=True)]
                displacements = [a + b for a, b in zip(u, shift, strict=True)]
            else:
                start, displacements = r0, u
            W = ufl.zero()
            for phase in range(2):  # the cosine's and the sine's
                wave_jets = [side_jets[phase] for side_jets in jets_of_waves]
                W = W + _perturbed_density(
                    energy.density, start, displacements, wave_jets, self._edge(), parameters
                )
            kernels.append(full_hessian(f"{energy.name} waves", W, self._wave, self._log))
        return kernels

    def _counts_from_initial(self, e: Energy) -> bool:
        """Return whether an energy counts from an initial placement other than r0."""
        return e.from_initial and self._domain.initial_placement is not None

    def _edge(self) -> tuple[list[Expr], list[Expr]] | None:
        """Return the covector and the cell's area on every side of an edge; None in cells.

        Here an edge is a circle, at a vertex of the meridian. The area, per radian, is half of that
        of the cell beside it, as it would be of a triangle.
        """
        density = self._energies[0].density  # all energies of a batch are on edges, or none
        if density is None or not density.on_edges:
            return None
        covectors = [ufl.as_vector([self._geometry[2 * side], 0]) for side in self._sides]
        areas = [self._geometry[2 * side + 1] / 2 for side in self._sides]
        return covectors, areas

    def _revolved_jets(self, field: fem.Function) -> list[Jet]:
        """Return the jets of an axisymmetric point field on each side of an entity."""
        return [revolved_jet_of(self._of_sides(field, PLANE, side)) for side in self._sides]

    def _of_sides(self, field: fem.Function, components: int, side: int) -> list[list[Expr]]:
        """Return value and two derivatives of a field's components on one side of an entity.

        The point field has for each side first the values of all components, then their first
        and their second derivatives.
        """
        first = components * DERIVATIVES * side
        entries = [field[first + i] for i in range(components * DERIVATIVES)]
        return [entries[i : i + components] for i in range(0, len(entries), components)]

    def _derivatives(self, field: fem.Function) -> Array:
        """Return an axisymmetric field at the points: its value, first and second derivative.

        The array is (points, sides, derivatives, components); derivatives are by the coordinate of
        the meridian.
        """
        nodal = field.x.array.reshape(-1, PLANE)[self._u.function_space.dofmap.list]
        sides = list[Array]()
        for cells, table, scale in zip(
            self._batch.cells, self._reference, self._by_length, strict=True
        ):
            # sum over the functions, then (entities, points of an entity, derivatives, components)
            values = np.tensordot(nodal[cells], table, axes=(1, 2)).transpose(0, 2, 3, 1)
            values = values * scale[:, None, :, None]
            sides.append(values.reshape(-1, DERIVATIVES, PLANE))
        return np.stack(sides, axis=1)

    @cached_property
    def _reference(self) -> list[Array]:
        """Shape functions in the reference cell, on each side.

        They are (points of an entity, derivatives, functions).
        """
        element = self._u.function_space.element.basix_element
        # the rule has its points in the reference cell of each side
        return [element.tabulate(2, X)[..., 0].transpose(1, 0, 2) for X in self._batch.rule.points]

    @cached_property
    def _by_length(self) -> list[Array]:
        """Factors (entities, derivatives), on each side, of value, first and second derivative.

        They turn derivatives by the reference coordinate into derivatives by the meridian's.
        """
        lengths = _lengths(self._u.function_space)
        return [
            1 / lengths[cells][:, None] ** np.arange(DERIVATIVES) for cells in self._batch.cells
        ]

    @cached_property
    def _products(self) -> Array:
        """Products of derivatives of two shape functions, for the functions of all sides.

        The rows are (point of an entity, derivative i, derivative j), the columns (function n,
        function m). The Hessians at the points of an entity, as one row, times this matrix give the
        entity's matrix.
        """
        points_per_entity, derivatives, functions = self._reference[0].shape
        count = len(self._sides)
        # a function of one side has no derivatives on the other: blocks on the diagonal
        tables = np.zeros((points_per_entity, count, derivatives, count, functions))
        for side, table in enumerate(self._reference):
            tables[:, side, :, side] = table
        all_derivatives = count * derivatives
        all_tables = tables.reshape(points_per_entity, all_derivatives, count * functions)
        products = np.einsum("qin,qjm->qijnm", all_tables, all_tables)
        return np.asarray(products.reshape(points_per_entity * all_derivatives**2, -1))

    @cached_property
    def _order(self) -> Ints:
        """Positions of Hessian entries, in the order of the rows of `_products`.

        The array is (pairs of components in `_UPPER`, points of an entity and pairs of
        derivatives). A position counts the upper triangles of all points of an entity, one after
        the other.
        """
        derivatives = DERIVATIVES * len(self._sides)
        # positions in the triangle of one point, by (derivative, component) of row and of column
        triangle = _triangle(WAVE * derivatives).reshape(derivatives, WAVE, derivatives, WAVE)
        # where the triangle of each point of an entity begins
        starts = np.arange(len(self._batch.rule.weights)) * (triangle.max() + 1)
        return np.stack([(triangle[:, c, :, d] + starts[:, None, None]).ravel() for c, d in _UPPER])

    @cached_property
    def _scales(self) -> Array:
        """Factors (points, entries of the Hessians) by which Hessians are integrated.

        They are the weights of the quadrature times the cell's size, times the factors that turn
        derivatives in the reference cell into those by the coordinate. A vertex has the weight one.
        """
        cells = self._batch.cells[0]
        weights = self._batch.rule.weights
        density = self._energies[0].density
        lengths = np.abs(_lengths(self._u.function_space)[cells])
        sizes = np.ones(len(cells)) if density and density.on_edges else lengths
        # a factor for each entity and entry of a wave's jet, then for each entry of the Hessian
        jet_factors = np.repeat(np.hstack(self._by_length), WAVE, axis=1)
        rows, columns = np.triu_indices(jet_factors.shape[1])
        by_length = np.repeat(jet_factors[:, rows] * jet_factors[:, columns], len(weights), axis=0)
        return np.asarray(np.outer(sizes, weights).reshape(-1, 1) * by_length)


def _perturbed_density(
    density: Density,
    r0: Sequence[Jet],
    u: Sequence[Jet],
    v: Sequence[Jet],
    edge: tuple[Sequence[Expr], Sequence[Expr]] | None,
    parameters: Sequence[fem.Constant | fem.Function],
) -> Expr:
    """Return a density whose Hessian in v, at v = 0, is that of the energy at u + v.

    A virtual work w(u, v) may have no potential; its derivative by u then is not symmetric. The
    quarter of w(u + v, v) - w(u - v, v) is quadratic in v and has the symmetric part as its
    Hessian. All jets are given on every side; `edge` has the covectors and the areas, or is None in
    cells.
    """
    u_plus_v = [a + b for a, b in zip(u, v, strict=True)]
    if density.work is None:
        return density.value_at([r0, u_plus_v], edge, parameters)
    u_minus_v = [a - b for a, b in zip(u, v, strict=True)]
    return (
        density.value_at([r0, u_plus_v, v], edge, parameters)
        - density.value_at([r0, u_minus_v, v], edge, parameters)
    ) / 4


def _sum_of_blocks(numbers: Ints, in_triangle: NDArray[np.bool_], count: int) -> csr_array:
    """Return the sparse matrix that adds up a batch's blocks into entries of pairs of nodes.

    It acts on the entries of all blocks, as one vector, and gives the nine entries of each pair of
    nodes. All its values are one.

    Parameters
    ----------
    numbers
        (entities, functions, functions) numbers of the pairs of nodes.
    in_triangle
        (entities, functions, functions) whether a pair is in the triangle that is assembled.
    count
        Number of all pairs.
    """
    # positions of the blocks' entries: (entities, pairs of components, functions, functions)
    entries = np.arange(numbers.size * len(_UPPER)).reshape(
        len(numbers), len(_UPPER), *numbers.shape[1:]
    )
    first_row = 9 * numbers[in_triangle]  # of the nine entries of a pair of nodes
    rows, columns = list[Ints](), list[Ints]()
    for k, (c, d) in enumerate(_UPPER):
        rows.append(first_row + WAVE * c + d)
        columns.append(entries[:, k][in_triangle])
        # the transposed pair of components follows by symmetry
        if c < d:
            rows.append(first_row + WAVE * d + c)
            columns.append(entries[:, k].transpose(0, 2, 1)[in_triangle])
    positions = np.concatenate(rows), np.concatenate(columns)
    return coo_array((np.ones(len(positions[0])), positions), (9 * count, entries.size)).tocsr()


def _support_of(e: Energy) -> tuple[int, int, tuple[int, ...]]:
    """Return a key of where an energy is integrated: sides, quadrature and facets.

    Energies with the same key share their points. A degree of quadrature 0 stands for that of the
    domain.
    """
    assert e.density
    facets = () if e.density.facets is None else tuple(int(facet) for facet in e.density.facets)
    return e.density.sides, e.density.quadrature or 0, facets


def _batches(domain: IntegrationDomain, density: Density | None) -> Iterable[EntityBatch]:
    """Yield the batches of entities of a density: all cells, or vertices with the same rule.

    The geometry of a batch (points, 2 for each side) has on each side the outward covector, 1 or
    -1 by the meridian's coordinate, and the length of the cell; it is zero for cells. Vertices are
    grouped by their local numbers in the cells beside them, as these decide on the reference point.
    """
    V = domain.r0.function_space
    topology, lengths = V.mesh.topology, _lengths(V)
    assert density
    if not density.on_edges:
        X, weights = basix.make_quadrature(
            basix.CellType.interval, density.quadrature or domain.rule
        )
        all_cells = np.arange(topology.index_map(1).size_local, dtype=np.int32)
        yield EntityBatch(
            (all_cells,), EntityRule((X,), (), weights), np.zeros((len(all_cells) * len(X), 2))
        )
        return
    cells_at_vertex, local_vertices = _cells_at_vertices(topology, density.facets)
    for local_numbers in np.unique(local_vertices, axis=0):
        is_of_kind = (local_vertices == local_numbers).all(axis=1)
        # the cells on each side; the vertex is their end with the number 0 or 1
        cells = tuple(np.ascontiguousarray(side) for side in cells_at_vertex[is_of_kind].T)
        geometry = list[Array]()
        for side, end in zip(cells, local_numbers, strict=True):
            outward = np.sign(lengths[side]) * (1 if end else -1)
            geometry.append(np.column_stack([outward, abs(lengths[side])]))
        rule = EntityRule(tuple(np.array([[float(end)]]) for end in local_numbers), (), np.ones(1))
        yield EntityBatch(cells, rule, np.hstack(geometry))


def _cells_at_vertices(
    topology: mesh.Topology, facets: NDArray[np.int32] | None
) -> tuple[NDArray[np.int32], Ints]:
    """Return the cells at vertices, and the local number of the vertex in each of these cells.

    Both are (vertices, sides). The vertices are the given ends `facets`, with one side; for None
    they are all vertices between two cells.
    """
    topology.create_connectivity(0, 1)
    cells_of_vertices = topology.connectivity(0, 1)
    vertices_of_cells = topology.connectivity(1, 0).array.reshape(-1, 2)
    vertices: NDArray[np.integer] = np.flatnonzero(np.diff(cells_of_vertices.offsets) == 2)
    if facets is not None:
        vertices = facets
    cells_at_vertex = np.array(
        [cells_of_vertices.links(vertex) for vertex in vertices], dtype=np.int32
    ).reshape(len(vertices), -1)
    is_other = vertices_of_cells[cells_at_vertex] != np.asarray(vertices)[:, None, None]
    return cells_at_vertex, is_other.argmin(axis=2)


def _lengths(V: fem.FunctionSpace) -> Array:
    """Return the change (cells,) of the coordinate from a cell's first to its second vertex.

    It is negative in a cell whose reference coordinate runs against the meridian's.
    """
    ends = V.mesh.geometry.x[compat.geometry_dofs(V.mesh), 0]
    return np.asarray(ends[:, 1] - ends[:, 0])


def _triangle(size: int) -> Ints:
    """Return positions (size, size) of a symmetric matrix's entries in its upper triangle."""
    positions = np.zeros((size, size), dtype=np.int64)
    rows, columns = np.triu_indices(size)
    positions[rows, columns] = positions[columns, rows] = np.arange(len(rows))
    return positions
