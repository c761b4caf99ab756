"""Boundaries of symmetry-breaking bifurcations: their equations with a second parameter p.

Modes of a family m (waves of a meridian) have a tangent K_m of their own at a state of the model,
and the path before them is regular: R(u, mu, p) = 0 and g(u, mu, p) = 0, with K_m v + g b = 0 and b
. v = 1, so that dg = -v . dK_m v. Families do not couple. So where two of them are neutral at once
both equations are regular, and each goes on alone.

R = dPi/du is the residual of the model, mu its unknown amplitude (load parameter), v the null
vector of K_m, and b a fixed vector near v; g = 0 where K_m is singular. A dot is the inner product
over all ranks. w_R, w_mu and w_p are K^-1 times R, R_mu and R_p. The quadratic form is v . K_m v,
whose differences give all derivatives of g. A row is the scalar equation that says where on the
boundary a point is. `family` are the systems at all p, m is the number of a family of modes.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.continuation.augmented import CurveRow, CurveVector, SystemFamily
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.fold import difference_step
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import State, Vector, dot, max_abs

MAX_INVERSE_ITERATIONS = 40  # for an eigenvalue
EIGENVALUE_TOLERANCE = 1e-9  # relative change of the eigenvalue that ends the iteration
DIFFERENCE_STEP = 1e-4  # relative, of an amplitude


class SymmetryBreakingSystems(SystemFamily, Protocol):
    """Systems that differ by a parameter p, with the tangents of their symmetry-breaking modes.

    All methods are collective.
    """

    def factored_tangent(self, p: float, state: State, m: int) -> Factorisation:
        """Factor the tangent K_m of a family at p and a state; the next call may overwrite it."""

    def quadratic_form(self, p: float, state: State, m: int, v: Vector) -> float:
        """Return v . K_m v of the family m, at p and a state."""

    def counts(self, p: float, state: State) -> Sequence[int]:
        """Return the numbers of unstable directions of the families 1, 2, ..."""


class SymmetryBreakingRows:
    """The rows of Newton's step at a state of a boundary: du = -w_R - dmu w_mu - dp w_p.

    Along a boundary these rows stand in for those of a bifurcation within the model
    (`augmented.AugmentedRows`), and so have the same methods. The constructor is collective.

    Parameters
    ----------
    newton
        The solver of the model's system at p.
    name
        The unknown amplitude mu.
    b
        A vector near the null vector of K_m, by which K_m is bordered.
    m
        The family of the modes, from 1.
    family
        The systems at all p.
    difference
        Pairs of a weight and a p: derivatives by p are weighted sums over the systems there.

    Attributes
    ----------
    v, g
        Null vector and residual of K_m v + g b = 0.
    pull, bend
        Work of the load along v, and third derivative of Pi along it: those tell a fold from a
        bifurcation. Both are zero, since a mode that breaks the symmetry does no work on the model.

    Private fields: `_factors` are those of the model's tangent K. `_g_mu` and `_g_p` are the total
    derivatives of g by mu and p, in which u follows them. `_other_unstable` counts the unstable
    directions of the family without v. `_w_R`, `_w_mu` and `_w_p` are K^-1 times R, R_mu and R_p.
    """

    def __init__(
        self,
        newton: BorderedNewton,
        state: State,
        name: str,
        b: Vector,
        m: int,
        family: SymmetryBreakingSystems,
        p: float,
        difference: Sequence[tuple[float, float]],
    ) -> None:
        """Factor the tangents of the model and of the family, and differentiate g by mu and p."""
        self._system, self._family, self._m = newton.system, family, m
        self.pull = self.bend = 0.0
        self._p, self._state, self._b = p, state, b
        system, u, mu, value = newton.system, state.u, state.mu, state.mu[name]
        self._factors = newton.factor_at(state)
        self._comm = comm = system.comm
        family_factors = family.factored_tangent(p, state, m)
        y = family_factors.solve(b)
        # K_m v + g b = 0 and b . v = 1 by block elimination
        compliance = dot(comm, b, y)
        self.v: Vector = np.asarray(y / compliance)
        self.g = -1 / compliance
        # where b . K_m^-1 b < 0, v itself counts among the negative pivots
        self._other_unstable = family_factors.negative_pivots - (compliance < 0)
        # derivatives by p at fixed u: R_p, and K_p = v . dK_m/dp v
        R_p, K_p = 0.0 * u, 0.0
        for weight, other_p in difference:
            state_at_other_p = State(u, {**family.amplitudes(other_p), name: value})
            R_p = R_p + weight * family.solver_at(other_p).system.residual(u, state_at_other_p.mu)
            K_p += weight * family.quadratic_form(other_p, state_at_other_p, m, self.v)
        # responses of u to mu and p
        self._w_mu = self._factors.solve(system.load(u, mu, name))
        self._w_p = self._factors.solve(R_p)
        mu_step = DIFFERENCE_STEP * (abs(value) or 1.0)
        forward, backward = (
            family.quadratic_form(p, State(u, {**mu, name: value + step}), m, self.v)
            for step in (mu_step, -mu_step)
        )
        # total derivatives: directly, and by the response of u
        self._g_mu = -(forward - backward) / (2 * mu_step) - self._derivative_of_g(self._w_mu)
        self._g_p = -K_p - self._derivative_of_g(self._w_p)
        self.set_residual(system.residual(u, mu))

    def counts(self) -> list[int]:
        """Return the numbers of unstable directions other than v: of the model, and of each family.

        Collective.
        """
        # the families from 1, at least up to m; the count of m leaves v out
        m, counts = self._m, list(self._family.counts(self._p, self._state))
        counts += [0] * (m - len(counts))
        counts[m - 1] = self._other_unstable
        return [self._factors.negative_pivots, *counts]

    def set_residual(self, residual: Vector) -> None:
        """Replace the residual by that of a nearby state, with the same factors."""
        self._w_R = self._factors.solve(residual)

    def step(self, row: CurveRow, value: float | None, *, settled: bool = False) -> CurveVector:
        """Return Newton's step (du, dmu, dp), or the tangent of the boundary. Collective.

        The rows g = 0 and the given one determine dmu and dp.

        Parameters
        ----------
        row
            The equation that says where on the boundary the point is.
        value
            The value of the row at the state; None for the tangent instead of a step.
        settled
            Whether g counts as zero already, after convergence: the step then reduces the residual
            alone.
        """
        comm, w_mu, w_p = self._comm, self._w_mu, self._w_p
        is_tangent = value is None
        w_R = 0.0 * w_mu if is_tangent else self._w_R
        g = 0.0 if is_tangent or settled else self.g - self._derivative_of_g(w_R)
        # changes of the row along du = -w_mu, -w_p and -w_R
        c = [-dot(comm, row.du, w) for w in (w_mu, w_p, w_R)] if row.du is not None else [0.0] * 3
        by_mu, by_p, by_residual = c
        rows = np.array([[self._g_mu, self._g_p], [by_mu + row.dmu, by_p + row.dp]])
        # for the tangent the row changes by 1 along it
        right_side = np.array([g, by_residual + value if value is not None else -1.0])
        # both equations are divided by their largest coefficients
        size = np.abs(rows).max(axis=1)
        dmu, dp = np.linalg.solve(rows / size[:, None], -right_side / size)
        return CurveVector(-w_R - dmu * w_mu - dp * w_p, float(dmu), float(dp))

    def eigenvalue(self, m: int, p: float, state: State) -> float:
        """Return the eigenvalue nearest to zero of a family's tangent; of the model's for m = 0.

        For the family of v only the space orthogonal to b counts. Collective.
        """
        factors = self._family.factored_tangent(p, state, m) if m else self._factors
        return nearest_eigenvalue(factors, self._comm, self._b if m == self._m else None)

    def _derivative_of_g(self, w: Vector) -> float:
        """Return the derivative of g = -v . K_m v along a displacement w, by a difference."""
        if not max_abs(self._comm, w):
            return 0.0
        d, state = difference_step(self._system, w), self._state
        forward, backward = (
            self._family.quadratic_form(
                self._p, State(state.u + step * w, state.mu), self._m, self.v
            )
            for step in (d, -d)
        )
        return -(forward - backward) / (2 * d)


def nearest_eigenvalue(factors: Factorisation, comm: MPI.Comm, b: Vector | None = None) -> float:
    """Return the eigenvalue nearest to zero of a factored matrix. Collective.

    Inverse iteration finds it, from a start vector that is always the same.

    Parameters
    ----------
    b
        A vector by which the matrix is bordered: only the space orthogonal to it counts; None: all.
    """
    solution_for_b = None if b is None else factors.solve(b)
    x, value = np.sin(1.0 + np.arange(factors.matrix.getLocalSize()[0]) + comm.rank), np.inf
    for _ in range(MAX_INVERSE_ITERATIONS):
        y = factors.solve(x)
        # a multiple of K^-1 b makes y orthogonal to b, as the border does
        if b is not None and solution_for_b is not None:
            y = y - dot(comm, b, y) / dot(comm, b, solution_for_b) * solution_for_b
        previous_value, value = value, float(dot(comm, x, x) / dot(comm, x, y))
        if abs(value - previous_value) <= EIGENVALUE_TOLERANCE * abs(value):
            break
        x = y / np.sqrt(dot(comm, y, y))
    return value
