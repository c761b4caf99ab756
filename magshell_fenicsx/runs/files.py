"""The output folder of one run: whether it may be written, resumed or replaced, and its files.

The checkpoint, or journal, keeps the results of all solves while a run goes on; summary.json is
written at its end. So a folder with a checkpoint alone has a run that was interrupted. The manifest
is a list of the files of a run, which a later run may replace. A document is the case with the
hashes of all that results depend on; the identity is what a folder has stored of it. A point has a
row in path.csv and a file of fields. Rank 0 alone reads and writes: `access_disk` runs a function
there, and raises its error on every rank. A scene is the model of a problem with its solver.
"""

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
from magshell_fenicsx.output.fields.outlines import (
    FILE_OF_ALL_POINTS,
    FILE_OF_POINT,
    outlines,
    solids,
)
from magshell_fenicsx.output.fields.surface import completed_by_symmetry, rotated_surface
from magshell_fenicsx.output.fields.vtu import FieldSeries, ShellData, is_whole, point_file
from magshell_fenicsx.output.report.verdict import read_run, terminal_text, verdict
from magshell_fenicsx.output.store import run_identity
from magshell_fenicsx.output.store.checkpoint import Checkpoint
from magshell_fenicsx.output.store.durable import (
    UNFINISHED,
    Damaged,
    damage,
    read_object,
    read_result,
    sync_folder,
    write_object,
    write_whole,
)
from magshell_fenicsx.output.store.folder import DiskError, access_disk, prepare_folder
from magshell_fenicsx.output.store.manifest import (
    FILES_OF_PATH,
    MESH,
    files_of_runs,
    refuse_unwritten,
    remove,
    write_manifest,
)
from magshell_fenicsx.output.store.manifest import NAME as MANIFEST
from magshell_fenicsx.output.store.run_identity import CHECKPOINT, NEW_CHECKPOINT, SUMMARY
from magshell_fenicsx.output.store.stored_results import read_summary
from magshell_fenicsx.output.store.table import PathTable, Row, read_lines
from magshell_fenicsx.parts.magnetism.field_maps import maps_at
from magshell_fenicsx.problem.problem import Document
from magshell_fenicsx.quantities.registry import field_columns
from magshell_fenicsx.simulate.scene import Scene

INTERRUPTION = re.compile(r"^interrupted by |cannot be (written|read): ")
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-6, 1e-9  # of recomputed values in path.csv
CUT_OFF = "it is cut off, or missing"
COMPARED_COLUMNS = ("p_over_pc", *field_columns(), "force", "w_over_h", "w_pole_over_h")


class AlreadyComplete(Exception):
    """Signal that a run to be resumed is complete.

    Attributes
    ----------
    summary
        The content of summary.json of the finished run.
    """

    def __init__(self, summary: dict[str, Any]) -> None:
        super().__init__(summary)
        self.summary = summary

    def __str__(self) -> str:
        return "the run is complete: there is nothing to resume"


def open_folder(
    out: Path, document: Document, comm: MPI.Comm, resume: bool, overwrite: bool = False
) -> None:
    """Check that a folder can take a new run, or that the run in it can be resumed; collective.

    Nothing in the folder is changed.

    Parameters
    ----------
    out
        The folder.
    document
        The case with what its results depend on.
    resume
        Whether the run in the folder goes on.
    overwrite
        Whether a new run may replace that of another case file, or an interrupted one.

    Raises
    ------
    CaseError
        If the folder cannot be written, or has files that no run has written. For a new run without
        `overwrite`: if the folder has a run of another case file, an interrupted or a damaged one.
        To resume: if it has no run of this case.
    AlreadyComplete
        If the run to be resumed is complete.
    """

    def check(folder: Path) -> None:
        """Check, on rank 0, that the folder can be written and its run may be touched."""
        refuse_unwritten(folder)
        for part in (folder, folder / "fields"):  # before the first file is removed
            if part.exists() and not os.access(part, os.W_OK | os.X_OK, effective_ids=True):
                raise OSError(EACCES, os.strerror(EACCES), str(part))
        if resume:
            _check_resumable(folder, document)
        elif not overwrite:
            _refuse_other_case(folder, document)
            _refuse_interrupted(folder)

    prepare_folder(out, comm, check)


