"""Reading measured places and deviations: CSV with a header, or .npz."""

import io
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.section import in_units
from magshell_fenicsx.platform.reading import Files, arrays, text_of

Array = NDArray[np.float64]
HEADER = re.compile(r"\s*(\w+)\s*(?:[\[(]\s*([^\])]+?)\s*[\])])?\s*")  # x, x [mm] or x (mm)
PLACES = (("x", "y", "z"), ("polar", "azimuth"), ("azimuth", "z"))
ANGLES = ("polar", "azimuth")
LARGEST, MOST = 200_000_000, 300_000  # bytes, rows


class ScanError(ValueError):
    """The file cannot be used; the message says what and where, without the file's name."""


@dataclass(frozen=True)
class Lengths:
    """The units of a case.

    Attributes
    ----------
    h
        Thickness over R.
    R
        Reference length in the case's length.
    si
        Whether that is a metre.
    """

    h: float
    R: float
    si: bool

    def over_R(self, unit: str | None, name: str) -> float:
        """The size of a column's unit over R; without one, w0 is over h and a place in the case's length."""
        if unit in ("h", "R"):
            return self.h if unit == "h" else 1.0
        if unit is None:
            return self.h if name == "w0" else 1 / self.R
        if not self.si:
            raise ScanError(
                f"column {name}: has the unit {unit}, but the shell's lengths have none; h and R are allowed"
            )
        try:
            return float(in_units("metre", bare=True)(unit)) / self.R
        except ValueError as e:
            raise ScanError(f"column {name}: its unit {unit} {e}") from None


@dataclass(frozen=True)
class Scan:
    """Columns of finite numbers, lengths over R and angles in rad; `lost` rows had others."""

    columns: dict[str, Array]
    lost: int

    @property
    def w0(self) -> Array | None:
        return self.columns.get("w0")


def read_scan(file: Path, lengths: Lengths, files: Files | None = None) -> Scan:
    """Read a file.

    Raises
    ------
    ScanError
        If it cannot be read, or has not the columns.
    """
    known, units = table(file, files or Files())
    wanted = next(
        (names for names in PLACES if set(names) <= known.keys() and ("w0" in known or len(names) == 3)), None
    )
    if wanted is None:
        raise ScanError(
            f"has the columns {shorten(', '.join(map(repr, known)), 200)}; needed are x, y, z, w0, or x, y, z of the "
            "real surface, or polar, azimuth, w0 of a sphere, or azimuth, z, w0 of a cylinder"
        )
    names = [*wanted, *(["w0"] if "w0" in known else [])]
    if "w0" in units and units["w0"] is None and any(units[name] for name in wanted if name not in ANGLES):
        raise ScanError("column w0: has no unit, but the places have one: write w0 [h] or a length, such as w0 [um]")
    return _finite(names, [known[name] * _factor(units[name], name, lengths) for name in names])


def table(file: Path, files: Files) -> tuple[dict[str, Array], dict[str, str | None]]:
    """The columns of a CSV file or the arrays of an .npz file, and their units, by name.

    Raises
    ------
    ScanError
        If it cannot be read, or has a column twice.
    """
    try:
        content = files.content(file)
    except OSError as e:
        raise ScanError(f"cannot be read: {e.strerror or e}") from None
    if len(content) > LARGEST:
        raise ScanError(f"is larger than {LARGEST // 1_000_000} MB; leave out rows")
    try:
        columns = arrays(content) if file.suffix == ".npz" else _csv(text_of(content))
    except ScanError:
        raise
    except ValueError as e:
        raise ScanError(str(e)) from None
    units = dict(_named(header) for header in columns)
    if len(units) < len(columns):
        raise ScanError(f"has a column twice: {shorten(', '.join(columns), 200)}")
    return {name: np.asarray(v, dtype=float) for name, v in zip(units, columns.values(), strict=True)}, units


def _factor(unit: str | None, name: str, lengths: Lengths) -> float:
    if name not in ANGLES:
        return lengths.over_R(unit, name)
    if unit not in (None, "deg", "degree", "degrees", "°", "rad"):
        raise ScanError(f"column {name}: its unit {unit} is no angle: degree or rad")
    return 1.0 if unit == "rad" else np.pi / 180


def _finite(names: Sequence[str], columns: Sequence[Array]) -> Scan:
    try:
        rows = np.column_stack([np.ravel(column) for column in np.broadcast_arrays(*columns)])
    except ValueError:
        raise ScanError("its arrays have different lengths") from None
    if len(rows) > MOST:
        raise ScanError(f"has {len(rows)} rows; allowed at most {MOST}: leave out rows, or average neighbours")
    good = np.isfinite(rows).all(axis=1)
    if good.sum() < max(20, len(rows) // 2):
        raise ScanError(f"has {good.sum()} rows of finite numbers in {len(rows)}; needed are 20, and half of the rows")
    return Scan(dict(zip(names, rows[good].T, strict=True)), int((~good).sum()))


def _named(header: str) -> tuple[str, str | None]:
    found = HEADER.fullmatch(header)
    return (found[1], found[2]) if found else (header, None)


def _csv(text: str) -> dict[str, Array]:
    stream = io.StringIO(text)
    header = next((line for line in stream if line.strip()), "").lstrip("# ").strip()
    mark = next((mark for mark in (";", "\t", ",") if mark in header), None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an empty file
        try:
            rows = np.genfromtxt(stream, delimiter=mark, ndmin=2, comments="#")
        except ValueError as e:
            raise ScanError(f"has rows of different lengths: {str(e).splitlines()[-1].strip()}") from None
    names = [
        name.strip() for name in (header.split(mark) if mark else re.findall(r"\w+(?:\s*[\[(][^\])]*[\])])?", header))
    ]
    if not names or rows.size == 0:
        raise ScanError("has no rows of numbers below a header such as x,y,z,w0")
    if rows.shape[1] != len(names):
        raise ScanError(f"has {len(names)} names in its header and {rows.shape[1]} columns")
    return dict(zip(names, rows.T, strict=True))
