"""k_d against an independent axisymmetric solver (nine digits) as the mesh is refined and the
degree raised.

Run as a script for the whole table: python3 tests/test_convergence.py
"""

from pathlib import Path

import numpy as np
import pytest

from magshell_fenicsx import Case
from magshell_fenicsx.public import run

CASE = Path(__file__).parents[1] / "cases" / "dimple_buckling.yaml"
REFERENCE = {0.0: 0.326233289, 0.00184: 0.552053778, -0.00184: 0.120723848}


def error(lambda_m: float, degree: int, refinement: float) -> tuple[int, int, float]:
    """Cells, unknowns and relative error of k_d."""
    settings = [
        f"magnetic.lambda_m={lambda_m}",
        f"mesh.degree={degree}",
        f"mesh.refinement={refinement}",
        "symmetry=half",
    ]
    found = run(Case.load(CASE, settings))
    assert found.knockdown is not None
    return (
        found.scene.cells,
        found.scene.model.system.dofs,
        found.knockdown / REFERENCE[lambda_m] - 1,
    )


@pytest.mark.slow
def test_knockdown_converges() -> None:
    """Smooth solutions give h^(2k-2); the rim of the dimple is followed to h^4."""
    (coarse, _, a), (fine, _, b) = (error(0.0, 4, refinement) for refinement in (0.5, 1.0))
    assert np.log(abs(a / b)) / np.log(np.sqrt(fine / coarse)) > 4


if __name__ == "__main__":
    print("lambda_m  degree  refinement  cells  unknowns  error of k_d  order in h")
    for lambda_m in REFERENCE:
        for degree, refinements in {2: (1, 2), 3: (0.5, 1, 2), 4: (0.5, 1, 2), 5: (0.5, 1)}.items():
            last = None
            for refinement in refinements:
                cells, dofs, e = error(lambda_m, degree, refinement)
                order = (
                    f"{np.log(abs(last[1] / e)) / np.log(np.sqrt(cells / last[0])):.1f}"
                    if last
                    else ""
                )
                print(
                    (
                        f"{lambda_m:+.5f} {degree:6} {refinement:9} {cells:9} {dofs:9} "
                        f"{e:+12.1e} {order:>9}"
                    ),
                    flush=True,
                )
                last = cells, e
