"""The reference of errors: a given number, or the finest run with its own error estimate."""

from collections.abc import Sequence
from dataclasses import dataclass

from scipy.optimize import brentq

ORDERS = 0.05, 30.0  # range of credible observed orders


@dataclass(frozen=True)
class Reference:
    """A value with its own error.

    Attributes
    ----------
    error
        Relative error; None if unknown.
    order
        Observed order of convergence for that error; None if there is none.
    source
        Description of the reference.
    """

    value: float
    error: float | None
    order: float | None
    source: str

    def error_of(self, value: float) -> float:
        """Relative error of another value; absolute if the reference is zero."""
        return abs(value - self.value) / (abs(self.value) or 1.0)


def extrapolated(h: Sequence[float], values: Sequence[float]) -> tuple[float | None, float | None]:
    """Error of the last value, and the order p, from v(h) = v + C h^p (Richardson).

    Parameters
    ----------
    h
        Mesh sizes, decreasing.
    values
        At least three values give the order. With two, or without monotonic convergence, the error is the last
        difference and there is no order.

    Returns
    -------
    tuple
        Absolute error, None for a single value; order, or None.

    Examples
    --------
    >>> error, order = extrapolated([4, 2, 1], [1 + 16e-3, 1 + 4e-3, 1 + 1e-3])
    >>> round(error, 9), round(order, 9)
    (0.001, 2.0)
    """
    if len(values) < 2:
        return None, None
    last = abs(values[-1] - values[-2])
    p = observed_order(h[-3:], values[-3:]) if len(values) > 2 else None
    if p is None:
        return last, None
    return last * h[-1] ** p / (h[-2] ** p - h[-1] ** p), p


def observed_order(h: Sequence[float], values: Sequence[float]) -> float | None:
    """p with (v1 - v2)/(v2 - v3) = (h1^p - h2^p)/(h2^p - h3^p); None if there is none between `ORDERS`."""
    (a, b, c), (v1, v2, v3) = h, values
    if (v1 - v2) * (v2 - v3) <= 0:
        return None

    def mismatch(p: float) -> float:
        return float((v1 - v2) * (b**p - c**p) - (v2 - v3) * (a**p - b**p))

    low, high = ORDERS
    return float(brentq(mismatch, low, high)) if mismatch(low) * mismatch(high) < 0 else None
