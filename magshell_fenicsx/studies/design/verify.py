"""The best case of a design, run from its file on a finer mesh."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.case.design import DesignSection
from magshell_fenicsx.case.opened import opened
from magshell_fenicsx.runs.run import run
from magshell_fenicsx.runs.summary import Result
from magshell_fenicsx.shape.sections import MeshSurface
from magshell_fenicsx.simulate.gradients.barriers import BARRIER
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS, SCALES, Lost
from magshell_fenicsx.simulate.gradients.mass import MASS, mass
from magshell_fenicsx.simulate.gradients.results import vibration_at_end
from magshell_fenicsx.simulate.results import distances
from magshell_fenicsx.studies.design.evaluate import DISTANCE, Evaluation
from magshell_fenicsx.studies.design.problem import Problem

FAR = 0.3  # relative difference of a result that is another result
ROUNDING = 1e-12  # a smaller one is none


def verified(
    folder: Path,
    section: DesignSection,
    problem: Problem,
    best: Evaluation,
    comm: MPI.Intracomm,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """The results of best.yaml by `run` into verified/, and what its excluded modes say; collective."""
    case = opened(folder / "best.yaml", comm)
    settings = []
    if not isinstance(case.shell, MeshSurface):
        settings = [f"mesh.refinement={case.mesh.refinement * section.verify:.6g}"]
        case = opened(folder / "best.yaml", comm, settings)
    how = ", ".join(settings) or "on the mesh of the file"
    result = run(case, folder / "verified", comm, overwrite=True)  # the folder is the design's
    values = {name: _value(result, name) for name in problem.results if name not in problem.targets}
    seen = dict[str, float]()
    for target in problem.targets.values():
        seen["rms_distance"], seen[DISTANCE] = distances(result.scene, result.last, target)
    for name, value in (values | seen).items():
        here = best.values.get(name, best.seen.get(name))
        if value is None:
            say(f"verified ({how}): no {name}{f': {result.stopped}' if result.stopped else ''}")
        elif here is not None:
            away = value / here - 1
            say(f"verified ({how}): {name} = {value:.9g}, {_beside(away)} the design's {here:.9g}")
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
        size = result.scene.sizes.of[SCALES[name]] if name in SCALES else 1.0
        return next((size * float(p["value"]) for p in found), None)
    if name == BARRIER:
        return result.barrier
    if not result.rows:
        return None
    row = result.rows[-1]
    try:
        omega2 = vibration_at_end(result.scene, result.history, name)
    except Lost:
        return None
    return float((row | result.scene.sizes.values(row))[name]) if omega2 is None else omega2


def _beside(away: float) -> str:
    """A relative difference in words.

    Examples
    --------
    >>> _beside(-3.19e-8), _beside(1.62e-2), _beside(-8.9e-15)
    ('3.2e-06 % below', '1.6 % above', 'equal to')
    """
    if abs(away) < ROUNDING:
        return "equal to"
    return f"{100 * abs(away):.2g} % {'above' if away > 0 else 'below'}"
