"""Ogden's rubber: the energy per volume is sum mu_p/alpha_p (l1^alpha_p + l2^alpha_p + l3^alpha_p -
3).

R. W. Ogden, Proc. R. Soc. Lond. A 326 (1972) 565. Principal stretches have no derivatives where
they are equal, their sum has: with d = det C, t = tr C, a = alpha/2 and 1 + w = t/(2 sqrt(d)) the
squares of both stretches are sqrt(d) exp(+-u) with cosh u = 1 + w, so that

    l1^alpha + l2^alpha = 2 d^(a/2) (1 + V(w)), V = cosh(a u) - 1, w (2 + w) V'' + (1 + w) V' = a^2
    (1 + V),

where V is Chebyshev's function of the order a, less one: a power series in w that is cut off where
w is small.

The energy of bending is that of docs/theory.md, Rubber.

- C = a0^-1 a is the Cauchy-Green tensor of the mid-surface, with the undeformed and the deformed
  metric; l1, l2 and l3 = 1/(l1 l2) are the principal stretches.
- T = tr C - 2 and D = det(C - 1), so that t = 2 + T and d = 1 + T + D: numbers of order one are not
  subtracted.
- K is the change of curvature, whose energy is a quadratic form in a^ij K_ij, tr K and det K.
- Scalars are numbers, arrays or expressions of UFL.

A section is the part of a case with the law's keys.
"""

from dataclasses import dataclass, field
from math import isfinite
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from magshell_fenicsx.models.shell.law import Tensor
from magshell_fenicsx.models.shell.rubber import BendingForm, Incompressible, Stretched
from magshell_fenicsx.models.strain_energy import Scalar, is_expression, root
from magshell_fenicsx.parts.laws.law_section import LawSection
from magshell_fenicsx.platform.lazy_import import lazy_import

if TYPE_CHECKING:
    import ufl
else:
    ufl = lazy_import("ufl")

Exponent = Annotated[float, Field(ge=-20, le=20)]

SERIES_LIMIT, SERIES_TERMS = (
    0.02,
    10,
)  # w below which the series is taken, and its terms: the next is below 1e-20


@dataclass(frozen=True)
class Ogden(Incompressible):
    """Ogden's law.

    Attributes
    ----------
    mu, alpha
        Constants of the terms, mu over E: the sum of mu alpha is 2/3, each mu alpha is positive.
    """

    mu: Any
    alpha: tuple[float, ...] = field(kw_only=True)

    @property
    def terms(self) -> list[tuple[Scalar, float]]:
        """mu and alpha of each term."""
        return [(self.mu[i], alpha) for i, alpha in enumerate(self.alpha)]

    @property
    def softening(self) -> float:
        """Share of the stress in the stiffness of bending, which keeps it positive at any stretch.

        It is zero if all |alpha| are at least 2.
        """
        return max(0.0, 2 - min(abs(alpha) for alpha in self.alpha))

    def membrane(self, E: Tensor, up: Tensor) -> Scalar:
        """Return the energy of stretching over E h, without differences of numbers of order one.

        For each term it is mu/alpha (l1^alpha + l2^alpha + l3^alpha - 3), by z = d^(alpha/4).
        """
        surface, total = Stretched(E, up), 0.0  # the invariants T, D and d of the strain
        for mu, alpha in self.terms:
            z = surface.d ** (alpha / 4)
            V, _, _ = _chebyshev(alpha / 2, w=_uneven(surface))
            # 2 z (1 + V) + 1/z² - 3, rearranged
            total = total + mu / alpha * ((z - 1) ** 2 * (2 * z + 1) / z**2 + 2 * z * V)
        return self.modulus_factor * self.thickness_factor * total

    def _slopes(self, surface: Stretched) -> tuple[Scalar, Scalar]:
        """Return the derivatives of the energy of stretching by T and D.

        As t = 2 + T and d = 1 + T + D, they are W_t + W_d and W_d.
        """
        w, by_t, by_d = _uneven(surface), 0.0, 0.0
        for mu, alpha in self.terms:
            a = alpha / 2
            V, V1, _ = _chebyshev(a, w)
            by_t = by_t + mu / alpha * surface.d ** ((a - 1) / 2) * V1
            by_d = by_d + mu / alpha / surface.d * (
                surface.d ** (a / 2) * (a * (1 + V) - (1 + w) * V1) - a * surface.d**-a
            )
        return by_t + by_d, by_d

    def _bending_form(self, surface: Stretched) -> BendingForm:
        """Return the form of bending, by second derivatives of the energy of stretching.

        They are those by t and d, as derived in docs/theory.md, Rubber.
        """
        w, softening = _uneven(surface), self.softening
        y = 1 + w
        # sums over the terms; `equibiaxial` is the stiffness to bending in all directions
        square_factor, mixed_factor, trace_factor, equibiaxial = 0.0, 0.0, 0.0, 0.0
        for mu, alpha in self.terms:
            a = alpha / 2
            V, V1, V2 = _chebyshev(a, w)
            z, m = surface.d ** (a / 2), mu / alpha
            # first derivative by d and second one by d and t, but for factors
            by_d, by_both = a * (1 + V) - y * V1, (a - 1) * V1 - y * V2
            trace_factor = trace_factor + 2 * m * z * V2
            mixed_factor = mixed_factor + m * z * (4 * by_both + 2 * softening * V1)
            in_surface = (2 * a - 4 + 2 * softening) * by_d - 2 * y * by_both
            square_factor = square_factor + m * (
                z * in_surface + (4 * a * (a + 1) - 2 * a * softening) / z**2
            )
            equibiaxial = equibiaxial + 4 * a * m * (
                (a - 1 + softening / 2) * z + (a + 1 - softening / 2) / z**2
            )
        # the factor of det K from the stiffness to bending in one direction and in all directions;
        # below, surface.up is the determinant of the undeformed inverse metric
        uniaxial = trace_factor + y * mixed_factor + square_factor
        det_factor = 2 * uniaxial**2 / (uniaxial + equibiaxial)
        factor = self.modulus_factor * self.thickness_factor**3 * self.h**2 / (12 * surface.d)
        s = root(surface.d)
        return BendingForm(
            factor * square_factor,
            -factor * mixed_factor / s,
            factor * det_factor * surface.up / surface.d,
            factor * trace_factor / surface.d,
        )


