"""Symmetry planes of a shape itself: of a grid's chart, or of a mesh file's triangles.

`grid_mirrors` and `mesh_mirrors` return `Mirror`s: planes with the half that is modelled, and the
removed edges, those of the other half, each with its mirror image. A chart is the plane domain of a
grid, which an embedding maps to space. A side of the grid is glued if it is the same line in space
as the opposite one. A patch is a mesh of triangles in space, with named edges and named parts
(`patches`). A loose mirror maps areas onto each other, but not triangles. Lengths are over R.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.mesh.mirror import ROUNDING, SYMMETRY_EDGE, Mirror, cut
from magshell_fenicsx.mesh.patch import Embedding, MeshError, PatchMesh

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
Flip = Callable[[Array, Array], tuple[Array, Array]]
# of two halves with different triangles: difference of their areas over the area, and of their
# centres over the extent
HALVES_TOLERANCE = 1e-3
# where the chart's corner low + (s, t) extent goes, and the sides in the places of left, right,
# bottom and top
FLIPS: tuple[tuple[Flip, tuple[int, ...]], ...] = (
    (lambda s, t: (1 - s, t), (1, 0, 2, 3)),
    (lambda s, t: (s, 1 - t), (0, 1, 3, 2)),
    (lambda s, t: (t, s), (2, 3, 0, 1)),
    (lambda s, t: (1 - t, 1 - s), (3, 2, 1, 0)),
)
# of left, right, bottom and top, as (s, t)
SIDE_MIDDLES = ((0.0, 0.5), (1.0, 0.5), (0.5, 0.0), (0.5, 1.0))
SAMPLES_PER_AXIS = 8  # of the chart; a power makes them unsymmetric along the second axis
SAMPLE_POWER = 1.5
LINE_SAMPLES = 9  # places along a grid line
FIRST_NODES = 50  # nodes whose images are tried before those of all


def grid_mirrors(grid: Grid, embedding: Embedding) -> list[Mirror]:
    """Return the planes that map a grid onto itself.

    The modelled half of each has the larger chart coordinates. `embedding` maps charts (n, 2) to
    places (n, 3).
    """
    low, extent = np.array(grid.low), np.subtract(grid.high, grid.low)
    t = np.linspace(0, 1, SAMPLES_PER_AXIS)
    sample = np.stack(np.meshgrid(t, t**SAMPLE_POWER), axis=-1).reshape(-1, 2)
    is_square = abs(extent[0] - extent[1]) < ROUNDING * extent[0]

    def places(chart: Array) -> Array:
        """Return places in space of charts (s, t) from 0 to 1."""
        return embedding(low + chart * extent)

    # the last two flips exchange both axes, which only a square allows
    mirrors = []
    flips = FLIPS if is_square and not any(grid.glued) else FLIPS[:2]
    for axis, (flip, images_of_sides) in enumerate(flips):
        # a surface that is closed around e3 has all planes through e3, which are not listed here
        if axis == 0 and grid.glued[0]:
            continue
        mirror = _plane_between(places(sample), places(np.column_stack(flip(*sample.T))))
        if mirror is None:
            continue
        # right and top are on the half with the larger coordinates
        distances = mirror.signed_distance(places(np.array(SIDE_MIDDLES)))
        if distances[1] + distances[3] < -ROUNDING:
            mirror, distances = mirror.reversed, -distances
        removed_edges = dict[str, str]()
        # edges of the half that is not modelled, and their images
        for side, image in enumerate(images_of_sides):
            is_glued = grid.glued[side // 2]
            is_on_other_half = side != image and distances[side] < 0
            if is_on_other_half and not is_glued:
                removed_edges[grid.sides[side]] = grid.sides[image]
        mirrors.append(Mirror(mirror.normal, mirror.offset, removed_edges))
    return mirrors


def _plane_between(originals: Array, images: Array) -> Mirror | None:
    """Return the plane that maps places (n, 3) onto their images (n, 3); None without one."""
    # the plane is normal to the line between a place and its image
    differences = originals - images
    normal = differences[np.argmax(np.linalg.norm(differences, axis=1))]
    if not normal.any():  # all places are their own images
        return None
    unit = Mirror.with_normal(normal).normal
    offset = float(((originals + images) / 2 @ unit).mean())
    mirror = Mirror(unit, _rounded(offset))
    error = np.abs(mirror.image(originals) - images).max()
    if error > ROUNDING * max(1.0, np.abs(originals).max()):
        return None
    return mirror


def mirror_lines(
    mirror: Mirror, grid: Grid, embedding: Embedding
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the coordinates of the grid lines, of either axis, that lie in a mirror plane.

    Only lines within the chart count, not its sides.
    """
    t, lines = np.linspace(0, 1, LINE_SAMPLES), []
    low, extent = np.array(grid.low), np.subtract(grid.high, grid.low)
    for axis in range(2):
        coordinates = []
        # a plane cuts a closed line twice: at its ends and its middle, or at its quarters
        for fraction in (0.25, 0.5, 0.75) if grid.glued[axis] else (0.5,):
            chart = np.empty((len(t), 2))
            chart[:, axis], chart[:, 1 - axis] = fraction, t
            distances = mirror.signed_distance(embedding(low + chart * extent))
            if np.abs(distances).max() < ROUNDING:
                coordinates.append(float(low[axis] + fraction * extent[axis]))
        lines.append(tuple(coordinates))
    return lines[0], lines[1]


