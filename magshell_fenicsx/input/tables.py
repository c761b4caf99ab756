"""Tables from files beside the case: columns with units, and vectors at control points."""

import csv
import io
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from textwrap import shorten

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.section import in_units
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.platform.reading import Files, arrays, text_of

Array = NDArray[np.float64]
HEADER = re.compile(r"\s*(\w+)\s*(?:[\[(]\s*([^\])]+?)\s*[\])])?\s*")  # x, x [mm] or x (mm)
LARGEST, MOST_POINTS = 200_000_000, 200_000  # bytes, control points
PLACES = {3: ("x", "y", "z"), 2: ("rho", "z")}
VECTORS = {3: ("bx", "by", "bz"), 2: ("b_rho", "b_z")}


class TableError(ValueError):
    """The file cannot be used; the message says what and where, without the file's name."""


def read_table(file: Path, files: Files) -> tuple[dict[str, Array], dict[str, str | None]]:
    """The columns of a CSV file or the arrays of an .npz file, and their units, by name.

    Raises
    ------
    TableError
        If it cannot be read, or has a column twice.
    """
    try:
        content = files.content(file)
    except OSError as e:
        raise TableError(f"cannot be read: {e.strerror or e}") from None
    if len(content) > LARGEST:
        raise TableError(f"is larger than {LARGEST // 1_000_000} MB; leave out rows")
    try:
        columns = arrays(content) if file.suffix == ".npz" else _csv_columns(text_of(content))
    except TableError:
        raise
    except ValueError as e:
        raise TableError(str(e)) from None
    units = dict(_name_and_unit(header) for header in columns)
    if len(units) < len(columns):
        raise TableError(f"has a column twice: {shorten(', '.join(columns), 200)}")
    return {name: np.asarray(v, dtype=float) for name, v in zip(units, columns.values(), strict=True)}, units


def column_size(name: str, unit: str, of: str) -> float:
    """What one of a column's unit is in another, such as metre or tesla.

    Raises
    ------
    TableError
        If it is none of that dimension.
    """
    try:
        return float(in_units(of, bare=True)(unit))
    except ValueError as e:
        raise TableError(f"column {name}: its unit {unit} {e}") from None


def read_vectors(file: Path, key: str, files: Files | None = None) -> tuple[Array, Array]:
    """Places (n, 3) and vectors (n, 3), or both (n, 2), of a CSV file with the columns x, y, z, bx, by, bz or
    rho, z, b_rho, b_z.

    Raises
    ------
    CaseError
        If it has other columns, no row, or what is no number; the message begins with the key.
    """
    try:
        lines = text_of((files or Files()).content(file)).splitlines()
        header, *rows = [[cell.strip() for cell in row] for row in csv.reader(lines) if row]
    except (OSError, ValueError, csv.Error) as e:
        raise CaseError(f"{key}: {file}: cannot be read: {getattr(e, 'strerror', None) or 'no table'}") from None
    for dim in (3, 2):
        columns = (*PLACES[dim], *VECTORS[dim])
        if sorted(header) == sorted(columns):
            return _points_and_vectors(file, key, header, rows, columns, dim)
    allowed = " or ".join(", ".join((*PLACES[dim], *VECTORS[dim])) for dim in (3, 2))
    raise CaseError(f"{key}: {file}: its columns are {shorten(', '.join(header), 200)}; allowed are {allowed}")


def write_vectors(file: Path, places: Array, vectors: Array) -> None:
    """Write such a file, with all digits."""
    dim = places.shape[1]
    lines = [",".join((*PLACES[dim], *VECTORS[dim]))]
    lines += [",".join(repr(float(v)) for v in row) for row in np.hstack([places, vectors])]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _points_and_vectors(
    file: Path, key: str, header: Sequence[str], rows: Sequence[Sequence[str]], columns: Sequence[str], dim: int
) -> tuple[Array, Array]:
    try:
        values = np.array([[float(row[header.index(name)]) for name in columns] for row in rows]).reshape(-1, 2 * dim)
    except (ValueError, IndexError):
        raise CaseError(f"{key}: {file}: has a row without a number in each column") from None
    if not 0 < len(values) <= MOST_POINTS or not np.isfinite(values).all():
        raise CaseError(f"{key}: {file}: has {len(values)} rows of numbers; allowed are 1 to {MOST_POINTS}, all finite")
    return values[:, :dim], values[:, dim:]


def _name_and_unit(header: str) -> tuple[str, str | None]:
    parts = HEADER.fullmatch(header)
    return (parts[1], parts[2]) if parts else (header, None)


def _csv_columns(text: str) -> dict[str, Array]:
    stream = io.StringIO(text)
    header = next((line for line in stream if line.strip()), "").lstrip("# ").strip()
    mark = next((mark for mark in (";", "\t", ",") if mark in header), None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an empty file
        try:
            rows = np.genfromtxt(stream, delimiter=mark, ndmin=2, comments="#")
        except ValueError as e:
            raise TableError(f"has rows of different lengths: {str(e).splitlines()[-1].strip()}") from None
    names = [
        name.strip() for name in (header.split(mark) if mark else re.findall(r"\w+(?:\s*[\[(][^\])]*[\])])?", header))
    ]
    if not names or rows.size == 0:
        raise TableError("has no rows of numbers below a header such as x,y,z,w0")
    if rows.shape[1] != len(names):
        raise TableError(f"has {len(names)} names in its header and {rows.shape[1]} columns")
    return dict(zip(names, rows.T, strict=True))
