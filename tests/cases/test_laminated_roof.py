"""The case "laminated_roof.yaml": laminates of Sze, Liu and Lo, Finite Elem. Anal. Des. 40 (2004),
3.8.

The tables are of S4R on one mesh; see docs/benchmarks/README.md for their source.
"""

import pytest
from benchmarks.obstacles import along_curve, computed, published
from conftest import CASES

from magshell_fenicsx import Case
from magshell_fenicsx.public import run


@pytest.mark.slow
@pytest.mark.parametrize(("angles", "most"), [((0, 90, 0), None), ((90, 0, 90), 0.5970)])
def test_whole_curve(angles: tuple[int, ...], most: float | None) -> None:
    """Through their folds, within 1 % of the largest displacement and of the largest load; h =
    12.7.

    The first fold of [90/0/90] is near the largest tabulated load before the snap.
    """
    table = f"hinged_roof_12.7_{'_'.join(map(str, angles))}"
    settings = [f"shell.laminate.plies.{i}.angle={angle}" for i, angle in enumerate(angles)]
    found = run(
        Case.load(
            CASES / "laminated_roof.yaml", [*settings, "shell.thickness=12.7", "mesh.size=64"]
        )
    )
    assert found.stopped is None
    folds = [point for point in found.limit_points if point["kind"] == "fold"]
    assert len(folds) >= 2
    assert most is None or folds[0]["value"] == pytest.approx(most, abs=2e-3)
    assert along_curve(computed(found.rows, "-C_ux"), published(table, "minus_w_C")) < 1e-2
