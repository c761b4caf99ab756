"""Langevin's law in a thin sheet: its energy in a field, with three derivatives at points.

Along b = mu0 H the material has mu0 M = J L(3 chi b/J), L(x) = coth x - 1/x, that is chi k b with k
= 3 L(x)/x, and the coenergy w = chi b² W/2 with W = 6 ln (sinh x/x)/x²; both are functions of y =
x², with

    2 y k' = 3 (1 - k) - y k²/3,    (y W)' = k.

Along the sheet b is B; across it is the number with B_n = b_n (1 + chi k), for which the energy

    e = max over b_n of -w(|(B_t, b_n)|) - (B_n - b_n)²/2

is stationary. With p = B_n², s = |B_t|² and kappa = chi k its derivatives are e_p = -kappa/(1 +
kappa)/2 and e_s = -kappa/2. So what is solved for stays out of compiled kernels: they take a
polynomial of third order about the present p and s, whose derivatives are those of e itself, as
many as tangents and their derivatives ask for.

Symbols: L is Langevin's function, chi the initial susceptibility, J the saturation, x = 3 chi |b|/J
its argument, k the ratio of the magnetisation to that of a linear material. B is the applied field,
n the sheet's unit normal; indices n and t are components across and along the sheet. Fields and J
have one unit, that of lambda_m. Above `SERIES_LIMIT` functions of y have closed forms, below they
are series, as closed forms lose digits there.
"""

from collections.abc import Callable, Sequence
from math import factorial
from typing import Any

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.memo import PointField, at_quadrature

Array = NDArray[np.float64]
# orders (i, j) of derivatives by p and s, up to the third: (0, 0), (1, 0), (0, 1), (2, 0), ...
ORDERS = [(i, j) for total in range(4) for i in range(total, -1, -1) for j in [total - i]]
SIZE = 2 + len(ORDERS)  # numbers of a polynomial: p and s, then its coefficients
SERIES_LIMIT = 1.0  # y below which a series is summed; its terms are those of y/pi²
SERIES_TERMS = 18
MAX_NEWTON_STEPS = 100  # limit of Newton's method, which takes some six


def _series() -> Array:
    """Return the coefficients of k(y) in powers of y, from its differential equation.

    The power y^n of 2 y k' + 3 k + y k²/3 = 3 gives (2 n + 3) a_n = -(sum of a_i a_(n-1-i))/3.
    """
    a = [1.0]  # k(0) = 1
    for n in range(1, SERIES_TERMS):
        a.append(-sum(a[i] * a[n - 1 - i] for i in range(n)) / (3 * (2 * n + 3)))
    return np.array(a)


RATIO = np.polynomial.Polynomial(_series())  # k(y)
# W(y), from (y W)' = k
COENERGY = np.polynomial.Polynomial(_series() / np.arange(1, SERIES_TERMS + 1))


def ratio(y: Array) -> Array:
    """Return k(y) = 3 L(x)/x, with Langevin's function L and y = x²; a series for small y."""
    # both branches are computed everywhere; the limit keeps each of them finite
    y_above = np.maximum(y, SERIES_LIMIT)
    x = np.sqrt(y_above)
    return np.asarray(
        np.where(
            y < SERIES_LIMIT, RATIO(np.minimum(y, SERIES_LIMIT)), 3 * (x / np.tanh(x) - 1) / y_above
        )
    )


def slopes_of_ratio(y: Array, k: Array) -> tuple[Array, Array]:
    """Return k'(y) and k''(y), with k = k(y) given.

    Below `SERIES_LIMIT` they are derivatives of the series, above closed forms.
    """
    is_below = y < SERIES_LIMIT
    # both branches are computed everywhere; the limit keeps each of them finite
    y_below, y_above = np.minimum(y, SERIES_LIMIT), np.maximum(y, SERIES_LIMIT)
    x = np.sqrt(y_above)
    c, inverse = 1 / np.tanh(x), 4 * np.exp(-2 * x) / np.expm1(-2 * x) ** 2  # coth x and 1/sinh² x
    first = (1.5 * (c / x - inverse) - k) / y_above
    second = (0.75 * (2 * c * inverse - inverse / x - c / y_above) / x - 2 * first) / y_above
    return np.where(is_below, RATIO.deriv()(y_below), first), np.where(
        is_below, RATIO.deriv(2)(y_below), second
    )


