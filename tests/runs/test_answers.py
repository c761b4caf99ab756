"""Runs whose answer is there: what is beyond it is a remark, and pictures show the point that the
headline names.
"""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command import magshell, read_path

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.output.pictures.plot import draw
from magshell_fenicsx.public import run
from magshell_fenicsx.simulate.adapt.choice import Adapted, AdaptiveRound, Choice
from magshell_fenicsx.simulate.follow import BEYOND_INSTABILITY, follow
from magshell_fenicsx.simulate.path_records import TINY_STEPS, _StageRecords, creeping_remark

MESH = {"degree": 3, "refinement": 0.7}


def case_of(shell: dict[str, Any], edge: dict[str, str], **sections: Any) -> Case:
    return Case.from_source({"shell": shell, "boundary": edge, "mesh": MESH} | sections)


def dimpled(radius: float, amplitude: float, **load: Any) -> Case:
    defect = {"kind": "dimple", "amplitude": amplitude, "width": 2.5}
    shell = {
        "geometry": "hemisphere",
        "radius_to_thickness": radius,
        "poisson_ratio": 0.3,
        "defect": defect,
    }
    return case_of(shell, {"equator": "clamped"}, loading={"kind": "pressure"} | load)


def in_units(polar: float, thickness: str, **sections: Any) -> dict[str, Any]:
    shell = {"geometry": "cap", "radius": "30 mm", "thickness": thickness, "polar": polar}
    shell |= {"youngs_modulus": "1.5 MPa", "poisson_ratio": 0.49}
    return {"shell": shell, "boundary": {"rim": "clamped"}} | sections


def test_load_control_locates_the_fold() -> None:
    """As volume control does; nothing is wrong beyond it."""
    found, known = (
        run(dimpled(50, 1.0, control=control, until="limit")) for control in ("load", "volume")
    )
    assert (found.stopped, found.remarks) == (None, [])
    assert found.knockdown == pytest.approx(known.knockdown, rel=1e-7)
    assert found.rows[-1]["label"] == "fold"


@pytest.mark.slow
def test_volume_that_turns_just_behind_the_fold() -> None:
    """Of a very thin shell; volume control cannot hold it, arc length alone gives the same k_d."""
    found, known = (run(dimpled(20_000, 0.5, **control)) for control in ({}, {"control": "arc"}))
    assert (found.stopped, found.remarks) == (None, [])
    assert found.knockdown == pytest.approx(known.knockdown, rel=1e-7)


PERFECT = in_units(60, "0.3 mm", mesh=MESH, loading={"kind": "pressure", "until": "limit"})


