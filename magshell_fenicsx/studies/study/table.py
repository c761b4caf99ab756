"""The table of a study: study.md."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from magshell_fenicsx.studies.study.machine import described
from magshell_fenicsx.studies.study.reference import Reference
from magshell_fenicsx.studies.study.rows import Row
from magshell_fenicsx.studies.sweep.points import short

FORMS = {
    "result": ".9g",
    "error": ".1e",
    "peak_mb": ".0f",
    **dict.fromkeys(("wall_s", "cpu_s", "jit_s", "setup_s", "assembly_s", "factor_s", "solve_s", "output_s"), ".3g"),
}
SHOWN = (
    *("cells", "dofs", "result", "error", "wall_s", "cpu_s", "jit_s", "setup_s", "assembly_s", "factor_s", "solve_s"),
    *("output_s", "peak_mb", "factorisations", "iterations", "stopped"),
)
LEGEND = """Wall and CPU seconds are for the whole process with its files, kernels compiled; the phases are as in
summary.json; the peak is the resident memory of all ranks. **Bold**: no other run is both faster and more accurate.
"""


def write_table(rows: Sequence[Row], keys: Sequence[str], content: dict[str, Any], file: Path) -> None:
    """Write study.md.

    Parameters
    ----------
    keys
        The swept keys.
    content
        The content of study.json.
    """
    head = [*map(short, keys), "ranks", *(name.replace("_s", " (s)").replace("_mb", " (MB)") for name in SHOWN)]
    lines = [head, ["---"] * len(head)]
    for row in rows:
        cells = [_cell(row, key) for key in (*keys, "ranks", *SHOWN)]
        lines.append([f"**{cell}**" if row["pareto"] and cell else cell for cell in cells])
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    file.write_text(
        f"# {content['result']} of {content['case']}: error against run time\n\n"
        f"{content['reference_said']} {repeated(content['repeat'])} on {described(content['machine'])}.\n"
        f"{LEGEND}\n![](study.png)\n\n{table}\n",
        encoding="utf-8",
    )


def repeated(repeat: int) -> str:
    """How often each point was run.

    Examples
    --------
    >>> repeated(1), repeated(3)
    ('One run each', 'Medians of 3 runs')
    """
    return f"Medians of {repeat} runs" if repeat > 1 else "One run each"


def reference_sentence(reference: Reference | None) -> str:
    """The reference of the errors, as a sentence."""
    if reference is None:
        return "No run gave the result."
    value = f"Errors are relative to {reference.value:.10g} ({reference.source}"
    if reference.source == "given":
        return f"{value})."
    if reference.error is None:
        return f"{value}; its own error is not known: it has no coarser mesh to compare with)."
    how = f"observed order {reference.order:.2g}" if reference.order else "the last difference: no order was observed"
    return f"{value}; its own error is estimated at {reference.error:.1e}, {how}): smaller errors mean nothing."


def _cell(row: Row, key: str) -> str:
    value = row[key]
    if value is None:
        return ""
    return format(value, FORMS[key]) if key in FORMS else str(value).replace("|", "/").replace("\n", " ")
