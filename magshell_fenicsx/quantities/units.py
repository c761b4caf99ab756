"""Units as data: what one of a dimensionless number is, as a function of the shell's sizes."""

from collections.abc import Callable
from dataclasses import dataclass
from math import nan, pi, sqrt


@dataclass(frozen=True)
class Given:
    """What a case gives with units; nan for what it gives without.

    Attributes
    ----------
    R, E, rho
        Radius (m), Young's modulus (Pa) and density (kg/m³).
    applied, strength
        Applied flux density (mT), or strength of the sources (%), of lambda_m = 1.
    second
        The unit of time (s).
    """

    nu: float
    R_over_h: float
    R: float = nan
    E: float = nan
    rho: float = nan
    applied: float = nan
    strength: float = nan
    second: float = nan

    @property
    def h(self) -> float:
        """The thickness (m)."""
        return self.R / self.R_over_h

    @property
    def force(self) -> float:
        """2πD/R (N)."""
        return pi * self.E * self.h**3 / (6 * (1 - self.nu**2) * self.R)

    @property
    def any(self) -> float:
        """1 in a case whose lengths and modulus have units, else nan."""
        return 1.0 + 0.0 * self.R * self.E


@dataclass(frozen=True)
class Unit:
    """The unit of a number in path.csv.

    Attributes
    ----------
    key
        Its name, and the unit as a formula such as "E h R²" unless `formula` says another.
    si
        The unit in SI.
    ending, shown
        The unit in which a case with units has a column of its own: the ending of its name, and the unit in words.
    size
        What one of the number is in that unit; nan if the case lacks what it needs.
    text
        The unit into which a text with a unit is converted for it, for pint; empty if no text is.
    needs
        What a case must have for such a text.
    words, symbol
        Of the column in that unit, if they are not those of the quantity.
    """

    key: str
    si: str = ""
    ending: str = ""
    shown: str = ""
    size: Callable[[Given], float] = lambda given: nan
    text: str = ""
    needs: str = "youngs_modulus and lengths of the shell with units"
    formula: str | None = None
    words: str | None = None
    symbol: str | None = None

    @property
    def written(self) -> str:
        """The unit as a formula."""
        return self.key if self.formula is None else self.formula


DENSITY_TOO = "density, youngs_modulus and lengths of the shell with units"


def _one(given: Given) -> float:
    return given.any


PRESSURE = Unit("p_c", "Pa", "Pa", "Pa", lambda g: 2 * g.E / sqrt(3 * (1 - g.nu**2)) / g.R_over_h**2, text="pascal")
THICKNESS = Unit("h", "m", "mm", "mm", lambda g: 1e3 * g.h, text="millimetre")
VOLUME = Unit("R³", "m³", "mm3", "mm³", lambda g: 1e9 * g.R**3, text="millimetre**3")
POINT_FORCE = Unit("2πD/R", "N", "N", "N", lambda g: g.force, text="newton")
ENERGY = Unit("E h R²", "J", "mJ", "mJ", lambda g: 1e3 * g.E * g.h * g.R**2)
STIFFNESS = Unit("E h/R²", "N/m³", "N_per_m3", "N/m³", lambda g: g.E * g.h / g.R**2)
FIELD = Unit(
    "λ_m", "mT", "mT", "mT", lambda g: g.applied, text="millitesla", formula="", words="applied field", symbol="B_a"
)
STRENGTH = Unit("λ_m", "", "percent", "%", lambda g: g.strength, formula="", words="strength of the sources", symbol="")
PLACE = Unit("place", "", "mm", "mm", lambda g: 1e3 * g.R / g.R, formula="")
REACTION = Unit("reaction", "", "N", "N", _one, formula="")
MOMENT = Unit("moment", "", "N_m", "N m", _one, formula="")
FORCE = Unit("force", "N", "N", "N", _one, formula="")
TORQUE = Unit("torque", "N m", "N_m", "N m", _one, formula="")
WORK = Unit("work", "J", "J", "J", _one, formula="")
TIME = Unit("t", "", "s", "s", lambda g: g.second, formula="")
SECONDS = Unit("s", "s")
DEGREES = Unit("degrees", "degrees")
