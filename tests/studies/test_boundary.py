"""Boundaries of stability: a shallow arch against its closed form and against runs, resume, and
what is refused.
"""

import atexit
import csv
import json
import shutil
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import magshell, read_path, started
from conftest import CAP, CASES
from matplotlib.figure import Figure
from scipy.optimize import brentq
from scipy.special import jv, jvp

import magshell_fenicsx as ms
from magshell_fenicsx import Case
from magshell_fenicsx.case.planner import document_of
from magshell_fenicsx.input.source import CaseError, read_source
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.scene_cache import problem_on_moved_mesh
from magshell_fenicsx.studies.boundary.picture import _regions, draw_map
from magshell_fenicsx.studies.boundary.start import with_texts


def saved_figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are saved from now on."""
    figures, save = list[Figure](), Figure.savefig

    def keep_and_save(figure: Figure, *arguments: Any, **keywords: Any) -> None:
        figures.append(figure)
        save(figure, *arguments, **keywords)

    monkeypatch.setattr(Figure, "savefig", keep_and_save)
    return figures


def coarse() -> Path:
    """The case "arch_boundary.yaml" with larger elements, in a folder that is removed as the
    process ends.
    """
    folder = Path(tempfile.mkdtemp(prefix="arch"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    text = (CASES / "arch_boundary.yaml").read_text(encoding="utf-8")
    assert text.count("size: 0.05") == 1
    (folder / "arch_boundary.yaml").write_text(
        text.replace("size: 0.05", "size: 0.1"), encoding="utf-8"
    )
    return folder / "arch_boundary.yaml"


ARCH = coarse()
KEY = "loading.0.factor"


def folds(*settings: str) -> list[float]:
    """The loads of all folds of a run."""
    onward = ["loading.1.until=points", "loading.1.points=80"]
    scene = ms.Scene(ms.Case.load(ARCH, [*settings, *onward]))
    return [r.point.state.mu["load"] for r in ms.follow(scene) if r.label == "fold"]


def test_snapping_begins_at_a_rise_of_one(tmp_path: Path) -> None:
    """Fung and Kaplan (NACA TN 2840): folds at a load of 2 e -+ 4 ((e^2 - 1)/3)^(3/2), here for a/h
    = 1/100.

    In the unknown a of the first sine the load is 2 (e - a) + 2 a (e^2 - a^2), stationary at 3 a^2
    = e^2 - 1.
    """
    done = magshell(
        "boundary",
        ARCH,
        "--over",
        f"{KEY}=0.7:1.3:4",
        "--set",
        f"{KEY}=1.2",
        "--out",
        tmp_path / "b",
    )
    assert done.returncode == 0, done.stderr
    assert "a cusp, where two folds are born" in done.stdout
    rows = list(csv.DictReader((tmp_path / "b" / "boundary.csv").open()))
    assert (tmp_path / "b" / "boundary.png").exists()
    (cusp,) = (row for row in rows if row["kind"] == "cusp")
    assert float(cusp["key"]) == pytest.approx(1.0, abs=1e-4)
    assert float(cusp["load"]) == pytest.approx(2.0, rel=1e-3)
    assert {row["kind"] for row in rows} == {"cusp", "fold"}
    assert float(rows[0]["key"]) == float(rows[-1]["key"]) == 1.3
    for row in rows:
        rise, load = float(row["key"]), float(row["load"])
        half = 4 * (max(rise**2 - 1, 0) / 3) ** 1.5
        assert min(abs(load - 2 * rise - half), abs(load - 2 * rise + half)) < 2e-3


@pytest.mark.slow
def test_against_runs_through_the_cusp(tmp_path: Path) -> None:
    """Load 1e-7 of that of runs at the same rise; 20 points cost at most four runs to the fold."""
    found = ms.boundary(ARCH, f"{KEY}=0.7:1.6:12", out=tmp_path / "b")
    assert not found.stopped
    ordinary = [row for row in found.rows if row["kind"] == "fold"]
    assert len(ordinary) >= 12
    for row in ordinary[:: len(ordinary) // 12]:
        of_runs = folds(f"{KEY}={row['key']!r}")
        assert min(abs(load - row["load"]) for load in of_runs) < 1e-7 * abs(row["load"])
    work = found.content["factorisations"]
    assert 20 * work["boundary"] / len(found.rows) < 4 * work["run"]


@pytest.mark.slow
def test_a_number_of_the_shape(tmp_path: Path) -> None:
    """The drawn rise in place of the grown one, in scenes made again: against runs, 1e-7."""
    key = "shell.imperfections.0.amplitude"
    fixed = [f"{KEY}=1"]
    found = ms.boundary(ARCH, f"{key}=0.75:0.85:2", [*fixed, f"{key}=0.8"], tmp_path / "b")
    for row in (found.rows[0], found.rows[-1]):
        assert (
            min(abs(load - row["load"]) for load in folds(*fixed, f"{key}={row['key']!r}"))
            < 1e-7 * row["load"]
        )


@pytest.mark.slow
def test_a_caps_fold_vanishes_with_the_order_three_halves(tmp_path: Path) -> None:
    """Over its depth: the cusp is the same from two starts to 1e-6, and beyond it both loads differ
    by c d^(3/2).
    """
    case = tmp_path / "cap.yaml"
    case.write_text(
        "shell: {geometry: cap, radius: 1, thickness: 0.01, polar: 12, poisson_ratio: 0.3}\n"
        "boundary: {rim: clamped}\n"
        "symmetry: axisymmetric\nloading: {kind: pressure, until: limit}\n"
    )
    cusps, depths, gaps = list[float](), (10.533, 10.548), list[float]()
    for i, depth in enumerate(depths):
        found = ms.boundary(case, f"shell.polar=10.4:{depth}:3", out=tmp_path / f"{i}")
        (cusp,) = found.special
        assert cusp["kind"] == "cusp"
        assert found.rows[0]["key"] == found.rows[-1]["key"] == depth
        cusps.append(cusp["key"])
        gaps.append(abs(found.rows[0]["load"] - found.rows[-1]["load"]))
    assert cusps[0] == pytest.approx(cusps[1], rel=1e-6)
    order = np.log(gaps[1] / gaps[0]) / np.log((depths[1] - cusps[0]) / (depths[0] - cusps[0]))
    assert order == pytest.approx(1.5, abs=0.005)


@pytest.mark.slow
def test_higher_arches_buckle_to_one_side(tmp_path: Path) -> None:
    """Before the fold from sqrt(5.5) on; that boundary turns at 2, both in the limit of shallow
    arches.
    """
    found = ms.boundary(ARCH, f"{KEY}=1.8:2.7:8", [f"{KEY}=2.6"], tmp_path / "b")
    assert found.content["kind"] == "bifurcation"
    places = {
        kind: [row["key"] for row in found.special if row["kind"] == kind]
        for kind in ("meeting", "turn")
    }
    assert places["turn"] == pytest.approx([2.0], rel=1e-3)
    assert places["meeting"] == pytest.approx(2 * [np.sqrt(5.5)], rel=1e-3)
    assert found.rows[-1]["unstable"] == 0


@pytest.mark.slow
def test_a_mode_has_one_name_in_both_files(tmp_path: Path) -> None:
    """A high arch buckles to one side: path.csv of its half and boundary.csv, on the whole, call it
    antisymmetric."""
    setting = f"{KEY}=2.6"
    run = magshell("run", ARCH, "--set", setting, "--out", tmp_path / "run", "--no-pictures")
    assert run.returncode == 0, run.stderr
    first = next(row for row in read_path(tmp_path / "run") if row["label"] == "bifurcation")
    found = ms.boundary(ARCH, f"{KEY}=2.59:2.6:1", [setting], tmp_path / "b")
    assert {row["mode"] for row in found.rows} == {first["mode"]} == {"antisymmetric"}
    assert found.content["mode"] == "antisymmetric"


@pytest.mark.slow
def test_another_branch_from_a_point_of_a_run(tmp_path: Path) -> None:
    """The symmetric fold beyond the bifurcation, which the case alone does not start from, by its
    closed form.
    """
    run, onward = tmp_path / "run", ["loading.1.until=points", "loading.1.points=40", f"{KEY}=2.6"]
    words = [word for setting in onward for word in ("--set", setting)]
    assert magshell("run", ARCH, *words, "--out", run, "--no-pictures").returncode == 0
    located = {
        row["label"]: row["point"]
        for row in read_path(run)
        if row["label"] in ("fold", "bifurcation")
    }
    over = ["boundary", ARCH, "--over", f"{KEY}=2.4:2.7:2", "--out", tmp_path / "b"]
    done = magshell(*over, "--from", f"{run}:{located['fold']}")
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((tmp_path / "b" / "boundary.csv").open()))
    assert (float(rows[0]["key"]), float(rows[-1]["key"])) == (2.4, 2.7)
    for row in rows:
        rise = float(row["key"])
        assert row["kind"] == "fold"
        assert float(row["load"]) == pytest.approx(
            2 * rise + 4 * ((rise**2 - 1) / 3) ** 1.5, rel=3e-3
        )
    other = ms.boundary(
        ARCH, f"{KEY}=2.6:2.7:1", out=tmp_path / "c", start=f"{run}:{located['bifurcation']}"
    )
    alone = ms.boundary(ARCH, f"{KEY}=2.6:2.7:1", [f"{KEY}=2.6"], out=tmp_path / "d")
    assert [row["load"] for row in other.rows] == pytest.approx(
        [row["load"] for row in alone.rows], rel=1e-7
    )
    for start, said in (
        (
            f"{run}:0",
            (
                f"is no fold or bifurcation of this run; these are {located['bifurcation']} "
                "(bifurcation), "
            ),
        ),
        (f"{run}", "write it as DIR:POINT"),
        (f"{tmp_path}:1", "path.csv"),
    ):
        refused = magshell(*over, "--from", start)
        assert refused.returncode == 2
        assert said in refused.stderr
    outside = magshell(
        "boundary", ARCH, "--over", f"{KEY}=1:2", "--from", f"{run}:{located['fold']}"
    )
    assert outside.returncode == 2
    assert "has 2.6, outside the range" in outside.stderr
    both = magshell(
        *over, "--over", "foundation.stiffness=1e-9,1e-4", "--from", f"{run}:{located['fold']}"
    )
    assert both.returncode == 2
    assert "a map starts at the end of each of its cases" in both.stderr


class Killed(Exception):
    pass


def test_a_stored_case_has_its_units_again() -> None:
    """A run stores 0.09 for 90 mT, and the case of the run is one with units still."""
    source = read_source(CASES / "bistable_dome.yaml")
    stored = document_of(Case.from_source(source)).data | {"reactions": True}
    stored["shell"] |= {"polar": 30}
    data = with_texts(stored, document_of(Case.from_source(source)).data, source.data)
    assert data["magnetic"]["remanent"]["flux_density"] == "90 mT"
    assert (data["shell"]["radius"], data["shell"]["polar"]) == ("10 mm", 30)
    assert document_of(Case.from_source(data)).data == stored


@pytest.mark.slow
def test_from_a_point_on_two_ranks_and_after_an_interruption(tmp_path: Path) -> None:
    """The lower fold, which a case does not end at: the same rows on one rank and on two, whole and
    in two parts.
    """
    run = tmp_path / "run"
    words = [f"{KEY}=1.3", "loading.1.until=points", "loading.1.points=80"]
    settings = [word for setting in words for word in ("--set", setting)]
    assert magshell("run", ARCH, *settings, "--out", run, "--no-pictures").returncode == 0
    start = f"{run}:{[row['point'] for row in read_path(run) if row['label'] == 'fold'][1]}"
    over, said = f"{KEY}=1.28:1.32:1", list[str]()
    done = started(
        "boundary", ARCH, "--over", over, "--from", start, "--out", tmp_path / "two", ranks=2
    )
    assert done.returncode == 0, done.stderr
    two = list(csv.DictReader((tmp_path / "two" / "boundary.csv").open()))
    assert [float(two[i]["key"]) for i in (0, -1)] == [1.28, 1.32]

    def killed(line: str) -> None:
        said.append(line)
        if len(said) == 3:
            raise Killed

    with pytest.raises(Killed):
        ms.boundary(ARCH, over, out=tmp_path / "b", say=killed, start=start)
    kept = {
        file: file.stat().st_mtime_ns for file in (tmp_path / "b" / "points").glob("*down*.json")
    }
    assert kept
    again = ms.boundary(ARCH, over, out=tmp_path / "b", start=start)
    assert all(file.stat().st_mtime_ns == then for file, then in kept.items() if file.exists())
    for row, there in zip(again.rows, two, strict=True):
        rise = row["key"]
        assert (row["kind"], row["load"]) == (
            there["kind"],
            pytest.approx(float(there["load"]), rel=1e-9),
        )
        assert row["load"] == pytest.approx(2 * rise - 4 * ((rise**2 - 1) / 3) ** 1.5, rel=3e-3)


def test_an_interrupted_boundary_goes_on(tmp_path: Path) -> None:
    """The same numbers, and no solve twice."""
    over, settings = f"{KEY}=1.25:1.3:2", [f"{KEY}=1.3"]
    said: list[str] = []

    def killed(line: str) -> None:
        said.append(line)
        if len(said) == 3:
            raise Killed

    with pytest.raises(Killed):
        ms.boundary(ARCH, over, settings, tmp_path / "b", say=killed)
    kept = {
        file.name: file.stat().st_mtime_ns
        for file in (tmp_path / "b" / "points").glob("*down-*.json")
    }
    assert len(kept) >= 3
    seen: list[str] = []
    again = ms.boundary(ARCH, over, settings, tmp_path / "b", say=seen.append)
    whole = ms.boundary(ARCH, over, settings, tmp_path / "whole")
    assert again.rows == whole.rows
    assert seen[1:3] == said[1:3]


@pytest.mark.parametrize(
    ("over", "settings", "said"),
    [
        ("loading.0.factor", [], "write it as key.path=first:last"),
        (f"{KEY}=1:1", [], "two different finite numbers"),
        (f"{KEY}=1:1.5:0", [], "allowed 1 to 1000"),
        ("mesh.size=0.1:0.2", [], "is no part of the shell or of its loads"),
        ("boundary.left=1:2", [], "boundary.left"),
        ("shell.poisson_ratio=0:0.9", [], "shell.poisson_ratio"),
        ("shell.density=1:2", [], "it has no influence on this instability"),
        (
            f"{KEY}=1:1.6",
            ["loading.1.until=target", "loading.1.factor=0.5"],
            "the case ends without an instability",
        ),
    ],
)
def test_what_is_no_boundary(tmp_path: Path, over: str, settings: list[str], said: str) -> None:
    with pytest.raises(CaseError, match=said):
        ms.boundary(ARCH, over, settings, tmp_path / "b")


@pytest.mark.telling
def test_through_a_field_of_zero(tmp_path: Path) -> None:
    """Where the case starts; at the ends against the axisymmetric reference of
    tests/cases/test_cases.py.
    """
    found = ms.boundary(
        CASES / "dimple_buckling.yaml", "magnetic.lambda_m=-0.00184:0.00184:3", out=tmp_path / "b"
    )
    ends = {row["key"]: row["load"] for row in (found.rows[0], found.rows[-1])}
    assert ends == pytest.approx({-0.00184: 0.120723848, 0.00184: 0.552053778}, rel=1e-6)
    assert not found.special


def test_a_load_is_in_the_units_of_the_case(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is said and drawn is the column in Pa: 2 E/sqrt(3 (1 - nu^2)) (h/R)^2 times the load of
    the same row.
    """
    drawn = saved_figures(monkeypatch)
    case = tmp_path / "cap.yaml"
    case.write_text(CAP)
    said: list[str] = []
    found = ms.boundary(
        case, "shell.youngs_modulus=1.3 MPa:1.31 MPa:1", out=tmp_path / "b", say=said.append
    )
    for row in found.rows:
        unit = 2e6 * row["key"] / np.sqrt(3 * (1 - 0.49**2)) * (0.8 / 40) ** 2
        assert row["pressure_Pa"] == pytest.approx(unit * row["load"], rel=1e-12)
        assert any(f"p = {row['pressure_Pa']:.9g} Pa" in line for line in said)
    (plot,) = drawn[0].axes
    assert plot.get_ylabel() == "pressure  $p$  (Pa)"
    heights = np.concatenate([line.get_ydata() for line in plot.lines])
    assert heights.min() == pytest.approx(min(row["pressure_Pa"] for row in found.rows))


