"""Studies: what a result is, what errors are measured against, that times are those of clean
processes.
"""

import csv
import json
import math
import os
from pathlib import Path
from typing import Any

import pytest
from conftest import CASES
from many import make_points, study

from magshell_fenicsx import CaseError
from magshell_fenicsx.platform.processes import Usage, measure
from magshell_fenicsx.studies.points import parse_axes
from magshell_fenicsx.studies.results import Scalar, parse_scalar
from magshell_fenicsx.studies.study import timings as sample
from magshell_fenicsx.studies.study.report import Run, estimated_error, make_rows
from magshell_fenicsx.studies.study.study import parse_ranks
from magshell_fenicsx.studies.study.timings import TIMES, Timings

DIMPLE, PLATE = CASES / "dimple_buckling.yaml", CASES / "clamped_plate.yaml"
K_D = 0.326233289  # axisymmetric solver, nine digits


def path(*points: tuple[str, float, float]) -> list[dict[str, str]]:
    """Rows of a path.csv with (amplitude, w_over_h, force)."""
    return [
        {
            "amplitude": amplitude,
            "w_over_h": repr(w),
            "force": repr(force),
            "mode": "",
            "branch": "0",
        }
        for amplitude, w, force in points
    ]


def force_at(w: float, rows: list[dict[str, str]]) -> float | None:
    return parse_scalar(f"force@w_over_h={w}").value_in({}, rows)


def test_result_at_a_requested_point_is_its_row() -> None:
    rows = path(
        ("", 0.0, 0.0), ("force", 1.0, 2.5), ("force", 2.0, 3.7), ("force", 3.0 - 1e-12, 4.4)
    )
    assert force_at(1, rows) == 2.5
    assert force_at(2, rows) == 3.7
    assert force_at(3, rows) == 4.4
    assert force_at(4, rows) is None
    assert parse_scalar("force@end").value_in({}, rows) == 4.4


def test_a_frequency_is_no_column() -> None:
    with pytest.raises(
        CaseError,
        match=r"--result hertz_1@end: hertz_1 is a natural frequency, which path.csv has not",
    ):
        parse_scalar("hertz_1@end")


def test_result_between_points_is_cubic() -> None:
    """F = w^3 is met exactly; the field's part of the path, which meets it in a corner, is left
    out.
    """
    rows = path(
        ("", -9.0, 5.0), ("lambda_m", 0.0, 0.0), *(("force", w, w**3) for w in (1.0, 2.0, 3.5))
    )
    assert force_at(1.5, rows) == pytest.approx(1.5**3, rel=1e-14)
    assert force_at(3, rows) == pytest.approx(_parabola(3.0), rel=1e-14)  # the last three points


def _parabola(w: float) -> float:
    """Through w^3 at 1, 2 and 3.5: w^3 - (w - 1)(w - 2)(w - 3.5)."""
    return w**3 - (w - 1) * (w - 2) * (w - 3.5)


def test_result_is_the_first_on_the_way() -> None:
    """A path that turns back has two forces at one displacement; branches and excluded modes are
    not on the way.
    """
    rows = path(("force", 0.0, 0.0), ("force", 2.0, 2.0), ("force", 1.0, 3.0))
    assert force_at(1.5, rows) == 1.5
    aside = [{**rows[2], "branch": "1"}, {**rows[2], "mode": "antisymmetric"}]
    assert parse_scalar("force@end").value_in({}, [*rows[:2], *aside]) == 2.0


def test_results_of_the_summary() -> None:
    points = [{"amplitude": "pressure", "value": 0.3}, {"amplitude": "lambda_m", "value": -0.0034}]
    told = {"knockdown": 0.3, "limit_points": points}
    assert Scalar("knockdown").value_in(told, []) == 0.3
    assert Scalar("critical_field").value_in(told, []) == -0.0034
    assert Scalar("critical_field").value_in({"limit_points": points[:1]}, []) is None
    earlier = {"snaps": [{"time": 2.0, "overshoot": 0.0}]}  # of an earlier version
    of_snaps = [
        Scalar(name).value_in(earlier, []) for name in ("snap_time", "snap_departure", "snap_jump")
    ]
    assert of_snaps == [2.0, None, None]
    assert Scalar("snap_jump").value_in({"snaps": []}, []) is None
    in_units = parse_scalar("critical_field_mT")
    assert in_units.value_in({"in_units": {"critical_field_mT": -400.0}}, []) == -400.0
    assert in_units.value_in({"in_units": {}}, []) is None


