"""Rooms of the package import what is below them: the table of CONTRIBUTING, read from the code."""

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import magshell_fenicsx
from magshell_fenicsx.parts.registered import ABILITIES, KINDS_OF_STEPS, REGISTERED

PACKAGE = Path(magshell_fenicsx.__file__).parent
NOT_IMPORTED = {  # room -> rooms that it does not know
    "studies": {"case"},
    "runs": {"case", "studies"},
    "output": {"case", "studies", "runs", "simulate"},
    "simulate": {"case", "studies", "runs", "output"},
    "problem": {"case", "studies", "runs", "output", "simulate"},
    "shells": {"case", "studies", "runs", "output", "simulate", "problem"},
    "parts": {"case", "studies", "runs", "output", "simulate", "problem", "shells"},
    "models": {"case", "studies", "runs", "output", "simulate", "problem", "shells", "parts"},
    "shape": {
        "case",
        "studies",
        "runs",
        "output",
        "simulate",
        "problem",
        "shells",
        "models",
        "assembly",
        "continuation",
    },
    "assembly": {
        "case",
        "studies",
        "runs",
        "output",
        "simulate",
        "problem",
        "shells",
        "parts",
        "models",
        "shape",
        "mesh",
    },
}
ALONE = {  # room -> all rooms that it knows
    "mesh": {"platform"},
    "continuation": {"platform"},
    "input": {"platform", "quantities"},
    "quantities": set[str](),
    "platform": set[str](),
}
REGISTRY = {"parts.kinds", "parts.registered"}  # by which rooms below find parts
OF_TYPES = {
    "parts/observables.py",
    "parts/supports/reacting.py",
    "parts/supports/reactions.py",
    "parts/magnetism/interacting.py",
}  # what is observed, of which they know no more than the type


@cache
def trees(room: str) -> list[tuple[str, list[ast.AST]]]:
    """Name and all nodes of each file of a room."""
    files = sorted((PACKAGE / room).rglob("*.py"))
    return [
        (
            str(file.relative_to(PACKAGE)),
            list(ast.walk(ast.parse(file.read_text(encoding="utf-8")))),
        )
        for file in files
    ]


def imported(nodes: list[ast.AST], *, running: bool = False, below: str = "") -> Iterator[str]:
    """The rooms that a file imports, also within functions and, but for `running`, for types alone.

    Parameters
    ----------
    below
        The room whose rooms are meant; those of the package without it.
    """
    package = f"{PACKAGE.name}.{below}".rstrip(".")
    typed = {
        inner
        for node in nodes
        if running and isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for each in node.body
        for inner in ast.walk(each)
    }
    for node in nodes:
        if node in typed:
            continue
        names = list[str]()
        if isinstance(node, ast.ImportFrom) and node.module == package:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        yield from (
            name.removeprefix(f"{package}.").split(".")[0]
            for name in names
            if name.startswith(f"{package}.")
        )


@pytest.mark.parametrize("room", [*NOT_IMPORTED, *ALONE])
def test_a_room_knows_what_is_below_it(room: str) -> None:
    files = trees(room)
    assert files
    others = {file.name for file in PACKAGE.iterdir() if file.is_dir()} - {room}
    upward = NOT_IMPORTED[room] if room in NOT_IMPORTED else others - ALONE[room]
    arrows = {(name, other) for name, tree in files for other in imported(tree) if other in upward}
    assert {
        (name, other)
        for name, other in arrows
        if (name, other) not in {(file, "shells") for file in OF_TYPES}
    } == set()


def test_no_circles() -> None:
    """Of rooms, by what is imported when a program runs; the registry alone is asked from below."""
    rooms = [*NOT_IMPORTED, *ALONE]
    below = {
        room: {other for _, tree in trees(room) for other in imported(tree, running=True)} - {room}
        for room in rooms
    }
    below["shape"] -= {"parts"}  # its registry, see below
    order = TopologicalSorter({room: others & set(rooms) for room, others in below.items()})
    assert len(list(order.static_order())) == len(rooms)  # else: CycleError


KNOWN_KINDS = {"OwnTerm", "Magnetisation", "Loads", "ShellModel", "MeridianModel", "SolidModel"}


@pytest.mark.parametrize("room", ["case", "studies", "runs", "problem", "simulate", "output"])
def test_no_room_asks_what_kind_a_model_is(room: str) -> None:
    asked = {
        (name, node.lineno)
        for name, tree in trees(room)
        for node in tree
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance"
        if KNOWN_KINDS & {each.id for each in ast.walk(node.args[1]) if isinstance(each, ast.Name)}
    }
    assert asked == set()


def test_parts_do_not_know_each_other() -> None:
    """A part's room imports infrastructure, and infrastructure imports no part but through the
    registry.
    """
    rooms = {file.stem for file in (PACKAGE / "parts").iterdir() if file.is_dir()} - {"__pycache__"}
    rooms |= {path.split(".")[0] for path in (*REGISTERED, *KINDS_OF_STEPS.values(), *ABILITIES)}
    arrows = set[tuple[str, str]]()
    for name, tree in trees("parts"):
        if name.removesuffix(".py").replace("/", ".") in REGISTRY:
            continue
        own = Path(name).parts[1].removesuffix(".py")
        arrows |= {
            (name, other)
            for other in imported(tree, running=True, below="parts")
            if other in rooms - {own}
        }
    assert arrows == set()


@pytest.mark.parametrize("room", ["models", "shape", "assembly", "continuation", "mesh"])
def test_parts_are_found_by_their_registry(room: str) -> None:
    """Nothing outside a part's room names it."""
    modules = {
        (name, node.module.removeprefix(f"{PACKAGE.name}."))
        for name, tree in trees(room)
        for node in tree
        if isinstance(node, ast.ImportFrom)
        and node.module
        and node.module.startswith(f"{PACKAGE.name}.parts")
    }
    assert {module for _, module in modules} <= REGISTRY, modules


@pytest.mark.parametrize("room", ["simulate", "runs", "output", "parts"])
def test_no_scene_has_a_case(room: str) -> None:
    """What is computed is all in its problem."""
    asked = [
        (name, node.lineno)
        for name, tree in trees(room)
        for node in tree
        if isinstance(node, ast.Attribute) and node.attr == "case"
    ]
    assert asked == []