@pytest.mark.slow
def test_a_map_of_boundaries(tmp_path: Path) -> None:
    """On springs the arch snaps later, or not at all. Each line is its case's boundary."""
    over, second = f"{KEY}=1.1:1.3:2", "foundation.stiffness=1e-12,1e-9,1e-4"
    out = tmp_path / "map"
    fixed = [f"{KEY}=1.3", "loading.1.until=target", "loading.1.factor=6"]
    words = [word for setting in fixed for word in ("--set", setting)]
    done = magshell("boundary", ARCH, "--over", over, "--over", second, *words, "--out", out)
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((out / "boundary.csv").open()))
    content = json.loads((out / "map.json").read_text())
    assert list(content["without"]) == ["1e-4"]
    assert "the case ends without an instability" in content["without"]["1e-4"]
    assert (out / "boundary.png").stat().st_size > 10_000
    alone = ms.boundary(ARCH, over, [*fixed, "foundation.stiffness=1e-9"], tmp_path / "alone")
    own = [row for row in rows if float(row["second"]) == 1e-9]
    assert [float(row["load"]) for row in own] == pytest.approx(
        [row["load"] for row in alone.rows], rel=1e-9
    )
    assert {float(row["second"]) for row in rows} == {1e-12, 1e-9}


@pytest.mark.parametrize(
    ("second", "said"),
    [
        (f"{KEY}=1:2:3", "the second key of a map is another number"),
        ("shell.law=koiter,neo-hookean", "the second key of a map is another number"),
        ("mesh.size=0.1,0.2", "the second key of a map is another number"),
        ("foundation.stiffness=1e-9:1e-9:3", "1e-09 stands twice"),
        ("foundation.stiffness=1e-9,0.001e-6", "0.001e-6 stands twice"),
        ("shell.nope=1,2", "--over shell.nope=1: shell.nope: unknown key"),
    ],
)
def test_what_is_no_map(tmp_path: Path, second: str, said: str) -> None:
    with pytest.raises(CaseError, match=said):
        ms.boundary(ARCH, [f"{KEY}=1.1:1.3:2", second], [], tmp_path / "b")
    with pytest.raises(CaseError, match="3 keys; a boundary takes one"):
        ms.boundary(ARCH, [f"{KEY}=1.1:1.3:2", second, second], [], tmp_path / "b")


