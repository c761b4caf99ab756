"""Pictures of the deformed shell: displacement, strains, bending moments, magnetic fields and
loads.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import SHELL, Surface
from magshell_fenicsx.output.fields.tessellation import tessellated
from magshell_fenicsx.output.pictures.beside import Beside, bare_outlines, far_said, near_places
from magshell_fenicsx.output.pictures.colours import (
    Coloured,
    contact,
    contact_region,
    loads,
    moments,
    pressure_said,
    shell,
    strains,
    stretches,
)
from magshell_fenicsx.output.pictures.layout import (
    Arrow,
    Panel,
    columns,
    drawing,
    panel_width,
    panels_figure,
)
from magshell_fenicsx.output.pictures.scales import Scale, colour_map
from magshell_fenicsx.output.pictures.view import Camera, Image, InView, Window
from magshell_fenicsx.problem.wanted import OutputSection

if TYPE_CHECKING:  # takes long to import
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
NAMED = ("", "w_over_h")  # layers with the names of shells
GREY = 0.93  # of a surface without colours
NONE_BEYOND = 0.01  # of a bar: values no farther beyond its ends are those of the ends
UNDEFORMED, EDGE, OTHERS = ("0.5", "--"), ("0.35", "-"), ("0.2", "-")  # pens
# pixels between the outlines of the undeformed and of the deformed shell; nearer the former is no
# news
SEEN_APART = 2.0
CRUMB = 40.0  # pixels: what is left of that outline is longer
SAME_PLACE = 1e-7  # over R
DIVISION = 8  # of a line between two nodes


@dataclass(frozen=True)
class Content:
    """What a picture shows, what it says at its foot, and the places (n, 3) around which it is;
    None: all.
    """

    layers: Sequence[Coloured]
    note: str = ""
    detail: Array | None = None


def _with_arrows(surface: Surface, h: float) -> Content:
    arrows = drawn_arrows(surface)
    return Content(
        [Coloured("", np.zeros(len(surface.r0)), (0, 1), "", "")] if arrows else [],
        far_said(surface),
    )


def _of_contact(surface: Surface) -> Content:
    layers = contact(surface)
    detail = contact_region(surface) if layers else None
    notes = [] if detail is None else ["The part of the shell around the contact."]
    return Content(
        layers, " ".join([*notes, pressure_said(surface)] if layers else []).strip(), detail
    )


PICTURES: dict[str, Callable[[Surface, float], Content]] = {
    "shell": lambda surface, h: Content(shell(surface, h), far_said(surface)),
    "magnetic_loads": lambda surface, h: Content(*loads(surface, h)),
    "strains": lambda surface, h: Content(*strains(surface, h)),
    "moments": lambda surface, h: Content(*moments(surface, h)),
    "stretches": lambda surface, h: Content(stretches(surface)),
    "fields": _with_arrows,
    "contact": lambda surface, h: _of_contact(surface),
}


def figures(
    surface: Surface, h: float, style: OutputSection, camera: Camera, names: Sequence[str] = ()
) -> dict[str, "Figure"]:
    """Draw pictures of a whole deformed shell, by default all of `PICTURES`; empty pictures are
    left out.
    """
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
    """A shell as it is seen, to be coloured by its fields; the outline of the undeformed one,
    sources and bodies.
    """

    def __init__(
        self, surface: Surface, camera: Camera, width: int, window: Window | None = None
    ) -> None:
        self._surface, self._camera = surface, camera
        pieces, r = tessellated(surface), surface.r0 + surface.u
        self.window = window or Window.around(
            camera(np.concatenate([surface.r0, r, *near_places(surface)])), width
        )
        self.seen = InView(pieces, r, camera, self.window)
        self._beside = Beside(surface, camera, self.window, self.seen)
        coarse = replace(
            self.window, scale=self.window.scale / 2
        )  # enough for a line that is wider than a pixel
        drawn, before = silhouette(self.seen), InView(pieces, surface.r0, camera, coarse)
        near, crumb = SEEN_APART / self.window.scale, CRUMB / self.window.scale
        undeformed = apart(
            [self._not_behind(line, before) for line in silhouette(before)], drawn, near, crumb
        )
        self._lines = (
            *((line, UNDEFORMED) for line in undeformed),
            *((line, EDGE) for line in drawn),
            *((line, EDGE) for line in apart([self._where_seen(rims(surface))], drawn, near)),
            *((line, OTHERS) for line in self._beside.lines),
            *((self._where_seen(_divided(line)), OTHERS) for line in bare_outlines(surface)),
        )

    def _not_behind(self, line: Array, before: InView) -> Array:
        """A line (n, 2) around the undeformed shell, without what the deformed one hides."""
        hidden = (
            self.seen.depth_around(line)
            > before.depth_around(line) + SEEN_APART / self.window.scale
        )
        return np.where(hidden[:, None], np.nan, line)

    def _where_seen(self, line: Array) -> Array:
        """A line (n, 3) in the projection, without the parts that the shell hides."""
        places = self._camera(line)[:, :2]
        places[~self.seen.shows(np.nan_to_num(line), 2 / self.window.scale)] = np.nan
        return places

    def panel(self, layer: Coloured, style: OutputSection) -> Panel:
        """The shell in a layer's colours; grey with arrows if it has none."""
        texts = tuple(self._beside.poles)
        names = self._names() if layer.name in NAMED else ()
        if not layer.colours:
            arrows = self._arrows()
            image = self._whole(self.seen.plain(GREY))
            return Panel(
                image,
                self.window,
                self._camera,
                lines=self._lines,
                arrows=arrows,
                texts=texts,
                names=names,
            )
        low, high = style.ranges.get(layer.name, layer.limits)
        image = self.seen.coloured(
            layer.values, (low, high), colour_map(layer.colours, (low, high))
        )
        slack = NONE_BEYOND * (high - low)
        beyond = (
            bool(np.nanmin(layer.values) < low - slack),
            bool(np.nanmax(layer.values) > high + slack),
        )
        scale = Scale((low, high), layer.colours, layer.caption, beyond)
        return Panel(
            self._whole(image),
            self.window,
            self._camera,
            scale,
            self._lines,
            texts=texts,
            names=names,
        )

    def _names(self) -> tuple[tuple[float, float, str], ...]:
        """The name of each of several shells, as far as it is seen: next to the middle of that
        part.
        """
        r, number = self._surface.r0 + self._surface.u, self._surface.fields.get(SHELL)
        if number is None:
            return ()
        seen, names = self.seen.shows(r, 2 / self.window.scale), []
        for i, name in enumerate(self._surface.shells):
            places = self._camera(r[seen & (np.rint(number) == i)])[:, :2]
            if len(places):
                x, y = places[np.linalg.norm(places - places.mean(axis=0), axis=1).argmin()]
                names.append((float(x), float(y), name))
        return tuple(names)

    def plain(self, grey: float) -> Image:
        """The shell in one grey, with what is beside it."""
        return self._whole(self.seen.plain(grey))

    def _whole(self, image: Image) -> Image:
        """An image of the shell with what is beside it."""
        for laid in self._beside.laid:
            image = laid.on(image)
        return image

    def _arrows(self) -> tuple[Arrow, ...]:
        extent = float(np.ptp(self._surface.r0 + self._surface.u, axis=0).max())
        return drawn_arrows(
            self._surface, self._camera, lambda r: self.seen.shows(r, 0.03 * extent)
        )


