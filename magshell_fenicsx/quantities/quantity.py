"""Quantities observed along a path, amplitudes that vary, their units and their symbols.

A unit is data: what one of a dimensionless number is, as a function of the shell's sizes. A
quantity is a column of path.csv. A case with units has a second column for some quantities, whose
name ends in the unit, such as w_mm for w_over_h. An amplitude is a load parameter; its conjugate is
the displacement on which it does work. p_c is the classical buckling pressure, D the bending
stiffness, E Young's modulus, R the radius, h the thickness, λ_m the dimensionless magnetic field.
"""

import re
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil, floor, inf, isfinite, log10, nan, pi, sqrt
from typing import Literal

Kind = Literal[
    "load",
    "displacement",
    "energy",
    "error",
    "time",
    "place",
    "reaction",
    "moment",
    "stress",
    "field",
    "count",
    "text",
]
SUPERSCRIPTS = str.maketrans("²³⁴", "234")
PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}  # by powers of ten


@dataclass(frozen=True)
class CaseSizes:
    """Sizes of a shell with units, from which units of columns follow; nan where a case has none.

    Attributes
    ----------
    nu, R_over_h
        Poisson's ratio, and the radius over the thickness.
    R, E, rho
        Radius (m), Young's modulus (Pa) and density (kg/m³).
    applied, strength
        Applied flux density (mT), or strength of the sources (%), of a field strength of one.
    second
        The unit of time (s).
    lambda_m
        The dimensionless field at the state that is shown, with its sign; nan without a field, and
        for one that has turned.
    largest_field
        Its largest magnitude on the shell there.
    has_one_thickness
        Whether the thickness is h everywhere.
    """

    nu: float
    R_over_h: float
    R: float = nan
    E: float = nan
    rho: float = nan
    applied: float = nan
    strength: float = nan
    second: float = nan
    lambda_m: float = nan
    largest_field: float = nan
    has_one_thickness: bool = True

    @property
    def h(self) -> float:
        """The thickness (m)."""
        return self.R / self.R_over_h

    @property
    def force(self) -> float:
        """The unit 2πD/R of forces (N), with the bending stiffness D = E h³/(12(1 - ν²))."""
        return pi * self.E * self.h**3 / (6 * (1 - self.nu**2) * self.R)

    @property
    def moment(self) -> float:
        """The unit D/R of moments per length (N)."""
        return self.force / (2 * pi)

    @property
    def force_per_length(self) -> float:
        """The unit E h of forces per length (N/m); nan where the thickness varies."""
        return self.E * self.h if self.has_one_thickness else nan

    @property
    def in_si(self) -> float:
        """1 in a case whose lengths and modulus have units, else nan.

        It is the size of numbers that are in SI already.
        """
        return 1.0 + 0.0 * self.R * self.E


NO_UNITS = CaseSizes(nan, nan)  # of a case without units


@dataclass(frozen=True)
class Unit:
    """The unit of a number in path.csv.

    Attributes
    ----------
    key
        Name of the unit, and the unit as a formula such as "E h R²" unless `formula` gives another.
    si
        The unit in SI.
    ending, shown
        The unit in which a case with units has a column of its own: the ending of the column's
        name, and the unit in words. Both are empty if there is no such column.
    size
        Function of the sizes of a case: the value in that unit of a number 1; nan if the case lacks
        what it needs.
    text
        The unit of `size` in pint's words, into which a text with a unit is converted; empty if no
        text is. A column in another unit than that of a target has a `Unit` of its own.
    needs
        What a case must have to convert a text, for messages.
    words, symbol
        Words and symbol of the column in that unit, if they are not those of the quantity; a
        quantity without a symbol gets none.
    """

    key: str
    si: str = ""
    ending: str = ""
    shown: str = ""
    size: Callable[[CaseSizes], float] = lambda sizes: nan
    text: str = ""
    needs: str = "youngs_modulus and lengths of the shell with units"
    formula: str | None = None
    words: str | None = None
    symbol: str | None = None

    @property
    def formula_text(self) -> str:
        """The unit as a formula, such as "E h R²"; empty if it has none."""
        return self.key if self.formula is None else self.formula


