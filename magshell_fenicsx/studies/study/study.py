"""Error against run time of a case over meshes, degrees, models and ranks; every run is a separate process."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path
from shutil import which
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.folder import by_first, given_folder, held_folder, refuse_others
from magshell_fenicsx.platform import sources
from magshell_fenicsx.platform.terminal import print_line
from magshell_fenicsx.studies.study.machine import fingerprint
from magshell_fenicsx.studies.study.plot import draw_study
from magshell_fenicsx.studies.study.reference import Reference
from magshell_fenicsx.studies.study.rows import COLUMNS, Row, Run, make_rows
from magshell_fenicsx.studies.study.sample import Measured, complete, load, of_others
from magshell_fenicsx.studies.study.scalar import Scalar, parse_scalar
from magshell_fenicsx.studies.study.table import reference_sentence, repeated, write_table
from magshell_fenicsx.studies.sweep.axes import parse_axes
from magshell_fenicsx.studies.sweep.points import make_points
from magshell_fenicsx.studies.sweep.table import write_csv


@dataclass(frozen=True)
class Study:
    """A finished study.

    Attributes
    ----------
    rows
        As in study.csv, the points in product order, the ranks fastest.
    reference
        None if no run gave the result.
    """

    rows: list[Row]
    reference: Reference | None

    @property
    def without_result(self) -> int:
        """Number of runs without the requested result."""
        return sum(row["result"] is None for row in self.rows)


def study(
    file: Path | str,
    over: Sequence[str],
    settings: Sequence[str] = (),
    *,
    result: str,
    reference: float | None = None,
    ranks: Sequence[int] = (1,),
    repeat: int = 3,
    out: Path | str = "results/study",
    say: Callable[[str], None] = print_line,
) -> Study:
    """Measure error and run time at all points of a product; write study.csv, .json, .md and .png.

    Runs are separate processes, one at a time: each point runs once to compile its kernels, then `repeat` times. Runs
    in the folder are kept if this machine measured them with these sources.

    Parameters
    ----------
    over
        `key.path=start:stop:count` or `key.path=value,value`; keys tied with `+`.
    result
        `knockdown`, `critical_field`, `COLUMN@COLUMN=VALUE` or `COLUMN@end`; see `Scalar`.
    reference
        The exact value for the errors; None takes the finest run and estimates its own error.
    ranks
        Numbers of MPI ranks for every point.
    say
        Called with one line per run.

    Raises
    ------
    CaseError
        Before the first run: if a point is not a valid case, the result has no such name, or `out` cannot be
        written.
    DiskError
        If the disk is full; finished runs are kept.
    """
    scalar, axes = parse_scalar(result), parse_axes(over)
    _check(reference, ranks, repeat)
    points, folder, machine, runs = make_points(Path(file), axes, settings), given_folder(out), fingerprint(), []
    with held_folder(folder, MPI.COMM_WORLD, make=True):
        tables = ("study.json", "study.csv", "study.md", "study.png")
        refuse_others(folder, tables, ("machine", "result"), "a study", Path(file).name)
        by_first(MPI.COMM_WORLD, lambda: (folder / "points").mkdir(exist_ok=True))
        files = {
            (i, n): folder / "points" / f"{point.key}-{n}.json" for i, point in enumerate(points) for n in set(ranks)
        }
        origins = [{"sources": sources.ours(), **point.case.outside} for point in points]
        if again := sum(of_others(file, origins[i]) for (i, _), file in files.items()):
            say(f"{again} of {len(files)} computed again: the folder has results of other sources of magshell_fenicsx")
        for number, (point, origin) in enumerate(zip(points, origins, strict=True), 1):
            chosen = [*settings, *(f"{key}={value}" for key, value in point.values.items())]
            arguments = [str(file), *(word for setting in chosen for word in ("--set", setting))]
            for n in sorted(set(ranks)):
                run = Run(point, n, load(files[number - 1, n], machine, origin))
                complete(run.measured, arguments, n, repeat, files[number - 1, n], origin)
                runs.append(run)
                say(f"{number:4d}/{len(points)}  {run.label}: {_outcome(run.measured, scalar)}")
        rows, against = make_rows(runs, scalar, reference)
        content = {
            "case": Path(file).name,
            "settings": list(settings),
            "over": list(over),
            "result": result,
            "reference": asdict(against) if against else None,
            "reference_said": reference_sentence(against),
            "repeat": repeat,
            "machine": machine,
        }
        done = Study(rows, against)
        by_first(MPI.COMM_WORLD, lambda: _write(done, tuple(points[0].values), content, folder))
    say(reference_sentence(against))
    return done


def parse_ranks(text: str) -> list[int]:
    """Read `--ranks`.

    Examples
    --------
    >>> parse_ranks("1,2")
    [1, 2]
    """
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise CaseError(f"--ranks {text}: write whole numbers with commas, for example 1,2") from None


def _check(reference: float | None, ranks: Sequence[int], repeat: int) -> None:
    if MPI.COMM_WORLD.size > 1:
        raise CaseError("a study starts its ranks itself: use --ranks instead of mpirun")
    if repeat < 1 or not ranks or min(ranks) < 1:
        raise CaseError("--repeat and --ranks must be at least 1")
    if max(ranks) > 1 and not which("mpirun"):
        raise CaseError("--ranks: there is no mpirun to start more than one")
    if reference is not None and not isfinite(reference):
        raise CaseError(f"--reference {reference}: must be a finite number")


def _write(done: Study, keys: Sequence[str], content: dict[str, Any], folder: Path) -> None:
    write_whole(folder / "study.json", (json.dumps(content, indent=1) + "\n").encode())
    write_csv(done.rows, (*keys, *COLUMNS), folder / "study.csv")
    write_table(done.rows, keys, content, folder / "study.md")
    repeats = repeated(content["repeat"]).lower()
    title = f"{content['result']} of {content['case']}\n{content['machine']['cpu']}, kernels compiled, {repeats}"
    own_error = done.reference.error if done.reference else None
    draw_study(done.rows, keys, title, own_error, folder / "study.png")


def _outcome(measured: Measured, scalar: Scalar) -> str:
    if measured.summary is None:
        return f"stopped early: {measured.failure}"
    value = scalar.of(measured.summary, measured.rows)
    found = f"{scalar.name} = {value:.9g}" if value is not None else f"no {scalar.name}"
    stopped = measured.summary["stopped"]
    return f"{found}, {measured.typical('wall_s'):.2f} s" + (f", stopped early: {stopped}" if stopped else "")