def apart(
    lines: Sequence[Array], others: Sequence[Array], distance: float, least: float = 0.0
) -> list[Array]:
    """Lines (n, 2) with nan where they are as near as that to others, or what is left is shorter
    than `least`.
    """
    from scipy.spatial import cKDTree

    if not len(others):
        return list(lines)
    near = cKDTree(np.concatenate(others))
    broken = []
    for line in lines:
        far = near.query(np.nan_to_num(line))[0] > distance
        left = np.where(far[:, None], line, np.nan)
        part = np.cumsum(np.isnan(left[:, 0]))
        steps = np.nan_to_num(np.linalg.norm(np.diff(left, axis=0, prepend=left[:1]), axis=1))
        left[np.bincount(part, steps)[part] < least] = np.nan
        if not np.isnan(left).all():
            broken.append(left)
    return broken


def rims(surface: Surface) -> Array:
    """Places (n, 3) along the edges of a deformed mid-surface, which one triangle has alone; nan
    follows each.
    """
    if surface.is_body:
        return np.zeros((0, 3))
    inner = round((np.sqrt(8 * surface.cells.shape[1] + 1) - 3) / 2) - 1
    along = [
        [k, *range(3 + k * inner, 3 + (k + 1) * inner), (k + 1) % 3] for k in range(3)
    ]  # VTK's order
    edges = surface.cells[:, along].reshape(-1, inner + 2)
    _, place = np.unique(
        np.round(surface.r0 / SAME_PLACE) + 0.0, axis=0, return_inverse=True
    )  # nodes of two may be double
    _, first, count = np.unique(
        np.sort(place.ravel()[edges[:, [0, -1]]], axis=1),
        axis=0,
        return_index=True,
        return_counts=True,
    )
    lines = (surface.r0 + surface.u)[edges[first[count == 1]]]
    at, nodes = np.linspace(0, 1, DIVISION * (inner + 1) + 1), np.linspace(0, 1, inner + 2)
    table = np.vander(at, inner + 2) @ np.linalg.inv(
        np.vander(nodes)
    )  # of the shape functions along an edge
    ended = np.concatenate([table @ lines, np.full((len(lines), 1, 3), np.nan)], axis=1)
    return np.asarray(ended.reshape(-1, 3))


