"""Natural frequencies: exact plates, beams and cylinders, two discretisations, exponents at
instabilities, files.
"""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import magshell
from conftest import CASES
from numpy.polynomial import Legendre
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.optimize import brentq
from scipy.special import ive, jv

from magshell_fenicsx import Case, Scene, run
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.trace import trace


def scene_of(shell: dict[str, Any], boundary: dict[str, Any], **sections: Any) -> Scene:
    return Scene(Case.from_source({"shell": shell, "boundary": boundary, **sections}))


def lowest(scene: Scene, count: int) -> list[tuple[str, float]]:
    """Label and omega^2 rho R^2/E of the unloaded shell."""
    return [
        (mode.label, mode.eigenvalue)
        for mode in ShellModes(scene.model).vibrations(scene.unloaded(), count)
    ]


def of_plate(scene: Scene, count: int, label: str | None = None) -> list[float]:
    """omega R^2 sqrt(rho h/D)."""
    D = scene.problem.material.bending_stiffness
    return [
        float(np.sqrt(value / D)) for name, value in lowest(scene, count) if label in (None, name)
    ]


def clamped_disc(n: int, first: float, last: float) -> float:
    """k^2 between two bounds: J_n(k) I_n'(k) = I_n(k) J_n'(k), whose roots are in Leissa's table
    2.1.
    """

    def determinant(k: float) -> float:
        return float(
            jv(n, k) * (ive(n - 1, k) + ive(n + 1, k)) - ive(n, k) * (jv(n - 1, k) - jv(n + 1, k))
        )

    return float(brentq(determinant, first, last, xtol=1e-12)) ** 2


@pytest.mark.parametrize("symmetry", ["axisymmetric", "half"])
def test_clamped_disc(symmetry: str) -> None:
    shell = {"geometry": "disc", "radius_to_thickness": 1000, "poisson_ratio": 0.3}
    scene = scene_of(
        shell, {"rim": "clamped"}, symmetry=symmetry, mesh={"degree": 4, "refinement": 1.2}
    )
    exact = [clamped_disc(n, *b) for n, b in enumerate([(3, 3.5), (4.4, 4.8), (5.7, 6.1)])]
    exact.append(clamped_disc(0, 6.1, 6.5))
    assert exact == pytest.approx([10.2158, 21.26, 34.88, 39.771], rel=1e-4)  # Leissa
    if symmetry == "half":
        exact = sorted([*exact, *exact[1:3]])
    assert of_plate(scene, len(exact)) == pytest.approx(exact, rel=1e-4)


def test_simply_supported_square_and_a_thickness_that_counts_twice() -> None:
    """pi^2 (m^2 + n^2); twice as thick the stiffness is eight times and the mass twice as large."""
    shell = {
        "geometry": "plate",
        "length": 1.0,
        "width": 1.0,
        "thickness": 1e-3,
        "poisson_ratio": 0.3,
    }
    edges = dict.fromkeys(("left", "right", "bottom", "top"), "hinged")
    exact = np.pi**2 * np.array([2, 5, 5, 8])
    once = of_plate(scene_of(shell, edges, symmetry="none", mesh={"size": 0.3}), 4)
    assert once == pytest.approx(exact, rel=1e-4)
    twice = of_plate(
        scene_of(shell | {"thickness_factor": "2.0"}, edges, symmetry="none", mesh={"size": 0.3}), 1
    )
    assert twice[0] == pytest.approx(2 * exact[0], rel=1e-4)


def test_clamped_strip() -> None:
    """cos a cosh a = -1, bending of a cantilever; with nu = 0 a plate bends to cylinders as beams
    do.
    """
    shell = {"geometry": "strip", "radius_to_thickness": 1000, "width": 0.1, "poisson_ratio": 0}
    exact = [brentq(lambda a: np.cos(a) * np.cosh(a) + 1, *b) ** 2 for b in ((1.5, 2), (4.5, 5))]
    assert exact == pytest.approx([3.5160, 22.0345], rel=1e-5)
    found = of_plate(scene_of(shell, {"root": "clamped"}, symmetry="half"), 3, label="")
    assert found[:2] == pytest.approx(exact, rel=1e-4)


