"""Two flat sheets pressed together whose meshes do not match: the pressure is uniform."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.control import PrescribedLoad

Array = NDArray[np.float64]
h, P = 0.02, 4e-3  # thickness, and the pressure over E h/R
SOFT = 1.0  # foundation, over E/R, which holds what nothing touches yet


def square(
    size: float, angle: float, shift: tuple[float, float]
) -> tuple[Array, NDArray[np.int64]]:
    """Corners and triangles of a unit square: inside a lattice of a size that is turned and
    shifted, and its edge.
    """
    n = round(1 / size)
    t = np.arange(n) / n
    sides = (t, 0 * t), (0 * t + 1, t), (1 - t, 0 * t + 1), (0 * t, 1 - t)
    edge = np.concatenate([np.stack(xy, axis=1) for xy in sides])
    i = np.arange(-3 * n, 3 * n + 1)
    lattice = size * np.stack(np.meshgrid(i, i), axis=-1).reshape(-1, 2)
    c, s = np.cos(angle), np.sin(angle)
    turned = lattice @ np.array([[c, s], [-s, c]]) + size * np.array(shift) + 0.5
    inner = turned[(np.abs(turned - 0.5) < 0.5 - 0.4 * size).all(axis=1)]
    points = np.concatenate([edge, inner])
    triangles = Delaunay(points).simplices
    a, b, c3 = (points[triangles[:, k]] for k in range(3))
    return points, triangles[np.abs(np.cross(b - a, c3 - a)) > 1e-6].astype(np.int64)


def write(file: Path, lower: tuple[Any, ...], upper: tuple[Any, ...]) -> Path:
    """A mesh file of gmsh's version 2 with both, whose faces touch."""
    nodes, elements = list[str](), list[str]()
    for number, ((points, triangles), z) in enumerate(((lower, 0.0), (upper, h))):
        first, edge = len(nodes) + 1, np.flatnonzero(((points == 0) | (points == 1)).any(axis=1))
        nodes += [f"{x:.16g} {y:.16g} {z}" for x, y in points]
        elements += [f"2 2 {number + 1} {number + 1} {a} {b} {c}" for a, b, c in triangles + first]
        around = zip(edge + first, np.roll(edge, -1) + first, strict=True)
        elements += [f"1 2 {number + 3} {number + 3} {a} {b}" for a, b in around]
    text = [
        "$MeshFormat",
        "2.2 0 8",
        "$EndMeshFormat",
        "$PhysicalNames",
        "4",
        '2 1 "lower"',
        '2 2 "upper"',
    ]
    text += ['1 3 "lower_edge"', '1 4 "upper_edge"', "$EndPhysicalNames"]
    for name, lines in (("Nodes", nodes), ("Elements", elements)):
        text += [
            f"${name}",
            str(len(lines)),
            *(f"{i} {line}" for i, line in enumerate(lines, 1)),
            f"$End{name}",
        ]
    file.write_text("\n".join(text) + "\n", encoding="utf-8")
    return file


def test_pressure_is_uniform(tmp_path: Path) -> None:
    """To 1e-3 at all points and in all cells: that of the load less the foundation's."""
    file = write(
        tmp_path / "two.msh",
        square(1 / 2, 0.0, (0.0, 0.0)),
        square(1 / 3, np.radians(30), (0.37, 0.21)),
    )
    case = {
        "shell": {
            "geometry": "mesh", "file": str(file), "radius": 1, "thickness": h, "youngs_modulus": 1,
            "poisson_ratio": 0
        },
        "boundary": {f"{name}_edge": {"held": ["x", "y"]} for name in ("lower", "upper")},
        "contact": [["upper", "lower"]],
        "foundation": {"stiffness": SOFT},
        "mesh": {"degree": 2},
        "loading": {
            "kind": "dead", "control": "load", "factor": 1, "points": 1,
            "loads": [{"over": name, "per_area": [0, 0, sign * P * h]}
                      for name, sign in (("upper", -1), ("lower", 1))],
        },
    }  # fmt: skip
    scene = Scene(Case.model_validate(case))
    state, (touching,) = scene.unloaded(), scene.model.shell_contacts
    for factor in (0.01, 0.1, 1.0):
        outcome = scene.newton.solve(
            state.with_(state.u, "load", factor), "load", PrescribedLoad("load", factor)
        )
        assert outcome.converged, outcome.reason
        state = outcome.state
    at = scene.model.system.at_state(state)
    _, at_points, _ = at.evaluate(touching._active_set).penalties
    in_cells = at.evaluate(touching.cell_pressures_and_gaps)[0]
    expected = P - SOFT * at.evaluate(touching.penetration) / (2 * h)
    assert at_points == pytest.approx(np.full(len(at_points), expected), rel=1e-3)
    assert in_cells == pytest.approx(np.full(len(in_cells), expected), rel=1e-3)
