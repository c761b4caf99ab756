"""Branches of modes that a reduced model excludes, in the smallest model that has them."""

import json
from itertools import islice, pairwise
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import magshell, read_path
from numpy.typing import NDArray
from simulate.tube_by_ritz import koiter

from magshell_fenicsx.case.open_problem import problem_of
from magshell_fenicsx.continuation import bifurcation
from magshell_fenicsx.continuation.control import PrescribedConjugate
from magshell_fenicsx.continuation.modes import critical_mode, nearest_to_zero
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.mesh.mirror import Sector
from magshell_fenicsx.mesh.unfolding import ChartUnfolding
from magshell_fenicsx.parts.supports.boundary import BoundarySection
from magshell_fenicsx.runs.running import run
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.shells.shell import ShellModel
from magshell_fenicsx.simulate.adapt.choice import Adapted, Choice
from magshell_fenicsx.simulate.adapt.ending import at_target, near_by
from magshell_fenicsx.simulate.follow import follow, follow_alone
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]
FOLLOWED = {"kind": "pressure", "until": "bifurcation", "then": "follow", "points": 3}
CAP = {
    "shell": {
        "geometry": "cap",
        "radius": 1.0,
        "thickness": 0.01,
        "polar": 30.0,
        "poisson_ratio": 0.3,
    },
    "boundary": {"rim": "clamped"},
    "loading": FOLLOWED,
}
TUBE = {
    "shell": {
        "geometry": "cylinder",
        "radius": 1.0,
        "length": 2.0,
        "thickness": 0.05,
        "poisson_ratio": 0.3,
    },
    "boundary": {"bottom": "clamped", "top": "clamped"},
    "loading": FOLLOWED,
}
FINER = {"mesh": {"refinement": 1.5}}
BARREL = {
    "shell": {
        "geometry": "revolution",
        "profile": {"radius": "1 - 0.2*z**2", "heights": [-0.8, 0.8]},
        "thickness": 0.04,
        "poisson_ratio": 0.3,
    },
    "boundary": {"bottom": "clamped", "top": "clamped"},
    "loading": FOLLOWED,
}
BALL = {  # more than half of a sphere
    "shell": {
        "geometry": "cap",
        "radius": 1.0,
        "thickness": 0.04,
        "polar": 120.0,
        "poisson_ratio": 0.3,
    },
    "boundary": {"rim": "clamped"},
    "loading": FOLLOWED,
}
# the larger model's mesh, and w0 of h/10000 at most: it changes the load by its part of the waves'
# height
WAVES = {
    "cap": (CAP | FINER, 5, FINER, "0.003*(x**5 - 10*x**3*y**2 + 5*x*y**4)"),
    "barrel": (BARREL | FINER, 6, FINER, "0.0001*cos(6*arctan2(y, x))"),
    "ball": (
        BALL | FINER,
        8,
        FINER,
        "1e-5*(x**8 - 28*x**6*y**2 + 70*x**4*y**4 - 28*x**2*y**6 + y**8)",
    ),
}


def _on_larger(small: ShellModel, u: Array, large: ShellModel) -> Array:
    """A displacement of a sector and its images at the nodes of a larger model (n, 3), by its
    elements.
    """
    assert isinstance(small.mirror, Sector)
    folding, chart = (
        ChartUnfolding(small.mirror.angle, small.mirror.waves, small.midsurface.patch),
        large.chart(),
    )
    nodes = small.V.dofmap.list
    corners = small.chart()[nodes[:, :3]]
    sides = np.linalg.inv(
        np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
    )
    local = np.einsum("cij,ncj->nci", sides, folding.to_sector(chart)[:, None] - corners[:, 0])
    cells = np.minimum(local.min(axis=2), 1 - local.sum(axis=2)).argmax(
        axis=1
    )  # beyond a curved rim the nearest
    table = small.V.element.basix_element.tabulate(0, local[np.arange(len(chart)), cells])[
        0, :, :, 0
    ]
    turns = np.array([folding.turn(k) for k in range(folding.count)])[folding.copies(chart)]
    return np.asarray(np.einsum("nij,np,npj->ni", turns, table, u.reshape(-1, 3)[nodes[cells]]))


