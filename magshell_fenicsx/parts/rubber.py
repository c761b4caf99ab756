"""The law of a shell's material: small strains, or rubber of two kinds, with what each is not for, and its words."""

from dataclasses import dataclass
from typing import Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.parts.part import Ability, Context, Offer


class LawKeys(Section):
    """The keys of a shell that choose its law."""

    law: Literal["koiter", "neo-hookean", "mooney-rivlin"] = "koiter"
    """Koiter's for small strains; the others for rubber, incompressible at any stretch, with E = 6 (C10 + C01)"""
    mooney: float | None = Field(default=None, ge=0, le=1000)
    """C01/C10 of law: mooney-rivlin"""

    @model_validator(mode="after")
    def _law_fits(self) -> Self:
        if (self.mooney is not None) != (self.law == "mooney-rivlin"):
            raise ValueError(
                f"mooney: C01/C10 belongs to law: mooney-rivlin, and only to it; here the law is {self.law}"
            )
        if self.law != "koiter" and (nu := getattr(self, "poisson_ratio", 0.5)) != 0.5:
            raise ValueError(f"poisson_ratio: {nu:g}: law: {self.law} is incompressible: give 0.5, or law: koiter")
        return self

    @property
    def rubber(self) -> float | None:
        """C01/(C10 + C01); None of Koiter's law."""
        ratio = self.mooney or 0.0
        return None if self.law == "koiter" else ratio / (1 + ratio)


@dataclass(frozen=True)
class Rubber(Ability):
    """A law of rubber."""

    law: str

    @classmethod
    def of(cls, context: Context) -> "Rubber | None":
        """The first of several shells that is of rubber."""
        laws = (law for law in laws_of(context) if law not in ("koiter", "laminate"))
        return next((cls(law) for law in laws), None)

    def withdraws(self, context: Context) -> dict[Offer, str]:
        """Rubber keeps its volume."""
        return {"a thickness that does not change": f"shell.law: {self.law} makes the shell thinner: take koiter"}


def laws_of(context: Context) -> list[str]:
    """The words for the laws of all shells."""
    several = getattr(context.shell, "assembly", None)  # of a mesh in pieces alone
    return [*several.laws.values()] if several else [context.shell.law]


def law_account(rubber: float | None) -> str:
    """The words of `magshell check`; see `LawKeys.rubber`."""
    if rubber is None:
        return "membrane and bending energy"
    law = f"Mooney-Rivlin, C01/C10 = {rubber / (1 - rubber):.5g}" if rubber else "neo-Hookean"
    return f"membrane and bending energy of incompressible rubber at any stretch ({law}); its thickness follows"
