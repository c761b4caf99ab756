"""The picture of a search: the point where it begins, and the solutions that it has found."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.layout import panels
from magshell_fenicsx.output.pictures.picture import PANEL, deflected_place, towards
from magshell_fenicsx.output.pictures.render import View, rendered, smooth_surface
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


def solutions_figure(surfaces: Sequence[Surface], rows: Sequence[Row], h: float, title: str) -> "Figure":
    """Draw the deformed shells of some rows, all from one side, each coloured by its own displacement."""
    camera = towards(deflected_place(surfaces[-1]))
    views = []
    for surface, row in zip(surfaces, rows, strict=True):
        smooth = smooth_surface(surface, h)
        limit = float(np.abs(surface.w).max() / h) or 1.0
        name = f"solution {row['branch']}" if row["label"] == SOLUTION else "end of the path"
        caption = f"$w/h$, {name}: {stability(row).split()[0]}"
        views.append(View(smooth, smooth.point_data["w_over_h"], (-limit, limit), "RdBu_r", camera, PANEL, caption))
    return panels(rendered(views), views, title)
