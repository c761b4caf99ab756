"""Compilation of kernels ahead of time, for images and clusters without a compiler at run time.

These are the kernels of hemispheres, of their solids, and of any mid-surface under dead loads.
Remanences by formula, fields with a gradient, approximate energies, surfaces with kinks and loads
of other solids compile theirs on the first run.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.input.source import Source
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.simulate.scene import Scene

HEMISPHERE = {
    "shell": {"geometry": "hemisphere", "radius_to_thickness": 20, "poisson_ratio": 0.3},
    "boundary": {"equator": "clamped"},
    "magnetic": {"lambda_m": 1e-3},
}
SCENES = (
    ("half", {"kind": "pressure"}),
    ("axisymmetric", {"kind": "pressure"}),
    ("half", {"kind": "indentation", "at": {"polar": 45}, "depth": 1, "patch": 5}),
)
SOLIDS = SCENES[::2]  # those of halves, as a solid is never axisymmetric
OCTANT: dict[str, Any] = {  # symmetric in three planes, each a kernel of its own
    "shell": {
        "geometry": "cylinder",
        "radius": 1,
        "length": 1,
        "azimuth": [0, 90],
        "thickness": 0.05,
    }
    | {"youngs_modulus": 1, "poisson_ratio": 0.3},
    "magnetic": {"lambda_m": 1e-3},
    "boundary": {"left": "symmetry", "right": "symmetry", "bottom": "symmetry"},
    "points": {"A": [1, 0, 0]},
    "loading": {
        "kind": "dead",
        "factor": 1,
        "loads": [
            {"at": "A", "force": [1, 0, 0]},
            {"edge": "top", "force": [0, 0, 1]},
            {"edge": "top", "moment": 1},
            {"over": "all", "per_area": [0, 0, 1]},
            {"over": "all", "pressure": 1},
        ],
    },
}


def precompile(degree: int, make_problem: Callable[[Source], Problem]) -> float:
    """Compile the kernels of shells of a degree and of solids; return the time in seconds.

    Parameters
    ----------
    make_problem
        Function from a source of a case to its problem.
    """
    start = time.perf_counter()
    for data in _cases(degree):
        scene = Scene(make_problem(Source("precompile", data)), MPI.COMM_WORLD)
        scene.model.symmetry_breaking_modes  # noqa: B018  (the first use compiles its kernels)
    return time.perf_counter() - start


def _cases(degree: int) -> Iterator[dict[str, Any]]:
    """Yield data of cases that together need the kernels of shells of a degree and of solids."""
    for symmetry, loading in SCENES:
        yield {
            **HEMISPHERE,
            "symmetry": symmetry,
            "loading": loading,
            "mesh": {"refinement": 0.5, "degree": degree},
        }
    for symmetry, loading in SOLIDS:
        yield {
            **HEMISPHERE,
            "model": "solid",
            "symmetry": symmetry,
            "loading": loading,
            "mesh": {"refinement": 0.5},
        }
    # a uniform thickness, and one that varies, have kernels of their own
    for factor in ({}, {"thickness_factor": "1 + z/2"}):
        yield {
            **OCTANT,
            "shell": {**OCTANT["shell"], **factor},
            "mesh": {"size": 0.5, "degree": degree},
        }
