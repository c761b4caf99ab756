"""A tolerance instead of a mesh size: the true error of the result is below it, and not ten times
smaller.

k_d: an independent axisymmetric solver, nine digits. F at w/h = 10 under 45 degrees: degree 5 and
refinement 1.6 of this program, 15.14768, which the independent mixed elements have within 5e-5
(15.147).
"""

import json
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import basix
import numpy as np
import pytest
from command import started
from conftest import CASES
from mpi4py import MPI

from magshell_fenicsx import Case, CaseError
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.public import Scene, run
from magshell_fenicsx.simulate.adapt import tolerance
from magshell_fenicsx.simulate.adapt.choice import (
    GRID_FACTOR,
    Adapted,
    AdaptiveRound,
    Choice,
    LineSpacing,
    equidistributed,
    equidistributed_lines,
)
from magshell_fenicsx.simulate.adapt.ending import (
    CellFields,
    NoResult,
    NotCarried,
    by_path,
    carry,
    from_near,
    near_by,
)
from magshell_fenicsx.simulate.adapt.tolerance import adapted

FORCE = 15.14768
KNOCKDOWN = {0.0: 0.326233289, 0.00184: 0.552053778, -0.00184: 0.120723848}
COMM = MPI.COMM_WORLD


def buckling(tolerance: float, lambda_m: float = 0.0, symmetry: str = "half") -> Case:
    settings = [
        f"mesh.tolerance={tolerance!r}",
        f"magnetic.lambda_m={lambda_m}",
        f"symmetry={symmetry}",
    ]
    return Case.load(CASES / "dimple_buckling.yaml", settings)


def indentation(tolerance: float) -> Case:
    settings = [f"mesh.tolerance={tolerance!r}", "loading.depth=10", "loading.points=10"]
    return Case.load(CASES / "indentation.yaml", settings)


def check(case: Case, reference: float, mesh: Adapted | None = None) -> None:
    """The path on the mesh that was found ends where the rounds did, with an error as it was asked
    for.

    On a meridian, whose cells cost nothing, it may be far smaller.
    """
    mesh, tolerance = mesh or adapted(case.problem(), COMM), case.mesh.tolerance
    assert tolerance
    end = by_path(mesh.choice.scene(case.problem(), COMM))
    error = abs(end.value / reference - 1)
    assert end.value == pytest.approx(mesh.best.result, rel=1e-7)
    assert (
        (0.0 if mesh.choice.applied(case.problem()).axisymmetric else tolerance / 10)
        < error
        < tolerance
    )
    assert error < max(mesh.best.estimate, 1e-8)


