"""Solid harmonics: multipole moments of charges in a box, their shifts, derivatives, translations.

With R = r^l P_l^m(cos theta) e^(i m phi)/(l + m)! and I = (l - m)! P_l^m(cos theta) e^(i m
phi)/r^(l + 1) about centres at a distance D from each other, 1/|a - b| is the sum of (-1)^l
conj(R_l^m(a) R_l'^m'(b)) I_(l + l')^(m + m')(D) (L. Greengard, V. Rokhlin, Acta Numerica 6, 1997;
M. A. Epton, B. Dembart, SIAM J. Sci. Comput. 16, 1995, 865). Real and imaginary parts are taken
apart: Y has ORDER + 1 squared numbers. The sum ends with l + l' = ORDER: it is then Taylor's
polynomial in a - b, so that what two charges do to each other is opposite to rounding.

R are the regular solid harmonics, I the irregular ones; the degree is l, the order m. Y holds the
real and imaginary parts of all R_l^m with m from 0 to l, by degree: COUNT numbers at a place, see
`place_of`. Negative m follow from R_l^-m = (-1)^m conj(R_l^m). Lengths are over any unit.
"""

from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
ORDER = 7  # highest degree
COUNT = (ORDER + 1) ** 2  # numbers in Y


def place_of(degree: int, m: int) -> int:
    """Return the row of Re R_l^m in Y; the imaginary part, for m > 0, is in the next row."""
    return degree**2 + max(0, 2 * m - 1)


def harmonics(x: Array) -> Array:
    """Return the regular solid harmonics Y (COUNT, n) at places x (n, 3)."""
    (a, b, z), Y = np.ascontiguousarray(x.T), np.empty((COUNT, len(x)))
    square = a * a + b * b + z * z
    Y[0] = 1.0
    for m in range(ORDER + 1):
        if m:
            previous, row = place_of(m - 1, m - 1), place_of(m, m)
            # R_m^m from R_(m-1)^(m-1), real part and imaginary part; R_0^0 has no imaginary part
            if m == 1:
                Y[row], Y[row + 1] = -a / 2, -b / 2
            else:
                Y[row] = (b * Y[previous + 1] - a * Y[previous]) / (2 * m)
                Y[row + 1] = -(a * Y[previous + 1] + b * Y[previous]) / (2 * m)
        for degree in range(m + 1, ORDER + 1):
            # recurrence in the degree l at fixed m
            inverse_product = 1 / ((degree + m) * (degree - m))
            # rows of the real part, and of the imaginary part for m > 0, of this degree and of the
            # two lower ones
            for imaginary in range(1 + (m > 0)):
                row, lower, second_lower = (place_of(degree - k, m) + imaginary for k in range(3))
                np.multiply(z, Y[lower], out=Y[row])
                Y[row] *= (2 * degree - 1) * inverse_product
                if degree > m + 1:
                    Y[row] -= inverse_product * square * Y[second_lower]
    return Y


@cache
def derivatives() -> tuple[Array, Array, Array]:
    """Return the matrices N (COUNT, COUNT) with dY/dx_i = N_i Y, for x, y and z."""
    matrices = [np.zeros((COUNT, COUNT)) for _ in range(3)]
    # R_l^m as combinations of Y; zero where |m| > l
    coefficients, zero_row = _complex()
    for degree, m in product(range(1, ORDER + 1), range(ORDER + 1)):
        if m > degree:
            continue
        # derivatives of R_l^m: d/dx + i d/dy gives R_(l-1)^(m+1), d/dx - i d/dy gives
        # -R_(l-1)^(m-1), and d/dz gives R_(l-1)^m
        up, down, unchanged = (
            coefficients.get((degree - 1, n), zero_row) for n in (m + 1, m - 1, m)
        )
        for i, row in enumerate(((up - down) / 2, (up + down) / 2j, unchanged)):
            position = place_of(degree, m)
            matrices[i][position] = row.real
            if m:
                matrices[i][position + 1] = row.imag
    return matrices[0], matrices[1], matrices[2]


def _complex() -> tuple[dict[tuple[int, int], NDArray[np.complex128]], NDArray[np.complex128]]:
    """Return R_l^m as rows of coefficients of Y, (l, m) -> row, and a row of zeros.

    All l up to ORDER and all m from -l to l are there.
    """
    rows = {}
    for degree in range(ORDER + 1):
        for m in range(degree + 1):
            row = np.zeros(COUNT, dtype=np.complex128)
            row[place_of(degree, m)] = 1.0
            if m:
                row[place_of(degree, m) + 1] = 1j
                rows[degree, -m] = (-1) ** m * row.conj()
            rows[degree, m] = row
    return rows, np.zeros(COUNT, dtype=np.complex128)


@cache
def shift(octant: tuple[int, int, int]) -> Array:
    """Return the matrix Z with Y(y/2 + s) = Z Y(y), from a box to its parent.

    s is the middle of this `octant` of the parent; lengths are over the width of each box.
    """
    y = np.random.default_rng(0).uniform(-1, 1, (4 * COUNT, 3))
    s = (np.array(octant) - 0.5) / 2
    # Y(y/2 + s) is a polynomial in y, so that random places determine Z
    return np.asarray(np.linalg.lstsq(harmonics(y).T, harmonics(y / 2 + s).T, rcond=None)[0].T)


def translations(D: Array) -> Array:
    """Return the matrices G (n, COUNT, COUNT) with 1/|a - b| = Y(b) . G Y(a).

    D (n, 3) are the vectors from b's centre to a's; a and b are relative to their centres.
    """
    x, y, z = D.T
    square, w = x * x + y * y + z * z, x + 1j * y
    # irregular harmonics I_l^m of D by recurrence
    irregular: dict[tuple[int, int], NDArray[np.complex128]] = {(0, 0): square ** (-0.5) + 0j}
    for m in range(ORDER + 1):
        if m:
            irregular[m, m] = -(2 * m - 1) * w / square * irregular[m - 1, m - 1]
        for degree in range(m + 1, ORDER + 1):
            irregular[degree, m] = (2 * degree - 1) * z / square * irregular[degree - 1, m]
            if degree > m + 1:
                irregular[degree, m] -= (
                    ((degree - 1) ** 2 - m * m) / square * irregular[degree - 2, m]
                )
    # from Y to the conjugates of all R_l^m, as matrix C; keys are (l, m)
    rows, _ = _complex()
    C, keys = np.array(list(rows.values())).conj(), list(rows)
    # the sum over the harmonics of a and of b: (-1)^l conj(R_l^m(a) R_l'^m'(b)) I_(l + l')^(m + m')
    G = np.zeros((len(D), COUNT, COUNT), dtype=np.complex128)
    for i, (degree_of_a, m_of_a) in enumerate(keys):
        for j, (degree_of_b, m_of_b) in enumerate(keys):
            degree, m = degree_of_a + degree_of_b, m_of_a + m_of_b
            if degree > ORDER:
                continue
            harmonic = irregular[degree, abs(m)]
            if m < 0:
                harmonic = (-1) ** m * harmonic.conj()
            G[:, j, i] = (-1) ** degree_of_a * harmonic
    return np.ascontiguousarray((C.T @ G @ C).real)


def ends() -> Ints:
    """Return how many of the first rows of each column of `translations` are not zero, (COUNT,).

    Entries with l + l' above ORDER are zero: rows of degree l' are needed up to ORDER - l.
    """
    return np.concatenate(
        [np.full(2 * degree + 1, (ORDER - degree + 1) ** 2) for degree in range(ORDER + 1)]
    )
