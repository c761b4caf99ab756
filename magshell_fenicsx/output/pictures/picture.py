"""Pictures of the deformed shell: displacement, strains, moments, magnetic fields and loads.

A layer is the field in whose colours one panel of a picture is drawn. A window is the part of the
camera's projection that a picture shows; places in the projection are over the reference length R,
to the right, up and towards the eye. Its `scale` is the number of pixels for R. A place is visible
if no part of the surface is nearer to the eye. A line with nan between places is interrupted there.
A pen is a grey and matplotlib's name of dashes. Br, Ba and J are remanence, applied field and
induced polarisation, h is the thickness over R.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import SHELL, Surface
from magshell_fenicsx.output.fields.tessellation import tessellate
from magshell_fenicsx.output.pictures.bodies_and_magnets import (
    BodiesInView,
    bare_outlines,
    far_bodies_note,
    near_places,
)
from magshell_fenicsx.output.pictures.colours import (
    ColouredField,
    contact,
    contact_region,
    in_units,
    loads,
    moments,
    pressure_note,
    shell,
    strains,
    stretches,
)
from magshell_fenicsx.output.pictures.layout import (
    Arrow,
    Panel,
    Pen,
    columns,
    drawing,
    panel_width,
    panels_figure,
)
from magshell_fenicsx.output.pictures.rendering import Camera, Image, RenderedSurface, Window
from magshell_fenicsx.output.pictures.scales import Scale, colour_map, contour_values, from_zero
from magshell_fenicsx.output.pictures.sections import UprightSection, level_lines, upright_section
from magshell_fenicsx.problem.requests import OutputSection
from magshell_fenicsx.quantities.quantity import NO_UNITS, CaseSizes

if TYPE_CHECKING:  # takes long to import
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
FIELDS_WITH_NAMES = ("", "w_over_h")  # names of fields whose pictures name the shells
FIELDS_WITH_CONTOURS = ("w_over_h",)  # names of fields that have lines at round values
PICTURES_WITH_BODIES = ("shell", "fields", "contact")  # the others show the shell alone
GREY = 0.93  # of a surface without colours
END_TOLERANCE = 0.01  # of a bar's length: values no farther beyond its ends are those of the ends
UNDEFORMED, EDGE, OTHERS = ("0.5", "--"), ("0.35", "-"), ("0.2", "-")  # pens
MIN_OUTLINE_DISTANCE = 2.0  # pixels, of the drawn undeformed outline from the deformed one
MIN_OUTLINE_LENGTH = 40.0  # pixels, of drawn parts of the undeformed outline
NAME_LETTER_WIDTH, NAME_HEIGHT = 0.7, 1.4  # of the font: room for names of shells
CONTOUR_TOLERANCE = 1e-6  # over the range of colours: smaller differences come from rounding
SAME_PLACE_TOLERANCE = 1e-7  # over R
DEPTH_TOLERANCE = 2.0  # pixels: depth below the surface at which lines are visible
ARROW_DEPTH_TOLERANCE = 0.03  # over the shell's extent, at which places of arrows are visible
SEGMENTS_PER_INTERVAL = 8  # of a line between two nodes


@dataclass(frozen=True)
class Content:
    """What a picture shows.

    Attributes
    ----------
    layers
        One field for each panel; a picture without layers is not drawn.
    note
        Note at the foot.
    detail
        Places (n, 3) that the picture is cut to; None to show the whole shell.
    """

    layers: Sequence[ColouredField]
    note: str = ""
    detail: Array | None = None


def _arrows_content(surface: Surface, h: float) -> Content:
    """Return the content of the picture of magnetic fields: a grey shell with arrows.

    It is empty without fields. `h` is the thickness over R.
    """
    layers = list[ColouredField]()
    if field_arrows(surface):
        # no name and no colours: a grey shell, on which `Background.panel` draws arrows
        layers.append(ColouredField("", np.zeros(len(surface.r0)), (0, 1), "", ""))
    return Content(layers, far_bodies_note(surface))


def _contact_content(surface: Surface, sizes: CaseSizes) -> Content:
    """Return the content of the picture of contact, cut to the contact if that is small."""
    layers = contact(surface)
    if not layers:
        return Content([])
    detail = contact_region(surface)
    notes = [] if detail is None else ["The part of the shell around the contact."]
    return Content(layers, " ".join([*notes, pressure_note(surface, sizes)]).strip(), detail)


# functions of the surface, the thickness over R, and the sizes of the case
PICTURES: dict[str, Callable[[Surface, float, CaseSizes], Content]] = {
    "shell": lambda surface, h, _: Content(shell(surface, h), far_bodies_note(surface)),
    "magnetic_loads": lambda surface, h, _: Content(*loads(surface, h)),
    "strains": lambda surface, h, _: Content(*strains(surface, h)),
    "moments": lambda surface, h, _: Content(*moments(surface, h)),
    "stretches": lambda surface, h, _: Content(stretches(surface)),
    "fields": lambda surface, h, _: _arrows_content(surface, h),
    "contact": lambda surface, h, sizes: _contact_content(surface, sizes),
}


def figures(
    surface: Surface,
    h: float,
    style: OutputSection,
    camera: Camera,
    names: Sequence[str] = (),
    sizes: CaseSizes = NO_UNITS,
) -> dict[str, "Figure"]:
    """Return pictures of a whole deformed shell by name; empty pictures are left out.

    Parameters
    ----------
    surface
        The whole shell with its fields.
    h
        Thickness over R.
    names
        Keys of `PICTURES` to draw; all of them by default.
    sizes
        Sizes of the case at the state of the surface, which give bars and notes their units.
    """
    drawn_figures, views = {}, dict[tuple[int, bool], Background]()
    has_bodies = bool(near_places(surface))
    for name in names or PICTURES:
        content = PICTURES[name](surface, h, sizes)
        if not content.layers:
            continue
        width = panel_width(style, columns(len(content.layers)))
        if content.detail is not None:
            window = Window.around(camera(content.detail), width)
            view = Background(surface, camera, width, window)
        else:  # panels of one width are all painted on one view
            key = width, has_bodies and name in PICTURES_WITH_BODIES
            if key not in views:
                seen_surface = surface if key[1] else replace(surface, outlines=(), solids=())
                views[key] = Background(seen_surface, camera, width)
            view = views[key]
        with drawing(style):
            panels = [view.panel(in_units(layer, sizes), style) for layer in content.layers]
            if name == "shell":
                panels[0] = replace(panels[0], section=visible_section(surface, view.window))
            drawn_figures[name] = panels_figure(panels, style, content.note)
    return drawn_figures


def visible_section(surface: Surface, window: Window) -> UprightSection | None:
    """Return the upright section of a surface; None if its lines are one at the window's scale."""
    largest = float(np.linalg.norm(surface.u, axis=1).max())
    if largest * window.scale < MIN_OUTLINE_DISTANCE:
        return None
    return upright_section(surface)


