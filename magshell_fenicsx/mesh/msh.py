"""A surface that somebody else meshed: gmsh's .msh with triangles of order 1, 2 or 3."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Mirror, cut
from magshell_fenicsx.mesh.msh_format import Block, Content, parsed
from magshell_fenicsx.mesh.patch import MeshError, PatchMesh
from magshell_fenicsx.mesh.soundness import border_edges, oriented, said_place

Array = NDArray[np.float64]
TRIANGLES, LINES = ("Triangle 3", "Triangle 6", "Triangle 10"), ("Line 2", "Line 3", "Line 4")
NEAR = 1e-6  # of the extent, within which a named point is a vertex


@dataclass(frozen=True)
class MeshFile:
    """A .msh file.

    Attributes
    ----------
    path
        Of the file.
    scale
        From its coordinates to lengths of R.
    """

    path: Path
    scale: float


def in_space(x: Array) -> Array:
    """The chart of a mesh that lies in space already."""
    return x


def read_msh(file: MeshFile, points: Mapping[str, Array], mirror: Mirror | None = None) -> PatchMesh:
    """Read a surface; call it on one rank only.

    Physical groups of surfaces become named patches, those of curves named edges. Triangles that run the
    other way round than most are turned over.

    Parameters
    ----------
    points
        Named places (3,) that must be vertices, in lengths of R. Without a "pole" it is the highest vertex.
    mirror
        Of the half that is taken; None for all.

    Raises
    ------
    MeshError
        If the file cannot be read, or holds no sound surface; see `soundness`.
    """
    patch = _whole(file)
    patch = cut(patch, mirror) if mirror else patch
    return replace(patch, points=_vertices(patch.nodes, patch.cells, points))


def _whole(file: MeshFile) -> PatchMesh:
    nodes, cells, patches, edges = _content(file)
    used, again = np.unique(cells, return_inverse=True)  # without nodes that no triangle has
    cells = again.reshape(cells.shape)
    number = np.full(len(nodes), -1, dtype=np.int64)
    number[used] = np.arange(len(used))
    nodes = nodes[used] * file.scale
    for name, pairs in edges.items():
        edges[name] = number[pairs]
        if (edges[name] < 0).any():
            raise MeshError(f"{file.path}: the physical curve {name} is not part of the surface")
    cells = oriented(nodes, cells)
    edges = border_edges(nodes, cells, edges)
    return PatchMesh(nodes, cells, in_space, edges, patches=patches)


def _vertices(nodes: Array, cells: NDArray[np.int64], points: Mapping[str, Array]) -> dict[str, Array]:
    corners = nodes[np.unique(cells[:, :3])]
    highest = corners[np.lexsort(np.round(corners, 9).T)[-1]]
    found = {"pole": highest}
    for name, x in points.items():
        distance = np.linalg.norm(corners - x, axis=1)
        nearest = corners[np.argmin(distance)]
        if distance.min() > NEAR * np.ptp(corners, axis=0).max():
            raise MeshError(f"the point {name} is no vertex of the mesh; the nearest, over R, is {said_place(nearest)}")
        found[name] = nearest
    return found


def _content(
    file: MeshFile,
) -> tuple[Array, NDArray[np.int64], dict[str, NDArray[np.bool_]], dict[str, NDArray[np.int64]]]:
    """Nodes (n, 3), cells, patches and edges (vertex pairs)."""
    if not file.path.is_file():
        raise MeshError(f"{file.path}: there is no such mesh file")
    try:
        held = parsed(file.path.read_bytes())
    except OSError as e:
        raise MeshError(f"{file.path}: cannot be read: {e.strerror}") from None
    except MeshError as e:
        raise MeshError(f"{file.path}: {e}") from None
    if not len(held.tags):
        raise MeshError(f"{file.path}: there is no mesh in it")
    faces = [block for block in held.blocks if block.dimension == 2]
    if len({_cells(file, block, TRIANGLES).shape[1] for block in faces}) != 1:
        raise MeshError(f"{file.path}: it has no triangles, or triangles of several orders")
    cells = _places(file, held, np.concatenate([block.nodes for block in faces]))
    entity = np.concatenate([np.full(len(block.nodes), block.entity) for block in faces])
    patches = {name: np.isin(entity, sorted(entities)) for name, entities in _groups(held, 2).items()}
    edges = {}
    for name, entities in _groups(held, 1).items():
        lines = [block for block in held.blocks if block.dimension == 1 and block.entity in entities]
        if lines:  # a curve of the drawing may carry no elements
            edges[name] = _places(file, held, np.concatenate([_cells(file, line, LINES)[:, :2] for line in lines]))
    return held.places, cells, patches, edges


def _cells(file: MeshFile, block: Block, known: Collection[str]) -> NDArray[np.int64]:
    if block.name not in known:
        raise MeshError(f"{file.path}: it has elements {block.name}; allowed are triangles of order 1, 2 and 3")
    return block.nodes


def _places(file: MeshFile, held: Content, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where the nodes of elements stand among all."""
    order = np.argsort(held.tags)
    found: NDArray[np.int64] = order[np.searchsorted(held.tags, numbers, sorter=order).clip(max=len(order) - 1)]
    if (missing := held.tags[found] != numbers).any():
        raise MeshError(f"{file.path}: it has elements with the node {numbers[missing][0]}, which is not there")
    return found


def _groups(held: Content, dim: int) -> dict[str, set[int]]:
    """Name of each physical group -> its entities; without a name, its number."""
    found: dict[int, set[int]] = {}
    for (of, entity), groups in held.groups.items():
        for group in groups if of == dim else ():
            found.setdefault(group, set()).add(entity)
    return {held.names.get((dim, group)) or str(group): found[group] for group in sorted(found)}
