"""The output folder of one run."""

import json
import math
import os
import re
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from errno import EACCES
from pathlib import Path
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.section import case_sizes
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import Sector
from magshell_fenicsx.output.fields.gathering import gatherer
from magshell_fenicsx.output.fields.grids import grid_content
from magshell_fenicsx.output.fields.outlines import DRIVEN, STILL, outlines, solids
from magshell_fenicsx.output.fields.surface import turned, whole
from magshell_fenicsx.output.fields.vtu import About, FieldSeries, is_whole, point_file
from magshell_fenicsx.output.report.verdict import plain, read_run, verdict
from magshell_fenicsx.output.store import checkpoint
from magshell_fenicsx.output.store.durable import (
    Damaged,
    read_object,
    read_result,
    sync_folder,
    write_whole,
)
from magshell_fenicsx.output.store.folder import DiskError, by_first, prepare_folder
from magshell_fenicsx.output.store.known import SUMMARY, read_summary
from magshell_fenicsx.output.store.table import PathTable, Row, read_lines
from magshell_fenicsx.output.store.written import (
    MESH,
    NEW,
    OF_PATH,
    note,
    refuse_unwritten,
    remove,
    replaced,
    written,
)
from magshell_fenicsx.output.store.written import NAME as LIST
from magshell_fenicsx.parts.registered import SEEN
from magshell_fenicsx.problem.problem import Document
from magshell_fenicsx.simulate.scene import Scene

INTERRUPTED = re.compile(r"^interrupted by |cannot be (written|read): ")
COMPARED = ("p_over_pc", "lambda_m", "force", "w_over_h", "w_pole_over_h")


class AlreadyComplete(Exception):
    """There is nothing to resume; `summary` is the summary.json of the finished run."""

    def __init__(self, summary: dict[str, Any]) -> None:
        super().__init__(summary)
        self.summary = summary

    def __str__(self) -> str:
        return "the run is complete: there is nothing to resume"


def open_folder(
    out: Path, document: Document, comm: MPI.Comm, resume: bool, overwrite: bool = False
) -> None:
    """See that a folder can take a new run, or that the run in it can be resumed; nothing in it is
    changed.

    Parameters
    ----------
    overwrite
        Whether a new run may replace that of another case file, or an interrupted one.

    Raises
    ------
    CaseError
        If the folder cannot be written, has files that no run has written, a run of another case
        file, an interrupted one or a damaged one; or no run of this case to resume.
    AlreadyComplete
        If the run to be resumed is complete.
    """

    def ready(folder: Path) -> None:
        refuse_unwritten(folder)
        for part in (folder, folder / "fields"):  # before the first file is removed
            if part.exists() and not os.access(part, os.W_OK | os.X_OK, effective_ids=True):
                raise OSError(EACCES, os.strerror(EACCES), str(part))
        if resume:
            _refuse_no_resuming(folder, document)
        elif not overwrite:
            _refuse_other_case(folder, document)
            _refuse_interrupted(folder)

    prepare_folder(out, comm, ready)


def _refuse_other_case(out: Path, document: Document) -> None:
    """A run replaces one of the same case, and one of the same file with other values."""
    try:
        begun = belongs_to(out, document)
    except Damaged as e:
        raise CaseError(f"{e}; --overwrite replaces the run that is there") from None
    name = begun.get(checkpoint.FILE)
    if (
        name
        and Path(name).stem != Path(document.name).stem
        and not checkpoint.is_of(begun, document)
    ):
        raise CaseError(
            f"--out {out}: has a run of {name}, which is kept; give another folder, or --overwrite"
        )


def belongs_to(out: Path, document: Document) -> dict[str, Any]:
    """What the run in a folder depends on; empty without checkpoint and summary.json.

    Raises
    ------
    Damaged
        If it cannot be read.
    """
    if replaced(out):  # what is left of the earlier run is no run
        return checkpoint.begun_with(out / NEW) or {}
    if begun := checkpoint.begun_with(out / checkpoint.NAME):
        return begun
    summary = read_object(out / SUMMARY) if (out / SUMMARY).exists() else {}
    return {
        key: summary[key] for key in ("case", checkpoint.FILE, *document.outside) if key in summary
    }