class Background:
    """A shell in view, to be coloured by its fields, with outlines, sources and bodies.

    The outline of the undeformed shell is dashed.

    Parameters
    ----------
    surface
        The deformed shell with its fields, and with bodies and sources.
    camera
        Projection.
    width
        Width of the picture in pixels.
    window
        Part of the projection to draw; None for all of the shell and what is near.

    Attributes
    ----------
    window
        The part that is drawn.
    seen
        The deformed shell rendered in it, which tells what is visible.
    """

    def __init__(
        self, surface: Surface, camera: Camera, width: int, window: Window | None = None
    ) -> None:
        """Render the shell, and find the visible parts of all lines.

        `_bodies` are the bodies and sources in the picture. `_lines` are pairs of a line (n, 2) in
        the projection and its pen.
        """
        self._surface, self._camera = surface, camera
        # the deformed shell and the bodies in the window
        tessellation, r = tessellate(surface), surface.r0 + surface.u
        self.window = window or Window.around(
            camera(np.concatenate([surface.r0, r, *near_places(surface)])), width
        )
        self.seen = RenderedSurface(tessellation, r, camera, self.window)
        self._bodies = BodiesInView(surface, camera, self.window, self.seen)
        # outlines of the deformed and the undeformed shell. For the latter half of the resolution
        # is enough, since its line is wider than a pixel
        coarse = replace(self.window, scale=self.window.scale / 2)
        undeformed_view = RenderedSurface(tessellation, surface.r0, camera, coarse)
        outline = silhouette(self.seen)
        undeformed_outline = [
            self._not_behind(line, undeformed_view) for line in silhouette(undeformed_view)
        ]
        distance = MIN_OUTLINE_DISTANCE / self.window.scale
        min_length = MIN_OUTLINE_LENGTH / self.window.scale
        edges = [self._visible_part(edge_lines(surface))]
        # of sources without faces, such as coils
        bare_lines = [self._visible_part(_divided(line)) for line in bare_outlines(surface)]
        # the undeformed outline, and edges, are drawn where they are apart from the outline
        undeformed = lines_away_from(undeformed_outline, outline, distance, min_length)
        self._lines = (
            *((line, UNDEFORMED) for line in undeformed),
            *((line, EDGE) for line in outline),
            *((line, EDGE) for line in lines_away_from(edges, outline, distance)),
            *((line, OTHERS) for line in self._bodies.lines),
            *((line, OTHERS) for line in bare_lines),
        )

    def _not_behind(self, line: Array, undeformed_view: RenderedSurface) -> Array:
        """Return a line (n, 2) of the undeformed outline, nan where the deformed shell hides it.

        `undeformed_view` is the undeformed shell rendered alone, which gives the line's depth.
        """
        tolerance = MIN_OUTLINE_DISTANCE / self.window.scale
        depth = undeformed_view.depth_around(line)
        is_hidden = self.seen.depth_around(line) > depth + tolerance
        return np.where(is_hidden[:, None], np.nan, line)

    def _visible_part(self, line: Array) -> Array:
        """Return the projection (n, 2) of a line (n, 3) in space, nan where the shell hides it."""
        places = self._camera(line)[:, :2]
        is_visible = self.seen.shows(np.nan_to_num(line), DEPTH_TOLERANCE / self.window.scale)
        places[~is_visible] = np.nan
        return places

    def contours(self, layer: ColouredField) -> list[tuple[Array, Pen]]:
        """Return the visible lines (n, 2) on which a layer has round values, with their pen.

        The values are those of a bar from the layer's least to its largest value and with zero.
        """
        tessellation = tessellate(self._surface)
        places = tessellation.at_points(self._surface.r0 + self._surface.u)
        values = tessellation.at_points(layer.values)
        low, high = from_zero(float(layer.values.min()), float(layer.values.max()))
        tolerance, contours = CONTOUR_TOLERANCE * (high - low), []
        for value in contour_values(low, high):
            lines = level_lines(tessellation.triangles, places, values - value, tolerance)
            interrupted = np.concatenate([lines, np.full((len(lines), 1, 3), np.nan)], axis=1)
            contours.append((self._visible_part(interrupted.reshape(-1, 3)), EDGE))
        return contours

    def panel(self, layer: ColouredField, style: OutputSection) -> Panel:
        """Return the shell in a layer's colours, or grey with arrows if the layer has none.

        The limits of colours are those of the layer, or those that `style` gives for its field.
        """
        texts = tuple(self._bodies.poles)
        names = self._names(style) if layer.name in FIELDS_WITH_NAMES else ()
        if not layer.colours:
            return Panel(
                self.grey_image(GREY),
                self.window,
                self._camera,
                lines=self._lines,
                arrows=self._arrows(),
                texts=texts,
                names=names,
            )
        low, high = layer.limits_within(style.ranges)
        colours = colour_map(layer.colours, (low, high))
        image = self.seen.coloured(layer.values, (low, high), colours)
        # whether there are values beyond an end of the bar, by more than rounding
        slack = END_TOLERANCE * (high - low)
        is_below = bool(np.nanmin(layer.values) < low - slack)
        is_above = bool(np.nanmax(layer.values) > high + slack)
        contours = self.contours(layer) if layer.name in FIELDS_WITH_CONTOURS else ()
        scale = Scale((low, high), layer.colours, layer.caption, (is_below, is_above))
        return Panel(
            self._with_bodies(image),
            self.window,
            self._camera,
            scale,
            (*contours, *self._lines),
            texts=texts,
            names=names,
        )

    def _names(self, style: OutputSection) -> tuple[tuple[float, float, str], ...]:
        """Return (x, y, name) of each of several shells that is visible, in the projection.

        The place is the node nearest to the middle of the visible part at which the name covers no
        earlier one; the nearest node of all if there is no such one.
        """
        r, shell_numbers = self._surface.r0 + self._surface.u, self._surface.fields.get(SHELL)
        if shell_numbers is None:
            return ()
        letter = style.font_size / 72 * style.dpi / self.window.scale  # its height over R
        is_visible = self.seen.shows(r, DEPTH_TOLERANCE / self.window.scale)
        names = list[tuple[float, float, str]]()
        for i, name in enumerate(self._surface.shells):
            is_of_shell = np.rint(shell_numbers) == i
            places = self._camera(r[is_visible & is_of_shell])[:, :2]
            if not len(places):
                continue
            is_free = np.ones(len(places), bool)
            for x, y, other_name in names:
                offset_x, offset_y = np.abs(places - [x, y]).T
                width = NAME_LETTER_WIDTH * letter * (len(name) + len(other_name)) / 2
                is_free &= (offset_x > width) | (offset_y > NAME_HEIGHT * letter)
            distances = np.linalg.norm(places - places.mean(axis=0), axis=1)
            distances[~is_free] += np.inf if is_free.any() else 0.0
            x, y = places[distances.argmin()]
            names.append((float(x), float(y), name))
        return tuple(names)

    def grey_image(self, grey: float) -> Image:
        """Return the image of the shell in one grey, with bodies and sources."""
        return self._with_bodies(self.seen.grey_image(grey))

    def _with_bodies(self, image: Image) -> Image:
        """Return an image of the shell with bodies and sources drawn over it."""
        for body in self._bodies.images:
            image = body.over(image)
        return image

    def _arrows(self) -> tuple[Arrow, ...]:
        """Return the arrows of the magnetic fields at visible places of the shell."""
        extent = float(np.ptp(self._surface.r0 + self._surface.u, axis=0).max())
        tolerance = ARROW_DEPTH_TOLERANCE * extent
        return field_arrows(self._surface, self._camera, lambda r: self.seen.shows(r, tolerance))


