"""The estimate of a mesh's size before it is made."""

import pytest
from conftest import CASES

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.mesh.triangulation import triangulate
from magshell_fenicsx.plan.planner import make_plan


@pytest.mark.parametrize(
    ("file", "setting"),
    [
        ("dimple_buckling.yaml", "symmetry=half"),
        ("dimple_buckling.yaml", "symmetry=none"),
        ("indentation.yaml", "mesh.refinement=4"),
        ("indentation.yaml", "shell.radius_to_thickness=1000"),
        ("magnetic_strip.yaml", "shell.width=0.01"),
        ("magnetic_strip.yaml", "mesh.refinement=5"),
    ],
)
def test_estimate_of_cells_is_near_what_gmsh_makes(file: str, setting: str) -> None:
    """Never far too few, and too many at most by half."""
    plan = make_plan(Case.load(CASES / file, [setting]))
    cells = len(triangulate(plan.shape, plan.size, plan.points, plan.embedding).cells)
    assert 0.9 < plan.size.cells(plan.shape) / cells < 1.6
