"""Differential geometry of a placement, in UFL, as plain functions of point quantities.

A placement enters by its value and its first and second derivatives, its *jet*. Every
expression is covariant under linear changes of the coordinates: finite-element forms take
an orthonormal frame t_1, t_2 of the flat cell, the fast tangent those of the reference cell.

- r0 and r = r0 + u are placements of the undeformed and the deformed mid-surface, u is the
  displacement. a_i = r,_i are the tangents, n the unit normal; a 0 marks the undeformed surface.
- a_ij and b_ij are the first and second fundamental forms, E and K half and whole of their changes.
- nu is the conormal of an edge: in the surface, normal to the edge, outward.
- An edge has a parameter: its length in the coordinates, or a number from 0 to 1. `stretch` is the
  true length over it.
- A natural shape is the one that the shell would have without stress; the index n marks it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, TypeAlias

from magshell_fenicsx.platform.lazy_import import lazy_import

if TYPE_CHECKING:
    import ufl
    from ufl.core.expr import Expr
else:
    ufl = lazy_import("ufl")

Vectors: TypeAlias = Any  # several expressions (3,), or arrays (..., 3)
FIRST_DERIVATIVES = ("r1", "r2")
SECOND_DERIVATIVES = ("r11", "r12", "r22")
ALL_DERIVATIVES = (*FIRST_DERIVATIVES, *SECOND_DERIVATIVES)
VALUE_AND_FIRST = ("r", *FIRST_DERIVATIVES)


@dataclass(frozen=True)
class Jet:
    """A vector field's value, first and second derivatives by cell coordinates, (3,) each."""

    r: Expr
    r1: Expr
    r2: Expr
    r11: Expr
    r12: Expr
    r22: Expr

    def parts(self) -> list[Expr]:
        """The six vectors."""
        return [getattr(self, f.name) for f in fields(self)]

    def __add__(self, other: Jet) -> Jet:
        return Jet(*(a + b for a, b in zip(self.parts(), other.parts(), strict=True)))

    def __sub__(self, other: Jet) -> Jet:
        return Jet(*(a - b for a, b in zip(self.parts(), other.parts(), strict=True)))

    def side(self, sign: str) -> Jet:
        """Return the jet on one side ('+' or '-') of an edge."""
        return Jet(*(a(sign) for a in self.parts()))


def cell_frame(mesh: ufl.Mesh) -> tuple[Expr, Expr]:
    """Return orthonormal vectors t_1, t_2 of the flat cell, t_1 x t_2 along its normal.

    t_1 is along the first edge of the reference cell.
    """
    J = ufl.Jacobian(mesh)
    first, second = J[:, 0], J[:, 1]
    t1 = first / ufl.sqrt(ufl.dot(first, first))
    second_normal = second - ufl.dot(second, t1) * t1
    return t1, second_normal / ufl.sqrt(ufl.dot(second_normal, second_normal))


def jet(v: Expr, mesh: ufl.Mesh) -> Jet:
    """Return the jet of a vector field on the affine mesh, in the frame of `cell_frame`."""
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
    """Return a vector over its length."""
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
    """Return a^1, a^2 with a^i . a_j = delta^i_j, tangent to the surface."""
    up = inverse_metric(j)
    return up[0, 0] * j.r1 + up[0, 1] * j.r2, up[1, 0] * j.r1 + up[1, 1] * j.r2


def strain_components(
    r0: Vectors, u: Vectors, dot: Callable[[Any, Any], Any]
) -> tuple[Any, Any, Any]:
    """Return the membrane strain E_11, E_12 and E_22 from the first derivatives of r0 and u.

    E_ij = (a0_i . u,_j + u,_i . a0_j + u,_i . u,_j)/2. So no two metrics of order one are
    subtracted, and small strains keep their digits. `dot` is the scalar product of expressions or
    of arrays.
    """
    (r1, r2), (u1, u2) = r0, u
    E12 = (dot(r1, u2) + dot(u1, r2) + dot(u1, u2)) / 2
    return dot(r1, u1) + dot(u1, u1) / 2, E12, dot(r2, u2) + dot(u2, u2) / 2


def curvature_components(
    n: Any, normal_change: Any, r0: Vectors, u: Vectors, dot: Callable[[Any, Any], Any]
) -> list[Any]:
    """Return K_11, K_12 and K_22, the changes of the curvature n . r,_ij.

    Parameters
    ----------
    n
        The deformed unit normal.
    normal_change
        n - n0.
    r0, u
        Second derivatives r,_11, r,_12, r,_22 of placement and displacement.
    dot
        Scalar product of expressions or of arrays.
    """
    return [dot(n, uij) + dot(normal_change, rij) for rij, uij in zip(r0, u, strict=True)]


def membrane_strain(r0: Jet, u: Jet) -> Expr:
    """E_ij = (a_ij - a0_ij)/2, (2, 2)."""
    E11, E12, E22 = strain_components((r0.r1, r0.r2), (u.r1, u.r2), ufl.dot)
    return ufl.as_matrix([[E11, E12], [E12, E22]])


