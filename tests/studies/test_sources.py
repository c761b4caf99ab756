"""What is kept on disk is not taken for a result of other sources, of another case or of another
mesh.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from benchmarks import obstacles
from conftest import CASES
from many import study, sweep
from test_sweep import plate

import magshell_fenicsx
from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import document_of
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store import run_identity
from magshell_fenicsx.output.store.manifest import MESH
from magshell_fenicsx.output.store.stored_results import GROUPS, PHASES
from magshell_fenicsx.output.store.table import COLUMNS, TEXTS
from magshell_fenicsx.platform import environment
from magshell_fenicsx.platform.processes import Usage
from magshell_fenicsx.public import run
from magshell_fenicsx.runs.files import AlreadyComplete
from magshell_fenicsx.studies.compare import model_runs as runs
from magshell_fenicsx.studies.results import parse_scalar
from magshell_fenicsx.studies.study import timings as sample
from magshell_fenicsx.studies.study.study import _outcome
from magshell_fenicsx.studies.sweep import chains as chain

PACKAGE, BUCKLING = Path(magshell_fenicsx.__file__).parent, CASES / "dimple_buckling.yaml"
QUICK = ["mesh.degree=3", "mesh.refinement=0.3"]
OTHER = "0.1.0+anotherhash00000"


@pytest.fixture
def edited(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Called, makes the sources others."""
    return lambda: monkeypatch.setattr(environment, "_RUNNING_VERSION", OTHER)


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A folder with a copy of the package, as an installation makes it."""
    shutil.copytree(
        PACKAGE, tmp_path / "site" / PACKAGE.name, ignore=shutil.ignore_patterns("__pycache__")
    )
    return tmp_path / "site"


def magshell(site: Path, *words: str | Path) -> subprocess.CompletedProcess[str]:
    """The program in a folder."""
    told = {**os.environ, "PYTHONPATH": str(site)}
    command = [sys.executable, "-m", "magshell_fenicsx", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=site, env=told)


def test_every_file_of_the_package_counts(copied: Path) -> None:
    """Code, C and template: changed, renamed, added, taken away; where it lies and what Python
    compiles do not.
    """
    package = copied / PACKAGE.name
    known = [environment.source_version(package)]
    assert known == [environment.code_version()]
    (package / "__pycache__").mkdir()
    (package / "__pycache__" / "cli.cpython-313.pyc").write_bytes(b"compiled")
    assert known == [environment.source_version(package)]
    for file in (
        "continuation/newton.py",
        "assembly/scatter.c",
        "output/report/report_template.html",
    ):
        with (package / file).open("a", encoding="utf-8") as stream:
            stream.write("\n")
        known.append(environment.source_version(package))
    (package / "continuation" / "newton.py").rename(package / "continuation" / "newtons.py")
    known.append(environment.source_version(package))
    (package / "new.py").touch()
    known.append(environment.source_version(package))
    (package / "models" / "shell" / "edges.py").unlink()
    known.append(environment.source_version(package))
    assert len(set(known)) == 7


@pytest.mark.slow
def test_an_interrupted_run_of_an_edited_program(copied: Path, tmp_path: Path) -> None:
    """In a copy of the package, one file of which is changed: one message, exit code 2, nothing is
    lost.
    """
    words = ("run", BUCKLING, *(f"--set={setting}" for setting in QUICK), "--out", tmp_path / "out")
    assert magshell(copied, *words, "--time-limit", "0").returncode == 3
    before = (tmp_path / "out" / "checkpoint").read_bytes()
    with (copied / PACKAGE.name / "continuation" / "newton.py").open(
        "a", encoding="utf-8"
    ) as stream:
        stream.write("\n# another tolerance\n")
    done = magshell(copied, *words, "--resume")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    version = magshell_fenicsx.__version__
    assert (
        f"--resume: {tmp_path}/out was computed by other sources of magshell_fenicsx ({version}+"
        in done.stderr
    )
    assert "--overwrite in place of --resume computes it again" in done.stderr
    assert (tmp_path / "out" / "checkpoint").read_bytes() == before


def test_a_complete_run_of_other_sources(tmp_path: Path, edited: Any, no_pictures: None) -> None:
    """Is not complete; the benchmarks, which keep theirs, compute it again and say so."""
    case = Case.load(BUCKLING, QUICK)
    run(case, tmp_path)
    with pytest.raises(AlreadyComplete):
        run(case, tmp_path, resume=True)
    edited()
    with pytest.raises(run_identity.OtherSources, match=OTHER.replace("+", r"\+")):
        run(case, tmp_path, resume=True)
    assert (tmp_path / "summary.json").exists()
    summary, _ = obstacles.finished(case, tmp_path)
    assert summary["sources"] == OTHER


def test_what_differs_is_told(tmp_path: Path, edited: Any) -> None:
    """The case where it does, else the sources; what an earlier version of the program left is of
    others.
    """
    this, file = document_of(Case.load(BUCKLING)), tmp_path / "checkpoint"
    file.write_bytes(run_identity.empty_checkpoint(this))
    run_identity.check_resumable(file, this)
    known = run_identity.identity(this)
    edited()
    with pytest.raises(CaseError, match=r"another run: mesh.degree is 4 there and 3 here"):
        run_identity.check_resumable(file, document_of(Case.load(BUCKLING, ["mesh.degree=3"])))
    with pytest.raises(run_identity.OtherSources):
        run_identity.check_resumable(file, this)
    with pytest.raises(run_identity.OtherSources, match=r"\(0\.1\.0; these are"):
        run_identity.refuse_other_case({"version": "0.1.0", "case": known["case"]}, this, tmp_path)


def test_the_mesh_for_a_tolerance(tmp_path: Path, edited: Any, no_pictures: None) -> None:
    """Is not taken over from other sources."""
    case = Case.load(BUCKLING, ["mesh.tolerance=1e-2"])
    assert run(case, tmp_path, time_limit=0).stopped
    (tmp_path / MESH).write_bytes(b"of these sources")
    edited()
    with pytest.raises(run_identity.OtherSources):
        run(case, tmp_path, resume=True)
    assert run(case, tmp_path, overwrite=True).stopped is None
    assert (tmp_path / MESH).read_bytes() != b"of these sources"


@pytest.mark.slow
def test_points_of_a_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, edited: Any) -> None:
    """Are computed again, and it is said how many and why; then they are kept again."""
    said, computed = [], []
    whole = chain.run
    monkeypatch.setattr(
        chain, "run", lambda case, comm: computed.append(case) or whole(case, comm=comm)
    )

    def again(*over: str) -> list[str]:
        said.clear()
        computed.clear()
        plate(tmp_path, *over, say=said.append)
        return [line for line in said if "again" in line]

    assert again() == []
    assert len(computed) == 2
    edited()
    assert again("loading.pressure=1e-5:3e-5:3") == [
        "2 of these computed again: their files are of other sources of magshell_fenicsx, "
        "or damaged"
    ]
    assert len(computed) == 3
    assert again("loading.pressure=1e-5:3e-5:3") == []
    assert computed == []
    stored_outcome = [
        json.loads(file.read_text(encoding="utf-8")) for file in (tmp_path / "points").iterdir()
    ]
    assert [point["sources"] for point in stored_outcome] == 3 * [OTHER]


SUMMARY = {
    "case": {"model": "shell", "shell": {"geometry": "hemisphere"}, "mesh": {}},
    "dimensionless": dict.fromkeys(GROUPS, 1.0),
    "dimensions": {"radius": None, "thickness": None, "youngs_modulus": None, "units": "SI"},
    "model": {"included": [], "left_out": []},
    "stopped": None,
    "sensitivities": {},
    "knockdown": 0.3,
    "mesh": {"cells": 9, "dofs": 99, "degree": 3},
    "timing": dict.fromkeys(PHASES, 0.0),
    **dict.fromkeys(("points", "factorisations", "iterations", "ranks"), 1),
    "blas": "openblas",
    "versions": {"magshell_fenicsx": "0.1.0"},
}


def faked(monkeypatch: pytest.MonkeyPatch, module: Any) -> list[str]:
    """Runs that leave a summary at once, by which sources it says."""
    by: list[str] = []

    def measure(_: str, words: list[str], ranks: int = 1) -> Usage:
        out = Path(words[words.index("--out") + 1])
        out.mkdir(parents=True, exist_ok=True)
        by.append(environment.code_version())
        (out / "summary.json").write_text(
            json.dumps({**SUMMARY, "sources": by[-1]}), encoding="utf-8"
        )
        row = {name: "" if name in TEXTS else "0" for name in COLUMNS}
        (out / "path.csv").write_text(
            f"{','.join(row)}\n{','.join(row.values())}\n", encoding="utf-8"
        )
        return Usage(0, 1.0, 1.0, 100.0, "", "")

    monkeypatch.setattr(module, "measure", measure)
    return by


def test_samples_of_a_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, edited: Any) -> None:
    by, said = faked(monkeypatch, sample), list[str]()

    def measured() -> int:
        before = len(by)
        said.clear()
        study(
            BUCKLING,
            ["mesh.refinement=0.3,0.5"],
            result="knockdown",
            repeat=1,
            out=tmp_path,
            say=said.append,
        )
        return len(by) - before

    assert (measured(), measured()) == (4, 0)
    assert not any("again" in line for line in said)
    edited()
    assert measured() == 4
    assert (
        said[0]
        == "2 of 2 computed again: the folder has results of other sources of magshell_fenicsx"
    )
    assert measured() == 0


def test_a_program_that_changes_under_a_study(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run of other sources than the study's is no sample."""
    faked(monkeypatch, sample)
    measured = sample.Timings({})
    sample.complete(measured, ["case"], 1, 3, tmp_path / "kept.json", {"sources": OTHER})
    assert measured.failure == "the program or the mesh file was changed during the study"
    assert _outcome(measured, parse_scalar("knockdown")) == f"stopped early: {measured.failure}"
    assert not measured.samples


