"""Differential geometry of a placement, in UFL, as plain functions of point quantities.

A placement enters by its value and its first and second derivatives, its *jet*. Every
expression is covariant under linear changes of the coordinates: finite-element forms take
an orthonormal frame t_1, t_2 of the flat cell, the fast tangent those of the reference cell.
"""

from dataclasses import dataclass, fields

import ufl
from ufl.core.expr import Expr

FIRST = ("r1", "r2")
SECOND = ("r11", "r12", "r22")
CURVED = (*FIRST, *SECOND)
MOVED = ("r", *FIRST)


@dataclass(frozen=True)
class Jet:
    """Value, first and second derivatives of a vector field in coordinates of the cell; each (3,)."""

    r: Expr
    r1: Expr
    r2: Expr
    r11: Expr
    r12: Expr
    r22: Expr

    def parts(self) -> list[Expr]:
        """The six vectors."""
        return [getattr(self, f.name) for f in fields(self)]

    def __add__(self, other: "Jet") -> "Jet":
        return Jet(*(a + b for a, b in zip(self.parts(), other.parts(), strict=True)))

    def __sub__(self, other: "Jet") -> "Jet":
        return Jet(*(a - b for a, b in zip(self.parts(), other.parts(), strict=True)))

    def side(self, sign: str) -> "Jet":
        """The same on one side ('+' or '-') of an edge."""
        return Jet(*(a(sign) for a in self.parts()))


def cell_frame(mesh: ufl.Mesh) -> tuple[Expr, Expr]:
    """Orthonormal vectors t_1, t_2 of the flat cell, t_1 x t_2 along its normal."""
    J = ufl.Jacobian(mesh)
    first, second = J[:, 0], J[:, 1]
    t1 = first / ufl.sqrt(ufl.dot(first, first))
    across = second - ufl.dot(second, t1) * t1
    return t1, across / ufl.sqrt(ufl.dot(across, across))


def jet(v: Expr, mesh: ufl.Mesh) -> Jet:
    """The jet of a vector field on the affine mesh."""
    t1, t2 = cell_frame(mesh)
    Dv = ufl.grad(v)
    DDv = ufl.grad(Dv)
    return Jet(
        v,
        ufl.dot(Dv, t1),
        ufl.dot(Dv, t2),
        ufl.dot(ufl.dot(DDv, t1), t1),
        ufl.dot(ufl.dot(DDv, t1), t2),
        ufl.dot(ufl.dot(DDv, t2), t2),
    )


def area_vector(j: Jet) -> Expr:
    """a_1 x a_2: the normal times the area ratio."""
    return ufl.cross(j.r1, j.r2)


def unit(v: Expr) -> Expr:
    return v / ufl.sqrt(ufl.dot(v, v))


def normal(j: Jet) -> Expr:
    """Unit normal n = a_1 x a_2 / |a_1 x a_2|."""
    return unit(area_vector(j))


def area_ratio(j: Jet) -> Expr:
    """Area of the surface over the area of the flat cell."""
    m = area_vector(j)
    return ufl.sqrt(ufl.dot(m, m))


def metric(j: Jet) -> Expr:
    """First fundamental form a_ij = a_i . a_j, (2, 2)."""
    a12 = ufl.dot(j.r1, j.r2)
    return ufl.as_matrix([[ufl.dot(j.r1, j.r1), a12], [a12, ufl.dot(j.r2, j.r2)]])


def inverse_metric(j: Jet) -> Expr:
    """a^ij, (2, 2)."""
    return ufl.inv(metric(j))


def dual_basis(j: Jet) -> tuple[Expr, Expr]:
    """a^1, a^2 with a^i . a_j = delta^i_j, tangent to the surface."""
    up = inverse_metric(j)
    return up[0, 0] * j.r1 + up[0, 1] * j.r2, up[1, 0] * j.r1 + up[1, 1] * j.r2


def membrane_strain(r0: Jet, u: Jet) -> Expr:
    """E_ij = (a_ij - a0_ij)/2, (2, 2), without subtracting two metrics of order one."""

    def E(ri: Expr, ui: Expr, rj: Expr, uj: Expr) -> Expr:
        return (ufl.dot(ri, uj) + ufl.dot(ui, rj) + ufl.dot(ui, uj)) / 2

    E12 = E(r0.r1, u.r1, r0.r2, u.r2)
    return ufl.as_matrix([[E(r0.r1, u.r1, r0.r1, u.r1), E12], [E12, E(r0.r2, u.r2, r0.r2, u.r2)]])


def curvature_change(r0: Jet, u: Jet) -> Expr:
    """K_ij = b_ij - b0_ij with b_ij = n . r,_ij, (2, 2)."""
    r = r0 + u
    n, n0 = normal(r), normal(r0)

    def K(rij: Expr, uij: Expr) -> Expr:
        return ufl.dot(n, uij) + ufl.dot(n - n0, rij)

    K12 = K(r0.r12, u.r12)
    return ufl.as_matrix([[K(r0.r11, u.r11), K12], [K12, K(r0.r22, u.r22)]])


def mixed(S: Expr, up: Expr) -> Expr:
    """S^i_j = a^ik S_kj of a surface tensor, (2, 2)."""
    return ufl.dot(up, S)


def facet_covector(mesh: ufl.Mesh) -> Expr:
    """Outward unit normal of the flat cell's edge in the cell's frame, (2,)."""
    t1, t2 = cell_frame(mesh)
    outward = ufl.FacetNormal(mesh)
    return ufl.as_vector([ufl.dot(outward, t1), ufl.dot(outward, t2)])


def conormal(r0: Jet, m: Expr) -> tuple[Expr, Expr, Expr]:
    """Undeformed outward unit conormal of a cell's edge and the edge's length ratio.

    Parameters
    ----------
    m
        (2,) covector that is zero along the edge, whatever the placement, and positive outward.
        The edge's length is told per length of (-m_2, m_1), which is along the edge.

    Returns
    -------
    nu_1, nu_2, stretch
        nu^i (contravariant, so that r_nu = r,_i nu^i) and ds0 over the edge's parameter.
    """
    up = inverse_metric(r0)
    nu = ufl.dot(up, m) / ufl.sqrt(ufl.dot(m, ufl.dot(up, m)))
    along = r0.r2 * m[0] - r0.r1 * m[1]
    return nu[0], nu[1], ufl.sqrt(ufl.dot(along, along))


def angle_from(sine: Expr, cosine: Expr, past: Expr) -> Expr:
    """The angle with that sine and cosine, counted from the turn whose cosine and sine are `past` (2,)."""
    return ufl.atan2(sine * past[0] - cosine * past[1], cosine * past[0] + sine * past[1])
