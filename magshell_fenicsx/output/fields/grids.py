"""Fields on grids beside the shell, as .vtu files for ParaView that pictures read back."""

from math import isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.vtu import arrays, content_of, give, give_texts, read_grid
from magshell_fenicsx.parts.seen import MapGrid

if TYPE_CHECKING:  # VTK takes long to import
    from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid

Array = NDArray[np.float64]
QUAD, HEXAHEDRON = 9, 12  # VTK's numbers of cell types
NAMED = ("name", "unit", "words")


def grid_content(grid: MapGrid, R: float) -> bytes:
    """The content of a .vtu file with B at a grid's points, which are over R; R is in metres, nan
    without units.
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid

    points, cells, made = vtkPoints(), vtkCellArray(), vtkUnstructuredGrid()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(grid.places), deep=True))
    corners = _cells(grid.points)
    starts = np.arange(0, corners.size + 1, corners.shape[1])
    cells.SetData(
        *(numpy_to_vtk(each.astype(np.int64), deep=True) for each in (starts, corners.ravel()))
    )
    made.SetPoints(points)
    made.SetCells(QUAD if len(grid.points) == 2 else HEXAHEDRON, cells)
    give(made.GetPointData(), "B", grid.values)
    data = made.GetFieldData()
    numbers = {
        "corner": grid.corner[None],
        "sides": grid.sides,
        "points_along": np.array(grid.points, dtype=float),
    }
    for name, values in (numbers | ({} if isnan(R) else {"R_in_m": np.array([R])})).items():
        give(data, name, values)
    for name in NAMED:
        give_texts(data, name, [str(getattr(grid, name))])
    give_texts(data, "units", ["points: R", f"B: {grid.unit}"])
    return content_of(made)


def read_map(file: Path) -> tuple[MapGrid, float]:
    """The grid of a file, and R in metres.

    Raises
    ------
    Damaged
        If it cannot be read.
    """

    def made(read: "vtkUnstructuredGrid") -> tuple[MapGrid, float]:
        numbers, texts = (
            arrays(read.GetFieldData()),
            {name: _text(read.GetFieldData(), name) for name in NAMED},
        )
        along = tuple(int(n) for n in numbers["points_along"].ravel())
        values = arrays(read.GetPointData())["B"].reshape(int(np.prod(along)), 3)
        corner, sides = numbers["corner"].reshape(3), numbers["sides"].reshape(-1, 3)
        R = float(numbers["R_in_m"].ravel()[0]) if "R_in_m" in numbers else nan
        return MapGrid(
            texts["name"], corner, sides, along, texts["unit"], texts["words"], values
        ), R

    return read_grid(file, made)


def _text(data: Any, name: str) -> str:
    return str(data.GetAbstractArray(name).GetValue(0))


def _cells(points: tuple[int, ...]) -> NDArray[np.int64]:
    """(cells, 4 or 8) the corners of a grid's cells, in VTK's order."""
    number = np.arange(np.prod(points)).reshape(points[::-1])
    low, high = slice(None, -1), slice(1, None)
    around = [
        (low, low),
        (low, high),
        (high, high),
        (high, low),
    ]  # of the second and the first side
    if len(points) == 2:
        return np.stack([number[at].ravel() for at in around], axis=-1)
    return np.stack([number[up, *at].ravel() for up in (low, high) for at in around], axis=-1)
