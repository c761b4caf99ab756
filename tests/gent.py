"""Gent's rubber, as a law that is added to the package: copied into `parts/laws/` by a test.

A. N. Gent, Rubber Chem. Technol. 69, 1996: chains cannot be stretched beyond I1 - 3 = J_m.
"""

from typing import ClassVar, Literal

from pydantic import Field

from magshell_fenicsx.models.strain_energy import Scalar, StrainEnergy, ln
from magshell_fenicsx.parts.laws.law_section import RubberSection


def gent(first: Scalar, second: Scalar, limit: Scalar) -> Scalar:
    """Return the energy over E at I1 - 3 = `first`; it is infinite at `limit`."""
    return -limit / 6 * ln(1 - first / limit)


class GentSection(RubberSection):
    """Gent's rubber."""

    law: Literal["gent"]
    jm: float = Field(gt=0, le=1e6)
    """J_m of law: gent, the value of I1 - 3 that no stretch reaches"""

    title: ClassVar[str] = "Gent"
    keys_text: ClassVar[str] = "J_m belongs to law: gent, and only to it"

    def strain_energy(self) -> StrainEnergy:
        return StrainEnergy(gent, (self.jm,))

    @property
    def numbers_text(self) -> str:
        return f"J_m = {self.jm:.5g}"
