"""Snaps of a dimpled hemisphere, the pressure held or the volume: at rest it is on a branch of the
static path.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.point import Point, RecordedValues
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.report.verdict import _snaps
from magshell_fenicsx.runs.rows import columns, rows
from magshell_fenicsx.runs.running import Interrupted
from magshell_fenicsx.runs.summary import snaps
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.trace import trace


def case_of(radius: float, amplitude: float, **load: Any) -> Case:
    dimple = {"kind": "dimple", "amplitude": amplitude, "width": 3.2}
    shell = {
        "geometry": "hemisphere",
        "radius_to_thickness": radius,
        "poisson_ratio": 0.5,
        "imperfections": [dimple],
    }
    pressed = {"kind": "pressure", "until": "limit"} | load
    data = {
        "shell": shell,
        "boundary": {"equator": "clamped"},
        "symmetry": "axisymmetric",
        "mesh": {"refinement": 0.4},
    }
    return Case.from_source(data | {"loading": pressed})


@pytest.mark.slow
def test_volume_held() -> None:
    """The volume turns just beyond the largest pressure; the shell snaps to the branch on which it
    grows again.
    """
    scene = Scene(case_of(100, 0.5, then="snap", hold={"pressure": "conjugate"}))
    records = list(follow(scene))
    table = rows(scene, records)
    (made,) = snaps(table)
    fold, rest = records[made["point"]], records[made["rest"]]
    volumes = [row["volume_change"] for row in table[made["point"] :]]
    assert volumes == pytest.approx(np.full(len(volumes), volumes[0]), rel=1e-9)
    assert table[made["rest"]]["p_over_pc"] < 0.9 * table[made["point"]]["p_over_pc"]
    assert made["dissipated"] == pytest.approx(
        table[made["point"]]["stored"] - table[made["rest"]]["stored"], rel=0.05
    )
    unit, there = scene.conjugate_unit("pressure"), []
    path = trace(scene, "pressure", fold, first=-0.01, until="points", steps=30)
    for record in path:  # by arc length past the fold, to a larger change of volume
        there.append(record.point.state)
        if (
            record.point.negative_pivots == 1
            and record.point.negative_pivots_held == 0
            and len(there) > 5
        ):
            break
    target = [volumes[0] * unit]
    *_, static = trace(
        scene, "pressure", there[-1], control="conjugate", until="target", targets=target
    )
    assert rest.point.state.u == pytest.approx(static.point.state.u, abs=1e-6 * 0.01)
    assert rest.point.state.mu == pytest.approx(static.point.state.mu, rel=1e-6)


@pytest.mark.slow
def test_pressure_held() -> None:
    """A thick shell everts and holds the pressure; the static path comes there through all folds,
    and from above.
    """
    scene = Scene(case_of(20, 3.0, then="snap", snap={"tolerance": 0.1}))
    *_, rest = follow(scene)
    assert rest.label == "target"
    p = rest.point.state.mu["pressure"]
    path = trace(scene, "pressure", until="target", targets=[0.6], first=0.1)
    away = [record for record in path if record.label == "target"][-1]
    *_, static = trace(scene, "pressure", away, control="load", until="target", targets=[p])
    assert rest.point.state.u == pytest.approx(static.point.state.u, abs=1e-6 / 20)


def test_own_conjugate_goes_with_a_limit() -> None:
    with pytest.raises(CaseError, match=r"hold.pressure: this step drives pressure"):
        case_of(100, 0.5, hold={"pressure": "conjugate"}, until="target", volume_change=-0.01)


class Kept:
    """A journal in memory that begins with known results, and stops a motion at a number of steps
    in time.
    """

    def __init__(self, known: Sequence[Point | str] = (), steps: float = np.inf) -> None:
        self.found, self._known, self._steps = list[Point | str](), list(known), steps

    def replay(self) -> Point | str | None:
        if len(self.found) == len(self._known):
            return None
        self.found.append(self._known[len(self.found)])
        return self.found[-1]

    def record(self, found: Point | str) -> None:
        self.found.append(found)
        self._known.append(found)

    def recorded_values(self, find: Callable[[], RecordedValues]) -> RecordedValues:
        return find()

    def check(self, known: bool) -> None:
        self._steps -= 1
        if self._steps < 0:
            raise Interrupted


@pytest.mark.slow
def test_a_resumed_snap_is_the_same() -> None:
    """From the fold, and from within the motion, whose interruption is between two steps."""

    def numbers(journal: Kept) -> dict[str, Any]:
        scene = Scene(case)
        scene.journal = journal
        return columns(scene, follow(scene))

    defect = {"kind": "dimple", "amplitude": 1, "width": 3}
    shell = {
        "geometry": "hemisphere",
        "radius_to_thickness": 50,
        "poisson_ratio": 0.3,
        "defect": defect,
    }
    snap = {"kind": "pressure", "until": "limit", "then": "snap", "snap": {"tolerance": 0.1}}
    data = {"shell": shell, "boundary": {"equator": "clamped"}, "loading": snap}
    case = Case.from_source(data | {"mesh": {"refinement": 0.5, "degree": 3}})
    whole = Kept()
    wanted = numbers(whole)
    stopped = Kept(steps=1200)  # of which some 1100 are of rehearsals
    with pytest.raises(Interrupted):
        numbers(stopped)
    assert len(stopped.found) > 12
    for known in (whole.found[:5], stopped.found):
        found = numbers(Kept(known))
        for column, values in wanted.items():
            if values.dtype.kind == "f":
                assert np.nanmax(np.abs(found[column] - values), initial=0) <= 1e-12 * np.nanmax(
                    np.abs(values)
                ), column


@pytest.mark.parametrize("late", [20.0, 60.0])
def test_departure_and_jump(late: float) -> None:
    """A logistic way goes from 0.1 to 0.9 in 2 ln 9 of its time, whenever it departs; the verdict
    says of what."""
    t = np.concatenate([np.linspace(0, late + 30, 161), [late + 30]])
    way = 1 / (1 + np.exp(late - t))
    common = {"step": 1, "amplitude": "time", "dissipated": 0.0}
    moving = [
        {**common, "label": "step", "point": i, "time": at, "w_over_h": 3 * w}
        for i, (at, w) in enumerate(zip(t, way, strict=True))
    ]
    moving[0] |= {"label": "fold", "amplitude": "load"}
    moving[-1] |= {"label": "target"}
    (snap,) = snaps(moving)
    assert snap["jump"] == pytest.approx(2 * np.log(9), rel=2e-4)
    assert snap["departure"] == pytest.approx(late - np.log(9), abs=2e-3)
    assert snap["time"] == pytest.approx(late, abs=2e-3)
    bare, *_ = _snaps({"snaps": [snap]})
    assert bare.startswith(
        "The snap takes 4.394 from 10 to 90 % of its way, after a departure from the fold of "
    )
    assert bare.endswith("(times in R √(ρ/E); with a density of the shell they are in ms).")
    (in_ms,) = _snaps({"snaps": [snap], "snap_jump_ms": 3.1, "snap_departure_ms": 28.0})
    assert in_ms == (
        "The snap takes 3.1 ms from 10 to 90 % of its way, "
        "after a departure from the fold of 28 ms."
    )
    steps = [{"snap": {"damping": 0.1}}, {"snap": {"damping": 0.2}}]
    lines = [{"point": "0", "step": "2"}]
    (with_damping,) = _snaps({"snaps": [snap], "case": {"loading": steps}}, lines)
    assert " of its way with the damping 0.2 of snap, after" in with_damping
    lines.append({"point": str(snap["rest"]), "ball_normal_force": "0.0", "contact_force": "2e-3"})
    touching = {"bodies": {"ball": {}}, "shells": {"upper": {}, "lower": {}}}
    *_, touched = _snaps({"snaps": [snap], "case": touching}, lines)
    assert touched == "It comes to rest on another shell."
