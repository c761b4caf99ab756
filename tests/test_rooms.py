"""Rooms of the package import what is below them: the table of CONTRIBUTING, read from the code."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import magshell_fenicsx

PACKAGE = Path(magshell_fenicsx.__file__).parent
NOT_IMPORTED = {  # room -> rooms that it does not know
    "studies": {"case"},
    "runs": {"case", "studies"},
    "output": {"case", "studies", "runs", "simulate"},
    "simulate": {"case", "studies", "runs", "output"},
    "problem": {"case", "studies", "runs", "output", "simulate"},
    "parts": {"case", "studies", "runs", "output", "simulate", "problem"},
    "models": {"case", "studies", "runs", "output", "simulate", "problem"},
    "shape": {"case", "studies", "runs", "output", "simulate", "problem", "models", "assembly", "continuation"},
    "assembly": {"case", "studies", "runs", "output", "simulate", "problem", "parts", "models", "shape", "mesh"},
}
ALONE = {  # room -> all rooms that it knows
    "mesh": {"platform"},
    "continuation": {"platform"},
    "input": {"platform", "quantities"},
    "quantities": set[str](),
    "platform": set[str](),
}
REGISTRY = {"parts.kinds", "parts.registered"}  # by which rooms below find parts


def trees(room: str) -> Iterator[tuple[str, ast.AST]]:
    """Name and content of each file of a room."""
    for file in sorted((PACKAGE / room).rglob("*.py")):
        yield str(file.relative_to(PACKAGE)), ast.parse(file.read_text(encoding="utf-8"))


def imported(tree: ast.AST) -> Iterator[str]:
    """The rooms that a file imports, also within functions and for types alone."""
    for node in ast.walk(tree):
        names = list[str]()
        if isinstance(node, ast.ImportFrom) and node.module == PACKAGE.name:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        yield from (name.split(".")[1] for name in names if name.startswith(f"{PACKAGE.name}."))


@pytest.mark.parametrize("room", [*NOT_IMPORTED, *ALONE])
def test_a_room_knows_what_is_below_it(room: str) -> None:
    files = list(trees(room))
    assert files
    others = {file.name for file in PACKAGE.iterdir() if file.is_dir()} - {room}
    upward = NOT_IMPORTED[room] if room in NOT_IMPORTED else others - ALONE[room]
    assert {(name, other) for name, tree in files for other in imported(tree) if other in upward} == set()


@pytest.mark.parametrize("room", ["shape", "assembly", "continuation", "mesh"])
def test_parts_are_found_by_their_registry(room: str) -> None:
    """Nothing outside a part's room names it."""
    modules = {
        (name, node.module.removeprefix(f"{PACKAGE.name}."))
        for name, tree in trees(room)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(f"{PACKAGE.name}.parts")
    }
    assert {module for _, module in modules} <= REGISTRY, modules


@pytest.mark.parametrize("room", ["simulate", "runs", "output", "parts"])
def test_no_scene_has_a_case(room: str) -> None:
    """What is computed is all in its problem."""
    asked = [
        (name, node.lineno)
        for name, tree in trees(room)
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and node.attr == "case"
    ]
    assert asked == []
