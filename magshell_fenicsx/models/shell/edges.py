"""The bending energy of edges, by C0 interior penalty for a C0 displacement, and folds.

A C0 surface has b_nunu = (-[n] . r_nu) delta on an edge. With the jump J of that quantity over its
undeformed value, an edge contributes

    {M_nunu} J + sigma {D}/(2 h_e) J^2      per undeformed length.

It is one energy: derived twice it gives a symmetric tangent. Every expression is invariant under
exchange of '+' and '-'. The means {M_nunu} and {D} weight each side by its width: however narrow a
cell is beside its neighbour, the same sigma holds its moment (docs/theory.md).

- '+' and '-' are the cells on both sides of an edge; [n] is the jump of the normal, {} a mean.
- nu is the outward conormal of a cell at the edge, r_nu the derivative of the place along it, and
  b_nunu the curvature across the edge. M_nunu is the moment that works on it.
- m is the covector (2,) of an edge (`kinematics.conormal`); an edge's parameter is its length in
  the coordinates, or a number from 0 to 1.
- The width of a cell at an edge is half its height over it, h_e the mean of both sides; sigma is
  the penalty, D a bending stiffness. `area` is that of a cell in its coordinates, per unit of the
  edge's parameter, from which the width follows.
- A natural shape (`Forms`) is the one that the shell would have without stress. Its `kink(nu)` is
  its curvature across an edge over the undeformed one, `along(nu)` the square of its stretch there.
- A jet is a field's value with its first and second derivatives.
"""

from collections.abc import Sequence
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
# h_e over the thickness, below which cells resolve the layer where rubber bends at an edge
WIDTH_OF_LAYER = 1.5
FOLD_ANGLE = 0.02  # rad: below, the sine of an angle is the angle to 7e-5


def edge_density(M: Expr, D: Expr, J: Expr, width: Expr, sigma: Expr) -> Expr:
    """{M} J + sigma D/(2 h_e) J^2: moment M, penalty stiffness D, jump J, h_e the `width`."""
    return M * J + sigma * D / (2 * width) * J**2


def cell_width(r0: Jet, area: Expr, stretch: Expr) -> Expr:
    """Return the width of a cell at an edge: its area over the edge's length.

    Both are those of a cell with the undeformed metric at the point. A flat triangle through the
    corners may be far higher, where the curved one is low. `stretch` is the undeformed length of
    the edge over its parameter.
    """
    return area * kin.area_ratio(r0) / stretch


def fold_jump(
    plus: Jet, minus: Jet, nu_plus: tuple[Expr, Expr], nu_minus: tuple[Expr, Expr]
) -> Expr:
    """-[n] . {r_nu} with [n] = n- - n+: the jump of the normal across an edge.

    nu_plus and nu_minus are the components of each side's outward conormal. The mean {r_nu} points
    out of '+', so that '-' enters with the opposite sign.
    """
    r_nu = (
        plus.r1 * nu_plus[0]
        + plus.r2 * nu_plus[1]
        - minus.r1 * nu_minus[0]
        - minus.r2 * nu_minus[1]
    ) / 2
    return -ufl.dot(kin.normal(minus) - kin.normal(plus), r_nu)


def fold_angle(plus: Jet, minus: Jet, m_plus: Expr) -> tuple[Expr, Expr]:
    """Return sine and cosine of the angle about the edge from one normal to the other.

    The angle has the sign of `fold_jump`. `m_plus` is the edge's covector on the side '+', which
    gives the edge its direction.
    """
    edge_tangent = kin.unit(plus.r2 * m_plus[0] - plus.r1 * m_plus[1])
    n_plus, n_minus = kin.normal(plus), kin.normal(minus)
    return -ufl.dot(ufl.cross(n_plus, n_minus), edge_tangent), ufl.dot(n_plus, n_minus)


def mean_by_width(values: Sequence[Expr], widths: Sequence[Expr]) -> Expr:
    """Return the mean of the values on both sides of an edge, weighted by the cells' widths."""
    return (values[0] * widths[0] + values[1] * widths[1]) / (widths[0] + widths[1])


