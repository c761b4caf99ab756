"""The mesh of a half, made of the mesh of a sector around e3 and its images side by side.

The symmetry-breaking modes of a sector are computed on the half, whose triangulation is the copies
of the sector's. Copy k lies between the azimuths k and k + 1 times the sector's angle; every second
copy is a mirror image, since the sector has symmetry planes at both of its ends.

Nodes are coordinates in a chart (d = 2), or places in space, perhaps followed by normals; those of
several shells have ten numbers (see `multi_shell`): their place first, the number of the shell
last. An embedding maps nodes to places. Glued nodes have one representative. Lengths are over R.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import SECOND_SYMMETRY_EDGE, SYMMETRY_EDGE, Sector, rotation
from magshell_fenicsx.mesh.patch import Embedding, PatchMesh

Array = NDArray[np.float64]
SAME_NODE_TOLERANCE = 1e-7  # over the chart's extent: nodes that are one
MIRRORED_NODES = {
    3: [0, 2, 1],
    6: [0, 2, 1, 5, 4, 3],
    10: [0, 2, 1, 8, 7, 6, 5, 4, 3, 9],
}  # nodes of a triangle -> gmsh's order of the nodes of its mirror image


class ChartUnfolding:
    """Copies of a sector side by side in a chart, which together are a half.

    Copy 0 is the sector; copies with odd numbers are mirror images. The surface is one of
    revolution, so that the copies have the sector's own chart and embedding.

    Attributes
    ----------
    count
        Number of copies, the first of which is the sector itself.
    round
        Whether the chart is a disc around the axis; else its first coordinate goes around e3.
    end
        Where the sector ends: an angle (rad) of a disc, else a first coordinate.
    _angle
        Angle of the sector (rad).

    Parameters
    ----------
    angle
        Angle of the sector (rad), which begins at azimuth 0.
    count
        Number of copies.
    patch
        Triangulation of the sector, in the chart of a disc around the axis, or of a rectangle
        whose first axis goes around e3.
    """

    def __init__(self, angle: float, count: int, patch: PatchMesh) -> None:
        """Find out by the embedding whether the chart turns with the surface, as a disc does."""
        self.count, self._angle = count, angle
        # turning the chart of a disc turns the surface; a rectangular chart does not do so
        places, Q = patch.embedding(patch.nodes), rotation(-angle)
        rotated_chart_places = patch.embedding(patch.nodes @ Q[:2, :2].T)
        error = np.abs(rotated_chart_places - places @ Q.T).max()
        self.round = bool(error < SAME_NODE_TOLERANCE * np.abs(places).max())
        self.end = angle if self.round else float(patch.nodes[:, 0].max())

    def image(self, chart: Array, k: int) -> Array:
        """Return places (n, 2) of the sector's chart in copy k."""
        if self.round:
            return np.asarray(chart @ self.turn(k)[:2, :2].T)
        # copies with odd numbers run backwards
        x = (k + 1) * self.end - chart[:, 0] if k % 2 else k * self.end + chart[:, 0]
        return np.column_stack([x, chart[:, 1]])

    def turn(self, k: int) -> Array:
        """Return the matrix (3, 3) that takes vectors of the sector to copy k.

        Copies with odd numbers are mirror images.
        """
        if k % 2:
            return np.asarray(rotation(-(k + 1) * self._angle) @ np.diag([1.0, -1.0, 1.0]))
        return rotation(-k * self._angle)

    def copies(self, chart: Array) -> NDArray[np.int64]:
        """Return the number (n,) of the copy in which each place (n, 2) of the half lies."""
        # absolute: at the end of the half rounding may give -pi
        angle = np.abs(np.arctan2(chart[:, 1], chart[:, 0])) if self.round else chart[:, 0]
        return np.asarray(np.clip(np.floor(angle / self.end), 0, self.count - 1), dtype=np.int64)

    def embedding(self, of_sector: Embedding) -> Embedding:
        """Return the embedding of all copies: that of the sector, since they share the chart."""
        return of_sector

    def key(self, nodes: Array) -> Array:
        """Return rows (n, d) that are equal for nodes that are the same: their places."""
        return nodes

    def to_sector(self, chart: Array) -> Array:
        """Return the places (n, 2) of the sector whose copies are the places of the half."""
        places, copies = np.empty_like(chart), self.copies(chart)
        for k in range(self.count):
            in_copy = copies == k
            if self.round:
                places[in_copy] = chart[in_copy] @ self.turn(k)[:2, :2]
            else:
                # copies with odd numbers run backwards
                x = chart[in_copy, 0]
                places[in_copy, 0] = (k + 1) * self.end - x if k % 2 else x - k * self.end
                places[in_copy, 1] = chart[in_copy, 1]
        return places


