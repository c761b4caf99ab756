"""Magnetised parts in each other's field: magpylib's closed forms, differences, and an elastica."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import gmsh
import magpylib
import numpy as np
import pytest
from command import magshell, read_path
from dolfinx import fem
from numpy.typing import NDArray
from scipy.integrate import solve_bvp

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.assembly.dense_tangent import DenseTangent
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import State, Vector, symmetric_part
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.parts.magnetism import interacting, interaction
from magshell_fenicsx.parts.magnetism.charge_derivatives import Weights
from magshell_fenicsx.parts.magnetism.self_field import self_field
from magshell_fenicsx.parts.magnetism.singular_pairs import SingularPairs
from magshell_fenicsx.public import run
from magshell_fenicsx.simulate.gradients.gradient import gradient as gradient_of

Array = NDArray[np.float64]
MM, MU_0, BR = 1e-3, 4e-7 * np.pi, 0.1


def meshed(file: Path, size: float, order: int = 1) -> None:
    """Write what gmsh's model has: surfaces part0, part1, ..., edges of the same numbers."""
    gmsh.model.occ.synchronize()
    for i, (dim, tag) in enumerate(gmsh.model.getEntities(2)):
        gmsh.model.addPhysicalGroup(2, [tag], name=f"part{i}")
        lines = [line for _, line in gmsh.model.getBoundary([(dim, tag)], oriented=False)]
        gmsh.model.addPhysicalGroup(1, lines, name=f"edge{i}")
    for word in ("Min", "Max"):
        gmsh.option.setNumber(f"Mesh.MeshSize{word}", size)
    gmsh.model.mesh.generate(2)
    gmsh.model.mesh.setOrder(order)
    gmsh.write(str(file))


@pytest.fixture
def model() -> Any:
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    yield gmsh.model
    gmsh.finalize()


def discs(file: Path, radius: float, apart: float, size: float) -> None:
    """Two coaxial discs (mm)."""
    for z in (0.0, apart):
        gmsh.model.occ.addDisk(0, 0, z, radius, radius)
    meshed(file, size, 2)


def strips(
    file: Path, length: float, width: float, apart: float, size: float, *, halved: bool = False
) -> None:
    """Two parallel strips along x (mm); if `halved`, with edges of cells along their middle."""
    for z in (0.0, apart):
        gmsh.model.occ.addRectangle(0, -width / 2, z, length, width)
    if halved:
        gmsh.model.occ.synchronize()
        for _, line in gmsh.model.getEntities(1):
            gmsh.model.mesh.setTransfiniteCurve(line, 3)
        for _, face in gmsh.model.getEntities(2):
            gmsh.model.mesh.setTransfiniteSurface(face)
    meshed(file, size)


def case_of(file: Path, h: float, E: str = "1 MPa", **sections: Any) -> Case:
    """Two parts, all held, magnetised along e3 (mm)."""
    data: dict[str, Any] = {
        "shell": {"geometry": "mesh", "file": str(file), "unit": "mm", "radius": "5 mm"}
        | {"thickness": f"{h} mm", "youngs_modulus": E, "poisson_ratio": 0},
        "boundary": {"part0": "clamped", "part1": "clamped"},
        "magnetic": {"interaction": "others", "remanent": {"polar": 0, "flux_density": f"{BR} T"}},
        "loading": {"kind": "interaction", "points": 2},
    }
    return Case.from_source(data | sections)


def gradient(scene: Scene, u: Vector) -> Array:
    """dW/du at all nodes."""
    system = scene.model.system
    (term,) = (each for each in system.terms if each.name == "interaction")

    def add() -> Array:
        b = np.zeros_like(system.u.x.array)
        term.add_residual(b, 1.0)
        return b

    return system.at_state(State(u, {"interaction": 1.0})).evaluate(add)


def force(scene: Scene, h: float) -> Array:
    """That on the upper part (N)."""
    found = -gradient(scene, scene.model.zero()).reshape(-1, 3)
    upper = scene.model.r0.x.array.reshape(-1, 3)[:, 2] > 1e-6
    assert np.abs(found.sum(axis=0)).max() < 1e-12 * np.abs(found).sum(), "actio and reactio"
    return np.asarray(found[upper].sum(axis=0) * 1e6 * h * MM * 5 * MM)


