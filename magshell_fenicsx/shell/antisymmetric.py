"""Stability of a half model against the modes that its mirror plane excludes.

At a symmetric state u the whole shell's energy for an antisymmetric addition v is that of one half
with u + v and of the other, mirrored, with u - v. Its Hessian at v = 0 on one half is the half's own,
but v moves freely along the mirror normal m and not in the plane, and the edges on the plane see the
two halves tilt against each other.
"""

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.shell import densities
from magshell_fenicsx.shell import kinematics as kin
from magshell_fenicsx.shell.edges import edge_density
from magshell_fenicsx.shell.kinematics import Jet
from magshell_fenicsx.shell.parameters import MIRROR_NORMAL
from magshell_fenicsx.solve.events import locate_bifurcation
from magshell_fenicsx.solve.factor import Factorisation
from magshell_fenicsx.solve.path import Path, Point
from magshell_fenicsx.solve.problem import FiniteElementSystem
from magshell_fenicsx.solve.system import State


def antisymmetric_edge(
    r0: Jet, u: Jet, v: Jet, m: Expr, width: Expr, nu: Expr, h: Expr, sigma: Expr, mirror: Expr
) -> Expr:
    """Half the energy of an edge between the half with u + v and the mirror image of that with u - v.

    The other parameters are those of `edges.symmetric`.
    """
    nu1, nu2, stretch = kin.conormal(r0, m)

    def mirrored(a: Expr) -> Expr:
        return a - 2 * ufl.dot(a, mirror) * mirror

    def jump(here: Jet, there: Jet) -> Expr:
        outward, inward = (j.r1 * nu1 + j.r2 * nu2 for j in (here, there))
        r_nu = (outward - mirrored(inward)) / 2
        return -ufl.dot(mirrored(kin.normal(there)) - kin.normal(here), r_nu)

    sides = (u + v, u - v)
    J = jump(r0 + sides[0], r0 + sides[1]) - jump(r0, r0)
    M = sum(densities.normal_moment(r0, side, nu1, nu2, nu, h) for side in sides) / 2
    return edge_density(M, J, width, nu, h, sigma) * stretch / 2


class AntisymmetricModes:
    """The tangent of the modes that a half model excludes; a `solve.events.Stability`.

    Attributes
    ----------
    system
        Whose tangent it is, at the displacements of the half model.
    """

    def __init__(self, system: FiniteElementSystem) -> None:
        self.system = system
        self._factorisation = Factorisation(system.comm)
        self._factored: State | None = None

    def factor_at(self, state: State) -> Factorisation:
        """Factor the tangent of the antisymmetric modes at a symmetric state."""
        if self._factored is not state:
            self._factorisation.factor(self.system.tangent(state.u, state.mu))
            self._factored = state
        return self._factorisation

    def is_unstable(self, state: State) -> bool:
        """Whether an antisymmetric mode is unstable at a symmetric state."""
        return self.factor_at(state).negative_pivots > 0

    def first_instability(self, path: Path, points: Sequence[Point]) -> tuple[str, Point] | None:
        """The first point of a path at which an antisymmetric mode becomes unstable.

        The last point is looked at first, then those before it, by bisection: what becomes
        unstable on the way and stable again passes for stable.

        Raises
        ------
        PathStopped
            If Newton fails between two points that it had found.
        """

        def is_unstable(number: int) -> bool:
            return self.is_unstable(points[number].state)

        if not is_unstable(len(points) - 1):
            return None
        first = bisect_left(range(len(points) - 1), True, key=is_unstable)
        if first == 0:
            return "antisymmetric", points[0]
        return "antisymmetric", locate_bifurcation(path, points[first - 1], points[first], self)


def held_against_mirror(V: fem.FunctionSpace, facets: NDArray[np.int32]) -> list[fem.DirichletBC]:
    """v = (v . m) m on the mirror plane."""
    in_plane = [V.sub(i) for i in range(3) if not MIRROR_NORMAL[i]]
    return [fem.dirichletbc(0.0, fem.locate_dofs_topological(W, 1, facets), W) for W in in_plane]