def _refuse_interrupted(out: Path) -> None:
    """A run that has ended, also where its solver could not go on, may be repeated; one that can go
    on is kept.
    """
    if replaced(out):
        return
    file, table = out / checkpoint.NAME, out / "path.csv"
    points = max(read_result(table).count(b"\n") - 1, 0) if table.exists() else 0
    if not file.exists() or (
        points < 2 and not (out / MESH).exists()
    ):  # the undeformed shell alone is no loss
        return
    how = "killed, or its machine stopped"
    if (out / SUMMARY).exists():
        stopped = read_object(out / SUMMARY).get("stopped")
        if not (isinstance(stopped, str) and INTERRUPTED.search(stopped)):
            return
        how = stopped
    when = datetime.fromtimestamp(file.stat().st_mtime).strftime("%Y-%m-%d %H:%M")
    raise CaseError(
        f"--out {out}: has a run that was not finished: {points} point{'s' * (points != 1)}, the last on {when}; "
        f"{how}. Give --resume to continue it, or --overwrite to start again"
    )


def _refuse_no_resuming(out: Path, document: Document) -> None:
    """See that the run can be resumed."""
    file = out / checkpoint.NAME
    if replaced(out):
        raise CaseError(
            f"--resume: {out}: a new run was interrupted while it removed the files of the earlier one; "
            "start again without --resume, or with --overwrite"
        )
    if not file.exists() and (out / SUMMARY).exists():
        summary = read_summary(out)
        if summary["stopped"] is None:
            kept = {
                key: summary[key]
                for key in ("case", "sources", *document.outside)
                if key in summary
            }
            checkpoint.refuse_other(
                {"version": summary["versions"]["magshell_fenicsx"], **kept}, document, out
            )
            try:
                points = len(read_run(out)[1])
            except FileNotFoundError as e:
                raise Damaged(f"{e.filename}: is damaged: it is cut off, or missing") from None
            for number in range(points):
                if not is_whole(out / "fields" / point_file(number)):
                    raise Damaged(
                        f"{out / 'fields' / point_file(number)}: is damaged: it is cut off, or missing"
                    )
            raise AlreadyComplete(summary)
    checkpoint.check_resumable(file, document)


