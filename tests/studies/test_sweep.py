"""Sweeps: what --over means, what is kept, what is written, and that ranks do not matter."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from command import magshell
from conftest import CASES
from figures import figures
from figures.figures import FIGURES
from many import make_points, sweep, with_earlier

from magshell_fenicsx import CaseError
from magshell_fenicsx.input.section import number_and_unit
from magshell_fenicsx.input.source import read_source
from magshell_fenicsx.public import run
from magshell_fenicsx.studies import points as axes_module
from magshell_fenicsx.studies.figures import is_map
from magshell_fenicsx.studies.points import SweepPoint, parse_axes
from magshell_fenicsx.studies.sweep import chains
from magshell_fenicsx.studies.sweep import sweep as module

PLATE, DIMPLE, POLE = (
    CASES / f"{name}.yaml" for name in ("clamped_plate", "dimple_buckling", "pole_indentation")
)
COARSE = ["mesh.degree=3", "mesh.refinement=0.5"]
PRESSURES = "loading.pressure=1e-5:3e-5:2"


def points(file: Path, *over: str) -> list[SweepPoint]:
    return make_points(file, parse_axes(over))


def test_what_acts_without_a_field_makes_points_differ() -> None:
    """The remanence of a shell that a sensor reads."""
    first, second = points(CASES / "hall_sensor.yaml", "magnetic.remanent.flux_density=10 mT,20 mT")
    assert first.key != second.key


def read(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Pressures of the cases that a sweep really computes, in order."""
    done: list[float] = []

    def counted(problem, comm):  # type: ignore[no-untyped-def]
        done.append(problem.document.data["loading"]["pressure"])
        return run(problem, comm=comm)

    monkeypatch.setattr(chains, "run", counted)
    return done


def plate(
    out: Path, *over: str, settings: tuple[str, ...] = (), say: Callable[[str], None] = print
) -> module.Sweep:
    return sweep(PLATE, over or [PRESSURES], [*COARSE, *settings], out, say=say)


def test_product_and_ties() -> None:
    """The last axis is the fastest; tied keys have one value."""
    found = points(
        DIMPLE,
        "magnetic.energy=full,first",
        "magnetic.remanent.polar+magnetic.applied.polar=0:90:3",
        "mesh.degree=3:4:2",
    )
    assert len(found) == 2 * 3 * 2
    magnetic = [p.case.magnetic for p in found]
    assert [m.energy for m in magnetic if m] == ["full"] * 6 + ["first"] * 6
    assert [m.applied.polar for m in magnetic if m] == [0, 0, 45, 45, 90, 90] * 2
    assert [m.remanent.polar for m in magnetic if m] == [0, 0, 45, 45, 90, 90] * 2
    assert [p.case.mesh.degree for p in found] == [3, 4] * 6
    assert list(found[2].values.items()) == [
        ("magnetic.energy", "full"),
        ("magnetic.remanent.polar", "45"),
        ("magnetic.applied.polar", "45"),
        ("mesh.degree", "3"),
    ]


def test_units_and_exact_ends() -> None:
    found = points(PLATE, "loading.pressure=0.1:0.3:3")
    assert [p.values["loading.pressure"] for p in found] == ["0.1", "0.2", "0.3"]
    settings = ["shell={geometry: disc, radius: 1 m, thickness: 1 mm, poisson_ratio: 0.3}"]
    found = make_points(PLATE, parse_axes(["shell.radius=25.2 mm,1 m"]), settings)
    assert [p.case.shell.radius for p in found] == pytest.approx([0.0252, 1])


