"""Libraries that several processes want at the same time, disks that are full, compilers of every kind and none."""

import ctypes
import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cffi
import pytest
from command import started
from conftest import CASES
from mpi4py import MPI

from magshell_fenicsx.platform import compiler, kept
from magshell_fenicsx.platform.compiler import NoCompiler
from magshell_fenicsx.platform.native import native

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
    monkeypatch.setattr(kept, "_usual", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def test_one_compiles_and_the_others_wait(cache: Path) -> None:
    """Of all that ask at once one compiles; the others load what it makes. Nothing else is left in the folder."""
    asked = list[str]()

    def source() -> str:
        asked.append("asked")
        return SOURCE

    def seven(_: int) -> int:
        return int(ctypes.CDLL(str(compiler.library("seven", source, ("-O0",)))).seven())

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(seven, range(4))) == [7] * 4
    assert len(asked) == 1
    assert [file.suffix for file in cache.iterdir()] == [".so"]


@pytest.mark.telling
def test_options_and_names_make_another_library(cache: Path) -> None:
    made = {
        compiler.library(*of)
        for of in (("a", lambda: SOURCE, ()), ("b", lambda: SOURCE, ()), ("a", lambda: SOURCE, ("-O1",)))
    }
    assert len(made) == 3


def test_code_that_is_none(cache: Path) -> None:
    """The compiler's words are on stderr, and no library is left."""
    with pytest.raises(subprocess.CalledProcessError):
        compiler.library("broken", lambda: "int seven(void) { return", ())
    assert not list(cache.glob("*.so"))


def test_a_full_disk(tmp_path: Path) -> None:
    """The message names the folder and the reason."""
    reason = r"^kernels cannot be compiled into .*full: No space left on device$"
    with pytest.raises(RuntimeError, match=reason), compiler.written_into(tmp_path / "full"):
        Path("/dev/full").write_text("x", encoding="utf-8")
    compiler.check_room(tmp_path)


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
    """That of CC, else that of Python, else any of the usual ones, else Zig's; none is refused in words."""
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


def test_a_compiler_that_is_not_gcc(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The package's C code and its libraries are compiled without the options of GCC."""
    gcc = shutil.which("gcc")
    if not gcc or not compiler.is_gnu((gcc,)):
        pytest.skip("no GCC here")
    monkeypatch.setenv("CC", str(program(tmp_path / "a place", "cc", LIKE_CLANG.format(gcc))).replace(" ", "\\ "))
    (tmp_path / "seven.c").write_text(SOURCE, encoding="utf-8")
    assert native(tmp_path / "seven.c", "int seven(void);", MPI.COMM_SELF)[1].seven() == 7
    assert ctypes.CDLL(str(compiler.library("seven", lambda: SOURCE, ("-O0",)))).seven() == 7
    assert "LDSHARED" not in os.environ


def test_a_compiler_that_compiles_nothing(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its first error is said, before anything is solved. Where kernels have been compiled, none is needed."""
    lacking = "#!/bin/sh\necho 'in file\nmath.h: fatal error: no such file' >&2\nexit 1\n"
    monkeypatch.setenv("CC", str(program(tmp_path, "cc", lacking)))
    (tmp_path / "seven.c").write_text(SOURCE, encoding="utf-8")
    said = r"cc.* cannot compile: math\.h: fatal error: no such file; install"
    with pytest.raises(NoCompiler, match=said):
        compiler.check_compiler()
    with pytest.raises(NoCompiler, match=said):
        native(tmp_path / "seven.c", "int seven(void);", MPI.COMM_SELF)
    kept.keep(compiler.CHECKED, b"yes")
    compiler.check_compiler()


FUNCTIONS = "double sum(const double *, int64_t, float); uint32_t flag(_Bool, uint8_t); extern int seven;"
CODE = """
double sum(const double *x, int64_t n, float more) { double s = more; while (n--) s += x[n]; return s; }
uint32_t flag(_Bool one, uint8_t other) { return one + other; }
int seven = 7;
"""


def test_the_headers_that_stand_in_for_those_of_python(tmp_path: Path) -> None:
    """An extension of cffi, of every kind that the package has, is compiled by them alone, and works."""
    builder = cffi.FFI()
    builder.cdef(FUNCTIONS)
    builder.set_source("stood_in", f"#include <stdint.h>\n{CODE}")
    builder.emit_c_code(str(tmp_path / "stood_in.c"))
    words = [compiler.c_compiler()[0], f"-I{compiler.STAND_IN}", "-Werror=implicit-function-declaration"]
    subprocess.run([*words, "-fPIC", "-shared", "stood_in.c", "-o", "stood_in.so"], cwd=tmp_path, check=True)
    spec = importlib.util.spec_from_file_location("stood_in", tmp_path / "stood_in.so")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    numbers = module.ffi.new("double[]", [1.0, 2.5])
    assert module.lib.sum(numbers, 2, 0.5) == module.lib.sum([1.0, 2.5], 2, 0.5) == 4.0
    assert (module.lib.flag(True, 200), module.lib.seven) == (201, 7)
    with pytest.raises(OverflowError):
        module.lib.flag(True, 300)


def test_a_run_without_a_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One message, exit code 2, and nothing is solved."""
    monkeypatch.setenv("CC", "none-of-all")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    done = started("run", CASES / "dimple_buckling.yaml", "--out", tmp_path / "out")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("CC=none-of-all: there is no such compiler; install gcc or clang")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out/path.csv").exists()
