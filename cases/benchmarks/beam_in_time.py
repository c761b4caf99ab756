"""The arch of `beam_in_time.yaml` as a beam in the plane, by NumPy and SciPy alone: when it snaps,
and CPU seconds.

Koiter's energy of a curve, h (a - a0)^2/8 + h^3 (b - b0)^2/24 per length with a = |r'|^2 and the
curvature b, on cubic Hermite elements of half the arch; `solve_ivp` takes the steps (Radau, exact
Jacobian). Units: R, E and R sqrt(rho/E).

python3 cases/benchmarks/beam_in_time.py [--elements 8] [--tolerance 1e-4]
"""

import argparse
import time

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

Array = NDArray[np.float64]
h, ANGLE, DRAG, END = 0.01, np.radians(9.0), 0.1, 40.0
PRESSURE = 0.5 * 2 / np.sqrt(3) * h**2  # at the end: half of p_c
HALFWAY = 1.5 * h  # deflection of the middle that says when it snaps


class Beam:
    """Half an arch: pinned at the first node, its middle, a mirror, at the last; x at a node are r
    and r'.
    """

    def __init__(self, elements: int) -> None:
        n, length = elements, ANGLE / elements
        s, w = np.polynomial.legendre.leggauss(5)
        s, self._w = (s + 1) / 2, w / 2 * length
        e = length
        shape = np.stack(
            [
                1 - 3 * s**2 + 2 * s**3,
                e * (s - 2 * s**2 + s**3),
                3 * s**2 - 2 * s**3,
                e * (s**3 - s**2),
            ]
        )
        first = (
            np.stack(
                [
                    -6 * s + 6 * s**2,
                    e * (1 - 4 * s + 3 * s**2),
                    6 * s - 6 * s**2,
                    e * (3 * s**2 - 2 * s),
                ]
            )
            / e
        )
        second = np.stack([-6 + 12 * s, e * (-4 + 6 * s), 6 - 12 * s, e * (6 * s - 2)]) / e**2
        values, slopes, bends = (
            np.einsum("kq,ij->qikj", by, np.eye(2)).reshape(5, 2, 8)
            for by in (shape, first, second)
        )
        self._values, self._jet = values, np.concatenate([slopes, bends], axis=1)
        angle = ANGLE * (np.arange(n + 1) / n - 1)  # zero at the middle
        cos, sin = np.cos(angle), np.sin(angle)
        self.begin = np.stack([cos, sin, -sin, cos], axis=1).ravel()
        self.free = np.setdiff1d(np.arange(4 * n + 4), [0, 1, 4 * n + 1, 4 * n + 2])
        self.middle = int(np.flatnonzero(self.free == 4 * n)[0])
        self._nodes = 4 * np.arange(n)[:, None] + np.arange(8)
        mass = h * np.einsum("q,qij,qik->jk", self._w, values, values)
        self.mass = self._matrix(np.broadcast_to(mass, (n, 8, 8)))
        self._a0, _, self._b0 = self._metric(self._at(self.begin))

    def forces(self, x: Array, pressure: float) -> Array:
        """Of the free values: inner ones less those of the pressure, which stays normal."""
        jet = self._at(x)
        a, g, b = self._metric(jet)
        by_a, by_g = self._slopes(jet)
        by_b = by_g / np.sqrt(a)[..., None] - (g * a**-1.5 / 2)[..., None] * by_a
        inner = (h * (a - self._a0) / 4)[..., None] * by_a + (h**3 / 12 * (b - self._b0))[
            ..., None
        ] * by_b
        inward = np.stack([-jet[..., 1], jet[..., 0]], axis=-1)
        each = np.einsum("q,qij,eqi->ej", self._w, self._jet, inner)
        each -= pressure * np.einsum("q,qij,eqi->ej", self._w, self._values, inward)
        whole = np.zeros(x.size)
        np.add.at(whole, self._nodes, each)
        return whole[self.free]

    def tangent(self, x: Array, pressure: float) -> Array:
        """The derivative of `forces`."""
        jet = self._at(x)
        a, g, b = self._metric(jet)
        by_a, by_g = self._slopes(jet)
        by_b = by_g / np.sqrt(a)[..., None] - (g * a**-1.5 / 2)[..., None] * by_a
        of_a, of_g = np.diag([2.0, 2, 0, 0]), np.fliplr(np.diag([1.0, -1, -1, 1]))

        def outer(p: Array, q: Array) -> Array:
            return p[..., :, None] * q[..., None, :]

        def each(size: Array) -> Array:
            return size[..., None, None]

        mixed = outer(by_a, by_g) + outer(by_g, by_a)
        of_b = each(a**-0.5) * of_g - each(a**-1.5 / 2) * mixed - each(g * a**-1.5 / 2) * of_a
        of_b += each(0.75 * g * a**-2.5) * outer(by_a, by_a)
        K = each(h * (a - self._a0) / 4) * of_a + h / 4 * outer(by_a, by_a)
        K += each(h**3 / 12 * (b - self._b0)) * of_b + h**3 / 12 * outer(by_b, by_b)
        turned = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0]])
        live = pressure * np.einsum("q,qij,ik,qkl->jl", self._w, self._values, turned, self._jet)
        return self._matrix(
            np.einsum("q,qij,eqik,qkl->ejl", self._w, self._jet, K, self._jet, optimize=True) - live
        )

    def _at(self, x: Array) -> Array:
        return np.einsum("qij,ej->eqi", self._jet, x[self._nodes])

    def _metric(self, jet: Array) -> tuple[Array, Array, Array]:
        """a, r'' times the turned r', and the curvature."""
        a = jet[..., 0] ** 2 + jet[..., 1] ** 2
        g = jet[..., 3] * jet[..., 0] - jet[..., 2] * jet[..., 1]
        return a, g, g / np.sqrt(a)

    def _slopes(self, jet: Array) -> tuple[Array, Array]:
        """Of a and g by (r', r'')."""
        x, y, xx, yy = np.moveaxis(jet, -1, 0)
        return np.stack([2 * x, 2 * y, 0 * x, 0 * x], axis=-1), np.stack([yy, -xx, -y, x], axis=-1)

    def _matrix(self, each: Array) -> Array:
        whole = np.zeros((self.begin.size, self.begin.size))
        np.add.at(whole, (self._nodes[:, :, None], self._nodes[:, None, :]), each)
        return whole[np.ix_(self.free, self.free)]


