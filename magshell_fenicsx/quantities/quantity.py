"""A quantity observed along a path, an amplitude that varies, and the spelling of their symbols."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Kind = Literal["load", "displacement", "energy", "error", "time", "place", "reaction", "moment", "count", "text"]
PLAIN = str.maketrans({"λ": "lambda", "π": "pi", "Δ": "d", "τ": "tau", "²": "^2", "³": "^3"})
LATEX = str.maketrans({"λ": r"\lambda ", "π": r"\pi ", "Δ": r"\Delta ", "τ": r"\tau ", "²": "^2", "³": "^3"})


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
            return f"{words}  {self.latex if self.sign > 0 else f'$-{self.latex[1:]}'}"
        return f"{words}  ({self.unit})" if self.unit else words

    def on_axis(self, row: Mapping[str, float | int | str]) -> float:
        """Its value in a row of path.csv, with the sign of the axis."""
        return self.sign * float(row[self.name])


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
