"""Small bodies that several tests share."""

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.mesh.hexahedra import Body, sweep
from magshell_fenicsx.mesh.shapes import DiscShape
from magshell_fenicsx.mesh.sphere import Dimple, SphereEmbedding, flat
from magshell_fenicsx.mesh.triangulation import triangulate


def hemisphere(size: float, h: float, *, layers: int = 1, half: bool = False, dimple: Dimple | None = None) -> Body:
    """A body around the hemisphere of radius 1; the triangles' size holds everywhere."""
    shape = DiscShape(np.pi / 2, half, dimple.phi_o if dimple else None)
    points = {"pole": np.zeros(2)}
    return sweep(triangulate(shape, lambda x: size, points, SphereEmbedding(dimple)), h, layers, MPI.COMM_SELF)


def plate(size: float, h: float, *, layers: int = 1, half: bool = False) -> Body:
    """A disc of radius 1."""
    patch = triangulate(DiscShape(1.0, half), lambda x: size, {"pole": np.zeros(2)}, flat)
    return sweep(patch, h, layers, MPI.COMM_SELF)
