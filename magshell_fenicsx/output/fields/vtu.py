"""Fields for ParaView: a .vtu file with curved triangles per point, and a .pvd list; pictures read them back."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.fields.outlines import read_outlines, vtp_content
from magshell_fenicsx.output.fields.surface import (
    LAGRANGE_HEXAHEDRON,
    LAGRANGE_TRIANGLE,
    TRIANGLE,
    Surface,
    completed,
)
from magshell_fenicsx.output.store.durable import Damaged, write_whole

if TYPE_CHECKING:  # VTK takes long to import
    from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid

Array = NDArray[np.float64]
SYMMETRIC = ([0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2])  # VTK's order of a symmetric tensor: XX, YY, ZZ, XY, YZ, XZ
FULL = [[0, 3, 5], [3, 1, 4], [5, 4, 2]]  # from VTK's order to (3, 3)
JUMPS = ("moment_jump", "strain_jump")
OWN_DATA = ("u_over_h", "w_over_h", "r0", "n0")


@dataclass(frozen=True)
class About:
    """Data of a shell that pictures need besides the nodes; every file has them.

    Attributes
    ----------
    h
        Thickness over R.
    nu
        Poisson's ratio.
    mirror
        Unit normal (3,) of the mirror plane of a half shell, then its offset if that is not zero; None for a whole one.
    """

    h: float
    nu: float
    mirror: Array | None = None


def unstructured_grid(surface: Surface, h: float) -> "vtkUnstructuredGrid":
    """The deformed surface or body with u/h, w/h, r0, n0 and its fields at the nodes; lengths are over R.

    It is built without pyvista, which takes longer to import than all fields of a path to write.
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid

    points, cells, grid = vtkPoints(), vtkCellArray(), vtkUnstructuredGrid()
    points.SetData(numpy_to_vtk(surface.r0 + surface.u, deep=True))
    number, count = surface.cells.shape
    starts, nodes = np.arange(0, (number + 1) * count, count), surface.cells.ravel()
    cells.SetData(*(numpy_to_vtk(array.astype(np.int64), deep=True) for array in (starts, nodes)))
    grid.SetPoints(points)
    grid.SetCells(TRIANGLE if count == 3 else LAGRANGE_HEXAHEDRON if surface.is_body else LAGRANGE_TRIANGLE, cells)
    own = (surface.u / h, surface.w / h, surface.r0, surface.n0)
    fields = {name: f if f.ndim < 3 else f[:, *SYMMETRIC] for name, f in surface.fields.items()}
    for name, values in {**dict(zip(OWN_DATA, own, strict=True)), **fields}.items():
        _give(grid.GetPointData(), name, values)
    return grid


def _give(to: Any, name: str, values: NDArray[Any]) -> None:
    """Add an array to VTK's data of points, or of a file."""
    from vtkmodules.util.numpy_support import numpy_to_vtk

    array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
    array.SetName(name)
    to.AddArray(array)


def read_vtu(file: Path) -> tuple[Surface, About]:
    """Read a file of `FieldSeries` or `write_mode`.

    Raises
    ------
    CaseError
        If an earlier version wrote it, without the data of `About`, or it is damaged.
    """
    from vtkmodules.vtkCommonCore import vtkObject
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

    if not is_whole(file):
        raise Damaged(f"{file}: is damaged: {'it is cut off' if file.exists() else 'it is missing'}")
    errors, reader, shown = list[str](), vtkXMLUnstructuredGridReader(), vtkObject.GetGlobalWarningDisplay()
    reader.AddObserver("ErrorEvent", lambda _, event: errors.append(event))
    reader.SetFileName(str(file))
    vtkObject.GlobalWarningDisplayOff()  # the message follows
    try:
        reader.Update()
        found = _surface(reader.GetOutput(), file)
    except (KeyError, ValueError, IndexError, TypeError, AttributeError) as e:
        raise Damaged(f"{file}: is damaged: {type(e).__name__}: {e}") from None
    finally:
        vtkObject.SetGlobalWarningDisplay(shown)
    if errors or reader.GetErrorCode():
        raise Damaged(f"{file}: is damaged: VTK cannot read it")
    return found


def is_whole(file: Path) -> bool:
    """Whether there is a file of VTK in XML with its beginning and its end."""
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        head, size = stream.read(200), stream.seek(0, os.SEEK_END)
        stream.seek(max(size - 40, 0))
        return b"<VTKFile" in head and stream.read().rstrip().endswith(b"</VTKFile>")