@pytest.mark.parametrize(
    ("over", "message"),
    [
        ("mesh.degree", "--over mesh.degree: write it as key.path=start:stop:count"),
        ("=1,2", "write it as"),
        ("mesh.degree+=3,4", "write it as"),
        ("mesh.degree=3,,4", "a value is missing"),
        ("mesh.degree=", "a value is missing"),
        ("mesh.degree=3:4", "3:4 is not start:stop:count"),
        ("mesh.degree=3:4:a", "is not start:stop:count"),
        ("mesh.refinement=nan:1:3", "start and stop must be finite"),
        ("shell.radius=1 mm:2 mT:3", "is not start:stop:count (two numbers of one unit"),
        ("mesh.refinement=1:2:1", "count is 1; allowed 2 to 10000"),
        ("mesh.refinement=1:2:100000000", "count is 100000000"),
        ("magnetic.remanent=[1,2]", "only numbers and words"),
        ("mesh.degree+mesh.degree=3,4", "mesh.degree is swept twice"),
        (
            "mesh.refinement.x=1,2",
            "--over mesh.refinement.x=1: refinement is a value, not a section",
        ),
        ("mesh.degre=3,4", "mesh.degre: unknown key; did you mean degree?"),
        ("mesh.degree=3:4:3", "mesh.degree: 3.5: must be a valid integer"),
        (
            "mesh.degree=3,4,9",
            "--over mesh.degree=9: mesh.degree: 9: must be less than or equal to 5",
        ),
        ("symmetry=auto,half", "have no common mirror plane"),
    ],
)
def test_mistakes_are_found_at_the_door(over: str, message: str) -> None:
    with pytest.raises(CaseError) as e:
        make_points(
            DIMPLE,
            parse_axes([over]),
            [
                "magnetic={lambda_m: 1e-3, remanent: {polar: 9}, applied: {polar: 9, azimuth: 9}}",
                "mesh.refinement=1",
            ],
        )
    assert message in str(e.value)


def test_too_many_points_and_a_key_that_is_also_set() -> None:
    with pytest.raises(CaseError, match="1000000 points; allowed at most 10000"):
        points(DIMPLE, "magnetic.lambda_m=0:1:1000", "mesh.refinement=1:2:1000")
    with pytest.raises(CaseError, match="this key is swept"):
        make_points(DIMPLE, parse_axes(["mesh.degree=3,4"]), ["mesh.degree=3"])


@pytest.mark.telling
@pytest.mark.parametrize("ranks", [0, 2])
def test_invalid_point_is_one_message_and_nothing_is_computed(tmp_path: Path, ranks: int) -> None:
    done = magshell(
        "sweep",
        PLATE,
        "--over",
        "shell.poisson_ratio=0.3,0.7",
        "--out",
        tmp_path / "out",
        ranks=ranks,
    )
    assert done.returncode == 2
    assert (
        done.stderr.count(
            "--over shell.poisson_ratio=0.7: shell.poisson_ratio: 0.7: must be less than"
        )
        == 1
    )
    assert "in the point shell.poisson_ratio=0.7" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_unwritable_out_and_no_over() -> None:
    done = magshell("sweep", PLATE, "--over", "mesh.degree=3,4", "--out", "/dev/null/x")
    assert done.returncode == 2
    assert done.stderr.startswith("--out /dev/null/x: cannot be written: ")
    assert magshell("sweep", PLATE).returncode == 2


def test_second_call_computes_what_is_missing(tmp_path: Path, computed: list[float]) -> None:
    first = plate(tmp_path)
    assert computed == [1e-5, 3e-5]
    table = (tmp_path / "sweep.csv").read_text(encoding="utf-8")
    assert plate(tmp_path).outcomes == first.outcomes
    assert computed == [1e-5, 3e-5]
    assert (tmp_path / "sweep.csv").read_text(encoding="utf-8") == table
    plate(tmp_path, "loading.pressure=1e-5:3e-5:3")  # the ends are there
    assert computed == [1e-5, 3e-5, 2e-5]
    damaged = tmp_path / "points" / f"{first.points[0].key}.json"
    damaged.write_text(damaged.read_text(encoding="utf-8")[:100], encoding="utf-8")
    assert plate(tmp_path).outcomes[0].curve == first.outcomes[0].curve
    assert computed == [1e-5, 3e-5, 2e-5, 1e-5]


