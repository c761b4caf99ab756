"""path.csv: one row per accepted point, on disk before the next point is sought."""

import csv
import os
from pathlib import Path

COLUMNS = (
    "point",
    "label",
    "amplitude",
    "p_over_pc",
    "lambda_m",
    "force",
    "w_over_h",
    "w_from_field_over_h",
    "w_pole_over_h",
    "volume_change",
    "energy",
    "negative_pivots",
    "iterations",
    "factorisations",
    "wall_s",
    "stretching",
    "bending",
    "magnetic",
    "U1",
    "Uq",
    "Utau",
    "mode",
    "field_angle",
)
Row = dict[str, float | int | str]


class PathTable:
    """Writes rows as they come."""

    def __init__(self, file: Path) -> None:
        self._stream = file.open("w", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._stream, COLUMNS)
        self._writer.writeheader()

    def write(self, row: Row) -> None:
        self._writer.writerow({key: repr(v) if isinstance(v, float) else v for key, v in row.items()})
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def close(self) -> None:
        self._stream.close()
