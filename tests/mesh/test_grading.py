"""The estimate of a mesh's size before it is made."""

from typing import Any

import numpy as np
import pytest
from conftest import CASES
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.mesh.triangulation import triangulate

Array = NDArray[np.float64]


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
    assert 0.9 < estimated(Case.load(CASES / file, [setting])) < 1.2


@pytest.mark.parametrize(
    ("count", "width"), [(1, 0.5), (10, 0.5), (10, 3.0), (100, 0.5), (100, 2.0)]
)
def test_estimate_of_cells_where_fine_places_overlap(count: int, width: float) -> None:
    """Gaussians at random on a hemisphere: one, some apart, and many that overlap."""
    rng = np.random.default_rng(1)
    polar, azimuth = (
        np.degrees(np.arccos(rng.uniform(0.2, 0.98, count))),
        rng.uniform(-180, 180, count),
    )
    imperfections = [
        {
            "kind": "gaussian",
            "amplitude": 0.1,
            "width": width,
            "at": {"polar": float(p), "azimuth": float(a)},
        }
        for p, a in zip(polar, azimuth, strict=True)
    ]
    shell = {
        "geometry": "hemisphere",
        "radius_to_thickness": 100,
        "poisson_ratio": 0.5,
        "imperfections": imperfections,
    }
    data = {
        "shell": shell,
        "boundary": {"equator": "clamped"},
        "loading": {"kind": "pressure"},
        "symmetry": "none",
    }
    assert 0.9 < estimated(Case.from_source({**data, "mesh": {"refinement": 0.25}})) < 1.2


@pytest.mark.parametrize(
    "of_place", ["exp(-3000*((x-0.3)**2 + y**2))", "exp(-2000*(sqrt(x**2+y**2) - 0.5)**2)"]
)
def test_estimate_of_cells_where_a_formula_varies(of_place: str) -> None:
    """At a place, and along a circle."""
    load = {"kind": "dead", "loads": [{"over": "all", "pressure": f"1e-6*{of_place}"}], "factor": 1}
    shell = {"geometry": "disc", "radius_to_thickness": 100, "poisson_ratio": 0.3}
    data = {"shell": shell, "boundary": {"rim": "clamped"}, "loading": load, "symmetry": "none"}
    assert 0.8 < estimated(Case.from_source(data)) < 1.25


def estimated(case: Case) -> float:
    """The estimate over the number of cells that gmsh makes."""
    problem = make_problem(case)
    cells = len(triangulate(problem.shape, problem.size, problem.points, problem.embedding).cells)
    return problem.size.cells(problem.shape) / cells


PLATE = {"geometry": "plate", "length": 1, "width": 1, "thickness": 0.005, "poisson_ratio": 0.3}


def lines(**sections: Any) -> list[Array]:
    """Those of a grid across its axes."""
    data = {"shell": PLATE, "boundary": {"left": "clamped"}, "symmetry": "none", **sections}
    problem = make_problem(Case.from_source(data))
    assert isinstance(problem.shape, Grid)
    assert problem.shape.cells == pytest.approx(len(problem.triangulated().cells), rel=0.35)
    return [problem.shape.lines(axis, list(problem.points.values())) for axis in range(2)]


def test_grid_lines_are_dense_where_an_edge_is_held() -> None:
    """1.2 sqrt(Rh) at the clamped edge, 2 sqrt(Rh) far from it; all the same along it."""
    across, along = lines()
    steps, root = np.diff(across), np.sqrt(0.005)
    assert steps[0] == pytest.approx(
        1.4 * root, rel=0.2
    )  # the mean of the size over the first step
    assert steps[-1] == pytest.approx(2 * root, rel=0.2)
    assert (np.diff(steps) > -1e-12).all()
    assert np.diff(along) == pytest.approx(np.full(len(along) - 1, along[1]))


def test_grid_lines_are_dense_at_a_load() -> None:
    """Down to the thickness at the point, the same on either side of it."""
    loading = {"kind": "indentation", "at": {"point": "A"}, "depth": 1}
    for x in lines(
        points={"A": [0.5, 0.5, 0]},
        loading=loading,
        boundary=dict.fromkeys(("left", "right"), "clamped"),
    ):
        steps = np.diff(x)
        assert steps == pytest.approx(steps[::-1])
        assert steps.min() == pytest.approx(0.005, rel=0.5)
        assert steps.max() > 10 * steps.min()


def test_a_given_size_is_everywhere() -> None:
    assert [np.diff(x) for x in lines(mesh={"size": 0.1})] == [pytest.approx(np.full(10, 0.1))] * 2
