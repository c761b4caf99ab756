"""The placement on the affine mesh, its named edges and the refusal of bad triangulations."""

import signal
from dataclasses import replace

import numpy as np
import pytest
import ufl
from conftest import hemisphere
from dolfinx import fem
from mpi4py import MPI

from magshell_fenicsx.mesh.midsurface import distribute
from magshell_fenicsx.mesh.patch import MeshError, PatchMesh, check_orientation
from magshell_fenicsx.mesh.shapes import DiscShape, plane_embedding, sphere_embedding
from magshell_fenicsx.mesh.triangulation import triangulate
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.parts.imperfections.dimple import Dimple


def patch(size: float = 0.5) -> PatchMesh:
    return triangulate(
        DiscShape(1.0, half=False), lambda x: size, {"pole": np.zeros(2)}, plane_embedding
    )


@pytest.mark.parametrize("seconds", [1e-3, 3e-3, 1e-2, 2e-2, 3e-2])
def test_an_interrupt_while_gmsh_works(seconds: float) -> None:
    """It ends the triangulation wherever it comes; gmsh may ignore it and take the size 0."""
    previous_handler = signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        with pytest.raises(KeyboardInterrupt):
            patch(size=0.01)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous_handler)


@pytest.mark.parametrize("degree", [2, 3, 4, 5])
def test_nodes_lie_on_the_dimpled_sphere(degree: int) -> None:
    """Interpolation nodes are on the surface, whatever the numbering of the edges' nodes."""
    dimple = Dimple(0.05, 0.5)
    surface = hemisphere(dimple=dimple)
    r0 = surface.placement(
        fem.functionspace(surface.mesh, ("Lagrange", degree, (3,)))
    ).x.array.reshape(-1, 3)
    radius = np.linalg.norm(r0, axis=1)
    phi = np.arccos(r0[:, 2] / radius)
    w0 = np.where(phi < 0.5, -0.05 * (1 - (phi / 0.5) ** 2) ** 2, 0)
    assert radius == pytest.approx(1 + w0, abs=1e-12)


@pytest.mark.parametrize(("degree", "order"), [(2, 2), (3, 4), (4, 4)])
def test_area_converges(degree: int, order: int) -> None:
    errors = []
    for size in (0.4, 0.2):
        surface = hemisphere(size)
        r0 = surface.placement(fem.functionspace(surface.mesh, ("Lagrange", degree, (3,))))
        dx = ufl.dx(metadata={"quadrature_degree": 2 * degree})
        area = fem.assemble_scalar(fem.form(kin.area_ratio(kin.jet(r0, surface.mesh)) * dx))
        errors.append(abs(area / (2 * np.pi) - 1))
    assert np.log2(errors[0] / errors[1]) > order - 0.5


def test_edges_follow_the_rim_of_the_dimple() -> None:
    """Vertices and edge nodes lie on the circle phi = phi_o: no triangle straddles it."""
    dimple = Dimple(0.05, 0.5)
    mesh = triangulate(
        DiscShape(np.pi / 2, False, (0.5,)), lambda x: 0.3, {"pole": np.zeros(2)}, plane_embedding
    )
    phi = np.hypot(*mesh.nodes.T)[mesh.cells[:, :9]]
    inside, outside = phi < dimple.width - 1e-9, phi > dimple.width + 1e-9
    assert not (inside.any(axis=1) & outside.any(axis=1)).any()
    assert inside.any()
    assert outside.any()


def test_normals_point_outwards() -> None:
    surface = hemisphere()
    r0 = surface.placement(fem.functionspace(surface.mesh, ("Lagrange", 3, (3,))))
    j = kin.jet(r0, surface.mesh)
    away = ufl.conditional(ufl.gt(ufl.dot(kin.normal(j), j.r), 0.99), 1.0, 0.0)
    share = fem.assemble_scalar(fem.form(away * ufl.dx)) / fem.assemble_scalar(
        fem.form(1.0 * ufl.dx(surface.mesh))
    )
    assert share == pytest.approx(1.0)


def test_rim_has_all_its_facets() -> None:
    surface = hemisphere(half=True)
    ends = surface.mesh.geometry.x
    for name, distance in {"rim": ends[:, 2], "symmetry": ends[:, 1]}.items():
        surface.mesh.topology.create_connectivity(1, 0)
        on = np.abs(distance) < 1e-12
        assert len(surface.edges[name]) == on.sum() - 1


def test_flipped_triangle_is_refused() -> None:
    good = patch()
    check_orientation(good)
    cells = good.cells.copy()
    cells[3, [0, 1]] = cells[3, [1, 0]]
    with pytest.raises(MeshError, match="opposite sides"):
        distribute(replace(good, cells=cells), MPI.COMM_SELF)


def test_smooth_sphere_has_no_dimple() -> None:
    chart = np.array([[0.3, 0.4], [0.0, 0.0]])
    assert np.linalg.norm(sphere_embedding(chart), axis=1) == pytest.approx(1.0)
