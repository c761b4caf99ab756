"""Every case file runs, and one physical number of each is asserted.

References: "axisymmetric" is an independent solver of the meridian's equations, nine digits;
"mixed" is an independent hybridised Hellan-Herrmann-Johnson discretisation, two meshes within 2e-4.
"""

import pathlib

import numpy as np
import pytest
from conftest import CASES
from numpy.typing import NDArray
from scipy.integrate import solve_bvp
from scipy.interpolate import CubicSpline
from solved import result

from magshell_fenicsx import Case, Result, Scene
from magshell_fenicsx.continuation.control import PrescribedConjugate
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import PathStopped, Point
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.public import run
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.simulate.follow import follow

Array = NDArray[np.float64]


def force_at(found: Result, depth: float) -> float:
    (row,) = [
        row
        for row in found.rows
        if row["label"] == "target" and abs(float(row["w_over_h"]) - depth) < 1e-6
    ]
    return float(row["force"])


def test_every_case_is_run() -> None:
    """Here or in another of these files, where its name stands in quotes."""
    tests = "".join(
        file.read_text(encoding="utf-8")
        for file in pathlib.Path(__file__).parents[1].rglob("test_*.py")
    )
    cases = [
        file.relative_to(CASES).as_posix().removeprefix("benchmarks/")
        for file in CASES.rglob("*.yaml")
    ]
    assert [case for case in cases if f'"{case}"' not in tests] == []


DIMPLED = [
    (90, 0, "full", 0.326233289),
    (90, 0.00184, "full", 0.552053778),
    (90, -0.00184, "full", 0.120723848),
    (78.75, 0, "full", 0.326944309),
    (90, 0.00184, "second", 0.537770729),
    (90, 0.00184, "first", 0.336890384),
    (90, 0.00184, "torque", 0.536061699),
]


@pytest.mark.parametrize(
    ("R_over_h", "lambda_m", "energy", "k_d", "symmetry", "tolerance"),
    [
        *((*each, "auto", 1e-6) for each in DIMPLED),
        *(pytest.param(*DIMPLED[i], "half", 2e-4, marks=pytest.mark.slow) for i in (5,)),
    ],
)
def test_dimple_buckling(
    R_over_h: float, lambda_m: float, energy: str, k_d: float, symmetry: str, tolerance: float
) -> None:
    """Axisymmetric reference, nine digits; `auto` takes the meridian."""
    found = result(
        "dimple_buckling.yaml",
        f"shell.radius_to_thickness={R_over_h}",
        f"magnetic.lambda_m={lambda_m}",
        f"magnetic.energy={energy}",
        f"symmetry={symmetry}",
    )
    assert found.knockdown == pytest.approx(k_d, rel=tolerance)
    assert [point["kind"] for point in found.limit_points] == ["fold"]
    kernels = found.scene.model.kernels.names
    assert len(kernels) == len(set(kernels)), "a kernel was made twice"


def test_bistable_dome() -> None:
    """It snaps in at a fold, that of the half shell within its mesh.

    It snaps back at a bifurcation with two waves.
    The numbers are those of README.
    """
    found = result("bistable_dome.yaml")
    snap_in, *_, back = found.limit_points
    half = result("bistable_dome.yaml", "symmetry=half", "loading.until=limit")
    assert snap_in["value"] == pytest.approx(half.limit_points[0]["value"], rel=1e-3)
    assert (snap_in["kind"], round(snap_in["applied_mT"])) == ("fold", -363)
    assert (back["mode"], round(back["applied_mT"])) == ("m = 2", 169)


