"""Pieces of a run that are timed inside a process of their own, without files.

`[mpirun -n N] python3 -m magshell_fenicsx.study.workload KIND CASE SETTINGS RESULTS`, the last two JSON
lists, prints one line of JSON. Every time is in wall seconds of the slowest rank and in CPU seconds
of all ranks.
"""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.follow import Stopped, follow
from magshell_fenicsx.results.summary import Result
from magshell_fenicsx.scene import Scene
from magshell_fenicsx.study.scalar import parse_scalar

Report = dict[str, Any]
REPEATS = 5
AMPLITUDES = {"lambda_m": 1e-3, "pressure": 0.1, "force": 0.1}  # for a tangent in which every term has a part


def path(scene: Scene, results: list[str]) -> Report:
    """The history from the unloaded shell to its end, and numbers of it."""
    result, comm = Result(scene, scene.unloaded()), scene.comm

    def solve() -> None:
        try:
            for record in follow(scene):
                told = {"label": record.label, "amplitude": record.amplitude, "mode": record.mode}
                state = record.point.state
                result.rows.append({**told, **scene.observe(state), "branch": record.branch})
        except Stopped as e:
            result.stopped = str(e)

    wall, cpu = timed(comm, solve)
    found = {"knockdown": result.knockdown, "limit_points": result.limit_points}
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


def tangent(scene: Scene, results: list[str]) -> Report:
    """The tangent, its factorisation and one back-solve, several times each."""
    state, newton, comm = scene.unloaded(), scene.newton, scene.comm
    rng = np.random.default_rng(comm.rank)
    # far below an element's size: rough, but no element turns over
    u = 1e-4 * newton.system.length * rng.standard_normal(state.u.size)
    state = replace(state, u=u, mu={name: AMPLITUDES.get(name, 0.0) for name in state.mu})
    rhs = rng.standard_normal(state.u.size)
    times: dict[str, list[tuple[float, float]]] = {"tangent": [], "factor": [], "back_solve": []}
    first = timed(comm, lambda: newton.factorisation.factor(newton.system.tangent(state.u, state.mu)))
    for _ in range(REPEATS):
        K = newton.system.tangent(state.u, state.mu)  # outside the times: of the ranks, none is ahead
        times["tangent"].append(timed(comm, lambda: newton.system.tangent(state.u, state.mu)))
        times["factor"].append(timed(comm, lambda K=K: newton.factorisation.factor(K)))  # type: ignore[misc]
        times["back_solve"].append(timed(comm, lambda: newton.factorisation.solve(rhs)))
    report: Report = {"first_wall_s": first[0], "first_cpu_s": first[1]}
    for name, pairs in times.items():
        report[f"{name}_wall_s"], report[f"{name}_cpu_s"] = (list(column) for column in zip(*pairs, strict=True))
    return report


def kernels(scene: Scene, results: list[str]) -> Report:
    """Every kernel that the scene needs, also for the modes that it excludes."""
    scene.model.excluded_modes  # noqa: B018  (compiles theirs)
    return {"kernels": len(scene.model.kernels.names)}


KINDS: dict[str, Callable[[Scene, list[str]], Report]] = {"path": path, "tangent": tangent, "kernels": kernels}


def timed(comm: MPI.Comm, do: Callable[[], Any]) -> tuple[float, float]:
    """Wall seconds of the slowest rank and CPU seconds of all; collective."""
    comm.Barrier()
    wall, cpu = time.perf_counter(), time.process_time()
    do()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return float(comm.allreduce(wall, MPI.MAX)), float(comm.allreduce(cpu))


def main(kind: str, case: str, settings: str, results: str) -> None:
    """Build the scene of a case, do the work, print what it took."""
    comm = MPI.COMM_WORLD
    scene = Scene(Case.load(case, json.loads(settings)), comm)
    report = KINDS[kind](scene, json.loads(results))
    if comm.rank == 0:
        model = scene.model
        built = {"jit_s": model.kernels.seconds, "setup_s": scene.setup_s, "dofs": model.system.dofs}
        print(json.dumps({**built, **report}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
