"""Effectivity: estimated errors of results over true ones, by twice as fine a mesh, of degree 5.

`make effectivity`, or `python3 -m effectivity [CASE or KIND]...`, prints a table for
docs/accuracy.md.
"""

import sys
from dataclasses import dataclass
from math import isfinite, nan
from pathlib import Path
from tempfile import TemporaryDirectory

import gmsh
from mpi4py import MPI

from magshell_fenicsx import Case
from magshell_fenicsx.public import Result, run

CASES = Path(__file__).parent.parent


# problems that others asked in public, and shells far from the ordinary ones
TEXTS = {
    "plate_on_its_edges": """
shell:
  {geometry: plate, length: 1, width: 1, thickness: 0.01, youngs_modulus: 1.0e9, poisson_ratio: 0.3}
boundary: {left: hinged, right: hinged, bottom: hinged, top: hinged}
points: {middle: [0.5, 0.5, 0]}
loading:
  {kind: dead, loads: [{over: all, pressure: 1}], factor: 0.001, control: load, points: 1}
reactions: true
mesh: {size: 0.25}
""",
    "tube_under_live_pressure": """
shell:
  {geometry: cylinder, radius: 0.5, length: 0.25, azimuth: [0, 90], thickness: 0.005,
  youngs_modulus: 1, poisson_ratio: 0.3}
boundary: {left: symmetry, right: symmetry, bottom: symmetry, top: symmetry}
loading: {kind: pressure, control: load, until: bifurcation}
mesh: {size: 0.2}
""",
    "twisted_tube": """
shell:
  {geometry: cylinder, radius: 1, length: 6, thickness: 0.066667, youngs_modulus: 1,
  poisson_ratio: 0.3}
boundary: {bottom: clamped, top: clamped}
loading:
  kind: edge
  name: twist
  moves: [{supports: [top], rotation: {axis: [0, 0, 1], point: [0, 0, 6], angle: 30}}]
  until: bifurcation
mesh: {size: 1}
""",
    "cantilever_plate": """
shell:
  {geometry: plate, length: 1, width: 1, thickness: 0.01, youngs_modulus: 1, poisson_ratio: 0.3}
boundary: {left: clamped}
frequencies: {count: 3, at: end}
mesh: {size: 0.34}
""",
    "beam_of_two_moduli": """
shells:
  soft:
    shell:
      {geometry: plate, length: 1, width: 0.2, thickness: 0.02, youngs_modulus: 1,
      poisson_ratio: 0.3}
    boundary: {left: clamped}
  stiff:
    shell:
      {geometry: plate, length: 1, width: 0.2, thickness: 0.02, youngs_modulus: 10000,
      poisson_ratio: 0.3}
    place: {position: [1, 0, 0]}
    points: {tip: [1, 0.1, 0]}
joints: [{edges: [soft.right, stiff.left]}]
loading:
  {kind: dead, loads: [{edge: stiff.right, force: [0, 0, -1]}], factor: 1.0e-8, control: load,
  points: 1}
mesh: {size: 0.25}
""",
    "rubber_disc": """
shell:
  {geometry: disc, radius: 10 mm, thickness: 0.5 mm, youngs_modulus: 3 MPa, poisson_ratio: 0.5,
  law: neo-hookean}
boundary: {rim: clamped}
loading: {kind: pressure, control: arc, until: limit}
""",
    "rubber_cap": """
shell:
  {geometry: cap, radius: 1, polar: 40, thickness: 0.02, youngs_modulus: 1, poisson_ratio: 0.5,
  law: neo-hookean}
boundary: {rim: clamped}
loading: {kind: pressure, control: arc, until: limit}
""",
}


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes
    ----------
    case, result
        Name of a case file or of `TEXTS`, and name of the result as in `errors` of summary.json.
    refinement, degree
        The mesh whose error is estimated. A refinement of 0 stands for a mesh file.
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

    def run(self, folder: Path, *, finer: bool) -> Result:
        """Return the run on the mesh of the row, or on twice as fine a mesh of degree 5.

        The folder is for files that the case needs, and for the results of the run.
        """
        mesh = [f"mesh.degree={5 if finer else self.degree}"]
        if self.refinement:
            mesh.append(f"mesh.refinement={(1 + finer) * self.refinement}")
        elif finer:
            mesh.append(f"shell.file={finer_mesh(self.case, folder)}")
        file = CASES / f"{self.case}.yaml"
        if self.case in TEXTS:
            file = folder / f"{self.case}.yaml"
            file.write_text(TEXTS[self.case])
        case = Case.load(file, [*self.settings, *mesh])
        return run(case, folder / "results", pictures=False, overwrite=True)