def test_excluded_mode_that_cannot_be_located_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Newton failing while an excluded instability is located ends the run with a message, after
    the whole path.
    """

    def lost(path: Path, stable: Point, *others: object) -> Point:
        raise PathStopped("the iteration diverged", stable)

    monkeypatch.setattr("magshell_fenicsx.continuation.stability_monitor.locate_bifurcation", lost)
    found = run(Case.load(CASES / "dimple_drift.yaml"))
    assert found.rows[-1]["label"] == "target"
    assert found.stopped
    assert "excludes is unstable" in found.stopped


def test_dimple_drift() -> None:
    """Waves m = 1 come and go between two folds; stable against them are both the fold and the end.

    The numbers are the case's own, bracketed on a surface mesh by `test_dimple_drift_on_the_shell`.
    """
    found = result("dimple_drift.yaml")
    assert [(p["kind"], p["mode"]) for p in found.limit_points] == [
        ("fold", ""),
        ("bifurcation", "m = 1"),
        ("bifurcation", "m = 1"),
    ]
    assert [p["value"] for p in found.limit_points] == pytest.approx(
        [0.328068, 0.303360, 0.151836], rel=1e-5
    )
    assert found.stopped is None
    assert found.knockdown == found.limit_points[0]["value"]
    labels = [row["label"] for row in found.rows]
    first, last = (i for i, label in enumerate(labels) if label == "bifurcation")
    assert [row["excluded_pivots"] for row in found.rows] == [
        int(first < i < last) for i in range(len(labels))
    ]


@pytest.mark.slow
def test_dimple_drift_on_the_shell() -> None:
    """A half shell brought into equilibrium at the meridian's volumes, before, between and after
    the two.

    Besides the direction of the fold it sees one wave, cos, and excludes the other, sin; its mesh
    lowers and raises the pressures by up to 3e-3.
    """
    records = list(follow(scene := Scene(Case.load(CASES / "dimple_drift.yaml"))))
    shell = Scene(Case.load(CASES / "dimple_drift.yaml", ["symmetry=half", "mesh.refinement=1.8"]))
    assert isinstance(scene.model, MeridianModel)
    assert shell.model.symmetry_breaking_modes
    x, y, z = shell.model.r0.x.array.reshape(-1, 3).T
    rho = np.hypot(x, y)
    c, s = (np.divide(a, rho, out=np.zeros_like(a), where=rho > 0) for a in (x, y))
    places = np.arctan2(*scene.model.r0.x.array.reshape(-1, 2).T)
    found = []
    depths = {
        scene.observe(r.point.state)["w_over_h"]: r
        for r in records
        if r.label not in ("fold", "bifurcation")
    }
    for wanted in (4.0, 6.0, 14.0, 17.6):
        record = depths[min(depths, key=lambda depth: abs(depth - wanted))]
        U, W = CubicSpline(
            np.sort(places), record.point.state.u.reshape(-1, 2)[np.argsort(places)]
        )(np.arctan2(rho, z)).T
        guess = State(
            shell.model.system.zero_at_supports(np.column_stack([U * c, U * s, W]).ravel()),
            record.point.state.mu,
        )
        volume = -shell.model.system.potential(guess.u, {}, "pressure")
        there = shell.newton.solve(
            guess, "pressure", PrescribedConjugate(shell.newton.system, "pressure", volume)
        )
        assert there.converged
        assert there.state.mu["pressure"] == pytest.approx(
            record.point.state.mu["pressure"], rel=4e-3
        )
        tangents = shell.newton, shell.model.symmetry_breaking_modes
        found.append([tangent.factor_at(there.state).negative_pivots for tangent in tangents])
    assert found == [[1, 0], [2, 1], [2, 1], [1, 0]]


@pytest.mark.slow
def test_half_and_full_shell_agree() -> None:
    """A field that is tilted to the remanence, in its plane."""
    settings = (
        "magnetic={lambda_m: 0.00184, remanent: {polar: 0}, applied: {polar: 45}}",
        "mesh.refinement=0.45",
    )
    half, full = (
        result("dimple_buckling.yaml", *settings, f"symmetry={s}") for s in ("half", "none")
    )
    assert half.knockdown == pytest.approx(full.knockdown, rel=1e-4)


@pytest.mark.parametrize("symmetry", ["auto", "half"])
def test_pole_indentation(symmetry: str) -> None:
    """Axisymmetric reference: F R/(2 pi D) = 2.9615563 and 5.6202235 at w/h = 1.5 and 6."""
    found = result("pole_indentation.yaml", f"symmetry={symmetry}")
    assert force_at(found, 1.5) == pytest.approx(2.9615563, rel=1e-3)
    assert force_at(found, 6.0) == pytest.approx(5.6202235, rel=1e-3)


def test_clamped_plate() -> None:
    """w0 = p R^4/(64 D) (Timoshenko)."""
    found = result("clamped_plate.yaml", "symmetry=half")
    R_over_h, nu = 50, 0.3
    pressure = 1e-5 * 2 / (3 * (1 - nu**2)) ** 0.5 / R_over_h**2
    w0_over_h = pressure * 12 * (1 - nu**2) * R_over_h**4 / 64
    assert found.rows[-1]["w_pole_over_h"] == pytest.approx(w0_over_h, rel=1e-4)


def test_standing_strip() -> None:
    """Greenhill's column: g = 9/4 j² E h²/(12 ρ L³), j the first zero of J₋⅓."""
    found = result(
        "standing_strip.yaml",
        "shell.poisson_ratio=0",
        "loading.then=null",
        "loading.acceleration=null",
    )
    (row,) = [row for row in found.rows if row["label"] == "bifurcation"]
    assert row["gravity_m_per_s2"] == pytest.approx(
        7.8373 * 1e6 * 1e-3**2 / (12 * 1100 * 0.05**3), rel=2e-3
    )


