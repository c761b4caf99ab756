"""Designs: what is reached, kept, said and resumed; SciPy's optimisers are trusted, gradients
tested elsewhere.
"""

import csv
import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import scipy
from command import magshell
from conftest import CAP, CASES, draw_nothing
from interrupted import kill, start, wait_until
from many import design, variables
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import read_source
from magshell_fenicsx.input.tables import read_vectors
from magshell_fenicsx.models.shell.control_points import ControlPoints
from magshell_fenicsx.public import run
from magshell_fenicsx.simulate.scene_cache import SceneCache
from magshell_fenicsx.studies.design.evaluation import DesignEvaluation, evaluate
from magshell_fenicsx.studies.design.variables import controls_of

Array = NDArray[np.float64]
STRIP = """
shell: {geometry: strip, radius_to_thickness: 100, width: 0.1, poisson_ratio: 0.2}
boundary: {root: clamped}
points: {tip: [1, 0, 0]}
magnetic: {lambda_m: 1.0e-4, remanent: {polar: 90}, applied: {polar: 0}}
mesh: {degree: 2}
symmetry: none
"""
TURN = "design: {objective: {reach: tip_uz, value: 0.5}, remanence: {points: 5}, iterations: 6}\n"


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    draw_nothing(monkeypatch)


@pytest.fixture
def strip(tmp_path: Path) -> Callable[[str], Path]:
    def write(section: str) -> Path:
        (tmp_path / "strip.yaml").write_text(STRIP + section)
        return tmp_path / "strip.yaml"

    return write


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "design.csv").open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.parametrize(("settings", "most"), [([], 401), (["magnetic.remanent.polar=45"], 1681)])
def test_more_points_than_places(settings: list[str], most: int) -> None:
    """The meridian and the surface have so many places; each is one control point, with a vector,
    at a distance from the next.
    """
    case = Case.load(CASES / "dimple_buckling.yaml", ["magnetic.lambda_m=0.00184", *settings])
    controls, vectors = controls_of(case, 2000, None, "design.remanence")
    assert len(controls.places) == len(vectors) == most
    assert controls.width > 0