def coenergy(y: Array) -> Array:
    """Return W(y) = 6 ln(sinh x/x)/x², y = x²; the coenergy is chi b² W/2."""
    y_above = np.maximum(y, SERIES_LIMIT)
    x = np.sqrt(y_above)
    # ln(sinh x/x) without overflow
    log = x + np.log(-np.expm1(-2 * x) / (2 * x))
    return np.asarray(
        np.where(y < SERIES_LIMIT, COENERGY(np.minimum(y, SERIES_LIMIT)), 6 * log / y_above)
    )


def normal_field(chi: Array, p: Array, s: Array, J: float) -> Array:
    """Return |b_n|, the root of B_n = b_n (1 + chi k), at points.

    Newton's method starts from below, where the function is concave, and stays within bounds.

    Parameters
    ----------
    chi
        Susceptibility.
    p, s
        B_n² and |B_t|² of the field across and along the sheet.
    J
        Saturation, in the unit of B.
    """
    # y = scale |b|²
    scale, normal = (3 * chi / J) ** 2, np.sqrt(p)
    # bounds of b: k lies between 0 and 1
    lowest = normal / (1 + chi)
    b = lowest
    for _ in range(MAX_NEWTON_STEPS):
        y = scale * (s + b**2)
        k = ratio(y)
        k_y, _ = slopes_of_ratio(y, k)  # dk/dy
        slope = 1 + chi * (k + 2 * scale * b**2 * k_y)
        newton_step = (normal - b * (1 + chi * k)) / slope
        b = np.clip(b + newton_step, lowest, normal)
        if np.all(np.abs(newton_step) <= 4e-16 * normal):  # to rounding
            break
    return np.asarray(b)


def polarisation(chi: Array, along: Array, normal: Array, n: Array, J: float) -> Array:
    """Return mu0 M (..., 3) from the field along the sheet (..., 3) and across it (..., 1).

    `chi` is the susceptibility, `n` (..., 3) are the normals, `J` is the saturation.
    """
    s = np.sum(along * along, axis=-1, keepdims=True)
    b_n = normal_field(chi, normal**2, s, J)
    # y = x² of Langevin's argument x = 3 chi |b|/J; kappa = chi k
    y = (3 * chi / J) ** 2 * (s + b_n**2)
    kappa = chi * ratio(y)
    return np.asarray(kappa * (along + normal / (1 + kappa) * n))