def two_sided(
    J: Expr,
    r0: Sides,
    u: Sides,
    m: tuple[Expr, Expr],
    areas: tuple[Expr, Expr],
    sigma: Expr,
    *,
    law: tuple[Law, Law],
    natural: Shapes | None = None,
) -> Expr:
    """Energy of an interior edge with a jump J, per unit of its parameter.

    It is {M_nunu} J + sigma {D}/(2 h_e) J^2 per undeformed length.

    Parameters
    ----------
    J
        Strength of the curvature b_nunu that the edge concentrates, less its undeformed strength.
    r0, u
        Jets on both sides, '+' first.
    m
        Covectors of the edge on both sides; see `kinematics.conormal`.
    areas
        Areas of the cells on both sides.
    sigma
        Penalty.
    law
        Laws of both sides.
    natural
        The natural forms on both sides; None if they are those of r0.
    """
    # on each side the conormal's two components, and the edge's length over its parameter
    conormals = [kin.conormal(j, covector) for j, covector in zip(r0, m, strict=True)]
    stretch = (conormals[0][2] + conormals[1][2]) / 2
    # moment across the edge and stiffness for the penalty on each side, then their means
    moments = [
        densities.normal_moment(r0[i], u[i], *conormals[i][:2], law[i], natural and natural[i])
        for i in range(2)
    ]
    widths = [cell_width(r0[i], areas[i], conormals[i][2]) for i in range(2)]
    M, D = (mean_by_width(pair, widths) for pair in zip(*moments, strict=True))
    return edge_density(M, D, J, sum(widths) / 2, sigma) * stretch


def interior(
    r0: Sides,
    u: Sides,
    m: tuple[Expr, Expr],
    *rest: Any,
    law: tuple[Law, Law],
    natural: Shapes | None = None,
) -> Expr:
    """Energy of an interior edge between cells that meet smoothly, or nearly so.

    It is per unit of the edge's parameter. The jump of the normal stands for the angle, whose sine
    it is. `rest` are the areas and sigma of `two_sided`.
    """
    # the two components of the conormal on each side
    nus = [kin.conormal(j, covector)[:2] for j, covector in zip(r0, m, strict=True)]
    J0 = fold_jump(*r0, *nus)
    if natural:  # a natural shape has another kink at the edge: the mean ratio of both sides
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

    J is the change of the angle, whatever its size. A natural kink is the limit of a narrow bend:
    its strength of b_nunu is the angle times the natural stretch across the fold. `rest` are the
    areas and sigma of `two_sided`.
    """
    sine0, cosine0 = fold_angle(*r0, m[0])
    sine, cosine = fold_angle(r0[0] + u[0], r0[1] + u[1], m[0])
    stretch_across = 1
    if natural:
        # means over both sides: the natural stretch across the fold, and the ratio by which the
        # natural shape changes the undeformed angle
        nus = [kin.conormal(j, covector)[:2] for j, covector in zip(r0, m, strict=True)]
        stretch_across = (
            sum(ufl.sqrt(shape.along(*nu)) for shape, nu in zip(natural, nus, strict=True)) / 2
        )
        angle_ratio = sum(shape.kink(*nu) for shape, nu in zip(natural, nus, strict=True)) / (
            2 * stretch_across
        )
        angle = angle_ratio * ufl.atan2(sine0, cosine0)
        sine0, cosine0 = ufl.sin(angle), ufl.cos(angle)
    # the difference of both angles, from their sines and cosines
    J = stretch_across * ufl.atan2(sine * cosine0 - cosine * sine0, cosine * cosine0 + sine * sine0)
    return two_sided(J, r0, u, m, *rest, law=law, natural=natural)


def turning(r0: Jet, u: Jet, m: Expr, area: Expr, intensity: Expr, reference_turn: Expr) -> Expr:
    """Potential of a moment per length about an edge, per unit of the edge's parameter.

    It is -`intensity` times the angle of the normal about the undeformed tangent. The tangent runs
    with the surface on its left, so that a positive angle turns the normal outward. Only the
    normal's part across the tangent counts. `reference_turn` (2,) holds cosine and sine of the turn
    from which the angle is counted, so that it may grow beyond pi. `area` is not used.
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
    area: Expr,
    sigma: Expr,
    turn: Expr | None = None,
    *,
    law: Law,
    natural: Forms | None = None,
) -> Expr:
    """Energy of a clamped edge, per unit of its parameter.

    The side '-' is rigid: its normal stays n0, or is `turn` n0 with a rotation (3, 3). There are
    jets, covector, law and natural forms of one side only; `area` is that of its cell, `sigma` the
    penalty.

    The stiffness of rubber falls with the stretch: an edge that stretched by itself would turn
    freely. Where cells resolve the layer in which rubber bends, the penalty has the stiffness of
    small strains. Larger cells would resist the turn as a whole with it.
    """
    nu1, nu2, stretch = kin.conormal(r0, m)
    r, n0 = r0 + u, kin.normal(r0)
    # the jump -[n] . r_nu from the held normal to that of the shell
    held_normal = n0 if turn is None else ufl.dot(turn, n0)
    J = -ufl.dot(held_normal - kin.normal(r), r.r1 * nu1 + r.r2 * nu2)
    M, D = densities.normal_moment(r0, u, nu1, nu2, law, natural)
    width = cell_width(r0, area, stretch)
    if law.linear is not law:
        _, D_at_small_strains = densities.normal_moment(r0, u, nu1, nu2, law.linear, natural)
        resolves_layer = ufl.lt(width, WIDTH_OF_LAYER * law.h)
        D = ufl.conditional(resolves_layer, D_at_small_strains, D)
    return edge_density(M, D, J, width, sigma) * stretch