@pytest.mark.slow
@pytest.mark.parametrize("name", WAVES)
def test_a_sector_follows_the_branch_of_larger_models(name: str) -> None:
    """Of shells of their own meshes, with an imperfection of h/10000 in the mode's waves, at the
    same volumes.

    They carry the same pressure to 1e-3 at three amplitudes, and have as many unstable directions.
    They are halves, whose plane holds the waves where they are: a whole shell may turn them about
    e3 almost without a force. Their own count of antisymmetric modes has this one or not.
    """
    case, m, mesh, waves = WAVES[name]
    records = list(follow(Scene(problem_of(case)), remark=lambda said: None))
    branch = [r for r in records if r.label == "step" and r.scene is not records[0].scene][1:]
    flawed = case["shell"] | {"imperfections": [{"kind": "formula", "w0": f"-({waves})"}]}
    larger = {"shell": flawed, "symmetry": "half", "loading": {"kind": "pressure"}}
    full = Scene(problem_of({**case, **mesh, **larger}))
    assert len(branch) >= 3
    for record in branch[-3:]:
        scene, state = record.scene, record.point.state
        assert scene
        assert scene.problem.included[0] == f"sector of {180 / m:g} degrees of the shell"
        assert scene.problem.azimuth == full.problem.azimuth
        guess = full.model.system.zero_at_supports(
            _on_larger(scene.model, state.u, full.model).ravel()
        )
        copies = scene.model.multiplicity / full.model.multiplicity
        volume = copies * scene.model.system.potential(state.u, state.mu, "pressure")
        row = PrescribedConjugate(full.model.system, "pressure", -volume)
        found = full.newton.solve(State(guess, {**full.unloaded().mu, **state.mu}), "pressure", row)
        assert found.converged
        assert found.state.mu["pressure"] == pytest.approx(state.mu["pressure"], rel=1e-3)
        counted = record.point.negative_pivots + record.excluded_pivots
        assert full.model.symmetry_breaking_modes
        others = sum(full.model.symmetry_breaking_modes.counts(found.state))
        assert full.newton.factor_at(found.state).negative_pivots + others in (counted, counted + 1)


@pytest.mark.slow
def test_an_instability_is_located_on_the_path() -> None:
    """Of a cap on a bed: other branches pass near its first bifurcation, at smaller loads (0.760
    and 0.783).
    """
    cap = CAP["shell"] | {
        "radius": "25 mm",
        "thickness": "0.25 mm",
        "youngs_modulus": "1 MPa",
        "polar": 22.0,
    }
    case = CAP | {
        "shell": cap,
        "foundation": {"stiffness": "40 kPa/m"},
        "loading": {"kind": "pressure", "until": "limit"},
    }
    loads = [
        next(
            record.point.state.mu["pressure"]
            for record in follow(Scene(problem_of(case | other)))
            if record.label == "bifurcation"
        )
        for other in ({}, {"symmetry": 3})
    ]
    assert loads[1] == pytest.approx(loads[0], rel=1e-3)


def test_handing_over_is_continuous_to_the_meshes_error() -> None:
    """Load, energy and deflection of the meridian; the mode's stiffness is zero in both models."""
    way, records = (
        follow(Scene(problem_of({**CAP, "mesh": {"refinement": 1.5}})), remark=lambda said: None),
        [],
    )
    for record in way:
        records.append(record)
        if record.scene is not records[0].scene:  # what follows is the branch
            break
    old, new = next((a, b) for a, b in pairwise(records) if a.mode == "m = 5")
    assert new.scene is not old.scene
    assert old.scene
    assert new.scene
    assert new.point.state.mu["pressure"] == pytest.approx(old.point.state.mu["pressure"], rel=1e-4)
    one, two = old.scene.observe(old.point.state), new.scene.observe(new.point.state)
    for column in ("energy", "volume_change", "w_pole_over_h"):
        assert two[column] == pytest.approx(one[column], rel=3e-4)
    waves = old.scene.model.waves
    stiff = abs(nearest_to_zero(waves.factor_at(records[1].point.state, 5))[0])
    assert abs(nearest_to_zero(waves.factor_at(old.point.state, 5))[0]) < 1e-6 * stiff
    lowest = ShellModes(new.scene.model).lowest(new.point.state, 2)
    assert abs(lowest[0].eigenvalue) < 1e-6 * lowest[1].eigenvalue


