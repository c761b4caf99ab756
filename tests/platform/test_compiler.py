"""Libraries that several processes want at the same time, and disks that are full."""

import ctypes
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from magshell_fenicsx.platform import compiler, kept

SOURCE = "int seven(void) { return 7; }\n"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(kept, "_usual", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def test_one_compiles_and_the_others_wait(cache: Path) -> None:
    """Of all that ask at once one compiles; the others load what it makes. Nothing else is left in the folder."""
    asked = list[str]()

    def source() -> str:
        asked.append("asked")
        return SOURCE

    def seven(_: int) -> int:
        return int(ctypes.CDLL(str(compiler.Library("seven", source, ("-O0",)).path())).seven())

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(seven, range(4))) == [7] * 4
    assert len(asked) == 1
    assert [file.suffix for file in cache.iterdir()] == [".so"]


@pytest.fixture
def two_cores(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(compiler, "cores", lambda: 2)
    compiler._pool.cache_clear()
    yield
    compiler._pool.cache_clear()


def libraries(*names: str, source: str = SOURCE) -> list[compiler.Library]:
    return [compiler.Library(name, lambda: source, ("-O0",)) for name in names]


MEETING = """#!/bin/sh
touch {folder}/$$
for wait in $(seq 100); do
  [ $(ls {folder} | wc -l) -ge 2 ] && break
  sleep 0.05
done
ls {folder} | wc -l >> {seen}
sleep 0.2
rm {folder}/$$
"""  # waits until it sees another one


@pytest.mark.usefixtures("cache", "two_cores")
def test_side_by_side(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many compilers as there are cores run at once, and no more."""
    beside, seen, program = tmp_path / "beside", tmp_path / "seen", tmp_path / "compiler"
    beside.mkdir()
    program.write_text(MEETING.format(folder=beside, seen=seen) + 'exec cc "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    monkeypatch.setenv("CC", str(program))
    told = list[int]()
    compiler.side_by_side(libraries("a", "b"), told.append)
    assert seen.read_text(encoding="utf-8").split() == ["2", "2"]
    assert told == sorted(told)
    assert told[0] == 0


@pytest.mark.usefixtures("cache", "two_cores")
def test_in_opposite_orders() -> None:
    """Nobody waits for another one that waits for it: a lock is held while a compiler runs, and no longer."""
    orders = ["abcdef", "fedcba", "cfaebd"]
    with ThreadPoolExecutor(len(orders)) as pool:
        for done in [pool.submit(compiler.side_by_side, libraries(*order)) for order in orders]:
            done.result(timeout=60)
    assert all(library.there for library in libraries(*orders[0]))


@pytest.mark.usefixtures("two_cores")
def test_what_has_not_begun_is_given_up(cache: Path) -> None:
    """The first failure is raised, and no lock is left, so that another process may try."""
    broken = libraries("broken", source="int seven(void) { return")
    others = libraries(*map(str, range(12)))
    with pytest.raises(subprocess.CalledProcessError):
        compiler.side_by_side([*broken, *others])
    for work in [library.work for library in others]:
        if work:
            work.result()
    assert not list(cache.glob("*.lock"))
    assert not all(library.there for library in others)
    compiler.side_by_side(others)


@pytest.mark.telling
def test_options_and_names_make_another_library(cache: Path) -> None:
    made = {
        compiler.Library(*of).path()
        for of in (("a", lambda: SOURCE, ()), ("b", lambda: SOURCE, ()), ("a", lambda: SOURCE, ("-O1",)))
    }
    assert len(made) == 3


def test_code_that_is_none(cache: Path) -> None:
    """The compiler's words are on stderr, and no library is left."""
    with pytest.raises(subprocess.CalledProcessError):
        compiler.Library("broken", lambda: "int seven(void) { return", ()).path()
    assert not list(cache.glob("*.so"))


def test_a_full_disk(tmp_path: Path) -> None:
    """The message names the folder and the reason."""
    reason = r"^kernels cannot be compiled into .*full: No space left on device$"
    with pytest.raises(RuntimeError, match=reason), compiler.written_into(tmp_path / "full"):
        Path("/dev/full").write_text("x", encoding="utf-8")
