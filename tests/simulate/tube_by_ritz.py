"""A clamped tube under live pressure by Ritz's method, and Koiter's b of its lowest mode: of no
finite elements.

Displacements are Legendre polynomials along the tube, held at both ends, times the harmonics 0, m
and 2 m around it. The energy is Koiter's, of the exact strains and changes of curvature; the
pressure works on the enclosed volume. Lengths are over R, stresses over E.
"""

from itertools import pairwise

import numpy as np
import scipy
from numpy.polynomial import Legendre
from numpy.typing import NDArray

Array = NDArray[np.float64]
POINTS, AROUND = 32, 12  # along the tube, and around one wave
STEP = 0.1  # of a difference along the mode, in thicknesses


class Tube:
    """Energy of q, the coefficients of w, v and u of the harmonics 0, m and 2 m."""

    def __init__(self, h: float, length: float, nu: float, m: int, count: int) -> None:
        s, weights = np.polynomial.legendre.leggauss(POINTS)
        t = 2 * np.pi / m * np.arange(AROUND) / AROUND
        self.weight = np.outer(weights * length / 2, np.full(AROUND, 1 / AROUND)).ravel()
        self.h, self.nu, self.size = h, nu, 1 / (1 - nu**2)
        x, one, none = (
            np.repeat(s * length / 2, AROUND),
            np.ones(len(s) * AROUND),
            np.zeros(len(s) * AROUND),
        )
        self.const = {
            "r": np.array([x, none, one]),
            "x": np.array([one, none, none]),
            "t": np.array([none, one, none]),
            "xx": np.zeros((3, len(x))),
            "xt": np.zeros((3, len(x))),
            "tt": np.array([none, none, -one]),
        }
        columns, self.harmonic = list[dict[str, Array]](), list[int]()
        for k in (0, 1, 2):
            for axis, power, odd in (
                (0, 1, 1),
                (1, 1, 0),
                (2, 2, 0),
            ):  # u, v, w in the frame e_x, e_theta, e_r
                if k or axis != 1:
                    phase = np.pi / 2 * (axis == 1)
                    waves = [
                        (k * m) ** d * np.cos(k * m * t - phase + d * np.pi / 2) for d in range(3)
                    ]
                    for i in range(count):
                        of_s = (
                            Legendre([1.0])
                            * Legendre.fromroots([-1, 1]) ** power
                            * Legendre.basis(2 * i + odd)
                        )
                        along = [
                            of_s.deriv(d)(s) * (2 / length) ** d if d else of_s(s) for d in range(3)
                        ]
                        columns.append(_derivatives(axis, along, waves))
                        self.harmonic.append(k)
        self.linear = {
            name: np.stack([each[name] for each in columns], axis=2) for name in self.const
        }

    def at(self, q: Array) -> dict[str, Array]:
        return {name: self.const[name] + self.linear[name] @ q for name in self.const}

    def tangent(self, q: Array, p: float) -> tuple[Array, Array]:
        """Gradient and Hessian of the energy."""
        f, A = self.at(q), self.linear
        C, D = self.size * self.h, self.size * self.h**3 / 12
        pairs = (("x", "x"), ("t", "t"), ("x", "t"))
        E = [(np.sum(f[a] * f[b], axis=0) - (a == b)) / 2 for a, b in pairs]
        dE = [(_dot(f[a], A[b]) + _dot(f[b], A[a])) / 2 for a, b in pairs]
        # the square of the area ratio J, and b = k/J with k = r_ab . (r_x x r_t)
        stretches = [2 + 4 * E[1], 2 + 4 * E[0], -8 * E[2]]
        J = np.sqrt((1 + 2 * E[0]) * (1 + 2 * E[1]) - 4 * E[2] ** 2)
        dJ2 = np.sum([w[:, None] * d for w, d in zip(stretches, dE, strict=True)], axis=0)
        of = [_determinant(f, A, (ab, "x", "t")) for ab in ("xx", "tt", "xt")]
        K = [k / J + (i == 1) for i, (k, _) in enumerate(of)]
        dK = [dk / J[:, None] - (k / J**3 / 2)[:, None] * dJ2 for k, dk in of]
        M, N = self._stress(K), [C * n for n in self._stress(E)]
        H = C * self._squared(dE) + D * self._squared(dK)
        both, turned = np.zeros_like(J), np.zeros_like(dJ2)
        for ab, (k, dk), m in zip(("xx", "tt", "xt"), of, M, strict=True):
            H += D * _bent(f, A, (ab, "x", "t"), self.weight * m / J)
            turned -= (m / J**3 / 2)[:, None] * dk - (3 / 8 * m * k / J**5)[:, None] * dJ2
            both -= D * m * k / J**3 / 2
        for (a, b), n, w in zip(pairs, N, stretches, strict=True):
            X = self._product(n / 2 + both * w / 2, A[a], A[b])
            H += X + X.T
        X = D * np.einsum("p,pn,pm->nm", self.weight, turned, dJ2, optimize=True)
        Y = np.einsum("p,pn,pm->nm", 4 * self.weight * both, dE[0], dE[1], optimize=True)
        Z = np.einsum("p,pn,pm->nm", 8 * self.weight * both, dE[2], dE[2], optimize=True)
        _, volume = _determinant(f, A, ("r", "x", "t"))
        self.pull = self.weight @ volume / 3
        g = C * self._sum(E, dE) + D * self._sum(K, dK) + p * self.pull
        return g, H + X + X.T + Y + Y.T - Z + p / 3 * _bent(f, A, ("r", "x", "t"), self.weight)

    def _product(self, n: Array, a: Array, b: Array) -> Array:
        return np.asarray(np.einsum("p,apn,apm->nm", self.weight * n, a, b, optimize=True))

    def _stress(self, e: list[Array]) -> list[Array]:
        return [e[0] + self.nu * e[1], e[1] + self.nu * e[0], 2 * (1 - self.nu) * e[2]]

    def _sum(self, e: list[Array], slopes: list[Array]) -> Array:
        return np.sum(
            [(self.weight * n) @ each for n, each in zip(self._stress(e), slopes, strict=True)],
            axis=0,
        )

    def _squared(self, slopes: list[Array]) -> Array:
        stress = self._stress(slopes)
        return np.sum(
            [(self.weight[:, None] * a).T @ b for a, b in zip(slopes, stress, strict=True)], axis=0
        )


