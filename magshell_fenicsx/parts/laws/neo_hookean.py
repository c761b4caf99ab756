"""Neo-Hookean rubber, C10 (I1 - 3) with E = 6 C10."""

from typing import ClassVar, Literal

from magshell_fenicsx.models.strain_energy import Scalar, StrainEnergy
from magshell_fenicsx.parts.laws.law_section import RubberSection


def neo_hookean(first: Scalar, second: Scalar) -> Scalar:
    """Return the energy over E at I1 - 3 = `first`; it does not depend on I2 - 3 = `second`."""
    return first / 6


class NeoHookeanSection(RubberSection):
    """Neo-Hookean rubber."""

    law: Literal["neo-hookean"]

    title: ClassVar[str] = "neo-Hookean"

    def strain_energy(self) -> StrainEnergy:
        return StrainEnergy(neo_hookean)