def symmetric(
    r0: Jet,
    u: Jet,
    m: Expr,
    area: Expr,
    sigma: Expr,
    mirror: Expr,
    *,
    law: Law,
    natural: Forms | None = None,
) -> Expr:
    """Energy of an edge on a mirror plane, per unit of its parameter.

    It is half of the energy of an interior edge whose side '-' is the mirror image of '+'. `mirror`
    is the unit normal of the plane. There are jets, covector, law and natural forms of one side
    only; `area` is that of its cell, `sigma` the penalty.
    """
    nu1, nu2, stretch = kin.conormal(r0, m)

    def mirror_jump(j: Jet) -> Expr:
        """Return the jump `fold_jump` between a surface and its mirror image."""
        return 2 * ufl.dot(kin.normal(j), mirror) * ufl.dot(mirror, j.r1 * nu1 + j.r2 * nu2)

    J = mirror_jump(r0 + u) - (natural.kink(nu1, nu2) if natural else 1) * mirror_jump(r0)
    M, D = densities.normal_moment(r0, u, nu1, nu2, law, natural)
    return edge_density(M, D, J, cell_width(r0, area, stretch), sigma) * stretch / 2


def largest_fold(r0: fem.Function, degree: int) -> float:
    """Return the largest angle (rad) between the undeformed normals of two cells at their edge.

    Angles are taken at the points of a quadrature rule of the given degree. Collective.
    """
    V = r0.function_space
    nodes, largest = r0.x.array.reshape(-1, 3), 0.0
    for batch in interior_batches(V, degree):
        normals = []  # (edges, points, 3) on each side
        for table, cells in zip(batch.rule.tables, batch.cells, strict=True):
            jets = table.jets(nodes[V.dofmap.list[cells]])
            m = np.cross(jets[:, :, 1], jets[:, :, 2])
            normals.append(m / np.linalg.norm(m, axis=-1)[..., None])
        sine = np.linalg.norm(np.cross(*normals), axis=-1)
        angles = np.arctan2(sine, np.einsum("epi,epi->ep", *normals))
        largest = max(largest, float(angles.max()))
    return float(V.mesh.comm.allreduce(largest, MPI.MAX))