class OgdenSection(LawSection):
    """Ogden's rubber, whose energy is a sum of powers of the principal stretches."""

    law: Literal["ogden"]
    mu: list[float] = Field(min_length=1, max_length=6)
    """Of law: ogden, the modulus of each term (neo-Hookean takes youngs_modulus E = 3 mu); the
    energy of a term is mu/alpha (λ1^alpha + λ2^alpha + λ3^alpha - 3). Only their ratios count, for
    E = 3/2 (mu1 alpha1 + mu2 alpha2 + ...)"""
    alpha: list[Exponent] = Field(min_length=1, max_length=6)
    """Of law: ogden, the exponent of each term, with the sign of its mu"""

    title: ClassVar[str] = "Ogden"
    keys_text: ClassVar[str] = "lists, one as long as the other, of law: ogden alone"

    @model_validator(mode="after")
    def _energy_is_positive(self) -> Self:
        """Refuse a modulus that does not have the sign of its exponent."""
        for i, (modulus, exponent) in enumerate(zip(self.mu, self.alpha, strict=True)):
            if not (isfinite(modulus) and modulus * exponent > 0):
                raise ValueError(
                    f"mu.{i}: {modulus:g}: mu alpha must be positive; here alpha is {exponent:g}"
                )
        return self

    def elastic_law(self, h: float, nu: float) -> Ogden:
        return Ogden(h, self._mu_over_E, alpha=tuple(self.alpha))

    @property
    def numbers_text(self) -> str:
        terms = zip(self._mu_over_E, self.alpha, strict=True)
        terms_text = ", ".join(f"{mu:.5g} and {alpha:g}" for mu, alpha in terms)
        return f"mu/E and alpha: {terms_text}"

    @property
    def _mu_over_E(self) -> tuple[float, ...]:
        modulus = 3 / 2 * sum(mu * alpha for mu, alpha in zip(self.mu, self.alpha, strict=True))
        return tuple(mu / modulus for mu in self.mu)


def _uneven(surface: Stretched) -> Scalar:
    """Return w = t/(2 sqrt(d)) - 1: zero if both principal stretches are equal.

    It is computed as (t^2/4 - d)/(sqrt(d) (t/2 + sqrt(d))), without a difference of numbers of
    order one.
    """
    s = root(surface.d)
    return (surface.T**2 / 4 - surface.D) / (s * (1 + surface.T / 2 + s))


def _chebyshev(a: float, w: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Return V(w) = cosh(a u) - 1, with cosh u = 1 + w, and its first two derivatives by w.

    A power series is used for w below `SERIES_LIMIT`; if a is a small integer it ends, and holds
    for all w. Otherwise V follows from p = exp(a u).
    """
    # the differential equation of V gives each coefficient from the one before
    coefficients = [0.0, a**2]
    for k in range(1, SERIES_TERMS):
        coefficients.append(coefficients[-1] * (a**2 - k**2) / ((2 * k + 1) * (k + 1)))
    # V and its derivatives by the series
    series = list[Scalar]()
    for n in range(3):
        derivative = np.polynomial.polynomial.polyder(coefficients, n)
        series.append(_horner([float(coefficient) for coefficient in derivative], w))
    if a == int(a) and abs(a) <= SERIES_TERMS:  # a polynomial
        return series[0], series[1], series[2]
    in_series = ufl.lt(w, SERIES_LIMIT) if is_expression(w) else np.real(w) < SERIES_LIMIT
    # in the series' range the other branch is evaluated too: it must not divide by zero
    bounded_w = _conditional(in_series, SERIES_LIMIT, w)
    # V and its derivatives by p = exp(a u), where cosh u = y
    y = 1 + bounded_w
    p = (y + root(bounded_w * (2 + bounded_w))) ** a
    V = (p + 1 / p) / 2 - 1
    V1 = a * (p - 1 / p) / (2 * root(bounded_w * (2 + bounded_w)))
    V2 = (a**2 * (1 + V) - y * V1) / (bounded_w * (2 + bounded_w))
    value, slope, second = (
        _conditional(in_series, series_value, f)
        for series_value, f in zip(series, (V, V1, V2), strict=True)
    )
    return value, slope, second


def _horner(c: list[float], w: Scalar) -> Scalar:
    """Return the polynomial with coefficients c, of ascending powers, at w."""
    total: Scalar = float(c[-1])
    for coefficient in reversed(c[:-1]):
        total = total * w + float(coefficient)
    return total


def _conditional(condition: Any, if_true: Scalar, if_false: Scalar) -> Scalar:
    if is_expression(condition):
        return ufl.conditional(condition, if_true, if_false)
    return np.where(condition, if_true, if_false)
