"""The residual without compiled residual forms, from the point gradients of the terms' own densities."""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.batches import boundary_edges, edge_width, interior_edges
from magshell_fenicsx.assembly.cell_frames import cell_frames
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.shape_tables import Table, cell_rule, edge_covector, edge_rule
from magshell_fenicsx.assembly.sheets import Sheet
from magshell_fenicsx.assembly.terms import Term
from magshell_fenicsx.models.shell.energy import Density, ShellTerm, cell_quadrature, edge_quadrature
from magshell_fenicsx.models.shell.gradients import FRAME, PointGradient, in_own_coordinates
from magshell_fenicsx.models.shell.kinematics import CURVED, FIRST, Jet
from magshell_fenicsx.models.shell.sites import NAMES, at_points

Array = NDArray[np.float64]


class _Site(Protocol):
    names: list[str]

    def place(self, r0: fem.Function) -> None:
        """Take another placement."""

    def add(self, nodal: Array, factors: Mapping[str, float], elements: Array) -> None:
        """Add the element vectors (cells, functions * 3) of the terms with these factors."""


class FastResidual:
    """The residual of a sum of terms; a `solve.problem.ResidualAssembler`.

    Terms on cells that share an amplitude also share a kernel: their geometry is found once.

    Parameters
    ----------
    r0, u
        The placement, and the displacement that the terms were written with.
    degree
        Of the elements.
    terms
        Those without a density are left out. Collective.

    Attributes
    ----------
    names
        Of the terms that it serves.
    """

    def __init__(self, r0: fem.Function, u: fem.Function, degree: int, terms: Sequence[Term], log: KernelLog) -> None:
        found = [term for term in terms if isinstance(term, ShellTerm)]
        on_cells = [term for term in found if not term.density.on_edges]
        on_edges = [term for term in found if term.density.on_edges]
        self._sites: list[_Site] = []
        for kind in dict.fromkeys((term.amplitude, term.density.quadrature) for term in on_cells):
            together = [term for term in on_cells if (term.amplitude, term.density.quadrature) == kind]
            self._sites.append(_Cells(r0, kind[1] or cell_quadrature(degree), together, log))
        if on_edges:
            self._sites.append(_Edges(r0, edge_quadrature(degree), on_edges, log))
        self.names = frozenset(term.name for term in found)
        self._r0 = r0
        self._u, self._nodes = u, u.function_space.dofmap.list
        self._dofs = (3 * self._nodes[:, :, None] + np.arange(3)).ravel()

    def renew(self) -> None:
        """Take the placement anew."""
        for site in self._sites:
            site.place(self._r0)

    def add(self, b: Array, factors: Mapping[str, float]) -> None:
        """Add it to the local vector (ghosts included), at the present u."""
        nodal = np.take(self._u.x.array.reshape(-1, 3), self._nodes, axis=0).reshape(-1, 3 * self._nodes.shape[1])
        elements = np.zeros_like(nodal)
        for site in self._sites:
            site.add(nodal, factors, elements)
        b += np.bincount(self._dofs, elements.ravel(), len(b))


