"""What a clamped cap loses its stability by, over its depth."""

from pathlib import Path

import numpy as np
import pytest
from conftest import CASES

import magshell_fenicsx as ms
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.scene_cache import problem_on_moved_mesh
from magshell_fenicsx.studies.boundary.picture import _regions


def test_deeper_caps_buckle_before_they_snap(tmp_path: Path) -> None:
    """Huang (J.

    Appl. Mech. 31, 1964): from lambda = 5.5 on, with one wave. Runs on both sides have the same
    loads.
    """
    file = CASES / "cap_boundary.yaml"
    found = ms.boundary(file, "shell.polar=17.2:17.55:1", ["shell.polar=17.2"], out=tmp_path / "b")
    (crossing,) = found.special
    depth = 100 * (1 - np.cos(np.radians(crossing["key"])))
    assert (crossing["kind"], crossing["mode"]) == ("crossing", "fold, m = 1")
    assert 2 * (3 * (1 - 0.3**2)) ** 0.25 * np.sqrt(depth) == pytest.approx(5.5, abs=0.02)
    first = ms.Scene(ms.Case.load(file, ["shell.polar=17.2"]))
    for row in (found.rows[0], found.rows[-1]):
        problem = ms.Case.load(file, [f"shell.polar={row['key']!r}"]).problem()
        of_run = next(
            r
            for r in ms.follow(Scene(problem_on_moved_mesh(first, problem), first.comm))
            if r.label in ("fold", "bifurcation")
        )
        assert (of_run.label, of_run.mode) == (row["kind"], row["mode"])
        assert row["load"] == pytest.approx(of_run.point.state.mu["pressure"], rel=1e-7)
        assert not row["unstable"]
    back = ms.boundary(
        file, "shell.polar=17.3:17.55:1", ["shell.polar=17.55"], out=tmp_path / "back"
    )
    assert [row["kind"] for row in back.rows] == [
        "fold",
        *["fold"] * (len(back.rows) - 3),
        "crossing",
        "bifurcation",
    ]
    assert back.special[0]["key"] == pytest.approx(crossing["key"], abs=1e-6)
    assert {words for _, _, words in _regions(found.rows, found.content, (0, 1))} == {
        "stable",
        "snaps",
        "buckles with m = 1",
    }


@pytest.mark.slow
def test_a_region_narrower_than_the_first_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One wave comes first between 17.411 and 17.621 degrees alone; with two waves beyond, as runs
    say.
    """
    monkeypatch.setattr("magshell_fenicsx.continuation.critical.DISTANCE_BEYOND_CROSSING", 0.5)
    found = ms.boundary(
        CASES / "cap_boundary.yaml", "shell.polar=17.3:17.8:1", ["shell.polar=17.3"], out=tmp_path
    )
    assert [row["mode"] for row in found.special] == ["fold, m = 1", "m = 1, m = 2"]
    assert found.special[1]["key"] == pytest.approx(17.621, abs=1e-3)
    assert not any(row["unstable"] for row in found.rows)