def _divided(line: Array) -> Array:
    """A line (n, 3) with places between its own."""
    at = np.arange(DIVISION * (len(line) - 1) + 1) / DIVISION
    return np.column_stack([np.interp(at, np.arange(len(line)), x) for x in line.T])


def silhouette(seen: InView) -> list[Array]:
    """Lines (n, 2) around the drawn part of a surface, in the projection; none where it goes on
    beyond the window.
    """
    import contourpy

    part = seen.share
    left, _, _, high = seen.window.box
    lines: Any = contourpy.contour_generator(z=np.pad(part, 1, mode="edge")).lines(0.5)
    return [
        np.array([left, high]) + (line - 0.5) * np.array([1, -1]) / seen.window.scale
        for line in lines
    ]


SEEDS, APART = 70, 0.13  # largest number of places; their least distance over the shell's extent
LENGTH, BESIDE = (
    0.1,
    0.014,
)  # of the longest arrow, and from an arrow to its place, over the shell's extent
ALIKE = 0.2  # sine of the angle below which one arrow covers another from the same place
FIELDS = {
    "Br": ("C3", r"remanence $F\,\hat B^\mathrm{r}$, as the shell carries it"),
    "Ba": ("C0", r"applied field $\hat B^\mathrm{a}$"),
    "J": ("C2", r"induced polarisation $\mu_0 M$"),
}


def drawn_arrows(
    surface: Surface,
    camera: Camera | None = None,
    visible: Callable[[Array], NDArray[np.bool_]] | None = None,
) -> tuple[Arrow, ...]:
    """The arrows of the fields that a surface has; they begin at the place that they belong to.

    Where one would cover the other their feet are left and right of it: opposite fields are
    opposite arrows.
    """
    lengths = {
        name: np.nan_to_num(np.linalg.norm(surface.fields[name], axis=1))
        for name in FIELDS.keys() & surface.fields
    }
    names = [name for name in FIELDS if name in lengths and lengths[name].max() > 0]
    if camera is None or visible is None:
        return tuple(Arrow(np.zeros((0, 3)), np.zeros((0, 3)), *FIELDS[name]) for name in names)
    r = surface.r0 + surface.u
    extent = float(np.ptp(r, axis=0).max())
    seen = np.flatnonzero(visible(r))
    seeds = seen[spread(r[seen], APART * extent)]
    places, arrows = camera(r[seeds]), []
    drawn = {
        name: camera(surface.fields[name][seeds]) * (LENGTH * extent / lengths[name].max())
        for name in names
    }
    across = _across(list(drawn.values()) or [places]) * BESIDE * extent * (len(names) > 1)
    for name, side in zip(names, (1, -1, 0), strict=False):
        shown = lengths[name][seeds] > 1e-3 * lengths[name].max()
        arrows.append(Arrow((places + side * across)[shown], drawn[name][shown], *FIELDS[name]))
    return tuple(arrows)


def _across(fields: Sequence[Array]) -> Array:
    """Unit vectors (n, 3) in the picture, left of the first projected vectors where the last cover
    them, or zero.
    """
    (x, y), (a, b) = fields[0][:, :2].T, fields[-1][:, :2].T
    size, other = np.hypot(x, y), np.hypot(a, b)
    cover = np.abs(x * b - y * a) <= ALIKE * size * other
    flat = np.column_stack([-y, x, 0 * x]) / np.maximum(size, 1e-300)[:, None]
    left = np.where(size[:, None] > 1e-6, flat, np.array([-1.0, 0, 0]))
    return np.asarray(left * (cover & (len(fields) > 1))[:, None])


def spread(r: Array, apart: float) -> NDArray[np.int64]:
    """Indices of well separated points of (n, 3): each is the farthest from those before, at least
    `apart` away.
    """
    chosen = [int(np.argmax(r[:, 2]))]
    distance = np.full(len(r), np.inf)
    while len(chosen) < SEEDS:
        distance = np.minimum(distance, np.linalg.norm(r - r[chosen[-1]], axis=1))
        if distance.max() < apart:
            break
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)
