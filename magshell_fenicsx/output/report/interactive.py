"""The part of a report to play with: the deformed shell to turn, a slider along the path, the curve
linked to it.

All data stand in the page: the rows of path.csv as JSON, the shells as small integers, compressed.
"""

import base64
import importlib.util
import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import SHELL, Surface, on_nodes_of
from magshell_fenicsx.output.fields.tessellation import Tessellation, tessellated
from magshell_fenicsx.output.fields.vtu import point_file, read_point
from magshell_fenicsx.output.pictures.colours import SCALARS, WITH_SIGN, couple
from magshell_fenicsx.output.pictures.lines import (
    Part,
    axes_for,
    drawn_parts,
    is_unstable,
    line_coordinates,
    named,
    of_load,
)
from magshell_fenicsx.output.pictures.scales import NEAR, SIGNED, colour_map, from_zero
from magshell_fenicsx.output.pictures.view import near_outlines, near_solids, run_camera
from magshell_fenicsx.output.store.known import headline, pole_of, style_of
from magshell_fenicsx.output.store.table import LOCATED, SOLUTION, Row, read_rows
from magshell_fenicsx.platform.disk_cache import load_cached, save_cached
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import amplitude, quantity
from magshell_fenicsx.shape.drawn_bodies import Solid

Array = NDArray[np.float64]
SAME = 1e-7  # places over R that are one vertex
MOST = 8000  # triangles of a curved mesh
STOPS = 33  # of a colour map


@dataclass(frozen=True)
class Thinned:
    """Vertices that represent a surface, and triangles (m, 3) of their numbers."""

    pieces: Tessellation
    kept: NDArray[np.int64]
    triangles: NDArray[np.int64]

    @property
    def count(self) -> int:
        """The number of vertices."""
        return len(self.kept)

    def at(self, values: Array) -> Array:
        """Values of nodes at the vertices."""
        return self.pieces.at(values)[self.kept]


def thinned(surface: Surface, most: int) -> Thinned:
    """The surface in at most about `most` vertices; where there are more, those within a small cube
    become one.
    """
    pieces = tessellated(surface, MOST)
    r, size = pieces.at(surface.r0), SAME
    kept, triangles = _joined(r, pieces.triangles, size)
    size = 0.5 * float(np.ptp(r, axis=0).max()) / np.sqrt(most)
    while len(kept) > most:
        kept, triangles = _joined(r, pieces.triangles, size)
        size *= 1.3
    outwards, corners = pieces.at(surface.n0)[kept][triangles].sum(axis=1), r[kept][triangles]
    turned = (
        np.einsum(
            "ij,ij->i", np.cross(*np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 0)), outwards
        )
        < 0
    )
    triangles[turned] = triangles[turned][:, ::-1]  # the image of a half has the other orientation
    return Thinned(pieces, kept, triangles)


