"""The bending energy of edges: C0 interior penalty for a C0 displacement.

A C0 surface has b_nunu = (-[n] . r_nu) delta on an edge. With the jump J of that
quantity over its undeformed value, an edge contributes

    {M_nunu} J + sigma D/(2 h_e) J^2        per undeformed length.

It is one energy: derived twice it gives a symmetric tangent. Every expression is
invariant under exchange of '+' and '-'.
"""

import ufl
from ufl.core.expr import Expr

from magshell_fenicsx.shell import densities
from magshell_fenicsx.shell import kinematics as kin
from magshell_fenicsx.shell.kinematics import Jet

Sides = tuple[Jet, Jet]


def edge_density(M: Expr, J: Expr, width: Expr, nu: Expr, h: Expr, sigma: Expr) -> Expr:
    """{M} J + sigma D/(2 h_e) J^2."""
    return M * J + sigma * densities.bending_stiffness(h, nu) / (2 * width) * J**2


def fold_jump(plus: Jet, minus: Jet, nu_plus: tuple[Expr, Expr], nu_minus: tuple[Expr, Expr]) -> Expr:
    """-[n] . {r_nu}, nu out of '+', [n] = n- - n+."""
    r_nu = (plus.r1 * nu_plus[0] + plus.r2 * nu_plus[1] - minus.r1 * nu_minus[0] - minus.r2 * nu_minus[1]) / 2
    return -ufl.dot(kin.normal(minus) - kin.normal(plus), r_nu)


def interior(r0: Sides, u: Sides, m: tuple[Expr, Expr], width: Expr, nu: Expr, h: Expr, sigma: Expr) -> Expr:
    """Energy of an interior edge per length of its parameter.

    Parameters
    ----------
    r0, u
        Jets on both sides, '+' first.
    m
        Covectors of the edge on both sides; see `kinematics.conormal`.
    width
        h_e: half the height of the flat triangles over the edge, averaged.
    """
    conormals = [kin.conormal(j, covector) for j, covector in zip(r0, m, strict=True)]
    nus = [(nu1, nu2) for nu1, nu2, _ in conormals]
    M = sum(densities.normal_moment(r0[i], u[i], *nus[i], nu, h) for i in range(2)) / 2
    J = fold_jump(r0[0] + u[0], r0[1] + u[1], *nus) - fold_jump(*r0, *nus)
    stretch = (conormals[0][2] + conormals[1][2]) / 2
    return edge_density(M, J, width, nu, h, sigma) * stretch


def clamped(r0: Jet, u: Jet, m: Expr, width: Expr, nu: Expr, h: Expr, sigma: Expr) -> Expr:
    """Energy of a clamped edge per length of its parameter: the outer normal is held at n0."""
    nu1, nu2, stretch = kin.conormal(r0, m)
    r = r0 + u
    J = -ufl.dot(kin.normal(r0) - kin.normal(r), r.r1 * nu1 + r.r2 * nu2)
    M = densities.normal_moment(r0, u, nu1, nu2, nu, h)
    return edge_density(M, J, width, nu, h, sigma) * stretch


def symmetric(r0: Jet, u: Jet, m: Expr, width: Expr, nu: Expr, h: Expr, sigma: Expr, mirror: Expr) -> Expr:
    """Energy of an edge on a mirror plane with that normal per length of its parameter: half of an interior edge's."""
    nu1, nu2, stretch = kin.conormal(r0, m)

    def mirror_jump(j: Jet) -> Expr:
        return 2 * ufl.dot(kin.normal(j), mirror) * ufl.dot(mirror, j.r1 * nu1 + j.r2 * nu2)

    J = mirror_jump(r0 + u) - mirror_jump(r0)
    M = densities.normal_moment(r0, u, nu1, nu2, nu, h)
    return edge_density(M, J, width, nu, h, sigma) * stretch / 2
