"""Comparison of a case as a shell and as a solid: curve against curve, error against run time.

Each model is run on several meshes, given by their refinements; the element size is proportional to
the inverse. Loads are compared at places, displacements that both models reach; one of these, the
judged place, or a scalar (a named number of a run) gives the number whose error is estimated.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from math import copysign
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.input.source import CaseError, read_source
from magshell_fenicsx.output.store.durable import write_object
from magshell_fenicsx.output.store.folder import access_disk, user_folder
from magshell_fenicsx.quantities.registry import amplitude
from magshell_fenicsx.studies.compare.curves import (
    Difference,
    amplitude_of,
    differences,
    load_at,
    places,
)
from magshell_fenicsx.studies.compare.model_runs import (
    MODELS,
    WITHOUT,
    ModelName,
    ModelRun,
    NothingLeft,
    run_model,
)
from magshell_fenicsx.studies.compare.picture import Errors, draw_comparison
from magshell_fenicsx.studies.points import MakeCase
from magshell_fenicsx.studies.results import Scalar, parse_scalar
from magshell_fenicsx.studies.runner import Say, compute
from magshell_fenicsx.studies.store import Folder, write_table
from magshell_fenicsx.studies.study.report import estimated_error

UNCOMPARED = ("angle", "time")  # amplitudes over which curves are not compared
FOLDER = Folder(
    "a comparison",
    ("compare.json", "compare.csv", "compare.png"),
    ("difference", "runs"),
    points="",
)


def judge(
    runs: Sequence[ModelRun], judged_place: float | None, scalar: Scalar | None
) -> tuple[str, Callable[[ModelRun], float | None]]:
    """Choose the number by which runs are compared.

    It is `scalar` if that is given. If not, it is k_d if all runs have it, and otherwise the load
    at `judged_place`.

    Parameters
    ----------
    judged_place
        Displacement w/h; None if there is none that all runs reach.

    Returns
    -------
    name
        Name of the number.
    value_of
        Function that returns the number of a run; None if a run lacks it.
    """
    if scalar is None and all(run.summary["knockdown"] is not None for run in runs):
        scalar = parse_scalar("knockdown")
    if scalar:
        return scalar.name, lambda run: scalar.value_in(run.summary, run.rows)
    if judged_place is None:
        return "nothing", lambda run: None
    return (
        f"{amplitude(amplitude_of(runs[0])).column} at w/h = {judged_place:g}",
        lambda run: load_at(run, judged_place),
    )


def time_at(error: float, runs: Sequence[tuple[float, float]]) -> float | None:
    """Return the run time in seconds that an error takes; None outside the range of the runs.

    It is interpolated between runs (error, seconds), linearly in the logarithms.

    Examples
    --------
    >>> round(time_at(0.01, [(0.1, 1.0), (0.001, 100.0)]), 9)
    10.0
    """
    errors_and_seconds = sorted((e, s) for e, s in runs if e > 0)
    if not errors_and_seconds:
        return None
    least_error, largest_error = errors_and_seconds[0][0], errors_and_seconds[-1][0]
    if not least_error <= error <= largest_error:
        return None
    e, s = np.log(np.array(errors_and_seconds)).T  # logarithms of errors and seconds
    return float(np.exp(np.interp(np.log(error), e, s)))


ONE_PERCENT = 0.01


@dataclass(frozen=True)
class Comparison:
    """The result of a comparison of shell and solid.

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
    make_case: MakeCase,
    result: str | None = None,
    say: Say = print,
) -> Comparison:
    """Run a case as a shell and as a solid, and compare the results.

    Writes compare.csv, compare.json and compare.png, and a folder for each run. Every run is a
    separate process. Runs of the same case and sources that are in the folder are kept.

    Parameters
    ----------
    refinements
        Mesh refinements of each model. The finest runs are compared. Errors are relative to the
        limit that the three finest runs extrapolate to.
    make_case
        Makes a case of its source.
    result
        The number that is compared, as of `magshell study`; by default k_d, or the load at a
        displacement.

    Raises
    ------
    CaseError
        If the case is not valid for one of the models.
    NothingLeft
        If a run left no results.
    """
    file, folder, scalar = Path(file), user_folder(out), parse_scalar(result) if result else None
    _refuse_incomparable(file, settings, make_case)
    runs: dict[ModelName, list[ModelRun]] = {model: [] for model in MODELS}

    def computed(task: tuple[ModelName, float]) -> Iterator[str]:
        """Run a model at a refinement, append the run to `runs`, and yield a line of text."""
        model, refinement = task
        model_run = run_model(
            file, settings, model, refinement, folder / f"{model}_{refinement:g}", say
        )
        runs[model].append(model_run)
        yield (
            f"{model} at refinement {refinement:g}: {model_run.dofs} unknowns, "
            f"{model_run.cpu_s:.1f} s CPU"
        )
        if not amplitude_of(model_run):  # "" at the start of the path
            raise NothingLeft(
                f"the {model} did not leave its undeformed state: {model_run.summary['stopped']}"
            )

    with FOLDER.locked(folder, MPI.COMM_SELF, file.name):
        tasks = [
            (model, refinement)
            for model in MODELS
            for refinement in sorted(set(refinements[model]))
        ]
        compute(tasks, computed, MPI.COMM_SELF, say)
        shell, solid = (runs[model][-1] for model in MODELS)  # the finest ones
        if amplitude_of(shell) != amplitude_of(solid):
            ends = [amplitude_of(run) for run in (shell, solid)]
            raise CaseError(
                f"compare: the shell ended while {ends[0]} varied, the solid while {ends[1]} did"
            )
        curve_differences = differences(shell, solid)
        judged_place = max(places([run for model in MODELS for run in runs[model]]), default=None)
        content = {"case": file.name, **_content(runs, judged_place, curve_differences, scalar)}
        access_disk(MPI.COMM_SELF, lambda: _write(content, curve_differences, folder))
        errors: Errors = {model: _errors_of(content["runs"][model]) for model in MODELS}
        title = f"{file.name} {' '.join(settings)}".strip()
        draw_comparison(shell, solid, curve_differences, errors, title, folder / "compare.png")
    return Comparison(curve_differences, content)


