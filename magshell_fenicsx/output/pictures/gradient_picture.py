"""gradients.png: where a result would change most with more of a field."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.output import OutputSection
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.colours import Coloured
from magshell_fenicsx.output.pictures.layout import SIGNED, Arrow, Panel, columns, drawing, panel_width, panels_figure
from magshell_fenicsx.output.pictures.picture import Background, spread
from magshell_fenicsx.output.pictures.view import Camera

if TYPE_CHECKING:  # takes long to import
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
QUANTILE, PEAK = 0.995, 1.3  # colours end at most PEAK times above this quantile of the nodes
SMALL, APART = 0.15, 0.16  # vectors below this part of the largest have none; their distance over the extent of those
NOTE = "Change of a result per area by the change of a field there."
WORDS = {
    "remanence": "more remanence, along arrows",
    "magnitude": "stronger magnet",
    "thickness": "more thickness",
    "curvature_11": r"natural curvature $\kappa_{11}$",
    "curvature_22": r"natural curvature $\kappa_{22}$",
    "curvature_12": r"natural twist $\kappa_{12}$",
    "deviation": r"shape moved outwards, $w_0/R$",
}


def gradients_figure(found: Mapping[str, Surface], style: OutputSection, camera: Camera) -> "Figure":
    """One panel for each result and field: red raises the result, blue lowers it; of vectors their length."""
    count = sum(name in surface.fields for surface in found.values() for name in WORDS)
    width = panel_width(style, columns(count))
    with drawing(style):
        panels = [panel for of, surface in found.items() for panel in _panels(of, surface, style, camera, width)]
        return panels_figure(panels, style, NOTE)


def _panels(of: str, surface: Surface, style: OutputSection, camera: Camera, width: int) -> Iterator[Panel]:
    view = Background(surface, camera, width)
    for name in (name for name in WORDS if name in surface.fields):
        caption, values = f"{of.replace('_', ' ')}: {WORDS[name]}", surface.fields[name]
        if values.ndim == 1:
            limit = _limit(np.abs(values))
            yield view.panel(Coloured(name, values, (-limit, limit), SIGNED, caption), style)
            continue
        size = np.asarray(np.linalg.norm(values, axis=1))
        panel = view.panel(Coloured(name, size, (0.0, _limit(size)), "Reds", caption), style)
        yield replace(panel, arrows=(_arrows(surface, values, view, camera),))


def _limit(sizes: Array) -> float:
    """The largest, without peaks at few nodes."""
    return float(min(sizes.max(), PEAK * np.quantile(sizes, QUANTILE))) or 1.0


def _arrows(surface: Surface, vectors: Array, view: Background, camera: Camera) -> Arrow:
    r, length = surface.r0 + surface.u, np.linalg.norm(vectors, axis=1)
    most, extent = length.max() or 1.0, float(np.ptp(r, axis=0).max())
    large = np.flatnonzero((length >= SMALL * most) & view.seen.shows(r, 0.03 * extent))
    apart = APART * float(np.ptp(r[large], axis=0).max())
    seeds = large[spread(r[large], apart)]
    return Arrow(camera(r[seeds]), camera(apart / most * vectors[seeds]), "0.15", "")
