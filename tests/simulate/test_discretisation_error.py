"""Estimated errors of results against true ones, which finer meshes of higher degree give.

References: refinement 2 and degree 5 of this program, except where another source is named.
"""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from command import magshell
from conftest import CASES
from mpi4py import MPI

from magshell_fenicsx import Case
from magshell_fenicsx.public import Result, Scene, run
from magshell_fenicsx.simulate.degree_comparison import (
    NotEstimated,
    fine_scene,
    with_higher_degree,
)
from magshell_fenicsx.simulate.discretisation_error import FineScenes, estimate_errors

COARSE = ["mesh.degree=3", "mesh.refinement=0.5"]
POLE = [*COARSE, "loading.depth=2", "loading.points=2"]


def coarse_run(file: str, *settings: str) -> Result:
    return run(Case.load(CASES / file, [*COARSE, *settings]))


def check_effectivity(result: Result, name: str, value: float, reference: float) -> None:
    """The estimate is the true error within a factor of three."""
    true_error = abs(value - reference)
    assert true_error > 1e-9 * abs(reference)
    assert 0.3 < result.errors[name] / true_error < 3


def test_fold_of_a_meridian() -> None:
    """k_d of an independent axisymmetric solver, nine digits."""
    result = coarse_run("dimple_buckling.yaml")
    assert result.knockdown
    check_effectivity(result, "knockdown", result.knockdown, 0.326233289)
    assert result.errors["limit_load"] == result.errors["knockdown"]
    assert not result.error_estimates.reasons

    def stop() -> None:
        raise NotEstimated("interrupted by SIGTERM")

    stopped = estimate_errors(result.scene, result.path_history, FineScenes(stop))
    assert not stopped.errors
    assert stopped.reasons["knockdown"] == "interrupted by SIGTERM"


def test_fold_of_half_a_shell() -> None:
    """The same, 1 % off; the relative error is large enough for a warning."""
    result = coarse_run("dimple_buckling.yaml", "symmetry=half")
    assert result.knockdown
    check_effectivity(result, "knockdown", result.knockdown, 0.326233289)
    assert result.large_errors["knockdown"] == pytest.approx(0.012, abs=0.001)


@pytest.mark.slow
def test_waves_that_a_meridian_excludes() -> None:
    result = coarse_run("cylinder_waves.yaml")
    assert result.knockdown
    check_effectivity(result, "knockdown", result.knockdown, 0.113753163)


@pytest.mark.slow
def test_pitchfork_of_a_strip() -> None:
    """A mode of the model itself; degree 4, refinement 1."""
    settings = ["mesh.degree=2", "mesh.refinement=0.5"]
    result = run(Case.load(CASES / "strip_buckling.yaml", settings))
    assert result.critical_field
    check_effectivity(result, "critical_field", result.critical_field, 2.05612717e-5)


@pytest.mark.slow
def test_waves_in_a_pair() -> None:
    """A whole tube that is shortened: both waves are unstable with one degree more.

    The reference is that of the meridian, whose estimated error is 4e-8.
    """
    tube = {"geometry": "cylinder", "radius": 30, "length": 30, "thickness": 0.5}
    move = {"supports": ["top"], "translation": [0, 0, -1]}
    case = {
        "shell": {**tube, "youngs_modulus": 1, "poisson_ratio": 0.29},
        "boundary": {"bottom": "clamped", "top": "clamped"},
        "mesh": {"degree": 4, "refinement": 0.6},
        "symmetry": "none",
        "loading": {"kind": "edge", "name": "shortening", "moves": [move], "until": "bifurcation"},
    }
    result = run(Case.from_source(case))
    check_effectivity(result, "limit_load", float(result.limit_points[0]["value"]), 0.27929334)


@pytest.mark.slow
@pytest.mark.parametrize(("degree", "refinement"), [(3, 0.4), (4, 0.6)])
def test_mode_that_a_half_excludes(degree: int, refinement: float) -> None:
    """Antisymmetric; degree 5, refinement 0.9. The first mesh is 32 % off: it says so."""
    around = {"a": [1.4, 0, 0], "b": [-1.4, 0, 0], "c": [0, 1.4, 0], "d": [0, -1.4, 0]}
    held = {"a": ["x", "y", "z"], "b": ["y", "z"], "c": ["z"], "d": ["z"]}
    torus = {"geometry": "torus", "radius": 1.0, "tube_radius": 0.4}
    case = {
        "shell": {**torus, "thickness": 0.08, "poisson_ratio": 0.3},
        "points": around,
        "boundary": {name: {"held": axes} for name, axes in held.items()},
        "mesh": {"degree": degree, "refinement": refinement},
        "loading": {"kind": "pressure", "until": "bifurcation"},
    }
    result = run(Case.from_source(case))
    assert result.knockdown
    assert result.limit_points[0]["mode"] == "antisymmetric"
    if degree == 4:
        check_effectivity(result, "knockdown", result.knockdown, 0.3732450)
    else:
        assert "knockdown" not in result.errors
        assert "the mesh is too coarse" in result.error_estimates.reasons["knockdown"]