def lines_away_from(
    lines: Sequence[Array], others: Sequence[Array], distance: float, min_length: float = 0.0
) -> list[Array]:
    """Return lines (n, 2) in the projection, with nan where they are near to other lines.

    Lines of which nothing remains are left out.

    Parameters
    ----------
    lines, others
        Lines (n, 2) in the projection.
    distance
        Largest distance of a place that is near.
    min_length
        Length of the parts that remain, at least.
    """
    from scipy.spatial import cKDTree

    if not len(others):
        return list(lines)
    places_of_others = cKDTree(np.concatenate(others))
    broken = []
    for line in lines:
        distance_to_others, _ = places_of_others.query(np.nan_to_num(line))
        is_far = distance_to_others > distance
        remaining = np.where(is_far[:, None], line, np.nan)
        remaining[_lengths_of_parts(remaining) < min_length] = np.nan
        if not np.isnan(remaining).all():
            broken.append(remaining)
    return broken


def _lengths_of_parts(line: Array) -> Array:
    """Return (n,) the length of the part to which each place of a line (n, 2) belongs.

    Places of nan divide a line into parts.
    """
    # each nan begins a part: places of one part have one number
    part_numbers = np.cumsum(np.isnan(line[:, 0]))
    steps = np.diff(line, axis=0, prepend=line[:1])
    lengths_of_steps = np.nan_to_num(np.linalg.norm(steps, axis=1))
    return np.asarray(np.bincount(part_numbers, lengths_of_steps)[part_numbers])


