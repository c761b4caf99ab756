"""Maps of the magnetic field on planes: its lines and |B|, with the section of the shell.

A `MapGrid` has a corner, two sides (a plane) or three (a box), numbers of points along them, and
the flux density B at the points, which are numbered along the first side, then along the next one;
places are over the reference length R. A case without units has no R in metres: nan stands for it.
A section is the set of lines in which a plane meets a surface. In a picture the first side of a
plane is to the right, the second one up.
"""

from collections.abc import Mapping, Sequence
from math import isnan
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.layout import INCH, ONE_COLUMN, TWO_COLUMNS, columns, drawing
from magshell_fenicsx.output.pictures.readings import unit_of
from magshell_fenicsx.output.pictures.scales import number_format
from magshell_fenicsx.output.pictures.sections import plane_section
from magshell_fenicsx.parts.observables import MapGrid
from magshell_fenicsx.problem.requests import OutputSection

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.path import Path as MatplotlibPath

Array = NDArray[np.float64]
MAX_MAPS = 6  # in the picture
MIN_RATIO_OF_LOGARITHMS = 10.0  # of the sizes of B, from which colours are logarithms
DECADES = 3.0  # powers of ten of colours that are logarithms
MIN_IN_PLANE_PART = 1e-6  # of |B|: a smaller part in the plane has no lines
MARGIN = 1.5  # inches of a panel above and below its map: title, axis, colours
MAP_WIDTH, MAX_MAP_HEIGHT = 0.78, 2.0  # over a panel's width
PARALLEL = 1 - 1e-12  # least cosine of parallel directions
NEIGHBOUR_DISTANCE = 1.5  # cells: of a neighbour, also across a corner
LINE_DENSITY = 1.2  # of field lines, as matplotlib counts it
LENGTH_TOLERANCE = 1e-7  # relative: a line without length, where a corner is on the plane
LINE_WIDTH = 0.6  # points: around the section of the shell, whose thickness is true
TINY = 1e-300  # least divisor


def field_maps_figure(
    maps: Sequence[tuple[MapGrid, float]],
    surface: Surface,
    h: float,
    case: Mapping[str, Any],
    style: OutputSection,
) -> "Figure":
    """Return the figure of magnetic fields on planes: |B| in colours, and field lines in the plane.

    A box is shown by its plane nearest to the middle.

    Parameters
    ----------
    maps
        Grids, and R in metres.
    surface
        The whole deformed shell, in the frame of the case.
    h
        Its thickness over R.
    case
        The case of summary.json.
    """
    from matplotlib.figure import Figure

    shown_maps = maps[:MAX_MAPS]
    panels_per_row = columns(len(shown_maps))
    row_count = -(-len(shown_maps) // panels_per_row)  # rounded up
    width = (style.width or (ONE_COLUMN if panels_per_row == 1 else TWO_COLUMNS)) / INCH
    with drawing(style):
        side_lengths = [np.linalg.norm(grid.sides, axis=1) for grid, _ in shown_maps]
        # height over width of the tallest map, since all rows have one height
        ratio = max(float(second / first) for first, second, *_ in side_lengths)
        row_height = MARGIN + MAP_WIDTH * min(ratio, MAX_MAP_HEIGHT) * width / panels_per_row
        figure = Figure(
            figsize=(width, row_height * row_count), dpi=style.dpi, layout="constrained"
        )
        grid_of_axes = figure.subplots(row_count, panels_per_row, squeeze=False).ravel()
        for axes, (grid, R) in zip(grid_of_axes, shown_maps, strict=False):
            plane = plane_of(grid)
            _draw(axes, plane, R, surface, h, case, with_name=len(shown_maps) > 1)
        for axes in grid_of_axes[len(shown_maps) :]:
            axes.set_axis_off()
    return figure


def plane_of(grid: MapGrid) -> MapGrid:
    """Return the grid itself if it is a plane; of a box the layer nearest to its middle."""
    if len(grid.points) == 2:
        return grid
    nx, ny, nz = grid.points
    layer = nz // 2
    corner = grid.corner + layer / (nz - 1) * grid.sides[2]
    values = grid.values.reshape(nz, ny, nx, 3)[layer].reshape(-1, 3)
    return MapGrid(grid.name, corner, grid.sides[:2], (nx, ny), grid.unit, grid.words, values)


def section(surface: Surface, grid: MapGrid) -> Array:
    """Return the lines (n, 2, 3) over R in which a deformed surface meets the plane of a grid."""
    return plane_section(surface, surface.r0 + surface.u, grid.corner, np.cross(*grid.sides))


def _draw(
    axes: "Axes",
    grid: MapGrid,
    R: float,
    surface: Surface,
    h: float,
    case: Mapping[str, Any],
    *,
    with_name: bool,
) -> None:
    """Draw the field on a plane grid in axes, with the section of the shell.

    Parameters
    ----------
    R
        In metres; nan for a case without units.
    h
        Thickness over R.
    case
        The case of summary.json.
    with_name
        Whether the title has the name of the map, which tells it from others.
    """
    # factor from values of B in the grid to the drawn unit, and its name
    size_of_unit, unit = unit_of(case)
    length_of_R = 1.0 if isnan(R) else 1e3 * R  # in mm, or in R itself
    directions = grid.sides / np.linalg.norm(grid.sides, axis=1)[:, None]
    nx, ny = grid.points
    # coordinates of the points along both sides, in the unit of the picture
    x, y = (
        length_of_R * (e @ grid.corner + np.linspace(0, np.linalg.norm(side), n))
        for e, side, n in zip(directions, grid.sides, grid.points, strict=True)
    )
    B = size_of_unit * grid.values.reshape(ny, nx, 3)
    magnitude = np.linalg.norm(B, axis=-1)
    norm, largest, is_logarithmic = _colour_norm(magnitude)
    # half a distance of points beyond the first and the last ones, where the limits of axes cut it
    half_x, half_y = (float(values[1] - values[0]) / 2 for values in (x, y))
    image = axes.imshow(
        masked(_without_steps(magnitude)),
        norm=norm,
        cmap="viridis",
        interpolation="bilinear",
        origin="lower",
        extent=(x[0] - half_x, x[-1] + half_x, y[0] - half_y, y[-1] + half_y),
    )
    _draw_field_lines(axes, x, y, [B @ e for e in directions], largest)
    lines = section(surface, grid)
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), aspect="equal")
    axes.set(xlabel=_direction(directions[0], R), ylabel=_direction(directions[1], R))
    place = _place(grid, directions, length_of_R, R)
    name = f"{grid.name.replace('_', ' ')}\n" if with_name else ""
    axes.set_title(f"{name}{grid.words} field{place}")
    bar = axes.figure.colorbar(
        image, ax=axes, label=f"$|B|$  {unit}", location="bottom", fraction=0.05
    )
    if not is_logarithmic:
        bar.ax.xaxis.set_major_formatter(number_format())
    plane_lines = length_of_R * np.stack([lines @ e for e in directions], axis=-1)
    _draw_section(axes, plane_lines, length_of_R * h, is_body=surface.is_body)


