"""Run a case: follow its history, write every accepted point, summarise."""

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.environment import fast_blas, versions
from magshell_fenicsx.follow import Record, Stopped, follow
from magshell_fenicsx.results.curve import draw_curve
from magshell_fenicsx.results.folder import prepare_folder
from magshell_fenicsx.results.picture import draw_loads, draw_shell
from magshell_fenicsx.results.surface import completed, gatherer, turned
from magshell_fenicsx.results.table import PathTable, Row
from magshell_fenicsx.results.vtu import FieldSeries
from magshell_fenicsx.scene import Scene
from magshell_fenicsx.solve.system import State

Say = Callable[[str], None]
VALUE_COLUMN = {"pressure": "p_over_pc", "force": "force", "lambda_m": "lambda_m"}


@dataclass
class Result:
    """What a run found.

    Attributes
    ----------
    rows
        One mapping per accepted point, with the columns of path.csv.
    last
        The displacement and the amplitudes at the last point.
    stopped
        Why the run ended before its target; None if it reached it.
    """

    scene: Scene
    last: State
    rows: list[Row] = field(default_factory=list)
    stopped: str | None = None

    @property
    def limit_points(self) -> list[dict[str, Any]]:
        """The located instabilities."""
        return [
            {
                "amplitude": row["amplitude"],
                "value": row[VALUE_COLUMN[str(row["amplitude"])]],
                "p_over_pc": row["p_over_pc"],
                "w_pole_over_h": row["w_pole_over_h"],
                "kind": row["label"],
                "mode": row["mode"],
            }
            for row in self.rows
            if row["label"] in ("fold", "bifurcation")
        ]

    @property
    def knockdown(self) -> float | None:
        """k_d: the lowest p/p_c of an instability under pressure; None if there is none."""
        return min((float(p["value"]) for p in self.limit_points if p["amplitude"] == "pressure"), default=None)


def run(
    case: Case, out: Path | str | None = None, comm: MPI.Comm = MPI.COMM_WORLD, say: Say = lambda line: None
) -> Result:
    """Run a case.

    Parameters
    ----------
    out
        Folder for path.csv, summary.json, fields and pictures; None writes nothing.
    say
        Called with one line of text per accepted point, on rank 0.

    Raises
    ------
    CaseError
        If the case has a fault that shows only now, or `out` cannot be written.
    """
    start = time.perf_counter()
    folder = prepare_folder(Path(out), comm, _emptied) if out is not None else None
    scene = Scene(case, comm)
    result = Result(scene, scene.unloaded())
    say = say if comm.rank == 0 else lambda line: None
    say(f"{', '.join(scene.plan.included)}: {scene.cells} cells, {scene.model.system.dofs} unknowns")
    if fast_blas() is None:
        say("warning: PETSc uses the reference BLAS; install OpenBLAS to factor seven times faster")
    files = _Files(folder, scene) if folder else None
    field_end = 0.0
    record = None
    try:
        for record in follow(scene):
            values = scene.observe(record.point.state)
            if record.label in ("start", "field"):
                field_end = values["w_over_h"]
            row: Row = {
                "point": len(result.rows),
                "label": record.label,
                "amplitude": record.amplitude,
                **values,
                "w_from_field_over_h": values["w_over_h"] - field_end,
                "negative_pivots": record.point.negative_pivots,
                "iterations": record.point.iterations,
                "factorisations": record.point.factorisations,
                "wall_s": round(time.perf_counter() - start, 3),
                "mode": record.mode,
            }
            result.rows.append(row)
            result.last = record.point.state
            say(_line(row))
            if files:
                files.write(row, record)
    except Stopped as e:
        result.stopped = str(e)
    if files and record:
        files.finish(result, record, summary(result, time.perf_counter() - start))
    return result