def free_square(nu: float, order: int = 12) -> list[float]:
    """omega a^2 sqrt(rho h/D) of the vibrations of a free square plate, by Ritz's method with
    Legendre polynomials.
    """
    x, weight = leggauss(order + 2)
    of = [Legendre.basis(n) for n in range(order)]
    p = [np.array([f(x) for f in of])] + [np.array([f.deriv(d)(x) for f in of]) for d in (1, 2)]

    def integral(i: int, j: int) -> NDArray[np.float64]:
        return np.asarray((p[i] * weight) @ p[j].T)

    zero, one, two, mixed = integral(0, 0), integral(1, 1), integral(2, 2), integral(2, 0)
    K = (
        np.kron(two, zero)
        + np.kron(zero, two)
        + nu * (np.kron(mixed, mixed.T) + np.kron(mixed.T, mixed))
    )
    K += 2 * (1 - nu) * np.kron(one, one)
    return list(
        4 * np.sqrt(eigh(K, np.kron(zero, zero), eigvals_only=True)[3:12])
    )  # a side of the square is 2


@pytest.mark.parametrize("symmetry", ["half", "none"])
def test_a_free_plate_has_six_rigid_motions_before_it_vibrates(symmetry: str) -> None:
    scene = Scene(Case.load(CASES / "free_plate.yaml", [f"symmetry={symmetry}"]))
    modes = ShellModes(scene.model).vibrations(
        scene.unloaded(), 11, allows_rigid_motion=scene.allows_rigid_motion
    )
    D = scene.problem.material.bending_stiffness
    values = [mode.eigenvalue for mode in modes]
    assert values[:6] == [0.0] * 6
    assert np.sqrt(np.array(values[6:]) / D) == pytest.approx(free_square(0.3)[:5], rel=1e-4)


def free_disc(n: int, first: float, last: float, nu: float) -> float:
    """k^2 between two bounds: a circular plate without moment and shear force at its rim (Leissa,
    equation 2.10).
    """

    def determinant(k: float) -> float:
        J, I = jv(n, k), ive(n, k)  # noqa: E741
        dJ, dI = (jv(n - 1, k) - jv(n + 1, k)) / 2, (ive(n - 1, k) + ive(n + 1, k)) / 2
        moments = [
            k**2 * f + sign * (1 - nu) * (k * df - n**2 * f)
            for f, df, sign in ((J, dJ, 1), (I, dI, -1))
        ]
        shears = [
            k**3 * df + sign * (1 - nu) * n**2 * (k * df - f)
            for f, df, sign in ((J, dJ, 1), (I, dI, -1))
        ]
        return float(moments[0] * shears[1] - moments[1] * shears[0])

    return float(brentq(determinant, first, last, xtol=1e-12)) ** 2


def test_a_free_disc_as_a_meridian() -> None:
    """Along and around its axis it moves freely, and across it; then it vibrates with n = 2, 0 and
    3.
    """
    # rounding is less than 1e-5 at this thickness
    shell = {"geometry": "disc", "radius_to_thickness": 300, "poisson_ratio": 0.33}
    scene = scene_of(shell, {"rim": "free"}, frequencies={})
    modes = ShellModes(scene.model).vibrations(
        scene.unloaded(), 7, allows_rigid_motion=scene.allows_rigid_motion
    )
    assert [mode.label for mode in modes] == ["", "torsion", "m = 1", "m = 1", "m = 2", "", "m = 3"]
    assert [mode.eigenvalue for mode in modes[:4]] == [0.0] * 4
    exact = [
        free_disc(n, *b, nu=0.33) for n, b in ((2, (2, 2.6)), (0, (2.7, 3.3)), (3, (3.2, 3.8)))
    ]
    assert exact == pytest.approx([5.253, 9.084, 12.23], rel=2e-3)  # Leissa, table 2.5
    D = scene.problem.material.bending_stiffness
    assert [np.sqrt(mode.eigenvalue / D) for mode in modes[4:]] == pytest.approx(exact, rel=1e-4)


def of_cylinder(n: int, k: float, h: float, nu: float) -> float:
    """The lowest omega^2 rho R^2/E of u cos kx cos nt, v sin kx sin nt, w sin kx cos nt on a
    cylinder of radius 1.

    Koiter's strains, linear: E = (u,x; v,t + w; (u,t + v,x)/2), K = (w,xx; w,tt - 2 v,t - w; w,xt -
    v,x).
    """
    E = np.array([[-k, 0, 0], [0, n, 1], [-n / 2, k / 2, 0]])
    K = np.array([[0, 0, -(k**2)], [0, -2 * n, -(n**2) - 1], [0, -k, -k * n]])
    law = np.array([[1, nu, 0], [nu, 1, 0], [0, 0, 2 * (1 - nu)]]) / (1 - nu**2)
    return float(eigh(E.T @ law @ E + h**2 / 12 * K.T @ law @ K, eigvals_only=True)[0])


