"""The outlines of sources of the applied field and of bodies, for pictures and for ParaView."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.parameters import Loads
from magshell_fenicsx.output.store.durable import Damaged
from magshell_fenicsx.parts.magnetism.driven import carried

Array = NDArray[np.float64]
ARRAY = re.compile(r'Name="(\w+)" [^>]*>([^<]*)</DataArray>')  # in the files of `vtp_content`
STILL, DRIVEN = "outlines.vtp", "outlines_{:04d}.vtp"  # of all points, or of each


def outlines(loads: Loads, mu: Mapping[str, float], h: float) -> tuple[Array, ...]:
    """Places (n, 3) over R along lines in the model's frame, where the amplitudes have driven sources and bodies."""
    bodies = [
        line + mu.get(c.amplitude, 0.0) * h * c.direction
        for c in loads.contacts
        for line in getattr(c.distance, "lines", ())
    ]
    field = loads.magnetic
    if field is None:
        return tuple(bodies)
    found = [line for part in getattr(field.in_space, "parts", ()) for line in getattr(part, "lines", ())]
    for each in field.driven:
        Q, t = carried(each.motions, mu)
        found += [line @ Q.T + t for line in getattr(each.of, "lines", ())]
    return (*bodies, *found)


def vtp_content(lines: tuple[Array, ...]) -> bytes:
    """The content of a .vtp file; VTK's own writer takes as long as a step of a path."""
    places = np.concatenate(lines)
    arrays = {
        "Points": ("Float64", places),
        "connectivity": ("Int64", np.arange(len(places))),
        "offsets": ("Int64", np.cumsum([len(line) for line in lines])),
    }
    data = {
        name: f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{a[0].size}" format="ascii">'
        f"{' '.join(map(repr, a.ravel().tolist()))}</DataArray>"
        for name, (kind, a) in arrays.items()
    }
    return (
        '<?xml version="1.0"?>\n<VTKFile type="PolyData" version="0.1" byte_order="LittleEndian"><PolyData>\n'
        f'<Piece NumberOfPoints="{len(places)}" NumberOfLines="{len(lines)}">\n<Points>{data.pop("Points")}</Points>\n'
        f"<Lines>{''.join(data.values())}</Lines>\n</Piece></PolyData></VTKFile>\n"
    ).encode()


def read_outlines(folder: Path, number: int) -> tuple[Array, ...]:
    """Those beside the fields of a point; none without any."""
    file = folder / DRIVEN.format(number)
    file = file if file.exists() else folder / STILL
    if not file.exists():
        return ()
    try:
        parts = {name: text.split() for name, text in ARRAY.findall(file.read_text(encoding="utf-8"))}
        ends = np.array(parts["offsets"], dtype=int)
        return tuple(np.split(np.array(parts["Points"], dtype=float).reshape(-1, 3), ends[:-1]))
    except (KeyError, ValueError) as e:
        raise Damaged(f"{file}: is damaged: {type(e).__name__}: {e}") from None
