"""Wave number of a mode around e3, counted on a ring: the surface at one height.

The mode between nodes is that of its elements, so the count does not depend on where nodes lie.
`mode_w` is the normal component of a mode at the nodes, w on the ring. theta is the azimuth around
e3. A tessellation divides curved cells into flat triangles, which the plane of one height z cuts in
straight lines. Places are over the reference length R.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.tessellation import Numbers, Tessellation, tessellate

Array = NDArray[np.float64]
MIN_HEIGHT = 0.02  # over R: flatter surfaces have no rings
# over R: how far below the top, or above the bottom, a ring is cut; the second at uneven rims
OFFSETS_OF_RING = (1e-6, 0.01)
ENDPOINT_TOLERANCE = 1e-9  # over R: distance of ends of lines that are one point of the ring
MAX_GAP = np.pi / 4  # rad, between points of a closed ring
MAX_WAVES = 80
MAX_REMAINDER = 0.1  # of the mode's square on the ring, that waves of one number leave
NODES_PER_WAVE = 4  # at least, of waves that a mesh resolves
MAX_TRIANGLES = 1_000_000


@dataclass(frozen=True)
class WaveCount:
    """Number of a mode's waves around e3, at least two, and how many the mesh resolves.

    Attributes
    ----------
    number
        Number of waves.
    largest
        The largest number of waves that the mesh resolves on the ring.
    """

    number: int
    largest: int

    @property
    def resolved(self) -> bool:
        """Whether the mesh resolves the waves."""
        return self.number <= self.largest


@dataclass(frozen=True)
class Ring:
    """Points of a closed ring around e3, ascending in azimuth, with the mode there.

    Attributes
    ----------
    theta, w
        (n,) azimuth (rad), and normal component of the mode.
    spacing
        Largest angle (rad) around e3 between neighbouring nodes of the mesh.
    """

    theta: Array
    w: Array
    spacing: float

    def waves(self) -> WaveCount | None:
        """Return the wave count; None if no single number of at least two waves fits the mode.

        Each number is fitted by least squares; the one that leaves the least of the mode counts.
        """
        angle_to_next = np.diff(self.theta, append=self.theta[0] + 2 * np.pi)
        # weights by the length of arc: small elements have many points
        arc_weights = np.sqrt((angle_to_next + np.roll(angle_to_next, 1)) / 2)
        values = arc_weights * self.w
        # for each m the square of what is left of the mode after the fit of waves cos(m theta) and
        # sin(m theta)
        remainders = []
        for m in range(MAX_WAVES + 1):
            wave = np.column_stack([np.cos(m * self.theta), np.sin(m * self.theta)])
            basis = arc_weights[:, None] * wave
            coefficients, *_ = np.linalg.lstsq(basis, values)
            remainders.append(float(np.sum((values - basis @ coefficients) ** 2)))
        best = int(np.argmin(remainders))
        if best < 2 or remainders[best] >= MAX_REMAINDER * float(values @ values):
            return None
        return WaveCount(best, int(2 * np.pi / (NODES_PER_WAVE * self.spacing)))


def waves_around(surface: Surface) -> WaveCount | None:
    """Count a mode's waves around e3, on the ring where the mode is largest.

    A ring is the surface at one height z.

    Parameters
    ----------
    surface
        A surface with the field "mode_w" of `mode_fields.mode_surface`.

    Returns
    -------
    The number of waves and how many the mesh resolves. None if no single number of at least two
    waves dominates, if the surface is flat, or if the ring is not closed around e3.
    """
    height = surface.r0[:, 2]
    if np.ptp(height) < MIN_HEIGHT:
        return None
    crest = surface.r0[np.argmax(np.abs(surface.fields["mode_w"]))]
    # the crest may be on the rim, where the surface has no height beyond: go towards the middle
    sign_inwards = np.sign((height.max() + height.min()) / 2 - crest[2]) or 1.0
    tessellation = tessellate(surface, MAX_TRIANGLES)
    # just inside the crest, and farther from it where rims are uneven
    for offset in OFFSETS_OF_RING:
        if ring := _ring(surface, tessellation, crest, float(crest[2] + offset * sign_inwards)):
            return ring.waves()
    return None


def _ring(surface: Surface, tessellation: Tessellation, crest: Array, height: float) -> Ring | None:
    """Return the ring at a height z over R; None if it is not closed around e3.

    Parameters
    ----------
    surface
        The surface with the field "mode_w".
    tessellation
        Its flat triangles.
    crest
        (3,) place where the mode is largest. Of several rings at that height the nearest to this
        place is taken.
    """
    r, mode_w = tessellation.at_points(surface.r0), tessellation.at_points(surface.fields["mode_w"])
    is_above = r[tessellation.triangles, 2] > height
    cut_triangles = np.flatnonzero(is_above.any(axis=1) & ~is_above.all(axis=1))
    if not len(cut_triangles):
        return None
    triangles = tessellation.triangles[cut_triangles]
    values = np.column_stack([r, mode_w])
    # each cut triangle has one line of a ring: (t, 2, 2) x and y of its ends, and (t, 2) w there
    ends, w_at_ends = _cuts(triangles, is_above[cut_triangles], values, height)
    on_ring = _connected(ends, crest)  # numbers of the lines of the ring that is nearest
    theta = np.arctan2(ends[on_ring, :, 1], ends[on_ring, :, 0])
    order = np.argsort(theta, axis=None)
    ascending = theta.ravel()[order]
    # the ring is not closed if it has a wide gap, the one from the last point to the first included
    if np.diff(ascending, append=ascending[0] + 2 * np.pi).max() > MAX_GAP:
        return None
    # how far neighbouring nodes of the mesh are apart on the ring
    triangles_per_cell = len(tessellation.triangles) // len(tessellation.nodes)
    cells_on_ring = cut_triangles[on_ring] // triangles_per_cell  # triangles are cell after cell
    nodes_of_cells = surface.r0[tessellation.nodes[cells_on_ring]]
    # a cell of degree d has d intervals between nodes along its side
    spacing = _extent(nodes_of_cells, theta[:, 0]) / tessellation.degree
    return Ring(ascending, w_at_ends[on_ring].ravel()[order], spacing)


def _cuts(
    triangles: NDArray[np.int32], is_above: NDArray[np.bool_], values: Array, height: float
) -> tuple[Array, Array]:
    """Return the lines in which the plane z = height cuts triangles.

    Parameters
    ----------
    triangles
        (t, 3) numbers of points, of triangles that the plane cuts.
    is_above
        (t, 3) whether each corner is above the plane.
    values
        (n, 4) x, y, z and the mode's w at points.

    Returns
    -------
    ends
        (t, 2, 2) x and y of both ends of each line.
    w
        (t, 2) w at these ends.
    """
    # the corner that is alone on its side of the plane, be it above or below
    single_is_above = is_above.sum(axis=1) == 1
    single_corner = np.argmax(is_above == single_is_above[:, None], axis=1)
    order = (single_corner[:, None] + np.arange(3)) % 3  # that corner first
    corners = values[np.take_along_axis(triangles, order, axis=1)]
    single, other_two = corners[:, :1], corners[:, 1:]
    # the plane cuts the two sides from the single corner to the others
    fraction = (height - single[..., 2]) / (other_two[..., 2] - single[..., 2])
    ends = single + fraction[..., None] * (other_two - single)  # (t, 2, 4): x, y, z and w
    return ends[..., :2], ends[..., 3]


def _connected(ends: Array, place: Array) -> Numbers:
    """Return the numbers of the lines that are connected with the line nearest to a place (3,).

    `ends` (t, 2, 2) are x and y of the ends of t lines.
    """
    points = ends.reshape(-1, 2)  # points 2 i and 2 i + 1 are the ends of line i
    pairs = scipy.spatial.cKDTree(points).query_pairs(ENDPOINT_TOLERANCE, output_type="ndarray")
    # ends at one place, and the two ends of each line
    links = np.concatenate([pairs, np.arange(len(points)).reshape(-1, 2)])
    graph = scipy.sparse.coo_array(
        (np.ones(len(links)), tuple(links.T)), shape=(len(points), len(points))
    )
    _, ring_number = scipy.sparse.csgraph.connected_components(graph, directed=False)
    nearest = np.argmin(np.linalg.norm(points - place[:2], axis=1))
    ring_of_line = ring_number[::2]  # that of the line's first end
    return np.flatnonzero(ring_of_line == ring_number[nearest])


def _extent(nodes: Array, theta: Array) -> float:
    """Return the largest angle (rad) about e3 that a cell spans.

    Parameters
    ----------
    nodes
        (t, k, 3) places of the nodes of the cells.
    theta
        (t,) azimuth of a point in each cell. Angles of nodes are counted from it, so that they do
        not jump by 2 pi.
    """
    azimuth = np.arctan2(nodes[..., 1], nodes[..., 0]) - theta[:, None]
    return float(np.ptp((azimuth + np.pi) % (2 * np.pi) - np.pi, axis=1).max())