@pytest.mark.parametrize(
    ("gap", "size", "radius"),
    [(1, 1.2, 2.5), pytest.param(3, 2.5, 5, marks=pytest.mark.slow), (20, 2.5, 5)],
)
def test_force_between_coaxial_discs(
    model: Any, tmp_path: Path, gap: float, size: float, radius: float
) -> None:
    """Magpylib's field of one cylinder on the other's faces, at gaps of 1, 3 and 20 h: 1e-3."""
    h = 0.2
    discs(tmp_path / "discs.msh", radius, (gap + 1) * h, size)
    magnet = magpylib.magnet.Cylinder(polarization=(0, 0, BR), dimension=(2 * radius * MM, h * MM))
    x, w = np.polynomial.legendre.leggauss(200)
    t = (1 - x) / 2
    r, weight = radius * MM * (1 - t**3), radius * MM * 1.5 * w * t**2  # points gather at the rim
    faces = [
        magnet.getB(np.column_stack([r, 0 * r, 0 * r + (gap + k) * h * MM]))[:, 2]
        for k in (0.5, 1.5)
    ]
    exact = BR / MU_0 * np.sum(2 * np.pi * r * weight * (faces[1] - faces[0]))
    found = force(Scene(case_of(tmp_path / "discs.msh", h)), h)
    assert found == pytest.approx([0, 0, exact], rel=1e-3, abs=1e-3 * abs(exact))


@pytest.mark.parametrize(
    ("along", "gap"),
    [
        *((along, gap) for along in "xz" for gap in (1, 4, 20)),
        *(pytest.param("z", gap, marks=pytest.mark.slow) for gap in (0.2, 0.05)),
    ],
)
def test_force_between_parallel_strips(model: Any, tmp_path: Path, gap: float, along: str) -> None:
    """Magpylib's cuboid on the charged sides of the other, and close above it: 1e-3."""
    h, L, w = 0.25, 5.0, 1.0
    strips(tmp_path / "strips.msh", L, w, (gap + 1) * h, 0.5)
    polar = {"x": 90, "z": 0}[along]
    magnetic = {"interaction": "others", "remanent": {"polar": polar, "flux_density": f"{BR} T"}}
    axis = np.eye(3)["xyz".index(along)]
    size = np.array([L, w, h]) * MM
    magnet = magpylib.magnet.Cuboid(
        polarization=BR * axis, dimension=size, position=(L * MM / 2, 0, 0)
    )
    x, weight = np.polynomial.legendre.leggauss(40 if gap >= 1 else 200)
    x = np.sin(np.pi / 2 * x)  # points gather at the edges
    weight = weight * np.pi / 2 * np.sqrt(1 - x**2)
    across = [i for i in range(3) if not axis[i]]
    exact, middle = np.zeros(3), np.array([L / 2, 0, (gap + 1) * h]) * MM
    a, b = (each.ravel() for each in np.meshgrid(x, x))
    for side in (1, -1):
        places = middle + side * axis * size / 2 + np.zeros((len(a), 3))
        places[:, across[0]] += a * size[across[0]] / 2
        places[:, across[1]] += b * size[across[1]] / 2
        area = np.outer(weight, weight).ravel() * size[across[0]] * size[across[1]] / 4
        exact += side * BR / MU_0 * area @ magnet.getB(places)
    found = force(Scene(case_of(tmp_path / "strips.msh", h, magnetic=magnetic)), h)
    assert np.linalg.norm(found - exact) < 1e-3 * np.linalg.norm(exact)


@pytest.fixture
def bent(model: Any, tmp_path: Path) -> tuple[Scene, Vector]:
    """Two curved magnets, held at their edges, and a displacement of a smooth kind."""
    strips(tmp_path / "strips.msh", 4.0, 2.0, 1.2, 1.5)
    held = {"edge0": "clamped", "edge1": "clamped"}
    given = {"kind": "expression", "components": ["0.6", "0.2", "0.8"], "flux_density": f"{BR} T"}
    magnetic = {"interaction": "others", "remanent": given}
    scene = Scene(
        case_of(tmp_path / "strips.msh", 0.3, boundary=held, magnetic=magnetic, mesh={"degree": 3})
    )
    x, y, z = scene.model.r0.x.array.reshape(-1, 3).T
    u = [0.01 * np.sin(5 * y + z), 0.02 * np.cos(6 * x), 0.03 * np.sin(7 * x + 3 * y + 5 * z)]
    return scene, scene.model.system.zero_at_supports(
        np.column_stack(u).ravel()[: scene.model.system.size]
    )


