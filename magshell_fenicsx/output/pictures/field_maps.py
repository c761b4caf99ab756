"""Maps of the magnetic field on planes: its lines and |B|, beside the section of the shell."""

from collections.abc import Mapping, Sequence
from math import isnan
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.tessellation import tessellated
from magshell_fenicsx.output.pictures.layout import INCH, ONE, SEVERAL, columns, drawing
from magshell_fenicsx.output.pictures.readings import unit_of
from magshell_fenicsx.output.pictures.scales import number_format
from magshell_fenicsx.parts.seen import MapGrid
from magshell_fenicsx.problem.wanted import OutputSection

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.path import Path as MatplotlibPath

Array = NDArray[np.float64]
MOST = 6  # maps in the picture
LEAST, DECADES = (
    10.0,
    3.0,
)  # ratio of the sizes from which colours are logarithms, and how many powers of ten
FLAT = 1e-6  # of |B|: a part in the plane as small as this has no lines
MARGIN = 1.5  # inches of a panel above and below its map: title, axis, colours
BODY, TALLEST = 0.78, 2.0  # of a panel's width: how wide and tall its map is
PARALLEL = 1 - 1e-12
ON_PLANE = 1e-9  # over R
DENSITY = 1.2  # of lines
SHORT = 1e-7  # a line of no length, relative: where a corner is on the plane
LINE_WIDTH, TINY = 0.6, 1e-300  # points: around the section of the shell, whose thickness is true


def field_maps_figure(
    maps: Sequence[tuple[MapGrid, float]],
    surface: Surface,
    h: float,
    case: Mapping[str, Any],
    style: OutputSection,
) -> "Figure":
    """Draw |B| in colours and the lines of the part in the plane; of a box the plane nearest to its
    middle.

    Parameters
    ----------
    maps
        Grids, and R in metres.
    surface
        The whole deformed shell, in the frame of the case.
    h
        Its thickness over R.
    case
        As in summary.json.
    """
    from matplotlib.figure import Figure

    shown = maps[:MOST]
    across = columns(len(shown))
    high, wide = -(-len(shown) // across), (style.width or (ONE if across == 1 else SEVERAL)) / INCH
    with drawing(style):
        ratio = max(
            float(np.linalg.norm(grid.sides[1]) / np.linalg.norm(grid.sides[0]))
            for grid, _ in shown
        )
        tall = MARGIN + BODY * min(ratio, TALLEST) * wide / across
        figure = Figure(figsize=(wide, tall * high), dpi=style.dpi, layout="constrained")
        grid_of_axes = figure.subplots(high, across, squeeze=False).ravel()
        for axes, (grid, R) in zip(grid_of_axes, shown, strict=False):
            _draw(axes, plane_of(grid), R, surface, h, case)
        for axes in grid_of_axes[len(shown) :]:
            axes.set_axis_off()
    return figure


def plane_of(grid: MapGrid) -> MapGrid:
    """The grid itself; of a box the layer that is nearest to the middle of its third side."""
    if len(grid.points) == 2:
        return grid
    nx, ny, nz = grid.points
    layer = nz // 2
    corner = grid.corner + layer / (nz - 1) * grid.sides[2]
    values = grid.values.reshape(nz, ny, nx, 3)[layer].reshape(-1, 3)
    return MapGrid(grid.name, corner, grid.sides[:2], (nx, ny), grid.unit, grid.words, values)


def section(surface: Surface, grid: MapGrid) -> Array:
    """Where the deformed mid-surface, or the surface of a solid, meets the plane of a grid: lines
    (n, 2, 3), over R.
    """
    pieces = tessellated(surface)
    places = pieces.at(surface.r0 + surface.u)
    normal = np.cross(*grid.sides)
    height = (places - grid.corner) @ (normal / np.linalg.norm(normal))
    height = np.where(
        np.abs(height) < ON_PLANE, ON_PLANE, height
    )  # on one side of it, in all pieces
    corners, heights = places[pieces.triangles], height[pieces.triangles]
    crossed = np.abs(np.sign(heights).sum(axis=1)) < 3
    corners, heights = corners[crossed], heights[crossed]
    alone = np.where(
        np.sign(heights).sum(axis=1) > 0, heights.argmin(axis=1), heights.argmax(axis=1)
    )
    rows, ends = np.arange(len(corners)), list[Array]()
    for way in (1, 2):
        other = (alone + way) % 3
        a, b = heights[rows, alone], heights[rows, other]
        share = (a / (a - b))[:, None]
        ends.append((1 - share) * corners[rows, alone] + share * corners[rows, other])
    return np.stack(ends, axis=1)


def _draw(
    axes: "Axes", grid: MapGrid, R: float, surface: Surface, h: float, case: Mapping[str, Any]
) -> None:
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.patches import PathPatch

    size_of_unit, unit = unit_of(case)
    length = 1.0 if isnan(R) else 1e3 * R
    units = grid.sides / np.linalg.norm(grid.sides, axis=1)[:, None]
    nx, ny = grid.points
    x, y = (
        length * (e @ grid.corner + np.linspace(0, np.linalg.norm(side), n))
        for e, side, n in zip(units, grid.sides, grid.points, strict=True)
    )
    B = size_of_unit * grid.values.reshape(ny, nx, 3)
    size = np.linalg.norm(B, axis=-1)
    low, top = (
        float(each(size, initial=start)) for each, start in ((np.nanmin, np.inf), (np.nanmax, 0.0))
    )
    low, top = (low, top) if top > 0 else (0.0, 1.0)
    wide = low * LEAST < top
    norm = LogNorm(max(low, top / 10**DECADES), top) if wide else Normalize(low, top)
    image = axes.pcolormesh(x, y, masked(size), norm=norm, cmap="viridis", shading="nearest")
    along = [masked(B @ e) for e in units]
    if any(float(np.nanmax(np.abs(B @ e), initial=0.0)) > FLAT * top for e in units):
        axes.streamplot(
            x, y, along[0], along[1], color="white", linewidth=0.6, density=DENSITY, arrowsize=0.6
        )
    lines = section(surface, grid)
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), aspect="equal")
    axes.set(xlabel=_direction(units[0], R), ylabel=_direction(units[1], R))
    axes.set_title(
        f"{grid.name.replace('_', ' ')}\n{grid.words} field{_place(grid, units, length, R)}"
    )
    bar = axes.figure.colorbar(
        image, ax=axes, label=f"$|B|$  {unit}", location="bottom", fraction=0.05
    )
    if not wide:
        bar.ax.xaxis.set_major_formatter(number_format())
    flat = length * np.stack([lines @ e for e in units], axis=-1)
    if surface.is_body:
        axes.add_patch(PathPatch(with_holes(outlines(flat)), color="0.15", linewidth=LINE_WIDTH))
    else:
        drawn = list(_thickened(flat, length * h))
        axes.add_collection(
            PolyCollection(drawn, color="0.15", linewidth=LINE_WIDTH), autolim=False
        )