def _derivatives(axis: int, along: list[Array], waves: list[Array]) -> dict[str, Array]:
    """r and its derivatives by x and theta in the frame that turns with theta."""

    def of(d: int, e: int) -> Array:
        found = np.zeros((3, along[0].size * waves[0].size))
        found[axis] = np.outer(along[d], waves[e]).ravel()
        return found

    def turned(a: Array) -> Array:  # e_theta' = -e_r, e_r' = e_theta
        return np.array([0 * a[0], a[2], -a[1]])

    return {
        "r": of(0, 0),
        "x": of(1, 0),
        "t": of(0, 1) + turned(of(0, 0)),
        "xx": of(2, 0),
        "xt": of(1, 1) + turned(of(1, 0)),
        "tt": of(0, 2) + 2 * turned(of(0, 1)) + turned(turned(of(0, 0))),
    }


def _dot(a: Array, A: Array) -> Array:
    return np.einsum("ap,apn->pn", a, A, optimize=True)


def _determinant(
    f: dict[str, Array], A: dict[str, Array], names: tuple[str, str, str]
) -> tuple[Array, Array]:
    """a . (b x c) and its slopes."""
    a, b, c = names
    parts = ((a, b, c), (b, c, a), (c, a, b))
    slopes = np.sum([_dot(np.cross(f[y], f[z], axis=0), A[x]) for x, y, z in parts], axis=0)
    return np.sum(f[a] * np.cross(f[b], f[c], axis=0), axis=0), slopes


def _bent(
    f: dict[str, Array], A: dict[str, Array], names: tuple[str, str, str], weight: Array
) -> Array:
    """The second derivative of a . (b x c), summed with weights."""
    a, b, c = names
    found = 0.0
    for x, y, z in ((a, b, c), (b, c, a), (c, a, b)):
        M = np.einsum(
            "p,apn,apm->nm", weight, A[x], np.cross(A[y], f[z][:, :, None], axis=0), optimize=True
        )
        found = found + M + M.T
    return np.asarray(found)


def koiter(h: float, length: float, nu: float, m: int, count: int = 6) -> tuple[float, float]:
    """The pressure p_c at which m waves bifurcate, and b of p/p_c = 1 + b (w/h)^2 with their height
    w.

    On the branch q0(p) + x phi + x^2 q2 with P2 q2 = -P3 phi^2/2 and the n-th derivatives Pn of the
    energy, it is b p_c = -(P4 phi^4/6 + P3 phi^2 q2)/(d(P2 phi^2)/dp) (Budiansky, Adv. Appl. Mech.
    14, 1974).
    """
    tube = Tube(h, length, nu, m, count)
    harmonic = np.array(tube.harmonic)
    own, waves, others = harmonic == 0, harmonic == 1, harmonic != 1

    def unbuckled(p: float) -> Array:
        q = np.zeros(len(harmonic))
        for _ in range(8):
            g, H = tube.tangent(q, p)
            q[own] -= np.linalg.solve(H[np.ix_(own, own)], g[own])
        return q

    def lowest(p: float) -> float:
        return float(np.linalg.eigvalsh(tube.tangent(unbuckled(p), p)[1][np.ix_(waves, waves)])[0])

    tried = np.linspace(0.1, 1.0, 10) * h**2 / np.sqrt(3 * (1 - nu**2))
    low, high = next((a, b) for a, b in pairwise(tried) if lowest(b) < 0)
    p = float(scipy.optimize.brentq(lowest, low, high, xtol=1e-14))
    q, d = unbuckled(p), 1e-4 * p
    _, H = tube.tangent(q, p)
    phi = np.zeros(len(harmonic))
    phi[waves] = np.linalg.eigh(H[np.ix_(waves, waves)])[1][:, 0]
    phi *= h / np.abs(tube.linear["r"][2] @ phi).max()
    ahead, back = (tube.tangent(q + sign * STEP * phi, p)[1] for sign in (1, -1))
    third = (ahead - back) @ phi / (2 * STEP)
    fourth = phi @ (ahead + back - 2 * H) @ phi / STEP**2
    q2 = np.zeros(len(harmonic))
    q2[others] = -np.linalg.solve(H[np.ix_(others, others)], third[others]) / 2
    stiffer, softer = (tube.tangent(unbuckled(p + sign * d), p + sign * d)[1] for sign in (1, -1))
    fall = phi @ (stiffer - softer) @ phi / (2 * d)
    return p, float(-(fourth / 6 + third @ q2) / fall / p)
