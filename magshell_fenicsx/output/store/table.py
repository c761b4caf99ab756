"""path.csv: one row per accepted point, on disk before the next point is computed."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from magshell_fenicsx.output.store.durable import AppendedFile
from magshell_fenicsx.quantities.registry import OF_EVERY_RUN

COLUMNS = tuple(q.name for q in OF_EVERY_RUN)
TEXTS = tuple(q.name for q in OF_EVERY_RUN if q.kind == "text")
Row = dict[str, float | int | str]
POLE = "the pole"
LOCATED = ("fold", "bifurcation")
SOLUTION = "solution"  # label of what a search found
OWN_MODES = ("", "symmetric", "asymmetric")  # modes of the model itself; it excludes all other modes


def pole_name(row: Mapping[str, object], pole: str = POLE) -> str:
    """The point of `w_pole_over_h`: the first named point, or what is there in place of a pole, see `pole_of`."""
    return next((key.removesuffix("_ux") for key in row if key.endswith("_ux")), pole)


def stability(row: Mapping[str, object]) -> str:
    """Whether a point is stable, in words.

    Examples
    --------
    >>> stability({"negative_pivots": 1, "excluded_pivots": 2}), stability({"negative_pivots": 0, "excluded_pivots": 0})
    ('unstable in 1 direction and 2 that the model excludes', 'stable')
    """
    own, excluded = (int(str(row.get(key, 0))) for key in ("negative_pivots", "excluded_pivots"))
    if not own + excluded:
        return "stable"
    first = f"unstable in {own} direction{'s' * (own != 1)}" if own else "unstable in"
    return first + (f"{' and' * bool(own)} {excluded} that the model excludes" if excluded else "")


class PathTable:
    """Writes rows one by one, after the rows of an interrupted run.

    Parameters
    ----------
    extra
        Columns besides those of every run.

    Attributes
    ----------
    kept
        The complete rows of an existing file; an incomplete last row is cut off.
    """

    def __init__(self, file: Path, extra: Sequence[str] = ()) -> None:
        self._columns = (*COLUMNS, *extra)
        lines = file.read_bytes().decode().splitlines(keepends=True) if file.exists() else []
        self.kept: list[dict[str, str]] = []
        header = _line(self._columns)
        length = len(header) if lines[:1] == [header] else 0
        for line in lines[1:] if length else []:
            values = next(csv.reader([line]))
            if not line.endswith("\n") or values[0] != str(len(self.kept)) or len(values) != len(self._columns):
                break
            self.kept.append(dict(zip(self._columns, values, strict=True)))
            length += len(line.encode())
        self._file = AppendedFile(file, length)
        if not length:
            self._file.append(header.encode())

    def write(self, row: Row) -> None:
        """Add a row, unless the file has it.

        Raises
        ------
        OSError
            If the disk is full; the file still ends with a complete row.
        """
        if int(row["point"]) >= len(self.kept):
            self._file.append(
                _line(repr(float(v)) if isinstance(v := row[key], float) else v for key in self._columns).encode()
            )

    def close(self) -> None:
        self._file.close()


def _line(values: Iterable[Any]) -> str:
    stream = io.StringIO()
    csv.writer(stream).writerow(values)
    return stream.getvalue()


def read_rows(file: Path) -> list[Row]:
    """The complete rows of a path.csv, also after a kill."""
    text = file.read_text(encoding="utf-8")
    rows = csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1], newline=""))
    return [{key: v if key in TEXTS else _number(v) for key, v in row.items()} for row in rows]


def _number(text: str) -> float | int:
    return int(text) if text.lstrip("-").isdigit() else float(text)
