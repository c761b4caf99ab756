"""Pictures of the deformed shell: displacement, strains, bending moments, magnetic fields and loads."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.colours import (
    Coloured,
    contact,
    contact_region,
    jump_said,
    loads,
    moments,
    shell,
    strains,
    stretches,
)
from magshell_fenicsx.output.pictures.layout import (
    Arrow,
    Panel,
    Pen,
    Scale,
    colour_map,
    columns,
    drawing,
    panel_width,
    panels_figure,
)
from magshell_fenicsx.output.pictures.view import Camera, Seen, Window, near_outlines, tessellated
from magshell_fenicsx.problem.wanted import OutputSection

if TYPE_CHECKING:  # takes long to import
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
GREY = 0.93  # of a surface without colours
UNDEFORMED, EDGE, OTHERS = ("0.5", "--"), ("0.35", "-"), ("0.2", "-")  # pens


@dataclass(frozen=True)
class Content:
    """What a picture shows, what it says at its foot, and the places (n, 3) around which it is; None: all."""

    layers: Sequence[Coloured]
    note: str = ""
    detail: Array | None = None


def _with_arrows(surface: Surface, h: float) -> Content:
    found = drawn_arrows(surface)
    return Content([Coloured("", np.zeros(len(surface.r0)), (0, 1), "", "")] if found else [], far_said(surface))


def far_said(surface: Surface) -> str:
    """Whether there are sources of the field, or bodies, that are not drawn."""
    left_out = len(surface.outlines) - len(near_outlines(surface))
    return "Sources of the field, or bodies, are outside the picture." if left_out else ""


def _of_contact(surface: Surface) -> Content:
    layers = contact(surface)
    detail = contact_region(surface) if layers else None
    return Content(layers, "" if detail is None else "The part of the shell around the contact.", detail)


PICTURES: dict[str, Callable[[Surface, float], Content]] = {
    "shell": lambda surface, h: Content(shell(surface, h), far_said(surface)),
    "magnetic_loads": lambda surface, h: Content(*loads(surface, h)),
    "strains": lambda surface, h: Content(strains(surface), jump_said(surface.strain_jump, "strains")),
    "moments": lambda surface, h: Content(moments(surface), jump_said(surface.jump, "moments")),
    "stretches": lambda surface, h: Content(stretches(surface)),
    "fields": _with_arrows,
    "contact": lambda surface, h: _of_contact(surface),
}


def figures(
    surface: Surface, h: float, style: OutputSection, camera: Camera, names: Sequence[str] = ()
) -> dict[str, "Figure"]:
    """Draw pictures of a whole deformed shell, by default all of `PICTURES`; empty pictures are left out."""
    drawn, views = {}, dict[int, Background]()
    for name in names or PICTURES:
        content = PICTURES[name](surface, h)
        if not content.layers:
            continue
        width = panel_width(style, columns(len(content.layers)))
        if content.detail is not None:
            window = Window.around(camera(content.detail), width)
            view = Background(surface, camera, width, window)
        else:  # panels of one width are all painted on one view
            view = views[width] = views.get(width) or Background(surface, camera, width)
        with drawing(style):
            panels = [view.panel(layer, style) for layer in content.layers]
            drawn[name] = panels_figure(panels, style, content.note)
    return drawn


class Background:
    """A shell as it is seen, to be coloured by its fields; the outline of the undeformed one, sources and bodies."""

    def __init__(self, surface: Surface, camera: Camera, width: int, window: Window | None = None) -> None:
        self._surface, self._camera = surface, camera
        near = near_outlines(surface)
        pieces, r = tessellated(surface), surface.r0 + surface.u
        self.window = window or Window.around(camera(np.concatenate([surface.r0, r, *near])), width)
        self.seen = Seen(pieces, r, camera, self.window)
        coarse = replace(self.window, scale=self.window.scale / 2)  # enough for a line that is wider than a pixel
        undeformed = silhouette(Seen(pieces, surface.r0, camera, coarse))
        self._lines = (
            *((line, UNDEFORMED) for line in undeformed),
            *((line, EDGE) for line in silhouette(self.seen)),
            *self._visible(near),
        )

    def _visible(self, lines: Sequence[Array]) -> tuple[tuple[Array, Pen], ...]:
        """Lines (n, 3) in the projection, without the parts that the shell hides."""
        found = []
        for line in lines:
            at = np.linspace(0, len(line) - 1, 8 * len(line))
            fine = np.column_stack([np.interp(at, np.arange(len(line)), x) for x in line.T])
            places = self._camera(fine)[:, :2]
            places[~self.seen.shows(fine, 2 / self.window.scale)] = np.nan
            found.append((places, OTHERS))
        return tuple(found)

    def panel(self, layer: Coloured, style: OutputSection) -> Panel:
        """The shell in a layer's colours; grey with arrows if it has none."""
        if not layer.colours:
            arrows = self._arrows()
            return Panel(self.seen.plain(GREY), self.window, self._camera, lines=self._lines, arrows=arrows)
        low, high = style.ranges.get(layer.name, layer.limits)
        image = self.seen.coloured(layer.values, (low, high), colour_map(layer.colours))
        slack = 1e-6 * (high - low)
        beyond = bool(np.nanmin(layer.values) < low - slack), bool(np.nanmax(layer.values) > high + slack)
        scale = Scale((low, high), layer.colours, layer.caption, beyond)
        return Panel(image, self.window, self._camera, scale, self._lines)

    def _arrows(self) -> tuple[Arrow, ...]:
        extent = float(np.ptp(self._surface.r0 + self._surface.u, axis=0).max())
        return drawn_arrows(self._surface, self._camera, lambda r: self.seen.shows(r, 0.03 * extent))


def silhouette(seen: Seen) -> list[Array]:
    """Lines (n, 2) around the drawn part of a surface, in the projection; none where it goes on beyond the window."""
    import contourpy

    part = seen.share
    left, _, _, high = seen.window.box
    lines: Any = contourpy.contour_generator(z=np.pad(part, 1, mode="edge")).lines(0.5)
    return [np.array([left, high]) + (line - 0.5) * np.array([1, -1]) / seen.window.scale for line in lines]


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