@pytest.mark.parametrize("symmetry", ["axisymmetric", "none"])
def test_cylinder_with_diaphragms(symmetry: str) -> None:
    """A half of the length: the plane in the middle leaves odd axial waves."""
    nu, h, length = 0.3, 0.02, 2.0
    shell = {
        "geometry": "cylinder",
        "radius": 1.0,
        "length": length / 2,
        "thickness": h,
        "poisson_ratio": nu,
    }
    held = {"bottom": "symmetry", "top": {"held": ["x", "y"]}}
    mesh = {} if symmetry == "axisymmetric" else {"size": 0.25}
    found = lowest(scene_of(shell, held, symmetry=symmetry, mesh=mesh), 4)
    exact = sorted(
        (of_cylinder(n, j * np.pi / length, h, nu), n) for n in range(2, 9) for j in (1, 3)
    )
    if symmetry == "axisymmetric":
        assert found == [(f"m = {n}", pytest.approx(value, rel=1e-4)) for value, n in exact[:4]]
    else:
        assert [value for _, value in found] == pytest.approx(
            [exact[i // 2][0] for i in range(4)], rel=1e-4
        )


def test_torsion_of_a_tube() -> None:
    """omega^2 rho/G = (pi/L)^2 (1 + h^2/(3 R^2)), with the twist of Koiter's shell.

    A meridian has no displacement around the axis; its waves of m = 0 do.
    """
    shell = {
        "geometry": "cylinder",
        "radius": 1.0,
        "length": 20.0,
        "thickness": 0.1,
        "poisson_ratio": 0.25,
    }
    scene = scene_of(shell, {"bottom": "clamped", "top": "clamped"}, symmetry="axisymmetric")
    found = [value for label, value in lowest(scene, 6) if label == "torsion"]
    assert found[:1] == pytest.approx([(np.pi / 20) ** 2 / 2.5 * (1 + 0.1**2 / 3)], rel=1e-4)


def test_clamped_hemisphere_by_half_and_meridian() -> None:
    """Ten frequencies by two discretisations; the half sees both of each pair of waves."""
    shell = {"geometry": "hemisphere", "radius_to_thickness": 90, "poisson_ratio": 0.3}
    found = {
        symmetry: lowest(scene_of(shell, {"equator": "clamped"}, symmetry=symmetry), 10)
        for symmetry in ("axisymmetric", "half")
    }
    pairs = [value for label, value in found["axisymmetric"] for _ in range(2 if label else 1)]
    assert [value for _, value in found["half"]] == pytest.approx(pairs[:10], rel=1e-4)


def test_full_shell_has_both_symmetries() -> None:
    """The lowest ten of a coarse full shell are the symmetric and the antisymmetric ones of its
    half.
    """
    shell = {"geometry": "hemisphere", "radius_to_thickness": 30, "poisson_ratio": 0.3}
    mesh = {"degree": 4, "refinement": 0.8}
    half, full = (
        lowest(scene_of(shell, {"equator": "clamped"}, symmetry=symmetry, mesh=mesh), 10)
        for symmetry in ("half", "none")
    )
    labels = [label for label, _ in half]
    assert {"", "antisymmetric"} == set(labels)
    assert [value for _, value in full] == pytest.approx([value for _, value in half], rel=1e-3)


@pytest.mark.slow
def test_a_solid_disc_converges() -> None:
    """The lowest frequency of a clamped solid disc, R/h = 20, comes from above and closer with each
    refinement.
    """
    shell = {"geometry": "disc", "radius_to_thickness": 20, "poisson_ratio": 0.3}
    found = []
    for refinement in (0.5, 1.0, 1.5):
        sections = {"model": "solid", "symmetry": "half", "mesh": {"refinement": refinement}}
        found.append(lowest(scene_of(shell, {"rim": "clamped"}, **sections), 1)[0][1])
    changes = -np.diff(found) / found[-1]
    assert 0 < changes[1] < changes[0] / 2


def near_instability(scene: Scene) -> tuple[float, float]:
    """The exponent with which omega^2 of the neutral mode grows with the distance below its load,
    and omega^2 there.
    """
    located = next(record for record in follow(scene) if record.label in ("fold", "bifurcation"))
    end, name, shell = located.point.state, located.amplitude, ShellModes(scene.model)
    distances = np.array([4e-3, 1e-3])
    path = trace(
        scene, name, control="load", until="target", targets=[*(end.mu[name] * (1 - distances))]
    )
    states = [record.point.state for record in path if record.label == "target"]
    values = [
        next(m.eigenvalue for m in shell.vibrations(s, 1) if m.label == located.mode)
        for s in states
    ]
    slope = np.log(values[0] / values[1]) / np.log(distances[0] / distances[1])
    return float(slope), shell.vibrations(end, 1)[0].eigenvalue


def test_unstable_shell() -> None:
    """As many negative squares as unstable directions."""
    loading = "loading={kind: pressure, control: arc, until: points, points: 7}"
    scene = Scene(Case.load(CASES / "dimple_buckling.yaml", [loading, "mesh.refinement=0.5"]))
    *_, last = follow(scene)
    modes = ShellModes(scene.model).vibrations(last.point.state, 1)
    assert (
        sum(mode.eigenvalue < 0 for mode in modes)
        == last.point.negative_pivots + last.excluded_pivots
        > 0
    )


def test_square_root_at_a_fold() -> None:
    case = Case.load(CASES / "dimple_buckling.yaml", ["mesh.refinement=0.5"])
    slope, there = near_instability(Scene(case))
    assert slope == pytest.approx(0.5, abs=0.02)
    assert abs(there) < 1e-5


def test_linear_at_a_bifurcation() -> None:
    shell = {"geometry": "hemisphere", "radius_to_thickness": 30, "poisson_ratio": 0.3}
    pressed = {"loading": {"kind": "pressure", "until": "bifurcation"}, "mesh": {"refinement": 0.5}}
    slope, there = near_instability(scene_of(shell, {"equator": "clamped"}, **pressed))
    assert slope == pytest.approx(1.0, abs=0.02)
    assert abs(there) < 1e-6


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "frequencies.csv").open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_files(tmp_path: Path) -> None:
    """A steel plate in hertz: 10.2158/(2 pi R^2) sqrt(D/(rho h)). Pictures, modes, the report."""
    R, h, E, rho = 0.1, 0.001, 2e11, 7800.0
    steel = (
        "{geometry: disc, radius: 100 mm, thickness: 1 mm, youngs_modulus: 200 GPa, "
        "poisson_ratio: 0.3,"
    )
    settings = [
        f"--set=shell={steel} density: 7800 kg/m^3}}",
        "--set=frequencies={count: 3, at: all}",
    ]
    done = magshell("run", CASES / "clamped_plate.yaml", *settings, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    rows = table(tmp_path)
    assert [(row["point"], row["wave"]) for row in rows] == [(p, w) for p in "01" for w in "012"]
    D = E * h**3 / (12 * (1 - 0.3**2))
    assert float(rows[0]["hertz"]) == pytest.approx(
        10.2158 / (2 * np.pi * R**2) * np.sqrt(D / (rho * h)), rel=1e-4
    )
    assert "Natural frequencies" in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert (tmp_path / "frequencies.png").exists()
    fields = sorted(file.name for file in (tmp_path / "fields").glob("mode_*"))
    assert fields == [f"mode_000{p}_f{name}.vtu" for p in (0, 1) for name in ("1", "2_m1", "3_m2")]


@pytest.mark.slow
def test_one_rank_and_two(tmp_path: Path) -> None:
    """A half has both symmetries."""
    settings = [
        "--set=symmetry=half",
        "--set=mesh={degree: 3, refinement: 0.5}",
        "--set=frequencies.count=4",
    ]
    tables = []
    for ranks in (1, 2):
        out = tmp_path / str(ranks)
        done = magshell("run", CASES / "clamped_plate.yaml", *settings, "--out", out, ranks=ranks)
        assert done.returncode == 0, done.stderr
        tables.append(table(out))
    values = [[float(row["omega2"]) for row in rows] for rows in tables]
    assert {row["wave"] for row in tables[0]} == {"symmetric", "antisymmetric"}
    assert values[1] == pytest.approx(values[0], rel=1e-8, abs=1e-9)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("frequencies.count=0", "frequencies.count: 0: must be greater than or equal to 1"),
        ("frequencies.at=fold", "frequencies.at: 'fold': must be 'ends', 'end' or 'all'"),
        ("shell.density=1000 kg/m^3", "density turns frequencies into hertz"),
    ],
)
def test_mistakes(setting: str, message: str) -> None:
    with pytest.raises(CaseError) as error:
        Case.load(CASES / "dimple_buckling.yaml", [setting])
    assert message in str(error.value)


