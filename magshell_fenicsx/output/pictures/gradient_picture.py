"""gradients.png: where a result would change most with more of a field."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.layout import panels, png
from magshell_fenicsx.output.pictures.picture import spread
from magshell_fenicsx.output.pictures.render import Arrows, View, rendered, smooth_surface

Array = NDArray[np.float64]
PANEL, QUANTILE, PEAK = 480, 0.995, 1.3  # pixels; colours end at most PEAK times above this quantile of the nodes
THICK, LONGEST = 0.045, 1.3  # of arrows over their distance: radius, largest length
SMALL, APART = 0.15, 0.16  # vectors below this part of the largest have none; their distance over the extent of those
ASIDE = np.array([0.4, -0.7, 0.4])  # added to the normal that the camera looks along
WORDS = {
    "remanence": "more remanence, along arrows",
    "magnitude": "stronger magnet",
    "thickness": "more thickness",
    "curvature_11": r"natural curvature $\kappa_{11}$",
    "curvature_22": r"natural curvature $\kappa_{22}$",
    "curvature_12": r"natural twist $\kappa_{12}$",
    "deviation": r"shape moved outwards, $w_0/R$",
}


def draw_gradients(found: Mapping[str, Surface], h: float, title: str) -> bytes:
    """A PNG with one panel for each result and field: red raises the result, blue lowers it; of vectors their length.

    Raises
    ------
    NoScreen
        If there is no display.
    """
    views = [view for of, surface in found.items() for view in _views(of, surface, h)]
    return png(panels(rendered(views), views, title))


def _views(of: str, surface: Surface, h: float) -> list[View]:
    smooth = smooth_surface(surface, h)
    camera = _outwards(surface) + ASIDE
    views = []
    for name in (name for name in WORDS if name in surface.fields):
        caption = f"{of.replace('_', ' ')}: {WORDS[name]}"
        nodes, values = surface.fields[name], np.asarray(smooth.point_data[name])
        if nodes.ndim == 2:
            limits, colours = (0.0, _limit(np.linalg.norm(nodes, axis=1))), "Reds"
            arrows: tuple[Arrows, ...] = (_arrows(surface, nodes),)
            values = np.linalg.norm(values, axis=1)
        else:
            limit = _limit(np.abs(nodes))
            limits, colours, arrows = (-limit, limit), "RdBu_r", ()
        views.append(View(smooth, values, limits, colours, camera, PANEL, caption, arrows))
    return views


def _outwards(surface: Surface) -> Array:
    """The normal where the first field is largest."""
    first = next(iter(surface.fields.values()))
    return np.asarray(surface.n0[np.argmax(np.linalg.norm(np.reshape(first, (len(first), -1)), axis=1))])


def _limit(sizes: Array) -> float:
    """The largest, without peaks at few nodes."""
    return float(min(sizes.max(), PEAK * np.quantile(sizes, QUANTILE))) or 1.0


def _arrows(surface: Surface, vectors: Array) -> Arrows:
    r, length = surface.r0 + surface.u, np.linalg.norm(vectors, axis=1)
    most = length.max() or 1.0
    large = np.flatnonzero(length >= SMALL * most)
    apart = APART * float(np.ptp(r[large], axis=0).max())
    seeds = large[spread(r[large], apart)]
    return Arrows(r[seeds], LONGEST * apart / most * vectors[seeds], "0.15", THICK * apart)
