"""The mesh of a sector around e3 and its mirror images, side by side."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import CUT, SECOND_CUT, Sector, rotation
from magshell_fenicsx.mesh.patch import Embedding, PatchMesh

Array = NDArray[np.float64]
CLOSE = 1e-7  # over the chart's extent: nodes that are one
TURNED_OVER = {
    3: [0, 2, 1],
    6: [0, 2, 1, 5, 4, 3],
    10: [0, 2, 1, 8, 7, 6, 5, 4, 3, 9],
}  # gmsh's nodes of a mirrored cell


class Folding:
    """Copies of a sector side by side: copy k lies between the azimuths k and k + 1 times its
    angle.

    Parameters
    ----------
    angle
        Of the sector (rad), which begins at azimuth 0.
    count
        Of the copies, the first of which is the sector itself.
    patch
        Its triangulation, in the chart of a disc around the axis, or of a rectangle whose first
        axis goes around e3.
    """

    def __init__(self, angle: float, count: int, patch: PatchMesh) -> None:
        self.count, self._angle = count, angle
        places, turn = patch.embedding(patch.nodes), rotation(-angle)
        turned = patch.embedding(patch.nodes @ turn[:2, :2].T)
        self.round = bool(np.abs(turned - places @ turn.T).max() < CLOSE * np.abs(places).max())
        self.end = angle if self.round else float(patch.nodes[:, 0].max())

    def image(self, chart: Array, k: int) -> Array:
        """Copy k of places of the chart."""
        if self.round:
            return np.asarray(chart @ self.turn(k)[:2, :2].T)
        x = (k + 1) * self.end - chart[:, 0] if k % 2 else k * self.end + chart[:, 0]
        return np.column_stack([x, chart[:, 1]])

    def turn(self, k: int) -> Array:
        """The matrix (3, 3) that takes vectors of the sector to copy k."""
        if k % 2:
            return np.asarray(rotation(-(k + 1) * self._angle) @ np.diag([1.0, -1.0, 1.0]))
        return rotation(-k * self._angle)

    def copies(self, chart: Array) -> NDArray[np.int64]:
        """In which copy each place (n, 2) of the half lies."""
        along = (
            np.abs(np.arctan2(chart[:, 1], chart[:, 0])) if self.round else chart[:, 0]
        )  # at pi rounding has a sign
        return np.asarray(np.clip(np.floor(along / self.end), 0, self.count - 1), dtype=np.int64)

    def embedding(self, of: Embedding) -> Embedding:
        """That of all copies, which have the chart in common."""
        return of

    def key(self, nodes: Array) -> Array:
        """What nodes have in common that are one: their places."""
        return nodes

    def back(self, chart: Array) -> Array:
        """The places of the sector whose copies these are."""
        places, copies = np.empty_like(chart), self.copies(chart)
        for k in range(self.count):
            of_copy = copies == k
            if self.round:
                places[of_copy] = chart[of_copy] @ self.turn(k)[:2, :2]
            else:
                x = chart[of_copy, 0]
                places[of_copy, 0] = (k + 1) * self.end - x if k % 2 else x - k * self.end
                places[of_copy, 1] = chart[of_copy, 1]
        return places


class FoldingInSpace:
    """The same for a triangulation in space: that of a mesh file, or of several shells, whose nodes
    are not shared.
    """

    def __init__(self, sector: Sector, patch: PatchMesh) -> None:
        self.count, self._sector = sector.waves, sector
        self._several = hasattr(patch.embedding, "charts")

    def image(self, nodes: Array, k: int) -> Array:
        """Copy k of nodes; those of several shells get k as their last number but one."""
        images, vectors = (
            nodes.copy(),
            1 if self._several else nodes.shape[1] // 3,
        )  # places, and normals if any
        for i in range(vectors):
            images[:, 3 * i : 3 * i + 3] = nodes[:, 3 * i : 3 * i + 3] @ self.turn(k).T
        return np.insert(images, -1, k, axis=1) if self._several else images

    def turn(self, k: int) -> Array:
        """See `Folding`."""
        begin = rotation(self._sector.azimuth)
        angle = self._sector.angle
        Q = (
            rotation(-(k + 1) * angle) @ np.diag([1.0, -1.0, 1.0])
            if k % 2
            else rotation(-k * angle)
        )
        return np.asarray(begin.T @ Q @ begin)

    def copies(self, x: Array) -> NDArray[np.int64]:
        """In which copy each place (n, 3) of the half lies."""
        at = x @ rotation(self._sector.azimuth).T
        along = np.abs(np.arctan2(at[:, 1], at[:, 0]))
        return np.asarray(
            np.clip(np.floor(along / self._sector.angle), 0, self.count - 1), dtype=np.int64
        )

    def back(self, x: Array) -> Array:
        """The places of the sector whose copies these are."""
        turns = np.array([self.turn(k) for k in range(self.count)])[self.copies(x)]
        return np.asarray(np.einsum("ni,nij->nj", x, turns))

    def embedding(self, of: Embedding) -> Embedding:
        """That of all copies."""
        return (
            CopiesEmbedded(of, tuple(self.turn(k) for k in range(self.count)))
            if self._several
            else of
        )

    def key(self, nodes: Array) -> Array:
        """What nodes of copies have in common that are one: the place, and the shell."""
        return nodes[:, [0, 1, 2, -1]] if self._several else nodes


@dataclass(frozen=True)
class CopiesEmbedded:
    """Nodes of copies of several shells -> places (n, 3), each by the nodes of the sector and its
    matrix (3, 3).
    """

    of: Embedding
    turns: tuple[Array, ...]

    @property
    def charts(self) -> bool:
        """See `assembly.Embedded`."""
        return bool(getattr(self.of, "charts", False))

    def __call__(self, nodes: Array) -> Array:
        turns = np.array(self.turns)[np.rint(nodes[:, -2]).astype(int)]
        return np.asarray(np.einsum("nij,nj->ni", turns, self.of(np.delete(nodes, -2, axis=1))))


def folding_of(sector: Sector, patch: PatchMesh) -> "Folding | FoldingInSpace":
    """The copies of a sector that make a half."""
    if patch.nodes.shape[1] > 2:
        return FoldingInSpace(sector, patch)
    return Folding(sector.angle, sector.waves, patch)


def unfolded(
    patch: PatchMesh, folding: Folding | FoldingInSpace, ends: tuple[str, str]
) -> PatchMesh:
    """The triangulation of all copies, from that of the sector; the edges where it begins and ends
    have these names.
    """
    n, count = len(patch.nodes), folding.count
    nodes = np.concatenate([folding.image(patch.nodes, k) for k in range(count)])
    over = TURNED_OVER[patch.cells.shape[1]]
    cells = np.concatenate(
        [k * n + (patch.cells[:, over] if k % 2 else patch.cells) for k in range(count)]
    )
    keys = folding.key(nodes)
    near = scipy.spatial.cKDTree(keys).query_ball_point(keys, CLOSE * np.ptp(keys, axis=0).max())
    same = np.array([min(each) for each in near])
    one = np.arange(n) if patch.one is None else patch.one
    glued = same[np.concatenate([k * n + one for k in range(count)])]
    apart = keys is not nodes  # then each copy keeps its nodes, and vertices are glued
    used, numbers = np.unique(np.arange(len(nodes)) if apart else same, return_inverse=True)
    new = np.full(len(nodes), -1, dtype=np.int64)
    new[used] = np.arange(len(used))

    def copied(name: str, ks: Sequence[int]) -> NDArray[np.int64]:
        return np.concatenate([new[glued[k * n + patch.edges[name]]] for k in ks])

    last = count - 1
    edges = {
        name: copied(name, range(count)) for name in patch.edges if name not in (CUT, SECOND_CUT)
    }
    first, second = copied(CUT, [0]), copied(CUT if last % 2 else SECOND_CUT, [last])
    edges |= (
        {CUT: np.concatenate([first, second])}
        if ends == (CUT, CUT)
        else dict(zip(ends, (first, second), strict=True))
    )
    return replace(
        patch,
        nodes=nodes[used],
        cells=numbers[cells],
        embedding=folding.embedding(patch.embedding),
        edges=edges,
        points={name: folding.image(x[None], 0)[0] for name, x in patch.points.items()},
        one=new[glued[used]] if apart or patch.one is not None else None,
        patches={name: np.tile(inside, count) for name, inside in patch.patches.items()},
        given=None if patch.given is None else np.tile(patch.given, (count, 1)),
        joints=tuple(
            both and (np.tile(both[0], count), np.tile(both[1], count)) for both in patch.joints
        ),
    )


def doubled(patch: PatchMesh, angle: float) -> PatchMesh:
    """A sector of an angle (rad) from the triangulation of its first half."""
    return unfolded(patch, Folding(angle / 2, 2, patch), (CUT, SECOND_CUT))
