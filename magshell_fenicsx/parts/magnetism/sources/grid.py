"""A field that is known on a rectilinear grid, as a C2 cubic spline.

In goes a file with places and flux densities; out come B and its first and second derivatives at
any place within the grid. An axis is the sorted list of the coordinates of the grid along x, y or
z. Places are in m, B in T.
"""

from itertools import combinations_with_replacement
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.section import FileKeys
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.input.tables import TableError, column_size, read_table
from magshell_fenicsx.parts.magnetism.sources.source import Array, FieldOfSource, SourceSection
from magshell_fenicsx.platform.input_files import Files, read_vtk
from magshell_fenicsx.shape.reference_shell import box_lines

if TYPE_CHECKING:
    import scipy

PLACES, FIELD = ("x", "y", "z"), ("Bx", "By", "Bz")
VTK, DEGREE = (".vtk", ".vti", ".vtr", ".vts"), 3  # endings of VTK files; degree of the spline
PLACE_TOLERANCE = 1e-6  # over the distance between places: rounding of a table
_grids: dict[tuple[Path, str], tuple[list[Array], Array]] = {}  # a run plans its case several times


class GridSection(FileKeys, SourceSection):
    """A measured or computed flux density on a rectilinear grid, between whose points a C² cubic
    spline runs.

    A table with the columns x, y, z, Bx, By, Bz in any order (.csv with a header, or arrays of
    these names in .npz), each perhaps with a unit as in x [mm], Bx [mT], by default m and T; or a
    VTK file (.vtk, .vti, .vtr, .vts) with a vector named B, in m and T. At least four places along
    each axis. Places are those of its own axes.
    """

    kind: Literal["grid"]
    file: str
    """Its path from the folder of the case"""

    def words(self) -> str:
        return f"grid of {self.file}"

    def field(self, key: str, R: float) -> FieldOfSource:
        """Return the field of the spline in the source's own axes, places in m.

        `key` is the source's key in the case file, for messages. R, the unit of formulas, is not
        used.

        Raises
        ------
        CaseError
            If the file is no such grid.
        """
        try:
            axes, B_on_grid = read(self.path, self.digest, self.files)
        except TableError as e:
            raise CaseError(f"{key}.file: {self.file}: {e}") from None
        spline = _spline(axes, B_on_grid)

        def values(x: Array) -> tuple[Array, Array, Array]:
            """Return B at places x (n, 3) with its first and second derivatives."""

            def derivative(*axes_of_derivative: int) -> Array:
                """Return dB (n, 3) by one or more places; their axes are given by number."""
                orders = np.bincount(axes_of_derivative, minlength=3)  # along each axis
                return np.asarray(spline(x, nu=orders))

            B = np.asarray(spline(x))
            G = np.stack([derivative(j) for j in range(3)], axis=-1)
            H = np.empty((len(x), 3, 3, 3))
            # second derivatives are symmetric in the last two axes
            for j, k in combinations_with_replacement(range(3), 2):
                second_derivative = derivative(j, k)
                H[:, :, j, k] = second_derivative
                H[:, :, k, j] = second_derivative
            return B, G, H

        low, high = np.array([axis[0] for axis in axes]), np.array([axis[-1] for axis in axes])
        # beyond the grid the spline is nan
        return FieldOfSource(values, box_lines(low, high), "beyond the grid of")


def _spline(axes: list[Array], values: Array) -> "scipy.interpolate.NdBSpline":
    """Return the tensor-product cubic spline of values (nx, ny, nz, 3) on three axes."""
    import scipy

    knots = []
    for i, axis in enumerate(axes):
        spline = scipy.interpolate.make_interp_spline(axis, values, DEGREE, axis=i)
        knots.append(spline.t)
        # coefficients along one axis are the values for the next
        values = np.moveaxis(spline.c, 0, i)
    return scipy.interpolate.NdBSpline(tuple(knots), values, DEGREE, extrapolate=False)


def read(file: Path, digest: str | None, files: Files) -> tuple[list[Array], Array]:
    """Return the places along each axis in m, and B (nx, ny, nz, 3) in T, of a file.

    Grids are cached; a file is read again if its `digest` has changed, or is None.

    Raises
    ------
    TableError
        If the file cannot be read, or is no rectilinear grid.
    """
    if digest is None or (file, digest) not in _grids:
        if len(_grids) > 3:  # a few grids may fill the memory
            _grids.clear()
        rows = _vtk_rows(file, files) if file.suffix in VTK else _table_rows(file, files)
        _grids[file, digest or ""] = _gridded(*rows)
    return _grids[file, digest or ""]


