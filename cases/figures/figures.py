"""The figures of Pezzulla, Yan and Reis: sweeps of the cases in cases/figures/, their numbers and
pictures.

`make figures`, or `python3 -m figures.figures [NAME]...`; what has been computed is kept.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.output.store.folder import access_disk
from magshell_fenicsx.output.store.table import write_csv
from magshell_fenicsx.studies.sweep.picture import loaded
from magshell_fenicsx.studies.sweep.sweep import Sweep, sweep, sweep_row

CASES = Path(__file__).parent
OUT = Path("results") / "figures"
ENERGY, FIELD = "magnetic.energy", "magnetic.lambda_m"
LAMBDA = f"{FIELD}=0,0.00184,-0.00184"
PAPER = f"{ENERGY}=full,second,first,torque"  # parallel fields: second_consistent is second
ALL = f"{PAPER},second_consistent"

COLOURS = {0.0: "black", 0.00184: "tab:red", -0.00184: "tab:blue"}
NAMES = {
    "full": "full",
    "second": r"second order  $\mathcal{U}_\mathrm{m}^{\,2}$",
    "first": r"first order  $\mathcal{U}_\mathrm{m}^{\,1}$",
    "torque": r"torque  $\mathcal{U}_\mathrm{m}^{\,q}$",
    "second_consistent": "second order, consistent",
}
MARKED: dict[str, dict[str, Any]] = {
    "full": {"linestyle": "-"},
    "second": {"linestyle": "", "marker": "o", "fillstyle": "none"},
    "first": {"linestyle": "", "marker": (8, 2, 0), "markersize": 7},
    "torque": {"linestyle": "", "marker": "D", "fillstyle": "none", "markersize": 5},
    "second_consistent": {"linestyle": "--", "linewidth": 0.8},
}
LINES: dict[str, dict[str, Any]] = {
    "full": {"linestyle": "-"},
    "second": {"linestyle": ":", "linewidth": 2},
    "first": {"linestyle": "--", "linewidth": 1},
    "torque": {"linestyle": "-.", "linewidth": 1},
}


@dataclass(frozen=True)
class Figure:
    """One figure: a sweep of a case, and what is drawn of it.

    Attributes
    ----------
    along
        The swept key on the horizontal axis; "" for indentation curves.
    """

    case: str
    over: tuple[str, ...]
    along: str
    x_label: str
    title: str


FIGURES = {
    "indentation": Figure(
        "indentation.yaml",
        (LAMBDA, PAPER),
        "",
        r"displacement at the load  $w/h$",
        "Indentation at 45° under a vertical field",
    ),
    "aligned": Figure(
        "coplanar.yaml",
        (LAMBDA, PAPER, "magnetic.remanent.polar+magnetic.applied.polar=0:90:13"),
        "magnetic.applied.polar",
        r"polar angle of both  $\varphi^\mathrm{r} = \varphi^\mathrm{a}$  (degrees)",
        "(a) Pressure buckling, magnetisation and field parallel",
    ),
    "tilted": Figure(
        "coplanar.yaml",
        (LAMBDA, ALL, "magnetic.applied.polar=0:90:13"),
        "magnetic.applied.polar",
        r"polar angle of the field  $\varphi^\mathrm{a}$  (degrees)",
        r"(b) Pressure buckling, vertical magnetisation, $\varphi^\mathrm{r} = 0$",
    ),
    "noncoplanar": Figure(
        "noncoplanar.yaml",
        (LAMBDA, ALL, "magnetic.applied.azimuth=0:180:13"),
        "magnetic.applied.azimuth",
        r"azimuth between magnetisation and field  $\varphi$  (degrees)",
        "(c) Pressure buckling, both at 45° to the equator, not coplanar",
    ),
}


def make(name: str, out: Path = OUT) -> Sweep:
    """Compute a figure's sweep, then write its numbers and its picture; collective."""
    figure = FIGURES[name]
    done = sweep(CASES / figure.case, figure.over, out=out / name, make_case=Case.from_source)

    def write() -> None:
        rows, y = (knockdowns(done), "delta_k_d") if figure.along else (curves(done), "force")
        write_csv(rows, list(rows[0]), out / f"{name}.csv")
        draw(figure, rows, figure.along or "w_over_h", y, out / f"{name}.png")

    access_disk(MPI.COMM_WORLD, write)
    return done


