"""The magnetic terms of each law of the remanence and each energy.

A remanence moves with F (`densities`), or it turns with the surface and does not stretch: R Br in
place of F Br. R is the rotation of the polar decomposition of F = a_i (x) a0^i + n (x) n0. In the
surface let C = U², U = (C + J 1)/T, T² = tr C + 2 J and J = sqrt(det C). Then R = F U^-1 = (F + J F
C^-1)/T, and J F C^-1 = J a^i (x) a0_i. All roots are of positive numbers, at equal stretches too.
Units and arguments are those of `densities`.

- r0 and u are the jets of placement and displacement: values with first and second derivatives.
- Br and Ba are the remanence and the applied flux density over their magnitudes.
- n is the unit normal, a_i the tangents, a^i the dual basis; a 0 marks the undeformed surface. In
  the code `up1` and `up2` are a0^1 and a0^2.
- The expansions of the energy in u have the terms U1 (linear), Uq (rotational springs), Utau
  (torques from surface gradients) and the couple.
"""

import ufl
from ufl.core.expr import Expr

from magshell_fenicsx.models.shell import densities
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.densities import MagneticDensity
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.parts.magnetism.magnetised import MagneticEnergy, RemanenceLaw


def magnetic(r0: Jet, u: Jet, Br: Expr, Ba: Expr) -> Expr:
    """Return the full energy density -Ba . (R - R0) Br of a remanence that only rotates.

    R is the rotation of the polar decomposition of F, R0 = 1 its value at u = 0.
    """
    r, n0, up = r0 + u, kin.normal(r0), kin.dual_basis(r0)
    n, area0 = kin.normal(r), kin.area_ratio(r0)
    J = kin.area_ratio(r) / area0
    trace = ufl.inner(kin.inverse_metric(r0), kin.metric(r))  # of C
    # F Br and J F C^-1 Br, of the part of Br in the surface. Their sum over T = sqrt(tr C + 2 J) is
    # R of this part; its part along n0 turns to n
    in_surface = r.r1 * ufl.dot(up[0], Br) + r.r2 * ufl.dot(up[1], Br)
    cofactor_part = (
        ufl.cross(r.r2, n) * ufl.dot(r0.r1, Br) + ufl.cross(n, r.r1) * ufl.dot(r0.r2, Br)
    ) / area0
    normal_Br = ufl.dot(n0, Br)
    return -ufl.dot(Ba, (in_surface + cofactor_part) / ufl.sqrt(trace + 2 * J) - Br + normal_Br * n)


def magnetic_first(r0: Jet, u: Jet, Br: Expr, Ba: Expr) -> Expr:
    """Return the term U1, linear in u, of a remanence that only rotates.

    It is the part of `densities.magnetic_first` that is antisymmetric in Br and Ba: the surface
    turns in itself and does not stretch the remanence.
    """
    return (densities.magnetic_first(r0, u, Br, Ba) - densities.magnetic_first(r0, u, Ba, Br)) / 2


def magnetic_torque(r0: Jet, u: Jet, Br: Expr, Ba: Expr) -> Expr:
    """Return the term Uq of a remanence that only rotates.

    It is quadratic in the rotations: q_i = n0 . u,_i of the normal, and w in the surface. It is the
    term of a remanence that moves with F, and further products of rotations.
    """
    n0, q = kin.normal(r0), densities.rotation(r0, u)
    up1, up2 = kin.dual_basis(r0)
    w = ufl.dot(n0, ufl.cross(up1, u.r1) + ufl.cross(up2, u.r2)) / 2
    in_surface = ufl.dot(Ba, Br) - ufl.dot(n0, Ba) * ufl.dot(n0, Br)
    rotation_products = ufl.dot(q, Ba) * ufl.dot(q, Br) + w**2 * in_surface
    return densities.magnetic_torque(r0, u, Br, Ba) + rotation_products / 2


def magnetic_tau(r0: Jet, u: Jet, Br: Expr, Ba: Expr) -> Expr:
    """Return the term Utau of a remanence that only rotates.

    The normal part of the remanence contributes rotations times surface gradients of u. Its part
    in the surface contributes rotations times strains (`stretched`, `widened`).
    """
    n0, q = kin.normal(r0), densities.rotation(r0, u)  # q is a vector in the surface
    up1, up2 = kin.dual_basis(r0)
    in_surface = Br - ufl.dot(n0, Br) * n0  # the part of the remanence in the surface
    along_q = ufl.dot(q, u.r1 * ufl.dot(up1, Br) + u.r2 * ufl.dot(up2, Br))
    along_Br = ufl.dot(in_surface, u.r1 * ufl.dot(up1, q) + u.r2 * ufl.dot(up2, q))
    stretched = ufl.dot(n0, Ba) * (along_q + along_Br) / 2
    widened = (ufl.dot(up1, u.r1) + ufl.dot(up2, u.r2)) * magnetic_first(r0, u, Br, Ba) / 2
    return densities.magnetic_tau(r0, u, Br, Ba) + stretched - widened


LINEAR = ("U1", "couple")
_FULL: dict[RemanenceLaw, MagneticDensity] = {
    "deformation": densities.magnetic,
    "rotation": magnetic,
}
_EXPANDED: dict[RemanenceLaw, dict[str, MagneticDensity]] = {
    "deformation": {
        "U1": densities.magnetic_first,
        "Uq": densities.magnetic_torque,
        "Utau": densities.magnetic_tau,
        "couple": densities.magnetic_couple,
    },
    "rotation": {
        "U1": magnetic_first,
        "Uq": magnetic_torque,
        "Utau": magnetic_tau,
        "couple": densities.magnetic_couple,
    },
}
_TERMS: dict[MagneticEnergy, tuple[str, ...]] = {
    "first": ("U1",),
    "torque": ("Uq",),
    "second": ("U1", "Uq", "Utau"),
    "second_consistent": ("U1", "Uq", "Utau", "couple"),
}


def full_density(law: RemanenceLaw, *, thins: bool) -> MagneticDensity:
    """Return the density of the full energy under a law of the remanence.

    `thins` says whether the thickness of the shell changes with its area.
    """
    if thins and law == "deformation":
        return densities.magnetic_thinned
    return _FULL[law]


def magnetic_densities(
    law: RemanenceLaw, energy: MagneticEnergy, *, thins: bool
) -> dict[str, MagneticDensity]:
    """Return the densities of a magnetic energy under a law of the remanence, by name of the term.

    They are linear in the applied field. `thins` says whether the thickness changes with the area.
    """
    if energy == "full":
        return {"magnetic": full_density(law, thins=thins)}
    return {name: _EXPANDED[law][name] for name in _TERMS[energy]}
