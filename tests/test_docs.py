"""What the pages say is there: links, files, places in the code, cases, commands, options."""

import ast
import re
import shlex
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest
from conftest import CASES
from typer.main import get_command

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.case.reference import anchor
from magshell_fenicsx.cli import app
from magshell_fenicsx.public import run

TOP = CASES.parent
PAGES = [
    TOP / "README.md",
    TOP / "CONTRIBUTING.md",
    *sorted((TOP / "docs").rglob("*.md")),
    TOP / "meshes/README.md",
]
GUIDES = [
    TOP / name
    for name in (
        "README.md",
        "docs/install.md",
        "docs/tutorial.md",
        "docs/howto.md",
        "docs/troubleshooting.md",
    )
]


def text(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text(page), re.DOTALL | re.MULTILINE)


def commands(page: Path) -> Iterator[list[str]]:
    """Words of every indented command line with magshell or make."""
    lines = re.sub(r"\\\n\s*", " ", text(page)).splitlines()
    for line in lines:
        if re.match(r"    (\S*in-env .*magshell |magshell |make )", line):
            yield shlex.split(line, comments=True)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(TOP)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!http)([^)]+)\)", text(page)):
        file, _, part = target.partition("#")
        there = (page.parent / file).resolve() if file else page
        assert there.exists(), target
        if part:
            assert part in [
                anchor(title) for title in re.findall(r"^#+ (.*)$", text(there), re.MULTILINE)
            ], target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(TOP)))
def test_files_that_are_named_exist(page: Path) -> None:
    for name in re.findall(
        r"\b(?:cases|meshes|docs|tests|magshell_fenicsx)/[\w./-]*\w\.\w+\b", text(page)
    ):
        assert (TOP / name).exists(), name


def test_places_in_the_code() -> None:
    """`file.py: name` of docs/theory.md."""
    places = re.findall(r"`([\w/]+\.py): (\w+)`", text(TOP / "docs/theory.md"))
    assert len(places) > 60
    for file, name in places:
        code = text(TOP / "magshell_fenicsx" / file)
        assert re.search(rf"^\s*(def|class) {name}\b|^{name} = ", code, re.MULTILINE), (
            f"{file}: {name}"
        )


def test_places_that_docstrings_name() -> None:
    """Of three names or more with dots, such as `mesh.mirror.rotation`, the first a folder's."""
    package, gone = TOP / "magshell_fenicsx", list[str]()
    for file in package.rglob("*.py"):
        for name in re.findall(r"`(\w+(?:\.\w+){2,})`", text(file)):
            room, *rest = name.split(".")
            place = package / room
            if not place.is_dir():
                continue
            while rest and not place.is_file():
                place = place / rest[0] if (place / rest[0]).is_dir() else place / f"{rest[0]}.py"
                rest.pop(0)
            if not place.exists() or any(
                not re.search(rf"\b{each}\b", text(place)) for each in rest
            ):
                gone.append(f"{file.name}: {name}")
    assert not gone


CASE_BLOCKS = [(page, block) for page in PAGES for block in blocks(page, "yaml")]


@pytest.mark.parametrize(
    ("page", "block"),
    CASE_BLOCKS,
    ids=[f"{page.stem}{i}" for i, (page, _) in enumerate(CASE_BLOCKS)],
)
def test_yaml_is_a_case_that_can_be_built(page: Path, block: str, tmp_path: Path) -> None:
    """So is what stands behind a key as another value of it, `# key: {...}`, alone on its line."""
    (tmp_path / "case.yaml").write_text(block, encoding="utf-8")
    others = re.findall(r"^# (\w+): (\{.*?\}|\w+)(?:\s+#.*)?$", block, re.MULTILINE)
    for setting in ["", *(f"{key}={value}" for key, value in others)]:
        assert "built:" in describe(Case.load(tmp_path / "case.yaml", [setting] if setting else []))


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: str(page.relative_to(TOP)))
def test_commands_are_understood(page: Path, tmp_path: Path) -> None:
    """Options are known to the command line, none is missing, cases are there and take their
    settings.
    """
    for number, block in enumerate(blocks(page, "yaml")):
        (tmp_path / ("cap.yaml" if page.stem == "tutorial" else f"{number}.yaml")).write_text(
            block, encoding="utf-8"
        )
    known = get_command(app).commands  # type: ignore[attr-defined]
    for words in commands(page):
        if words[0] == "make":
            assert re.search(rf"^[\w ]*\b{words[1]}\b.*:", text(TOP / "Makefile"), re.MULTILINE), (
                words
            )
            continue
        name, *rest = words[words.index("magshell") + 1 :]
        if name.startswith("--"):  # of magshell itself
            continue
        options = {option for parameter in known[name].params for option in parameter.opts}
        given = {word.partition("=")[0] for word in rest if word.startswith("--")}
        assert given <= options, words
        needed = [p.opts for p in known[name].params if p.required and p.opts[0].startswith("--")]
        assert all(given & set(opts) for opts in needed), words
        settings = [after for word, after in pairwise(rest) if word == "--set"]
        for case in (word for word in rest if word.endswith(".yaml")):
            places = (place / case for place in (TOP, CASES, tmp_path) if (place / case).is_file())
            assert Case.load(next(places), settings)


