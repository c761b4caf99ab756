"""Energies of a solid of compressible rubber at points.

Energies are over E, with lengths in R; divided by h/R they are in the shell's unit E h R^2. X is
the undeformed place, u the displacement and H its gradient by X; F = 1 + H. At an end, the face
above an edge of the mid-surface, n is the undeformed outward normal of the mid-surface and t the
edge's tangent, which has the surface on its left.

- J = det F is the ratio of volumes; I1 and I2 are invariants of F^T F.
- A growth G is the deformation of a part of the body without stress: only F G^(-1) is elastic. It
  has the energy of the grown volume, so times det G.
- Br and Ba are the remanence and the applied flux density over their magnitudes.
- Pi is an energy, p a pressure, da an element of area. X1, X2 and u1, u2 are derivatives by the two
  coordinates of a face, on which n is its normal.
- `unit` is a factor that turns a volume over R³ into the unit of energies.
"""

from collections.abc import Callable
from dataclasses import dataclass

import ufl
from ufl.core.expr import Expr

from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.densities import field_at_displacement
from magshell_fenicsx.models.strain_energy import StrainEnergy


def distortion(
    X: Expr,
    u: Expr,
    H: Expr,
    shear: Expr,
    h: Expr,
    *constants: Expr,
    energy: Callable[..., Expr],
    growth: Expr | None = None,
) -> Expr:
    """3 mu W(J^(-2/3) I1 - 3, J^(-4/3) I2 - 3)/h: the energy of distortion.

    It has no part of a change of volume. W is the `energy` of incompressible rubber over its
    Young's modulus, 3 mu, a function of the invariants and of `constants`; `shear` is mu over E.
    With a `growth` G, F G^(-1) takes the place of F, and the energy is times det G.
    """
    F = ufl.Identity(3) + H
    if growth is not None:  # the same density, for H + 1 = F G^(-1)
        elastic_gradient = ufl.dot(F, ufl.inv(growth)) - ufl.Identity(3)
        return ufl.det(growth) * distortion(
            X, u, elastic_gradient, shear, h, *constants, energy=energy
        )
    J, C = ufl.det(F), ufl.dot(F.T, F)
    first = J ** (-2 / 3) * ufl.inner(F, F) - 3
    second = J ** (-4 / 3) * (ufl.tr(C) ** 2 - ufl.inner(C, C)) / 2 - 3
    return shear / (2 * h) * (6 * energy(first, second, *constants))


def compression(X: Expr, u: Expr, H: Expr, bulk: Expr, h: Expr, growth: Expr | None = None) -> Expr:
    """kappa/2 (J - 1)^2/h, with kappa = `bulk` over E.

    After a `growth` G, J/det G takes the place of J, and the energy is times det G.
    """
    J = ufl.det(ufl.Identity(3) + H)
    if growth is not None:
        return ufl.det(growth) * bulk / (2 * h) * (J / ufl.det(growth) - 1) ** 2
    return bulk / (2 * h) * (J - 1) ** 2


def magnetic(X: Expr, u: Expr, H: Expr, Br: Expr, Ba: Expr, h: Expr) -> Expr:
    """-Ba . (F - 1) Br/h, paper Eq. (eq:mage) without its constant: a dead load."""
    return -ufl.dot(Ba, ufl.dot(H, Br)) / h


def magnetic_gradient(X: Expr, u: Expr, H: Expr, Br: Expr, G: Expr, h: Expr) -> Expr:
    """Magnetic density in the part Ba = G x of the field, at the deformed place x = X + u.

    G is the field's gradient, constant in space. The density is -(G x) . F Br/h without its value
    at u = 0, which is a constant.
    """
    F = ufl.Identity(3) + H
    return -(ufl.dot(ufl.dot(G, X + u), ufl.dot(F, Br)) - ufl.dot(ufl.dot(G, X), Br)) / h


def magnetic_in_space(X: Expr, u: Expr, H: Expr, Br: Expr, P: Expr, h: Expr) -> Expr:
    """Magnetic density in a field known by values, without its value at u = 0.

    P are the coefficients of the field's polynomial at the point. It gives the field B at the place
    X + u, and the change of the field from X to X + u.
    """
    B, change = field_at_displacement(P, u)
    return magnetic(X, u, H, Br, B, h) - ufl.dot(change, Br) / h


def enclosed(x: Expr, x1: Expr, x2: Expr) -> Expr:
    """x . n da/3 of a face, per area of its coordinates, from its place x and tangents x1, x2.

    It is the volume of a cone from the origin to the element of the face. So the integral is the
    volume between the face and the origin; it is all of a body whose other faces are flat and go
    through the origin.
    """
    return ufl.dot(x, ufl.cross(x1, x2)) / 3


def pressure(
    X: Expr, X1: Expr, X2: Expr, u: Expr, u1: Expr, u2: Expr, unit: Expr, origin: Expr | None = None
) -> Expr:
    """Pi/p of a live pressure, times `unit`: the change of volume between a face and an origin.

    It is per area of the face's coordinates, by which X1, X2, u1 and u2 are derivatives. `origin`
    is a place, by default the origin of X.
    """
    X = X if origin is None else X - origin
    return unit * (enclosed(X + u, X1 + u1, X2 + u2) - enclosed(X, X1, X2))


