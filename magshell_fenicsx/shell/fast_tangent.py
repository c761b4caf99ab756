"""The tangent without compiled tangent forms, from the point Hessians of the terms' own densities."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from magshell_fenicsx.shell.energy import HessianTerm, ShellTerm, cell_quadrature, edge_quadrature
from magshell_fenicsx.shell.sites import Site
from magshell_fenicsx.solve.batches import (
    boundary_batches,
    cell_batches,
    cross_entries,
    interior_batches,
    same_cell_entries,
)
from magshell_fenicsx.solve.kernels import KernelLog
from magshell_fenicsx.solve.scatter import ListedMatrix
from magshell_fenicsx.solve.terms import Term

MOST_ENTRIES = 100_000_000  # a rank's list takes 50 bytes an entry while it is set up, 25 later


class FastTangent:
    """The tangent of a sum of terms; a `solve.problem.TangentAssembler`.

    Parameters
    ----------
    u
        The displacement that the terms were written with.
    sites
        Where they live; others may live there too.
    clamped
        Homogeneous Dirichlet conditions.
    """

    def __init__(self, u: fem.Function, sites: Sequence[Site], clamped: list[fem.DirichletBC]) -> None:
        V = u.function_space
        self._u, self._sites = u, sites
        listed = [same_cell_entries(V), *(cross_entries(V, batch) for site in sites for batch in site.coupling)]
        rows, columns = (np.concatenate([x.ravel() for x in part]) for part in zip(*listed, strict=True))
        self._matrix = ListedMatrix(V, rows, columns, clamped)
        functions, same = V.dofmap.list.shape[1], listed[0][0]
        self._same = self._matrix.entries[: same.size].reshape(same.shape)
        self._cross = self._matrix.entries[same.size :].reshape(-1, 9, functions**2)
        a, b = np.triu_indices(functions)
        self._diagonal = np.flatnonzero(a == b)

    def tangent(self, factors: Mapping[str, float]) -> PETSc.Mat:
        """The assembled matrix, at the present u; it is reused by the next call. Collective."""
        same = self._same
        same[:] = 0
        for site in self._sites:
            site.add(self._u.x.array, factors, same, self._cross)
        symmetric, skew = same[:, 3:6], same[:, 6:]
        difference = symmetric - skew  # K_cd at b, a
        symmetric += skew  # K_cd at a, b
        skew[:] = difference
        same[:, :3, self._diagonal] /= 2  # they are their own transposes
        return self._matrix.assemble()


def make_sites(r0: fem.Function, degree: int, terms: Iterable[Term], log: KernelLog) -> list[Site]:
    """The sites of some terms: all cells and all interior edges together, boundary edges term by term. Collective."""
    V = r0.function_space
    found = [t for t in terms if isinstance(t, ShellTerm | HessianTerm) and not t.linear]
    cells = [t for t in found if t.density.facets is None and t.density.sides == 1]
    interior = [t for t in found if t.density.sides == 2]
    sites = []
    if cells:
        sites.append(Site(r0, cell_batches(V, cell_quadrature(degree)), 1, cells, log))
    if interior:
        sites.append(Site(r0, interior_batches(V, edge_quadrature(degree)), 2, interior, log))
    for term in found:
        if term.density.facets is not None:
            batches = boundary_batches(V, edge_quadrature(degree), term.density.facets)
            sites.append(Site(r0, batches, 1, [term], log))
    return sites


def fits(V: fem.FunctionSpace) -> bool:
    """Whether the lists of entries are short enough on every rank; collective."""
    topology = V.mesh.topology
    cells = len(V.dofmap.list)
    functions = V.dofmap.list.shape[1]
    entries = 9 * functions**2 * (cells + 2 * topology.index_map(1).size_local)
    return bool(V.mesh.comm.allreduce(entries, MPI.MAX) <= MOST_ENTRIES)
