"""The run time of the parts of a Newton iteration, measured in a separate process.

`[mpirun -n N] python3 -m magshell_fenicsx.studies.study.iteration REPEATS DEGREE REFINEMENT` prints one line of JSON.
Times are wall seconds of the slowest rank and CPU seconds of all ranks.
"""

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.simulate.scene import Scene

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
    """Medians over iterations after the first, which also computes the ordering and the sparsity."""
    model, factorisation, comm = scene.model, scene.newton.factorisation, scene.comm
    system = model.system
    r0 = model.r0.x.array[: system.size].reshape(-1, 3)
    u = system.held((HEIGHT * system.length * np.sin(r0 @ WAVES)).ravel())
    rhs = system.load(u, MU, "pressure")
    first = timed(comm, lambda: factorisation.factor(system.tangent(u, MU)))
    K = system.tangent(u, MU)
    pieces = {
        "tangent": lambda: system.tangent(u, MU),
        "factor": lambda: factorisation.factor(K),
        "back_solves": lambda: (factorisation.solve(rhs), factorisation.solve(rhs)),
        "residual": lambda: system.residual(u, MU),
    }
    found = {"first_wall_s": first[0], "first_cpu_s": first[1], "negative_pivots": factorisation.negative_pivots}
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


def main(repeats: str, degree: str, refinement: str) -> None:
    """Build the scene, measure, print."""
    data = {**CASE, "mesh": {"degree": int(degree), "refinement": float(refinement)}}
    scene = Scene(Case.from_source(Source("scale", data)), MPI.COMM_WORLD)
    found = measured(scene, int(repeats))
    if scene.comm.rank == 0:
        built = {"dofs": scene.model.system.dofs, "cells": scene.cells, "setup_s": scene.setup_s}
        print(json.dumps({**built, **found}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
