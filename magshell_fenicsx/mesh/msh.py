"""Reading a surface that somebody else meshed: gmsh's .msh with triangles of order 1, 2 or 3."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import MeshError, PatchMesh
from magshell_fenicsx.mesh.soundness import border_edges, oriented, said_place

Array = NDArray[np.float64]
TRIANGLES, LINES, VERTEX = {2: 3, 9: 6, 21: 10}, {1: 2, 8: 3, 26: 4}, 15  # gmsh's types -> their nodes
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


def read_msh(file: MeshFile, points: Mapping[str, Array]) -> PatchMesh:
    """Read a surface; call it on one rank only.

    Physical groups of surfaces become named patches, those of curves named edges. Triangles that run the
    other way round than most are turned over.

    Parameters
    ----------
    points
        Named places (3,) that must be vertices, in lengths of R. Without a "pole" it is the highest vertex.

    Raises
    ------
    MeshError
        If the file cannot be read, or holds no sound surface; see `soundness`.
    """
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
    return PatchMesh(nodes, cells, in_space, edges, _vertices(nodes, cells, points), patches=patches)


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
    import gmsh

    if not file.path.is_file():
        raise MeshError(f"{file.path}: there is no such mesh file")
    with _session():
        try:
            gmsh.open(str(file.path))
        except Exception as e:  # gmsh's own errors have no class of their own
            raise MeshError(f"{file.path}: gmsh cannot read it: {e}") from None
        tags, xyz, _ = gmsh.model.mesh.getNodes()
        if not len(tags):
            raise MeshError(f"{file.path}: there is no mesh in it")
        number = np.full(int(tags.max()) + 1, -1, dtype=np.int64)
        number[tags.astype(np.int64)] = np.arange(len(tags))
        parts, where = _elements(file, 2, TRIANGLES, number)
        if len({part.shape[1] for part in parts}) != 1:
            raise MeshError(f"{file.path}: it has no triangles, or triangles of several orders")
        cells = np.concatenate(parts)
        entity = np.concatenate([np.full(len(part), tag) for part, tag in zip(parts, where, strict=True)])
        patches = {name: np.isin(entity, tags) for name, tags in _groups(2).items()}
        edges = {}
        for name, tags in _groups(1).items():
            lines = [_elements(file, 1, LINES, number, int(tag))[0] for tag in tags]
            pairs = [part[:, :2] for each in lines for part in each]
            if pairs:  # a curve of the drawing may carry no elements
                edges[name] = np.concatenate(pairs)
        return xyz.reshape(-1, 3).copy(), cells, patches, edges


@contextmanager
def _session() -> Iterator[None]:
    """gmsh while inside; one that the caller has open keeps its own model."""
    import gmsh

    if not gmsh.isInitialized():
        gmsh.initialize(interruptible=False)
        try:
            gmsh.option.setNumber("General.Terminal", 0)
            yield
        finally:
            gmsh.finalize()
        return
    callers, before = gmsh.model.getCurrent(), set(gmsh.model.list())
    try:
        yield
    finally:
        if gmsh.model.getCurrent() != callers or len(gmsh.model.list()) > len(before):
            gmsh.model.remove()
        gmsh.model.setCurrent(callers)


def _elements(
    file: MeshFile, dim: int, known: Mapping[int, int], number: NDArray[np.int64], tag: int = -1
) -> tuple[list[NDArray[np.int64]], list[int]]:
    """Node numbers (m, k) of the elements of each entity, and its tag."""
    import gmsh

    parts, where = [], []
    for _, entity in gmsh.model.getEntities(dim) if tag < 0 else [(dim, tag)]:
        for kind, _, nodes in zip(*gmsh.model.mesh.getElements(dim, entity), strict=True):
            if kind not in known:
                name = gmsh.model.mesh.getElementProperties(kind)[0]
                raise MeshError(f"{file.path}: it has elements {name}; allowed are triangles of order 1, 2 and 3")
            parts.append(number[nodes.astype(np.int64)].reshape(-1, known[kind]))
            where.append(entity)
    return parts, where


def _groups(dim: int) -> dict[str, NDArray[np.int64]]:
    """Name of each physical group -> its entities; without a name, its number."""
    import gmsh

    groups = [tag for _, tag in gmsh.model.getPhysicalGroups(dim)]
    return {
        gmsh.model.getPhysicalName(dim, tag) or str(tag): gmsh.model.getEntitiesForPhysicalGroup(dim, tag)
        for tag in groups
    }
