"""Incompressible rubber: the energies of a neo-Hookean or Mooney-Rivlin shell at any stretch.

The energy per volume is C10 (I1 - 3) + C01 (I2 - 3), E = 6 (C10 + C01). The normal stress is zero
and the thickness follows from the area (R. W. Ogden, *Non-linear elastic deformations*, 1984): with
C = a0^-1 a of the surface, t = tr C and d = det C, the stretch of the thickness is d^(-1/2), I1 = t
+ 1/d and I2 = d + t/d.

A layer at the height z over the middle has the strain E - d^(-1/2) z K, so that the energy of
bending is

    h^2/(24 d) K : W''(E) : K.

Of W'' a part that multiplies det K is changed by a factor that is 1 without stretch; see
docs/theory.md, Rubber.

- E is the membrane strain, K the change of curvature, W the energy of stretching. `up` is the
  inverse metric of the shape without stress, a0^-1; a is the deformed metric.
- Numbers of order one are not subtracted: T = tr C - 2 and D = det(C - 1) stand for t and d, as t =
  2 + T and d = 1 + T + D.
- The energy of bending is a quadratic form in a^ij K_ij (deformed trace), tr K (undeformed trace)
  and det K.
- A covector c (2,) at an edge is its unit conormal.
- The factors of modulus and thickness, which multiply energies and stresses, are those of shells
  whose material or thickness varies.
- Tensors are arrays or expressions with two last indices; components are the numbers 11, 12, 22.
  The adjugate of S has the components S22, -S12, S11; it is the derivative of det S.
"""

from abc import abstractmethod
from dataclasses import dataclass

import ufl
from ufl.core.expr import Expr

from magshell_fenicsx.models.shell.law import (
    Components,
    Koiter,
    Law,
    Scalar,
    Tensor,
    lower_index,
    trace,
)


class Incompressible(Law):
    """A law of rubber: stress, moments and energy of bending, from three functions of a subclass.

    These are the energy of stretching (`membrane`), its slopes by T and D (`_slopes`) and the four
    factors in the energy of bending (`_stiffness`).
    """

    @property
    def thins(self) -> Scalar:
        return 1

    @property
    def linear(self) -> Koiter:
        return Koiter(self.h, 0.5, self.thickness_factor, self.modulus_factor)

    def stress(self, E: Tensor, up: Tensor) -> Components:
        """Return S with indices up, by the energy's slopes in T = tr C - 2 and D = det(C - 1).

        T has the derivative 2 a0^ij by E_ij, D has 4 det(up) times the adjugate of E.
        """
        surface = Stretched(E, up)
        # derivatives of the energy of stretching by T and by D
        by_T, by_D = (
            self.modulus_factor * self.thickness_factor * slope for slope in self._slopes(surface)
        )
        adjugate = E[..., 1, 1], -E[..., 0, 1], E[..., 0, 0]
        a = up[..., 0, 0], up[..., 0, 1], up[..., 1, 1]
        S11, S12, S22 = (
            2 * by_T * metric_up + 4 * by_D * surface.up * strain_cofactor
            for metric_up, strain_cofactor in zip(a, adjugate, strict=True)
        )
        return S11, S12, S22

    def bending(self, E: Tensor, K: Tensor, up: Tensor) -> Scalar:
        """Return the energy of bending, a quadratic form in a^ij K_ij, tr K and det K."""
        surface = Stretched(E, up)
        # factors of T², -T tau, -det K and tau² in twice the energy
        square_factor, mixed_factor, det_factor, trace_factor = self._stiffness(surface)
        det = K[..., 0, 0] * K[..., 1, 1] - K[..., 0, 1] ** 2
        T, tau = surface.deformed_trace(K), trace(K, up)  # deformed and undeformed trace of K
        return (
            square_factor * T**2 - mixed_factor * T * tau - det_factor * det + trace_factor * tau**2
        ) / 2

    def moment(self, E: Tensor, K: Tensor, up: Tensor) -> Components:
        """Return M with indices up, the derivative of `bending` by K."""
        surface = Stretched(E, up)
        # factors of T², -T tau, -det K and tau² in twice the energy
        square_factor, mixed_factor, det_factor, trace_factor = self._stiffness(surface)
        T, tau = surface.deformed_trace(K), trace(K, up)  # deformed and undeformed trace of K
        # derivatives of the energy by both traces
        by_T = square_factor * T - mixed_factor / 2 * tau
        by_tau = trace_factor * tau - mixed_factor / 2 * T
        # components 11, 12, 22: derivatives of tau and of det K by K
        a = (up[..., 0, 0], up[..., 0, 1], up[..., 1, 1])
        adjugate = (K[..., 1, 1], -K[..., 0, 1], K[..., 0, 0])
        M11, M12, M22 = (
            by_T * deformed_up + by_tau * metric_up - det_factor / 2 * curvature_cofactor
            for deformed_up, metric_up, curvature_cofactor in zip(
                surface.inverse, a, adjugate, strict=True
            )
        )
        return M11, M12, M22

    def edge_moment(
        self,
        E: Tensor,
        K: Tensor,
        up: Tensor,
        covector_up: tuple[Scalar, Scalar],
        covector_square: Scalar,
    ) -> Scalar:
        """Return M^ij c_i c_j, the moment contracted twice with a covector c.

        `covector_up` are the components c^i; `covector_square` is not used.
        """
        M, (c1, c2) = self.moment(E, K, up), lower_index(covector_up, up)
        return M[0] * c1**2 + 2 * M[1] * c1 * c2 + M[2] * c2**2

    def edge_stiffness(
        self, E: Tensor, up: Tensor, covector_up: tuple[Scalar, Scalar], covector_square: Scalar
    ) -> Scalar:
        """Return the second derivative of `bending` along K = c (x) c, for a covector c.

        The determinant of c (x) c is zero, so that its factor is not needed.
        """
        surface = Stretched(E, up)
        # factors of T², -T tau and tau² in twice the energy
        square_factor, mixed_factor, _, trace_factor = self._stiffness(surface)
        (c1, c2), (a11, a12, a22) = lower_index(covector_up, up), surface.inverse
        # the deformed trace of c (x) c; the undeformed one is the square of c
        T = a11 * c1**2 + 2 * a12 * c1 * c2 + a22 * c2**2
        return (
            square_factor * T**2
            - mixed_factor * T * covector_square
            + trace_factor * covector_square**2
        )

    @abstractmethod
    def _slopes(self, surface: "Stretched") -> tuple[Scalar, Scalar]:
        """Return the derivatives by T and D of the energy of stretching, per volume over E.

        T = tr C - 2 and D = det(C - 1) are attributes of the surface.
        """

    @abstractmethod
    def _stiffness(self, surface: "Stretched") -> tuple[Scalar, Scalar, Scalar, Scalar]:
        """Return the factors in twice the energy of bending, over E h per undeformed area.

        They belong to T^2, -T tr K, -det K and (tr K)^2, in this order. Here T = a^ij K_ij with the
        deformed inverse metric a^ij.
        """


