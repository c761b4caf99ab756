"""Systems with one or two unknowns whose paths are known."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.continuation.system import (
    Amplitudes,
    Vector,
    WeightedDisplacement,
)

Array = NDArray[np.float64]


@dataclass
class Toy:
    """Pi(u) = Pi_0(u) - mu u[0], from the gradient and the Hessian of Pi_0."""

    gradient: Callable[[Vector], Vector]
    hessian: Callable[[Vector], Vector]
    size: int
    length: float = 1.0
    comm = MPI.COMM_SELF
    coordinates = frozenset[str]()

    def __post_init__(self) -> None:
        self.K = PETSc.Mat().createAIJ([self.size, self.size], comm=self.comm)
        self.K.setUp()
        self.K.setOption(PETSc.Mat.Option.SYMMETRIC, True)

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        return self.gradient(u) + mu["load"] * self.load(u, mu, "load")

    def load(self, u: Vector, mu: Amplitudes, name: str) -> Vector:
        column = np.zeros(self.size)
        column[0] = -1.0
        return column

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        return -float(u[0])

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        return 0.0

    def tangent(
        self, u: Vector, mu: Amplitudes, stress: Sequence[WeightedDisplacement] = ()
    ) -> PETSc.Mat:
        self.K.setValues(range(self.size), range(self.size), self.hessian(u))
        self.K.assemble()
        return self.K


def snap_through(p: float = 0.0, length: float = 1.0) -> Toy:
    """Shallow arch, load = x^3 - 3 x^2 + (2 + p) x with u = length x.

    For p < 1 there are folds at x = 1 -+ sqrt((1 - p)/3); for p = 0 the load is +-2/(3 sqrt(3))
    there.
    """

    def gradient(u: Vector) -> Vector:
        x = u / length
        return x**3 - 3 * x**2 + (2 + p) * x

    def hessian(u: Vector) -> Vector:
        x = u / length
        return (3 * x**2 - 6 * x + 2 + p) / length

    return Toy(gradient, hessian, 1, length)


def pitchfork(imperfection: float = 0.0, stiffening: float = 1.0) -> Toy:
    """u[0] shortens a column that bends by v = u[1] once u[0] passes 1: bifurcation at load 1.

    Pi_0 = u^2/2 + (1 - u) v^2/2 + stiffening v^4/4 - imperfection v. With the stiffening -1/2,
    (1 - load) v - v^3 = imperfection: Koiter's fold at load = 1 - 3 (imperfection/2)^(2/3).
    """

    def gradient(x: Vector) -> Vector:
        u, v = x
        return np.array([u - v**2 / 2, (1 - u) * v + stiffening * v**3 - imperfection])

    def hessian(x: Vector) -> Vector:
        u, v = x
        return np.array([[1.0, -v], [-v, 1 - u + 3 * stiffening * v**2]])

    return Toy(gradient, hessian, 2)


def closed_loop() -> Toy:
    """Pi_0 = (u^2 - 1) v + v^3/3: equilibria on the circle u = cos t, v = sin t alone, at the load
    sin 2t.
    """

    def gradient(x: Vector) -> Vector:
        u, v = x
        return np.array([2 * u * v, u**2 + v**2 - 1])

    def hessian(x: Vector) -> Vector:
        u, v = x
        return np.array([[2 * v, 2 * u], [2 * u, 2 * v]])

    return Toy(gradient, hessian, 2)


def snap_back(k: float, c: float) -> Toy:
    """The arch behind a spring, and a column: q = u[0] is loaded, x = u[1] snaps through, v = u[2]
    bends.

    Pi_0 = k (q - x)^2/2 + x^4/4 - x^3 + x^2 + (c - x) v^2/2 + v^4/4. With f = x^3 - 3x^2 + 2x: load
    = f(x) and q = x + f/k where v = 0; folds in the load at x = 1 -+ 1/sqrt(3); folds in q, for k <
    1, at x = 1 -+ sqrt((1 - k)/3); a pitchfork at x = c, beyond which v^2 = x - c and load = f(x) -
    (x - c)/2.
    """

    def gradient(u: Vector) -> Vector:
        q, x, v = u
        f = x**3 - 3 * x**2 + 2 * x
        return np.array([k * (q - x), -k * (q - x) + f - v**2 / 2, (c - x) * v + v**3])

    def hessian(u: Vector) -> Vector:
        _, x, v = u
        slope = 3 * x**2 - 6 * x + 2
        return np.array([[k, -k, 0.0], [-k, k + slope, -v], [0.0, -v, c - x + 3 * v**2]])

    return Toy(gradient, hessian, 3)


def column_of_modes(distance: float, hidden: float = 0.0, count: int = 2, *others: float) -> Toy:
    """u^2/2 + sum (c_i - u) v_i^2/2 + v_i^4/4: modes at the loads c_i, `distance` apart from 1 on,
    and at others.

    So near as `hidden` to 1 the residual is not a number, as rounding or divergence hide points in
    a shell.
    """
    first = np.array([*(1 + distance * np.arange(count)), *others])
    count = len(first)

    def gradient(x: Vector) -> Vector:
        u, v = x[0], x[1:]
        if abs(u - 1) < hidden:
            return np.full(1 + count, np.nan)
        return np.array([u - np.sum(v**2) / 2, *((first - u) * v + v**3)])

    def hessian(x: Vector) -> Vector:
        K = np.diag([1.0, *(first - x[0] + 3 * x[1:] ** 2)])
        K[0, 1:] = K[1:, 0] = -x[1:]
        return K

    return Toy(gradient, hessian, 1 + count)


def matrix(entries: np.ndarray) -> PETSc.Mat:
    """A symmetric matrix of PETSc's from all its entries."""
    n = len(entries)
    A = PETSc.Mat().createAIJ([n, n], comm=PETSc.COMM_SELF)
    A.setUp()
    A.setValues(range(n), range(n), entries.ravel())
    A.assemble()
    A.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return A
