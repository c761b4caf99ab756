"""Which places are distinct enough to be vertices of one mesh, and triangles that are too flat for their neighbours.

The interior penalty of an edge is over the mean height of its two triangles. Where one is lower than about a hundredth
of the other, the default penalty is too small, whatever the degree. So vertices that are nearer to each other than a
part of the elements there share a grid line, or are refused.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import MeshError, PatchMesh, directed_sides

Array = NDArray[np.float64]
SAME_PLACE = 1e-6  # over R: nearer places are one, and a place so near to an edge is on it
NEAR = 0.02  # of the element size: with nearer vertices cells are too flat; with half of that a plate is unstable
WIDEST = 0.2  # of the element size: places farther apart have grid lines of their own
MOST_DIGITS = 17  # of a number
FLAT = 25.0  # `flatness` from where meshes of the default penalty may be unstable: 26 to 37 in grids, 32 to 47 by gmsh
TOO_FLAT = 1000.0  # `flatness` that the default penalty never stands


def gathered(coordinates: Array, size: Callable[[float], float], rounding: float) -> list[Array]:
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
        if groups and c - groups[-1][-1] <= max(rounding, NEAR * min(size(float(c)), size(float(groups[-1][-1])))):
            groups[-1] = np.append(groups[-1], c)
        else:
            groups.append(np.array([c]))
    return [part for group in groups for part in _halved(group, max(rounding, WIDEST * size(float(group.mean()))))]


def _halved(group: Array, widest: float) -> list[Array]:
    """The group, or as many parts of it as have at most that width."""
    if np.ptp(group) <= widest:
        return [group]
    lower = group < (group[0] + group[-1]) / 2
    return [*_halved(group[lower], widest), *_halved(group[~lower], widest)]


def told_apart(one: Array, other: Array) -> tuple[str, str]:
    """Return the coordinates (n,) of two places, with as many digits as show where they differ."""
    for digits in range(4, MOST_DIGITS + 1):
        texts = [[f"{c + 0.0:.{digits}g}" for c in place] for place in (one, other)]
        shown = np.array(texts[1], dtype=np.float64) - np.array(texts[0], dtype=np.float64)
        if np.abs(shown - (other - one)).max() <= 0.05 * np.abs(other - one).max():
            break
    return ", ".join(texts[0]), ", ".join(texts[1])


def flatness(patch: PatchMesh) -> Array:
    """Return for each triangle (m,) how many times as high its neighbours are: sum (h + h') / (4 h) over its sides.

    h and h' are the heights of the triangle and of its neighbour over a side. Alike triangles have 1.5.
    """
    corners = patch.embedding(patch.nodes)[patch.cells[:, :3]]
    sides = corners[:, [1, 2, 0]] - corners
    doubled = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        heights = (doubled[:, None] / np.linalg.norm(sides, axis=2)).T.ravel()
        _, edge = np.unique(np.sort(directed_sides(patch.corners), axis=1), axis=0, return_inverse=True)
        edge = edge.ravel()
        both = np.bincount(edge, weights=heights)[edge]
        ratios = np.where(np.bincount(edge)[edge] > 1, both / (4 * heights), 0.0)
    return np.asarray(np.nan_to_num(ratios, nan=np.inf).reshape(3, -1).sum(axis=0))


def flat_triangle(patch: PatchMesh, penalty: float, default: float) -> str:
    """Say where a triangle is too flat for the penalty of the edges, and what helps; empty if none is.

    Parameters
    ----------
    penalty, default
        The factor of the interior penalty, and that of its degree by default.
    """
    return _flat(patch, penalty, default, FLAT)


def refuse_flat(patch: PatchMesh, penalty: float, default: float) -> None:
    """See that no triangle is far too flat; parameters as of `flat_triangle`.

    Raises
    ------
    MeshError
        With the place of the flattest.
    """
    if text := _flat(patch, penalty, default, TOO_FLAT):
        raise MeshError(f"mesh: {text}")


def _flat(patch: PatchMesh, penalty: float, default: float, most: float) -> str:
    flat = flatness(patch)
    worst = int(flat.argmax())
    if flat[worst] * default <= most * penalty:
        return ""
    places = patch.embedding(patch.nodes[patch.cells[worst, :3]])
    x, y, z = places.mean(axis=0)
    lengths = np.linalg.norm(places - places[[1, 2, 0]], axis=1)
    low = np.linalg.norm(np.cross(places[1] - places[0], places[2] - places[0])) / lengths.max()
    return (
        f"the triangle around ({x:.9g}, {y:.9g}, {z:.9g}), over R, is {low:.3g} R high and {lengths.max():.3g} R long, "
        "too flat beside its neighbours: mesh that place with triangles of like sizes, or move the point, edge or rim "
        f"that makes it, or take mesh.penalty: {_two_digits(default * flat[worst] / FLAT)}"
    )


def _two_digits(x: float) -> str:
    """A number rounded upwards to two digits."""
    if not np.isfinite(x):
        return "larger"
    unit = 10.0 ** (np.floor(np.log10(x)) - 1)
    return f"{np.ceil(x / unit) * unit:g}"
