"""Rules for the charges of two cells that touch, or of one with itself: points where 1/distance is
nearly singular.

Each point of the first cell sees the second along rays from where it is itself, or from where the
plane of the second would have it. With polar coordinates and r = s sinh v a rule is exact for
charges in one surface, where the area r dr dangle takes the pole away, and for those in two at a
distance s: both faces, with the same points.
"""

from itertools import pairwise

import basix
import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.charges import gauss

Array = NDArray[np.float64]
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
ENDS = ((1, 2), (2, 0), (0, 1))  # corners of the local edges, with the surface on the left
ALONG, RADIAL = 5, 7  # points over a sector of rays, more over wide ones, and along a ray
INNER = 6  # degree of the rule on the first cell
FROM_EDGE, BESIDE = 7, 4  # its points off and along a free edge
STRIP = (8, 5)  # points along an edge and through the thickness
APART = 10  # degree on cells that touch the other only with another side
THIN = 1e-9
SPLIT = 0.15  # of the thickness: from points on an edge strip to the faces


def graded(n: int, s: float, end: float = 1.0) -> tuple[Array, Array]:
    """Points in [0, end] and weights, dense at 0 on the scale s."""
    x, w = gauss(n)
    top = np.arcsinh(end / s)
    return s * np.sinh(top * x), w * top * s * np.cosh(top * x)


def _turn(a: Array, b: Array) -> float:
    """The area that two vectors in the plane span, with its sign."""
    return float(a[0] * b[1] - a[1] * b[0])


def barycentric(X: Array) -> Array:
    return np.column_stack([1 - X.sum(axis=-1), X])


def polar(apex: Array, s: float) -> tuple[Array, Array]:
    """Points (n, 2) and weights of the reference triangle as seen from a place (2,) in its plane,
    with the scale s.
    """
    V = CORNERS - apex
    inside = min(_turn(V[i], V[j]) for i, j in ENDS) > -THIN
    lines = np.array([V[j] - V[i] for i, j in ENDS])
    points, weights = list[Array](), list[Array]()
    v, wv = gauss(RADIAL)
    for A, B in _sectors(V, inside):
        middle = A / np.linalg.norm(A) + B / np.linalg.norm(B)
        entry = int(np.argmin(_cuts(lines, V, middle[None])[0]))
        along = lines[entry] / np.linalg.norm(lines[entry])
        start = V[ENDS[entry][0]]
        normal = start - (start @ along) * along
        normal = normal / np.linalg.norm(normal)
        ends = [np.arcsinh((C @ along) / (C @ normal)) for C in (A, B)]
        x, w = gauss(ALONG + int(abs(ends[1] - ends[0])))
        mu = ends[0] + (ends[1] - ends[0]) * x
        rays = (normal[None] + np.sinh(mu)[:, None] * along) / np.cosh(mu)[:, None]
        cuts = _cuts(lines, V, rays)
        low = np.zeros(len(x)) if inside else cuts.min(axis=1)
        high = np.where(np.isfinite(cuts), cuts, 0.0).max(axis=1)
        bottom, top = (np.arcsinh(each / s)[:, None] for each in (low, high))
        r = s * np.sinh(bottom + (top - bottom) * v)
        turn = (abs(ends[1] - ends[0]) * w / np.cosh(mu))[:, None]
        points.append((apex + r[..., None] * rays[:, None]).reshape(-1, 2))
        weights.append((turn * wv * (top - bottom) * np.sqrt(r**2 + s**2) * r).ravel())
    return np.concatenate(points), np.concatenate(weights)


def _sectors(V: Array, inside: bool) -> list[tuple[Array, Array]]:
    """Pairs of rays between which the corners (3, 2) of a triangle around or beside the origin have
    no other.
    """
    if inside:
        return [(V[i], V[j]) for i, j in ENDS if _turn(V[i], V[j]) > THIN]
    towards = V.mean(axis=0)
    angle = [np.arctan2(_turn(towards, v), towards @ v) for v in V]
    order = np.argsort(angle)
    return [(V[i], V[j]) for i, j in pairwise(order) if angle[j] - angle[i] > THIN]


