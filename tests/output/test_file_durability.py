"""Files that grow: what is lost when the power or the disk fails."""

import errno
import os
from pathlib import Path

import pytest

from magshell_fenicsx.output.store import durable
from magshell_fenicsx.output.store.table import write_csv


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


def test_two_writers_of_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One begins and ends while the other writes: each file is whole, the last one stays."""
    file, append, seen = tmp_path / "table.csv", durable.AppendedFile.append, list[bytes]()

    def interleaved(stream: durable.AppendedFile, content: bytes, *, waits: bool = True) -> None:
        append(stream, content[:3], waits=waits)
        if not seen:
            seen.append(b"")
            durable.write_whole(file, b"of another job")
            seen.append(file.read_bytes())
        append(stream, content[3:], waits=waits)

    monkeypatch.setattr(durable.AppendedFile, "append", interleaved)
    durable.write_whole(file, b"of this job")
    assert (seen[1], file.read_bytes()) == (b"of another job", b"of this job")
    assert [each.name for each in tmp_path.iterdir()] == ["table.csv"]


def test_a_table_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaves the one before as it was."""
    write_csv([{"a": 1}], ["a"], tmp_path / "table.csv")

    def full(number: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as failure:
        write_csv([{"a": 2}], ["a"], tmp_path / "table.csv")
    assert failure.value.filename == str(tmp_path / "table.csv")
    assert (tmp_path / "table.csv").read_text(encoding="utf-8") == "a\n1\n"
    assert [each.name for each in tmp_path.iterdir()] == ["table.csv"]


def test_errors_of_content_are_damage(tmp_path: Path) -> None:
    """With the file's name and the kind of error, once; other errors are bugs."""
    file = tmp_path / "a.json"
    with (
        pytest.raises(durable.Damaged, match=r"inner: is damaged: KeyError: 'rows'$"),
        durable.errors_as_damage(file),
        durable.errors_as_damage(tmp_path / "inner"),
    ):
        {}["rows"]
    with pytest.raises(ZeroDivisionError), durable.errors_as_damage(file):
        1 / 0  # noqa: B018
