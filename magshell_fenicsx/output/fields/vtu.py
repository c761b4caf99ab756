"""Fields for ParaView: a .vtu file with curved cells for each point, and a .pvd list of the points.

Pictures read these files back. A point is an equilibrium of a path, numbered along it; its row is
the line of path.csv with its numbers. A .vtu file has data of the nodes (VTK's point data) and of
the file as a whole (VTK's field data). A grid is a plane or a box outside the shell with the
magnetic field, as its own file map_NAME_NNNN.vtu. h and R are thickness and reference length;
lengths in the files are over R.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from itertools import pairwise
from math import isnan, nan
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.fields.contact_peak import ContactPeak
from magshell_fenicsx.output.fields.outlines import read_outlines, vtp_content
from magshell_fenicsx.output.fields.surface import (
    LAGRANGE_HEXAHEDRON,
    LAGRANGE_TRIANGLE,
    TRIANGLE,
    Surface,
    completed,
)
from magshell_fenicsx.output.store.durable import damage, errors_as_damage, write_whole
from magshell_fenicsx.output.store.table import read_rows
from magshell_fenicsx.parts.magnetism.fields import FIELD
from magshell_fenicsx.quantities.registry import amplitude, quantity, shown_quantity
from magshell_fenicsx.quantities.stresses import LAYERS

if TYPE_CHECKING:  # VTK takes long to import
    from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid

Array = NDArray[np.float64]
Read = TypeVar("Read")
# VTK's order of a symmetric tensor: XX, YY, ZZ, XY, YZ, XZ
VTK_TENSOR_INDICES = ([0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2])
VTK_TENSOR_POSITIONS = [[0, 3, 5], [3, 1, 4], [5, 4, 2]]  # from VTK's order to (3, 3)
JUMPS = ("moment_jump", "strain_jump")
PEAK = "contact_peak"  # the fields of a `ContactPeak`, in their order
PEAK_NUMBERS = 5  # of these, before `is_median`
SHELLS = "shells"  # names of the shells, in the order of the numbers in `shell`
DATA_OF_SURFACE = ("u", "u_over_h", "w_over_h", "r0", "n0")
STRENGTH = quantity(FIELD.column).ascii_symbol  # of the applied field
UNITS = {  # of the arrays, for those who open the files in other programs
    **dict.fromkeys(("points", "u", "r0"), "R"),
    **dict.fromkeys(("u_over_h", "w_over_h", "w0_over_h", "gap_over_h"), "h"),
    **dict.fromkeys(("n0", "E", "E_1", "E_2", "E_total"), "1"),
    **dict.fromkeys(("M", "M_1", "M_2"), "D/R"),
    **dict.fromkeys(("p_mag", "f_mag"), f"E {STRENGTH}"),
    **dict.fromkeys(("k", "tau"), f"h E {STRENGTH}"),
    "N": "E h",
    **dict.fromkeys((f"{name}_{layer}" for layer in LAYERS for name in ("stress", "mises")), "E"),
    "Br": "largest remanence",
    "Ba": "mu0 E / largest remanence",
    "contact_pressure": "E h/R",
}
TIME_INCREMENT = 1e-9  # between points of one time, in units of the time


@dataclass(frozen=True)
class ShellData:
    """Data of a shell that pictures need besides the nodes; every .vtu file has them.

    Attributes
    ----------
    h
        Thickness over R.
    nu
        Poisson's ratio.
    mirror
        Mirror plane of a half shell: its unit normal (3,), followed by its offset over R unless
        that is zero. None for a whole shell.
    R
        In metres; nan for a case without units.
    """

    h: float
    nu: float
    mirror: Array | None = None
    R: float = nan


def unstructured_grid(
    surface: Surface, h: float, *, deformed: bool = False
) -> "vtkUnstructuredGrid":
    """Return a surface or body as VTK's grid, with u, u/h, w/h, r0, n0 and fields at the nodes.

    Lengths are over R. The grid is built without pyvista, which takes longer to import than all
    fields of a path take to write.

    Parameters
    ----------
    h
        Thickness over R.
    deformed
        Whether the points of the grid are the deformed ones. Undeformed points are deformed to
        scale by warping with the vector `u`.
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid

    points, cells, grid = vtkPoints(), vtkCellArray(), vtkUnstructuredGrid()
    # deep copies: VTK must not refer to memory that numpy frees
    points.SetData(numpy_to_vtk(surface.r0 + surface.u if deformed else surface.r0, deep=True))
    cell_count, nodes_per_cell = surface.cells.shape
    # VTK's cells: where each begins in one list of nodes, and that list
    cell_starts = np.arange(0, (cell_count + 1) * nodes_per_cell, nodes_per_cell)
    nodes = surface.cells.ravel()
    cells.SetData(
        *(numpy_to_vtk(array.astype(np.int64), deep=True) for array in (cell_starts, nodes))
    )
    grid.SetPoints(points)
    cell_type = LAGRANGE_HEXAHEDRON if surface.is_body else LAGRANGE_TRIANGLE
    grid.SetCells(TRIANGLE if nodes_per_cell == 3 else cell_type, cells)
    # arrays of the nodes: those that every surface has, then its fields. Of a tensor the six
    # different components are stored
    values_of_surface = (surface.u, surface.u / h, surface.w / h, surface.r0, surface.n0)
    data_of_surface = dict(zip(DATA_OF_SURFACE, values_of_surface, strict=True))
    fields = {
        name: values if values.ndim < 3 else values[:, *VTK_TENSOR_INDICES]
        for name, values in surface.fields.items()
    }
    for name, values in {**data_of_surface, **fields}.items():
        add_array(grid.GetPointData(), name, values)
    return grid


