"""A smooth function of place through values at scattered places, noise included.

Each patch of the surface has a spline of its own that minimises sum (f - w)^2 + lambda |f|^2 in the
seminorm of the kernel -r^5 (Duchon 1977). The weights of the patches add up to one (Wendland,
*Scattered Data Approximation*, 2005, chapter 15), so that the function is twice continuously
differentiable. Generalised cross-validation over all patches estimates the noise (Craven and Wahba
1979); the lambda of each patch then has the least estimated risk (Mallows 1973).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
NEIGHBOURS = 80  # values in a patch
TRIED = 60  # patches that estimate the noise
ACROSS = (
    2.5  # radius of a patch in a hole over the distance of the nearest value: it reaches across
)
INNER = 0.7  # part of its radius up to which a patch covers the surface
SAME = 1e-9  # distance over R of one place
FLAT = 0.1  # height of a patch over its width, below which polynomials along the surface are enough
DEPENDENT = 1e-6  # relative size below which a polynomial depends on others
LAMBDAS = np.logspace(-13, 3, 161)  # over the largest eigenvalue of a kernel


@dataclass(frozen=True)
class Scattered:
    """The function; see `scattered`.

    Attributes
    ----------
    centres, radii, splines
        (p, 3), (p,) and p splines: the patches.
    noise
        Standard deviation of the values beside the function, estimated or given.
    residual
        Root mean square of the function less the values.
    """

    centres: Array
    radii: Array
    splines: tuple["_Spline", ...]
    noise: float = 0.0
    residual: float = 0.0

    def __call__(self, x: Array) -> Array:
        """Values (n,) at places (n, 3); NaN where no patch reaches."""
        total, weights = np.zeros(len(x)), np.zeros(len(x))
        members = scipy.spatial.cKDTree(x).query_ball_point(self.centres, self.radii)
        for centre, radius, spline, inside in zip(
            self.centres, self.radii, self.splines, members, strict=True
        ):
            if inside:
                weight = _wendland(np.linalg.norm(x[inside] - centre, axis=1) / radius)
                total[inside] += weight * spline(x[inside])
                weights[inside] += weight
        with np.errstate(invalid="ignore"):
            return np.asarray(total / weights)


def scattered(
    places: Array, values: Array, cover: Array, *, noise: float | None = None
) -> Scattered:
    """A smooth function through values (n,) at places (n, 3); of several values at one place the
    first counts.

    Parameters
    ----------
    cover
        Places (m, 3) all over the surface: patches reach them and their neighbourhoods.
    noise
        Standard deviation of the values' noise; None to estimate it, 0 to interpolate.
    """
    tree = scipy.spatial.cKDTree(places)
    if len(same := tree.query_pairs(SAME, output_type="ndarray")):
        places, values = (np.delete(f, same.max(axis=1), axis=0) for f in (places, values))
        tree = scipy.spatial.cKDTree(places)
    centres, radii = _balls(tree, np.vstack([cover, places]))
    parts = [
        (_Part.of(places[inside], np.asarray(centre)), values[inside])
        for centre, inside in zip(
            centres, map(_some, tree.query_ball_point(centres, radii)), strict=True
        )
    ]
    if noise is None:
        noise = _noise(parts[:: max(1, len(parts) // TRIED)])
    function = Scattered(centres, radii, tuple(part.spline(w, noise) for part, w in parts), noise)
    return replace(function, residual=float(np.sqrt(np.mean((function(places) - values) ** 2))))


def _balls(tree: "scipy.spatial.cKDTree", cover: Array) -> tuple[Array, Array]:
    """Balls with enough places of the tree in each, whose inner parts hold all places of `cover`."""
    first, last = tree.query(cover, [1, min(NEIGHBOURS, tree.n)])[0].T
    reach = np.maximum(last, ACROSS * first) * (1 + 1e-9)
    around, bare, chosen = scipy.spatial.cKDTree(cover), np.ones(len(cover), dtype=bool), []
    for i in range(len(cover)):
        if bare[i]:
            chosen.append(i)
            bare[around.query_ball_point(cover[i], INNER * reach[i])] = False
    return np.asarray(cover[chosen]), np.asarray(reach[chosen])


def _some(inside: list[int]) -> NDArray[np.int64]:
    """Of too many values around a hole a part, drawn evenly."""
    if len(inside) <= 2 * NEIGHBOURS:
        return np.array(inside)
    return np.sort(np.random.default_rng(len(inside)).permutation(inside)[: 2 * NEIGHBOURS])


@dataclass(frozen=True)
class _Spline:
    """A sum of -r^5 and of quadratic polynomials, in lengths of `scale`."""

    places: Array
    centre: Array
    scale: float
    axes: Array
    kernel: Array
    polynomial: Array

    def __call__(self, x: Array) -> Array:
        y = np.asarray((x - self.centre) / self.scale)
        return np.asarray(
            _kernel(y, self.places) @ self.kernel + _quadratics(y, self.axes) @ self.polynomial
        )


@dataclass(frozen=True)
class _Part:
    """Places of a patch in lengths of `scale`, and the axes along which they extend."""

    places: Array
    centre: Array
    scale: float
    axes: Array

    @classmethod
    def of(cls, places: Array, centre: Array) -> "_Part":
        scale = float(np.linalg.norm(places - centre, axis=1).max())
        y = np.asarray((places - centre) / scale)
        _, sizes, axes = np.linalg.svd(y - y.mean(axis=0), full_matrices=False)
        return cls(y, centre, scale, axes[sizes > FLAT * sizes[0]])

    @cached_property
    def polynomials(self) -> Array:
        """An orthonormal basis (n, q) of the quadratic polynomials."""
        U, sizes, _ = np.linalg.svd(_quadratics(self.places, self.axes), full_matrices=False)
        return np.asarray(U[:, sizes > DEPENDENT * sizes[0]])

    @cached_property
    def modes(self) -> tuple[Array, Array]:
        """Eigenvalues of the kernel beside the polynomials, in lengths of R, and its eigenvectors
        (n, n - q).
        """
        free = np.linalg.qr(self.polynomials, mode="complete")[0][:, self.polynomials.shape[1] :]
        sizes, vectors = np.linalg.eigh(free.T @ _kernel(self.places, self.places) @ free)
        return np.maximum(sizes, 1e-15 * sizes[-1]) * self.scale**5, free @ vectors

    def spline(self, values: Array, noise: float) -> _Spline:
        sizes, modes = self.modes
        parts, smoothing = modes.T @ values, 0.0
        if noise:
            tried = sizes[-1] * LAMBDAS
            left = tried[:, None] / (tried[:, None] + sizes)
            smoothing = tried[np.argmin(left**2 @ parts**2 - 2 * noise**2 * left.sum(axis=1))]
        kernel = modes @ (parts / (sizes + smoothing)) * self.scale**5
        rest = (
            values - _kernel(self.places, self.places) @ kernel - smoothing / self.scale**5 * kernel
        )
        polynomial = np.asarray(
            np.linalg.lstsq(_quadratics(self.places, self.axes), rest, rcond=DEPENDENT)[0]
        )
        return _Spline(self.places, self.centre, self.scale, self.axes, kernel, polynomial)


def _noise(parts: Sequence[tuple[_Part, Array]]) -> float:
    """Standard deviation of the noise where one lambda for all patches has the least score of
    cross-validation.
    """
    sizes = np.concatenate([part.modes[0] for part, _ in parts])
    components = np.concatenate([part.modes[1].T @ values for part, values in parts])
    tried = sizes.max() * LAMBDAS
    left = tried[:, None] / (tried[:, None] + sizes)
    squares, freedom = left**2 @ components**2, left.sum(axis=1)
    best = np.argmin(squares / freedom**2)
    return float(np.sqrt(squares[best] / freedom[best]))


def _kernel(x: Array, y: Array) -> Array:
    return -np.asarray(scipy.spatial.distance.cdist(x, y) ** 5)


def _quadratics(y: Array, axes: Array) -> Array:
    t = y @ axes.T
    products = [t[:, i] * t[:, j] for i in range(t.shape[1]) for j in range(i + 1)]
    return np.column_stack([np.ones(len(y)), t, *products])


def _wendland(r: Array) -> Array:
    """1 at 0, falling to 0 at 1, twice continuously differentiable."""
    return np.asarray(np.maximum(1 - r, 0) ** 4 * (4 * r + 1))