def edge_lines(surface: Surface) -> Array:
    """Return places (n, 3) along the edges of a deformed mid-surface, with nan after each edge.

    An edge is a side of one triangle only. A solid has no edges.
    """
    if surface.is_body:
        return np.zeros((0, 3))
    # a triangle of degree d has (d + 1)(d + 2)/2 nodes, d - 1 of them within each side
    nodes_within_side = round((np.sqrt(8 * surface.cells.shape[1] + 1) - 3) / 2) - 1
    # in VTK's order: three corners, then the nodes within each side
    nodes_of_sides = [
        [k, *range(3 + k * nodes_within_side, 3 + (k + 1) * nodes_within_side), (k + 1) % 3]
        for k in range(3)
    ]
    sides = surface.cells[:, nodes_of_sides].reshape(-1, nodes_within_side + 2)
    # a number for each place of nodes: where two shells meet, nodes are double but have one place
    rounded = np.round(surface.r0 / SAME_PLACE_TOLERANCE) + 0.0
    _, place_numbers = np.unique(rounded, axis=0, return_inverse=True)
    # sides of two triangles have the same two ends
    ends = np.sort(place_numbers.ravel()[sides[:, [0, -1]]], axis=1)
    _, first_side, count = np.unique(ends, axis=0, return_index=True, return_counts=True)
    edges = sides[first_side[count == 1]]
    nodes_along_edges = (surface.r0 + surface.u)[edges]
    # values of the shape functions at places along an edge, (places, nodes of a side): polynomials
    # through the nodes, by matrices of powers
    positions = np.linspace(0, 1, SEGMENTS_PER_INTERVAL * (nodes_within_side + 1) + 1)
    node_positions = np.linspace(0, 1, nodes_within_side + 2)
    table = np.vander(positions, nodes_within_side + 2) @ np.linalg.inv(np.vander(node_positions))
    lines = table @ nodes_along_edges
    lines_with_ends = np.concatenate([lines, np.full((len(lines), 1, 3), np.nan)], axis=1)
    return np.asarray(lines_with_ends.reshape(-1, 3))


