"""A measured imperfection: a smooth function through heights over the perfect surface.

w0 is the deviation of the real from the perfect surface, along the outward normal. Places, lengths
and w0 are over R, the reference length, from `Scan` on; h is the thickness. A scan has measured
places and perhaps w0. The chart is the pair of coordinates of the perfect surface, an `Outline`.
Its `sample` are places all over it. The foot of a place is the nearest point of that surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, sqrt
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.input.section import FileKeys
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.input.tables import TableError, column_size, read_table
from magshell_fenicsx.mesh.patch import place_text
from magshell_fenicsx.parts.imperfections.imperfection import (
    ImperfectionGeometry,
    ImperfectionSection,
    number_over,
)
from magshell_fenicsx.platform.input_files import Files
from magshell_fenicsx.shape.reference_shell import ReferenceShell

if TYPE_CHECKING:  # SciPy and the solver take their time, and a case alone does not need them
    from magshell_fenicsx.mesh.scattered_data import ScatteredSpline
    from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
PLACES = (("x", "y", "z"), ("polar", "azimuth"), ("azimuth", "z"))
ANGLES = ("polar", "azimuth")
MAX_ROWS = 300_000
MAX_DEPTH_OVER_H, MAX_DEPTH_OVER_R = 50.0, 0.5  # largest |w0| over h and over R
MAX_DISTANCE_OVER_R = 0.5  # distance over R beyond which a place is not of this shell
MERGE_DISTANCE = 0.2  # of the typical distance of neighbours, below which values are averaged
MAX_HOLE, MAX_HOLE_OVER_SPACING = (
    3.0,
    4.0,
)  # largest hole: radius over sqrt(R h), or over the typical distance of neighbours
MIN_ELEMENT_SIZE, SIZE_OVER_BEND = (
    0.45,
    2.0,
)  # element size over sqrt(R h), and over the length of the sharpest bend
NEWTON_STEPS, CHART_STEP = 30, 1e-5  # of Newton's method, and of differences in the chart
NODES_PER_QUADRIC = 12  # nodes of a mesh file that a quadric goes through
_fits: dict[tuple[str | None, ...], "_Fit"] = {}  # a run plans its case several times


class DataSection(FileKeys, ImperfectionSection):
    """w0 measured at places of the surface, scattered or on a grid, with noise and holes; a smooth
    function fits it.

    Columns of the file: x, y, z, w0; or polar, azimuth, w0 (spheres); or azimuth, z, w0
    (cylinders), angles in degrees; or x, y, z of the real surface. A header such as x [mm], w0 [um]
    has units; without one, places are in the shell's length and w0 is over h.
    """

    kind: Literal["data"]
    file: str
    """CSV with a header or .npz, its path from the folder of the case"""
    amplitude: float = Field(default=1.0, ge=-1e3, le=1e3)
    """Factor of w0"""
    noise: Annotated[float, number_over("h")] | None = Field(default=None, ge=0, le=50)
    """Standard deviation of the noise in w0; 0: w0 is exact; estimated by default [h]"""

    def account(self) -> str:
        return f"data of {self.file}"

    def geometry(self, reference: ReferenceShell, key: str) -> ImperfectionGeometry:
        """Return the geometry of the measured imperfection on the perfect shell.

        The fit of a file is remembered. `key` is the key of the section in the case, for messages.

        Raises
        ------
        CaseError
            If the file cannot be read, or its values are not of this shell.
        """
        fit_key = (self.digest, str(self.path), str(self.noise), *reference.identity)
        if fit_key not in _fits:
            if len(_fits) > 3:  # fits are large: a few are kept
                _fits.clear()
            lengths = Lengths(reference.h, reference.R, reference.with_units)
            try:
                _fits[fit_key] = _fit_of_scan(
                    self.noise, read_scan(self.path, lengths, self.files), reference
                )
            except TableError as e:
                raise CaseError(f"{key}.file: {self.file}: {e}") from None
        fit = _fits[fit_key]
        return ImperfectionGeometry(
            Factored(fit.function, self.amplitude),
            fit.size,
            account=f"{self.file}: {fit.account}",
        )


@dataclass(frozen=True)
class Factored:
    """A deviation: a fitted function of places (n, 3), times a factor; all over R."""

    function: "ScatteredSpline"
    factor: float

    def __call__(self, places: Array) -> Array:
        return self.factor * self.function(places)


@dataclass(frozen=True)
class Lengths:
    """The units of lengths of a case, to convert columns of a file.

    Attributes
    ----------
    h
        Thickness over R.
    R
        Reference length in the case's length.
    si
        Whether lengths of the case are in metres.
    """

    h: float
    R: float
    si: bool

    def over_R(self, unit: str | None, name: str) -> float:
        """Return the size over R of the unit of the column `name`.

        Without a unit (None), w0 is over h, and a place is in the case's length.

        Raises
        ------
        TableError
            If the column has a unit of length, and the case has none.
        """
        if unit in ("h", "R"):
            return self.h if unit == "h" else 1.0
        if unit is None:
            return self.h if name == "w0" else 1 / self.R
        if not self.si:
            raise TableError(
                f"column {name}: has the unit {unit}, but the shell's lengths have none; h and R "
                "are allowed"
            )
        return column_size(name, unit, "metre") / self.R


@dataclass(frozen=True)
class Scan:
    """Measured places and perhaps deviations, in rows of finite numbers.

    Attributes
    ----------
    columns
        Name -> values (n,): lengths over R, angles in rad.
    lost
        Number of rows that had other values, and are left out.
    """

    columns: dict[str, Array]
    lost: int

    @property
    def w0(self) -> Array | None:
        """The measured deviations (n,); None if the places lie on the real surface themselves."""
        return self.columns.get("w0")


def read_scan(file: Path, lengths: Lengths, files: Files | None = None) -> Scan:
    """Return the measured places and deviations of a file: CSV with a header, or .npz.

    Raises
    ------
    TableError
        If the file cannot be read, or lacks the columns.
    """
    columns, units = read_table(file, files or Files())  # name -> values, and name -> unit
    # the first of the three kinds of places that the file has; without w0 only x, y, z will do,
    # which are then on the real surface
    place_columns = None
    for names_of_kind in PLACES:
        is_complete = set(names_of_kind) <= columns.keys()
        has_deviations = "w0" in columns or len(names_of_kind) == 3
        if is_complete and has_deviations:
            place_columns = names_of_kind
            break
    if place_columns is None:
        raise TableError(
            f"has the columns {shorten(', '.join(map(repr, columns)), 200)}; needed are x, y, z, "
            "w0, or x, y, z of the real surface, or polar, azimuth, w0 of a sphere, or azimuth, "
            "z, w0 of a cylinder"
        )
    names = [*place_columns, *(["w0"] if "w0" in columns else [])]
    # w0 without a unit is over h: beside places with a unit that is most likely a mistake
    lengths_have_units = any(units[name] for name in place_columns if name not in ANGLES)
    w0_lacks_unit = "w0" in units and units["w0"] is None
    if w0_lacks_unit and lengths_have_units:
        raise TableError(
            "column w0: has no unit, but the places have one: write w0 [h] or a length, such as "
            "w0 [um]"
        )
    return _finite_rows(
        names, [columns[name] * _factor(units[name], name, lengths) for name in names]
    )


def _factor(unit: str | None, name: str, lengths: Lengths) -> float:
    """Return the size of the unit of a column: over R, or of an angle in rad."""
    if name not in ANGLES:
        return lengths.over_R(unit, name)
    if unit not in (None, "deg", "degree", "degrees", "°", "rad"):
        raise TableError(f"column {name}: its unit {unit} is no angle: degree or rad")
    return 1.0 if unit == "rad" else np.pi / 180


def _finite_rows(names: Sequence[str], columns: Sequence[Array]) -> Scan:
    """Return the rows of columns in which all numbers are finite.

    Parameters
    ----------
    names, columns
        Names, and values of each, which broadcast to one shape.

    Raises
    ------
    TableError
        If shapes differ, there are too many rows, or too few of finite numbers.
    """
    try:
        rows = np.column_stack([np.ravel(column) for column in np.broadcast_arrays(*columns)])
    except ValueError:
        raise TableError("its arrays have different lengths") from None
    if len(rows) > MAX_ROWS:
        raise TableError(
            f"has {len(rows)} rows; allowed at most {MAX_ROWS}: leave out rows, or average "
            "neighbours"
        )
    is_finite = np.isfinite(rows).all(axis=1)
    # fewer rows do not show the shape of the shell
    if is_finite.sum() < max(20, len(rows) // 2):
        raise TableError(
            f"has {is_finite.sum()} rows of finite numbers in {len(rows)}; needed are 20, and "
            "half of the rows"
        )
    return Scan(dict(zip(names, rows[is_finite].T, strict=True)), int((~is_finite).sum()))


@dataclass(frozen=True)
class _Fit:
    """A fitted deviation over R, the element size over R that resolves it, and words about it."""

    function: "ScatteredSpline"
    size: float
    account: str


def _fit_of_scan(standard: float | None, scan: Scan, reference: ReferenceShell) -> _Fit:
    """Return the smooth function through the deviations of a scan.

    Parameters
    ----------
    standard
        Standard deviation of the noise over h; None to estimate it.
    reference
        The shell without the imperfection.

    Raises
    ------
    TableError
        If deviations are too large, or the values leave a hole that is too large to guess.
    """
    import scipy

    from magshell_fenicsx.mesh.scattered_data import fit_scattered

    h, surface = reference.h, reference.perfect.sample()
    places, w0 = _on_surface(scan, reference, surface)
    _refuse_too_deep(w0, h, measured=scan.w0 is not None)
    count = len(w0)
    tree = scipy.spatial.cKDTree(places)
    # typical distance of neighbours: of nine nearest places the first is the place itself, and the
    # last, its eighth neighbour, is taken to be 1.7 spacings away
    eighth_distances, _ = tree.query(places, [9])
    spacing = float(np.median(eighth_distances)) / 1.7
    distances, _ = tree.query(surface)  # from places of the surface to the nearest value
    if distances.max() > max(MAX_HOLE * sqrt(h), MAX_HOLE_OVER_SPACING * spacing):
        place = place_text(surface[np.argmax(distances)])
        raise TableError(
            f"no value lies within {distances.max():.3g} R of the place {place} over R, where the "
            "hole is too large to guess; give values there, w0 = 0 where the shell is perfect"
        )
    # the fit, through means of values that lie close together
    places, w0 = _averaged_in_cubes(places, w0, MERGE_DISTANCE * spacing)
    noise = None if standard is None else standard * h  # None: the fit estimates it
    function = fit_scattered(places, w0, surface, noise=noise)
    # words about it
    estimated = "estimated" if noise is None else "given"
    account = (
        f"{count} values, w0 from {w0.min() / h:.4g} to {w0.max() / h:.4g} h, residual of the fit "
        f"{function.residual / h:.3g} h, noise {function.noise / h:.3g} h ({estimated}), largest "
        f"gap {distances.max():.3g} R"
    )
    lost_rows = f", {scan.lost} rows without a number left out" if scan.lost else ""
    # elements resolve the sharpest bend, but need not be smaller than for the shell's own waves
    size_for_bend = SIZE_OVER_BEND * _sharpest_bend(function, surface, sqrt(h))
    return _Fit(function, max(size_for_bend, MIN_ELEMENT_SIZE * sqrt(h)), account + lost_rows)


def _refuse_too_deep(w0: Array, h: float, *, measured: bool) -> None:
    """Refuse deviations w0 over R that are too large, or no numbers.

    Parameters
    ----------
    h
        Thickness over R.
    measured
        Whether the file has w0; else the places are on the real surface.

    Raises
    ------
    TableError
        With the largest deviation and the limit.
    """
    if not np.abs(w0).max() <= min(MAX_DEPTH_OVER_H * h, MAX_DEPTH_OVER_R):
        unit = (
            "; without a unit in the header, w0 is over h"
            if measured
            else ": are they in the shell's frame?"
        )
        raise TableError(
            f"w0 reaches {np.abs(w0).max() / h:.4g} h; allowed at most "
            f"{min(MAX_DEPTH_OVER_H, MAX_DEPTH_OVER_R / h):.4g}{unit}"
        )


def _on_surface(scan: Scan, reference: ReferenceShell, surface: Array) -> tuple[Array, Array]:
    """Return places (n, 3) on the perfect surface and deviations w0 (n,) of a scan, both over R.

    Columns of angles give places on a sphere or a cylinder. Places x, y, z are replaced by the
    nearest points of the surface, their feet. Without measured deviations, w0 is the height of x,
    y, z above the surface.

    Parameters
    ----------
    surface
        Places (m, 3) all over the perfect surface.

    Raises
    ------
    TableError
        If places are not of this shell, or do not agree with w0.
    """
    import scipy

    columns, w0 = scan.columns, scan.w0
    if "x" not in columns:
        assert w0 is not None
        return _places_of_angles(columns, reference.geometry), w0
    x = np.column_stack([columns[name] for name in "xyz"])
    distance, _ = scipy.spatial.cKDTree(surface).query(x)
    if distance.max() > MAX_DISTANCE_OVER_R:
        row = int(np.argmax(distance))
        raise TableError(
            f"the place {place_text(x[row])} over R is {distance[row]:.3g} R from the shell: give "
            "the columns their unit, such as x [mm], or turn and move them to the shell's frame"
        )
    places, heights = feet(reference.perfect, x)
    if w0 is None:
        return places, heights
    # x, y, z may be on the real surface, at the height w0, or on the perfect one, at zero
    if np.abs(heights).max() > 0.02 + 2 * np.abs(w0).max():
        row = int(np.argmax(np.abs(heights)))
        raise TableError(
            f"the place {place_text(x[row])} over R is {abs(heights[row]):.3g} R from the shell, "
            f"but w0 there is {w0[row]:.3g} R: the unit of one of them is wrong, or it is the "
            "place of another shell"
        )
    return places, w0


def _places_of_angles(columns: dict[str, Array], geometry: str) -> Array:
    """Return the places (n, 3) over R of columns of angles: on a cylinder, or on a sphere.

    Columns without `polar` have azimuth and z, of a cylinder.

    Raises
    ------
    TableError
        If the geometry of the shell is another one.
    """
    polar = columns.get("polar")
    if geometry not in (("cylinder",) if polar is None else ("hemisphere", "cap")):
        angles = (
            "azimuth and z are of a cylinder"
            if polar is None
            else "polar and azimuth are of a sphere"
        )
        raise TableError(f"{angles}; on geometry: {geometry} give x, y, z")
    # distance from the axis and height, over R: of a cylinder, or of a sphere
    rho, z = (1.0, columns["z"]) if polar is None else (np.sin(polar), np.cos(polar))
    return np.column_stack([rho * np.cos(columns["azimuth"]), rho * np.sin(columns["azimuth"]), z])


def _averaged_in_cubes(places: Array, w0: Array, distance: float) -> tuple[Array, Array]:
    """Return the means of places (n, 3) and of w0 (n,) over cubes, so that no two places are equal.

    `distance` is the side of the cubes over R.
    """
    # number of the cube of each place
    _, cube = np.unique(np.floor(places / distance).astype(np.int64), axis=0, return_inverse=True)
    cube = cube.ravel()
    # sums over cubes divided by their numbers of places
    count = np.bincount(cube)
    mean_places = np.column_stack([np.bincount(cube, c) / count for c in places.T])
    return mean_places, np.bincount(cube, w0) / count


def _sharpest_bend(function: "ScatteredSpline", x: Array, length: float) -> float:
    """Return 1/k of the shortest wave sin(k x) that a function resembles; infinite for a constant.

    A wave a sin(k x) has the range 2 a and the largest second derivative a k², so that 1/k is the
    root of half the range over this derivative. The second derivative is estimated by differences.

    Parameters
    ----------
    x
        (n, 3) places over R at which the function is looked at.
    length
        Length over R; the step of the differences is 0.7 times as long.
    """
    x = x[:: max(1, len(x) // 2000)]  # some 2000 places are enough
    w, step = function(x), 0.7 * length
    # sums of the second differences along the three axes, by size
    second_derivatives = (
        sum(np.abs(function(x + step * e) - 2 * w + function(x - step * e)) for e in np.eye(3))
        / step**2
    )
    largest = float(np.nanmax(second_derivatives))
    return float(np.sqrt(np.ptp(w) / 2 / largest)) if largest > 0 else inf


def feet(perfect: "Outline", x: Array) -> tuple[Array, Array]:
    """Return feet (n, 3) of normals through places x (n, 3), and heights (n,) of the places.

    All are over R; heights are above the perfect surface, along its outward normal. On a mesh file
    the surface is made of quadrics through its nodes.
    """
    import scipy

    if (nodes := perfect.nodes) is not None:
        return _on_quadrics(nodes, x)
    if perfect.sphere:
        r = np.linalg.norm(x, axis=1)
        return x / r[:, None], r - 1
    # the iteration begins at the charts of the nearest places of a sample; the chart of each of
    # these is computed only once
    sample = perfect.sample()
    _, nearest_of_place = scipy.spatial.cKDTree(sample).query(x)
    nearest, row_of_place = np.unique(nearest_of_place, return_inverse=True)
    chart = np.array([perfect.inverse(place) for place in sample[nearest]])[row_of_place]
    # the method of Gauss and Newton for the least distance; it converges fast where w0 is small
    # against the radius of curvature
    for _ in range(NEWTON_STEPS):
        # tangents (n, 3, 2) of the surface, by central differences
        differences = [
            (perfect.perfect(chart + e) - perfect.perfect(chart - e)) / (2 * CHART_STEP)
            for e in CHART_STEP * np.eye(2)
        ]
        tangents = np.stack(differences, axis=-1)
        # the step in the chart solves: metric of the surface times step = residual
        residual = np.einsum("nij,ni->nj", tangents, x - perfect.perfect(chart))
        metric = np.einsum("nij,nik->njk", tangents, tangents)
        step = np.linalg.solve(metric, residual[..., None])[..., 0]
        chart = chart + np.clip(step, -0.2, 0.2)  # a long step could leave the chart
        if np.abs(step).max() < 1e-12:
            break
    places = perfect.perfect(chart)
    return places, np.einsum("ij,ij->i", x - places, perfect.normal(chart))


def _on_quadrics(nodes: Array, x: Array) -> tuple[Array, Array]:
    """Return feet (n, 3) and heights (n,) of places x (n, 3) on quadrics through nodes.

    Each place has the quadric z(s, t) through the nodes nearest to it, in the frame of the tangents
    and the normal at the nearest node. The foot is on the normal of the quadric at (s, t) of the
    place, which is exact to first order in the height.

    Parameters
    ----------
    nodes
        (m, 6) places and normals.
    """
    import scipy

    # a node that is given twice would count twice
    nodes = np.unique(nodes.round(14), axis=0)
    # the nearest nodes (n, NODES_PER_QUADRIC) of each place, and the first one's place and normal
    tree = scipy.spatial.cKDTree(nodes[:, :3])
    _, nearest = tree.query(x, NODES_PER_QUADRIC)
    centre, normal = nodes[nearest[:, 0], :3], nodes[nearest[:, 0], 3:]
    normal = normal / np.linalg.norm(normal, axis=1)[:, None]
    frame = _frames_of_normals(normal)
    # coordinates (n, NODES_PER_QUADRIC) of the neighbours in the frame of each place
    s, t, z = np.moveaxis(
        np.einsum("nkj,nij->nki", nodes[nearest, :3] - centre[:, None], frame), -1, 0
    )
    # coefficients of z = a + b s + c t + d s^2 + e s t + f t^2 by least squares
    terms = np.stack([0 * s + 1, s, t, s * s, s * t, t * t], axis=-1)
    quadric = np.linalg.pinv(terms) @ z[..., None]
    a, b, c, d, e, f = quadric[..., 0].T
    # the place itself has the coordinates s = p, t = q, z = height. There the quadric has two
    # slopes; the gap is the distance from the quadric to the place along z
    p, q, height = np.einsum("nj,nij->ni", x - centre, frame).T
    slope_s, slope_t = b + 2 * d * p + e * q, c + e * p + 2 * f * q
    gap = height - (a + b * p + c * q + d * p * p + e * p * q + f * q * q)
    # unit normal of the quadric in the frame; w0 is the component of the gap along it
    upwards = np.stack([-slope_s, -slope_t, 0 * p + 1], axis=-1)
    upwards /= np.linalg.norm(upwards, axis=1)[:, None]
    w0 = gap * upwards[:, 2]
    return x - w0[:, None] * np.einsum("ni,nij->nj", upwards, frame), w0


def _frames_of_normals(normal: Array) -> Array:
    """Return frames (n, 3 vectors, 3 components): two tangents, and the unit normals (n, 3).

    The first tangent is normal to the normal, and to the axis that makes the largest angle with the
    normal.
    """
    first_tangent = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal), axis=1)])
    first_tangent /= np.linalg.norm(first_tangent, axis=1)[:, None]
    return np.stack([first_tangent, np.cross(normal, first_tangent), normal], axis=1)