def finer_mesh(case: str, folder: Path) -> Path:
    """Return the file of a mesh half as coarse as that of a case, from the same outline."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("Mesh.MeshSizeFactor", 0.5)
    gmsh.open(str(CASES.parent / "meshes" / f"{case}.geo"))
    gmsh.model.mesh.generate(2)
    gmsh.write(str(folder / f"{case}.msh"))
    gmsh.finalize()
    return folder / f"{case}.msh"


HALF, POLE = "symmetry=half", ("loading.depth=2", "loading.points=2")
THIN, TAPER = "shell.radius_to_thickness=2000", 'shell.thickness_factor="0.3 + 1.4*z"'
FIRST = "loading.branches=false", "loading.until=bifurcation", "loading.factor=null"
ROWS = [
    Row("dimple_buckling", "knockdown", "fold, meridian"),
    Row("dimple_buckling", "knockdown", "fold, half", 0.5, settings=(HALF,)),
    Row("dimple_buckling", "volume_change@end", "volume at a fold"),
    Row("cylinder_waves", "knockdown", "9 waves on a meridian", 0.5),
    Row("cap_waves_branch", "knockdown", "5 waves on a meridian", 0.5),
    Row("dome_on_wall", "knockdown", "waves beside a body", 0.5),
    Row("bistable_dome", "critical_field", "fold in a field", 0.5),
    Row("bistable_dome", "w_mm@end", "displacement in a field", 0.5),
    Row("pole_indentation", "force@end", "force at a depth", 0.5, settings=POLE),
    Row("pole_indentation", "force@end", "the same, half", 0.5, 3, (HALF, *POLE)),
    Row("probing", "barrier", "energy barrier", 0.5),
    Row("plate_contact", "force@end", "force on a body", 0.5),
    Row("balloon", "limit_load", "rubber, largest pressure", 0.5),
    Row("arch", "critical_field", "fold of a strip", 0.5),
    Row("strip_buckling", "critical_field", "pitchfork of a strip", 0.5, 2),
    Row("laminated_roof", "limit_load", "plies", 0.5),
    Row("spinning_blade", "w_over_h@end", "spin", 0.5),
    Row("magnetic_strip", "w_over_h@end", "strip in a field", 0.5),
    Row("free_plate", "omega2_7", "frequency", 0.5),
    # models, loads and kinds of results that these have not
    Row("dimple_buckling", "knockdown", "fold, sector of 45°", 0.5, settings=("symmetry=4",)),
    Row("bracket", "tip_uz@end", "mesh file", 0, settings=("shell.poisson_ratio=0.3",)),
    Row("stiffened_plate", "w_over_h@end", "two shells, T-junction", 0.5),
    Row("crease", "load_factor@end", "two shells, crease", 0.5),
    Row("coaxial_domes", "load_factor@end", "two shells in contact", 0.5),
    Row("standing_strip", "limit_load", "weight", 0.5, 2),
    Row("shortened_strip", "limit_load", "moved edges", 1, 2, FIRST),
    Row("hall_sensor", "hall_Bz@end", "sensor", 0.5),
    Row("foundation", "w_over_h@end", "foundation", 0.5),
    Row("rod_contact", "force@end", "sharp body", 0.5),
    Row("saturated_strip", "w_over_h@end", "soft magnet", 0.5, 2),
    # extremes
    Row("dimple_buckling", "knockdown", "R/h = 2000", 0.5, settings=(THIN,)),
    Row("dimple_buckling", "knockdown", "steep taper", 0.5, settings=(TAPER,)),
    Row("beam_of_two_moduli", "w_over_h@end", "moduli 1 to 10 000"),
    Row("dimple_buckling", "knockdown", "coarse mesh", 0.2),
    Row("natural_strip", "w_over_h@end", "rolled by 180°", 0.5, 2, ("loading.curvature=0.5",)),
    Row("rubber_disc", "limit_load", "rubber, R/h = 20", degree=4),
    Row("rubber_cap", "limit_load", "rubber cap", 0.5),
    # questions from public forums
    Row("plate_on_its_edges", "w_over_h@end", "plate under pressure"),
    Row("plate_on_its_edges", "left_fz@end", "reaction", settings=("boundary.left=clamped",)),
    Row("tube_under_live_pressure", "knockdown", "tube in plane strain"),
    Row("twisted_tube", "limit_load", "torsion"),
    Row("cantilever_plate", "omega2_1", "frequency of a cantilever"),
]


def value(result: Result, name: str) -> float:
    """Return a result of a run by its name in `errors`; nan if the run does not have it."""
    if name.endswith("@end"):
        last = [row for row in result.rows if not row["branch"]][-1]
        return float(last[name.removesuffix("@end")])
    if name.startswith("omega2_"):
        modes = list(result.frequencies.values())[-1]
        return modes[int(name.removeprefix("omega2_")) - 1].eigenvalue
    if name == "limit_load":
        return float(result.limit_points[0]["value"]) if result.limit_points else nan
    number = getattr(result, name)
    return nan if number is None else float(number)


def load_error(result: Result) -> float:
    """Return the error of the solver in the load at the first instability of a run."""
    return float(result.limit_points[0]["load_error"]) if result.limit_points else 0.0


def line(row: Row) -> str:
    """Return a row of the table in Markdown."""
    with TemporaryDirectory() as name:
        coarse_run, fine_run = (row.run(Path(name), finer=finer) for finer in (False, True))
    coarse, fine = (value(each, row.result) for each in (coarse_run, fine_run))
    estimates, true_error = coarse_run.error_estimates, abs(coarse - fine)
    estimate = estimates.errors.get(row.result, nan)
    effectivity = f"{estimate / true_error:.2f}"
    if not isfinite(estimate):
        reason = estimates.reasons.get(row.result) or next(iter(estimates.reasons.values()))
        effectivity = f"none: {reason}"
    elif true_error < max(map(load_error, (coarse_run, fine_run))):
        effectivity = "below the error of the solver"
    has_warning = row.result in coarse_run.large_errors or bool(estimates.too_coarse)
    cells = [
        f"`{row.case}` {' '.join(row.settings)}".strip(),
        f"{row.what}: `{row.result}`",
        f"{row.degree}, {row.refinement:g}" if row.refinement else f"{row.degree}, of the file",
        f"{coarse:.7g}",
        f"{true_error / abs(fine):.1e}",
        effectivity,
        "yes" if has_warning else "",
    ]
    return f"| {' | '.join(cells)} |"


def main(names: list[str]) -> None:
    """Print the table, of some cases or kinds of results, or of all."""
    heads = (
        "case",
        "result",
        "degree, refinement",
        "value",
        "relative error",
        "effectivity",
        "warning",
    )
    print(f"| {' | '.join(heads)} |\n|{' --- |' * len(heads)}", flush=True)
    for row in ROWS:
        if not names or {row.case, row.what} & set(names):
            try:
                print(line(row), flush=True)
            except (Exception, SystemExit) as e:
                print(f"| {row.case} {row.what} | {type(e).__name__} {e}", flush=True)


if __name__ == "__main__":
    assert MPI.COMM_WORLD.size == 1
    main(sys.argv[1:])
