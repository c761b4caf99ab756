"""The case "laminated_roof.yaml": laminates of Sze, Liu and Lo, Finite Elem. Anal. Des. 40 (2004), 3.8.

The tables are of S4R on one mesh; see docs/benchmarks/README.md for their source.
"""

import pytest
from benchmarks.obstacles import along_curve, computed, published
from conftest import CASES

from magshell_fenicsx import Case
from magshell_fenicsx.public import run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("angles", "thickness", "size"),
    [((0, 90, 0), 12.7, 64), ((90, 0, 90), 12.7, 64), ((0, 90, 0), 6.35, 32)],
)
def test_whole_curve(angles: tuple[int, ...], thickness: float, size: float) -> None:
    """Through their folds, within 1 % of the largest displacement and of the largest load.

    A thin roof under a force at a point is farthest away at its end: 1.2 % on the mesh of the thick one, and 0.96 % on
    finer ones.
    """
    table = f"hinged_roof_{thickness:g}_{'_'.join(map(str, angles))}"
    settings = [f"shell.laminate.plies.{i}.angle={angle}" for i, angle in enumerate(angles)]
    settings += [f"shell.thickness={thickness:g}", f"mesh.size={size}"]
    found = run(Case.load(CASES / "laminated_roof.yaml", settings))
    assert found.stopped is None
    folds = [point for point in found.limit_points if point["kind"] == "fold"]
    assert len(folds) >= 2
    assert along_curve(computed(found.rows, "-C_ux"), published(table, "minus_w_C")) < 1e-2


@pytest.mark.slow
def test_first_fold() -> None:
    """[90/0/90], h = 12.7: the largest tabulated load before the snap is 0.5970 of 3000."""
    found = run(Case.load(CASES / "laminated_roof.yaml", ["loading.points=10"]))
    fold = next(point for point in found.limit_points if point["kind"] == "fold")
    assert fold["value"] == pytest.approx(0.5970, abs=2e-3)
