"""The waves of a mode around e3, counted on a ring: where a plane of one height cuts the surface.

The mode between nodes is that of its elements, so the count does not depend on where nodes lie.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.tessellation import Numbers, Tessellation, tessellated

Array = NDArray[np.float64]
FLAT = 0.02  # height over R below which a surface has no rings
ASIDE = (
    1e-6,
    0.01,
)  # over R: how far below the top, or above the bottom, a ring is cut; the latter at uneven rims
SAME_PLACE = 1e-9  # over R: distance of ends of pieces of the ring that are one
GAP = np.pi / 4  # largest gap of a ring that is closed
MOST_WAVES = 80
REST = 0.1  # largest part of the mode's square on the ring that waves of one number leave
NODES_PER_WAVE = 4  # at least, of waves that a mesh resolves
MOST_TRIANGLES = 1_000_000


@dataclass(frozen=True)
class Waves:
    """The waves of a mode around e3, at least two.

    Attributes
    ----------
    number
        Of the waves.
    largest
        The largest number of waves that the mesh resolves on the ring.
    """

    number: int
    largest: int

    @property
    def resolved(self) -> bool:
        """Whether the mesh resolves them."""
        return self.number <= self.largest


@dataclass(frozen=True)
class Ring:
    """Points of a closed ring around e3, by ascending azimuth.

    Attributes
    ----------
    theta, w
        (n,) azimuth, and the mode's normal component.
    spacing
        Largest distance of nodes around the ring, rad.
    """

    theta: Array
    w: Array
    spacing: float

    def waves(self) -> Waves | None:
        """Count the waves; None if no single number of them, at least two, makes up the mode."""
        ahead = np.diff(self.theta, append=self.theta[0] + 2 * np.pi)
        share = np.sqrt(
            (ahead + np.roll(ahead, 1)) / 2
        )  # of the ring: small elements have many points
        values = share * self.w
        left = []
        for m in range(MOST_WAVES + 1):
            basis = share[:, None] * np.column_stack(
                [np.cos(m * self.theta), np.sin(m * self.theta)]
            )
            left.append(float(np.sum((values - basis @ np.linalg.lstsq(basis, values)[0]) ** 2)))
        best = int(np.argmin(left))
        if best < 2 or left[best] >= REST * float(values @ values):
            return None
        return Waves(best, int(2 * np.pi / (NODES_PER_WAVE * self.spacing)))


def waves_around(surface: Surface) -> Waves | None:
    """Count the waves of a mode around e3, on the ring where it is largest.

    Parameters
    ----------
    surface
        With the field "mode_w" of `modes.mode_surface`.

    Returns
    -------
    None if no single number of at least two waves dominates, if the surface is flat, or if the ring
    is not closed around e3.
    """
    height = surface.r0[:, 2]
    if np.ptp(height) < FLAT:
        return None
    crest = surface.r0[np.argmax(np.abs(surface.fields["mode_w"]))]
    inwards = np.sign((height.max() + height.min()) / 2 - crest[2]) or 1.0
    pieces = tessellated(surface, MOST_TRIANGLES)
    for aside in ASIDE:
        if ring := _ring(surface, pieces, crest, float(crest[2] + aside * inwards)):
            return ring.waves()
    return None


def _ring(surface: Surface, pieces: Tessellation, crest: Array, height: float) -> Ring | None:
    """The ring at a height that passes a place; None if it is not closed around e3."""
    r, w = pieces.at(surface.r0), pieces.at(surface.fields["mode_w"])
    is_above = r[pieces.triangles, 2] > height
    cut = np.flatnonzero(is_above.any(axis=1) & ~is_above.all(axis=1))
    if not len(cut):
        return None
    ends, w_at_ends = _cuts(pieces.triangles[cut], is_above[cut], np.column_stack([r, w]), height)
    on_ring = _connected(ends, crest)
    theta = np.arctan2(ends[on_ring, :, 1], ends[on_ring, :, 0])
    order = np.argsort(theta, axis=None)
    ascending = theta.ravel()[order]
    if np.diff(ascending, append=ascending[0] + 2 * np.pi).max() > GAP:
        return None
    per_piece = len(pieces.triangles) // len(pieces.nodes)
    of_nodes = surface.r0[pieces.nodes[cut[on_ring] // per_piece]]
    return Ring(
        ascending, w_at_ends[on_ring].ravel()[order], _extent(of_nodes, theta[:, 0]) / pieces.degree
    )


def _cuts(
    triangles: NDArray[np.int32], is_above: NDArray[np.bool_], values: Array, height: float
) -> tuple[Array, Array]:
    """Both ends (t, 2, 2) of the line on which each triangle is cut, x and y, and w (t, 2) there.

    `values` (n, 4) are x, y, z, w at points.
    """
    alone = np.argmax(
        is_above == (is_above.sum(axis=1) == 1)[:, None], axis=1
    )  # the corner on its side of the plane
    corners = values[np.take_along_axis(triangles, (alone[:, None] + np.arange(3)) % 3, axis=1)]
    tip, base = corners[:, :1], corners[:, 1:]
    part = (height - tip[..., 2]) / (base[..., 2] - tip[..., 2])
    ends = tip + part[..., None] * (base - tip)
    return ends[..., :2], ends[..., 3]


def _connected(ends: Array, place: Array) -> Numbers:
    """Which lines, with ends (t, 2, 2), are connected with that which is nearest to a place."""
    points = ends.reshape(-1, 2)
    pairs = scipy.spatial.cKDTree(points).query_pairs(SAME_PLACE, output_type="ndarray")
    links = np.concatenate([pairs, np.arange(len(points)).reshape(-1, 2)])
    graph = scipy.sparse.coo_array(
        (np.ones(len(links)), tuple(links.T)), shape=(len(points), len(points))
    )
    number = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    nearest = np.argmin(np.linalg.norm(points - place[:2], axis=1))
    return np.flatnonzero(number[::2] == number[nearest])


def _extent(nodes: Array, theta: Array) -> float:
    """The largest extent around e3 of pieces with nodes (t, k, 3), each near an azimuth (t,)."""
    azimuth = np.arctan2(nodes[..., 1], nodes[..., 0]) - theta[:, None]
    return float(np.ptp((azimuth + np.pi) % (2 * np.pi) - np.pi, axis=1).max())
