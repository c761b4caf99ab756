"""Mutants: does a test fail if a line of the package is wrong?

First record what each test executes, in whole or in several runs:

    python3 -m pytest -p executed_lines --executed-lines FILE tests

Then `python3 tests/mutants.py FILE --out TABLE.md` draws mutants at random: a sign, a factor 1.01,
a dropped term, an index, a comparison or two swapped arguments, in lines that a test executes. Each
is written into a copy of the repository, with kernels of its own. There the tests that execute its
line run, the shortest first, until one fails: first those that are not marked slow, then the slow
ones.
"""

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any, ClassVar

TOP = Path(__file__).parents[1]
PACKAGE = "magshell_fenicsx"
GROUPS = {
    "mechanics": (
        "models",
        "shells",
        "parts/laws",
        "parts/laminate.py",
        "parts/natural",
        "parts/joints.py",
    ),
    "assembly": ("assembly",),
    "continuation": ("continuation",),
    "loads": (
        "parts/forces",
        "parts/pressure",
        "parts/motion",
        "parts/gravity.py",
        "parts/spin.py",
        "parts/foundation.py",
        "parts/supports",
    ),
    "magnetism": ("parts/magnetism",),
    "contact": ("parts/contact", "parts/bodies", "parts/gap.py"),
    "simulate": ("simulate",),
    "output": ("output", "quantities"),
}  # the package's files, by what is asked of them
BATCH = 12  # tests that one process runs: it starts in two seconds
# of CPU that the tests of one mutant may have taken without it
FAST_SECONDS, SLOW_SECONDS = 240.0, 600.0


@dataclass(frozen=True)
class Mutant:
    """A change of one expression.

    Attributes
    ----------
    module
        File below the package.
    line
        Of the changed expression, from 1.
    kind
        What is changed.
    begin, end
        The expression in the file, in bytes.
    before, after
        Its text.
    """

    module: str
    line: int
    kind: str
    begin: int
    end: int
    before: str
    after: str


@dataclass
class Executed:
    """A test that executes a line.

    Attributes
    ----------
    seconds
        Of CPU without a mutant.
    """

    test: str
    slow: bool
    seconds: float
    lines: dict[str, list[int]] = field(repr=False)


class Sites(ast.NodeVisitor):
    """All mutants of a module, in functions alone, apart from annotations and messages."""

    OPPOSITE: ClassVar = {
        ast.Lt: ">=",
        ast.Gt: "<=",
        ast.LtE: ">",
        ast.GtE: "<",
        ast.Eq: "!=",
        ast.NotEq: "==",
    }

    def __init__(self, module: str, source: bytes):
        self.module, self.source = module, source
        self.mutants = list[Mutant]()
        self._starts = [0, *accumulate(map(len, source.splitlines(keepends=True)))]
        self._depth = 0
        self.visit(ast.parse(source))

    def _place(self, node: ast.expr) -> tuple[int, int]:
        """Return where an expression begins and ends in the source."""
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        begin = self._starts[node.lineno - 1] + node.col_offset
        return begin, self._starts[node.end_lineno - 1] + node.end_col_offset

    def _text(self, node: ast.expr) -> str:
        begin, end = self._place(node)
        return self.source[begin:end].decode()

    def _add(self, kind: str, node: ast.expr, after: str) -> None:
        if self._depth:
            self.mutants.append(
                Mutant(self.module, node.lineno, kind, *self._place(node), self._text(node), after)
            )

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self._depth += 1
        for statement in node.body:
            self.visit(statement)
        self._depth -= 1

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value:
            self.visit(node.value)

    def visit_Raise(self, node: ast.Raise) -> None:
        """A message is no number."""

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """A message is no number."""

    def visit_Assert(self, node: ast.Assert) -> None:
        """An assertion is a test."""

    def visit_BinOp(self, node: ast.BinOp) -> None:
        left, right = self._text(node.left), self._text(node.right)
        texts = any(
            isinstance(n, ast.JoinedStr)
            or (isinstance(n, ast.Constant) and isinstance(n.value, str))
            for n in ast.walk(node)
        )
        if not texts:
            if isinstance(node.op, ast.Add | ast.Sub):
                self._add(
                    "sign",
                    node,
                    f"({left} {'-' if isinstance(node.op, ast.Add) else '+'} ({right}))",
                )
                self._add("dropped term", node, f"({left})")
            if isinstance(node.op, ast.Mult | ast.Div):
                self._add("factor 1.01", node, f"(1.01 * ({self._text(node)}))")
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub):
            self._add("sign", node, f"(+{self._text(node.operand)})")
        self.generic_visit(node)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        if (
            isinstance(node.slice, ast.Constant)
            and isinstance(node.slice.value, int)
            and isinstance(node.ctx, ast.Load)
        ):
            self._add("index", node, f"{self._text(node.value)}[{node.slice.value + 1}]")
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        if len(node.ops) == 1 and (opposite := self.OPPOSITE.get(type(node.ops[0]))):
            left, right = self._text(node.left), self._text(node.comparators[0])
            self._add("comparison", node, f"(({left}) {opposite} ({right}))")
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        plain = len(node.args) >= 2 and not any(
            isinstance(each, ast.Starred) for each in node.args[:2]
        )
        if plain and not (
            isinstance(node.func, ast.Name)
            and node.func.id in ("isinstance", "getattr", "hasattr", "min", "max")
        ):
            texts = [self._text(each) for each in node.args]
            swapped = [
                texts[1],
                texts[0],
                *texts[2:],
                *(self._text_of_keyword(each) for each in node.keywords),
            ]
            if texts[0] != texts[1]:
                self._add(
                    "swapped arguments", node, f"{self._text(node.func)}({', '.join(swapped)})"
                )
        self.generic_visit(node)

    def _text_of_keyword(self, keyword: ast.keyword) -> str:
        value = self._text(keyword.value)
        return f"{keyword.arg}={value}" if keyword.arg else f"**{value}"


