"""The mirror planes of a shape itself: of a grid's chart, or of a mesh file's triangles."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.mesh.mirror import CUT, ROUNDING, Mirror, cut
from magshell_fenicsx.mesh.patch import Embedding, MeshError, PatchMesh

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
Flip = Callable[[Array, Array], tuple[Array, Array]]
ALIKE = 1e-3  # of two halves with different triangles: difference of their areas and centres
# where the chart's corner low + (s, t) extent goes, and the sides in the places of left, right,
# bottom and top
FLIPS: tuple[tuple[Flip, tuple[int, ...]], ...] = (
    (lambda s, t: (1 - s, t), (1, 0, 2, 3)),
    (lambda s, t: (s, 1 - t), (0, 1, 3, 2)),
    (lambda s, t: (t, s), (2, 3, 0, 1)),
    (lambda s, t: (1 - t, 1 - s), (3, 2, 1, 0)),
)
MIDDLES = ((0.0, 0.5), (1.0, 0.5), (0.5, 0.0), (0.5, 1.0))


def grid_mirrors(grid: Grid, embedding: Embedding) -> list[Mirror]:
    """Planes that map a grid onto itself; the half that is kept has the larger chart coordinates."""
    low, extent = np.array(grid.low), np.subtract(grid.high, grid.low)
    sample = np.stack(
        np.meshgrid(np.linspace(0, 1, 8), np.linspace(0, 1, 8) ** 1.5), axis=-1
    ).reshape(-1, 2)
    square = abs(extent[0] - extent[1]) < ROUNDING * extent[0]

    def places(chart: Array) -> Array:
        return embedding(low + chart * extent)

    mirrors = []
    for axis, (flip, sides) in enumerate(FLIPS if square and not any(grid.glued) else FLIPS[:2]):
        originals, images = places(sample), places(np.column_stack(flip(*sample.T)))
        apart = originals - images
        normal = apart[np.argmax(np.linalg.norm(apart, axis=1))]
        if (axis == 0 and grid.glued[0]) or not normal.any():
            continue
        mirror = Mirror.of(normal)
        mirror = Mirror(
            mirror.normal, _rounded(float(((originals + images) / 2 @ mirror.normal).mean()))
        )
        if np.abs(mirror.image(originals) - images).max() > ROUNDING * max(
            1.0, np.abs(originals).max()
        ):
            continue
        beyond = mirror.beyond(places(np.array(MIDDLES)))
        if beyond[1] + beyond[3] < -ROUNDING:
            mirror, beyond = mirror.reversed, -beyond
        lost = {
            grid.sides[i]: grid.sides[j]
            for i, j in enumerate(sides)
            if i != j and beyond[i] < 0 and _edge(grid, i)
        }
        mirrors.append(Mirror(mirror.normal, mirror.offset, lost))
    return mirrors


def lines_on(
    mirror: Mirror, grid: Grid, embedding: Embedding
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Coordinates of the grid lines, of either axis, that lie in a mirror plane within the chart."""
    t, lines = np.linspace(0, 1, 9), []
    low, extent = np.array(grid.low), np.subtract(grid.high, grid.low)
    for axis in range(2):
        on = []
        for share in (0.25, 0.5, 0.75) if grid.glued[axis] else (0.5,):
            chart = np.empty((len(t), 2))
            chart[:, axis], chart[:, 1 - axis] = share, t
            if np.abs(mirror.beyond(embedding(low + chart * extent))).max() < ROUNDING:
                on.append(float(low[axis] + share * extent[axis]))
        lines.append(tuple(on))
    return lines[0], lines[1]


def mesh_mirrors(patch: PatchMesh, vectors: Sequence[Array], *, loosely: bool) -> list[Mirror]:
    """Planes that map a triangulation, its named edges and its patches onto themselves.

    Parameters
    ----------
    vectors
        Which the plane should hold, where the shape itself leaves a choice.
    loosely
        Take planes too that only the shape has, as far as areas and centres tell, where edges of
        the mesh lie in them.
    """
    if CUT in patch.edges:
        return []
    mirrors: list[Mirror] = []
    corners = patch.nodes[np.unique(patch.cells[:, :3])]
    centre, (middle, _) = corners.mean(axis=0), _centre(patch)
    tree = scipy.spatial.cKDTree(patch.nodes)
    for normal in _normals(patch, vectors):
        mirror = Mirror.of(normal)
        exact = _with_edges(
            Mirror(mirror.normal, _rounded(float(mirror.normal @ centre))), patch, tree
        )
        if exact:
            mirrors.append(exact)
        elif loosely:
            heights = corners @ mirror.normal
            nearest = float(heights[np.argmin(np.abs(heights - mirror.normal @ middle))])
            if _halves_alike(loose := Mirror(mirror.normal, _rounded(nearest)), patch):
                mirrors.append(loose)
    return mirrors


