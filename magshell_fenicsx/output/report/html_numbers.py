"""Numbers for people, in HTML."""

import math
from collections.abc import Iterable, Sequence

from markupsafe import Markup

ROUNDING = 1e-15, 1e-9  # displacements and forces as small as this, in any unit or over their largest, are zero
LEAST, MOST = 1e-3, 1e6  # magnitudes between them are written without a power of ten
DIGITS = 6


def number(value: float, digits: int = DIGITS) -> Markup:
    """A number with at most `digits` significant digits.

    Examples
    --------
    >>> number(0.32623330500000004), number(90.0), number(1.84e-05), number(1e-4)
    (Markup('0.326233'), Markup('90'), Markup('1.84 · 10<sup>−5</sup>'), Markup('10<sup>−4</sup>'))
    """
    if value == 0 or LEAST <= abs(value) < MOST:
        return _signed(f"{value:.{digits}g}")
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    short = mantissa.rstrip("0").rstrip(".")
    return (Markup() if short == "1" else _signed(short) + Markup(" · ")) + power(int(exponent))


def above_rounding(value: float, along: Iterable[float] = ()) -> float:
    """The value, or zero if it is as small as rounding, also beside the values along a path.

    Examples
    --------
    >>> above_rounding(3.5e-14, [76.4]), above_rounding(3.5e-14, [1e-13])
    (0.0, 3.5e-14)
    """
    largest = max((abs(v) for v in along if math.isfinite(v)), default=0.0)
    return value if abs(value) > max(ROUNDING[0], ROUNDING[1] * largest) else 0.0


def column(values: Sequence[float], beside: Sequence[float] = ()) -> tuple[int, list[Markup]]:
    """A column of numbers with a common power of ten and equally many decimals; nan is left empty.

    `beside` are numbers of other columns with the same power of ten and the same decimals.

    Examples
    --------
    >>> column([0.0, -1.5e-06, 2.25e-05])
    (-5, [Markup('0.00'), Markup('−0.15'), Markup('2.25')])
    """
    largest = max((abs(v) for v in (*values, *beside) if math.isfinite(v)), default=0.0)
    order = math.floor(math.log10(largest)) if largest else 0
    exponent = 0 if LEAST <= largest < MOST or not largest else order
    texts = [f"{v / 10.0**exponent:.{max(0, DIGITS - 1 - order + exponent)}f}" for v in values]
    if largest and "." in texts[0]:
        spare = min(len(t) - len(t.rstrip("0")) for t, v in zip(texts, values, strict=True) if math.isfinite(v))
        texts = [t[: len(t) - spare].rstrip(".") for t in texts]
    return exponent, [_signed(t) if math.isfinite(v) else Markup("") for t, v in zip(texts, values, strict=True)]


def power(exponent: int) -> Markup:
    """A power of ten."""
    return Markup("10<sup>{}</sup>").format(_signed(str(exponent)))


def _signed(text: str) -> Markup:
    """Use a typographic minus sign, and none before zero."""
    return Markup(text.removeprefix("-") if not text.strip("-0.") else text.replace("-", "−"))
