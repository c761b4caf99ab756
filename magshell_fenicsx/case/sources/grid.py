"""A field that is known on a grid."""

from typing import Literal

from magshell_fenicsx.input.file import FileKeys
from magshell_fenicsx.parts.magnetism.sources.source import SourceSection


class GridSection(FileKeys, SourceSection):
    """A measured or computed flux density on a rectilinear grid, between whose points a C² cubic spline runs.

    A table with the columns x, y, z, Bx, By, Bz in any order (.csv with a header, or arrays of these names in .npz),
    each perhaps with a unit as in x [mm], Bx [mT], by default m and T; or a VTK file (.vtk, .vti, .vtr, .vts) with a
    vector named B, in m and T. At least four places along each axis. Places are those of its own axes.
    """

    kind: Literal["grid"]
    file: str
    """Its path from the folder of the case"""

    def words(self) -> str:
        return f"grid of {self.file}"