def knockdowns(done: Sweep) -> list[dict[str, Any]]:
    """A row for every point with a field: k_d, and its change from the shell without a field."""
    pairs = list(zip(done.points, done.outcomes, strict=True))
    none = next(o.knockdown for p, o in pairs if not p.case.lambda_m)
    rows = []
    for point, outcome in pairs:
        if point.case.lambda_m:
            found = sweep_row(outcome)
            change = (
                outcome.knockdown - none
                if outcome.knockdown is not None and none is not None
                else None
            )
            kept = {
                key: found[key]
                for key in ("w_pole_over_h", "kind", "mode", "stopped", "dofs", "wall_s")
            }
            rows.append({**point.values, "k_d": outcome.knockdown, "delta_k_d": change, **kept})
    return rows


def curves(done: Sweep) -> list[dict[str, Any]]:
    """A row for every accepted point under the force; without a field the energies are one."""
    keys = ("label", "w_over_h", "force", "w_pole_over_h")
    return [
        {**point.values, **{key: row[key] for key in keys}}
        for point, outcome in zip(done.points, done.outcomes, strict=True)
        if point.case.lambda_m or point.values[ENERGY] == "full"
        for row in loaded(outcome.curve, "force")
    ]


def draw(figure: Figure, rows: Sequence[dict[str, Any]], x: str, y: str, file: Path) -> None:
    """Draw as the paper does: colours are the sign of lambda_m, styles the energy."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D

    styles = MARKED if figure.along else LINES
    picture, axes = plt.subplots(figsize=(7.6, 4.6), layout="constrained")
    axes.axhline(0, color="0.8", linewidth=0.8, zorder=0)
    groups = list(dict.fromkeys((row[FIELD], row[ENERGY]) for row in rows))
    for field, energy in groups:
        line = [
            row
            for row in rows
            if (row[FIELD], row[ENERGY]) == (field, energy) and row[y] is not None
        ]
        xy = [float(row[x]) for row in line], [row[y] for row in line]
        axes.plot(*xy, color=COLOURS[float(field)], **styles[energy])
        if line[-1].get("label") == "step":
            axes.plot(xy[0][-1], xy[1][-1], "x", color=COLOURS[float(field)], markersize=5)
    shown = {float(field) for field, _ in groups}
    legend = [
        Line2D([], [], color=c, label=rf"$\lambda_\mathrm{{m}} = {f:+g}$" if f else "no field")
        for f, c in COLOURS.items()
        if f in shown
    ]
    used = {energy for _, energy in groups}
    legend += [
        Line2D([], [], color="0.3", label=NAMES[e], **style)
        for e, style in styles.items()
        if e in used
    ]
    if not figure.along:
        legend.append(
            Line2D(
                [], [], color="0.3", linestyle="", marker="x", label="the displacement turns back"
            )
        )
    picture.legend(handles=legend, loc="outside right upper", frameon=False, fontsize=9)
    change = r"change of the knockdown factor  $\Delta k_\mathrm{d}$"
    axes.set(xlabel=figure.x_label, ylabel=change if figure.along else r"force  $FR/(2\pi D)$")
    if figure.along:
        axes.set_xticks(sorted({float(row[x]) for row in rows})[::2])
    axes.set_title(figure.title, fontsize=10)
    picture.savefig(file, dpi=200)
    plt.close(picture)


def main(names: Sequence[str]) -> int:
    """Make the named figures, or all; curves that end at a fold are part of them, so that is no
    error.
    """
    for name in names:
        if name not in FIGURES:
            print(f"{name}: no such figure; there are {', '.join(FIGURES)}", file=sys.stderr)
            return 2
    for name in names or FIGURES:
        make(name)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
