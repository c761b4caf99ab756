"""Scenes whose numbers are those of the finite elements alone: no mesh of theirs is made by gmsh.

half_disc.msh is the chart of a dimpled half hemisphere, as gmsh 4.13 triangulated it.
`python3 tests/versions/version_scenes.py` prints the numbers of the versions that it runs on.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from magshell_fenicsx import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.mesh.msh import MeshFile, read_msh
from magshell_fenicsx.mesh.patch import PatchMesh
from magshell_fenicsx.platform.environment import versions
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.public import Scene
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Record

HERE = Path(__file__).parent
CASES = HERE.parents[1] / "cases"
Numbers = dict[str, float]


@dataclass(frozen=True)
class ProblemOnFile(Problem):
    """A problem of a dimpled half hemisphere, R/h = 90, on the triangulation in the file."""

    def _triangulation(self) -> PatchMesh:
        patch = read_msh(
            MeshFile(HERE / "half_disc.msh", 1.0),
            {k: np.append(x, 0.0) for k, x in self.points.items()},
        )
        edges = {"equator" if name == "rim" else name: edge for name, edge in patch.edges.items()}
        return replace(
            patch,
            nodes=patch.nodes[:, :2],
            embedding=self.embedding,
            points=self.points,
            edges=edges,
        )


def _scene(file: str, *settings: str, on_file: bool = False) -> Scene:
    case = Case.load(CASES / file, settings)
    if not on_file:
        return Scene(case)
    problem = make_problem(case)
    values = {f.name: getattr(problem, f.name) for f in fields(Problem) if f.init}
    return Scene(ProblemOnFile(**values))


def _end(scene: Scene) -> Record:
    *_, last = follow(scene)
    return last


def _modes(scene: Scene, record: Record) -> Numbers:
    modes = ShellModes(scene.model).lowest(record.point.state, 2)
    return {
        f"eigenvalue {n} {mode.label}".strip(): mode.eigenvalue for n, mode in enumerate(modes[:4])
    }


def meridian() -> Numbers:
    """One dimension: buckling under a field; forms assembled into matrices for the waves around the
    axis.
    """
    scene = _scene("dimple_buckling.yaml", "magnetic.lambda_m=0.00184")
    records = list(follow(scene))
    fold = next(r for r in records if r.label == "fold")
    return {"k_d": fold.point.state.mu["pressure"], **_modes(scene, records[1])}


def half_shell() -> Numbers:
    """Buckling of the dimpled shell, and the modes of its fields' state."""
    scene = _scene(
        "dimple_buckling.yaml", "symmetry=half", "magnetic.lambda_m=0.00184", on_file=True
    )
    records = list(follow(scene))
    fold = next(r for r in records if r.label == "fold")
    return {"k_d": fold.point.state.mu["pressure"], **_modes(scene, records[1])}


def indentation() -> Numbers:
    """A point force at 45 degrees under a field that is not parallel to the remanence; energies at
    the end.
    """
    tilted = "magnetic={lambda_m: 0.00184, remanent: {polar: 0}, applied: {polar: 45}}"
    dimple = "shell.defect={kind: dimple, amplitude: 1.64, width: 3.2}"
    depth = ("loading.depth=3", "loading.points=3")
    scene = _scene("indentation.yaml", dimple, tilted, *depth, on_file=True)
    records = [r for r in follow(scene) if r.label == "target"]
    ends = scene.observe(records[-1].point.state)
    told = {
        name: ends[name]
        for name in ("stretching", "bending", "magnetic", "volume_change", "w_pole_over_h")
    }
    return {
        f"force {n}": scene.observe(r.point.state)["force"] for n, r in enumerate(records, 1)
    } | told


def mesh_file() -> Numbers:
    """Flat triangles with a fold, from a file."""
    scene = _scene("bracket.yaml")
    ends = scene.observe(_end(scene).point.state)
    return {name: ends[name] for name in ("tip_ux", "tip_uz", "energy")}


def grid() -> Numbers:
    """A pinched quarter of a sphere on a grid of its chart."""
    scene = _scene(
        "benchmarks/hemisphere_hole.yaml", "loading.points=1", "loading.factor=0.1", "mesh.size=4"
    )
    ends = scene.observe(_end(scene).point.state)
    return {name: ends[name] for name in ("A_ux", "B_uy", "stretching", "bending")}


def solid() -> Numbers:
    """Hexahedra of a neo-Hookean body under pressure and a field."""
    fixed = "loading={kind: pressure, control: load, until: target, pressure: 0.05, points: 1}"
    scene = _scene(
        "solid_buckling.yaml", "symmetry=half", "magnetic.lambda_m=0.00184", fixed, on_file=True
    )
    ends = scene.observe(_end(scene).point.state)
    return {name: ends[name] for name in ("w_pole_over_h", "volume_change", "energy")}


SCENES: dict[str, Callable[[], Numbers]] = {
    scene.__name__: scene for scene in (meridian, half_shell, indentation, mesh_file, grid, solid)
}


if __name__ == "__main__":
    print(
        json.dumps(
            {"versions": versions(), **{name: scene() for name, scene in SCENES.items()}}, indent=2
        )
    )
