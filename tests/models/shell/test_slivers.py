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
from magshell_fenicsx.simulate.undeformed_instability import cause_of_instability

Array = NDArray[np.float64]
LINES = np.array([0, 1 / 3, 1 / 3 + 4e-4, 2 / 3, 1])  # a column of cells 800 times as narrow


def crossed(x: Array, y: Array) -> mesh.Mesh:
    """A plate of rectangles between lines, each divided into four triangles."""
    places = [(a, b, 0.0) for a in x for b in y]
    cells = []
    for i, (left, right) in enumerate(pairwise(x)):
        for j, (low, high) in enumerate(pairwise(y)):
            first = i * len(y) + j
            ring = [first, first + len(y), first + len(y) + 1, first + 1]
            cells += [(ring[n], ring[(n + 1) % 4], len(places)) for n in range(4)]
            places.append(((left + right) / 2, (low + high) / 2, 0.0))
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(3,))
    return mesh.create_mesh(
        MPI.COMM_SELF, cells=np.array(cells), e=ufl.Mesh(element), x=np.array(places)
    )


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


@pytest.mark.parametrize("thick", [1.0, 10.0])
@pytest.mark.parametrize("degree", [2, 3, 4])
def test_slivers_across_each_other(degree: int, thick: float) -> None:
    """Columns and rows of slivers, cells of a thousand times the stiffness beside soft ones, and a
    quarter of the default: sigma = 3 k (k - 1)/2 is enough by the trace inequality."""
    problem = clamped_plate(
        crossed(LINES, LINES), degree, thick, penalty=default_penalty(degree) / 4
    )
    scene = ms.Scene(problem)
    assert scene.newton.factor_at(scene.unloaded()).negative_pivots == 0


def test_too_small_a_penalty_is_told_with_its_place() -> None:
    """With the default as the value that helps."""
    domain = crossed(np.array([0, 0.5, 1]), np.array([0, 0.5]))
    scene = ms.Scene(clamped_plate(domain, 3, 1.0, penalty=0.5))
    with pytest.raises(Stopped, match=r"around \(.*\), over R: take mesh.penalty: 45, the default"):
        list(ms.follow(scene))


def test_a_triangle_that_is_turned_over() -> None:
    """The place of the middle of a curved side goes beyond the opposite corner."""
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    middles = [(0.5, 0, 0), (1.2, 0.1, 0), (1, 0.5, 0), (0, 0.5, 0), (0.5, 1, 0)]
    # corners, then the middles of the sides opposite to them
    cells = [(0, 1, 2, 6, 5, 4), (0, 2, 3, 8, 7, 5)]
    element = basix.ufl.element("Lagrange", "triangle", 2, shape=(3,))
    places = np.array([*corners, *middles], dtype=np.float64)
    domain = mesh.create_mesh(MPI.COMM_SELF, cells=np.array(cells), e=ufl.Mesh(element), x=places)
    scene = ms.Scene(clamped_plate(domain, 4, 1.0))
    cause = cause_of_instability(scene, scene.unloaded())
    assert "the curved triangle around" in cause
    assert "is turned over in part" in cause
