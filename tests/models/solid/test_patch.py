"""The patch test: a uniform deformation is a solution on distorted, straight-edged hexahedra, and
Newton finds it.
"""

import numpy as np
from dolfinx import fem, mesh
from mpi4py import MPI
from rubbers import NEO_HOOKEAN

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.mesh.hexahedra import sweep
from magshell_fenicsx.mesh.shapes import StripShape, plane_embedding
from magshell_fenicsx.mesh.triangulation import triangulate
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.solid.body_densities import CompressibleRubber
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.shells.solid import SolidModel


def test_uniform_deformation() -> None:
    """x = F X, J = 1.02, given on the whole boundary of a block of two layers; kappa/mu = 100."""
    patch = triangulate(StripShape(0.8, False), lambda x: 0.25, {}, plane_embedding)
    body = sweep(patch, 0.3, 2, MPI.COMM_SELF)
    model = SolidModel(
        body,
        Material(0.5, 0.3),
        CompressibleRubber.from_poisson_ratio(NEO_HOOKEAN, 0.5, 100.0),
        {},
        Loads(),
    )
    V = model.V
    outside = fem.locate_dofs_topological(V, 2, mesh.exterior_facet_indices(body.mesh.topology))
    held = [fem.dirichletbc(np.zeros(3), outside, V)]
    system = FiniteElementSystem(model.u, model._terms, held, model._pattern, 1.0)
    F = np.array([[1.3, 0.2, -0.1], [0.0, 0.8, 0.1], [0.15, 0.05, 1.1]])
    H = F * (1.02 / np.linalg.det(F)) ** (1 / 3) - np.eye(3)
    exact = (model.r0.x.array.reshape(-1, 3) @ H.T).ravel()
    inside = system.zero_at_supports(np.ones(system.size))
    assert inside.sum() > 300
    u = exact + 1e-4 * inside * np.random.default_rng(0).standard_normal(system.size)
    factors = Factorisation(body.mesh.comm)
    for _ in range(5):
        factors.factor(system.tangent(u, {}))
        u -= factors.solve(system.residual(u, {}))
    assert np.abs(u - exact).max() < 1e-10
