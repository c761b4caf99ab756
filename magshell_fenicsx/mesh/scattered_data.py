"""A smooth function of place through values at scattered places, noise included.

Each patch of the surface has a spline of its own that minimises sum (f - w)^2 + lambda |f|^2 in the
seminorm of the kernel -r^5 (Duchon 1977). The weights of the patches add up to one (Wendland,
*Scattered Data Approximation*, 2005, chapter 15), so that the function is twice continuously
differentiable. Generalised cross-validation over all patches estimates the noise (Craven and Wahba
1979); the lambda of each patch then has the least estimated risk (Mallows 1973).

A patch is here a ball of places, in which its spline counts. The seminorm vanishes for quadratic
polynomials. lambda weighs smoothness against the values: zero interpolates. In a patch the splines
are found in the eigenvectors ("modes") of the kernel on the complement of the polynomials, where a
lambda removes the part lambda/(lambda + eigenvalue) of each mode. Lengths are over R.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
MIN_VALUES = 80  # in a patch; at most twice as many are used
MAX_NOISE_PATCHES = 60  # patches that estimate the noise
# radius of a patch in a hole of the data over the distance of the nearest value: it reaches across
HOLE_RADIUS = 2.5
INNER_RADIUS = 0.7  # part of its radius up to which a patch covers the surface
RADIUS_MARGIN = 1e-9  # relative: the farthest value is in the patch
SAME_PLACE_TOLERANCE = 1e-9  # over R
# height of a patch over its width, below which polynomials along the surface are enough
FLATNESS_TOLERANCE = 0.1
RANK_TOLERANCE = 1e-6  # relative size below which a polynomial depends on others
MIN_EIGENVALUE = 1e-15  # over the largest: what rounding leaves of the kernel's eigenvalues
SMOOTHINGS = np.logspace(-13, 3, 161)  # lambda over the largest eigenvalue of a kernel


@dataclass(frozen=True)
class ScatteredSpline:
    """A smooth function made of splines on patches; see `fit_scattered`.

    Attributes
    ----------
    centres, radii, splines
        (p, 3), (p,) and p splines: the patches.
    noise
        Standard deviation of the values about the function, estimated or given.
    residual
        Root mean square of the function less the values.
    """

    centres: Array
    radii: Array
    splines: tuple["_PatchSpline", ...]
    noise: float = 0.0
    residual: float = 0.0

    def __call__(self, x: Array) -> Array:
        """Return the mean (n,) of the patches' splines at places (n, 3); nan where none reaches.

        A spline is weighted by the distance from the centre of its patch.
        """
        total, weights = np.zeros(len(x)), np.zeros(len(x))
        places_of_patches = scipy.spatial.cKDTree(x).query_ball_point(self.centres, self.radii)
        for centre, radius, spline, in_patch in zip(
            self.centres, self.radii, self.splines, places_of_patches, strict=True
        ):
            if in_patch:
                weight = _wendland(np.linalg.norm(x[in_patch] - centre, axis=1) / radius)
                total[in_patch] += weight * spline(x[in_patch])
                weights[in_patch] += weight
        with np.errstate(invalid="ignore"):  # 0/0 where no patch reaches
            return np.asarray(total / weights)


def fit_scattered(
    places: Array, values: Array, cover: Array, *, noise: float | None = None
) -> ScatteredSpline:
    """Return a smooth function through values (n,) at places (n, 3).

    Of several values at one place the first counts.

    Parameters
    ----------
    cover
        Places (m, 3) all over the surface: patches reach them and their neighbourhoods.
    noise
        Standard deviation of the values' noise; None to estimate it, 0 to interpolate.
    """
    tree = scipy.spatial.cKDTree(places)
    if len(duplicates := tree.query_pairs(SAME_PLACE_TOLERANCE, output_type="ndarray")):
        # drop the later one of each pair
        places, values = (np.delete(f, duplicates.max(axis=1), axis=0) for f in (places, values))
        tree = scipy.spatial.cKDTree(places)
    # the patches are balls that cover the surface, each with the places and values in it
    centres, radii = _covering_balls(tree, np.vstack([cover, places]))
    patches = list[tuple[_PatchPlaces, Array]]()
    for centre, numbers in zip(centres, tree.query_ball_point(centres, radii), strict=True):
        in_patch = _thinned(numbers)
        patch = _PatchPlaces.around_centre(places[in_patch], np.asarray(centre))
        patches.append((patch, values[in_patch]))
    if noise is None:
        # some of the patches are enough
        noise = _estimated_noise(patches[:: max(1, len(patches) // MAX_NOISE_PATCHES)])
    splines = tuple(patch.spline(w, noise) for patch, w in patches)
    function = ScatteredSpline(centres, radii, splines, noise)
    residual = float(np.sqrt(np.mean((function(places) - values) ** 2)))
    return replace(function, residual=residual)


def _covering_balls(tree: "scipy.spatial.cKDTree", cover: Array) -> tuple[Array, Array]:
    """Return centres (p, 3) and radii (p,) of balls that have enough places of the tree in each.

    The balls with `INNER_RADIUS` of these radii cover all places of `cover` (m, 3).
    """
    # distances of the nearest value, and of the last one that a patch needs
    distances, _ = tree.query(cover, [1, min(MIN_VALUES, tree.n)])
    nearest, farthest = distances.T
    radii = np.maximum(farthest, HOLE_RADIUS * nearest) * (1 + RADIUS_MARGIN)
    cover_tree, is_uncovered = scipy.spatial.cKDTree(cover), np.ones(len(cover), dtype=bool)
    centres = []
    # greedily: a place that no ball covers yet becomes the centre of one
    for i in range(len(cover)):
        if is_uncovered[i]:
            centres.append(i)
            inner = cover_tree.query_ball_point(cover[i], INNER_RADIUS * radii[i])
            is_uncovered[inner] = False
    return np.asarray(cover[centres]), np.asarray(radii[centres])


def _thinned(numbers: list[int]) -> NDArray[np.int64]:
    """Return the numbers of the values that a patch uses: all, or a random part.

    A patch that reaches across a hole of the data has too many.
    """
    if len(numbers) <= 2 * MIN_VALUES:
        return np.array(numbers)
    generator = np.random.default_rng(len(numbers))  # the same choice in each run
    return np.sort(generator.permutation(numbers)[: 2 * MIN_VALUES])


@dataclass(frozen=True)
class _PatchSpline:
    """The spline of a patch: a sum of kernels -r^5 and of quadratic polynomials.

    Attributes
    ----------
    places
        (n, 3) places of the kernels, relative to the centre and over `scale`.
    centre, scale
        (3,) and number, over R.
    axes
        (1 to 3, 3) directions of the polynomials.
    kernel, polynomial
        Coefficients of kernels (n,) and polynomials.
    """

    places: Array
    centre: Array
    scale: float
    axes: Array
    kernel: Array
    polynomial: Array

    def __call__(self, x: Array) -> Array:
        """Return the values (n,) of the spline at places (n, 3) over R."""
        scaled = np.asarray((x - self.centre) / self.scale)
        kernel_values = _kernel(scaled, self.places) @ self.kernel
        return np.asarray(kernel_values + _quadratics(scaled, self.axes) @ self.polynomial)


@dataclass(frozen=True)
class _PatchPlaces:
    """Places of the values in a patch, and the axes along which they extend.

    Attributes
    ----------
    places
        (n, 3) places relative to the centre and over `scale`.
    centre, scale
        (3,) and number, over R: the ball around the patch.
    axes
        (1 to 3, 3) principal directions of the places; not the normal of a flat patch.
    """

    places: Array
    centre: Array
    scale: float
    axes: Array

    @classmethod
    def around_centre(cls, places: Array, centre: Array) -> "_PatchPlaces":
        """Return places (n, 3) over R, scaled to a ball of radius one around a centre (3,)."""
        scale = float(np.linalg.norm(places - centre, axis=1).max())
        y = np.asarray((places - centre) / scale)
        _, sizes, axes = np.linalg.svd(y - y.mean(axis=0), full_matrices=False)
        return cls(y, centre, scale, axes[sizes > FLATNESS_TOLERANCE * sizes[0]])

    @cached_property
    def polynomials(self) -> Array:
        """An orthonormal basis (n, q) of the quadratic polynomials."""
        U, sizes, _ = np.linalg.svd(_quadratics(self.places, self.axes), full_matrices=False)
        return np.asarray(U[:, sizes > RANK_TOLERANCE * sizes[0]])

    @cached_property
    def modes(self) -> tuple[Array, Array]:
        """Eigenvalues (n - q,) and eigenvectors (n, n - q) of the kernel, with lengths over R.

        They are on the complement of the polynomials: the vectors normal to all q polynomials.
        """
        basis = np.linalg.qr(self.polynomials, mode="complete")[0]
        complement = basis[:, self.polynomials.shape[1] :]
        kernel = complement.T @ _kernel(self.places, self.places) @ complement
        sizes, vectors = np.linalg.eigh(kernel)
        sizes = np.maximum(sizes, MIN_EIGENVALUE * sizes[-1])
        return sizes * self.scale**5, complement @ vectors

    def spline(self, values: Array, noise: float) -> _PatchSpline:
        """Return the spline through values (n,) with noise of a standard deviation.

        Its lambda has the least estimated risk (Mallows); without noise it is zero, and the spline
        interpolates.
        """
        sizes, modes = self.modes
        components, smoothing = modes.T @ values, 0.0  # values in the modes; lambda
        if noise:
            candidates = sizes[-1] * SMOOTHINGS
            # (lambdas, modes) part of each mode that a lambda removes
            removed = candidates[:, None] / (candidates[:, None] + sizes)
            # Mallows' estimate of the risk for each lambda, up to a constant: the squares of what
            # is removed, less twice the noise that is removed
            risk = removed**2 @ components**2 - 2 * noise**2 * removed.sum(axis=1)
            smoothing = candidates[np.argmin(risk)]
        # coefficients of the kernels; scale^5 is for places over the scale instead of over R
        kernel = modes @ (components / (sizes + smoothing)) * self.scale**5
        # the spline solves (K + lambda) kernel + P polynomial = values, with the kernels K and the
        # quadratics P at the places: what the kernels leave of the values is P polynomial
        kernel_values = _kernel(self.places, self.places) @ kernel
        remainder = values - kernel_values - smoothing / self.scale**5 * kernel
        quadratics = _quadratics(self.places, self.axes)
        polynomial = np.asarray(np.linalg.lstsq(quadratics, remainder, rcond=RANK_TOLERANCE)[0])
        return _PatchSpline(self.places, self.centre, self.scale, self.axes, kernel, polynomial)


def _estimated_noise(patches: Sequence[tuple[_PatchPlaces, Array]]) -> float:
    """Return the standard deviation of the noise by generalised cross-validation.

    One lambda for all patches has the least score.

    Parameters
    ----------
    patches
        Places of each patch, and its values (n,).
    """
    # eigenvalues of the modes of all patches, and the values in these modes
    modes_of_patches = [patch.modes for patch, _ in patches]
    sizes = np.concatenate([eigenvalues for eigenvalues, _ in modes_of_patches])
    components = np.concatenate(
        [
            vectors.T @ values
            for (_, vectors), (_, values) in zip(modes_of_patches, patches, strict=True)
        ]
    )
    candidates = sizes.max() * SMOOTHINGS
    # (lambdas, modes) part of each mode that a lambda removes from the spline
    removed = candidates[:, None] / (candidates[:, None] + sizes)
    # sum of squared residuals, and the degrees of freedom that are left to them
    squares, freedom = removed**2 @ components**2, removed.sum(axis=1)
    best = np.argmin(squares / freedom**2)
    return float(np.sqrt(squares[best] / freedom[best]))


def _kernel(x: Array, y: Array) -> Array:
    """Return the kernel -|x - y|^5, (n, m), for places (n, 3) and (m, 3)."""
    return -np.asarray(scipy.spatial.distance.cdist(x, y) ** 5)


def _quadratics(y: Array, axes: Array) -> Array:
    """Return the monomials up to degree two, (n, q), of coordinates along axes."""
    t = y @ axes.T
    products = [t[:, i] * t[:, j] for i in range(t.shape[1]) for j in range(i + 1)]
    return np.column_stack([np.ones(len(y)), t, *products])


def _wendland(r: Array) -> Array:
    """Return Wendland's weight: 1 at 0, falling to 0 at 1, twice continuously differentiable."""
    return np.asarray(np.maximum(1 - r, 0) ** 4 * (4 * r + 1))
