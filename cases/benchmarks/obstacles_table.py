"""The table and the pictures of the nonlinear benchmarks."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.pictures.lines import smooth
from magshell_fenicsx.output.store.table import write_csv

Array = NDArray[np.float64]
HEAD = (
    "benchmark",
    "refinement",
    "cells",
    "unknowns",
    "along the curve",
    "at equal load",
    "required",
    "factorisations",
)


@dataclass(frozen=True)
class Line:
    """One benchmark on one mesh.

    Attributes
    ----------
    along, equal
        By column of the published table: the largest difference over the largest displacement,
        along the curve and at equal loads (None where the load turns back).
    turns
        Folds of the load on the path.
    """

    name: str
    refinement: float
    cells: int
    unknowns: int
    points: int
    factorisations: int
    along: Mapping[str, float | None]
    equal: Mapping[str, float | None]
    required: float
    turns: int
    stopped: str


def rows(lines: Sequence[Line]) -> list[dict[str, Any]]:
    """One row for each quantity."""
    return [
        {
            "benchmark": line.name,
            "refinement": line.refinement,
            "cells": line.cells,
            "unknowns": line.unknowns,
            "points": line.points,
            "folds": line.turns,
            "quantity": column,
            "along_curve": line.along[column],
            "at_equal_load": line.equal[column],
            "required": line.required,
            "factorisations": line.factorisations,
            "stopped": line.stopped,
        }
        for line in lines
        for column in line.along
    ]


def markdown(lines: Sequence[Line]) -> str:
    """The table for people: the worst quantity of each run."""
    table = [list(HEAD), ["---"] * len(HEAD)]
    for line in lines:
        worst = max(value for value in line.along.values() if value is not None)
        equal = [value for value in line.equal.values() if value is not None]
        table.append(
            [
                line.name,
                f"{line.refinement:g}",
                str(line.cells),
                str(line.unknowns),
                f"{worst:.2%}",
                f"{max(equal):.2%}" if equal else "turns back",
                f"{line.required:.1%}",
                str(line.factorisations),
            ]
        )
    return "\n".join(f"| {' | '.join(row)} |" for row in table) + "\n"


def write(lines: Sequence[Line], file: Path) -> None:
    """Write the CSV and, beside it, the same for people."""
    found = rows(lines)
    write_csv(found, list(found[0]), file)
    file.with_suffix(".md").write_text(
        f"# The obstacle course: all meshes\n\n{markdown(lines)}", encoding="utf-8"
    )


def draw(
    title: str, curves: Mapping[str, tuple[Array, Array]], second: Mapping[str, Array]
) -> bytes:
    """Computed curves (n, 2) of displacement and load factor, published points, another code's
    curves; a PNG file.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(4.8, 3.6), layout="constrained")
    for number, (name, (curve, reference)) in enumerate(curves.items()):
        axes.plot(*smooth(*curve.T), color=f"C{number}", label=name.replace("_", " "))
        axes.plot(*reference.T, "o", color=f"C{number}", markersize=3.5, markerfacecolor="none")
        if name in second:
            axes.plot(*second[name].T, "+", color=f"C{number}", markersize=4)
    axes.plot(
        [],
        [],
        "o",
        color="0.4",
        markersize=3.5,
        markerfacecolor="none",
        label="published, or exact",
    )
    if second:
        axes.plot([], [], "+", color="0.4", markersize=4, label="a second code")
    axes.set(xlabel="displacement (the case's unit of length)", ylabel="load factor")
    axes.set_title(title.replace("_", " "), fontsize=9)
    axes.axhline(0, color="0.8", linewidth=0.8, zorder=0)
    axes.legend(frameon=False, fontsize=8)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=170)
    plt.close(figure)
    return content.getvalue()


def draw_beams(beams: Mapping[str, tuple[Array, Array]]) -> bytes:
    """Hard-magnetic cantilevers, computed curves and measured points (n, 2) by name; a PNG file."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(4.8, 3.6), layout="constrained")
    said = {"bending": "field across the beam", "reversal": "field against the magnetisation"}
    for number, (name, (curve, measured)) in enumerate(beams.items()):
        axes.plot(*curve.T, color=f"C{number}", label=said[name])
        axes.plot(*measured.T, "o", color=f"C{number}", markersize=4, markerfacecolor="none")
    axes.plot(
        [],
        [],
        "o",
        color="0.4",
        markersize=4,
        markerfacecolor="none",
        label="measured, Zhao et al. (2019)",
    )
    axes.set(
        xlabel="applied field  (mT)",
        ylabel="tip deflection over length",
        ylim=(0, None),
        xlim=(0, None),
    )
    axes.legend(frameon=False, fontsize=8)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=170)
    plt.close(figure)
    return content.getvalue()
