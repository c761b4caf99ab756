"""Compiled kernels, and what else takes long to find and is the same for every run: kept in a
folder.

What is there is executed. So it is only taken from folders and files that the user or root owns and
nobody else may change; where the usual folder is none, a private one takes its place.
"""

import grp
import os
import pwd
import stat
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path


class UnsafeCache(RuntimeError):
    """There is no folder for kernels that the user alone may write."""


def kernel_cache() -> Path:
    """The folder of the compiled kernels, to which new ones go.

    Raises
    ------
    UnsafeCache
        If none can be made that nobody else may write.
    """
    return _folders(_usual())[0]


def kept_file(name: str) -> Path | None:
    """A file of this name that may be trusted, in the folder of the kernels or in a shared one;
    None without.
    """
    folders = dict.fromkeys([kernel_cache(), *_folders(_usual())])
    return next((folder / name for folder in folders if trusted(folder / name)), None)


def trusted(file: Path) -> bool:
    """Whether there is such a file, of the user or root, that nobody else may change."""
    try:
        about = file.stat()
    except OSError:
        return False
    return about.st_uid in (0, os.getuid()) and not _writable_by_others(about)


def recall(name: str) -> bytes | None:
    """What is kept under a name, which says what it depends on; None without."""
    file = kept_file(name)
    try:
        return file.read_bytes() if file else None
    except OSError:
        return None


def keep(name: str, content: bytes) -> None:
    """Keep it for later processes; a folder that cannot be written stays as it is."""
    folder = kernel_cache()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        number, new = tempfile.mkstemp(dir=folder, prefix=name)
        with os.fdopen(number, "wb") as stream:
            stream.write(content)
        Path(new).replace(folder / name)  # whole at every moment: other processes may read it
    except OSError:
        return


def _usual() -> Path:
    from dolfinx.jit import get_options  # takes long to import

    usual, base = Path(get_options()["cache_dir"]), os.environ.get("XDG_CACHE_HOME")
    if base is not None and not Path(base).is_absolute() and usual == Path(base) / "fenics":
        return (
            Path.home() / ".cache" / "fenics"
        )  # its specification: what is empty or relative is ignored
    return usual.absolute()


@cache
def _folders(usual: Path) -> tuple[Path, ...]:
    """Where new kernels go, and the usual folder if that can be trusted too but not written, as
    that of an image.
    """
    also = (usual,) if usual.is_dir() and _is_private(usual) else ()
    for folder in _candidates(usual):
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True, mode=0o755 if folder == usual else 0o700)
        if folder.is_dir() and os.access(folder, os.W_OK) and _is_private(folder):
            return tuple(dict.fromkeys((folder, *also)))
    if also:
        return also  # has what was compiled before
    raise UnsafeCache(
        f"kernel cache {usual}: others may write to it or own it, and what is in it is executed; no private folder can "
        "be made in its place: set XDG_CACHE_HOME to a folder that you own and nobody else may write (chmod go-w)"
    )


def _candidates(usual: Path) -> Iterator[Path]:
    """The usual folder, one within it, and others if it is another user's."""
    user = os.getuid()
    yield usual
    yield usual / f"user_{user}"
    with suppress(RuntimeError):  # no home
        yield Path.home() / ".cache" / "magshell"
    yield Path(tempfile.gettempdir()) / f"magshell_{user}"


def _is_private(folder: Path) -> bool:
    """Whether nobody but the user and root may change what is in a folder, or put another in its
    place.
    """
    folder = folder.resolve()
    about = folder.stat()
    if about.st_uid not in (0, os.getuid()) or _writable_by_others(about):
        return False
    return all(_keeps(parent.stat()) for parent in folder.parents)


def _keeps(about: os.stat_result) -> bool:
    """Whether others cannot move a folder of ours out of this one: in a sticky folder they cannot."""
    owned = about.st_uid in (0, os.getuid(), *_unmapped())
    return owned and (bool(about.st_mode & stat.S_ISVTX) or not _writable_by_others(about))


def _writable_by_others(about: os.stat_result) -> bool:
    by_group = about.st_mode & stat.S_IWGRP and not _own_group(about.st_gid)
    return bool(about.st_mode & stat.S_IWOTH or by_group)


@cache
def _own_group(number: int) -> bool:
    """Whether a group is that of the user alone, as many systems make one for each."""
    try:
        group, user = grp.getgrgid(number), pwd.getpwuid(os.getuid())
    except KeyError:
        return False
    return group.gr_name == user.pw_name and {*group.gr_mem} <= {user.pw_name}


@cache
def _unmapped() -> tuple[int, ...]:
    """Who root seems to be where a container has only this user; none where it has root."""
    try:
        lines = Path("/proc/self/uid_map").read_text(encoding="utf-8").splitlines()
        if any(line.split()[0] == "0" for line in lines):
            return ()
        return (int(Path("/proc/sys/kernel/overflowuid").read_text(encoding="utf-8")),)
    except (OSError, ValueError, IndexError):
        return ()
