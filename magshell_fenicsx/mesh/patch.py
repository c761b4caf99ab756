"""A triangulated surface as it leaves the mesh generator, before dolfinx."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Embedding = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class PatchMesh:
    """Triangles of order 1, 2 or 3 with named edges and points.

    Attributes
    ----------
    nodes
        (n, d) coordinates: of a chart (d = 2) or of space (d = 3).
    cells
        (m, 3 | 6 | 10) node numbers in gmsh's order, vertices first.
    embedding
        Maps (n, d) coordinates to (n, 3) points of the mid-surface.
    edges
        Name -> (e, 2) vertex pairs of that boundary edge.
    points
        Name -> (d,) coordinates of a vertex of the mesh.
    one
        (n,) the node that each is glued to (itself where it is not): the two have one place in space
        and are one vertex; `edges` are told in these numbers. None where nothing is glued.
    patches
        Name -> (m,) whether each triangle belongs to that part of the surface.
    """

    nodes: NDArray[np.float64]
    cells: NDArray[np.int64]
    embedding: Embedding
    edges: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    points: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    one: NDArray[np.int64] | None = None
    patches: dict[str, NDArray[np.bool_]] = field(default_factory=dict)

    @property
    def corners(self) -> NDArray[np.int64]:
        """(m, 3) vertices of the triangles, glued ones under one number."""
        corners = self.cells[:, :3]
        return corners if self.one is None else self.one[corners]


class MeshError(ValueError):
    """The triangulation cannot carry a shell; the message says where and why."""


def check_orientation(patch: PatchMesh) -> None:
    """Refuse a triangulation whose normals do not all point to one side.

    Raises
    ------
    MeshError
        If two neighbours run through their common edge in the same direction, or
        if more than two triangles share an edge.
    """
    corners = patch.corners
    directed = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    same_way, times = np.unique(directed, axis=0, return_counts=True)
    if (times > 1).any():
        a, b = same_way[times > 1][0]
        where = patch.embedding(patch.nodes[[a, b]]).mean(axis=0)
        raise MeshError(
            f"the normals of two neighbouring triangles point to opposite sides (or three triangles meet) "
            f"at the edge around ({where[0]:.4g}, {where[1]:.4g}, {where[2]:.4g})"
        )
