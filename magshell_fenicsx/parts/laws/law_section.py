"""The base of the laws of a material: a section with the keys of one law, and what it makes.

A section is a part of a case file, checked by pydantic. The keys of all laws are keys of a shell,
which may give those of its own law alone.
"""

from abc import abstractmethod
from typing import ClassVar

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.models.shell.law import Law
from magshell_fenicsx.models.shell.rubber import Rubber
from magshell_fenicsx.models.strain_energy import StrainEnergy


class LawSection(Section):
    """The law of a material with its keys; the key `law` is a Literal of its name.

    Attributes
    ----------
    title
        Name of the law in `magshell check`.
    keys_text
        What a message says of the law's own keys where another law has them, or this law has not.
    incompressible
        Whether the volume stays at any stretch.
    """

    title: ClassVar[str]
    keys_text: ClassVar[str] = ""
    incompressible: ClassVar[bool] = True

    @classmethod
    def own_keys(cls) -> list[str]:
        """Return the keys of this law alone, in their order."""
        return [key for key in cls.model_fields if key != "law"]

    @property
    def numbers_text(self) -> str:
        """The numbers of the law in words, such as "C01/C10 = 0.1"; empty without any."""
        return ""

    @abstractmethod
    def elastic_law(self, h: float, nu: float) -> Law:
        """Return the law of a shell with the thickness h over R and Poisson's ratio nu."""

    @property
    def solid_law(self) -> "RubberSection | None":
        """The law of a solid for which this one is chosen; None if there is no such solid."""
        return None


class RubberSection(LawSection):
    """Incompressible rubber whose energy is a function of the invariants I1 and I2."""

    @abstractmethod
    def strain_energy(self) -> StrainEnergy:
        """Return the energy of the rubber, per volume over E."""

    def elastic_law(self, h: float, nu: float) -> Law:
        return Rubber(h, self.strain_energy())

    @property
    def solid_law(self) -> "RubberSection":
        return self


def law_account(section: LawSection) -> str:
    """Return the line of `magshell check` on the law of a shell."""
    if not section.incompressible:
        return "membrane and bending energy"
    words = ", ".join(text for text in (section.title, section.numbers_text) if text)
    return (
        f"membrane and bending energy of incompressible rubber at any stretch ({words}); its "
        "thickness follows"
    )