def test_the_branch_of_a_ring_has_the_published_curvature(monkeypatch: pytest.MonkeyPatch) -> None:
    """p/p_c = 1 + (27/32) (w/R)^2 of an inextensible ring under hydrostatic pressure, p_c = 3
    D/R^3.

    Budiansky, Theory of buckling and post-buckling behavior of elastic structures, Adv. Appl. Mech.
    14 (1974). The ring is held by nothing, which a case is not allowed: a sector excludes its rigid
    motions.
    """
    own = BoundarySection.symmetry_constraints
    monkeypatch.setattr(
        BoundarySection,
        "symmetry_constraints",
        lambda self, context, outline: own(self, context, outline)[:-1],
    )
    h = 0.01
    shell = {
        "geometry": "cylinder",
        "radius": 1.0,
        "length": 0.12,
        "thickness": h,
        "poisson_ratio": 0.0,
    }
    case = {
        "shell": shell,
        "boundary": {"bottom": "symmetry", "top": "symmetry"},
        "mesh": {"size": 0.24, "degree": 4},
    }
    scene = Scene(problem_of({**case, "symmetry": 2, "loading": FOLLOWED}))
    records = list(follow(scene, remark=lambda said: None))
    x, unit = scene.model.r0.x.array.reshape(-1, 3), scene.problem.material.classical_pressure
    crest, trough = (int(np.argmin(np.linalg.norm(x - place, axis=1))) for place in np.eye(3)[:2])

    def bend(record: Record) -> float:
        u = record.point.state.u.reshape(-1, 3)
        return float(u[crest, 0] - u[trough, 1]) / 2

    pressures = [record.point.state.mu["pressure"] for record in records]
    assert pressures[1] * unit == pytest.approx(3 * h**3 / 12, rel=1e-4)
    squares = np.array([bend(record) ** 2 for record in records[3:]])
    rises = (
        np.diff(pressures[3:]) / pressures[1]
    )  # along the branch: at its begin rounding hides 1e-5 of the pressure
    assert rises / np.diff(squares) == pytest.approx(27 / 32, rel=0.01)
    begin = np.polyfit(squares, pressures[3:], len(squares) - 1)[-1]  # of the branch
    assert abs(begin - pressures[1]) <= records[1].point.load_error < 1e-4 * begin


@pytest.mark.slow
def test_the_branch_of_a_tube_has_the_curvature_of_koiters_theory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Load and b of p/p_c = 1 + b (w/h)^2 by Ritz's method, w the height of four waves: -0.1300."""
    h, length = TUBE["shell"]["thickness"], TUBE["shell"]["length"]
    critical, b = koiter(h, length, 0.3, 4)
    seen = list[tuple[float, float]]()
    for size in (0.15, 0.3):  # of the first step along the mode, in thicknesses
        monkeypatch.setattr(bifurcation, "FIRST_STEP_SIZES", (size,))
        records = follow(Scene(problem_of(TUBE)), remark=lambda said: None)
        buckled, first = islice(
            (r for r in records if r.scene and isinstance(r.scene.problem.mirror, Sector)), 2
        )
        assert first.scene
        x, u = first.scene.model.r0.x.array.reshape(-1, 3), first.point.state.u.reshape(-1, 3)
        normals = np.array(
            [[1.0, 0.0, 0.0], [np.cos(pi / 4), np.sin(pi / 4), 0.0]]
        )  # of a crest and a trough
        nodes = [np.argmin(np.linalg.norm(x - n - [0.0, 0.0, length / 2], axis=1)) for n in normals]
        crest, trough = (n @ u[node] for n, node in zip(normals, nodes, strict=True))
        height = (crest - trough) / 2 / h
        p_c = buckled.point.state.mu["pressure"]
        seen.append((height**2, (first.point.state.mu["pressure"] / p_c - 1) / height**2))
        assert p_c * first.scene.problem.material.classical_pressure == pytest.approx(
            critical, rel=2e-4
        )
    (x0, b0), (x1, b1) = seen
    assert b0 - x0 * (b1 - b0) / (x1 - x0) == pytest.approx(b, rel=0.02)


