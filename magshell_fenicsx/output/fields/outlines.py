"""Bodies and field sources beside a shell, as .vtp files: their outlines and faces.

They are drawn where the amplitudes have driven them. An amplitude is a load parameter, by name; mu
maps names to values. A `Solid` is a body or a magnet: corners, triangles between them, and at each
corner of a magnet its pole strength, positive on the north half. h and R are thickness and
reference length; places are over R.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.store.durable import errors_as_damage, read_result
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.moving_source import combined_motion
from magshell_fenicsx.shape.drawn_bodies import Solid

Array = NDArray[np.float64]
ARRAY = re.compile(r'Name="(\w+)" [^>]*>([^<]*)</DataArray>')  # in the files of `vtp_content`
FILE_OF_ALL_POINTS = "outlines.vtp"  # where nothing moves
FILE_OF_POINT = "outlines_{:04d}.vtp"
DIGITS = 7  # decimals of the corners of faces, over R


def outlines(loads: Loads, mu: Mapping[str, float], h: float) -> tuple[Array, ...]:
    """Return places (n, 3) over R along the lines of bodies and sources, in the model's frame.

    Parameters
    ----------
    loads
        Bodies and magnetic fields.
    mu
        Amplitudes, which drive bodies and sources.
    h
        Thickness over R.
    """
    lines_in_space = list[Array]()
    for drawn_object, Q, t, _ in _placed_objects(loads, mu, h):
        lines_in_space += [line @ Q.T + t for line in getattr(drawn_object, "lines", ())]
    return tuple(lines_in_space)


def solids(loads: Loads, mu: Mapping[str, float], h: float) -> tuple[Solid, ...]:
    """Return the faces of bodies and sources over R, in the model's frame.

    Parameters
    ----------
    loads
        Bodies and magnetic fields.
    mu
        Amplitudes, which drive bodies and sources.
    h
        Thickness over R.
    """
    solids_in_space = list[Solid]()
    for drawn_object, Q, t, name in _placed_objects(loads, mu, h):
        if solid := getattr(drawn_object, "solid", None):
            solids_in_space.append(replace(solid.transformed(Q, t), name=solid.name or name))
    return tuple(solids_in_space)


def _placed_objects(
    loads: Loads, mu: Mapping[str, float], h: float
) -> Iterator[tuple[Any, Array, Array, str]]:
    """Yield (object, Q, t, name) of bodies and sources, with their rigid motion x -> Q x + t.

    The motion begins at the place where all amplitudes `mu` are zero. Sources have an empty name.
    `h` is the thickness over R.
    """
    for contact in loads.contacts:  # the amplitude of a body is its approach, over h
        translation = mu.get(contact.amplitude, 0.0) * h * contact.direction
        yield contact.distance, np.eye(3), translation, contact.body
    if loads.magnetic is None:
        return
    # a uniform field has no parts, that is no sources
    for part_of_field in getattr(loads.magnetic.in_space, "parts", ()):
        yield part_of_field, np.eye(3), np.zeros(3), ""
    for moving_source in loads.magnetic.driven:
        Q, t = combined_motion(moving_source.motions, mu)
        yield moving_source.at_rest, Q, t, ""


def vtp_content(lines: tuple[Array, ...], faces: Sequence[Solid] = ()) -> bytes:
    """Return outlines and faces as the content of a .vtp file.

    The XML is written here, because VTK's own writer takes as long as a step of a path. The points
    of all lines come first, then the corners of the solids. The array `pole` is positive on the
    north half of a magnet. The arrays `names` and `sizes` have the name, the number of corners and
    the number of triangles of each body or magnet.

    Parameters
    ----------
    lines
        Places (n, 3) along each line.
    faces
        Faces of bodies and magnets.
    """
    # points: those of lines, then the corners of solids
    line_sizes = [len(line) for line in lines]
    # number of each solid's first corner, after the points of lines; at last that of all points
    starts = np.cumsum([sum(line_sizes), *(len(solid.points) for solid in faces)])
    corners = [np.round(solid.points, DIGITS) for solid in faces]  # short numbers, small files
    triangles = [solid.triangles + start for solid, start in zip(faces, starts, strict=False)]
    poles = [
        np.zeros(sum(line_sizes)),  # points of lines are no poles
        *(_poles_of(solid) for solid in faces),
    ]
    # what tells the solids apart: numbers of corners and triangles, and names, which are texts as
    # bytes with a zero after each
    counts = [[len(solid.points), len(solid.triangles)] for solid in faces]
    sizes = np.array(counts).reshape(-1, 2)
    names = "".join(f"{solid.name}\0" for solid in faces).encode()
    field_data = [
        _array("sizes", "Int64", sizes, f'NumberOfTuples="{len(faces)}"'),
        _array("names", "String", np.frombuffer(names, np.uint8), f'NumberOfTuples="{len(faces)}"'),
    ]
    # the XML of the arrays of all points and of all triangles
    count = sum(len(triangles_of_solid) for triangles_of_solid in triangles)
    corners_of_triangles = np.concatenate([np.zeros((0, 3), int), *triangles])
    pole = _array("pole", "Float64", np.round(np.concatenate(poles), DIGITS))
    points = _array("Points", "Float64", np.concatenate([*lines, *corners]))
    polys = _cells(corners_of_triangles, 3 * np.arange(1, count + 1))
    return (
        '<?xml version="1.0"?>\n'
        '<VTKFile type="PolyData" version="0.1" byte_order="LittleEndian"><PolyData>\n'
        f"<FieldData>{''.join(field_data) if faces else ''}</FieldData>\n"
        f'<Piece NumberOfPoints="{starts[-1]}" NumberOfLines="{len(lines)}" '
        f'NumberOfPolys="{count}">\n'
        f"<PointData>{pole}</PointData>\n"
        f"<Points>{points}</Points>\n"
        f"<Lines>{_cells(np.arange(sum(line_sizes)), np.cumsum(line_sizes))}</Lines>\n"
        f"<Polys>{polys}</Polys>\n"
        "</Piece></PolyData></VTKFile>\n"
    ).encode()


def _poles_of(solid: Solid) -> Array:
    """Return the pole strengths at the corners of a solid; zero for a body that is no magnet."""
    return np.zeros(len(solid.points)) if solid.poles is None else solid.poles


def _cells(numbers: NDArray[np.int64], ends: NDArray[np.int64]) -> str:
    """Return the XML of cells from all their node numbers; `ends` is where each cell ends."""
    return _array("connectivity", "Int64", numbers.ravel()) + _array("offsets", "Int64", ends)


def _array(name: str, kind: str, values: NDArray[Any], attributes: str = "") -> str:
    """Return the XML of an array in text form.

    Parameters
    ----------
    name
        Name of the array in the file.
    kind
        VTK's name of the type of its numbers, such as Int64.
    values
        (n,) or (n, components).
    attributes
        Further attributes of the XML element.
    """
    width = values.shape[1] if values.ndim > 1 else 1
    text = " ".join(map(repr, values.ravel().tolist()))
    space = " " if attributes else ""
    return (
        f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{width}" {attributes}{space}'
        f'format="ascii">{text}</DataArray>'
    )


def read_outlines(folder: Path, number: int) -> tuple[tuple[Array, ...], tuple[Solid, ...]]:
    """Return lines and faces of bodies and sources at point `number`, from a folder of fields.

    Both are empty without a file. The file of an earlier version has no faces.

    Raises
    ------
    Damaged
        If the file cannot be read.
    """
    file = folder / FILE_OF_POINT.format(number)
    file = file if file.exists() else folder / FILE_OF_ALL_POINTS
    if not file.exists():
        return (), ()
    content = read_result(file)
    with errors_as_damage(file):
        return _read(content.decode())


def _read(text: str) -> tuple[tuple[Array, ...], tuple[Solid, ...]]:
    """Return the lines and the faces in the text of a .vtp file that `vtp_content` made.

    Raises KeyError, ValueError or IndexError for other texts.
    """
    # lines and faces have arrays of the same names, so the text is divided first
    before_faces, _, polys = text.partition("<Polys>")
    arrays = {name: text_of_array.split() for name, text_of_array in ARRAY.findall(before_faces)}
    line_ends = np.array(arrays["offsets"], dtype=int)
    points = np.array(arrays["Points"], dtype=float).reshape(-1, 3)
    # points of lines come first, then the corners of solids
    on_lines = int(line_ends[-1]) if len(line_ends) else 0
    lines = tuple(np.split(points[:on_lines], line_ends[:-1])) if len(line_ends) else ()
    if "sizes" not in arrays:  # without faces, or of an earlier version
        return lines, ()
    solid_counts = np.array(arrays["sizes"], dtype=int).reshape(-1, 2)
    names = bytes(int(code) for code in arrays["names"]).decode().split("\0")
    connectivity = dict(ARRAY.findall(polys))["connectivity"].split()
    triangles = np.array(connectivity, dtype=int).reshape(-1, 3)
    poles, solids = np.array(arrays["pole"], dtype=float), list[Solid]()
    first_corner, first_triangle = on_lines, 0
    # a zero ends the last name too, so that an empty text is left after the names of all solids
    for name, (corner_count, triangle_count) in zip(names, solid_counts, strict=False):
        next_corner = first_corner + corner_count
        next_triangle = first_triangle + triangle_count
        pole_values = poles[first_corner:next_corner]
        # numbers of corners begin at zero in each solid
        numbers = triangles[first_triangle:next_triangle] - first_corner
        if numbers.size and not 0 <= numbers.min() <= numbers.max() < corner_count:
            raise IndexError(name)
        poles_of_magnet = pole_values if pole_values.any() else None
        solids.append(Solid(points[first_corner:next_corner], numbers, name, poles_of_magnet))
        first_corner, first_triangle = next_corner, next_triangle
    return lines, tuple(solids)