def test_another_sweep_into_a_folder_adds_or_is_refused(
    tmp_path: Path, computed: list[float]
) -> None:
    """sweep.csv never loses a row: more values are added to it; another case and other keys need
    another folder.
    """
    plate(tmp_path)
    before = {row["point"] for row in read(tmp_path / "sweep.csv")}
    plate(tmp_path, "loading.pressure=3e-5,5e-5")
    after = (tmp_path / "sweep.csv").read_text(encoding="utf-8")
    assert computed == [1e-5, 3e-5, 5e-5]
    assert before < {row["point"] for row in read(tmp_path / "sweep.csv")}
    assert [float(row["loading.pressure"]) for row in read(tmp_path / "sweep.csv")] == [
        1e-5,
        3e-5,
        5e-5,
    ]
    with pytest.raises(
        CaseError, match="has a sweep of another case or other --set, which is kept; give another"
    ):
        plate(tmp_path, settings=("shell.radius_to_thickness=60",))
    with pytest.raises(
        CaseError,
        match=r"has a sweep over loading\.pressure, which is kept; give another folder for",
    ):
        plate(tmp_path, "shell.poisson_ratio=0.3,0.4")
    (tmp_path / "sweep.json").unlink()
    with pytest.raises(
        CaseError, match=r"has a sweep\.csv of an earlier version; give another folder"
    ):
        plate(tmp_path)
    assert (tmp_path / "sweep.csv").read_text(encoding="utf-8") == after