@pytest.mark.slow
def test_path_that_is_lost_beyond_the_first_instability(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same k_d as with until: bifurcation, exit code 0, the reason as a remark, and pictures of
    that point.
    """
    monkeypatch.setattr("magshell_fenicsx.simulate.steps.MAX_STEPS", 9)
    (tmp_path / "cap.yaml").write_text(json.dumps(PERFECT), encoding="utf-8")
    done = magshell("run", tmp_path / "cap.yaml", "--out", tmp_path / "limit")
    assert (done.returncode, done.stderr) == (0, "")
    *_, headline = done.stdout.splitlines()
    assert "The shell buckles at" in headline
    assert "Beyond the first instability the path stopped: " in headline
    summary = json.loads((tmp_path / "limit" / "summary.json").read_text(encoding="utf-8"))
    assert summary["stopped"] is None
    assert [remark.startswith(BEYOND_INSTABILITY) for remark in summary["remarks"]] == [True]
    first = next(row for row in read_path(tmp_path / "limit") if row["label"] == "bifurcation")
    number = int(first["point"])
    assert number < summary["points"] - 3
    draw(tmp_path / "limit", number)
    pictures = [
        (tmp_path / "limit" / name).read_bytes()
        for name in ("shell.png", f"shell_{number:04d}.png")
    ]
    assert pictures[0] == pictures[1]
    report = (tmp_path / "limit" / "report.html").read_text(encoding="utf-8")
    assert f"Bending moments at point {number}, the first instability." in report
    known = run(
        Case.from_source(PERFECT | {"loading": {"kind": "pressure", "until": "bifurcation"}})
    )
    assert summary["knockdown"] == pytest.approx(known.knockdown, rel=1e-9)


def test_python_hears_what_is_beyond(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("magshell_fenicsx.simulate.steps.MAX_STEPS", 9)
    with pytest.warns(UserWarning, match=BEYOND_INSTABILITY):
        labels = [record.label for record in follow(Scene(Case.from_source(PERFECT)))]
    assert "bifurcation" in labels


def test_path_that_is_lost_before_an_instability_is_no_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("magshell_fenicsx.simulate.steps.MAX_STEPS", 3)
    found = run(Case.from_source(PERFECT))
    assert found.stopped
    assert (found.remarks, found.knockdown) == ([], None)


@pytest.mark.slow
def test_snap_of_a_shell_that_has_buckled_before() -> None:
    """A shallow cap has waves before its fold; the remark names the first of them, which the path
    has located.
    """
    load = {"kind": "pressure", "until": "limit", "then": "snap"}
    data = in_units(25, "0.6 mm", mesh=MESH, loading=load) | {"boundary": {"rim": "hinged"}}
    heard, records = list[str](), list[Any]()
    for record in follow(Scene(Case.from_source(data)), remark=heard.append):
        records.append(record)
        if record.amplitude == "time":
            break
    first = next(record for record in records if record.label == "bifurcation")
    fold = next(record for record in records if record.label == "fold")
    assert fold.excluded_pivots > 1
    (remark,) = heard
    assert f"{fold.excluded_pivots} modes that the model excludes are unstable" in remark
    assert f"({first.mode}) since pressure = {first.point.state.mu['pressure']:.6g} (" in remark


@pytest.mark.slow
def test_plate_on_a_deep_cap_snaps() -> None:
    """Where it snaps a finer mesh (refinement 2) has 5.40719 h; behind it the contact goes back the
    way it came.
    """
    loading = {"kind": "contact", "approach": "8 mm", "points": 10}
    data = in_units(40, "0.5 mm", bodies={"plate": {"kind": "plane"}}, loading=loading)
    found = run(Case.from_source(data))
    (fold,) = (row for row in found.rows if row["label"] == "fold")
    assert fold["approach_over_h"] == pytest.approx(5.40719, rel=1e-3)
    assert found.stopped
    assert (
        "at its fold the shell snaps under a given approach; the last fold is at approach = 5.4"
        in found.stopped
    )
    assert found.rows[-1]["approach_over_h"] > 5


def test_line_of_a_fold_has_the_force_of_its_body() -> None:
    """Of two bodies; the column `force` is of no body then."""
    ball = {
        "kind": "sphere",
        "radius": "3 mm",
        "side": "inside",
        "position": ["0 mm", "0 mm", "10 mm"],
    }
    bodies = {"plate": {"kind": "plane"}, "ball": ball | {"direction": [0, 0, 1]}}
    loading = {"kind": "contact", "body": "plate", "until": "limit"}
    lines = list[str]()
    found = run(
        Case.from_source(in_units(22, "0.5 mm", bodies=bodies, loading=loading)), say=lines.append
    )
    fold = next(line for line in lines if " fold " in line)
    assert found.rows[-1]["force_plate_N"] == pytest.approx(0.0696, rel=1e-3)
    assert f"F {found.rows[-1]['force_plate_N']:9.5g} N" in fold


@pytest.mark.slow
def test_best_estimate_of_a_meridian_is_kept(tmp_path: Path) -> None:
    """A field and a pressure on a dimple at the pole; the finer mesh is twice as fine."""
    shell = {"geometry": "hemisphere", "radius_to_thickness": 80, "poisson_ratio": 0.49}
    shell |= {"imperfections": [{"kind": "gaussian", "amplitude": 0.5, "width": 2}]}
    field = {"lambda_m": 0.0005, "remanent": {"polar": 0}, "applied": {"polar": 0}}
    data = {"shell": shell, "boundary": {"equator": "clamped"}, "magnetic": field}
    data |= {"loading": {"kind": "pressure", "until": "limit"}}
    (tmp_path / "case.yaml").write_text(
        json.dumps(data | {"mesh": {"tolerance": 1e-4}}), encoding="utf-8"
    )
    done = magshell("run", tmp_path / "case.yaml", "--out", tmp_path / "out", "--no-pictures")
    assert done.returncode == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    known = summary["tolerance"]
    assert known["error_estimate"] == min(each["estimate"] for each in known["rounds"])
    exact = run(Case.from_source(data | {"mesh": {"degree": 5, "refinement": 2.0}})).knockdown
    assert summary["knockdown"] == pytest.approx(exact, rel=max(known["error_estimate"], 1e-8))
    told = re.search(
        r" The estimated relative error of the result is (\S+)\.$", done.stdout.rstrip()
    )
    assert told
    assert float(told[1]) == pytest.approx(known["error_estimate"], rel=0.05)


def test_better_round_than_that_of_the_mesh_that_is_taken() -> None:
    """Of a surface. A coarser mesh within the tolerance is cheaper: both numbers are there."""
    rounds = [
        AdaptiveRound(3, 0.5, 300, 5000, 0.330001, 2e-6),
        AdaptiveRound(3, 0.4, 200, 3000, 0.3301, 5e-4),
    ]
    made = Adapted(dimpled(50, 1.0).problem(), Choice(3, 0.4), rounds[1], rounds)
    known = made.account(0.3301)
    assert (known["error_estimate"], known["best"]) == (
        5e-4,
        {"result": 0.330001, "error_estimate": 2e-6},
    )
    assert made.account(0.5)["best"] is None


def test_line_names_the_watched_point() -> None:
    """The first named point of a case in place of the pole, where it is not the loaded point."""
    case = Case.from_source(
        in_units(22, "0.5 mm", points={"side": ["0 mm", "6 mm", "29.39387691 mm"]})
        | {"loading": {"kind": "indentation", "depth": 0.1, "points": 1}, "mesh": MESH}
    )
    lines = list[str]()
    found = run(case, say=lines.append)
    last = next(line for line in lines if " target " in line)
    assert f"side {found.rows[-1]['w_pole_mm']:9.5g} mm" in last
    assert "pole" not in last


def test_snap_onto_a_shell_is_told_before() -> None:
    """What is faster than its landing; not where that is taken already."""
    shell = {"geometry": "cap", "radius": 1, "polar": 20, "thickness": 0.02}
    shell |= {"youngs_modulus": 1, "poisson_ratio": 0.3}
    upper = {"shell": shell, "boundary": {"rim": "hinged"}, "place": {"position": [0, 0, 0.06]}}
    lower = {"shell": shell, "boundary": {"rim": "hinged"}}
    data = {"shells": {"lower": lower, "upper": upper}, "contact": [["upper", "lower"]]}
    load = {"kind": "pressure", "on": {"upper": "outside"}, "until": "limit", "then": "snap"}

    def told(**keys: Any) -> str:
        return "".join(Case.from_source(data | {"loading": load | keys}).problem().warnings)

    assert re.search("control: arc", told())
    assert not told(snap={"errors": "step"})


def test_creeping_contact_is_told() -> None:
    """Once, after enough tiny steps, with a size of elements in the case's unit."""
    data = in_units(22, "0.5 mm", bodies={"plate": {"kind": "plane"}}, mesh=MESH)
    scene = Scene(Case.from_source(data | {"symmetry": "half"}))
    records = object.__new__(_StageRecords)
    records._stage = SimpleNamespace(scene=scene)  # type: ignore[assignment]
    steps = [0, 1, *(1 + 1e-6 * np.arange(1, 2 * TINY_STEPS))]

    def said_on(
        steps: Sequence[float], control: str, *targets: float, name: str = "approach_plate"
    ) -> list[str]:
        """What is said at each of these values of s."""
        records._tiny_steps = []
        points = [SimpleNamespace(s=s) for s in steps]
        path = SimpleNamespace(control=control, name=name)
        goal = SimpleNamespace(targets=targets)
        course = SimpleNamespace(points=points, path=path, goal=goal)
        return [
            records._remark_on_tiny_steps(course, point)  # type: ignore[arg-type]
            for point in points
        ]

    said = said_on(steps, "arc")
    even = np.linspace(0, 1, 40)
    assert not any(said_on(even, "arc"))
    assert any(said_on(1e-6 * even, "load", 1.0))
    assert [bool(text) for text in said].index(True) == 1 + TINY_STEPS
    size = 0.4 * np.sqrt(30 * 0.5)
    assert [text for text in said if text] == [creeping_remark(scene)]
    said_of_a_load = said_on(steps, "arc", name="pressure")
    assert [text for text in said_of_a_load if text] == [
        f"{creeping_remark(scene)}; or control: load"
    ]
    assert creeping_remark(scene).endswith(f"mesh.size: {size:.2g} mm")
    assert creeping_remark(Scene(Case.from_source(data))).endswith("mesh.refinement: 1.4")
