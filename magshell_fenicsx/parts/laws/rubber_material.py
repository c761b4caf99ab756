"""The ability of shells of rubber: what their law does not allow.

An offer is a property of a case that other parts may need; a law withdraws those that it does not
allow.
"""

from dataclasses import dataclass

from magshell_fenicsx.parts.ability import Ability, Context, Offer
from magshell_fenicsx.parts.kinds import LAWS


@dataclass(frozen=True)
class RubberMaterial(Ability):
    """A law of rubber, by its name."""

    law: str

    @classmethod
    def from_context(cls, context: Context) -> "RubberMaterial | None":
        """Return the law of the first shell of rubber in a case; None without rubber."""
        rubbers = [name for name, section in LAWS.items() if section.incompressible]
        return next((cls(law) for law in laws_of(context) if law in rubbers), None)

    def refuse_unfit(self, context: Context) -> None:
        """Refuse a law that only shells have where the body is a solid, by a ValueError."""
        if context.shell.law_section.solid_law is None:
            context.needs(f"law: {self.law}", "a mid-surface")

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