def deflections(elements: int = 8, tolerance: float = 1e-4) -> tuple[Array, Array]:
    """Times, and the deflections of the middle at these."""
    beam = Beam(elements)
    count, inverse = beam.free.size, np.linalg.inv(beam.mass)
    one, none = np.eye(count), np.zeros((count, count))

    def placed(y: Array) -> Array:
        x = beam.begin.copy()
        x[beam.free] += y[:count]
        return x

    def rate(t: float, y: Array) -> Array:
        v = y[count:]
        return np.concatenate([v, -inverse @ beam.forces(placed(y), PRESSURE * t / END) - DRAG * v])

    def jacobian(t: float, y: Array) -> Array:
        return np.block(
            [[none, one], [-inverse @ beam.tangent(placed(y), PRESSURE * t / END), -DRAG * one]]
        )

    found = solve_ivp(
        rate,
        (0, END),
        np.zeros(2 * count),
        "Radau",
        rtol=tolerance,
        atol=tolerance * h,
        jac=jacobian,
        dense_output=True,
    )
    times = np.linspace(0, END, 4001)
    return times, -found.sol(times)[beam.middle]


def snapped(times: Array, deflection: Array) -> float:
    """When the deflection first passes half way, by splines through the times."""
    return float(min(CubicSpline(times, deflection).solve(HALFWAY, extrapolate=False)))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--elements", type=int, default=8)
    parser.add_argument("--tolerance", type=float, default=1e-4)
    asked = parser.parse_args()
    times, w = deflections(asked.elements, asked.tolerance)
    print(
        f"snaps at {snapped(times, w):.5f}, ends at {w[-1] / h:.4f} h; "
        f"{time.process_time():.2f} s of CPU"
    )


if __name__ == "__main__":
    main()