def add_array(vtk_data: Any, name: str, values: NDArray[Any]) -> None:
    """Add a named array (n,) or (n, k) to VTK's data of points, or to its data of a whole file."""
    from vtkmodules.util.numpy_support import numpy_to_vtk

    array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
    array.SetName(name)
    vtk_data.AddArray(array)


def add_texts(vtk_data: Any, name: str, lines: Sequence[str]) -> None:
    """Add a named list of texts to VTK's data of a whole file."""
    from vtkmodules.vtkCommonCore import vtkStringArray

    text_array = vtkStringArray()
    text_array.SetName(name)
    for line in lines:
        text_array.InsertNextValue(line)
    vtk_data.AddArray(text_array)


def read_vtu(file: Path) -> tuple[Surface, ShellData]:
    """Return the surface and the shell's data from a .vtu file that this module wrote.

    Raises
    ------
    CaseError
        If the file is damaged, or an earlier version wrote it without the data of `ShellData`.
    """
    return read_grid(file, lambda grid: _surface(grid, file))


def read_grid(file: Path, convert: "Callable[[vtkUnstructuredGrid], Read]") -> "Read":
    """Read a .vtu file and return what `convert` makes of its grid.

    Raises
    ------
    Damaged
        If the file is damaged. One of `ERRORS_OF_CONTENT` from `convert` counts as damage.
    """
    from vtkmodules.vtkCommonCore import vtkObject
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

    if not is_whole(file):
        reason = "it is cut off" if file.exists() else "it is missing"
        raise damage(file, reason)
    # VTK reports errors to an observer and goes on; its own messages are switched off meanwhile
    errors, reader = list[str](), vtkXMLUnstructuredGridReader()
    vtk_warnings = vtkObject.GetGlobalWarningDisplay()
    reader.AddObserver("ErrorEvent", lambda _, event: errors.append(event))
    reader.SetFileName(str(file))
    vtkObject.GlobalWarningDisplayOff()
    try:
        with errors_as_damage(file):
            reader.Update()
            content = convert(reader.GetOutput())
    finally:
        vtkObject.SetGlobalWarningDisplay(vtk_warnings)
    if errors or reader.GetErrorCode():
        raise damage(file, "VTK cannot read it")
    return content


def is_whole(file: Path) -> bool:
    """Whether a file is VTK's XML with its beginning and its end, and so not cut off."""
    if not file.is_file():
        return False
    # the first 200 bytes have the opening element, the last 40 the closing one with white space
    with file.open("rb") as stream:
        head, size = stream.read(200), stream.seek(0, os.SEEK_END)
        stream.seek(max(size - 40, 0))
        return b"<VTKFile" in head and stream.read().rstrip().endswith(b"</VTKFile>")


