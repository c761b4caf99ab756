"""A body around a mid-surface: hexahedra of degree 2, swept through the thickness."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import basix
import basix.ufl
import numpy as np
from dolfinx import fem, mesh
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.midsurface import create_mesh
from magshell_fenicsx.mesh.patch import Deviated, MeshError, PatchMesh, as_set, place_text
from magshell_fenicsx.mesh.quadrilaterals import Quadrilaterals, split, square
from magshell_fenicsx.platform import compat

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
OUTER = ""  # face: a name that no edge has, while an annulus has an edge "outer"
MIDDLE = 0.5  # of the thickness


@dataclass(frozen=True)
class Body:
    """A body on all ranks.

    Attributes
    ----------
    mesh
        Hexahedra with geometry of degree 2; the third coordinate of their reference cell runs outwards.
    faces
        Name -> facets (local numbers): those of `OUTER`, and those above each named edge of the mid-surface.
    points, normals
        Name -> (3,) position of a node in the middle of the thickness, and the mid-surface's normal there.
    patches
        Name -> whether each local cell is above that part of the mid-surface.
    between
        (cells, 2) where each local cell begins and ends in the thickness: from 0 inside to 1 outside.
    chart, heights, thickness
        Of each node of the geometry: the chart's coordinates (n, d) under it, where it is in the thickness, from 0 to
        1, and h(x) over R; see `at_nodes`.
    w0
        Of each node of the geometry: the deviation over R of the mid-surface under it; None without imperfections.
    """

    mesh: mesh.Mesh
    faces: dict[str, NDArray[np.int32]]
    points: dict[str, Array]
    normals: dict[str, Array]
    patches: dict[str, NDArray[np.bool_]]
    between: Array
    chart: Array
    heights: Array
    thickness: Array
    w0: Array | None = None

    def at_nodes(self, V: fem.FunctionSpace, values: Array) -> Array:
        """What is known at the nodes of the geometry, at those of a quadratic space."""
        nodes = V.dofmap.index_map
        found = np.empty((nodes.size_local + nodes.num_ghosts, *values.shape[1:]))
        found[V.dofmap.list] = values[compat.corner_numbers(self.mesh)]
        return found


def sweep(
    patch: PatchMesh,
    h: float,
    layers: int | Sequence[float],
    comm: MPI.Comm,
    factor: Callable[[Array], Array] | None = None,
) -> Body:
    """Make the body of all ranks from the triangulation, which each of them has: it is small.

    Parameters
    ----------
    h
        The thickness over R.
    layers
        Number of cells through the thickness, or where they begin and end, from 0 to 1.
    factor
        What multiplies h at places (n, 3) of the mid-surface; None for 1.

    Raises
    ------
    MeshError
        On every rank, if the body overlaps itself.
    """
    quads = split(patch)
    ends = np.linspace(0, 1, layers + 1) if isinstance(layers, int) else np.array(layers)
    heights = np.concatenate([ends[:1], *([(a + b) / 2, b] for a, b in pairwise(ends))])
    thick = h * (np.ones(len(quads.places)) if factor is None else factor(quads.places))
    z = (heights - MIDDLE) * thick[:, None]
    X = (quads.places[:, None] + z[..., None] * quads.offsets[:, None]).reshape(-1, 3)
    cells = _swept(quads.cells, len(ends) - 1)
    _refuse_overlap(X, cells)
    domain = create_mesh(comm, basix.ufl.element("Lagrange", "hexahedron", 2, shape=(3,)), cells, X)
    original = domain.topology.original_cell_index
    triangle, layer = original // (3 * (len(ends) - 1)), original % (len(ends) - 1)
    places = {name: patch.embedding(x[None])[0] for name, x in patch.points.items()}
    nearest = {name: np.argmin(np.linalg.norm(quads.places - x, axis=1)) for name, x in places.items()}
    node, level = np.divmod(domain.geometry.input_global_indices, len(heights))
    return Body(
        domain,
        _named_faces(domain, quads, len(heights)),
        places,
        {name: quads.offsets[n] / np.linalg.norm(quads.offsets[n]) for name, n in nearest.items()},
        {name: inside[triangle] for name, inside in patch.patches.items()},
        np.column_stack([ends[layer], ends[layer + 1]]),
        quads.nodes[node],
        heights[level],
        thick[node],
        patch.embedding.w0(quads.nodes)[node] if isinstance(patch.embedding, Deviated) else None,
    )


def _refuse_overlap(X: Array, cells: Numbers) -> None:
    """Look at the volume of all cells at their nodes."""
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType.hexahedron, 2, basix.LagrangeVariant.equispaced
    )
    tables = element.tabulate(1, element.points)[1:, :, :, 0]
    for part in np.array_split(cells, len(cells) // 2000 + 1):
        volumes = np.linalg.det(np.einsum("dqk,ckx->cqdx", tables, X[part]))
        if (volumes <= 0).any():
            place = X[part[np.argwhere(volumes <= 0)[0][0]]].mean(axis=0)
            raise MeshError(
                f"model: solid: the body overlaps itself around {place_text(place)}/R: half its thickness is "
                "more than the radius of curvature, or than a fold leaves beside it"
            )


def _swept(quads: Numbers, layers: int) -> Numbers:
    """Hexahedra (quads * layers, 27) in the order of basix; node q at level k has the number q levels + k."""
    points = basix.create_element(
        basix.ElementFamily.P, basix.CellType.hexahedron, 2, basix.LagrangeVariant.equispaced
    ).points
    below = np.argmin(np.linalg.norm(points[:, None, :2] - square()[None], axis=2), axis=1)
    level = np.rint(2 * points[:, 2]).astype(np.int64)
    levels = 2 * layers + 1
    cells = [quads[:, below] * levels + level + 2 * layer for layer in range(layers)]
    return np.stack(cells, axis=1).reshape(-1, 27)


def _named_faces(domain: mesh.Mesh, quads: Quadrilaterals, levels: int) -> dict[str, NDArray[np.int32]]:
    """Outer and side faces, found by the numbers of their nodes."""
    for pair in ((2, 3), (2, 0), (0, 3), (3, 2)):
        domain.topology.create_connectivity(*pair)
    facets = mesh.exterior_facet_indices(domain.topology)
    vertices = domain.topology.index_map(0)
    # of a vertex its number in the chart and its level
    ends = mesh.entities_to_geometry(domain, 0, np.arange(vertices.size_local + vertices.num_ghosts, dtype=np.int32))
    numbers = domain.geometry.input_global_indices[ends[:, 0]]
    corners = domain.topology.connectivity(2, 0).array.reshape(-1, 4)[facets]
    chart, level = np.divmod(numbers[corners], levels)
    found = {OUTER: facets[(level == levels - 1).all(axis=1)]}
    for name, pairs in quads.edges.items():
        wanted = as_set(pairs)
        above = [len(set(c)) == 2 and (min(c), max(c)) in wanted for c in chart]
        found[name] = facets[np.array(above, dtype=bool)]
    return found


def quadratic(domain: mesh.Mesh) -> fem.FunctionSpace:
    """Displacements of the mesh's own degree: rigid motions are exact."""
    return fem.functionspace(domain, ("Lagrange", 2, (3,)))