def summary(result: Result, total_s: float) -> dict[str, Any]:
    """The content of summary.json."""
    scene = result.scene
    material, model, newton = scene.plan.material, scene.model, scene.newton
    R_over_h = 1 / material.h
    return {
        "case": scene.case.model_dump(mode="json", exclude_none=True),
        "dimensionless": {
            "radius_to_thickness": R_over_h,
            "poisson_ratio": material.nu,
            "lambda_m": scene.case.lambda_m,
            "Lambda_m": scene.case.lambda_m * R_over_h,
            "pc_over_E": material.classical_pressure,
            "energy_unit": "E h R^2",
        },
        "model": {
            "included": scene.plan.included,
            "left_out": scene.plan.left_out,
            "kernels": model.kernels.names,
            "forms": len(model.kernels.names),
            "penalty": model.sigma,
        },
        "stopped": result.stopped,
        "limit_points": result.limit_points,
        "knockdown": result.knockdown,
        "points": len(result.rows),
        "mesh": {"cells": scene.cells, "dofs": model.system.dofs, "degree": model.degree},
        "timing": {
            "jit_s": model.kernels.seconds,
            "setup_s": scene.setup_s,
            "assembly_s": model.system.assembly.seconds,
            "factor_s": newton.factorisation.stopwatch.seconds,
            "total_s": total_s,
        },
        "factorisations": newton.factorisation.count,
        "iterations": newton.iterations,
        "ranks": scene.comm.size,
        "blas": fast_blas() or "reference",
        "versions": versions(),
    }


class _Files:
    """The output folder of one run; all ranks call, rank 0 writes."""

    def __init__(self, folder: Path, scene: Scene) -> None:
        self._folder, self._scene = folder, scene
        self._gatherer = gatherer(scene.model, scene.comm)
        self._first = scene.comm.rank == 0
        if self._first:
            self._table = PathTable(folder / "path.csv")
            self._fields = FieldSeries(folder / "fields")

    def write(self, row: Row, record: Record) -> None:
        surface = self._gatherer.gather(record.point.state.u)
        if surface is not None:
            self._table.write(row)
            plan = self._scene.plan
            self._fields.write(int(row["point"]), turned(surface, plan.azimuth), plan.material.h)

    def finish(self, result: Result, last: Record, content: dict[str, Any]) -> None:
        surface = self._gatherer.gather(last.point.state.u)
        if surface is None:
            return
        self._table.close()
        (self._folder / "summary.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        plan = self._scene.plan
        whole = turned(completed(surface) if plan.half else surface, plan.azimuth)
        title = _title(result)
        draw_shell(whole, plan.material.h, title, self._folder / "shell.png")
        if whole.fields:
            draw_loads(whole, plan.material.h, title, self._folder / "magnetic_loads.png")
        if last.amplitude:
            draw_curve(result.rows, last.amplitude, title, self._folder / "curve.png")


def _emptied(out: Path) -> None:
    """Make the folder and take an earlier run's files out of it."""
    out.mkdir(parents=True, exist_ok=True)
    for name in ("path.csv", "summary.json", "shell.png", "curve.png", "magnetic_loads.png"):
        (out / name).unlink(missing_ok=True)
    shutil.rmtree(out / "fields", ignore_errors=True)
    (out / "path.csv").touch()


def _line(row: Row) -> str:
    return (
        f"{row['point']:4d} {row['label']:>11}  lambda_m {row['lambda_m']:+.4e}  p/pc {row['p_over_pc']:.6f}  "
        f"FR/2piD {row['force']:9.5f}  w/h {row['w_over_h']:8.4f}  pole {row['w_pole_over_h']:8.4f}  "
        f"unstable {row['negative_pivots']}  it {row['iterations']}"
    )


def _title(result: Result) -> str:
    case, row = result.scene.case, result.rows[-1]
    said = [f"R/h = {case.shell.R_over_h:g}", f"nu = {case.shell.poisson_ratio:g}"]
    if case.lambda_m:
        said.append(f"lambda_m = {row['lambda_m']:g}")
    if row["amplitude"] == "pressure":
        said.append(f"p/pc = {row['p_over_pc']:.5g}")
    if row["amplitude"] == "force":
        said.append(f"w/h = {row['w_over_h']:.4g} at the load")
    return ", ".join(said)