def test_spinning_blade() -> None:
    """SciPy's boundary values of an extensible elastica: how deep its tip hangs at rest and at 300
    rpm.
    """
    found = result("spinning_blade.yaml", "shell.poisson_ratio=0", "loading.1.points=2")
    L, h, E, rho, weight = 0.05, 1e-3, 1e6, 1100, 10.79
    rows = [row for row in found.rows if row["label"] == "target"]
    (at_rest,) = [row for row in rows if row["step"] == 1 and row["load_factor"] == 1]
    for rpm, row in ((0, at_rest), (300, rows[-1])):
        s, y = np.linspace(0, L, 50), np.zeros((6, 50))
        y[0] = s
        for share in np.linspace(0.1, 1, 10):
            outward, down = share * rho * h * (rpm * np.pi / 30) ** 2, share * weight

            def along(s: Array, y: Array, outward: float = outward, down: float = down) -> Array:
                x, _, angle, M, N, Q = y
                c, d = np.cos(angle), np.sin(angle)
                stretch = 1 + (N * c + Q * d) / (E * h)
                turned = M / (E * h**3 / 12)
                return np.array(
                    [
                        stretch * c,
                        stretch * d,
                        turned,
                        stretch * (N * d - Q * c),
                        -outward * x,
                        down + 0 * x,
                    ]
                )

            solved = solve_bvp(along, lambda a, b: np.concatenate([a[:3], b[3:]]), s, y, tol=1e-6)
            assert solved.success
            s, y = solved.x, solved.y
        assert row["tip_uz"] == pytest.approx(y[1, -1], rel=1e-3)


def test_cylinder_waves() -> None:
    """The half shell's first bifurcation, p/p_c = 0.113764 with elements of 0.14 R; a tube between
    two walls, m = 9.
    """
    found = result("cylinder_waves.yaml")
    (first,) = found.limit_points
    assert (first["kind"], first["mode"]) == ("bifurcation", "m = 9")
    assert found.knockdown == pytest.approx(0.113764, rel=2e-4)
    assert found.rows[-1]["label"] == "bifurcation"


@pytest.mark.slow
def test_cap_waves_branch() -> None:
    """The fold of the branch of five waves, p/p_c = 0.474389 of the sector with elements of two
    thirds the size.
    """
    found = result("cap_waves_branch.yaml")
    first, fold = found.limit_points[:2]
    assert (first["mode"], fold["kind"]) == ("m = 5", "fold")
    assert fold["p_over_pc"] == pytest.approx(0.474389, rel=3e-4)
    assert found.scene_of(found.end).model.multiplicity == 10


