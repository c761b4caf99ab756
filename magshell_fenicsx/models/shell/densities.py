"""Energy densities of the shell as plain functions of jets: the one source of the physics.

All in units of E h per undeformed area (lengths in R), so that the membrane energy is
of order one. An energy is the integral of density times area_ratio(r0).
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import ufl
from ufl.core.expr import Expr

from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.kinematics import Forms, Jet
from magshell_fenicsx.models.shell.law import Law, work

COMPONENT_PAIRS = np.triu_indices(3)
FIELD_POLYNOMIAL_SIZE = (
    3 + 3 + 3 + 9 + 18
)  # of a field's polynomial: u*, B at r0, B*, G*, H* by pairs j <= k

MagneticDensity = Callable[
    ..., Expr
]  # of (r0, u, Br, Ba), and the natural forms where these are known


def membrane(r0: Jet, u: Jet, *, law: Law, natural: Forms | None = None) -> Expr:
    """Stretching density, paper Eq. (eqn:energy), first term; of the strain from the `natural`
    forms.
    """
    E, law = kin.membrane_strain(r0, u), law_at(law, r0)
    if natural is None:
        return law.membrane(E, kin.inverse_metric(r0))
    return natural.area * law.thicker(natural.thickness).membrane(E - natural.strain, natural.up)


def prestress(r0: Jet, u: Jet, v: Jet, E: Expr, *, law: Law, natural: Forms | None = None) -> Expr:
    """S : (v_i . v_j)/2 with what a change E_11, E_12, E_22 of strain adds to S: what that adds to
    the energy of v.
    """
    strain = ufl.as_matrix([[E[0], E[1]], [E[1], E[2]]])
    present, law = kin.membrane_strain(r0, u), law_at(law, r0)
    if natural is None:
        return work(law.stress_change(present, strain, kin.inverse_metric(r0)), kin.metric(v)) / 2
    law = law.thicker(natural.thickness)
    return (
        natural.area
        * work(law.stress_change(present - natural.strain, strain, natural.up), kin.metric(v))
        / 2
    )


def bending(r0: Jet, u: Jet, *, law: Law, natural: Forms | None = None) -> Expr:
    """Bending density, paper Eq. (eqn:energy), second term; of the change from the `natural`
    curvature.
    """
    E, K, law = kin.membrane_strain(r0, u), kin.curvature_change(r0, u), law_at(law, r0)
    if natural is None:
        return law.bending(E, K, kin.inverse_metric(r0))
    return natural.area * law.thicker(natural.thickness).bending(
        E - natural.strain, K - natural.bend, natural.up
    )


def normal_moment(
    r0: Jet, u: Jet, nu1: Expr, nu2: Expr, law: Law, natural: Forms | None = None
) -> tuple[Expr, Expr]:
    """M_nunu for the unit conormal nu^1, nu^2, which works on b_nunu, and the stiffness of a
    penalty.
    """
    E, K, law = kin.membrane_strain(r0, u), kin.curvature_change(r0, u), law_at(law, r0)
    if natural is None:
        edge = kin.inverse_metric(r0), (nu1, nu2), 1
        return law.edge_moment(E, K, *edge), law.edge_stiffness(E, *edge)
    covector = ufl.dot(kin.metric(r0), ufl.as_vector([nu1, nu2]))
    covector_up = ufl.dot(natural.up, covector)
    edge = natural.up, (covector_up[0], covector_up[1]), ufl.dot(covector_up, covector)
    E, K, law = E - natural.strain, K - natural.bend, law.thicker(natural.thickness)
    return natural.area * law.edge_moment(E, K, *edge), natural.area * law.edge_stiffness(E, *edge)


def law_at(law: Law, r0: Jet) -> Law:
    """Return the law at a place, on which directions of plies depend."""
    return law.at_point(r0.r, r0.r1, r0.r2, kin.area_vector(r0))


def magnetic(r0: Jet, u: Jet, Br: Expr, Ba: Expr) -> Expr:
    """-Ba . (F - F0) Br, F = a_i (x) a0^i + n (x) n0; paper Eq. (eq:magenergy) without its
    constant.
    """
    up1, up2 = kin.dual_basis(r0)
    n, n0 = kin.normal(r0 + u), kin.normal(r0)
    return -ufl.dot(
        Ba, u.r1 * ufl.dot(up1, Br) + u.r2 * ufl.dot(up2, Br) + (n - n0) * ufl.dot(n0, Br)
    )


def magnetic_thinned(
    r0: Jet, u: Jet, Br: Expr, Ba: Expr, *, natural: Forms | None = None, thins: Expr | int = 1
) -> Expr:
    """Magnetic density where the thickness follows from the area (`thins` is 1): in F n (x) n0 is
    stretched so that the `natural` volume stays.
    """
    r, n0 = r0 + u, kin.normal(r0)
    thinned = kin.area_ratio(r0) / kin.area_ratio(r)
    if natural is not None:
        thinned *= natural.area * natural.thickness
    return magnetic(r0, u, Br, Ba) - thins * (thinned - 1) * ufl.dot(Ba, kin.normal(r)) * ufl.dot(
        n0, Br
    )


def in_gradient(law: MagneticDensity) -> MagneticDensity:
    """The part of Ba = G r, of (r0, u, Br, G): -(G r) . F Br at the deformed position, without its
    value at u = 0.

    `law` is `magnetic`, or has R in place of F.
    """

    def magnetic_gradient(r0: Jet, u: Jet, Br: Expr, G: Expr, **options: Any) -> Expr:
        return law(r0, u, Br, ufl.dot(G, r0.r + u.r), **options) - ufl.dot(ufl.dot(G, u.r), Br)

    return magnetic_gradient


def in_space(law: MagneticDensity) -> MagneticDensity:
    """Return the density in a field known by values, of (r0, u, Br, P): P as in
    `field_at_displacement`; `law` as in `in_gradient`.
    """

    def magnetic_in_space(r0: Jet, u: Jet, Br: Expr, P: Expr, **options: Any) -> Expr:
        B, change = field_at_displacement(P, u.r)
        return law(r0, u, Br, B, **options) - ufl.dot(change, Br)

    return magnetic_in_space


def magnetic_first(r0: Jet, u: Jet, Br: Expr, Ba: Expr) -> Expr:
    """U1, linear in u: in-plane forces and a pressure; paper Eq. (eq:terms)."""
    up1, up2 = kin.dual_basis(r0)
    n0 = kin.normal(r0)
    tangential = Ba - ufl.dot(Ba, n0) * n0
    return -ufl.dot(tangential, u.r1 * ufl.dot(up1, Br) + u.r2 * ufl.dot(up2, Br))


def magnetic_torque(r0: Jet, u: Jet, Br: Expr, Ba: Expr) -> Expr:
    """Uq, quadratic in the rotation q_i = n0 . u,_i: rotational springs; paper Eq. (eq:terms)."""
    n0 = kin.normal(r0)
    q = rotation(r0, u)
    return ufl.dot(q, q) * ufl.dot(n0, Ba) * ufl.dot(n0, Br) / 2


def magnetic_tau(r0: Jet, u: Jet, Br: Expr, Ba: Expr) -> Expr:
    """Utau: torques from the surface gradient of u, q^c U_ac with a the derivative; paper Eq.
    (eq:terms).
    """
    up1, up2 = kin.dual_basis(r0)
    q = rotation(r0, u)
    rotated = ufl.dot(q, u.r1) * ufl.dot(up1, Ba) + ufl.dot(q, u.r2) * ufl.dot(up2, Ba)
    return -rotated * ufl.dot(kin.normal(r0), Br)


def magnetic_couple(r0: Jet, u: Jet, Br: Expr, Ba: Expr) -> Expr:
    """Couple: the other term linear in u, zero where Br is parallel to Ba; not in the paper's U1
    and U2.

    With it, U1 + Uq + Utau is the second-order Taylor polynomial of the full energy.
    """
    n0 = kin.normal(r0)
    q = rotation(r0, u)
    return ufl.dot(q, Ba) * ufl.dot(n0, Br) - ufl.dot(n0, Ba) * ufl.dot(q, Br)


def rotation(r0: Jet, u: Jet) -> Expr:
    """q^i a0_i with q_i = n0 . u,_i, tangent to the undeformed surface."""
    up1, up2 = kin.dual_basis(r0)
    n0 = kin.normal(r0)
    return ufl.dot(n0, u.r1) * up1 + ufl.dot(n0, u.r2) * up2


def volume(r0: Jet, u: Jet, origin: Expr | None = None) -> Expr:
    """(x . n dω - x0 . n0 dω0)/3 per area of the coordinates, x from the origin."""
    r = r0 + u
    x, x0 = (r.r, r0.r) if origin is None else (r.r - origin, r0.r - origin)
    return (ufl.dot(x, kin.area_vector(r)) - ufl.dot(x0, kin.area_vector(r0))) / 3


def swept_volume(r0: Jet, u: Jet, unit: Expr | float = 1.0) -> Expr:
    """Volume that the surface sweeps when its points move straight to r0 + u; per area of the
    coordinates.

    It is the work of p = 1 in that unit, and its potential wherever there is one: whatever the
    edges are, no origin and no faces that close the volume enter.
    """
    halfway = ufl.cross(r0.r1 + u.r1 / 2, r0.r2 + u.r2 / 2)
    return unit * ufl.dot(u.r, halfway + kin.area_vector(u) / 12)


def follower_pressure_work(r0: Jet, u: Jet, v: Jet, unit: Expr | float = 1.0) -> Expr:
    """v . n da: the virtual work of p = 1 in that unit; per area of the coordinates."""
    return unit * ufl.dot(v.r, kin.area_vector(r0 + u))


def field_at_displacement(P: Expr, u: Expr) -> tuple[Expr, Expr]:
    """B at the displacement u from the polynomial P (`FIELD_POLYNOMIAL_SIZE`,), and less what it is
    at u = 0.
    """
    d = u - ufl.as_vector([P[i] for i in range(3)])

    def component(i: int) -> Expr:
        linear = sum(P[9 + 3 * i + j] * d[j] for j in range(3))
        pairs = enumerate(zip(*COMPONENT_PAIRS, strict=True))
        return (
            P[6 + i]
            + linear
            + sum(P[18 + 6 * i + n] * d[int(j)] * d[int(k)] for n, (j, k) in pairs)
        )

    B = ufl.as_vector([component(i) for i in range(3)])
    return B, B - ufl.as_vector([P[3 + i] for i in range(3)])
