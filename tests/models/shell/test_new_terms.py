"""Folds, moments, dead loads and thicknesses: derivatives, tangents, invariance and limits."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from along import along, difference
from conftest import TILTED, random_displacement
from mpi4py import MPI

from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.mesh.grid import Grid, grid_mesh
from magshell_fenicsx.mesh.midsurface import Midsurface, distribute
from magshell_fenicsx.mesh.msh import space_embedding
from magshell_fenicsx.mesh.patch import PatchMesh
from magshell_fenicsx.mesh.shapes import plane_embedding
from magshell_fenicsx.mesh.surfaces_of_revolution import (
    ArcProfile,
    RevolvedEmbedding,
    StraightProfile,
)
from magshell_fenicsx.models.shell.parameters import (
    AreaForce,
    EdgeForce,
    EdgeMoment,
    HeldComponents,
    Material,
    PointForce,
)
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.shells.shell import ShellModel

MATERIAL = Material(0.3, 0.05)
MOMENT = Loads(dead={"load": (EdgeMoment("right", 0.01),)})


def panel(size: float = 0.5) -> Midsurface:
    """A cylindrical panel of one radian."""
    points = {"pole": np.array([0.5, 0.5])}
    grid = Grid((0.0, 0.0), (1.0, 1.0), size)
    return distribute(
        grid_mesh(grid, points, RevolvedEmbedding(StraightProfile((1.0, 0.0), (1.0, 1.0)), 1.0)),
        MPI.COMM_SELF,
    )


def box(angle: float) -> Midsurface:
    """Two unit squares that meet at an angle (rad, 0 is flat) along x = 0, as a mesh from elsewhere
    would.
    """

    def fold(chart: np.ndarray) -> np.ndarray:
        x, y = chart.T
        right = np.maximum(x, 0)
        return np.column_stack(
            [np.minimum(x, 0) + right * np.cos(angle), y, -right * np.sin(angle)]
        )

    chart = grid_mesh(Grid((-1.0, 0.0), (1.0, 1.0), 0.5), {}, plane_embedding)
    nodes = fold(chart.nodes)
    points = {"pole": fold(np.array([[1.0, 1.0]]))[0]}
    halves = {"left half": chart.nodes[chart.cells].mean(axis=1)[:, 0] < 0}
    return distribute(
        PatchMesh(nodes, chart.cells, space_embedding, chart.edges, points, patches=halves),
        MPI.COMM_SELF,
    )


def varying(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return 1 + 0.5 * y + 0.2 * z


SHELLS: dict[str, Callable[[], ShellModel]] = {
    "moment": lambda: ShellModel(panel(), MATERIAL, 2, {"left": "clamped"}, MOMENT),
    "planes": lambda: ShellModel(
        panel(),
        MATERIAL,
        2,
        {
            "bottom": "plane",
            "left": "plane",
            "top": HeldComponents((0, 1)),
            "right": HeldComponents((0, 1)),
        },
        Loads(pressure=True),
    ),
    "two terms on an edge": lambda: ShellModel(
        panel(),
        MATERIAL,
        2,
        {"bottom": "plane"},
        Loads(dead={"load": (EdgeMoment("bottom", 0.01),)}),
    ),
    "folded": lambda: ShellModel(box(1.8), MATERIAL, 2, {"left": "clamped"}, Loads()),
    "thickness": lambda: ShellModel(
        panel(),
        MATERIAL,
        2,
        {"left": "clamped", "bottom": "plane"},
        Loads(magnetic=replace(TILTED, gradient=np.diag([1.0, 0.5, -1.5]))),
        thickness=Thickness(varying),
    ),
    "folded, two thicknesses": lambda: ShellModel(
        box(1.2),
        MATERIAL,
        2,
        {"left": "clamped"},
        Loads(),
        thickness=Thickness(patches={"left half": 0.5}),
    ),
}
MU = {"load": 0.7, "pressure": 0.3, "lambda_m": 0.4}


@pytest.mark.parametrize("name", SHELLS)
def test_tangent(name: str) -> None:
    """From point Hessians as from the forms, to 1e-12; the forms' is the residual's derivative."""
    model = SHELLS[name]()
    u, v = (random_displacement(model, size, seed) for size, seed in ((1e-2, 1), (1.0, 2)))
    assert difference(model.system, u, MU) <= 1e-12
    u, v = model.system.zero_at_supports(u), model.system.zero_at_supports(v)
    step = 1e-6
    R = [model.system.residual(u + s * v, MU) for s in (step, -step)]
    slope, exact = (
        (R[0] - R[1]) / (2 * step),
        model.system.zero_at_supports(along(model.system, u, MU, v)),
    )
    assert np.abs(slope - exact).max() < 1e-5 * np.abs(exact).max()


@pytest.mark.parametrize("name", SHELLS)
def test_residual_is_the_derivative_of_the_energy(name: str) -> None:
    model = SHELLS[name]()
    u, v = (
        model.system.zero_at_supports(random_displacement(model, size, seed))
        for size, seed in ((1e-3, 1), (1.0, 2))
    )

    def energy(w: np.ndarray) -> float:
        found = model.system.energies(w)
        return sum(
            found[t.name] * (MU[t.amplitude] if t.amplitude else 1.0) for t in model.system.terms
        )

    step = 1e-6
    slope = (energy(u + step * v) - energy(u - step * v)) / (2 * step)
    assert slope == pytest.approx(model.system.residual(u, MU) @ v, rel=1e-5)


@pytest.mark.parametrize("angle", [0.3, 1.5707963267948966, 2.8])
def test_a_fold_takes_no_energy_from_rigid_motion_and_resists_opening(angle: float) -> None:
    """Opening by a little angle costs sigma D/2h_e angle^2 a length, at any fold: none is free."""
    model = ShellModel(box(angle), MATERIAL, 3, {}, Loads())
    x = model.r0.x.array.reshape(-1, 3)
    turn = 0.7
    Q = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    rigid = (x @ Q.T - x).ravel()
    assert abs(sum(model.system.energies(rigid).values())) < 1e-12
    little = 1e-3
    Q = np.array(
        [[np.cos(little), 0, np.sin(little)], [0, 1, 0], [-np.sin(little), 0, np.cos(little)]]
    )
    right = ~((x[:, 0] <= 1e-9) & (np.abs(x[:, 2]) < 1e-9))
    opened = np.where(right[:, None], x @ Q.T - x, 0.0).ravel()
    stiffness = (
        45 * MATERIAL.bending_stiffness / (2 * 0.125)
    )  # sigma = 5 k^2; flat area over length of the edge
    assert model.system.energies(opened)["interior edges"] == pytest.approx(
        stiffness * little**2, rel=1e-6
    )


def test_small_folds_are_smooth_edges() -> None:
    """Where cells meet smoothly the two forms of the jump agree to the square of its angle."""
    model = ShellModel(panel(0.25), MATERIAL, 3, {}, Loads())
    made = (replace(model.factory, has_folds=folded) for folded in (False, True))
    model.u.x.array[:] = random_displacement(model, 1e-5)
    smooth, folded = (factory.term(factory.interior_edges()).energy() for factory in made)
    assert folded == pytest.approx(smooth, rel=1e-3)


def test_moment_counts_turns() -> None:
    """-Pi = m L angle, through a turn and a half in steps of a quarter."""
    model = ShellModel(panel(), MATERIAL, 3, {}, MOMENT)
    x, state = model.r0.x.array.reshape(-1, 3), State(model.zero(), {"load": 1.0})
    for n in range(1, 7):
        a = n * np.pi / 4
        Q = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        # the right edge runs along -e3 with the surface on its left... the sign is that of the
        # outward normal
        u = (x @ Q.T - x).ravel()
        state = model.system.advance(State(u, {"load": 1.0}), state.mu)
        found = -model.system.potential(u, state.mu, "load")
        assert abs(found) == pytest.approx(0.01 * a, rel=1e-9)
        assert -model.system.potential(u, state.mu, "load") == found  # asking changes nothing


def test_dead_loads_add_up_to_their_resultants() -> None:
    """Of a translation: point, edge (in all and per length), area and normal pressure; Gauss for
    the last.
    """
    loads = (
        PointForce("pole", np.array([1.0, 2.0, 3.0])),
        EdgeForce("left", np.array([0.0, 1.0, 0.0]), total=True),
        EdgeForce("bottom", np.array([0.0, 0.0, 1.0]), total=False),
        AreaForce(None, np.array([1.0, 0.0, 0.0])),
        AreaForce(None, 2.0),
    )
    model = ShellModel(panel(), MATERIAL, 4, {}, Loads(dead={"load": loads}))
    entries = -model.system.load(model.zero(), {}, "load").reshape(-1, 3).sum(axis=0)
    pressure = -2.0 * np.array([np.sin(1), 1 - np.cos(1), 0.0])
    assert entries == pytest.approx(
        np.array([1.0, 2.0, 3.0]) + np.array([1.0, 1.0, 1.0]) + pressure, abs=1e-7
    )
    assert model.load_size["load"] == pytest.approx(np.sqrt(14) + 1 + 1 + 1 + 2, rel=1e-7)


def bent(thickness: Thickness | None, h: float, degree: int = 3) -> float:
    """Deflection of a cantilever of length 1 under a small end force, over F/(E h_ref)."""
    surface = distribute(
        grid_mesh(
            Grid((0.0, 0.0), (1.0, 0.1), 0.1), {"pole": np.array([1.0, 0.05])}, plane_embedding
        ),
        MPI.COMM_SELF,
    )
    force = 1e-9
    loads = Loads(dead={"load": (EdgeForce("right", np.array([0.0, 0.0, force]), total=True),)})
    model = ShellModel(
        surface, Material(0.0, h), degree, {"left": "clamped"}, loads, thickness=thickness
    )
    found = BorderedNewton(model.system).solve(
        State(model.zero(), {"load": 0.0}), "load", PrescribedLoad("load", 1.0)
    )
    return float(model.displacement(found.state.u, "pole")[2]) / force


def test_thickness_that_varies() -> None:
    """A cantilever with h(x) = h/(1 + x)^(1/3): w = F/E 12/(b h^3) int (1 - x)^2 (1 + x) dx
    (Bernoulli).
    """
    h, b = 0.02, 0.1
    found = bent(Thickness(lambda x, y, z: (1 + x) ** (-1 / 3)), h)
    assert found == pytest.approx(12 / (b * h**2) * (1 / 3 + 1 / 12), rel=2e-4)  # F is over E h


def test_uniform_factor_is_a_thickness() -> None:
    """Twice the thickness by a factor, or by h: force unit E h R."""
    assert bent(Thickness(lambda x, y, z: 2 + 0 * x), 0.01) == pytest.approx(
        bent(None, 0.02) / 2, rel=1e-7
    )


def test_arc_profile() -> None:
    assert ArcProfile(1.0, 0.0, np.pi / 2)(np.array([np.pi / 2])) == pytest.approx(
        np.array([[0.0, 1.0]]), abs=1e-15
    )
