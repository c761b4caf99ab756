"""The interior penalty holds the undeformed shell: slivers, and stiff cells beside soft ones."""

from itertools import pairwise

import basix.ufl
import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI
from numpy.typing import NDArray

import magshell_fenicsx as ms
from magshell_fenicsx.models.shell.parameters import default_penalty
from magshell_fenicsx.simulate.record import Stopped

Array = NDArray[np.float64]
LINES = np.array([0, 1 / 3, 1 / 3 + 4e-4, 2 / 3, 1])  # a column of cells 800 times as narrow


def crossed(x: Array, y: Array, bend: float = 0.0) -> mesh.Mesh:
    """Rectangles between lines, each divided into four triangles, on z = bend (x^2 - y^2)/2."""
    places, cells = [(a, b) for a in x for b in y], []
    for i, (left, right) in enumerate(pairwise(x)):
        for j, (low, high) in enumerate(pairwise(y)):
            first = i * len(y) + j
            ring = [first, first + len(y), first + len(y) + 1, first + 1]
            cells += [(ring[n], ring[(n + 1) % 4], len(places)) for n in range(4)]
            places.append(((left + right) / 2, (low + high) / 2))

    def mesh_of(cells: NDArray[np.int64], places: Array, order: int) -> mesh.Mesh:
        """Triangles with nodes (n, 2) or (n, 3)."""
        shape = (places.shape[1],)
        domain = ufl.Mesh(basix.ufl.element("Lagrange", "triangle", order, shape=shape))
        return mesh.create_mesh(MPI.COMM_SELF, cells=cells, e=domain, x=places)

    # quadratic triangles have this surface exactly
    flat = mesh_of(np.array(cells), np.array(places), 1)
    V = fem.functionspace(flat, ("Lagrange", 2))
    a, b = V.tabulate_dof_coordinates()[:, :2].T
    nodes = np.column_stack([a, b, bend * (a**2 - b**2) / 2])
    return mesh_of(V.dofmap.list.astype(np.int64), nodes, 2)


def clamped_plate(domain: mesh.Mesh, degree: int, thick: float, **numbers: float) -> ms.Problem:
    """Clamped at x = 0; `thick` is the thickness of every second cell over that of the others."""
    facets = mesh.locate_entities_boundary(domain, 1, lambda x: np.isclose(x[0], 0))
    rest = np.setdiff1d(mesh.exterior_facet_indices(domain.topology), facets)
    all_facets = np.concatenate([facets, rest])
    order = np.argsort(all_facets)
    tags = np.repeat(np.array([1, 2], dtype=np.int32), [len(facets), len(rest)])
    factor = fem.Function(fem.functionspace(domain, ("DG", 0)))
    factor.x.array[:] = np.where(np.arange(len(factor.x.array)) % 2, thick, 1.0)
    shell = ms.Shell(
        domain,
        edges={"root": 1, "rest": 2},
        facet_tags=mesh.meshtags(domain, 1, all_facets[order], tags[order]),
        radius=1,
        thickness=0.01,
        thickness_factor=factor,
        youngs_modulus=1,
        poisson_ratio=0.3,
    )
    return ms.Problem(shell, ms.Clamped("root"), ms.Pressure(), mesh={"degree": degree, **numbers})


@pytest.mark.parametrize(
    ("degree", "thick", "bend"),
    [(2, 1, 0), (2, 10, 1), (3, 10, 0), (3, 1, 1), (4, 1, 0), (4, 10, 1)],
)
def test_slivers_across_each_other(degree: int, thick: float, bend: float) -> None:
    """Columns and rows of slivers, cells of a thousand times the stiffness beside soft ones, and a
    quarter of the default: sigma = 3 k (k - 1)/2 is enough by the trace inequality. Where the
    surface bends, flat triangles through the corners of a sliver are twenty times as high."""
    domain, penalty = crossed(LINES, LINES, bend), default_penalty(degree) / 4
    scene = ms.Scene(clamped_plate(domain, degree, thick, penalty=penalty))
    assert scene.newton.factor_at(scene.unloaded()).negative_pivots == 0


def test_too_small_a_penalty_is_told_with_its_place() -> None:
    """With the default as the value that helps."""
    domain = crossed(np.array([0, 0.5, 1]), np.array([0, 0.5]))
    scene = ms.Scene(clamped_plate(domain, 3, 1.0, penalty=0.5))
    with pytest.raises(Stopped, match=r"around \(.*\), over R: take mesh.penalty: 45, the default"):
        list(ms.follow(scene))
