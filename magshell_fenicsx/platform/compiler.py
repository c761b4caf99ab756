"""The C compiler, and shared libraries of C, compiled once and kept beside the kernels of the forms.

The compiler is any that Python can call: that of CC, that which built Python, gcc, clang, or Zig's, which PyPI has.
"""

import fcntl
import hashlib
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from magshell_fenicsx.platform.kept import keep, kept_file, kernel_cache, recall
from magshell_fenicsx.platform.packages import Unusable

FULL = re.compile("No space left on device|Disk quota exceeded|File too large|Read-only file system")
VECTORS = ("avx2", "fma")  # of x86: what vectors of four numbers need to be one register

USUAL = ("cc", "gcc", "clang")
# For any processor, as the kernels may be shared; and without traps for undefined behaviour, which it adds by default.
ZIG_OPTIONS = ("-mcpu=baseline", "-fno-sanitize=undefined")
HINT = "install gcc or clang, or `python3 -m pip install ziglang`, or name one in CC"
SMALLEST = "#include <math.h>\n#include <Python.h>\nvoid *none(void) { return Py_None; }\n"
STAND_IN = Path(__file__).with_name("headers")  # for those of Python, which many systems package apart
CHECKED = "magshell_compiler_checked"  # of a cache for which a compiler has compiled


class NoCompiler(Unusable):
    """There is no C compiler that can compile kernels."""


def c_compiler() -> tuple[str, ...]:
    """The command of the C compiler, with a place for the headers of Python where they are not installed.

    Raises
    ------
    NoCompiler
        If there is none.
    """
    headers = Path(sysconfig.get_path("include"))
    also = () if (headers / "Python.h").is_file() else (f"-I{STAND_IN}",)
    if given := os.environ.get("CC"):
        command = tuple(shlex.split(given))
        if not command or not shutil.which(command[0]):
            raise NoCompiler(f"CC={given}: there is no such compiler; {HINT}")
        return *command, *also
    for name in (sysconfig.get_config_var("CC"), *USUAL):
        command = tuple(shlex.split(name or ""))
        if command and shutil.which(command[0]):
            return *command, *also
    if find_spec("ziglang"):
        return sys.executable, "-m", "ziglang", "cc", *ZIG_OPTIONS, *also
    raise NoCompiler(f"there is no C compiler, which the kernels take: {HINT}")


def is_gnu(compiler: tuple[str, ...]) -> bool:
    """Whether a compiler is GCC itself; others say so too, but are Clang."""
    command = [*compiler, "-dM", "-E", "-x", "c", os.devnull]
    macros = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False).stdout
    return "__GNUC__" in macros and "__clang__" not in macros


@contextmanager
def for_extensions() -> Iterator[None]:
    """While extensions of Python are compiled, which setuptools does for cffi: it is told the compiler.

    Raises
    ------
    NoCompiler
        In place of any error, if there is none or it cannot compile the smallest extension.
    """
    before = {name: os.environ.get(name) for name in ("CC", "LDSHARED")}
    with suppress(NoCompiler):  # what is compiled already needs none
        command = shlex.join(c_compiler())
        if command not in (before["CC"], None if before["CC"] else sysconfig.get_config_var("CC")):
            os.environ["CC"] = command
            os.environ.setdefault("LDSHARED", f"{command} -shared")
    try:
        yield
    except Exception:
        refuse_unusable()
        raise
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def check_compiler() -> None:
    """Refuse a compiler that cannot compile kernels, before any is compiled; a cache that has some needs none.

    Raises
    ------
    NoCompiler
        With the compiler's first error, or if there is none.
    """
    if recall(CHECKED) is None:
        refuse_unusable()
        keep(CHECKED, b"yes")


