"""Incompressible rubber: the energies of a shell at any stretch.

The normal stress is zero and the thickness follows from the area (R. W. Ogden, *Non-linear elastic
deformations*, 1984): with C = a0^-1 a of the surface, t = tr C and d = det C, the stretch of the
thickness is d^(-1/2), and the invariants of the body are I1 = t + 1/d and I2 = d + t/d.

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
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

from magshell_fenicsx.models.shell.law import Components, Koiter, Law, Tensor, lower_index, trace
from magshell_fenicsx.models.strain_energy import Scalar, StrainEnergy, root


class BendingForm(NamedTuple):
    """The energy of bending as a quadratic form in T = a^ij K_ij, tr K and det K.

    Attributes
    ----------
    square, mixed, determinant, trace
        Factors of T^2, -T tr K, -det K and (tr K)^2 in twice the energy, over E h.
    """

    square: Scalar
    mixed: Scalar
    determinant: Scalar
    trace: Scalar


class Incompressible(Law):
    """A law of rubber: stress, moments and energy of bending, from three functions of a subclass.

    These are the energy of stretching (`membrane`), its slopes by T and D (`_slopes`) and the form
    of bending (`_bending_form`).
    """

    @property
    def thins(self) -> Scalar:
        return 1

    @property
    def linear(self) -> Koiter:
        return Koiter(
            self.h,
            0.5,
            thickness_factor=self.thickness_factor,
            modulus_factor=self.modulus_factor,
        )

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
        form = self._bending_form(surface)
        det = K[..., 0, 0] * K[..., 1, 1] - K[..., 0, 1] ** 2
        T, tau = surface.deformed_trace(K), trace(K, up)  # deformed and undeformed trace of K
        return (
            form.square * T**2 - form.mixed * T * tau - form.determinant * det + form.trace * tau**2
        ) / 2

    def moment(self, E: Tensor, K: Tensor, up: Tensor) -> Components:
        """Return M with indices up, the derivative of `bending` by K."""
        surface = Stretched(E, up)
        form = self._bending_form(surface)
        T, tau = surface.deformed_trace(K), trace(K, up)  # deformed and undeformed trace of K
        # derivatives of the energy by both traces
        by_T = form.square * T - form.mixed / 2 * tau
        by_tau = form.trace * tau - form.mixed / 2 * T
        # components 11, 12, 22: derivatives of tau and of det K by K
        a = (up[..., 0, 0], up[..., 0, 1], up[..., 1, 1])
        adjugate = (K[..., 1, 1], -K[..., 0, 1], K[..., 0, 0])
        M11, M12, M22 = (
            by_T * deformed_up + by_tau * metric_up - form.determinant / 2 * curvature_cofactor
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
        form = self._bending_form(surface)
        (c1, c2), (a11, a12, a22) = lower_index(covector_up, up), surface.inverse
        # the deformed trace of c (x) c; the undeformed one is the square of c
        T = a11 * c1**2 + 2 * a12 * c1 * c2 + a22 * c2**2
        return (
            form.square * T**2 - form.mixed * T * covector_square + form.trace * covector_square**2
        )

    @abstractmethod
    def _slopes(self, surface: "Stretched") -> tuple[Scalar, Scalar]:
        """Return the derivatives by T and D of the energy of stretching, per volume over E.

        T = tr C - 2 and D = det(C - 1) are attributes of the surface.
        """

    @abstractmethod
    def _bending_form(self, surface: "Stretched") -> BendingForm:
        """Return the energy of bending at the stretch of a surface; it is positive for every K."""


@dataclass(frozen=True)
class Rubber(Incompressible):
    """The law of rubber whose energy is a function of the invariants I1 and I2.

    Attributes
    ----------
    energy
        The energy per volume.
    """

    energy: StrainEnergy

    @property
    def numbers(self) -> tuple[Any, ...]:
        return self.h, *self.energy.constants

    def with_numbers(self, *numbers: Any) -> Self:
        h, *constants = numbers
        return type(self)(h, replace(self.energy, constants=tuple(constants)))

    def membrane(self, E: Tensor, up: Tensor) -> Scalar:
        surface = Stretched(E, up)
        energy = self.energy.value(surface.first, surface.second)
        return self.modulus_factor * self.thickness_factor * energy

    def _slopes(self, surface: "Stretched") -> tuple[Scalar, Scalar]:
        """Return the derivatives by T and D of the energy, by the chain rule.

        The derivatives of I1 and I2 are found times d = 1 + T + D, which is divided out at the end.
        """
        T, D, d = surface.T, surface.D, surface.d
        energy = self.energy.derivatives(surface.first, surface.second)
        first_by_T, first_by_D = 2 * T + D - surface.first, T - 1 - surface.first
        second_by_T = 2 * (d - 1) - surface.second
        second_by_D = second_by_T - 1
        return (
            (energy.first * first_by_T + energy.second * second_by_T) / d,
            (energy.first * first_by_D + energy.second * second_by_D) / d,
        )

    def _bending_form(self, surface: "Stretched") -> BendingForm:
        """Return the form of bending from W'' of an energy W of I1 and I2.

        By the chain rule, d K:W'':K/4 is the sum of

        - the derivatives of the energy by I1 and I2, times d K:I1'':K/4 = 2 (T^2 - det K/det a) and
          d K:I2'':K/4 = 2 (t T^2 - T tr K - (t - d^2) det K/det a), in which sqrt(d) replaces d^2;
        - its second derivatives, times products of I1':K/2 = tr K - T/d and I2':K/2 = tr K/d + (d -
          t/d) T.

        Here T = a^ij K_ij with the deformed inverse metric a^ij.
        """
        d, trace_of_C = surface.d, 2 + surface.T
        energy = self.energy.derivatives(surface.first, surface.second)
        second_derivatives = energy.first_first, energy.first_second, energy.second_second

        def product(row: tuple[Scalar, Scalar], column: tuple[Scalar, Scalar]) -> Scalar:
            """Return the second derivatives contracted with factors of I1':K/2 and I2':K/2."""
            first_first, first_second, second_second = second_derivatives
            return (
                first_first * row[0] * column[0]
                + first_second * (row[0] * column[1] + row[1] * column[0])
                + second_second * row[1] * column[1]
            )

        # factors of T, then of tr K, in I1':K/2 and I2':K/2
        of_T, of_trace = (-1 / d, d - trace_of_C / d), (1, 1 / d)
        # h^2/(12 d) of the energy of bending, times 4/d
        factor = self.modulus_factor * self.thickness_factor**3 * self.h**2 / (3 * d**2)
        det_factor = energy.first + energy.second * (trace_of_C - root(d))
        return BendingForm(
            factor * (2 * (energy.first + energy.second * trace_of_C) + d * product(of_T, of_T)),
            factor * 2 * (energy.second - d * product(of_T, of_trace)),
            factor * 2 * det_factor * surface.up / d,
            factor * d * product(of_trace, of_trace),
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