@pytest.mark.slow
def test_frequencies_under_a_plate_are_those_of_a_rigid_one(tmp_path: Path) -> None:
    """The half shell's omega^2; the default stiffness, if given, lets the disc leave the plate,
    which is reported.
    """
    cap = tmp_path / "cap.yaml"
    cap.write_text(
        "shell: {geometry: cap, radius: 1, thickness: 0.02, poisson_ratio: 0.3, polar: 60}\n"
        "boundary: {rim: clamped}\nbodies: {plate: {kind: plane}}\nmesh: {degree: 3}\n"
        "loading: {kind: contact, approach: 2, points: 1}\nfrequencies: {count: 4, at: end}\n"
    )
    half = {1: 0.7640, 2: 1.0247, 0: 1.0445, 3: 1.1043}  # by the half shell on its default mesh
    for stiffness in ("", "3e5", "91575.1"):
        out = tmp_path / f"k{stiffness}"
        done = magshell(
            "run",
            cap,
            "--no-pictures",
            "--out",
            out,
            *([f"--set=bodies.plate.stiffness={stiffness}"] if stiffness else []),
        )
        found = [
            (int(r["wave"]), float(r["omega2"]), float(r["contact_change"])) for r in table(out)
        ]
        soft = [wave for wave, _, change in found if change > 1e-3]
        if stiffness == "91575.1":
            assert soft == [0]
            assert "depends on the stiffness of the bodies" in done.stdout
        else:
            assert {wave: value for wave, value, _ in found} == pytest.approx(half, rel=3e-3)
            assert not soft
            assert "depends on the stiffness" not in done.stdout


