"""The environment of a run: versions, the BLAS of PETSc, memory, and a hash of the code.

Results that other code has computed are not reused. Linux tells most of this in files below /proc
and /sys; a control group limits the memory of a set of processes, as of a container or a job.
"""

import hashlib
import os
import platform
import re
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from magshell_fenicsx.platform.version import __version__

OPTIMISED_BLAS = re.compile(
    r"/lib(openblas|mkl_rt|mkl_core|blis|flexiblas|armpl)[^/]*$", re.MULTILINE
)
MEMORY_VARIABLE = "MAGSHELL_MEMORY"  # GB to count on, in place of what the machine says
SOURCE_SUFFIXES = (".py", ".c", ".html")


def versions() -> dict[str, str]:
    """Return the versions of the packages that a result depends on."""
    import dolfinx
    import ufl
    from petsc4py import PETSc

    return {
        "magshell_fenicsx": __version__,
        "dolfinx": dolfinx.__version__,
        "ufl": ufl.__version__,
        "petsc": ".".join(str(n) for n in PETSc.Sys.getVersion()),
        "python": platform.python_version(),
    }


def fast_blas() -> str | None:
    """Return the name of the optimised BLAS that this process has loaded.

    None for the reference BLAS, with which a factorisation takes seven times as long. "unknown"
    where the system does not tell.
    """
    try:
        loaded = Path("/proc/self/maps").read_text(encoding="utf-8")
    except OSError:
        return "unknown"
    library = OPTIMISED_BLAS.search(loaded)
    return library[1] if library else None


def machine_fingerprint() -> dict[str, Any]:
    """Return processor, usable cores, memory (GB), BLAS and versions of this machine.

    Times of two machines are comparable if all of these are equal.
    """
    memory_kb = int(_first_group(Path("/proc/meminfo"), r"^MemTotal:\s*(\d+) kB$") or 0)
    return {
        "cpu": _first_group(Path("/proc/cpuinfo"), r"^model name\s*:\s*(.+)$"),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": round(memory_kb / 2**20, 1),
        "blas": fast_blas() or "reference",
        "versions": versions(),
    }


def describe_machine(machine: dict[str, Any]) -> str:
    """Return a machine's fingerprint in one line."""
    cores = f"{machine['cores']} core{'s' if machine['cores'] > 1 else ''}"
    numbers = ", ".join(f"{name} {number}" for name, number in machine["versions"].items())
    return f"{machine['cpu']}, {cores}, {machine['memory_gb']} GB, {machine['blas']}; {numbers}"


def _first_group(file: Path, pattern: str) -> str:
    """Return the first group of a regular expression in a kernel's file; empty without match."""
    match = re.search(pattern, file.read_text(encoding="utf-8"), re.MULTILINE)
    return match[1] if match else ""


def available_memory(root: Path = Path("/")) -> float:
    """Return the bytes of memory that new processes may still use; infinite if unknown.

    It is the least that the machine, the control groups and `ulimit -v` leave, or MAGSHELL_MEMORY.

    Parameters
    ----------
    root
        Root of the file system with /proc and /sys.

    Raises
    ------
    ValueError
        If MAGSHELL_MEMORY is no number of GB.
    """
    if gigabytes := os.environ.get(MEMORY_VARIABLE):
        try:
            return 1e9 * _positive(gigabytes)
        except ValueError:
            raise ValueError(
                f"MAGSHELL_MEMORY={gigabytes}: give the GB to count on, such as MAGSHELL_MEMORY=64"
            ) from None
    limits = [*_machine_memory(root), *_control_group_memory(root), *_process_memory(root)]
    return min(limits, default=float("inf"))


def _positive(text: str) -> float:
    """Return a positive number from text; raise a ValueError if it is none."""
    value = float(text)
    if not value > 0:
        raise ValueError(text)
    return value


def _machine_memory(root: Path) -> Iterator[float]:
    """Iterate over the bytes that the machine has available: one number, or none if unknown."""
    for line in _text(root / "proc/meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            yield 1024.0 * int(line.split()[1])


def _control_group_memory(root: Path) -> Iterator[float]:
    """Iterate over the bytes that control groups leave, from the innermost to the outermost group.

    Control groups may be of version 2, or of version 1, whose lines in /proc name controllers.
    """
    for line in _text(root / "proc/self/cgroup").splitlines():
        # "0::/path" of version 2; "7:memory:/path" of version 1
        _, controllers, group_path = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        if controllers:
            names = "memory.limit_in_bytes", "memory.usage_in_bytes"
        else:
            names = "memory.max", "memory.current"
        top = root / "sys/fs/cgroup" / ("memory" if controllers else "")
        innermost = top / group_path.lstrip("/")
        for group in (innermost, *innermost.parents):
            if not group.is_relative_to(top):
                break  # above the outermost group
            limit, used = (_text(group / name).strip() for name in names)
            if limit.isdigit() and used.isdigit():  # "max" stands for no limit
                yield max(int(limit) - int(used) + _reclaimable(group), 0.0)


def _reclaimable(group: Path) -> int:
    """Return the bytes of cached files, which the kernel gives back when they are needed."""
    for line in _text(group / "memory.stat").splitlines():
        name, *values = line.split() or [""]
        if name in ("inactive_file", "total_inactive_file"):
            return int(values[0])
    return 0


def _process_memory(root: Path) -> Iterator[float]:
    """Iterate over the bytes that `ulimit -v` leaves to this process; none without a limit."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    pages = _text(root / "proc/self/statm").split()  # the first: all of the address space
    if limit != resource.RLIM_INFINITY and pages:
        yield max(limit - int(pages[0]) * resource.getpagesize(), 0.0)


def _text(file: Path) -> str:
    """Return the text of a file; empty if it cannot be read."""
    try:
        return file.read_text(encoding="utf-8")
    except OSError:
        return ""


def source_version(folder: Path) -> str:
    """Return the version and a hash of the source files in a folder, as `code_version` does.

    Comments count; the place of the folder does not.
    """
    digest, root = hashlib.sha256(), str(folder)
    files = [f"{inner}/{name}" for inner, _, names in os.walk(root) for name in names]
    for file in sorted(files):
        if file.endswith(SOURCE_SUFFIXES):
            content = Path(file).read_bytes()
            digest.update(f"{file.removeprefix(root)} {len(content)}\n".encode() + content)
    return f"{__version__}+{digest.hexdigest()[:16]}"


# Computed at import: files may be edited during a run.
_RUNNING_VERSION = source_version(Path(__file__).parents[1])


def code_version() -> str:
    """Return version and hash of the running code, such as 0.2.0+3f2a9c1b2d3e4f50."""
    return _RUNNING_VERSION
