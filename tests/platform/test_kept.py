"""What is kept beside the kernels."""

from pathlib import Path

import pytest

from magshell_fenicsx.platform import kept


def test_what_is_kept_is_recalled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "kernel_cache", lambda: tmp_path / "new")
    assert kept.recall("name") is None
    kept.keep("name", b"content")
    kept.keep("name", b"later")
    assert kept.recall("name") == b"later"
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["name"]


def test_without_a_folder_nothing_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(kept, "kernel_cache", lambda: tmp_path / "file")
    kept.keep("name", b"content")
    assert kept.recall("name") is None