class RunFiles:
    """Writes the files of a run; every method is collective, and rank 0 writes.

    A new run changes nothing in the folder before `begin`: one that is refused loses no earlier
    results.

    Parameters
    ----------
    begun
        The content of an empty checkpoint, as the case and its files were before the scene was
        built.
    resume
        Whether the run in the folder goes on.
    mesh
        The content of mesh.json, if the case has a tolerance.

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

    journal: checkpoint.Checkpoint | None = None

    def __init__(
        self, folder: Path, scene: Scene, begun: bytes, *, resume: bool, mesh: bytes | None = None
    ) -> None:
        self._folder, self._scene, self._comm, self._new, self._mesh = (
            folder,
            scene,
            scene.comm,
            begun,
            mesh,
        )
        self._gatherer = gatherer(scene.model, scene.comm)
        self.kept, self._rows, self.elapsed = 0, list[dict[str, str]](), 0.0
        if resume:
            self.begin(again=True)
            self.elapsed = float(self._rows[-1]["wall_s"]) if self._rows else 0.0

    def begin(self, *, again: bool = False) -> None:
        """Make room for the files of the run, which has its first point, and open them.

        Parameters
        ----------
        again
            Keep the path of an interrupted run, and only delete what the end of a run writes.
        """
        by_first(self._comm, self._make_room_again if again else self._make_room)
        self.kept, self._rows = by_first(self._comm, self._open)
        self.journal = checkpoint.Checkpoint(
            self._folder / checkpoint.NAME, self._scene.model.V, self._comm
        )

    def _make_room(self) -> None:
        """Replace an earlier run by an empty checkpoint; whenever this is killed, what is there is
        known as a run's.
        """
        folder, file = self._folder, self._folder / checkpoint.NAME
        new, earlier = folder / NEW, written(folder) - {NEW}
        write_whole(new, self._new)  # a full disk stops here
        remove(folder, earlier - {SUMMARY, file.name})
        if self._mesh:
            write_whole(folder / MESH, self._mesh)
        new.replace(file)
        remove(folder, earlier & {SUMMARY})

    def _make_room_again(self) -> None:
        remove(
            self._folder,
            {n for n in written(self._folder) if n not in OF_PATH and not n.startswith("fields/")},
        )
        if self._mesh and not (self._folder / MESH).exists():
            write_whole(self._folder / MESH, self._mesh)

    def _open(self) -> tuple[int, list[dict[str, str]]]:
        begun = checkpoint.begun_with(self._folder / checkpoint.NAME) or {}
        self._begun_with = {
            key: value for key, value in begun.items() if key not in ("case", "version")
        }
        self._table = PathTable(self._folder / "path.csv", self._scene.extra_columns)
        problem = self._scene.problem
        halved = problem.mirror and not isinstance(
            problem.mirror, Sector
        )  # of which ParaView has one half
        mirror = problem.mirror.rotated(problem.azimuth).plane if problem.mirror and halved else None
        self._of_whole = mirror is None
        self._R = case_sizes(problem.context.shell).R
        about = About(problem.material.h, problem.material.nu, mirror, self._R)
        drawn = outlines(problem.loads, self._scene.unloaded().mu, about.h)
        moves = problem.loads.contacts or (problem.loads.magnetic and problem.loads.magnetic.driven)
        name = "" if not drawn else DRIVEN if moves else STILL
        grids = [grid for room in SEEN for grid in room.grids(problem.loads)]
        self._fields = FieldSeries(self._folder / "fields", about, name, self._table.kept, grids)
        sync_folder(self._folder)
        return min(len(self._table.kept), self._fields.kept), self._table.kept

    def write(self, row: Row, state: State, scene: Scene) -> None:
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
        if scene is not self._scene:
            self._scene, self._gatherer = scene, gatherer(scene.model, self._comm)
        surface, mirror = self._gatherer.gather(state.u, state.mu), scene.problem.mirror
        grids = [grid for room in SEEN for grid in room.on_grids(scene.sight, state)]

        def write() -> None:
            assert surface is not None
            problem = scene.problem
            beside = problem.loads, state.mu, problem.material.h
            every = (
                whole(surface, mirror)
                if mirror and (isinstance(mirror, Sector) or self._of_whole)
                else surface
            )
            drawn = replace(every, outlines=outlines(*beside), solids=solids(*beside))
            self._table.write(row)
            beside_it = {grid.name: grid_content(grid, self._R) for grid in grids}
            self._fields.write(number, turned(drawn, problem.azimuth), row, beside_it)

        by_first(self._comm, write)

    def summarise(self, content: dict[str, Any]) -> None:
        """Write summary.json."""

        def write() -> None:  # names the mesh file and the sources as they were at the start
            data = json.loads(json.dumps({**content, **self._begun_with}))
            data["says"] = plain(verdict(data, read_lines(self._folder / "path.csv")))
            write_whole(self._folder / SUMMARY, (json.dumps(data, indent=2) + "\n").encode())

        by_first(self._comm, write)

    def close(self, complete: bool) -> None:
        """Close the files; at the end of a complete run, delete the checkpoint.

        Write down which are the run's.
        """
        assert self.journal
        by_first(self._comm, lambda: self._table.close())
        self.journal.close()
        if complete:
            self.journal.remove()

        def listed() -> None:
            (self._folder / LIST).unlink(missing_ok=True)  # `plot` may have made one meanwhile
            note(self._folder)

        with suppress(DiskError):  # without the list, summary.json says that they are
            by_first(self._comm, listed)


def _same(row: Row, kept: dict[str, str]) -> None:
    """Check that a recomputed point equals the one in path.csv."""
    same = row["label"] == kept["label"] and all(
        math.isclose(float(row[key]), float(kept[key]), rel_tol=1e-6, abs_tol=1e-9)
        for key in COMPARED
    )
    if not same:
        raise CaseError(
            f"--resume: point {row['point']} differs from path.csv; give another folder, or --overwrite in place of "
            "--resume"
        )