def _without_steps(values: Array) -> Array:
    """Return values (ny, nx) whose nan have the nearest value, where that is at a neighbour.

    So no steps of white cells are beside the section of the shell, in which there is no value.
    """
    from scipy.ndimage import distance_transform_edt

    is_absent = np.isnan(values)
    if is_absent.all() or not is_absent.any():
        return values
    distance, (rows, columns) = distance_transform_edt(is_absent, return_indices=True)
    return np.where(distance <= NEIGHBOUR_DISTANCE, values[rows, columns], np.nan)


def _draw_field_lines(
    axes: "Axes", x: Array, y: Array, in_plane: Sequence[Array], largest: float
) -> None:
    """Draw the lines of a field in axes, unless the field is normal to the plane.

    Parameters
    ----------
    x, y
        (nx,) and (ny,) coordinates of the points in the axes.
    in_plane
        Components (ny, nx) of B along x and along y.
    largest
        Largest |B| at any point.
    """
    largest_in_plane = max(
        float(np.nanmax(np.abs(component), initial=0.0)) for component in in_plane
    )
    if largest_in_plane > MIN_IN_PLANE_PART * largest:
        along_x, along_y = (masked(component) for component in in_plane)
        axes.streamplot(
            x,
            y,
            along_x,
            along_y,
            color="white",
            linewidth=0.6,
            density=LINE_DENSITY,
            arrowsize=0.6,
        )


def _draw_section(axes: "Axes", lines: Array, thickness: float, *, is_body: bool) -> None:
    """Draw the section of a shell with its thickness, or of a solid, in dark grey.

    Parameters
    ----------
    lines
        (n, 2, 2) lines in which the plane meets the mid-surface, or the surface of the solid.
    thickness
        Thickness of the shell in the unit of the axes.
    is_body
        Whether the lines are those of a solid, which enclose its section.
    """
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import PathPatch

    if is_body:
        area = with_holes(outlines(lines))
        axes.add_patch(PathPatch(area, color="0.15", linewidth=LINE_WIDTH))
    else:
        rectangles = list(_thickened(lines, thickness))
        collection = PolyCollection(rectangles, color="0.15", linewidth=LINE_WIDTH)
        axes.add_collection(collection, autolim=False)


