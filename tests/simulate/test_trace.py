"""Paths in any amplitude, one's own among them, and what is shown of them."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas
import pytest
import ufl
from command import mpirun, read_path
from conftest import CASES
from scipy.special import bei, beip, ber, berp

import magshell_fenicsx as ms
from magshell_fenicsx.continuation.path import Control
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.output.store.table import COLUMNS

HALF = ["symmetry=half", "mesh.degree=3", "mesh.refinement=0.4"]


def winkler(r0: ms.Jet, u: ms.Jet) -> ufl.core.expr.Expr:
    return ufl.dot(u.r, ms.kinematics.normal(r0)) ** 2 / 2


def on_foundation(*settings: str, file: str = "dimple_buckling.yaml") -> ms.Scene:
    return ms.Scene(ms.Case.load(CASES / file, settings), terms=[ms.OwnTerm("foundation", winkler)])


def with_stiffness(scene: ms.Scene, k: float) -> State:
    rest = scene.unloaded()
    return rest.with_(rest.u, "foundation", k)


@pytest.mark.parametrize("symmetry", ["auto", "half"])
def test_plate_on_a_foundation(symmetry: str) -> None:
    """D w'''' + k w = q: w = q/k + A ber(x) + B bei(x), x = r (k/D)^(1/4), clamped at r = 1
    (Timoshenko).
    """
    scene = on_foundation(f"symmetry={symmetry}", "mesh.degree=4", file="clamped_plate.yaml")
    h, nu, k, load = 1 / 50, 0.3, 1e-3, 1e-5
    D, q = h**2 / (12 * (1 - nu**2)), load * scene.problem.material.classical_pressure / h
    edge = (k / D) ** 0.25
    A = np.linalg.solve([[ber(edge), bei(edge)], [berp(edge), beip(edge)]], [-q / k, 0])[0]
    *_, point = ms.trace(
        scene, "pressure", with_stiffness(scene, k), control="load", targets=[load]
    )
    found = scene.observe(point.point.state)["w_pole_over_h"] * h
    assert found == pytest.approx(q / k + A, rel=2e-5)  # ber(0) = 1, bei(0) = 0
    assert abs(A) > 0.1 * q / k, "the foundation carries all of the load: nothing is tested"


def test_every_control_finds_the_same_point() -> None:
    """A foundation under a shell that has pressure already; conjugate displacements as of the
    load-controlled point.
    """
    scene, k = on_foundation(), 0.02
    *_, pressed = ms.trace(scene, "pressure", targets=[0.2])
    *_, reference = ms.trace(scene, "foundation", pressed, control="load", targets=[k])
    conjugate = -scene.model.system.potential(reference.point.state.u, {}, "foundation")
    ways: list[tuple[Control, float, str]] = [("arc", k, "load"), ("conjugate", conjugate, "load")]
    for control, target, quantity in ways:
        records = list(
            ms.trace(
                scene, "foundation", pressed, control=control, targets=[target], quantity=quantity
            )
        )
        assert records[-1].label == "target"
        assert records[-1].point.state.mu["foundation"] == pytest.approx(k, rel=1e-6)
        difference = records[-1].point.state.u - reference.point.state.u
        assert np.abs(difference).max() < 1e-7 * scene.problem.material.h


@pytest.mark.parametrize(
    "settings",
    [pytest.param([], id="meridian"), pytest.param(HALF, id="half", marks=pytest.mark.slow)],
)
def test_sensitivity_to_ones_own_term(settings: list[str]) -> None:
    """From the null vector against differences of folds that are found for themselves."""
    scene, k, step = on_foundation(*settings, "magnetic.lambda_m=0.001"), 0.02, 0.002

    def fold(stiffness: float) -> ms.Record:
        *_, field = ms.trace(scene, "lambda_m", with_stiffness(scene, stiffness), targets=[0.001])
        *_, last = ms.trace(scene, "pressure", field, first=0.1)
        return last

    folds = {d: ms.fold_at(scene, fold(k + d)).value for d in (-2 * step, -step, step, 2 * step)}
    expected = (8 * (folds[step] - folds[-step]) - (folds[2 * step] - folds[-2 * step])) / (
        12 * step
    )
    found = ms.sensitivities(scene, ms.fold_at(scene, fold(k)))
    assert found["foundation"] == pytest.approx(expected, rel=1e-5)
    assert {"lambda_m", "defect.amplitude", "remanence dimple"} < set(found)


def test_trace_is_the_history_of_the_case() -> None:
    """The fold that `follow` finds by volume control, by arc length."""
    case = ms.Case.load(CASES / "dimple_buckling.yaml")
    *_, last = ms.follow(ms.Scene(case))
    *_, traced = ms.trace(ms.Scene(case), "pressure", first=0.1)
    assert traced.label == last.label == "fold"
    assert traced.point.state.mu["pressure"] == pytest.approx(
        last.point.state.mu["pressure"], rel=1e-7
    )


def test_path_through_the_fold() -> None:
    """So many steps by arc length; the fold is on the way and the pressure falls after it."""
    scene = ms.Scene(ms.Case.load(CASES / "dimple_buckling.yaml"))
    records = list(ms.trace(scene, "pressure", first=0.1, until="points", steps=9))
    table = ms.columns(scene, [record for record in records if not record.mode])
    fold = list(table["label"]).index("fold")
    assert sum(table["label"] == "step") == 9
    assert fold < len(table["label"]) - 1
    assert (np.diff(table["p_over_pc"][fold:]) < 0).all()
    assert table["negative_pivots"][0] == 0
    assert table["negative_pivots"][-1] == 1


@pytest.mark.parametrize(
    ("name", "asked", "said"),
    [
        ("force", {"first": 1.0}, "no such amplitude, only foundation, pressure"),
        ("pressure", {}, "give first"),
        ("pressure", {"until": "target"}, "needs targets"),
        ("pressure", {"quantity": "conjugate", "targets": [1e-3]}, "give first"),
    ],
)
def test_what_trace_refuses(name: str, asked: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        list(ms.trace(on_foundation(), name, **asked))  # type: ignore[arg-type]


def test_foundation_at_rest_has_no_conjugate_to_follow() -> None:
    """Where nothing is displaced, its stiffness moves nothing."""
    with pytest.raises(ms.Stopped, match="moves nothing"):
        list(ms.trace(on_foundation(), "foundation", control="conjugate", first=0.01))


def test_only_a_fold_is_one() -> None:
    scene = on_foundation()
    *_, last = ms.trace(scene, "pressure", targets=[0.1])
    with pytest.raises(ValueError, match="no fold, but a target"):
        ms.fold_at(scene, last)


def test_columns_are_those_of_the_table(tmp_path: Path, no_pictures: None) -> None:
    """Names, order and values of path.csv; but for the time."""
    case = ms.Case.load(CASES / "pole_indentation.yaml", ["mesh.degree=3"])
    ms.run(case, tmp_path)
    scene = ms.Scene(case)
    found, written = ms.columns(scene, ms.follow(scene)), read_path(tmp_path)
    assert (
        list(found)
        == [name for name in COLUMNS if name != "wall_s"]
        == [n for n in written[0] if n != "wall_s"]
    )
    for name, values in found.items():
        assert values.shape == (len(written),)
        assert [str(value) for value in values.tolist()] == [row[name] for row in written], name
    frame = pandas.read_csv(
        tmp_path / "path.csv", float_precision="round_trip", keep_default_na=False
    )
    pandas.testing.assert_frame_equal(
        pandas.DataFrame(found), frame.drop(columns="wall_s"), check_exact=True
    )


def test_surface_is_the_deformed_shell() -> None:
    """A half is completed; the volume changes as the model integrates it."""
    scene = ms.Scene(
        ms.Case.load(CASES / "pole_indentation.yaml", ["symmetry=half", "mesh.degree=3"])
    )
    *_, last = ms.follow(scene)
    surface, triangles = ms.surface(scene, last), ms.polydata(scene, last)
    assert surface
    assert triangles
    assert surface.r0[:, 1].min() == pytest.approx(-1, abs=1e-2)
    assert surface.w.max() / scene.problem.material.h == pytest.approx(6, rel=1e-6)
    faces = triangles.regular_faces
    cones = [
        np.abs(np.linalg.det(points.astype(float)[faces])) / 6
        for points in (triangles.points, triangles["r0"])
    ]  # to the centre
    assert cones[1].sum() == pytest.approx(2 * np.pi / 3, rel=1e-3)
    change = scene.observe(last.point.state)["volume_change"]
    assert cones[0].sum() - cones[1].sum() == pytest.approx(change, rel=1e-2)


RANKS = """
import json, ufl
from mpi4py import MPI
import magshell_fenicsx as ms
case = ms.Case.load("{file}", ["mesh.degree=2", "mesh.refinement=0.3"])
terms = [
    ms.OwnTerm("foundation", lambda r0, u: ufl.dot(u.r, ms.kinematics.normal(r0)) ** 2 / 2),
    ms.OwnTerm("weight", lambda r0, u, g: ufl.dot(g, u.r), ([0.0, 0.6, 0.8],)),
]
scene = ms.Scene(case, terms=terms)
rest = scene.unloaded()
*_, heavy = ms.trace(scene, "weight", rest.with_(rest.u, "foundation", 0.02), targets=[1e-5])
*_, last = ms.trace(scene, "pressure", heavy, first=0.1)
found = ms.sensitivities(scene, ms.fold_at(scene, last))
surface = ms.surface(scene, last)
if MPI.COMM_WORLD.rank == 0:
    print(json.dumps([last.label, last.point.state.mu, found, float(abs(surface.w).max())]))
"""


@pytest.mark.slow
def test_same_on_ranks() -> None:
    """A term without symmetry, on one rank and on two: the fold, the sensitivities and what is
    shown.
    """
    found = []
    for ranks in (1, 2):
        script = RANKS.format(file=CASES / "dimple_buckling.yaml")
        command = [*mpirun(ranks), sys.executable, "-c", script]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        found.append(json.loads(done.stdout.splitlines()[-1]))
    for label, mu, sensitivities, w in found:
        assert label == found[0][0] == "fold"
        assert mu == pytest.approx(found[0][1], rel=1e-8)
        assert sensitivities == pytest.approx(found[0][2], rel=1e-8)
        assert w == pytest.approx(found[0][3], rel=1e-8)
