"""Comparison of a case as a shell and as a solid."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.folder import by_first, given_folder, held_folder, refuse_others
from magshell_fenicsx.parts.magnetism.field_step import FieldBefore, RotationSection
from magshell_fenicsx.parts.motion.step import TimeSection
from magshell_fenicsx.studies.compare.curves import Difference, amplitude_of, differences, judged, places, time_at
from magshell_fenicsx.studies.compare.picture import draw_comparison
from magshell_fenicsx.studies.compare.runs import MODELS, ModelName, ModelRun, NothingLeft, run_model
from magshell_fenicsx.studies.study.reference import observed_order
from magshell_fenicsx.studies.sweep.table import write_csv

ONE_PERCENT = 0.01


@dataclass(frozen=True)
class Comparison:
    """The result of a comparison.

    Attributes
    ----------
    differences
        Differences between the curves of the finest runs.
    content
        The content of compare.json.
    """

    differences: list[Difference]
    content: dict[str, Any]


def compare(
    file: Path | str,
    settings: Sequence[str] = (),
    *,
    refinements: Mapping[ModelName, Sequence[float]],
    out: Path | str,
    say: Callable[[str], None] = print,
) -> Comparison:
    """Run a case with both models; write compare.csv, compare.json and compare.png, and a folder for each run.

    Every run is a separate process. Runs of the same case and sources that are in the folder are kept.

    Parameters
    ----------
    refinements
        Mesh refinements of each model. The finest runs are compared. Errors are relative to the limit that the
        three finest runs extrapolate to.

    Raises
    ------
    CaseError
        If the case is not valid for one of the models.
    NothingLeft
        If a run left no results.
    """
    file, folder = Path(file), given_folder(out)
    for model in MODELS:
        case = Case.load(file, [*settings, f"model={model}", *(["solid=null"] if model == "shell" else [])])
    if not case.programme or isinstance(case.programme[-1].load, FieldBefore | RotationSection | TimeSection):
        raise CaseError("compare: needs a load whose curve can be compared: pressure, indentation or field")
    with held_folder(folder, MPI.COMM_SELF, make=True):
        runs: dict[ModelName, list[ModelRun]] = {}
        tables = ("compare.json", "compare.csv", "compare.png")
        refuse_others(folder, tables, ("difference", "runs"), "a comparison", file.name)
        for model in MODELS:
            for refinement in sorted(set(refinements[model])):
                done = run_model(file, settings, model, refinement, folder / f"{model}_{refinement:g}", say)
                runs.setdefault(model, []).append(done)
                say(f"{model} at refinement {refinement:g}: {done.dofs} unknowns, {done.cpu_s:.1f} s CPU")
                if not amplitude_of(done):
                    raise NothingLeft(f"the {model} did not leave its undeformed state: {done.summary['stopped']}")
        shell, solid = (runs[model][-1] for model in MODELS)
        if amplitude_of(shell) != amplitude_of(solid):
            ends = [amplitude_of(run) for run in (shell, solid)]
            raise CaseError(f"compare: the shell ended while {ends[0]} varied, the solid while {ends[1]} did")
        found = differences(shell, solid)
        at = max(places([run for model in MODELS for run in runs[model]]), default=None)
        content = {"case": file.name, **_content(runs, at, found)}
        rows = [{**asdict(d), "relative": d.relative} for d in found]
        columns = (*(f.name for f in fields(Difference)), "relative")
        by_first(MPI.COMM_SELF, partial(write_csv, rows, columns, folder / "compare.csv"))
        by_first(
            MPI.COMM_SELF,
            partial(write_whole, folder / "compare.json", (json.dumps(content, indent=2) + "\n").encode()),
        )
        errors: dict[str, list[tuple[float, float]]] = {
            model: [(run["error"], run["cpu_s"]) for run in content["runs"][model] if run["error"]] for model in MODELS
        }
        title = f"{file.name} {' '.join(settings)}".strip()
        draw_comparison(shell, solid, found, errors, title, folder / "compare.png")
    return Comparison(found, content)


def parse_refinements(shell: str, solid: str) -> dict[ModelName, list[float]]:
    """Read the options.

    Raises
    ------
    CaseError
        If one is not a list of numbers from 0.1 to 20.

    Examples
    --------
    >>> parse_refinements("1", "0.5,1")
    {'shell': [1.0], 'solid': [0.5, 1.0]}
    """
    found: dict[ModelName, list[float]] = {}
    for model, text in zip(MODELS, (shell, solid), strict=True):
        try:
            found[model] = [float(part) for part in text.split(",")]
        except ValueError:
            found[model] = []
        if not found[model] or not all(0.1 <= r <= 20 for r in found[model]):
            raise CaseError(f"--{model} {text}: write refinements from 0.1 to 20, for example 0.5,0.7,1")
    return found


def _content(runs: dict[ModelName, list[ModelRun]], at: float | None, found: Sequence[Difference]) -> dict[str, Any]:
    accounts: dict[ModelName, list[dict[str, Any]]] = {}
    limits: dict[str, float | None] = {}
    seconds: dict[str, float | None] = {}
    name, judgements = judged([run for series in runs.values() for run in series], at)
    for model, series in runs.items():
        values, judgements = judgements[: len(series)], judgements[len(series) :]
        limit = extrapolated(values, [run.refinement for run in series])
        errors = [abs(v / limit - 1) if v is not None and limit else None for v in values]
        accounts[model] = [
            {
                "refinement": run.refinement,
                "dofs": run.dofs,
                "value": value,
                "error": error,
                "cpu_s": run.cpu_s,
                "wall_s": run.wall_s,
                "factorisations": run.summary["factorisations"],
                "stopped": run.summary["stopped"],
            }
            for run, value, error in zip(series, values, errors, strict=True)
        ]
        limits[model] = limit
        measured = [(e, run.cpu_s) for e, run in zip(errors, series, strict=True) if e is not None]
        seconds[model] = time_at(ONE_PERCENT, measured)
    both = [accounts[model][-1]["value"] for model in MODELS]
    times = [seconds[model] for model in MODELS]
    return {
        "result": name,
        "difference": both[1] / both[0] - 1 if None not in both else None,
        "largest_difference_of_the_curves": max((abs(d.relative) for d in found), default=None),
        "limits": limits,
        "seconds_to_one_percent": seconds,
        "ratio_at_one_percent": times[1] / times[0] if times[0] and times[1] else None,
        "runs": accounts,
    }


def extrapolated(values: Sequence[float | None], refinements: Sequence[float]) -> float | None:
    """The limit of the last three values by Richardson extrapolation; None for fewer values.

    It is the last value if no order of convergence is observed.

    Examples
    --------
    >>> round(extrapolated([2.0, 1.25, 1.0625], [1.0, 2.0, 4.0]), 12)
    1.0
    """
    last = [v for v in values[-3:] if v is not None]
    if len(last) < 3:
        return None
    h = [1 / r for r in refinements[-3:]]
    p = observed_order(h, last)
    return last[2] if p is None else last[2] + (last[2] - last[1]) * h[2] ** p / (h[1] ** p - h[2] ** p)