def _gridded(x: Array, B: Array) -> tuple[list[Array], Array]:
    """Return the places along each axis, and the values (nx, ny, nz, 3), of rows in any order.

    `x` (n, 3) are the places and `B` (n, 3) the values of the rows.

    Raises
    ------
    TableError
        If the places make no rectilinear grid, or have too few along an axis.
    """
    axes = [_places(x[:, i]) for i in range(3)]
    shape = tuple(len(axis) for axis in axes)
    if min(shape) <= DEGREE:
        raise TableError(
            f"has {' x '.join(map(str, shape))} places: a cubic spline needs four along each axis"
        )
    # nan where no row has its place; scattered places have far more nodes of a grid than rows
    values_on_grid = np.full((len(x), 3), np.nan)
    if len(x) == prod(shape):
        # each row goes to the node of the grid nearest to its place
        grid_numbers = tuple(_nearest(axis, x[:, i]) for i, axis in enumerate(axes))
        values_on_grid[np.ravel_multi_index(grid_numbers, shape)] = B
    if not np.isfinite(values_on_grid).all():
        raise TableError(
            f"is no rectilinear grid of finite numbers: {len(x)} rows with "
            f"{' x '.join(map(str, shape))} different places along the axes"
        )
    return axes, values_on_grid.reshape(*shape, 3)


def _table_rows(file: Path, files: Files) -> tuple[Array, Array]:
    """Return places (n, 3) in m and B (n, 3) in T, the rows of a .csv or .npz file.

    Raises
    ------
    TableError
        If a column is missing, or arrays differ in length.
    """
    columns, units = read_table(file, files)
    if missing := [name for name in (*PLACES, *FIELD) if name not in columns]:
        raise TableError(
            f"has no column {', '.join(missing)}; needed are {', '.join((*PLACES, *FIELD))}"
        )
    axes = [columns[name] for name in PLACES]
    # .npz arrays may hold the places along each axis alone, and B on the whole grid
    has_whole_grid = file.suffix == ".npz" and columns["Bx"].ndim == 3
    on_axes = has_whole_grid and {a.ndim for a in axes} == {1}
    if on_axes and columns["Bx"].size == prod(a.size for a in axes):
        columns |= dict(zip(PLACES, np.meshgrid(*axes, indexing="ij"), strict=True))
    rows = [columns[name].ravel() * _size(units[name], name) for name in (*PLACES, *FIELD)]
    if len({len(column) for column in rows}) > 1:
        raise TableError("its arrays have different lengths")
    return np.column_stack(rows[:3]), np.column_stack(rows[3:])


def _size(unit: str | None, name: str) -> float:
    """Return the factor of a column's unit: to m for places, to T for B."""
    base_unit = "metre" if name in PLACES else "tesla"
    return column_size(name, unit or base_unit, base_unit)


def _vtk_rows(file: Path, files: Files) -> tuple[Array, Array]:
    """Return places (n, 3) in m and B (n, 3) in T, the points of a VTK file.

    Raises
    ------
    TableError
        If the file cannot be read, or has no vector B.
    """
    try:
        data = read_vtk(files.content(file), file.suffix)
    except (OSError, ValueError) as e:
        raise TableError(f"cannot be read: {getattr(e, 'strerror', None) or e}") from None
    if "B" not in data.point_data or np.shape(data.point_data["B"]) != (data.n_points, 3):
        raise TableError("has no vector B at its points")
    return np.array(data.points, dtype=float), np.array(data.point_data["B"], dtype=float)


def _places(coordinates: Array) -> Array:
    """Return the different coordinates, sorted; those that differ by rounding are one."""
    distinct = np.unique(coordinates)
    mean_distance = np.ptp(distinct) / len(distinct) if len(distinct) > 1 else 1.0
    first = np.concatenate([[True], np.diff(distinct) > PLACE_TOLERANCE * mean_distance])
    return np.asarray(distinct[first])


def _nearest(axis: Array, coordinates: Array) -> NDArray[np.int64]:
    """Return the number of the place on a sorted axis nearest to each coordinate."""
    middle = (axis[1:] + axis[:-1]) / 2
    return np.asarray(np.searchsorted(middle, coordinates))
