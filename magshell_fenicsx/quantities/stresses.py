"""Columns of forces, moments and stresses at named points, such as `A_N11` and `A_mises_top`.

N and M are the membrane force and the moment per length, Q is the shear force per length, sigma a
stress of the top (outer face), the middle or the bottom, and mises von Mises' stress there. Indices
are directions in the surface.
"""

import re

from magshell_fenicsx.quantities.quantity import Quantity, Unit

LAYERS = {"top": 1, "middle": 0, "bottom": -1}  # place of a layer: the outer face is the top
MEMBRANE_FORCE = Unit("E h", "N/m", "N_per_m", "N/m", lambda g: g.E * g.h)
BENDING_MOMENT = Unit("D/R", "N", "N", "N", lambda g: g.moment)
SHEAR_FORCE = Unit("D/R²", "N/m", "N_per_m", "N/m", lambda g: g.moment / g.R)
STRESS = Unit("E", "Pa", "Pa", "Pa", lambda g: g.E)
_PATTERN = re.compile(r"\w+_(N|M|Q|sigma|mises)(\d{0,2})((?:_(?:top|middle|bottom))?)")
_WORDS_AND_UNITS = {
    "N": ("membrane force", MEMBRANE_FORCE),
    "M": ("moment", BENDING_MOMENT),
    "Q": ("shear force", SHEAR_FORCE),
    "sigma": ("stress", STRESS),
    "mises": ("von Mises stress", STRESS),
}


def stress_columns(*, has_stresses: bool) -> tuple[str, ...]:
    """Return the endings of the columns of a point; without stresses forces and moments alone.

    Examples
    --------
    >>> stress_columns(has_stresses=False)
    ('N11', 'N12', 'N22', 'M11', 'M12', 'M22', 'Q1', 'Q2')
    """
    forces = [f"{symbol}{indices}" for symbol in "NM" for indices in ("11", "12", "22")]
    stresses = [f"sigma{indices}" for indices in ("11", "12", "22")]
    layers = [f"{name}_{layer}" for layer in LAYERS for name in (*stresses, "mises")]
    return (*forces, "Q1", "Q2", *(layers if has_stresses else ()))


def stress_quantity(name: str) -> Quantity | None:
    """Return the quantity of a column at a point by its name; None of another column.

    Examples
    --------
    >>> [stress_quantity(name).words for name in ("A_N11", "A_mises_top")]
    ['A N11', 'A mises top']
    >>> stress_quantity("A_ux") is None
    True
    """
    match = _PATTERN.fullmatch(name)
    if match is None or f"{match[1]}{match[2]}{match[3]}" not in stress_columns(has_stresses=True):
        return None
    words, unit = _WORDS_AND_UNITS[match[1]]
    return Quantity(name, name.replace("_", " "), f"{words} at a point", "stress", units=(unit,))