def expand_energy(chi: Array, p: Array, s: Array, J: float) -> Array:
    """Return the energy's polynomial at points: p, s and its coefficients, (..., SIZE).

    It is Taylor's polynomial of third order about p = B_n² and s = |B_t|², in the order of
    `ORDERS`; `energy` evaluates it. `chi` is the susceptibility, `J` the saturation.
    """
    # suffixes _s and _p are derivatives by s and p, as in y_s; k1, k2, T1 and T2 are the first and
    # second derivatives of k and T by y. b is |b_n|
    b, scale = normal_field(chi, p, s, J), (3 * chi / J) ** 2
    y = scale * (s + b**2)
    k = ratio(y)
    k1, k2 = slopes_of_ratio(y, k)
    # b_n² = p T with T(y) = 1/(1 + kappa)² = q², where kappa = chi k
    q = 1 / (1 + chi * k)
    T, T1, T2 = q**2, -2 * chi * k1 * q**3, -2 * chi * k2 * q**3 + 6 * (chi * k1) ** 2 * q**4
    # derivatives of y follow from y = scale (s + p T(y))
    D = 1 - scale * p * T1
    y_s, y_p = scale / D, scale * T / D
    D_s, D_p = -scale * p * T2 * y_s, -scale * (T1 + p * T2 * y_p)
    y_ss, y_ps = -y_s * D_s / D, -y_s * D_p / D
    y_pp = scale * T1 * y_p / D - y_p * D_p / D
    # derivatives of e by p and s, (i, j) times: from e_p = -kappa/(1 + kappa)/2 and e_s = -kappa/2
    half = -chi / 2
    derivatives = {
        (0, 0): half * (s + b**2) * coenergy(y) - (np.sqrt(p) - b) ** 2 / 2,
        (1, 0): half * k * q,
        (0, 1): half * k,
        (2, 0): half * k1 * T * y_p,
        (1, 1): half * k1 * y_p,
        (0, 2): half * k1 * y_s,
        (3, 0): half * ((k2 * T - 2 * chi * k1**2 * q**3) * y_p**2 + k1 * T * y_pp),
        (2, 1): half * (k2 * y_p**2 + k1 * y_pp),
        (1, 2): half * (k2 * y_s * y_p + k1 * y_ps),
        (0, 3): half * (k2 * y_s**2 + k1 * y_ss),
    }
    coefficients = [derivatives[i, j] / (factorial(i) * factorial(j)) for i, j in ORDERS]
    return np.stack([*np.broadcast_arrays(p, s, *coefficients)], axis=-1)


def energy(P: Sequence[Expr], p: Expr, s: Expr) -> Expr:
    """Return the energy e(p, s) from the polynomial P (`SIZE`,); see `expand_energy`."""
    # the first two entries are p and s about which it is expanded; coefficients follow in the order
    # of `ORDERS`
    dp, ds = p - P[0], s - P[1]
    return sum(P[2 + number] * dp**i * ds**j for number, (i, j) in enumerate(ORDERS))


def induced(P: Sequence[Expr], B: Expr, normal: Expr, n: Expr) -> Expr:
    """Return mu0 M = -de/dB at the present field B, of which `normal` is the component along n.

    P is the polynomial at this field, so that its first coefficients are the derivatives there.
    """
    by_normal, by_along = (P[2 + ORDERS.index(order)] for order in ((1, 0), (0, 1)))
    return -2 * (by_along * (B - normal * n) + by_normal * normal * n)


def point_field(
    field: PointField,
    chi: fem.Constant | fem.Function,
    J: float,
    fields_and_normals: Callable[[], Sequence[tuple[Array, Array]]],
    inputs: Callable[[], tuple[Any, ...]],
) -> PointField:
    """Let `field`, of twice `SIZE` numbers, follow the energy's polynomials at u and at u = 0.

    It is recomputed when its inputs change. Returns `field`.

    Parameters
    ----------
    field
        Field at the quadrature points of cells.
    chi
        Susceptibility: a constant or a field.
    J
        Saturation, in the unit of the field.
    fields_and_normals
        Function that gives the magnetic field and the normals (cells, points, 3), at u and at u =
        0.
    inputs
        Function that gives the values on which these depend.
    """

    def values() -> Array:
        """Return both polynomials (cells, points, 2 SIZE) for the present fields and normals."""
        chi_at_points = (
            at_quadrature(chi, field.points)[..., 0] if isinstance(chi, fem.Function) else chi.value
        )
        polynomials = []
        for B, n in fields_and_normals():
            p = np.sum(B * n, axis=-1) ** 2
            s = np.maximum(np.sum(B * B, axis=-1) - p, 0.0)
            polynomials.append(expand_energy(np.broadcast_to(chi_at_points, p.shape), p, s, J))
        return np.concatenate(polynomials, axis=-1)

    values_of_chi = chi.x.array if isinstance(chi, fem.Function) else chi.value
    field.compute_by(values, lambda: (values_of_chi, *inputs()))
    return field
