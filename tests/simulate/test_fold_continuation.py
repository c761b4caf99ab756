"""Knockdown factors found by following the fold, against paths of their own."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command import magshell, mpirun
from conftest import CASES
from many import sweep

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.fold import Fold, FoldGuess, FoldLost, find_fold
from magshell_fenicsx.public import Scene, run
from magshell_fenicsx.simulate.transfer import _stretch, same_mesh, transfer
from magshell_fenicsx.studies.folds import Continuation
from magshell_fenicsx.studies.outcome import Outcome

DIMPLE, COPLANAR = CASES / "dimple_buckling.yaml", CASES / "figures" / "coplanar.yaml"
COARSE = ["mesh.degree=3", "mesh.refinement=0.4"]
ANGLES = "magnetic.applied.polar"


def outcomes(
    file: Path, over: str, settings: list[str], out: Path, *, full_paths: bool = False
) -> list[Outcome]:
    return sweep(file, [over], settings, out, say=lambda line: None, full_paths=full_paths).outcomes


def test_a_grid_takes_one_path(tmp_path: Path) -> None:
    """Each line begins at the fold of the line before it; nine digits of the axisymmetric reference
    in README.
    """
    over = ["magnetic.lambda_m=-0.00184,0.0005,0.00184", "shell.defect.amplitude=1.64,2"]
    found = sweep(DIMPLE, over, [], tmp_path / "grid", say=lambda line: None).outcomes
    assert [outcome.found for outcome in found] == ["path"] + 5 * ["fold"]
    assert [found[0].knockdown, found[4].knockdown] == pytest.approx(
        [0.120723865, 0.552053784], abs=2e-8
    )
    last = Case.load(DIMPLE, ["magnetic.lambda_m=0.00184", "shell.defect.amplitude=2"])
    assert found[5].knockdown == pytest.approx(run(last).knockdown, rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("over", "most"),
    [
        ("shell.radius_to_thickness=90:150:5", 5),
        ("shell.defect.width=2.8:3.6:5", 6),
    ],
)
def test_meridian_chains(tmp_path: Path, over: str, most: int) -> None:
    """Through what changes the mesh; 1e-7 is what paths locate their folds to.

    The first, the middle and the last have paths of their own too.
    """
    axis, _, count = over.rpartition(":")
    followed = outcomes(DIMPLE, over, [], tmp_path / "folds")
    paths = outcomes(DIMPLE, f"{axis}:3", [], tmp_path / "paths", full_paths=True)
    assert [o.found for o in paths] == ["path"] * 3
    assert [o.found for o in followed] == ["path"] + ["fold"] * (int(count) - 1)
    assert max(o.factorisations for o in followed[1:]) <= most
    met = followed[:: int(count) // 2]
    assert [o.knockdown for o in met] == pytest.approx([o.knockdown for o in paths], rel=1e-7)
    for a, b in zip(met, paths, strict=True):
        assert a.limit
        assert b.limit
        assert a.limit["kind"] == b.limit["kind"] == "fold"
        assert a.limit["w_pole_over_h"] == pytest.approx(b.limit["w_pole_over_h"], abs=1e-3)


@pytest.mark.slow
def test_half_shell_through_the_angles_of_the_figure(tmp_path: Path) -> None:
    """At most 4 factorisations an angle after the first; the first and the last have a path of its
    own too.
    """
    followed = outcomes(COPLANAR, f"{ANGLES}=0:90:5", COARSE, tmp_path / "folds")
    paths = outcomes(COPLANAR, f"{ANGLES}=0:90:2", COARSE, tmp_path / "paths", full_paths=True)
    assert [o.found for o in followed] == ["path"] + ["fold"] * 4
    assert max(o.factorisations for o in followed[1:]) <= 4
    assert [o.knockdown for o in followed[::4]] == pytest.approx(
        [o.knockdown for o in paths], rel=1e-7
    )


@pytest.mark.slow
def test_chain_has_the_model_of_its_least_symmetric_point(tmp_path: Path) -> None:
    """With the field along the axis the meridian would do; beside tilted fields it is a half shell
    too.
    """
    settings = [*COARSE, "magnetic.lambda_m=0.001"]
    followed = outcomes(DIMPLE, f"{ANGLES}=0,10", settings, tmp_path / "auto")
    half = outcomes(DIMPLE, f"{ANGLES}=0,10", [*settings, "symmetry=half"], tmp_path / "half")
    assert [o.knockdown for o in followed] == [o.knockdown for o in half]
    assert [o.dofs for o in followed] == [o.dofs for o in half]
    alone = outcomes(DIMPLE, f"{ANGLES}=0,10", settings, tmp_path / "alone", full_paths=True)
    assert alone[0].dofs < 0.2 * followed[0].dofs  # type: ignore[operator]


@pytest.mark.slow
def test_fold_behind_a_bifurcation_is_not_a_knockdown(tmp_path: Path) -> None:
    """R/h = 300, lambda_m = 0.00184: 28 waves come at p/p_c = 1.0145, the fold at 1.093385
    (reference solver).
    """
    settings = ["shell.radius_to_thickness=300"]
    chain = outcomes(DIMPLE, "magnetic.lambda_m=0.0006,0.001,0.00184", settings, tmp_path)
    assert [o.found for o in chain] == ["path", "fold", "path"]
    assert chain[2].limit
    assert chain[2].limit["mode"] == "m = 28"
    assert chain[2].knockdown == pytest.approx(1.0145, abs=2e-3)


def test_second_call_keeps_what_was_followed(tmp_path: Path) -> None:
    """How a point was found is not part of what it is."""
    over = "magnetic.lambda_m=0.0005,0.001"
    first = outcomes(DIMPLE, over, [], tmp_path)
    assert [o.found for o in first] == ["path", "fold"]
    assert outcomes(DIMPLE, over, [], tmp_path, full_paths=True) == first


def polished(*settings: str) -> tuple[Scene, Fold]:
    result = run(Case.load(DIMPLE, settings))
    return result.scene, find_fold(result.scene.newton, FoldGuess(result.last), "pressure")


def test_fold_below_no_pressure_is_refused() -> None:
    """At the critical field -0.0033554 (R/h = 90, nu = 1/2) the fold passes through p = 0."""
    scene, fold = polished("magnetic.lambda_m=-0.0032")
    continuation = Continuation(-0.0032, scene, fold.state)
    assert (
        continuation.follow(-0.0033, Scene(Case.load(DIMPLE, ["magnetic.lambda_m=-0.0033"]))).value
        > 0
    )
    with pytest.raises(FoldLost, match="not a maximum of the pressure"):
        continuation.follow(-0.0034, Scene(Case.load(DIMPLE, ["magnetic.lambda_m=-0.0034"])))


@pytest.mark.parametrize("model", ["axisymmetric", pytest.param("half", marks=pytest.mark.slow)])
def test_shallow_shells_are_similar(model: str) -> None:
    """At equal defects in units of h and of sqrt(Rh), the fold's u/h changes little from R/h = 90
    to 100.

    What is left of the change of u is a tenth of what scaling with h takes away.
    """
    settings = ["mesh.degree=4", "mesh.refinement=0.4", f"symmetry={model}"]
    source, fold = polished(*settings)
    target, there = polished(*settings, "shell.radius_to_thickness=100")
    assert not same_mesh(source, target)
    u = transfer(source, target, fold.state.u)
    assert abs(u - there.state.u).max() < 0.1 * (100 / 90 - 1) * abs(there.state.u).max()
    held = np.concatenate([bc.dof_indices()[0] for bc in target.model.system.clamped])
    assert not u[held].any()


def test_shallow_caps_are_similar() -> None:
    """The same on a cap of 35 degrees, whose charts are equal at its rim."""

    def at(R: int) -> tuple[Scene, Fold]:
        dimple = {"kind": "dimple", "amplitude": 1.64, "width": 3.2}
        shell = {
            "geometry": "cap",
            "radius": R,
            "thickness": 1,
            "polar": 35,
            "poisson_ratio": 0.5,
            "defect": dimple,
        }
        mesh = {"degree": 4, "refinement": 0.4}
        data = {
            "shell": shell,
            "boundary": {"rim": "clamped"},
            "mesh": mesh,
            "loading": {"kind": "pressure"},
        }
        result = run(Case.from_source(data))
        return result.scene, find_fold(result.scene.newton, FoldGuess(result.last), "pressure")

    (source, fold), (target, there) = at(90), at(100)
    rim, stretch = np.radians([[35.0]]), _stretch(source, target)
    assert stretch
    assert stretch.place(rim) == pytest.approx(rim, rel=1e-12)
    u = transfer(source, target, fold.state.u)
    assert abs(u - there.state.u).max() < 0.1 * (100 / 90 - 1) * abs(there.state.u).max()


def test_same_mesh_is_copied() -> None:
    """The depth of the dimple does not move the nodes in the chart."""
    source, fold = polished()
    deeper = Scene(Case.load(DIMPLE, ["shell.defect.amplitude=2"]))
    assert same_mesh(source, deeper)
    assert (transfer(source, deeper, fold.state.u) == fold.state.u).all()


SHARED = """
import json, sys
from mpi4py import MPI
from magshell_fenicsx.case.case import Case
from magshell_fenicsx.public import run
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.sensitivity import sensitivities
from magshell_fenicsx.continuation.fold import FoldGuess, find_fold, predict_fold
from magshell_fenicsx.simulate.transfer import transfer

