"""A gas under the shell, as the conjugate of the pressure."""

from dataclasses import dataclass
from math import cos, pi, radians

from magshell_fenicsx.continuation.device import Conjugate
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.course import GasSection
from magshell_fenicsx.shape.sections import CapSurface, Surface
from magshell_fenicsx.shape.shell import ShellSection


@dataclass(frozen=True)
class Enclosed:
    """A gas from where it was closed in, an equilibrium: (ambient - p) V stays what it was there (Boyle's law).

    Attributes
    ----------
    classical_pressure
        p_c/E.
    unit
        -dPi/dp of ΔV/R³ = 1, with p over p_c.
    pressure, conjugate
        p/p_c and -dPi/dp there.
    """

    section: GasSection
    shell: ShellSection | Surface
    classical_pressure: float
    unit: float
    pressure: float
    conjugate: float

    def law(self) -> Conjugate:
        """The conjugate as a function of p/p_c.

        Raises
        ------
        CaseError
            If the volume under the shell is not known, or the pressure is not below the ambient one.
        """
        ambient = self.section.ambient_over_pc
        if ambient is None:
            if self.shell.youngs_modulus is None:
                raise CaseError("hold.pressure.gas.ambient: needs shell.youngs_modulus; or give ambient_over_pc")
            ambient = float(self.section.ambient or 0.0) / (self.classical_pressure * self.shell.youngs_modulus)
        first, now, unit = self._volume(), self.pressure, self.unit
        changed = self.conjugate / unit
        if first + changed <= 0:
            raise CaseError(
                f"hold.pressure.gas.volume: {first:.4g}: the shell has shrunk by {-changed:.4g} R^3 already"
            )
        if now >= ambient:
            raise CaseError(
                f"hold.pressure.gas: the pressure, {now:.4g} p_c, is not below the ambient {ambient:.4g} p_c"
            )
        content = (ambient - now) * (first + changed)

        def conjugate(p: float) -> tuple[float, float]:
            return unit * (content / (ambient - p) - first), unit * content / (ambient - p) ** 2

        return conjugate

    def by_begin(self, p: float) -> tuple[float, float]:
        """What the conjugate at p/p_c changes by with that where the gas was closed in, and with p there."""
        at_now, slope = self.law()(p)
        first = self._volume()
        ahead = (at_now / self.unit + first) / slope * self.unit  # ambient - p
        share = (ahead + p - self.pressure) / ahead
        return share, -(self.unit * first + self.conjugate) / ahead

    def _volume(self) -> float:
        return self.section.volume or volume(self.shell)


def volume(shell: ShellSection | Surface) -> float:
    """The volume between a spherical shell without its dimple and the plane of its edge, over R^3.

    Raises
    ------
    CaseError
        On any other shape.
    """
    if shell.geometry == "hemisphere":
        return 2 * pi / 3
    if isinstance(shell, CapSurface) and shell.geometry == "cap":
        c = cos(radians(shell.polar))
        return pi * (2 + c) * (1 - c) ** 2 / 3
    raise CaseError(f"hold.pressure.gas.volume: give the volume of the gas under a {shell.geometry}")