def _thickened(lines: Array, h: float) -> Array:
    """Lines (n, 2, 2) as rectangles (n, 4, 2) of a width."""
    along = lines[:, 1] - lines[:, 0]
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    across *= h / 2 / np.maximum(np.linalg.norm(across, axis=1), TINY)[:, None]
    return np.stack(
        [lines[:, 0] - across, lines[:, 1] - across, lines[:, 1] + across, lines[:, 0] + across],
        axis=1,
    )


def outlines(lines: Array) -> list[Array]:
    """The polygons that lines (n, 2, 2) with common ends make, in any order."""
    from scipy.spatial import cKDTree  # takes long to import

    lines = lines[
        np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1) > SHORT * np.abs(lines).max(initial=0.0)
    ]
    if not len(lines):
        return []
    ends = lines.reshape(-1, 2)
    nearest, own = cKDTree(ends).query(ends, k=2)[1], np.arange(len(ends))
    beside = np.where(nearest[:, 0] == own, nearest[:, 1], nearest[:, 0])
    left, polygons = set(range(len(lines))), list[Array]()
    while left:
        line, polygon = left.pop(), list[Array]()
        end = 2 * line + 1
        while True:
            polygon.append(ends[end])
            following = int(beside[end])
            if following // 2 not in left:
                break
            left.remove(following // 2)
            end = following ^ 1  # the other end of that line
        polygons.append(np.array(polygon))
    return polygons


def with_holes(polygons: Sequence[Array]) -> "MatplotlibPath":
    """The area between polygons (n, 2): those within an odd number of others are holes."""
    from matplotlib.path import Path as MatplotlibPath

    paths = [MatplotlibPath(np.append(each, each[:1], axis=0), closed=True) for each in polygons]
    turned = list[MatplotlibPath]()
    for path, (x, y) in zip(paths, (each.T for each in polygons), strict=True):
        hole = sum(other is not path and other.contains_point((x[0], y[0])) for other in paths) % 2
        right = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) < 0
        turned.append(
            MatplotlibPath(np.asarray(path.vertices)[::-1], path.codes) if right != hole else path
        )
    return MatplotlibPath.make_compound_path(*turned)


def masked(values: Array) -> Any:
    """Values without those that are nan."""
    return np.ma.masked_array(values, np.isnan(values))  # type: ignore[no-untyped-call]


def _place(grid: MapGrid, units: Array, length: float, R: float) -> str:
    """Where a plane is, if it is one of x, y or z."""
    e = np.abs(np.cross(*units))
    number = int(e.argmax())
    if e[number] < PARALLEL:
        return ""
    unit = "$R$" if isnan(R) else "mm"
    return f", ${'xyz'[number]}$ = {length * grid.corner[number] + 0.0:.4g} {unit}"


def _direction(e: Array, R: float) -> str:
    """What stands along an axis of the picture."""
    unit = "/ $R$" if isnan(R) else "(mm)"
    for number, name in enumerate("xyz"):
        if abs(e[number]) > PARALLEL:
            return f"{'−' if e[number] < 0 else ''}${name}$  {unit}"
    return f"along ({', '.join(f'{v:.3g}' for v in e)})  {unit}"