@pytest.mark.parametrize(
    "column",
    [
        "w_mm",
        "gravity_m_per_s2",
        "force_ball",
        "force_ball_N",
        "force_2",
        "approach_ball_mm",
        "w_force_2_mm",
        "A_uz_mm",
        "rim_fz",
        "rim_mx_N_m",
        "time",
    ],
)
def test_columns_of_all_parts_are_results(column: str) -> None:
    assert parse_scalar(f"{column}@end") == Scalar(f"{column}@end", column, "end")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "k_d",
            (
                "k_d is no column with numbers; write knockdown, barrier, critical_field, "
                "snap_time, snap_dep"
            ),
        ),
        ("force", "nothing is no column"),
        ("force@w=1", "w is no column"),
        ("label@end", "label is no column"),
        ("A_uz_parsec@end", "A_uz_parsec is no column"),
        ("force@w_over_h=", "nothing is no finite number"),
        ("force@w_over_h=nan", "nan is no finite number"),
        ("force@w_over_h=ten", "ten is no finite number"),
    ],
)
def test_result_must_be_one(text: str, said: str) -> None:
    with pytest.raises(CaseError) as e:
        parse_scalar(text)
    assert said in str(e.value)


def test_richardson_with_unequal_refinements() -> None:
    """v = 2 + 0.3 h^3.5 is extrapolated exactly from any three sizes."""
    h = [1.0, 0.7, 0.4]
    error, order = estimated_error(h, [2 + 0.3 * x**3.5 for x in h])
    assert order == pytest.approx(3.5, rel=1e-9)
    assert error == pytest.approx(0.3 * 0.4**3.5, rel=1e-8)


def test_no_order_where_there_is_none() -> None:
    """Two meshes, or values that go to and fro: the last difference; one mesh: nothing is known."""
    assert estimated_error([2, 1], [1.2, 1.1]) == (pytest.approx(0.1), None)
    assert estimated_error([4, 2, 1], [1.2, 1.0, 1.1]) == (pytest.approx(0.1), None)
    assert estimated_error([4, 2, 1], [1.0, 1.1, 1.3]) == (pytest.approx(0.2), None)  # diverges
    assert estimated_error([1], [1.2]) == (None, None)


