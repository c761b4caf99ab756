"""The C compiler, and shared libraries of C: compiled once, in parallel, and cached on disk.

The compiler is the first that Python can call: that of CC, that which built Python, gcc, clang, or
Zig's, which PyPI has.

Of several processes that ask for a library one compiles it. A process holds the lock of a library
only while it generates the code and a compiler runs, and it waits for no other lock meanwhile. So
whoever waits for a library waits for one compilation at most. Ranks share the work without a
message: each takes a library that no other has taken.

Ranks are the processes of one run. Kernels are the C functions of forms, which a library holds. The
code of a library is made by a function, only if the library must be compiled.
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

from magshell_fenicsx.platform.disk_cache import cache_folder, cached_file, load_cached, save_cached
from magshell_fenicsx.platform.packages import Unusable
from magshell_fenicsx.platform.processes import world

FULL_DISK = re.compile(
    "No space left on device|Disk quota exceeded|File too large|Read-only file system"
)
POLL_SECONDS = 0.02  # between two checks whether another process has compiled a library
PROGRESS_SECONDS = 0.5  # between two messages of progress
VECTOR_FLAGS = ("avx2", "fma")  # of x86, for which four numbers are one register

USUAL_COMPILERS = ("cc", "gcc", "clang")
# For any processor, as the kernels may be shared; and without traps for undefined behaviour, which
# it adds by default.
ZIG_OPTIONS = ("-mcpu=baseline", "-fno-sanitize=undefined")
HINT = "install gcc or clang, or `python3 -m pip install ziglang`, or name one in CC"
SMALLEST_SOURCE = "#include <math.h>\ndouble root(double x) { return sqrt(x); }\n"
# Options of every kind that kernels have.
KERNEL_OPTIONS = ("-O3", "-ffast-math", "-fno-strict-overflow", "-std=gnu17")
COMPILER_CHECKED = "magshell_compiler_checked"  # name in a cache for which a compiler works


class NoCompiler(Unusable):
    """Error that no C compiler can compile kernels; the message has the reason."""


def c_compiler() -> tuple[str, ...]:
    """Return the command of the C compiler with its options.

    Raises
    ------
    NoCompiler
        If there is no compiler.
    """
    # the one that CC names; nothing else is tried
    if CC_value := os.environ.get("CC"):
        try:
            command = tuple(shlex.split(CC_value))
        except ValueError:  # a quotation without its end
            command = ()
        if not command or not shutil.which(command[0]):
            raise NoCompiler(f"CC={CC_value}: there is no such compiler; {HINT}")
        return command
    # that of Python, the usual ones, and Zig's
    for name in (sysconfig.get_config_var("CC"), *USUAL_COMPILERS):
        command = tuple(shlex.split(name or ""))
        if command and shutil.which(command[0]):
            return command
    if find_spec("ziglang"):
        return sys.executable, "-m", "ziglang", "cc", *ZIG_OPTIONS
    raise NoCompiler(f"there is no C compiler, which the kernels take: {HINT}")


@cache
def is_gnu(compiler: tuple[str, ...]) -> bool:
    """Return whether a compiler is GCC itself, and not Clang, which defines GCC's macros too."""
    command = [*compiler, "-dM", "-E", "-x", "c", os.devnull]
    macros = _run(command).stdout
    return "__GNUC__" in macros and "__clang__" not in macros


def check_compiler() -> None:
    """Refuse a compiler that cannot compile kernels, before any kernel is compiled.

    The check is skipped where the cache has a note that a compiler has worked.

    Raises
    ------
    NoCompiler
        With the compiler's first error, or if there is no compiler.
    """
    if load_cached(COMPILER_CHECKED) is None:
        refuse_unusable()
        save_cached(COMPILER_CHECKED, b"yes")


def refuse_unusable() -> None:
    """Refuse a compiler that cannot compile the smallest library.

    Raises
    ------
    NoCompiler
        With the compiler's first error.
    """
    command = c_compiler()
    with tempfile.TemporaryDirectory() as scratch:
        code, library = Path(scratch) / "smallest.c", Path(scratch) / "smallest.so"
        code.write_text(SMALLEST_SOURCE, encoding="utf-8")
        process = _compiler_run(command, (*KERNEL_OPTIONS, *processor_options()), code, library)
    if process.returncode and not FULL_DISK.search(process.stderr):
        lines = process.stderr.strip().splitlines() or [f"exit code {process.returncode}"]
        error = next((line for line in lines if "error" in line), lines[0])
        # the scratch folder means nothing to the user
        error = error.replace(f"{scratch}/", "")
        raise NoCompiler(
            f"{shlex.join(command)} cannot compile: {error}; install what it lacks, or {HINT}"
        )


