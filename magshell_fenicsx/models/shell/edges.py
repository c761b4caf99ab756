"""The bending energy of edges, by C0 interior penalty for a C0 displacement, and folds.

A C0 surface has b_nunu = (-[n] . r_nu) delta on an edge. With the jump J of that quantity over its
undeformed value, an edge contributes

    {M_nunu} J + sigma D/(2 h_e) J^2        per undeformed length.

It is one energy: derived twice it gives a symmetric tangent. Every expression is invariant under
exchange of '+' and '-'.
"""

from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.batches import interior_batches
from magshell_fenicsx.models.shell import densities
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.kinematics import Forms, Jet
from magshell_fenicsx.models.shell.law import Law

Sides = tuple[Jet, Jet]
Shapes = tuple[Forms, Forms]
FOLD_ANGLE = 0.02  # rad: below, the sine of an angle is the angle to 7e-5


def edge_density(M: Expr, D: Expr, J: Expr, width: Expr, sigma: Expr) -> Expr:
    """{M} J + sigma D/(2 h_e) J^2: moment M, penalty stiffness D, jump J, h_e the `width`."""
    return M * J + sigma * D / (2 * width) * J**2


def fold_jump(
    plus: Jet, minus: Jet, nu_plus: tuple[Expr, Expr], nu_minus: tuple[Expr, Expr]
) -> Expr:
    """-[n] . {r_nu} with [n] = n- - n+: the jump of the normal across an edge.

    nu_plus and nu_minus are the components of the outward conormals; the mean {r_nu} is out of '+'.
    """
    r_nu = (
        plus.r1 * nu_plus[0]
        + plus.r2 * nu_plus[1]
        - minus.r1 * nu_minus[0]
        - minus.r2 * nu_minus[1]
    ) / 2
    return -ufl.dot(kin.normal(minus) - kin.normal(plus), r_nu)


def fold_angle(plus: Jet, minus: Jet, m_plus: Expr) -> tuple[Expr, Expr]:
    """Return sine and cosine of the angle between the normals about the edge.

    The angle has the sign of `fold_jump`. `m_plus` is the edge's covector on the side '+'.
    """
    edge_tangent = kin.unit(plus.r2 * m_plus[0] - plus.r1 * m_plus[1])
    n_plus, n_minus = kin.normal(plus), kin.normal(minus)
    return -ufl.dot(ufl.cross(n_plus, n_minus), edge_tangent), ufl.dot(n_plus, n_minus)


def two_sided(
    J: Expr,
    r0: Sides,
    u: Sides,
    m: tuple[Expr, Expr],
    width: Expr,
    sigma: Expr,
    *,
    law: tuple[Law, Law],
    natural: Shapes | None = None,
) -> Expr:
    """Energy of an interior edge with a jump J, per length of its parameter.

    Parameters
    ----------
    J
        Jump of b_nunu over its undeformed value.
    r0, u
        Jets on both sides, '+' first.
    m
        Covectors of the edge on both sides; see `kinematics.conormal`.
    width
        h_e: half the height of the flat triangles over the edge, averaged.
    sigma
        Penalty.
    law
        Laws of both sides.
    natural
        The natural forms on both sides; None if they are those of r0.
    """
    conormals = [kin.conormal(j, covector) for j, covector in zip(r0, m, strict=True)]
    stretch = (conormals[0][2] + conormals[1][2]) / 2
    moments = [
        densities.normal_moment(r0[i], u[i], *conormals[i][:2], law[i], natural and natural[i])
        for i in range(2)
    ]
    M, D = ((plus + minus) / 2 for plus, minus in zip(*moments, strict=True))
    return edge_density(M, D, J, width, sigma) * stretch


def interior(
    r0: Sides,
    u: Sides,
    m: tuple[Expr, Expr],
    *rest: Any,
    law: tuple[Law, Law],
    natural: Shapes | None = None,
) -> Expr:
    """Energy of an interior edge between cells that meet smoothly, or nearly so.

    It is per length of the edge's parameter; `rest` are the width and sigma of `two_sided`.
    """
    nus = [kin.conormal(j, covector)[:2] for j, covector in zip(r0, m, strict=True)]
    J0 = fold_jump(*r0, *nus)
    if natural:
        J0 *= sum(shape.kink(*nu) for shape, nu in zip(natural, nus, strict=True)) / 2
    J = fold_jump(r0[0] + u[0], r0[1] + u[1], *nus) - J0
    return two_sided(J, r0, u, m, *rest, law=law, natural=natural)