def _errors_of(runs: Sequence[Mapping[str, Any]]) -> list[tuple[float, float]]:
    """Return error and CPU time of those runs of compare.json that have an error."""
    return [(run["error"], run["cpu_s"]) for run in runs if run["error"]]


def _refuse_incomparable(file: Path, settings: Sequence[str], make_case: MakeCase) -> None:
    """Check that a case is valid for both models, and has a load whose curve can be compared.

    Raises
    ------
    CaseError
        If it is not valid, or its last load is none, an angle, a time or a field alone.
    """
    for model in MODELS:
        case = make_case(read_source(file, [*settings, f"model={model}", *WITHOUT[model]]))
    # the programme of loads is the same for both models
    load_name = case.programme[-1].name if case.programme else ""
    is_field_alone = amplitude(load_name).is_field and case.loading is None
    if is_field_alone or load_name in ("", *UNCOMPARED):
        raise CaseError(
            "compare: needs a load whose curve can be compared: pressure, indentation or field"
        )


def _write(content: Mapping[str, Any], differing: Sequence[Difference], folder: Path) -> None:
    """Write compare.csv with the differences, and compare.json with the content."""
    rows = [{**asdict(d), "relative": d.relative} for d in differing]
    columns = (*(f.name for f in fields(Difference)), "relative")
    write_table(rows, folder / "compare.csv", first=columns)
    write_object(folder / "compare.json", content, indent=2)


def parse_refinements(shell: str, solid: str) -> dict[ModelName, list[float]]:
    """Read the options `--shell` and `--solid`, lists of mesh refinements with commas.

    Raises
    ------
    CaseError
        If one is not a list of numbers from 0.1 to 20.

    Examples
    --------
    >>> parse_refinements("1", "0.5,1")
    {'shell': [1.0], 'solid': [0.5, 1.0]}
    """
    refinements: dict[ModelName, list[float]] = {}
    for model, text in zip(MODELS, (shell, solid), strict=True):
        try:
            refinements[model] = [float(number) for number in text.split(",")]
        except ValueError:
            refinements[model] = []
        if not refinements[model] or not all(0.1 <= r <= 20 for r in refinements[model]):
            raise CaseError(
                f"--{model} {text}: write refinements from 0.1 to 20, for example 0.5,0.7,1"
            )
    return refinements


