"""A magnetised part in its own field: closed forms of prisms and spherical shells, differences,
eigenvalues.
"""

from pathlib import Path
from typing import Any

import gmsh
import numpy as np
import pytest
from command import magshell, read_path
from interrupted import start, wait_for_rows
from mpi4py import MPI
from test_interaction import BR, MU_0, Array, case_of, gradient, meshed, model
from test_own_field import sphere_of_triangles

from magshell_fenicsx import Scene
from magshell_fenicsx.assembly.dense_tangent import DenseTangent
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import State, Vector, symmetric_part
from magshell_fenicsx.parts.magnetism.coulomb import InteractingCharges
from magshell_fenicsx.parts.magnetism.singular_pairs import SingularPairs

__all__ = ["model"]


def demagnetising(a: float, b: float, c: float) -> float:
    """That of a prism of 2a x 2b x 2c along the last side: A.

    Aharoni, J. Appl. Phys. 83 (1998) 3432, equation 1.
    """
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
    return Scene(
        case_of(file, h, magnetic=magnetic, **{"boundary": {"edge0": "clamped"}, **sections})
    )


@pytest.mark.parametrize(("h", "polar"), [(0.25, 0), (0.25, 90), (0.05, 0), (0.05, 90)])
def test_a_prism(model: Any, tmp_path: Path, h: float, polar: float) -> None:
    """The energy of a strip magnetised across or along itself is N/2 Br² V/mu_0, 1e-3."""
    scene = alone(tmp_path / "strip.msh", h, polar)
    (term,) = (each for each in scene.model.system.terms if each.name == "interaction")
    found = scene.model.system.at_state(State(scene.model.zero(), {"interaction": 1.0})).evaluate(
        term.energy
    )
    N = demagnetising(2.5, 0.5, h / 2) if polar == 0 else demagnetising(0.5, h / 2, 2.5)
    exact = BR**2 / (MU_0 * 1e6) * N / 2 * 5.0 / 5.0**2  # of E h R²
    assert found == pytest.approx(exact, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("R_over_h", "error"), [(20, 2e-4), (90, 2e-4)])
def test_a_closed_sphere(R_over_h: float, error: float) -> None:
    """A uniformly magnetised spherical shell: field only inside the wall and outside, energy Br²
    V/(6 mu_0).
    """
    shape = sphere_of_triangles(1 / R_over_h, np.array([0.0, 0.0, 1.0]))
    corners = np.unique(shape.r0[:, :3].round(9).reshape(-1, 3), axis=0, return_inverse=True)[
        1
    ].reshape(-1, 3)
    none, count = np.zeros(0, dtype=np.intp), len(shape.r0)
    near = SingularPairs(shape, corners, none, none, range(count), MPI.COMM_WORLD)
    charged = InteractingCharges(
        shape, np.zeros(count, dtype=np.intp), none, none, MPI.COMM_WORLD, near
    )
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
    u, v = (
        scene.model.system.zero_at_supports(
            np.column_stack(each).ravel()[: scene.model.system.size]
        )
        for each in both
    )
    return u, v


@pytest.mark.slow
def test_derivatives(model: Any, tmp_path: Path) -> None:
    """Work is the change of the energy, the tangent is the slope of the forces: differences, 1e-6;
    no net force.
    """
    scene = alone(tmp_path / "strip.msh", 0.25, 40)
    (u, v), system, mu = bent(scene), scene.model.system, {"interaction": 1.0}
    (term,) = (each for each in system.terms if each.name == "interaction")
    step = 3e-6  # beside edges charges are so near each other
    moved = [
        (w / step, u + k * step * v)
        for k, w in ((1, 2 / 3), (-1, -2 / 3), (2, -1 / 12), (-2, 1 / 12))
    ]
    slope = gradient(scene, u)
    energies = [(w, system.at_state(State(each, mu)).evaluate(term.energy)) for w, each in moved]
    assert sum(w * value for w, value in energies) == pytest.approx(slope @ v, rel=1e-6)
    assert np.abs(slope.reshape(-1, 3).sum(axis=0)).max() < 1e-12 * np.abs(slope).sum()
    rows = rows_of(system, State(u, mu), term)
    change = sum(w * gradient(scene, each) for w, each in moved)
    assert np.linalg.norm(rows @ v - change) < 1e-6 * np.linalg.norm(change)
    assert np.abs(rows - rows.T).max() < 1e-11 * np.abs(rows).max()


