"""A field that is known on a rectilinear grid, as a C2 cubic spline."""

from itertools import combinations_with_replacement
from math import prod
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.sources.grid import GridSection
from magshell_fenicsx.input.section import in_units
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.imperfections.scan import ScanError, table
from magshell_fenicsx.parts.magnetism.sources.known import Array, Known
from magshell_fenicsx.platform.reading import Files, vtk_data
from magshell_fenicsx.shape.lines import edges

PLACES, FIELD = ("x", "y", "z"), ("Bx", "By", "Bz")
VTK, DEGREE = (".vtk", ".vti", ".vtr", ".vts"), 3
SAME = 1e-6  # of the distance between places: rounding of a table
_known: dict[tuple[Path, str], tuple[list[Array], Array]] = {}  # a run plans its case several times


def grid(section: GridSection, case: Case, key: str) -> Known:
    """See `Known`.

    Raises
    ------
    CaseError
        If the file is no such grid.
    """
    try:
        axes, values = read(section.path, section.digest, section.files)
    except ScanError as e:
        raise CaseError(f"{key}.file: {section.file}: {e}") from None
    spline = _spline(axes, values)

    def field(x: Array) -> tuple[Array, Array, Array]:
        def of(*by: int) -> Array:
            return np.asarray(spline(x, nu=np.bincount(by, minlength=3)) if by else spline(x))

        B, G = of(), np.stack([of(j) for j in range(3)], axis=-1)
        H = np.empty((len(x), 3, 3, 3))
        for j, k in combinations_with_replacement(range(3), 2):
            H[:, :, j, k] = H[:, :, k, j] = of(j, k)
        return B, G, H

    low, high = (np.array([axis[end] for axis in axes]) for end in (0, -1))
    return Known(field, edges(low, high), "beyond the grid of")


def _spline(axes: list[Array], values: Array) -> "scipy.interpolate.NdBSpline":
    """The tensor product of the cubic splines along each axis, of values (nx, ny, nz, 3)."""
    knots = []
    for i, axis in enumerate(axes):
        along = scipy.interpolate.make_interp_spline(axis, values, DEGREE, axis=i)
        knots.append(along.t)
        values = np.moveaxis(along.c, 0, i)
    return scipy.interpolate.NdBSpline(tuple(knots), values, DEGREE, extrapolate=False)


def read(file: Path, digest: str | None, files: Files) -> tuple[list[Array], Array]:
    """The places along each axis in m, and B (nx, ny, nz, 3) in T. A file is read again if its `digest` has changed.

    Raises
    ------
    ScanError
        If it cannot be read, or is no rectilinear grid.
    """
    if digest is None or (file, digest) not in _known:
        if len(_known) > 3:
            _known.clear()
        _known[file, digest or ""] = _gridded(*(_vtk(file, files) if file.suffix in VTK else _table(file, files)))
    return _known[file, digest or ""]


def _gridded(x: Array, B: Array) -> tuple[list[Array], Array]:
    """The places along each axis, and the values (nx, ny, nz, 3), of rows in any order."""
    axes = [_places(x[:, i]) for i in range(3)]
    shape = tuple(len(axis) for axis in axes)
    if min(shape) <= DEGREE:
        raise ScanError(f"has {' x '.join(map(str, shape))} places: a cubic spline needs four along each axis")
    values = np.full((len(x), 3), np.nan)
    if len(x) == prod(shape):  # scattered places have far more places along the axes than rows
        where = tuple(_nearest(axis, x[:, i]) for i, axis in enumerate(axes))
        values[np.ravel_multi_index(where, shape)] = B
    if not np.isfinite(values).all():
        raise ScanError(
            f"is no rectilinear grid of finite numbers: {len(x)} rows with {' x '.join(map(str, shape))} "
            "different places along the axes"
        )
    return axes, values.reshape(*shape, 3)


def _table(file: Path, files: Files) -> tuple[Array, Array]:
    known, units = table(file, files)
    if missing := [name for name in (*PLACES, *FIELD) if name not in known]:
        raise ScanError(f"has no column {', '.join(missing)}; needed are {', '.join((*PLACES, *FIELD))}")
    axes = [known[name] for name in PLACES]
    on_axes = file.suffix == ".npz" and known["Bx"].ndim == 3 and {a.ndim for a in axes} == {1}
    if on_axes and known["Bx"].size == prod(a.size for a in axes):  # the places along each axis
        known |= dict(zip(PLACES, np.meshgrid(*axes, indexing="ij"), strict=True))
    columns = [known[name].ravel() * _size(units[name], name) for name in (*PLACES, *FIELD)]
    if len({len(column) for column in columns}) > 1:
        raise ScanError("its arrays have different lengths")
    return np.column_stack(columns[:3]), np.column_stack(columns[3:])


def _size(unit: str | None, name: str) -> float:
    known = "metre" if name in PLACES else "tesla"
    try:
        return float(in_units(known, bare=True)(unit or known))
    except ValueError as e:
        raise ScanError(f"column {name}: its unit {unit} {e}") from None


def _vtk(file: Path, files: Files) -> tuple[Array, Array]:
    try:
        data = vtk_data(files.content(file), file.suffix)
    except (OSError, ValueError) as e:
        raise ScanError(f"cannot be read: {getattr(e, 'strerror', None) or e}") from None
    if "B" not in data.point_data or np.shape(data.point_data["B"]) != (data.n_points, 3):
        raise ScanError("has no vector B at its points")
    return np.array(data.points, dtype=float), np.array(data.point_data["B"], dtype=float)


def _places(along: Array) -> Array:
    """Different places, sorted; those that differ by rounding are one."""
    found = np.unique(along)
    apart = np.ptp(found) / len(found) if len(found) > 1 else 1.0
    first = np.concatenate([[True], np.diff(found) > SAME * apart])
    return np.asarray(found[first])


def _nearest(axis: Array, along: Array) -> NDArray[np.int64]:
    middle = (axis[1:] + axis[:-1]) / 2
    return np.asarray(np.searchsorted(middle, along))
