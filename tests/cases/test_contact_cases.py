"""Cases with bodies: paths, folds and rings of contact against other models, stiffnesses and the
point force.
"""

import csv
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from command import magshell, read_path
from conftest import CASES

from magshell_fenicsx import Case, Result, Scene
from magshell_fenicsx.public import run
from magshell_fenicsx.simulate.follow import follow

Row = dict[str, float]
LENGTH = 90**-0.5  # sqrt(Rh) over R


@cache
def rows(file: str, *settings: str) -> list[Row]:
    found: Result = run(Case.load(CASES / file, settings))
    assert found.stopped is None
    return [{**row} for row in found.rows]  # type: ignore[dict-item]


def last(file: str, *settings: str) -> Row:
    return rows(file, *settings)[-1]


ONE = ("loading.approach=0.8", "loading.points=1")


@pytest.mark.slow
def test_plate() -> None:
    """Flat up to a fold near 2.55 h, back to one at 2.50 h, then a dimple in a ring with the radius
    of a mirrored cap.

    The plane of the plate cuts the sphere at sqrt(2 R a); a mirrored cap of the depth w has the
    radius sqrt(R w).
    """
    path = rows("plate_contact.yaml", "loading.points=4")
    first, second = (row["approach_over_h"] for row in path if row["label"] == "fold")
    assert 2.5 < second < first < 2.6
    assert second == pytest.approx(2.5, abs=0.01)
    assert max(row["penetration_over_h"] for row in path) < 1e-3
    for row in path:
        flat = abs(row["w_pole_over_h"] - row["approach_over_h"]) < 0.02
        if row["label"] == "target":
            assert flat == (row["approach_over_h"] < 2.5)
            assert row["contact_inner"] <= row["contact_radius"] <= row["contact_outer"]
    end = path[-1]
    assert len(path) < 62  # at most 2.5 times the time of a point force
    assert end["force"] == pytest.approx(13.97, rel=2e-3)
    assert end["contact_radius"] == pytest.approx(np.sqrt(end["w_pole_over_h"]) * LENGTH, rel=0.1)


@pytest.mark.slow
def test_hard_plate() -> None:
    """Without folds, the flat branch goes on, as the shell presses on the plate at its centre too.

    Where it is flat, b = 0 and K = A/R: M = D (1 + nu) A/R is constant, but not the map from the
    sphere's metric A to the plane. With its radius r = theta - (3 nu - 1) theta^3/48 (plane
    stress), the pressure is (1 + nu)^2 D/R^3. A dimple at the same approach needs less force.
    """
    scene = Scene(
        Case.load(CASES / "plate_contact.yaml", ["bodies.plate.stiffness=2e6", "loading.points=1"])
    )
    records = list(follow(scene))
    assert [r.label for r in records if r.label != "step"] == ["start", "target"]
    end = records[-1]
    assert (end.point.negative_pivots, end.excluded_pivots) == (0, 0)
    row, h, nu = scene.observe(end.point.state), scene.problem.material.h, 0.5
    pressure = scene.model.cell_pressures(end.point.state)
    assert pressure is not None
    assert pressure[0] == pytest.approx((1 + nu) ** 2 * h**2 / (12 * (1 - nu**2)), rel=0.02)
    assert row["force"] == pytest.approx(23.626, rel=1e-3)
    assert row["w_pole_over_h"] == pytest.approx(4, abs=1e-3)


@pytest.mark.slow
def test_stiffness() -> None:
    """Over four decades of it the force changes by less than 1e-3. Penetrations: below 1e-3 h."""
    found = [
        last("plate_contact.yaml", *ONE, f"bodies.plate.stiffness={k}") for k in ("2e4", "2e8")
    ]
    assert all(row["penetration_over_h"] < 1e-3 for row in found)
    assert np.ptp([row["force"] for row in found]) < 1e-3 * found[0]["force"]
    assert found[1]["penetration_over_h"] < 0.05 * found[0]["penetration_over_h"]


@pytest.mark.slow
def test_half_and_full_against_meridian() -> None:
    """Triangles with quadrature of their own, 2e-4."""
    steps = "loading={kind: contact, control: approach, approach: 0.3, points: 1}"
    plate = "bodies.plate={kind: plane, stiffness: 2e4, penetration: 0.01}"
    forces = []
    for symmetry in ("axisymmetric", "half", "none"):
        scene = Scene(
            Case.load(CASES / "plate_contact.yaml", [steps, plate, f"symmetry={symmetry}"])
        )
        forces.append(scene.observe(list(follow(scene))[-1].point.state)["force"])
    assert forces == pytest.approx([forces[0]] * 3, rel=2e-4)


def test_stiffer_by_itself() -> None:
    """A plate without a given stiffness penetrates no more than it may, with the same force."""
    few = ("loading.approach=0.4", "loading.points=1", "mesh.refinement=0.5")
    soft, path = (
        last("plate_contact.yaml", *few),
        rows("plate_contact.yaml", *few, "bodies.plate.penetration=2e-4"),
    )
    assert max(row["penetration_over_h"] for row in path) < 2e-4 < soft["penetration_over_h"]
    assert path[-1]["contact_stiffness"] > path[0]["contact_stiffness"]
    assert path[-1]["force"] == pytest.approx(soft["force"], rel=1e-3)


