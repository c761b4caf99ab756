"""The keys of a shell that choose its law: small strains, or rubber of three kinds.

Each law says what it is not for, and its line of `magshell check`. An offer is a property of a
case that other parts may need; a law withdraws those that it does not allow. C10 and C01 are
constants of Mooney and Rivlin; mu and alpha the modulus and exponent of each term of Ogden's law,
with 3/2 sum(mu alpha) = E, Young's modulus.
"""

from dataclasses import dataclass
from math import isfinite
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.input.section import Rubberlike, Section
from magshell_fenicsx.parts.ability import Ability, Context, Offer

Exponent = Annotated[float, Field(ge=-20, le=20)]


class LawKeys(Section):
    """The keys of a shell that choose its law."""

    law: Literal["koiter", "neo-hookean", "mooney-rivlin", "ogden"] = "koiter"
    """Koiter's for small strains; the others for rubber, incompressible at any stretch, with E = 6
    (C10 + C01)"""
    mooney: float | None = Field(default=None, ge=0, le=1000)
    """C01/C10 of law: mooney-rivlin"""
    mu: list[float] | None = Field(default=None, min_length=1, max_length=6)
    """Of law: ogden, of each term of its energy mu/alpha (λ1^alpha + λ2^alpha + λ3^alpha - 3); only
    their ratios count, for E = 3/2 (mu1 alpha1 + mu2 alpha2 + ...)"""
    alpha: list[Exponent] | None = Field(default=None, min_length=1, max_length=6)
    """Of law: ogden, the exponent of each term, with the sign of its mu"""

    @model_validator(mode="after")
    def _law_fits(self) -> Self:
        """Check that keys of a law go with this law alone, and that rubber is incompressible."""
        if (self.mooney is not None) != (self.law == "mooney-rivlin"):
            raise ValueError(
                "mooney: C01/C10 belongs to law: mooney-rivlin, and only to it; here the law is "
                f"{self.law}"
            )
        ogden, mu, alpha = self.law == "ogden", self.mu or [], self.alpha or []
        if bool(mu) != ogden or len(mu) != len(alpha):
            raise ValueError(
                "mu, alpha: lists, one as long as the other, of law: ogden alone; here the law is "
                f"{self.law}, with {len(mu)} and {len(alpha)} numbers"
            )
        for i, (modulus, exponent) in enumerate(zip(mu, alpha, strict=True)):
            if not (isfinite(modulus) and modulus * exponent > 0):
                raise ValueError(
                    f"mu.{i}: {modulus:g}: mu alpha must be positive; here alpha is {exponent:g}"
                )
        # a key of the shells that inherit from this class, not of the class itself
        if self.law != "koiter" and (nu := getattr(self, "poisson_ratio", 0.5)) != 0.5:
            raise ValueError(
                f"poisson_ratio: {nu:g}: law: {self.law} is incompressible: give 0.5, or law: "
                "koiter"
            )
        return self

    @property
    def rubber(self) -> Rubberlike | None:
        """Numbers of a law of rubber; None of Koiter's law.

        C01/(C10 + C01) of neo-Hookean and Mooney-Rivlin rubber; of Ogden's law all mu over E, and
        all alpha.
        """
        if self.mu and self.alpha:
            young_ratio = (
                3 / 2 * sum(mu * alpha for mu, alpha in zip(self.mu, self.alpha, strict=True))
            )
            return tuple(mu / young_ratio for mu in self.mu), tuple(self.alpha)
        ratio = self.mooney or 0.0
        return None if self.law == "koiter" else ratio / (1 + ratio)


@dataclass(frozen=True)
class RubberMaterial(Ability):
    """A law of rubber."""

    law: str

    @classmethod
    def from_context(cls, context: Context) -> "RubberMaterial | None":
        """Return the law of the first shell of rubber in a case; None without rubber."""
        laws = (law for law in laws_of(context) if law not in ("koiter", "laminate"))
        return next((cls(law) for law in laws), None)

    def refuse_unfit(self, context: Context) -> None:
        """Check that Ogden's law is that of a shell, by a ValueError: a solid cannot have it."""
        if self.law == "ogden":
            context.needs("law: ogden", "a mid-surface")

    def withdraws(self, context: Context) -> dict[Offer, str]:
        """Return that the thickness changes, since rubber keeps its volume, and how to avoid it."""
        return {
            "a thickness that does not change": (
                f"shell.law: {self.law} makes the shell thinner: take koiter"
            )
        }


def laws_of(context: Context) -> list[str]:
    """Return the names of the laws of all shells."""
    assembly = getattr(context.shell, "assembly", None)  # of a mesh in pieces alone
    return [*assembly.laws.values()] if assembly else [context.shell.law]


def law_account(rubber: Rubberlike | None) -> str:
    """Return the line of `magshell check` on a law, given by its numbers as of `LawKeys.rubber`."""
    if rubber is None:
        return "membrane and bending energy"
    if isinstance(rubber, tuple):
        terms = ", ".join(f"{mu:.5g} and {alpha:g}" for mu, alpha in zip(*rubber, strict=True))
        law = f"Ogden, mu/E and alpha: {terms}"
    else:
        law = f"Mooney-Rivlin, C01/C10 = {rubber / (1 - rubber):.5g}" if rubber else "neo-Hookean"
    return (
        f"membrane and bending energy of incompressible rubber at any stretch ({law}); its "
        "thickness follows"
    )
