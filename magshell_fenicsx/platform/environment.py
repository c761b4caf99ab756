"""The environment of the program: versions, the BLAS of PETSc, the kernel cache."""

import os
import platform
import re
from pathlib import Path
from typing import Any

import dolfinx
import ufl
from petsc4py import PETSc

from magshell_fenicsx.platform.version import __version__

FAST_BLAS = re.compile(r"/lib(openblas|mkl_rt|mkl_core|blis|flexiblas|armpl)[^/]*$", re.MULTILINE)


def versions() -> dict[str, str]:
    """Versions of the packages that a result depends on."""
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
    found = FAST_BLAS.search(loaded)
    return found[1] if found else None


def fingerprint() -> dict[str, Any]:
    """Processor, usable cores, memory, BLAS and versions; times are comparable if all of these are equal."""
    return {
        "cpu": _first_group(Path("/proc/cpuinfo"), r"^model name\s*:\s*(.+)$"),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": round(int(_first_group(Path("/proc/meminfo"), r"^MemTotal:\s*(\d+) kB$") or 0) / 2**20, 1),
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
