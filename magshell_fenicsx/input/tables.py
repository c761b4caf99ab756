"""Tables from files beside the case: columns with units, and vectors at control points.

A header is the line of a CSV file with the names of its columns, perhaps with units, such as
"x [mm]". Measured tables may have empty cells; tables of vectors have a field at points in space,
or on a meridian (rho is the distance from the axis). A place is a point.
"""

import csv
import io
import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.section import in_units
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.platform.input_files import Files, npz_arrays, table_text

Array = NDArray[np.float64]
HEADER = re.compile(r"\s*(\w+)\s*(?:[\[(]\s*([^\])]+?)\s*[\])])?\s*")  # x, x [mm] or x (mm)
MAX_TABLE_BYTES = 200_000_000
MAX_CONTROL_POINTS = 200_000
MAX_MEASURED_NUMBER = 1e30  # squares of larger numbers have no finite sum

# Columns of files of vectors, by dimension.
PLACES = {3: ("x", "y", "z"), 2: ("rho", "z")}
VECTORS = {3: ("bx", "by", "bz"), 2: ("b_rho", "b_z")}


class TableError(ValueError):
    """Error that a file cannot be used; the message says what and where, without its name."""


@dataclass(frozen=True)
class TableRows:
    """The rows of a file of measured numbers.

    Attributes
    ----------
    columns
        Name -> numbers (rows,), nan where the cell is empty.
    units
        Name -> unit; None without.
    lines
        Line of each row in the file.
    """

    columns: Mapping[str, Array]
    units: Mapping[str, str | None]
    lines: Sequence[int]


@dataclass(frozen=True)
class _TableCells:
    """The cells of a file as numbers, nan where there is no number.

    Attributes
    ----------
    columns
        Header of each column, with its unit -> numbers.
    lines
        Line of each row in the file; empty for an .npz file.
    word
        Message about the first cell with text in place of a number; empty without.
    """

    columns: Mapping[str, Array]
    lines: Sequence[int] = ()
    word: str = ""


def read_table(file: Path, files: Files) -> tuple[dict[str, Array], dict[str, str | None]]:
    """Return the columns of a CSV file, or the arrays of an .npz file, and their units.

    Returns
    -------
    columns
        Name -> numbers, nan where there is none.
    units
        Name -> unit; None without.

    Raises
    ------
    TableError
        If the file cannot be read, or has a column twice.
    """
    return _by_name(_cells(file, files))


def read_rows(file: Path, files: Files) -> TableRows:
    """Return the measured rows of a file, whose cells are numbers, empty or nan.

    Raises
    ------
    TableError
        With the line of a cell that has text or a number out of bounds; see `read_table` too.
    """
    cells = _cells(file, files)
    columns, units = _by_name(cells)
    if cells.word:  # a cell has text in place of a number
        raise TableError(cells.word)
    lengths = {column.shape for column in columns.values()}
    if len(lengths) > 1 or any(len(shape) != 1 for shape in lengths):
        raise TableError("its arrays have different lengths")
    # an .npz file has no lines: its rows are counted from 1
    lines = cells.lines or range(1, 1 + next(iter(lengths))[0])
    for name, column in columns.items():
        too_large = np.flatnonzero(np.abs(column) > MAX_MEASURED_NUMBER)
        if len(too_large):
            row = too_large[0]
            raise TableError(
                f"line {lines[row]}: {name}: {column[row]:g}: allowed are numbers up to "
                f"{MAX_MEASURED_NUMBER:g} in size"
            )
    return TableRows(columns, units, lines)


def _cells(file: Path, files: Files) -> _TableCells:
    """Return the cells of a CSV or .npz file as numbers.

    Raises
    ------
    TableError
        If the file cannot be read, is too large, or is no table.
    """
    try:
        content = files.content(file)
    except OSError as e:
        raise TableError(f"cannot be read: {e.strerror or e}") from None
    if len(content) > MAX_TABLE_BYTES:
        raise TableError(f"is larger than {MAX_TABLE_BYTES // 1_000_000} MB; leave out rows")
    try:
        if file.suffix == ".npz":
            return _TableCells(npz_arrays(content))
        return _csv_cells(table_text(content))
    except TableError:
        raise  # a ValueError too, with its message
    except (ValueError, csv.Error) as e:
        raise TableError(str(e)) from None