def test_ball_and_rod_against_a_point_force() -> None:
    """At the same displacement of the pole the real indenters need a little more force; both press
    by their units.
    """
    ball, rod = (
        last(name, "loading.points=2") for name in ("ball_contact.yaml", "rod_contact.yaml")
    )
    case = "{kind: indentation, at: {polar: 0}, depth: 4, points: 2}"
    point = last("pole_indentation.yaml", f"loading={case}")
    stiffness = 0.563  # dF/d(w/h) there
    for row, more in ((ball, 1.0036), (rod, 1.0017)):
        force = row["force"] - stiffness * (row["w_pole_over_h"] - 4)
        assert force == pytest.approx(more * point["force"], rel=5e-4)
    assert rod["contact_radius"] == pytest.approx(0.2e-3, rel=0.1)  # in metres, at the rounded edge
    assert ball["contact_outer"] < 0.02


@pytest.mark.slow
def test_egg_between_two_balls() -> None:
    """The body that contains another leaves fewer shapes to the shell: the least energy at an
    approach is higher.

    A ball of its least radius of curvature is within the egg, one of the largest, 0.4^2/0.25,
    around it; both are modelled by their meridian.
    """
    egg = last("egg_contact.yaml", "loading.points=2")
    within, around = (
        last(
            "egg_contact.yaml",
            "loading.points=2",
            f"bodies={{ball: {{kind: sphere, radius: {radius}}}}}",
        )
        for radius in (0.25, 0.4**2 / 0.25)
    )
    assert egg["approach_over_h"] == within["approach_over_h"] == around["approach_over_h"] == 2
    assert 1.02 * within["energy"] < egg["energy"] < around["energy"] / 1.02
    assert within["force"] < egg["force"] < around["force"]


def test_sweep_of_a_body(tmp_path: Path) -> None:
    """The columns of a body are in the curves, and drawn: a blunter ball needs more force."""
    few = ("loading.approach=0.2", "loading.points=1", "mesh.refinement=0.4")
    over = ("--over", "bodies.ball.radius=0.1,0.3")
    done = magshell(
        "sweep", CASES / "ball_contact.yaml", *over, *(f"--set={s}" for s in few), "--out", tmp_path
    )
    assert done.returncode == 0, done.stderr
    with (tmp_path / "curves.csv").open(encoding="utf-8") as file:
        ends = [row for row in csv.DictReader(file) if row["label"] == "target"]
    assert [float(row["approach_over_h"]) for row in ends] == pytest.approx([0.2, 0.2])
    assert float(ends[0]["force"]) < float(ends[1]["force"])
    assert (tmp_path / "sweep.png").exists()


def test_held_while_the_shell_moves() -> None:
    """A ball that comes in a time, with drag, ends with the force of the static path, 1e-3."""
    shell = {
        "geometry": "hemisphere",
        "radius": "30 mm",
        "thickness": "1.5 mm",
        "poisson_ratio": 0.3,
    }
    given = {
        "shell": {**shell, "youngs_modulus": "1 MPa", "density": "1000 kg/m^3"},
        "boundary": {"equator": "clamped"},
        "bodies": {"ball": {"kind": "sphere", "radius": "9 mm"}},
        "mesh": {"refinement": 0.3},
    }
    come = {"kind": "ramp", "to": 0.4, "over": "10 ms"}
    move = {"kind": "time", "duration": "25 ms", "points": 1, "drag": "2000 Hz", "tolerance": 0.01}
    forces = []
    for steps in (
        [{"kind": "contact", "control": "approach", "approach": 0.4, "points": 1}],
        [
            {"kind": "contact", "control": "approach", "approach": 0.3, "points": 1},
            {**move, "history": {"approach": come}},
        ],
    ):
        scene = Scene(Case.model_validate({**given, "loading": steps}))
        forces.append(scene.observe(list(follow(scene))[-1].point.state)["force"])
    assert forces[1] == pytest.approx(forces[0], rel=1e-3)


def test_force_control_and_a_held_force(tmp_path: Path) -> None:
    """A ball with a weight: the approach follows; the weight stays while a pressure acts; then it
    is taken away.
    """
    steps = (
        "[{kind: contact, control: force, force: 1, points: 1},"
        " {kind: pressure, control: load, until: target, pressure: 0.1, points: 1, "
        "hold: {approach: conjugate}},"
        " {kind: contact, approach: -0.1, points: 1}]"
    )
    out = tmp_path / "out"
    done = magshell("run", CASES / "ball_contact.yaml", f"--set=loading={steps}", "--out", out)
    assert done.returncode == 0, done.stderr
    ends = [row for row in read_path(out) if row["label"] == "target"]
    force, approach = ([float(row[key]) for row in ends] for key in ("force", "approach_over_h"))
    assert force == pytest.approx([1, 1, 0], abs=1e-9)
    assert approach[0] == pytest.approx(0.3054, rel=1e-3)
    assert approach[1] > approach[0]
    assert not (out / "contact.png").exists()  # nothing touches at the end


def test_a_force_is_held_while_another_body_comes() -> None:
    """Two weights on a cantilever: that of the first stays when the second one touches."""
    first, second = (
        {"kind": "contact", "body": body, "control": "force", "force": 1e-3, "points": 1}
        for body in ("a", "b")
    )
    ball = {"kind": "sphere", "radius": 0.1, "direction": [0, 0, -1]}
    case = {
        "shell": {"geometry": "strip", "radius_to_thickness": 50, "width": 0.2}
        | {"poisson_ratio": 0},
        "boundary": {"root": "clamped"},
        "bodies": {
            "a": ball | {"position": [0.5, 0, 0.111]},
            "b": ball | {"position": [0.9, 0, 0.15]},
        },
        "mesh": {"degree": 3, "size": 0.15},
        "loading": [first, second | {"hold": {"approach_a": "conjugate"}}],
    }
    row = run(Case.from_source(case)).rows[-1]
    assert (row["force_a"], row["force_b"]) == pytest.approx((1e-3, 1e-3), rel=1e-5)
