"""Koiter's law of small strains."""

from typing import ClassVar, Literal

from magshell_fenicsx.models.shell.law import Koiter
from magshell_fenicsx.parts.laws.law_section import LawSection, RubberSection
from magshell_fenicsx.parts.laws.neo_hookean import NeoHookeanSection


class KoiterSection(LawSection):
    """Koiter's law; a solid is then of compressible neo-Hookean rubber."""

    law: Literal["koiter"]

    title: ClassVar[str] = "Koiter"
    incompressible: ClassVar[bool] = False

    def elastic_law(self, h: float, nu: float) -> Koiter:
        return Koiter(h, nu)

    @property
    def solid_law(self) -> RubberSection:
        return NeoHookeanSection.model_construct(law="neo-hookean")
