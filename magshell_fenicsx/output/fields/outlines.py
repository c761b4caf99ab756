"""Bodies and sources beside a shell: their outlines and faces where amplitudes have driven them, as
.vtp files.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.store.durable import Damaged
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.moving_source import carried
from magshell_fenicsx.shape.solids import Solid

Array = NDArray[np.float64]
ARRAY = re.compile(r'Name="(\w+)" [^>]*>([^<]*)</DataArray>')  # in the files of `vtp_content`
STILL, DRIVEN = "outlines.vtp", "outlines_{:04d}.vtp"  # of all points, or of each
DIGITS = 7  # of the corners of faces


def outlines(loads: Loads, mu: Mapping[str, float], h: float) -> tuple[Array, ...]:
    """Places (n, 3) over R along lines in the model's frame, where the amplitudes have driven
    sources and bodies.
    """
    lines_in_space = list[Array]()
    for each, Q, t, _ in _placed(loads, mu, h):
        lines_in_space += [line @ Q.T + t for line in getattr(each, "lines", ())]
    return tuple(lines_in_space)


def solids(loads: Loads, mu: Mapping[str, float], h: float) -> tuple[Solid, ...]:
    """Their faces, of those that have any."""
    solids_in_space = list[Solid]()
    for each, Q, t, name in _placed(loads, mu, h):
        if solid := getattr(each, "solid", None):
            solids_in_space.append(replace(solid.moved(Q, t), name=solid.name or name))
    return tuple(solids_in_space)


def _placed(
    loads: Loads, mu: Mapping[str, float], h: float
) -> Iterator[tuple[Any, Array, Array, str]]:
    """Bodies and sources, their way since all amplitudes were zero, x -> Q x + t, and the names of
    bodies.
    """
    for contact in loads.contacts:
        yield (
            contact.distance,
            np.eye(3),
            mu.get(contact.amplitude, 0.0) * h * contact.direction,
            contact.body,
        )
    if loads.magnetic is None:
        return
    for part in getattr(loads.magnetic.in_space, "parts", ()):
        yield part, np.eye(3), np.zeros(3), ""
    for driven in loads.magnetic.driven:
        yield driven.of, *carried(driven.motions, mu), ""


def vtp_content(lines: tuple[Array, ...], faces: Sequence[Solid] = ()) -> bytes:
    """The content of a .vtp file; VTK's own writer takes as long as a step of a path.

    `pole` is positive on the half of a magnet with its north pole, `names` are those of the bodies
    and magnets.
    """
    sizes = [len(line) for line in lines]
    starts = np.cumsum([sum(sizes), *(len(solid.points) for solid in faces)])
    corners = [np.round(solid.points, DIGITS) for solid in faces]
    triangles = [solid.triangles + start for solid, start in zip(faces, starts, strict=False)]
    poles = [
        np.zeros(sum(sizes)),
        *(np.zeros(len(s.points)) if s.poles is None else s.poles for s in faces),
    ]
    numbers = np.array([[len(solid.points), len(solid.triangles)] for solid in faces]).reshape(
        -1, 2
    )
    names = "".join(f"{solid.name}\0" for solid in faces).encode()
    about = [
        _array("sizes", "Int64", numbers, f'NumberOfTuples="{len(faces)}"'),
        _array("names", "String", np.frombuffer(names, np.uint8), f'NumberOfTuples="{len(faces)}"'),
    ]
    count = sum(len(each) for each in triangles)
    return (
        '<?xml version="1.0"?>\n<VTKFile type="PolyData" version="0.1" byte_order="LittleEndian"><PolyData>\n'
        f"<FieldData>{''.join(about) if faces else ''}</FieldData>\n"
        f'<Piece NumberOfPoints="{starts[-1]}" NumberOfLines="{len(lines)}" NumberOfPolys="{count}">\n'
        f"<PointData>{_array('pole', 'Float64', np.round(np.concatenate(poles), DIGITS))}</PointData>\n"
        f"<Points>{_array('Points', 'Float64', np.concatenate([*lines, *corners]))}</Points>\n"
        f"<Lines>{_cells(np.arange(sum(sizes)), np.cumsum(sizes))}</Lines>\n"
        f"<Polys>{_cells(np.concatenate([np.zeros((0, 3), int), *triangles]), 3 * np.arange(1, count + 1))}</Polys>\n"
        "</Piece></PolyData></VTKFile>\n"
    ).encode()


def _cells(numbers: NDArray[np.int64], ends: NDArray[np.int64]) -> str:
    return _array("connectivity", "Int64", numbers.ravel()) + _array("offsets", "Int64", ends)


def _array(name: str, kind: str, values: NDArray[Any], more: str = "") -> str:
    width = values.shape[1] if values.ndim > 1 else 1
    text = " ".join(map(repr, values.ravel().tolist()))
    return (
        f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{width}" {more}{" " if more else ""}'
        f'format="ascii">{text}</DataArray>'
    )


def read_outlines(folder: Path, number: int) -> tuple[tuple[Array, ...], tuple[Solid, ...]]:
    """Lines and faces beside the fields of a point; none without any, no faces in the file of an
    earlier version.
    """
    file = folder / DRIVEN.format(number)
    file = file if file.exists() else folder / STILL
    if not file.exists():
        return (), ()
    try:
        return _read(file.read_text(encoding="utf-8"))
    except (KeyError, ValueError, IndexError) as e:
        raise Damaged(f"{file}: is damaged: {type(e).__name__}: {e}") from None


def _read(text: str) -> tuple[tuple[Array, ...], tuple[Solid, ...]]:
    first, _, polys = text.partition("<Polys>")
    parts = {name: each.split() for name, each in ARRAY.findall(first)}
    ends = np.array(parts["offsets"], dtype=int)
    points = np.array(parts["Points"], dtype=float).reshape(-1, 3)
    on_lines = int(ends[-1]) if len(ends) else 0
    lines = tuple(np.split(points[:on_lines], ends[:-1])) if len(ends) else ()
    if "sizes" not in parts:
        return lines, ()
    sizes = np.array(parts["sizes"], dtype=int).reshape(-1, 2)
    names = bytes(int(code) for code in parts["names"]).decode().split("\0")
    triangles = np.array(dict(ARRAY.findall(polys))["connectivity"].split(), dtype=int).reshape(
        -1, 3
    )
    poles, solids, start, first_one = (
        np.array(parts["pole"], dtype=float),
        list[Solid](),
        on_lines,
        0,
    )
    for name, (n, m) in zip(names, sizes, strict=False):
        own = poles[start : start + n]
        numbers = triangles[first_one : first_one + m] - start
        if numbers.size and not 0 <= numbers.min() <= numbers.max() < n:
            raise IndexError(name)
        solids.append(Solid(points[start : start + n], numbers, name, own if own.any() else None))
        start, first_one = start + n, first_one + m
    return lines, tuple(solids)
