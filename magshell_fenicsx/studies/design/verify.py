"""The best case of a design, run from its file on a finer mesh."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.design import DesignSection
from magshell_fenicsx.case.surfaces import MeshSurface
from magshell_fenicsx.run.run import run
from magshell_fenicsx.run.summary import Result
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS
from magshell_fenicsx.simulate.gradients.mass import MASS, mass
from magshell_fenicsx.simulate.results import distances
from magshell_fenicsx.studies.design.evaluate import DISTANCE, Evaluation
from magshell_fenicsx.studies.design.problem import Problem

FAR = 0.3  # relative difference of a result that is another result


def verified(
    folder: Path,
    section: DesignSection,
    problem: Problem,
    best: Evaluation,
    comm: MPI.Intracomm,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """The results of best.yaml by `run` into verified/, and what its excluded modes say; collective."""
    case = Case.load(folder / "best.yaml")
    settings = []
    if not isinstance(case.shell, MeshSurface):
        settings = [f"mesh.refinement={case.mesh.refinement * section.verify:.6g}"]
        case = Case.load(folder / "best.yaml", settings)
    result = run(case, folder / "verified", comm)
    values = {name: _value(result, name) for name in problem.results if name not in problem.targets}
    seen = dict[str, float]()
    for target in problem.targets.values():
        seen["rms_distance"], seen[DISTANCE] = distances(result.scene, result.last, target)
    for name, value in (values | seen).items():
        here = best.values.get(name, best.seen.get(name))
        if value is None:
            say(f"verified ({', '.join(settings)}): no {name}{f': {result.stopped}' if result.stopped else ''}")
        elif here is not None:
            away = value / here - 1
            say(f"verified ({', '.join(settings)}): {name} = {value:.9g}, {away:+.2e} of {here:.9g}")
            if abs(away) > FAR:
                say(f"warning: {name} is another one there: the mesh is too coarse, or there are several equilibria")
    modes = [f"{p['kind']} {p['mode']}".strip() for p in result.limit_points if p["mode"]]
    if modes and not any(name in FOLDS for name in problem.results):
        say(f"warning: the run sees modes that the design did not: {', '.join(modes)}")
    excluded = int(result.rows[-1]["excluded_pivots"]) if result.rows else 0
    return {"settings": settings, **values, **seen, "excluded_modes": modes, "excluded_pivots": excluded}


def _value(result: Result, name: str) -> float | None:
    """A result of a run: the first instability of a fold's amplitude, excluded modes too."""
    if name == MASS:
        return mass(result.scene)[0]
    if name in FOLDS:
        found = (p for p in result.limit_points if p["amplitude"] == FOLDS[name] and not p["branch"])
        return next((float(p["value"]) for p in found), None)
    return float(result.rows[-1][name]) if result.rows else None
