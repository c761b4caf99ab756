"""A measured imperfection: a smooth function through its values."""

from dataclasses import dataclass
from math import inf, sqrt

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.imperfections.data import DataSection
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import place_text
from magshell_fenicsx.mesh.scattered import Scattered, scattered
from magshell_fenicsx.parts.imperfections.feet import feet
from magshell_fenicsx.parts.imperfections.flaw import Flaw
from magshell_fenicsx.parts.imperfections.scan import Lengths, Scan, ScanError, read_scan
from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
MOST_H, MOST_R, FAR = (
    50.0,
    0.5,
    0.5,
)  # largest |w0| over h and over R; distance over R beyond which a place is not of this shell
SAME = 0.2  # of the typical distance of neighbours, below which values are averaged
HOLE, GAPS = 3.0, 4.0  # largest hole: radius over sqrt(R h), or over the typical distance of neighbours
SMALLEST, SHOWN = 0.45, 2.0  # element size over sqrt(R h), and over the length of the sharpest bend


@dataclass(frozen=True)
class Factored:
    """A function of place times a factor; both over R."""

    function: Scattered
    factor: float

    def __call__(self, places: Array) -> Array:
        return self.factor * self.function(places)


@dataclass(frozen=True)
class _Fit:
    function: Scattered
    size: float
    account: str


_known: dict[tuple[str | None, ...], _Fit] = {}  # a run plans its case several times


def data(section: DataSection, case: Case, drawn: Outline, key: str) -> Flaw:
    """See `Flaw`.

    Raises
    ------
    CaseError
        If the file cannot be read, or its values are not of this shell.
    """
    shell = case.shell.model_dump_json(exclude={"imperfections"})
    mesh = case.outside.get("mesh_file")
    this = (section.digest, str(section.path), str(section.noise), shell, mesh)
    if this not in _known:
        if len(_known) > 3:
            _known.clear()
        lengths = Lengths(1 / case.shell.R_over_h, case.shell.reference, case.shell.with_units)
        try:
            scan = read_scan(section.path, lengths, section.files)
            _known[this] = _fitted(section, scan, case.shell.geometry, drawn, lengths)
        except ScanError as e:
            raise CaseError(f"shell.{key}.file: {section.file}: {e}") from None
    fit = _known[this]
    return Flaw(Factored(fit.function, section.amplitude), fit.size, account=f"{section.file}: {fit.account}")


def _fitted(section: DataSection, scan: Scan, geometry: str, drawn: Outline, lengths: Lengths) -> _Fit:
    h, surface = lengths.h, drawn.sample()
    places, w0 = _on_surface(scan, geometry, drawn, surface)
    if not np.abs(w0).max() <= min(MOST_H * h, MOST_R):
        unit = (
            "; without a unit in the header, w0 is over h"
            if scan.w0 is not None
            else ": are they in the shell's frame?"
        )
        raise ScanError(f"w0 reaches {np.abs(w0).max() / h:.4g} h; allowed at most {min(MOST_H, MOST_R / h):.4g}{unit}")
    given = len(w0)
    tree = scipy.spatial.cKDTree(places)
    spacing = float(np.median(tree.query(places, [9])[0])) / 1.7
    gaps = tree.query(surface)[0]
    if gaps.max() > max(HOLE * sqrt(h), GAPS * spacing):
        where = place_text(surface[np.argmax(gaps)])
        raise ScanError(
            f"no value lies within {gaps.max():.3g} R of the place {where} over R, where the hole is too large to "
            "guess; give values there, w0 = 0 where the shell is perfect"
        )
    places, w0 = _merged(places, w0, SAME * spacing)
    noise = None if section.noise is None else section.noise * h
    function = scattered(places, w0, surface, noise=noise)
    estimated = "estimated" if noise is None else "given"
    account = (
        f"{given} values, w0 from {w0.min() / h:.4g} to {w0.max() / h:.4g} h, "
        f"residual of the fit {function.residual / h:.3g} h, noise {function.noise / h:.3g} h ({estimated}), "
        f"largest gap {gaps.max():.3g} R"
    )
    lost = f", {scan.lost} rows without a number left out" if scan.lost else ""
    return _Fit(function, max(SHOWN * _bend(function, surface, sqrt(h)), SMALLEST * sqrt(h)), account + lost)


def _on_surface(scan: Scan, geometry: str, drawn: Outline, surface: Array) -> tuple[Array, Array]:
    """Places (n, 3) of the perfect surface and w0 (n,), over R."""
    columns, w0 = scan.columns, scan.w0
    if "x" not in columns:
        assert w0 is not None
        polar = columns.get("polar")
        if geometry not in (("cylinder",) if polar is None else ("hemisphere", "cap")):
            angles = "azimuth and z are of a cylinder" if polar is None else "polar and azimuth are of a sphere"
            raise ScanError(f"{angles}; on geometry: {geometry} give x, y, z")
        rho, z = (1.0, columns["z"]) if polar is None else (np.sin(polar), np.cos(polar))
        return np.column_stack([rho * np.cos(columns["azimuth"]), rho * np.sin(columns["azimuth"]), z]), w0
    x = np.column_stack([columns[name] for name in "xyz"])
    away = scipy.spatial.cKDTree(surface).query(x)[0]
    if away.max() > FAR:
        row = int(np.argmax(away))
        raise ScanError(
            f"the place {place_text(x[row])} over R is {away[row]:.3g} R from the shell: give the columns their unit, "
            "such as x [mm], or turn and move them to the shell's frame"
        )
    places, heights = feet(drawn, x)
    if w0 is None:
        return places, heights
    if np.abs(heights).max() > 0.02 + 2 * np.abs(w0).max():
        row = int(np.argmax(np.abs(heights)))
        raise ScanError(
            f"the place {place_text(x[row])} over R is {abs(heights[row]):.3g} R from the shell, but w0 there "
            f"is {w0[row]:.3g} R: the unit of one of them is wrong, or it is the place of another shell"
        )
    return places, w0


def _merged(places: Array, w0: Array, distance: float) -> tuple[Array, Array]:
    """Means over cubes of this size, so that no two places are the same."""
    _, cell = np.unique(np.floor(places / distance).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell)
    return np.column_stack([np.bincount(cell, c) / count for c in places.T]), np.bincount(cell, w0) / count


def _bend(function: Scattered, x: Array, length: float) -> float:
    """1/k of the shortest wave sin(k x) that a function resembles, from its second differences over a length over R."""
    x = x[:: max(1, len(x) // 2000)]
    w, d = function(x), 0.7 * length
    bent = sum(np.abs(function(x + d * e) - 2 * w + function(x - d * e)) for e in np.eye(3)) / d**2
    largest = float(np.nanmax(bent))
    return float(np.sqrt(np.ptp(w) / 2 / largest)) if largest > 0 else inf