def arrays(vtk_data: Any) -> dict[str, Array]:
    """Return name -> values of the numerical arrays in VTK's data of points, or of a whole file."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    named_arrays = (
        (vtk_data.GetArrayName(i), vtk_data.GetArray(i))
        for i in range(vtk_data.GetNumberOfArrays())
    )
    return {
        name: vtk_to_numpy(array) for name, array in named_arrays if array
    }  # texts are no numbers


def _surface(grid: "vtkUnstructuredGrid", file: Path) -> tuple[Surface, ShellData]:
    """Return the surface and the shell's data in a grid that `unstructured_grid` made.

    Any exception says that the grid is not of that kind; `file` is named in messages.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy

    # fields at the nodes: symmetric tensors, stored with six components, become (3, 3) again
    node_numbers = vtk_to_numpy(grid.GetCells().GetConnectivityArray())
    cells = node_numbers.reshape(grid.GetNumberOfCells(), -1)
    point_arrays, file_arrays = arrays(grid.GetPointData()), arrays(grid.GetFieldData())
    fields = {
        name: f[:, VTK_TENSOR_POSITIONS] if f.shape[1:] == (6,) else f
        for name, f in point_arrays.items()
        if name not in DATA_OF_SURFACE
    }
    if "h_over_R" not in file_arrays:
        raise CaseError(f"{file} is of an earlier version: run the case again")
    # numbers of the whole file, each an array (1,)
    R = float(file_arrays["R_in_m"][0]) if "R_in_m" in file_arrays else nan
    shell_data = ShellData(
        float(file_arrays["h_over_R"][0]),
        float(file_arrays["poisson_ratio"][0]),
        file_arrays.get("mirror"),
        R,
    )
    # the displacement is taken from u over h, which is stored too, and multiplied by h below
    r0, u_over_h, n0 = (point_arrays[name] for name in ("r0", "u_over_h", "n0"))
    _refuse_unfit_nodes(r0, u_over_h, n0, cells)
    moment_jump, strain_jump = (
        float(file_arrays[name][0]) if name in file_arrays else None for name in JUMPS
    )
    surface = Surface(
        r0,
        u_over_h * shell_data.h,
        n0,
        cells,
        fields,
        jump=moment_jump,
        strain_jump=strain_jump,
        shells=_shell_names(grid.GetFieldData()),
        contact_peak=_contact_peak(file_arrays[PEAK]) if PEAK in file_arrays else None,
    )
    return surface, shell_data


def _contact_peak(values: Array) -> ContactPeak:
    """Return the numbers of a contact from those of a file; one of an earlier version has fewer."""
    peak = ContactPeak(*map(float, values[:PEAK_NUMBERS]))
    return replace(peak, is_median=bool(values[PEAK_NUMBERS:].any()))


def _have_nodes(cells: NDArray[Any], count: int) -> bool:
    """Return whether there are cells, and all their node numbers are below the number of nodes."""
    return cells.size > 0 and bool(0 <= cells.min() <= cells.max() < count)


def _refuse_unfit_nodes(r0: Array, u_over_h: Array, n0: Array, cells: NDArray[Any]) -> None:
    """Raise ValueError if nodes are not (n, 3) and finite, or if cells have other node numbers."""
    have_one_shape = {r0.shape, u_over_h.shape, n0.shape} == {(len(r0), 3)}
    if not have_one_shape or not _have_nodes(cells, len(r0)):
        raise ValueError("its cells have no nodes")
    if not all(np.isfinite(values).all() for values in (r0, u_over_h, n0)):
        raise ValueError("a node is nowhere")


def _shell_names(vtk_data: Any) -> tuple[str, ...]:
    """Return the names of the shells in VTK's data of a file; empty if there is one shell."""
    names = vtk_data.GetAbstractArray(SHELLS)
    return tuple(names.GetValue(i) for i in range(names.GetNumberOfValues())) if names else ()


