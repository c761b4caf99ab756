"""Distances between vertices of a mesh, and triangles that are too flat for their neighbours.

A triangle that is much lower than its neighbours costs digits: the stiffness between its vertices
grows as the third power of one over its height. So vertices that are nearer to each other than a
part of the elements there share a grid line, or are refused. The flatness of a triangle says how
much higher its neighbours are.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import MeshError, PatchMesh, directed_sides

Array = NDArray[np.float64]
# over R: nearer places are one, and a place so near to an edge is on it
SAME_PLACE_TOLERANCE = 1e-6
# over the element size: nearer vertices make flat cells
MIN_VERTEX_DISTANCE = 0.02
MAX_GROUP_WIDTH = 0.2  # over the element size: places farther apart have grid lines of their own
MIN_DIGITS, MAX_DIGITS = 4, 17  # significant digits of a number in a message
TEXT_PRECISION = 0.05  # relative error of the difference of two places in a message
# `flatness` times the degree squared, beyond which rounding hides the stiffness of a plate: with
# elements of a quarter to a tenth of its length, Newton's method fails from 11 000 to 31 000
MAX_FLATNESS = 9000.0
SHORT_SIDE = 0.05  # a side over another one, below which messages tell its ends


def grouped_by_distance(
    coordinates: Array, size: Callable[[float], float], rounding: float
) -> list[Array]:
    """Return groups of coordinates, sorted, each of which has one grid line.

    Parameters
    ----------
    coordinates
        (n,) in any order.
    size
        Coordinate -> element size there.
    rounding
        Distance up to which coordinates are always one.
    """
    # chains of neighbours that are near each other
    groups = list[Array]()
    for c in np.sort(coordinates):
        if groups:
            previous = groups[-1][-1]
            smaller_size = min(size(float(c)), size(float(previous)))
            if c - previous <= max(rounding, MIN_VERTEX_DISTANCE * smaller_size):
                groups[-1] = np.append(groups[-1], c)
                continue
        groups.append(np.array([c]))
    # a long chain must not become one line
    narrow_groups = list[Array]()
    for group in groups:
        max_width = max(rounding, MAX_GROUP_WIDTH * size(float(group.mean())))
        narrow_groups += _narrow_parts(group, max_width)
    return narrow_groups


def line_coordinates(
    coordinates: Array, size: Callable[[float], float], ends: tuple[float, float]
) -> list[float]:
    """Return one coordinate for each group of near coordinates between two ends.

    Coordinates near an end are left out.

    Parameters
    ----------
    size
        Coordinate -> element size there.
    """

    def is_inside(x: float) -> bool:
        """Return whether a coordinate is so far from both ends that it has a line of its own."""
        distance_to_end = min(x - ends[0], ends[1] - x)
        return distance_to_end > max(SAME_PLACE_TOLERANCE, MIN_VERTEX_DISTANCE * size(x))

    inner = np.array([x for x in coordinates if is_inside(float(x))])
    groups = grouped_by_distance(inner, size, SAME_PLACE_TOLERANCE)
    return [float(group[0] + group[-1]) / 2 for group in groups]


def _narrow_parts(group: Array, max_width: float) -> list[Array]:
    """Return a group of sorted coordinates (n,), halved until no part is wider than `max_width`."""
    if np.ptp(group) <= max_width:
        return [group]
    lower = group < (group[0] + group[-1]) / 2
    return [*_narrow_parts(group[lower], max_width), *_narrow_parts(group[~lower], max_width)]


def _texts(place: Array, digits: int) -> list[str]:
    """Return the coordinates of a place as texts with a number of digits."""
    return [f"{c + 0.0:.{digits}g}" for c in place]


def distinguishable_texts(a: Array, b: Array) -> tuple[str, str]:
    """Return the coordinates (n,) of two places as texts, with digits that show the difference."""
    for digits in range(MIN_DIGITS, MAX_DIGITS + 1):
        texts = [_texts(place, digits) for place in (a, b)]
        difference = np.array(texts[1], dtype=np.float64) - np.array(texts[0], dtype=np.float64)
        error = np.abs(difference - (b - a)).max()
        if error <= TEXT_PRECISION * np.abs(b - a).max():
            break
    return ", ".join(texts[0]), ", ".join(texts[1])


def flatness(patch: PatchMesh) -> Array:
    """Return for each triangle (m,) how high its neighbours are over its own heights.

    It is the sum over the sides of (h + h') / (4 h), with the heights h and h' over the side of the
    triangle and of its neighbour. Equal triangles have 1.5.
    """
    corners = patch.embedding(patch.nodes)[patch.cells[:, :3]]
    sides = corners[:, [1, 2, 0]] - corners
    doubled_area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # (3 m,) heights over the sides, in the order of `directed_sides`: all first sides first
        heights = (doubled_area[:, None] / np.linalg.norm(sides, axis=2)).T.ravel()
        # number of the edge of each side; two neighbours share it
        _, edge = np.unique(
            np.sort(directed_sides(patch.corners), axis=1), axis=0, return_inverse=True
        )
        edge = edge.ravel()
        # h + h' at each side, in the same order; a border side has no neighbour and counts zero
        sum_of_heights = np.bincount(edge, weights=heights)[edge]
        has_neighbour = np.bincount(edge)[edge] > 1
        ratios = np.where(has_neighbour, sum_of_heights / (4 * heights), 0.0)
    return np.asarray(np.nan_to_num(ratios, nan=np.inf).reshape(3, -1).sum(axis=0))


def refuse_flat(patch: PatchMesh, degree: int, length: float, unit: str, key: str) -> None:
    """Check that no triangle is so flat that rounding hides what holds the shell.

    Parameters
    ----------
    degree
        Degree of the elements.
    length, unit
        R in the coordinates of the message, and their unit, such as "over R".
    key
        Key with which the message begins.

    Raises
    ------
    MeshError
        With the place of the flattest triangle.
    """
    ratios = flatness(patch)
    flattest = int(ratios.argmax())
    if ratios[flattest] < MAX_FLATNESS / degree**2:
        return
    corners = patch.embedding(patch.nodes[patch.cells[flattest, :3]]) * length
    x, y, z = corners.mean(axis=0)
    sides = np.linalg.norm(corners[[1, 2, 0]] - corners, axis=1)
    doubled_area = np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
    height = doubled_area / sides.max()
    near_vertices = ""  # where a short side is the reason, its ends are told
    if sides.min() < SHORT_SIDE * sides.max():
        side = int(sides.argmin())
        start, end = distinguishable_texts(corners[side], corners[(side + 1) % 3])
        near_vertices = f", with vertices at ({start}) and ({end})"
    raise MeshError(
        f"{key}: the triangle around ({x:.9g}, {y:.9g}, {z:.9g}), {unit}, is {height:.3g} high "
        f"and {sides.max():.3g} long{near_vertices}, too flat beside its "
        "neighbours: make triangles of like heights there"
    )
