"""Comparison of a case as a shell and as a solid: curve against curve, error against run time."""

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
from magshell_fenicsx.output.store.checkpoint import CASE_FILE, NAME, identity_in
from magshell_fenicsx.output.store.durable import Damaged, read_object, write_object
from magshell_fenicsx.output.store.folder import access_disk, user_folder
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
    """The results of a run.

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
    """The content of usage.json of a run: the request, and the times of the process."""

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

    Raises
    ------
    NothingLeft
        If there is nothing to compare.
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
    used, results, why = stored_outcome(folder / "usage.json", TypeAdapter(Used)), None, ""
    if used and used.asked == request:
        try:
            results = read_summary(folder), read_lines(folder / "path.csv")
        except (OSError, Damaged) as e:
            why = str(e)
    elif used and used.asked | {"sources": request["sources"]} == request:
        why = "the folder has results of other sources of magshell_fenicsx"
    if why:
        say(f"{model} at refinement {refinement:g}: computed again, {why}")
    if not (used and results):
        name = _case_in(folder)
        if name and Path(name).stem != case.stem:
            raise CaseError(
                f"--out {folder.parent}: has a comparison of {name}, which is kept; give another "
                "folder"
            )
        sets = [part for setting in model_settings for part in ("--set", setting)]
        measured = measure(
            "magshell_fenicsx", ["run", str(case), *sets, "--out", str(folder), "--overwrite"]
        )
        if not (folder / "summary.json").exists() or measured.code not in (0, 3):
            raise NothingLeft(
                f"model: {model}: {measured.last_error or f'exit code {measured.code}'}"
            )
        results = read_summary(folder), read_lines(folder / "path.csv")
        used = Used({**request, "sources": results[0]["sources"]}, measured.cpu_s, measured.wall_s)
        keep(folder / "usage.json", asdict(used))
    summary, rows = results
    compiling = float(summary["timing"]["jit_s"])
    return ModelRun(
        model, refinement, summary, rows, used.cpu_s - compiling, used.wall_s - compiling
    )


def _case_in(folder: Path) -> str:
    """The name of the case file whose run is in a folder; empty without."""
    with suppress(OSError, Damaged):
        return str(
            (identity_in(folder / NAME) or read_object(folder / "summary.json")).get(CASE_FILE, "")
        )
    return ""


W = "w"  # displacement of the mid-surface since the end of the field


@dataclass(frozen=True)
class Difference:
    """Loads of both models at the same displacement."""

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
    """Displacements and loads of the last part of the path, without branches."""
    y = amplitude(amplitude_of(run)).column
    return [float(row[W]) for row in loaded(run)], [float(row[y]) for row in loaded(run)]


def loaded(run: ModelRun) -> list[dict[str, str]]:
    """The rows of the last part of the path and the row before it, with the displacement since that
    row.

    The field displaces the mid-surface of a solid by nu lambda_m R/h more (of w/h), since it also
    stretches the thickness. The displacement since the end of the field excludes this.
    """
    load_name = amplitude_of(run)
    # the same point in both models
    x = "w_point_over_h" if load_name == "force" else "w_pole_over_h"
    first = next(i for i, row in enumerate(run.rows) if row["amplitude"] == load_name)
    row_before = run.rows[max(first - 1, 0)]
    part = [
        row_before,
        *(
            row
            for row in run.rows[first:]
            if row["amplitude"] == load_name and row["branch"] == "0"
        ),
    ]
    return [{**row, W: repr(float(row[x]) - float(row_before[x]))} for row in part]


def places(runs: Sequence[ModelRun]) -> list[float]:
    """The displacements 1, 2, ... that all runs reach, or their last common one if it is below 1.

    Empty if a run has no targets: its steps are too long to interpolate between them.
    """
    if not all(any(row["label"] == "target" for row in loaded(run)) for run in runs):
        return []
    end = min(max(curve(run)[0]) for run in runs)
    return [float(w) for w in range(1, int(end + 1e-6) + 1)] or [end]


def differences(shell: ModelRun, solid: ModelRun) -> list[Difference]:
    """The differences at the displacements that both runs reach."""
    loads_at_places = (
        (place, load_at(shell, place), load_at(solid, place)) for place in places([shell, solid])
    )
    return [
        Difference(place, shell_load, solid_load)
        for place, shell_load, solid_load in loads_at_places
        if shell_load is not None and solid_load is not None
    ]


def load_at(run: ModelRun, w: float) -> float | None:
    """The load at a displacement; None if the run does not reach it."""
    return Scalar("", amplitude(amplitude_of(run)).column, W, w).value_in(run.summary, loaded(run))


def judge(
    runs: Sequence[ModelRun], judged_place: float | None, scalar: Scalar | None
) -> tuple[str, Callable[[ModelRun], float | None]]:
    """The name of the compared number, and what gives it of a run.

    That is what is asked for; else k_d if all runs have it, else the load at a displacement.
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
    """Run time in seconds for an error, interpolated between runs (error, seconds); None outside
    their range.

    Examples
    --------
    >>> round(time_at(0.01, [(0.1, 1.0), (0.001, 100.0)]), 9)
    10.0
    """
    ordered = sorted((e, s) for e, s in runs if e > 0)
    if not ordered or not ordered[0][0] <= error <= ordered[-1][0]:
        return None
    e, s = np.log(np.array(ordered)).T
    return float(np.exp(np.interp(np.log(error), e, s)))


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
    make_case: MakeCase,
    result: str | None = None,
    say: Say = print,
) -> Comparison:
    """Run a case with both models; write compare.csv, compare.json and compare.png, and a folder
    for each run.

    Every run is a separate process. Runs of the same case and sources that are in the folder are
    kept.

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
    for model in MODELS:
        case = make_case(read_source(file, [*settings, f"model={model}", *WITHOUT[model]]))
    load_name = case.programme[-1].name if case.programme else ""
    if (
        not load_name
        or load_name in UNCOMPARED
        or (load_name == "lambda_m" and case.loading is None)
    ):
        raise CaseError(
            "compare: needs a load whose curve can be compared: pressure, indentation or field"
        )
    runs: dict[ModelName, list[ModelRun]] = {model: [] for model in MODELS}

    def computed(task: tuple[ModelName, float]) -> Iterator[str]:
        model, refinement = task
        model_run = run_model(
            file, settings, model, refinement, folder / f"{model}_{refinement:g}", say
        )
        runs[model].append(model_run)
        yield (
            f"{model} at refinement {refinement:g}: {model_run.dofs} unknowns, "
            f"{model_run.cpu_s:.1f} s CPU"
        )
        if not amplitude_of(model_run):
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
        shell, solid = (runs[model][-1] for model in MODELS)
        if amplitude_of(shell) != amplitude_of(solid):
            ends = [amplitude_of(run) for run in (shell, solid)]
            raise CaseError(
                f"compare: the shell ended while {ends[0]} varied, the solid while {ends[1]} did"
            )
        differing = differences(shell, solid)
        judged_place = max(places([run for model in MODELS for run in runs[model]]), default=None)
        content = {"case": file.name, **_content(runs, judged_place, differing, scalar)}
        access_disk(MPI.COMM_SELF, lambda: _write(content, differing, folder))
        errors: Errors = {
            model: [(run["error"], run["cpu_s"]) for run in content["runs"][model] if run["error"]]
            for model in MODELS
        }
        title = f"{file.name} {' '.join(settings)}".strip()
        draw_comparison(shell, solid, differing, errors, title, folder / "compare.png")
    return Comparison(differing, content)


def _write(content: Mapping[str, Any], differing: Sequence[Difference], folder: Path) -> None:
    rows = [{**asdict(d), "relative": d.relative} for d in differing]
    write_csv(rows, (*(f.name for f in fields(Difference)), "relative"), folder / "compare.csv")
    write_object(folder / "compare.json", content, indent=2)


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
    refinements: dict[ModelName, list[float]] = {}
    for model, text in zip(MODELS, (shell, solid), strict=True):
        try:
            refinements[model] = [float(part) for part in text.split(",")]
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
    accounts: dict[ModelName, list[dict[str, Any]]] = {}
    limits: dict[str, float | None] = {}
    seconds: dict[str, float | None] = {}
    name, value_of = judge(
        [run for series in runs.values() for run in series], judged_place, scalar
    )
    for model, series in runs.items():
        values = [value_of(run) for run in series]
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
    final_values = [accounts[model][-1]["value"] for model in MODELS]
    times = [seconds[model] for model in MODELS]
    return {
        "result": name,
        "difference": final_values[1] / final_values[0] - 1 if None not in final_values else None,
        "largest_difference_of_the_curves": max((abs(d.relative) for d in differing), default=None),
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
    error, order = estimated_error([1 / r for r in refinements[-3:]], last)
    return (
        last[2] if error is None or order is None else last[2] + copysign(error, last[2] - last[1])
    )


def draw_comparison(
    shell: ModelRun,
    solid: ModelRun,
    differing: Sequence[Difference],
    errors: Errors,
    title: str,
    file: Path,
) -> None:
    """Write the picture.

    Parameters
    ----------
    errors
        Model -> (relative error, CPU seconds) of its coarser runs; without any the panel is left
        out.
    """
    from matplotlib.figure import Figure

    panels = 1 + bool(differing) + any(errors.values())
    figure = Figure(figsize=(4.4 * panels, 3.7), dpi=160, layout="constrained")
    load_amplitude = amplitude(amplitude_of(shell))
    x_label, y_label = (
        f"{quantity('w_over_h').latex} {load_amplitude.place} since the field",
        quantity(load_amplitude.column).label,
    )
    first, *others = figure.subplots(1, panels, squeeze=False)[0]
    first.plot(
        *curve(shell),
        ".-",
        color="C0",
        markersize=4,
        linewidth=1,
        label=f"shell, {shell.dofs} unknowns",
    )
    first.plot(
        *curve(solid),
        "o",
        color="C3",
        markersize=4,
        fillstyle="none",
        label=f"solid, {solid.dofs} unknowns",
    )
    first.set(xlabel=x_label, ylabel=y_label)
    first.legend(frameon=False, fontsize=8)
    if differing:
        others[0].plot(
            [d.w_over_h for d in differing], [100 * d.relative for d in differing], ".-", color="C3"
        )
        others[0].axhline(0, color="0.8", linewidth=0.8, zorder=0)
        others[0].set(xlabel=x_label, ylabel="solid over shell, difference (%)")
    if any(errors.values()):
        for (model, points), color in zip(errors.items(), ("C0", "C3"), strict=True):
            if ordered := sorted((s, e) for e, s in points):
                others[-1].loglog(*zip(*ordered, strict=True), "o-", color=color, label=model)
        others[-1].set(
            xlabel="CPU time of the process (s)", ylabel="relative error, of each model's own limit"
        )
        others[-1].grid(which="both", color="0.92")
        others[-1].legend(frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=9)
    figure.savefig(file)
