"""The columns of path.csv and the amplitudes as tables of docs/case.md."""

from collections.abc import Iterable, Sequence

from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import AMPLITUDES, QUANTITIES

HEAD = """
## The columns of path.csv

One row for each accepted point. The numbers are dimensionless: multiply a number by its unit to get the quantity in SI.
A case with units has more columns at the end, which are in them already: those of "with units", `NAME_ux_mm` of
points, and `NAME_fx_N` and `NAME_mx_N_m` of supports. Terminal, pictures, report and sweeps then show these.
Named points add `NAME_ux`, `NAME_uy` and `NAME_uz`, in the unit of the shell's lengths. Where supports move, or with
`reactions: true`, every support adds its reaction on the shell: the forces `NAME_fx`, `NAME_fy` and `NAME_fz`, and the
moments `NAME_mx`, `NAME_my` and `NAME_mz` about the middle of the support's bounding box, where the support is now; in
N and N m if the case has units, else in its own (over E R² and E R³ if it has no lengths). A user-defined energy adds a
column with its name: its amplitude.
"""
AMPLITUDES_HEAD = """
The column `amplitude` names the amplitude that varied:
"""


def columns_page() -> str:
    """Both tables in Markdown."""
    columns = [
        (f"`{q.name}`", f"{q.html} {q.note}".strip() if q.symbol else q.words, q.unit, q.si, _in_units(q), q.meaning)
        for q in QUANTITIES.values()
    ]
    amplitudes = [(f"`{a.name}`", f"`{a.column}`", f"`{a.conjugate}`") for a in AMPLITUDES.values()]
    return "\n".join(
        [
            HEAD,
            *_table(("column", "label", "unit", "SI unit", "with units", "meaning"), columns),
            AMPLITUDES_HEAD,
            *_table(("amplitude", "column of its value", "displacement of its curve"), amplitudes),
            "",
        ]
    )


def _in_units(q: Quantity) -> str:
    return "" if q.kind == "text" else " or ".join(f"`{each.name}`" for each in q.in_units)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [head, ["---"] * len(head), *rows]
    return [f"| {' | '.join(cell.replace('|', '&#124;') for cell in line)} |" for line in lines]