@pytest.mark.slow
def test_a_sector_has_the_frequencies_of_the_whole_shell(tmp_path: Path) -> None:
    """A cap of m = 3 under half of its load: waves that the sector of 36 degrees excludes come
    first (meridian).
    """
    text = (
        "shell: {geometry: cap, radius: 1, thickness: 0.01, polar: 30, poisson_ratio: 0.3}\n"
        "boundary: {rim: clamped}\n"
        "mesh: {degree: 3, refinement: 0.7}\n"
        "frequencies: {count: 8, at: end}\nstability: {at: end}\n"
        "loading: {kind: pressure, control: load, until: target, pressure: 0.46, points: 1}\n"
        "symmetry: %s\n"
    )
    found = {}
    for symmetry in ("5", "axisymmetric"):
        (tmp_path / "case.yaml").write_text(text % symmetry)
        out = tmp_path / symmetry
        assert (
            magshell("run", tmp_path / "case.yaml", "--out", out, "--no-pictures").returncode == 0
        )
        tables = [
            list(csv.DictReader((out / name).open()))
            for name in ("frequencies.csv", "stability.csv")
        ]
        found[symmetry] = (
            [float(row["omega2"]) for row in tables[0]],
            float(tables[1][0]["eigenvalue"]),
        )
    waves = found["axisymmetric"]
    assert found["5"][1] == pytest.approx(waves[1], rel=3e-3)
    assert found["5"][0][0:8:2][:3] == pytest.approx(
        waves[0][:3], rel=5e-3
    )  # each wave and its twin
    assert found["5"][0][1:8:2][:3] == pytest.approx(waves[0][:3], rel=5e-3)


def test_no_modes_of_a_refused_state(tmp_path: Path) -> None:
    """A penalty too small makes the undeformed plate unstable: that is said, and no frequency."""
    case = {
        "shell": {"geometry": "disc", "radius_to_thickness": 100, "poisson_ratio": 0.3},
        "boundary": {"rim": "clamped"},
        "mesh": {"size": 0.5, "penalty": 0.3},
        "symmetry": "half",
        "frequencies": {"count": 2},
        "stability": {"at": "end", "modes": 1},
    }
    said = list[str]()
    result = run(Case.model_validate(case), tmp_path / "out", say=said.append, pictures=False)
    assert result.stopped
    assert result.stopped.startswith("the undeformed shell is unstable")
    assert not result.frequencies
    assert not any("lowest" in line for line in said)
