"""Compile kernels ahead of time, for images and clusters without a compiler at run time: of hemispheres and solids.

Other geometries have terms of their own (dead loads, mirror edges, thickness), compiled on the first run.
"""

import time

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.source import Source
from magshell_fenicsx.scene import Scene

EVERYTHING = {
    "shell": {"geometry": "hemisphere", "radius_to_thickness": 20, "poisson_ratio": 0.3},
    "boundary": {"equator": "clamped"},
    "magnetic": {"lambda_m": 1e-3},
}
SCENES = (
    ("half", {"kind": "pressure"}),
    ("axisymmetric", {"kind": "pressure"}),
    ("half", {"kind": "indentation", "at": {"polar": 45}, "depth": 1, "patch": 5}),
)
SOLIDS = SCENES[::2]  # of one degree


def precompile(degree: int) -> float:
    """Compile the kernels of hemispheres and solids of a degree; the seconds that it took."""
    start = time.perf_counter()
    shells = [("shell", *scene, {"degree": degree}) for scene in SCENES]
    solids = [("solid", *scene, {}) for scene in SOLIDS]
    for model, symmetry, loading, mesh in [*shells, *solids]:
        chosen = {"model": model, "symmetry": symmetry, "loading": loading, "mesh": {"refinement": 0.5, **mesh}}
        data = {**EVERYTHING, **chosen}
        scene = Scene(Case.from_source(Source("precompile", data)), MPI.COMM_WORLD)
        scene.model.excluded_modes  # noqa: B018  (compiles theirs)
    return time.perf_counter() - start