@dataclass(frozen=True)
class Rubber(Incompressible):
    """The law of Mooney and Rivlin; its parameter is C01/(C10 + C01), 0 for neo-Hooke."""

    def membrane(self, E: Tensor, up: Tensor) -> Scalar:
        """Return ((1 - s)(I1 - 3) + s (I2 - 3))/6 with s = C01/(C10 + C01), the law's parameter.

        It is multiplied by the factors of modulus and thickness.
        """
        surface = Stretched(E, up)
        return (
            self.modulus_factor
            * self.thickness_factor
            / 6
            * ((1 - self.parameter) * surface.first + self.parameter * surface.second)
        )

    def _slopes(self, surface: "Stretched") -> tuple[Scalar, Scalar]:
        """Return the derivatives by T and D of ((1 - s)(I1 - 3) + s (I2 - 3))/6.

        The slopes of I1 and I2 are found times d = 1 + T + D, which is divided out at the end.
        """
        # pairs: times d the derivatives by T and D of I1, then of I2
        first_slopes = 2 * surface.T + surface.D - surface.first, surface.T - 1 - surface.first
        second_slopes = (
            2 * (surface.d - 1) - surface.second,
            2 * (surface.d - 1) - 1 - surface.second,
        )
        by_T, by_D = (
            ((1 - self.parameter) * first_slope + self.parameter * second_slope) / (6 * surface.d)
            for first_slope, second_slope in zip(first_slopes, second_slopes, strict=True)
        )
        return by_T, by_D

    def _stiffness(self, surface: "Stretched") -> tuple[Scalar, Scalar, Scalar, Scalar]:
        """Return factors of T², -T tr K, -det K and (tr K)² in twice the energy of bending.

        Here T = a^ij K_ij with the deformed inverse metric a^ij.
        """
        # h^2/(12 d) of the energy of bending, times 4/6 and 1/d of W''
        factor = self.modulus_factor * self.thickness_factor**3 * self.h**2 / 18 / surface.d**2
        first_share, second_share, trace_of_C = 1 - self.parameter, self.parameter, 2 + surface.T
        # the part of W'' that multiplies det K is changed: W'' itself has d^2 in place of the root
        det_factor = first_share + second_share * (trace_of_C - root(surface.d))
        return (
            factor * 2 * (first_share + second_share * trace_of_C),
            factor * 2 * second_share,
            factor * 2 * det_factor * surface.up / surface.d,
            0,
        )


class Stretched:
    """The invariants of C = up a for a membrane strain E, with the deformed metric a.

    Attributes
    ----------
    T, D, d
        tr C - 2, det(C - 1) and det C = 1 + T + D.
    first, second
        I1 - 3 and I2 - 3, in which no numbers of order one are subtracted.
    up
        The determinant of the undeformed inverse metric.
    inverse
        Components 11, 12, 22 of the inverse of the deformed metric.
    """

    def __init__(self, E: Tensor, up: Tensor) -> None:
        """Compute the invariants from E, with indices down, and the undeformed inverse metric."""
        E11, E12, E22 = E[..., 0, 0], E[..., 0, 1], E[..., 1, 1]
        a11, a12, a22 = up[..., 0, 0], up[..., 0, 1], up[..., 1, 1]
        self.up = a11 * a22 - a12**2
        self.T, self.D = 2 * trace(E, up), 4 * self.up * (E11 * E22 - E12**2)
        area = self.T + self.D  # d - 1
        self.d = 1 + area
        self.first = (self.T**2 + self.T * self.D - self.D) / self.d
        self.second = (area**2 - self.D) / self.d
        twice = 2 * self.up
        self.inverse: Components = (
            (a11 + twice * E22) / self.d,
            (a12 - twice * E12) / self.d,
            (a22 + twice * E11) / self.d,
        )

    def deformed_trace(self, K: Tensor) -> Scalar:
        """Return a^ij K_ij with the inverse of the deformed metric."""
        a11, a12, a22 = self.inverse
        return a11 * K[..., 0, 0] + 2 * a12 * K[..., 0, 1] + a22 * K[..., 1, 1]


def root(x: Scalar) -> Scalar:
    """Return the square root of an expression, a number or an array."""
    return ufl.sqrt(x) if isinstance(x, Expr) else x**0.5