def _content(
    runs: dict[ModelName, list[ModelRun]],
    judged_place: float | None,
    differing: Sequence[Difference],
    scalar: Scalar | None,
) -> dict[str, Any]:
    """Return the content of compare.json without the name of the case.

    Parameters
    ----------
    runs
        Model -> its runs, from coarse to fine.
    judged_place
        Displacement w/h at which loads are compared; None if there is none.
    differing
        Differences between the curves of the finest runs.
    scalar
        The requested number; None for k_d, or the load at the judged place if a run has no k_d.
    """
    # for each model: plain data of its runs, the limit of their values, and the CPU time that an
    # error of one percent takes
    data_of_runs: dict[ModelName, list[dict[str, Any]]] = {}
    limits: dict[str, float | None] = {}
    seconds: dict[str, float | None] = {}
    name, value_of = judge(
        [run for runs_of_model in runs.values() for run in runs_of_model], judged_place, scalar
    )
    judged_scalar = parse_scalar(name) if name == "knockdown" else scalar
    for model, runs_of_model in runs.items():
        values = [value_of(run) for run in runs_of_model]
        # by Richardson extrapolation; None if it is not known
        limit = extrapolated(values, [run.refinement for run in runs_of_model])
        errors = [abs(v / limit - 1) if v is not None and limit else None for v in values]
        data_of_runs[model] = [
            _data_of_run(run, judged_scalar, value, error)
            for run, value, error in zip(runs_of_model, values, errors, strict=True)
        ]
        limits[model] = limit
        errors_and_seconds = [
            (e, run.cpu_s) for e, run in zip(errors, runs_of_model, strict=True) if e is not None
        ]
        seconds[model] = time_at(ONE_PERCENT, errors_and_seconds)
    # of the finest runs
    shell_value, solid_value = (data_of_runs[model][-1]["value"] for model in MODELS)
    has_both_values = None not in (shell_value, solid_value)
    shell_seconds, solid_seconds = (seconds[model] for model in MODELS)
    return {
        "result": name,
        # of the solid from the shell
        "difference": solid_value / shell_value - 1 if has_both_values else None,
        "largest_difference_of_the_curves": max((abs(d.relative) for d in differing), default=None),
        "limits": limits,
        "seconds_to_one_percent": seconds,
        "ratio_at_one_percent": solid_seconds / shell_seconds
        if shell_seconds and solid_seconds
        else None,
        "runs": data_of_runs,
    }


def _data_of_run(
    run: ModelRun, scalar: Scalar | None, value: float | None, error: float | None
) -> dict[str, Any]:
    """Return a run with its compared number and the errors of this, as in compare.json.

    Parameters
    ----------
    scalar
        The number; None for the load at a displacement.
    error
        Its relative error from the limit of the model's runs; None if that is not known.
    """
    # by the mesh, as the run estimates it
    value_error = None
    if scalar:
        value_error = scalar.error_in(run.summary.get("errors", {}), run.rows)
    return {
        "refinement": run.refinement,
        "dofs": run.dofs,
        "value": value,
        "value_error": value_error,
        "error": error,
        "cpu_s": run.cpu_s,
        "wall_s": run.wall_s,
        "factorisations": run.summary["factorisations"],
        "stopped": run.summary["stopped"],
    }


def extrapolated(values: Sequence[float | None], refinements: Sequence[float]) -> float | None:
    """Return the limit of the last three values by Richardson extrapolation.

    None if there are fewer or one is missing; the last value if no order of convergence is
    observed.

    Parameters
    ----------
    values
        A number of runs, from coarse to fine; None where a run lacks it.
    refinements
        Refinement of each run; the element size is proportional to its inverse.

    Examples
    --------
    >>> round(extrapolated([2.0, 1.25, 1.0625], [1.0, 2.0, 4.0]), 12)
    1.0
    """
    last_values = [v for v in values[-3:] if v is not None]
    if len(last_values) < 3:
        return None
    error, order = estimated_error([1 / r for r in refinements[-3:]], last_values)
    if error is None or order is None:
        return last_values[2]
    # the limit lies beyond the last value, in the direction of the last change
    return last_values[2] + copysign(error, last_values[2] - last_values[1])
