"""What takes long to find and is the same for every run: kept in files beside the kernels."""

import os
import tempfile
from pathlib import Path

from dolfinx.jit import get_options


def kernel_cache() -> Path:
    """The folder of the compiled kernels."""
    return Path(get_options()["cache_dir"])


def recall(name: str) -> bytes | None:
    """What is kept under a name, which says what it depends on; None without."""
    try:
        return (kernel_cache() / name).read_bytes()
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
