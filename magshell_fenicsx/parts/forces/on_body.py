"""Concentrated and spread loads of a solid: the entries of their load vectors.

A body is a shell as a solid of hexahedra, between an inner and an outer face. Loads of its
mid-surface are spread through the thickness, so measures of length and area are integrals over
faces and volumes, divided by the thickness. A pattern is a load as a function of the undeformed
place and normal, as by a formula. Entries of a load vector are numbers of degrees of freedom and
values, owned by this rank. Lengths are over R.
"""

from dataclasses import replace

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.mesh.hexahedra import MIDSURFACE_HEIGHT, OUTER_FACE, BodyMesh, face_measure
from magshell_fenicsx.models.shell.spatial_fields import (
    Pattern,
    body_cell_geometry,
    body_positions_and_normals,
    project_pattern,
    refuse_unbounded,
)
from magshell_fenicsx.models.shell.thickness import patch_of
from magshell_fenicsx.parts.forces.load_vectors import (
    Entries,
    Weighted,
    averaged,
    patch_indicator,
    smooth,
)
from magshell_fenicsx.platform import compat

Array = NDArray[np.float64]
WEIGHT_DEGREE = 8  # quadrature degree of a patch's weight


class BodyMeasures:
    """The `Measures` of a body in three dimensions, for loads of its mid-surface.

    Loads are spread evenly through the thickness. Their resultants are the shell's where the
    mid-surface is flat, else to the order of (h/R)^2.

    Parameters
    ----------
    body
        Mesh of the body.
    V
        Space of the displacement.
    log
        Compiles forms.

    The field `_thickness` is the thickness over R as a field in the body.
    """

    def __init__(self, body: BodyMesh, V: fem.FunctionSpace, log: KernelLog) -> None:
        """Take the body's mesh, with its normals and the thickness as fields."""
        self._body, self._V, self._log = body, V, log
        # the first two reference directions of a cell are along the surface
        J = ufl.Jacobian(body.mesh)
        area_vector = ufl.cross(J[:, 0], J[:, 1])
        self.normal = area_vector / ufl.sqrt(ufl.dot(area_vector, area_vector))
        thickness_space = fem.functionspace(body.mesh, ("Lagrange", 2))
        self._thickness = fem.Function(thickness_space)
        self._thickness.x.array[:] = body.at_nodes(thickness_space, body.thickness)

    def edge(self, name: str) -> Weighted:
        """Return the measure of undeformed length: the edge's face over the thickness."""
        # (1) is the tag of the first face of the list
        ds = face_measure(self._body.mesh, [self._body.faces[name]])(1)
        return Weighted(1 / self._thickness, ds)

    def area(self, patch: str | None) -> Weighted:
        """Return the measure of undeformed area on a named patch: volume over the thickness."""
        body, weight = self._body, 1 / self._thickness
        if patch is not None:
            weight = weight * patch_indicator(body.mesh, patch_of(body.patches, patch))
        return Weighted(
            weight, ufl.Measure("dx", domain=body.mesh, metadata={"quadrature_degree": 4})
        )

    def field(self, pattern: Pattern, edge: str | None) -> tuple[Expr, float | None]:
        """Return the field of a pattern in the body, constant through the thickness; collective.

        The pattern is taken on the mid-surface under each node. The integral of its size is not
        known, hence None.
        """
        # (cells, nodes, 3) places of nodes and normals there; the heights of nodes over the
        # mid-surface; and the feet, the places of the mid-surface under the nodes
        nodes, normals = body_positions_and_normals(self._V)
        heights = (self._body.heights - MIDSURFACE_HEIGHT) * self._body.thickness
        height = self._body.at_nodes(self._V, heights)[self._V.dofmap.list]
        feet = nodes - height[..., None] * normals
        # vectors of the pattern at these places
        field = fem.Function(
            fem.functionspace(self._V.mesh, ("DG", self._V.element.basix_element.degree, (3,)))
        )
        vectors = pattern(feet, normals)
        refuse_unbounded(vectors, nodes, self._V.mesh.comm, "loading.loads")
        # over the surface a formula is projected, so that its moments in each cell are exact; on an
        # edge its values at nodes are taken
        if edge is None:
            midsurface_cells = replace(body_cell_geometry(self._V), nodal=feet)
            vectors = project_pattern(
                pattern, midsurface_cells, vectors, field.function_space.element.basix_element
            ).nodal
        field.x.array.reshape(-1, 3)[field.function_space.dofmap.list] = vectors
        return field, None

    def at_point(self, name: str, force: Array) -> Entries:
        """Return the entries of a force (3,) over a patch around a named point; collective.

        In a solid a force at a point would sink in without limit. The patch has the radius h, or is
        as large as the elements around the point. It reaches through the thickness.
        """
        domain, x, n = self._body.mesh, self._body.points[name], self._body.normals[name]
        centre, normal = (fem.Constant(domain, v) for v in (x, n))
        from_point = ufl.SpatialCoordinate(domain) - centre
        height, h = ufl.dot(from_point, normal), thickness_at(self._body, x)
        # at least as large as the cells at the point reach from its normal line
        radius = fem.Constant(domain, max(h, self._reach(x, n)))
        # 1 in the shell at the point, 0 on the far side of a closed shell
        is_in_shell = ufl.conditional(ufl.lt(abs(height), fem.Constant(domain, h)), 1.0, 0.0)
        weight = is_in_shell * smooth(from_point - height * normal, radius)
        dx = ufl.Measure("dx", domain=domain, metadata={"quadrature_degree": WEIGHT_DEGREE})
        return averaged(self._V, force, Weighted(weight, dx), self._log)

    def _reach(self, x: Array, n: Array) -> float:
        """Return the largest distance over R of nodes around a point from the normal line there.

        The nodes are those of the cells at the point; collective.

        Parameters
        ----------
        x, n
            (3,) place of the point, and unit normal.
        """
        # (cells, nodes, 3): nodes of all cells from the point, and those of the cells that have it
        from_x = self._body.mesh.geometry.x[compat.geometry_dofs(self._body.mesh)] - x
        has_x = (np.linalg.norm(from_x, axis=2) < 1e-9).any(axis=1)
        nodes_around = from_x[has_x]
        from_normal = nodes_around - (nodes_around @ n)[..., None] * n
        own_largest = np.linalg.norm(from_normal, axis=2).max(initial=0.0)
        return float(self._V.mesh.comm.allreduce(own_largest, MPI.MAX))


def thickness_at(body: BodyMesh, x: Array) -> float:
    """Return the thickness over R at a vertex x (3,) of the mid-surface; collective."""
    is_at_x = np.linalg.norm(body.mesh.geometry.x - x, axis=1) < 1e-9
    return float(body.mesh.comm.allreduce(body.thickness[is_at_x].max(initial=0.0), MPI.MAX))


def outer_patch(
    body: BodyMesh, V: fem.FunctionSpace, point: str, radius: float, log: KernelLog
) -> Entries:
    """Return the entries of an inward force averaged over a patch of the outer face; collective.

    The weight is `smooth` around a named point.

    Parameters
    ----------
    radius
        Radius of the patch over R.
    """
    x, normal = body.points[point], body.normals[point]
    # the centre on the outer face, half a thickness from the mid-surface
    centre = fem.Constant(body.mesh, x + thickness_at(body, x) / 2 * normal)
    a = fem.Constant(body.mesh, radius)
    weight = smooth(ufl.SpatialCoordinate(body.mesh) - centre, a)
    ds = face_measure(body.mesh, [body.faces[OUTER_FACE]])(1)
    return averaged(V, -normal, Weighted(weight, ds), log, radius)
