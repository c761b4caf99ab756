"""What stands above pictures, with matplotlib's mathematics."""

from collections.abc import Sequence

from magshell_fenicsx.output.store.table import Row


def shell_caption(h: float, nu: float, row: Row) -> str:
    """The shell, its thickness over R and Poisson's ratio, and the field that it is in."""
    said = rf"$R/h$ = {1 / h:.6g}, $\nu$ = {nu:g}"
    return said + (rf", $\lambda_\mathrm{{m}}$ = {row['lambda_m']:.4g}" if row["lambda_m"] else "")


def caption(h: float, nu: float, row: Row, own: Sequence[str] = ()) -> str:
    """A point: the shell and its loads.

    Parameters
    ----------
    own
        Names of one's own amplitudes, columns of the row.

    Examples
    --------
    >>> row = {"lambda_m": 0.0, "field_angle": 0.0, "p_over_pc": 0.25, "amplitude": "pressure"}
    >>> caption(0.01, 0.5, row | {"foundation": 0.02}, own=["foundation"])
    '$R/h$ = 100, $\\\\nu$ = 0.5, $p/p_\\\\mathrm{c}$ = 0.25, foundation = 0.02'
    """
    said = [shell_caption(h, nu, row)]
    if row["field_angle"]:
        said.append(rf"turned by ${row['field_angle']:.4g}\degree$")
    if row["p_over_pc"]:
        said.append(rf"$p/p_\mathrm{{c}}$ = {row['p_over_pc']:.5g}")
    if row["amplitude"] == "force":
        said.append(rf"$FR/2\pi D$ = {row['force']:.4g}, $w/h$ = {row['w_over_h']:.4g} at the load")
    if "load_factor" in row:
        said.append(f"load factor = {row['load_factor']:.4g}, $w/h$ = {row['w_over_h']:.4g}")
    said += [f"{name.replace('_', ' ')} = {row[name]:.4g}" for name in own if row[name]]
    return ", ".join(said)
