"""Small bodies that several tests share."""

from typing import Any

import numpy as np
from conftest import spherical
from mpi4py import MPI

from magshell_fenicsx import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.mesh.hexahedra import BodyMesh, sweep
from magshell_fenicsx.mesh.shapes import DiscShape, plane_embedding
from magshell_fenicsx.mesh.triangulation import triangulate
from magshell_fenicsx.parts.imperfections.dimple import Dimple


def hemisphere(
    size: float, h: float, *, layers: int = 1, half: bool = False, dimple: Dimple | None = None
) -> BodyMesh:
    """A body around the hemisphere of radius 1; the triangles' size holds everywhere."""
    shape = DiscShape(np.pi / 2, half, (dimple.width,) if dimple else ())
    points = {"pole": np.zeros(2)}
    return sweep(
        triangulate(shape, lambda x: size, points, spherical(dimple)), h, layers, MPI.COMM_SELF
    )


def plate(size: float, h: float, *, layers: int = 1, half: bool = False) -> BodyMesh:
    """A disc of radius 1."""
    patch = triangulate(
        DiscShape(1.0, half), lambda x: size, {"pole": np.zeros(2)}, plane_embedding
    )
    return sweep(patch, h, layers, MPI.COMM_SELF)


def body_of(
    shell: dict[str, Any], size: float, *, layers: int = 1, points: Any = None, factor: Any = None
) -> BodyMesh:
    """A body around a shell as a case describes it."""
    data = {
        "shell": {"poisson_ratio": 0.3, **shell},
        "boundary": {},
        "points": points or {},
        "mesh": {"size": size},
    }
    problem = make_problem(Case.from_source(data))
    return sweep(problem.triangulated(), problem.material.h, layers, MPI.COMM_SELF, factor)
