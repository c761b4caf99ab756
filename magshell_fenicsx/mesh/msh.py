"""Reading a surface mesh from a file of gmsh (.msh), with triangles of order 1, 2 or 3."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Mirror, cut
from magshell_fenicsx.mesh.msh_format import Content, parsed
from magshell_fenicsx.mesh.nodal_normals import nodal_normals
from magshell_fenicsx.mesh.patch import MeshError, PatchMesh, place_text
from magshell_fenicsx.mesh.soundness import border_edges, oriented
from magshell_fenicsx.platform.reading import Files

Array = NDArray[np.float64]
TRIANGLES, LINES = ("Triangle 3", "Triangle 6", "Triangle 10"), ("Line 2", "Line 3", "Line 4")
NEAR = 1e-6  # distance, over the extent, up to which a vertex counts as a named point


@dataclass(frozen=True)
class MeshFile:
    """A .msh file.

    Attributes
    ----------
    scale
        Factor from its coordinates to lengths over R.
    normals
        Whether nodes are places followed by normals, (n, 6), which the triangles around a node have on average.
    files
        What has its content.
    """

    path: Path
    scale: float
    normals: bool = False
    files: Files = field(default_factory=Files, compare=False)


def in_space(x: Array) -> Array:
    """The embedding of a mesh whose nodes are given in space."""
    return x[..., :3]


def normals(x: Array) -> Array:
    """Unit normals (n, 3) of nodes (n, 6)."""
    return np.asarray(x[:, 3:] / np.linalg.norm(x[:, 3:], axis=1)[:, None])


def read_msh(file: MeshFile, points: Mapping[str, Array], mirror: Mirror | None = None) -> PatchMesh:
    """Read a surface; call it on one rank only.

    Physical groups of surfaces become named patches, those of curves named edges. Triangles whose orientation
    differs from that of the larger area are turned over.

    Parameters
    ----------
    points
        Named places (3,) over R that must be vertices. If no "pole" is named, the highest vertex is the pole.
    mirror
        The plane whose half is read; None for the whole surface.

    Raises
    ------
    MeshError
        If the file cannot be read, or its surface cannot carry a shell; see `soundness`. Places in messages are
        those of the file.
    """
    try:
        patch = _whole(file)
    except MeshError as e:
        raise MeshError(f"shell.file: {e}") from None
    patch = cut(patch, mirror) if mirror else patch
    return replace(patch, points=_vertices(patch.nodes, patch.cells, points, file.scale))


def _whole(file: MeshFile) -> PatchMesh:
    nodes, cells, patches, edges = _content(file)
    used, again = np.unique(cells, return_inverse=True)  # drops nodes without a triangle
    cells = again.reshape(cells.shape)
    number = np.full(len(nodes), -1, dtype=np.int64)
    number[used] = np.arange(len(used))
    nodes = nodes[used]
    for name, pairs in edges.items():
        edges[name] = number[pairs]
        if (edges[name] < 0).any():
            raise MeshError(f"{file.path}: the physical curve {name} is not part of the surface")
    cells = oriented(nodes, cells)
    edges = border_edges(nodes, cells, edges)
    nodes = nodes * file.scale
    if file.normals:
        nodes = np.column_stack([nodes, nodal_normals(nodes, cells)])
    return PatchMesh(nodes, cells, in_space, edges, patches=patches)


def cell_count(file: MeshFile) -> int:
    """How many triangles are in it; none in a file that cannot be read, which `read_msh` reports."""
    try:
        held = parsed(file.files.content(file.path))
    except (OSError, MeshError):
        return 0
    return sum(len(nodes) for _, dim, _, nodes in held.blocks if dim == 2)


def _vertices(nodes: Array, cells: NDArray[np.int64], points: Mapping[str, Array], scale: float) -> dict[str, Array]:
    corners = nodes[np.unique(cells[:, :3])]
    highest = corners[np.lexsort(np.round(corners[:, :3], 9).T)[-1]]
    found = {"pole": highest}
    for name, x in points.items():
        distance = np.linalg.norm(corners[:, :3] - x[:3], axis=1)
        nearest = corners[np.argmin(distance)]
        if distance.min() > NEAR * np.ptp(corners[:, :3], axis=0).max():
            wanted, near = (place_text(np.divide(place, scale)) for place in (x, nearest))
            raise MeshError(
                f"points.{name}: {wanted} in the file's coordinates is no vertex of the mesh; the nearest is {near}"
            )
        found[name] = nearest
    return found


def _content(
    file: MeshFile,
) -> tuple[Array, NDArray[np.int64], dict[str, NDArray[np.bool_]], dict[str, NDArray[np.int64]]]:
    """Nodes (n, 3), cells, patches and edges (vertex pairs)."""
    try:
        held = parsed(file.files.content(file.path))
    except FileNotFoundError:
        raise MeshError(f"{file.path}: there is no such mesh file") from None
    except OSError as e:
        raise MeshError(f"{file.path}: cannot be read: {e.strerror}") from None
    except MeshError as e:
        raise MeshError(f"{file.path}: {e}") from None
    if not len(held.tags):
        raise MeshError(f"{file.path}: there is no mesh in it")
    faces = _elements(file, held, 2, TRIANGLES)
    if len({nodes.shape[1] for _, nodes in faces}) != 1:
        raise MeshError(f"{file.path}: it has no triangles, or triangles of several orders")
    cells = _places(file, held, np.concatenate([nodes for _, nodes in faces]))
    entity = np.concatenate([np.full(len(nodes), entity) for entity, nodes in faces])
    patches = {name: np.isin(entity, entities) for name, entities in held.groups[2].items()}
    edges = {}
    for name, entities in held.groups[1].items():
        lines = [nodes[:, :2] for entity, nodes in _elements(file, held, 1, LINES) if entity in entities]
        if lines:  # a curve of the geometry may have no elements
            edges[name] = _places(file, held, np.concatenate(lines))
    return held.places, cells, patches, edges


def _elements(
    file: MeshFile, held: Content, dimension: int, known: Collection[str]
) -> list[tuple[int, NDArray[np.int64]]]:
    """Entity and nodes of the blocks of one dimension."""
    found = []
    for name, dim, entity, nodes in held.blocks:
        if dim == dimension:
            if name not in known:
                raise MeshError(f"{file.path}: it has elements {name}; allowed are triangles of order 1, 2 and 3")
            found.append((entity, nodes))
    return found


def _places(file: MeshFile, held: Content, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices of the nodes with these numbers."""
    order = np.argsort(held.tags)
    found: NDArray[np.int64] = order[np.searchsorted(held.tags, numbers, sorter=order).clip(max=len(order) - 1)]
    if (missing := held.tags[found] != numbers).any():
        raise MeshError(f"{file.path}: it has elements with the node {numbers[missing][0]}, which is not there")
    return found
