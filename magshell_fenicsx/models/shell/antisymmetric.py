"""Stability of a half model against the modes that its mirror plane excludes.

At a symmetric state u the whole shell's energy for an antisymmetric addition v is that of one half
with u + v and of the other, mirrored, with u - v. Its Hessian at v = 0 on one half is the half's
own, but v moves freely along the mirror normal m and not in the plane, and the edges on the plane
see the two halves tilt against each other.
"""

from collections.abc import Sequence

import ufl
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.snes import factor_with_lag
from magshell_fenicsx.continuation.stability_monitor import ModeFamily
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.shell import densities
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.edges import edge_density
from magshell_fenicsx.models.shell.kinematics import Forms, Jet
from magshell_fenicsx.models.shell.law import Law


def antisymmetric_edge(  # noqa: PLR0913 - the arguments of a density with an addition v
    r0: Jet,
    u: Jet,
    v: Jet,
    m: Expr,
    width: Expr,
    sigma: Expr,
    mirror: Expr,
    *,
    law: Law,
    natural: Forms | None = None,
) -> Expr:
    """Half the energy of an edge on a mirror plane, for an antisymmetric addition v.

    One half has the displacement u + v, the other is the mirror image of u - v. Parameters besides
    v are those of `edges.symmetric`.
    """
    nu1, nu2, stretch = kin.conormal(r0, m)

    def mirrored(a: Expr) -> Expr:
        """Return the mirror image of a vector."""
        return a - 2 * ufl.dot(a, mirror) * mirror

    def jump(inner: Jet, outer: Jet) -> Expr:
        """Return -[n] . {r_nu} between a surface and the mirror image of another one."""
        outward, inward = (j.r1 * nu1 + j.r2 * nu2 for j in (inner, outer))
        r_nu = (outward - mirrored(inward)) / 2
        return -ufl.dot(mirrored(kin.normal(outer)) - kin.normal(inner), r_nu)

    sides = (u + v, u - v)
    J = jump(r0 + sides[0], r0 + sides[1]) - (natural.kink(nu1, nu2) if natural else 1) * jump(
        r0, r0
    )
    moments = [densities.normal_moment(r0, side, nu1, nu2, law, natural) for side in sides]
    return (
        edge_density((moments[0][0] + moments[1][0]) / 2, moments[0][1], J, width, sigma)
        * stretch
        / 2
    )


class AntisymmetricModes:
    """The tangent of the modes that a half model excludes.

    It is a `ModeFamily` of `continuation.stability_monitor`; its methods are collective.

    Attributes
    ----------
    system
        The system of the antisymmetric modes, at displacements of the half model.
    """

    label = "antisymmetric"
    tangents = None  # they are one family

    def __init__(self, system: FiniteElementSystem) -> None:
        self.system = system
        self._factorisation = Factorisation(system.comm)
        self._factored: State | None = None

    def factor_at(self, state: State) -> Factorisation:
        """Factor the tangent of the antisymmetric modes at a symmetric state; collective.

        The factorisation of the last state is kept.
        """
        if self._factored is not state:
            if not factor_with_lag(self.system, self._factorisation, state):
                self._factorisation.factor(self.system.tangent(state.u, state.mu))
            self._factored = state
        return self._factorisation

    def is_unstable(self, state: State) -> bool:
        """Return whether an antisymmetric mode is unstable at a symmetric state; collective."""
        return self.factor_at(state).negative_pivots > 0

    @property
    def families(self) -> Sequence[ModeFamily]:
        """Families of a `StabilityMonitor`: all antisymmetric modes are one."""
        return [self]

    def counts(self, state: State) -> Sequence[int]:
        """Return the number of unstable directions at a symmetric state, in a list; collective."""
        return [self.factor_at(state).negative_pivots]
