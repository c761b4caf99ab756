"""What is published, and that it does its work where only pip put it: another folder, without the
repository.
"""

import csv
import email
import json
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest
from conftest import CASES

from magshell_fenicsx import __version__
from magshell_fenicsx.case.examples import examples
from magshell_fenicsx.case.reference import schema_text
from magshell_fenicsx.platform import environment

TOP = CASES.parent
QUICK = ("--set=mesh.degree=3", "--set=mesh.refinement=0.3")
CASE = "dimple_buckling.yaml"


def outside(command: list[str | Path], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder, without the path to the repository that tests have."""
    told = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, cwd=folder, env=told
    )


class Installed:
    """The program in an environment of its own, and the folder that it is used from."""

    def __init__(self, place: Path) -> None:
        self.bin, self.folder = place / "venv" / "bin", place / "folder"
        self.folder.mkdir()

    def magshell(self, *words: str) -> str:
        """What a command says that succeeds."""
        done = outside([self.bin / "magshell", *words], self.folder)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def python(self, program: str) -> str:
        """What a program prints."""
        done = outside([self.bin / "python", "-c", program], self.folder)
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()


@dataclass(frozen=True)
class Built:
    """What is published."""

    sdist: Path
    wheel: Path


BACKEND = (
    "import sys; from setuptools import build_meta; "
    "print(getattr(build_meta, sys.argv[1])(sys.argv[2]))"
)


def built(kind: str, source: Path, to: Path) -> Path:
    """The sdist or the wheel of a folder, as a frontend has it made."""
    done = outside([sys.executable, "-c", BACKEND, f"build_{kind}", to], source)
    assert done.returncode == 0, done.stderr
    return to / done.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> Built:
    """The sdist of a copy of the repository, for setuptools leaves its build in there, and the
    wheel of the sdist.
    """
    place = tmp_path_factory.mktemp("built")
    left_out = shutil.ignore_patterns(
        "__pycache__", "*.egg-info", ".*", "build", "results", "docs", "tests"
    )
    shutil.copytree(TOP, place / "copy", ignore=left_out)
    sdist = built("sdist", place / "copy", place)
    shutil.unpack_archive(sdist, place / "unpacked", filter="data")
    (source,) = (place / "unpacked").iterdir()
    wheel = built("wheel", source, place)
    for folder in ("copy", "unpacked"):
        shutil.rmtree(place / folder)
    return Built(sdist, wheel)


@pytest.fixture(scope="module")
def installed(archives: Built, tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """From the wheel, with dolfinx and the rest of the system's packages."""
    place = tmp_path_factory.mktemp("installed")
    home = place / "venv"
    offline = ("--no-deps", "--no-index", "--disable-pip-version-check")
    commands: list[list[str | Path]] = [
        [sys.executable, "-m", "venv", "--without-pip", "--system-site-packages", home],
        [sys.executable, "-m", "pip", "--python", home, "install", *offline, archives.wheel],
    ]
    for command in commands:
        done = outside(command, place)
        assert done.returncode == 0, done.stderr
    return Installed(place)


@pytest.mark.slow
def test_what_is_published(archives: Built) -> None:
    """A wheel for every machine with Python 3, its metadata complete, and the sources with their
    licence.
    """
    assert archives.wheel.name == f"magshell_fenicsx-{__version__}-py3-none-any.whl"
    with zipfile.ZipFile(archives.wheel) as wheel:
        names = wheel.namelist()
        (metadata,) = (name for name in names if name.endswith(".dist-info/METADATA"))
        told = email.message_from_bytes(wheel.read(metadata))
    assert told["Name"] == "magshell-fenicsx"
    assert told["License-Expression"] == "MIT"
    assert told.get_payload().startswith("# magshell_fenicsx\n")
    assert all(
        told[key]
        for key in ("Summary", "Author", "Keywords", "Requires-Python", "Classifier", "Project-URL")
    )
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {"magshell_fenicsx"}, (
        "no tests, no cases"
    )
    with tarfile.open(archives.sdist) as sdist:
        sources = {name.partition("/")[2] for name in sdist.getnames()}
    assert sources >= {"LICENSE", "README.md", "pyproject.toml", "setup.py", "meshes/gripper.msh"}


@pytest.mark.slow
def test_what_is_installed(installed: Installed) -> None:
    """The code with template, C source and marker of types. Of cases/ the examples alone."""
    package = Path(installed.python("import magshell_fenicsx; print(magshell_fenicsx.__path__[0])"))
    assert package.is_relative_to(installed.bin.parent)
    for file in ("py.typed", "assembly/scatter.c", "output/report/report_template.html"):
        assert (package / file).is_file()
    there = {
        file.relative_to(package / "examples").as_posix()
        for file in (package / "examples").rglob("*.*")
    }
    cases = {file.relative_to(TOP).as_posix() for file in examples().values()}
    beside = {"cases/arch_triangle.csv", *(f"cases/identify_{of}.csv" for of in ("arch", "field"))}
    beside |= {
        f"meshes/{of}.msh" for of in ("bracket", "gripper", "gripper_closed", "stack", "strips")
    }
    assert there == cases | beside


@pytest.mark.slow
def test_results_are_of_the_same_sources(installed: Installed) -> None:
    """What the repository's program keeps on disk, the installed one goes on with, and the other
    way round.
    """
    assert (
        installed.python(
            "from magshell_fenicsx.platform.environment import code_version; print(code_version())"
        )
        == environment.code_version()
    )


@pytest.mark.slow
def test_commands_without_a_case(installed: Installed) -> None:
    assert installed.magshell("--version") == f"magshell_fenicsx {__version__}\n"
    assert installed.magshell("schema") == schema_text()
    assert len(installed.magshell("example").splitlines()) == len(examples())


@pytest.mark.slow
def test_a_case_with_a_mesh(installed: Installed) -> None:
    """The mesh comes with the case, and is found beside it."""
    installed.magshell("example", "bracket")
    assert "built:" in installed.magshell("check", "bracket.yaml")


@pytest.mark.slow
def test_the_way_of_an_example(installed: Installed) -> None:
    """Written, checked, run, drawn again, swept (the second time from the disk), studied.

    k_d = 0.326233 of an axisymmetric solver; this mesh is coarse.
    """
    folder = installed.folder / "results"
    installed.magshell("example", "dimple_buckling")
    assert "R/h = 90" in installed.magshell("check", CASE)

    installed.magshell("run", CASE, *QUICK)
    summary = json.loads((folder / "dimple_buckling/summary.json").read_text(encoding="utf-8"))
    assert summary["knockdown"] == pytest.approx(0.326233, abs=5e-4)
    (folder / "dimple_buckling/report.html").unlink()
    assert "report.html" in installed.magshell("plot", "results/dimple_buckling")
    assert (folder / "dimple_buckling/report.html").read_text(encoding="utf-8").count(
        "data:image/png;base64,"
    ) >= 4

    sweep = ("sweep", CASE, *QUICK, "--over", "magnetic.lambda_m=0,1e-4")
    installed.magshell(*sweep)
    before = {
        file: file.stat().st_mtime_ns
        for file in (folder / "dimple_buckling_sweep/points").iterdir()
    }
    installed.magshell(*sweep)
    assert before == {
        file: file.stat().st_mtime_ns
        for file in (folder / "dimple_buckling_sweep/points").iterdir()
    }
    assert len(rows(folder / "dimple_buckling_sweep/sweep.csv")) == 2

    over = (
        "--over",
        "mesh.refinement=0.3",
        "--set=mesh.degree=3",
        "--result",
        "knockdown",
        "--repeat",
        "1",
    )
    installed.magshell("study", CASE, *over)
    assert len(rows(folder / "dimple_buckling_study/study.csv")) == 1


def rows(file: Path) -> list[dict[str, str]]:
    """Of a table."""
    with file.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))
