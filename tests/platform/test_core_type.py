"""The tests can be run with the rounding of another processor, and CI does so."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from conftest import CASES

TOP = CASES.parent
IN_ENV, CORE_TYPE = TOP / ".ci" / "in-env", TOP / ".ci" / "core-type"
PRODUCT = """
import numpy as np
A = np.random.default_rng(1).standard_normal((200, 200))
print((A @ A).tobytes().hex(), (A[0] @ A[1]).hex())
"""


def without(more: dict[str, str]) -> dict[str, str]:
    """The environment, without what a make around these tests says of itself and of this."""
    names = {"OPENBLAS_CORETYPE", "ROOT", "MAKEFLAGS", "MFLAGS", "MAKELEVEL", "MAKEOVERRIDES"}
    return {key: value for key, value in os.environ.items() if key not in names} | more


def said(*words: str | Path, core_type: str | None = None) -> subprocess.CompletedProcess[str]:
    told = without({"OPENBLAS_CORETYPE": core_type} if core_type else {})
    return subprocess.run(
        list(map(str, words)), capture_output=True, text=True, check=False, env=told, cwd=TOP
    )


def test_the_choice_reaches_the_environment() -> None:
    """And changes how products are rounded there."""
    used, other = (said(IN_ENV, CORE_TYPE, *option).stdout.strip() for option in ((), ("--other",)))
    assert used
    assert other
    assert other != used
    assert said(IN_ENV, CORE_TYPE, core_type=other).stdout.strip() == other
    assert said(IN_ENV, CORE_TYPE, other, core_type=other).returncode == 0
    first, second = (
        said(IN_ENV, "python3", "-c", PRODUCT, core_type=each).stdout for each in (None, other)
    )
    assert first
    assert second
    assert first != second


def test_a_choice_without_effect_is_an_error() -> None:
    done = said(IN_ENV, CORE_TYPE, "Nonesuch", core_type="Nonesuch")
    assert done.returncode == 1
    assert re.fullmatch(
        r"core-type: OPENBLAS_CORETYPE=Nonesuch has no effect: .* computes for \w+\n", done.stderr
    )


def test_make_looks_first() -> None:
    """Before its tests; without a choice there is nothing to look for."""
    lines = said("make", "-n", "test", "OPENBLAS_CORETYPE=Nehalem").stdout.splitlines()
    (check,) = (
        i
        for i, line in enumerate(lines)
        if line.split()[:3] == [".ci/in-env", ".ci/core-type", "Nehalem"]
    )
    assert "pytest" in lines[check + 1]
    assert "core-type" not in said("make", "-n", "test").stdout


MAKE = """#!/bin/sh
echo "$@" "${OPENBLAS_CORETYPE:-}" "ROOT=${ROOT:-}" >> "$CALLS"
[ -e "$CALLS.folders" ] || ls -A "$TMPDIR" "$HOME" "$XDG_CACHE_HOME" >> "$CALLS.folders"
case "$*" in *"${FAILS:-none}"*) exit 1 ;; esac
"""


GIT = """#!/bin/sh
case "$1" in
    clone) cp -r "$3" "$4" ;;
    rev-parse) echo 0123 ;;
    ls-files) echo tests/a/test_slow.py ;;
esac
"""
IN = """#!/bin/sh
[ "$1" = python3 ] && echo 0.11 || echo Nehalem
"""


CALLS_UP_TO_FAILURE = {
    "": 6,
    "test": 1,
    "MARK=slow": 2,
    "MARK=telling": 6,
    "run": 4,
    "ROOT=pypi TESTS": 6,
    "OPENBLAS_CORETYPE=": 6,
}  # by a part of the call of make that fails


@pytest.mark.parametrize("fails", CALLS_UP_TO_FAILURE)
def test_ci_runs_all(tmp_path: Path, fails: str) -> None:
    """In a clone, with folders that are empty at first.

    What fails fails the run, which ends or goes on.
    """
    top, home = tmp_path / "top", tmp_path / "home"
    (top / ".ci").mkdir(parents=True)
    home.mkdir()
    (home / "earlier").touch()
    shutil.copy(TOP / ".ci" / "run", top / ".ci" / "run")
    for name, text in (("make", MAKE), ("git", GIT), (".ci/in-env", IN)):
        (top / name).write_text(text, encoding="utf-8")
        (top / name).chmod(0o755)
    more = dict.fromkeys(("TMPDIR", "HOME", "XDG_CACHE_HOME"), str(home))
    more |= {
        "PATH": f"{top}:{os.environ['PATH']}",
        "FAILS": fails,
        "CALLS": str(tmp_path / "calls"),
    }
    done = subprocess.run(
        [top / ".ci" / "run"], env=without(more), capture_output=True, text=True, check=False
    )
    assert [each.name for each in home.iterdir()] == ["earlier"]
    listed = (tmp_path / "calls.folders").read_text(encoding="utf-8").splitlines()
    there = {each.split("/")[-1] for each in listed if each}
    assert there - {"sid", "sid.log"} == {
        "cache:",
        "home:",
        "tmp:",
    }  # nothing, but for building Debian unstable
    lines = (tmp_path / "calls").read_text(encoding="utf-8").splitlines()
    calls = [[word for word in line.split() if not word.startswith("LIMIT=")] for line in lines]
    assert (done.returncode != 0) == bool(fails)
    solving = [
        f"tests/{each}" for each in ("continuation", "models/axisymmetric", "simulate", "cases")
    ]
    wanted = [
        ["test", "ROOT="],
        ["test", "MARK=slow", "TESTS=tests/a/test_slow.py", "ROOT="],
        ["test", "ROOT=sid", "MARK=telling", "ROOT=sid"],
        ["run", "CASE=cases/dimple_buckling.yaml", "ROOT=pypi", "ROOT=pypi"],
        ["test", "ROOT=pypi", "TESTS=tests/continuation", "tests/simulate", "ROOT=pypi"],
        ["test", "OPENBLAS_CORETYPE=Nehalem", f"TESTS={solving[0]}", *solving[1:], "ROOT="],
    ]
    assert calls == wanted[: CALLS_UP_TO_FAILURE[fails]]
    assert ("all slow tests pass" in done.stdout) == (fails not in ("test", "MARK=slow"))
