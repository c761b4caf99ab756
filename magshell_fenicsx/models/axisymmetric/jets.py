"""Jets of fields on a surface of revolution at the azimuth theta = 0.

The surface coordinates are (s, theta), s the meridian's parameter; components are along
(e_rho, e_theta, e_z), which turn with theta: e_rho' = e_theta, e_theta' = -e_rho. In this
order a_1 x a_2 points outward where s grows away from the pole.
"""

from collections.abc import Sequence

import ufl
from ufl.core.expr import Expr

from magshell_fenicsx.models.shell.kinematics import Jet


def revolved(f: Expr) -> Jet:
    """Jet of the axisymmetric field f = (U, W), U e_rho + W e_z."""
    return revolved_by(_derivatives(f, 2))


def revolved_by(derivatives: Sequence[Sequence[Expr]]) -> Jet:
    """The same from the components of f, f' and f''."""
    (U, W), (Us, Ws), (Uss, Wss) = derivatives
    return Jet(
        r=_vector(U, 0, W),
        r1=_vector(Us, 0, Ws),
        r2=_vector(0, U, 0),
        r11=_vector(Uss, 0, Wss),
        r12=_vector(0, Us, 0),
        r22=_vector(-U, 0, 0),
    )


def wave(f: Expr, m: Expr) -> tuple[Jet, Jet]:
    """Jets of v = U cos(m theta) e_rho + V sin(m theta) e_theta + W cos(m theta) e_z.

    The unknowns are f = (P, V, W) with P = U + V: on the axis P = 0 for m = 1 (a
    translation has U = -V there), and for every other m all three vanish.

    Returns
    -------
    cosine, sine
        v,_i = cosine_i cos(m theta) + sine_i sin(m theta), and so for all derivatives.
    """
    return wave_by(_derivatives(f, 3), m)


def wave_by(derivatives: Sequence[Sequence[Expr]], m: Expr) -> tuple[Jet, Jet]:
    """The same from the components of f, f' and f''."""
    (U, V, W), (Us, Vs, Ws), (Uss, Vss, Wss) = ((P - V, V, W) for P, V, W in derivatives)
    cosine = Jet(
        r=_vector(U, 0, W),
        r1=_vector(Us, 0, Ws),
        r2=_vector(0, U + m * V, 0),
        r11=_vector(Uss, 0, Wss),
        r12=_vector(0, Us + m * Vs, 0),
        r22=_vector(-(1 + m**2) * U - 2 * m * V, 0, -(m**2) * W),
    )
    sine = Jet(
        r=_vector(0, V, 0),
        r1=_vector(0, Vs, 0),
        r2=_vector(-m * U - V, 0, -m * W),
        r11=_vector(0, Vss, 0),
        r12=_vector(-m * Us - Vs, 0, -m * Ws),
        r22=_vector(0, -2 * m * U - (1 + m**2) * V, 0),
    )
    return cosine, sine


def _derivatives(f: Expr, components: int) -> list[list[Expr]]:
    """Components of f, f' and f''."""
    Df = ufl.grad(f)
    DDf = ufl.grad(Df)
    every = range(components)
    return [[f[i] for i in every], [Df[i, 0] for i in every], [DDf[i, 0, 0] for i in every]]


def _vector(*components: Expr) -> Expr:
    return ufl.as_vector(components)
