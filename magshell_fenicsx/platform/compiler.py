"""Shared libraries of C, compiled once and kept beside the kernels of the forms."""

import fcntl
import hashlib
import os
import platform
import re
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from magshell_fenicsx.platform.kept import kept_file, kernel_cache

FULL = re.compile("No space left on device|Disk quota exceeded|File too large|Read-only file system")
VECTORS = ("avx2", "fma")  # of x86: what vectors of four numbers need to be one register


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
    RuntimeError
        If the compiler fails, or the folder of the kernels cannot be written.
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
    compiler = shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")
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
