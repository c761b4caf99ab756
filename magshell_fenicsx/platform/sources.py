"""Which code a result comes from: what is kept of one is not taken for a result of another."""

import hashlib
from pathlib import Path

from magshell_fenicsx.platform.version import __version__

SUFFIXES = {".py", ".c", ".html"}


def hashed(folder: Path) -> str:
    """Version and hash of a package's files, wherever it is installed.

    Comments count too: what can change a number is not for a program to say.
    """
    found = hashlib.sha256()
    for file in sorted(folder.rglob("*")):
        if file.suffix in SUFFIXES:
            content = file.read_bytes()
            found.update(f"{file.relative_to(folder).as_posix()} {len(content)}\n".encode() + content)
    return f"{__version__}+{found.hexdigest()[:16]}"


_OURS = hashed(Path(__file__).parents[1])  # at the import, for that is the code that runs, whatever is edited later


def ours() -> str:
    """Of the code that runs, such as 0.1.0+3f2a9c1b2d3e4f50."""
    return _OURS
