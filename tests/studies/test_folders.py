"""Studies of many runs replace no files of others, and no tables of another case file."""

import json
from pathlib import Path

import pytest
from command import magshell
from conftest import CASES

CASE = CASES / "dimple_buckling.yaml"
# the words of a command, its table in JSON, what a folder says that has one, its other tables
COMMANDS = {
    "sweep": ((CASE, "--over", "mesh.degree=2,3"), "sweep.json", {}, ("curves.csv", "sweep.png")),
    "ensemble": (
        (CASES / "random_dimples.yaml", "--samples", 2, "--seed", 1),
        "summary.json",
        {"seed": 1, "samples": 2},
        ("ensemble.png", "report.md", "samples.csv"),
    ),
    "study": (
        (CASE, "--over", "mesh.degree=2,3", "--result", "knockdown"),
        "study.json",
        {"machine": {}, "result": "knockdown"},
        ("study.csv", "study.md", "study.png"),
    ),
    "design": (
        (CASES / "designed_strip.yaml",),
        "summary.json",
        {"objective": {}, "best": {}},
        ("best.csv", "best.yaml", "design.csv", "design.png"),
    ),
    "compare": (
        (CASE,),
        "compare.json",
        {"difference": 0.1, "runs": {}},
        ("compare.csv", "compare.png"),
    ),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_files_of_others_are_refused(tmp_path: Path, name: str) -> None:
    words, first, _, tables = COMMANDS[name]
    for file in (first, *tables):
        (tmp_path / file).write_text("mine", encoding="utf-8")
    refused = magshell(name, *words, "--out", tmp_path)
    assert refused.returncode == 2
    assert (
        f"none is known to have written: {', '.join(sorted((first, *tables)))}; move them away"
        in refused.stderr
    )
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == dict.fromkeys(
        (first, *tables), "mine"
    )


@pytest.mark.parametrize("name", [name for name, (_, _, known, _) in COMMANDS.items() if known])
def test_another_case_is_refused(tmp_path: Path, name: str) -> None:
    words, first, known, tables = COMMANDS[name]
    for file in tables:
        (tmp_path / file).write_text("results", encoding="utf-8")
    (tmp_path / first).write_text(json.dumps(known | {"case": "other.yaml"}), encoding="utf-8")
    refused = magshell(name, *words, "--out", tmp_path)
    assert refused.returncode == 2
    assert "of other.yaml, which is kept; give another folder" in refused.stderr
    assert {file.name for file in tmp_path.iterdir()} == {first, *tables}


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"keys": 3, "base": "", "points": []}'])
def test_a_damaged_list_of_points(tmp_path: Path, content: str) -> None:
    (tmp_path / "points").mkdir()
    (tmp_path / "points" / "0.json").write_text('{"outcome": {}}', encoding="utf-8")
    (tmp_path / "sweep.json").write_text(content, encoding="utf-8")
    refused = magshell("sweep", CASE, "--over", "mesh.degree=2,3", "--out", tmp_path)
    assert refused.returncode == 2
    assert refused.stderr.startswith(f"{tmp_path / 'sweep.json'}: is damaged")
