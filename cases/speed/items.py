"""What the benchmark consists of."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

CASES = Path(__file__).parents[1]
WITH_CAMPAIGNS = {
    "PYTHONPATH": os.pathsep.join([str(CASES), os.environ.get("PYTHONPATH", "")])
}  # of a process

# F R/(2 pi D) at w/h, lambda_m = +0.00184: our own of degree 5, refinement 1.9 (1.4 is within 2e-5
# of it); hybridised Hellan-Herrmann-Johnson elements, two meshes within 1.8e-4, have 3.0565,
# 8.2762, 15.1470, 21.603, 27.528
FORCES = {"1": 3.056688, "5": 8.276619, "10": 15.147651, "15": 21.603598, "20": 27.525839}
INDENTATION = {f"force@w_over_h={w}": F for w, F in FORCES.items()}
K_D = {"knockdown": 0.326233289}  # axisymmetric solver, nine digits
FIELD_K_D = {"knockdown": 0.552053778}  # the same solver
TILTED_K_D = {"knockdown": 0.49154026}  # our own of degree 5: no other solver is at hand
COARSE, FINE = (
    "mesh.refinement=0.75",
    "mesh.refinement=1.25",
)  # good for 2e-3 and 2e-4: see docs/bench
TILTED = "magnetic={lambda_m: 0.00184, remanent: {polar: 45}, applied: {polar: 45}}"
HALF = ("symmetry=half", "magnetic.lambda_m=0.00184")
K_D_20_000, ONE_RANK, TWO_RANKS = "k_d 20 000", "iteration 100 000", "iteration 100 000, 2 ranks"
ITERATIONS = ("iteration 10 000", "iteration 30 000", ONE_RANK)

Kind = Literal["path", "run", "iteration", "kernels"]


@dataclass(frozen=True)
class Item:
    """One benchmark.

    Attributes
    ----------
    kind
        "run": all of `magshell run`; else a piece of it without files, see `speed.workload`.
    references
        Name of a result -> its value from elsewhere; the largest relative error is noted.
    cold
        In an empty kernel cache.
    """

    kind: Kind
    case: str
    settings: tuple[str, ...] = ()
    references: Mapping[str, float] = field(default_factory=dict)
    ranks: int = 1
    repeat: int = 3
    cold: bool = False


def _iteration(refinement: float, ranks: int = 1) -> Item:
    return Item(
        "iteration",
        "dimple_buckling",
        (*HALF, f"mesh.refinement={refinement}"),
        ranks=ranks,
        repeat=1,
    )


ITEMS = {
    "indentation": Item("path", "indentation", (), INDENTATION),
    "indentation, whole": Item("run", "indentation"),
    "indentation 2e-3": Item("path", "indentation", (COARSE,), INDENTATION),
    "indentation 2e-3, whole": Item("run", "indentation", (COARSE,)),
    "indentation 2e-4": Item("path", "indentation", (FINE,), INDENTATION),
    "indentation 2e-4, whole": Item("run", "indentation", (FINE,)),
    "k_d tilted": Item("path", "dimple_buckling", (TILTED, "mesh.refinement=0.5"), TILTED_K_D),
    "k_d meridian": Item("path", "dimple_buckling", (), K_D),
    "k_d meridian, whole": Item("run", "dimple_buckling"),
    "k_d half shell, whole": Item("run", "dimple_buckling", HALF),
    K_D_20_000: Item(
        "path", "dimple_buckling", (*HALF, "mesh.refinement=1.5"), FIELD_K_D, repeat=1
    ),
    **{
        name: _iteration(refinement) for name, refinement in zip(ITERATIONS, (1, 2, 4), strict=True)
    },
    TWO_RANKS: _iteration(4, ranks=2),
    "kernels, cold": Item("kernels", "indentation", ("mesh.refinement=0.3",), repeat=2, cold=True),
}
