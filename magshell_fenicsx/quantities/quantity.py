"""A quantity observed along a path, an amplitude that varies, and the spelling of their symbols."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

Kind = Literal["load", "displacement", "energy", "error", "time", "place", "reaction", "moment", "count", "text"]
PLAIN = str.maketrans({"λ": "lambda", "π": "pi", "Δ": "d", "τ": "tau", "²": "^2", "³": "^3"})
LATEX = str.maketrans({"λ": r"\lambda ", "π": r"\pi ", "Δ": r"\Delta ", "τ": r"\tau ", "²": "^2", "³": "^3"})

IN_UNITS = {  # the unit as a formula, or the kind of what is in the case's units -> ending of the name and unit
    "p_c": (("Pa", "Pa"),),
    "λ_m": (("mT", "mT"), ("percent", "%")),
    "2πD/R": (("N", "N"),),
    "h": (("mm", "mm"),),
    "R³": (("mm3", "mm³"),),
    "E h R²": (("mJ", "mJ"),),
    "E h/R²": (("N_per_m3", "N/m³"),),
    "place": (("mm", "mm"),),
    "reaction": (("N", "N"), ("N_m", "N m")),
    "force": (("N", "N"),),
    "work": (("J", "J"),),
    "moment": (("N_m", "N m"),),
    "t": (("s", "s"),),
}
ENDINGS = tuple(dict.fromkeys(ending for endings in IN_UNITS.values() for ending, _ in endings))
RENAMED = {"p_over_pc": "pressure", "lambda_m": "applied"}
FIELDS = {"mT": ("applied field", "B_a"), "%": ("strength of the sources", "")}


def spelled(value: float, form: str) -> str:
    """A number in a format, without the sign of a zero.

    Examples
    --------
    >>> spelled(-1e-9, "8.4f"), spelled(-0.0, "+.1e"), spelled(-2, ".4g")
    ('  0.0000', '+0.0e+00', '-2')
    """
    text = f"{value:{form}}"
    return text if float(text) else f"{0.0:{form}}"


@dataclass(frozen=True)
class Quantity:
    """A column of path.csv.

    Attributes
    ----------
    name
        Name of the column.
    words
        Name for axes and headings.
    meaning
        Definition in one sentence.
    symbol
        For example "λ_m": Greek letters and powers in Unicode, an index after "_"; empty if there is no symbol.
    unit, si
        The unit as a formula such as "E h R²", and that unit in SI; empty for a pure number.
    note
        Distinguishes quantities with the same symbol; follows the words or the symbol.
    sign
        Sign of its value on an axis.
    """

    name: str
    words: str
    meaning: str
    kind: Kind
    symbol: str = ""
    unit: str = ""
    si: str = ""
    note: str = ""
    sign: float = 1.0

    @property
    def plain(self) -> str:
        """The symbol for a terminal.

        Examples
        --------
        >>> [Quantity("", "", "", "load", symbol).plain for symbol in ("p/p_c", "λ_m", "ΔV/R³")]
        ['p/pc', 'lambda_m', 'dV/R^3']
        """
        return re.sub(r"(?<=[A-Za-z])_", "", self.symbol).translate(PLAIN) or self.words

    @property
    def latex(self) -> str:
        """The symbol in mathematics, or the words.

        Examples
        --------
        >>> [Quantity("", "", "", "load", symbol).latex for symbol in ("p/p_c", "λ_m", "F R/(2πD)")]
        ['$p/p_\\\\mathrm{c}$', '$\\\\lambda_\\\\mathrm{m}$', '$F R/(2\\\\pi D)$']
        """
        spelled = re.sub(r" ?_(\w+)", r"_\\mathrm{\1}", self.symbol.translate(LATEX))
        return f"${spelled}$" if self.symbol else self.words

    @property
    def html(self) -> str:
        """The symbol in HTML, or the words.

        Examples
        --------
        >>> Quantity("", "", "", "load", "p/p_c").html
        'p/p<sub>c</sub>'
        """
        return re.sub(r"_(\w+)", r"<sub>\1</sub>", self.symbol) or self.words

    @property
    def shown_unit(self) -> str:
        """The unit shown with a value; empty if the symbol, such as "w/h", contains the unit."""
        return "" if "/" in self.symbol else self.unit

    @property
    def label(self) -> str:
        """The label of an axis."""
        words = f"{self.words} {self.note}".strip()
        if self.symbol:
            unit = f"  ({self.shown_unit})" if self.shown_unit else ""
            return f"{words}  {self.latex if self.sign > 0 else f'$-{self.latex[1:]}'}{unit}"
        return f"{words}  ({self.unit})" if self.unit else words

    def on_axis(self, row: Mapping[str, float | int | str]) -> float:
        """Its value in a row of path.csv, with the sign of the axis."""
        return self.sign * float(row[self.name])

    @property
    def scale(self) -> str:
        """Its unit as a formula, a key of `IN_UNITS`; of what path.csv has in the case's units the kind."""
        if self.symbol in ("λ_m", "t"):
            return self.symbol
        if self.kind == "reaction" and self.si:
            return {"N": "force", "N m": "moment", "J": "work"}[self.si]
        return self.unit or self.kind

    @property
    def in_units(self) -> tuple["Quantity", ...]:
        """The same in the units of a case, one of which is a column of its own where the case has units.

        Examples
        --------
        >>> [q.name for q in Quantity("w_over_h", "", "", "displacement", "w/h", "h").in_units]
        ['w_mm']
        """
        stem, symbol = RENAMED.get(self.name, self.name.replace("_over_h", "")), re.split("[ /]", self.symbol)[0]
        found = []
        for ending, unit in IN_UNITS.get(self.scale, ()):
            words, sign = FIELDS[unit] if self.scale == "λ_m" else (self.words, symbol)
            found.append(replace(self, name=f"{stem}_{ending}", words=words, symbol=sign, unit=unit, si=unit))
        return tuple(found)


@dataclass(frozen=True)
class Amplitude:
    """The parameter that a path varies: mu of the energy mu Pi(u).

    Attributes
    ----------
    name
        Name in the column `amplitude`.
    column
        Column of its value.
    conjugate
        Column of the displacement on the other axis of its curve; proportional to -Pi if its meaning says so.
    place
        Location of that displacement.
    """

    name: str
    column: str
    conjugate: str = "w_pole_over_h"
    place: str = "of the pole"
