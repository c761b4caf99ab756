"""Stability of a half model against the modes that its mirror plane excludes.

At a symmetric state u the whole shell's energy for an antisymmetric addition v is that of one half
with u + v and of the other, mirrored, with u - v. Its Hessian at v = 0 on one half is the half's
own, but v moves freely along the mirror normal m and not in the plane, and the edges on the plane
see the two halves tilt against each other.

- A jet is a field's value with its first and second derivatives; r0 is the placement.
- A mode is unstable if the Hessian is negative along it; the number of negative pivots of the
  factored tangent counts such directions.
- A state is a point of a path of equilibria: the displacement u and the amplitudes (load
  parameters) mu.
"""

from collections.abc import Sequence

import ufl
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.stability_monitor import ModeFamily
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.shell import densities
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.edges import cell_width, edge_density
from magshell_fenicsx.models.shell.kinematics import Forms, Jet
from magshell_fenicsx.models.shell.law import Law
from magshell_fenicsx.quantities.mode_labels import ANTISYMMETRIC


def antisymmetric_edge(  # noqa: PLR0913 - the arguments of a density with an addition v
    r0: Jet,
    u: Jet,
    v: Jet,
    m: Expr,
    area: Expr,
    sigma: Expr,
    mirror: Expr,
    *,
    law: Law,
    natural: Forms | None = None,
) -> Expr:
    """Half the energy of an edge on a mirror plane, for an antisymmetric addition v.

    One half of the shell has the displacement u + v, the other is the mirror image of a half with u
    - v. `m` is the edge's covector, `area` that of the cell there, `sigma` the penalty and
    `mirror` the unit normal of the plane. `natural` are the forms of the shape that the shell would
    have without stress; None for those of r0.
    """
    # components of the edge's unit conormal, and the edge's length over its parameter
    nu1, nu2, stretch = kin.conormal(r0, m)

    def mirrored(a: Expr) -> Expr:
        """Return the mirror image of a vector."""
        return a - 2 * ufl.dot(a, mirror) * mirror

    def jump(inner: Jet, outer: Jet) -> Expr:
        """Return the jump -[n] . {r_nu} between a surface and the mirror image of another one.

        `inner` is the jet of the surface, `outer` that of the other before it is mirrored.
        """
        outward, inward = (j.r1 * nu1 + j.r2 * nu2 for j in (inner, outer))
        r_nu = (outward - mirrored(inward)) / 2
        return -ufl.dot(mirrored(kin.normal(outer)) - kin.normal(inner), r_nu)

    sides = (u + v, u - v)
    # the jump over that without stress: a natural shape has another kink at the edge than r0, by
    # the ratio `natural.kink`
    deformed_jump = jump(r0 + sides[0], r0 + sides[1])
    J = deformed_jump - (natural.kink(nu1, nu2) if natural else 1) * jump(r0, r0)
    # moments across the edge and penalty stiffnesses on both sides
    (first_moment, stiffness), (second_moment, _) = (
        densities.normal_moment(r0, side, nu1, nu2, law, natural) for side in sides
    )
    moment, width = (first_moment + second_moment) / 2, cell_width(r0, area, stretch)
    return edge_density(moment, stiffness, J, width, sigma) * stretch / 2


class AntisymmetricModes:
    """The tangent of the modes that a half model excludes.

    It is a `ModeFamily` of `continuation.stability_monitor`; its methods are collective.

    Attributes
    ----------
    system
        The system of the antisymmetric modes, at displacements of the half model.
    _factorisation, _factored
        Factors of the latest tangent, and the state to which they belong; None before the first.
    """

    label = ANTISYMMETRIC
    tangents = None  # all modes are one family, with one tangent

    def __init__(self, system: FiniteElementSystem) -> None:
        self.system = system
        self._factorisation = Factorisation(system.comm)
        self._factored: State | None = None

    def factor_at(self, state: State) -> Factorisation:
        """Factor the tangent of the antisymmetric modes at a symmetric state; collective.

        The factorisation of the last state is kept.
        """
        if self._factored is not state:
            self._factorisation.factor(self.system.tangent(state.u, state.mu))
            self._factored = state
        return self._factorisation

    @property
    def families(self) -> Sequence[ModeFamily]:
        """Families of a `StabilityMonitor`: all antisymmetric modes are one."""
        return [self]

    def counts(self, state: State) -> Sequence[int]:
        """Return the number of unstable directions at a symmetric state, in a list; collective."""
        return [self.factor_at(state).negative_pivots]