@pytest.mark.slow
def test_inertia(model: Any, tmp_path: Path) -> None:
    """Negative pivots of the factors are the dense matrix's negative eigenvalues, with 1 and 1e5
    times the energy.
    """
    scene = alone(tmp_path / "strip.msh", 0.25, 0)
    system, counts = scene.model.system, []
    for factor in (1.0, 1e5):
        K, factors = (
            system.tangent(0.01 * bent(scene)[0], {"interaction": factor}),
            Factorisation(system.comm),
        )
        factors.factor(K)
        eigenvalues = np.linalg.eigvalsh(
            symmetric_part(K).getValues(range(system.size), range(system.size))
        )
        counts.append(factors.negative_pivots)
        assert counts[-1] == np.sum(eigenvalues < 0)
    assert counts[0] == 0 < counts[1]


def halves(file: Path, symmetry: str, polar: float, azimuth: float, **sections: Any) -> Scene:
    """Two strips of 5 x 1 mm, one above the other, each of two halves with the same mesh; all of
    it, or a half.
    """
    if not file.exists():
        for z in (0.0, 0.5):
            both = [gmsh.model.occ.addRectangle(0, y, z, 5.0, 0.5) for y in (-0.5, 0.0)]
            gmsh.model.occ.fragment([(2, both[0])], [(2, both[1])])
        gmsh.model.occ.synchronize()
        for _, line in gmsh.model.getEntities(1):
            x = gmsh.model.getBoundingBox(1, line)
            gmsh.model.mesh.setTransfiniteCurve(line, 6 if x[3] - x[0] > 1 else 2)
        for i, (_, face) in enumerate(gmsh.model.getEntities(2)):
            gmsh.model.mesh.setTransfiniteSurface(face, "Left" if i % 2 else "Right")
        for name, z in (("lower", 0.0), ("upper", 0.5)):
            faces = gmsh.model.getEntitiesInBoundingBox(-1, -1, z - 0.1, 6, 1, z + 0.1, 2)
            gmsh.model.addPhysicalGroup(2, [tag for _, tag in faces], name=name)
            lines = gmsh.model.getEntitiesInBoundingBox(-0.1, -1, z - 0.1, 0.1, 1, z + 0.1, 1)
            root = [tag for _, tag in lines]
            rim = {tag for _, tag in gmsh.model.getBoundary(faces, oriented=False)}
            gmsh.model.addPhysicalGroup(1, root, name=f"{name}_root")
            gmsh.model.addPhysicalGroup(1, sorted(rim - set(root)), name=f"{name}_rim")
        gmsh.model.mesh.generate(2)
        gmsh.write(str(file))
    magnetic = {
        "interaction": "all",
        "remanent": {"polar": polar, "azimuth": azimuth, "flux_density": f"{BR} T"},
    }
    held = {"lower_root": "clamped", "upper_root": "clamped"}
    sections = {
        "boundary": held,
        "magnetic": magnetic,
        "symmetry": symmetry,
        "mesh": {"degree": 2},
    } | sections
    return Scene(case_of(file, 0.2, **sections))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("polar", "azimuth", "error"), [(40, 0, 5e-3), (90, 90, 1e-5)]
)  # mirrored, or opposite
def test_a_half(model: Any, tmp_path: Path, polar: float, azimuth: float, error: float) -> None:
    """A half in its images' field is the half of the whole, to the error of rules: energy 1e-5,
    even and odd tangents.

    Cells of the whole's other half begin at other corners than images do, which shows the error of
    rules for cells that touch: largest in the tangent, of charged faces. Differences of the half's
    own energy and forces: 1e-6.
    """
    file, at = tmp_path / "halves.msh", {"interaction": 1.0}
    whole, half = (halves(file, each, polar, azimuth) for each in ("none", "half"))
    assert (whole.model.multiplicity, half.model.multiplicity) == (1, 2)
    x, of = (each.model.r0.x.array.reshape(-1, 3) for each in (whole, half))
    images = half.model.mirror.image(of)
    here, there = (
        np.linalg.norm(x[:, None] - each, axis=-1).argmin(axis=0) for each in (of, images)
    )
    assert np.linalg.norm(x[here] - of, axis=-1).max() < 1e-9
    S = half.model.mirror.reflection
    bend = np.column_stack(
        [0.01 * np.sin(2 * of[:, 1]) ** 2, 0 * of[:, 0], 0.03 * of[:, 0] ** 2 * (1 + of[:, 1] ** 2)]
    )
    u = np.zeros_like(x)
    u[here], u[there] = bend, bend @ S
    terms = [
        next(t for t in each.model.system.terms if t.name == "interaction")
        for each in (whole, half)
    ]
    states = [State(u.ravel(), at), State(bend.ravel(), at)]
    systems = whole.model.system, half.model.system
    energies = [
        s.at_state(state).evaluate(t.energy)
        for s, state, t in zip(systems, states, terms, strict=True)
    ]
    assert 2 * energies[1] == pytest.approx(energies[0], rel=1e-5)
    system, term, step = systems[1], terms[1], 3e-6
    v, k = smooth(of, 1.0), rows_of(system, states[1], term)
    assert np.abs(k - k.T).max() < 1e-11 * np.abs(k).max()
    moved = [
        (w / step, bend + c * step * v)
        for c, w in ((1, 2 / 3), (-1, -2 / 3), (2, -1 / 12), (-2, 1 / 12))
    ]
    change = sum(
        w * system.at_state(State(each.ravel(), at)).evaluate(term.energy) for w, each in moved
    )
    assert change == pytest.approx(gradient(half, bend.ravel()) @ v.ravel(), rel=1e-6)
    slope = sum(w * gradient(half, each.ravel()) for w, each in moved)
    assert np.linalg.norm(k @ v.ravel() - slope) < 1e-6 * np.linalg.norm(slope)
    K = rows_of(systems[0], states[0], terms[0])
    for sign in (1.0, -1.0):
        v, V = smooth(of, sign), np.zeros_like(x)
        V[there], V[here] = sign * v @ S, v
        k = rows_of(system, states[1], term if sign > 0 else term.antisymmetric())
        assert 2 * v.ravel() @ k @ v.ravel() == pytest.approx(V.ravel() @ K @ V.ravel(), rel=error)


