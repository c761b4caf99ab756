"""Default element sizes of tubes, by the waves in which they buckle.

Source: on Koiter's circle half a wave along a tube is at least pi sqrt(Rh)/(12 (1 - nu^2))^(1/4)
long, under axial compression, and half a wave around it twice that. Torsion makes waves as long as
the tube. The load at a bifurcation is that of the tube's meridian, with waves around it.
"""

from collections.abc import Mapping
from math import pi, sqrt
from typing import Any

import pytest

from magshell_fenicsx import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.public import run

H = 0.02  # thickness over R
HALF_WAVE = pi * sqrt(H) / (12 * (1 - 0.3**2)) ** 0.25
SQUEEZED = {"translation": [0, 0, -0.05]}
TWISTED = {"rotation": {"axis": [0, 0, 1], "point": [0, 0, 2], "angle": 30}}
BENT = {"rotation": {"axis": [0, 1, 0], "point": [0, 0, 2], "angle": 30}}


def tube(move: Mapping[str, Any], length: float = 2, **keys: Any) -> dict[str, Any]:
    shell = {"geometry": "cylinder", "radius": 1, "length": length, "thickness": H}
    return {
        "shell": {**shell, "poisson_ratio": 0.3},
        "boundary": {"bottom": "clamped", "top": "clamped"},
        "loading": {
            "kind": "edge",
            "moves": [{"supports": ["top"], **move}],
            "until": "bifurcation",
        },
        **keys,
    }


def grid_of(data: Mapping[str, Any]) -> Grid:
    problem = make_problem(Case.from_source(data))
    assert isinstance(problem.shape, Grid)
    return problem.shape


@pytest.mark.parametrize(("move", "along"), [(SQUEEZED, 2), (TWISTED, 8), (BENT, 2)], ids=str)
def test_elements_of_a_tube(move: Mapping[str, Any], along: float) -> None:
    """A wave along the tube has an element and more to each half, one around it almost three."""
    grid = grid_of(tube(move, length=20, symmetry="none"))
    assert grid.size_at(1, 10.0) == pytest.approx(along * sqrt(H))
    assert grid.size_at(0, 1.0) == pytest.approx(2.5 * sqrt(H))
    assert grid.size_at(0, 1.0) < 2 * HALF_WAVE / 1.3
    assert grid.size_at(1, 0.0) == pytest.approx(1.2 * sqrt(H))


def test_unknowns_grow_with_the_length_of_a_tube() -> None:
    """And slowly under torsion: forty radii take three times the elements of eight."""
    short, long = (grid_of(tube(TWISTED, length, symmetry="none")).cells for length in (8, 40))
    assert 2 < long / short < 4


@pytest.mark.slow
def test_a_squeezed_tube() -> None:
    """It buckles in six waves: half of the tube, on its default mesh, against the meridian."""
    critical_loads = [run(tube(SQUEEZED, symmetry=model)).rows[-1] for model in ("auto", "half")]
    meridian, half = (float(row["motion"]) for row in critical_loads)
    assert critical_loads[0]["mode"] == "m = 6"
    assert half == pytest.approx(meridian, rel=2e-3)