def _joined(
    r: Array, triangles: NDArray[np.int32], size: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    cubes = np.rint((r - r.min(axis=0)) / size).astype(np.int64)
    key = (
        (cubes[:, 0] * (1 << 42)) ^ (cubes[:, 1] * (1 << 21)) ^ cubes[:, 2]
        if size > 1e-5
        else _exact(cubes)
    )
    _, kept, number = np.unique(key, return_index=True, return_inverse=True)
    corners = number[triangles]
    whole = (
        (corners[:, 0] != corners[:, 1])
        & (corners[:, 1] != corners[:, 2])
        & (corners[:, 2] != corners[:, 0])
    )
    return kept, corners[whole]


def _exact(cubes: NDArray[np.int64]) -> NDArray[np.void]:
    """Rows as single values."""
    return np.ascontiguousarray(cubes).view([("", cubes.dtype)] * 3).ravel()


MOST_FRAMES, FEWEST_FRAMES = 24, 6
MOST_VALUES = 110_000  # vertices times frames
LEVEL = 3  # of zlib: a tenth larger than by default, in half of the time
SCRIPT = "interactive.js"


@dataclass(frozen=True)
class Interactive:
    """What the page's script needs.

    Attributes
    ----------
    about
        JSON: rows, columns, frames, fields, limits, and where each array begins.
    data
        Base64 of the compressed arrays, see `_Packed`.
    library, script
        Plotly in base64, compressed; the script of this package.
    """

    about: Markup
    data: str
    library: str
    script: Markup


def interactive(folder: Path, case: Mapping[str, Any]) -> Interactive | None:
    """The data of a run's folder; None without fields of two points, or without Plotly."""
    fields = folder / "fields"
    rows = [
        row
        for row in read_rows(folder / "path.csv")
        if (fields / point_file(int(row["point"]))).exists()
    ]
    if len(rows) < 2 or (library := plotly()) is None:
        return None
    last = next(row for row in reversed(rows) if row["label"] != SOLUTION)
    about_row = headline(case, rows)
    surface, about = read_point(fields, int(about_row["point"]))
    mesh = thinned(surface, MOST_VALUES // FEWEST_FRAMES)
    frames = chosen_frames(rows, min(MOST_FRAMES, MOST_VALUES // mesh.count))
    shells = [on_nodes_of(read_point(fields, int(row["point"]))[0], surface) for row in frames]
    packed = _Packed()
    content: dict[str, Any] = {
        **_path(rows, last, pole_of(case)),
        "frames": [rows.index(row) for row in frames],
        "opens": frames.index(about_row) if about_row in frames else len(frames) - 1,
        "h": about.h,
        "camera": run_camera(surface, style_of(case)).direction.tolist(),
        "r0": packed.add(mesh.at(surface.r0), np.uint16),
        "triangles": packed.raw(
            mesh.triangles.astype(np.uint16 if mesh.count < 2**16 else np.uint32)
        ),
        "u": [packed.add(mesh.at(s.u), np.int16) for s in shells],
        "lines": [[np.round(line, 4).tolist() for line in near_outlines(s)] for s in shells],
        "solids": [[_solid(solid, packed) for solid in near_solids(s)] for s in shells],
        "fields": _fields(shells, mesh, about.h, packed),
    }
    text = json.dumps(content).replace("<", "\\u003c")  # nothing in it can end the script
    script = Path(__file__).with_name(SCRIPT).read_text(encoding="utf-8")
    return Interactive(Markup(text), packed.content, library, Markup(script))


def _solid(solid: Solid, packed: "_Packed") -> dict[str, Any]:
    """The faces of a body or a magnet; the sign of its poles at its corners."""
    poles = [] if solid.poles is None else np.sign(solid.poles).tolist()
    triangles = packed.raw(solid.triangles.astype(np.uint16))
    return {
        "name": solid.name,
        "r": packed.add(solid.points, np.uint16),
        "triangles": triangles,
        "poles": poles,
    }


def chosen_frames(rows: Sequence[Row], most: int) -> list[Row]:
    """At most about so many rows of a path, besides the first, the last, and instabilities and
    solutions.

    Between them the shape changes about equally: a snap has as many as the slow part before it.
    """
    special = [row for row in rows if row["label"] in (*LOCATED, SOLUTION)][: most // 2]
    others = [row for row in rows if row not in special]
    count = min(len(others), max(most - len(special), 2))
    way = _way(others)
    even = {int(np.abs(way - at).argmin()) for at in np.linspace(0, way[-1], count)} | {
        0,
        len(others) - 1,
    }
    left = [i for i in range(len(others)) if i not in even]
    more = count - len(even)
    even |= {
        left[round(i * (len(left) - 1) / max(more - 1, 1))] for i in range(min(more, len(left)))
    }
    return sorted([*special, *(others[i] for i in even)], key=lambda row: int(row["point"]))


def _way(rows: Sequence[Row]) -> Array:
    """How far the shape has changed until each row: of all displacements over their range, and half
    of it per point.
    """
    moved = [name for name in rows[0] if quantity(name).kind in ("displacement", "place")]
    values = np.array([[float(row[name]) for name in moved] for row in rows]).reshape(len(rows), -1)
    ranges = np.ptp(values, axis=0)
    steps = np.abs(np.diff(values[:, ranges > 0] / ranges[ranges > 0], axis=0)).sum(axis=1)
    share = 0.5 * (float(steps.sum()) or 1.0) / max(len(steps), 1)
    return np.concatenate([[0.0], np.cumsum(steps + share)])


def _path(rows: Sequence[Row], last: Row, pole: str) -> dict[str, Any]:
    """The numbers of path.csv that vary, names of columns, and the lines of the curve of each step."""
    varied = next(
        (str(row["amplitude"]) for row in [last, *reversed(rows)] if row["amplitude"]), ""
    )
    parts = _parts(rows, varied) if varied else []
    quantities = _quantities(rows[0])
    first = list[str]()
    for part in reversed(parts):  # its words say whose displacement it is
        quantities |= {q.name: q for q in axes_for(part)}
        first += [q.name for q in axes_for(part)]
    numeric = [name for name in rows[0] if not isinstance(rows[0][name], str)]
    varying = [name for name in numeric if len({row[name] for row in rows}) > 1]
    columns = {}
    for name in dict.fromkeys([*first, *varying]):
        shown = quantities.get(name) or quantity(name)
        values = [row[name] for row in rows]
        columns[name] = {"label": label(shown, rows[0], pole), "values": values, "sign": shown.sign}
    return {
        "columns": columns,
        "steps": [_step(part, rows) for part in parts],
        "points": [row["point"] for row in rows],
        "labels": [row["label"] for row in rows],
        "unstable": [is_unstable(row) for row in rows],
        "times": [row["time"] for row in rows] if "time" in rows[0] else [],
    }


def _quantities(names: Iterable[str]) -> dict[str, Quantity]:
    """Column -> its quantity; a column in units has the words of that without units.

    Examples
    --------
    >>> _quantities(["w_over_h", "w_mm"])["w_mm"].label
    'displacement  $w$  (mm)'
    """
    by_column = dict[str, Quantity]()
    for plain in map(quantity, names):
        for shown in (plain, *plain.in_units):
            by_column.setdefault(shown.name, shown)
    return by_column


def _step(part: Part, rows: Sequence[Row]) -> dict[str, Any]:
    """A step for the page: numbers of its rows, and the lines between them."""
    at = {int(row["point"]): i for i, row in enumerate(rows)}
    varied = quantity(amplitude(part.amplitude).column)
    return {
        "title": part.title or varied.words,
        "axes": [q.name for q in axes_for(part)],
        "varied": varied.name,
        "load": axes_for(part)[of_load(part.amplitude)].name,
        "rows": [at[int(row["point"])] for row in part.rows],
        "lines": [
            {
                "rows": [at[int(row["point"])] for row in it.rows],
                "pieces": it.pieces,
                "in_time": it.in_time,
                "level": it.level,
            }
            for it in line_coordinates(part)
        ],
    }


def _parts(rows: Sequence[Row], varied: str) -> list[Part]:
    """The steps of a curve as in curve.png, after those that it leaves out, such as the field
    before the loads.
    """
    drawn = drawn_parts(rows, varied)
    among = {int(row["point"]) for part in drawn for row in part.rows}
    before = [row for row in rows if int(row["point"]) not in among]
    names = list(dict.fromkeys(str(row["amplitude"]) for row in before if row["amplitude"]))
    others = []
    for name in names:
        own = [row for row in before if row["amplitude"] == name]
        first = max(rows.index(own[0]) - 1, 0)
        others.append(
            Part(name, [*rows[first : first + 1], *own] if rows[first] is not own[0] else own)
        )
    return [part for part in (*others, *drawn) if len(part.rows) > 1]


def label(of_axis: Quantity, row: Row, pole: str) -> str:
    """The label of an axis, as in curve.png, in HTML."""
    at_point = named(of_axis, row, pole)
    words = f"{at_point.words} {at_point.note}".strip()
    unit = f" ({at_point.shown_unit})" if at_point.shown_unit else ""
    minus = "−" if at_point.sign < 0 else ""
    return str(
        Markup("{}{}{}").format(
            words, Markup(f" {minus}{at_point.html}") if at_point.symbol else "", unit
        )
    )


def _fields(
    shells: Sequence[Surface], mesh: Thinned, h: float, packed: "_Packed"
) -> list[dict[str, Any]]:
    """Every scalar and every length of a vector, with the colours of the pictures and the limits of
    the whole path.
    """
    fields = []
    for name, caption in SCALARS.items():
        values = [_values(shell, name, h) for shell in shells]
        present = [v for v in values if v is not None]
        if len(present) < len(shells):
            continue
        low, high = min(float(v.min()) for v in present), max(float(v.max()) for v in present)
        if high - low < 1e-12:
            low, high = low - 1.0, low + 1.0
        colours: list[tuple[float, str]] = []  # plotly's own map
        if name == "gap_over_h":
            low, high, colours = 0.0, 1.0, _stops(NEAR)
        elif name in WITH_SIGN:
            low, high = from_zero(low, high)
            colours = _stops(SIGNED, (low, high))
        if name == SHELL:
            caption = (
                f"{caption}: {', '.join(f'{i} {each}' for i, each in enumerate(shells[0].shells))}"
            )
        parts = [np.clip((mesh.at(v) - low) / (high - low), 0.0, 1.0) for v in present]
        steps = [np.rint(255 * part).astype(np.uint8) for part in parts]
        still = all((step == steps[0]).all() for step in steps)
        places = [packed.raw(step) for step in (steps[:1] if still else steps)]
        fields.append(
            {
                "name": name,
                "label": caption,
                "low": low,
                "high": high,
                "colours": colours,
                "at": places,
            }
        )
    return fields


def _stops(name: str, limits: tuple[float, float] = (-1.0, 1.0)) -> list[tuple[float, str]]:
    """A colour map of the pictures as plotly takes it."""
    from matplotlib.colors import to_hex

    colours = colour_map(name, limits)
    at = [*(float(t) for t in np.linspace(0.0, 1.0, STOPS)[:-1]), 1 - 1e-3, 1.0]
    return [(t, to_hex(colours(t))) for t in at]


def _values(surface: Surface, name: str, h: float) -> Array | None:
    if name == "w_over_h":
        return np.asarray(surface.w / h)
    values = couple(surface) if name == "couple" else surface.fields.get(name)
    if values is None and name == "couple" and "Ba" in surface.fields:
        return np.zeros(len(surface.r0))  # before the field is applied
    if values is None:
        return None
    return np.nan_to_num(values if values.ndim == 1 else np.linalg.norm(values, axis=1))


class _Packed:
    """Arrays one after the other, each at a multiple of four bytes."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def add(self, values: Array, kind: type[np.integer[Any]]) -> dict[str, Any]:
        """Values (n, 3) as integers: low + step i."""
        least, most = np.iinfo(kind).min, np.iinfo(kind).max
        low, high = float(values.min()), float(values.max())
        if least < 0:
            low, high = 0.0, max(abs(low), abs(high))
        step = (high - low) / most or 1.0
        return {**self.raw(np.rint((values - low) / step).astype(kind)), "low": low, "step": step}

    def raw(self, values: NDArray[Any]) -> dict[str, Any]:
        content = np.ascontiguousarray(values).tobytes()
        at = {"at": self._length, "size": int(values.size), "kind": values.dtype.name}
        self._parts.append(content + bytes(-len(content) % 4))
        self._length += len(self._parts[-1])
        return at

    @property
    def content(self) -> str:
        return packed(b"".join(self._parts))


def packed(content: bytes) -> str:
    """Compressed, in base64."""
    return base64.b64encode(zlib.compress(content, LEVEL)).decode()


@cache
def plotly() -> str | None:
    """Plotly's script, packed; None if it is not installed. Its Python is not imported."""
    package = importlib.util.find_spec("plotly")
    for place in (package.submodule_search_locations or []) if package else []:
        file = Path(place) / "package_data" / "plotly.min.js"
        if file.exists():
            return _kept(file)
    return None


def _kept(file: Path) -> str:
    """A file, packed once for all runs."""
    about = file.stat()
    name = f"packed_{file.name}_{about.st_size}_{about.st_mtime_ns}_{LEVEL}"
    if kept := load_cached(name):
        return kept.decode()
    packed_file = packed(file.read_bytes())
    save_cached(name, packed_file.encode())
    return packed_file
