"""The script that sets up the environment, where links are in the way, and where nothing can be
had.
"""

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from conftest import CASES

TOP = CASES.parent
TOOLS = (  # all that a machine without anything has
    "bash cat cksum echo cp cut dirname env find flock getconf grep head id mkdir mktemp mv "
    "readlink rm sed tail touch"
    " tr uname xargs"
)
ARGUMENTS = "#!/bin/sh\nprintf '%s\\n' \"$@\"\n"
FAILS = "#!/bin/sh\nexit 1\n"


def program(file: Path, text: str) -> None:
    file.write_text(text, encoding="utf-8")
    file.chmod(0o755)


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """A repository's scripts on a machine with a shell alone, whose Python is too old."""
    (tmp_path / "bin").mkdir()
    for name in TOOLS.split():
        found = shutil.which(name)
        assert found, name
        (tmp_path / "bin" / name).symlink_to(found)
    program(tmp_path / "bin/python3", FAILS)
    (tmp_path / "top").mkdir()
    shutil.copytree(TOP / ".ci", tmp_path / "top/.ci")
    for name in ("Dockerfile", "pyproject.toml"):
        shutil.copy(TOP / name, tmp_path / "top")
    return tmp_path


def in_env(bare: Path, **told: str) -> subprocess.CompletedProcess[str]:
    """Run `.ci/in-env true` there."""
    environment = {"PATH": str(bare / "bin"), "HOME": str(bare), "TMPDIR": str(bare), **told}
    command = [bare / "top/.ci/in-env", "true"]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


@pytest.mark.parametrize(
    ("root", "said"), [("", "Debian 13 and root, or Docker"), ("pypi", "Python 3.12 or newer")]
)
def test_where_nothing_can_be_had(bare: Path, root: str, said: str) -> None:
    """One message, exit code 2."""
    done = in_env(bare, ROOT=root)
    assert done.returncode == 2
    assert done.stderr.startswith("in-env: cannot build the environment: ")
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_link_to_nothing(bare: Path) -> None:
    (bare / "top/.env").symlink_to(bare / "nowhere")
    done = in_env(bare)
    assert (done.returncode, done.stderr) == (
        2,
        f"in-env: .env is a link to {bare}/nowhere, which is no folder\n",
    )


def test_a_root_on_another_disk(bare: Path) -> None:
    """No place within the root is named through a link: bubblewrap could not make it there."""
    disk, home = bare / "disk", bare / "elsewhere"
    (disk / "root/etc").mkdir(parents=True)
    home.mkdir()
    (bare / "top/.env").symlink_to(disk)
    (bare / "home").symlink_to(home)
    done = in_env(bare)  # which says what the stamp is not
    packages = (TOP / ".ci/packages.txt").read_text(encoding="utf-8").splitlines()
    listed = " ".join(
        line.partition("#")[0].strip() for line in packages if line.partition("#")[0].strip()
    )
    stamp = subprocess.run(
        ["cksum"], input=listed, capture_output=True, text=True, check=True
    ).stdout
    (disk / "root/etc/magshell-packages").write_text(
        "-".join(stamp.split()) + "\n", encoding="utf-8"
    )
    pypi = subprocess.run(
        ["cksum"], input=(TOP / ".ci/pypi.txt").read_bytes(), capture_output=True, check=True
    ).stdout
    (disk / f"pypi-{'-'.join(pypi.decode().split())}").mkdir()
    program(bare / "bin/bwrap", ARGUMENTS)
    done = in_env(bare, HOME=str(bare / "home"))
    assert done.returncode == 0, done.stderr
    words = done.stdout.splitlines()
    bound = [words[i + 2] for i, word in enumerate(words) if word == "--bind"]
    assert str(disk / "cache") in bound
    assert str(home) in bound
    deeper = [place for place in bound if place.count("/") > 1]
    assert deeper == [os.path.realpath(place) for place in deeper]
