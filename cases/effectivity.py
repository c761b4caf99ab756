"""Effectivity: estimated errors of results over true ones, by twice as fine a mesh, of degree 5.

`make effectivity`, or `python3 -m effectivity [CASE]...`, prints a table for docs/accuracy.md.
"""

import sys
import time
from dataclasses import dataclass
from math import isfinite, nan
from pathlib import Path

from mpi4py import MPI

from magshell_fenicsx import Case
from magshell_fenicsx.public import Result, run

CASES = Path(__file__).parent


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes
    ----------
    case, result
        Name of the case file, and name of the result as in `errors` of summary.json.
    refinement, degree
        The mesh whose error is estimated.
    settings
        Further settings as of `--set`.
    what
        The kind of the result in words.
    """

    case: str
    result: str
    what: str
    refinement: float = 1.0
    degree: int = 3
    settings: tuple[str, ...] = ()

    def run(self, *, finer: bool) -> Result:
        """Return the run on the mesh of the row, or on twice as fine a mesh of degree 5."""
        refinement, degree = (2 * self.refinement, 5) if finer else (self.refinement, self.degree)
        mesh = f"mesh.degree={degree}", f"mesh.refinement={refinement}"
        return run(Case.load(CASES / f"{self.case}.yaml", [*self.settings, *mesh]))


POLE = "loading.depth=2", "loading.points=2"
ROWS = [
    Row("dimple_buckling", "knockdown", "fold, meridian"),
    Row("dimple_buckling", "knockdown", "fold, half", 0.5, settings=("symmetry=half",)),
    Row("dimple_buckling", "volume_change@end", "volume at a fold"),
    Row("cylinder_waves", "knockdown", "9 waves on a meridian", 0.5),
    Row("cap_waves_branch", "knockdown", "5 waves on a meridian", 0.5),
    Row("dome_on_wall", "knockdown", "waves beside a body", 0.5),
    Row("bistable_dome", "critical_field", "fold in a field", 0.5),
    Row("bistable_dome", "w_mm@end", "displacement in a field", 0.5),
    Row("pole_indentation", "force@end", "force at a depth", 0.5, settings=POLE),
    Row("pole_indentation", "force@end", "the same, half", 0.5, 3, ("symmetry=half", *POLE)),
    Row("probing", "barrier", "energy barrier", 0.5),
    Row("plate_contact", "force@end", "force on a body", 0.5),
    Row("balloon", "limit_load", "rubber, largest pressure", 0.5),
    Row("arch", "critical_field", "fold of a strip", 0.5),
    Row("strip_buckling", "critical_field", "pitchfork of a strip", 0.5, 2),
    Row("laminated_roof", "limit_load", "plies", 0.5),
    Row("spinning_blade", "w_over_h@end", "spin", 0.5),
    Row("magnetic_strip", "w_over_h@end", "strip in a field", 0.5),
]


def value(result: Result, name: str) -> float:
    """Return a result of a run by its name in `errors`; nan if the run does not have it."""
    if name.endswith("@end"):
        last = [row for row in result.rows if not row["branch"]][-1]
        return float(last[name.removesuffix("@end")])
    if name == "limit_load":
        return float(result.limit_points[0]["value"]) if result.limit_points else nan
    number = getattr(result, name)
    return nan if number is None else float(number)


def line(row: Row) -> str:
    """Return a row of the table in Markdown."""
    start = time.process_time()
    result = row.run(finer=False)
    path_s = time.process_time() - start
    estimate, reasons = result.errors.get(row.result, nan), result.error_estimates.reasons
    share = (time.process_time() - start - path_s) / path_s
    coarse, fine = (value(each, row.result) for each in (result, row.run(finer=True)))
    true_error = abs(coarse - fine)
    cells = [
        f"`{row.case}` {' '.join(row.settings)}".strip(),
        f"{row.what}: `{row.result}`",
        f"{row.degree}, {row.refinement:g}",
        f"{coarse:.7g}",
        f"{true_error / abs(fine):.1e}",
        f"{estimate / true_error:.2f}" if isfinite(estimate) else "; ".join(reasons.values()),
        f"{100 * share:.0f} %",
    ]
    return f"| {' | '.join(cells)} |"


def main(cases: list[str]) -> None:
    """Print the table, of some cases or of all."""
    heads = "case", "result", "degree, refinement", "value", "relative error", "effectivity", "CPU"
    print(f"| {' | '.join(heads)} |\n|{' --- |' * len(heads)}", flush=True)
    for row in ROWS:
        if not cases or row.case in cases:
            print(line(row), flush=True)


if __name__ == "__main__":
    assert MPI.COMM_WORLD.size == 1
    main(sys.argv[1:])
