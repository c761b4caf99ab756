"""Parts of a run, timed in a separate process without writing files.

`[mpirun -n N] python3 -m magshell_fenicsx.studies.study.workload KIND CASE SETTINGS RESULTS`, the last two JSON
lists, prints one line of JSON. Times are wall seconds of the slowest rank and CPU seconds of all ranks.
"""

import json
import sys
from collections.abc import Callable
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.case.opened import opened
from magshell_fenicsx.runs.rows import RowMaker
from magshell_fenicsx.runs.snaps import snaps
from magshell_fenicsx.runs.summary import Result
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.perfect import with_modes
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.studies.study.iteration import measured, timed
from magshell_fenicsx.studies.study.scalar import parse_scalar

Report = dict[str, Any]
REPEATS = 5


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
    found = {"knockdown": result.knockdown, "limit_points": result.limit_points, "snaps": snaps(result.rows)}
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
        "values": {name: parse_scalar(name).of(found, rows) for name in results},
        "stopped": result.stopped,
    }


def iteration(scene: Scene, results: list[str]) -> Report:
    """The run times of the parts of a Newton iteration."""
    return {**measured(scene, REPEATS)}


def kernels(scene: Scene, results: list[str]) -> Report:
    """The number of kernels of the scene, including the modes that it excludes."""
    scene.model.excluded_modes  # noqa: B018  (compiles theirs)
    return {"kernels": len(scene.model.kernels.names)}


KINDS: dict[str, Callable[[Scene, list[str]], Report]] = {"path": path, "iteration": iteration, "kernels": kernels}


def main(kind: str, case: str, settings: str, results: str) -> None:
    """Build the scene of a case, do the work, print the times."""
    comm = MPI.COMM_WORLD
    scene = Scene(with_modes(opened(case, comm, json.loads(settings)), comm), comm)
    report = KINDS[kind](scene, json.loads(results))
    if comm.rank == 0:
        model = scene.model
        built = {"jit_s": model.kernels.seconds, "setup_s": scene.setup_s, "dofs": model.system.dofs}
        print(json.dumps({**built, **report}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
