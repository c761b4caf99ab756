"""Time and memory of a Newton iteration against unknowns, on several numbers of ranks; see
docs/scale.md.

`python3 -m speed.scale [--refinement R]... [--ranks N]... [--degree K] [--repeats N]`
"""

import argparse
import json
import sys
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from speed.items import WITH_CAMPAIGNS

from magshell_fenicsx.platform.environment import describe_machine, machine_fingerprint
from magshell_fenicsx.platform.processes import measure

PIECES = ("tangent", "factor", "back_solves", "residual")
DEFAULT = (
    1.0,
    2.0,
    4.0,
)  # 1.1e4, 3.0e4 and 9.7e4 unknowns at degree 4; 7.5 and 14 make 3e5 and 1e6
Row = Mapping[str, float]


class ScaleFailed(RuntimeError):
    """A measurement ended without numbers; the message has what it said."""


def row(refinement: float, degree: int, ranks: int, repeats: int) -> Row:
    """One mesh on some ranks, in processes of their own.

    Raises
    ------
    ScaleFailed
        If they do not end well.
    """
    arguments = ["scale", str(repeats), str(degree), str(refinement)]
    used = measure("speed.workload", arguments, ranks, WITH_CAMPAIGNS)
    if used.code:
        raise ScaleFailed(
            f"refinement {refinement:g} on {ranks} ranks: exit code {used.code}: "
            f"{used.errors.strip()}"
        )
    found = json.loads(
        next(line for line in used.output.splitlines() if line.startswith("{"))
    )  # MPI may say more
    return {**found, "ranks": ranks, "peak_mb": used.peak_mb or float("nan")}


def iteration(row: Row, kind: str) -> float:
    """Seconds of one Newton iteration: tangent, factorisation, two back-solves, residual."""
    return sum(row[f"{piece}_{kind}_s"] for piece in PIECES)


def exponent(rows: Sequence[Row], kind: str) -> float:
    """p of time ~ unknowns^p, by least squares of the logarithms."""
    x, y = np.log([r["dofs"] for r in rows]), np.log([iteration(r, kind) for r in rows])
    return float(np.polyfit(x, y, 1)[0])


def table(rows: Iterable[Row]) -> list[str]:
    """Markdown: CPU seconds of all ranks, wall seconds and peak memory."""
    names = [
        "unknowns",
        "ranks",
        *(p.replace("_", "-") for p in PIECES),
        "iteration, CPU s",
        "wall s",
        "peak GB",
    ]
    lines = ["| " + " | ".join(names) + " |", "| " + " | ".join("---" for _ in names) + " |"]
    for r in rows:
        times = [f"{r[f'{piece}_cpu_s']:.3g}" for piece in PIECES]
        sums = [f"{iteration(r, kind):.3g}" for kind in ("cpu", "wall")]
        cells = [
            f"{r['dofs']:.0f}",
            f"{r['ranks']:.0f}",
            *times,
            *sums,
            f"{r['peak_mb'] / 1024:.2f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def main(words: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="speed.scale", description="time and memory against unknowns"
    )
    parser.add_argument(
        "--refinement",
        type=float,
        nargs="+",
        default=DEFAULT,
        help="of the mesh; 14 makes 1e6 unknowns",
    )
    parser.add_argument("--ranks", type=int, nargs="+", default=(1, 2))
    parser.add_argument("--degree", type=int, choices=(2, 3, 4, 5), default=4)
    parser.add_argument(
        "--repeats", type=int, default=3, help="iterations, of which the medians are told"
    )
    given = parser.parse_args(words)
    rows = []
    try:
        for refinement in given.refinement:
            for ranks in given.ranks:
                rows.append(row(refinement, given.degree, ranks, given.repeats))
                print(json.dumps(rows[-1]), flush=True)
    except ScaleFailed as e:
        sys.exit(f"scale: {e}")
    print(describe_machine(machine_fingerprint()), *table(rows), sep="\n")
    for ranks in given.ranks:
        those = [r for r in rows if r["ranks"] == ranks]
        if len({r["dofs"] for r in those}) > 1:
            powers = ", ".join(f"{kind} {exponent(those, kind):.2f}" for kind in ("cpu", "wall"))
            print(f"{ranks} ranks: time of an iteration ~ unknowns^p, p by {powers}")


if __name__ == "__main__":
    main(sys.argv[1:])
