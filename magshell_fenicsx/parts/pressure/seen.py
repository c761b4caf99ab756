"""The unit of what is conjugate to a live pressure."""

from magshell_fenicsx.models.shell.parameters import Loads
from magshell_fenicsx.parts.part import Account, Context
from magshell_fenicsx.parts.pressure.pressure import PressureSection
from magshell_fenicsx.parts.seen import Seen, Sight


class PressureSeen(Seen):
    """What is conjugate to a live pressure is the change of volume, which every run has."""

    def conjugate_unit(self, sight: Sight, name: str) -> float | None:
        """Of ΔV/R³."""
        if name != PressureSection.amplitude:
            return None
        return -sight.model.material.classical_pressure / sight.h / sight.model.multiplicity


def account(context: Context, loads: Loads) -> Account:
    """Whether there is a live pressure."""
    if not loads.pressure:
        return Account(left_out=["pressure: not loaded by it (the volume is only reported)"])
    return Account(["live pressure on the outer face" if context.solid else "live pressure"])