class _Cells:
    """Terms with one amplitude on the owned cells."""

    def __init__(self, r0: fem.Function, degree: int, terms: Sequence[ShellTerm], log: KernelLog) -> None:
        V = r0.function_space
        self.names = [term.name for term in terms]
        X, w = cell_rule(degree)
        table = Table.tabulate(V.element.basix_element, X)
        parts = [name for name in NAMES if name in FIRST or any(name in term.density.parts for term in terms)]
        self._sheet, self._each = Sheet(table, w, [NAMES.index(part) for part in parts]), len(w)
        cells = self._owned = np.arange(V.mesh.topology.index_map(2).size_local, dtype=np.int32)
        frames = self._frames = cell_frames(V.mesh)
        self._table, self._parts = table, parts
        known = self._known(r0)
        geometry = np.repeat(frames[cells], len(w), axis=0)
        self._gradient = PointGradient(
            terms, parts, len(w), known, geometry, lambda field: at_points(field, X, cells), log, V.mesh.comm
        )

    def _known(self, r0: fem.Function) -> Array:
        known = _placement(r0, self._table, self._frames, self._parts)[self._owned]
        return known.reshape(len(known) * self._each, 3 * len(self._parts))

    def place(self, r0: fem.Function) -> None:
        self._gradient.place(self._known(r0))

    def add(self, nodal: Array, factors: Mapping[str, float], elements: Array) -> None:
        factor = factors.get(self.names[0], 0.0)
        for chunk in self._gradient.chunks if factor else []:
            cells = slice(chunk.start // self._each, chunk.stop // self._each)
            self._sheet.at_points(nodal[cells], self._gradient.room(chunk))
            elements[cells] += factor * self._sheet.at_nodes(self._gradient.evaluate(chunk))


class _Edges:
    """Terms on edges, interior and boundary: the jets on the edges of all cells are found together."""

    def __init__(self, r0: fem.Function, degree: int, terms: Sequence[ShellTerm], log: KernelLog) -> None:
        V = r0.function_space
        self.names = [term.name for term in terms]
        rules = [edge_rule(degree, edge, backwards=False) for edge in range(3)]
        each = len(rules[0][1])
        X, w = np.concatenate([points for points, _ in rules]), np.tile(rules[0][1], 3)
        table = Table.tabulate(V.element.basix_element, X)
        self._sheet = Sheet(table, w, [NAMES.index(part) for part in CURVED])
        frames, cells = cell_frames(V.mesh), np.arange(len(V.dofmap.list), dtype=np.int32)
        self._table, self._frames = table, frames
        placement = self._placed(r0)
        self._there, self._back = np.empty_like(placement), np.empty_like(placement)
        self._rows, self._gradients = [], []
        for term in terms:
            rows, geometry = _where(V, term.density, frames, each)
            known = placement[rows].reshape(len(rows), rows.shape[1] * placement.shape[1])

            def values(field: fem.Function, rows: NDArray[np.intp] = rows) -> Array:
                return at_points(field, X, cells)[rows].reshape(len(rows), rows.shape[1] * field.ufl_shape[0])

            self._rows.append(rows)
            self._gradients.append(PointGradient([term], CURVED, each, known, geometry, values, log, V.mesh.comm))

    def _placed(self, r0: fem.Function) -> Array:
        return _placement(r0, self._table, self._frames, CURVED).reshape(-1, 3 * len(CURVED))

    def place(self, r0: fem.Function) -> None:
        placement = self._placed(r0)
        for gradient, rows in zip(self._gradients, self._rows, strict=True):
            gradient.place(placement[rows].reshape(len(rows), rows.shape[1] * placement.shape[1]))

    def add(self, nodal: Array, factors: Mapping[str, float], elements: Array) -> None:
        active = [
            (g, rows, factors[name])
            for name, rows, g in zip(self.names, self._rows, self._gradients, strict=True)
            if factors.get(name)
        ]
        if not active:
            return
        self._sheet.at_points(nodal, self._there)
        self._back[:] = 0
        for gradient, rows, factor in active:
            for chunk in gradient.chunks:
                here, size = rows[chunk].ravel(), 3 * len(CURVED)
                room = gradient.room(chunk).reshape(-1, size)
                np.take(self._there, here, axis=0, out=room, mode="clip")
                self._back[here] += factor * gradient.evaluate(chunk).reshape(-1, size)
        elements += self._sheet.at_nodes(self._back)


def _placement(r0: fem.Function, table: Table, frames: Array, parts: Sequence[str]) -> Array:
    """(local cells, points, parts, 3) in the cells' own coordinates."""
    nodes = r0.x.array.reshape(-1, 3)[r0.function_space.dofmap.list]
    jet = in_own_coordinates(Jet(*np.moveaxis(table.jets(nodes), 2, 0)), [x[:, None, None] for x in frames.T])
    return np.stack([getattr(jet, part) for part in parts], axis=2)


def _where(V: fem.FunctionSpace, density: Density, frames: Array, each: int) -> tuple[NDArray[np.intp], Array]:
    """(points, sides) among those of all cells' edges, and the geometry that `PointGradient` asks for.

    A rule on an edge is symmetric: run backwards, its points come in the opposite order.
    """
    if density.facets is None:
        cells, edges, backwards = interior_edges(V)
        turned = np.column_stack([np.zeros_like(backwards), backwards])
    else:
        cells, edges = boundary_edges(V, density.facets)
        turned = np.zeros(cells.shape, dtype=bool)
    order = np.where(turned[:, None], np.arange(each)[::-1, None], np.arange(each)[:, None])
    rows = (each * (3 * cells + edges))[:, None] + order
    p, q, s, area = frames[cells].transpose(2, 0, 1)
    first, second = np.array([edge_covector(edge) for edge in range(3)])[edges].transpose(2, 0, 1)
    m = np.stack([area * p * first, area * (q * first + s * second)], axis=2)  # as long as the edge
    width = edge_width(V, tuple(cells.T), edges[:, 0])
    sides = [frames[cells].reshape(-1, FRAME * density.sides), m.reshape(-1, 2 * density.sides), width[:, None]]
    return rows.reshape(-1, density.sides), np.repeat(np.concatenate(sides, axis=1), each, axis=0)
