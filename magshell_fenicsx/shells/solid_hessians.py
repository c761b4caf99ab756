"""Element matrices of a solid's terms: the Hessians of their densities at points, contracted in
batches.

Jets are in reference coordinates, so that the tables of the shape functions are the same for all
cells.

A jet is a field's value and its three derivatives by the reference coordinates xi, four vectors:
the parts 0 to 3. X is the undeformed placement, u the displacement. A term's density is integrated
over the body, its outer face, or ends (faces above edges). A point kernel gives the Hessian of a
density by the jet at each point of a batch of cells; the contraction with shape functions makes
element matrices of it. "Varying" parameters are fields, whose values at points are kept in memos
and renewed where they have changed.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations_with_replacement
from typing import Any

import basix
import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.batches import (
    MAX_BATCH_POINTS,
    Contraction,
    EntityBatch,
    EntityRule,
    HessianBlocks,
)
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.memo import Memo
from magshell_fenicsx.assembly.point_kernels import BlockPairs, PointStorage, point_hessian
from magshell_fenicsx.assembly.shape_tables import ShapeTable
from magshell_fenicsx.assembly.terms import Term
from magshell_fenicsx.mesh.hexahedra import BodyMesh
from magshell_fenicsx.models.shell.element_hessians import fill, on_batches, parameters_at
from magshell_fenicsx.shells.solid_terms import SolidTerm

Array = NDArray[np.float64]
JET_PARTS = 4  # value and three reference derivatives
# where the numbers that a density wants at a point begin: in the body those of X, of the inverse of
# dX/dxi, and its determinant; at ends the area in its place, then n and t; on the outer face there
# is X's jet alone
INVERSE, MEASURE, NORMAL, TANGENT = 3, 12, 13, 16
SIZES = {"body": 13, "outer": 12, "end": 19}


class BodyHessianIntegral:
    """Integral of the Hessians of terms with the same quadrature, over cells or faces.

    Parameters
    ----------
    X
        The undeformed placement in the displacement's space.
    cells
        Cells of this rank.
    rule
        Quadrature on the reference cell, or on a face of it.
    terms
        Terms with one region: body, outer face or end.
    facet
        Number of the face in the reference cell; None for the body.

    Attributes
    ----------
    coupling
        Batches that couple several cells; a solid has none.
    _dofs
        Nodes of each cell.
    _batches, _geometry
        The batches of cells, and at the points of each the numbers of the geometry that densities
        want: X, the inverse of dX/dxi, the area or volume ratio, at ends n and t.
    _points
        Storage of the fields at points that kernels read.
    _g, _u
        Such fields: geometry, and jet of u.
    _contraction
        Contraction of Hessians at points with shape functions to element matrices.
    _hessians, _pairs
        Term -> kernel of its Hessian, and the pairs of jet parts that this has.
    _varying
        Term -> its parameters that are fields: field at points, and memo of its values in each
        batch.
    _coupled
        All pairs of jet parts that some term has.
    """

    coupling: Sequence[EntityBatch] = ()

    def __init__(
        self,
        X: fem.Function,
        cells: NDArray[np.int32],
        rule: EntityRule,
        terms: Sequence[SolidTerm],
        log: KernelLog,
        facet: int | None = None,
    ) -> None:
        """Divide the cells into batches and compile the terms' Hessians; collective."""
        V = X.function_space
        self._dofs = V.dofmap.list
        cells_per_batch = max(MAX_BATCH_POINTS // len(rule.weights), 1)
        cell_groups = [
            cells[i : i + cells_per_batch] for i in range(0, len(cells), cells_per_batch)
        ]
        self._batches = [
            EntityBatch((group,), rule, np.empty((len(group), 0))) for group in cell_groups
        ]
        # storage for the largest batch; a rank may have none
        self._points = PointStorage(max([1, *(batch.size for batch in self._batches)]))
        region = terms[0].density.region
        self._geometry = [
            _geometry(self._jets(batch, X.x.array), region, facet) for batch in self._batches
        ]
        # geometry and jet of u at the points of a batch
        self._g, self._u = self._points.field(SIZES[region]), self._points.field(3 * JET_PARTS)
        self._hessians = {}
        self._pairs: dict[str, BlockPairs] = {}
        self._varying: dict[str, list[tuple[fem.Function, Memo[list[Array]]]]] = {}
        # kernel of each term's Hessian, between those parts of the jet on which it depends
        for term in terms:
            pairs = BlockPairs(tuple(combinations_with_replacement(term.density.parts, 2)))
            # a virtual work is differentiated by its test function, at zero
            by = self._points.field(3 * JET_PARTS) if term.density.work else self._u
            density = self._density(term, by)
            self._pairs[term.name] = pairs
            self._hessians[term.name] = point_hessian(
                term.name, density, by, JET_PARTS, pairs, log, at_zero=by is not self._u
            )
        # all pairs of parts, for the sum of all terms
        pairs_of_terms = sorted(
            {pair for pairs in self._pairs.values() for pair in pairs.within_side}
        )
        self._coupled = BlockPairs(tuple(pairs_of_terms))
        self._contraction = Contraction(rule, self._coupled)

    def add(
        self,
        u: Array,
        factors: Mapping[str, float],
        element_matrices: Array,
        couple: Callable[[int, Array], None],
    ) -> None:
        """Add factor times the terms' element matrices to `element_matrices`.

        Terms without a factor in `factors` (name -> number) are left out. `u` holds nodal values,
        `element_matrices` has one matrix for each cell. `couple`, for batches that couple cells, is
        not used here.
        """
        names = [name for name in self._hessians if factors.get(name)]
        for name in names:
            for _, values in self._varying[name]:
                values.renew()
        for i, batch in enumerate(self._batches):
            # what kernels read at the batch's points
            fill(self._u, self._jets(batch, u))
            fill(self._g, self._geometry[i])
            # sum of the terms' Hessians at points, then contracted with shape functions
            blocks = HessianBlocks(batch, self._coupled)
            for name in names:
                for target, values in self._varying[name]:
                    fill(target, values.latest[i])
                hessians = self._points.evaluate(self._hessians[name], batch.size)
                blocks.add(hessians, factors[name], self._pairs[name])
            element_matrices[batch.cells[0]] += self._contraction.within_side(blocks, 0)

    def _jets(self, batch: EntityBatch, field: Array) -> Array:
        """Return a field's value and reference derivatives at a batch, (cells, points, 4, 3)."""
        return batch.rule.tables[0].jets(field.reshape(-1, 3)[self._dofs[batch.cells[0]]])

    def _density(self, term: SolidTerm, v: fem.Function) -> Any:
        """Return a term's density times the area or volume ratio, as an expression of point fields.

        `v` is the jet by which it is differentiated: that of u itself, or of the test function of a
        virtual work. Of a virtual work it is a function of u and v, whose Hessian in v is the
        symmetric part of the work's derivative. Sets `_varying` of the term.
        """
        density, g, z = term.density, self._g, self._u
        # all parameters as expressions at points; those that are fields, with their point fields
        at_points, varying = parameters_at(self._points, density.parameters, 1)
        function = density.work or density.function
        self._varying[term.name] = [
            (target, on_batches(field, self._batches)) for target, field in varying
        ]

        def vector(f: fem.Function, start: int) -> Any:
            """Return three numbers of a point field, from `start` on, as a vector."""
            return ufl.as_vector([f[start + c] for c in range(3)])

        def derivatives(c: int) -> list[Any]:
            """Return the derivatives of the component c of u by the reference coordinates."""
            return [z[3 * part + c] for part in range(1, JET_PARTS)]

        def inverse_row(i: int) -> list[Any]:
            """Return a row of the inverse that makes dX from these derivatives."""
            return [g[INVERSE + 3 * i + j] for j in range(3)]

        def hessian_density(W: Any) -> Any:
            """Return the function whose Hessian by v is wanted, from an energy or a work W."""
            return ufl.dot(ufl.diff(W, z), v) / 2 if density.work else W

        # a virtual work takes the value of the test function before the parameters
        parameters = [vector(v, 0), *at_points] if density.work else at_points
        # X, X1, X2, u, u1, u2: both jets without the derivative through the thickness
        if density.region == "outer":
            return hessian_density(
                function(*(vector(f, 3 * part) for f in (g, z) for part in range(3)), *parameters)
            )
        # du/dX from the derivatives by reference coordinates
        by_reference = ufl.as_matrix([derivatives(c) for c in range(3)])
        inverse = ufl.as_matrix([inverse_row(i) for i in range(3)])
        # arguments X, u and H; on ends n and t; then parameters
        frame = [vector(g, NORMAL), vector(g, TANGENT)] if density.region == "end" else []
        W = function(
            vector(g, 0), vector(z, 0), ufl.dot(by_reference, inverse), *frame, *parameters
        )
        return hessian_density(W) * g[MEASURE]


def body_hessian_integrals(
    body: BodyMesh,
    X: fem.Function,
    terms: Sequence[Term],
    log: KernelLog,
    cell_mask: NDArray[np.bool_] | None = None,
) -> list[BodyHessianIntegral]:
    """Return the integrals of all nonlinear terms' Hessians, one for each quadrature; collective.

    `cell_mask` selects local cells; None for all.
    """
    V = X.function_space
    nonlinear = [t for t in terms if isinstance(t, SolidTerm) and not t.linear]
    in_body = [t for t in nonlinear if t.density.region == "body"]
    on_faces = [t for t in nonlinear if t.density.region != "body"]

    def selected(cells: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return those of some cells that the mask selects."""
        return cells if cell_mask is None else cells[cell_mask[cells]]

    integrals = []
    # one integral for all terms in the body with one degree of quadrature
    own_cells = np.arange(V.mesh.topology.index_map(3).size_local, dtype=np.int32)
    for degree in sorted({t.density.degree for t in in_body}):
        rule = _rule(V, *basix.make_quadrature(basix.CellType.hexahedron, degree))
        terms_of_degree = [t for t in in_body if t.density.degree == degree]
        integrals.append(BodyHessianIntegral(X, selected(own_cells), rule, terms_of_degree, log))
    # A face has a number from 0 to 5 in its cell, on which the tables of shape functions depend. So
    # a term on faces has one integral for each number. All ranks go through the numbers that some
    # rank has.
    for term in on_faces:
        cells_at_facets, facet_numbers = _cells_at(body, term.density.facets)
        points, weights = term.density.rule
        counts = V.mesh.comm.allreduce(np.bincount(facet_numbers, minlength=6))
        for facet in np.flatnonzero(counts):
            rule = _rule(V, _on_facet(points, facet), weights)
            cells = selected(cells_at_facets[facet_numbers == facet])
            integrals.append(BodyHessianIntegral(X, cells, rule, [term], log, facet))
    return integrals


def _rule(V: fem.FunctionSpace, points: Array, weights: Array) -> EntityRule:
    """Return a quadrature rule with the tabulated shape functions of a space."""
    table = ShapeTable(
        np.ascontiguousarray(V.element.basix_element.tabulate(1, points)[..., 0].transpose(1, 0, 2))
    )
    return EntityRule((points,), (table,), weights)


def _on_facet(points: Array, facet: int) -> Array:
    """Return points (n, 2) of the reference facet as places (n, 3) in the reference cell."""
    # three of the four corners span the face
    corners = basix.geometry(basix.CellType.hexahedron)[
        basix.topology(basix.CellType.hexahedron)[2][facet]
    ]
    return np.asarray(corners[0] + points @ (corners[1:3] - corners[0]))


def _cells_at(
    body: BodyMesh, facets: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Return the owned cells behind some facets, and the facet's number in each cell."""
    topology = body.mesh.topology
    cells_of_facets = topology.connectivity(2, 3)
    # the first cell of each facet, which is the only one on the surface
    cells = cells_of_facets.array[cells_of_facets.offsets[facets]]
    facets_of_cells = topology.connectivity(3, 2).array.reshape(-1, 6)
    facet_numbers = np.argmax(facets_of_cells[cells] == facets[:, None], axis=1)
    owned = cells < topology.index_map(3).size_local
    return np.asarray(cells[owned], dtype=np.int32), facet_numbers[owned]


def _geometry(jets: Array, region: str, facet: int | None) -> Array:
    """Return the geometry (points, SIZES[region]) at points from the placement's jets.

    Its numbers are listed above `SIZES`; the inverse of dX/dxi is stored by rows. `jets` are
    (cells, points, 4, 3). `facet` is the number of the face in the reference cell, None for the
    body.
    """
    flat = jets.reshape(-1, JET_PARTS, 3)  # by points
    if region == "outer":  # the jet alone
        return flat.reshape(-1, SIZES[region])
    G = flat[:, 1:].transpose(0, 2, 1)  # columns are the derivatives
    inverse, volume_ratio = np.linalg.inv(G), np.linalg.det(G)
    if facet is None:
        return np.column_stack([flat[:, 0], inverse.reshape(-1, 9), volume_ratio])
    # area ratio by Nanson's formula
    outward = basix.cell.facet_outward_normals(basix.CellType.hexahedron)[facet] @ inverse
    area_ratio = volume_ratio * np.linalg.norm(outward, axis=1)
    # n along the thickness, which is the third reference coordinate; t along the edge
    n, t = flat[:, 3], np.cross(flat[:, 3], outward)
    unit_vectors = [v / np.linalg.norm(v, axis=1)[:, None] for v in (n, t)]
    return np.column_stack([flat[:, 0], inverse.reshape(-1, 9), area_ratio, *unit_vectors])