def _surface(grid: "vtkUnstructuredGrid", file: Path) -> tuple[Surface, About]:
    """What a grid of `unstructured_grid` has; whatever is raised, it is none."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    def arrays(of: Any) -> dict[str, Array]:
        return {of.GetArrayName(i): vtk_to_numpy(of.GetArray(i)) for i in range(of.GetNumberOfArrays())}

    cells = vtk_to_numpy(grid.GetCells().GetConnectivityArray()).reshape(grid.GetNumberOfCells(), -1)
    data, numbers = arrays(grid.GetPointData()), arrays(grid.GetFieldData())
    fields = {name: f[:, FULL] if f.shape[1:] == (6,) else f for name, f in data.items() if name not in OWN_DATA}
    if "h_over_R" not in numbers:
        raise CaseError(f"{file} is of an earlier version: run the case again")
    about = About(float(numbers["h_over_R"][0]), float(numbers["poisson_ratio"][0]), numbers.get("mirror"))
    r0, u, n0 = (data[name] for name in ("r0", "u_over_h", "n0"))
    if (
        {r0.shape, u.shape, n0.shape} != {(len(r0), 3)}
        or not cells.size
        or not 0 <= cells.min() <= cells.max() < len(r0)
    ):
        raise ValueError("its cells have no nodes")
    if not all(np.isfinite(values).all() for values in (r0, u, n0)):
        raise ValueError("a node is nowhere")
    jumps = (float(numbers[name][0]) if name in numbers else None for name in JUMPS)
    return Surface(r0, u * about.h, n0, cells, fields, (), *jumps), about


class FieldSeries:
    """Writes `point_NNNN.vtu` files and updates `path.pvd` after each; continues after an interrupted run.

    Parameters
    ----------
    outlines
        Name of a point's file with the outlines of sources and bodies, of its number; empty without.

    Attributes
    ----------
    kept
        Number of leading points whose files are whole.
    """

    def __init__(self, folder: Path, about: About, outlines: str = "") -> None:
        self._folder, self._about, self._outlines = folder, about, outlines
        folder.mkdir(exist_ok=True)
        self.kept = 0
        while all(map(is_whole, self._files(self.kept))):
            self.kept += 1
        self._numbers = list(range(self.kept))
        if self.kept:
            self._write_list()

    def write(self, number: int, surface: Surface) -> None:
        """Write a point's file.

        Raises
        ------
        OSError
            If the disk is full; the file is not written then.
        """
        if self._outlines:
            write_whole(self._folder / self._outlines.format(number), vtp_content(surface.outlines, surface.solids))
        write_whole(self._folder / point_file(number), vtu_content(surface, self._about))
        self._numbers.append(number)
        self._write_list()

    def _files(self, number: int) -> list[Path]:
        """The files of a point."""
        names = [point_file(number), *([self._outlines.format(number)] if self._outlines else [])]
        return [self._folder / name for name in names]

    def _write_list(self) -> None:
        files = [(n, 0, point_file(n)) for n in self._numbers]
        files += [(n, 1, self._outlines.format(n)) for n in self._numbers if self._outlines]
        rows = "\n".join(f'    <DataSet timestep="{n}" part="{part}" file="{file}"/>' for n, part, file in files)
        content = (
            '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
            f"{rows}\n  </Collection>\n</VTKFile>\n"
        )
        write_whole(self._folder / "path.pvd", content.encode())


def point_file(number: int) -> str:
    """The name of a point's file."""
    return f"point_{number:04d}.vtu"


def vtu_content(surface: Surface, about: About) -> bytes:
    """The content of a .vtu file; VTK's own writer would ignore a full disk.

    LZ4 compression costs almost no time; zlib takes ten times as long and saves only a tenth more on curved surfaces.
    """
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    grid = unstructured_grid(surface, about.h)
    numbers = {"h_over_R": np.array([about.h]), "poisson_ratio": np.array([about.nu]), "mirror": about.mirror}
    jumps = zip(JUMPS, (surface.jump, surface.strain_jump), strict=True)
    numbers |= {name: None if jump is None else np.array([jump]) for name, jump in jumps}
    for name, values in numbers.items():
        if values is not None:
            _give(grid.GetFieldData(), name, values)
    writer = vtkXMLUnstructuredGridWriter()
    writer.SetInputData(grid)
    writer.SetDataModeToAppended()
    writer.EncodeAppendedDataOff()
    writer.SetCompressorTypeToLZ4()
    writer.WriteToOutputStringOn()
    writer.Write()
    content: bytes | str = writer.GetOutputString()  # VTK returns text if the bytes are valid UTF-8
    return content if isinstance(content, bytes) else content.encode()


def read_point(folder: Path, number: int) -> tuple[Surface, About]:
    """The surface of a point in a folder of fields, with the outlines beside it; a half shell is completed."""
    surface, about = read_vtu(folder / point_file(number))
    lines, solids = read_outlines(folder, number)
    surface = replace(surface, outlines=lines, solids=solids)
    return surface if about.mirror is None else completed(surface, about.mirror), about
