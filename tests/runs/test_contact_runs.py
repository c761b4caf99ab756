"""Runs in which a shell touches itself: on several ranks, and interrupted."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import all_started, magshell, read_path, started
from conftest import CASES
from interrupted import kill, start, wait_for_rows

from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.output.store.checkpoint import Checkpoint
from magshell_fenicsx.parts.contact.closest_points import ClosestPointSearch
from magshell_fenicsx.parts.contact.meridian_contact import MeridianContact
from magshell_fenicsx.shells.waves import Waves

THICK = [
    "--set=shell.thickness=0.08",
    "--set=shell.imperfections=[{kind: formula, w0: 0.3*(x**2 - y**2)}]",
    "--set=mesh={size: 0.3, degree: 3}",
    "--set=loading={kind: pressure, until: target, volume_change: -0.26, points: 1}",
    "--no-pictures",
]
PRESSED = 0.19  # 2 p R times the length at the end, in 2 pi D/R
EXACT = ("p_over_pc", "volume_change", "energy", "contact_force", "contact_gap_over_h")


def command(out: Path) -> list[str]:
    return ["run", str(CASES / "collapsing_tube.yaml"), *THICK, "--out", str(out)]


@pytest.mark.slow
def test_ranks_and_resume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """1 and 2: every target to 1e-9 of the largest value on the path; resumed, the same rows to the
    last digit.

    Of the contact to 1e-8, its gap over h, and its force, a small difference of two, over the load
    on a wall.
    """
    monkeypatch.setenv(
        "PETSC_OPTIONS", "-snes_stol 1e-11"
    )  # a stiff contact multiplies the error of u
    for ranks in (1, 2):
        done = all_started([command(tmp_path / str(ranks))], ranks)
        assert done.returncode == 0, done.stderr
    one, two = (read_path(tmp_path / ranks) for ranks in "12")
    assert float(one[-1]["contact_force"]) > 0
    labels = [[row["label"] for row in rows if row["label"] != "step"] for rows in (one, two)]
    assert labels[0] == labels[1]  # steps before a touch depend on rounding
    for column in EXACT:
        a, b = (
            np.array([float(row[column]) for row in rows if row["label"] == "target"])
            for rows in (one, two)
        )
        largest = np.nanmax(np.abs([float(row[column]) for row in one]))
        most = {"contact_force": PRESSED, "contact_gap_over_h": 1.0}.get(column, largest)
        part = 1e-8 if column.startswith("contact") else 1e-9
        assert a == pytest.approx(b, rel=0, abs=part * most, nan_ok=True), column
    run = start(*command(tmp_path / "killed"))
    wait_for_rows(run, tmp_path / "killed", 12)
    kill(run, 0)
    assert len(read_path(tmp_path / "killed")) < len(one)
    assert started(*command(tmp_path / "killed"), "--resume").returncode == 0
    again = read_path(tmp_path / "killed")
    for column in ("label", *EXACT):
        assert [row[column] for row in again] == [row[column] for row in one]


def pressed_caps(down: float, points: int, **mesh: Any) -> dict[str, Any]:
    """The upper cap is pressed down on the lower one, which it soon touches."""
    shell = {
        "geometry": "cap",
        "radius": 1,
        "polar": 20,
        "hole": 2,
        "thickness": 0.036,
        "poisson_ratio": 0.3,
    }
    lower, upper = (
        {"shell": shell | {"youngs_modulus": E}, "boundary": {"rim": "hinged"}} for E in (6, 1)
    )
    force = {"edge": "upper.hole", "force": [0, 0, -1]}
    loading = {
        "kind": "dead",
        "control": "displacement",
        "until": "target",
        "loads": [force],
        "displacement": down,
    }
    return {
        "shells": {"lower": lower, "upper": upper | {"place": {"position": [0, 0, 0.05]}}},
        "contact": [["upper", "lower"]],
        "mesh": {"degree": 3, **mesh},
        "loading": {**loading, "points": points},
    }


LOOKS = [
    (ClosestPointSearch, "projections_in_cells"),
    (MeridianContact, "_projections"),
    (Waves, "counts"),
]
FEW = 4  # looks of the undeformed shells, and of the last point


@pytest.mark.slow
@pytest.mark.parametrize(
    ("symmetry", "mesh"), [("auto", {"refinement": 0.3}), ("half", {"size": 0.15})]
)
def test_a_resumed_run_looks_at_no_known_contact_again(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    no_pictures: None,
    symmetry: str,
    mesh: dict[str, Any],
) -> None:
    """The folder as it was at a moment after the touch, as kill -9 leaves it; the same rows to the
    last digit.

    Where shells touch, what is found at points costs as much as the points: places that face each
    other, and modes that the model excludes.
    """
    case, whole, killed = tmp_path / "case.yaml", tmp_path / "whole", tmp_path / "killed"
    case.write_text(json.dumps(pressed_caps(0.03, 3, **mesh) | {"symmetry": symmetry}))
    looks, at_end, record, following = (
        list[str](),
        list[int](),
        Checkpoint.record,
        Checkpoint._next_content,
    )

    def recorded(journal: Checkpoint, result: Point | str) -> None:
        record(journal, result)
        if len(read_path(whole)) > 3 and not killed.exists():
            at_end.append(len(looks))
            shutil.copytree(whole, killed)

    def next_known(journal: Checkpoint) -> bytes | None:
        content = following(journal)
        if content is None:
            at_end.append(len(looks))
        return content

    monkeypatch.setattr(Checkpoint, "record", recorded)
    for kind, name in LOOKS:
        own = getattr(kind, name)
        monkeypatch.setattr(
            kind, name, lambda *a, own=own, **b: (looks.append(own.__name__), own(*a, **b))[1]
        )
    assert magshell("run", case, "--out", whole).returncode == 0
    before, looked = read_path(killed), at_end[-1]
    assert any(float(row["contact_force"]) > 0 for row in before)
    looks.clear(), at_end.clear()
    monkeypatch.setattr(Checkpoint, "_next_content", next_known)
    assert magshell("run", case, "--out", killed, "--resume").returncode == 0
    assert at_end[0] <= FEW < looked / 2, looks[: at_end[0]]
    rows = [[{**row, "wall_s": ""} for row in read_path(out)] for out in (killed, whole)]
    assert rows[0] == rows[1]
    assert len(rows[0]) > len(before)


def end_of(folder: Path, case: dict[str, Any], ranks: int) -> dict[str, str]:
    """The last row of a run."""
    (folder / "case.yaml").write_text(json.dumps(case))
    done = magshell(
        "run", folder / "case.yaml", "--no-pictures", "--out", folder / "out", ranks=ranks
    )
    assert done.returncode == 0, done.stderr
    return read_path(folder / "out")[-1]


@pytest.fixture(scope="module")
def on_meridian(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The end of two caps on their meridian, which several models are compared with."""
    return end_of(tmp_path_factory.mktemp("meridian"), pressed_caps(0.015, 1), 1)