def swept_volume(
    X: Expr, X1: Expr, X2: Expr, u: Expr, u1: Expr, u2: Expr, unit: Expr | float = 1.0
) -> Expr:
    """Volume that a face sweeps, times `unit`, per area of its coordinates.

    The points of the face move straight from X to X + u. The volume is u times the mean area vector
    on this way.
    """
    mean = ufl.cross(X1, X2) + (ufl.cross(X1, u2) + ufl.cross(u1, X2)) / 2 + ufl.cross(u1, u2) / 3
    return unit * ufl.dot(u, mean)


def follower_pressure_work(
    X: Expr, X1: Expr, X2: Expr, u: Expr, u1: Expr, u2: Expr, v: Expr, unit: Expr
) -> Expr:
    """v . n da: the virtual work of p = 1 along v, times `unit`, per area of the coordinates."""
    return unit * ufl.dot(v, ufl.cross(X1 + u1, X2 + u2))


def sealing(
    X: Expr, u: Expr, H: Expr, n: Expr, t: Expr, unit: Expr, origin: Expr | None = None
) -> Expr:
    """Pi/p of a live pressure on a part of an end, times `unit`, per undeformed area.

    It is `pressure` with the tangents t and n of the end, along which H has the derivatives of u.
    """
    return pressure(X, t, n, u, ufl.dot(H, t), ufl.dot(H, n), unit, origin)


def swept_volume_on_end(X: Expr, u: Expr, H: Expr, n: Expr, t: Expr, unit: Expr) -> Expr:
    """Volume that a part of an end sweeps, times `unit`, per undeformed area.

    It is `swept_volume` with the tangents t and n of the end.
    """
    return swept_volume(X, t, n, u, ufl.dot(H, t), ufl.dot(H, n), unit)


def follower_pressure_work_on_end(
    X: Expr, u: Expr, H: Expr, n: Expr, t: Expr, v: Expr, unit: Expr
) -> Expr:
    """Virtual work of p = 1 along v on a part of an end, times `unit`, per undeformed area.

    It is `follower_pressure_work` with the tangents t and n of the end.
    """
    return follower_pressure_work(X, t, n, u, ufl.dot(H, t), ufl.dot(H, n), v, unit)


def turning(
    X: Expr, u: Expr, H: Expr, n: Expr, t: Expr, weight: Expr, intensity: Expr, reference_turn: Expr
) -> Expr:
    """Potential of a moment per length about t on an end: -intensity times a mean angle.

    It is the angle of material lines along n, averaged over the thickness with the `weight` (1,)
    3/2 (1 - 4 z^2/h^2)/h. So its forces are at first a traction linear in z. `reference_turn` (2,)
    has cosine and sine of the turn from which the angle is counted, so that it may grow beyond pi.
    X and u are not used.
    """
    line = n + ufl.dot(H, n)
    sine, cosine = ufl.dot(ufl.cross(n, line), t), ufl.dot(n, line)
    return -intensity * weight[0] * kin.angle_from(sine, cosine, reference_turn)


@dataclass(frozen=True)
class CompressibleRubber:
    """Rubber with the energy 3 mu W(J^(-2/3) I1 - 3, J^(-4/3) I2 - 3) + kappa/2 (J - 1)^2.

    Neo-Hookean, W = (I1 - 3)/6, it is the law of Zhao et al. (J. Mech. Phys. Solids 124, 2019),
    whose elements the paper takes.

    Attributes
    ----------
    energy
        W, the energy of incompressible rubber over its Young's modulus.
    shear, bulk
        mu and kappa, over Young's modulus.

    Examples
    --------
    >>> W = StrainEnergy(lambda first, second: first / 6)
    >>> material = CompressibleRubber.from_poisson_ratio(W, 0.0, 100.0)
    >>> material.shear, material.bulk
    (0.5, 0.3333333333333333)
    >>> rubber = CompressibleRubber.from_poisson_ratio(W, 0.5, 100.0)
    >>> round(rubber.bulk / rubber.shear, 9), round(rubber.youngs_modulus, 5), round(rubber.nu, 5)
    (100.0, 0.99668, 0.49502)
    """

    energy: StrainEnergy
    shear: float
    bulk: float

    @classmethod
    def from_poisson_ratio(
        cls, energy: StrainEnergy, nu: float, bulk_to_shear: float
    ) -> "CompressibleRubber":
        """Return the law with Young's modulus 1 and Poisson's ratio `nu` at small strains.

        For nu = 0.5 the bulk modulus would be infinite. In its place it is `bulk_to_shear` times
        the shear modulus of the incompressible solid, 1/3. Young's modulus is then less than 1 by
        about 1/(3 bulk_to_shear), and nu less than 1/2 by about 1/(2 bulk_to_shear).
        """
        shear = 1 / (2 * (1 + nu))
        return cls(energy, shear, bulk_to_shear * shear if nu == 0.5 else 1 / (3 * (1 - 2 * nu)))

    @property
    def youngs_modulus(self) -> float:
        """Young's modulus at small strains."""
        return 9 * self.bulk * self.shear / (3 * self.bulk + self.shear)

    @property
    def nu(self) -> float:
        """Poisson's ratio for small strains."""
        return (3 * self.bulk - 2 * self.shear) / (2 * (3 * self.bulk + self.shear))