@pytest.mark.slow
def test_bracket() -> None:
    """w = F b^2 (a + b/3)/(E I) (Bernoulli). The mesh's fold is part of the undeformed shape."""
    found = result("bracket.yaml")
    E_I, F = 0.4 * 0.01**3 / 12, 2.5e-12
    assert found.rows[-1]["tip_uz"] == pytest.approx(-F * (1 + 1 / 3) / E_I, rel=1e-3)
    assert found.rows[-1]["tip_ux"] == pytest.approx(F / (2 * E_I), rel=1e-3)


@pytest.mark.slow
def test_indentation() -> None:
    """Mixed reference, 0.3 %; all four points converge."""
    found = result("indentation.yaml", "magnetic.lambda_m=0.00184", "loading.points=4")
    assert found.stopped is None
    for depth, force in {5: 8.2762, 10: 15.1470, 15: 21.603, 20: 27.528}.items():
        assert force_at(found, depth) == pytest.approx(force, rel=3e-3)


@pytest.mark.slow
def test_indentation_against_the_field_stops_at_the_fold_in_displacement() -> None:
    """Mixed reference: 1.7949 and 1.3149 at w/h = 1 and 5, the force peaks at 2.10, w turns back at
    5.9.
    """
    found = result("indentation.yaml", "magnetic.lambda_m=-0.00184", "mesh.refinement=0.75")
    assert force_at(found, 1) == pytest.approx(1.7949, rel=3e-3)
    assert force_at(found, 5) == pytest.approx(1.3149, rel=3e-3)
    assert [(p["amplitude"], p["kind"]) for p in found.limit_points] == [("force", "fold")]
    assert found.limit_points[0]["value"] == pytest.approx(2.10, abs=0.01)
    assert found.stopped
    assert "the path turns back in the controlled displacement" in found.stopped
    assert found.rows[-1]["w_over_h"] == pytest.approx(5.9, abs=0.1)


@pytest.mark.parametrize(
    ("polar", "shortening", "deflection"),
    [(0.0, 0.32894, 0.66996), (-60.0, 0.67087, 0.80901)],
)
def test_magnetic_strip(polar: float, shortening: float, deflection: float) -> None:
    """Hard-magnetic elastica, q = 12 lambda_m (L/h)^2 = 4, field at 90 and 150 degrees to the axis.

    The inextensible rod's boundary value problem, five digits; the strip also stretches by
    O(lambda_m) = 3e-5, a tenth of the tolerance.
    """
    found = result("magnetic_strip.yaml", f"magnetic.applied.polar={polar}")
    model, u = found.scene.model, found.last.u
    moved = model.displacement(u, "pole")
    assert -moved[0] == pytest.approx(shortening, abs=1e-3 * shortening)
    assert moved[2] == pytest.approx(deflection, abs=1e-3 * deflection)


def test_gripper() -> None:
    """Each arm is the same elastica on the hub's edge, from a mesh file in mm; stretching is
    O(lambda_m) = 4e-4.
    """
    row = result("gripper.yaml").rows[-1]
    assert row["label"] == "target"
    assert -row["tip_ux"] / 3e-3 == pytest.approx(0.32894, rel=1.5e-3)
    assert row["tip_uz"] / 3e-3 == pytest.approx(0.66996, rel=1.5e-3)


@pytest.mark.slow
def test_turning_field_ends_where_the_tilted_one_does() -> None:
    """Turning the field from 150 to 90 degrees, and applying it at 90, give the same strip."""
    turning = "loading={kind: rotation, to: {polar: 0}, points: 4}"
    found = result("magnetic_strip.yaml", "magnetic.applied.polar=-60", turning)
    straight = result("magnetic_strip.yaml", "magnetic.applied.polar=0.0")
    row = found.rows[-1]
    assert (row["label"], row["amplitude"]) == ("target", "angle")
    assert row["field_angle"] == pytest.approx(60.0)
    assert row["lambda_m"] == pytest.approx(found.scene.problem.lambda_m)
    for key in ("w_pole_over_h", "magnetic", "bending"):
        assert row[key] == pytest.approx(straight.rows[-1][key], rel=1e-7)


