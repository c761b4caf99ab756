"""The arch in time against its measured ramp, step and triangle: `python3 -m benchmarks.arch_snap`.

Draws docs/benchmarks/arch_snap.png and prints the numbers of its page.
"""

import csv
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import find_peaks

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.public import run

FILE = Path(__file__).parents[1] / "arch_snap.yaml"
REFERENCE = Path(__file__).parent / "reference"
PICTURE = Path(__file__).parents[2] / "docs" / "benchmarks" / "arch_snap.png"
RATE = 16.25 / 2.5  # mT/s
SNAPPED = 5.0  # mm
HISTORIES = {
    "ramp": ["loading.3.points=1000"],
    "step": [
        "loading.3.history.field={kind: step, to: 5 mT}",
        "loading.3.duration=0.8 s",
        "loading.3.points=400",
    ],
    "triangle": [
        "loading.3.history.field={kind: triangle, size: 16.25 mT, period: 10 s}",
        "loading.3.duration=10 s",
        "loading.3.points=2500",
    ],
}
SHOWN = {"ramp": (0.6, 1.4), "step": (0.0, 0.8), "triangle": (0.0, 10.0)}
Array = NDArray[np.float64]


def computed(settings: list[str]) -> Array:
    """(n, 2): time in s and mid-span change of deflection in mm."""
    rows = [row for row in run(Case.load(FILE, settings)).rows if int(row["step"]) == 4]
    found = np.array([[float(row["time"]), -1e3 * float(row["middle_uz"])] for row in rows])
    return found - [0.0, found[0, 1]]


def measured(name: str) -> Array:
    """The same as digitised."""
    with (REFERENCE / f"tan_arch_{name}.csv").open(encoding="utf-8") as file:
        return np.array(
            [[float(row["time_s"]), float(row["midspan_mm"])] for row in csv.DictReader(file)]
        )


def crossing(curve: Array, level: float) -> float:
    """The first time at which a curve crosses a level."""
    i = int(np.argmax(curve[:, 1] > level))
    return float(np.interp(level, curve[i - 1 : i + 1, 1], curve[i - 1 : i + 1, 0]))


def ringing(curve: Array, after: float, last: float) -> tuple[float, float]:
    """Period in s between the first peaks in some time, and the ratio of successive ones above the
    rest.
    """
    part = curve[(curve[:, 0] > after) & (curve[:, 0] < last)]
    peaks = part[find_peaks(part[:, 1], prominence=0.1)[0]][:3]
    rest = part[-len(part) // 4 :, 1].mean()
    above = peaks[:, 1] - rest
    return float(np.diff(peaks[:, 0]).mean()), float(
        (above[-1] / above[0]) ** (1 / (len(above) - 1))
    )


def main() -> None:
    """Run the histories, print the numbers, draw the figure."""
    figure = Figure(figsize=(9.2, 3.1), dpi=200, layout="constrained")
    for axes, (name, settings) in zip(figure.subplots(1, 3), HISTORIES.items(), strict=True):
        ours, theirs = computed(settings), measured(name)
        if name != "step":
            snap = [RATE * crossing(each, SNAPPED) for each in (ours, theirs)]
            print(
                f"{name}: {SNAPPED:g} mm at {snap[0]:.3f} mT, measured {snap[1]:.3f} mT "
                f"({snap[0] / snap[1] - 1:+.1%})"
            )
        after, last = (0.9, 1.2) if name == "ramp" else (0.0, 0.5)
        if name != "triangle":
            for who, each in (("computed", ours), ("measured", theirs)):
                period, ratio = ringing(each, after, last)
                print(
                    f"{name}, {who}: largest {each[:, 1].max():.3f} mm, "
                    f"period {period:.4f} s, ratio {ratio:.3f}"
                )
        axes.plot(*theirs.T, ".", color="C1", markersize=3.5, label="measured")
        axes.plot(*ours.T, color="C0", linewidth=1, label="computed")
        axes.set(xlabel="time (s)", title=name, xlim=SHOWN[name])
    figure.axes[0].set_ylabel("mid-span change of deflection (mm)")
    figure.axes[0].legend(frameon=False, loc="lower right")
    content = BytesIO()
    figure.savefig(content, format="png")
    write_whole(PICTURE, content.getvalue())


if __name__ == "__main__":
    main()
