"""Quadrature of 1/distance over two adjacent cells, or one cell twice, where it is nearly singular.

Each point of the first cell sees the second along rays from its own place, or from where it would
be in the plane of the second. In polar coordinates with r = s sinh v, a rule is exact for charges
in one surface: the area r dr dangle cancels the pole. It is also exact for charges in two surfaces
at a distance s: both faces, with the same points.

- A rule is points (n, 2) of the reference triangle, or of an edge strip, with weights (n,).
- An edge strip is the charged surface of a cell's edge: coordinate t along the edge and eta through
  the thickness, both in [0, 1].
- s is a scale: a distance, over the size of the cell or the length of the edge, at which the pole
  lies beside the points. Rules are dense on this scale.
- The apex is the place from which the rays start, at r = 0.
- Local edges run around the triangle with the surface on their left.
"""

from itertools import pairwise

import basix
import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.charges import gauss

Array = NDArray[np.float64]
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
ENDS = ((1, 2), (2, 0), (0, 1))  # corners of the local edges, with the surface on the left
SECTOR_POINTS = 5  # over a sector of rays, more over wide ones
RAY_POINTS = 7  # along a ray
INNER_DEGREE = 6  # of the rule on the first cell
POINTS_FROM_FREE_EDGE, POINTS_ALONG_FREE_EDGE = 7, 4  # of the first cell
STRIP_POINTS = (8, 5)  # along an edge and through the thickness
REGULAR_DEGREE = 10  # on cells that touch the other only with another side
AREA_TOLERANCE = 1e-9  # over the area of the reference triangle
STRIP_SCALE = 0.15  # scale of rules from an edge strip to the faces, over the thickness


def graded(n: int, s: float, end: float = 1.0) -> tuple[Array, Array]:
    """Return n points in [0, end] and their weights, dense at 0 on the scale s.

    They are Gauss's in v, with t = s sinh v: this map removes the near pole of 1/sqrt(t² + s²).
    """
    x, w = gauss(n)
    top = np.arcsinh(end / s)
    return s * np.sinh(top * x), w * top * s * np.cosh(top * x)


def _spanned_area(a: Array, b: Array) -> float:
    """Return the signed area that two vectors in the plane span."""
    return float(a[0] * b[1] - a[1] * b[0])


def barycentric(X: Array) -> Array:
    """Return barycentric coordinates (n, 3) of points (n, 2) of the reference triangle."""
    return np.column_stack([1 - X.sum(axis=-1), X])


def polar(apex: Array, s: float) -> tuple[Array, Array]:
    """Return a rule of the reference triangle in polar coordinates: points (n, 2), weights (n,).

    The pole is a place `apex` (2,) in the triangle's plane, inside or outside the triangle. Points
    are dense there on the scale s. The triangle is divided into sectors of rays from the apex; each
    ray from its entrance to its exit has a rule in v, with r = s sinh v.
    """
    corners = CORNERS - apex
    is_inside = min(_spanned_area(corners[i], corners[j]) for i, j in ENDS) > -AREA_TOLERANCE
    sides = np.array([corners[j] - corners[i] for i, j in ENDS])
    points, weights = list[Array](), list[Array]()
    v, wv = gauss(RAY_POINTS)
    # a sector has two vectors from the apex, along its first and its last ray
    for sector in _sectors(corners, is_inside):
        rays, angle_weights = _rays_of_sector(sector, sides, corners)
        # a ray is in the triangle from the length `low` to the length `high`
        side_distances = _ray_lengths(sides, corners, rays)
        low = np.zeros(len(rays)) if is_inside else side_distances.min(axis=1)
        high = np.where(np.isfinite(side_distances), side_distances, 0.0).max(axis=1)
        # points on each ray, by Gauss's rule in v with r = s sinh v
        bottom, top = (np.arcsinh(length / s)[:, None] for length in (low, high))
        r = s * np.sinh(bottom + (top - bottom) * v)
        points.append((apex + r[..., None] * rays[:, None]).reshape(-1, 2))
        # r dr dangle, with dr = sqrt(r² + s²) dv
        weights.append(
            (angle_weights[:, None] * wv * (top - bottom) * np.sqrt(r**2 + s**2) * r).ravel()
        )
    return np.concatenate(points), np.concatenate(weights)


