"""A cache on disk for compiled kernels, and for other results that are the same for every run.

Its files are executed. So only folders and files count that the user or root owns and nobody else
may change. Where the usual folder is not of this kind, a private one takes its place. Trusted are
such folders and files. A status is what the system knows of a file: owner, group and mode, with
bits that say who may write. A sticky folder is one, such as /tmp, in which only owners may move
files.
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
    """Error that no folder for kernels can be written by the user alone."""


def cache_folder() -> Path:
    """Return the folder of compiled kernels to which new ones are written.

    Raises
    ------
    UnsafeCache
        If there is no folder that only the user may write, and none can be made.
    """
    return _cache_folders(_usual_folder())[0]


def cached_file(name: str) -> Path | None:
    """Return a trusted file of this name in the user's cache or in a shared one; None without."""
    folders = dict.fromkeys([cache_folder(), *_cache_folders(_usual_folder())])
    return next((folder / name for folder in folders if is_trusted(folder / name)), None)


def is_trusted(file: Path) -> bool:
    """Return whether a file exists, belongs to the user or root, and nobody else may change it."""
    try:
        status = file.stat()
    except OSError:
        return False
    return status.st_uid in (0, os.getuid()) and not _writable_by_others(status)


def load_cached(name: str) -> bytes | None:
    """Return the content that is cached under a name; None without.

    The name must depend on everything that the content depends on.
    """
    file = cached_file(name)
    try:
        return file.read_bytes() if file else None
    except OSError:
        return None


def save_cached(name: str, content: bytes) -> None:
    """Cache a content for later processes; do nothing if the folder cannot be written."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor, scratch = tempfile.mkstemp(dir=folder, prefix=name)
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(content)
        Path(scratch).replace(folder / name)  # atomic: other processes may read it
    except OSError:
        return


def _usual_folder() -> Path:
    """Return the cache folder of dolfinx."""
    from dolfinx.jit import get_options  # takes long to import

    usual, base = Path(get_options()["cache_dir"]), os.environ.get("XDG_CACHE_HOME")
    if base is None or Path(base).is_absolute():
        return usual.absolute()
    if usual == Path(base) / "fenics":
        # The specification of XDG_CACHE_HOME says that an empty or relative one is ignored.
        return Path.home() / ".cache" / "fenics"
    return usual.absolute()


@cache
def _cache_folders(usual: Path) -> tuple[Path, ...]:
    """Return the trusted folders of the cache, the one for new kernels first.

    The second one, if any, is the usual folder. It may be trusted but not writable, as in a
    container image.
    """
    readable = (usual,) if usual.is_dir() and _is_private(usual) else ()
    for folder in _candidate_folders(usual):
        # the usual folder may be for reading by all; a private one is not
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True, mode=0o755 if folder == usual else 0o700)
        is_writable = folder.is_dir() and os.access(folder, os.W_OK)
        if is_writable and _is_private(folder):
            return tuple(dict.fromkeys((folder, *readable)))
    if readable:
        return readable  # has what was compiled before
    raise UnsafeCache(
        f"kernel cache {usual}: others may write to it or own it, and what is in it is executed; "
        "no private folder can be made in its place: set XDG_CACHE_HOME to a folder that you own "
        "and nobody else may write (chmod go-w)"
    )


def _candidate_folders(usual: Path) -> Iterator[Path]:
    """Iterate over folders for new kernels: the usual one, one in it, and private ones."""
    user = os.getuid()
    yield usual
    yield usual / f"user_{user}"
    with suppress(RuntimeError):  # no home
        yield Path.home() / ".cache" / "magshell"
    yield Path(tempfile.gettempdir()) / f"magshell_{user}"


def _is_private(folder: Path) -> bool:
    """Return whether only the user and root may change a folder's content or replace the folder."""
    folder = folder.resolve()
    status = folder.stat()
    if status.st_uid not in (0, os.getuid()) or _writable_by_others(status):
        return False
    return all(_protects_content(parent.stat()) for parent in folder.parents)


def _protects_content(status: os.stat_result) -> bool:
    """Return whether others cannot move our folders out of the folder with this status.

    They cannot if they may not write to it, or if it is sticky.
    """
    owned = status.st_uid in (0, os.getuid(), *_unmapped_users())
    if not owned:
        return False
    is_sticky = bool(status.st_mode & stat.S_ISVTX)
    return is_sticky or not _writable_by_others(status)


def _writable_by_others(status: os.stat_result) -> bool:
    """Return whether users other than the owner may write to a file or folder."""
    by_group = status.st_mode & stat.S_IWGRP and not _is_private_group(status.st_gid)
    return bool(status.st_mode & stat.S_IWOTH or by_group)


@cache
def _is_private_group(number: int) -> bool:
    """Return whether the user is a group's only member; many systems make such groups."""
    try:
        group, user = grp.getgrgid(number), pwd.getpwuid(os.getuid())
    except KeyError:
        return False
    return group.gr_name == user.pw_name and {*group.gr_mem} <= {user.pw_name}


@cache
def _unmapped_users() -> tuple[int, ...]:
    """Return the number that root seems to have in a container with this user alone.

    Empty where root is itself, or the number is not known.
    """
    try:
        lines = Path("/proc/self/uid_map").read_text(encoding="utf-8").splitlines()
        if any(line.split()[0] == "0" for line in lines):
            return ()  # root is itself
        return (int(Path("/proc/sys/kernel/overflowuid").read_text(encoding="utf-8")),)
    except (OSError, ValueError, IndexError):
        return ()
