"""What packages leave to each other, beyond the order of imports that `make lint` checks."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import magshell_fenicsx
from magshell_fenicsx.parts.registry import REGISTERED

PACKAGE = Path(magshell_fenicsx.__file__).parent
PARTS = f"{PACKAGE.name}.parts"
REGISTRY = {"kinds", "registered", "registry"}  # modules by which others find parts
MODELS_AND_TERMS = {
    "OwnTerm",
    "Magnetisation",
    "Loads",
    "ShellModel",
    "MeridianModel",
    "SolidModel",
}


@cache
def trees(package: str) -> list[tuple[str, list[ast.AST]]]:
    """Name and all nodes of each file of a package."""
    files = sorted((PACKAGE / package).rglob("*.py"))
    assert files
    return [
        (
            str(file.relative_to(PACKAGE)),
            list(ast.walk(ast.parse(file.read_text(encoding="utf-8")))),
        )
        for file in files
    ]


def imported_parts(nodes: list[ast.AST], *, with_types: bool) -> Iterator[str]:
    """The modules and packages of `parts` that a file imports, also within functions.

    `with_types` includes what is imported for types alone.
    """
    typed = {
        inner
        for node in nodes
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for each in node.body
        for inner in ast.walk(each)
    }
    for node in nodes:
        if node in typed and not with_types:
            continue
        names = list[str]()
        if isinstance(node, ast.ImportFrom) and node.module == PARTS:
            names = [f"{PARTS}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        yield from (
            name.removeprefix(f"{PARTS}.").split(".")[0]
            for name in names
            if name.startswith(f"{PARTS}.")
        )


@pytest.mark.parametrize("package", ["case", "studies", "runs", "problem", "simulate", "output"])
def test_no_package_asks_what_kind_a_model_is(package: str) -> None:
    asked = {
        (name, node.lineno)
        for name, tree in trees(package)
        for node in tree
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance"
        if MODELS_AND_TERMS
        & {each.id for each in ast.walk(node.args[1]) if isinstance(each, ast.Name)}
    }
    assert asked == set()


def test_parts_do_not_know_each_other() -> None:
    """A part imports what all parts share, and that imports no part but through the registry.

    What parts share names types of parts: the sum of all loads, a model as parts observe it.
    """
    parts = {file.stem for file in (PACKAGE / "parts").iterdir() if file.is_dir()} - {"__pycache__"}
    parts |= {path.split(".")[0] for role in ("abilities", "steps") for path in REGISTERED[role]}
    arrows = set[tuple[str, str]]()
    for name, tree in trees("parts"):
        own = Path(name).parts[1].removesuffix(".py")
        if own not in REGISTRY:
            others = imported_parts(tree, with_types=own in parts)
            arrows |= {(name, other) for other in others if other in parts - {own}}
    assert arrows == set()


@pytest.mark.parametrize("package", ["simulate", "runs", "output", "parts"])
def test_no_scene_has_a_case(package: str) -> None:
    """What is computed is all in its problem."""
    asked = [
        (name, node.lineno)
        for name, tree in trees(package)
        for node in tree
        if isinstance(node, ast.Attribute) and node.attr == "case"
    ]
    assert asked == []
