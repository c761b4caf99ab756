"""A measured imperfection."""

import hashlib
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, PrivateAttr

from magshell_fenicsx.case.imperfections.place import ImperfectionSection


class FileSection(ImperfectionSection):
    """May read a file; its path is from the folder of the case."""

    file: str | None = None
    """From the folder of the case"""

    _folder: Path = PrivateAttr(default_factory=Path)

    def model_post_init(self, context: Any, /) -> None:
        self._folder = Path((context or {}).get("folder", "")).absolute()

    @property
    def path(self) -> Path:
        """Where the file is."""
        return self._folder / (self.file or "")

    @cached_property
    def digest(self) -> str | None:
        """Hash of the file's content; None if it cannot be read."""
        try:
            return hashlib.sha256(self.path.read_bytes()).hexdigest()
        except OSError:
            return None


class DataSection(FileSection):
    """w0 measured at places of the surface, scattered or on a grid, with noise and holes; a smooth function fits it.

    Columns of the file: x, y, z, w0; or polar, azimuth, w0 (spheres); or azimuth, z, w0 (cylinders), angles in
    degrees; or x, y, z of the real surface. A header such as x [mm], w0 [um] has units; without one, places are in
    the shell's length and w0 is over h.
    """

    kind: Literal["data"]
    file: str
    """CSV with a header or .npz, its path from the folder of the case"""
    amplitude: float = Field(default=1.0, ge=-1e3, le=1e3)
    """Factor of w0"""
    noise: float | None = Field(default=None, ge=0, le=50)
    """Standard deviation of the noise in w0; 0: w0 is exact; estimated by default [h]"""

    def account(self) -> str:
        return f"data of {self.file}"