def refuse_unusable() -> None:
    """Refuse a compiler that cannot compile the smallest extension of Python.

    Raises
    ------
    NoCompiler
        With the compiler's first error.
    """
    command = c_compiler()
    with tempfile.TemporaryDirectory() as scratch:
        code, made = Path(scratch) / "smallest.c", Path(scratch) / "smallest.so"
        code.write_text(SMALLEST, encoding="utf-8")
        words = [*command, f"-I{sysconfig.get_path('include')}", "-fPIC", "-shared", str(code), "-o", str(made)]
        done = subprocess.run(words, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode and not FULL.search(done.stderr):
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        error = next((line for line in lines if "error" in line), lines[0]).replace(f"{scratch}/", "")
        raise NoCompiler(f"{shlex.join(command)} cannot compile: {error}; install what it lacks, or {HINT}")


def library(name: str, source: Callable[[], str], options: tuple[str, ...]) -> Path:
    """The file of a library, which is compiled first if it is not there.

    Parameters
    ----------
    name
        Says what it depends on, but for the options and the processor.
    source
        Its code in C; called if it must be compiled.
    options
        Of the compiler.

    Raises
    ------
    NoCompiler
        If there is none.
    RuntimeError
        If the folder of the kernels cannot be written.
    CalledProcessError
        If the compiler fails.
    """
    options = (*options, *processor_options())
    depends = hashlib.sha256("\n".join((name, *options)).encode()).hexdigest()[:40]
    file, folder = f"libmagshell_{depends}.so", kernel_cache()
    if kept := kept_file(file):
        return kept
    with written_into(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with _alone(folder / f"{file}.lock"):
        if not kept_file(file):  # another process may have made it meanwhile
            _compile(source(), options, folder / file)
    return folder / file


@cache
def processor_options() -> tuple[str, ...]:
    """Options for the vectors that this processor has."""
    if platform.machine() != "x86_64":
        return ()
    with suppress(OSError):
        flags = re.search(r"^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE)
        if flags and {*VECTORS} <= {*flags[1].split()}:
            return tuple(f"-m{vector}" for vector in VECTORS)
    return ()


def _compile(source: str, options: tuple[str, ...], file: Path) -> None:
    """Under a name of its own first, so that others find a whole library or none."""
    compiler = c_compiler()
    with written_into(file.parent), tempfile.TemporaryDirectory(dir=file.parent, prefix=file.stem) as scratch:
        code, made = Path(scratch) / "kernel.c", Path(scratch) / file.name
        code.write_text(source, encoding="utf-8")
        command = [*compiler, *options, "-fPIC", "-shared", str(code), "-o", str(made), "-lm"]
        done = subprocess.run(command, stderr=subprocess.PIPE, text=True, errors="replace", check=False)
        print(done.stderr, end="", file=sys.stderr)
        if done.returncode and (full := FULL.search(done.stderr)):  # of its own, or of the folder for temporary files
            raise OSError(0, full[0])
        done.check_returncode()
        made.chmod(0o755)  # whatever the umask: what others may write is not trusted
        made.replace(file)


@contextmanager
def _alone(lock: Path) -> Iterator[None]:
    """While another process has the lock, wait; where files cannot be locked, go on."""
    with written_into(lock.parent), lock.open("w") as stream:
        with suppress(OSError):
            fcntl.flock(stream, fcntl.LOCK_EX)
        yield
    lock.unlink(missing_ok=True)


def check_room(folder: Path) -> None:
    """Say so if the disk is full, of the kernels or of temporary files: what dolfinx runs does not.

    Raises
    ------
    RuntimeError
        If a file of a megabyte cannot be written.
    """
    for place in (folder, tempfile.gettempdir()):
        with written_into(folder), tempfile.TemporaryFile(dir=place) as stream:
            stream.write(bytes(2**20))
            stream.flush()


@contextmanager
def written_into(folder: Path) -> Iterator[None]:
    """Turn an error of the disk into one that names the cache; dolfinx passes on only its words on several ranks."""
    try:
        yield
    except OSError as e:
        raise RuntimeError(f"kernels cannot be compiled into {folder}: {e.strerror}") from None