def mesh_mirrors(patch: PatchMesh, vectors: Sequence[Array], *, loosely: bool) -> list[Mirror]:
    """Return the planes that map a triangulation, its edges and its patches onto themselves.

    Parameters
    ----------
    vectors
        (3,) which the plane should contain, where the shape itself leaves a choice.
    loosely
        Whether planes count too that map areas and centres onto each other, but not the triangles.
        Edges of the mesh must lie in them.
    """
    # a mesh with this edge is a half already
    if SYMMETRY_EDGE in patch.edges:
        return []
    mirrors: list[Mirror] = []
    corners = patch.nodes[np.unique(patch.cells[:, :3])]
    centre, (area_centre, _) = corners.mean(axis=0), _centre_and_area(patch)
    tree = scipy.spatial.cKDTree(patch.nodes)
    for normal in _candidate_normals(patch, vectors):
        unit = Mirror.with_normal(normal).normal
        mirror = _with_edges(Mirror(unit, _rounded(float(unit @ centre))), patch, tree)
        if mirror:
            mirrors.append(mirror)
        elif loosely:
            # through the vertex nearest to the centre of area, as edges must lie in the plane
            heights = corners @ unit
            nearest = float(heights[np.argmin(np.abs(heights - unit @ area_centre))])
            loose_mirror = Mirror(unit, _rounded(nearest))
            if _has_equal_halves(loose_mirror, patch):
                mirrors.append(loose_mirror)
    return mirrors


def _rounded(offset: float) -> float:
    """Return the offset of a plane; zero where it is rounding."""
    return 0.0 if abs(offset) < ROUNDING else offset


def _candidate_normals(patch: PatchMesh, vectors: Sequence[Array]) -> Iterator[Array]:
    """Yield unit normals (3,) of planes that may be symmetry planes, each once.

    They are normal to the vectors, along the axes of inertia, along those of space, or halfway
    between two of these.
    """
    corners = patch.nodes[np.unique(patch.cells[:, :3])]
    _, eigenvectors = np.linalg.eigh(np.cov(corners.T))
    principal = eigenvectors.T
    axes = np.eye(3)
    pairs = ((axes[0], axes[1]), (axes[1], axes[2]), (axes[0], axes[2]))
    diagonals = [a + sign * b for a, b in pairs for sign in (1, -1)]
    normal_to_vectors = [np.cross(v, w) for v in vectors for w in (*axes[::-1], *vectors)]
    yielded: list[Array] = []
    for normal in (*normal_to_vectors, axes[1], axes[0], axes[2], *principal, *diagonals):
        length = np.linalg.norm(normal)
        if length <= ROUNDING:
            continue
        if all(abs(abs(n @ normal) - length) > ROUNDING * length for n in yielded):
            yielded.append(normal / length)
            yield yielded[-1]


