"""Energy densities of the shell as plain functions of jets: the one source of the physics.

All are in units of E h per undeformed area (lengths in R), so that the membrane energy is of order
one. An energy is the integral of density times area_ratio(r0). The arguments r0 and u are the jets
of placement and displacement, `natural` the natural forms, None for those of r0.

- A jet is a vector field's value with its first and second derivatives by two coordinates.
- E is the membrane strain, K the change of curvature, `up` an inverse metric (index up).
- The natural forms (`kinematics.Forms`) are metric, curvature, area and thickness of the shape that
  the shell would have without stress; area and thickness are over the undeformed ones.
- `law` is the material's law, whose energies, moments and stresses are functions of E and K.
- Br and Ba are the remanence and the applied flux density over their magnitudes. F = a_i (x) a0^i +
  n (x) n0 is the deformation gradient at the mid-surface, F0 its value at u = 0.
- q_i = n0 . u,_i are the components of the normal's linearised rotation.
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
    """Stretching density, paper Eq. (eqn:energy), first term.

    With `natural`, the strain is that from the natural forms.
    """
    E, law = kin.membrane_strain(r0, u), law_at(law, r0)
    if natural is None:
        return law.membrane(E, kin.inverse_metric(r0))
    return natural.area * law.thicker(natural.thickness).membrane(E - natural.strain, natural.up)


def prestress(r0: Jet, u: Jet, v: Jet, E: Expr, *, law: Law, natural: Forms | None = None) -> Expr:
    """Second variation along v of an additional membrane stress S: S : (v_i . v_j)/2.

    S is the change of the stress when the strain of u is increased by E = (E_11, E_12, E_22). `v`
    is the jet of the displacement of the variation. It gives a tangent another membrane stress than
    the one at u.
    """
    # the metric of v has the components v_i . v_j
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
    """Bending density, paper Eq. (eqn:energy), second term.

    With `natural`, the change of curvature is that from the natural curvature.
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
    """Return the moment M_nunu across an edge, and the stiffness for the penalty there.

    The moment works on b_nunu, the curvature across the edge. nu1 and nu2 are the contravariant
    components of the undeformed unit conormal nu.
    """
    E, K, law = kin.membrane_strain(r0, u), kin.curvature_change(r0, u), law_at(law, r0)
    # `edge`: inverse metric, components of nu with index up, and the square of nu
    if natural is None:
        edge = kin.inverse_metric(r0), (nu1, nu2), 1
        return law.edge_moment(E, K, *edge), law.edge_stiffness(E, *edge)
    # nu with index down by the undeformed metric, then up by the natural one, in which its length
    # is not one
    covector = ufl.dot(kin.metric(r0), ufl.as_vector([nu1, nu2]))
    covector_up = ufl.dot(natural.up, covector)
    edge = natural.up, (covector_up[0], covector_up[1]), ufl.dot(covector_up, covector)
    # strain and change of curvature from the natural shape, and the law with its thickness
    E, K, law = E - natural.strain, K - natural.bend, law.thicker(natural.thickness)
    return natural.area * law.edge_moment(E, K, *edge), natural.area * law.edge_stiffness(E, *edge)


def law_at(law: Law, r0: Jet) -> Law:
    """Return the law at a place with the jet r0, on which directions of plies depend."""
    return law.at_point(r0.r, r0.r1, r0.r2, kin.area_vector(r0))


def magnetic(r0: Jet, u: Jet, Br: Expr, Ba: Expr) -> Expr:
    """-Ba . (F - F0) Br, F = a_i (x) a0^i + n (x) n0; paper Eq. (eq:magenergy).

    The constant -Ba . F0 Br is left out. Br and Ba are vectors over their magnitudes.
    """
    up1, up2 = kin.dual_basis(r0)
    n, n0 = kin.normal(r0 + u), kin.normal(r0)
    return -ufl.dot(
        Ba, u.r1 * ufl.dot(up1, Br) + u.r2 * ufl.dot(up2, Br) + (n - n0) * ufl.dot(n0, Br)
    )


def magnetic_thinned(
    r0: Jet, u: Jet, Br: Expr, Ba: Expr, *, natural: Forms | None = None, thins: Expr | int = 1
) -> Expr:
    """Magnetic density where the thickness follows from the area (`thins` is 1).

    Where the area grows the thickness shrinks, so that the volume stays: in F the part n (x) n0 has
    this stretch. With `natural`, the volume is that of the natural shape. Where `thins` is 0, the
    density is that of `magnetic`.
    """
    r, n0 = r0 + u, kin.normal(r0)
    thinned = kin.area_ratio(r0) / kin.area_ratio(r)
    if natural is not None:
        thinned *= natural.area * natural.thickness
    return magnetic(r0, u, Br, Ba) - thins * (thinned - 1) * ufl.dot(Ba, kin.normal(r)) * ufl.dot(
        n0, Br
    )


