"""A surface in few flat triangles, the same of every displacement."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.tessellation import Tessellation, tessellated

Array = NDArray[np.float64]
SAME = 1e-7  # places over R that are one vertex
MOST = 8000  # triangles of a curved mesh


@dataclass(frozen=True)
class Thinned:
    """Vertices that represent a surface, and triangles (m, 3) of their numbers."""

    pieces: Tessellation
    kept: NDArray[np.int64]
    triangles: NDArray[np.int64]

    @property
    def count(self) -> int:
        """The number of vertices."""
        return len(self.kept)

    def at(self, values: Array) -> Array:
        """Values of nodes at the vertices."""
        return self.pieces.at(values)[self.kept]


def thinned(surface: Surface, most: int) -> Thinned:
    """The surface in at most about `most` vertices; where there are more, those within a small cube become one."""
    pieces = tessellated(surface, MOST)
    r, size = pieces.at(surface.r0), SAME
    kept, triangles = _joined(r, pieces.triangles, size)
    size = 0.5 * float(np.ptp(r, axis=0).max()) / np.sqrt(most)
    while len(kept) > most:
        kept, triangles = _joined(r, pieces.triangles, size)
        size *= 1.3
    outwards, corners = pieces.at(surface.n0)[kept][triangles].sum(axis=1), r[kept][triangles]
    turned = np.einsum("ij,ij->i", np.cross(*np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 0)), outwards) < 0
    triangles[turned] = triangles[turned][:, ::-1]  # the image of a half has the other orientation
    return Thinned(pieces, kept, triangles)


def _joined(r: Array, triangles: NDArray[np.int32], size: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    cubes = np.rint((r - r.min(axis=0)) / size).astype(np.int64)
    key = (cubes[:, 0] * (1 << 42)) ^ (cubes[:, 1] * (1 << 21)) ^ cubes[:, 2] if size > 1e-5 else _exact(cubes)
    _, kept, number = np.unique(key, return_index=True, return_inverse=True)
    found = number[triangles]
    whole = (found[:, 0] != found[:, 1]) & (found[:, 1] != found[:, 2]) & (found[:, 2] != found[:, 0])
    return kept, found[whole]


def _exact(cubes: NDArray[np.int64]) -> NDArray[np.void]:
    """Rows as single values."""
    return np.ascontiguousarray(cubes).view([("", cubes.dtype)] * 3).ravel()