def _rays_of_sector(
    sector: tuple[Array, Array], sides: Array, corners: Array
) -> tuple[Array, Array]:
    """Return unit vectors (n, 2) along rays of a sector, and the weights (n,) of their angles.

    Parameters
    ----------
    sector
        Vectors along its first and its last ray.
    sides, corners
        (3, 2) vectors along the sides of the triangle and to its corners, from the apex.
    """
    A, B = sector
    bisector = A / np.linalg.norm(A) + B / np.linalg.norm(B)
    # the side that the sector's middle ray meets first, with its direction and its normal
    nearest_side = int(np.argmin(_ray_lengths(sides, corners, bisector[None])[0]))
    direction = sides[nearest_side] / np.linalg.norm(sides[nearest_side])
    start = corners[ENDS[nearest_side][0]]
    normal = start - (start @ direction) * direction
    normal = normal / np.linalg.norm(normal)
    # a ray is given by mu: sinh(mu) is the tangent of its angle from the side's normal
    first_mu, last_mu = (np.arcsinh((C @ direction) / (C @ normal)) for C in (A, B))
    x, w = gauss(SECTOR_POINTS + int(abs(last_mu - first_mu)))
    mu = first_mu + (last_mu - first_mu) * x
    rays = (normal[None] + np.sinh(mu)[:, None] * direction) / np.cosh(mu)[:, None]
    # the angle from the normal is atan(sinh(mu)), so that dangle = dmu/cosh(mu)
    return rays, np.asarray(abs(last_mu - first_mu) * w / np.cosh(mu))


def _sectors(V: Array, is_inside: bool) -> list[tuple[Array, Array]]:
    """Divide a triangle, seen from the origin, into sectors between two rays, in order of angle.

    The rays are the vectors to corners V (3, 2) of the triangle. The origin is inside the triangle
    (`is_inside`) or beside it. No corner lies between the rays of a sector; sectors almost without
    an angle are left out.
    """
    if is_inside:
        return [(V[i], V[j]) for i, j in ENDS if _spanned_area(V[i], V[j]) > AREA_TOLERANCE]
    # angles of the corners from the direction to the middle, in ascending order
    to_middle = V.mean(axis=0)
    angles = [np.arctan2(_spanned_area(to_middle, v), to_middle @ v) for v in V]
    order = np.argsort(angles)
    return [(V[i], V[j]) for i, j in pairwise(order) if angles[j] - angles[i] > AREA_TOLERANCE]


