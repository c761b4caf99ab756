"""Runs of a case as a shell or as a solid, each in a process of its own and kept in its folder.

A run of the same request (case, settings, sources) is not repeated.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.durable import Damaged
from magshell_fenicsx.output.store.run_identity import CASE_FILE, stored_identity
from magshell_fenicsx.output.store.stored_results import read_summary
from magshell_fenicsx.output.store.table import read_lines
from magshell_fenicsx.platform.environment import code_version
from magshell_fenicsx.platform.processes import measure
from magshell_fenicsx.studies.runner import Say
from magshell_fenicsx.studies.store import keep, stored_outcome

ModelName = Literal["shell", "solid"]
MODELS: tuple[ModelName, ...] = ("shell", "solid")
# settings of a model alone
WITHOUT: dict[ModelName, list[str]] = {
    "shell": ["solid=null"],
    "solid": [],
}


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
class StoredUsage:
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
    usage = stored_outcome(folder / "usage.json", TypeAdapter(StoredUsage))
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
    folder: Path, usage: StoredUsage | None, request: Mapping[str, Any]
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
) -> tuple[StoredUsage, Results]:
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
    usage = StoredUsage({**request, "sources": summary["sources"]}, measured.cpu_s, measured.wall_s)
    keep(folder / "usage.json", asdict(usage))
    return usage, (summary, rows)


def _case_in(folder: Path) -> str:
    """Return the name of the case file whose run is in a folder; "" without a run."""
    with suppress(OSError, Damaged):
        return str(stored_identity(folder).get(CASE_FILE, ""))
    return ""
