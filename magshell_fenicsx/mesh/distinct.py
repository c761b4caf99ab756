"""Which places are distinct enough to be vertices of one mesh, and triangles that are too flat for
their neighbours.

The interior penalty of an edge is over the mean height of its two triangles. Where one is lower
than about a hundredth of the other, the default penalty is too small, whatever the degree. So
vertices that are nearer to each other than a part of the elements there share a grid line, or are
refused.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import MeshError, PatchMesh, directed_sides

Array = NDArray[np.float64]
SAME_PLACE = 1e-6  # over R: nearer places are one, and a place so near to an edge is on it
# of the element size: nearer vertices make cells too flat; at half of it plates are unstable
NEAR = 0.02
WIDEST = 0.2  # of the element size: places farther apart have grid lines of their own
MOST_DIGITS = 17  # of a number
# `flatness` that the default penalty stands: grids are unstable from 26 to 37, gmsh's from 32 to 47
FLAT = 25.0
SHORT = 0.05  # a side over another one, from where its ends are told
TOO_FLAT = 400.0  # `flatness` that no penalty stands: rounding makes rigid motions of stiffness


def grouped_by_distance(
    coordinates: Array, size: Callable[[float], float], rounding: float
) -> list[Array]:
    """Return groups of sorted coordinates (n,), each of which has one grid line.

    Parameters
    ----------
    size
        Coordinate -> element size there.
    rounding
        Distance up to which coordinates are always one.
    """
    groups = list[Array]()
    for c in np.sort(coordinates):
        if groups and c - groups[-1][-1] <= max(
            rounding, NEAR * min(size(float(c)), size(float(groups[-1][-1])))
        ):
            groups[-1] = np.append(groups[-1], c)
        else:
            groups.append(np.array([c]))
    return [
        part
        for group in groups
        for part in _narrow_parts(group, max(rounding, WIDEST * size(float(group.mean()))))
    ]


def lines_of(
    coordinates: Array, size: Callable[[float], float], ends: tuple[float, float]
) -> list[float]:
    """Return one coordinate for each group of near ones that lies between two ends, and beside none
    of them."""

    def is_inside(x: float) -> bool:
        return min(x - ends[0], ends[1] - x) > max(SAME_PLACE, NEAR * size(x))

    groups = grouped_by_distance(
        np.array([x for x in coordinates if is_inside(float(x))]), size, SAME_PLACE
    )
    return [float(group[0] + group[-1]) / 2 for group in groups]


def _narrow_parts(group: Array, widest: float) -> list[Array]:
    """Return a group of sorted coordinates (n,), or halves of halves of it that are no wider than
    `widest`."""
    if np.ptp(group) <= widest:
        return [group]
    lower = group < (group[0] + group[-1]) / 2
    return [*_narrow_parts(group[lower], widest), *_narrow_parts(group[~lower], widest)]


def told_apart(one: Array, other: Array) -> tuple[str, str]:
    """Return the coordinates (n,) of two places, with as many digits as show where they differ."""
    for digits in range(4, MOST_DIGITS + 1):
        texts = [[f"{c + 0.0:.{digits}g}" for c in place] for place in (one, other)]
        shown = np.array(texts[1], dtype=np.float64) - np.array(texts[0], dtype=np.float64)
        if np.abs(shown - (other - one)).max() <= 0.05 * np.abs(other - one).max():
            break
    return ", ".join(texts[0]), ", ".join(texts[1])


def flatness(patch: PatchMesh) -> Array:
    """Return for each triangle (m,) how many times as high its neighbours are: sum (h + h') / (4 h)
    over its sides.

    h and h' are the heights of the triangle and of its neighbour over a side. Alike triangles have
    1.5.
    """
    corners = patch.embedding(patch.nodes)[patch.cells[:, :3]]
    sides = corners[:, [1, 2, 0]] - corners
    doubled = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        heights = (doubled[:, None] / np.linalg.norm(sides, axis=2)).T.ravel()
        _, edge = np.unique(
            np.sort(directed_sides(patch.corners), axis=1), axis=0, return_inverse=True
        )
        edge = edge.ravel()
        both = np.bincount(edge, weights=heights)[edge]
        ratios = np.where(np.bincount(edge)[edge] > 1, both / (4 * heights), 0.0)
    return np.asarray(np.nan_to_num(ratios, nan=np.inf).reshape(3, -1).sum(axis=0))


def flat_triangle(
    patch: PatchMesh, penalty: float, default: float, length: float, words: str
) -> str:
    """Say where a triangle is too flat for the penalty of the edges, and what helps; empty if none
    is.

    Parameters
    ----------
    penalty, default
        The factor of the interior penalty, and that of its degree by default.
    length
        R in the coordinates of the message, which `words` name.
    """
    ratios = flatness(patch)
    worst = int(ratios.argmax())
    if ratios[worst] * default <= FLAT * penalty:
        return ""
    corners = patch.embedding(patch.nodes[patch.cells[worst, :3]]) * length
    x, y, z = corners.mean(axis=0)
    sides = np.linalg.norm(corners[[1, 2, 0]] - corners, axis=1)
    height = (
        np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])) / sides.max()
    )
    near_vertices = ""
    if sides.min() < SHORT * sides.max():
        side = int(sides.argmin())
        one, other = told_apart(corners[side], corners[(side + 1) % 3])
        near_vertices = f", with vertices at ({one}) and ({other})"
    hint = _or_penalty(float(ratios[worst]), default)
    return (
        f"the triangle around ({x:.9g}, {y:.9g}, {z:.9g}), {words}, is {height:.3g} high "
        f"and {sides.max():.3g} long{near_vertices}, too flat beside its "
        f"neighbours: make triangles of like heights there{hint}"
    )


def _or_penalty(flat: float, default: float) -> str:
    """Return a hint at the penalty that stands triangles of this `flatness`; empty where none
    does."""
    if not flat < TOO_FLAT:
        return ""
    return f", or take mesh.penalty: {np.ceil(default * flat / FLAT / 100) * 100:g}"


def refuse_flat(patch: PatchMesh, default: float, length: float, words: str, key: str) -> None:
    """See that no triangle is so flat that no penalty helps; parameters as of `flat_triangle`.

    Raises
    ------
    MeshError
        With the place of the flattest; the message begins with the key.
    """
    if not flatness(patch).max() < TOO_FLAT:
        raise MeshError(f"{key}: {flat_triangle(patch, default, default, length, words)}")