def test_errors_of_a_solid_that_fall_with_the_square_of_the_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A result with such errors alone: both are found exactly, over the better result."""
    by_size, by_layers, refinement, layers = 0.3, 0.2, 1.5, 2

    def result(refinement: float, layers: int) -> float:
        return 1 + by_size / refinement**2 + by_layers / layers**2

    def ending(choice: Choice) -> SimpleNamespace:
        return SimpleNamespace(value=result(choice.refinement, choice.layers))

    def scene(choice: Choice, *_: object) -> SimpleNamespace:
        system = SimpleNamespace(dofs=1)
        return SimpleNamespace(
            cells=1,
            model=SimpleNamespace(system=system),
            refinement=choice.refinement,
            layers=choice.layers,
        )

    monkeypatch.setattr(Choice, "scene", scene)
    monkeypatch.setattr(tolerance, "by_path", ending)
    _, size_error, thickness_error = tolerance._round(None, COMM, refinement, layers)
    scale = result(tolerance.FINER * refinement, layers)
    assert size_error == pytest.approx(by_size / refinement**2 / scale)
    assert thickness_error == pytest.approx(by_layers / layers**2 / scale)


@cache
def mesh_for(case: tuple[float, float]) -> Adapted:
    """The mesh of a half for a tolerance and a field."""
    return adapted(buckling(*case).problem(), COMM)


@pytest.fixture(scope="module")
def half_mesh() -> Adapted:
    return mesh_for((1e-2, 0.0))


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-6])
def test_knockdown_on_the_meridian(tolerance: float) -> None:
    check(buckling(tolerance, symmetry="auto"), KNOCKDOWN[0.0])


def test_waves_are_carried_without_their_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """The load at nine waves is that of degree 5 with 50 cells, by the path of one mesh alone."""
    monkeypatch.setattr(tolerance, "from_near", None)  # which would compute another path
    problem = Case.load(CASES / "cylinder_waves.yaml", ["mesh.tolerance=1e-5"]).problem()
    mesh = adapted(problem, COMM)
    assert abs(mesh.best.result / 0.113753182 - 1) < mesh.best.estimate < 1e-5
    assert [each.degree for each in mesh.rounds] == [3, 4]


@pytest.mark.slow
@pytest.mark.parametrize(("tolerance", "lambda_m"), [(1e-2, 0.0), (1e-3, -0.00184)])
def test_knockdown(tolerance: float, lambda_m: float) -> None:
    check(buckling(tolerance, lambda_m), KNOCKDOWN[lambda_m], mesh_for((tolerance, lambda_m)))


@pytest.mark.slow
def test_force() -> None:
    check(indentation(1e-2), FORCE)


@pytest.mark.slow
def test_grading_by_the_indicator_takes_fewer_unknowns() -> None:
    """Than the default grading, refined as a whole, for an error that is not smaller."""
    lambda_m = -0.00184
    case = buckling(1e-3, lambda_m)
    graded, whole = mesh_for((1e-3, lambda_m)), Choice(4, 0.5)
    near = graded.choice.scene(case.problem(), COMM)
    scene = whole.scene(case.problem(), COMM)
    error = abs(from_near(scene, near, by_path(near)).value / KNOCKDOWN[lambda_m] - 1)
    assert graded.best.dofs < 0.85 * scene.model.system.dofs
    assert abs(graded.best.result / KNOCKDOWN[lambda_m] - 1) < error


def dome(thickness: float, height: float, **shell: object) -> dict[str, object]:
    keys = {
        "geometry": "cap",
        "radius": 1,
        "polar": 40,
        "thickness": thickness,
        "poisson_ratio": 0.3,
    }
    return {
        "shell": keys | shell,
        "boundary": {"rim": "clamped"},
        "place": {"position": [0, 0, height]},
    }


@pytest.mark.slow
def test_ends_of_several_shells_are_carried() -> None:
    """Each gives its own to itself, though they cross in space: exact to a higher degree, and the
    fold of its path.
    """
    flaw = {"kind": "gaussian", "amplitude": 0.5, "width": 1.5, "at": {"polar": 10}}
    shells = {"lower": dome(0.03, 0.0, imperfections=[flaw]), "upper": dome(0.04, 0.01)}
    case = Case.from_source({"shells": shells, "loading": {"kind": "pressure", "until": "limit"}})
    low, high, finer = (
        Choice(*each).scene(case.problem(), COMM) for each in ((3, 0.4), (4, 0.4), (4, 0.6))
    )
    end = by_path(low)
    assert carry(high, low, carry(low, high, end.state.u)) == pytest.approx(end.state.u, abs=1e-9)
    found = near_by(finer, low, end)
    assert found
    assert found.value == pytest.approx(by_path(finer).value, rel=1e-9)


def test_ends_of_shells_that_touch_are_carried() -> None:
    """On meridians, with penalties that are made fit; against a path on the finer scene."""
    low, finer = _domes_that_touch("coaxial_domes.yaml", 0.5)
    carried = near_by(finer, low, by_path(low))
    assert carried
    assert carried.value == pytest.approx(by_path(finer).value, rel=1e-6)


@pytest.mark.slow
def test_ends_of_surfaces_that_touch_are_found() -> None:
    """Newton's method from the other end does not reach it there, and its path is computed anew.

    The force of the sector of 10 degrees is that of the meridian of whole domes, over 36.
    """
    low, finer = _domes_that_touch("stacked_domes.yaml", 0.722)
    assert from_near(finer, low, by_path(low)).value == pytest.approx(3.16780e-4 / 36, rel=1e-3)


def _domes_that_touch(file: str, refinement: float) -> list[Scene]:
    """Scenes of degree 3 and 4."""
    mesh = f"mesh={{degree: 3, refinement: {refinement}}}"
    case = Case.load(CASES / file, ["loading.displacement=0.1", mesh])
    return [Choice(degree, refinement).scene(case.problem(), COMM) for degree in (3, 4)]


def test_ends_with_moved_supports_are_carried_on() -> None:
    """From degree to degree the reaction changes little; without the supports' motion the second
    end started far off, and was not found.
    """
    case = Case.from_source(
        {
            "shell": {"geometry": "plate", "length": 1, "width": 0.2, "thickness": 0.02}
            | {"poisson_ratio": 0.3},
            "boundary": {"left": "clamped", "right": "clamped"},
            "loading": {
                "kind": "edge",
                "control": "load",
                "moves": [{"supports": ["right"], "translation": [-0.1, 0, 0.1]}],
                "points": 1,
            },
            "mesh": {"size": 0.25},
        }
    )
    scenes = [Choice(degree, 1.0).scene(case.problem(), COMM) for degree in (3, 4, 5)]
    ends = [by_path(scenes[0])]
    for source, target in pairwise(scenes):
        carried = near_by(target, source, ends[-1])
        assert carried
        ends.append(carried)
    changes = np.abs(np.diff([end.value for end in ends])) / abs(ends[-1].value)
    assert changes[1] < changes[0] / 2


def test_displacements_are_carried_to_a_higher_degree_without_loss() -> None:
    """And back: polynomials of degree 3 are among those of degree 4, also on the curved edges at
    the dimple's rim.
    """
    case = buckling(1e-2)
    low, high = (Choice(degree, 0.3).scene(case.problem(), COMM) for degree in (3, 4))
    u = np.random.default_rng(0).standard_normal(low.model.system.size)
    values = np.zeros_like(low.model.system.u.x.array)
    values[: len(u)] = u
    for held in low.model.system.clamped:
        held.set(values)
    u = values[: len(u)]
    assert carry(high, low, carry(low, high, u)) == pytest.approx(u, abs=1e-9)


def test_equal_shares() -> None:
    """Shares that grow e^4-fold across a square and go as size^8 are equal on the new mesh; the
    error is met.
    """
    n, order, reduction = 40, 6.0, 0.1
    x, y = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n)
    centres = np.column_stack([x.ravel(), y.ravel()])
    shares = np.exp(4 * centres[:, 0])
    size, more = equidistributed(lambda x: 1 / n, centres, shares, order, reduction, 0.0)
    change = np.array([size(c) for c in centres]) * n
    step = 2 ** (1 / 8)  # sizes are rounded to it
    inner = np.abs(centres - 0.5).max(axis=1) < 0.4
    assert np.ptp(np.log(shares * change ** (order + 2))[inner]) < (order + 2) * np.log(step) * 1.5
    assert shares @ change**order / shares.sum() == pytest.approx(
        reduction, rel=order * np.log(step)
    )
    assert more == pytest.approx(np.mean(change**-2.0), rel=0.05)


def test_equal_shares_between_lines() -> None:
    """Shares that grow e^3-fold along one axis of a grid and go as distance^7 are equal between the
    new lines, which come nearer at its end. Beyond a plane of symmetry there are no shares.
    """
    n, order = 40, 6.0
    lines = np.linspace(0, 1, n + 1)
    middles = (lines[1:] + lines[:-1]) / 2
    x, y = np.meshgrid(middles, middles[: n // 2])
    centres = np.column_stack([x.ravel(), y.ravel()])
    shares = np.exp(3 * centres[:, 0])
    spacing, more = equidistributed_lines([lines, lines], centres, shares, order, 0.5, 0.0)
    along, across = (n * np.array([spacing(axis, place) for place in middles]) for axis in range(2))
    step = 2 ** (1 / 8)  # distances are rounded to it
    assert np.ptp(3 * middles + (order + 1) * np.log(along)) < (order + 1) * np.log(step) * 1.5
    assert np.ptp(across) < 1e-12
    assert (along**order).mean() < 1
    assert along[-1] < 1 / GRID_FACTOR * step
    assert more == pytest.approx(np.mean(1 / along) * np.mean(1 / across))


def test_lines_are_kept_for_a_run_that_is_resumed() -> None:
    problem = Case.load(CASES / "laminated_roof.yaml", ["mesh.tolerance=1e-3"]).problem()
    extent = np.array([problem.shape.low, problem.shape.high]).T
    spacing = LineSpacing(tuple(extent), tuple(each / 7 for each in extent + 1.0))
    choice, tried = Choice(3, 0.5, spacing), AdaptiveRound(3, 0.5, 16, 255, 8.46e-8, 8.8e-3)
    again = Adapted.from_json(problem, Adapted(problem, choice, tried, [tried]).to_json())
    grid, grid_again = (each.applied(problem).shape for each in (choice, again.choice))
    for axis in range(2):
        assert grid_again.lines(axis, []).tolist() == grid.lines(axis, []).tolist()


@pytest.mark.slow
def test_the_mesh_is_kept_for_a_run_that_is_resumed(half_mesh: Adapted) -> None:
    case, mesh = buckling(1e-2), half_mesh
    again = Adapted.from_json(mesh.requested, mesh.to_json())
    assert replace(again, choice=mesh.choice) == mesh
    for x in np.random.default_rng(0).uniform(-1, 1, (20, 2)):
        assert again.choice.applied(case.problem()).size(x) == mesh.choice.applied(
            case.problem()
        ).size(x)


def test_summary_has_the_estimate_and_the_rounds(tmp_path: Path, no_pictures: None) -> None:
    case = buckling(1e-2, symmetry="auto")
    lines: list[str] = []
    result = run(case, tmp_path, say=lines.append)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    said, rounds = summary["tolerance"], summary["tolerance"]["rounds"]
    assert said["tolerance"] == 1e-2
    assert abs(summary["knockdown"] / KNOCKDOWN[0.0] - 1) < said["error_estimate"] <= 1e-2
    (chosen,) = [r for r in rounds if r["dofs"] == summary["mesh"]["dofs"]]
    assert chosen["result"] == pytest.approx(result.knockdown, rel=1e-7)
    assert len([line for line in lines if line.startswith("tolerance 0.01: degree 3")]) == len(
        rounds
    )


def test_an_estimate_is_not_given_for_another_result() -> None:
    """Where the run on the mesh ends elsewhere than the rounds did."""
    mesh = adapted(buckling(1e-2, symmetry="auto").problem(), COMM)
    assert mesh.account(mesh.best.result)["error_estimate"] == mesh.best.estimate
    assert mesh.account(1.1 * mesh.best.result)["error_estimate"] is None
    assert mesh.account(None)["error_estimate"] is None


def test_without_a_load_there_is_no_result() -> None:
    data = buckling(1e-2, symmetry="auto").model_copy(update={"loading": None, "magnetic": None})
    with pytest.raises(NoResult, match="neither a load nor a field"):
        adapted(data.problem(), COMM)


@pytest.mark.parametrize(
    ("setting", "said"),
    [("mesh.degree=3", "tolerance chooses degree"), ("mesh.tolerance=1e-7", "1e-07")],
)
def test_refused(setting: str, said: str) -> None:
    with pytest.raises(CaseError, match=said):
        Case.load(CASES / "dimple_buckling.yaml", ["mesh.tolerance=1e-3", setting])


@pytest.mark.slow
def test_a_tolerance_on_a_grid() -> None:
    """A closed cylinder dented at one side, a seam in its chart: against degree 5 on 2.5 times as
    many cells.
    """
    data = {
        "shell": {
            "geometry": "cylinder",
            "radius": 1,
            "length": 1,
            "thickness": 0.02,
            "poisson_ratio": 0.3,
        },
        "boundary": {"bottom": "clamped", "top": "clamped"},
        "points": {"A": [1, 0, 0.5]},
        "loading": {"kind": "indentation", "at": {"point": "A"}, "depth": 1, "points": 1},
    }
    fine = Case.from_source({**data, "mesh": {"degree": 5, "refinement": 1.6}})
    mesh = adapted(Case.from_source({**data, "mesh": {"tolerance": 1e-2}}).problem(), COMM)
    error = abs(mesh.best.result / by_path(Scene(fine, COMM)).value - 1)
    assert 1e-3 < error < mesh.best.estimate < 1e-2


@pytest.mark.slow
def test_in_parallel(half_mesh: Adapted, tmp_path: Path) -> None:
    """The same meshes and the same estimates on any number of ranks."""
    settings = ["--set", "mesh.tolerance=1e-2", "--set", "symmetry=half", "--out", str(tmp_path)]
    done = started("run", CASES / "dimple_buckling.yaml", *settings, ranks=2, pictures=False)
    assert done.returncode == 0, done.stderr
    rounds = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["tolerance"][
        "rounds"
    ]
    assert [(r["cells"], r["dofs"]) for r in rounds] == [
        (r.cells, r.dofs) for r in half_mesh.rounds
    ]
    for there, here in zip(rounds, half_mesh.rounds, strict=True):
        assert there["result"] == pytest.approx(here.result, rel=1e-9)
        assert there["estimate"] == pytest.approx(here.estimate, rel=1e-6)


def test_a_point_in_a_large_cell_beside_small_ones_is_found() -> None:
    """Though the centres of a hundred small ones are nearer. Each cell's value is its number."""
    large = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    along = np.linspace(2.0, 8.0, 101)[:-1]
    small = [[[10 - t, t], [10 - t + 0.06, t], [10 - t, t + 0.06]] for t in along]
    cells = CellFields(
        np.array([large, *small]),
        basix.create_element(basix.ElementFamily.P, basix.CellType.triangle, 1),
    )
    values = np.tile(np.arange(101.0)[:, None, None], (1, 3, 1))
    inside, beside = np.array([[4.9, 4.9], [1.0, 1.0]]), np.array([[-0.01, 5.0]])
    found, xi, far = cells.places(inside)
    assert cells.evaluate(values, found, xi).ravel().tolist() == [0.0, 0.0]
    assert far.tolist() == [0.0, 0.0]
    assert cells.places(beside)[2] == pytest.approx([1e-3])


@pytest.mark.parametrize("symmetry", ["axisymmetric", "half"])
def test_a_place_that_the_other_mesh_has_not_is_refused(symmetry: str) -> None:
    """Polynomials that are exact inside grow without limit outside."""

    def cap(polar: float) -> Scene:
        shell = {
            "geometry": "cap",
            "radius": 1.0,
            "thickness": 0.02,
            "polar": polar,
            "poisson_ratio": 0.3,
        }
        shell["youngs_modulus"] = 1.0
        sections = {
            "shell": shell,
            "boundary": {"rim": "clamped"},
            "mesh": {"degree": 2},
            "symmetry": symmetry,
        }
        return Scene(
            Case.from_source(
                Source("cap", sections | {"loading": {"kind": "pressure", "until": "limit"}})
            )
        )

    low, wide = cap(30), cap(60)
    with pytest.raises(NotCarried, match="cells beside the other mesh"):
        carry(low, wide, low.model.zero())
    assert len(carry(wide, low, wide.model.zero())) == low.model.system.size
