"""A quantity observed along a path, an amplitude that varies, and the spelling of their symbols."""

import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from magshell_fenicsx.quantities.units import Unit

Kind = Literal["load", "displacement", "energy", "error", "time", "place", "reaction", "moment", "count", "text"]
SUPERSCRIPTS = str.maketrans("²³⁴", "234")


def _letter(greek: str) -> str:
    """The name of a Greek letter, as TeX spells it.

    Examples
    --------
    >>> _letter("λ"), _letter("Δ"), _letter("ω")
    ('lambda', 'Delta', 'omega')
    """
    name = unicodedata.name(greek).split()[-1].replace("LAMDA", "LAMBDA")
    return name.capitalize() if greek.isupper() else name.lower()


def plain_text(text: str) -> str:
    """Text with Greek letters and powers, for a terminal.

    Examples
    --------
    >>> plain_text("λ Δw² ρ")
    'lambda dw^2 rho'
    """
    text = re.sub("[\u0391-\u03c9]", lambda greek: "d" if greek[0] == "Δ" else _letter(greek[0]), text)
    return re.sub("[²³⁴]", lambda power: f"^{power[0].translate(SUPERSCRIPTS)}", text)


def _tex(text: str) -> str:
    text = re.sub("[\u0391-\u03c9]", lambda greek: rf"\{_letter(greek[0])} ", text)
    return re.sub("[²³⁴]", lambda power: f"^{power[0].translate(SUPERSCRIPTS)}", text)


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
    units
        What one of the number is, the first of them unless the case shows another; empty for a pure number.
    note
        Distinguishes quantities with the same symbol; follows the words or the symbol.
    sign
        Sign of its value on an axis.
    stem
        Its name without a unit, before the endings of columns in units; by default the name without "_over_h".
    """

    name: str
    words: str
    meaning: str
    kind: Kind
    symbol: str = ""
    units: tuple[Unit, ...] = ()
    note: str = ""
    sign: float = 1.0
    stem: str = ""

    @property
    def unit(self) -> str:
        """The unit as a formula such as "E h R²"; empty for a pure number."""
        return self.units[0].written if self.units else ""

    @property
    def si(self) -> str:
        """That unit in SI."""
        return self.units[0].si if self.units else ""

    @property
    def plain(self) -> str:
        """The symbol for a terminal.

        Examples
        --------
        >>> [Quantity("", "", "", "load", symbol).plain for symbol in ("p/p_c", "λ_m", "ΔV/R³")]
        ['p/pc', 'lambda_m', 'dV/R^3']
        """
        return plain_text(re.sub(r"(?<=[A-Za-z])_", "", self.symbol)) or self.words

    @property
    def latex(self) -> str:
        """The symbol in mathematics, or the words.

        Examples
        --------
        >>> [Quantity("", "", "", "load", symbol).latex for symbol in ("p/p_c", "λ_m", "F R/(2πD)")]
        ['$p/p_\\\\mathrm{c}$', '$\\\\lambda_\\\\mathrm{m}$', '$F R/(2\\\\pi D)$']
        """
        spelled = re.sub(r" ?_(\w+)", r"_\\mathrm{\1}", _tex(self.symbol))
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
        """The key of its unit; of a number without one the kind."""
        return self.units[0].key if self.units else self.kind

    def in_unit(self, unit: Unit) -> "Quantity":
        """The column in the unit that is shown for one of its units."""
        stem, symbol = self.stem or self.name.replace("_over_h", ""), re.split("[ /]", self.symbol)[0]
        words = self.words if unit.words is None else unit.words
        symbol = symbol if unit.symbol is None else unit.symbol
        shown = Unit(unit.shown, unit.shown)
        return replace(self, name=f"{stem}_{unit.ending}", words=words, symbol=symbol, units=(shown,))

    @property
    def in_units(self) -> tuple["Quantity", ...]:
        """The same in the units of a case, one of which is a column of its own where the case has units.

        Examples
        --------
        >>> from magshell_fenicsx.quantities.units import THICKNESS
        >>> [q.name for q in Quantity("w_over_h", "", "", "displacement", "w/h", (THICKNESS,)).in_units]
        ['w_mm']
        """
        return tuple(self.in_unit(unit) for unit in self.units if unit.ending)


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
