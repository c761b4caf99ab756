"""The mesh of a solid for a tolerance, against a mesh twice as fine."""

from typing import Any

from mpi4py import MPI

from magshell_fenicsx import Case
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.adapt.choice import Adapted
from magshell_fenicsx.simulate.adapt.ending import by_path
from magshell_fenicsx.simulate.adapt.tolerance import adapted


def plate(mesh: dict[str, Any], layers: int = 1) -> Case:
    shell = {"geometry": "disc", "radius_to_thickness": 10, "poisson_ratio": 0.3}
    loading = {
        "kind": "pressure",
        "control": "load",
        "until": "target",
        "pressure": 0.01,
        "points": 1,
    }
    data = {
        "model": "solid",
        "shell": shell,
        "boundary": {"rim": "clamped"},
        "loading": loading,
        "mesh": mesh,
    }
    return Case.from_source({**data, "solid": {"layers": layers}})


def test_error_of_a_clamped_disc() -> None:
    """It is below the estimate, and that is below the tolerance."""
    case, told = plate({"tolerance": 0.02}), list[str]()
    found = adapted(case.problem(), MPI.COMM_WORLD, told.append)
    assert found.best.estimate <= 0.02
    assert len(told) == len(found.rounds)
    exact = by_path(Scene(plate({"refinement": 2 * found.best.refinement}, 2))).value
    error = abs(found.best.result / exact - 1)
    assert 0 < error <= found.best.estimate
    again = Adapted.from_json(case.problem(), found.to_json())
    assert again.choice == found.choice
    assert Scene(again.choice.applied(case.problem())).cells == found.best.cells
