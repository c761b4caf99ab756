"""Rubber of Mooney and Rivlin, C10 (I1 - 3) + C01 (I2 - 3) with E = 6 (C10 + C01)."""

from typing import ClassVar, Literal

from pydantic import Field

from magshell_fenicsx.models.strain_energy import Scalar, StrainEnergy
from magshell_fenicsx.parts.laws.law_section import RubberSection


def mooney_rivlin(first: Scalar, second: Scalar, share: Scalar) -> Scalar:
    """Return the energy over E at I1 - 3 = `first` and I2 - 3 = `second`.

    `share` is C01/(C10 + C01).
    """
    return ((1 - share) * first + share * second) / 6


class MooneyRivlinSection(RubberSection):
    """Rubber of Mooney and Rivlin."""

    law: Literal["mooney-rivlin"]
    mooney: float = Field(ge=0, le=1000)
    """C01/C10 of law: mooney-rivlin"""

    title: ClassVar[str] = "Mooney-Rivlin"
    keys_text: ClassVar[str] = "C01/C10 belongs to law: mooney-rivlin, and only to it"

    def strain_energy(self) -> StrainEnergy:
        return StrainEnergy(mooney_rivlin, (self.mooney / (1 + self.mooney),))

    @property
    def numbers_text(self) -> str:
        return f"C01/C10 = {self.mooney:.5g}"
