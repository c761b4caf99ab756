"""The picture of a search: the point where it begins, and the solutions that it has found."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from magshell_fenicsx.case.output import OutputSection
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.bars import SIGNED
from magshell_fenicsx.output.pictures.colours import Coloured
from magshell_fenicsx.output.pictures.layout import drawing
from magshell_fenicsx.output.pictures.small import small_panels
from magshell_fenicsx.output.pictures.view import Camera
from magshell_fenicsx.output.store.table import SOLUTION, Row, stability

if TYPE_CHECKING:  # takes long to import
    from matplotlib.figure import Figure


def searched(rows: Sequence[Row]) -> list[Row]:
    """The rows of all solutions, and before those of a step the last point of its path."""
    found: list[Row] = []
    for i, row in enumerate(rows):
        if row["label"] == SOLUTION:
            first = rows[i - 1]["label"] != SOLUTION or rows[i - 1]["step"] != row["step"]
            before = [rows[max(j for j in range(i) if rows[j]["branch"] == 0)]] if first else []
            found += [*before, row]
    return found


def solutions_figure(
    surfaces: Sequence[Surface], rows: Sequence[Row], h: float, style: OutputSection, camera: Camera
) -> "Figure":
    """Draw the deformed shells of some rows with the same colours."""
    largest = max(float(np.abs(surface.w).max()) for surface in surfaces) / h or 1.0
    limits = (-largest, largest)
    layers = [
        Coloured("w_over_h", np.asarray(s.w / h), limits, SIGNED, "inward normal displacement $w/h$") for s in surfaces
    ]
    captions = [f"{_name(row)}: {stability(row).split()[0]}" for row in rows]
    with drawing(style):
        return small_panels(surfaces, layers, captions, style, camera)


def _name(row: Row) -> str:
    return f"solution {row['branch']}" if row["label"] == SOLUTION else "end of the path"