def fold(
    r0: Sides,
    u: Sides,
    m: tuple[Expr, Expr],
    *rest: Any,
    law: tuple[Law, Law],
    natural: Shapes | None = None,
) -> Expr:
    """Energy of an interior edge across a fold of the undeformed surface.

    The jump is the change of the angle, whatever its size. b_nunu is the angle times the natural
    stretch across the fold: a natural kink is the limit of a narrow bend. `rest` are the width and
    sigma of `two_sided`.
    """
    sine0, cosine0 = fold_angle(*r0, m[0])
    sine, cosine = fold_angle(r0[0] + u[0], r0[1] + u[1], m[0])
    stretch_across = 1
    if natural:
        nus = [kin.conormal(j, covector)[:2] for j, covector in zip(r0, m, strict=True)]
        stretch_across = (
            sum(ufl.sqrt(shape.along(*nu)) for shape, nu in zip(natural, nus, strict=True)) / 2
        )
        angle_ratio = sum(shape.kink(*nu) for shape, nu in zip(natural, nus, strict=True)) / (
            2 * stretch_across
        )
        angle = angle_ratio * ufl.atan2(sine0, cosine0)
        sine0, cosine0 = ufl.sin(angle), ufl.cos(angle)
    J = stretch_across * ufl.atan2(sine * cosine0 - cosine * sine0, cosine * cosine0 + sine * sine0)
    return two_sided(J, r0, u, m, *rest, law=law, natural=natural)


def turning(r0: Jet, u: Jet, m: Expr, width: Expr, intensity: Expr, reference_turn: Expr) -> Expr:
    """-Pi of a moment per length about the edge's first tangent.

    It is `intensity` times the angle of the normal. The tangent runs with the surface on its left,
    so that a positive angle turns the normal outward. The angle is that of the normal's part normal
    to the tangent. `reference_turn` (2,) holds cosine and sine of the turn from which the angle is
    counted, so that it may grow beyond pi.
    """
    edge_tangent = r0.r2 * m[0] - r0.r1 * m[1]
    length = ufl.sqrt(ufl.dot(edge_tangent, edge_tangent))
    t0, n0, n = edge_tangent / length, kin.normal(r0), kin.normal(r0 + u)
    sine, cosine = ufl.dot(ufl.cross(n0, n), t0), ufl.dot(n0, n)
    return -intensity * kin.angle_from(sine, cosine, reference_turn) * length


def clamped(
    r0: Jet,
    u: Jet,
    m: Expr,
    width: Expr,
    sigma: Expr,
    turn: Expr | None = None,
    *,
    law: Law,
    natural: Forms | None = None,
) -> Expr:
    """Energy of a clamped edge per length of its parameter.

    The outer normal is held at n0, or at `turn` n0 with a rotation (3, 3). Other parameters are
    those of `two_sided`, on one side.
    """
    nu1, nu2, stretch = kin.conormal(r0, m)
    r, n0 = r0 + u, kin.normal(r0)
    J = -ufl.dot(
        (n0 if turn is None else ufl.dot(turn, n0)) - kin.normal(r), r.r1 * nu1 + r.r2 * nu2
    )
    M, D = densities.normal_moment(r0, u, nu1, nu2, law, natural)
    return edge_density(M, D, J, width, sigma) * stretch


def symmetric(
    r0: Jet,
    u: Jet,
    m: Expr,
    width: Expr,
    sigma: Expr,
    mirror: Expr,
    *,
    law: Law,
    natural: Forms | None = None,
) -> Expr:
    """Energy of an edge on a mirror plane per length of its parameter: half of an interior edge's.

    `mirror` is the unit normal of the plane; other parameters are those of `two_sided`, on one
    side.
    """
    nu1, nu2, stretch = kin.conormal(r0, m)

    def mirror_jump(j: Jet) -> Expr:
        return 2 * ufl.dot(kin.normal(j), mirror) * ufl.dot(mirror, j.r1 * nu1 + j.r2 * nu2)

    J = mirror_jump(r0 + u) - (natural.kink(nu1, nu2) if natural else 1) * mirror_jump(r0)
    M, D = densities.normal_moment(r0, u, nu1, nu2, law, natural)
    return edge_density(M, D, J, width, sigma) * stretch / 2


def largest_fold(r0: fem.Function, degree: int) -> float:
    """Return the largest angle (rad) between the undeformed normals of two cells at their edge.

    It is compared at the points of a rule of the given degree. Collective.
    """
    V = r0.function_space
    nodes, largest = r0.x.array.reshape(-1, 3), 0.0
    for batch in interior_batches(V, degree):
        normals = []
        for table, cells in zip(batch.rule.tables, batch.cells, strict=True):
            jets = table.jets(nodes[V.dofmap.list[cells]])
            m = np.cross(jets[:, :, 1], jets[:, :, 2])
            normals.append(m / np.linalg.norm(m, axis=-1)[..., None])
        sine = np.linalg.norm(np.cross(*normals), axis=-1)
        angles = np.arctan2(sine, np.einsum("epi,epi->ep", *normals))
        largest = max(largest, float(angles.max()))
    return float(V.mesh.comm.allreduce(largest, MPI.MAX))