def test_numbers_of_the_tutorial(tmp_path: Path) -> None:
    """Its case, and its case in the field."""
    page = text(TOP / "docs/tutorial.md")
    (tmp_path / "cap.yaml").write_text(*blocks(TOP / "docs/tutorial.md", "yaml"), encoding="utf-8")
    (field,) = re.findall(r'--set "(magnetic=.*)" --out', page)
    for settings, number in zip(([], [field]), re.findall(r"k_d = (0\.\d+)", page), strict=True):
        assert run(Case.load(tmp_path / "cap.yaml", settings)).knockdown == pytest.approx(
            float(number), abs=1e-6
        )


def test_the_editor_line_leads_to_the_schema() -> None:
    """In the cases that a reader copies, and where it is explained."""
    for file in (TOP / "docs/howto.md", *CASES.glob("*.yaml")):
        (line,) = re.findall(r"^# yaml-language-server: \$schema=(.*)$", text(file), re.MULTILINE)
        assert (CASES / line).resolve() == TOP / "docs/case.schema.json"


def said(node: ast.AST) -> str:
    """A text in the code, with … for what is filled in."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(said(part) for part in node.values)
    return said(node.left) + said(node.right) if isinstance(node, ast.BinOp) else "…"


@cache
def nodes() -> list[ast.AST]:
    """Texts of the code, and what it raises."""
    kinds = ast.Constant | ast.JoinedStr | ast.BinOp | ast.Raise
    found = list[ast.AST]()
    for file in (TOP / "magshell_fenicsx").rglob("*.py"):
        if file.name not in ("cases/speed/scale.py", "native.py"):  # of whoever works on the code
            found += [node for node in ast.walk(ast.parse(text(file))) if isinstance(node, kinds)]
    return found


def words(message: str) -> str:
    """Without what is filled in."""
    return " ".join(re.sub(r"…|\n", " ", message).split())


ON_THE_PAGE = {
    words(message) for message in re.findall(r"`([^`]+)`", text(TOP / "docs/troubleshooting.md"))
}


def test_messages_of_the_page_are_in_the_code() -> None:
    """Every code span of the first column of its tables."""
    spoken = {
        words(said(node))
        for node in nodes()
        if isinstance(node, ast.Constant | ast.JoinedStr | ast.BinOp)
    }
    spoken |= {line.strip() for line in text(TOP / ".ci/in-env").splitlines()}
    everything = "\n".join(spoken)
    rows = re.findall(r"^\| (`.*?) \| ", text(TOP / "docs/troubleshooting.md"), re.MULTILINE)
    messages = [message for row in rows for message in re.findall(r"`([^`]+)`", row)]
    assert len(messages) > 100
    assert [
        m
        for m in messages
        if not all(part in everything for part in map(words, m.split("…")) if part)
    ] == []


def message_of(call: ast.Call) -> ast.AST:
    """What an error says: its first argument; of a damaged file, the reason."""
    return call.args[1 if ast.unparse(call.func) == "damage" else 0]


def test_messages_of_the_code_are_on_the_page() -> None:
    """What is raised for a user or said as a warning, unless it only passes on another message."""
    raised = {
        words(said(message_of(node.exc)))
        for node in nodes()
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args
        if ast.unparse(node.exc.func) != "AttributeError"  # a mistake in a program
    }
    warned = {
        words(said(node))
        for node in nodes()
        if isinstance(node, ast.JoinedStr) and "warning: " in said(node)
    }
    there = "\n".join(ON_THE_PAGE)
    assert [
        message for message in raised | warned if len(message) > 12 and message not in there
    ] == []
