"""The equations of a fold or a bifurcation with a second number p as unknown, and Newton's step for
them.

A fold is R(u, mu, p) = 0 and g(u, mu, p) = 0, a bifurcation R + beta b = 0, g = 0 and v . R_mu = 0,
with g and v of `fold.AugmentedTangent`: K v + g b = 0 and b . v = 1. One more row says where on the
curve a point is (Govaerts, Numerical methods for bifurcations of dynamical equilibria, SIAM 2000,
ch. 3 and 4). A step takes one factorisation and a back-solve for each of R, R_mu and R_p.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from magshell_fenicsx.continuation.bifurcation import DIFFERENCE as RELATIVE
from magshell_fenicsx.continuation.bifurcation import mixed as mixed_third
from magshell_fenicsx.continuation.fold import (
    AugmentedTangent,
    first_difference,
    offset,
    times_tangent,
)
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import State, System, Vector, dot, max_abs

Kind = Literal["fold", "bifurcation"]
# a smaller part of v . R_mu that changes along v is zero by symmetry where bifurcations meet
SYMMETRIC = 1e-4
SOLVES = 25  # of the power iteration for a second eigenvalue near zero


class Family(Protocol):
    """Systems that differ by a number p, with the same unknowns."""

    @property
    def costly(self) -> bool:
        """Whether a system of another p is made anew: points are then taken at given p where that
        is possible.
        """

    def at(self, p: float) -> BorderedNewton:
        """The solver of the system at p; it may raise `NoSystem`."""

    def amplitudes(self, p: float) -> dict[str, float]:
        """The amplitudes beside the one that is unknown."""

    def beside(self, p: float, *, rough: bool = False) -> Sequence[tuple[float, float]]:
        """Weights and values of p of a difference: the derivative by p is the weighted sum of what
        is there.

        A rough one is of first order, from p itself and one more value.
        """


class NoSystem(RuntimeError):
    """There is no system at this value of p; the message gives the reason."""


@dataclass(frozen=True)
class Way:
    """A direction (du, dmu, dp)."""

    du: Vector = field(repr=False)
    dmu: float
    dp: float


@dataclass(frozen=True)
class Locus:
    """A point of a boundary.

    Attributes
    ----------
    phi
        Null vector of K, of length one, the same way along the whole boundary.
    unstable
        Number of unstable directions besides `phi`.
    counts
        The same for each family: the model's own modes, then each family that it excludes, where
        these are counted.
    met
        At a crossing: index in `counts` of the family of the other bifurcation.
    habit
        `Factorisation.habit` after its solve, where one system serves all p.
    way
        Tangent of the boundary, of length one.
    cubic, pull
        phi . Pi'''(phi, phi) and phi . R_mu.
    second
        The eigenvalue nearest to zero besides that of `phi`, where it was asked for; else NaN.
    load_error
        Estimated error of the amplitude.
    """

    p: float
    state: State
    phi: Vector = field(repr=False)
    unstable: int
    way: Way
    cubic: float
    pull: float
    second: float
    load_error: float
    factorisations: int
    counts: Sequence[int] = ()
    met: int = 0
    habit: int = -1

    def unstable_of(self, family: int) -> int:
        """The number of a family; those that are too short for the shell are not counted."""
        return self.counts[family] if family < len(self.counts) else 0


@dataclass(frozen=True)
class Row:
    """g + c . (du, dmu, dp) = 0, the row that says where on the curve a point is."""

    du: Vector | None
    dmu: float
    dp: float
    value: Callable[[Vector, float, float], float]


class Lines:
    """The rows of Newton's step at a state, with what its columns take: du = alpha v - w_R - dmu
    w_mu - dp w_p.
    """

    def __init__(
        self,
        kind: Kind,
        system: System,
        state: State,
        name: str,
        tangent: AugmentedTangent,
        family: Family,
        p: float,
        beside: Sequence[tuple[float, float]],
        scales: tuple[float, float],
    ) -> None:
        self._kind, self._scales, self._largest = kind, scales, 0.0
        self._system, self._state, self._name, self._tangent = system, state, name, tangent
        own = {name: state.mu[name]}
        self._others = [
            (weight, family.at(q).system, {**family.amplitudes(q), **own}) for weight, q in beside
        ]
        v, u, mu = tangent.v, state.u, state.mu
        self._R = system.residual(u, mu)
        self.w_R, self.t_R = tangent.solve(self._R)
        self.w_mu, self.t_mu = tangent.solve(system.load(u, mu, name))
        d = offset(system, v)
        ahead, back = (system.residual(u + way * d * v, mu) for way in (1, -1))
        self.cubic = np.asarray((back - 2 * self._R + ahead) / d**2)
        self.v, self.unstable = v, tangent.unstable
        self.bend, self.pull = dot(system.comm, self.cubic, v), self.t_mu
        self.K_mu_v = first_difference(lambda x: system.load(x, mu, name), system, u, v)
        R_p, self.K_p_v = self._derivatives_by_p([p == q for _, q in beside], d, ahead, back)
        self.w_p, self.t_p = tangent.solve(R_p)

    def _derivatives_by_p(
        self, itself: Sequence[bool], d: float, ahead: Vector, back: Vector
    ) -> tuple[Vector, Vector]:
        """R_p and K_p v; at this p itself R is known, and ahead and back at u + d v and u - d v."""
        u, v, R_p, K_p_v = self._state.u, self._tangent.v, 0.0 * self._R, 0.0 * self._R
        for same, (weight, other, mu) in zip(itself, self._others, strict=True):
            R_p += weight * (self._R if same else other.residual(u, mu))
            K_p_v += weight * (
                (ahead - back) / (2 * d) if same else times_tangent(other, State(u, mu), v)
            )
        return R_p, K_p_v

    def _by_p(self, of: Callable[[System, dict[str, float]], Vector]) -> Vector:
        """The derivative by p at fixed u and amplitude."""
        return np.asarray(
            np.sum([weight * of(other, mu) for weight, other, mu in self._others], axis=0)
        )

    def balance(self, residual: Vector) -> None:
        """Take the residual at a state close by, with the same factors."""
        self.w_R, self.t_R = self._tangent.solve(residual)

    def eigenvalue(self, family: int, p: float, state: State) -> float:
        """The eigenvalue nearest to zero across b, of the model's own modes, with the factors of
        the last step.
        """
        return second_eigenvalue(self._tangent, self._system)

    def step(self, row: Row, value: float | None, *, settled: bool = False) -> Way:
        """Newton's step to the point on which a row has the value zero; without a value the tangent
        of the curve.

        `settled` takes only the residual and the row as not yet zero.
        """
        kind, comm, v, t = self._kind, self._system.comm, self._tangent.v, self._tangent
        w_R, t_R = (self.w_R, self.t_R) if value is not None else (0.0 * v, 0.0)
        g, pull = (t.g, self.t_mu) if value is not None and not settled else (0.0, 0.0)

        def along(c: Vector) -> list[float]:
            """What c . du has of dmu, dp, alpha and of R."""
            return [
                -dot(comm, c, self.w_mu),
                -dot(comm, c, self.w_p),
                dot(comm, c, v),
                -dot(comm, c, w_R),
            ]

        on_v, on_mu = along(self.cubic), dot(comm, v, self.K_mu_v)
        singular = [on_v[0] + on_mu, on_v[1] + dot(comm, v, self.K_p_v), on_v[2], on_v[3] - g]
        own = (
            [self.t_mu, self.t_p, -t.g, t_R] if kind == "fold" else self._without_work(along, pull)
        )
        c = along(row.du) if row.du is not None else [0.0] * 4
        place = [c[0] + row.dmu, c[1] + row.dp, c[2], c[3] + value if value is not None else -1.0]
        rows = np.array([singular, own, place])
        columns = np.array([*self._scales, self._system.length / max_abs(comm, v)])
        rows[:, :3] *= columns
        size = np.abs(rows[:, :3]).max(axis=1)
        if kind == "bifurcation":
            size[1] = max(size[1], self._largest * columns[2])
        rows /= np.where(size, size, 1.0)[:, None]
        dmu, dp, alpha = (
            columns
            * np.linalg.lstsq(rows[:, :3], -rows[:, 3], SYMMETRIC if kind != "fold" else None)[0]
        )
        return Way(alpha * v - w_R - dmu * self.w_mu - dp * self.w_p, float(dmu), float(dp))

    def _without_work(self, along: Callable[[Vector], list[float]], pull: float) -> list[float]:
        """The row v . R_mu = 0, with v' = -K^-1 K' v."""
        system, state, name, comm = self._system, self._state, self._name, self._system.comm
        v, w = self._tangent.v, self.w_mu
        mixed = mixed_third(system, state, v, w, self._R) - self.K_mu_v
        self._largest = dot(comm, np.abs(mixed), np.abs(v))
        mu, d = state.mu[name], RELATIVE * (abs(state.mu[name]) or 1.0)
        ahead, back = (
            system.load(state.u, {**state.mu, name: mu + step}, name) for step in (d, -d)
        )
        by_mu = dot(comm, v, np.asarray((ahead - back) / (2 * d))) - dot(comm, w, self.K_mu_v)
        load_p = self._by_p(lambda other, amplitudes: other.load(state.u, amplitudes, name))
        by_p = dot(comm, v, load_p) - dot(comm, w, self.K_p_v)
        c = along(mixed)
        return [by_mu - c[0], by_p - c[1], -c[2], pull - c[3]]


def second_eigenvalue(tangent: AugmentedTangent, system: System) -> float:
    """The eigenvalue of K nearest to zero across b, by a power iteration of the bordered inverse."""
    x = np.sin(1.0 + np.arange(system.size) + system.comm.rank)
    value = np.nan
    for _ in range(SOLVES):
        y, _ = tangent.solve(x)
        value = dot(system.comm, x, x) / dot(system.comm, x, y)
        x = y / np.sqrt(dot(system.comm, y, y))
    return float(value)