def _ray_lengths(sides: Array, corners: Array, rays: Array) -> Array:
    """Return the lengths (n, 3) of rays (n, 2) from the origin to the sides of a triangle.

    `sides` (3, 2) are vectors along the sides, `corners` (3, 2) those to the corners. A length is
    infinite where a ray does not meet a side.
    """
    starts = corners[[i for i, _ in ENDS]]  # where each side starts
    # solves r ray = start + t side, with t in [0, 1] on the side
    det = rays[:, :1] * sides[:, 1] - rays[:, 1:] * sides[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        r = (starts[:, 0] * sides[:, 1] - starts[:, 1] * sides[:, 0]) / det
        t = (starts[:, 0] * rays[:, 1:] - starts[:, 1] * rays[:, :1]) / det
    is_met = (
        (np.abs(det) > AREA_TOLERANCE)
        & (r > AREA_TOLERANCE)
        & (t > -AREA_TOLERANCE)
        & (t < 1 + AREA_TOLERANCE)
    )
    return np.where(is_met, r, np.inf)


def rule_along_sides(dense_sides: tuple[bool, bool, bool], s: float) -> tuple[Array, Array]:
    """Return a rule of the reference triangle that is dense at some of its sides.

    The triangle is divided into three by its centre. The points of a part are dense at its side, on
    the scale 3 s, if `dense_sides` (in the order of local edges) is true; else the part has a
    coarse rule. Points are (n, 2), weights (n,). Without dense sides the triangle is not divided.
    """
    if not any(dense_sides):
        X, w = basix.make_quadrature(basix.CellType.triangle, INNER_DEGREE)
        return np.asarray(X), np.asarray(w)
    points, weights, centre = list[Array](), list[Array](), CORNERS.mean(axis=0)
    for (i, j), is_dense in zip(ENDS, dense_sides, strict=True):
        # a runs from the side to the centre, b along the side
        a, wa = graded(POINTS_FROM_FREE_EDGE, 3 * s) if is_dense else gauss(3)
        b, wb = gauss(POINTS_ALONG_FREE_EDGE if is_dense else 3)
        side = CORNERS[i] + b[:, None] * (CORNERS[j] - CORNERS[i])
        points.append(((1 - a)[:, None, None] * side + a[:, None, None] * centre).reshape(-1, 2))
        weights.append(np.outer(wa * (1 - a), wb).ravel() / 3)
    return np.concatenate(points), np.concatenate(weights)


def at_corner(corner: int) -> tuple[Array, Array]:
    """Return a rule of the reference triangle for integrands nearly singular at a corner.

    It has points (n, 2) and weights (n,), by the Duffy transform: X = V + a (A - V + b (B - A)).
    The corner is V, the opposite side runs from A to B.
    """
    (a, wa), (b, wb) = gauss(6), gauss(5)  # more points towards the corner
    V, A, B = CORNERS[corner], CORNERS[(corner + 1) % 3], CORNERS[(corner + 2) % 3]
    to_side = A - V + b[:, None] * (B - A)  # from the corner to places of the opposite side
    points = (V + a[:, None, None] * to_side).reshape(-1, 2)
    # the Jacobian of the transform is a, as twice the area of the triangle is 1
    return points, np.asarray(np.outer(wa * a, wb).ravel(), dtype=np.float64)


def on_edge(edge: int, t: Array) -> Array:
    """Return points (n, 2) of a local edge of the reference triangle, t (n,) in [0, 1] along it."""
    i, j = ENDS[edge]
    return np.asarray(CORNERS[i] + t[:, None] * (CORNERS[j] - CORNERS[i]))


def continued_across_side(X: Array, sides: tuple[int, int], flip: bool) -> Array:
    """Return points X (n, 2) of a triangle in the reference coordinates of its neighbour.

    The neighbour's coordinates are continued linearly beyond the shared side, so that the results
    are outside of its reference triangle. The shared side has the local numbers `sides` in the
    first and the second triangle; `flip` says that it runs the other way in the second one.
    """
    bary = barycentric(X)
    # corners of the shared side: i and j in the first triangle are m and n in the second
    (i, j), (m, n) = ENDS[sides[0]], ENDS[sides[1]]
    m, n = (n, m) if flip else (m, n)
    continued = np.zeros_like(bary)
    # the third corner, 3 - i - j, is mirrored: its weight t becomes t, t, -t in the second triangle
    opposite = bary[:, 3 - i - j]
    continued[:, m] = bary[:, i] + opposite
    continued[:, n] = bary[:, j] + opposite
    continued[:, 3 - m - n] = -opposite
    return np.asarray(continued[:, 1:])


def strip() -> tuple[Array, Array, Array]:
    """Return a rule of an edge strip: coordinates along and across it, in [0, 1], and weights.

    All three are (n,). Points are dense at both ends of the edge.
    """
    (x, wt), (eta, we) = (gauss(n) for n in STRIP_POINTS)
    t, wt = x**2 * (3 - 2 * x), 6 * x * (1 - x) * wt  # dense at both ends; dt = 6 x (1 - x) dx
    a, b = (coordinate.ravel() for coordinate in np.meshgrid(t, eta, indexing="ij"))
    return a, b, np.asarray(np.outer(wt, we).ravel(), dtype=np.float64)


def strip_rule_seen_from(t: float, eta: float, s: float) -> tuple[Array, Array, Array]:
    """Return a rule of an edge strip, dense at a place (t, eta) on it or beyond one of its ends.

    Parameters
    ----------
    t, eta
        Coordinates along the edge and through the thickness; t is outside [0, 1] beyond an end.
    s
        The scale: the thickness over the length of the edge.

    Returns
    -------
    tuple
        Coordinates along and across the strip, and weights, each (n,).
    """
    x, w = gauss(STRIP_POINTS[1])
    v, wv = gauss(RAY_POINTS)
    # on the strip itself points are dense at the place, by a cubic map. Beyond an end normals may
    # differ, so that no points may come too near each other: the map is linear
    is_beyond = not 0 <= t <= 1
    power, min_scale = (1, 0.1) if is_beyond else (3, 0.02)
    segments = _segments_seen_from(t)
    along, across, weights = list[Array](), list[Array](), list[Array]()
    # below and above the height eta, with points dense at it
    for reach in (-eta, 1 - eta):
        heights = eta + reach * x**power
        height_weights = abs(reach) * power * x ** (power - 1) * w
        for height, weight in zip(heights, height_weights, strict=True):
            # a row of points at this height, dense at t on this scale, by a rule in v
            scale = s * max(abs(height - eta), min_scale)
            # segments on both sides of t: from and to which distance, and in which direction
            for start, end, sign in segments:
                bottom, top = np.arcsinh(start / scale), np.arcsinh(end / scale)
                r = bottom + (top - bottom) * v
                along.append(t + sign * scale * np.sinh(r))
                across.append(np.full_like(r, height))
                weights.append(weight * wv * (top - bottom) * scale * np.cosh(r))
    return np.concatenate(along), np.concatenate(across), np.concatenate(weights)


def _segments_seen_from(t: float) -> list[tuple[float, float, float]]:
    """Return the segments of an edge [0, 1] on both sides of a place t, or on one if t is outside.

    A segment is given by three numbers: the least and the largest distance of its places from t,
    and the sign of the direction from t to them.
    """
    if t < 0:
        return [(-t, 1 - t, 1.0)]
    if t > 1:
        return [(t - 1, t, -1.0)]
    return [(0.0, t, -1.0), (0.0, 1 - t, 1.0)]