class FieldSeries:
    """Writer of `point_NNNN.vtu` files, which updates the list `path.pvd` after each.

    It continues after an interrupted run.

    Parameters
    ----------
    folder
        Folder of the files; made if it is not there.
    shell_data
        Data of the shell, which each file has.
    outlines
        Name of a point's file with the outlines of sources and bodies, as a format of the point's
        number; empty if there are none.
    rows
        Rows of path.csv of the points that an interrupted run has written.
    grids
        Names of the grids with fields outside the shell; each has files and a list of its own.

    Attributes
    ----------
    complete_points
        Number of points, counted from the first, until a file is missing or cut off.

    The field `_rows` has the rows of path.csv of the complete points.
    """

    def __init__(
        self,
        folder: Path,
        shell_data: ShellData,
        outlines: str = "",
        rows: Sequence[Mapping[str, Any]] = (),
        grids: Sequence[str] = (),
    ) -> None:
        """Count the complete points in the folder, and list them in path.pvd."""
        self._folder, self._shell_data = folder, shell_data
        self._outlines, self._grids = outlines, grids
        folder.mkdir(exist_ok=True)
        self.complete_points = 0
        # all files of points 0, 1, ... until one is missing or cut off
        while all(map(is_whole, self._files(self.complete_points))):
            self.complete_points += 1
        if rows:  # a point without a row will be written again
            self.complete_points = min(self.complete_points, len(rows))
        # without rows of path.csv a row has the number of its point alone
        self._rows: list[Mapping[str, Any]] = list(rows[: self.complete_points]) or [
            {"point": n} for n in range(self.complete_points)
        ]
        if self.complete_points:
            self._write_list()

    def write(
        self,
        number: int,
        surface: Surface,
        row: Mapping[str, Any] | None = None,
        grid_contents: Mapping[str, bytes] = MappingProxyType({}),
    ) -> None:
        """Write the files of a point and update the lists.

        No file waits for the disk, because a resumed run writes lost ones again.

        Parameters
        ----------
        number
            Number of the point.
        row
            The point's row of path.csv; None if only its number is known.
        grid_contents
            Name of a grid outside the shell -> content of its file.

        Raises
        ------
        OSError
            If the disk is full; the file is not written then.
        """
        if self._outlines:
            write_whole(
                self._folder / self._outlines.format(number),
                vtp_content(surface.outlines, surface.solids),
                waits=False,
            )
        for name, content in grid_contents.items():
            write_whole(self._folder / grid_file(name, number), content, waits=False)
        write_whole(
            self._folder / point_file(number), vtu_content(surface, self._shell_data), waits=False
        )
        self._rows.append(row or {"point": number})
        self._write_list()

    def _files(self, number: int) -> list[Path]:
        """Return the paths of all files of point `number`, grids outside the shell included."""
        names = self._files_of_shell(number)
        names += [grid_file(grid, number) for grid in self._grids]
        return [self._folder / name for name in names]

    def _files_of_shell(self, number: int) -> list[str]:
        """Return the names of a point's files of the shell and of the outlines beside it."""
        outlines = [self._outlines.format(number)] if self._outlines else []
        return [point_file(number), *outlines]

    def _write_list(self) -> None:
        """Write the lists of all points for ParaView: path.pvd, and map_NAME.pvd for each grid."""
        numbers = [int(row["point"]) for row in self._rows]
        times = abscissae(self._rows)
        files = [self._files_of_shell(number) for number in numbers]
        write_whole(self._folder / "path.pvd", pvd_content(times, files), waits=False)
        for grid in self._grids:
            content = pvd_content(times, [[grid_file(grid, number)] for number in numbers])
            write_whole(self._folder / f"map_{grid}.pvd", content, waits=False)


def pvd_content(times: Sequence[float], files: Sequence[Sequence[str]]) -> bytes:
    """Return the content of a .pvd file: which files ParaView shows at which time.

    Parameters
    ----------
    times
        Place of each point on ParaView's time axis.
    files
        The files of each point, first that of the shell.
    """
    rows = "\n".join(
        f'    <DataSet timestep="{t!r}" part="{part_number}" file="{file}"/>'
        for t, files_of_point in zip(times, files, strict=True)
        for part_number, file in enumerate(files_of_point)
    )
    return (
        '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
        f"{rows}\n  </Collection>\n</VTKFile>\n"
    ).encode()


def abscissae(rows: Sequence[Mapping[str, Any]]) -> list[float]:
    """Return the places of the points of a path on ParaView's time axis, ascending.

    A run with motions has its time, in s if it has units. Several points may have one time; then
    each is placed 1e-9 after the one before it. Without motions the place is the value of the
    amplitude that varied, in the case's unit. If several amplitudes varied, or the amplitude does
    not rise all the way, it is the number of the point.

    Examples
    --------
    >>> times = enumerate([0.0, 0.0, 0.5])
    >>> abscissae([{"point": i, "time": t, "amplitude": "time"} for i, t in times])
    [0.0, 1e-09, 0.5]
    >>> loads = enumerate([0, 0.2, 0.3])
    >>> pressed = [{"point": i, "p_over_pc": p, "amplitude": "pressure"} for i, p in loads]
    >>> abscissae(pressed), abscissae([*pressed, {**pressed[0], "point": 3}])
    ([0.0, 0.2, 0.3], [0.0, 1.0, 2.0, 3.0])
    """
    numbers = [float(row["point"]) for row in rows]
    amplitudes = {str(row.get("amplitude", "")) for row in rows} - {""}
    if rows and "time" in rows[0]:
        times = list[float]()
        for row in rows:
            t = float(row[shown_quantity("time", row).name])  # the column in s, if there is one
            # ParaView shows one point at a time, so that times must ascend
            times.append(max(t, times[-1] + TIME_INCREMENT) if times else t)
        return times
    if len(amplitudes) != 1:
        return numbers
    (varied_amplitude,) = amplitudes
    # the column of the amplitude, or its column in the case's unit if rows have that
    column = shown_quantity(amplitude(varied_amplitude).column, rows[0]).name
    loads = [float(row[column]) for row in rows]
    rises = all(a < b for a, b in pairwise(loads))
    return loads if rises else numbers


