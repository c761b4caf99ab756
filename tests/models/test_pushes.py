"""Random pushes of two sheets against each other: at no accepted point do they intersect, by a test of triangles."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from sheets import Sheet, write

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Stopped

Array = NDArray[np.float64]
h, PARTS = 0.02, 4


def crossings(one: Array, other: Array) -> int:
    """How many sides of triangles (n, 3, 3) pass through other triangles (m, 3, 3)."""
    found = 0
    for a, b in ((one, other), (other, one)):
        p = a[:, [0, 1, 2]].reshape(-1, 1, 3)
        d = a[:, [1, 2, 0]].reshape(-1, 1, 3) - p
        e1, e2 = b[None, :, 1] - b[None, :, 0], b[None, :, 2] - b[None, :, 0]
        normal = np.cross(d, e2)
        det = np.sum(normal * e1, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = p - b[None, :, 0]
            u = np.sum(s * normal, axis=-1) / det
            q = np.cross(s, e1)
            v = np.sum(q * d, axis=-1) / det
            t = np.sum(q * e2, axis=-1) / det
            inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)
        found += int(np.sum(inside))
    return found


def triangles(scene: Scene, u: Array, name: str) -> Array:
    """The sheet of a patch, each cell in flat triangles."""
    model, n = scene.model, PARTS
    X = np.array([(i, j) for j in range(n + 1) for i in range(n + 1 - j)]) / n
    number = {(i, j): k for k, (i, j) in enumerate((i, j) for j in range(n + 1) for i in range(n + 1 - j))}
    low = [(number[i, j], number[i + 1, j], number[i, j + 1]) for j in range(n) for i in range(n - j)]
    high = [(number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]) for j in range(n) for i in range(n - j - 1)]
    shape = model.V.element.basix_element.tabulate(0, X)[0, :, :, 0]
    r = (model.r0.x.array + u).reshape(-1, 3)[model.V.dofmap.list[model.midsurface.patches[name]]]
    return np.einsum("mk,nki->nmi", shape, r)[:, low + high].reshape(-1, 3, 3)


def test_the_test_of_triangles() -> None:
    flat = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    upright = np.array([[[0.2, 0.2, -0.1], [0.3, 0.2, 0.1], [0.2, 0.3, 0.1]]])
    assert crossings(flat, upright)
    assert not crossings(flat, upright + np.array([0, 0, 0.2]))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1))
def test_nothing_passes_through(tmp_path: Path, seed: int) -> None:
    """Two cantilevers, held at opposite ends, are pushed past each other if contact did not keep them apart."""
    rng = np.random.default_rng(seed)
    gap = h * rng.uniform(1.5, 3)
    sheets = [
        Sheet("lower", (0, 0, 0), (1, 0, 0), (0, 0.3, 0), (5, 2)),
        Sheet("upper", (0.3, 0.02, gap), (1, 0, 0), (0, 0.26, 0), (4, 1)),
    ]
    file = write(tmp_path / "two.msh", sheets)
    push = 4e-6 * rng.uniform(0.5, 1.0, 2)
    loads = [
        {"over": "upper", "per_area": [0, 0, -push[0]]},
        {"over": "lower", "per_area": [0, 0, push[1]]},
        {"over": "upper", "per_area": [0, 1e-6 * rng.uniform(-1, 1), 0]},
    ]
    case = Case.model_validate(
        {
            "shell": {
                "geometry": "mesh", "file": str(file), "radius": 1, "thickness": h, "youngs_modulus": 1,
                "poisson_ratio": 0.3,
            },
            "boundary": {"lower_4": "clamped", "upper_2": "clamped"},
            "contact": [["upper", "lower"]],
            "mesh": {"degree": 3},
            "loading": {"kind": "dead", "loads": loads, "factor": 1, "points": 2},
        }
    )  # fmt: skip
    scene, forces = Scene(case), list[float]()
    try:
        for record in follow(scene):
            u = scene.model.system.with_ghosts(record.point.state.u)
            assert crossings(triangles(scene, u, "lower"), triangles(scene, u, "upper")) == 0
            forces.append(scene.observe(record.point.state)["contact_force"])
    except Stopped:
        pass  # a path may end; what it has accepted counts
    assert max(forces) > 0