def test_force_at_a_depth() -> None:
    """What the step prescribes has no error, and what follows has one."""
    result = run(Case.load(CASES / "pole_indentation.yaml", POLE))
    last = result.rows[-1]
    check_effectivity(result, "force@end", float(last["force"]), 3.32861271)
    check_effectivity(result, "energy@end", float(last["energy"]), -2.2227381e-6)
    assert result.errors.get("w_over_h@end", 0.0) < 1e-12


def test_a_narrow_contact_has_no_estimate_of_its_pressure() -> None:
    """Under the edge of a rod the largest pressure grows with finer meshes, the force does not."""
    result = coarse_run("rod_contact.yaml", "loading.approach=1", "loading.points=1")
    assert "force@end" in result.errors
    assert not any("pressure_max" in name for name in result.errors)
    reason = result.error_estimates.reasons["contact_pressure_max@end"]
    assert reason == "the contact is narrower than a cell of the mesh"


def test_critical_field_and_displacement_beyond_it() -> None:
    result = coarse_run("bistable_dome.yaml")
    assert result.critical_field
    check_effectivity(result, "critical_field", result.critical_field, -0.0236453674)
    check_effectivity(result, "w_mm@end", float(result.rows[-1]["w_mm"]), 5.1236557)
    field = result.errors["critical_field"] / abs(result.critical_field)
    in_units = result.errors["critical_field_mT"] / 363.17
    assert in_units == pytest.approx(field, rel=1e-3)
    # later instabilities, by modes that the meridian excludes and by its own
    references = -0.0115600159, 0.00838612896, 0.0117788327
    for number, reference in enumerate(references, 2):
        value = float(result.limit_points[number - 1]["value"])
        check_effectivity(result, f"limit_load_{number}", value, reference)
    assert [*result.error_estimates.reasons] == ["limit_load_5"]


@pytest.mark.slow
def test_frequencies(tmp_path: Path) -> None:
    """The sixth of the modes that are no rigid motions; these have no error."""
    result = run(Case.load(CASES / "free_plate.yaml", COARSE), tmp_path / "out", pictures=False)
    modes = result.frequencies[0]
    check_effectivity(result, "omega2_7", modes[6].eigenvalue, 0.00166110321)
    assert "omega2_6" not in result.errors
    relative_error = result.errors["omega2_7"] / modes[6].eigenvalue
    assert result.errors["hertz_7"] / 165.448 == pytest.approx(relative_error / 2, rel=1e-4)
    with (tmp_path / "out" / "frequencies.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert float(rows[6]["omega2_error"]) == result.errors["omega2_7"]
    assert rows[5]["omega2_error"] == ""  # a rigid motion


def test_what_has_no_estimate_says_why() -> None:
    settings = ["mesh.refinement=0.3", "shell.radius_to_thickness=20", "loading.points=1"]
    result = run(
        Case.load(CASES / "solid_indentation.yaml", [*settings, "loading.depth=1"]),
    )
    assert result.errors == {}
    reason = "a solid has one degree alone; mesh.tolerance estimates its error"
    assert result.error_estimates.reasons == {"end": reason}


@pytest.mark.parametrize("symmetry", ["auto", "half"])
def test_a_field_of_the_run_is_one_of_the_fine_scene(symmetry: str) -> None:
    """A cubic displacement has the same energy with one degree more, to the error of quadrature."""
    case = Case.load(CASES / "dimple_buckling.yaml", [*COARSE, f"symmetry={symmetry}"])
    scene = Scene(case.problem(), MPI.COMM_SELF)
    fine, state = fine_scene(scene), scene.unloaded()
    u = scene.model.system.zero_at_supports(np.sin(np.arange(state.u.size) / 50) * 1e-4)
    raised = with_higher_degree(scene, fine, u)
    volumes = [
        -each.model.system.potential(v, state.mu, "pressure")
        for each, v in ((scene, u), (fine, raised))
    ]
    assert volumes[0] == pytest.approx(volumes[1], rel=1e-6)


@pytest.mark.slow
def test_same_on_two_ranks_and_resumed(tmp_path: Path) -> None:
    """summary.json of two ranks, and of a run that stops and goes on, has the same errors."""
    case = CASES / "dimple_buckling.yaml"
    settings = [f"--set={setting}" for setting in (*COARSE, "symmetry=half")]
    errors = dict[str, dict[str, float]]()
    for name, ranks in (("one", 0), ("two", 2)):
        out = tmp_path / name
        done = magshell("run", case, *settings, "--no-pictures", "--out", out, ranks=ranks)
        assert done.returncode == 0, done.stderr
        errors[name] = json.loads((out / "summary.json").read_text())["errors"]
        assert "k_d = 0.330(4)" in done.stdout
        assert "warning: the estimated error of knockdown is 1.2 % of it" in done.stdout
    assert errors["two"]["knockdown"] == pytest.approx(errors["one"]["knockdown"], rel=1e-5)
    out = tmp_path / "resumed"
    words = ("run", case, *settings, "--no-pictures", "--out", out)
    assert magshell(*words, "--time-limit", 0).returncode == 3
    assert json.loads((out / "summary.json").read_text())["errors"] == {}
    assert magshell(*words, "--resume").returncode == 0
    resumed = json.loads((out / "summary.json").read_text())["errors"]
    assert resumed == errors["one"]
