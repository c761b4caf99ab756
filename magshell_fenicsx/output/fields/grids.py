"""Fields on grids outside the shell, as .vtu files for ParaView that pictures read back.

A `MapGrid` has a corner, two sides (a plane) or three sides (a box), the numbers of points along
them, and the flux density B at these points. Points are numbered along the first side, then along
the second and the third. R is the reference length; places are over R.
"""

from math import isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.vtu import add_array, add_texts, arrays, content_of, read_grid
from magshell_fenicsx.parts.observables import MapGrid

if TYPE_CHECKING:  # VTK takes long to import
    from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid

Array = NDArray[np.float64]
QUAD, HEXAHEDRON = 9, 12  # VTK's numbers of cell types
TEXT_FIELDS = ("name", "unit", "words")


def grid_content(grid: MapGrid, R: float) -> bytes:
    """Return a grid with the flux density B at its points as the content of a .vtu file.

    Places are over R. `R` is in metres; nan for a case without units.
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid

    points, cells, vtk_grid = vtkPoints(), vtkCellArray(), vtkUnstructuredGrid()
    # deep copies: VTK must not refer to memory that numpy frees
    points.SetData(numpy_to_vtk(np.ascontiguousarray(grid.places), deep=True))
    # VTK's cells: where each begins in one list of corners, and that list
    corners = _cells(grid.points)  # (cells, 4 or 8) numbers of points
    cell_starts = np.arange(0, corners.size + 1, corners.shape[1])
    cells.SetData(
        *(
            numpy_to_vtk(array.astype(np.int64), deep=True)
            for array in (cell_starts, corners.ravel())
        )
    )
    vtk_grid.SetPoints(points)
    vtk_grid.SetCells(QUAD if len(grid.points) == 2 else HEXAHEDRON, cells)
    add_array(vtk_grid.GetPointData(), "B", grid.values)
    file_data = vtk_grid.GetFieldData()
    # what describes the grid: numbers, then texts
    file_arrays = {
        "corner": grid.corner[None],
        "sides": grid.sides,
        "points_along": np.array(grid.points, dtype=float),
    }
    if not isnan(R):
        file_arrays["R_in_m"] = np.array([R])
    for name, values in file_arrays.items():
        add_array(file_data, name, values)
    for name in TEXT_FIELDS:
        add_texts(file_data, name, [str(getattr(grid, name))])
    add_texts(file_data, "units", ["points: R", f"B: {grid.unit}"])
    return content_of(vtk_grid)


def read_map(file: Path) -> tuple[MapGrid, float]:
    """Return the grid in a .vtu file of `grid_content`, and R in metres.

    R is nan for a case without units.

    Raises
    ------
    Damaged
        If the file cannot be read.
    """

    def map_grid(vtk_grid: "vtkUnstructuredGrid") -> tuple[MapGrid, float]:
        """Return the grid and R from VTK's grid."""
        numbers = arrays(vtk_grid.GetFieldData())  # name -> array, of the whole file
        texts = {name: _text(vtk_grid.GetFieldData(), name) for name in TEXT_FIELDS}
        points_per_side = tuple(int(n) for n in numbers["points_along"].ravel())
        values = arrays(vtk_grid.GetPointData())["B"].reshape(int(np.prod(points_per_side)), 3)
        corner, sides = numbers["corner"].reshape(3), numbers["sides"].reshape(-1, 3)
        R = float(numbers["R_in_m"].ravel()[0]) if "R_in_m" in numbers else nan
        return MapGrid(
            texts["name"], corner, sides, points_per_side, texts["unit"], texts["words"], values
        ), R

    return read_grid(file, map_grid)


def _text(data: Any, name: str) -> str:
    """Return the text of a name in VTK's data of a file."""
    return str(data.GetAbstractArray(name).GetValue(0))


def _cells(points: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the corners (cells, 4 or 8) of a grid's cells, in VTK's order.

    `points` are the numbers of points along two or three sides. A cell has two corners along each
    side. The lower corners of all cells are all points but the last one along the side (`low`), the
    upper corners all points but the first one (`high`).
    """
    # the last axis of the array is the first side, whose points are numbered first
    number = np.arange(np.prod(points)).reshape(points[::-1])
    low, high = slice(None, -1), slice(1, None)
    # around a square: slices along the second and the first side
    corners_of_square = [(low, low), (low, high), (high, high), (high, low)]
    if len(points) == 2:
        corners_of_cell = [number[corner] for corner in corners_of_square]
    else:
        layers = low, high
        corners_of_cell = [
            number[layer, *square] for layer in layers for square in corners_of_square
        ]
    return np.stack([corner.ravel() for corner in corners_of_cell], axis=-1)
