"""A measured imperfection."""

from typing import Annotated, Literal

from pydantic import Field

from magshell_fenicsx.input.file import FileKeys
from magshell_fenicsx.parts.imperfections.place import ImperfectionSection
from magshell_fenicsx.parts.imperfections.sized import over


class DataSection(FileKeys, ImperfectionSection):
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
    noise: Annotated[float, over("h")] | None = Field(default=None, ge=0, le=50)
    """Standard deviation of the noise in w0; 0: w0 is exact; estimated by default [h]"""

    def account(self) -> str:
        return f"data of {self.file}"
