"""Bodies and magnets near a shell in a picture, and names of those that are too far.

Bodies are drawn as glass, magnets with a red north and a blue south pole. A `Solid` has corners and
triangles, and of a magnet a pole strength at each corner, positive on its north half. Its creases
are lines along sharp edges. A source of the field without faces, such as a coil, is drawn by its
outlines. Depth grows towards the eye; it is -inf where nothing is drawn. A drawn pixel is finer
than a pixel of the picture: `in_pixels` gives the fraction of each pixel that some drawn ones
cover. A rendered surface `shows` places that it does not hide, up to a tolerance of the depth.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.tessellation import Tessellation
from magshell_fenicsx.output.pictures.rendering import (
    Camera,
    Image,
    RenderedSurface,
    Window,
    in_pixels,
    near_outlines,
    near_solids,
)
from magshell_fenicsx.shape.drawn_bodies import Solid

Array = NDArray[np.float64]
NORTH, SOUTH, BODY = (0.80, 0.36, 0.33), (0.35, 0.52, 0.78), (0.62, 0.66, 0.66)
# opacities where there is no shell behind, and where there is
OPACITIES_OF_MAGNETS, OPACITIES_OF_BODIES = (1.0, 0.3), (0.55, 0.3)
# derivatives of a triangle's shape functions, at its corners
SLOPES = np.array([[[-1.0, 1, 0]] * 3, [[-1.0, 0, 1]] * 3])
BOX_TOLERANCE = 1e-3  # over R: lines of a solid are within the box around it
DEPTH_TOLERANCE = 2.0  # pixels: a line that is no deeper than this below a face lies on it
LONG_LINE = 0.2  # over R: extent of a straight line that is divided finely
DIVISIONS, DIVISIONS_OF_LONG_LINES = 4, 24


@dataclass(frozen=True)
class SolidImage:
    """Image of one solid in a picture.

    Attributes
    ----------
    image
        (height, width, 4) colours.
    opacity
        (height, width) opacity of the solid in each pixel, from 0 to 1.
    """

    image: Image
    opacity: Array

    def over(self, background: Image) -> Image:
        """Return the image `background` with the solid drawn in front of it."""
        # the usual composition of two transparent images, in pixels that the solid covers
        composed, covered = background.copy(), self.opacity > 0
        opacity, behind = self.opacity[covered], background[covered]
        opacity_behind = behind[:, 3] / 255 * (1 - opacity)
        # opacity of both together
        alpha = opacity + opacity_behind
        colours = opacity[:, None] * self.image[covered, :3]
        colours = colours + opacity_behind[:, None] * behind[:, :3]
        colours = colours / alpha[:, None]
        composed[covered] = np.rint(np.column_stack([colours, 255 * alpha]))
        return composed


class BodiesInView:
    """The solids near a shell in a window, and where the shell hides them.

    Parameters
    ----------
    surface
        The deformed shell with all solids.
    camera, window
        The projection, and the part of it that the picture shows.
    shell
        The shell rendered in the same window.
    """

    def __init__(
        self, surface: Surface, camera: Camera, window: Window, shell: RenderedSurface
    ) -> None:
        """Choose the solids that are near enough; they are rendered when they are needed."""
        self._camera, self._window, self._shell = camera, window, shell
        self._solids = near_solids(surface)

    @cached_property
    def _views(self) -> list[RenderedSurface]:
        """Each solid rendered alone in the window."""
        return [
            RenderedSurface(_face_tessellation(solid), solid.points, self._camera, self._window)
            for solid in self._solids
        ]

    @cached_property
    def _visible(self) -> list[NDArray[np.bool_]]:
        """For each solid the drawn pixels where it is in front of other solids and of the shell."""
        depths = [view.depth for view in self._views]
        in_front = []
        for i, depth in enumerate(depths):
            # depth grows towards the eye: the largest one is in front
            other_depths = [
                self._shell.depth,
                *(depth_of_other for k, depth_of_other in enumerate(depths) if k != i),
            ]
            in_front_of_others = np.logical_and.reduce(
                [depth >= depth_of_other for depth_of_other in other_depths]
            )
            in_front.append((depth > -np.inf) & in_front_of_others)
        return in_front

    @cached_property
    def images(self) -> list[SolidImage]:
        """Images of all solids, to be drawn over an image of the shell."""
        has_shell, images = self._shell.depth > -np.inf, []
        for solid, view, visible in zip(self._solids, self._views, self._visible, strict=True):
            opacity_alone, opacity_over_shell = (
                OPACITIES_OF_BODIES if solid.poles is None else OPACITIES_OF_MAGNETS
            )
            # fractions of each pixel that the solid covers, without and with the shell behind it
            covered_alone = in_pixels(visible & ~has_shell)
            covered_over_shell = in_pixels(visible & has_shell)
            opacity = opacity_alone * covered_alone + opacity_over_shell * covered_over_shell
            # a body has one colour. A magnet has two, which change at pole strength zero, in the
            # middle of the limits
            table = np.array([BODY] if solid.poles is None else [SOUTH, NORTH])
            values = np.zeros(len(solid.points)) if solid.poles is None else solid.poles
            largest = float(np.abs(values).max()) or 1.0
            corner_values = values[solid.triangles.ravel()]
            images.append(
                SolidImage(view.painted(corner_values, (-largest, largest), table), opacity)
            )
        return images

    @property
    def lines(self) -> list[Array]:
        """Outlines and edges (n, 2) of the solids in the projection, where they are visible."""
        import contourpy

        left, _, _, high = self._window.box
        upper_left_corner, downwards = np.array([left, high]), np.array([1, -1])
        lines = list[Array]()
        for solid, view, visible in zip(self._solids, self._views, self._visible, strict=True):
            # the outline of the solid: where it covers half of a pixel. A frame of equal values
            # around the image gives no line where the solid goes on beyond the window
            padded = np.pad(in_pixels(visible), 1, mode="edge")
            contours: Any = contourpy.contour_generator(z=padded).lines(0.5)
            # from pixels of the padded image, centred at whole numbers, to the projection
            lines += [
                upper_left_corner + (line - 0.5) * downwards / self._window.scale
                for line in contours
            ]
            lines += self._visible_creases(solid, view)
        return lines

    def _visible_creases(self, solid: Solid, view: RenderedSurface) -> list[Array]:
        """Return the visible parts of a solid's creases as a line (n, 2) with nan between them.

        The list is empty for a solid without creases. `view` is the solid rendered alone.
        """
        if not (creases := solid.creases):
            return []
        divided_lines = [_divided(line) for line in creases]
        points, tolerance = np.concatenate(divided_lines), DEPTH_TOLERANCE / self._window.scale
        places = self._camera(points)[:, :2]
        visible = view.shows(points, tolerance) & self._shell.shows(points, tolerance)
        places[~visible] = np.nan
        # the last place of each line is left out, so that lines are not joined
        last_places = np.cumsum([len(line) for line in divided_lines]) - 1
        places[last_places] = np.nan
        return [places]

    @property
    def poles(self) -> list[tuple[float, float, str]]:
        """(x, y, letter) of the visible poles N and S of magnets, in the projection.

        A letter is in the middle of the pole's faces that are turned to the eye.
        """
        letters = []
        for solid, view in zip(self._solids, self._views, strict=True):
            if solid.poles is None:
                continue
            centres = _centres(solid)
            # faces that the magnet itself does not hide
            visible = view.shows(centres, 2 * DEPTH_TOLERANCE / self._window.scale)
            for sign, letter in ((1, "N"), (-1, "S")):
                centres_of_pole = centres[(_poles(solid) * sign > 0) & visible]
                if not len(centres_of_pole):
                    continue
                middle = centres_of_pole.mean(axis=0)
                (is_visible,) = self._shell.shows(middle[None], 0.0)  # the shell may hide it
                if is_visible:
                    x, y = self._camera(middle)[:2]
                    letters.append((float(x), float(y), letter))
        return letters


def _face_tessellation(solid: Solid) -> Tessellation:
    """Return the faces of a solid as flat triangles, with normals averaged at corners.

    The points of each triangle are its corners, where the three shape functions are 0 or 1.
    """
    numbers = np.arange(3 * len(solid.triangles), dtype=np.int32).reshape(-1, 3)
    return Tessellation(solid.triangles, np.eye(3), SLOPES, numbers, flat=True)


def _divided(line: Array) -> Array:
    """Return a line from its first to its last place with points between, the last one twice.

    The last point is made nan by the caller, so that lines are not joined.
    """
    is_long = len(line) == 2 and np.ptp(line, axis=0).max() > LONG_LINE
    count = DIVISIONS_OF_LONG_LINES if is_long else DIVISIONS
    t = np.linspace(0.0, 1.0, count)[:, None]
    return np.concatenate([(1 - t) * line[0] + t * line[-1], line[-1:]])


def _centres(solid: Solid) -> Array:
    """Return the centres (m, 3) of the triangles of a solid."""
    return np.asarray(solid.points[solid.triangles].mean(axis=1))


def _poles(solid: Solid) -> Array:
    """Return the pole strength (m,) at the triangles of a magnet: positive on its north half."""
    assert solid.poles is not None
    return np.asarray(solid.poles[solid.triangles].mean(axis=1))


def near_places(surface: Surface) -> Sequence[Array]:
    """Return places (n, 3) of all that is drawn beside the shell, to fit a window around it."""
    return (*near_outlines(surface), *(solid.points for solid in near_solids(surface)))


def bare_outlines(surface: Surface) -> tuple[Array, ...]:
    """Return the lines (n, 3) of sources that have no faces, such as coils.

    Such a line lies in no box around a solid.
    """
    corners = [solid.points for solid in surface.solids]
    boxes = [(np.min(points, axis=0), np.max(points, axis=0)) for points in corners]

    def is_in_a_box(line: Array) -> bool:
        """Whether a line is within the box around one of the solids, whose outline it then is."""
        return any(
            bool(((line >= low - BOX_TOLERANCE) & (line <= high + BOX_TOLERANCE)).all())
            for low, high in boxes
        )

    return tuple(line for line in near_outlines(surface) if not is_in_a_box(line))


def far_bodies_note(surface: Surface) -> str:
    """Return a note on bodies and sources that are too far away to be drawn; empty without such."""
    near = near_solids(surface)

    def is_near(solid: Solid) -> bool:
        """Return whether a body is one of those near the surface."""
        return any(solid is other for other in near)

    far_solids = [solid for solid in surface.solids if not is_near(solid)]
    middle = (surface.r0 + surface.u).mean(axis=0)
    words = [f"{solid.name} ({_distance(solid, middle):.2g} R away)" for solid in far_solids]
    if words:
        return f"Outside the picture: {', '.join(words)}."
    left_out = len(surface.outlines) - len(near_outlines(surface))
    return "Sources of the field, or bodies, are outside the picture." if left_out else ""


def _distance(solid: Solid, middle: Array) -> float:
    """Return the distance of a solid's middle from a place (3,), over R."""
    return float(np.linalg.norm(solid.points.mean(axis=0) - middle))
