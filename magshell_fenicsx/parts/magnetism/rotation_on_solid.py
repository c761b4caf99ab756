"""Magnetic densities of a remanence that turns with the solid without stretch: R Br, not F Br.

F = R U. With C = U^2 and the invariants i1, i2, i3 of U, the theorem of Cayley and Hamilton gives R
= (i1 cof F + (i1^2 - i2) F - F C)/(i1 i2 - i3). The denominator is the product of the sums of two
stretches, so that it is smooth at equal stretches too. Units and arguments are those of
`body_densities`: X place, u displacement, H = du/dX, Br remanence, h thickness over R. Densities
are per undeformed volume; they are divided by h, as energies are over E h R². cof F = det(F) F^-T.
"""

import ufl
from ufl.core.expr import Expr

from magshell_fenicsx.models.shell.densities import field_at_displacement

STEPS = 3  # Newton steps from sqrt(3 I): exact to rounding for stretches from 0.05 to 20


def magnetic(X: Expr, u: Expr, H: Expr, Br: Expr, Ba: Expr, h: Expr) -> Expr:
    """Return the density -Ba . (R - 1) Br/h in a uniform field Ba."""
    return -(ufl.dot(Ba, rotated(ufl.Identity(3) + H, Br)) - ufl.dot(Ba, Br)) / h


def magnetic_gradient(X: Expr, u: Expr, H: Expr, Br: Expr, G: Expr, h: Expr) -> Expr:
    """Return the density of the part G x of the field, -(G x) . R Br/h at x = X + u.

    Its value at u = 0 is subtracted.
    """
    turned = rotated(ufl.Identity(3) + H, Br)
    return -(ufl.dot(ufl.dot(G, X + u), turned) - ufl.dot(ufl.dot(G, X), Br)) / h


def magnetic_in_space(X: Expr, u: Expr, H: Expr, Br: Expr, P: Expr, h: Expr) -> Expr:
    """Return the density in a field known by values, less its value at u = 0.

    P is the field's polynomial, see `field_at_displacement`.
    """
    B, change = field_at_displacement(P, u)
    return magnetic(X, u, H, Br, B, h) - ufl.dot(change, Br) / h


def rotated(F: Expr, v: Expr) -> Expr:
    """Return R v, with the rotation R of the polar decomposition F = R U.

    It is v multiplied by (i1 cof F + (i1^2 - i2) F - F C)/(i1 i2 - i3), with C = F^T F and the
    invariants i1, i2, i3 of U (the theorem of Cayley and Hamilton).
    """
    # cof F from the columns of F; `first` and `second` are the invariants tr C = F:F and
    # tr cof C = cof F : cof F
    f1, f2, f3 = (F[:, i] for i in range(3))
    cofactor = ufl.as_tensor([ufl.cross(f2, f3), ufl.cross(f3, f1), ufl.cross(f1, f2)]).T
    first, second, i3 = (
        ufl.inner(F, F),
        ufl.inner(cofactor, cofactor),
        ufl.dot(f1, ufl.cross(f2, f3)),
    )
    i1 = _trace(first, second, i3)
    i2 = ufl.sqrt(second + 2 * i3 * i1)
    # vectors only: F C v = F F^T F v
    Fv = ufl.dot(F, v)
    FCv = ufl.dot(F, ufl.dot(F.T, Fv))
    return (i1 * ufl.dot(cofactor, v) + (i1**2 - i2) * Fv - FCv) / (i1 * i2 - i3)


def _trace(first: Expr, second: Expr, i3: Expr) -> Expr:
    """Return i1 = tr U from the invariants of C, by Newton's method.

    `first` and `second` are I = tr C and II = tr cof C, and i3 = det F. From i1^2 = I + 2 i2 and
    i2^2 = II + 2 i1 i3 it is the fixed point of x -> sqrt(I + 2 sqrt(II + 2 i3 x)). That map is
    almost linear, with a slope of at most 1/9.
    """
    x = ufl.sqrt(3 * first)
    for _ in range(STEPS):
        i2 = ufl.sqrt(second + 2 * i3 * x)
        image = ufl.sqrt(first + 2 * i2)
        # Newton's step to the fixed point; i3/(i2 image) is the map's slope
        x += (image - x) / (1 - i3 / (i2 * image))
    return x
