"""Forces, moments and stresses at points, against series and textbooks."""

from math import cos, exp, pi, radians, sin, sqrt
from pathlib import Path
from typing import Any

import gmsh
import numpy as np
import pytest
from command import magshell
from conftest import CASES
from numpy.polynomial import legendre
from numpy.typing import NDArray

from magshell_fenicsx import Case, CaseError, MeshError, Scene, follow, surface
from magshell_fenicsx.models.shell.laminate import Laminate, Laminated
from magshell_fenicsx.models.shell.law import Koiter, Law
from magshell_fenicsx.models.shell.strains import NaturalFrame, TangentFrame
from magshell_fenicsx.output.store.table import read_rows
from magshell_fenicsx.parts.laminate import LaminateSection

Array = NDArray[np.float64]
SMALL = 1e-3  # factor of loads, so that the path is linear


def last_row(case: dict[str, Any] | Case) -> dict[str, float]:
    """Return what a linear case observes at its end, with units, over the factor of dead loads."""
    scene = Scene((case if isinstance(case, Case) else Case.from_source(case)).problem())
    *_, record = follow(scene)
    row = scene.observe(record.point.state)
    row |= scene.sizes.values(row)
    mu = record.point.state.mu
    return {name: value / mu["load"] for name, value in row.items()} if "load" in mu else row


def dead(*loads: dict[str, Any]) -> dict[str, Any]:
    """Return a step of dead loads in one point."""
    return {"kind": "dead", "loads": [*loads], "factor": SMALL, "control": "load", "points": 1}


# Scordelis and Lo's roof (J. Am. Concr. Inst. 61, 1964): N along it is 76 kip/ft at the middle of
# the free edge, the moment across 2.06 kip at the crown
R, LENGTH, HALF_ANGLE, T, E, WEIGHT = 25.0, 50.0, radians(40), 0.25, 4.32e8, 90.0


def roof_series(phi: float, z: float) -> dict[str, float]:
    """Return forces and moments of the roof by linear theory: a Fourier series along it, and
    polynomials across in Ritz's method.

    `phi` is from the crown, `z` from the middle. 1 is down the axis, 2 around it, towards the
    crown's other side. nu = 0.
    """
    x, rule = legendre.leggauss(40)
    nodes, weights = HALF_ANGLE * (x + 1) / 2, rule * HALF_ANGLE / 2 * R
    stretching, bending = E * T * np.diag([1, 1, 0.5]), E * T**3 / 12 * np.diag([1, 1, 0.5])

    def shapes(angles: Array, parity: int) -> list[Array]:
        """Return value, first and second derivative of even or odd polynomials."""
        coefficients = np.eye(17)[parity::2].T
        return [
            legendre.legval(angles / HALF_ANGLE, legendre.legder(coefficients, d)) / HALF_ANGLE**d
            for d in range(3)
        ]

    def strains(angles: Array, wave: float) -> tuple[Array, Array]:
        """Return strains and curvatures (3, unknowns, angles) of the waves cos and sin(wave z)."""
        (u, du, _), (v, dv, _), (w, dw, ddw) = (shapes(angles, parity) for parity in (0, 1, 0))
        no_u, no_v = 0 * u, 0 * v
        E_ = [[wave * u, no_v, no_u], [no_u, dv / R, w / R], [du / R, -wave * v, no_u]]
        K = [
            [no_u, no_v, -(wave**2) * w],
            [no_u, -2 * dv / R**2, (ddw - w) / R**2],
            [no_u, 2 * wave * v / R, -2 * wave * dw / R],
        ]
        return np.array([np.vstack(row) for row in E_]), np.array([np.vstack(row) for row in K])

    N, M = np.zeros(3), np.zeros(3)
    for n in range(1, 60, 2):
        wave, load = n * pi / LENGTH, WEIGHT * 4 / (pi * n) * sin(n * pi / 2)
        strain, bend = strains(nodes, wave)
        stiffness = np.einsum("iap,ij,jbp,p->ab", strain, stretching, strain, weights)
        stiffness += np.einsum("iap,ij,jbp,p->ab", bend, bending, bend, weights)
        (v, *_), (w, *_) = shapes(nodes, 1), shapes(nodes, 0)
        work = [0 * w @ weights, v @ (weights * np.sin(nodes)), -w @ (weights * np.cos(nodes))]
        amplitudes = np.linalg.solve(stiffness, load * np.concatenate(work))
        at_point = [amplitudes @ form[..., 0].T for form in strains(np.array([phi]), wave)]
        along = np.array([cos(wave * z), cos(wave * z), sin(wave * z)])
        N += stretching @ at_point[0] * along
        M += bending @ at_point[1] * along
    names = ("11", "22", "12")
    signs = (1, 1, -1)  # of direction 1, down the axis
    forces = {f"N{i}": s * value for i, s, value in zip(names, signs, N, strict=True)}
    return forces | {f"M{i}": s * value for i, s, value in zip(names, signs, M, strict=True)}


