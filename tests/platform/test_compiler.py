"""Libraries that several processes want at the same time, disks that are full, compilers of every
kind and none.
"""

import ctypes
import shlex
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from command import started
from conftest import CASES
from mpi4py import MPI

import magshell_fenicsx as ms
from magshell_fenicsx.platform import compiler, disk_cache
from magshell_fenicsx.platform.compiler import NoCompiler
from magshell_fenicsx.platform.native import load_native

LIKE_CLANG = """#!/bin/sh
for word; do
    case $word in
        -fsched*) echo "error: unknown option $word" >&2; exit 1 ;;
        -dM) echo "#define __GNUC__ 4"; echo "#define __clang__ 1"; exit ;;
    esac
done
exec {} "$@"
"""  # refuses what is GCC's alone, as Zig's does
SOURCE = "int seven(void) { return 7; }\n"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(disk_cache, "_usual_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def test_one_compiles_and_the_others_wait(cache: Path) -> None:
    """Of all that ask at once one compiles; the others load what it makes.

    Nothing else is left in the folder.
    """
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
    then_compiles = f'exec {shlex.join(compiler.c_compiler())} "$@"\n'
    program.write_text(
        MEETING.format(folder=shlex.quote(str(beside)), seen=shlex.quote(str(seen)))
        + then_compiles,
        encoding="utf-8",
    )
    program.chmod(0o755)
    monkeypatch.setenv("CC", shlex.quote(str(program)))
    told = list[int]()
    compiler.compile_libraries(libraries("a", "b", "c", "d"), told.append)
    assert max(map(int, seen.read_text(encoding="utf-8").split())) == 2
    assert told == sorted(told)
    assert told[0] == 0


@pytest.mark.usefixtures("cache", "two_cores")
def test_in_opposite_orders() -> None:
    """Nobody waits for another one that waits for it: a lock is held while a compiler runs, and no
    longer.
    """
    orders = ["abcdef", "fedcba", "cfaebd"]
    with ThreadPoolExecutor(len(orders)) as pool:
        for done in [
            pool.submit(compiler.compile_libraries, libraries(*order)) for order in orders
        ]:
            done.result(timeout=60)
    assert all(library.is_compiled for library in libraries(*orders[0]))


@pytest.mark.usefixtures("two_cores")
def test_what_has_not_begun_is_given_up(cache: Path) -> None:
    """The first failure is raised, and no lock is left, so that another process may try."""
    broken = libraries("broken", source="int seven(void) { return")
    others = libraries(*map(str, range(12)))
    with pytest.raises(subprocess.CalledProcessError):
        compiler.compile_libraries([*broken, *others])
    for work in [library.running_compilation for library in others]:
        if work:
            work.result()
    assert not list(cache.glob("*.lock"))
    assert not all(library.is_compiled for library in others)
    compiler.compile_libraries(others)


@pytest.mark.telling
def test_options_and_names_make_another_library(cache: Path) -> None:
    made = {
        compiler.Library(*of).path()
        for of in (
            ("a", lambda: SOURCE, ()),
            ("b", lambda: SOURCE, ()),
            ("a", lambda: SOURCE, ("-O1",)),
        )
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


def program(folder: Path, name: str, text: str = "#!/bin/sh\n") -> Path:
    """A program in a folder."""
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(text, encoding="utf-8")
    (folder / name).chmod(0o755)
    return folder / name


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with all programs that there are: none yet; and no Zig."""
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(compiler, "find_spec", lambda name: None)
    return tmp_path / "bin"


def test_the_compiler_is_any_that_there_is(bare: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That of CC, else that of Python, else any of the usual ones, else Zig's; none is refused in
    words.
    """
    with pytest.raises(NoCompiler, match=r"there is no C compiler.*install gcc or clang.*ziglang"):
        compiler.c_compiler()
    monkeypatch.setattr(compiler, "find_spec", lambda name: name)
    assert compiler.c_compiler()[:4] == (sys.executable, "-m", "ziglang", "cc")
    program(bare, "clang")
    assert compiler.c_compiler()[0] == "clang"
    own = sysconfig.get_config_var("CC").split()[0]
    program(bare, own)
    assert compiler.c_compiler()[0] == own
    monkeypatch.setenv("CC", "other -x")
    with pytest.raises(NoCompiler, match="CC=other -x: there is no such compiler"):
        compiler.c_compiler()
    program(bare, "other")
    assert compiler.c_compiler()[:2] == ("other", "-x")


def test_a_compiler_that_is_not_gcc(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The package's C code and its libraries are compiled without the options of GCC."""
    gcc = shutil.which("gcc")
    if not gcc or not compiler.is_gnu((gcc,)):
        pytest.skip("no GCC here")
    monkeypatch.setenv(
        "CC", shlex.quote(str(program(tmp_path / "a place", "cc", LIKE_CLANG.format(gcc))))
    )
    (tmp_path / "seven.c").write_text(SOURCE, encoding="utf-8")
    assert load_native(tmp_path / "seven.c", "int seven(void);", MPI.COMM_SELF)[1].seven() == 7
    assert ctypes.CDLL(str(compiler.Library("seven", lambda: SOURCE, ("-O0",)).path())).seven() == 7


def test_a_compiler_that_compiles_nothing(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its first error is said, before anything is solved.

    Where kernels have been compiled, none is needed.
    """
    lacking = "#!/bin/sh\necho 'in file\nmath.h: fatal error: no such file' >&2\nexit 1\n"
    monkeypatch.setenv("CC", shlex.quote(str(program(tmp_path, "cc", lacking))))
    (tmp_path / "seven.c").write_text(SOURCE, encoding="utf-8")
    said = r"cc.* cannot compile: math\.h: fatal error: no such file; install"
    with pytest.raises(NoCompiler, match=said):
        compiler.check_compiler()
    with pytest.raises(NoCompiler, match=said):
        load_native(tmp_path / "seven.c", "int seven(void);", MPI.COMM_SELF)
    disk_cache.save_cached(compiler.COMPILER_CHECKED, b"yes")
    compiler.check_compiler()


def test_a_run_without_a_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One message, exit code 2, and nothing is solved."""
    monkeypatch.setenv("CC", "none-of-all")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    done = started("run", CASES / "dimple_buckling.yaml", "--out", tmp_path / "out")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("CC=none-of-all: there is no such compiler; install gcc or clang")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out/path.csv").exists()


@pytest.mark.parametrize("given", ["'gcc", "{refusing}"])
def test_compilers_that_are_refused(
    given: str, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A quotation without its end, and a compiler that lacks an option of the kernels."""
    text = (
        '#!/bin/sh\ncase "$*" in *-std=*) echo "error: unknown option" >&2; exit 1 ;; esac\n'
        'exec cc "$@"\n'
    )
    monkeypatch.setenv(
        "CC", given.format(refusing=shlex.quote(str(program(tmp_path, "refusing", text))))
    )
    with pytest.raises(
        NoCompiler,
        match=r"there is no such compiler|refusing'? cannot compile: error: unknown option",
    ):
        compiler.check_compiler()


def test_pictures_have_their_code_before_anything_is_solved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a compiler has been there before, and not for this."""

    def without_compiler() -> None:
        raise NoCompiler("there is none")

    monkeypatch.setattr("magshell_fenicsx.output.pictures.rendering.library", without_compiler)
    with pytest.raises(NoCompiler, match="there is none"):
        ms.run(CASES / "clamped_plate.yaml", tmp_path / "out")
    assert not (tmp_path / "out/path.csv").exists()


@pytest.mark.usefixtures("cache")
def test_denormal_numbers_stay_what_they_are() -> None:
    """A library that is compiled with -ffast-math changes nothing beside it as it is loaded."""
    least = np.array([5e-324])
    ctypes.CDLL(str(compiler.Library("denormal", lambda: SOURCE, ("-O1", "-ffast-math")).path()))
    assert least * np.ones(1) > 0