def in_gradient(law: MagneticDensity) -> MagneticDensity:
    """Return the density of the part Ba = G r of the field, a function of (r0, u, Br, G).

    It is -(G r) . F Br at the deformed position r, without its value at u = 0. `law` is `magnetic`,
    or a density like it with the rotation R in place of F.
    """

    def magnetic_gradient(r0: Jet, u: Jet, Br: Expr, G: Expr, **options: Any) -> Expr:
        """Return the density at the displacement's jet u in the field G r."""
        # -(G r) . F Br + (G r0) . F0 Br, where `law` has -(G r) . (F - F0) Br, and F0 = 1
        return law(r0, u, Br, ufl.dot(G, r0.r + u.r), **options) - ufl.dot(ufl.dot(G, u.r), Br)

    return magnetic_gradient


def in_space(law: MagneticDensity) -> MagneticDensity:
    """Return the density in a field that is known by values, a function of (r0, u, Br, P).

    P is the field's Taylor polynomial as in `field_at_displacement`. `law` is `magnetic`, or a
    density like it with the rotation R in place of F.
    """

    def magnetic_in_space(r0: Jet, u: Jet, Br: Expr, P: Expr, **options: Any) -> Expr:
        """Return the density at the displacement's jet u in the field with the polynomial P."""
        # `change` adds the work of the field's difference from its value at u = 0 on Br itself
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
    """Utau: torques from the surface gradient of u; paper Eq. (eq:terms).

    It is -(n0 . Br) Ba^a q . u,_a, with the rotation vector q and the components Ba^a of the field
    in the surface.
    """
    up1, up2 = kin.dual_basis(r0)
    q = rotation(r0, u)
    rotated = ufl.dot(q, u.r1) * ufl.dot(up1, Ba) + ufl.dot(q, u.r2) * ufl.dot(up2, Ba)
    return -rotated * ufl.dot(kin.normal(r0), Br)


def magnetic_couple(r0: Jet, u: Jet, Br: Expr, Ba: Expr) -> Expr:
    """Couple: the further term linear in u, zero where Br is parallel to Ba.

    It is not in the paper's U1 and U2. With it, U1 + Uq + Utau is the second-order Taylor
    polynomial of the full energy.
    """
    n0 = kin.normal(r0)
    q = rotation(r0, u)
    return ufl.dot(q, Ba) * ufl.dot(n0, Br) - ufl.dot(n0, Ba) * ufl.dot(q, Br)


def rotation(r0: Jet, u: Jet) -> Expr:
    """Return the rotation q^i a0_i with q_i = n0 . u,_i, tangent to the undeformed surface."""
    up1, up2 = kin.dual_basis(r0)
    n0 = kin.normal(r0)
    return ufl.dot(n0, u.r1) * up1 + ufl.dot(n0, u.r2) * up2


def volume(r0: Jet, u: Jet, origin: Expr | None = None) -> Expr:
    """(x . n dω - x0 . n0 dω0)/3 per area of the coordinates: the change of the enclosed volume.

    x is the deformed and x0 the undeformed place, both from `origin`; None for the origin of r0.
    """
    r = r0 + u
    x, x0 = (r.r, r0.r) if origin is None else (r.r - origin, r0.r - origin)
    return (ufl.dot(x, kin.area_vector(r)) - ufl.dot(x0, kin.area_vector(r0))) / 3


def swept_volume(r0: Jet, u: Jet, unit: Expr | float = 1.0) -> Expr:
    """Volume that the surface sweeps when its points move straight to r0 + u.

    It is per area of the coordinates, times `unit`, a unit of pressure. So it is the work of the
    pressure 1 on this way. It is the potential of a live pressure wherever there is one, and needs
    no origin and no faces that close the volume.
    """
    # the area vector is quadratic along the way: its mean is the value halfway plus a twelfth of
    # u,_1 x u,_2
    halfway = ufl.cross(r0.r1 + u.r1 / 2, r0.r2 + u.r2 / 2)
    return unit * ufl.dot(u.r, halfway + kin.area_vector(u) / 12)


def follower_pressure_work(r0: Jet, u: Jet, v: Jet, unit: Expr | float = 1.0) -> Expr:
    """v . n da: the virtual work of p = 1 along v, per area of the coordinates, times `unit`."""
    return unit * ufl.dot(v.r, kin.area_vector(r0 + u))


def field_at_displacement(P: Expr, u: Expr) -> tuple[Expr, Expr]:
    """Return the field B at the displacement u, and its difference from B at u = 0.

    P (`FIELD_POLYNOMIAL_SIZE`,) is a Taylor polynomial of second order about the displacement u* in
    P[0:3]. P[3:6] is B at u = 0. At u*, P[6:9] is B, P[9:18] its gradient by rows, and P[18:36]
    its second derivatives by pairs j <= k, of which those with j = k are halved.
    """
    d = u - ufl.as_vector([P[i] for i in range(3)])

    def component(i: int) -> Expr:
        """Return component i of B at the displacement."""
        linear = sum(P[9 + 3 * i + j] * d[j] for j in range(3))
        pairs = enumerate(zip(*COMPONENT_PAIRS, strict=True))
        return (
            P[6 + i]
            + linear
            + sum(P[18 + 6 * i + n] * d[int(j)] * d[int(k)] for n, (j, k) in pairs)
        )

    B = ufl.as_vector([component(i) for i in range(3)])
    return B, B - ufl.as_vector([P[3 + i] for i in range(3)])