def test_a_map_is_named_as_in_a_paper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Symbols for keys, signs of minus, words for loads; no second panel where all lines end by the
    same load.
    """
    drawn = saved_figures(monkeypatch)
    content = {
        "case": "a_map.yaml", "keys": ["shell.defect.amplitude", "magnetic.lambda_m"],
        "units": ["", ""], "range": [0.4, 2.0], "values": [-0.004, -0.002, 0.0], "load": "pressure",
    }  # fmt: skip
    loads = {-0.002: "pressure", -0.004: "lambda_m"}
    rows = [
        {
            "second": second,
            "amplitude": load,
            "key": key,
            "load": key / 4,
            "kind": "fold",
            "unstable": 0,
        }
        for second, load in loads.items()
        for key in (0.4, 1.0, 2.0)
    ]
    draw_map(rows, content, tmp_path / "both.png")
    draw_map(rows[:3], content | {"values": [-0.002]}, tmp_path / "one.png")
    both, one = drawn
    assert [axes.get_xlabel() for axes in both.axes] == 2 * ["amplitude over $h$"]
    assert both.axes[1].get_ylabel() == r"field  $\lambda_\mathrm{m}$"
    assert [text.get_text() for text in both.axes[0].get_legend().get_texts()] == ["−0.002"]
    said = [text.get_text() for text in both.axes[1].get_legend().get_texts()]
    assert said == ["by the pressure", "by the field", "nowhere"]
    assert len(one.axes) == 1


@pytest.mark.slow
def test_the_number_of_waves_changes_along_a_boundary(tmp_path: Path) -> None:
    """Of a clamped cap over its depth: 3, then 4.

    Runs on both sides have these loads, one at the crossing both.
    """
    case, key = tmp_path / "cap.yaml", "shell.polar"
    case.write_text(
        "shell: {geometry: cap, radius: 1, thickness: 0.01, polar: 24.5, poisson_ratio: 0.3}\n"
        "boundary: {rim: clamped}\nloading: {kind: pressure, until: limit}\n"
    )

    def run(depth: float) -> dict[str, float]:
        """The loads of all waves, in their order, on the mesh of the boundary: that of the case,
        stretched.
        """
        start = ms.Scene(ms.Case.load(case))
        scene = Scene(
            problem_on_moved_mesh(start, ms.Case.load(case, [f"{key}={depth!r}"]).problem()),
            start.comm,
        )
        return {
            r.mode: r.point.state.mu["pressure"]
            for r in ms.follow(scene)
            if r.mode.startswith("m = ")
        }

    done = magshell("boundary", case, "--over", f"{key}=24:26:2", "--out", tmp_path / "b")
    assert done.returncode == 0, done.stderr
    assert "two bifurcations cross, m = 3, m = 4" in done.stdout
    rows = list(csv.DictReader((tmp_path / "b" / "boundary.csv").open()))
    modes = [row["mode"] for row in rows]
    at = modes.index("m = 3, m = 4")
    assert rows[at]["kind"] == "crossing"
    assert {*modes[:at]} == {"m = 3"}
    assert {*modes[at + 1 :]} == {"m = 4"}
    for row in (rows[0], rows[-1]):
        loads = run(float(row["key"]))
        assert next(iter(loads)) == row["mode"]
        assert float(row["load"]) == pytest.approx(loads[row["mode"]], rel=1e-7)
    loads = run(float(rows[at]["key"]))
    assert [loads["m = 3"], loads["m = 4"]] == pytest.approx(
        [float(rows[at]["load"])] * 2, rel=1e-6
    )
    content = json.loads((tmp_path / "b" / "boundary.json").read_text())
    named = {words for _, _, words in _regions(_numbers(rows), content, (0.0, 1.0))}
    assert named == {"stable", "buckles with m = 3", "buckles with m = 4"}
    assert (tmp_path / "b" / "boundary.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_number_of_waves_changes_with_the_thickness(tmp_path: Path) -> None:
    """Thinner caps have more waves, and more families are counted.

    The boundary goes on in its sense.
    """
    case = tmp_path / "cap.yaml"
    case.write_text(
        "shell: {geometry: cap, radius: 1, thickness: 0.01, polar: 24.5, poisson_ratio: 0.3}\n"
        "boundary: {rim: clamped}\nloading: {kind: pressure, until: limit}\n"
    )
    found = ms.boundary(case, "shell.thickness=0.0094:0.0104:2", out=tmp_path / "b")
    keys = [row["key"] for row in found.rows]
    assert keys == sorted(keys)
    assert [row["mode"] for row in found.rows if row["kind"] == "crossing"] == ["m = 3, m = 4"]
    assert (found.rows[0]["mode"], found.rows[-1]["mode"]) == ("m = 4", "m = 3")
    assert (keys[0], keys[-1]) == (0.0094, 0.0104)


def neutral_compression(stiffness: float, m: int) -> float:
    """N R²/D at which a clamped plate on a foundation k R⁴/D is neutral against m waves.

    Its deflection is A J_m(a r) + B J_m(b r) with a² + b² = N R²/D and a² b² = k R⁴/D.
    """

    def clamped(N: float) -> float:
        gap = np.sqrt(N**2 / 4 - stiffness)
        a, b = np.sqrt(N / 2 + gap), np.sqrt(N / 2 - gap)
        return float((a * jvp(m, a) * jv(m, b) - b * jv(m, a) * jvp(m, b)) / gap)

    lowest = 2 * np.sqrt(stiffness) * (1 + 1e-9)
    tried = np.linspace(lowest, lowest + 60, 600)[1:]
    low, high = next(pair for pair in pairwise(tried) if clamped(pair[0]) * clamped(pair[1]) < 0)
    return float(brentq(clamped, low, high))


@pytest.mark.slow
def test_where_three_modes_meet_the_first_is_followed(tmp_path: Path) -> None:
    """A clamped plate that grows on a foundation, by its Bessel functions: m = 1 up to k R⁴/D =
    722.62, then m = 0.

    There m = 2 is neutral at the same load, and beyond it comes later than m = 0, by 1 % at 1100.
    """
    thinness, nu, growth = 200, 0.3, 1e-3
    D, case = thinness**-3 / (12 * (1 - nu**2)), tmp_path / "plate.yaml"
    case.write_text(
        f"shell: {{geometry: disc, radius_to_thickness: {thinness}, poisson_ratio: {nu}}}\n"
        f"boundary: {{rim: clamped}}\nfoundation: {{stiffness: {700 * D!r}}}\n"
        f"natural: {{stretch: {1 + growth}}}\n"
        "loading: {kind: natural, grows: stretch, until: limit}\n"
    )
    found = ms.boundary(
        case, f"foundation.stiffness={650 * D!r}:{1100 * D!r}:4", out=tmp_path / "b"
    )
    assert not found.stopped
    assert {row["unstable"] for row in found.rows} == {0}
    meeting = brentq(lambda k: neutral_compression(k, 1) - neutral_compression(k, 2), 650, 800)
    met = [row["key"] / D for row in found.special]
    assert met[0] == pytest.approx(meeting, abs=0.1)
    assert met[-1] < meeting + 3  # the discrete modes 0 and 2 may come in another order so near
    for row in found.rows:
        k = row["key"] / D
        N = (
            12 * (1 + nu) * thinness**2 * growth * row["load"]
        )  # of a plate that cannot grow at its rim
        assert pytest.approx(min(neutral_compression(k, m) for m in range(4)), rel=5e-4) == N
        assert met[0] <= k <= met[-1] or row["mode"] == ("m = 1" if k < met[0] else "")


def _numbers(rows: list[dict[str, str]]) -> list[dict[str, Any]]:
    return [{**row, "key": float(row["key"]), "load": float(row["load"])} for row in rows]
