"""A quantity that is observed along a path, an amplitude that varies, and how their symbols are spelled."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Kind = Literal["load", "displacement", "energy", "error", "time", "place", "count", "text"]
PLAIN = str.maketrans({"λ": "lambda", "π": "pi", "Δ": "d", "τ": "tau", "²": "^2", "³": "^3"})
LATEX = str.maketrans({"λ": r"\lambda ", "π": r"\pi ", "Δ": r"\Delta ", "τ": r"\tau ", "²": "^2", "³": "^3"})


@dataclass(frozen=True)
class Quantity:
    """A column of path.csv.

    Attributes
    ----------
    name
        Of the column.
    words
        What it is called beside an axis and above a column.
    meaning
        What it is, in one sentence.
    symbol
        As "λ_m": Greek letters and powers as such, an index after "_"; empty where there is none.
    unit, si
        What a value of one is without units, and the unit of that in SI; empty for a pure number.
    note
        What tells it from others with the same symbol, to stand after words or symbol.
    sign
        Of its value on an axis.
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
        """The unit that stands beside a value; a symbol such as "w/h" says it already."""
        return "" if "/" in self.symbol else self.unit

    @property
    def label(self) -> str:
        """What stands beside an axis."""
        words = f"{self.words} {self.note}".strip()
        if self.symbol:
            return f"{words}  {self.latex if self.sign > 0 else f'$-{self.latex[1:]}'}"
        return f"{words}  ({self.unit})" if self.unit else words

    def on_axis(self, row: Mapping[str, float | int | str]) -> float:
        """Its value in a row of path.csv, as it is drawn."""
        return self.sign * float(row[self.name])


@dataclass(frozen=True)
class Amplitude:
    """What a path varies: mu of the energy mu Pi(u).

    Attributes
    ----------
    name
        As in the column `amplitude`.
    column
        The column of its value.
    conjugate
        The column of the displacement that its curve is drawn over; in proportion to -Pi where the meaning says so.
    place
        Where that displacement is.
    """

    name: str
    column: str
    conjugate: str = "w_pole_over_h"
    place: str = "of the pole"