file, *settings = sys.argv[1:]
result = run(Case.load(file, settings))
fold = find_fold(result.scene.newton, FoldGuess(result.last), "pressure")
other = Scene(Case.load(file, [*settings, "shell.radius_to_thickness=95"]))
u, phi = (transfer(result.scene, other, v) for v in (fold.state.u, fold.phi))
guess = FoldGuess(other.unloaded().with_(u, "pressure", fold.value), phi)
there = find_fold(other.newton, guess, "pressure")
found = {"there": there.value, "curvature": there.curvature, "k_d": fold.value}
found |= sensitivities(result.scene, fold)
if MPI.COMM_WORLD.rank == 0:
    print(json.dumps([found, fold.unstable, fold.factorisations, there.factorisations]))
"""


@pytest.mark.slow
def test_ranks_do_not_matter() -> None:
    """A half shell without field on one rank and on two: fold, sensitivities, transfer to another
    mesh.
    """
    found = []
    for ranks in (1, 2):
        command = [*mpirun(ranks), sys.executable, "-c", SHARED]
        settings = [*COARSE, "mesh.refinement=0.25", "magnetic.lambda_m=0"]
        done = subprocess.run(
            [*command, COPLANAR, *settings], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        found.append(json.loads(done.stdout))
    for other in found[1:]:
        assert other[0] == pytest.approx(found[0][0], rel=1e-6)
        assert other[0]["k_d"] == pytest.approx(found[0][0]["k_d"], rel=1e-9)
        assert other[1:] == found[0][1:]


@pytest.mark.slow
def test_chains_are_dealt_to_ranks(tmp_path: Path) -> None:
    """Two chains on one rank and on two: the same rows."""
    tables = []
    for ranks in (1, 2):
        over = ["--over", "shell.defect.width=3,3.2", "--over", "magnetic.lambda_m=0.0005,0.001"]
        done = magshell("sweep", DIMPLE, *over, "--out", tmp_path / str(ranks), ranks=ranks)
        assert done.returncode == 0, done.stderr
        with (tmp_path / str(ranks) / "sweep.csv").open(encoding="utf-8") as stream:
            tables.append(
                [{k: v for k, v in row.items() if k != "wall_s"} for row in csv.DictReader(stream)]
            )
    assert tables[0] == tables[1]
    assert [row["found"] for row in tables[0]] == ["path", "fold", "path", "fold"]
