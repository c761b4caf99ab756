"""The memory that this process may still take."""

import os
import resource
from collections.abc import Iterator
from pathlib import Path

GIVEN = "MAGSHELL_MEMORY"  # GB to count on, in place of what the machine says


def available(root: Path = Path("/")) -> float:
    """Bytes that are left to new processes and their control group, or to this one by `ulimit -v`; inf if unknown.

    Raises
    ------
    ValueError
        If MAGSHELL_MEMORY is no number of GB.
    """
    if given := os.environ.get(GIVEN):
        try:
            return 1e9 * _positive(given)
        except ValueError:
            raise ValueError(f"MAGSHELL_MEMORY={given}: give the GB to count on, such as MAGSHELL_MEMORY=64") from None
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
    """What the limits of the control groups leave, of version 2 and 1, each up to the outermost group."""
    for line in _text(root / "proc/self/cgroup").splitlines():
        _, controllers, own = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        names = ("memory.limit_in_bytes", "memory.usage_in_bytes") if controllers else ("memory.max", "memory.current")
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
    return next((int(line[1]) for line in lines if line[:1] in (["inactive_file"], ["total_inactive_file"])), 0)


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