def _divided(line: Array) -> Array:
    """Return a line (n, 3) with SEGMENTS_PER_INTERVAL segments between every two of its places."""
    positions = np.arange(SEGMENTS_PER_INTERVAL * (len(line) - 1) + 1) / SEGMENTS_PER_INTERVAL
    return np.column_stack([np.interp(positions, np.arange(len(line)), x) for x in line.T])


def silhouette(view: RenderedSurface) -> list[Array]:
    """Return lines (n, 2) around the drawn part of a surface, in the projection.

    There is no line where the surface goes on beyond the window.
    """
    import contourpy

    left, _, _, high = view.window.box  # of its upper left corner, where pixels begin
    # a frame of equal values: no line at the border of the window
    padded = np.pad(view.coverage, 1, mode="edge")
    lines: Any = contourpy.contour_generator(z=padded).lines(0.5)
    return [
        np.array([left, high]) + (line - 0.5) * np.array([1, -1]) / view.window.scale
        for line in lines
    ]


MAX_ARROWS = 70  # of a field
MIN_ARROW_DISTANCE = 0.13  # over the shell's extent
MAX_ARROW_LENGTH = 0.1  # over the shell's extent
FOOT_OFFSET = 0.014  # over the shell's extent: of an arrow's foot from its place, beside another
MIN_ARROW = 1e-3  # over the longest: a shorter arrow is not drawn
COVERING_ANGLE = 0.2  # sine of the angle below which one arrow covers another from the same place
MIN_IN_PICTURE = 1e-6  # length in the picture of an arrow that has a left side
TINY = 1e-300  # least divisor
FIELDS = {
    "Br": ("C3", r"remanence $F\,\hat B^\mathrm{r}$, as the shell carries it"),
    "Ba": ("C0", r"applied field $\hat B^\mathrm{a}$"),
    "J": ("C2", r"induced polarisation $\mu_0 M$"),
}
# of a remanence that turns with the material and does not stretch
ROTATED_REMANENCE = FIELDS["Br"][0], FIELDS["Br"][1].replace("$F", "$R")


