"""The table of the extremes, for people and for programs."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from magshell_fenicsx.output.store.table import write_csv

INTRO = """# Extremes

What becomes of shells far from the ordinary ones: `make extremes` runs every case of \
`cases/extreme/` in the variants
below and writes this table and `extremes.csv`.

- **outcome**: *reached* what the case asked for, or *stopped* and why; \
then the instabilities on the way.
- **value**: of the first instability (for `inside_out` of the first fold in the force), \
or the displacement at the end
  (tip over length for `slivers`, pole over thickness for `nothing`). \
**error** is against an independent solution or,
  in *italics*, against our own at degree 5 on a mesh twice as fine.
- **smallest step**: the least motion of the pole over h between two accepted points.
- **condition**: largest over smallest |eigenvalue| of the tangent, \
of the undeformed shell and at the last point; at a
  fold or bifurcation the latter has no bound but rounding.

"""
HEAD = ["family", "variant", "outcome", "value", "error", "points", "iterations", "factorisations"]
HEAD += ["smallest step", "condition", "unknowns", "s"]


@dataclass(frozen=True)
class Line:
    """A row of the table.

    Attributes
    ----------
    value, reference, source
        What is compared, with what, and where that is from: "reference" or "finer mesh".
    smallest_step
        Of the pole, over h; None if there was no step.
    condition_undeformed, condition_last
        Of the tangent.
    """

    family: str
    variant: str
    outcome: str
    value: float | None
    reference: float | None
    source: str
    points: int
    iterations: int
    factorisations: int
    smallest_step: float | None
    condition_undeformed: float
    condition_last: float
    unknowns: int
    seconds: float

    @property
    def error(self) -> float | None:
        """Relative; absolute where the reference is zero."""
        if self.value is None or self.reference is None:
            return None
        return abs(self.value - self.reference) / (abs(self.reference) or 1.0)


def write(lines: Sequence[Line], out: Path) -> None:
    """Write README.md and extremes.csv."""
    out.mkdir(parents=True, exist_ok=True)
    rows = [{**asdict(line), "error": line.error} for line in lines]
    write_csv(rows, list(rows[0]), out / "extremes.csv")
    table = [HEAD, ["---"] * len(HEAD), *map(cells, lines)]
    text = "\n".join(f"| {' | '.join(row)} |" for row in table)
    (out / "README.md").write_text(f"{INTRO}{text}\n", encoding="utf-8")


def cells(line: Line) -> list[str]:
    """What the table shows of a row."""
    error = _number(line.error, ".1e")
    return [
        line.family,
        f"`{line.variant}`" if line.variant else "",
        line.outcome,
        _number(line.value, ".7g"),
        f"*{error}*" if error and line.source == "finer mesh" else error,
        *map(str, (line.points, line.iterations, line.factorisations)),
        _number(line.smallest_step, ".1e"),
        f"{line.condition_undeformed:.0e}, {line.condition_last:.0e}",
        str(line.unknowns),
        f"{line.seconds:.1f}",
    ]


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, f"z{form}")
