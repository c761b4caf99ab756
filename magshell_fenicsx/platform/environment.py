"""What the program runs in: versions, the BLAS of PETSc, memory; and the version of its own code.

Results of other code are not reused.
"""

import hashlib
import os
import platform
import re
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from magshell_fenicsx import __version__

FAST_BLAS = re.compile(r"/lib(openblas|mkl_rt|mkl_core|blis|flexiblas|armpl)[^/]*$", re.MULTILINE)
GIVEN = "MAGSHELL_MEMORY"  # GB to count on, in place of what the machine says
SUFFIXES = (".py", ".c", ".html")


def versions() -> dict[str, str]:
    """Versions of the packages that a result depends on."""
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
    """Name of the optimised BLAS in this process; None for the reference BLAS.

    With the reference BLAS a factorisation takes seven times as long.
    """
    try:
        loaded = Path("/proc/self/maps").read_text(encoding="utf-8")
    except OSError:
        return "unknown"
    library = FAST_BLAS.search(loaded)
    return library[1] if library else None


def fingerprint() -> dict[str, Any]:
    """Processor, usable cores, memory, BLAS and versions; times are comparable if all of these are
    equal.
    """
    return {
        "cpu": _first_group(Path("/proc/cpuinfo"), r"^model name\s*:\s*(.+)$"),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": round(
            int(_first_group(Path("/proc/meminfo"), r"^MemTotal:\s*(\d+) kB$") or 0) / 2**20, 1
        ),
        "blas": fast_blas() or "reference",
        "versions": versions(),
    }


def described(machine: dict[str, Any]) -> str:
    """The machine in one line."""
    cores = f"{machine['cores']} core{'s' if machine['cores'] > 1 else ''}"
    numbers = ", ".join(f"{name} {number}" for name, number in machine["versions"].items())
    return f"{machine['cpu']}, {cores}, {machine['memory_gb']} GB, {machine['blas']}; {numbers}"


def _first_group(file: Path, pattern: str) -> str:
    """The first group of a pattern in a file of the kernel; "" without a match."""
    match = re.search(pattern, file.read_text(encoding="utf-8"), re.MULTILINE)
    return match[1] if match else ""


def available_memory(root: Path = Path("/")) -> float:
    """Bytes that are left to new processes and their control group, or to this one by `ulimit -v`;
    inf if unknown.

    Raises
    ------
    ValueError
        If MAGSHELL_MEMORY is no number of GB.
    """
    if given := os.environ.get(GIVEN):
        try:
            return 1e9 * _positive(given)
        except ValueError:
            raise ValueError(
                f"MAGSHELL_MEMORY={given}: give the GB to count on, such as MAGSHELL_MEMORY=64"
            ) from None
    return min([*_of_machine(root), *_of_groups(root), *_of_limit(root)], default=float("inf"))


def _positive(text: str) -> float:
    value = float(text)
    if not value > 0:
        raise ValueError(text)
    return value


def _of_machine(root: Path) -> Iterator[float]:
    for line in _text(root / "proc/meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            yield 1024.0 * int(line.split()[1])


def _of_groups(root: Path) -> Iterator[float]:
    """What the limits of the control groups leave, of version 2 and 1, each up to the outermost
    group.
    """
    for line in _text(root / "proc/self/cgroup").splitlines():
        _, controllers, own = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        names = (
            ("memory.limit_in_bytes", "memory.usage_in_bytes")
            if controllers
            else ("memory.max", "memory.current")
        )
        top = root / "sys/fs/cgroup" / ("memory" if controllers else "")
        for group in (top / own.lstrip("/"), *(top / own.lstrip("/")).parents):
            if not group.is_relative_to(top):
                break
            limit, used = (_text(group / name).strip() for name in names)
            if limit.isdigit() and used.isdigit():
                yield max(int(limit) - int(used) + _cached(group), 0.0)


def _cached(group: Path) -> int:
    """Bytes of files that the kernel gives back when they are needed."""
    lines = (line.split() for line in _text(group / "memory.stat").splitlines())
    return next(
        (
            int(line[1])
            for line in lines
            if line[:1] in (["inactive_file"], ["total_inactive_file"])
        ),
        0,
    )


def _of_limit(root: Path) -> Iterator[float]:
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    pages = _text(root / "proc/self/statm").split()
    if limit != resource.RLIM_INFINITY and pages:
        yield max(limit - int(pages[0]) * resource.getpagesize(), 0.0)


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except OSError:
        return ""


def version_of(folder: Path) -> str:
    """Version and hash of a package's files, comments included, independent of where it is
    installed.
    """
    digest, root = hashlib.sha256(), str(folder)
    for file in sorted(f"{inner}/{name}" for inner, _, names in os.walk(root) for name in names):
        if file.endswith(SUFFIXES):
            content = Path(file).read_bytes()
            digest.update(f"{file.removeprefix(root)} {len(content)}\n".encode() + content)
    return f"{__version__}+{digest.hexdigest()[:16]}"


_RUNNING = version_of(
    Path(__file__).parents[1]
)  # hashed at import: files may be edited during a run


def code_version() -> str:
    """Version and hash of the running code, such as 0.2.0+3f2a9c1b2d3e4f50."""
    return _RUNNING
