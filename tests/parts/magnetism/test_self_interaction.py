"""A magnetised part in its own field: closed forms of prisms and spherical shells, differences, eigenvalues."""

from pathlib import Path
from typing import Any

import gmsh
import numpy as np
import pytest
from mpi4py import MPI
from test_interaction import BR, MU_0, Array, case_of, gradient, meshed, model
from test_own_field import sphere_of_triangles

from magshell_fenicsx import Scene
from magshell_fenicsx.assembly.whole import WholeMatrix
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.parts.magnetism.coulomb import Charged
from magshell_fenicsx.parts.magnetism.near import Near

__all__ = ["model"]


def demagnetising(a: float, b: float, c: float) -> float:
    """That of a prism of 2a x 2b x 2c along the last side: A. Aharoni, J. Appl. Phys. 83 (1998) 3432, equation 1."""
    r, ab, ac, bc = np.sqrt([a * a + b * b + c * c, a * a + b * b, a * a + c * c, b * b + c * c])
    D = (b * b - c * c) / (2 * b * c) * np.log((r - a) / (r + a))
    D += (a * a - c * c) / (2 * a * c) * np.log((r - b) / (r + b))
    D += b / (2 * c) * np.log((ab + a) / (ab - a)) + a / (2 * c) * np.log((ab + b) / (ab - b))
    D += c / (2 * a) * np.log((bc - b) / (bc + b)) + c / (2 * b) * np.log((ac - a) / (ac + a))
    D += 2 * np.arctan(a * b / (c * r)) + (a**3 + b**3 - 2 * c**3) / (3 * a * b * c)
    D += (a * a + b * b - 2 * c * c) / (3 * a * b * c) * r + c / (a * b) * (ac + bc)
    return float((D - (ab**3 + bc**3 + ac**3) / (3 * a * b * c)) / np.pi)


def alone(file: Path, h: float, polar: float, **sections: Any) -> Scene:
    """One strip of 5 x 1 mm, magnetised in one direction."""
    gmsh.model.occ.addRectangle(0, -0.5, 0, 5.0, 1.0)
    meshed(file, 0.5)
    magnetic = {"interaction": "all", "remanent": {"polar": polar, "flux_density": f"{BR} T"}}
    return Scene(case_of(file, h, magnetic=magnetic, **{"boundary": {"edge0": "clamped"}, **sections}))


@pytest.mark.parametrize(("h", "polar"), [(0.25, 0), (0.25, 90), (0.05, 0), (0.05, 90)])
def test_a_prism(model: Any, tmp_path: Path, h: float, polar: float) -> None:
    """The energy of a strip magnetised across or along itself is N/2 Br² V/mu_0, 1e-3."""
    scene = alone(tmp_path / "strip.msh", h, polar)
    (term,) = (each for each in scene.model.system.terms if each.name == "interaction")
    found = scene.model.system.at(State(scene.model.zero(), {"interaction": 1.0})).of(term.energy)
    N = demagnetising(2.5, 0.5, h / 2) if polar == 0 else demagnetising(0.5, h / 2, 2.5)
    exact = BR**2 / (MU_0 * 1e6) * N / 2 * 5.0 / 5.0**2  # of E h R²
    assert found == pytest.approx(exact, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("R_over_h", "error"), [(20, 2e-4), (90, 2e-4)])
def test_a_closed_sphere(R_over_h: float, error: float) -> None:
    """A uniformly magnetised spherical shell: field only inside the wall and outside, energy Br² V/(6 mu_0)."""
    shape = sphere_of_triangles(1 / R_over_h, np.array([0.0, 0.0, 1.0]))
    corners = np.unique(shape.r0[:, :3].round(9).reshape(-1, 3), axis=0, return_inverse=True)[1].reshape(-1, 3)
    none, count = np.zeros(0, dtype=np.intp), len(shape.r0)
    near = Near(shape, corners, none, none, range(count), MPI.COMM_WORLD)
    charged = Charged(shape, np.zeros(count, dtype=np.intp), none, none, MPI.COMM_WORLD, near)
    found = charged.evaluate(shape.r0, range(count))[0]
    h = 1 / R_over_h
    volume = 4 * np.pi / 3 * ((1 + h / 2) ** 3 - (1 - h / 2) ** 3)
    assert found == pytest.approx(4 * np.pi * volume / 6, rel=error)


def bent(scene: Scene) -> tuple[Vector, Array]:
    """A smooth displacement, and a smooth change of it."""
    x, y, _ = scene.model.r0.x.array.reshape(-1, 3).T
    both = [
        [0.01 * np.sin(2 * y), 0.02 * np.cos(2 * x), 0.03 * np.sin(2 * x + 1.5 * y)],
        [np.cos(2 * y + x), np.sin(2 * x), np.cos(2 * x - 1.5 * y)],
    ]
    u, v = (scene.model.system.held(np.column_stack(each).ravel()[: scene.model.system.size]) for each in both)
    return u, v


@pytest.mark.slow
def test_derivatives(model: Any, tmp_path: Path) -> None:
    """Work is the change of the energy, the tangent is the slope of the forces: differences, 1e-6; no net force."""
    scene = alone(tmp_path / "strip.msh", 0.25, 40)
    (u, v), system, mu = bent(scene), scene.model.system, {"interaction": 1.0}
    (term,) = (each for each in system.terms if each.name == "interaction")
    step = 3e-6  # beside edges charges are so near each other
    moved = [(w / step, u + k * step * v) for k, w in ((1, 2 / 3), (-1, -2 / 3), (2, -1 / 12), (-2, 1 / 12))]
    slope = gradient(scene, u)
    energies = [(w, system.at(State(each, mu)).of(term.energy)) for w, each in moved]
    assert sum(w * value for w, value in energies) == pytest.approx(slope @ v, rel=1e-6)
    assert np.abs(slope.reshape(-1, 3).sum(axis=0)).max() < 1e-12 * np.abs(slope).sum()
    matrix = WholeMatrix(system.u.function_space, system.clamped)
    rows = system.at(State(u, mu)).of(lambda: matrix.rows([(1.0, term)])).reshape(system.size, -1)
    change = sum(w * gradient(scene, each) for w, each in moved)
    assert np.linalg.norm(rows @ v - change) < 1e-6 * np.linalg.norm(change)
    assert np.abs(rows - rows.T).max() < 1e-11 * np.abs(rows).max()


@pytest.mark.slow
def test_inertia(model: Any, tmp_path: Path) -> None:
    """Negative pivots of the factors are the dense matrix's negative eigenvalues, with 1 and 1e5 times the energy."""
    scene = alone(tmp_path / "strip.msh", 0.25, 0)
    system, counts = scene.model.system, []
    for factor in (1.0, 1e5):
        K, factors = system.tangent(0.01 * bent(scene)[0], {"interaction": factor}), Factorisation(system.comm)
        factors.factor(K)
        eigenvalues = np.linalg.eigvalsh(K.getValues(range(system.size), range(system.size)))
        counts.append(factors.negative_pivots)
        assert counts[-1] == np.sum(eigenvalues < 0)
    assert counts[0] == 0 < counts[1]