def point_file(number: int) -> str:
    """Return the name of the file with the surface of point `number`."""
    return f"point_{number:04d}.vtu"


def grid_file(name: str, number: int) -> str:
    """Return the name of the file with grid `name` outside the shell, at point `number`."""
    return f"map_{name}_{number:04d}.vtu"


def vtu_content(surface: Surface, shell_data: ShellData) -> bytes:
    """Return the content of the .vtu file of a surface, as bytes that the caller writes.

    VTK's own writer of files would ignore a full disk. Names of units, of shells, and the data of
    `ShellData` are in the file's field data. The content is compressed by LZ4, which costs almost
    no time. zlib takes ten times as long and saves only a tenth more on curved surfaces.
    """
    grid = unstructured_grid(surface, shell_data.h)
    # numbers and vectors of the whole file; what is None is left out
    file_arrays = {
        "h_over_R": np.array([shell_data.h]),
        "poisson_ratio": np.array([shell_data.nu]),
        "mirror": shell_data.mirror,
    }
    jumps = zip(JUMPS, (surface.jump, surface.strain_jump), strict=True)
    file_arrays |= {name: None if jump is None else np.array([jump]) for name, jump in jumps}
    peak = surface.contact_peak
    file_arrays[PEAK] = None if peak is None else np.array(astuple(peak))
    file_arrays |= {"R_in_m": None if isnan(shell_data.R) else np.array([shell_data.R])}
    for name, values in file_arrays.items():
        if values is not None:
            add_array(grid.GetFieldData(), name, values)
    # texts of the whole file: units of the arrays that are there, and names of shells
    point_data = grid.GetPointData()
    array_names = [
        "points",
        *(point_data.GetArrayName(i) for i in range(point_data.GetNumberOfArrays())),
    ]
    texts = {
        "units": [f"{name}: {UNITS[name]}" for name in array_names if name in UNITS],
        SHELLS: surface.shells,
    }
    for name, lines in texts.items():
        if lines or name != SHELLS:  # of one shell there are no names
            add_texts(grid.GetFieldData(), name, lines)
    return content_of(grid)


def content_of(grid: "vtkUnstructuredGrid") -> bytes:
    """Return a grid as the bytes of a .vtu file."""
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    writer = vtkXMLUnstructuredGridWriter()
    writer.SetInputData(grid)
    writer.SetDataModeToAppended()
    writer.EncodeAppendedDataOff()
    writer.SetCompressorTypeToLZ4()
    writer.WriteToOutputStringOn()
    writer.Write()
    content: bytes | str = writer.GetOutputString()  # VTK returns text if the bytes are valid UTF-8
    return content if isinstance(content, bytes) else content.encode()


def read_point(folder: Path, number: int) -> tuple[Surface, ShellData]:
    """Return the surface of a point with its outlines, and the shell's data, from its files.

    A half shell is completed by its mirror image. `ShellData.mirror` still has its plane.
    """
    surface, shell_data = read_vtu(folder / point_file(number))
    lines, solids = read_outlines(folder, number)
    surface = replace(surface, outlines=lines, solids=solids)
    if shell_data.mirror is not None:
        surface = completed(surface, shell_data.mirror)
    return surface, shell_data


def write_whole_shells(folder: Path) -> list[str]:
    """Write `whole_NNNN.vtu` and `whole.pvd` with both halves of a half shell, beside its points.

    Parameters
    ----------
    folder
        Folder of a run.

    Returns
    -------
    The names of the files; an empty list if the shell is whole.

    Raises
    ------
    Damaged
        If a point cannot be read.
    """
    fields, rows, names = folder / "fields", read_rows(folder / "path.csv"), list[str]()
    rows = [row for row in rows if (fields / point_file(int(row["point"]))).exists()]
    for row in rows:
        number = int(row["point"])
        surface, shell_data = read_point(fields, number)
        if shell_data.mirror is None:
            return []
        names.append(f"whole_{number:04d}.vtu")
        write_whole(fields / names[-1], vtu_content(surface, replace(shell_data, mirror=None)))
    write_whole(fields / "whole.pvd", pvd_content(abscissae(rows), [[name] for name in names]))
    return [*names, "whole.pvd"]