@pytest.mark.slow
def test_a_half_hands_over_to_the_whole_shell() -> None:
    """A shallow pinned arch of rise parameter 2.6 buckles to one side before its fold (Fung and
    Kaplan 1952).

    The half finds an antisymmetric mode; on its branch, in the whole shell, the load falls.
    """
    shell = {
        "geometry": "plate",
        "length": 1.0,
        "width": 0.05,
        "thickness": 0.01,
        "youngs_modulus": 1.0,
    }
    shell |= {
        "poisson_ratio": 0.0,
        "imperfections": [{"kind": "formula", "w0": "sin(pi*x)", "amplitude": 1.50111}],
    }
    dead = {
        "over": "all",
        "per_area": ["0", "0", f"{-4 * pi**4 / 12 * 1e-8 * 0.577350269 / 2 / 2!r}*sin(pi*x)"],
    }
    load = {"kind": "dead", "loads": [dead], "until": "bifurcation", "then": "follow", "points": 2}
    case = {
        "shell": shell,
        "boundary": {"left": "hinged", "right": "hinged"},
        "mesh": {"size": 0.05},
        "loading": load,
    }
    records = list(follow(Scene(problem_of(case)), remark=lambda said: None))
    old, new = next((a, b) for a, b in pairwise(records) if a.mode == "antisymmetric")
    assert old.scene
    assert new.scene
    assert (old.scene.model.multiplicity, new.scene.model.multiplicity) == (2, 1)
    assert new.point.state.mu["load"] == pytest.approx(old.point.state.mu["load"], rel=1e-6)
    one, two = old.scene.observe(old.point.state), new.scene.observe(new.point.state)
    assert two["energy"] == pytest.approx(one["energy"], rel=1e-5)
    phi = critical_mode(new.scene.newton, new.point.state)
    assert abs(phi.eigenvalue) < 1e-9
    assert records[-1].point.state.mu["load"] < old.point.state.mu["load"]
    alone = list[Record]()
    with pytest.raises(
        Stopped, match="in which nothing is read for this command"
    ):  # as `identify` follows it
        alone.extend(follow_alone(old.scene, remark=lambda said: None))


@pytest.mark.slow
def test_a_torus_that_is_closed_in_both_directions() -> None:
    """Held at four points; its half hands an antisymmetric mode over to all of it, which finds the
    branch alone too.
    """
    around = {"a": [1.4, 0, 0], "b": [-1.4, 0, 0], "c": [0, 1.4, 0], "d": [0, -1.4, 0]}
    held = {"a": ["x", "y", "z"], "b": ["y", "z"], "c": ["z"], "d": ["z"]}
    case = {
        "shell": {
            "geometry": "torus",
            "radius": 1.0,
            "tube_radius": 0.4,
            "thickness": 0.08,
            "poisson_ratio": 0.3,
        },
        "points": around,
        "boundary": {name: {"held": axes} for name, axes in held.items()},
        "mesh": {"degree": 3, "refinement": 0.5},
        "loading": FOLLOWED | {"points": 2},
    }
    half, whole = (
        list(follow(Scene(problem_of(case | {"symmetry": how})), remark=lambda said: None))
        for how in ("auto", "none")
    )
    assert next(record.mode for record in half if record.label == "bifurcation") == "antisymmetric"
    ends = [records[-1] for records in (half, whole)]
    assert [end.scene.model.multiplicity for end in ends if end.scene] == [1, 1]
    loads, volumes = (
        [of(end.scene, end.point.state) for end in ends if end.scene]
        for of in (
            lambda scene, state: state.mu["pressure"],
            lambda scene, state: scene.model.system.potential(state.u, state.mu, "pressure"),
        )
    )
    assert loads[0] == pytest.approx(loads[1], rel=1e-6)
    assert volumes[0] == pytest.approx(volumes[1], rel=1e-6)


