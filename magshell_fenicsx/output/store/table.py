"""Tables of results: writing and reading CSV files, and path.csv, on disk row by row.

A row of path.csv is one point of a path: the values of its columns. The column `amplitude` has the
name of the load parameter that varied. A pivot count is the number of unstable directions: of the
model, and of modes that the reduced model excludes by its symmetry.
"""

import csv
import io
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from math import isnan
from pathlib import Path
from typing import Any, TypeVar

from magshell_fenicsx.output.store.durable import (
    AppendedFile,
    Damaged,
    damage,
    errors_as_damage,
    open_result,
    read_result,
    write_whole,
)
from magshell_fenicsx.quantities.registry import OF_EVERY_RUN, amplitude, quantity

COLUMNS = tuple(q.name for q in OF_EVERY_RUN)
TEXTS = tuple(q.name for q in OF_EVERY_RUN if q.kind == "text")
Row = dict[str, float | int | str]
Read = TypeVar("Read")
POLE = "the pole"
LOCATED = ("fold", "bifurcation")
SOLUTION = "solution"  # label of what a search found
MAX_NUMBER = 1e100  # no run writes a larger one


def pole_name(row: Mapping[str, object], pole: str = POLE) -> str:
    """Return the name of the point of `w_pole_over_h`.

    It is the first named point of the case: `row` has its displacement in columns NAME_ux and so
    on. Without a named point it is `pole`, the name of that point on the shape of the shell.
    """
    return next((key.removesuffix("_ux") for key in row if key.endswith("_ux")), pole)


def stability(row: Mapping[str, object]) -> str:
    """Return in words whether a point of a path is stable, from its row of path.csv.

    Examples
    --------
    >>> stability({"negative_pivots": 1, "excluded_pivots": 2})
    'unstable in 1 direction and 2 that the model excludes'
    >>> stability({"negative_pivots": 0, "excluded_pivots": 0})
    'stable'
    """
    model_pivots, excluded_pivots = (
        int(str(row.get(key, 0))) for key in ("negative_pivots", "excluded_pivots")
    )
    if not model_pivots + excluded_pivots:
        return "stable"
    counts = []
    if model_pivots:
        counts.append(f"{model_pivots} direction{'s' * (model_pivots != 1)}")
    if excluded_pivots:
        counts.append(f"{excluded_pivots} that the model excludes")
    return f"unstable in {' and '.join(counts)}"


class PathTable:
    """Writer of path.csv, which appends rows to those of an interrupted run.

    Parameters
    ----------
    file
        The table; an existing one is continued.
    extra
        Columns besides those of every run.

    Raises
    ------
    Damaged
        If an existing file is no table of a run, or has other columns.

    Attributes
    ----------
    complete_rows
        The complete rows of an existing file, as text; an incomplete last row is cut off.

    The field `_columns` has the names of the columns, and `_file` is the file as it is appended to.
    """

    def __init__(self, file: Path, extra: Sequence[str] = ()) -> None:
        """Open the file after its complete rows, or begin it with its header."""
        self._columns = (*COLUMNS, *extra)
        header = table_text([self._columns])
        content = read_result(file) if file.exists() else b""
        length = content.rfind(b"\n") + 1  # bytes of the header and the complete rows
        if length and not content.startswith(header.encode()):
            raise damage(file, "its columns are not those of this run")
        self.complete_rows = read_lines(file) if length else []
        self._file = AppendedFile(file, length)
        if not length:
            self._file.append(header.encode())

    def write(self, row: Row) -> None:
        """Append a row, unless the existing file already has the row of that point.

        Raises
        ------
        OSError
            If the disk is full; the file still ends with a complete row.
        """
        if int(row["point"]) >= len(self.complete_rows):
            self._file.append(table_text([[row[key] for key in self._columns]]).encode())

    def close(self) -> None:
        """Close the file, whose last rows are then on disk."""
        self._file.close()


def _cells(line: Iterable[Any]) -> list[Any]:
    """Return the cells of a line of a CSV file, where numbers are texts in full precision."""
    return [repr(float(v)) if isinstance(v, float) else v for v in line]


