"""Files that grow: what is lost when the power or the disk fails."""

import errno
import os
from pathlib import Path

import pytest

from magshell_fenicsx.output.store import durable


def test_the_disk_is_waited_for_now_and_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the first piece, a second later and at the end; each piece is in the file at once, as a
    kill leaves it.
    """
    lengths, clock = list[int](), [0.0]
    monkeypatch.setattr(os, "fsync", lambda number: lengths.append(os.fstat(number).st_size))
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    file = durable.AppendedFile(tmp_path / "file")
    for now in (0.0, 0.4, 0.9, 1.1, 1.2):
        clock[0] = now
        file.append(b"piece")
    assert (tmp_path / "file").read_bytes() == 5 * b"piece"
    file.close()
    assert lengths == [5, 20, 25]


def test_a_disk_that_fails_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was written since the last wait may be lost: the file ends where it is known to be
    whole.
    """

    def full(number: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    clock = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    file = durable.AppendedFile(tmp_path / "file")
    file.append(b"first")
    file.append(b"second")
    clock[0] = 2.0
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as failure:
        file.append(b"third")
    assert failure.value.filename == str(tmp_path / "file")
    assert (tmp_path / "file").read_bytes() == b"first"
