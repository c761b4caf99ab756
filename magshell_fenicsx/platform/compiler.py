"""The C compiler, and shared libraries of C, compiled once, side by side, and kept for later
processes.

The compiler is any that Python can call: that of CC, that which built Python, gcc, clang, or Zig's,
which PyPI has.

Of several processes that ask for a library one compiles it. A process holds the lock of a library
only while it makes its code and a compiler runs, and waits for none meanwhile: whoever waits for
another one's library waits for no more than that. So ranks share the work without a message: each
takes what no other one has.
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
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import IO

from magshell_fenicsx.platform.kept import keep, kept_file, kernel_cache, recall
from magshell_fenicsx.platform.packages import Unusable
from magshell_fenicsx.platform.processes import world

FULL = re.compile(
    "No space left on device|Disk quota exceeded|File too large|Read-only file system"
)
POLL = 0.02  # s between two looks whether another process has made a library
RENEWED = 0.5  # s after which it is told again how many there are
VECTORS = ("avx2", "fma")  # of x86: what vectors of four numbers need to be one register

USUAL = ("cc", "gcc", "clang")
# For any processor, as the kernels may be shared; and without traps for undefined behaviour, which
# it adds by default.
ZIG_OPTIONS = ("-mcpu=baseline", "-fno-sanitize=undefined")
HINT = "install gcc or clang, or `python3 -m pip install ziglang`, or name one in CC"
SMALLEST = "#include <math.h>\ndouble root(double x) { return sqrt(x); }\n"
USED = (
    "-O3",
    "-ffast-math",
    "-fno-strict-overflow",
    "-std=gnu17",
)  # what kernels ask of any compiler, by kind
CHECKED = "magshell_compiler_checked"  # of a cache for which a compiler has compiled


class NoCompiler(Unusable):
    """There is no C compiler that can compile kernels."""


def c_compiler() -> tuple[str, ...]:
    """Return the command of the C compiler.

    Raises
    ------
    NoCompiler
        If there is none.
    """
    if given := os.environ.get("CC"):
        try:
            command = tuple(shlex.split(given))
        except ValueError:  # a quotation without its end
            command = ()
        if not command or not shutil.which(command[0]):
            raise NoCompiler(f"CC={given}: there is no such compiler; {HINT}")
        return command
    for name in (sysconfig.get_config_var("CC"), *USUAL):
        command = tuple(shlex.split(name or ""))
        if command and shutil.which(command[0]):
            return command
    if find_spec("ziglang"):
        return sys.executable, "-m", "ziglang", "cc", *ZIG_OPTIONS
    raise NoCompiler(f"there is no C compiler, which the kernels take: {HINT}")


@cache
def is_gnu(compiler: tuple[str, ...]) -> bool:
    """Whether a compiler is GCC itself; others say so too, but are Clang."""
    command = [*compiler, "-dM", "-E", "-x", "c", os.devnull]
    macros = subprocess.run(
        command, capture_output=True, text=True, errors="replace", check=False
    ).stdout
    return "__GNUC__" in macros and "__clang__" not in macros


def check_compiler() -> None:
    """Refuse a compiler that cannot compile kernels, before any is compiled; a cache that has some
    needs none.

    Raises
    ------
    NoCompiler
        With the compiler's first error, or if there is none.
    """
    if recall(CHECKED) is None:
        refuse_unusable()
        keep(CHECKED, b"yes")


def refuse_unusable() -> None:
    """Refuse a compiler that cannot compile the smallest library.

    Raises
    ------
    NoCompiler
        With the compiler's first error.
    """
    command = c_compiler()
    with tempfile.TemporaryDirectory() as scratch:
        code, made = Path(scratch) / "smallest.c", Path(scratch) / "smallest.so"
        code.write_text(SMALLEST, encoding="utf-8")
        done = _compiler_run(command, (*USED, *processor_options()), code, made)
    if done.returncode and not FULL.search(done.stderr):
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        error = next((line for line in lines if "error" in line), lines[0]).replace(
            f"{scratch}/", ""
        )
        raise NoCompiler(
            f"{shlex.join(command)} cannot compile: {error}; install what it lacks, or {HINT}"
        )


class Library:
    """A library: it is there, or is compiled meanwhile, by this process or another one.

    Parameters
    ----------
    name
        Says what it depends on, but for the options.
    source
        Its code in C; called if it must be compiled.
    options, gnu_options
        Of any compiler, and more of GCC itself.
    """

    def __init__(
        self,
        name: str,
        source: Callable[[], str],
        options: tuple[str, ...],
        gnu_options: tuple[str, ...] = (),
    ) -> None:
        depends = hashlib.sha256("\n".join((name, *options, *gnu_options)).encode()).hexdigest()[
            :40
        ]
        self.file = f"libmagshell_{depends}.so"
        self._source, self._options, self._gnu_options = source, options, gnu_options
        self._work: Future[Path] | None = None
        self._lock: IO[str] | None = None
        self._kept = kept_file(self.file)

    @property
    def there(self) -> bool:
        """Whether it can be loaded.

        Raises
        ------
        RuntimeError
            If the folder of the kernels cannot be written.
        CalledProcessError
            If the compiler has failed.
        """
        if not self._kept and self._work and self._work.done():
            self._kept = self._work.result()
        elif not self._kept and not self._work:
            self._kept = kept_file(self.file)
        return self._kept is not None

    @property
    def work(self) -> "Future[Path] | None":
        """The compilation by this process, while it lasts."""
        return self._work if self._work and not self._work.done() else None

    def start(self) -> None:
        """Have it compiled, unless it is there or another process does so; returns at once.

        Raises
        ------
        RuntimeError
            If the folder of the kernels cannot be written.
        """
        if self.there or self._work or not self._take_lock():
            return
        try:
            if not self.there:  # another process may have made it meanwhile
                self._work = _pool().submit(self._compile, self._source())
        finally:
            if not self._work:
                self._release_lock()

    def path(self) -> Path:
        """Its file, once it is there."""
        side_by_side([self])
        assert self._kept
        return self._kept

    def cancel(self) -> None:
        """Give it up if no compiler runs yet."""
        if self._work and self._work.cancel():
            self._work = None
            self._release_lock()

    def _compile(self, source: str) -> Path:
        try:
            options = (
                *self._options,
                *(self._gnu_options if self._gnu_options and is_gnu(c_compiler()) else ()),
            )
            _compile(source, options, file := kernel_cache() / self.file)
            return file
        finally:
            self._release_lock()

    def _take_lock(self) -> bool:
        """Lock out other processes; False if one has the lock.

        Where files cannot be locked, go on.
        """
        folder = kernel_cache()
        with written_into(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = (folder / f"{self.file}.lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            return False
        except OSError:
            pass
        return True

    def _release_lock(self) -> None:
        assert self._lock
        self._lock.close()
        Path(self._lock.name).unlink(missing_ok=True)


def side_by_side(
    libraries: Sequence[Library], tell: Callable[[int], None] = lambda _: None
) -> None:
    """Compile libraries in their order, several at once, and return when all are there.

    While compilers run, the code of one more is made; no more than that, so that other ranks find
    work.

    Parameters
    ----------
    tell
        Called again and again with the number of those that are there.

    Raises
    ------
    NoCompiler
        If there is none.
    RuntimeError
        If the folder of the kernels cannot be written.
    CalledProcessError
        If the compiler fails. Libraries that have not begun are given up.
    """
    try:
        while missing := [each for each in libraries if not each.there]:
            tell(len(libraries) - len(missing))
            for each in missing:
                if not each.work and len(_running(missing)) <= cores():
                    each.start()
                    tell(sum(each.there for each in libraries))
            if running := _running(missing):
                wait(running, RENEWED, FIRST_COMPLETED)
            else:
                time.sleep(POLL)
        tell(len(libraries))
    except BaseException:
        for each in libraries:
            each.cancel()
        raise


def _running(libraries: Iterable[Library]) -> list["Future[Path]"]:
    return [each.work for each in libraries if each.work]


@cache
def cores() -> int:
    """How many compilers this process runs at once: ranks share the cores that they see."""
    seen = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, seen // int(world().size))


@cache
def _pool() -> ThreadPoolExecutor:
    """Threads that wait for compilers."""
    return ThreadPoolExecutor(cores(), "compiler")


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads stay behind


@cache
def processor_options() -> tuple[str, ...]:
    """Options for the vectors that this processor has."""
    if platform.machine() != "x86_64":
        return ()
    with suppress(OSError):
        flags = re.search(
            r"^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE
        )
        if flags and {*VECTORS} <= {*flags[1].split()}:
            return tuple(f"-m{vector}" for vector in VECTORS)
    return ()


def _compiler_run(
    compiler: tuple[str, ...], options: tuple[str, ...], code: Path, library: Path
) -> subprocess.CompletedProcess[str]:
    """Compile a file of C and link its library; return the process that failed, or the last one.

    They are linked apart and without options: with -ffast-math older compilers link code that
    flushes denormal numbers of the whole process to zero as the library is loaded.
    """
    to_object = [*compiler, *options, "-fPIC", "-c", str(code), "-o", f"{code}.o"]
    to_library = [*compiler, "-shared", f"{code}.o", "-o", str(library), "-lm"]
    compiled = subprocess.run(
        to_object, capture_output=True, text=True, errors="replace", check=False
    )
    if compiled.returncode:
        return compiled
    linked = subprocess.run(
        to_library, capture_output=True, text=True, errors="replace", check=False
    )
    linked.stderr = compiled.stderr + linked.stderr
    return linked


def _compile(source: str, options: tuple[str, ...], file: Path) -> None:
    """Compile a library under a name of its own first, so that others find a whole one or none.

    Whoever has its lock removes what killed processes have left of it.
    """
    compiler = c_compiler()
    for left in file.parent.glob(f"{file.stem}????????/"):
        shutil.rmtree(left, ignore_errors=True)
    with (
        written_into(file.parent),
        tempfile.TemporaryDirectory(dir=file.parent, prefix=file.stem) as scratch,
    ):
        code, made = Path(scratch) / "kernel.c", Path(scratch) / file.name
        code.write_text(source, encoding="utf-8")
        done = _compiler_run(compiler, options, code, made)
        print(done.stderr, end="", file=sys.stderr)
        if done.returncode and (
            full := FULL.search(done.stderr)
        ):  # of its own, or of the folder for temporary files
            raise OSError(0, full[0])
        if done.returncode:
            refuse_unusable()
        done.check_returncode()
        made.chmod(0o755)  # whatever the umask: what others may write is not trusted
        made.replace(file)


@contextmanager
def written_into(folder: Path) -> Iterator[None]:
    """Turn an error of the disk into one that names the cache."""
    try:
        yield
    except OSError as e:
        raise RuntimeError(f"kernels cannot be compiled into {folder}: {e.strerror}") from None
