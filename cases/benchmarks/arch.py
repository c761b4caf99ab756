"""The bistable magnetic arch against its measured ramp: `python3 -m benchmarks.arch` draws
docs/benchmarks/arch.png.
"""

import csv
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.public import run

FILE = Path(__file__).parents[1] / "arch.yaml"
RAMP = Path(__file__).parent / "reference" / "tan_arch_ramp.csv"
PICTURE = Path(__file__).parents[2] / "docs" / "benchmarks" / "arch.png"
RATE = 16.25 / 2.5  # mT/s
Array = NDArray[np.float64]


def ramp(rows: list[Row], case: Case) -> Array:
    """(n, 2): the field in mT during the last step, and the mid-span change of deflection since
    zero field in mm.
    """
    assert case.magnetic
    assert case.magnetic.applied.flux_density
    unit = 1e3 * case.magnetic.applied.flux_density / case.lambda_m
    last = max(int(row["step"]) for row in rows)
    start = next(i for i, row in enumerate(rows) if int(row["step"]) == last) - 1
    curve = np.array(
        [[unit * float(row["lambda_m"]), -1e3 * float(row["middle_uz"])] for row in rows[start:]]
    )
    curve[:, 1] -= np.interp(0.0, *curve[:2].T)
    return curve


def measured() -> Array:
    """(n, 2): field in mT and mid-span change of deflection in mm, as digitised."""
    with RAMP.open(encoding="utf-8") as file:
        return np.array(
            [
                [RATE * float(row["time_s"]), float(row["midspan_mm"])]
                for row in csv.DictReader(file)
            ]
        )


def first_fold(rows: list[Row]) -> int:
    """Number of the row with the first fold of the field."""
    return next(
        i for i, row in enumerate(rows) if row["label"] == "fold" and row["amplitude"] == "lambda_m"
    )


def main() -> None:
    """Run the case and draw the figure."""
    case = Case.load(FILE)
    rows = run(case).rows
    curve, points, fold = ramp(rows, case), measured(), first_fold(rows)
    start = len(rows) - len(curve)
    figure = Figure(figsize=(4.6, 3.4), dpi=200, layout="constrained")
    axes = figure.subplots()
    axes.plot(*points.T, ".", color="C1", markersize=4, label="measured, 6.5 mT/s")
    stable = np.array(
        [int(row["negative_pivots"]) + int(row["excluded_pivots"]) == 0 for row in rows[start:]]
    )
    for style, which in (("-", stable), ("--", ~stable)):
        axes.plot(curve[:, 0], np.where(which, curve[:, 1], np.nan), style, color="C0")
    at = curve[fold - start]
    axes.plot(*at, "o", color="C3", label=f"first fold, {at[0]:.3g} mT")
    axes.set(
        xlabel="applied field (mT)", ylabel="mid-span change of deflection (mm)", xlim=(-8, 16.5)
    )
    axes.legend(frameon=False, loc="lower right")
    content = BytesIO()
    figure.savefig(content, format="png")
    write_whole(PICTURE, content.getvalue())


if __name__ == "__main__":
    main()