def _refuse_other_case(out: Path, document: Document) -> None:
    """Refuse to replace a run of another case file, by a CaseError.

    A run may replace one of an equal case, and one of a file of the same name with other values.
    """
    try:
        identity = run_identity.stored_identity(out, document.outside)
    except Damaged as e:
        raise CaseError(f"{e}; --overwrite replaces the run that is there") from None
    name = identity.get(run_identity.CASE_FILE)
    # a file of the same name: the user has changed the case, and repeats its run
    if not name or Path(name).stem == Path(document.name).stem:
        return
    if not run_identity.belongs_to(identity, document):
        raise CaseError(
            f"--out {out}: has a run of {name}, which is kept; give another folder, or --overwrite"
        )


def _refuse_interrupted(out: Path) -> None:
    """Refuse to replace a run that can be continued, by a CaseError.

    A run that has ended may be repeated, also one whose solver could not go on.
    """
    if run_identity.is_replacement_unfinished(out):
        return
    # without a checkpoint, or without results that took long, nothing would be lost
    file, table = out / CHECKPOINT, out / "path.csv"
    points = max(read_result(table).count(b"\n") - 1, 0) if table.exists() else 0  # but the header
    has_results = points >= 2 or (out / MESH).exists()  # the undeformed shell alone is no loss
    if not file.exists() or not has_results:
        return
    # a run with a summary has stopped itself: it was interrupted, or it has ended
    reason = "killed, or its machine stopped"
    if (out / SUMMARY).exists():
        stopped = read_object(out / SUMMARY).get("stopped")
        if not (isinstance(stopped, str) and INTERRUPTION.search(stopped)):
            return  # it has ended: at its target, or where the solver could not go on
        reason = stopped
    when = datetime.fromtimestamp(file.stat().st_mtime).strftime("%Y-%m-%d %H:%M")
    raise CaseError(
        f"--out {out}: has a run that was not finished: {points} point{'s' * (points != 1)}, "
        f"the last on {when}; {reason}. Give --resume to continue it, or --overwrite to start again"
    )


def _check_resumable(out: Path, document: Document) -> None:
    """Check that the run in a folder is of this case and can be resumed.

    Raises
    ------
    CaseError
        If there is no such run.
    AlreadyComplete
        If the run is complete.
    """
    file = out / CHECKPOINT
    if run_identity.is_replacement_unfinished(out):
        raise CaseError(
            f"--resume: {out}: a new run was interrupted while it removed the files of the earlier "
            "one; start again without --resume, or with --overwrite"
        )
    if not file.exists() and (out / SUMMARY).exists():
        summary = read_summary(out)
        if summary["stopped"] is None:  # it has reached its target
            _check_complete(out, summary, document)
            raise AlreadyComplete(summary)
    run_identity.check_resumable(file, document)


def _check_complete(out: Path, summary: dict[str, Any], document: Document) -> None:
    """Check that a finished run is of this case, and that all of its files are there.

    Raises
    ------
    CaseError
        If the run is of another case or of other sources.
    Damaged
        If a file is missing or cut off.
    """
    version = {"version": summary["versions"]["magshell_fenicsx"]}  # of a run without `sources`
    run_identity.refuse_other_case(
        version | run_identity.stored_identity(out, document.outside), document, out
    )
    try:
        _, rows = read_run(out)
        points = len(rows)
    except FileNotFoundError as e:
        raise damage(e.filename, CUT_OFF) from None
    for number in range(points):
        fields = out / "fields" / point_file(number)
        if not is_whole(fields):
            raise damage(fields, CUT_OFF)


