"""Error against run time of a case over meshes, degrees, models and ranks.

Every run is a separate process. A point is a case with a value for each axis of `over`; a scalar is
the number of a run whose error is studied; timings are the measurements of a point on a number of
ranks. An origin says which sources and mesh file a run is of.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.durable import write_object
from magshell_fenicsx.output.store.folder import access_disk, user_folder
from magshell_fenicsx.output.store.table import write_csv
from magshell_fenicsx.platform.environment import code_version, machine_fingerprint
from magshell_fenicsx.platform.processes import mpirun_path
from magshell_fenicsx.platform.terminal import print_line
from magshell_fenicsx.studies.points import (
    MakeCase,
    SweepPoint,
    make_points,
    parse_axes,
    swept_source,
)
from magshell_fenicsx.studies.results import Scalar, parse_scalar
from magshell_fenicsx.studies.runner import Say, compute
from magshell_fenicsx.studies.store import Folder
from magshell_fenicsx.studies.study.report import (
    COLUMNS,
    Reference,
    Row,
    Run,
    draw_study,
    make_rows,
    reference_sentence,
    repeated,
    write_report,
)
from magshell_fenicsx.studies.study.timings import Timings, complete, load, of_others

FOLDER = Folder(
    "a study", ("study.json", "study.csv", "study.md", "study.png"), ("machine", "result")
)


@dataclass(frozen=True)
class Study:
    """A finished study of error against run time.

    Attributes
    ----------
    rows
        Rows of study.csv: the points in the order of the product of axes, numbers of ranks fastest.
    reference
        The value that errors are relative to; None if no run gave the result.
    """

    rows: list[Row]
    reference: Reference | None

    @property
    def without_result(self) -> int:
        """Number of runs without the requested result."""
        return sum(row["result"] is None for row in self.rows)


def study(  # noqa: PLR0913 - what a user gives
    file: Path | str,
    over: Sequence[str],
    settings: Sequence[str] = (),
    *,
    result: str,
    make_case: MakeCase,
    reference: float | None = None,
    ranks: Sequence[int] = (1,),
    repeat: int = 3,
    out: Path | str = "results/study",
    say: Say = print_line,
) -> Study:
    """Measure error and run time at all points of a product; write study.csv, .json, .md and .png.

    Runs are separate processes, one at a time: each point runs once to compile its kernels, then
    `repeat` times. Runs in the folder are kept if this machine measured them with these sources.

    Parameters
    ----------
    over
        One axis each: `key.path=start:stop:count` or `key.path=value,value`; keys tied with `+`.
    result
        `knockdown`, `critical_field`, `COLUMN@COLUMN=VALUE` or `COLUMN@end`; see `Scalar`.
    make_case
        Makes a case of its source.
    reference
        The exact value for the errors; None takes the finest run and estimates its own error.
    ranks
        Numbers of MPI ranks for every point.
    repeat
        Number of measured runs of each point, of which the median counts.
    out
        Folder of the tables and of points/.
    say
        Called with one line per run.

    Raises
    ------
    CaseError
        Before the first run: if a point is not a valid case, the result has no such name, or `out`
        cannot be written.
    DiskError
        If the disk is full; finished runs are kept.
    """
    scalar, axes = parse_scalar(result), parse_axes(over)
    _check(reference, ranks, repeat)
    points = make_points(swept_source(Path(file), axes, settings), axes, make_case)
    folder = user_folder(out)
    with FOLDER.locked(folder, MPI.COMM_WORLD, Path(file).name):
        runs = _run_all(Path(file), points, settings, scalar, ranks, repeat, folder, say)
        rows, reference_value = make_rows(runs, scalar, reference)
        # of study.json
        content = {
            "case": Path(file).name,
            "settings": list(settings),
            "over": list(over),
            "result": result,
            "reference": asdict(reference_value) if reference_value else None,
            "reference_said": reference_sentence(reference_value),
            "repeat": repeat,
            "machine": machine_fingerprint(),
        }
        study_result = Study(rows, reference_value)
        access_disk(
            MPI.COMM_WORLD, lambda: _write(study_result, tuple(points[0].values), content, folder)
        )
    say(reference_sentence(reference_value))
    return study_result


def _run_all(
    file: Path,
    points: Sequence[SweepPoint],
    settings: Sequence[str],
    scalar: Scalar,
    ranks: Sequence[int],
    repeat: int,
    folder: Path,
    say: Say,
) -> list[Run]:
    """Measure all points on all numbers of ranks, and return their runs.

    The runs of a point on rising numbers of ranks follow each other. Measurements in the folder
    count if they are of this machine, of these sources, and of the point's mesh file.
    """
    machine = machine_fingerprint()
    origins = [{"sources": code_version(), **point.case.outside} for point in points]
    # (index of a point, number of ranks) -> file of its measurements
    files = {
        (i, rank_count): folder / "points" / f"{points[i].key}-{rank_count}.json"
        for i in range(len(points))
        for rank_count in sorted(set(ranks))
    }
    if known_count := sum(of_others(path, origins[i]) for (i, _), path in files.items()):
        say(
            f"{known_count} of {len(files)} computed again: the folder has results of other "
            "sources of magshell_fenicsx"
        )
    runs = {
        (i, rank_count): Run(points[i], rank_count, load(path, machine, origins[i]))
        for (i, rank_count), path in files.items()
    }

    def point_measured(key: tuple[int, int]) -> Iterator[str]:
        """Measure a point on a number of ranks, and yield a line of text.

        The key is the index of the point, and the number of ranks.
        """
        (i, rank_count), run = key, runs[key]
        settings_of_point = [f"{name}={value}" for name, value in run.point.values.items()]
        arguments = [str(file)]
        for setting in (*settings, *settings_of_point):
            arguments += ["--set", setting]
        complete(run.measured, arguments, rank_count, repeat, files[key], origins[i])
        yield f"{i + 1:4d}/{len(points)}  {run.label}: {_outcome(run.measured, scalar)}"

    compute([*runs], point_measured, MPI.COMM_SELF, say)
    return [*runs.values()]


def parse_ranks(text: str) -> list[int]:
    """Read `--ranks`, numbers of MPI ranks with commas.

    Raises
    ------
    CaseError
        If one is no whole number.

    Examples
    --------
    >>> parse_ranks("1,2")
    [1, 2]
    """
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise CaseError(
            f"--ranks {text}: write whole numbers with commas, for example 1,2"
        ) from None


def _check(reference: float | None, ranks: Sequence[int], repeat: int) -> None:
    """Check the reference, the numbers of ranks and the number of repeated runs of a study.

    Raises
    ------
    CaseError
        If one is not allowed, or the study itself runs under mpirun.
    """
    if MPI.COMM_WORLD.size > 1:
        raise CaseError("a study starts its ranks itself: use --ranks instead of mpirun")
    if repeat < 1 or min(ranks, default=0) < 1:
        raise CaseError("--repeat and --ranks must be at least 1")
    if max(ranks) > 1 and not mpirun_path():
        raise CaseError("--ranks: there is no mpirun to start more than one")
    if reference is not None and not isfinite(reference):
        raise CaseError(f"--reference {reference}: must be a finite number")


def _write(study_result: Study, keys: Sequence[str], content: dict[str, Any], folder: Path) -> None:
    """Write study.json, study.csv, study.md and study.png; called on rank 0."""
    write_object(folder / "study.json", content)
    write_csv(study_result.rows, (*keys, *COLUMNS), folder / "study.csv")
    write_report(study_result.rows, keys, content, folder / "study.md")
    repeats = repeated(content["repeat"]).lower()
    title = (
        f"{content['result']} of {content['case']}\n"
        f"{content['machine']['cpu']}, kernels compiled, {repeats}"
    )
    own_error = study_result.reference.error if study_result.reference else None
    draw_study(study_result.rows, keys, title, own_error, folder / "study.png")


def _outcome(measured: Timings, scalar: Scalar) -> str:
    """Describe the measurements of a point in words: the result and the typical wall time."""
    if measured.summary is None:
        return f"stopped early: {measured.failure}"
    value = scalar.value_in(measured.summary, measured.rows)
    result_text = f"{scalar.name} = {value:.9g}" if value is not None else f"no {scalar.name}"
    stopped = measured.summary["stopped"]
    return f"{result_text}, {measured.typical('wall_s'):.2f} s" + (
        f", stopped early: {stopped}" if stopped else ""
    )