class Library:
    """A shared library that is cached, or being compiled by this process or another one.

    Parameters
    ----------
    name
        Text that determines the library, apart from the options.
    source
        Function that returns the code in C; called only if the library must be compiled.
    options
        Options for any compiler.
    gnu_options
        Further options for GCC itself.

    Attributes
    ----------
    file
        Name of the library's file in the cache.
    _source, _options, _gnu_options
        The parameters of these names.
    _compilation
        The compilation by this process, in a thread; None before it starts.
    _lock
        The open lock file, while this process holds the lock.
    _path
        The compiled file; None as long as it is not known to be there.
    """

    def __init__(
        self,
        name: str,
        source: Callable[[], str],
        options: tuple[str, ...],
        gnu_options: tuple[str, ...] = (),
    ) -> None:
        inputs = "\n".join((name, *options, *gnu_options))
        self.file = f"libmagshell_{hashlib.sha256(inputs.encode()).hexdigest()[:40]}.so"
        self._source, self._options, self._gnu_options = source, options, gnu_options
        self._compilation: Future[Path] | None = None
        self._lock: IO[str] | None = None
        self._path = cached_file(self.file)

    @property
    def is_compiled(self) -> bool:
        """Whether the library's file can be loaded.

        Raises
        ------
        RuntimeError
            If the folder of the kernels cannot be written.
        CalledProcessError
            If the compiler has failed.
        """
        if not self._path:
            if not self._compilation:
                self._path = cached_file(self.file)
            elif self._compilation.done():
                self._path = self._compilation.result()
        return self._path is not None

    @property
    def running_compilation(self) -> "Future[Path] | None":
        """The compilation by this process, while it lasts."""
        compilation = self._compilation
        return compilation if compilation and not compilation.done() else None

    def start(self) -> None:
        """Start the compilation, unless the library is compiled or another process compiles it.

        Raises
        ------
        RuntimeError
            If the folder of the kernels cannot be written.
        """
        if self.is_compiled or self._compilation:
            return
        if not self._take_lock():
            return
        try:
            if not self.is_compiled:  # another process may have compiled it meanwhile
                self._compilation = _pool().submit(self._compile, self._source())
        finally:
            if not self._compilation:  # else the compilation releases it
                self._release_lock()

    def path(self) -> Path:
        """Return the library's file; if need be, compile it or wait for a process that does."""
        compile_libraries([self])
        assert self._path
        return self._path

    def cancel(self) -> None:
        """Cancel the compilation if no compiler runs yet, and release the lock."""
        if self._compilation and self._compilation.cancel():
            self._compilation = None
            self._release_lock()

    def _compile(self, source: str) -> Path:
        """Compile the code in a thread, return the library's file, and release the lock."""
        try:
            options, file = self._options, cache_folder() / self.file
            if self._gnu_options and is_gnu(c_compiler()):
                options = (*options, *self._gnu_options)
            _compile(source, options, file)
            return file
        finally:
            self._release_lock()

    def _take_lock(self) -> bool:
        """Lock out other processes; return False if another process has the lock.

        Where files cannot be locked, return True: then several processes may compile the same
        library.
        """
        folder = cache_folder()
        with written_into(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = (folder / f"{self.file}.lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            return False
        except OSError:  # no locks on this file system
            pass
        return True

    def _release_lock(self) -> None:
        """Close the lock file, which unlocks it, and delete it."""
        assert self._lock
        self._lock.close()
        Path(self._lock.name).unlink(missing_ok=True)


def compile_libraries(
    libraries: Sequence[Library], tell: Callable[[int], None] = lambda _: None
) -> None:
    """Compile libraries in their order, several in parallel, and return when all are compiled.

    While compilers run, the code of one further library is generated; no more, so that other ranks
    find work.

    Parameters
    ----------
    libraries
        The libraries; those that another process compiles are waited for.
    tell
        Called repeatedly with the number of libraries that are compiled.

    Raises
    ------
    NoCompiler
        If there is no compiler.
    RuntimeError
        If the folder of the kernels cannot be written.
    CalledProcessError
        If the compiler fails. Compilations that have not begun are cancelled.
    """
    try:
        while missing := [library for library in libraries if not library.is_compiled]:
            tell(len(libraries) - len(missing))
            # start compilations: one more than there are cores, whose code waits for a free core
            for library in missing:
                if not library.running_compilation and len(_running(missing)) <= cores():
                    library.start()
                    tell(sum(library.is_compiled for library in libraries))
            # wait for one of them; without any, other processes compile all that is missing, and
            # their files are looked for again
            if running := _running(missing):
                wait(running, PROGRESS_SECONDS, FIRST_COMPLETED)
            else:
                time.sleep(POLL_SECONDS)
        tell(len(libraries))
    except BaseException:
        for library in libraries:
            library.cancel()
        raise


def _running(libraries: Iterable[Library]) -> list["Future[Path]"]:
    """Return the compilations of libraries that this process runs or has queued."""
    compilations = [library.running_compilation for library in libraries]
    return [compilation for compilation in compilations if compilation]


@cache
def cores() -> int:
    """Return how many compilers this process runs at once: its share of the visible cores."""
    if hasattr(os, "sched_getaffinity"):
        visible = len(os.sched_getaffinity(0))
    else:
        visible = os.cpu_count() or 1
    return max(1, visible // int(world().size))


@cache
def _pool() -> ThreadPoolExecutor:
    """Return the pool of threads that wait for compilers."""
    return ThreadPoolExecutor(cores(), "compiler")


os.register_at_fork(after_in_child=_pool.cache_clear)  # a child process has no threads


@cache
def processor_options() -> tuple[str, ...]:
    """Return compiler options for the vector instructions of this processor; none but on x86."""
    if platform.machine() != "x86_64":
        return ()
    with suppress(OSError):
        cpuinfo = Path("/proc/cpuinfo").read_text(encoding="utf-8")
        flags = re.search(r"^flags\s*:(.*)$", cpuinfo, re.MULTILINE)
        if flags and {*VECTOR_FLAGS} <= {*flags[1].split()}:
            return tuple(f"-m{vector}" for vector in VECTOR_FLAGS)
    return ()


def _compiler_run(
    compiler: tuple[str, ...], options: tuple[str, ...], code: Path, library: Path
) -> subprocess.CompletedProcess[str]:
    """Compile a file of C and link its library; return the process that failed, or the last one.

    Linking is a step of its own, without options. With -ffast-math, older compilers link code that
    flushes denormal numbers of the whole process to zero when the library is loaded.
    """
    to_object = [*compiler, *options, "-fPIC", "-c", str(code), "-o", f"{code}.o"]
    to_library = [*compiler, "-shared", f"{code}.o", "-o", str(library), "-lm"]
    compiled = _run(to_object)
    if compiled.returncode:
        return compiled
    linked = _run(to_library)
    linked.stderr = compiled.stderr + linked.stderr
    return linked


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run a command and return its exit code and output as text."""
    return subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)


def _compile(source: str, options: tuple[str, ...], file: Path) -> None:
    """Compile a library in a scratch folder, then move it: others find it complete or not at all.

    This process must hold the library's lock. It therefore removes scratch folders that killed
    processes have left.

    Raises
    ------
    RuntimeError
        If the folder of the kernels cannot be written.
    NoCompiler, CalledProcessError
        If the compiler fails for any code, or for this code.
    """
    compiler = c_compiler()
    # abandoned scratch folders: tempfile adds eight characters to the prefix
    for abandoned in file.parent.glob(f"{file.stem}????????/"):
        shutil.rmtree(abandoned, ignore_errors=True)
    with (
        written_into(file.parent),
        tempfile.TemporaryDirectory(dir=file.parent, prefix=file.stem) as scratch,
    ):
        code, library = Path(scratch) / "kernel.c", Path(scratch) / file.name
        code.write_text(source, encoding="utf-8")
        process = _compiler_run(compiler, options, code, library)
        print(process.stderr, end="", file=sys.stderr)
        if process.returncode:
            # The disk of the cache may be full, or that of temporary files.
            if full_disk := FULL_DISK.search(process.stderr):
                raise OSError(0, full_disk[0])
            refuse_unusable()  # raises if the compiler fails for any code
        process.check_returncode()
        library.chmod(0o755)  # whatever the umask: a file that others may write is not trusted
        library.replace(file)


@contextmanager
def written_into(folder: Path) -> Iterator[None]:
    """Turn an error of the disk within `with` into a RuntimeError that names the cache folder."""
    try:
        yield
    except OSError as e:
        raise RuntimeError(f"kernels cannot be compiled into {folder}: {e.strerror}") from None