@pytest.mark.slow
def test_a_branch_goes_on_after_an_interruption_and_on_several_ranks(tmp_path: Path) -> None:
    """The same path as an uninterrupted run on one rank."""
    case = tmp_path / "case.yaml"
    case.write_text(
        "shell: {geometry: cap, radius: 1, thickness: 0.01, polar: 30, poisson_ratio: 0.3}\n"
        "boundary: {rim: clamped}\n"
        "loading: {kind: pressure, until: bifurcation, then: follow, points: 2}\n"
    )
    one, cut = tmp_path / "one", tmp_path / "cut"
    assert magshell("run", case, "--out", one, "--no-pictures").returncode == 0
    wanted = read_path(one)
    content = (one / "fields" / "path.pvd").read_text()
    assert content.count("point_") == len(wanted)
    magshell("run", case, "--out", cut, "--no-pictures", "--time-limit", "2")
    assert magshell("run", case, "--out", cut, "--no-pictures", "--resume").returncode == 0
    out = tmp_path / "ranks_2"
    assert magshell("run", case, "--out", out, "--no-pictures", ranks=2).returncode == 0
    for folder in (cut, out):
        for row, there in zip(read_path(folder), wanted, strict=True):
            assert (row["label"], row["mode"], row["excluded_pivots"]) == (
                there["label"],
                there["mode"],
                there["excluded_pivots"],
            )
            for column in ("p_over_pc", "w_over_h", "energy"):
                assert float(row[column]) == pytest.approx(
                    float(there[column]), rel=1e-5, abs=1e-12
                )


@pytest.mark.slow
def test_results_of_a_run_that_has_handed_over(tmp_path: Path) -> None:
    """Gradients of the instability are of the first model, those at the end of the last;
    differences of runs agree.
    """
    target = "{kind: pressure, control: load, until: target, pressure: 0.505, points: 1}"
    text = (
        "shell: {geometry: cap, radius: 1, thickness: %r, polar: 30, poisson_ratio: 0.3}\n"
        "boundary: {rim: clamped}\n"
        "loading: [{kind: pressure, until: bifurcation, then: follow, points: 6}, %s]\n"
    )
    coarse = "mesh={degree: 3, refinement: 0.7}"
    asked = "gradients={of: [knockdown, volume_change], by: [shell.thickness]}"
    found = dict[float, Any]()
    for h in (0.00999, 0.01001, 0.01):
        case = tmp_path / f"{h}.yaml"
        case.write_text(text % (h, target))
        more = ["--set", asked] if h == 0.01 else []
        out = tmp_path / f"{h}"
        assert (
            magshell("run", case, "--set", coarse, *more, "--out", out, "--no-pictures").returncode
            == 0
        )
        last = float(read_path(out)[-1]["volume_change"])
        found[h] = json.loads((out / "summary.json").read_text()) | {"volume_change": last}
    slopes = found[0.01]["gradients"]
    assert slopes["knockdown"]["value"] == pytest.approx(found[0.01]["knockdown"], rel=1e-6)
    for of in ("knockdown", "volume_change"):
        by_difference = (found[0.01001][of] - found[0.00999][of]) / 2e-5
        assert slopes[of]["numbers"]["shell.thickness"] == pytest.approx(by_difference, rel=2e-3)


@pytest.mark.slow
def test_a_tolerance_holds_on_the_branch() -> None:
    """The first mesh of the sector has 3 % of error; that of the run less than 1 %, as a mesh of
    degree 5 says.

    The load there at the same volume lies beside by less than the estimate, and more than a quarter
    of it.
    """
    problem = problem_of({**CAP, "mesh": {"tolerance": 0.01}})
    result = run(problem)
    chosen, estimate = result.adapted, result.branch_error
    assert chosen
    assert chosen.branch
    assert estimate
    assert chosen.branch.rounds[0].estimate > 0.02
    assert chosen.branch.best.estimate < 0.01
    assert estimate < 0.01
    assert any("at the end of the branch" in said for said in result.remarks)
    record = result.record
    assert record.scene
    end = at_target(record.scene, record)
    fine = Choice(5, 2.0).scene(record.scene.problem, record.scene.comm)
    found = near_by(fine, record.scene, end)
    assert found
    assert estimate / 4 < abs(end.value / found.value - 1) < estimate
    again = Adapted.from_json(problem, chosen.to_json())  # of a resumed run
    assert again.branch
    assert again.branch.best == chosen.branch.best
    assert again.branch.choice.size
    assert again.branch.choice.size(np.array([0.2, 0.1])) == chosen.branch.choice.size(
        np.array([0.2, 0.1])
    )  # type: ignore[misc]
