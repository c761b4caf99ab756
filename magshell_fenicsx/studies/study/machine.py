"""The machine on which times were measured."""

import os
import re
from pathlib import Path
from typing import Any

from magshell_fenicsx.platform.environment import fast_blas, versions


def fingerprint() -> dict[str, Any]:
    """Processor, usable cores, memory, BLAS and versions; times are comparable if all of these are equal."""
    return {
        "cpu": _found(Path("/proc/cpuinfo"), r"^model name\s*:\s*(.+)$"),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": round(int(_found(Path("/proc/meminfo"), r"^MemTotal:\s*(\d+) kB$") or 0) / 2**20, 1),
        "blas": fast_blas() or "reference",
        "versions": versions(),
    }


def described(machine: dict[str, Any]) -> str:
    """The machine in one line."""
    cores = f"{machine['cores']} core{'s' if machine['cores'] > 1 else ''}"
    numbers = ", ".join(f"{name} {number}" for name, number in machine["versions"].items())
    return f"{machine['cpu']}, {cores}, {machine['memory_gb']} GB, {machine['blas']}; {numbers}"


def _found(file: Path, pattern: str) -> str:
    """The first group of a pattern in a file of the kernel; "" without a match."""
    match = re.search(pattern, file.read_text(encoding="utf-8"), re.MULTILINE)
    return match[1] if match else ""