def _with_edges(mirror: Mirror, patch: PatchMesh, tree: "scipy.spatial.cKDTree") -> Mirror | None:
    """Return the mirror with its removed edges, each with its image, or None.

    None if it does not map the triangulation, its patches and its edges onto themselves, or does
    not pass along edges of triangles. `tree` holds the nodes of the patch.
    """
    nodes = patch.nodes
    tolerance = ROUNDING * np.ptp(nodes, axis=0).max()
    # a few nodes exclude most planes in little time
    if tree.query(mirror.image(nodes[:FIRST_NODES]))[0].max() > tolerance:
        return None
    distance, image_numbers = tree.query(mirror.image(nodes))
    # a plane in which the whole surface lies halves nothing
    if distance.max() > tolerance or np.abs(mirror.signed_distance(nodes)).max() <= tolerance:
        return None
    # patches must be mapped onto themselves
    twin = _image_triangles(patch.cells[:, :3], image_numbers)
    if twin is None or any((mask != mask[twin]).any() for mask in patch.patches.values()):
        return None
    removed_edges = {}
    for name, pairs in patch.edges.items():
        image_name = _edge_with_pairs(image_numbers[pairs], patch)
        if image_name is None:
            return None
        # edges of the half that is not modelled
        if image_name != name and mirror.signed_distance(nodes[pairs]).mean() < 0:
            removed_edges[name] = image_name
    # only planes along edges of triangles can be cut
    try:
        cut(patch, mirror)
    except MeshError:
        return None
    return Mirror(mirror.normal, mirror.offset, removed_edges)


def _edge_with_pairs(pairs: Numbers, patch: PatchMesh) -> str | None:
    """Return the name of the patch's edge with these pairs of vertices (e, 2); None without one."""
    names = (name for name, own_pairs in patch.edges.items() if _same_pairs(pairs, own_pairs))
    return next(names, None)


def _image_triangles(cells: Numbers, image: Numbers) -> Numbers | None:
    """Return the number of each triangle's mirror image, (m,); None if one has no image.

    Parameters
    ----------
    cells
        (m, 3) nodes of the triangles.
    image
        (n,) number of the mirror image of each node.
    """
    corners, image_corners = np.sort(cells, axis=1), np.sort(image[cells], axis=1)
    # if each image is a triangle, both lists are equal after sorting
    order, order_of_images = np.lexsort(corners.T), np.lexsort(image_corners.T)
    if (corners[order] != image_corners[order_of_images]).any():
        return None
    twin = np.empty(len(cells), dtype=np.int64)
    twin[order_of_images] = order
    return twin


def _same_pairs(a: Numbers, b: Numbers) -> bool:
    """Return whether pairs of vertices (e, 2) are the same, in any order."""
    a, b = (np.unique(np.sort(x, axis=1), axis=0) for x in (a, b))
    return a.shape == b.shape and not (a != b).any()


def _has_equal_halves(mirror: Mirror, patch: PatchMesh) -> bool:
    """Return whether both halves at a plane have equal areas and mirrored centres."""
    try:
        half, other_half = (_centre_and_area(cut(patch, m)) for m in (mirror, mirror.reversed))
    except MeshError:
        return False
    (centre, area), (other_centre, other_area) = half, other_half
    extent = np.ptp(patch.nodes, axis=0).max()
    distance = np.abs(mirror.image(centre) - other_centre).max()
    has_equal_areas = abs(area - other_area) < HALVES_TOLERANCE * (area + other_area)
    return bool(has_equal_areas and distance < HALVES_TOLERANCE * extent)


def _centre_and_area(patch: PatchMesh) -> tuple[Array, float]:
    """Return the centre (3,) and the area of the flat triangles."""
    a, b, c = (patch.nodes[patch.cells[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    return np.asarray(areas @ (a + b + c) / 3 / areas.sum()), float(areas.sum())