def _edge(grid: Grid, side: int) -> bool:
    return not grid.glued[side // 2]


def _rounded(offset: float) -> float:
    return 0.0 if abs(offset) < ROUNDING else offset


def _normals(patch: PatchMesh, vectors: Sequence[Array]) -> Iterator[Array]:
    """Each once: normal to what the parts need, the axes of inertia, those of space, and halfway
    between.
    """
    corners = patch.nodes[np.unique(patch.cells[:, :3])]
    principal = np.linalg.eigh(np.cov(corners.T))[1].T
    axes = np.eye(3)
    diagonals = [
        a + s * b
        for a, b in ((axes[0], axes[1]), (axes[1], axes[2]), (axes[0], axes[2]))
        for s in (1, -1)
    ]
    crossed = [np.cross(v, w) for v in vectors for w in (*axes[::-1], *vectors)]
    seen: list[Array] = []
    for normal in (*crossed, axes[1], axes[0], axes[2], *principal, *diagonals):
        size = np.linalg.norm(normal)
        if size > ROUNDING and all(abs(abs(n @ normal) - size) > ROUNDING * size for n in seen):
            seen.append(normal / size)
            yield seen[-1]


def _with_edges(mirror: Mirror, patch: PatchMesh, tree: "scipy.spatial.cKDTree") -> Mirror | None:
    """The mirror with its pairs of edges; None if it does not map the triangulation onto itself."""
    nodes = patch.nodes
    near = ROUNDING * np.ptp(nodes, axis=0).max()
    if tree.query(mirror.image(nodes[:50]))[0].max() > near:
        return None
    distance, image = tree.query(mirror.image(nodes))
    if distance.max() > near or np.abs(mirror.beyond(nodes)).max() <= near:
        return None
    twin = _twins(patch.cells[:, :3], image)
    if twin is None or any((inside != inside[twin]).any() for inside in patch.patches.values()):
        return None
    lost = {}
    for name, lines in patch.edges.items():
        other = next(
            (o for o, pairs in patch.edges.items() if _same_rows(image[lines], pairs)), None
        )
        if other is None:
            return None
        if other != name and mirror.beyond(nodes[lines]).mean() < 0:
            lost[name] = other
    try:
        cut(patch, mirror)
    except MeshError:
        return None
    return Mirror(mirror.normal, mirror.offset, lost)


def _twins(cells: Numbers, image: Numbers) -> Numbers | None:
    """For each triangle the number of its mirror image; None if one has none."""
    corners, images = np.sort(cells, axis=1), np.sort(image[cells], axis=1)
    order, mirrored = np.lexsort(corners.T), np.lexsort(images.T)
    if (corners[order] != images[mirrored]).any():
        return None
    twin = np.empty(len(cells), dtype=np.int64)
    twin[mirrored] = order
    return twin


def _same_rows(a: Numbers, b: Numbers) -> bool:
    a, b = (np.unique(np.sort(x, axis=1), axis=0) for x in (a, b))
    return a.shape == b.shape and not (a != b).any()


def _halves_alike(mirror: Mirror, patch: PatchMesh) -> bool:
    try:
        one, other = (_centre(cut(patch, half)) for half in (mirror, mirror.reversed))
    except MeshError:
        return False
    extent, whole = np.ptp(patch.nodes, axis=0).max(), one[1] + other[1]
    return bool(
        abs(one[1] - other[1]) < ALIKE * whole
        and np.abs(mirror.image(one[0]) - other[0]).max() < ALIKE * extent
    )


def _centre(patch: PatchMesh) -> tuple[Array, float]:
    """Centre and area of the flat triangles."""
    a, b, c = (patch.nodes[patch.cells[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    return np.asarray(areas @ (a + b + c) / 3 / areas.sum()), float(areas.sum())