def made(*measured: tuple[float | None, int, float]) -> tuple[list[Run], list[Timings]]:
    """Runs of three refinements with (k_d, dofs, seconds)."""
    values = "1:3:3" if len(measured) == 3 else "1:2:2"
    points = make_points(DIMPLE, parse_axes([f"mesh.refinement={values}"]))
    kept = [
        Timings(
            {},
            dict.fromkeys(TIMES),
            [{**dict.fromkeys(TIMES), "wall_s": seconds + noise} for noise in (0.5, 0.0, -0.1)],
            {
                "knockdown": k_d,
                "mesh": {"cells": dofs // 10, "dofs": dofs, "degree": 4},
                "timing": {},
                "factorisations": 9,
                "iterations": 20,
                "stopped": None if k_d else "lost",
            },
        )
        for k_d, dofs, seconds in measured
    ]
    return [Run(point, 1, one) for point, one in zip(points, kept, strict=True)], kept


def test_errors_and_front_against_a_given_reference() -> None:
    """The second is slower and less accurate than the first; seconds are medians."""
    runs, _ = made((0.51, 100, 1.0), (0.52, 200, 2.0), (0.5005, 300, 3.0))
    rows, reference = make_rows(runs, Scalar("knockdown"), 0.5)
    assert reference is not None
    assert reference.source == "given"
    assert [row["error"] for row in rows] == pytest.approx([0.02, 0.04, 0.001])
    assert [row["pareto"] for row in rows] == [True, False, True]
    assert [row["wall_s"] for row in rows] == [1.0, 2.0, 3.0]


def test_front_of_single_ranks_is_by_cpu_time() -> None:
    """Another program made the first wait: it is the fastest all the same.

    On two ranks waiting counts.
    """
    runs, kept = made((0.51, 100, 5.0), (0.5005, 200, 2.0), (0.502, 300, 3.0))
    for one, seconds in zip(kept, (1.0, 2.0, 3.0), strict=True):
        one.samples = [{**times, "cpu_s": seconds} for times in one.samples]
    assert [row["pareto"] for row in make_rows(runs, Scalar("knockdown"), 0.5)[0]] == [
        True,
        True,
        False,
    ]
    on_two = [Run(run.point, 2, run.measured) for run in runs]
    assert [row["pareto"] for row in make_rows(on_two, Scalar("knockdown"), 0.5)[0]] == [
        False,
        True,
        False,
    ]


def test_finest_run_is_the_reference_with_its_own_error() -> None:
    """k_d = 0.5 + 0.01 h^2 at h = 1, 1/2, 1/3; the run with most unknowns is the reference."""
    runs, _ = made((0.51, 100, 1.0), (0.5025, 200, 2.0), (0.5 + 0.01 / 9, 300, 3.0))
    rows, reference = make_rows(runs, Scalar("knockdown"), None)
    assert reference is not None
    assert reference.value == rows[2]["result"]
    assert reference.order == pytest.approx(2)
    assert rows[2]["error"] == reference.error == pytest.approx(0.01 / 9 / reference.value)
    assert rows[0]["error"] == pytest.approx((0.01 - 0.01 / 9) / reference.value)


def test_run_without_the_result_is_a_row_with_its_cause() -> None:
    runs, kept = made((0.51, 100, 1.0), (None, 200, 2.0), (0.505, 300, 3.0))
    kept[0].summary, kept[0].failure = None, "exit code 59: out of memory"
    rows, _ = make_rows(runs, Scalar("knockdown"), 0.5)
    assert [row["stopped"] for row in rows] == ["exit code 59: out of memory", "lost", None]
    assert [row["error"] for row in rows] == [None, None, pytest.approx(0.01)]
    assert [row["pareto"] for row in rows] == [False, False, True]
    assert make_rows(runs[:2], Scalar("knockdown"), None)[1] is None


@pytest.mark.slow
def test_peak_and_cpu_are_those_of_the_process(tmp_path: Path) -> None:
    """200 MB written to and a second of work, against neither; the starter's own 400 MB do not
    count.
    """
    (tmp_path / "rest.py").write_text("import sys; sys.exit(3)", encoding="utf-8")
    work = "x = bytearray(200 << 20)\nfor i in range(0, len(x), 1024): x[i] = 1\n"
    work += "import time; start = time.process_time()\nwhile time.process_time() < start + 1: pass"
    (tmp_path / "work.py").write_text(work, encoding="utf-8")
    ballast = bytearray(b"\1" * 400 * 2**20)
    path = {"PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    rest, busy = (measure(module, [], environment=path) for module in ("rest", "work"))
    assert len(ballast) == 400 * 2**20
    assert (rest.code, busy.code) == (3, 0)
    assert rest.peak_mb is not None
    assert busy.peak_mb is not None
    assert rest.peak_mb < 400
    assert busy.peak_mb - rest.peak_mb == pytest.approx(200, abs=20)
    assert busy.cpu_s > 1
    assert busy.wall_s > 1


def test_failing_process_is_told() -> None:
    used = measure("no_such_module", [])
    assert used.code == 1
    assert "No module named no_such_module" in used.errors


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The command lines of the runs that a study starts."""
    seen: list[list[str]] = []

    def counted(module: str, arguments: list[str], ranks: int) -> Usage:
        seen.append(arguments)
        return measure(module, arguments, ranks)

    monkeypatch.setattr(sample, "measure", counted)
    return seen


def read(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def small(out: Path, **options: Any) -> Any:
    over = ["mesh.refinement=0.3,0.5"]
    return study(DIMPLE, over, ["mesh.degree=3"], result="knockdown", repeat=1, out=out, **options)


@pytest.mark.slow
def test_study_measures_and_keeps(tmp_path: Path, started: list[list[str]]) -> None:
    """k_d of two meridians against the axisymmetric reference; a second call runs only what it
    lacks.
    """
    said: list[str] = []
    done = small(tmp_path, reference=K_D, say=said.append)
    assert len(started) == 4  # each once to compile, once to measure
    assert len(said) == 3
    coarse, fine = rows = read(tmp_path / "study.csv")
    assert float(coarse["error"]) > float(fine["error"]) > 0
    for row in rows:
        assert float(row["result"]) == pytest.approx(K_D, rel=float(row["error"]) * 1.001)
        assert float(row["wall_s"]) > float(row["total_s"]) > float(row["assembly_s"]) > 0
        assert float(row["factor_s"]) > 0
        assert float(row["cpu_s"]) > 0.5  # Python alone takes that
        assert 100 < float(row["peak_mb"]) < 2000
        assert row["stopped"] == ""
        assert (row["degree"], row["ranks"]) == ("3", "1")
    assert int(fine["dofs"]) > int(coarse["dofs"]) > 100
    assert [row["pareto"] for row in done.rows].count(True) >= 1
    told = json.loads((tmp_path / "study.json").read_text(encoding="utf-8"))
    assert told["machine"]["cores"] >= 1
    assert told["machine"]["versions"]["dolfinx"]
    assert told["reference"]["value"] == K_D
    assert (tmp_path / "study.png").stat().st_size > 10_000
    table = (tmp_path / "study.md").read_text(encoding="utf-8")
    assert "Errors are relative to 0.326233289 (given)" in table
    assert len([line for line in table.splitlines() if line.startswith("|")]) == 4

    again = small(tmp_path)  # another reference: nothing is run
    assert len(started) == 4
    assert [row["wall_s"] for row in again.rows] == [row["wall_s"] for row in done.rows]
    assert again.reference.source.startswith("finest run: degree 3")
    kept = sorted((tmp_path / "points").iterdir())[0]
    content = json.loads(kept.read_text(encoding="utf-8"))
    content["machine"]["cpu"] = "another"
    kept.write_text(json.dumps(content), encoding="utf-8")
    small(tmp_path)
    assert len(started) == 6  # times of another machine are measured anew


@pytest.mark.slow
def test_ranks_and_a_field_that_is_too_strong(tmp_path: Path) -> None:
    """Beyond the critical field (axisymmetric: -0.0033554) a run stops early: the field is its
    result.
    """
    settings = ["magnetic.lambda_m=-0.0035", "mesh.refinement=0.5"]
    done = study(
        DIMPLE,
        ["mesh.degree=4"],
        settings,
        result="critical_field",
        ranks=[2, 1],
        repeat=1,
        out=tmp_path,
    )
    one, two = done.rows
    assert (one["ranks"], two["ranks"]) == (1, 2)
    assert one["result"] == pytest.approx(two["result"], rel=1e-9)
    assert one["result"] == pytest.approx(-0.0033554, rel=1e-4)
    assert "the field alone makes the shell unstable" in one["stopped"]
    assert two["peak_mb"] > 1.3 * one["peak_mb"]
    assert done.without_result == 0


def test_mistakes_are_found_at_the_door(tmp_path: Path, started: list[list[str]]) -> None:
    def refused(over: str = "mesh.degree=3,4", **options: Any) -> str:
        with pytest.raises(CaseError) as e:
            study(PLATE, [over], **{"result": "knockdown", "out": tmp_path / "out", **options})
        return str(e.value)

    assert "is no column" in refused(result="k_d")
    assert "mesh.degree: 9" in refused("mesh.degree=3,9")
    assert "--repeat and --ranks must be at least 1" in refused(repeat=0)
    assert "--repeat and --ranks must be at least 1" in refused(ranks=[0])
    assert "--reference nan: must be" in refused(reference=math.nan)
    assert "--out /dev/null/x: cannot be written" in refused(out="/dev/null/x")
    with pytest.raises(CaseError, match="--ranks 1,x: write whole numbers"):
        parse_ranks("1,x")
    assert not started
    assert not (tmp_path / "out").exists()
