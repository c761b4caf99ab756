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


def edge_density(M: Expr, J: Expr, width: Expr, nu: Expr, h: Expr, sigma: Expr) -> Expr:
    """{M} J + sigma D/(2 h_e) J^2."""
    return M * J + sigma * densities.bending_stiffness(h, nu) / (2 * width) * J**2


def fold_jump(plus: Jet, minus: Jet, nu_plus: tuple[Expr, Expr], nu_minus: tuple[Expr, Expr]) -> Expr:
    """-[n] . {r_nu}, nu out of '+', [n] = n- - n+."""
    r_nu = (plus.r1 * nu_plus[0] + plus.r2 * nu_plus[1] - minus.r1 * nu_minus[0] - minus.r2 * nu_minus[1]) / 2
    return -ufl.dot(kin.normal(minus) - kin.normal(plus), r_nu)


def interior(r0: Jet, u: Jet, mesh: ufl.Mesh, nu: Expr, h: Expr, sigma: Expr) -> Expr:
    """Energy of an interior edge per flat length."""
    facet_normal = ufl.FacetNormal(mesh)
    nu1, nu2, stretch = kin.conormal(r0, facet_normal, mesh)
    conormals = {s: (nu1(s), nu2(s)) for s in "+-"}
    M = sum(densities.normal_moment(r0.side(s), u.side(s), *conormals[s], nu, h) for s in "+-") / 2
    r = r0 + u
    J = fold_jump(r.side("+"), r.side("-"), conormals["+"], conormals["-"]) - fold_jump(
        r0.side("+"), r0.side("-"), conormals["+"], conormals["-"]
    )
    width = ufl.avg(ufl.CellVolume(mesh)) / ufl.avg(ufl.FacetArea(mesh))
    return edge_density(M, J, width, nu, h, sigma) * ufl.avg(stretch)


def clamped(r0: Jet, u: Jet, mesh: ufl.Mesh, nu: Expr, h: Expr, sigma: Expr) -> Expr:
    """Energy of a clamped edge per flat length: the outer normal is held at n0."""
    nu1, nu2, stretch = kin.conormal(r0, ufl.FacetNormal(mesh), mesh)
    r = r0 + u
    J = -ufl.dot(kin.normal(r0) - kin.normal(r), r.r1 * nu1 + r.r2 * nu2)
    M = densities.normal_moment(r0, u, nu1, nu2, nu, h)
    width = ufl.CellVolume(mesh) / ufl.FacetArea(mesh)
    return edge_density(M, J, width, nu, h, sigma) * stretch


def symmetric(r0: Jet, u: Jet, mesh: ufl.Mesh, nu: Expr, h: Expr, sigma: Expr, m: Expr) -> Expr:
    """Energy of an edge on a mirror plane with normal m per flat length: half of an interior edge's."""
    nu1, nu2, stretch = kin.conormal(r0, ufl.FacetNormal(mesh), mesh)

    def mirror_jump(j: Jet) -> Expr:
        return 2 * ufl.dot(kin.normal(j), m) * ufl.dot(m, j.r1 * nu1 + j.r2 * nu2)

    J = mirror_jump(r0 + u) - mirror_jump(r0)
    M = densities.normal_moment(r0, u, nu1, nu2, nu, h)
    width = ufl.CellVolume(mesh) / ufl.FacetArea(mesh)
    return edge_density(M, J, width, nu, h, sigma) * stretch / 2
