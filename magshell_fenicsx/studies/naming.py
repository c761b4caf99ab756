"""Keys and results as a paper names them, for pictures.

A key is a path of words with dots into the case; a result is a column of path.csv or a number of a
run, whose name may end with its unit. An amplitude is a load parameter, by name.
"""

import re
from collections.abc import Mapping
from typing import Any

from magshell_fenicsx.quantities.registry import (
    QUANTITIES,
    amplitude,
    endings,
    field_columns,
    quantity,
    shown_quantity,
)
from magshell_fenicsx.studies.points import Axis, short_key

UNITS = {"polar": "degrees", "azimuth": "degrees"}
NAMES = {  # words and symbol of keys
    "poisson_ratio": ("Poisson's ratio", r"$\nu$"),
    "radius_to_thickness": ("radius over thickness", "$R/h$"),
    "youngs_modulus": ("Young's modulus", "$E$"),
    # the strength of a field has the same name in a case and in path.csv
    **{name: (quantity(name).words, quantity(name).latex) for name in field_columns()},
}


def key_words(key: str, unit: str = "") -> str:
    """Return the name of a key on an axis.

    The name of a magnetic field says whose it is, and that of a step which step.

    Parameters
    ----------
    unit
        Unit of the values; "" without.

    Examples
    --------
    >>> key_words("magnetic.applied.flux_density"), key_words("shell.radius_to_thickness")
    ('applied flux density', 'radius over thickness  $R/h$')
    >>> key_words("shell.defect.amplitude"), key_words("shell.defect.amplitude", "mm")
    ('amplitude over $h$', 'amplitude')
    >>> key_words("loading.0.factor")
    'factor of step 1'
    >>> key_words("magnetic.applied.sources.0.position.2"), key_words("shell.polar")
    ('position z', 'polar angle of shell')
    """
    name = short_key(key)
    if name in NAMES:
        return "  ".join(part for part in NAMES[name] if part)
    if name == "amplitude" and not unit:
        return "amplitude over $h$"
    *_, parent, last_word = ("", *key.split("."))  # a key of one word has the parent ""
    # a flux density says of what field, and a number of which list
    needs_parent = last_word == "flux_density" or last_word.isdigit()
    words = f"{parent} {last_word}" if needs_parent else name
    if last_word in UNITS:
        words = f"{last_word} angle of {parent}" if parent else f"{last_word} angle"
    # the numbers of coordinates become their letters
    words = re.sub(r"^position ([012])$", lambda axis: f"position {'xyz'[int(axis[1])]}", words)
    step = re.match(r"loading\.(\d+)\.", key)
    return words.replace("_", " ") + (f" of step {int(step[1]) + 1}" if step else "")


def key_label(key: str, unit: str = "") -> str:
    """Return a key and its unit as the label of an axis."""
    unit = unit or UNITS.get(key.split(".")[-1], "")
    return key_words(key, unit) + (f"  ({unit})" if unit else "")


def axis_label(axis: Axis) -> str:
    """Return the label of an axis of a sweep, with all its tied keys."""
    *tied_keys, last_key = axis.keys
    return " = ".join(
        [*(key_words(key, axis.unit) for key in tied_keys), key_label(last_key, axis.unit)]
    )


def key_symbol(key: str) -> str:
    r"""Return the text of a key before its value: its symbol with a sign of equality, or its words.

    Examples
    --------
    >>> key_symbol("shell.poisson_ratio"), key_symbol("mesh.degree")
    ('$\\nu$ = ', 'degree ')
    """
    symbol = NAMES.get(short_key(key), ("", ""))[1]
    return f"{symbol} = " if symbol else f"{key_words(key)} "


def load_text(row: Mapping[str, Any], name: str) -> str:
    """Return the load of a row of a boundary as text, in the case's units if the row has them.

    Parameters
    ----------
    row
        Row of boundary.csv.
    name
        The amplitude of the load.

    Examples
    --------
    >>> load_text({"load": 0.5}, "pressure")
    'p/pc = 0.5'
    >>> load_text({"load": 0.5, "pressure_Pa": 61.25}, "pressure")
    'p = 61.25 Pa'
    """
    # the column in units if the row has it, else the one without
    load_quantity = shown_quantity(amplitude(name).column, row)
    value = row.get(load_quantity.name, row["load"])
    unit_text = f" {load_quantity.si}" if load_quantity.name in row else ""
    return f"{load_quantity.ascii_symbol} = {value:.9g}{unit_text}"


def split_unit(result: str) -> tuple[str, str] | None:
    """Return the name of a result without its unit, and the unit; None without a unit.

    The longest ending counts: N_m before m.
    """
    units = endings()
    for ending in sorted(units, key=len, reverse=True):
        if result.endswith(f"_{ending}"):
            return result.removesuffix(f"_{ending}"), units[ending]
    return None


def result_words(result: str) -> str:
    r"""Return a result in words or symbols, without its unit.

    Examples
    --------
    >>> result_words("tip_fz"), result_words("omega2_1")
    ('$f_z$ of tip', '$\\omega_{1}^2 \\rho R^2/E$')
    >>> result_words("hertz_2"), result_words("knockdown")
    ('frequency 2', 'knockdown factor  $k_\\mathrm{d}$')
    >>> result_words("tip_uz_mm"), result_words("buckling_pressure_Pa")
    ('$u_z$ of tip', 'buckling pressure')
    """
    if result == "shape":
        return "mean square distance over $R^2$"
    if result == "knockdown":
        return r"knockdown factor  $k_\mathrm{d}$"
    if number := re.fullmatch(r"omega2_(\d+)", result):
        return rf"$\omega_{{{number[1]}}}^2 \rho R^2/E$"
    if number := re.fullmatch(r"hertz_(\d+)", result):
        return f"frequency {number[1]}"
    result = name_and_unit[0] if (name_and_unit := split_unit(result)) else result
    if component := re.fullmatch(r"(.+)_([fum])([xyz])", result):
        return f"${component[2]}_{component[3]}$ of {component[1].replace('_', ' ')}"
    return result.replace("_", " ")


def result_label(result: str) -> str:
    r"""Return a result and its unit as the label of an axis, as the curve of a run names it.

    Examples
    --------
    >>> result_label("applied_mT"), result_label("tip_uz_mm"), result_label("hertz_1")
    ('applied field  $B_\\mathrm{a}$  (mT)', '$u_z$ of tip  (mm)', 'frequency 1  (Hz)')
    """
    # a registered quantity, or one of its columns in units, has its own label
    for column_quantity in QUANTITIES.values():
        for column in (column_quantity, *column_quantity.in_units):
            if column.name == result:
                return column.label
    unit = ""
    if result.startswith("hertz_"):
        unit = "Hz"
    elif name_and_unit := split_unit(result):
        unit = name_and_unit[1]
    return result_words(result) + (f"  ({unit})" if unit else "")