NEEDS_DENSITY = "density, youngs_modulus and lengths of the shell with units"


def _in_si(sizes: CaseSizes) -> float:
    return sizes.in_si


PRESSURE = Unit(
    "p_c",
    "Pa",
    "Pa",
    "Pa",
    lambda g: 2 * g.E / sqrt(3 * (1 - g.nu**2)) / g.R_over_h**2,
    text="pascal",
)
THICKNESS = Unit("h", "m", "mm", "mm", lambda g: 1e3 * g.h, text="millimetre")
VOLUME = Unit("R³", "m³", "mm3", "mm³", lambda g: 1e9 * g.R**3, text="millimetre**3")
POINT_FORCE = Unit("2πD/R", "N", "N", "N", lambda g: g.force, text="newton")
ENERGY = Unit("E h R²", "J", "mJ", "mJ", lambda g: 1e3 * g.E * g.h * g.R**2)
STIFFNESS = Unit("E h/R²", "N/m³", "N_per_m3", "N/m³", lambda g: g.E * g.h / g.R**2)
CONTACT_PRESSURE = Unit("E h/R", "Pa", "Pa", "Pa", lambda g: g.E * g.h / g.R)
FIELD = Unit(
    "λ_m",
    "mT",
    "mT",
    "mT",
    lambda g: g.applied,
    text="millitesla",
    formula="",
    words="applied field",
    symbol="B_a",
)
STRENGTH = Unit(
    "λ_m",
    "",
    "percent",
    "%",
    lambda g: g.strength,
    formula="",
    words="strength of the sources",
    symbol="",
)
PLACE = Unit("place", "", "mm", "mm", lambda g: 1e3 * g.R / g.R, formula="")
REACTION = Unit("reaction", "", "N", "N", _in_si, formula="")
MOMENT = Unit("moment", "", "N_m", "N m", _in_si, formula="")
FORCE = Unit("force", "N", "N", "N", _in_si, formula="")
TORQUE = Unit("torque", "N m", "N_m", "N m", _in_si, formula="")
WORK = Unit("work", "J", "J", "J", _in_si, formula="")
TIME = Unit("t", "", "s", "s", lambda g: g.second, formula="")
DISTANCE = Unit("way", "", "mm", "mm", formula="")  # of motions, each with its own size
TURN = Unit("turn", "", "degrees", "degrees", formula="")
SECOND_UNIT = Unit("s", "s")
DEGREES = Unit("degrees", "degrees")


def _letter(greek: str) -> str:
    """Return the name of a Greek letter, as TeX spells it.

    Examples
    --------
    >>> _letter("λ"), _letter("Δ"), _letter("ω")
    ('lambda', 'Delta', 'omega')
    """
    name = unicodedata.name(greek).split()[-1].replace("LAMDA", "LAMBDA")
    return name.capitalize() if greek.isupper() else name.lower()


def plain_text(text: str) -> str:
    """Return text with Greek letters and powers in ASCII, for a terminal.

    Examples
    --------
    >>> plain_text("λ Δw² ρ")
    'lambda dw^2 rho'
    """
    text = re.sub(
        "[\u0391-\u03c9]", lambda greek: "d" if greek[0] == "Δ" else _letter(greek[0]), text
    )
    return re.sub("[²³⁴]", lambda power: f"^{power[0].translate(SUPERSCRIPTS)}", text)


def with_prefix(value: float, unit: str) -> tuple[float, str]:
    """Return the size of a 1 in a unit with a prefix, and that unit, which suits a value.

    The value is then from 1 to 1000.

    Examples
    --------
    >>> with_prefix(32000.0, "Pa"), with_prefix(-0.012, "N/m"), with_prefix(0.0, "N")
    ((0.001, 'kPa'), (1000.0, 'mN/m'), (1.0, 'N'))
    """
    order = 3 * floor(log10(abs(value)) / 3) if value else 0
    power = min(max(order, min(PREFIXES)), max(PREFIXES))
    return 10.0**-power, f"{PREFIXES[power]}{unit}"


