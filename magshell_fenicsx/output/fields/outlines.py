"""The outlines of sources of the applied field and of bodies, for pictures and for ParaView."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.driven import carried
from magshell_fenicsx.models.shell.parameters import Loads

Array = NDArray[np.float64]
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
    """The content of a .vtp file."""
    import pyvista
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    starts = np.cumsum([0, *(len(line) for line in lines)])
    cells = [np.r_[len(line), start + np.arange(len(line))] for start, line in zip(starts[:-1], lines, strict=True)]
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(pyvista.PolyData(np.concatenate(lines), lines=np.concatenate(cells)))
    writer.SetDataModeToAscii()
    writer.WriteToOutputStringOn()
    writer.Write()
    content: bytes | str = writer.GetOutputString()
    return content if isinstance(content, bytes) else content.encode()


def read_outlines(folder: Path, number: int) -> tuple[Array, ...]:
    """Those beside the fields of a point; none without any."""
    file = folder / DRIVEN.format(number)
    file = file if file.exists() else folder / STILL
    if not file.exists():
        return ()
    import pyvista

    data = pyvista.read(file)
    return tuple(np.asarray(cell.points, dtype=float) for cell in data.cell)