def test_runs_of_a_comparison(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, edited: Any) -> None:
    by, said = faked(monkeypatch, runs), list[str]()

    def measured() -> int:
        before = len(by)
        runs.run_model(BUCKLING, [], "shell", 0.5, tmp_path / "shell", said.append)
        return len(by) - before

    assert (measured(), measured(), said) == (1, 0, [])
    edited()
    assert measured() == 1
    why = "the folder has results of other sources of magshell_fenicsx"
    assert said == [f"shell at refinement 0.5: computed again, {why}"]
    assert measured() == 0
    for name in ("path.csv", "summary.json"):
        file = tmp_path / "shell" / name
        file.write_text("{", encoding="utf-8")
        assert (measured(), measured()) == (1, 0)
        assert said[-1].startswith(f"shell at refinement 0.5: computed again, {file}: is damaged")


@pytest.mark.usefixtures("no_pictures")
def test_a_mesh_file_that_changes_on_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All points of a sweep, and all of a run, are of the mesh that it began with."""
    (tmp_path / "bracket.msh").write_bytes((CASES.parent / "meshes" / "bracket.msh").read_bytes())
    text = (CASES / "bracket.yaml").read_text(encoding="utf-8").replace("../meshes/", "")
    (tmp_path / "case.yaml").write_text(text, encoding="utf-8")
    settings, whole = ["mesh.degree=2", "loading.factor=0.01", "loading.points=1"], chain.run

    def edited(case: Case, comm: Any) -> Any:
        found = whole(case, comm=comm)
        with (tmp_path / "bracket.msh").open("a", encoding="utf-8") as stream:
            stream.write("$Comments\nanother\n$EndComments\n")
        return found

    monkeypatch.setattr(chain, "run", edited)
    first = Case.load(tmp_path / "case.yaml", settings).outside["mesh_file"]
    done = sweep(
        tmp_path / "case.yaml", ["shell.poisson_ratio=0.2,0.3"], settings, tmp_path / "out"
    )
    assert [point.case.outside["mesh_file"] for point in done.points] == [first, first]
    case = Case.load(tmp_path / "case.yaml", settings)
    before = case.outside["mesh_file"]

    def say(line: str) -> None:
        with (tmp_path / "bracket.msh").open("a", encoding="utf-8") as stream:
            stream.write("\n")

    run(case, tmp_path / "run", say=say)
    assert (
        case.outside["mesh_file"]
        == before
        != Case.load(tmp_path / "case.yaml", settings).outside["mesh_file"]
    )
    assert (
        json.loads((tmp_path / "run" / "summary.json").read_text(encoding="utf-8"))["mesh_file"]
        == before
    )