def _cuts(lines: Array, starts: Array, rays: Array) -> Array:
    """Where rays (n, 2) from the origin cut the sides of a triangle, (n, 3); infinite where they do
    not.
    """
    starts = starts[[i for i, _ in ENDS]]
    det = rays[:, :1] * lines[:, 1] - rays[:, 1:] * lines[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        r = (starts[:, 0] * lines[:, 1] - starts[:, 1] * lines[:, 0]) / det
        t = (starts[:, 0] * rays[:, 1:] - starts[:, 1] * rays[:, :1]) / det
    met = (np.abs(det) > THIN) & (r > THIN) & (t > -THIN) & (t < 1 + THIN)
    return np.where(met, r, np.inf)


def around(mask: tuple[bool, bool, bool], s: float) -> tuple[Array, Array]:
    """A rule of the reference triangle that is dense at some of its sides."""
    if not any(mask):
        X, w = basix.make_quadrature(basix.CellType.triangle, INNER)
        return np.asarray(X), np.asarray(w)
    points, weights, centre = list[Array](), list[Array](), CORNERS.mean(axis=0)
    for (i, j), free in zip(ENDS, mask, strict=True):
        a, wa = graded(FROM_EDGE, 3 * s) if free else gauss(3)
        b, wb = gauss(BESIDE if free else 3)
        side = CORNERS[i] + b[:, None] * (CORNERS[j] - CORNERS[i])
        points.append(((1 - a)[:, None, None] * side + a[:, None, None] * centre).reshape(-1, 2))
        weights.append(np.outer(wa * (1 - a), wb).ravel() / 3)
    return np.concatenate(points), np.concatenate(weights)


def at_corner(corner: int) -> tuple[Array, Array]:
    """A rule of the reference triangle for what is nearly singular at a corner."""
    (a, wa), (b, wb) = gauss(6), gauss(5)
    V, A, B = CORNERS[corner], CORNERS[(corner + 1) % 3], CORNERS[(corner + 2) % 3]
    side = A - V + b[:, None] * (B - A)
    return (V + a[:, None, None] * side).reshape(-1, 2), np.asarray(
        np.outer(wa * a, wb).ravel(), dtype=np.float64
    )


def on_edge(edge: int, t: Array) -> Array:
    i, j = ENDS[edge]
    return np.asarray(CORNERS[i] + t[:, None] * (CORNERS[j] - CORNERS[i]))


def beyond(X: Array, sides: tuple[int, int], flip: bool) -> Array:
    """Where points of a triangle are in the plane of the next one, behind the side that both have."""
    bary, (i, j), (m, n) = barycentric(X), ENDS[sides[0]], ENDS[sides[1]]
    m, n = (n, m) if flip else (m, n)
    beyond_side = np.zeros_like(bary)
    rest = bary[:, 3 - i - j]
    beyond_side[:, m], beyond_side[:, n], beyond_side[:, 3 - m - n] = (
        bary[:, i] + rest,
        bary[:, j] + rest,
        -rest,
    )
    return np.asarray(beyond_side[:, 1:])


def strip() -> tuple[Array, Array, Array]:
    """Coordinates along an edge and through the thickness, in [0, 1], and weights."""
    (x, wt), (eta, we) = (gauss(n) for n in STRIP)
    t, wt = x**2 * (3 - 2 * x), 6 * x * (1 - x) * wt  # dense at both ends
    a, b = (each.ravel() for each in np.meshgrid(t, eta, indexing="ij"))
    return a, b, np.asarray(np.outer(wt, we).ravel(), dtype=np.float64)


def along_strip(t: float, eta: float, s: float) -> tuple[Array, Array, Array]:
    """The same of a strip seen from a place on it, or beyond one of its ends."""
    x, w = gauss(STRIP[1])
    v, wv = gauss(RADIAL)
    beyond_it = (
        not 0 <= t <= 1
    )  # where normals may differ, so that no points come too near each other
    power, least = (1, 0.1) if beyond_it else (3, 0.02)
    ways = (
        [(0.0, t, -1.0), (0.0, 1 - t, 1.0)]
        if not beyond_it
        else [(-t, 1 - t, 1.0) if t < 0 else (t - 1, t, -1.0)]
    )
    pieces = list[tuple[Array, Array, Array]]()
    for high in (-eta, 1 - eta):
        for e, we in zip(
            eta + high * x**power, abs(high) * power * x ** (power - 1) * w, strict=True
        ):
            scale = s * max(abs(e - eta), least)
            for near, far, way in ways:
                bottom, top = np.arcsinh(near / scale), np.arcsinh(far / scale)
                r = bottom + (top - bottom) * v
                along = t + way * scale * np.sinh(r)
                pieces.append(
                    (along, np.full_like(r, e), we * wv * (top - bottom) * scale * np.cosh(r))
                )
    return tuple(np.concatenate(each) for each in zip(*pieces, strict=True))
