"""Pictures of the deformed shell: displacement, strains, bending moments, magnetic fields and loads."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.layout import DPI, beside, directions, panels, with_margin
from magshell_fenicsx.output.pictures.render import Arrows, Image, View, rendered, smooth_surface

if TYPE_CHECKING:  # take long to import
    import pyvista
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
LOADS = {
    "p_mag": r"magnetic pressure $p_\mathrm{mag}$",
    "f_mag": r"in-plane force $|f_\mathrm{mag}|$",
    "k": "stiffness of rotational springs $k$",
    "tau": r"torque $|\tau(u)|$",
}
STRAINS = {"E_1": "larger principal membrane strain $E_1$", "E_2": "smaller principal membrane strain $E_2$"}
MOMENTS = {"M_1": "larger principal bending moment $M_1R/D$", "M_2": "smaller principal bending moment $M_2R/D$"}
CONTACT = {"gap_over_h": "gap, up to $h$", "contact_pressure": r"contact pressure $pR/(Eh)$"}
CONSTANT = 1e-9  # a load that varies by less is drawn as constant
ROUNDING = {"E_1": 1e-13, "M_1": 1e-8}  # smaller values are drawn as zero
EVERYWHERE, PEAK = 0.997, 1.5  # colour limit: PEAK times this quantile of the area
FROM_THE_SIDE = np.array([2.2, -3.6, 2.85])
PANEL, WHOLE = 480, 1000  # pixels
FAR = 4.0  # of the shell's extent, from its middle: sources farther away are not drawn
SEEDS, APART = 70, 0.13  # largest number of arrows; their least distance over the shell's extent
FIELDS = {  # colour, caption, length of the longest arrow, thickness; both over the shell's extent
    "Br": ("C3", r"remanence $F\,\hat B^\mathrm{r}$", 0.105, 0.008),
    "Ba": ("C0", r"applied field $\hat B^\mathrm{a}$", 0.15, 0.004),
}


@dataclass(frozen=True)
class Picture:
    """One picture: a function for its views (none if there is nothing to show), and one that arranges them."""

    views: Callable[[Surface, "pyvista.PolyData", float], list[View]]
    figure: Callable[[Sequence[Image], Sequence[View], str], "Figure"]


def figures(surface: Surface, h: float, title: str, names: Sequence[str] = ()) -> dict[str, "Figure"]:
    """Draw pictures of a whole deformed shell, by default all of `PICTURES`; empty pictures are left out.

    Raises
    ------
    NoScreen
        If there is no display.
    """
    smooth = smooth_surface(surface, h)
    views = {name: PICTURES[name].views(surface, smooth, h) for name in names or PICTURES}
    images = iter(rendered([view for shown in views.values() for view in shown]))
    drawn = {name: [next(images) for _ in shown] for name, shown in views.items()}
    return {name: PICTURES[name].figure(drawn[name], shown, title) for name, shown in views.items() if shown}


def towards(place: Array) -> Array:
    """A camera direction (3,) from which a point (3,) of a shell is visible: from above and from the side."""
    heading = np.arctan2(place[1], place[0]) if np.hypot(*place[:2]) > 0.1 else -0.5
    return np.array([4.2 * np.cos(heading - 0.5), 4.2 * np.sin(heading - 0.5), 2.75])


def deflected_place(surface: Surface) -> Array:
    """The point (3,) of the largest normal displacement."""
    return np.asarray(surface.r0[np.argmax(np.abs(surface.w))])


def _shell(surface: Surface, smooth: "pyvista.PolyData", h: float) -> list[View]:
    limit = float(np.abs(surface.w).max() / h) or 1.0
    camera = towards(deflected_place(surface))
    colours = smooth.point_data["w_over_h"]
    return [View(smooth, colours, (-limit, limit), "RdBu_r", camera, WHOLE, "$w/h$", outlines=_near(surface))]


def _near(surface: Surface) -> tuple[Array, ...]:
    """The outlines of sources and bodies that leave the shell large enough to be seen."""
    r = surface.r0 + surface.u
    middle, reach = r.mean(axis=0), FAR * float(np.ptp(r, axis=0).max())
    return tuple(line for line in surface.outlines if np.linalg.norm(line - middle, axis=1).max() < reach)


def _loads(surface: Surface, smooth: "pyvista.PolyData", h: float) -> list[View]:
    return [_load(smooth, name) for name in LOADS if name in surface.fields]


def _load(smooth: "pyvista.PolyData", name: str) -> View:
    values = np.asarray(smooth.point_data[name])
    values = np.linalg.norm(values, axis=1) if values.ndim == 2 else values
    low, high = float(values.min()), float(values.max())
    if high - low < CONSTANT:  # do not colour rounding errors
        low, high = low - 1, high + 1
    return View(smooth, values, (low, high), "viridis", FROM_THE_SIDE, PANEL, LOADS[name])


def _principal(captions: dict[str, str]) -> Callable[[Surface, "pyvista.PolyData", float], list[View]]:
    """Two panels with the same colours, white at zero, so that rounding of a constant field is invisible."""

    def views(surface: Surface, smooth: "pyvista.PolyData", h: float) -> list[View]:
        if not all(name in surface.fields for name in captions):
            return []
        camera = towards(deflected_place(surface))
        limit = _limit(surface, *captions)
        return [
            View(smooth, np.asarray(smooth.point_data[name]), (-limit, limit), "RdBu_r", camera, PANEL, caption)
            for name, caption in captions.items()
        ]

    return views


def _contact(surface: Surface, smooth: "pyvista.PolyData", h: float) -> list[View]:
    """The gap and the pressure of bodies, from above them."""
    if not CONTACT.keys() <= surface.fields.keys():
        return []
    camera = towards(surface.r0[np.argmin(surface.fields["gap_over_h"])])
    most = float(surface.fields["contact_pressure"].max()) or 1.0
    limits, colours = {"gap_over_h": (0.0, 1.0), "contact_pressure": (0.0, most)}, {"gap_over_h": "viridis_r"}
    return [
        View(
            smooth,
            np.asarray(smooth.point_data[name]),
            limits[name],
            colours.get(name, "magma_r"),
            camera,
            PANEL,
            words,
        )
        for name, words in CONTACT.items()
    ]


def _limit(surface: Surface, first: str, second: str) -> float:
    """The colour limit of two fields: their largest magnitude, without peaks of small area such as at a point load."""
    size = np.maximum(np.abs(surface.fields[first]), np.abs(surface.fields[second]))
    if (largest := float(size.max())) < ROUNDING[first]:
        return 1.0
    in_cells = size[surface.cells].mean(axis=1)
    a, b, c = np.moveaxis(surface.r0[surface.cells[:, :3]], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    order = np.argsort(in_cells)
    most = in_cells[order][np.searchsorted(np.cumsum(area[order]), EVERYWHERE * area.sum())]
    return float(min(largest, max(PEAK * most, ROUNDING[first])))


def _fields(surface: Surface, smooth: "pyvista.PolyData", h: float) -> list[View]:
    """Arrows of both fields at the same points of the visible side; arrows that point into the shell end on it."""
    if not FIELDS.keys() & surface.fields.keys():
        return []
    camera = towards(deflected_place(surface))
    r = surface.r0 + surface.u
    extent = float(np.ptp(r, axis=0).max())
    seeds = spread(r, APART * extent)
    normals = np.asarray(smooth.point_data["Normals"])[_nearest(np.asarray(smooth.points), r[seeds])]
    side = normals * np.copysign(1.0, normals @ camera)[:, None]
    arrows = []
    for name, (colour, _, size, thickness) in FIELDS.items():
        vectors = surface.fields[name][seeds]
        length = np.nan_to_num(np.linalg.norm(vectors, axis=1))  # a formula may end somewhere
        if not (longest := length.max()):
            continue
        shown, vectors = length > 1e-3 * longest, vectors * (size * extent / longest)
        inward = np.einsum("ij,ij->i", vectors, side) < -1e-9
        places = r[seeds] + 0.01 * extent * side - np.where(inward[:, None], vectors, 0.0)
        arrows.append(Arrows(places[shown], vectors[shown], colour, thickness * extent))
    grey = np.full(smooth.n_points, 0.25)
    return [View(smooth, grey, (0.0, 1.0), "Greys", camera, 700, arrows=tuple(arrows), outlines=_near(surface))]


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


def _nearest(points: Array, places: Array) -> NDArray[np.int64]:
    import scipy

    return np.asarray(scipy.spatial.cKDTree(points).query(places)[1])


def _one(images: Sequence[Image], views: Sequence[View], title: str) -> "Figure":
    return beside(images[0], views[0], title)


def _with_legend(images: Sequence[Image], views: Sequence[View], title: str) -> "Figure":
    (image,), (view,) = images, views
    figure = with_margin(image, 190, title)
    width, height = (figure.get_size_inches() * DPI).round()
    drawn = {arrows.colour for arrows in view.arrows}
    for i, (colour, caption, *_) in enumerate(FIELDS.values()):
        if colour in drawn:
            place = 1 - 15 / width, 1 - (40 + 26 * i) / height
            figure.text(*place, caption, color=colour, fontsize=11, ha="right", va="top")
    directions(figure, view, width - 130, 10)
    return figure


PICTURES = {
    "shell": Picture(_shell, _one),
    "magnetic_loads": Picture(_loads, panels),
    "strains": Picture(_principal(STRAINS), panels),
    "moments": Picture(_principal(MOMENTS), panels),
    "fields": Picture(_fields, _with_legend),
    "contact": Picture(_contact, panels),
}
