"""The profile of a live pressure: a polynomial of the deformed place that multiplies it.

A pressure p f(x), with a function f of the place x alone, does the virtual work p f n . v da, as
that of a fluid at rest does whose depth f measures. It is the variation of p times the integral of
f over the volume that the surface sweeps (`PressureProfile.swept_integral`). Points move straight,
so the integral over the time of the motion is exact for a polynomial: nothing depends on the way.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.legendre import leggauss

from magshell_fenicsx.input.expressions import FUNCTIONS, symbolic
from magshell_fenicsx.mesh.mirror import ROUNDING, rotation
from magshell_fenicsx.models.shell import densities
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.own_term import OwnTerm, symbolic_functions
from magshell_fenicsx.platform.lazy_import import lazy_import

if TYPE_CHECKING:
    import ufl
    from ufl.core.expr import Expr
else:
    ufl = lazy_import("ufl")

MAX_DEGREE = 8  # of a profile: quadrature on the surface resolves no more
GENERIC_LINE = ((0.31, 0.57), (-0.43, 0.71), (0.23, -0.83))  # begin and slope of x, y, z


def polynomial_degree(text: str) -> int | None:
    """Return the degree of a formula of x, y, z; None if it is no polynomial, -1 if it is zero.

    The formula is expanded along a line that is parallel to nothing special.
    """
    line = [Polynomial(coordinate) for coordinate in GENERIC_LINE]
    try:  # polynomials of NumPy have no quotients, roots or other functions
        value = Polynomial([0.0]) + symbolic(text, FUNCTIONS, *line)
    except (TypeError, ValueError):
        return None
    value = value.trim(ROUNDING * float(np.abs(value.coef).max()))
    return int(value.degree()) if value.coef.any() else -1


@dataclass(frozen=True)
class PressureProfile:
    """A polynomial of the deformed place over R, by which a live pressure is multiplied.

    Attributes
    ----------
    text
        Formula of x, y, z in the case's frame.
    turn
        Azimuth of the model's frame (rad), in which places are.
    """

    text: str
    turn: float = 0.0

    def value(self, x: "Expr") -> "Expr":
        """Return the profile at a place x (3,) over R in the model's frame, as a UFL scalar."""
        Q = rotation(self.turn) if self.turn else np.eye(3)
        place = [sum(float(Q[j, i]) * x[j] for j in range(3) if Q[j, i]) for i in range(3)]
        return ufl.as_ufl(symbolic(self.text, symbolic_functions(), *place))

    def swept_integral(self, r0: Jet, u: Jet, unit: "Expr | float" = 1.0) -> "Expr":
        """Return the integral of the profile over the volume that the surface sweeps, times `unit`.

        Points move straight from r0 to r0 + u. It is per area of the coordinates, as
        `densities.swept_volume`, which it is for a profile of one.
        """
        degree = polynomial_degree(self.text)
        if not degree:  # a number
            return self.value(r0.r) * densities.swept_volume(r0, u, unit)
        # on the way the area vector is quadratic, the profile of its degree; Gauss's rule with n
        # points is exact up to the degree 2n - 1
        count = degree // 2 + 2
        total = 0
        for node, weight in zip(*leggauss(count), strict=True):
            time, share = float(node + 1) / 2, float(weight) / 2
            area_vector = ufl.cross(r0.r1 + time * u.r1, r0.r2 + time * u.r2)
            total += share * self.value(r0.r + time * u.r) * ufl.dot(u.r, area_vector)
        return unit * total

    def work(self, r0: Jet, u: Jet, v: Jet, unit: "Expr | float" = 1.0) -> "Expr":
        """Return the virtual work along v, per area of the coordinates, times `unit`."""
        r = r0 + u
        return unit * self.value(r.r) * ufl.dot(v.r, kin.area_vector(r))

    def energy_term(self, name: str) -> OwnTerm:
        """Return the swept integral as an energy, which knows its symmetries."""

        def density(r0: Jet, u: Jet) -> "Expr":  # per undeformed area
            return self.swept_integral(r0, u) / kin.area_ratio(r0)

        return OwnTerm(name, density)