def test_a_large_sweep_reads_each_value_a_few_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The work before the first point grows like the number of points."""
    asked: list[str] = []
    monkeypatch.setattr(
        axes_module, "number_and_unit", lambda text: asked.append(text) or number_and_unit(text)
    )
    axes = parse_axes(["loading.pressure=1e-5:3e-5:15", "shell.poisson_ratio=0.1:0.4:4"])
    with_earlier(tmp_path, read_source(PLATE), axes, make_points(PLATE, axes))
    assert len(asked) < 10 * 60


def test_a_named_result_of_each_point(tmp_path: Path, computed: list[float]) -> None:
    """A clamped plate, w = p R^4/(64 D) at its centre (Timoshenko): a column, and a line for each
    point.

    Points that an earlier sweep has kept without that column are computed again, then they are
    kept.
    """
    plate(tmp_path)
    said: list[str] = []
    done = sweep(
        PLATE, [PRESSURES], COARSE, tmp_path, say=said.append, result="w_from_field_over_h@end"
    )
    assert computed == 2 * [1e-5, 3e-5]
    rows = read(tmp_path / "sweep.csv")
    for name in ("w_from_field_over_h@end", "result"):
        assert [float(row[name]) for row in rows] == done.results
    p_over_E = 1e-5 * 2 / (3 * (1 - 0.3**2)) ** 0.5 / 50**2
    w_over_h = p_over_E * 50**4 * 12 * (1 - 0.3**2) / 64
    assert done.results == pytest.approx([w_over_h, 3 * w_over_h], rel=2e-3)
    for w, line in zip(done.results, said[-2:], strict=True):
        assert f"w_from_field_over_h@end = {w:.9g}" in line
    sweep(PLATE, [PRESSURES], COARSE, tmp_path, result="w_from_field_over_h@end")
    assert len(computed) == 4
    over = ["--over", PRESSURES, *(f"--set={setting}" for setting in COARSE)]
    none = magshell("sweep", PLATE, *over, "--out", tmp_path, "--result", "critical_field")
    assert none.returncode == 3
    assert "2 of 2 points gave no critical_field; sweep.csv says why" in none.stderr


def test_a_frequency_at_the_end_of_each_point(tmp_path: Path) -> None:
    """A clamped disc: omega R^2 sqrt(rho h/D) = 10.2158 (Leissa, Vibration of Plates, NASA SP-160),
    so omega2 is in proportion to h^2."""
    over, still = ["shell.radius_to_thickness=50:100:2"], ["loading.pressure=1e-9", *COARSE]
    done = sweep(PLATE, over, still, tmp_path, result="omega2_1@end")
    for ratio, found in zip((50, 100), done.results, strict=True):
        assert found == pytest.approx(10.2158**2 / (12 * (1 - 0.3**2) * ratio**2), rel=5e-3)
    again = sweep(PLATE, over, still, tmp_path, result="omega2_1@end")
    assert again.results == done.results
    with pytest.raises(CaseError, match=r"hertz_1: needs shell\.density"):
        sweep(PLATE, over, still, tmp_path, result="hertz_1@end")


def test_parts_of_several_jobs_make_one_table(tmp_path: Path, computed: list[float]) -> None:
    """Each computes its share into one folder; the whole sweep then computes nothing."""
    over = "loading.pressure=1e-5:3e-5:3"
    first = sweep(PLATE, [over], COARSE, tmp_path, part="1/2")
    assert (computed, len(first.points)) == ([1e-5], 1)
    assert len(read(tmp_path / "sweep.csv")) == 1
    sweep(PLATE, [over], COARSE, tmp_path, part="2/2")
    assert len(plate(tmp_path, over).points) == len(read(tmp_path / "sweep.csv")) == 3
    assert computed == [1e-5, 2e-5, 3e-5]
    with pytest.raises(CaseError, match="--part 3/2: write it as i/n with 1 <= i <= n"):
        sweep(PLATE, [over], COARSE, tmp_path, part="3/2")


def test_values_with_units_are_numbers(tmp_path: Path) -> None:
    """A cap's fold is followed along a field in mT; the picture's line is straight to 1 %, as that
    over lambda_m is.
    """
    sizes = "radius: 25.2 mm, thickness: 0.28 mm, youngs_modulus: 1.8 MPa"
    shell = f"{{geometry: cap, polar: 60, {sizes}, poisson_ratio: 0.5, "
    file = tmp_path / "cap.yaml"
    file.write_text(
        f"shell: {shell}defect: {{kind: dimple, amplitude: 1.64, width: 3.2}}}}\n"
        "boundary: {rim: clamped}\n"
        "magnetic: {remanent: {flux_density: 63 mT}, applied: {flux_density: 1 mT}}\n"
        "loading: {kind: pressure, until: limit}\nmesh: {degree: 3, refinement: 0.5}\n",
        encoding="utf-8",
    )
    done = sweep(file, ["magnetic.applied.flux_density=-20mT:0.02T:3"], out=tmp_path / "out")
    assert [outcome.found for outcome in done.outcomes] == ["path", "fold", "fold"]
    rows = read(tmp_path / "out" / "sweep.csv")
    assert [row["magnetic.applied.flux_density"] for row in rows] == ["-20 mT", "0 mT", "20 mT"]
    assert [float(row["magnetic.applied.flux_density_mT"]) for row in rows] == [-20, 0, 20]
    low, middle, high = (float(row["pressure_Pa"]) for row in rows)
    p_c = 2 * 1.8e6 / 1.5 * (0.28 / 25.2) ** 2
    assert middle == pytest.approx(0.326233289 * p_c, rel=3e-3)
    assert middle == pytest.approx((low + high) / 2, rel=1e-2)
    assert done.axes[0].numbers == [-20, 0, 20]


def test_two_numbers_are_a_map() -> None:
    """Only if both have several values; one of another unit is converted."""
    three, two, words = (
        parse_axes([f"mesh.degree={each}"])[0] for each in ("1,2,3", "1,2", "a,b,c")
    )
    lengths = parse_axes(["shell.radius=25 mm,3 cm,0.04 m"])[0]
    assert lengths.numbers == [25, pytest.approx(30), pytest.approx(40)]
    assert is_map([three, lengths])
    assert not any(is_map([three, each]) for each in (two, words))


def test_equal_problems_are_computed_once(tmp_path: Path, computed: list[float]) -> None:
    """Without a field, its direction and its energy do not matter."""
    over = ("magnetic.energy=full,first", "magnetic.applied.polar=0,45")
    found = plate(tmp_path, *over, settings=("magnetic.lambda_m=0",))
    assert len(found.points) == 4
    assert len(computed) == len(list((tmp_path / "points").iterdir())) == 1


@pytest.mark.slow
def test_table_tells_knockdowns_and_reasons(tmp_path: Path) -> None:
    """k_d from the axisymmetric reference; a field below -0.003355 destabilises alone: no
    knockdown, but a reason.
    """
    over = ["--over", "magnetic.lambda_m=-0.004,0,0.00184", "--set=mesh.refinement=0.5"]
    done = magshell("sweep", DIMPLE, *over, "--out", tmp_path)
    assert done.returncode == 3
    assert "1 of 3 points stopped early" in done.stderr
    assert len([line for line in done.stdout.splitlines() if "/3  lambda_m=" in line]) == 3
    alone, none, positive = read(tmp_path / "sweep.csv")
    assert [row["magnetic.lambda_m"] for row in (alone, none, positive)] == [
        "-0.004",
        "0",
        "0.00184",
    ]
    assert alone["k_d"] == ""
    assert (alone["amplitude"], alone["kind"]) == ("lambda_m", "fold")
    assert float(alone["value"]) == pytest.approx(-0.003355, rel=1e-3)
    assert "the field alone makes the shell unstable" in alone["stopped"]
    for row, k_d in ((none, 0.326233289), (positive, 0.552053778)):
        # the estimate is of the order of the true error
        assert 0.3 < float(row["k_d_error"]) / abs(float(row["k_d"]) - k_d) < 3
        assert float(row["k_d"]) == float(row["p_over_pc"]) == pytest.approx(k_d, rel=3e-4)
        assert row["kind"] == "fold"
        assert row["found"] in ("path", "fold")
        assert int(row["factorisations"]) > 0
        assert row["stopped"] == ""
        assert int(row["dofs"]) > 100
        assert float(row["wall_s"]) > 0
        assert float(row["w_pole_over_h"]) > 1
        kept = json.loads(
            (tmp_path / "points" / f"{row['point']}.json").read_text(encoding="utf-8")
        )
        assert kept["case"]["magnetic"]["lambda_m"] == float(row["magnetic.lambda_m"])
    assert (tmp_path / "sweep.png").stat().st_size > 10_000


@pytest.mark.slow
def test_two_ranks_give_the_numbers_of_one(tmp_path: Path) -> None:
    over = ["--over", "shell.poisson_ratio=0.3,0.5", "--over", "loading.depth=1,2"]
    for ranks in (1, 2):
        done = magshell(
            "sweep",
            POLE,
            *over,
            *(f"--set={s}" for s in COARSE),
            "--out",
            tmp_path / str(ranks),
            ranks=ranks,
        )
        assert done.returncode == 0, done.stderr
        assert (tmp_path / str(ranks) / "sweep.png").stat().st_size > 10_000
    for name in ("sweep.csv", "curves.csv"):
        one, two = (read(tmp_path / str(ranks) / name) for ranks in (1, 2))
        assert len(one) == len(two) >= 4
        for a, b in zip(one, two, strict=True):
            assert a.keys() == b.keys()
            for key in a.keys() - {"wall_s"}:
                try:
                    assert float(b[key]) == pytest.approx(float(a[key]), rel=1e-9, abs=1e-12)
                except ValueError:
                    assert b[key] == a[key]
    none = magshell(
        *("sweep", POLE, *over, *(f"--set={s}" for s in COARSE), "--out", tmp_path / "2"),
        *("--result", "critical_field"),
        ranks=2,
    )
    assert none.returncode == 3
    assert "4 of 4 points gave no critical_field; sweep.csv says why" in none.stderr


@pytest.mark.parametrize(
    ("name", "count"),
    [("indentation", 12), ("aligned", 156), ("tilted", 195), ("noncoplanar", 195)],
)
def test_every_point_of_the_figures_is_valid(name: str, count: int) -> None:
    figure = FIGURES[name]
    assert len(points(figures.CASES / figure.case, *figure.over)) == count


@pytest.mark.slow
def test_figure_has_its_numbers_and_its_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Paper, figure b: the first-order energy gives an almost null change, the torque energy most
    of it.
    """
    over = (
        "magnetic.lambda_m=0,0.00184",
        "magnetic.energy=full,first,torque",
        "magnetic.applied.polar=0",
    )
    monkeypatch.setitem(FIGURES, "tilted", replace(FIGURES["tilted"], over=over))
    figures.make("tilted", tmp_path)
    rows = read(tmp_path / "tilted.csv")
    change = {
        (row["magnetic.energy"], row["magnetic.applied.polar"]): float(row["delta_k_d"])
        for row in rows
    }
    assert len(rows) == len(change) == 3
    assert change["full", "0"] == pytest.approx(0.552053778 - 0.326233289, rel=1e-3)
    assert abs(change["first", "0"]) < 0.06 * change["full", "0"]
    assert change["torque", "0"] == pytest.approx(change["full", "0"], rel=0.15)
    assert (tmp_path / "tilted.png").stat().st_size > 10_000