def test_strip_against_its_field_buckles() -> None:
    """Field antiparallel to the magnetisation: straight until q = pi^2/4, there a bifurcation
    (elastica).
    """
    found = result(
        "magnetic_strip.yaml", "magnetic.applied.polar=-90.0", "loading={kind: field, until: limit}"
    )
    (limit,) = found.limit_points
    assert limit["kind"] == "bifurcation"
    assert 12 * limit["value"] * 100**2 == pytest.approx(np.pi**2 / 4, rel=1e-4)


@pytest.mark.slow
def test_solid_buckling() -> None:
    """The axisymmetric shell's k_d. The solid's is above it.

    That is 0.8 % (docs/solid), and 0.4 % of mesh.
    """
    found = result("solid_buckling.yaml", "magnetic.lambda_m=0.00184", "mesh.refinement=0.5")
    assert found.knockdown is not None
    assert 0.005 < found.knockdown / 0.552053778 - 1 < 0.018
    assert [(point["kind"], point["mode"]) for point in found.limit_points] == [("fold", "")]


@pytest.mark.slow
def test_solid_indentation() -> None:
    """The shell under the same patch: the field alone moves the body's middle elsewhere
    (docs/solid), 5 % of F here.
    """
    settings = ["loading.depth=2", "loading.points=2", "mesh.refinement=0.5"]
    solid, shell = (
        result("solid_indentation.yaml", *settings, f"model={model}")
        for model in ("solid", "shell")
    )
    for depth in (1.0, 2.0):
        assert force_at(solid, depth) == pytest.approx(force_at(shell, depth), rel=0.05)


def test_magnetic_strip_as_a_solid() -> None:
    """The same elastica as of `test_magnetic_strip`; nu = 0, so that the strip bends like a rod."""
    found = result("magnetic_strip.yaml", "magnetic.applied.polar=0.0", "model=solid")
    moved = found.scene.model.displacement(found.last.u, "pole")
    assert -moved[0] == pytest.approx(0.32894, rel=1e-3)
    assert moved[2] == pytest.approx(0.66996, rel=1e-3)


@pytest.mark.slow
def test_figure_of_coplanar_fields() -> None:
    """figures/coplanar.yaml at angle zero: axisymmetric reference, on the figures' coarse mesh."""
    assert result("figures/coplanar.yaml").knockdown == pytest.approx(0.552053778, rel=3e-4)


@pytest.mark.slow
def test_figure_of_non_coplanar_fields() -> None:
    """figures/noncoplanar.yaml at azimuth zero has parallel fields: the half shell of the default
    mesh, 0.4915468.
    """
    assert result("figures/noncoplanar.yaml").knockdown == pytest.approx(0.4915468, rel=5e-4)


@pytest.mark.slow
def test_figure_of_indentation() -> None:
    """figures/indentation.yaml: mixed reference at w/h = 5."""
    found = result("figures/indentation.yaml", "loading.depth=5", "loading.points=5")
    assert force_at(found, 5) == pytest.approx(8.2762, rel=3e-3)


@pytest.mark.slow
def test_natural_strip() -> None:
    """A natural curvature of 2 pi/L closes a strip to a circle; a quarter of it lifts the tip by 2
    L/pi, to 1e-6.
    """
    rows = [row for row in result("natural_strip.yaml").rows if row["label"] == "target"]
    w = [float(row["w_pole_over_h"]) for row in rows]
    assert w == pytest.approx(
        [-200 / np.pi, -200 / np.pi, -200 / (3 * np.pi), 0], rel=1e-6, abs=1e-5
    )
    assert [float(row["natural_curvature"]) for row in rows] == [0.25, 0.5, 0.75, 1.0]
    assert abs(float(rows[-1]["energy"])) < 1e-12