class RunFiles:
    """Writer of the files of a run; every method is collective, and rank 0 writes.

    A new run changes nothing in the folder before `begin`: one that is refused loses no earlier
    results.

    Parameters
    ----------
    folder
        Folder of the run, prepared by `open_folder`.
    scene
        The model of the problem with its solver.
    empty_checkpoint
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
    complete_points
        Number of points of an interrupted run with rows and fields on disk.
    elapsed
        Run time in seconds of the interrupted run up to the last of these points.
    _folder, _empty_checkpoint, _mesh
        The parameters of these names.
    _scene, _comm
        The present scene, which may be that of a larger model after an instability, and its
        communicator.
    _rows
        Rows of path.csv that the interrupted run has written.
    _gatherer
        Brings the fields of a point in the present scene to rank 0.
    _table, _fields
        Writers of path.csv and of the fields; on rank 0, once the run has begun.
    _origin
        What summary.json takes from the checkpoint: hashes of files and of sources as they were at
        the start; on rank 0.
    _has_whole_shell
        Whether the files have the whole shell, and not a half that ParaView mirrors; on rank 0.
    _R
        The reference length in metres, nan without units; on rank 0.
    """

    journal: Checkpoint | None = None

    def __init__(
        self,
        folder: Path,
        scene: Scene,
        empty_checkpoint: bytes,
        *,
        resume: bool,
        mesh: bytes | None = None,
    ) -> None:
        self._folder, self._scene, self._comm = folder, scene, scene.comm
        self._empty_checkpoint, self._mesh = empty_checkpoint, mesh
        self._gatherer = gatherer(scene.model, scene.comm)
        self.complete_points, self._rows, self.elapsed = 0, list[dict[str, str]](), 0.0
        if resume:  # a new run begins later, with its first point
            self.begin(continues=True)
            self.elapsed = float(self._rows[-1]["wall_s"]) if self._rows else 0.0

    def begin(self, *, continues: bool = False) -> None:
        """Prepare the folder and open the files of the run, once its first point is computed.

        Parameters
        ----------
        continues
            Whether to keep the path of an interrupted run, and delete only what the end of a run
            writes. Otherwise an earlier run is removed.
        """
        access_disk(self._comm, self._remove_end_of_run if continues else self._make_room)
        self.complete_points, self._rows = access_disk(self._comm, self._open)
        self.journal = Checkpoint(self._folder / CHECKPOINT, self._scene.model.V, self._comm)

    def _make_room(self) -> None:
        """Replace an earlier run by an empty checkpoint; on rank 0.

        The order of the steps matters: whenever the process is killed, the files that are left are
        recognised as those of a run.
        """
        folder, file = self._folder, self._folder / CHECKPOINT
        new_checkpoint = folder / NEW_CHECKPOINT
        earlier_files = files_of_runs(folder) - {NEW_CHECKPOINT}
        write_whole(new_checkpoint, self._empty_checkpoint)  # a full disk stops here
        remove(folder, earlier_files - {SUMMARY, file.name})
        if self._mesh:
            write_whole(folder / MESH, self._mesh)
        new_checkpoint.replace(file)  # in one step: there is always one of both
        remove(folder, earlier_files & {SUMMARY})

    def _remove_end_of_run(self) -> None:
        """Delete the files that the end of an interrupted run has written; on rank 0."""
        # the fields of points stay, and so do the checkpoint, path.csv and the chosen mesh
        files = files_of_runs(self._folder)
        fields = {name for name in files if name.startswith("fields/")}
        unfinished = {name for name in files if name.endswith(UNFINISHED)}
        remove(self._folder, (files - fields - set(FILES_OF_PATH)) | unfinished)
        if self._mesh and not (self._folder / MESH).exists():
            write_whole(self._folder / MESH, self._mesh)

    def _open(self) -> tuple[int, list[dict[str, str]]]:
        """Open path.csv and the series of fields; on rank 0.

        Returns
        -------
        complete_points
            Number of points of an interrupted run with both a row and fields on disk.
        rows
            Rows of path.csv that the interrupted run has written; empty for a new run.
        """
        # what summary.json takes from the checkpoint; it has the case and the version itself
        identity = run_identity.identity_in(self._folder / CHECKPOINT) or {}
        self._origin = {
            key: value for key, value in identity.items() if key not in ("case", "version")
        }
        self._table = PathTable(self._folder / "path.csv", self._scene.extra_columns)
        # the fields have one half of a mirrored shell, with its plane for ParaView; of a sector
        # they have the whole shell, without a plane
        problem, mirror = self._scene.problem, None
        if problem.mirror and not isinstance(problem.mirror, Sector):
            mirror = problem.mirror.rotated(problem.azimuth).plane
        self._has_whole_shell = mirror is None
        self._R = case_sizes(problem.context.shell).R
        shell_data = ShellData(problem.material.h, problem.material.nu, mirror, self._R)
        magnetic = problem.loads.magnetic
        # bodies and sources are drawn as outlines: one file for each point if they move, else one
        has_moving_sources = bool(magnetic and magnetic.driven)
        outlines_move = problem.loads.contacts or has_moving_sources
        outlines_file = ""
        if outlines(problem.loads, self._scene.unloaded().mu, shell_data.h):
            outlines_file = FILE_OF_POINT if outlines_move else FILE_OF_ALL_POINTS
        grids = [field_map.grid.name for field_map in problem.loads.field_maps]
        rows = self._table.complete_rows
        self._fields = FieldSeries(self._folder / "fields", shell_data, outlines_file, rows, grids)
        sync_folder(self._folder)
        return min(len(rows), self._fields.complete_points), rows

    def write(self, row: Row, state: State, scene: Scene) -> None:
        """Write a point's row and fields, unless an interrupted run has written both.

        Parameters
        ----------
        row
            The point's row of path.csv.
        state
            Displacement and amplitudes of the point, in the model of `scene`.

        Raises
        ------
        CaseError
            If the point differs from that of the interrupted run.
        """
        number = int(row["point"])
        # points of the interrupted run: with a row on disk, and with fields too
        if number < len(self._rows):
            _check_equal(row, self._rows[number])
        if number < self.complete_points:
            return
        if scene is not self._scene:  # the path goes on in another model
            self._scene, self._gatherer = scene, gatherer(scene.model, self._comm)
        surface, mirror = self._gatherer.gather(state.u, state.mu), scene.problem.mirror
        grids = maps_at(scene.view, state)

        def write() -> None:
            """Write the row, the grids and the fields of the whole or modelled shell; on rank 0."""
            assert surface is not None
            problem = scene.problem
            # the files have one half only if ParaView mirrors it, from the first point on
            shell = surface
            has_no_plane = isinstance(mirror, Sector) or self._has_whole_shell
            if mirror and has_no_plane:
                shell = completed_by_symmetry(surface, mirror)
            # bodies and sources beside the shell
            loads_and_state = problem.loads, state.mu, problem.material.h
            shell = replace(
                shell, outlines=outlines(*loads_and_state), solids=solids(*loads_and_state)
            )
            self._table.write(row)
            grid_contents = {grid.name: grid_content(grid, self._R) for grid in grids}
            self._fields.write(number, rotated_surface(shell, problem.azimuth), row, grid_contents)

        access_disk(self._comm, write)

    def write_summary(self, content: dict[str, Any]) -> None:
        """Write summary.json, with a verdict in words under the key `says`."""

        def write() -> None:  # names the mesh file and the sources as they were at the start
            data = json.loads(json.dumps({**content, **self._origin}))
            data["says"] = terminal_text(verdict(data, read_lines(self._folder / "path.csv")))
            write_object(self._folder / SUMMARY, data, indent=2)

        access_disk(self._comm, write)

    def close(self, complete: bool) -> None:
        """Close the files and write the manifest; delete the checkpoint of a complete run.

        The manifest lists the files that a later run may replace. `complete` is whether the run has
        come to its end, so that nothing is left to resume.
        """
        assert self.journal
        access_disk(self._comm, lambda: self._table.close())
        self.journal.close()
        if complete:
            self.journal.remove()

        def list_files() -> None:
            (self._folder / MANIFEST).unlink(missing_ok=True)  # `plot` may have made one meanwhile
            write_manifest(self._folder)

        # a folder without the list is still known by its summary.json
        with suppress(DiskError):
            access_disk(self._comm, list_files)


def _check_equal(row: Row, stored: dict[str, str]) -> None:
    """Check that the row of a recomputed point equals the stored one, within tolerances.

    Raises
    ------
    CaseError
        If the label or a number differs.
    """
    is_equal = row["label"] == stored["label"] and all(
        math.isclose(
            float(row[key]),
            float(stored[key]),
            rel_tol=RELATIVE_TOLERANCE,
            abs_tol=ABSOLUTE_TOLERANCE,
        )
        for key in COMPARED_COLUMNS
    )
    if not is_equal:
        raise CaseError(
            f"--resume: point {row['point']} differs from path.csv; give another folder, "
            "or --overwrite in place of --resume"
        )
