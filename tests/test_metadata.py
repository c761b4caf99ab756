"""What says who we are, how to install and to cite, says the same everywhere."""

import re
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import jinja2
import pytest
import yaml
from conftest import CASES

from magshell_fenicsx import __version__

TOP = CASES.parent
PROJECT = tomllib.loads((TOP / "pyproject.toml").read_text(encoding="utf-8"))["project"]
OF_DOLFINX = {
    "fenics-dolfinx",
    "petsc",
    "slepc4py",
    "python-gmsh",
    "c-compiler",
    "python",
}  # on PyPI there are none
CONDA = {"matplotlib-base": "matplotlib"}  # its name there


def recipe() -> dict[str, Any]:
    """As conda-build reads it: a template first, then YAML."""
    text = (TOP / "conda-recipe/meta.yaml").read_text(encoding="utf-8")
    filled = (
        jinja2.Environment(undefined=jinja2.StrictUndefined)
        .from_string(text)
        .render(PYTHON="python")
    )
    return dict(yaml.safe_load(filled))


def named(lines: list[Any]) -> dict[str, str]:
    """Names -> bounds, of lines such as "pydantic>=2.9"."""
    parts = (
        re.match(r"([\w-]+)\s*([^#]*\S|)", line)
        for line in lines
        if isinstance(line, str) and line != "."
    )
    return {CONDA.get(part[1], part[1]): part[2] for part in parts if part}


def test_one_version() -> None:
    citation = yaml.safe_load((TOP / "CITATION.cff").read_text(encoding="utf-8"))
    assert str(citation["version"]) == recipe()["package"]["version"] == __version__
    assert recipe()["package"]["name"] == PROJECT["name"]


def test_dependencies_agree() -> None:
    """Of pip, of the environment for conda, and of the recipe; bounds too."""
    extra = PROJECT["optional-dependencies"][
        "dolfinx"
    ]  # its other packages have other names on conda-forge
    pip = named(PROJECT["dependencies"]) | {"setuptools": named(extra)["setuptools"]}
    dependencies = yaml.safe_load((TOP / "environment.yml").read_text(encoding="utf-8"))[
        "dependencies"
    ]
    (inner,) = (entry["pip"] for entry in dependencies if isinstance(entry, dict))
    environment = named(dependencies) | named(inner)
    run = named(recipe()["requirements"]["run"])
    assert {name: bound for name, bound in run.items() if name not in OF_DOLFINX} == pip
    newest = re.search(r"<[\d.]+", named(extra)["dolfinx-solver-real"])
    assert newest
    assert newest[0] in run["fenics-dolfinx"].split(",")
    assert {name: bound for name, bound in environment.items() if name != "pip"} == run
    assert recipe()["build"]["entry_points"] == [f"magshell = {PROJECT['scripts']['magshell']}"]
    assert set(recipe()["requirements"]["host"]) == {
        f"python {PROJECT['requires-python']}",
        "pip",
        "setuptools >=77",
    }


def test_commands_of_the_recipe() -> None:
    """They are what the recipe's test environment runs: names of examples and options exist."""
    commands = [line.split() for line in recipe()["test"]["commands"]]
    assert [words[:2] for words in commands] == [
        ["magshell", word] for word in ("--version", "example", "run")
    ]
    assert (CASES / commands[2][2]).is_file()


def test_placeholders_are_where_it_is_said() -> None:
    """The page that lists them, and the files that have them."""
    page = (TOP / "docs/design.md").read_text(encoding="utf-8")
    (said,) = re.findall(r"`example\.org` stands for it in (.*?), and nowhere", page, re.DOTALL)
    listed = set(re.findall(r"`([^`]+)`", said))
    for name in listed:
        assert "example.org" in (TOP / name).read_text(encoding="utf-8"), name
    git = subprocess.run(
        ["git", "grep", "-l", "example.org"], cwd=TOP, capture_output=True, text=True
    )
    if git.returncode:
        pytest.skip("no repository of git")
    assert set(git.stdout.split()) - {"docs/design.md", "tests/test_metadata.py"} == listed


@pytest.mark.parametrize(
    "form", sorted((TOP / ".github/ISSUE_TEMPLATE").glob("*.yml")), ids=lambda form: form.stem
)
def test_forms_for_issues(form: Path) -> None:
    """What a form needs: a name, a description, and a label for each field, none twice."""
    content = yaml.safe_load(form.read_text(encoding="utf-8"))
    if form.stem == "config":
        assert all({"name", "url", "about"} == link.keys() for link in content["contact_links"])
        return
    assert content["name"]
    assert content["description"]
    ids = [field["id"] for field in content["body"]]
    assert len(set(ids)) == len(ids)
    assert all(field["attributes"]["label"] for field in content["body"])
