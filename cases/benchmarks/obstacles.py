"""The popular nonlinear shell benchmarks: whole curves against Sze, Liu and Lo (2004), at several
meshes.

`make benchmarks`, or `python3 -m benchmarks.obstacles [NAME]...`, writes docs/benchmarks/; runs
that are complete in results/benchmarks/, by the same sources, are taken as they are. The table is
of all: with a NAME it is left alone.

The published numbers are of a shear-flexible, finite-strain element (S4R of ABAQUS) on one mesh
each; see docs/benchmarks/README.md for the sources.
"""

import argparse
import csv
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.obstacles_table import Line, draw, draw_beams, write
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.output.pictures.lines import smooth
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.run_identity import OtherSources
from magshell_fenicsx.public import run
from magshell_fenicsx.runs.files import AlreadyComplete

CASES = Path(__file__).parent
OUT = CASES.parents[1] / "docs" / "benchmarks"
RESULTS = Path("results") / "benchmarks"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Obstacle:
    """A benchmark.

    Attributes
    ----------
    case, table
        The case, and the published curve in cases/benchmarks/reference/.
    columns
        Column of the table -> column of path.csv that it is, "-" before it for the other sign.
    required
        Largest difference along the curve, over the largest displacement.
    refinements
        Meshes, coarse to fine, as of `mesh.refinement`.
    second
        The curve of another code beside the published one, with the columns of path.csv.
    """

    case: str
    table: str
    columns: dict[str, str]
    required: float
    refinements: tuple[float, ...] = (0.5, 1.0, 2.0)
    second: str | None = None


SHEAR = {"minus_u_tip": "-A_ux", "w_tip": "A_uz"}
EXACT = {"minus_u_tip_exact": "-A_ux", "w_tip_exact": "A_uz"}
PULLED = {"w_A": "A_ux", "minus_u_B": "-B_uy", "minus_u_C": "-C_uy"}
OBSTACLES = [
    Obstacle("cantilever_end_shear", "cantilever_end_shear", SHEAR, 5e-3),
    Obstacle("cantilever_end_moment", "cantilever_end_moment", EXACT, 5e-3),
    Obstacle(
        "slit_annular_plate",
        "slit_annular_plate",
        {"w_inner": "inner_uz", "w_outer": "outer_uz"},
        5e-3,
    ),
    Obstacle(
        "hemisphere_hole",
        "hemisphere_18deg_hole",
        {"outward_at_pulled_point": "A_ux", "inward_at_pushed_point": "-B_uy"},
        5e-3,
    ),
    Obstacle("cylinder_pullout", "cylinder_pullout", PULLED, 1e-2),
    Obstacle(
        "pinched_cylinder",
        "pinched_cylinder_diaphragms",
        {"minus_w_A": "-A_ux", "u_B": "B_uy"},
        1e-2,
        second="pinched_cylinder_calculix",
    ),
    Obstacle(
        "pinched_semicylinder",
        "pinched_semicylinder",
        {"minus_w_A_isotropic": "-A_ux"},
        1e-2,
        (0.5, 1.0),
    ),
    Obstacle("hinged_roof_12.7", "hinged_roof_12.7_isotropic", {"minus_w_C": "-C_ux"}, 1e-2),
    Obstacle("hinged_roof_6.35", "hinged_roof_6.35_isotropic", {"minus_w_C": "-C_ux"}, 1e-2),
]


def published(table: str, column: str) -> Array:
    """(n, 2): displacement and load factor."""
    with (CASES / "reference" / f"{table}.csv").open(encoding="utf-8") as file:
        return np.array(
            [[float(row[column]), float(row["load_factor"])] for row in csv.DictReader(file)]
        )


