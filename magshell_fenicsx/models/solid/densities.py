"""Energy densities of the solid as plain functions of point quantities: the one source of its physics.

Over E, with lengths in R; divided by h/R they are in the shell's unit E h R^2. X is the undeformed place,
u the displacement and H its gradient by X; F = 1 + H.
"""

import ufl
from ufl.core.expr import Expr


def distortion(X: Expr, u: Expr, H: Expr, shear: Expr, h: Expr) -> Expr:
    """mu/2 (J^(-2/3) F:F - 3): what does not depend on a change of volume."""
    F = ufl.Identity(3) + H
    return shear / (2 * h) * (ufl.det(F) ** (-2 / 3) * ufl.inner(F, F) - 3)


def compression(X: Expr, u: Expr, H: Expr, bulk: Expr, h: Expr) -> Expr:
    """kappa/2 (J - 1)^2."""
    return bulk / (2 * h) * (ufl.det(ufl.Identity(3) + H) - 1) ** 2


def magnetic(X: Expr, u: Expr, H: Expr, Br: Expr, Ba: Expr, h: Expr) -> Expr:
    """-Ba . (F - 1) Br, paper Eq. (eq:mage) without its constant: a dead load."""
    return -ufl.dot(Ba, ufl.dot(H, Br)) / h


def magnetic_gradient(X: Expr, u: Expr, H: Expr, Br: Expr, G: Expr, h: Expr) -> Expr:
    """The part of Ba = G x: -(G x) . F Br at the deformed place x = X + u, without its value at u = 0."""
    F = ufl.Identity(3) + H
    return -(ufl.dot(ufl.dot(G, X + u), ufl.dot(F, Br)) - ufl.dot(ufl.dot(G, X), Br)) / h


def enclosed(x: Expr, x1: Expr, x2: Expr) -> Expr:
    """x . n da/3 under a face, per area of its coordinates: with flat ends through the origin the volume."""
    return ufl.dot(x, ufl.cross(x1, x2)) / 3


def pressure(X: Expr, X1: Expr, X2: Expr, u: Expr, u1: Expr, u2: Expr, unit: Expr, origin: Expr | None = None) -> Expr:
    """Pi/p of a live pressure in that unit: the change of the volume between the outer face and an origin."""
    X = X if origin is None else X - origin
    return unit * (enclosed(X + u, X1 + u1, X2 + u2) - enclosed(X, X1, X2))