def _colour_norm(magnitude: Array) -> tuple["Normalize", float, bool]:
    """Return the norm of colours for |B|, the largest |B|, and whether the norm is logarithmic.

    `magnitude` is |B| (ny, nx), with nan where there is no value.
    """
    from matplotlib.colors import LogNorm, Normalize

    low = float(np.nanmin(magnitude, initial=np.inf))
    high = float(np.nanmax(magnitude, initial=0.0))
    if high <= 0:
        low, high = 0.0, 1.0
    if low * MIN_RATIO_OF_LOGARITHMS < high:  # a wide range, as near a magnet
        return LogNorm(max(low, high / 10**DECADES), high), high, True
    return Normalize(low, high), high, False


def _thickened(lines: Array, h: float) -> Array:
    """Return lines (n, 2, 2) as rectangles (n, 4, 2) of width h around them."""
    vectors = lines[:, 1] - lines[:, 0]
    offsets = np.stack([-vectors[:, 1], vectors[:, 0]], axis=-1)
    # half of h across each line; of a line without length the rectangle is a point
    offsets *= h / 2 / np.maximum(np.linalg.norm(offsets, axis=1), TINY)[:, None]
    return np.stack(
        [
            lines[:, 0] - offsets,
            lines[:, 1] - offsets,
            lines[:, 1] + offsets,
            lines[:, 0] + offsets,
        ],
        axis=1,
    )


def outlines(lines: Array) -> list[Array]:
    """Return the closed polygons (k, 2) that lines (n, 2, 2) form, given in any order.

    Ends of two lines that are at one point are connected there.
    """
    from scipy.spatial import cKDTree  # takes long to import

    lengths = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    lines = lines[lengths > LENGTH_TOLERANCE * np.abs(lines).max(initial=0.0)]
    if not len(lines):
        return []
    ends = lines.reshape(-1, 2)
    # of each end the two nearest ends, itself among them
    _, nearest = cKDTree(ends).query(ends, k=2)
    numbers = np.arange(len(ends))
    # of each end the end of another line at the same point; ends 2 i and 2 i + 1 belong to line i
    twin = np.where(nearest[:, 0] == numbers, nearest[:, 1], nearest[:, 0])
    remaining, polygons = set(range(len(lines))), list[Array]()
    while remaining:  # a polygon in each turn
        line, polygon = remaining.pop(), list[Array]()
        end = 2 * line + 1
        while True:
            polygon.append(ends[end])
            # go on along the line that begins at this end; if that is in a polygon already, this
            # polygon is closed
            next_end = int(twin[end])
            if next_end // 2 not in remaining:
                break
            remaining.remove(next_end // 2)
            end = next_end ^ 1  # the other end of that line
        polygons.append(np.array(polygon))
    return polygons


def with_holes(polygons: Sequence[Array]) -> "MatplotlibPath":
    """Return the area between polygons (n, 2) as a path of matplotlib.

    A polygon within an odd number of others is a hole.
    """
    from matplotlib.path import Path as MatplotlibPath

    paths = [
        MatplotlibPath(np.append(polygon, polygon[:1], axis=0), closed=True) for polygon in polygons
    ]
    oriented = list[MatplotlibPath]()
    for path, polygon in zip(paths, polygons, strict=True):
        x, y = polygon.T
        corner = x[0], y[0]
        enclosing_count = sum(
            other_path is not path and other_path.contains_point(corner) for other_path in paths
        )
        is_hole = enclosing_count % 2
        is_clockwise = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) < 0
        # matplotlib fills between outlines of opposite directions: holes are clockwise
        if is_clockwise != is_hole:
            path = MatplotlibPath(np.asarray(path.vertices)[::-1], path.codes)
        oriented.append(path)
    return MatplotlibPath.make_compound_path(*oriented)


def masked(values: Array) -> Any:
    """Return values as a masked array without its nan."""
    return np.ma.masked_array(values, np.isnan(values))  # type: ignore[no-untyped-call]


def _place(grid: MapGrid, directions: Array, length: float, R: float) -> str:
    """Return words for the place of a plane of constant x, y or z, such as ", $z$ = 5 mm".

    Empty for other planes.

    Parameters
    ----------
    directions
        (2, 3) unit vectors along the sides.
    length
        R in the unit of the picture.
    R
        In metres; nan without units.
    """
    normal = np.abs(np.cross(*directions))
    number = int(normal.argmax())
    if normal[number] < PARALLEL:
        return ""
    unit = "$R$" if isnan(R) else "mm"
    # adding zero turns a negative zero into zero
    return f", ${'xyz'[number]}$ = {length * grid.corner[number] + 0.0:.4g} {unit}"


def _direction(e: Array, R: float) -> str:
    """Return the label of the picture's axis along a unit vector e (3,); R is nan without units."""
    unit = "/ $R$" if isnan(R) else "(mm)"
    for number, name in enumerate("xyz"):
        if abs(e[number]) > PARALLEL:
            return f"{'−' if e[number] < 0 else ''}${name}$  {unit}"
    return f"along ({', '.join(f'{component:.3g}' for component in e)})  {unit}"