def _tex(text: str) -> str:
    """Return text with Greek letters, powers and hats as TeX writes them."""
    text = re.sub("(\\w)\u0302", r"\\hat \1", text).replace("×", r"\times ")
    text = re.sub(r"\^(\w+)", r"^\\mathrm{\1}", text)
    text = re.sub("[\u0391-\u03c9]", lambda greek: rf"\{_letter(greek[0])} ", text)
    return re.sub("[²³⁴]", lambda power: f"^{power[0].translate(SUPERSCRIPTS)}", text)


def format_number(value: float, form: str) -> str:
    """Return a number in a format, without the sign of a zero.

    Examples
    --------
    >>> format_number(-1e-9, "8.4f"), format_number(-0.0, "+.1e"), format_number(-2, ".4g")
    ('  0.0000', '+0.0e+00', '-2')
    """
    text = f"{value:{form}}"
    # what rounds to zero may have a minus sign
    return text if float(text) else f"{0.0:{form}}"


def number_with_error(value: float, error: float | None, digits: int = 9) -> str:
    """Return a number with the digits that its error leaves, and the error of the last one.

    The error is rounded up to one digit. Without an error, or with one that is smaller than the
    last of `digits` significant digits, the number has these digits.

    Examples
    --------
    >>> number_with_error(0.3262333, 1.2e-6), number_with_error(0.3262333, 1e-12, 6)
    ('0.326233(2)', '0.326233')
    >>> number_with_error(1.84e-5, 2e-8), number_with_error(27532.1, 31.0)
    ('1.840(2)e-05', '27530(40)')
    >>> number_with_error(0.3, 2.0), number_with_error(-0.0996, 0.0095, 6)
    ('0(2)', '-0.10(1)')
    """
    number_text = f"{value:.{digits}g}"
    if error is None or not 0 < error < inf or not isfinite(value):
        return number_text
    # the error is `count` units of the decimal place `place`
    place = floor(log10(error))
    count = ceil(round(error / 10.0**place, 6))
    if count == 10:
        count, place = 1, place + 1
    exponent = floor(log10(abs(value))) if value else place
    if place <= exponent - digits:
        return number_text
    # a number that would begin with many zeros, or end with them, has a power of ten
    power = 0 if -5 < exponent < digits else exponent
    decimals = max(power - place, 0)
    mantissa = round(value / 10.0**power, power - place)
    scale = 1 if place <= power else 10 ** (place - power)
    suffix = f"e{power:+03d}" if power else ""
    return f"{mantissa + 0.0:.{decimals}f}({count * scale}){suffix}"


