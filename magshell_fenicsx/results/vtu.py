"""Fields for ParaView: one .vtu per saved point, with curved triangles, and a .pvd of all."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magshell_fenicsx.results.durable import write_whole
from magshell_fenicsx.results.surface import LAGRANGE_HEXAHEDRON, LAGRANGE_TRIANGLE, TRIANGLE, Surface

if TYPE_CHECKING:  # VTK takes long to import
    import pyvista


def unstructured_grid(surface: Surface, h: float) -> "pyvista.UnstructuredGrid":
    """The deformed surface or body with u/h, w/h, r0, n0 and the magnetic loads at its nodes; lengths in R."""
    import pyvista

    count = surface.cells.shape[1]
    cells = np.column_stack([np.full(len(surface.cells), count), surface.cells])
    kind = TRIANGLE if count == 3 else LAGRANGE_HEXAHEDRON if surface.is_body else LAGRANGE_TRIANGLE
    kinds = np.full(len(surface.cells), kind, dtype=np.uint8)
    grid = pyvista.UnstructuredGrid(cells.ravel(), kinds, surface.r0 + surface.u)
    grid.point_data["u_over_h"] = surface.u / h
    grid.point_data["w_over_h"] = surface.w / h
    grid.point_data["r0"] = surface.r0
    grid.point_data["n0"] = surface.n0
    for name, values in surface.fields.items():
        grid.point_data[name] = values
    return grid


class FieldSeries:
    """Writes `point_NNNN.vtu` files and keeps `path.pvd` complete after each, also after an interrupted run.

    Attributes
    ----------
    kept
        Number of points from the first on whose files are there.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(exist_ok=True)
        self.kept = 0
        while (folder / _name(self.kept)).exists():
            self.kept += 1
        self._numbers = list(range(self.kept))
        if self.kept:
            self._write_list()

    def write(self, number: int, surface: Surface, h: float) -> None:
        """Write a point's file.

        Raises
        ------
        OSError
            If the disk is full; there is no such file then.
        """
        write_whole(self._folder / _name(number), vtu_content(unstructured_grid(surface, h)))
        self._numbers.append(number)
        self._write_list()

    def _write_list(self) -> None:
        rows = "\n".join(f'    <DataSet timestep="{n}" part="0" file="{_name(n)}"/>' for n in self._numbers)
        content = (
            '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
            f"{rows}\n  </Collection>\n</VTKFile>\n"
        )
        write_whole(self._folder / "path.pvd", content.encode())


def _name(number: int) -> str:
    return f"point_{number:04d}.vtu"


def vtu_content(grid: "pyvista.UnstructuredGrid") -> bytes:
    """The file's content; VTK itself would pass over a full disk.

    Raw, compressed by LZ4, which takes no time: zlib takes ten times as long and saves a tenth more on curved surfaces.
    """
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter  # type: ignore[import-untyped]

    writer = vtkXMLUnstructuredGridWriter()
    writer.SetInputData(grid)
    writer.SetDataModeToAppended()
    writer.EncodeAppendedDataOff()
    writer.SetCompressorTypeToLZ4()
    writer.WriteToOutputStringOn()
    writer.Write()
    content: bytes | str = writer.GetOutputString()  # text, where the bytes happen to be UTF-8
    return content if isinstance(content, bytes) else content.encode()
