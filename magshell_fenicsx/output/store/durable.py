"""Files that stay readable after a kill, a crash or a full disk.

Writing is atomic (`write_whole`) or by complete pieces (`AppendedFile`). A sync waits until the
disk has what the system keeps in memory; without it a power failure may lose what was written, a
kill may not. Reading refuses anything that is no regular file. What cannot be used is `Damaged`,
with one form of message (`damage`).
"""

import csv
import json
import math
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from errno import EFBIG, EINVAL, EISDIR
from pathlib import Path
from typing import Any, BinaryIO
from uuid import uuid4

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.platform.input_files import open_regular, read_bounded

# s between two waits for the disk: on a busy one each takes as long as a point of a small model
SYNC_INTERVAL = 1.0
UNFINISHED = ".unfinished"  # ending of a file that is being written, or that a kill has left
# errors of code that gets another content than the program wrote
ERRORS_OF_CONTENT = (ValueError, KeyError, TypeError, IndexError, AttributeError, csv.Error)


class Damaged(CaseError):
    """Error: a file of results is not what the program wrote; the message names it and says why."""


def damage(file: Path, reason: str, *, may_be_earlier: bool = False) -> Damaged:
    """Return the error that a file of results is damaged, for a reason.

    Parameters
    ----------
    may_be_earlier
        Whether an earlier version may have written such a file.
    """
    if may_be_earlier:
        return Damaged(f"{file}: is damaged, or of an earlier version: {reason}")
    return Damaged(f"{file}: is damaged: {reason}")


@contextmanager
def errors_as_damage(file: Path) -> Iterator[None]:
    """Turn errors within `with`, of code that interprets the content of a file, into `Damaged`."""
    try:
        yield
    except Damaged:
        raise
    except ERRORS_OF_CONTENT as e:
        raise damage(file, f"{type(e).__name__}: {e}") from None


def read_result(file: Path) -> bytes:
    """Return the content of a file of results.

    Raises
    ------
    Damaged
        If it is a folder, a device or a pipe.
    OSError
        If it is not there, or cannot be read.
    """
    try:
        return read_bounded(file)
    except OSError as e:
        raise _error_for(e) from None


def open_result(file: Path) -> BinaryIO:
    """Open a file of results for reading.

    Raises
    ------
    Damaged
        If it is a folder, a device or a pipe.
    OSError
        If it is not there, or cannot be read.
    """
    try:
        return open_regular(file)
    except OSError as e:
        raise _error_for(e) from None


def _error_for(e: OSError) -> Exception:
    """Return the exception to raise for an error of the disk.

    That is `Damaged` where the file is no regular file, which a run does not write; otherwise the
    error itself.
    """
    if e.errno in (EFBIG, EINVAL, EISDIR):
        return damage(e.filename, str(e.strerror))
    return e


def read_object(file: Path) -> dict[str, Any]:
    """Return the JSON object in a file of results.

    Raises
    ------
    Damaged
        If the file has no JSON object, or is a folder, a device or a pipe.
    OSError
        If it is not there, or cannot be read.
    """
    try:
        content = json.loads(read_result(file))
    except (ValueError, RecursionError) as e:
        raise damage(file, f"no JSON: {e}") from None
    if not isinstance(content, dict):
        raise damage(file, "no JSON object")
    return content


def write_object(file: Path, content: Mapping[str, Any], indent: int = 1) -> None:
    """Write a JSON object, so that at every moment the complete old or the new file exists.

    Raises
    ------
    OSError
        With the file's name; the old file is unchanged.
    """
    write_whole(file, (json.dumps(content, indent=indent) + "\n").encode())


def write_whole(file: Path, content: bytes, *, waits: bool = True) -> None:
    """Write a file so that at every moment the complete old or the complete new one exists.

    Several processes may write the same file; the last one counts.

    Parameters
    ----------
    waits
        Whether to wait until the disk has the file. Otherwise a power failure may lose it, which
        suits files that a resumed run writes again.

    Raises
    ------
    OSError
        With the file's name; the old file is unchanged.
    """
    unfinished = file.with_name(f"{file.name}.{uuid4().hex[:8]}{UNFINISHED}")
    try:
        stream = AppendedFile(unfinished, length=0)
        try:
            stream.append(content, waits=waits)
        finally:
            stream.close()
        unfinished.replace(file)
        if waits:
            sync_folder(file.parent)
    except OSError as e:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)
        raise OSError(e.errno, e.strerror, str(file)) from None


def sync_folder(folder: Path) -> None:
    """Wait until the disk has the directory entries of a folder."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


class AppendedFile:
    """File that grows by complete pieces.

    A killed process loses no piece. A power failure may lose the pieces since the last sync with
    the disk. There is a sync at the first piece, at later ones if `SYNC_INTERVAL` seconds have
    passed, and at the end.

    Parameters
    ----------
    file
        The file; it is created if it is not there.
    length
        Number of bytes of an existing file to keep; None keeps all.

    `_length` is the number of bytes of all complete pieces, `_synced_length` that at the last sync,
    and `_last_sync` the time of the last sync.
    """

    def __init__(self, file: Path, length: int | None = None) -> None:
        """Open the file, and cut it off after `length` bytes."""
        self._file = file
        self._stream = file.open("ab", buffering=0)
        self._length = self._stream.seek(0, os.SEEK_END) if length is None else length
        self._stream.truncate(self._length)
        self._last_sync = -math.inf  # s, of the monotonic clock
        self._synced_length = self._length

    def append(self, content: bytes, *, waits: bool = True) -> None:
        """Append a piece to the file.

        Parameters
        ----------
        waits
            Whether to sync with the disk, if `SYNC_INTERVAL` has passed since the last time.

        Raises
        ------
        OSError
            With the file's name. The file is cut to its length before the piece, or to that at the
            last sync if the sync has failed.
        """
        remaining = memoryview(content)
        try:
            while remaining:  # a write may take a part only
                remaining = remaining[self._stream.write(remaining) :]
            if waits and time.monotonic() - self._last_sync >= SYNC_INTERVAL:
                self._sync(self._length + len(content))
        except OSError as e:
            self._stream.truncate(self._length)
            raise OSError(e.errno, e.strerror, str(self._file)) from None
        self._length += len(content)

    def _sync(self, length: int) -> None:
        """Wait until the disk has the file's first `length` bytes.

        If that fails, the pieces since the last sync count as lost.
        """
        try:
            os.fsync(self._stream.fileno())
        except OSError:
            self._length = self._synced_length  # pieces between are lost
            raise
        self._synced_length, self._last_sync = length, time.monotonic()

    def close(self) -> None:
        """Sync the last pieces with the disk, and close the file.

        Raises
        ------
        OSError
            With the file's name.
        """
        try:
            # if there was no sync at all, the caller has never asked to wait
            if self._last_sync > -math.inf and self._synced_length < self._length:
                self._sync(self._length)
        except OSError as e:
            raise OSError(e.errno, e.strerror, str(self._file)) from None
        finally:
            self._stream.close()