@dataclass(frozen=True)
class Quantity:
    """A quantity observed along a path: a column of path.csv.

    Attributes
    ----------
    name
        Name of the column.
    words
        Name for axes and headings.
    meaning
        Definition in one sentence.
    kind
        Kind of quantity, such as "load" or "energy".
    symbol
        For example "λ_m": Greek letters and powers in Unicode, an index after "_", a letter above
        after "^"; empty if there is no symbol.
    units
        Units of the number, the first of them unless the case shows another; empty for a pure
        number.
    note
        Distinguishes quantities with the same symbol; follows the words or the symbol.
    sign
        Sign of the value on an axis.
    stem
        Name without a unit, to which the endings of columns in units are added; by default the name
        without "_over_h".
    each
        Whether there may be several such quantities, each with a column of its own, such as
        approach_ball: the name of this one, an underscore, the name of a body.
    may_be_nan
        Whether a run may have no number for it.
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
    each: bool = False
    may_be_nan: bool = False

    @property
    def unit(self) -> str:
        """The unit as a formula such as "E h R²"; empty for a pure number."""
        return self.units[0].formula_text if self.units else ""

    @property
    def si(self) -> str:
        """The unit in SI; empty for a pure number."""
        return self.units[0].si if self.units else ""

    @property
    def ascii_symbol(self) -> str:
        """The symbol for a terminal, or the words if there is none.

        Examples
        --------
        >>> symbols = ("p/p_c", "ω_1", "ΔV/R³")
        >>> [Quantity("", "", "", "load", symbol).ascii_symbol for symbol in symbols]
        ['p/pc', 'omega_1', 'dV/R^3']
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
        tex = re.sub(r" ?_(\w+)", r"_\\mathrm{\1}", _tex(self.symbol))
        return f"${tex}$" if self.symbol else self.words

    @property
    def html(self) -> str:
        """The symbol in HTML, or the words.

        Examples
        --------
        >>> Quantity("", "", "", "load", "p/p_c").html
        'p/p<sub>c</sub>'
        """
        with_indices = re.sub(r"_(\w+)", r"<sub>\1</sub>", self.symbol)
        return re.sub(r"\^(\w+)", r"<sup>\1</sup>", with_indices) or self.words

    @property
    def shown_unit(self) -> str:
        """The unit shown with a value; empty if the symbol, such as "w/h", contains the unit."""
        return "" if "/" in self.symbol else self.unit

    @property
    def label(self) -> str:
        """The label of an axis: words, symbol in TeX, and unit."""
        words = f"{self.words} {self.note}".strip()
        if self.symbol:
            unit = f"  ({self.shown_unit})" if self.shown_unit else ""
            return f"{words}  {self.latex if self.sign > 0 else f'$-{self.latex[1:]}'}{unit}"
        return f"{words}  ({self.unit})" if self.unit else words

    def on_axis(self, row: Mapping[str, float | int | str]) -> float:
        """Return the quantity's value in a row of path.csv, with the sign of the axis."""
        return self.sign * float(row[self.name])

    @property
    def scale(self) -> str:
        """The key of the unit, by which quantities share an axis.

        It is the kind for a pure number, and for the factor of a motion, which has units of its
        own.
        """
        return self.units[0].key if self.units and self.units[0] is not DISTANCE else self.kind

    def for_name(self, name: str) -> "Quantity":
        """Return the column of one of several such quantities, by a name such as a body's."""
        return replace(self, name=f"{self.name}_{name}", words=f"{self.words} {name}", note="")

    def in_unit(self, unit: Unit) -> "Quantity":
        """Return the column in the unit that a case shows for one of this quantity's units.

        For example w_mm, in mm, for w_over_h with the unit h.
        """
        stem = self.stem or self.name.replace("_over_h", "")
        # of p/p_c or F R/(2πD) the first letter alone is the quantity with a unit
        symbol = re.split("[ /]", self.symbol)[0]
        words = self.words if unit.words is None else unit.words
        if unit.symbol is not None and symbol:
            symbol = unit.symbol
        shown_unit = Unit(key=unit.shown, si=unit.shown)
        name = f"{stem}_{unit.ending}"
        return replace(self, name=name, words=words, symbol=symbol, units=(shown_unit,))

    @cached_property
    def in_units(self) -> tuple["Quantity", ...]:
        """The columns in the units of a case, one of which is there where the case has units.

        Examples
        --------
        >>> from magshell_fenicsx.quantities.quantity import THICKNESS
        >>> w = Quantity("w_over_h", "", "", "displacement", "w/h", (THICKNESS,))
        >>> [q.name for q in w.in_units]
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
        Column of the parameter's value.
    conjugate
        Column of the displacement on the other axis of the parameter's curve; proportional to -Pi
        if its meaning says so.
    place
        Location of that displacement, in words.
    sideways
        Whether the curve has the value on the x axis, and the conjugate on the y axis.
    each
        Whether there may be several such parameters, whose columns have their names at the end.
    components
        Further amplitudes of the same load, across its first direction, which a step may turn.
    turned_load
        The load that it turns, of an angle, which itself is no parameter of the energy.
    critical_names
        Names of its value at the first instability as a number of a run: over its unit, and with
        units; empty without.
    history_name
        Its name in the histories of a step in time, of a field; empty if that is its own name.
    """

    name: str
    column: str
    conjugate: str = "w_pole_over_h"
    place: str = "of the pole"
    sideways: bool = False
    each: bool = False
    components: tuple[str, ...] = ()
    turned_load: str = ""
    critical_names: tuple[str, ...] = ()
    history_name: str = ""

    @property
    def is_field(self) -> bool:
        """Whether it is strength or direction of a field in space, which has no conjugate."""
        return bool(self.components or self.turned_load)
