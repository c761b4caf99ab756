"""Remanence and applied field as arrows, side by side at the same points of the visible side."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.layout import Arrow
from magshell_fenicsx.output.pictures.view import Camera

Array = NDArray[np.float64]
SEEDS, APART = 70, 0.13  # largest number of places; their least distance over the shell's extent
LENGTH, BESIDE = 0.1, 0.014  # of the longest arrow, and from an arrow to its place, over the shell's extent
FIELDS = {
    "Br": ("C3", r"remanence $F\,\hat B^\mathrm{r}$, as the shell carries it"),
    "Ba": ("C0", r"applied field $\hat B^\mathrm{a}$"),
}


def drawn_arrows(
    surface: Surface, camera: Camera | None = None, visible: Callable[[Array], NDArray[np.bool_]] | None = None
) -> tuple[Arrow, ...]:
    """The arrows of the fields that a surface has; their feet are left and right of the place that they belong to.

    All begin at their feet: opposite fields are opposite arrows.
    """
    lengths = {
        name: np.nan_to_num(np.linalg.norm(surface.fields[name], axis=1)) for name in FIELDS.keys() & surface.fields
    }
    there = [name for name in FIELDS if name in lengths and lengths[name].max() > 0]
    if camera is None or visible is None:
        return tuple(Arrow(np.zeros((0, 3)), np.zeros((0, 3)), *FIELDS[name]) for name in there)
    r = surface.r0 + surface.u
    extent = float(np.ptp(r, axis=0).max())
    seen = np.flatnonzero(visible(r))
    seeds = seen[spread(r[seen], APART * extent)]
    places, found = camera(r[seeds]), []
    drawn = {name: camera(surface.fields[name][seeds]) * (LENGTH * extent / lengths[name].max()) for name in there}
    across = _across(next(iter(drawn.values()), places)) * BESIDE * extent * (len(there) > 1)
    for name, side in zip(there, (1, -1), strict=False):
        shown = lengths[name][seeds] > 1e-3 * lengths[name].max()
        found.append(Arrow((places + side * across)[shown], drawn[name][shown], *FIELDS[name]))
    return tuple(found)


def _across(vectors: Array) -> Array:
    """Unit vectors (n, 3) in the picture, to the left of projected vectors."""
    flat = np.column_stack([-vectors[:, 1], vectors[:, 0], np.zeros(len(vectors))])
    size = np.linalg.norm(flat, axis=1)[:, None]
    return np.where(size > 1e-6, flat / np.maximum(size, 1e-300), np.array([-1.0, 0, 0]))


def spread(r: Array, apart: float) -> NDArray[np.int64]:
    """Indices of well separated points of (n, 3): each is the farthest from those before, at least `apart` away."""
    chosen = [int(np.argmax(r[:, 2]))]
    distance = np.full(len(r), np.inf)
    while len(chosen) < SEEDS:
        distance = np.minimum(distance, np.linalg.norm(r - r[chosen[-1]], axis=1))
        if distance.max() < apart:
            break
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)
