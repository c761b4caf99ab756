"""Sheets of one mesh file that are not connected: they are oriented and held one by one, and
pressed together.
"""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from along import csr
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve
from sheets import Sheet, write

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.simulate.follow import follow

Array = NDArray[np.float64]
h = 0.02
SOFT = 1.0  # foundation, over E/R, which holds what nothing touches yet


def pair(
    folder: Path, below: tuple[int, int], above: tuple[int, int], gap: float = 0.0
) -> dict[str, Any]:
    """Two unit squares whose faces are a gap (over h) apart; both are free to move across."""
    low = Sheet("lower", (0, 0, 0), (1, 0, 0), (0, 1, 0), below)
    high = Sheet("upper", (0, 0, (1 + gap) * h), (0, 1, 0), (1, 0, 0), above)  # the other way round
    file = write(folder / "two.msh", [low, high])
    edges = {
        f"{name}_{i}": {"held": ["x", "y"]} for name in ("lower", "upper") for i in range(1, 5)
    }
    return {
        "shell": {
            "geometry": "mesh", "file": str(file), "radius": 1, "thickness": h, "youngs_modulus": 1,
            "poisson_ratio": 0
        },
        "boundary": edges,
        "contact": [["upper", "lower"]],
        "foundation": {"stiffness": SOFT},
        "mesh": {"degree": 2},
        "loading": {"kind": "dead", "control": "load", "loads": [], "factor": 1, "points": 1},
    }  # fmt: skip


def pressed(
    folder: Path, below: tuple[int, int], above: tuple[int, int]
) -> tuple[Scene, dict[str, float], Array, Any]:
    """Pressed together by 0.004 h E/R on both; the scene, what is observed, the pressures of all
    cells, the end.
    """
    data, p = pair(folder, below, above), 4e-3 * h
    data["loading"]["loads"] = [
        {"over": "upper", "per_area": [0, 0, -p]},
        {"over": "lower", "per_area": [0, 0, p]},
    ]
    scene = Scene(Case.model_validate(data))
    *_, last = follow(scene)
    (touching,) = scene.model.shell_contacts
    at = scene.model.system.at_state(last.point.state)
    return (
        scene,
        scene.observe(last.point.state),
        at.evaluate(touching.cell_pressures_and_gaps)[0],
        last,
    )


def test_patch_test_of_equal_meshes(tmp_path: Path) -> None:
    """The pressure is that of the load less the foundation's, everywhere: 1e-3."""
    scene, seen, pressure, _ = pressed(tmp_path, (2, 2), (2, 2))
    deep = -seen["contact_gap_over_h"] * h
    assert 0 < deep < 1e-3 * h
    assert np.ptp(pressure) < 1e-3 * pressure.mean()
    assert pressure.mean() == pytest.approx(4e-3 - SOFT * deep / (2 * h), rel=1e-3)
    assert seen["contact_force"] * scene.model.force_unit == pytest.approx(
        4e-3 - SOFT * deep / (2 * h), rel=1e-3
    )


def test_newton_is_quadratic(tmp_path: Path) -> None:
    """Beside the equilibrium of pressed sheets whose meshes do not match, to whose force the
    pressure adds up.

    Each error is of the order of the square of the one before.
    """
    scene, seen, pressure, last = pressed(tmp_path, (2, 2), (3, 2))
    deep = -seen["contact_gap_over_h"] * h
    assert seen["contact_force"] * scene.model.force_unit == pytest.approx(
        4e-3 - SOFT * deep / (2 * h), rel=2e-3
    )
    assert pressure.min() > 0
    system, exact, mu = scene.model.system, last.point.state.u, last.point.state.mu
    exact = exact - spsolve(
        csr(system.tangent(exact, mu)).tocsc(), system.residual(exact, mu)
    )  # which was near enough
    rough = system.zero_at_supports(np.random.default_rng(0).standard_normal(system.size))
    u, errors = exact + 2e-5 * h * rough, list[float]()
    for _ in range(5):
        u = u - spsolve(csr(system.tangent(u, mu)).tocsc(), system.residual(u, mu))
        errors.append(float(np.abs(u - exact).max()) / h)
    below = [(a, b) for a, b in pairwise(errors) if b > 1e-13]
    assert errors[-1] < 1e-11
    assert len(below) >= 3
    assert all(b < 1e4 * a**2 for a, b in below), errors


def test_a_piece_that_is_not_held(tmp_path: Path) -> None:
    data = pair(tmp_path, (1, 1), (1, 1), 1.0)
    del data["foundation"]
    data["boundary"] = {"lower_1": "clamped"}
    data["loading"]["loads"] = [{"over": "upper", "per_area": [0, 0, -1e-5]}]
    with pytest.raises(MeshError, match=r"the shell is not held: .*; this is its piece around"):
        Scene(Case.model_validate(data))


def test_pieces_that_overlap(tmp_path: Path) -> None:
    data = pair(tmp_path, (1, 1), (1, 1), -0.1)
    data["loading"]["loads"] = [{"over": "upper", "per_area": [0, 0, -1e-5]}]
    with pytest.raises(
        MeshError, match=r"contact: upper and lower overlap undeformed, by 0.1 h at \("
    ):
        Scene(Case.model_validate(data))
    data["contact"] = [["upper", "other"]]
    with pytest.raises(
        MeshError, match="contact: other: the surface has no such part, only lower, shell, upper"
    ):
        Scene(Case.model_validate(data))


def test_check_knows_the_parts(tmp_path: Path) -> None:
    """`magshell check` builds no model, and finds a pair with a wrong name, or that shares cells
    with another.
    """
    data = pair(tmp_path, (1, 1), (1, 1), 1.0)
    data["loading"]["loads"] = [{"over": "upper", "per_area": [0, 0, -1e-5]}]
    describe(Case.model_validate(data))
    data["contact"] = [["upper", "lover"]]
    with pytest.raises(
        CaseError, match="contact: lover: the surface has no such part, only lower, shell, upper"
    ):
        describe(Case.model_validate(data))
    data["contact"] = [["upper", "lower"], ["shell", "upper"]]
    with pytest.raises(
        CaseError, match="contact: shell and upper: shares cells with upper and lower"
    ):
        describe(Case.model_validate(data))


@pytest.mark.slow
def test_sheets_far_apart(tmp_path: Path) -> None:
    """Each bends as it does alone: 1e-10."""
    data = pair(tmp_path, (2, 2), (3, 2), 50.0)
    del data["foundation"]
    data["boundary"] = {
        f"{name}_{i}": "clamped" for name in ("lower", "upper") for i in range(1, 5)
    }
    data["loading"]["loads"] = [{"over": "upper", "per_area": [0, 0, -1e-6]}]
    tips = []
    for names in (("lower", "upper"), ("upper",)):
        sheets = [Sheet("lower", (0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 2)),
                  Sheet("upper", (0, 0, 51 * h), (0, 1, 0), (1, 0, 0), (3, 2))]  # fmt: skip
        write(tmp_path / "two.msh", [sheet for sheet in sheets if sheet.name in names])
        alone = data | {
            "boundary": {k: v for k, v in data["boundary"].items() if k.split("_")[0] in names}
        }
        alone |= {"points": {"tip": [0.5, 1 / 3, 51 * h]}, "contact": [["shell", "shell"]]}
        scene = Scene(Case.model_validate(alone))
        *_, last = follow(scene)
        tips.append(scene.observe(last.point.state)["tip_uz"])
    assert tips[0] == pytest.approx(tips[1], rel=1e-10)