def _by_name(cells: _TableCells) -> tuple[dict[str, Array], dict[str, str | None]]:
    """Return the columns by their names, and the units by these, from headers such as "x [mm]"."""
    headers = [_name_and_unit(header) for header in cells.columns]
    names = [name for name, _ in headers]
    _refuse_double(names)
    values = [np.asarray(v, dtype=float) for v in cells.columns.values()]
    return dict(zip(names, values, strict=True)), dict(headers)


def _refuse_double(names: Sequence[str]) -> None:
    """Raise a TableError if a name of a column occurs twice."""
    if len(set(names)) < len(names):
        raise TableError(f"has a column twice: {shorten(', '.join(names), 200)}")


def column_size(name: str, unit: str, target_unit: str) -> float:
    """Return the size of a column's unit in another unit, such as metre or tesla.

    `name` is that of the column, for the message.

    Raises
    ------
    TableError
        If the unit is none, or has another dimension.
    """
    try:
        return float(in_units(target_unit, bare=True)(unit))
    except ValueError as e:
        raise TableError(f"column {name}: its unit {unit} {e}") from None


def read_vectors(file: Path, key: str, files: Files | None = None) -> tuple[Array, Array]:
    """Return the places and vectors of a CSV file.

    Its columns are x, y, z, bx, by, bz or rho, z, b_rho, b_z, in any order.

    Parameters
    ----------
    key
        Key of the case that names the file, for messages.
    files
        Contents of files of the case; None to read the file itself.

    Returns
    -------
    tuple
        Places and vectors, both (n, 3) or both (n, 2).

    Raises
    ------
    CaseError
        If the file has other columns, no row, or a cell without a number; the message begins with
        the key.
    """
    try:
        lines = table_text((files or Files()).content(file)).splitlines()
        header, *rows = [_without_blanks(row) for row in csv.reader(lines) if row]
    except (OSError, ValueError, csv.Error) as e:
        raise CaseError(
            f"{key}: {file}: cannot be read: {getattr(e, 'strerror', None) or 'no table'}"
        ) from None
    for dim in (3, 2):
        columns = (*PLACES[dim], *VECTORS[dim])
        if sorted(header) == sorted(columns):
            return _points_and_vectors(file, key, header, rows, columns, dim)
    allowed = " or ".join(", ".join((*PLACES[dim], *VECTORS[dim])) for dim in (3, 2))
    raise CaseError(
        f"{key}: {file}: its columns are {shorten(', '.join(header), 200)}; allowed are {allowed}"
    )


def _without_blanks(row: Sequence[str]) -> list[str]:
    """Return the cells of a row without blanks around their texts."""
    return [cell.strip() for cell in row]


def write_vectors(file: Path, places: Array, vectors: Array) -> None:
    """Write a CSV file of places and vectors, see `read_vectors`, with all digits."""
    dim = places.shape[1]
    lines = [",".join((*PLACES[dim], *VECTORS[dim]))]
    lines += [",".join(map(repr, map(float, row))) for row in np.hstack([places, vectors])]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _points_and_vectors(
    file: Path,
    key: str,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    columns: Sequence[str],
    dim: int,
) -> tuple[Array, Array]:
    """Return the places (n, dim) and vectors (n, dim) in the rows of a file.

    Parameters
    ----------
    header, rows
        Names of the columns, and the texts of the cells, as the file has them.
    columns
        The names in order: coordinates of places, then components of vectors.
    dim
        3, or 2 on a meridian.

    Raises
    ------
    CaseError
        If a row lacks a finite number, or there are too many rows or none.
    """

    def numbers(row: Sequence[str]) -> list[float]:
        """Return the numbers of a row in the order of `columns`."""
        return [float(row[header.index(name)]) for name in columns]

    try:
        values = np.array([numbers(row) for row in rows]).reshape(-1, 2 * dim)
    except (ValueError, IndexError):
        raise CaseError(f"{key}: {file}: has a row without a number in each column") from None
    if not 0 < len(values) <= MAX_CONTROL_POINTS or not np.isfinite(values).all():
        raise CaseError(
            f"{key}: {file}: has {len(values)} rows of numbers; allowed are 1 to "
            f"{MAX_CONTROL_POINTS}, all finite"
        )
    return values[:, :dim], values[:, dim:]