def test_forces_and_moments_of_a_roof() -> None:
    """Scordelis and Lo's roof, a quarter of it: a vertex, edges and a point inside."""
    places = {"A": (40, 0.0), "C": (0, 0.0), "G": (20, 12.5), "D": (40, 25.0)}
    points = {
        name: [R * cos(radians(phi)), R * sin(radians(phi)), z] for name, (phi, z) in places.items()
    }
    row = last_row(
        {
            "shell": {
                "geometry": "cylinder",
                "radius": R,
                "length": LENGTH / 2,
                "azimuth": [0, 40],
                "thickness": T,
                "youngs_modulus": E,
                "poisson_ratio": 0,
            },
            "boundary": {"bottom": "symmetry", "left": "symmetry", "top": {"held": ["x", "y"]}},
            "points": points,
            "stress": [*places],
            "loading": dead({"over": "all", "per_area": [-WEIGHT, 0, 0]}),
            "mesh": {"size": 3},
        }
    )
    units = {"N": E * T, "M": E * T**3 / 12 / R}
    for name, (phi, z) in places.items():
        exact = roof_series(radians(phi), z)
        largest = {"N": 7567.0, "M": 2056.0}  # a tenth of the largest force, the largest moment
        for column, value in exact.items():
            found = row[f"{name}_{column}"] * units[column[0]]
            assert found == pytest.approx(value, rel=3e-3, abs=5e-3 * largest[column[0]]), column
    assert row["A_N11"] * E * T == pytest.approx(75_667, rel=1e-3)
    assert row["C_M22"] * units["M"] == pytest.approx(-2056.2, rel=1e-3)


@pytest.mark.parametrize(
    ("settings", "h", "error"),
    [
        ([], 0.02, 2e-3),
        pytest.param(["symmetry=half", "mesh.size=1.5 m"], 0.4, 0.01, marks=pytest.mark.slow),
    ],
)
def test_a_tank_at_its_foot(settings: list[str], h: float, error: float) -> None:
    """S. Timoshenko and S. Woinowsky-Krieger, Theory of Plates and Shells (1959), art. 118, at the
    foot and in the wall; on the meridian and on a coarse half."""
    a, d, gamma, nu = 8.0, 10.0, 9810.0, 0.3
    beta = (3 * (1 - nu**2) / (a * h) ** 2) ** 0.25
    moment = (1 - 1 / (beta * d)) * gamma * a * d * h / sqrt(12 * (1 - nu**2))
    shear = (2 * beta * d - 1) * gamma * a * h / sqrt(12 * (1 - nu**2))
    decay = exp(-beta) * (d * cos(beta) + (d - 1 / beta) * sin(beta))  # at the height of 1 m
    settings = [*settings, f"loading.pressure={-SMALL * gamma * a} Pa", f"shell.thickness={h} m"]
    row = last_row(Case.load(CASES / "tank.yaml", settings))
    row = {name: value / SMALL for name, value in row.items()}
    assert row["foot_M11_N"] == pytest.approx(moment, rel=error)
    assert row["foot_M22_N"] == pytest.approx(nu * moment, rel=error)
    assert row["foot_Q1_N_per_m"] == pytest.approx(shear, rel=4 * error)
    assert row["wall_N22_N_per_m"] == pytest.approx(gamma * a * (d - 1 - decay), rel=error)
    bending = 6 * moment / h**2
    assert row["foot_sigma11_bottom_Pa"] == pytest.approx(bending, rel=error)
    assert row["foot_sigma11_top_Pa"] == pytest.approx(-bending, rel=error)
    mises = bending * sqrt(1 - nu + nu**2)
    assert row["foot_mises_top_Pa"] == pytest.approx(mises, rel=error)


def test_a_tank_of_concrete() -> None:
    """The moment at the foot of a full tank, 20 904 N by Timoshenko's formula (art. 118)."""
    wall = "{geometry: cylinder, radius: 10 m, length: 8 m, thickness: 0.1 m, "
    material = "youngs_modulus: 30 GPa, poisson_ratio: 0.2}"
    points = "{foot: [10 m, 0, 0], wall: [10 m, 0, 4 m]}"
    loads = "[{over: all, pressure: '-9810*(8 - z)'}]"
    loading = f"loading={{kind: dead, loads: {loads}, factor: 1, control: load, points: 1}}"
    settings = [f"shell={wall}{material}", f"points={points}", loading]
    row = last_row(Case.load(CASES / "tank.yaml", settings))
    assert row["foot_M11_N"] == pytest.approx(20_904, rel=1e-3)