class SpaceUnfolding:
    """Copies of a sector side by side in space, for a mesh file or several shells.

    It has the methods of `ChartUnfolding`. Copies of several shells do not share nodes: a node has
    the number of its copy, and `CopiesEmbedding` places it.

    Attributes
    ----------
    count
        Number of copies: the waves m of the sector.
    _sector
        The sector, with its azimuth and angle.
    _several_shells
        Whether the nodes are those of several shells.
    """

    def __init__(self, sector: Sector, patch: PatchMesh) -> None:
        self.count, self._sector = sector.waves, sector
        self._several_shells = hasattr(patch.embedding, "has_charts")

    def image(self, nodes: Array, k: int) -> Array:
        """Return the nodes in copy k, from nodes (n, d) of the sector.

        Nodes of several shells get a further number before their last: k.
        """
        images = nodes.copy()
        # nodes are places, of a mesh file perhaps with normals
        vector_count = 1 if self._several_shells else nodes.shape[1] // 3
        for i in range(vector_count):
            images[:, 3 * i : 3 * i + 3] = nodes[:, 3 * i : 3 * i + 3] @ self.turn(k).T
        return np.insert(images, -1, k, axis=1) if self._several_shells else images

    def turn(self, k: int) -> Array:
        """Return the matrix (3, 3) that takes vectors of the sector to copy k.

        Copies with odd numbers are mirror images.
        """
        # turn to the frame in which the sector begins at azimuth 0, and back at the end
        to_azimuth_zero = rotation(self._sector.azimuth)
        angle = self._sector.angle
        Q = rotation(-(k + k % 2) * angle)
        if k % 2:
            Q = np.asarray(Q @ np.diag([1.0, -1.0, 1.0]))
        return np.asarray(to_azimuth_zero.T @ Q @ to_azimuth_zero)

    def copies(self, x: Array) -> NDArray[np.int64]:
        """Return the number (n,) of the copy in which each place (n, 3) of the half lies."""
        in_sector_frame = x @ rotation(self._sector.azimuth).T
        angle = np.abs(np.arctan2(in_sector_frame[:, 1], in_sector_frame[:, 0]))
        return np.asarray(
            np.clip(np.floor(angle / self._sector.angle), 0, self.count - 1), dtype=np.int64
        )

    def to_sector(self, x: Array) -> Array:
        """Return the places (n, 3) of the sector whose copies are the places of the half."""
        turns = np.array([self.turn(k) for k in range(self.count)])[self.copies(x)]
        return np.asarray(np.einsum("ni,nij->nj", x, turns))

    def embedding(self, of_sector: Embedding) -> Embedding:
        """Return the embedding of all copies."""
        if not self._several_shells:
            return of_sector  # nodes are places already
        return CopiesEmbedding(of_sector, tuple(self.turn(k) for k in range(self.count)))

    def key(self, nodes: Array) -> Array:
        """Return rows that are equal for nodes that are the same: the place, and the shell."""
        return nodes[:, [0, 1, 2, -1]] if self._several_shells else nodes


@dataclass(frozen=True)
class CopiesEmbedding:
    """Map of nodes (n, d) of copies of several shells to places (n, 3).

    Attributes
    ----------
    of_sector
        Nodes of the sector -> places (n, 3).
    turns
        For each copy the matrix (3, 3) that takes vectors of the sector to it.
    """

    of_sector: Embedding
    turns: tuple[Array, ...]

    @property
    def has_charts(self) -> bool:
        """Whether all shells have charts, and none is from a mesh file."""
        return bool(getattr(self.of_sector, "has_charts", False))

    def __call__(self, nodes: Array) -> Array:
        """Return the places of nodes, whose last number but one is that of the copy."""
        turns = np.array(self.turns)[np.rint(nodes[:, -2]).astype(int)]
        places_in_sector = self.of_sector(np.delete(nodes, -2, axis=1))
        return np.asarray(np.einsum("nij,nj->ni", turns, places_in_sector))


def unfolding_of(sector: Sector, patch: PatchMesh) -> ChartUnfolding | SpaceUnfolding:
    """Return the copies of a sector that make a half, for its triangulation."""
    if patch.nodes.shape[1] > 2:
        return SpaceUnfolding(sector, patch)
    return ChartUnfolding(sector.angle, sector.waves, patch)


