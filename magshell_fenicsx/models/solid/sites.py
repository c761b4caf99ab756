"""Where the solid's terms live: the Hessians of their densities at points, contracted in batches.

As on the shell (see `shell.sites`), with the jets in reference coordinates: the tables of the shape
functions are the same for all cells.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations_with_replacement
from typing import Any

import basix
import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.batches import POINTS, Batch, Rule
from magshell_fenicsx.assembly.contraction import Blocks, Contraction
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.point_kernels import Pairs, Points, point_hessian
from magshell_fenicsx.assembly.shape_tables import Table
from magshell_fenicsx.assembly.terms import Term
from magshell_fenicsx.mesh.hexahedra import OUTER, Body
from magshell_fenicsx.models.solid.terms import SolidTerm

Array = NDArray[np.float64]
PARTS = 4  # value and three reference derivatives
BULK, FACE = 13, 12  # numbers that a density wants at a point: X, the inverse of dX/dxi and its determinant; X's jet


class Site:
    """Where some terms live with the same quadrature.

    Parameters
    ----------
    X
        The undeformed placement in the displacement's space.
    cells
        Those of this rank.
    rule
        Quadrature on the reference cell, or on its outer face.
    """

    coupling: Sequence[Batch] = ()

    def __init__(
        self, X: fem.Function, cells: NDArray[np.int32], rule: Rule, terms: Sequence[SolidTerm], log: KernelLog
    ) -> None:
        V = X.function_space
        self._dofs = V.dofmap.list
        size = max(POINTS // len(rule.weights), 1)
        parts = [cells[i : i + size] for i in range(0, len(cells), size)]
        self._batches = [Batch((part,), rule, np.empty((len(part), 0))) for part in parts]
        self._points = Points(max([1, *(batch.size for batch in self._batches)]))
        on_face = terms[0].density.on_face
        placements = [self._jets(batch, X.x.array) for batch in self._batches]
        self._geometry = [jets.reshape(-1, FACE) if on_face else _inverted(jets) for jets in placements]
        self._g, self._u = self._points.field(FACE if on_face else BULK), self._points.field(3 * PARTS)
        self._hessians = {}
        self._pairs: dict[str, Pairs] = {}
        for term in terms:
            pairs = Pairs(tuple(combinations_with_replacement(term.density.parts, 2)))
            W = self._density(term)
            self._pairs[term.name] = pairs
            self._hessians[term.name] = point_hessian(
                term.name, W, self._u, PARTS, pairs, log, V.mesh.comm, at_zero=False
            )
        wanted = sorted({pair for pairs in self._pairs.values() for pair in pairs.same})
        self._coupled = Pairs(tuple(wanted))
        self._contraction = Contraction(rule, self._coupled)

    def add(self, u: Array, factors: Mapping[str, float], same: Array, couple: Callable[[int, Array], None]) -> None:
        """Add the terms' element matrices to `same`; see `shell.sites.Site.add`."""
        names = [name for name in self._hessians if factors.get(name)]
        for batch, geometry in zip(self._batches, self._geometry, strict=True):
            jets = self._jets(batch, u)
            self._u.x.array[: jets.size] = jets.ravel()
            self._g.x.array[: geometry.size] = geometry.ravel()
            blocks = Blocks(batch, self._coupled)
            for name in names:
                blocks.add(self._points.evaluate(self._hessians[name], batch.size), factors[name], self._pairs[name])
            same[batch.cells[0]] += self._contraction.same(blocks, 0)

    def _jets(self, batch: Batch, field: Array) -> Array:
        """(cells, points, 4, 3) of a field."""
        return batch.rule.tables[0].jets(field.reshape(-1, 3)[self._dofs[batch.cells[0]]])

    def _density(self, term: SolidTerm) -> Any:
        density, g, z = term.density, self._g, self._u
        parameters = [self._points.constant(p) for p in density.parameters]

        def vector(f: fem.Function, part: int) -> Any:
            return ufl.as_vector([f[3 * part + c] for c in range(3)])

        if density.on_face:
            return density.of(*(vector(f, part) for f in (g, z) for part in range(3)), *parameters)
        by_reference = ufl.as_matrix([[z[3 * part + c] for part in range(1, PARTS)] for c in range(3)])
        inverse = ufl.as_matrix([[g[3 + 3 * i + j] for j in range(3)] for i in range(3)])
        return density.of(vector(g, 0), vector(z, 0), ufl.dot(by_reference, inverse), *parameters) * g[12]


def make_sites(body: Body, X: fem.Function, terms: Sequence[Term], log: KernelLog) -> list[Site]:
    """The sites of the terms that have a tangent, one for each quadrature. Collective."""
    V = X.function_space
    element = V.element.basix_element
    found = [t for t in terms if isinstance(t, SolidTerm) and not t.linear]
    sites = []
    for on_face, degree in sorted({(t.density.on_face, t.density.degree) for t in found}):
        if on_face:
            square, w = basix.make_quadrature(basix.CellType.quadrilateral, degree)
            points = np.column_stack([square, np.ones(len(square))])
            cells = _cells_under(body)
        else:
            points, w = basix.make_quadrature(basix.CellType.hexahedron, degree)
            cells = np.arange(V.mesh.topology.index_map(3).size_local, dtype=np.int32)
        table = Table(np.ascontiguousarray(element.tabulate(1, points)[..., 0].transpose(1, 0, 2)))
        here = [t for t in found if (t.density.on_face, t.density.degree) == (on_face, degree)]
        sites.append(Site(X, cells, Rule((points,), (table,), w), here, log))
    return sites


def _cells_under(body: Body) -> NDArray[np.int32]:
    """Owned cells with a facet on the outer face."""
    topology = body.mesh.topology
    links = topology.connectivity(2, 3)
    cells = links.array[links.offsets[body.faces[OUTER]]]
    return np.asarray(cells[cells < topology.index_map(3).size_local], dtype=np.int32)


def _inverted(jets: Array) -> Array:
    """(points, 13): X, the inverse of dX/dxi by rows, and its determinant."""
    flat = jets.reshape(-1, PARTS, 3)
    G = flat[:, 1:].transpose(0, 2, 1)  # columns are the derivatives
    return np.column_stack([flat[:, 0], np.linalg.inv(G).reshape(-1, 9), np.linalg.det(G)])