def test_a_point_of_a_half() -> None:
    """Half of a plate has what the whole plate has at a point, in the directions of the case; in
    its mirror plane exactly no shear force across it."""
    case = {
        "shell": {
            "geometry": "plate",
            "length": 1,
            "width": 1,
            "thickness": 0.01,
            "youngs_modulus": 1,
            "poisson_ratio": 0.3,
        },
        "boundary": {"left": "clamped", "bottom": "hinged", "top": "hinged"},
        "points": {"A": [0.25, 0.25, 0], "B": [0.25, 0.5, 0]},
        "stress": ["A", "B"],
        "loading": dead({"over": "all", "pressure": 1e-9}),
        "mesh": {"size": 0.25},
    }
    half, whole = last_row({**case, "symmetry": "half"}), last_row({**case, "symmetry": "none"})
    for name in ("A_M11", "A_M22", "A_M12", "A_Q1", "A_Q2"):
        assert half[name] == pytest.approx(whole[name], rel=1e-3)
    for name in ("B_M11", "B_M22", "B_Q1"):
        assert half[name] == pytest.approx(whole[name], rel=1e-3)
    for name in ("B_M12", "B_Q2"):
        assert abs(half[name]) < 1e-9 * abs(half["B_Q1"])


def le5(size: float) -> dict[str, Any]:
    """Return NAFEMS' LE5, a cantilever of Z-section that is twisted by shear at its end."""
    material = {"thickness": "0.1 m", "youngs_modulus": "210 GPa", "poisson_ratio": 0.3}

    def plate(width: float, **keys: Any) -> dict[str, Any]:
        """Return a wall of the cantilever."""
        shell = {"geometry": "plate", "length": "10 m", "width": f"{width} m", **material}
        return {"shell": shell, "boundary": {"left": "hinged"}, **keys}

    upright = {"position": [0, 0, -1], "axis": {"polar": 90, "azimuth": -90}, "turn": 90}
    return {
        "shells": {
            "web": plate(2, place=upright),
            "upper": plate(1, place={"position": [0, 0, 1]}, points={"A": [2.5, 1, 0]}),
            "lower": plate(1, place={"position": [0, -1, -1]}),
        },
        "joints": [{"edges": ["web.top", "upper.bottom"]}, {"edges": ["web.bottom", "lower.top"]}],
        "stress": ["upper.A"],
        "loading": dead(
            {"edge": "upper.right", "force": [0, "0.6 MN", 0]},
            {"edge": "lower.right", "force": [0, "-0.6 MN", 0]},
        ),
        "mesh": {"size": f"{size} m"},
    }


@pytest.mark.slow
def test_z_section() -> None:
    """LE5's -108 MPa is Vlasov's theory of thin-walled beams (107.9), which has no shear of the
    walls and no plates: shells have -109.5 on any mesh."""
    # unit warping of the tip, sectorial moment of inertia, and decay of the bimoment along x
    omega, inertia, G = 0.75, 1 / 24, 210e9 / 2.6
    k = sqrt(G * 4 * 0.1**3 / 3 / (210e9 * inertia))
    vlasov = 1.2e6 / k * np.sinh(k * 7.5) / np.cosh(k * 10) * omega / inertia
    assert vlasov == pytest.approx(108e6, rel=2e-3)
    row = last_row(le5(1.0))
    assert row["upper_A_sigma11_middle_Pa"] == pytest.approx(-108e6, rel=0.015)
    assert row["upper_A_sigma11_middle_Pa"] == pytest.approx(-109.467e6, rel=1e-3)  # of 0.25 m
    assert row["upper_A_N11_N_per_m"] == pytest.approx(0.1 * row["upper_A_sigma11_middle_Pa"])