def unfold(
    patch: PatchMesh, unfolding: ChartUnfolding | SpaceUnfolding, end_names: tuple[str, str]
) -> PatchMesh:
    """Return the triangulation of all copies of a sector.

    Parameters
    ----------
    patch
        The triangulation of the sector.
    unfolding
        The copies of the sector.
    end_names
        Names of the edges where the first copy begins and the last one ends; equal names make one
        edge of both.
    """
    # node i of the sector has the number k n + i in copy k
    n, count = len(patch.nodes), unfolding.count
    nodes = np.concatenate([unfolding.image(patch.nodes, k) for k in range(count)])
    mirrored_order = MIRRORED_NODES[patch.cells.shape[1]]
    cells = np.concatenate(
        [k * n + (patch.cells[:, mirrored_order] if k % 2 else patch.cells) for k in range(count)]
    )
    # rows that are equal for nodes that are the same, and the lowest number of those nodes
    keys = unfolding.key(nodes)
    first_of_same = _first_at_same_place(keys)
    glued_to = np.arange(n) if patch.representative is None else patch.representative
    representative = first_of_same[np.concatenate([k * n + glued_to for k in range(count)])]
    # copies of several shells keep their nodes, which are glued; others share nodes at one place
    has_own_nodes = keys is not nodes  # `key` returns other rows for several shells alone
    kept_nodes = np.arange(len(nodes)) if has_own_nodes else first_of_same
    used, numbers = np.unique(kept_nodes, return_inverse=True)
    # number of a node in all copies -> its number in the result; -1 where it is dropped
    new_number = np.full(len(nodes), -1, dtype=np.int64)
    new_number[used] = np.arange(len(used))

    edges = _edges_of_copies(patch, new_number[representative], count, end_names)
    inner_lines = {
        name: np.concatenate([new_number[representative[k * n + pairs]] for k in range(count)])
        for name, pairs in patch.inner_lines.items()
    }
    is_glued = has_own_nodes or patch.representative is not None
    source_triangles = patch.source_triangles
    if source_triangles is not None:
        source_triangles = np.tile(source_triangles, (count, 1))
    return replace(
        patch,
        nodes=nodes[used],
        cells=numbers[cells],
        embedding=unfolding.embedding(patch.embedding),
        edges=edges,
        inner_lines=inner_lines,
        # named points are those of copy 0, the sector
        points={name: unfolding.image(x[None], 0)[0] for name, x in patch.points.items()},
        representative=new_number[representative[used]] if is_glued else None,
        patches={name: np.tile(mask, count) for name, mask in patch.patches.items()},
        source_triangles=source_triangles,
        joints=tuple(
            masks and (np.tile(masks[0], count), np.tile(masks[1], count)) for masks in patch.joints
        ),
    )


def _edges_of_copies(
    patch: PatchMesh, vertex_number: NDArray[np.int64], count: int, end_names: tuple[str, str]
) -> dict[str, NDArray[np.int64]]:
    """Return the edges of all copies of a sector: name -> pairs of vertices.

    Edges between two copies vanish.

    Parameters
    ----------
    patch
        The triangulation of the sector, with n nodes.
    vertex_number
        (count n,) number of the vertex at each node of all copies, in the result.
    count
        Number of copies.
    end_names
        Names of the edges where the first copy begins and the last one ends.
    """
    n = len(patch.nodes)

    def edge_in(name: str, copies: Sequence[int]) -> NDArray[np.int64]:
        """Return the vertex pairs of an edge of the sector in some copies."""
        return np.concatenate([vertex_number[k * n + patch.edges[name]] for k in copies])

    last_copy = count - 1
    edges = {
        name: edge_in(name, range(count))
        for name in patch.edges
        if name not in (SYMMETRY_EDGE, SECOND_SYMMETRY_EDGE)
    }
    first_end = edge_in(SYMMETRY_EDGE, [0])
    # an odd copy is a mirror image, and ends where the sector begins
    last_end = edge_in(SYMMETRY_EDGE if last_copy % 2 else SECOND_SYMMETRY_EDGE, [last_copy])
    if end_names == (SYMMETRY_EDGE, SYMMETRY_EDGE):
        edges[SYMMETRY_EDGE] = np.concatenate([first_end, last_end])
    else:
        edges |= dict(zip(end_names, (first_end, last_end), strict=True))
    return edges


def _first_at_same_place(keys: Array) -> NDArray[np.int64]:
    """Return for each node (n,) the lowest number of the nodes at its place.

    Parameters
    ----------
    keys
        (n, k) rows that are equal, but for rounding, for nodes that are the same.
    """
    distance = SAME_NODE_TOLERANCE * np.ptp(keys, axis=0).max()
    nodes_at_place = scipy.spatial.cKDTree(keys).query_ball_point(keys, distance)
    return np.array([min(numbers) for numbers in nodes_at_place])


def double_sector(patch: PatchMesh, angle: float) -> PatchMesh:
    """Return the triangulation of a sector of an angle (rad), made of that of its first half."""
    unfolding = ChartUnfolding(angle / 2, count=2, patch=patch)
    return unfold(patch, unfolding, (SYMMETRY_EDGE, SECOND_SYMMETRY_EDGE))
