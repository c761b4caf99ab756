"""The benchmark: its smallest items on coarse meshes, and the comparison of two of its files."""

import json
from pathlib import Path
from typing import Any

import pytest
from speed import measure
from speed.__main__ import main
from speed.items import CASES, HALF, ITEMS, K_D, Item
from speed.measure import BenchFailed, measure_item
from speed.report import compare, derived, table

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.studies.results import parse_scalar


def file(machine: str = "a", **numbers: float) -> dict[str, Any]:
    machines = {
        "cpu": machine,
        "cores": 2,
        "memory_gb": 8,
        "blas": "openblas",
        "versions": {"dolfinx": "0.9.0"},
    }
    return {
        "machine": machines,
        "items": {"x": {key: {"median": value} for key, value in numbers.items()}},
    }


@pytest.mark.parametrize("item", ITEMS.values(), ids=ITEMS)
def test_every_item_is_a_valid_case(item: Item) -> None:
    make_problem(Case.load(CASES / f"{item.case}.yaml", item.settings))
    for name in item.references:
        parse_scalar(name)


def test_ratios_beyond_a_fifth_are_marked() -> None:
    same, slower, faster = (
        line.split()
        for line in compare(file(a_s=1.1, b_s=2.5, c_s=0.5, d_s=1), file(a_s=1, b_s=2, c_s=1))
    )
    assert same == ["x", "a_s", "1.100"]
    assert slower == ["x", "b_s", "1.250", "more"]
    assert faster == ["x", "c_s", "0.500", "less"]


def test_other_machine_is_taken_out_of_times_alone() -> None:
    """Three times as slow in all but one: that one, and the count, stand out."""
    new, old = file("b", a_s=3, b_s=6, c_s=12, count=4), file("a", a_s=1, b_s=2, c_s=1, count=3)
    lines = compare(new, old)
    assert "Not the same machine" in lines[2]
    assert [line.split()[2:] for line in lines[3:]] == [
        ["1.000"],
        ["1.000"],
        ["4.000", "more"],
        ["1.333", "more"],
    ]


def test_ratios_within_a_benchmark() -> None:
    """Factorisation 5 and back-solves 1 of 8 seconds; an iteration of 6.6 against 4.4 s."""

    def item(**numbers: float) -> dict[str, Any]:
        return {key: {"median": value} for key, value in numbers.items()}

    path = item(factor_wall_s=5, back_solve_wall_s=1, solve_phase_wall_s=8)
    one = item(tangent_wall_s=2, factor_wall_s=4, back_solves_wall_s=0.4, residual_wall_s=0.2)
    two = item(tangent_wall_s=1, factor_wall_s=3, back_solves_wall_s=0.2, residual_wall_s=0.2)
    found = derived(
        {"k_d 20 000": path, "iteration 100 000": one, "iteration 100 000, 2 ranks": two}
    )
    assert list(found.values()) == pytest.approx([0.75, 1.5])
    assert derived({"iteration 100 000": one}) == {}


def test_growth_with_the_unknowns() -> None:
    """Four times the unknowns and eight times the seconds: the power 3/2."""

    def item(dofs: float, seconds: float) -> dict[str, Any]:
        parts = {
            f"{part}_cpu_s": {"median": seconds}
            for part in ("tangent", "factor", "back_solves", "residual")
        }
        return {"dofs": {"median": dofs}, **parts}

    assert list(
        derived({"iteration 10 000": item(1e4, 1), "iteration 30 000": item(4e4, 8)}).values()
    ) == [1.5]


def test_table_has_the_medians_and_the_ratios() -> None:
    """Columns without a number are empty."""
    lines = table({**file(error=1.23e-4, peak_mb=512.4), "derived": {"a ratio": 0.5}}).splitlines()
    row = next(line for line in lines if line.startswith("| x "))
    assert [cell.strip() for cell in row.split("|") if cell.strip()] == ["x", "1.2e-04", "512"]
    assert lines[-1] == "- a ratio: 0.5"


@pytest.mark.slow
def test_path_of_the_meridian() -> None:
    """k_d of the axisymmetric solver; the solve phase is a part of its process."""
    numbers = measure_item(Item("path", "dimple_buckling", ("mesh.refinement=0.5",), K_D, repeat=2))
    assert all(len(values) == 2 for values in numbers.values())
    assert numbers["error"] == pytest.approx([2.6e-6] * 2, rel=0.1)
    assert numbers["factorisations"][0] == numbers["factorisations"][1] > 3
    for solve, process in zip(numbers["solve_phase_cpu_s"], numbers["process_cpu_s"], strict=True):
        assert 0 < solve < process
    assert 0 < numbers["factor_wall_s"][0] < numbers["solve_phase_wall_s"][0]


@pytest.mark.slow
def test_pieces_of_an_iteration() -> None:
    item = Item("iteration", "dimple_buckling", (*HALF, "mesh.refinement=0.3"), ranks=2, repeat=1)
    numbers = measure_item(item)
    assert numbers["dofs"] == [2577]
    for name in ("tangent", "factor", "back_solves", "residual"):
        assert numbers[f"{name}_wall_s"][0] > 0
    assert numbers["negative_pivots"] == [0]


@pytest.mark.slow
def test_cold_kernels_are_compiled() -> None:
    """The meridian's take seconds in an empty cache, and a tenth of one in a full cache."""
    settings = ("mesh.refinement=0.5", "mesh.degree=3")
    cold = measure_item(Item("kernels", "dimple_buckling", settings, repeat=1, cold=True))
    warm = measure_item(Item("kernels", "dimple_buckling", settings, repeat=1))
    assert cold["jit_s"][0] > 5 * warm["jit_s"][0]
    assert cold["kernels"] == warm["kernels"]


@pytest.mark.slow
def test_file_and_comparison(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(
        ITEMS, "k_d meridian", Item("run", "dimple_buckling", ("mesh.refinement=0.5",), repeat=1)
    )
    earlier, out = (
        file("b", process_wall_s=1, process_cpu_s=1, peak_mb=100),
        tmp_path / "deep" / "b.json",
    )
    (tmp_path / "a.json").write_text(
        json.dumps(earlier | {"items": {"k_d meridian": earlier["items"]["x"]}})
    )
    main(["k_d meridian", "--out", str(out), "--compare", str(tmp_path / "a.json")])
    found = json.loads(out.read_text(encoding="utf-8"))
    numbers = found["items"]["k_d meridian"]
    assert set(numbers) == {"process_wall_s", "process_cpu_s", "peak_mb"}
    assert numbers["peak_mb"]["median"] == numbers["peak_mb"]["all"][0] > 100
    assert found["machine"]["cpu"]
    assert "| k_d meridian |" in out.with_suffix(".md").read_text(encoding="utf-8")
    assert [line.split()[2] for line in capsys.readouterr().out.splitlines()[-3:]] == [*numbers]


def test_mistakes_are_messages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in (
        (["nothing"], "no item 'nothing'"),
        (["--compare", "/none.json"], "--compare /none.json"),
    ):
        with pytest.raises(SystemExit) as e:
            main(words)
        assert e.value.code == 2
        assert said in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_that_stops_is_no_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    """The field -0.004 is beyond the critical one, -0.0033554."""
    settings = ("magnetic.lambda_m=-0.004", "mesh.refinement=0.5")
    with pytest.raises(BenchFailed, match="the field alone makes the shell unstable"):
        measure_item(Item("path", "dimple_buckling", settings, repeat=1))
    monkeypatch.setattr(measure, "CASES", Path("/none"))
    with pytest.raises(BenchFailed, match="exit code"):
        measure_item(Item("path", "dimple_buckling", repeat=1))