def table_text(lines: Iterable[Iterable[Any]], end: str = "\r\n") -> str:
    r"""Return lines of cells as the text of a CSV file, with numbers in full precision.

    Examples
    --------
    >>> table_text([["label", "value"], ["fold, first", 0.1]], end="\n")
    'label,value\n"fold, first",0.1\n'
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator=end)
    writer.writerows(_cells(line) for line in lines)
    return stream.getvalue()


def write_csv(rows: Iterable[Mapping[str, Any]], columns: Sequence[str], file: Path) -> None:
    """Write columns of rows as a CSV file with a header; a missing value is left empty.

    The complete old or the complete new file exists at every moment (`write_whole`).
    """

    def values_of(row: Mapping[str, Any]) -> list[Any]:
        """Return the values of a row in the columns."""
        return [row.get(column, "") for column in columns]

    lines = map(values_of, rows)
    write_whole(file, table_text([columns, *lines]).encode())


def varying_columns(rows: Sequence[Mapping[str, Any]], columns: Iterable[str]) -> list[str]:
    """Return those of some columns that have several values in rows."""
    return [column for column in columns if len({row[column] for row in rows}) > 1]


def read_csv(file: Path, convert: Callable[[Mapping[str, str]], Read]) -> list[Read]:
    """Return what `convert` makes of each row of a CSV file, in their order.

    Parameters
    ----------
    convert
        Function of a row: name in the header -> text.

    Raises
    ------
    Damaged
        If the file is no table, or `convert` raises one of `ERRORS_OF_CONTENT`.
    """
    content = read_result(file)
    with errors_as_damage(file):
        stream = io.StringIO(content.decode(), newline="")
        return [convert(row) for row in csv.DictReader(stream)]


def is_path(file: Path) -> bool:
    """Whether a file begins as a path.csv does; False if it cannot be read."""
    try:
        with open_result(file) as stream:
            return stream.readline(1000).startswith(",".join(COLUMNS[:4]).encode())
    except (OSError, Damaged):
        return False


def read_rows(file: Path) -> list[Row]:
    """Return the complete rows of a path.csv, with numbers where columns are numbers.

    It also reads the table of a killed run, whose last line may be incomplete.

    Raises
    ------
    Damaged
        If a column is missing or a line is not from a run; the message names the first such line.
    """
    return [_row_of_texts(texts) for texts in read_lines(file)]


def _row_of_texts(texts: Mapping[str, str]) -> Row:
    """Return a row of texts with numbers where columns are numbers."""
    return {key: v if key in TEXTS else _number(v) for key, v in texts.items()}


def read_lines(file: Path) -> list[dict[str, str]]:
    """Return the complete rows of a path.csv as text.

    Raises
    ------
    Damaged
        If a column is missing or a line is not from a run; the message names the first such line.
    """
    try:
        text = read_result(file).decode()
        complete_lines = text[: text.rfind("\n") + 1]  # a killed run may leave a part of a line
        lines = list(csv.reader(io.StringIO(complete_lines, newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as e:
        raise damage(file, f"no table in UTF-8: {e}") from None
    head = lines[0] if lines else []
    if missing := [name for name in COLUMNS if name not in head]:
        raise damage(file, f"it has no column {missing[0]}", may_be_earlier=True)
    counts = {name for name in head if quantity(name).kind == "count"}  # columns of whole numbers
    rows = []
    # row `number` is line number + 2 of the file: the header is line 1
    for number, values in enumerate(lines[1:]):
        rows.append(dict(zip(head, values, strict=False)))
        if len(values) != len(head):
            raise damage(
                file, f"line {number + 2} has {len(values)} values, its header {len(head)}"
            )
        if column := _wrong_column(number, rows[-1], counts):
            raise damage(file, f"line {number + 2} has {column} = {rows[-1][column]!r}")
    return rows


def _may_have_nan(column: str) -> bool:
    """Return whether a run may write nan into a column."""
    return column not in COLUMNS or quantity(column).may_be_nan


def _wrong_column(number: int, row: Mapping[str, str], counts: Collection[str]) -> str:
    """Return the first column whose value no run writes; empty if there is none.

    Parameters
    ----------
    number
        Number that the row's point must have.
    row
        Column -> text.
    counts
        Columns whose values are whole numbers.
    """
    for key, text in row.items():
        try:
            value = 0.0 if key in TEXTS else float(text)
            may_be_nan = isnan(value) and _may_have_nan(key)
            # infinity is too large, and nan fails the comparison
            if not (abs(value) <= MAX_NUMBER or may_be_nan):
                return key
            if key in counts and not value.is_integer():
                return key
        except ValueError:
            return key
    if row["point"] != str(number):
        return "point"
    # the amplitude that varied must have its column
    if row["amplitude"] and amplitude(row["amplitude"]).column not in row:
        return "amplitude"
    return ""


def _number(text: str) -> float | int:
    """Return an integer where the text is one, else a float."""
    return int(text) if text.removeprefix("-").isdecimal() else float(text)
