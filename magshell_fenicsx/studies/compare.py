"""Comparison of a case as a shell and as a solid: curve against curve, error against run time.

Each model is run on several meshes, given by their refinements; the element size is proportional to
the inverse. A curve is the load over the displacement w/h in the last part of the path, in which
the last amplitude (load parameter) varies. Loads are compared at places, displacements that both
models reach; one of these, the judged place, or a scalar (a named number of a run) gives the number
whose error is estimated. A run of the same request (case, settings, sources) is not repeated. h and
R are thickness and reference length, nu Poisson's ratio, lambda_m the size of the magnetic load.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from math import copysign
from pathlib import Path
from typing import Any, Literal

import numpy as np
from mpi4py import MPI
from pydantic import TypeAdapter

from magshell_fenicsx.input.source import CaseError, read_source
from magshell_fenicsx.output.store.durable import Damaged, write_object
from magshell_fenicsx.output.store.folder import access_disk, user_folder
from magshell_fenicsx.output.store.run_identity import CASE_FILE, stored_identity
from magshell_fenicsx.output.store.stored_results import read_summary
from magshell_fenicsx.output.store.table import read_lines, write_csv
from magshell_fenicsx.platform.environment import code_version
from magshell_fenicsx.platform.processes import measure
from magshell_fenicsx.quantities.registry import amplitude, quantity
from magshell_fenicsx.studies.results import Scalar, parse_scalar
from magshell_fenicsx.studies.runner import Folder, MakeCase, Say, compute, keep, stored_outcome
from magshell_fenicsx.studies.study_report import estimated_error

Errors = Mapping[str, Sequence[tuple[float, float]]]
ModelName = Literal["shell", "solid"]
MODELS: tuple[ModelName, ...] = ("shell", "solid")
# settings of a model alone
WITHOUT: dict[ModelName, list[str]] = {
    "shell": ["solid=null"],
    "solid": [],
}
UNCOMPARED = ("angle", "time")  # amplitudes over which curves are not compared
FOLDER = Folder(
    "a comparison",
    ("compare.json", "compare.csv", "compare.png"),
    ("difference", "runs"),
    points="",
)


@dataclass(frozen=True)
class ModelRun:
    """The results of a run of a case with one model, shell or solid.

    Attributes
    ----------
    refinement
        The value of mesh.refinement.
    summary, rows
        The content of summary.json and of path.csv.
    cpu_s, wall_s
        Times of the process without the compilation of kernels.
    """

    model: ModelName
    refinement: float
    summary: dict[str, Any]
    rows: list[dict[str, str]]
    cpu_s: float
    wall_s: float

    @property
    def dofs(self) -> int:
        return int(self.summary["mesh"]["dofs"])


class NothingLeft(RuntimeError):
    """A run left no results; the message has the reason."""


@dataclass(frozen=True)
class Used:
    """The content of usage.json of a run.

    Attributes
    ----------
    asked
        The request: text and settings of the case, and the sources.
    cpu_s, wall_s
        Times of the process.
    """

    asked: dict[str, Any]
    cpu_s: float
    wall_s: float


def run_model(
    case: Path,
    settings: Sequence[str],
    model: ModelName,
    refinement: float,
    folder: Path,
    say: Say = print,
) -> ModelRun:
    """Run a case with one of the models, unless the folder has that run by the same sources.

    The run is a separate process.

    Parameters
    ----------
    settings
        Settings of the case, as for `--set`.
    refinement
        Value of mesh.refinement.
    folder
        Folder of this run; its usage.json has the request and the times.
    say
        Called with a line if a stored run is computed again.

    Raises
    ------
    NothingLeft
        If the run leaves no results.
    CaseError
        If the folder has a run of another case.
    """
    model_settings = [
        *settings,
        f"model={model}",
        f"mesh.refinement={refinement:g}",
        *WITHOUT[model],
    ]
    request = {
        "case": case.read_text(encoding="utf-8"),
        "settings": model_settings,
        "sources": code_version(),
    }
    usage = stored_outcome(folder / "usage.json", TypeAdapter(Used))
    results, reason = _stored_results(folder, usage, request)
    if reason:
        say(f"{model} at refinement {refinement:g}: computed again, {reason}")
    if not (usage and results):  # no stored run serves
        _refuse_another_case(folder, case)
        usage, results = _run_in_process(case, model, folder, request)
    summary, rows = results
    # the time for the compilation of kernels, which later runs do not need
    compiling = float(summary["timing"]["jit_s"])
    return ModelRun(
        model, refinement, summary, rows, usage.cpu_s - compiling, usage.wall_s - compiling
    )


# the content of summary.json and of path.csv
Results = tuple[dict[str, Any], list[dict[str, str]]]


def _stored_results(
    folder: Path, usage: Used | None, request: Mapping[str, Any]
) -> tuple[Results | None, str]:
    """Return the results of the run in a folder, and why they do not serve.

    Parameters
    ----------
    usage
        The content of usage.json there; None if there is none.
    request
        Case, settings and sources of the run that is needed.

    Returns
    -------
    results
        Those of the same request; None if there are none.
    reason
        Why the run of this case is computed again; "" if it serves, or if there is none.
    """
    if usage and usage.asked == request:
        try:
            return (read_summary(folder), read_lines(folder / "path.csv")), ""
        except (OSError, Damaged) as e:
            return None, str(e)
    # the same but for the sources
    if usage and usage.asked | {"sources": request["sources"]} == request:
        return None, "the folder has results of other sources of magshell_fenicsx"
    return None, ""


def _refuse_another_case(folder: Path, case: Path) -> None:
    """Check that a folder has no run of another case.

    Raises
    ------
    CaseError
        With the name of the other case.
    """
    name = _case_in(folder)
    if name and Path(name).stem != case.stem:
        raise CaseError(
            f"--out {folder.parent}: has a comparison of {name}, which is kept; give another folder"
        )


def _run_in_process(
    case: Path, model: ModelName, folder: Path, request: Mapping[str, Any]
) -> tuple[Used, Results]:
    """Run a case in a process of its own into a folder, and write its usage.json.

    Parameters
    ----------
    request
        Case, settings and sources of the run.

    Returns
    -------
    usage
        The content of usage.json: the request with the sources that have run, and the times.
    results
        The content of summary.json and of path.csv.

    Raises
    ------
    NothingLeft
        If the run leaves no results.
    """
    arguments = [argument for setting in request["settings"] for argument in ("--set", setting)]
    measured = measure(
        "magshell_fenicsx", ["run", str(case), *arguments, "--out", str(folder), "--overwrite"]
    )
    # exit code 3: stopped early, with results
    if not (folder / "summary.json").exists() or measured.code not in (0, 3):
        raise NothingLeft(f"model: {model}: {measured.last_error or f'exit code {measured.code}'}")
    summary, rows = read_summary(folder), read_lines(folder / "path.csv")
    # the sources that the run has recorded itself
    usage = Used({**request, "sources": summary["sources"]}, measured.cpu_s, measured.wall_s)
    keep(folder / "usage.json", asdict(usage))
    return usage, (summary, rows)


def _case_in(folder: Path) -> str:
    """Return the name of the case file whose run is in a folder; "" without a run."""
    with suppress(OSError, Damaged):
        return str(stored_identity(folder).get(CASE_FILE, ""))
    return ""


W = "w"  # displacement of the mid-surface since the end of the field


@dataclass(frozen=True)
class Difference:
    """The loads of both models at the same displacement.

    Attributes
    ----------
    w_over_h
        The displacement.
    shell, solid
        The loads.
    """

    w_over_h: float
    shell: float
    solid: float

    @property
    def relative(self) -> float:
        """Relative difference of the solid from the shell."""
        return self.solid / self.shell - 1


def amplitude_of(run: ModelRun) -> str:
    """The amplitude that varied last."""
    return run.rows[-1]["amplitude"]


def curve(run: ModelRun) -> tuple[list[float], list[float]]:
    """Return displacements w/h and loads of the last part of the path, without branches.

    The last part is that in which the last amplitude varies. The displacement counts from its
    begin.
    """
    y = amplitude(amplitude_of(run)).column
    return [float(row[W]) for row in loaded(run)], [float(row[y]) for row in loaded(run)]


def loaded(run: ModelRun) -> list[dict[str, str]]:
    """Return the rows of path.csv of the last part of the path, and the row before it.

    In the last part the last amplitude varies. The column `W` has the displacement since the row
    before.

    The field displaces the mid-surface of a solid by nu lambda_m R/h more (of w/h), since it also
    stretches the thickness. The displacement since the end of the field excludes this.
    """
    load_name = amplitude_of(run)
    # the same point in both models: of a force where it acts
    displacement_column = "w_point_over_h" if load_name == "force" else "w_pole_over_h"
    first = next(i for i, row in enumerate(run.rows) if row["amplitude"] == load_name)
    row_before = run.rows[max(first - 1, 0)]
    load_rows = [
        row for row in run.rows[first:] if row["amplitude"] == load_name and row["branch"] == "0"
    ]
    # with the displacement since the row before, as text like all columns
    begin = float(row_before[displacement_column])
    return [
        {**row, W: repr(float(row[displacement_column]) - begin)}
        for row in (row_before, *load_rows)
    ]


def _has_target(run: ModelRun) -> bool:
    """Return whether a run has reached a target while its load varied."""
    return any(row["label"] == "target" for row in loaded(run))


def places(runs: Sequence[ModelRun]) -> list[float]:
    """Return the displacements w/h = 1, 2, ... that all runs reach.

    If the last common displacement is below 1, the list has that alone. It is empty if a run has no
    targets: its steps are too long to interpolate between them.
    """
    if not all(_has_target(run) for run in runs):
        return []
    end = min(max(curve(run)[0]) for run in runs)
    # the tolerance is for an end that is a whole number but for rounding
    return [float(w) for w in range(1, int(end + 1e-6) + 1)] or [end]


def differences(shell: ModelRun, solid: ModelRun) -> list[Difference]:
    """Return the differences of the loads at the displacements that both runs reach."""
    loads_at_places = (
        (place, load_at(shell, place), load_at(solid, place)) for place in places([shell, solid])
    )
    return [
        Difference(place, shell_load, solid_load)
        for place, shell_load, solid_load in loads_at_places
        if shell_load is not None and solid_load is not None
    ]


def load_at(run: ModelRun, w: float) -> float | None:
    """Return the load of a run at a displacement w/h; None if the run does not reach it."""
    # the column of the load, where the displacement first has this value
    load = Scalar("", column=amplitude(amplitude_of(run)).column, at=W, value=w)
    return load.value_in(run.summary, loaded(run))


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
    is_field_alone = load_name == "lambda_m" and case.loading is None
    if is_field_alone or load_name in ("", *UNCOMPARED):
        raise CaseError(
            "compare: needs a load whose curve can be compared: pressure, indentation or field"
        )


def _write(content: Mapping[str, Any], differing: Sequence[Difference], folder: Path) -> None:
    """Write compare.csv with the differences, and compare.json with the content."""
    rows = [{**asdict(d), "relative": d.relative} for d in differing]
    write_csv(rows, (*(f.name for f in fields(Difference)), "relative"), folder / "compare.csv")
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
    for model, runs_of_model in runs.items():
        values = [value_of(run) for run in runs_of_model]
        # by Richardson extrapolation; None if it is not known
        limit = extrapolated(values, [run.refinement for run in runs_of_model])
        errors = [abs(v / limit - 1) if v is not None and limit else None for v in values]
        data_of_runs[model] = [
            _data_of_run(run, value, error)
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


def _data_of_run(run: ModelRun, value: float | None, error: float | None) -> dict[str, Any]:
    """Return a run with its compared number and the relative error of this, as in compare.json."""
    return {
        "refinement": run.refinement,
        "dofs": run.dofs,
        "value": value,
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


def draw_comparison(
    shell: ModelRun,
    solid: ModelRun,
    differing: Sequence[Difference],
    errors: Errors,
    title: str,
    file: Path,
) -> None:
    """Draw the curves of both finest runs, their differences and the errors over CPU time.

    Parameters
    ----------
    differing
        Differences between these curves; without any the panel is left out.
    errors
        Model -> (relative error, CPU seconds) of its coarser runs; without any the panel is left
        out.
    file
        Name of the picture file.
    """
    from matplotlib.figure import Figure

    panels = 1 + bool(differing) + any(errors.values())
    figure = Figure(figsize=(4.4 * panels, 3.7), dpi=160, layout="constrained")
    load_amplitude = amplitude(amplitude_of(shell))
    x_label = f"{quantity('w_over_h').latex} {load_amplitude.place} since the field"
    y_label = quantity(load_amplitude.column).label
    # the curves, then the differences if there are any, and last the errors if there are any
    first, *other_panels = figure.subplots(1, panels, squeeze=False)[0]
    _draw_curves(first, shell, solid)
    first.set(xlabel=x_label, ylabel=y_label)
    if differing:
        other_panels[0].plot(
            [d.w_over_h for d in differing], [100 * d.relative for d in differing], ".-", color="C3"
        )
        other_panels[0].axhline(0, color="0.8", linewidth=0.8, zorder=0)
        other_panels[0].set(xlabel=x_label, ylabel="solid over shell, difference (%)")
    if any(errors.values()):
        _draw_errors(other_panels[-1], errors)
    figure.suptitle(title, fontsize=9)
    figure.savefig(file)


def _draw_curves(plot: Any, shell: ModelRun, solid: ModelRun) -> None:
    """Draw load over displacement of both models on the axes `plot`."""
    plot.plot(
        *curve(shell),
        ".-",
        color="C0",
        markersize=4,
        linewidth=1,
        label=f"shell, {shell.dofs} unknowns",
    )
    plot.plot(
        *curve(solid),
        "o",
        color="C3",
        markersize=4,
        fillstyle="none",
        label=f"solid, {solid.dofs} unknowns",
    )
    plot.legend(frameon=False, fontsize=8)


def _draw_errors(plot: Any, errors: Errors) -> None:
    """Draw error over CPU time of both models on the axes `plot`, with logarithmic scales.

    Parameters
    ----------
    errors
        Model -> (relative error, CPU seconds) of its coarser runs.
    """
    for (model, errors_and_seconds), color in zip(errors.items(), ("C0", "C3"), strict=True):
        if seconds_and_errors := sorted((s, e) for e, s in errors_and_seconds):
            plot.loglog(*zip(*seconds_and_errors, strict=True), "o-", color=color, label=model)
    plot.set(
        xlabel="CPU time of the process (s)", ylabel="relative error, of each model's own limit"
    )
    plot.grid(which="both", color="0.92")
    plot.legend(frameon=False, fontsize=8)
