"""What stands above pictures, with matplotlib's mathematics."""

from collections.abc import Sequence

from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.quantities.registry import amplitude, quantity


def shell_caption(h: float, nu: float, row: Row) -> str:
    """The shell, its thickness over R and Poisson's ratio, and the field that it is in."""
    said = rf"$R/h$ = {1 / h:.6g}, $\nu$ = {nu:g}"
    return said + (f", {_value('lambda_m', row)}" if row["lambda_m"] else "")


def caption(h: float, nu: float, row: Row, own: Sequence[str] = ()) -> str:
    """A point: the shell and its loads.

    Parameters
    ----------
    own
        Names of one's own amplitudes, columns of the row.

    Examples
    --------
    >>> row = {"lambda_m": 0.0, "field_angle": 0.0, "p_over_pc": 0.25, "amplitude": "pressure"}
    >>> caption(0.01, 0.5, row | {"my_springs": 0.02}, own=["my_springs"])
    '$R/h$ = 100, $\\\\nu$ = 0.5, $p/p_\\\\mathrm{c}$ = 0.25, my springs = 0.02'
    """
    said = [shell_caption(h, nu, row)]
    if row["field_angle"]:
        said.append(rf"turned by ${row['field_angle']:.4g}\degree$")
    if row["p_over_pc"]:
        said.append(_value("p_over_pc", row, 5))
    if row["amplitude"] == "force":
        said.append(f"{_value('force', row)}, {_value('w_over_h', row)} {amplitude('force').place}")
    if "load_factor" in row:
        said.append(f"{_value('load_factor', row)}, {_value('w_over_h', row)}")
    said += [_value(name, row) for name in own if row[name]]
    return ", ".join(said)


def _value(name: str, row: Row, digits: int = 4) -> str:
    return f"{quantity(name).latex} = {row[name]:.{digits}g}"