CAP = """
shell: {geometry: cap, radius: 25 mm, thickness: 1.2 mm, polar: 60, youngs_modulus: 0.3 MPa, \
poisson_ratio: 0.49}
boundary: {rim: clamped}
magnetic: {remanent: {polar: 0, flux_density: 150 mT}, interaction: all}
loading: {kind: pressure, control: load, points: 1, pressure: 100 Pa, until: target}
mesh: {degree: 2, size: 25 mm}
symmetry: half
"""


@pytest.mark.slow
def test_ranks_and_resume(tmp_path: Path) -> None:
    """A half in its own and its image's field: the same path on 2 ranks, and on 1 of a run that
    goes on.
    """
    (tmp_path / "case.yaml").write_text(CAP)
    words = "run", tmp_path / "case.yaml", "--no-pictures", "--out"
    run = start(*words, tmp_path / "again")
    wait_for_rows(run, tmp_path / "again", 2)
    run.terminate()
    run.communicate()
    assert len(read_path(tmp_path / "again")) < 5
    paths = []
    for out, resume, ranks in (("again", ["--resume"], 1), ("2", [], 2)):
        done = magshell(*words, tmp_path / out, *resume, ranks=ranks)
        assert done.returncode == 0, done.stderr
        paths.append(read_path(tmp_path / out))
    one, two = paths
    assert len(one) == len(two) == 5
    for name in ("interaction", "p_over_pc", "w_over_h", "energy", "magnetic"):
        first, values = ([float(row[name]) for row in rows] for rows in paths)
        assert values == pytest.approx(first, rel=1e-7, abs=1e-13), name


def smooth(x: Array, sign: float) -> Array:
    """A displacement that a mirror at y = 0 leaves, or turns into its opposite."""
    even, odd = (np.cos(x[:, 1]), x[:, 1]) if sign > 0 else (x[:, 1], np.cos(x[:, 1]))
    return np.column_stack(
        [even * np.sin(3 * x[:, 0] + 1), odd * np.cos(2 * x[:, 0]), even * np.sin(2 * x[:, 0])]
    )


def rows_of(system: Any, state: State, term: Any) -> Array:
    """The interaction's part of the tangent."""
    matrix = DenseTangent(system.u.function_space, [term], system.clamped)
    return np.asarray(system.at_state(state).evaluate(lambda: matrix.rows({term.name: 1.0})))