def second_opinion(obstacle: Obstacle) -> dict[str, Array]:
    """The same of another code, by column of the table; empty where there is none."""
    if obstacle.second is None:
        return {}
    with (CASES / "reference" / f"{obstacle.second}.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {column: _curve(rows, ours) for column, ours in obstacle.columns.items()}


def computed(rows: Sequence[Mapping[str, Any]], column: str) -> Array:
    """The same of a run's path, every accepted point of it."""
    return _curve(
        [row for row in rows if row["label"] != "bifurcation" and not int(row["branch"])], column
    )


def _curve(rows: Sequence[Mapping[str, Any]], column: str) -> Array:
    sign, key = (-1.0, column[1:]) if column.startswith("-") else (1.0, column)
    return np.array([[sign * float(row[key]), float(row["load_factor"])] for row in rows])


def along_curve(curve: Array, reference: Array) -> float:
    """Largest distance of the reference points from a curve; displacements over their largest,
    loads over one.

    Points beyond the curve's largest load are left out.
    """
    scale = np.array([np.abs(reference[:, 0]).max(), 1.0])
    fine = smooth(*(curve / scale).T).T
    start, way = fine[:-1], np.diff(fine, axis=0)
    length = np.maximum((way**2).sum(axis=1), 1e-30)
    farthest = 0.0
    for point in reference[reference[:, 1] <= curve[:, 1].max() + 1e-9] / scale:
        t = np.clip(((point - start) * way).sum(axis=1) / length, 0, 1)
        farthest = max(
            farthest, float(np.linalg.norm(start + t[:, None] * way - point, axis=1).min())
        )
    return farthest


def at_equal_load(curve: Array, reference: Array) -> float | None:
    """Largest difference of displacements at equal loads, over the largest; None where the load
    turns back.
    """
    if (np.diff(curve[:, 1]) < 0).any() or (np.diff(reference[:, 1]) < 0).any():
        return None
    found = []
    for value, load in reference:
        nearest = curve[np.argmin(np.abs(curve[:, 1] - load))]
        if abs(nearest[1] - load) < 1e-6:
            found.append(abs(nearest[0] - value))
    return float(max(found) / np.abs(reference[:, 0]).max())


def measured(obstacle: Obstacle, refinement: float) -> tuple[Line, list[dict[str, str]]]:
    """Run a benchmark on a mesh, unless its folder in results/ has it already; its path."""
    case = Case.load(CASES / f"{obstacle.case}.yaml", [f"mesh.refinement={refinement:g}"])
    found, rows = finished(case, RESULTS / f"{obstacle.case}_{refinement:g}")
    of: dict[str, Callable[[Array, Array], float | None]] = {
        "along": along_curve,
        "equal": at_equal_load,
    }
    errors = {
        kind: {
            column: error(computed(rows, ours), published(obstacle.table, column))
            for column, ours in obstacle.columns.items()
        }
        for kind, error in of.items()
    }
    line = Line(
        name=obstacle.case,
        refinement=refinement,
        cells=found["mesh"]["cells"],
        unknowns=found["mesh"]["dofs"],
        points=len(rows),
        factorisations=found["factorisations"],
        along=errors["along"],
        equal=errors["equal"],
        required=obstacle.required,
        turns=sum(row["label"] == "fold" for row in rows),
        stopped=found["stopped"] or "",
    )
    return line, rows


def finished(case: Case, folder: Path) -> tuple[dict[str, Any], list[dict[str, str]]]:
    """Summary and path of a case. It runs, unless its folder has a run by these sources."""
    with suppress(AlreadyComplete):
        try:
            run(
                case,
                folder,
                resume=(folder / "checkpoint").exists() or (folder / "summary.json").exists(),
            )
        except OtherSources:
            print(f"{folder} is of other sources of magshell_fenicsx: again", flush=True)
            run(case, folder)
    with (folder / "path.csv").open(encoding="utf-8") as file:
        return json.loads((folder / "summary.json").read_text(encoding="utf-8")), list(
            csv.DictReader(file)
        )


def hard_magnetic(which: str) -> tuple[Array, Array]:
    """Computed and measured (n, 2): field in mT, tip deflection over the length."""
    case = Case.load(CASES / f"hard_magnetic_{which}.yaml")
    _, rows = finished(case, RESULTS / f"hard_magnetic_{which}")
    assert case.magnetic
    assert case.magnetic.applied.flux_density
    unit = 1e3 * case.magnetic.applied.flux_density / case.lambda_m
    length = case.points["tip"][0]
    curve = np.array(
        [[unit * float(row["lambda_m"]), abs(float(row["tip_uz"])) / length] for row in rows]
    )
    with (CASES / "reference" / f"hard_magnetic_beam_{which}.csv").open(encoding="utf-8") as file:
        points = [
            (float(row["field_mT"]), float(row["tip_deflection_over_length"]))
            for row in csv.DictReader(file)
        ]
    return curve, np.array(points)


def main() -> None:
    """Run the benchmarks that are named, or all."""
    known = [*(obstacle.case for obstacle in OBSTACLES), "hard_magnetic"]
    parser = argparse.ArgumentParser(description="The nonlinear benchmarks; by default all.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(known))
    names = parser.parse_args().names
    if unknown := set(names) - set(known):
        parser.error(f"{min(unknown)}: there is no such benchmark; there are {', '.join(known)}")
    if not names or "hard_magnetic" in names:
        beams = {which: hard_magnetic(which) for which in ("bending", "reversal")}
        write_whole(OUT / "hard_magnetic.png", draw_beams(beams))
    lines = []
    for obstacle in OBSTACLES:
        if names and obstacle.case not in names:
            continue
        for refinement in obstacle.refinements:
            line, rows = measured(obstacle, refinement)
            lines.append(line)
            print(line, flush=True)
        curves = {
            column: (computed(rows, ours), published(obstacle.table, column))
            for column, ours in obstacle.columns.items()
        }
        write_whole(
            OUT / f"{obstacle.case}.png", draw(obstacle.case, curves, second_opinion(obstacle))
        )
    if not names:
        write(lines, OUT / "obstacles.csv")


if __name__ == "__main__":
    main()
