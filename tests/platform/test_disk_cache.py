"""Where kernels and what is kept beside them come from: nobody else may have put it there."""

import os
from pathlib import Path

import pytest
from command import started

from magshell_fenicsx.platform import disk_cache


def test_what_is_kept_is_recalled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk_cache, "cache_folder", lambda: tmp_path / "new")
    assert disk_cache.load_cached("name") is None
    disk_cache.save_cached("name", b"content")
    disk_cache.save_cached("name", b"later")
    assert disk_cache.load_cached("name") == b"later"
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["name"]


def test_without_a_folder_nothing_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(disk_cache, "cache_folder", lambda: tmp_path / "file")
    disk_cache.save_cached("name", b"content")
    assert disk_cache.load_cached("name") is None


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home and a folder for temporary files that are the user's own."""
    (tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(disk_cache.tempfile, "gettempdir", lambda: str(tmp_path / "home"))
    return tmp_path / "home"


def folder(path: Path, mode: int) -> Path:
    path.mkdir(parents=True)
    path.chmod(mode)
    return path


def test_folders_of_kernels(tmp_path: Path, home: Path) -> None:
    """One's own is used; beside others only a private one in a sticky folder; else one at home."""
    own = home / ".cache" / "magshell"
    assert disk_cache._cache_folders(tmp_path / "new") == (tmp_path / "new",)
    assert disk_cache._cache_folders(folder(tmp_path / "own", 0o755)) == (tmp_path / "own",)
    sticky = folder(tmp_path / "sticky", 0o1777)
    assert disk_cache._cache_folders(sticky) == (sticky / f"user_{os.getuid()}",)
    assert (sticky / f"user_{os.getuid()}").stat().st_mode & 0o777 == 0o700
    assert disk_cache._cache_folders(sticky / "fenics") == (
        sticky / "fenics",
    )  # nobody can move it away
    assert disk_cache._cache_folders(folder(tmp_path / "open", 0o777)) == (own,)
    assert disk_cache._cache_folders(tmp_path / "open" / "fenics") == (own,)
    (tmp_path / "link").symlink_to(tmp_path / "open")
    assert disk_cache._cache_folders(tmp_path / "link") == (own,)


@pytest.mark.skipif(os.getuid() != 0, reason="only root gives files away")
def test_folders_of_others(tmp_path: Path, home: Path) -> None:
    """Nothing in them is taken, nor a private folder that another user has made before."""
    foreign, sticky = folder(tmp_path / "foreign", 0o755), folder(tmp_path / "sticky", 0o1777)
    os.chown(foreign, 12345, 12345)
    assert disk_cache._cache_folders(foreign) == (home / ".cache" / "magshell",)
    os.chown(folder(sticky / "user_0", 0o700), 12345, 12345)
    assert disk_cache._cache_folders(sticky) == (home / ".cache" / "magshell",)
    file = foreign / "libffcx.so"
    file.touch(0o644)
    assert disk_cache.is_trusted(file)
    os.chown(file, 12345, 12345)
    assert not disk_cache.is_trusted(file)


@pytest.mark.skipif(os.getuid() != 0, reason="root owns the image")
def test_an_image_is_read_by_any_user(
    tmp_path: Path, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kernels of root's that nobody else may write are taken; new ones go to a private folder."""
    image, own = folder(tmp_path / "image", 0o755), home / ".cache" / "magshell"
    (image / "kernel").write_bytes(b"compiled")
    monkeypatch.setattr(disk_cache, "_usual_folder", lambda: image)
    monkeypatch.setattr(disk_cache.os, "getuid", lambda: 12345)
    monkeypatch.setattr(disk_cache.os, "access", lambda path, how: path != image)
    monkeypatch.setattr(disk_cache, "_candidate_folders", lambda usual: iter([usual, own]))
    assert disk_cache._cache_folders(image) == (own, image)
    assert disk_cache.load_cached("kernel") == b"compiled"
    assert disk_cache.cached_file("kernel") == image / "kernel"
    disk_cache.save_cached("another", b"new")
    assert (own / "another").read_bytes() == b"new"


def test_a_kernel_that_others_may_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not loaded."""
    monkeypatch.setattr(disk_cache, "_usual_folder", lambda: tmp_path / "cache")
    made = folder(tmp_path / "cache", 0o755)
    (made / "libmagshell.so").touch()
    assert disk_cache.cached_file("libmagshell.so") == made / "libmagshell.so"
    (made / "libmagshell.so").chmod(0o666)
    assert disk_cache.cached_file("libmagshell.so") is None


def test_no_private_folder_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One message that says what to do."""
    shared = folder(tmp_path / "shared", 0o777)
    for name in ("XDG_CACHE_HOME", "HOME", "TMPDIR"):
        monkeypatch.setenv(name, str(shared))
    done = started("info")
    assert done.returncode == 2
    assert done.stderr.startswith(
        f"kernel cache {shared}/fenics: others may write to it or own it, "
    )
    assert done.stderr.endswith(
        "set XDG_CACHE_HOME to a folder that you own and nobody else may write (chmod go-w)\n"
    )


@pytest.mark.parametrize("base", ["", "relative"])
def test_relative_base(base: str, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """XDG base directories: what is empty or relative is ignored."""
    monkeypatch.setenv("XDG_CACHE_HOME", base)
    monkeypatch.setattr("dolfinx.jit.get_options", lambda: {"cache_dir": Path(base) / "fenics"})
    assert disk_cache._usual_folder() == home / ".cache/fenics"
