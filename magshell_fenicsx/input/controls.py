"""Tables of values at control points, from files beside the case."""

import csv
from collections.abc import Sequence
from pathlib import Path
from textwrap import shorten

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.platform.reading import Files, text_of

Array = NDArray[np.float64]
MOST = 200_000  # points
PLACES = {3: ("x", "y", "z"), 2: ("rho", "z")}
VECTORS = {3: ("bx", "by", "bz"), 2: ("b_rho", "b_z")}


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
            return _numbers(file, key, header, rows, columns, dim)
    allowed = " or ".join(", ".join((*PLACES[dim], *VECTORS[dim])) for dim in (3, 2))
    raise CaseError(f"{key}: {file}: its columns are {shorten(', '.join(header), 200)}; allowed are {allowed}")


def _numbers(
    file: Path, key: str, header: Sequence[str], rows: Sequence[Sequence[str]], columns: Sequence[str], dim: int
) -> tuple[Array, Array]:
    try:
        found = np.array([[float(row[header.index(name)]) for name in columns] for row in rows]).reshape(-1, 2 * dim)
    except (ValueError, IndexError):
        raise CaseError(f"{key}: {file}: has a row without a number in each column") from None
    if not 0 < len(found) <= MOST or not np.isfinite(found).all():
        raise CaseError(f"{key}: {file}: has {len(found)} rows of numbers; allowed are 1 to {MOST}, all finite")
    return found[:, :dim], found[:, dim:]


def write_vectors(file: Path, places: Array, vectors: Array) -> None:
    """Write such a file, with all digits."""
    dim = places.shape[1]
    lines = [",".join((*PLACES[dim], *VECTORS[dim]))]
    lines += [",".join(repr(float(v)) for v in row) for row in np.hstack([places, vectors])]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