def executed_tests(file: Path) -> list[Executed]:
    """Return the tests of a record that passed, the shortest first."""
    records: list[dict[str, Any]] = [
        json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()
    ]
    tests = [
        Executed(r["test"], r["slow"], r["seconds"], r["lines"]) for r in records if r["passed"]
    ]
    return sorted(tests, key=lambda test: test.seconds)


def drawn_mutants(count: int, seed: int, tests: Sequence[Executed]) -> Iterator[tuple[str, Mutant]]:
    """Draw mutants of executed lines, as many of each group: first the kind, then the place."""
    executed = defaultdict[str, set[int]](set)
    for test in tests:
        for module, lines in test.lines.items():
            executed[module].update(lines)
    draw = random.Random(seed)
    mutants_of_group = dict[str, dict[str, list[Mutant]]]()
    for group, places in GROUPS.items():
        assert all((TOP / PACKAGE / place).exists() for place in places)
        of_kind = defaultdict[str, list[Mutant]](list)
        for module in sorted(executed):
            if module.endswith(".py") and any(
                module == place or module.startswith(f"{place}/") for place in places
            ):
                source = (TOP / PACKAGE / module).read_bytes()
                for mutant in Sites(module, source).mutants:
                    if mutant.line in executed[module]:
                        of_kind[mutant.kind].append(mutant)
        mutants_of_group[group] = of_kind
    for number in range(count):
        group = list(GROUPS)[number % len(GROUPS)]
        of_kind = mutants_of_group[group]
        kind = draw.choice(sorted(of_kind))
        mutant = draw.choice(of_kind[kind])
        of_kind[kind].remove(mutant)
        yield group, mutant


