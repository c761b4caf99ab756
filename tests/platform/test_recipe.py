"""Apptainer's recipe has what the Dockerfile has. Conda's list has what pyproject.toml needs."""

import re
import shlex
import subprocess
import tomllib
from pathlib import Path

import yaml
from conftest import CASES

TOP = CASES.parent


def test_recipe_has_the_commands_of_the_dockerfile(tmp_path: Path) -> None:
    """All of RUN, in order, as a program that a shell can read; every file is there."""
    made = subprocess.run(
        [TOP / ".ci/apptainer-recipe"], capture_output=True, text=True, check=True
    ).stdout
    head, files, post, *rest = re.split(r"^%\w+.*\n", made, flags=re.MULTILINE)
    assert head.split() == ["Bootstrap:", "docker", "From:", "debian:trixie-slim"]
    pairs = [shlex.split(line) for line in files.splitlines() if line]
    assert all(Path(source).exists() for source, _ in pairs)
    assert {"/usr/src/magshell/magshell_fenicsx", "/usr/src/magshell/meshes"} <= {
        target for _, target in pairs
    }
    dockerfile = re.sub(r" *\\\n *", " ", (TOP / "Dockerfile").read_text(encoding="utf-8"))
    runs = [
        line.removeprefix("RUN ") for line in dockerfile.splitlines() if line.startswith("RUN ")
    ]
    assert len(runs) > 3
    assert [line.strip() for line in post.splitlines() if line.strip() in runs] == runs
    for part in (post, *rest):
        (tmp_path / "part").write_text(part, encoding="utf-8")
        subprocess.run(["bash", "-n", tmp_path / "part"], check=True)


def test_conda_has_what_the_package_needs() -> None:
    listed = yaml.safe_load((TOP / "environment.yml").read_text(encoding="utf-8"))["dependencies"]
    pip = next(each["pip"] for each in listed if isinstance(each, dict))
    there = {
        re.split(r"[ <>=]", each)[0] for each in [*(x for x in listed if isinstance(x, str)), *pip]
    }
    needed = tomllib.loads((TOP / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "dependencies"
    ]
    assert {re.split("[<>=]", each)[0] for each in needed} | {
        "fenics-dolfinx",
        "slepc4py",
        "python-gmsh",
    } <= there
