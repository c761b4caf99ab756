"""Titles of pictures, in matplotlib's mathematics."""

from collections.abc import Sequence

from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.quantities.quantity import spelled
from magshell_fenicsx.quantities.registry import amplitude, shown


def shell_caption(h: float, nu: float, row: Row) -> str:
    """R/h, Poisson's ratio and the field, from the thickness h over R and nu."""
    text = rf"$R/h$ = {1 / h:.6g}, $\nu$ = {nu:g}"
    return text + (f", {named_value('lambda_m', row)}" if row["lambda_m"] else "")


def caption(h: float, nu: float, row: Row, own: Sequence[str] = ()) -> str:
    """The shell and its loads at a point.

    Parameters
    ----------
    own
        Names of user-defined amplitudes, columns of the row.

    Examples
    --------
    >>> row = {"lambda_m": 0.0, "field_angle": 0.0, "p_over_pc": 0.25, "amplitude": "pressure"}
    >>> caption(0.01, 0.5, row | {"my_springs": 0.02}, own=["my_springs"])
    '$R/h$ = 100, $\\\\nu$ = 0.5, $p/p_\\\\mathrm{c}$ = 0.25, my springs = 0.02'
    """
    parts = [shell_caption(h, nu, row)]
    if row["field_angle"]:
        parts.append(rf"turned by ${row['field_angle']:.4g}\degree$")
    if row["p_over_pc"]:
        parts.append(named_value("p_over_pc", row, 5))
    if row.get("force"):
        parts.append(f"{named_value('force', row)}, {named_value('w_over_h', row)} {amplitude('force').place}")
    if "load_factor" in row:
        parts.append(f"{named_value('load_factor', row)}, {named_value('w_over_h', row)}")
    if row["amplitude"] == "time":
        parts.append(named_value("time", row))
    parts += [named_value(name, row) for name in own if row[name]]
    return ", ".join(parts)


def named_value(name: str, row: Row, digits: int = 4) -> str:
    """A column of a row, in the case's units if it has any."""
    q = shown(name, row)
    unit = q.si.replace("%", r"\%") if q.name != name else ""
    return f"{q.latex} = {in_mathematics(float(row[q.name]), digits)}{f' {unit}' if unit else ''}"


def in_mathematics(value: float, digits: int) -> str:
    """A number with so many digits, with a power of ten where Python has an exponent.

    Examples
    --------
    >>> in_mathematics(0.32623, 4), in_mathematics(-5.5, 4), in_mathematics(-1.5e-06, 4)
    ('0.3262', '−5.5', '$-1.5 \\\\times 10^{-6}$')
    """
    mantissa, _, exponent = spelled(value, f".{digits}g").partition("e")
    return rf"${mantissa} \times 10^{{{int(exponent)}}}$" if exponent else mantissa.replace("-", "−")
