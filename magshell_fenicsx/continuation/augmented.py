"""Equations of folds and bifurcations with a second parameter p, and Newton's step for them.

A fold is R(u, mu, p) = 0 and g(u, mu, p) = 0, a bifurcation R + beta b = 0, g = 0 and v . R_mu = 0,
with g and v of `fold.AugmentedTangent`: K v + g b = 0 and b . v = 1. One more row says where on the
curve a point is (Govaerts, Numerical methods for bifurcations of dynamical equilibria, SIAM 2000,
ch. 3 and 4). A step takes one factorisation and a back-solve for each of R, R_mu and R_p.

Pi(u; mu) is the potential, R = dPi/du, K = dR/du; a dot is the inner product over all ranks, and
Pi'''(v, w, .) a third derivative as a vector. mu is the one load parameter (amplitude) that is
unknown. w_R, w_mu and w_p solve K w + t b = R, R_mu and R_p with b . w = 0; their t are the parts
that K cannot balance. A family of systems (`SystemFamily`) has one system for each p. A family of
modes, by number, shares a tangent: 0 are the model's own modes, 1, 2, ... symmetry-breaking modes,
which the model excludes. The null vector is also called phi, scaled to length one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.bifurcation import DIFFERENCE_STEP as RELATIVE_DIFFERENCE_STEP
from magshell_fenicsx.continuation.bifurcation import mixed_third_derivative
from magshell_fenicsx.continuation.fold import (
    AugmentedTangent,
    difference_step,
    first_difference,
    times_tangent,
)
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import State, System, Vector, dot, max_abs

Kind = Literal["fold", "bifurcation"]
# a smaller part of v . R_mu that changes along v is zero by symmetry where bifurcations meet
SYMMETRY_TOLERANCE = 1e-4
POWER_ITERATIONS = 25  # for a second eigenvalue near zero


class SystemFamily(Protocol):
    """Systems that differ by a parameter p, with the same unknowns.

    All methods are collective.
    """

    @property
    def costly(self) -> bool:
        """Whether a system at another p is made anew.

        Points are then taken at given p where that is possible.
        """

    def solver_at(self, p: float) -> BorderedNewton:
        """Return the solver of the system at p.

        Raises
        ------
        NoSystem
            If there is no system at p.
        """

    def amplitudes(self, p: float) -> dict[str, float]:
        """Return the amplitudes that are given at p: all but the unknown one."""

    def difference_weights(
        self, p: float, *, low_order: bool = False
    ) -> Sequence[tuple[float, float]]:
        """Return weights and values of p of a difference formula.

        The derivative by p is the weighted sum of a quantity of the systems at these values.

        Parameters
        ----------
        low_order
            Whether the formula is of first order, from p itself and one more value.

        Returns
        -------
        Pairs of a weight and its value of p.
        """


class NoSystem(RuntimeError):
    """No system exists at this value of p; the message gives the reason."""


@dataclass(frozen=True)
class CurveVector:
    """A vector (du, dmu, dp): a direction, or a point (u, mu, p)."""

    du: Vector = field(repr=False)
    dmu: float
    dp: float


@dataclass(frozen=True)
class BoundaryPoint:
    """A point of a boundary of stability: an instability at one value of p.

    Attributes
    ----------
    p, state
        The second parameter, and displacement and amplitudes there.
    phi
        Null vector of K, of length one, with the same orientation along the whole boundary.
    unstable
        Number of unstable directions other than `phi`.
    way
        Tangent (du, dmu, dp) of the boundary, of length one in the metric of `Boundary.inner`.
    cubic, pull
        phi . Pi'''(phi, phi), which is zero at a cusp, and phi . R_mu, zero at a bifurcation.
    second
        The eigenvalue nearest to zero other than that of `phi`, if requested; else NaN.
    load_error
        Estimated error of the amplitude.
    factorisations
        Iterations of its solve, of one factorisation each.
    counts
        Number of unstable directions other than `phi` for each family of modes: the model's own,
        then each one that it excludes, where these are counted.
    met
        At a crossing: index in `counts` of the family of the other bifurcation.
    habit
        `Factorisation.habit` after its solve, with which a resumed run has the same rounding; -1
        where systems at other p are made anew.
    """

    p: float
    state: State
    phi: Vector = field(repr=False)
    unstable: int
    way: CurveVector
    cubic: float
    pull: float
    second: float
    load_error: float
    factorisations: int
    counts: Sequence[int] = ()
    met: int = 0
    habit: int = -1

    def unstable_of(self, family: int) -> int:
        """Return the count of a family of modes; 0 if its waves are too short to be counted."""
        return self.counts[family] if family < len(self.counts) else 0


@dataclass(frozen=True)
class CurveRow:
    """The scalar equation that says where on a boundary a point is.

    Attributes
    ----------
    du, dmu, dp
        Its gradient by u, mu and p; du is None where it is zero.
    value
        Called with u, mu and p; it returns the value of the equation, zero at the point.
    """

    du: Vector | None
    dmu: float
    dp: float
    value: Callable[[Vector, float, float], float]


@dataclass(frozen=True)
class DifferenceSystem:
    """The system at one value of p in a difference by p.

    Attributes
    ----------
    weight
        Weight of its residual in the difference.
    system, mu
        The system, and all its amplitudes.
    is_same_p
        Whether p is that of the state, where the residual is known.
    """

    weight: float
    system: System
    mu: dict[str, float]
    is_same_p: bool


class AugmentedRows:
    """The linear equations (rows) of Newton's step at a state of a boundary.

    The step is du = alpha v - w_R - dmu w_mu - dp w_p: with it R + K du + R_mu dmu + R_p dp is a
    multiple of b. Three rows determine the scalar unknowns dmu, dp and alpha. A row is given by its
    coefficients of these three and its constant term, four numbers whose weighted sum is zero. The
    constructor is collective.

    Parameters
    ----------
    kind
        Whether the boundary is of folds or of bifurcations.
    name
        The unknown amplitude mu.
    tangent
        The augmented tangent at the state.
    difference
        The systems whose weighted sum is a derivative by p.
    scales
        Changes of the amplitude and of p that count as of order one.

    Attributes
    ----------
    v
        The null vector.
    unstable
        Number of unstable directions other than v.
    bend, pull
        v . Pi'''(v, v) and v . R_mu.
    w_R, w_mu, w_p, t_R, t_mu, t_p
        Responses w and remainders t of R, R_mu and R_p.
    cubic, K_mu_v, K_p_v
        The vectors Pi'''(v, v, .) and (dK/dmu) v, (dK/dp) v at fixed u.

    Private fields: `_R` is the residual. `_mixed_size` is the size of the terms that may cancel in
    the row v . R_mu, for its rounding. `_difference` are the systems of the difference by p,
    `_tangent` is the augmented tangent.
    """

    def __init__(
        self,
        kind: Kind,
        system: System,
        state: State,
        name: str,
        tangent: AugmentedTangent,
        difference: Sequence[DifferenceSystem],
        scales: tuple[float, float],
    ) -> None:
        """Solve for the responses w with the tangent's factors, and differentiate g. Collective."""
        self._kind, self._scales, self._mixed_size = kind, scales, 0.0
        self._system, self._state, self._name, self._tangent = system, state, name, tangent
        self._difference = difference
        v, u, mu = tangent.v, state.u, state.mu
        self._R = system.residual(u, mu)
        # responses to the residual and to the load, orthogonal to b
        self.w_R, self.t_R = tangent.solve(self._R)
        self.w_mu, self.t_mu = tangent.solve(system.load(u, mu, name))
        step_factor = difference_step(system, v)
        # residuals at u + step_factor v and at u - step_factor v
        forward, backward = (system.residual(u + sign * step_factor * v, mu) for sign in (1, -1))
        # Pi'''(v, v, .) by a second difference of the residual
        self.cubic = np.asarray((backward - 2 * self._R + forward) / step_factor**2)
        self.v, self.unstable = v, tangent.unstable
        # v . R_mu = t_mu, since v . K w_mu = -g b . w_mu = 0
        self.bend, self.pull = dot(system.comm, self.cubic, v), self.t_mu
        # (dK/dmu) v is the derivative of the load vector R_mu along v
        self.K_mu_v = first_difference(lambda x: system.load(x, mu, name), system, u, v)
        R_p, self.K_p_v = self._derivatives_by_p(step_factor, forward, backward)
        self.w_p, self.t_p = tangent.solve(R_p)

    def _derivatives_by_p(
        self, d: float, forward: Vector, backward: Vector
    ) -> tuple[Vector, Vector]:
        """Return R_p and K_p v: weighted sums of R and K v over systems at several p.

        Parameters
        ----------
        d
            Factor of v in the difference along it, which gives K v.
        forward, backward
            Residuals at u + d v and at u - d v, at the p of the state.
        """
        u, v, R_p, K_p_v = self._state.u, self._tangent.v, 0.0 * self._R, 0.0 * self._R
        for neighbour in self._difference:
            if neighbour.is_same_p:
                R, K_v = self._R, (forward - backward) / (2 * d)
            else:
                R = neighbour.system.residual(u, neighbour.mu)
                K_v = times_tangent(neighbour.system, State(u, neighbour.mu), v)
            R_p += neighbour.weight * R
            K_p_v += neighbour.weight * K_v
        return R_p, K_p_v

    def set_residual(self, residual: Vector) -> None:
        """Take the residual of a nearby state for the next `step`; the factors stay."""
        self.w_R, self.t_R = self._tangent.solve(residual)

    def eigenvalue(self, family: int, p: float, state: State) -> float:
        """Return the model's eigenvalue nearest to zero in the space orthogonal to b.

        It belongs to the state of these rows. The arguments serve only the same method of
        `SymmetryBreakingRows`.
        """
        return second_eigenvalue(self._tangent, self._system)

    def step(self, row: CurveRow, value: float | None, *, settled: bool = False) -> CurveVector:
        """Return Newton's step to the point on which a row has the value zero. Collective.

        Three linear equations, scaled to order one, determine dmu, dp and alpha: g = 0, then R = 0
        along b for a fold or v . R_mu = 0 for a bifurcation, and the given row.

        Parameters
        ----------
        row
            The equation that says where on the boundary the point is.
        value
            The value of the row at the state; None for the tangent of the curve instead of a step.
        settled
            Whether g and v . R_mu count as zero already, after convergence: the step then reduces
            the residual alone, with the same matrix.
        """
        kind, comm, v, tangent = self._kind, self._system.comm, self._tangent.v, self._tangent
        is_tangent = value is None
        w_R, t_R = (0.0 * v, 0.0) if is_tangent else (self.w_R, self.t_R)
        g, pull = (0.0, 0.0) if is_tangent or settled else (tangent.g, self.t_mu)

        def coefficients(c: Vector) -> list[float]:
            """Return c . du: its coefficients of dmu, dp and alpha, and its constant term."""
            return [
                -dot(comm, c, self.w_mu),
                -dot(comm, c, self.w_p),
                dot(comm, c, v),
                -dot(comm, c, w_R),
            ]

        # first row: K is singular, -(g + dg) = 0 with
        # -dg = Pi'''(v, v, du) + v . K_mu v dmu + v . K_p v dp
        cubic, K_mu_vv = coefficients(self.cubic), dot(comm, v, self.K_mu_v)
        K_p_vv = dot(comm, v, self.K_p_v)
        singular_row = [cubic[0] + K_mu_vv, cubic[1] + K_p_vv, cubic[2], cubic[3] - g]
        # second row: at a fold the force along b that is left of the equilibrium is zero, at a
        # bifurcation the load does no work along v
        if kind == "fold":
            kind_row = [self.t_mu, self.t_p, -tangent.g, t_R]
        else:
            kind_row = self._row_without_work(coefficients, pull)
        # third row: the given one; along the tangent of the curve its value changes by 1
        c = coefficients(row.du) if row.du is not None else [0.0] * 4
        constant = c[3] + value if value is not None else -1.0
        place_row = [c[0] + row.dmu, c[1] + row.dp, c[2], constant]
        dmu, dp, alpha = self._solve_rows(np.array([singular_row, kind_row, place_row]))
        du = alpha * v - w_R - dmu * self.w_mu - dp * self.w_p
        return CurveVector(du, float(dmu), float(dp))

    def _solve_rows(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return dmu, dp and alpha from three linear equations. Collective.

        Parameters
        ----------
        rows
            (3, 4): the coefficients of dmu, dp and alpha, and the constant. It is overwritten.
        """
        # units of dmu, dp and alpha: alpha v then moves the system by one length
        units = np.array(
            [*self._scales, self._system.length / max_abs(self._system.comm, self._tangent.v)]
        )
        rows[:, :3] *= units
        # every row is scaled to order one
        row_sizes = np.abs(rows[:, :3]).max(axis=1)
        if self._kind == "bifurcation":
            # where all coefficients of v . R_mu are zero by symmetry, they are only rounding, which
            # must not be scaled up
            row_sizes[1] = max(row_sizes[1], self._mixed_size * units[2])
        rows /= np.where(row_sizes, row_sizes, 1.0)[:, None]
        # where bifurcations meet by symmetry the rows are dependent: least squares then take the
        # smallest step
        rank_tolerance = SYMMETRY_TOLERANCE if self._kind != "fold" else None
        solution = np.linalg.lstsq(rows[:, :3], -rows[:, 3], rank_tolerance)[0]
        return np.asarray(units * solution)

    def _row_without_work(
        self, coefficients: Callable[[Vector], list[float]], pull: float
    ) -> list[float]:
        """Return the row v . R_mu = 0: coefficients of dmu, dp and alpha, and the constant term.

        A prime is a change along the step. v . R_mu changes by v . R_mu' + v' . R_mu. The null
        vector changes by v' = -K^-1 K' v, so the second part is -w_mu . K' v.

        Parameters
        ----------
        coefficients
            Called with a vector c. It returns the product c . du: its coefficients of dmu, dp and
            alpha, and its constant term.
        pull
            The value of v . R_mu at the state.
        """
        system, state, name, comm = self._system, self._state, self._name, self._system.comm
        v, w_mu = self._tangent.v, self.w_mu
        # minus the derivative of v . R_mu by u
        mixed = mixed_third_derivative(system, state, v, w_mu, self._R) - self.K_mu_v
        self._mixed_size = dot(comm, np.abs(mixed), np.abs(v))
        mu, mu_step = state.mu[name], RELATIVE_DIFFERENCE_STEP * (abs(state.mu[name]) or 1.0)
        forward, backward = (
            system.load(state.u, {**state.mu, name: mu + step}, name)
            for step in (mu_step, -mu_step)
        )
        # the derivatives of v . R_mu by mu and p at fixed u, each with the two parts that the load
        # and the null vector contribute
        load_mu = np.asarray((forward - backward) / (2 * mu_step))
        by_mu = dot(comm, v, load_mu) - dot(comm, w_mu, self.K_mu_v)
        loads = [
            neighbour.weight * neighbour.system.load(state.u, neighbour.mu, name)
            for neighbour in self._difference
        ]
        load_p = np.asarray(np.sum(loads, axis=0))
        by_p = dot(comm, v, load_p) - dot(comm, w_mu, self.K_p_v)
        # the derivative by u is -mixed
        mixed_row = coefficients(mixed)
        return [by_mu - mixed_row[0], by_p - mixed_row[1], -mixed_row[2], pull - mixed_row[3]]


def second_eigenvalue(tangent: AugmentedTangent, system: System) -> float:
    """Return the eigenvalue of K nearest to zero in the space orthogonal to b. Collective.

    A power iteration of the bordered inverse finds it, in a fixed number of steps. No error is
    estimated, because only the place where the eigenvalue changes its sign matters.
    """
    # a start vector that no symmetry makes orthogonal to a mode, always the same
    x = np.sin(1.0 + np.arange(system.size) + system.comm.rank)
    value = np.nan
    for _ in range(POWER_ITERATIONS):
        y, _ = tangent.solve(x)
        value = dot(system.comm, x, x) / dot(system.comm, x, y)
        x = y / np.sqrt(dot(system.comm, y, y))
    return float(value)