def field_arrows(
    surface: Surface,
    camera: Camera | None = None,
    visible: Callable[[Array], NDArray[np.bool_]] | None = None,
) -> tuple[Arrow, ...]:
    """Return the arrows of the magnetic fields of a surface, which begin at their nodes.

    Where one arrow would cover another at the same place, their feet are moved left and right. So
    opposite fields are opposite arrows side by side.

    Parameters
    ----------
    camera
        Projection.
    visible
        Function from places (n, 3) to a mask (n,) of the visible ones. Without `camera` or
        `visible` the arrows have no places: they only tell which fields there are.
    """
    lengths = {
        name: np.nan_to_num(np.linalg.norm(surface.fields[name], axis=1))
        for name in FIELDS.keys() & surface.fields
    }
    names = [name for name in FIELDS if name in lengths and lengths[name].max() > 0]
    legend = FIELDS | ({"Br": ROTATED_REMANENCE} if surface.remanence_rotates else {})
    if camera is None or visible is None:  # only to ask which fields there are
        return tuple(Arrow(np.zeros((0, 3)), np.zeros((0, 3)), *legend[name]) for name in names)
    # nodes at which arrows begin, and all of their arrows in the projection
    r = surface.r0 + surface.u
    extent = float(np.ptp(r, axis=0).max())
    visible_nodes = np.flatnonzero(visible(r))
    feet = visible_nodes[spread_points(r[visible_nodes], MIN_ARROW_DISTANCE * extent)]
    places, arrows = camera(r[feet]), []
    vectors = {
        name: camera(surface.fields[name][feet]) * (MAX_ARROW_LENGTH * extent / lengths[name].max())
        for name in names
    }
    offsets = np.zeros(places.shape)
    if len(names) > 1:
        offsets = _foot_offsets(list(vectors.values())) * FOOT_OFFSET * extent
    # the feet of the first field are moved to the left, those of the second to the right; those of
    # a third stay
    for name, sign in zip(names, (1, -1, 0), strict=False):
        is_long = lengths[name][feet] > MIN_ARROW * lengths[name].max()
        arrow_feet = (places + sign * offsets)[is_long]
        arrows.append(Arrow(arrow_feet, vectors[name][is_long], *legend[name]))
    return tuple(arrows)


def _foot_offsets(fields: Sequence[Array]) -> Array:
    """Return unit vectors (n, 3) in the picture, to the left of the arrows of the first field.

    They are zero where the arrow of the last field does not cover that of the first one.

    Parameters
    ----------
    fields
        Projected vectors (n, 3) of each field, at the same n places.
    """
    (x, y), (last_x, last_y) = fields[0][:, :2].T, fields[-1][:, :2].T
    length, last_length = np.hypot(x, y), np.hypot(last_x, last_y)
    # cross product of the projections: small where they are parallel
    covers = np.abs(x * last_y - y * last_x) <= COVERING_ANGLE * length * last_length
    to_the_left = np.column_stack([-y, x, 0 * x]) / np.maximum(length, TINY)[:, None]
    # an arrow that is a point in the picture is moved along the picture's width
    offsets = np.where(length[:, None] > MIN_IN_PICTURE, to_the_left, np.array([-1.0, 0, 0]))
    return np.asarray(offsets * covers[:, None])


def spread_points(r: Array, min_distance: float) -> NDArray[np.int64]:
    """Return indices of well separated points among r (n, 3), at most `MAX_ARROWS`.

    The first is the highest point. Each further one is the farthest from all before, and at least
    `min_distance` away.
    """
    indices = [int(np.argmax(r[:, 2]))]
    distance = np.full(len(r), np.inf)
    while len(indices) < MAX_ARROWS:
        distance = np.minimum(distance, np.linalg.norm(r - r[indices[-1]], axis=1))
        if distance.max() < min_distance:
            break
        indices.append(int(np.argmax(distance)))
    return np.array(indices)
