"""The output folder of one run."""

import json
import math
from dataclasses import replace
from pathlib import Path
from shutil import rmtree
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.output.fields.gathering import gatherer
from magshell_fenicsx.output.fields.outlines import DRIVEN, STILL, outlines
from magshell_fenicsx.output.fields.surface import turned
from magshell_fenicsx.output.fields.vtu import About, FieldSeries
from magshell_fenicsx.output.pictures.picture import PICTURES
from magshell_fenicsx.output.store import checkpoint
from magshell_fenicsx.output.store.durable import sync_folder, write_whole
from magshell_fenicsx.output.store.folder import by_first, prepare_folder
from magshell_fenicsx.output.store.table import PathTable, Row
from magshell_fenicsx.simulate.scene import Scene

DRAWN = (*PICTURES, "curve", "instabilities", "modes", "frequencies", "solutions", "gradients")
LAST_FILES = (
    *("summary.json", "report.html", "stability.csv", "frequencies.csv", "animation.gif"),
    *(f"{name}{end}.{kind}" for name in DRAWN for end in ("", "_[0-9]*") for kind in ("png", "svg", "pdf")),
)
MESH = "mesh.json"  # the mesh chosen for a tolerance
COMPARED = ("p_over_pc", "lambda_m", "force", "w_over_h", "w_pole_over_h")


class AlreadyComplete(Exception):
    """There is nothing to resume; `summary` is the summary.json of the finished run."""

    def __init__(self, summary: dict[str, Any]) -> None:
        super().__init__(summary)
        self.summary = summary


def open_folder(out: Path, case: Case, comm: MPI.Comm, resume: bool, overwrite: bool = False) -> None:
    """Prepare a folder for a new run, or check that the run in it can be resumed.

    Parameters
    ----------
    overwrite
        Whether a new run may replace that of another case file.

    Raises
    ------
    CaseError
        If the folder cannot be written, has a run of another case file, or no run of this case to resume.
    AlreadyComplete
        If the run to be resumed is complete.
    """

    def ready(folder: Path) -> None:
        if resume:
            _resumed(folder, case)
            return
        if not overwrite:
            _refuse_other_case(folder, case)
        _emptied(folder, case)

    prepare_folder(out, comm, ready)


def _refuse_other_case(out: Path, case: Case) -> None:
    """A run replaces one of the same case, and one of the same file with other values."""
    known = _belongs_to(out, case)
    name = known.get(checkpoint.FILE)
    if name and Path(name).stem != Path(case.file_name).stem and not checkpoint.is_of(known, case):
        raise CaseError(f"--out {out}: has a run of {name}, which is kept; give another folder, or --overwrite")


def _belongs_to(out: Path, case: Case) -> dict[str, Any]:
    """What the run in a folder depends on; empty if there is none, or it is not known."""
    try:
        if begun := checkpoint.begun_with(out / checkpoint.NAME):
            return begun
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        return {key: summary[key] for key in ("case", checkpoint.FILE, *case.outside) if key in summary}
    except (OSError, ValueError, TypeError):
        return {}


def _emptied(out: Path, case: Case) -> None:
    """Delete the files of an earlier run and begin a checkpoint."""
    for name in (checkpoint.NAME, "path.csv", MESH):
        (out / name).unlink(missing_ok=True)
    _remove_last_files(out)
    rmtree(out / "fields", ignore_errors=True)
    checkpoint.begin_checkpoint(out / checkpoint.NAME, case)


def _resumed(out: Path, case: Case) -> None:
    """Check that the run can be resumed, and delete the files that the end of a run writes."""
    file = out / checkpoint.NAME
    if not file.exists() and (out / "summary.json").exists():
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        if summary["stopped"] is None:
            kept = {key: summary[key] for key in ("case", "sources", *case.outside) if key in summary}
            checkpoint.refuse_other({"version": summary["versions"]["magshell_fenicsx"], **kept}, case, out)
            raise AlreadyComplete(summary)
    checkpoint.check_resumable(file, case)
    _remove_last_files(out)


def _remove_last_files(out: Path) -> None:
    for pattern in LAST_FILES:
        for file in out.glob(pattern):
            file.unlink()


class RunFiles:
    """Writes the files of a run; every method is collective, and rank 0 writes.

    Raises
    ------
    DiskError
        From every method, on every rank, if something cannot be written.

    Attributes
    ----------
    journal
        The checkpoint.
    kept
        Number of points of an interrupted run with rows and fields on disk.
    elapsed
        Run time in seconds of the interrupted run up to the last of these points.
    """

    def __init__(self, folder: Path, scene: Scene) -> None:
        self._folder, self._scene, self._comm = folder, scene, scene.comm
        self.journal = checkpoint.Checkpoint(folder / checkpoint.NAME, scene.model.V, scene.comm)
        self._gatherer = gatherer(scene.model, scene.comm)
        self.kept, self._rows = by_first(self._comm, self._open)
        self.elapsed = float(self._rows[-1]["wall_s"]) if self._rows else 0.0

    def _open(self) -> tuple[int, list[dict[str, str]]]:
        begun = checkpoint.begun_with(self._folder / checkpoint.NAME) or {}
        self._begun_with = {key: value for key, value in begun.items() if key not in ("case", "version")}
        self._table = PathTable(self._folder / "path.csv", self._scene.extra_columns)
        plan = self._scene.plan
        mirror = plan.mirror.turned(plan.azimuth).plane if plan.mirror else None
        about = About(plan.material.h, plan.material.nu, mirror)
        drawn = outlines(plan.loads, self._scene.unloaded().mu, about.h)
        moves = plan.loads.contacts or (plan.loads.magnetic and plan.loads.magnetic.driven)
        name = "" if not drawn else DRIVEN if moves else STILL
        self._fields = FieldSeries(self._folder / "fields", about, name)
        sync_folder(self._folder)
        return min(len(self._table.kept), self._fields.kept), self._table.kept

    def write(self, row: Row, state: State) -> None:
        """Write a point, unless an interrupted run has written it.

        Raises
        ------
        CaseError
            If the point differs from the one of the interrupted run.
        """
        number = int(row["point"])
        if number < len(self._rows):
            _same(row, self._rows[number])
        if number < self.kept:
            return
        surface = self._gatherer.gather(state.u, state.mu)

        def write() -> None:
            assert surface is not None
            plan = self._scene.plan
            whole = replace(surface, outlines=outlines(plan.loads, state.mu, plan.material.h))
            self._table.write(row)
            self._fields.write(number, turned(whole, plan.azimuth))

        by_first(self._comm, write)

    def summarise(self, content: dict[str, Any]) -> None:
        """Write summary.json."""

        def write() -> None:  # names the mesh file and the sources as they were at the start
            data = (json.dumps({**content, **self._begun_with}, indent=2) + "\n").encode()
            write_whole(self._folder / "summary.json", data)

        by_first(self._comm, write)

    def close(self, complete: bool) -> None:
        """Close the files; at the end of a complete run, delete the checkpoint."""
        by_first(self._comm, lambda: self._table.close())
        self.journal.close()
        if complete:
            self.journal.remove()


def _same(row: Row, there: dict[str, str]) -> None:
    """Check that a recomputed point equals the one in path.csv."""
    same = row["label"] == there["label"] and all(
        math.isclose(float(row[key]), float(there[key]), rel_tol=1e-6, abs_tol=1e-9) for key in COMPARED
    )
    if not same:
        raise CaseError(f"--resume: point {row['point']} differs from path.csv; run without --resume")
