"""Libraries that several processes want at the same time, and disks that are full."""

import ctypes
import subprocess
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
