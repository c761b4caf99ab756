"""Parts of a run and of a Newton iteration, timed in a separate process without writing files.

`[mpirun -n N] python3 -m speed.workload KIND CASE SETTINGS RESULTS`, the last two JSON lists,
prints one line of JSON; `python3 -m speed.workload scale REPEATS DEGREE REFINEMENT` that of the
parts of an iteration. Times are wall seconds of the slowest rank and CPU seconds of all ranks.
"""

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.case_variants import open_case
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.public import Scene
from magshell_fenicsx.runs.rows import RowMaker
from magshell_fenicsx.runs.summary import Result, snaps
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.perfect import with_modes
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.studies.results import parse_scalar

Report = dict[str, Any]
REPEATS = 5
CASE = {
    "shell": {
        "geometry": "hemisphere",
        "radius_to_thickness": 90,
        "poisson_ratio": 0.5,
        "defect": {"kind": "dimple", "amplitude": 1.64, "width": 3.2},
    },
    "boundary": {"equator": "clamped"},
    "magnetic": {"lambda_m": 0.00184},
    "loading": {"kind": "pressure", "until": "limit"},
    "symmetry": "half",
}
MU = {"lambda_m": 1e-3, "pressure": 0.1}
WAVES = 5 * np.array([[3, 1, 2], [1, -2, 5], [-4, 2, 1]])
HEIGHT = 1e-4  # over h; every term contributes, and the tangent is positive definite


def measured(scene: Scene, repeats: int) -> dict[str, float]:
    """Medians over iterations after the first, which also finds the ordering and the sparsity."""
    model, factorisation, comm = scene.model, scene.newton.factorisation, scene.comm
    system = model.system
    r0 = model.r0.x.array[: system.size].reshape(-1, 3)
    u = system.zero_at_supports((HEIGHT * system.length * np.sin(r0 @ WAVES)).ravel())
    rhs = system.load(u, MU, "pressure")
    first = timed(comm, lambda: factorisation.factor(system.tangent(u, MU)))
    K = system.tangent(u, MU)
    pieces = {
        "tangent": lambda: system.tangent(u, MU),
        "factor": lambda: factorisation.factor(K),
        "back_solves": lambda: (factorisation.solve(rhs), factorisation.solve(rhs)),
        "residual": lambda: system.residual(u, MU),
    }
    found = {
        "first_wall_s": first[0],
        "first_cpu_s": first[1],
        "negative_pivots": factorisation.negative_pivots,
    }
    runs = [{name: timed(comm, do) for name, do in pieces.items()} for _ in range(repeats)]
    for name in pieces:
        for place, kind in enumerate(("wall", "cpu")):
            found[f"{name}_{kind}_s"] = float(np.median([run[name][place] for run in runs]))
    error = rhs - factorisation.times(factorisation.solve(rhs))
    found["solve_error"] = float(np.sqrt(comm.allreduce(error @ error) / comm.allreduce(rhs @ rhs)))
    return found


def timed(comm: MPI.Comm, do: Callable[[], Any]) -> tuple[float, float]:
    """Wall seconds of the slowest rank and CPU seconds of all; collective."""
    comm.Barrier()
    wall, cpu = time.perf_counter(), time.process_time()
    do()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return float(comm.allreduce(wall, MPI.MAX)), float(comm.allreduce(cpu))


def path(scene: Scene, results: list[str]) -> Report:
    """The run time of the whole history, and its results."""
    result, made, comm = Result(scene, scene.unloaded()), RowMaker(scene), scene.comm

    def solve() -> None:
        try:
            for record in follow(scene, remark=result.remarks.append):
                result.rows.append(made.row(record, 0.0))
        except Stopped as e:
            result.stopped = str(e)

    wall, cpu = timed(comm, solve)
    found = {
        "knockdown": result.knockdown,
        "limit_points": result.limit_points,
        "snaps": snaps(result.rows),
    }
    rows = [{key: str(value) for key, value in row.items()} for row in result.rows]
    newton = scene.newton
    return {
        "solve_phase_wall_s": wall,
        "solve_phase_cpu_s": cpu,
        "assembly_wall_s": scene.model.system.assembly.seconds,
        "factor_wall_s": newton.factorisation.stopwatch.seconds,
        "back_solve_wall_s": newton.factorisation.solving.seconds,
        "factorisations": newton.factorisation.count,
        "iterations": newton.iterations,
        "values": {name: parse_scalar(name).value_in(found, rows) for name in results},
        "stopped": result.stopped,
    }


def iteration(scene: Scene, results: list[str]) -> Report:
    """The run times of the parts of a Newton iteration."""
    return {**measured(scene, REPEATS)}


def kernels(scene: Scene, results: list[str]) -> Report:
    """The number of kernels of the scene, including the modes that it excludes."""
    scene.model.symmetry_breaking_modes  # noqa: B018  (compiles theirs)
    return {"kernels": len(scene.model.kernels.names)}


KINDS: dict[str, Callable[[Scene, list[str]], Report]] = {
    "path": path,
    "iteration": iteration,
    "kernels": kernels,
}


def scale(repeats: str, degree: str, refinement: str) -> tuple[Scene, Report]:
    """The parts of an iteration on a mesh of one shell."""
    data = {**CASE, "mesh": {"degree": int(degree), "refinement": float(refinement)}}
    scene = Scene(Case.from_source(Source("scale", data)), MPI.COMM_WORLD)
    return scene, {"cells": scene.cells, **measured(scene, int(repeats))}


def of_case(kind: str, case: str, settings: str, results: str) -> tuple[Scene, Report]:
    """A part of the run of a case."""
    comm = MPI.COMM_WORLD
    scene = Scene(with_modes(open_case(case, comm, json.loads(settings)).problem(), comm), comm)
    report = KINDS[kind](scene, json.loads(results))
    return scene, {"jit_s": scene.model.kernels.seconds, **report}


def main(kind: str, *arguments: str) -> None:
    """Build the scene, do the work, print the times."""
    scene, report = scale(*arguments) if kind == "scale" else of_case(kind, *arguments)
    if scene.comm.rank == 0:
        built = {"setup_s": scene.setup_s, "dofs": scene.model.system.dofs}
        print(json.dumps({**built, **report}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