def killer(copy: Path, cache: Path, tests: Sequence[Executed], seconds: float) -> tuple[str, bool]:
    """Return the first test that fails in a copy, or "", and whether all of the tests have been
    run.
    """
    spent = 0.0
    for first in range(0, len(tests), BATCH):
        batch = tests[first : first + BATCH]
        if spent > seconds:
            return "", False
        spent += sum(test.seconds for test in batch)
        limit = 120 + 10 * sum(test.seconds for test in batch)
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-x",
            "-p",
            "no:cacheprovider",
            "--timeout",
            f"{limit:.0f}",
        ]
        folders = os.pathsep.join([str(copy), *os.environ.get("PYTHONPATH", "").split(os.pathsep)])
        environment = {**os.environ, "PYTHONPATH": folders, "XDG_CACHE_HOME": str(cache)}
        names = [test.test for test in batch]
        try:
            done = subprocess.run(
                [*command, *names],
                cwd=copy,
                env=environment,
                capture_output=True,
                text=True,
                timeout=2 * limit,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return f"{names[0]} (no end)", True
        failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        # a test of the record is not there any more
        assert done.returncode != 4, f"{done.stdout}\n{done.stderr}"
        # tests that fail, a crash; 5: none is collected
        if failed:
            return failed[0].split(" - ")[0].split(" ", 1)[1], True
        if done.returncode not in (0, 1, 5):
            return f"{names[0]} (crash)", True
    return "", True


def reaching_tests(mutant: Mutant, tests: Sequence[Executed]) -> list[Executed]:
    """Return the tests that execute the line of a mutant, then the others of its module, each the
    shortest first.

    The second may depend on the line too: what a process has made once, as a compiled form, it
    makes for no later test.
    """
    of_module = [test for test in tests if mutant.module in test.lines]
    return sorted(
        of_module, key=lambda test: (mutant.line not in test.lines[mutant.module], test.seconds)
    )


def tried(mutant: Mutant, tests: Sequence[Executed], kernels: Path) -> tuple[str, str]:
    """Return which test kills a mutant, or "none", and of which suite it is."""
    with tempfile.TemporaryDirectory(prefix="mutant", dir=kernels.parent) as scratch:
        copy, cache = Path(scratch) / "copy", Path(scratch) / "cache"
        names = subprocess.run(
            ["git", "ls-files", "-z"], cwd=TOP, capture_output=True, text=True, check=True
        ).stdout
        for name in filter(None, names.split("\0")):
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(TOP / name, copy / name, follow_symlinks=False)
        shutil.copytree(
            kernels,
            cache,
            copy_function=os.link,
            ignore=shutil.ignore_patterns("*.lock", "*.so????????"),
        )
        file = copy / PACKAGE / mutant.module
        text = file.read_bytes()
        mutated = text[: mutant.begin] + mutant.after.encode() + text[mutant.end :]
        reaching = reaching_tests(mutant, tests)
        all_are_run = True
        for suite, seconds in (("make test", FAST_SECONDS), ("make test-all", SLOW_SECONDS)):
            of_suite = [test for test in reaching if test.slow == (suite == "make test-all")]
            file.write_bytes(mutated)
            found, complete = killer(copy, cache, of_suite, seconds)
            while found:
                killing_tests = [test for test in of_suite if test.test == found]
                file.write_bytes(text)
                false_alarm, _ = killer(copy, cache, killing_tests, seconds)
                if not false_alarm:
                    return found, suite
                file.write_bytes(mutated)  # the test fails without the mutant too: the next ones
                of_suite = of_suite[of_suite.index(killing_tests[0]) + 1 :]
                found, complete = killer(copy, cache, of_suite, seconds)
            all_are_run &= complete
    if all_are_run:
        return "none", f"all {len(reaching)} tests"
    return "none", f"of {len(reaching)} tests those within the time"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("record", type=Path, help="what each test executes")
    parser.add_argument(
        "--out", type=Path, required=True, help="table in Markdown, a row as soon as it is known"
    )
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=50)
    parser.add_argument("--part", default="1/1", help="i/n: the i-th of n parts")
    arguments = parser.parse_args()
    part, parts = map(int, arguments.part.split("/"))
    tests = executed_tests(arguments.record)
    kernels = Path(os.environ["XDG_CACHE_HOME"])
    with arguments.out.open("w", encoding="utf-8") as stream:
        stream.write(
            "| of | line | mutant | before | after | killed by | suite |\n" + "| --- " * 7 + "|\n"
        )
        for number, (group, mutant) in enumerate(
            drawn_mutants(arguments.count, arguments.seed, tests)
        ):
            if number % parts == part - 1:
                found, suite = tried(mutant, tests, kernels)
                texts = (
                    " ".join(text.split()).replace("|", "\\|")
                    for text in (mutant.before, mutant.after)
                )
                before, after = (f"`{text}`" for text in texts)
                row = (
                    group,
                    f"{mutant.module}:{mutant.line}",
                    mutant.kind,
                    before,
                    after,
                    found,
                    suite,
                )
                stream.write(f"| {' | '.join(row)} |\n")
                stream.flush()


if __name__ == "__main__":
    main()