def curvature_change(r0: Jet, u: Jet) -> Expr:
    """K_ij = b_ij - b0_ij with b_ij = n . r,_ij, (2, 2)."""
    n = normal(r0 + u)
    second0, second = ((j.r11, j.r12, j.r22) for j in (r0, u))
    K11, K12, K22 = curvature_components(n, n - normal(r0), second0, second, ufl.dot)
    return ufl.as_matrix([[K11, K12], [K12, K22]])


def mixed(S: Expr, up: Expr) -> Expr:
    """S^i_j = a^ik S_kj of a surface tensor, (2, 2)."""
    return ufl.dot(up, S)


def facet_covector(mesh: ufl.Mesh) -> Expr:
    """Outward unit normal of the flat cell's edge in the cell's frame, (2,)."""
    t1, t2 = cell_frame(mesh)
    outward = ufl.FacetNormal(mesh)
    return ufl.as_vector([ufl.dot(outward, t1), ufl.dot(outward, t2)])


def conormal(r0: Jet, m: Expr) -> tuple[Expr, Expr, Expr]:
    """Return the undeformed outward unit conormal of a cell's edge and the edge's length ratio.

    Parameters
    ----------
    r0
        Jet of the placement.
    m
        (2,) covector in the coordinates of jets: zero along the edge and positive outward. It does
        not depend on the placement. The vector (-m_2, m_1) is along the edge, the step of one unit
        of the edge's parameter.

    Returns
    -------
    nu_1, nu_2, stretch
        Contravariant components nu^i, so that the derivative along nu is r,_i nu^i; and the
        undeformed length of the edge over its parameter.
    """
    up = inverse_metric(r0)
    nu = ufl.dot(up, m) / ufl.sqrt(ufl.dot(m, ufl.dot(up, m)))
    edge_tangent = r0.r2 * m[0] - r0.r1 * m[1]
    return nu[0], nu[1], ufl.sqrt(ufl.dot(edge_tangent, edge_tangent))


@dataclass(frozen=True)
class Edge:
    """An edge of the undeformed surface at a point.

    Attributes
    ----------
    outward
        Unit conormal (3,): in the surface, normal to the edge, pointing outwards.
    along
        Unit tangent (3,), n0 x outward.
    normal_part, tangent_part
        Contravariant components of `outward` and of `along` in the coordinates of jets.
    stretch
        Length of the edge over that of its parameter.
    """

    outward: Expr
    along: Expr
    normal_part: tuple[Expr, Expr]
    tangent_part: tuple[Expr, Expr]
    stretch: Expr

    @classmethod
    def of(cls, r0: Jet, m: Expr) -> Edge:
        """Return the edge with the covector m (2,) on a surface with the jet r0.

        The covector is zero along the edge and positive outward, in the coordinates of jets.
        """
        nu1, nu2, stretch = conormal(r0, m)
        # (-m_2, m_1) is along the edge, with the length `stretch`
        t1, t2 = -m[1] / stretch, m[0] / stretch
        return cls(
            r0.r1 * nu1 + r0.r2 * nu2, r0.r1 * t1 + r0.r2 * t2, (nu1, nu2), (t1, t2), stretch
        )

    def by_outward(self, j: Jet) -> Expr:
        """Return the derivative of a field with jet j by the length along the outward conormal."""
        return j.r1 * self.normal_part[0] + j.r2 * self.normal_part[1]

    def by_length(self, j: Jet) -> Expr:
        """Return the derivative of a field with jet j by the arc length of the edge."""
        return j.r1 * self.tangent_part[0] + j.r2 * self.tangent_part[1]


def angle_from(sine: Expr, cosine: Expr, reference_turn: Expr) -> Expr:
    """Return the angle (rad) with a sine and a cosine, counted from a reference turn.

    `reference_turn` (2,) has cosine and sine of that turn. So an angle can grow beyond pi without a
    jump, if the reference follows. `sine` and `cosine` may have a common positive factor.
    """
    return ufl.atan2(
        sine * reference_turn[0] - cosine * reference_turn[1],
        cosine * reference_turn[0] + sine * reference_turn[1],
    )


@dataclass(frozen=True)
class Forms:
    """The natural shape at a point: surface tensors in coordinates, (2, 2) each, and two ratios.

    Attributes
    ----------
    strain
        (a_n - a0)/2, the membrane strain of the natural shape.
    bend
        b_n - b0, its change of curvature.
    metric, up
        a_n and its inverse.
    area
        Natural over undeformed area.
    thickness
        Natural over undeformed thickness.
    """

    strain: Expr
    bend: Expr
    metric: Expr
    up: Expr
    area: Expr
    thickness: Expr

    def kink(self, nu1: Expr, nu2: Expr) -> Expr:
        """Return natural over undeformed curvature b_nunu where all curvature is across an edge.

        It is the square of the natural stretch across the edge, over the ratio of thicknesses. nu1
        and nu2 are the components of the edge's undeformed unit conormal.
        """
        return self.along(nu1, nu2) / self.thickness

    def along(self, nu1: Expr, nu2: Expr) -> Expr:
        """Return the natural length, squared, of the vector with components nu1 and nu2."""
        nu = ufl.as_vector([nu1, nu2])
        return ufl.dot(nu, ufl.dot(self.metric, nu))