def _name_and_unit(header: str) -> tuple[str, str | None]:
    """Return name and unit of a header such as "x [mm]"; None without a unit."""
    parts = HEADER.fullmatch(header)
    return (parts[1], parts[2]) if parts else (header, None)


def _csv_cells(text: str) -> _TableCells:
    """Return the cells of a CSV file from its text, as numbers.

    A cell with text in place of a number becomes nan, and the first one gives the message `word` of
    the result.

    Raises
    ------
    TableError
        If a column occurs twice, there are no rows, or a row has another number of cells.
    """
    header, begin = _header(text)  # the line with the names, and its number
    separator, names = _separator(header), _names(header)
    _refuse_double(names)
    # all cells, row by row, and the line of each row; an array takes less memory than a list, and
    # there may be millions of cells
    cell_values, lines, word = array("d"), list[int](), ""
    for line, row in _rows(text, separator, begin):
        if len(row) != len(names):
            raise TableError(
                f"has {len(names)} names in its header and {len(row)} columns in line {line}: "
                "every row has as many cells as the header, and decimal points"
            )
        for name, cell in zip(names, row, strict=True):
            value = _number(cell)
            if value is None and not word:
                word = (
                    f"line {line}: {name}: {shorten(cell, 40)}: is no number; where nothing was "
                    "measured the cell is empty"
                )
            cell_values.append(np.nan if value is None else value)
        lines.append(line)
    if not lines:
        raise TableError("has no rows of numbers below a header with the names of its columns")
    rows = np.array(cell_values).reshape(-1, len(names))
    return _TableCells(dict(zip(names, rows.T, strict=True)), lines, word)


def _header(text: str) -> tuple[str, int]:
    """Return the line with the names of the columns, and its number from 1.

    It is the first line without a #. If that line has numbers, it is the comment above it with as
    many names as numbers, or else the first comment.
    """
    comments = list[tuple[str, int]]()
    for number, line in enumerate(io.StringIO(text), 1):
        bare = line.strip()
        if bare.startswith("#"):
            comments.append((bare.lstrip("# "), number))
        elif bare:
            cells = [cell for cell in re.split(r"[;,\s]+", bare.replace('"', "")) if cell]
            # a line of numbers: the names are in a comment above
            if comments and any(_number(cell) is not None for cell in cells):
                # the first comment with the largest key: True where the counts agree
                return max(comments, key=lambda comment: len(_names(comment[0])) == len(cells))
            return bare, number
    return "", 0


def _separator(header: str) -> str | None:
    """Return the character that separates columns in a header; None for blanks."""
    return next((mark for mark in (";", "\t", ",") if mark in header), None)


def _names(header: str) -> list[str]:
    """Return the names of columns, with their units, in a header."""
    if separator := _separator(header):
        return [cell.strip() for cell in next(csv.reader([header], delimiter=separator))]
    return re.findall(r"[\w.]+(?:\s*[\[(][^\])]*[\])])?", header)


def _rows(text: str, separator: str | None, begin: int) -> Iterator[tuple[int, list[str]]]:
    """Iterate over the rows below the header: number of the line, and cells as text.

    Comments and empty rows are left out. `begin` is the number of the header's line.
    """
    # lines above become empty, so that numbers of lines stay right
    numbered = enumerate(io.StringIO(text), 1)
    bare = (line.partition("#")[0] if number > begin else "" for number, line in numbered)
    if separator:
        reader = csv.reader(bare, delimiter=separator)
        rows = ((reader.line_num, _without_blanks(row)) for row in reader)
    else:
        rows = ((i, line.replace('"', "").split()) for i, line in enumerate(bare, 1))
    return ((number, row) for number, row in rows if any(row))


def _number(cell: str) -> float | None:
    """Return the number in a cell, nan for an empty cell, None for text."""
    try:
        return float(cell) if cell else np.nan
    except ValueError:
        return None