def write_plate_with_a_hole(file: Path) -> None:
    """Write a plate, 20 by 10, with a round hole of the diameter 1, which has an odd number of
    sides on each quarter: no vertex is where it is widest."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    g = gmsh.model.geo
    angles = [pi / 4 + i * pi / 2 for i in range(4)]
    centre = g.addPoint(0, 0, 0)
    rings = [[g.addPoint(r * cos(a), r * sin(a), 0) for a in angles] for r in (0.5, 1.5)]
    corners = [g.addPoint(x, y, 0) for x, y in ((10, 5), (-10, 5), (-10, -5), (10, -5))]
    following = (1, 2, 3, 0)
    hole, around = (
        [g.addCircleArc(p[i], centre, p[following[i]]) for i in range(4)] for p in rings
    )
    spokes = [g.addLine(a, b) for a, b in zip(*rings, strict=True)]
    sides = [g.addLine(corners[i], corners[following[i]]) for i in range(4)]
    surfaces = [g.addPlaneSurface([g.addCurveLoop(sides), g.addCurveLoop(around)])]
    for i in range(4):
        loop = g.addCurveLoop([hole[i], spokes[following[i]], -around[i], -spokes[i]])
        surfaces.append(g.addPlaneSurface([loop]))
        g.mesh.setTransfiniteSurface(surfaces[-1])
        g.mesh.setTransfiniteCurve(spokes[i], 4, "Progression", 1.5)
        for arc in (hole[i], around[i]):
            g.mesh.setTransfiniteCurve(arc, 6)
    g.synchronize()
    gmsh.model.addPhysicalGroup(2, surfaces, name="plate")
    gmsh.model.addPhysicalGroup(1, hole, name="hole")
    for name, side in zip(("top", "left", "bottom", "right"), sides, strict=True):
        gmsh.model.addPhysicalGroup(1, [side], name=name)
    gmsh.option.setNumber("Mesh.MeshSizeMax", 2.5)
    gmsh.model.mesh.generate(2)
    gmsh.model.mesh.setOrder(2)
    gmsh.write(str(file))
    gmsh.finalize()


def plate_with_a_hole(file: Path, points: dict[str, list[float]]) -> dict[str, Any]:
    """Return a plate of a mesh file that is pulled by 1 per length."""
    sides = {name: {"held": ["z"]} for name in ("right", "top", "bottom")}
    return {
        "shell": {
            "geometry": "mesh",
            "file": str(file),
            "radius": 1,
            "thickness": 0.01,
            "youngs_modulus": 1e6,
            "poisson_ratio": 0.3,
        },
        "boundary": {"left": {"held": ["x", "z"]}, "corner": {"held": ["y"]}, **sides},
        "points": {**points, "corner": [-10, 5, 0]},
        "stress": [*points],
        "loading": dead({"edge": "right", "force": [10, 0, 0]}),
        "mesh": {"degree": 3},
    }


@pytest.mark.slow
def test_a_plate_with_a_hole(tmp_path: Path) -> None:
    """R. C. J. Howland (Phil. Trans. R. Soc. A 229, 1930): 3.03 where the hole is a tenth of the
    width. The point is in a side of the mesh, and is none of its vertices."""
    write_plate_with_a_hole(tmp_path / "hole.msh")
    row = last_row(plate_with_a_hole(tmp_path / "hole.msh", {"A": [0, 0.5, 0], "B": [6, 1, 0]}))
    assert row["A_N11"] * 1e4 == pytest.approx(3.03, rel=0.01)
    assert row["A_N22"] * 1e4 == pytest.approx(0, abs=0.05)
    # displacements are those of the surface, too: far from the hole it is pulled by 1e-4
    assert row["B_ux"] == pytest.approx(16e-4, rel=0.02)
    assert row["B_uz"] == pytest.approx(0, abs=1e-9)
    with pytest.raises(MeshError, match=r"points\.A: .* is no vertex of the mesh"):
        last_row({**plate_with_a_hole(tmp_path / "hole.msh", {"A": [0, 0.5, 0]}), "stress": []})
    with pytest.raises(MeshError, match=r"stress: A: is .* away from the surface"):
        last_row(plate_with_a_hole(tmp_path / "hole.msh", {"A": [0, 0.3, 0]}))


@pytest.mark.slow
def test_points_on_two_ranks(tmp_path: Path) -> None:
    """Cells of a point, and nodes of a cell, may belong to several ranks."""
    write_plate_with_a_hole(tmp_path / "hole.msh")
    places = {"A": [0, 0.5, 0], "B": [3, 1, 0], "C": [0.1, 2.5, 0], "D": [0.5, 0, 0]}
    case = plate_with_a_hole(tmp_path / "hole.msh", places)
    (tmp_path / "case.yaml").write_text(str(case).replace("'", '"'))
    rows = []
    for ranks in (1, 2):
        out = tmp_path / str(ranks)
        run = magshell("run", tmp_path / "case.yaml", "--out", out, ranks=ranks)
        assert run.returncode == 0, run.stderr
        rows.append(read_rows(out / "path.csv")[-1])
    one, two = rows
    for column in (name for name in one if name[:2] in {f"{point}_" for point in places}):
        assert float(two[column]) == pytest.approx(float(one[column]), rel=1e-5, abs=1e-12), column


def test_fields_have_stresses() -> None:
    """With `stress`, fields have forces and stresses: on a stretched strip all are N/h."""
    case = {
        "shell": {
            "geometry": "plate",
            "length": 2,
            "width": 1,
            "thickness": 0.1,
            "youngs_modulus": 1,
            "poisson_ratio": 0,
        },
        "boundary": {"left": "clamped"},
        "stress": [],
        "loading": dead({"edge": "right", "force": [1e-4, 0, 0]}),
        "mesh": {"size": 1, "degree": 2},
    }
    scene = Scene(Case.from_source(case).problem())
    *_, record = follow(scene)
    fields = surface(scene, record).fields
    for name in ("N", "stress_top", "stress_middle", "stress_bottom"):
        assert fields[name][:, 0, 0] == pytest.approx(np.full(len(fields[name]), 1e-6), rel=1e-3)
    assert fields["mises_top"] == pytest.approx(fields["stress_top"][:, 0, 0], rel=1e-3)


def test_where_shells_meet() -> None:
    """Two walls at an angle have no single stress where they meet."""
    case = le5(2.5)
    case["shells"]["upper"]["points"] = {"A": [2.5, 0, 0]}
    row = last_row(case)  # the side of the shell that has the name
    assert row["upper_A_N11"] != 0
    with pytest.raises(CaseError, match=r"stress\.0: B: name it in points"):
        Case.from_source({**case, "stress": ["B"]})
    solid = {"geometry": "hemisphere", "radius_to_thickness": 20, "poisson_ratio": 0.3}
    with pytest.raises(CaseError, match="stress: needs a mid-surface"):
        Case.from_source({"shell": solid, "boundary": {}, "model": "solid", "stress": []})
    rubber = {**solid, "law": "neo-hookean", "poisson_ratio": 0.5}
    with pytest.raises(CaseError, match=r"stress: needs a thickness .*sigma_1"):
        Case.from_source({"shell": rubber, "boundary": {"equator": "clamped"}, "stress": []})


PLIES = LaminateSection.model_validate(
    {
        "plies": [
            {"angle": 30, "E1": 2, "E2": 0.5, "nu12": 0.3, "G12": 0.4, "fraction": 0.25},
            {"angle": -60, "E1": 2, "E2": 0.5, "nu12": 0.3, "G12": 0.4, "fraction": 0.75},
        ]
    }
)


@pytest.mark.parametrize(
    "law",
    [
        Koiter(0.05, 0.3, thickness_factor=1.3),
        Laminated.from_laminate(
            Laminate(PLIES.matrices(1.0), np.array([1.0, 0, 0])), 0.05, 0.3
        ).thicker(1.3),
    ],
)
def test_the_force_is_the_derivative_of_the_energy(law: Law) -> None:
    """N is the derivative of membrane and bending energy by E, also where plies couple them."""
    rng = np.random.default_rng(1)
    E, K, change = rng.normal(size=(3, 2, 2))
    E, K, change = (S + S.T for S in (E, K, change))

    def energy(step: float) -> float:
        """Return the energy of the strain, changed by a step."""
        strain = E + step * change
        return float(law.membrane(strain, np.eye(2)) + law.bending(strain, K, np.eye(2)))

    N11, N12, N22 = law.force(E, K, np.eye(2))
    work = N11 * change[0, 0] + 2 * N12 * change[0, 1] + N22 * change[1, 1]
    assert work == pytest.approx((energy(0.5) - energy(-0.5)), rel=1e-9)  # it is quadratic


def test_free_growth_has_no_force() -> None:
    """A shell in its natural shape has no force; the rest of the strain has that of its law."""
    jet = np.zeros((6, 1, 3))
    jet[1:3, 0] = [[1, 0, 0], [0, 1, 0]]
    frame, stretch = TangentFrame.from_jet(jet), 0.1 * np.diag([1.0, 1.0, 0.0])
    shape = NaturalFrame.from_tensors(
        frame, stretch[None], np.zeros((1, 3, 3)), np.zeros(1), bent=1.0, stretched=1.0
    )
    law, zero = Koiter(0.05, 0.3), np.zeros((1, 3))
    natural = np.array([[0.105, 0.0, 0.105]])  # (1.1² - 1)/2
    assert shape.force(natural, zero, law) == pytest.approx(zero, abs=1e-15)
    more = np.array([[0.01, 0.0, 0.0]])  # (1.1)² of the strain 0.01/1.1² in the natural shape
    assert shape.force(natural + more, zero, law)[0, 0] == pytest.approx(
        0.01 / 1.1**2 / (1 - 0.3**2), rel=1e-9
    )