def test_forces_do_not_depend_on_the_place(model: Any, tmp_path: Path) -> None:
    """Two discs, and the same ones moved together."""
    discs(tmp_path / "discs.msh", 2.5, 0.4, 2.5)
    scene = Scene(case_of(tmp_path / "discs.msh", 0.2))
    moved = np.tile([3.0, -2.0, 5.0], scene.model.system.size // 3)
    forces, expected = gradient(scene, moved), gradient(scene, scene.model.zero())
    assert np.abs(forces - expected).max() < 1e-8 * np.abs(expected).max()


def test_derivatives(bent: tuple[Scene, Vector]) -> None:
    """Forces are the slope of the energy, the tangent is that of the forces, symmetric:
    differences, 1e-6.
    """
    scene, u = bent
    system, mu = scene.model.system, {"interaction": 1.0}
    (term,) = (each for each in system.terms if each.name == "interaction")
    v, step = system.zero_at_supports(np.cos(3.0 * np.arange(system.size))), 1e-4
    ways = ((1, 2 / 3), (-1, -2 / 3), (2, -1 / 12), (-2, 1 / 12))
    moved = [(w / step, u + k * step * v) for k, w in ways]
    slope = sum(w * system.at_state(State(each, mu)).evaluate(term.energy) for w, each in moved)
    assert slope == pytest.approx(gradient(scene, u) @ v, rel=1e-6)
    matrix = DenseTangent(system.u.function_space, [term], system.clamped)
    rows = system.at_state(State(u, mu)).evaluate(lambda: matrix.rows(mu))
    change = sum(w * gradient(scene, each) for w, each in moved)
    assert np.linalg.norm(rows @ v - change) < 1e-6 * np.linalg.norm(change)
    assert np.abs(rows - rows.T).max() < 1e-12 * np.abs(rows).max()
    K, out = (
        symmetric_part(system.tangent(u, mu)),
        sum(w * system.residual(each, mu) for w, each in moved),
    )
    x, y = K.createVecs()
    x.array[:] = v
    K.mult(x, y)
    assert np.linalg.norm(y.array - out) < 1e-6 * np.linalg.norm(out)


@pytest.mark.parametrize("factor", [0.0, 1.0, 1e5])
def test_inertia(bent: tuple[Scene, Vector], factor: float) -> None:
    """Negative pivots of the factors are the negative eigenvalues of the dense matrix."""
    scene, u = bent
    K = scene.model.system.tangent(0.01 * u, {"interaction": factor})
    factors = Factorisation(scene.model.system.comm)
    factors.factor(K)
    dense = symmetric_part(K).getValues(
        range(scene.model.system.size), range(scene.model.system.size)
    )
    assert factors.negative_pivots == np.sum(np.linalg.eigvalsh(dense) < 0)
    assert (factors.negative_pivots > 0) == (factor > 1)


def elastica(L: float, w: float, h: float, apart: float, E: float) -> Array:
    """How the tip of a magnetised cantilever above an equal rigid strip moves, in mm: SciPy,
    magpylib's cuboid.

    Both are magnetised across. The forces are those on the charged faces, their mean over the
    width.
    """
    magnet = magpylib.magnet.Cuboid(
        polarization=(0, 0, BR), dimension=(L * MM, w * MM, h * MM), position=(L * MM / 2, 0, 0)
    )
    y, weight = np.polynomial.legendre.leggauss(12)
    stiffness, charge, half = E * w * h**3 / 12 * MM**4, BR / MU_0 * w * MM, h * MM / 2

    def slopes(s: Array, state: Array) -> Array:
        x, z, angle, moment, Fx, Fz = state
        n, f, couple = (-np.sin(angle), np.cos(angle)), np.zeros((len(s), 3)), np.zeros(len(s))
        for side in (1, -1):
            places = (
                (x + side * half * n[0])[:, None],
                y * w * MM / 2,
                (z + side * half * n[1])[:, None],
            )
            B = magnet.getB(np.stack(np.broadcast_arrays(*places), axis=-1).reshape(-1, 3))
            on = side * charge * (B.reshape(len(s), -1, 3) * weight[:, None] / 2).sum(axis=1)
            f += on
            couple += side * half * (n[0] * on[:, 2] - n[1] * on[:, 0])
        bend = -(np.cos(angle) * Fz - np.sin(angle) * Fx) - couple
        return np.array(
            [np.cos(angle), np.sin(angle), moment / stiffness, bend, -f[:, 0], -f[:, 2]]
        )

    def ends(a: Array, b: Array) -> Array:
        return np.array([a[0], a[1] - apart * MM, a[2], b[3], b[4], b[5]])

    s = np.linspace(0, L * MM, 41)
    start = np.zeros((6, 41))
    start[0], start[1] = s, apart * MM
    found = solve_bvp(slopes, ends, s, start, tol=1e-6)
    assert found.success
    return np.array([found.y[0, -1] / MM - L, found.y[1, -1] / MM - apart])


@pytest.mark.slow
def test_strip_above_a_strip(model: Any, tmp_path: Path) -> None:
    """The elastica in the field of its neighbour, 1e-3; Newton's method is quadratic."""
    L, w, h, apart = 10.0, 2.0, 0.25, 1.5
    strips(tmp_path / "strips.msh", L, w, apart, 1.0)
    root = gmsh.model.getEntitiesInBoundingBox(-0.1, -2, apart - 0.1, 0.1, 2, apart + 0.1, 1)
    gmsh.model.addPhysicalGroup(1, [root[0][1]], name="root")
    gmsh.write(str(tmp_path / "strips.msh"))
    points = {"tip": [f"{L} mm", f"{w / 2} mm", f"{apart} mm"]}
    case = case_of(
        tmp_path / "strips.msh",
        h,
        "200 MPa",
        boundary={"part0": "clamped", "root": "clamped"},
        points=points,
    )
    found = run(case)
    row = found.rows[-1]
    assert row["interaction"] == 1.0
    exact = elastica(L, w, h, apart, 200e6)
    assert np.linalg.norm([row["tip_ux_mm"], row["tip_uz_mm"]] - exact) < 1e-3 * np.linalg.norm(
        exact
    )
    assert exact[1] < -0.2
    assert row["negative_pivots"] == 0
    system, mu = found.scene.model.system, {"interaction": 1.0}
    factors, u, steps = Factorisation(system.comm), np.zeros(system.size), []
    while not steps or steps[-1] > 1e-11:
        factors.factor(system.tangent(u, mu))
        step = factors.solve(-system.residual(u, mu))
        u += step
        steps.append(np.abs(step).max())
        assert len(steps) < 8
    near = [(a, b) for a, b in pairwise(steps) if a < 1e-5]
    assert len(near) > 1
    assert all(b < 2e3 * a**2 for a, b in near), steps


CASE = """
shell:
  {geometry: mesh, file: strips.msh, unit: mm, radius: 5 mm, thickness: 0.2 mm, \
youngs_modulus: 20 MPa,
   poisson_ratio: 0.3}
boundary: {edge0: clamped, edge1: clamped}
magnetic: {remanent: {polar: 30, flux_density: 100 mT}, interaction: others}
loading: {kind: interaction, points: 3}
mesh: {degree: 2}
"""
SAME = ("interaction", "w_over_h", "energy", "magnetic", "bending")


@pytest.mark.slow
def test_same_path_on_ranks(model: Any, tmp_path: Path) -> None:
    """On 1 and 2 ranks; test_self_interaction.py has a run that goes on."""
    strips(tmp_path / "strips.msh", 4.0, 2.0, 1.5, 2.0)
    (tmp_path / "case.yaml").write_text(CASE)
    for ranks in (1, 2):
        done = magshell("run", tmp_path / "case.yaml", "--out", tmp_path / str(ranks), ranks=ranks)
        assert done.returncode == 0, done.stderr
    one, two = (read_path(tmp_path / ranks) for ranks in "12")
    for name in ("negative_pivots", *SAME):
        first, second = ([float(row[name]) for row in rows] for rows in (one, two))
        assert second == pytest.approx(first, rel=1e-7, abs=1e-14), name
    assert one[-1]["interaction"] == "1.0"


def test_parts_that_are_in_each_other(bent: tuple[Scene, Vector]) -> None:
    """There is no such equilibrium, and the energy is no number."""
    scene, u = bent
    z = scene.model.r0.x.array.reshape(-1, 3)[:, 2]
    u.reshape(-1, 3)[:, 2] -= np.where(z > 1e-6, 0.2, 0.0)
    assert np.isnan(gradient(scene, u)).all()


def test_parts_that_are_near_from_the_start(model: Any, tmp_path: Path) -> None:
    """In each other, their energy were no number: refused before anything is written, with what to
    do.
    """
    strips(tmp_path / "near.msh", 4.0, 1.0, 0.04, 2.0)
    for refused in (Scene, describe):
        with pytest.raises(
            CaseError, match=r"undeformed, two parts are nearer to each other .* take smaller cells"
        ):
            refused(case_of(tmp_path / "near.msh", 0.1))


SHELL = {
    "geometry": "mesh",
    "unit": "mm",
    "radius": "5 mm",
    "thickness": "0.2 mm",
    "youngs_modulus": "1 MPa",
}
REMANENT = {"polar": 0, "flux_density": "0.1 T"}
WRONG = [
    ({"remanent": None, "susceptibility": 2, "lambda_m": 1e-3}, {}, "not with remanent: none"),
    (
        {"remanent": REMANENT, "susceptibility": 2, "applied": REMANENT},
        {},
        "not with susceptibility",
    ),
    (
        {"remanent": REMANENT, "remanence": "rotation", "applied": REMANENT},
        {},
        "not with remanence: rotation",
    ),
    ({"remanent": REMANENT, "energy": "first", "applied": REMANENT}, {}, "not with energy: first"),
    (
        {"remanent": {"polar": 0}, "lambda_m": 1e-3},
        {},
        "how strong it is follows from remanent.flux_density",
    ),
    (
        {"remanent": REMANENT},
        {"loading": [{"kind": "pressure"}]},
        "no step of the programme drives it",
    ),
    ({"remanent": REMANENT}, {"model": "solid"}, "geometry: mesh|needs a mid-surface"),
    ({"remanent": REMANENT}, {}, "here all is one part"),
]


@pytest.mark.parametrize(("magnetic", "sections", "said"), WRONG)
def test_bad_input(
    model: Any, tmp_path: Path, magnetic: dict[str, Any], sections: dict[str, Any], said: str
) -> None:
    gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
    meshed(tmp_path / "one.msh", 0.5)
    data = {
        "shell": {**SHELL, "file": str(tmp_path / "one.msh"), "poisson_ratio": 0.3},
        "boundary": {"edge0": "clamped"},
        "magnetic": {"interaction": "others", **magnetic},
        "loading": {"kind": "interaction"},
    }
    with pytest.raises((CaseError, ValueError), match=said):
        Scene(Case.from_source(data | sections))


def test_a_step_without_interaction_is_refused(model: Any, tmp_path: Path) -> None:
    strips(tmp_path / "strips.msh", 2.0, 1.0, 1.0, 0.5)
    with pytest.raises(ValueError, match=r"interaction needs magnetic\.interaction: others"):
        case_of(tmp_path / "strips.msh", 0.1, magnetic={"lambda_m": 1e-3})


def test_models_that_are_too_large(
    model: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(interaction, "MAX_UNKNOWNS", 100)
    strips(tmp_path / "strips.msh", 2.0, 1.0, 1.0, 0.5)
    for refused in (Scene, describe):
        with pytest.raises(
            CaseError, match="as all of them act on each other, at most 100 are allowed"
        ):
            refused(case_of(tmp_path / "strips.msh", 0.1))


def test_a_piece_that_is_not_held(model: Any, tmp_path: Path) -> None:
    """Each piece of a mesh needs its own support."""
    strips(tmp_path / "strips.msh", 2.0, 1.0, 1.0, 0.5)
    with pytest.raises(MeshError, match=r"free to .*; this is its piece around \(0.2, .*, 0.2\)"):
        Scene(case_of(tmp_path / "strips.msh", 0.1, boundary={"part0": "clamped"}))


def rooted_strips(file: Path) -> None:
    """Two parallel strips, the left end of the upper one as the edge root."""
    strips(file, 4.0, 2.0, 1.5, 1.0)
    root = gmsh.model.getEntitiesInBoundingBox(-0.1, -2, 1.4, 0.1, 2, 1.6, 1)
    gmsh.model.addPhysicalGroup(1, [root[0][1]], name="root")
    gmsh.write(str(file))


@pytest.mark.slow
def test_motion_in_a_neighbours_field(model: Any, tmp_path: Path) -> None:
    """A strip whose neighbour's field doubles swings.

    Kinetic and stored energy are the work, 1e-3.
    """
    rooted_strips(tmp_path / "strips.msh")
    shell = {
        "geometry": "mesh",
        "file": str(tmp_path / "strips.msh"),
        "unit": "mm",
        "radius": "5 mm",
    }
    shell |= {
        "thickness": "0.2 mm",
        "youngs_modulus": "20 MPa",
        "poisson_ratio": 0,
        "density": "1200 kg/m^3",
    }
    magnetic = {"interaction": "others", "remanent": {"polar": 30, "flux_density": f"{BR} T"}}
    history = {"interaction": [["0 ms", 1], ["1 ms", 2], ["20 ms", 2]]}
    moves = {"kind": "time", "duration": "20 ms", "points": 20, "history": history}
    loading = [{"kind": "interaction", "points": 2}, moves]
    held = {"part0": "clamped", "root": "clamped"}
    case = case_of(
        tmp_path / "strips.msh",
        0.2,
        shell=shell,
        boundary=held,
        magnetic=magnetic,
        loading=loading,
        mesh={"degree": 2},
    )
    rows = [row for row in run(case).rows if row["time"]]
    assert max(row["kinetic"] / row["stored"] for row in rows) > 0.1
    assert max(abs(row["imbalance"]) for row in rows) < 1e-3 * max(row["work"] for row in rows)


@pytest.mark.slow
def test_gradient_beside_a_neighbour(model: Any, tmp_path: Path) -> None:
    """The deflection of a tip by both strips' flux density: differences of whole runs, 1e-5."""
    rooted_strips(tmp_path / "strips.msh")

    def ran(B: float) -> Any:
        magnetic = {"interaction": "others", "remanent": {"polar": 30, "flux_density": f"{B} T"}}
        held, points = {"part0": "clamped", "root": "clamped"}, {"tip": ["4 mm", "1 mm", "1.5 mm"]}
        sections = {"boundary": held, "points": points, "magnetic": magnetic, "mesh": {"degree": 2}}
        return run(case_of(tmp_path / "strips.msh", 0.2, "20 MPa", **sections))

    found, key, d = ran(BR), "magnetic.remanent.flux_density", 1e-4
    slope = gradient_of(found.scene, found.last_record, of="tip_uz_mm", by=key)[key]
    tips = [ran(BR + side * d).rows[-1]["tip_uz_mm"] for side in (1, -1)]
    assert slope == pytest.approx((tips[0] - tips[1]) / (2 * d), rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("interaction", "symmetry"),
    [("others", "half"), ("others", "none"), ("all", "half")],
)
def test_derivatives_by_thickness_and_place(
    model: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interaction: str, symmetry: str
) -> None:
    """Of the energy and of forces along a displacement: differences of fourth order, 1e-7; cells
    and rules stay.
    """
    strips(tmp_path / "strips.msh", 3.0, 1.0, 1.5, 1.5, halved=symmetry == "half")
    remanent = {
        "kind": "expression",
        "components": ["1 + x/9", "0", "0.2"],
        "flux_density": f"{BR} T",
    }
    case = case_of(
        tmp_path / "strips.msh",
        0.2,
        magnetic={"interaction": interaction, "remanent": remanent},
        mesh={"degree": 2},
        symmetry=symmetry,
    )
    scene = Scene(replace(case.problem(), thickness=Thickness()))
    term = next(
        term for term in scene.model.system.terms if isinstance(term, interacting.InteractionTerm)
    )
    r0, thickness, u, v = (
        scene.model.r0,
        scene.model.thickness,
        scene.model.u,
        fem.Function(scene.model.V),
    )
    assert thickness
    X, rng = r0.x.array.reshape(-1, 3).copy(), np.random.default_rng(0)

    def smooth(k: float) -> np.ndarray:
        x, y = k * X[:, 0], X[:, 1] ** 2
        return np.stack(
            [np.sin(2 * x + y), X[:, 1] * np.cos(x), np.sin(3 * x + y)], axis=-1
        ).ravel()

    u.x.array[:], v.x.array[:], r0.x.array[:] = (
        1e-2 * smooth(1.5),
        smooth(0.7),
        r0.x.array + 1e-2 * smooth(1.0),
    )
    thickness.x.array[:] += 0.1 * rng.standard_normal(len(thickness.x.array))
    fixed = property(lambda self: 0.07, lambda self, value: None)
    monkeypatch.setattr(
        SingularPairs, "_scale", fixed, raising=False
    )  # else rules change with the size of cells

    def values() -> np.ndarray:
        b = np.zeros(len(u.x.array))
        term.add_residual(b, 1.0)
        return np.array([term.energy(), b @ v.x.array])

    for f, change in ((thickness, rng.standard_normal(len(thickness.x.array))), (r0, smooth(1.2))):
        before, width = f.x.array.copy(), f.function_space.dofmap.bs
        along = change.reshape(-1, width)[f.function_space.dofmap.list]
        both = [term.by_field(f.name, v, *weights) for weights in ((1.0, 0.0), (0.0, 1.0))]
        found = [np.sum(of[1] * along) for of in both if of]
        expected = np.zeros(2)
        for way, weight in ((-2, 1 / 12), (-1, -2 / 3), (1, 2 / 3), (2, -1 / 12)):
            f.x.array[:] = before + way * 1e-4 * change
            expected += weight / 1e-4 * values()
        f.x.array[:] = before
        np.testing.assert_allclose(found, expected, rtol=1e-7)


@pytest.mark.parametrize("interaction", ["others", pytest.param("all", marks=pytest.mark.slow)])
def test_derivatives_by_the_remanence(model: Any, tmp_path: Path, interaction: str) -> None:
    """Of the energy and of forces along a displacement: differences of both, exact as they are
    quadratic; 1e-9.
    """
    size = 1.5 if interaction == "others" else 3.0
    strips(tmp_path / "strips.msh", 3.0, 1.0, 1.5, size)
    remanent = {
        "kind": "expression",
        "components": ["1 + x/9", "y/3", "0.2"],
        "flux_density": f"{BR} T",
    }
    magnetic = {"interaction": interaction, "remanent": remanent}
    scene = Scene(
        case_of(tmp_path / "strips.msh", 0.2, magnetic=magnetic, mesh={"degree": 2}).problem()
    )
    term = next(
        term for term in scene.model.system.terms if isinstance(term, interacting.InteractionTerm)
    )
    rng, u, v = np.random.default_rng(0), scene.model.u, fem.Function(scene.model.V)
    u.x.array[:], v.x.array[:] = (
        size * rng.standard_normal(len(u.x.array)) for size in (1e-3, 1.0)
    )
    (Br, by_energy), (_, by_force) = (
        term.by_field("Br", v, *weights) for weights in ((1.0, 0.0), (0.0, 1.0))
    )
    change, before = rng.standard_normal(len(Br.x.array)), Br.x.array.copy()
    own, forces, energies = self_field(term._view), list[float](), list[float]()
    own.edges = own.chargeable  # the change has charges on edges between cells
    for side in (1, -1):
        Br.x.array[:], b = before + side * change, np.zeros(len(u.x.array))
        term.add_residual(b, 1.0)
        energies.append(term.energy())
        forces.append(float(b @ v.x.array))
    along = change.reshape(-1, 3)[Br.function_space.dofmap.list]
    assert np.sum(by_energy * along) == pytest.approx((energies[0] - energies[1]) / 2, rel=1e-9)
    assert np.sum(by_force * along) == pytest.approx((forces[0] - forces[1]) / 2, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("interaction", ["others", "all"])
def test_gradients_by_thickness_and_shape_beside_a_neighbour(
    model: Any, tmp_path: Path, interaction: str
) -> None:
    """The deflection of a tip: differences of whole runs with other thickness and shape of both
    strips, 1e-6.
    """
    rooted_strips(tmp_path / "strips.msh")

    def ran(**keys: Any) -> Any:
        shell = {
            "geometry": "mesh",
            "file": str(tmp_path / "strips.msh"),
            "unit": "mm",
            "radius": "5 mm",
        }
        shell |= {"thickness": "0.2 mm", "youngs_modulus": "20 MPa", "poisson_ratio": 0, **keys}
        magnetic = {
            "interaction": interaction,
            "remanent": {"polar": 30, "flux_density": f"{BR} T"},
        }
        held, points = {"part0": "clamped", "root": "clamped"}, {"tip": ["4 mm", "1 mm", "1.5 mm"]}
        sections = {
            "shell": shell,
            "boundary": held,
            "points": points,
            "magnetic": magnetic,
            "mesh": {"degree": 2},
        }
        return run(case_of(tmp_path / "strips.msh", 0.2, **sections))

    def slope(d: float, keys: Any) -> float:
        tips = [ran(**keys(side * d)).rows[-1]["tip_uz_mm"] for side in (1, -1)]
        return float(tips[0] - tips[1]) / (2 * d)

    found = ran()
    by = gradient_of(found.scene, found.last_record, of="tip_uz_mm", by=["thickness", "deviation"])
    x = by["thickness"].places[..., :1]
    thicker = slope(1e-3, lambda e: {"thickness_factor": f"1 + {e!r}*x"})
    assert by["thickness"].along(x) == pytest.approx(thicker, rel=1e-6)
    x, y = by["deviation"].places[..., :1], by["deviation"].places[..., 1:2]
    other = slope(
        5e-3,
        lambda e: {"imperfections": [{"kind": "formula", "w0": "x**2 + 0.3*x*y", "amplitude": e}]},
    )
    assert by["deviation"].along(x**2 + 0.3 * x * y) * 0.2 / 5 == pytest.approx(other, rel=1e-6)


@pytest.mark.slow
def test_gradient_by_the_remanence_of_a_neighbour(model: Any, tmp_path: Path) -> None:
    """The deflection of a tip by the remanence of both strips: differences of whole runs, 1e-5."""
    rooted_strips(tmp_path / "strips.msh")

    def ran(e: float) -> Any:
        remanent = {
            "kind": "expression",
            "components": [f"0.5 + {e!r}*x", f"{e!r}*y", f"0.8 + {e!r}*z*x"],
        }
        magnetic = {"interaction": "others", "remanent": {**remanent, "flux_density": f"{BR} T"}}
        held, points = {"part0": "clamped", "root": "clamped"}, {"tip": ["4 mm", "1 mm", "1.5 mm"]}
        sections = {"boundary": held, "points": points, "magnetic": magnetic, "mesh": {"degree": 2}}
        return run(case_of(tmp_path / "strips.msh", 0.2, "20 MPa", **sections))

    found, d = ran(0.0), 1e-3
    by = gradient_of(found.scene, found.last_record, of="tip_uz_mm", by="remanence")["remanence"]
    x, y, z = np.moveaxis(by.places, -1, 0)
    tips = [ran(side * d).rows[-1]["tip_uz_mm"] for side in (1, -1)]
    assert by.along(np.stack([x, y, z * x], axis=-1)) == pytest.approx(
        (tips[0] - tips[1]) / (2 * d), rel=1e-5
    )


@pytest.mark.slow
def test_close_faces_by_remanence(model: Any, tmp_path: Path) -> None:
    """Energy and forces are quadratic in it: Euler's identity, 1e-9."""
    strips(tmp_path / "strips.msh", 4.0, 2.0, 0.33, 1.5)
    scene = Scene(case_of(tmp_path / "strips.msh", 0.3, mesh={"degree": 2}))
    (term,) = (each for each in scene.model.system.terms if each.name == "interaction")
    nodes, own, charged = term._nodes(), term._cells.own_range, term._charges
    assert charged.rules(nodes, own)[1].any()
    rates = 0.01 * np.cos(3.0 * np.arange(nodes.size)).reshape(nodes.shape)
    energy, slope = charged.evaluate(nodes, own)
    for weights, of in ((Weights(1.0, 0.0), energy), (Weights(0.0, 1.0), np.sum(slope * rates))):
        by = charged.field_derivatives(nodes, rates, own, weights).by_remanence
        assert np.sum(by * charged._shape.remanence) == pytest.approx(2 * of, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [1e-4, -1e-3])
def test_close_faces_have_an_energy_down_to_contact(model: Any, tmp_path: Path, gap: float) -> None:
    """A strip leans on another one just behind its end: forces and tangent are slopes of the
    energy, by differences.

    It ends 0.1 h before the other one begins: its face, continued, would cross that one's. The gap
    (h) is at its end.
    """
    h = 0.3
    rooted_strips(tmp_path / "strips.msh")
    held = {"part0": "clamped", "root": "clamped"}
    scene = Scene(case_of(tmp_path / "strips.msh", h, boundary=held, mesh={"degree": 2}))
    system, mu = scene.model.system, {"interaction": 1.0}
    (term,) = (each for each in system.terms if each.name == "interaction")
    x, _, z = 5 * scene.model.r0.x.array.reshape(-1, 3).T
    upper, (sine, cosine) = z > 1e-6, (0.1, np.sqrt(0.99))
    end = (
        0.5 * h * (1 + cosine) + gap * h
    )  # of the mid-surface, whose lower face touches with its edge
    places = [4.0 - 0.1 * h - 0.5 * h * sine + cosine * (x - 4.0), end - sine * (x - 4.0) - 1.5]
    u = np.zeros((len(x), 3))
    u[upper, 0], u[upper, 2] = (
        (each - (x if i == 0 else 0))[upper] / 5 for i, each in enumerate(places)
    )
    v = np.where(upper, -((x / 4) ** 2), 0.0)[:, None] * [0, 0, 1]
    u, v, step = u.ravel(), v.ravel(), 1e-4 * h / 5
    sides = [u + side * step * v for side in (1, -1)]
    energies = [system.at_state(State(each, mu)).evaluate(term.energy) for each in sides]
    assert (energies[0] - energies[1]) / (2 * step) == pytest.approx(
        gradient(scene, u) @ v, rel=1e-5
    )
    matrix = DenseTangent(system.u.function_space, [term], system.clamped)
    bend = v @ system.at_state(State(u, mu)).evaluate(lambda: matrix.rows(mu)) @ v
    slopes = [gradient(scene, each) @ v for each in sides]
    assert (slopes[0] - slopes[1]) / (2 * step) == pytest.approx(bend, rel=2e-3)
