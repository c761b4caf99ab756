"""Polynomials in one or two variables that are fitted to samples by least squares.

Shapes: n fits at once, s samples of each, d variables, c coefficients.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
MIN_SAMPLES_PER_COEFFICIENT = 1.2  # of a polynomial
RIDGE = 1e-10  # regularises fits whose samples lie on few lines


def polynomial_fits(places: Array, weight: Array, degree: int) -> tuple[Array, Array]:
    """Return least-squares fits around the origin, and the sizes of their patches.

    The degree is lowered until there are enough samples; there are fewer coefficients then. A
    small ridge keeps a fit regular even if its samples lie on few lines.

    Parameters
    ----------
    places, weight
        (n, s, d) samples and (n, s) their weights.
    degree
        Degree of the polynomials.

    Returns
    -------
    fits
        (n, c, s) matrices from values to coefficients of the places over the size.
    size
        (n,) largest coordinate of the places.
    """
    size = np.abs(places).max(axis=(1, 2))
    _, sample_count, dimensions = places.shape
    degree = _affordable_degree(degree, dimensions, sample_count)
    values = monomials(places / size[:, None, None], degree)  # (n, s, c)
    weight_roots = np.sqrt(weight / weight.sum(axis=1, keepdims=True))[..., None]
    count = values.shape[-1]
    ridge = np.broadcast_to(RIDGE * np.eye(count), (len(places), count, count))
    # below the samples the ridge has rows of its own, whose values are zero. A QR factorisation
    # keeps the condition small, where normal equations would square it
    Q, upper_triangle = np.linalg.qr(np.concatenate([weight_roots * values, ridge], axis=1))
    Q_of_samples = Q[:, :sample_count]  # the ridge's rows, with values of zero, are left out
    fits = np.linalg.solve(upper_triangle, np.swapaxes(Q_of_samples * weight_roots, 1, 2))
    return np.asarray(fits), size


def _affordable_degree(degree: int, dimensions: int, sample_count: int) -> int:
    """Return the degree, lowered until there are more samples than coefficients.

    `dimensions` is the number of the polynomial's variables.
    """
    while (
        degree and MIN_SAMPLES_PER_COEFFICIENT * len(exponents(dimensions, degree)) > sample_count
    ):
        degree -= 1
    return degree


def exponents(dimensions: int, degree: int) -> list[tuple[int, ...]]:
    """Return the exponents of all monomials up to `degree` in one or two variables."""
    if dimensions == 1:
        return [(n,) for n in range(degree + 1)]
    return [(i, n - i) for n in range(degree + 1) for i in range(n + 1)]


def monomials(y: Array, degree: int) -> Array:
    """Return the values (..., coefficients) of all monomials up to `degree` at y (..., d)."""
    # of each variable its powers (..., degree + 1)
    powers = list[Array]()
    for x in np.moveaxis(y, -1, 0):
        powers_of_variable = [x**n for n in range(degree + 1)]
        powers.append(np.stack(powers_of_variable, axis=-1))
    products = []
    for exponents_of_product in exponents(len(powers), degree):
        factors = [power[..., n] for power, n in zip(powers, exponents_of_product, strict=True)]
        products.append(np.prod(factors, axis=0))
    return np.stack(products, axis=-1)