@pytest.mark.slow
def test_reach_interrupt_and_resume(
    strip: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An interrupted design ends as one that was not; its best case runs as it is, to the same
    number.
    """
    case, room = strip(TURN), import_module("magshell_fenicsx.studies.design.search")
    evaluate, count = room.evaluate, [0]

    def stopping(*arguments: object) -> object:
        count[0] += 1
        if count[0] == 3:
            raise KeyboardInterrupt
        return evaluate(*arguments)

    monkeypatch.setattr(room, "evaluate", stopping)
    with pytest.raises(KeyboardInterrupt):
        design(case, out=tmp_path / "out")
    assert len(rows(tmp_path / "out")) == 2
    design(case, out=tmp_path / "out", resume=True)
    computed = count[0]
    whole = rows(tmp_path / "out")
    assert computed == len(whole) + 1  # the interrupted one twice, no other
    content = design(case, out=tmp_path / "out")
    assert count[0] == computed
    assert rows(tmp_path / "out") == whole
    assert content["best"]["tip_uz"] == pytest.approx(0.5, rel=1e-3)
    best = run(Case.load(tmp_path / "out/best.yaml"))
    assert best.rows[-1]["tip_uz"] == pytest.approx(content["best"]["tip_uz"], rel=1e-9)
    vectors = read_vectors(tmp_path / "out/best.csv", "")[1]
    assert np.linalg.norm(vectors, axis=1) == pytest.approx(1)
    assert content["verified"]["tip_uz"] == pytest.approx(content["best"]["tip_uz"], rel=1e-2)


@pytest.mark.slow
def test_numbers_between_bounds_and_a_constraint(
    strip: Callable[[str], Path], tmp_path: Path
) -> None:
    """The deflection is largest at the bound of the field that a constraint on the shortening
    gives.
    """
    kept = "[{of: tip_ux, least: -0.2}]"
    varied = "{magnetic.lambda_m: [1.0e-5, 2.0e-4]}"
    section = (
        f"{{objective: {{maximise: tip_uz}}, numbers: {varied}, constraints: {kept}, "
        "iterations: 8}"
    )
    content = design(strip(f"design: {section}\n"), out=tmp_path / "out")
    assert content["best"]["tip_ux"] == pytest.approx(-0.2, rel=1e-3)
    assert 1e-5 < content["numbers"]["magnetic.lambda_m"] < 2e-4


def test_fields_between_bounds(strip: Callable[[str], Path], tmp_path: Path) -> None:
    """The deflection and the mass by a random change of thickness and curvature, against
    differences.
    """
    varied = "thickness: {points: 4, values: [0.5, 2]}, curvature: {points: 3, values: [-1, 1]}"
    source = read_source(strip(f"design: {{objective: {{maximise: tip_uz}}, {varied}}}\n"))
    case = Case.from_source(source)
    assert case.design
    vary, standing = variables(source, case, case.design), SceneCache(overwrites=True)
    x, way = vary.start_values, np.random.default_rng(0).standard_normal(len(vary.start_values))

    def at(c: float) -> DesignEvaluation:
        there = vary.case_of(x + c * way, tmp_path / "B.csv")
        return evaluate(there, x, vary, ["tip_uz", "mass"], {}, standing)

    here, (further, back) = at(0.0), (at(1e-3), at(-1e-3))
    assert here.values["mass"] == pytest.approx(1, rel=1e-12)
    for result in ("tip_uz", "mass"):
        expected = (further.values[result] - back.values[result]) / 2e-3
        assert np.array(here.gradients[result]) @ way == pytest.approx(expected, rel=1e-5)


def test_a_variable_without_influence(strip: Callable[[str], Path], tmp_path: Path) -> None:
    """The azimuth of a field along e3."""
    section = "{objective: {maximise: tip_uz}, numbers: {magnetic.applied.azimuth: [-10, 10]}}"
    done = magshell("design", strip(f"design: {section}\n"), "--out", tmp_path / "out")
    assert done.returncode == 3
    assert "warning: magnetic.applied.azimuth has no influence on tip_uz" in done.stdout
    assert "no variable has an influence on tip_uz" in done.stderr


IN_UNITS = (
    CAP
    + """symmetry: axisymmetric
design:
  objective: {reach: buckling_pressure_Pa, value: 250}
  numbers: {magnetic.applied.flux_density: [-20 mT, 0.02 T]}
  iterations: 5
  verify: 1
"""
)


def test_bounds_and_results_in_units(tmp_path: Path) -> None:
    """A field in tesla for a load in pascals. The best case, run as written, buckles there."""
    (tmp_path / "cap.yaml").write_text(IN_UNITS, encoding="utf-8")
    content = design(tmp_path / "cap.yaml", out=tmp_path / "out")
    assert content["verified"]["buckling_pressure_Pa"] == pytest.approx(250, rel=1e-3)
    (found,) = content["numbers"].items()
    assert found[0] == "magnetic.applied.flux_density [mT]"
    best = Case.load(tmp_path / "out/best.yaml")
    assert best.magnetic
    assert best.magnetic.applied.flux_density == pytest.approx(1e-3 * found[1], rel=1e-12)
    bare = "--set=design.numbers={magnetic.applied.flux_density: [-20, 20]}"
    checked = magshell("check", tmp_path / "cap.yaml", bare)
    assert (
        "design.numbers: magnetic.applied.flux_density: the case gives 10 mT: its bounds need"
        in checked.stderr
    )


@pytest.mark.slow
def test_a_target_out_of_reach(strip: Callable[[str], Path], tmp_path: Path) -> None:
    section = (
        "{objective: {reach: tip_uz, value: 0.99}, "
        "numbers: {magnetic.lambda_m: [5.0e-5, 2.0e-4]}, iterations: 4}"
    )
    done = magshell("design", strip(f"design: {section}\n"), "--out", tmp_path / "out")
    assert done.returncode == 3
    assert "tip_uz = 0.99 is not reached within the bounds: the nearest found is" in done.stderr
    assert (tmp_path / "out/best.yaml").exists()
    content = json.loads((tmp_path / "out/summary.json").read_text())
    assert content["numbers"]["magnetic.lambda_m"] == pytest.approx(2e-4)


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ("", "design: is missing: it says what varies and what is wanted"),
        (
            "design: {objective: {minimise: tip_ux}}",
            "needs numbers, remanence, thickness, curvature or deviation: otherwise nothing varies",
        ),
        (
            "design: {objective: {}, remanence: {}}",
            "give one of maximise, minimise, reach and shape, here none",
        ),
        ("design: {objective: {reach: tip_ux}, remanence: {}}", "reach and value belong together"),
        ("design: {objective: {shape: {}}, remanence: {}}", "give components or curve"),
        (
            "design: {objective: {maximise: tip_ux}, constraints: [{of: tip_uz}], remanence: {}}",
            "of: tip_uz: give least",
        ),
        (
            "design: {objective: {maximise: hertz_1}, remanence: {points: 3}}",
            "hertz_1: needs shell.density",
        ),
        (
            "design: {objective: {minimise: barrier}, remanence: {points: 3}}",
            "barrier: needs a last step with until: zero",
        ),
        (
            "design: {objective: {minimise: tip_ux}, remanence: {}}",
            "design.remanence: give points, or",
        ),
        (
            "design: {objective: {minimise: tip_ux}, numbers: {magnetic.lambda_m: [1, 2]}}",
            "design.numbers: magnetic.lambda_m: the case starts at 0.0001, beyond 1 to 2",
        ),
        (
            "design: {objective: {minimise: tip_ux}, numbers: {magnetic.lambda_m: [1 mT, 2 mT]}}",
            (
                "design.numbers: magnetic.lambda_m: is a number without a unit in the case: "
                "so are its bounds"
            ),
        ),
        (
            "design: {objective: {minimise: tip_ux}, numbers: {magnetic.lambda_m: [1 mT, 2]}}",
            "design: numbers: magnetic.lambda_m: 2 has no unit: give both bounds one",
        ),
        (
            "design: {objective: {minimise: tip_ux}, numbers: {magnetic.lambd: [1, 2]}}",
            "design.numbers: magnetic.lambd: the case has no such key (lambd)",
        ),
        (
            (
                "design: {objective: {minimise: tip_ux}, "
                "remanence: {points: 3, magnitude: [0.1, 0.5]}}"
            ),
            "design.remanence.magnitude: the vectors start with lengths 1 to 1, beyond 0.1 to 0.5",
        ),
        (
            (
                "design: {objective: {shape: {curve: [[1, 0, 0], [2, 0, 0], [3, 0, 0]]}}, "
                "remanence: {points: 3}}"
            ),
            "design.objective.shape.curve: begins at",
        ),
        (
            "design: {objective: {minimise: sideways}, remanence: {points: 3}}",
            "design.objective.minimise: sideways: has no gradient here; allowed",
        ),
        (
            "design: {objective: {maximise: [tip_uz, sideways]}, remanence: {points: 3}}",
            (
                "strip.yaml:8: design.objective.maximise: sideways: has no gradient here; "
                "allowed are knockdown, "
            ),
        ),
        (
            (
                "design: {objective: {maximise: tip_uz}, remanence: {points: 3}, "
                "constraints: [{of: mass, same_as: side}]}"
            ),
            "design.constraints.0.same_as: side: has no gradient here; allowed",
        ),
    ],
)
def test_mistakes(strip: Callable[[str], Path], tmp_path: Path, section: str, message: str) -> None:
    done = magshell("design", strip(f"{section}\n"), "--out", tmp_path / "out")
    assert done.returncode == 2
    assert message in done.stderr


@pytest.mark.slow
def test_strip_that_becomes_half_a_circle(tmp_path: Path) -> None:
    """Within 1 % of the strip's length everywhere, on a finer mesh too."""
    coarse = ["mesh.degree=2", "symmetry=none", "design.iterations=13"]
    content = design(CASES / "designed_strip.yaml", coarse, tmp_path)
    assert content["best"]["largest_distance"] < 0.01
    assert content["verified"]["largest_distance"] < 0.01


@pytest.mark.slow
def test_a_mesh_from_a_file_is_said(tmp_path: Path) -> None:
    wanted = (
        "design={objective: {maximise: tip_uz}, numbers: {shell.poisson_ratio: [0, 0.3]}, "
        "iterations: 1}"
    )
    done = magshell("design", CASES / "bracket.yaml", "--set", wanted, "--out", tmp_path)
    assert "verified (on the mesh of the file): tip_uz = -0.0001" in done.stdout


@pytest.mark.slow
def test_hemisphere_that_buckles_late(tmp_path: Path) -> None:
    """1.3 times the knockdown factor of the uniform remanence of the same magnitude; waves are
    looked at too.
    """
    content = design(
        CASES / "designed_hemisphere.yaml", ["design.iterations=4", "design.verify=2"], tmp_path
    )
    assert content["start"]["knockdown"] == pytest.approx(0.447276, rel=1e-5)
    assert content["best"]["knockdown"] > 1.3 * content["start"]["knockdown"]
    assert content["verified"]["knockdown"] == pytest.approx(content["best"]["knockdown"], rel=5e-4)


@pytest.mark.slow
def test_thickness_for_the_highest_load_at_equal_mass(tmp_path: Path) -> None:
    """1.5 times the even shell's knockdown factor, at its mass. The finer mesh has the same."""
    content = design(CASES / "designed_thickness.yaml", ["design.iterations=4"], tmp_path)
    assert content["start"]["knockdown"] == pytest.approx(0.326233305, rel=1e-6)
    assert content["best"]["knockdown"] > 1.5 * content["start"]["knockdown"]
    assert content["best"]["mass"] == pytest.approx(1, rel=1e-6)
    assert content["verified"]["knockdown"] == pytest.approx(content["best"]["knockdown"], rel=5e-4)


@pytest.mark.slow
def test_equal_forces_of_four_tips(tmp_path: Path) -> None:
    """Arms that are magnetised inwards, by symmetry, press with 5.1 uN each in the part of the
    field along e3.
    """
    content = design(CASES / "designed_gripper.yaml", ["design.iterations=40"], tmp_path)
    tips = np.array(
        [content["best"][f"{arm}_tip_fz"] for arm in ("east", "north", "west", "south")]
    )
    assert content["start"]["east_tip_fz"] == pytest.approx(
        -content["start"]["west_tip_fz"], rel=1e-5
    )
    assert np.ptp(tips) < 2.1e-3 * tips.max()  # each within 1e-3 of the west one's
    assert tips.min() > 4.9e-6
    radial = "{kind: expression, components: [-x/sqrt(x**2 + y**2), -y/sqrt(x**2 + y**2), 0]}"
    inwards = run(Case.load(CASES / "designed_gripper.yaml", [f"magnetic.remanent={radial}"])).rows[
        -1
    ]
    assert tips.mean() == pytest.approx(float(inwards["north_tip_fz"]), rel=0.03)


@pytest.mark.slow
def test_shape_for_the_highest_frequency(tmp_path: Path) -> None:
    """A clamped disc, omega = 10.2158 sqrt(D/(rho h))/R^2 (Leissa, 1969) where it is flat, as a
    designed dome.
    """
    file = CASES / "designed_shape.yaml"
    vary = variables(source := read_source(file), case := Case.from_source(source), case.design)  # type: ignore[arg-type]
    way, B = np.random.default_rng(0).random(len(vary.start_values)), tmp_path / "B.csv"
    back, here, further = (
        evaluate(vary.case_of(x, B), x, vary, ["omega2_1"], {}, SceneCache(overwrites=True))
        for x in (vary.start_values + c * way for c in (0.01, 0.02, 0.03))
    )
    slope = (further.values["omega2_1"] - back.values["omega2_1"]) / 0.02
    assert np.array(here.gradients["omega2_1"]) @ way == pytest.approx(
        slope, rel=3e-4
    )  # 1e-4 of the difference
    content = design(file, ["design.iterations=4"], tmp_path / "out")
    flat = 10.2158**2 * 1e-4 / (12 * (1 - 0.3**2))
    assert content["start"]["omega2_1"] == pytest.approx(flat, rel=0.05)  # the dome of 0.2 h
    assert content["best"]["omega2_1"] > 5 * flat
    assert content["verified"]["omega2_1"] == pytest.approx(content["best"]["omega2_1"], rel=1e-5)


@pytest.mark.slow
def test_a_given_load_of_a_design_that_is_killed(tmp_path: Path) -> None:
    """The field with which a shell buckles at a given pressure; killed and resumed, a design walks
    the same way.
    """
    file, out = CASES / "designed_field.yaml", tmp_path / "out"
    content = design(file, ["design.verify=1"], tmp_path / "whole")
    assert content["best"]["knockdown"] == pytest.approx(0.4, rel=1e-4)
    strength = content["numbers"]["magnetic.lambda_m"]
    other = run(
        Case.load(
            CASES / "dimple_buckling.yaml", [f"magnetic.lambda_m={strength}", "mesh.degree=3"]
        )
    )
    assert other.knockdown == pytest.approx(0.4, rel=1e-3)
    killed = start("design", file, "--out", out, "--set=design.verify=1")
    wait_until(lambda: len([*out.glob("points/*.json")]) > 1 or killed.poll() is not None)
    kill(killed, 0)
    known = len([*out.glob("points/*.json")])
    assert 1 < known < len(rows(tmp_path / "whole"))
    assert (
        magshell("design", file, "--out", out, "--set=design.verify=1", "--resume").returncode == 0
    )
    for row, whole in zip(rows(out), rows(tmp_path / "whole"), strict=True):
        assert float(row["knockdown"]) == pytest.approx(float(whole["knockdown"]), rel=1e-12)


@pytest.mark.slow
def test_letter_and_its_elastica(tmp_path: Path) -> None:
    """The letter U to 1 % of the length; the elastica with the remanence that was found has the
    same tip.
    """
    coarse = [
        "mesh.degree=2",
        "symmetry=none",
        "design.iterations=16",
        "design.remanence={points: 16}",
    ]
    content = design(CASES / "designed_letter.yaml", coarse, tmp_path)
    assert content["best"]["largest_distance"] < 0.01
    assert content["verified"]["largest_distance"] < 0.01
    places, vectors = read_vectors(tmp_path / "best.csv", "")
    found = ControlPoints(places, 1 / 15)
    q, s = 12 * 1e-3 * 100**2, np.linspace(0, 1, 201)

    def slopes(s: Array, y: Array) -> Array:
        theta = y[0]
        bx, _, bz = (found.weights(np.column_stack([s, 0 * s, 0 * s])) @ vectors).T
        return np.stack(
            [y[1], -q * (bx * np.cos(theta) - bz * np.sin(theta)), np.cos(theta), np.sin(theta)]
        )

    def ends(root: Array, tip: Array) -> Array:
        return np.array([root[0], tip[1], root[2], root[3]])

    letter = np.clip((s - 0.3) / 0.4, 0, 1) * np.pi
    guess = np.stack([letter, np.gradient(letter, s), s * 0.5, s * 0.25])
    solved = scipy.integrate.solve_bvp(slopes, ends, s, guess, tol=1e-6, max_nodes=20_000)
    assert solved.success
    finer = run(Case.load(tmp_path / "best.yaml", ["mesh.degree=3", "points={tip: [1, 0, 0]}"]))
    tip = np.array([1 + finer.rows[-1]["tip_ux"], finer.rows[-1]["tip_uz"]])
    np.testing.assert_allclose(solved.y[2:, -1], tip, rtol=0, atol=1e-4)


@pytest.mark.slow
def test_remanence_for_a_sensor_that_reads_most(
    strip: Callable[[str], Path], tmp_path: Path
) -> None:
    """Far away the strip is a dipole m, e .

    B = m . (3 (x . e) x - e)/(4 pi r^3): most along that vector; to 1e-3.
    """
    x, turned = (
        np.array([30.0, 0.0, 20.0]),
        "design: {objective: {maximise: hall_Bz}, remanence: {points: 2}}\n",
    )
    text = (
        "sensors: {hall: {position: [30.5, 0, 20]}}\n"
        "loading: {kind: pressure, control: load, until: target"
    )
    file = strip(f"{text}, pressure: 1.0e-9, points: 1}}\n{turned}")
    file.write_text(
        file.read_text().replace(
            "{lambda_m: 1.0e-4, remanent: {polar: 90}, applied: {polar: 0}}",
            "{remanent: {polar: 90, flux_density: 1 T}}",
        )
    )
    content = design(file, ["design.iterations=20"], tmp_path / "out")
    r, e = np.linalg.norm(x), np.array([0.0, 0.0, 1.0])
    way, volume = (3 * (x @ e) * x / r**2 - e) / (4 * np.pi * r**3), 0.1 * 0.01
    assert content["start"]["hall_Bz"] == pytest.approx(way[0] * volume, rel=2e-3)
    assert content["best"]["hall_Bz"] == pytest.approx(np.linalg.norm(way) * volume, rel=1e-3)


@pytest.mark.slow
def test_remanences_of_two_strips(tmp_path: Path) -> None:
    """What pulls a strip down to another lifts it, by remanences found with the gradient of the
    interaction.
    """
    content = design(CASES / "designed_neighbour.yaml", ["design.iterations=4"], tmp_path)
    assert content["start"]["tip_uz_mm"] == pytest.approx(-0.575, abs=1e-3)
    assert content["best"]["tip_uz_mm"] > 0.1
    assert content["verified"]["tip_uz_mm"] == pytest.approx(content["best"]["tip_uz_mm"], rel=1e-6)