@pytest.mark.slow
@pytest.mark.parametrize(("symmetry", "size"), [("half", 0.2), (6, 0.15)])
def test_pressed_caps_on_other_models(
    tmp_path: Path, on_meridian: dict[str, str], symmetry: str | int, size: float
) -> None:
    """Just after the touch a half and a sector on two ranks have the force of the meridian, another
    discretisation."""
    model = {"symmetry": symmetry, "mesh": {"size": size, "degree": 3}}
    end = end_of(tmp_path, pressed_caps(0.015, 1) | model, 2)
    assert float(on_meridian["contact_force"]) > 0
    for column in ("load_factor", "contact_force", "energy"):
        assert float(end[column]) == pytest.approx(float(on_meridian[column]), rel=5e-3), column


@pytest.mark.slow
def test_ranks_of_supports_that_push(tmp_path: Path) -> None:
    """Two caps on their meridian, of which one is pushed on the other: each rank has all of it,
    with the same rows.
    """
    cap = {
        "geometry": "cap",
        "radius": 1,
        "polar": 20,
        "hole": 3,
        "thickness": 0.02,
        "poisson_ratio": 0.3,
    }
    lower = {"shell": cap, "boundary": {"rim": "clamped"}}
    upper = {"shell": cap, "boundary": {"hole": "clamped"}, "place": {"position": [0, 0, 0.025]}}
    moves = [{"supports": ["upper.hole"], "translation": [0, 0, -0.01]}]
    loading = {"kind": "edge", "name": "way", "points": 1, "moves": moves}
    case = {
        "shells": {"lower": lower, "upper": upper},
        "contact": [["upper", "lower"]],
        "loading": loading,
    }
    (tmp_path / "case.yaml").write_text(
        json.dumps(case | {"mesh": {"refinement": 0.5, "degree": 3}})
    )
    for ranks in (1, 2):
        run = [
            "run",
            str(tmp_path / "case.yaml"),
            "--no-pictures",
            "--out",
            str(tmp_path / str(ranks)),
        ]
        done = all_started([run], ranks)
        assert done.returncode == 0, done.stderr
    one, two = (read_path(tmp_path / str(ranks))[-1] for ranks in (1, 2))
    assert float(one["contact_force"]) > 0
    for column in ("reaction", "contact_force", "energy"):
        assert float(two[column]) == pytest.approx(float(one[column]), rel=1e-9), column
