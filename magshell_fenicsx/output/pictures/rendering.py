"""Rendering of a surface: parallel projection, hidden triangles, colours, shade.

raster.c draws at `FINER` times the resolution of the picture. A "drawn pixel" is of that finer
resolution. The projection has coordinates to the right, up and towards the eye (the depth), over
the reference length R; a window is the part that a picture shows. Pixels are counted from the upper
left corner, to the right and downwards. A tessellation divides the cells of a surface into flat
triangles, whose corners are its points. A surface has colours by the values at these points, and
light and shade by a lamp. Sources and bodies near the shell are drawn as lines and faces.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.tessellation import Tessellation, tessellate
from magshell_fenicsx.platform.native import load_native

if TYPE_CHECKING:  # takes long to import
    from matplotlib.colors import Colormap
from collections.abc import Sequence

from magshell_fenicsx.problem.requests import OutputSection
from magshell_fenicsx.shape.drawn_bodies import Solid

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
FUNCTIONS = """
    void rasterise(const double *, const int32_t *, int64_t, int32_t, int32_t, int32_t *, float *);
    void paint(const double *, const int32_t *, const int32_t *, int32_t, int32_t, int32_t,
               const float *, const float *, const float *, float, float, float, float, float,
               const float *, int32_t, uint8_t *);
"""
FINER = 2  # drawn pixels along each side of a pixel of the picture
LAMP = (-0.45, 0.55, 0.7)  # direction to the lamp: to the right, up, towards the eye
RELIEF = 0.6  # of the light comes from the lamp, and falls on slopes alone
RIM = 0.12  # loss of light where the surface is seen edgewise
NEIGHBOURS = (-2, -1, 0, 1, 2)  # drawn pixels around one, along each side
WINDOW_MARGIN = 0.02  # around what is drawn, over its largest side


@dataclass(frozen=True)
class Camera:
    """Parallel projection; e3 is up on the picture.

    Attributes
    ----------
    direction
        (3,) from the shell to the eye.
    """

    direction: Array

    @cached_property
    def axes(self) -> Array:
        """Unit vectors (3, 3): to the right, up, towards the eye."""
        to_eye = self.direction / np.linalg.norm(self.direction)
        right = np.cross([0.0, 0.0, 1.0], to_eye)
        right /= np.linalg.norm(right)
        return np.array([right, np.cross(to_eye, right), to_eye])

    def __call__(self, r: Array) -> Array:
        """Return components to the right, up and towards the eye of places or vectors (..., 3)."""
        return np.asarray(r @ self.axes.T)


@dataclass(frozen=True)
class Window:
    """Part of the projection that a picture shows.

    Attributes
    ----------
    box
        (left, right, low, high) over R.
    scale
        Pixels of the picture per R.
    """

    box: tuple[float, float, float, float]
    scale: float

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        left, right, low, high = self.box
        return max(round((high - low) * self.scale), 1), max(round((right - left) * self.scale), 1)

    @staticmethod
    def around(places: Array, width: int, tallest: float = 1.3) -> "Window":
        """Return the window around all projected places (n, 2 or 3).

        Its width is `width` pixels, and its height over its width is at most `tallest`.
        """
        low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
        margin = WINDOW_MARGIN * max(high - low)
        low, high = low - margin, high + margin
        extent_x, extent_y = high - low
        # what would be too tall gets room at both sides
        side_margin = max(extent_y / tallest - extent_x, 0.0) / 2
        box = low[0] - side_margin, high[0] + side_margin, low[1], high[1]
        return Window(box, width / (extent_x + 2 * side_margin))


class RenderedSurface:
    """Deformed surface rendered in a window.

    Parameters
    ----------
    tessellation
        Flat triangles of the surface.
    r
        (n, 3) deformed places of the nodes over R.
    camera
        Projection.
    window
        Part of the projection to draw.
    """

    def __init__(
        self, tessellation: Tessellation, r: Array, camera: Camera, window: Window
    ) -> None:
        """Draw the triangles, and keep what is in front at each drawn pixel.

        `_index` (height, width) is the number of the triangle in front, and `_depth` its depth
        towards the eye. `_places` are the points of the tessellation: in drawn pixels to the right
        and downwards, and their depth over R. `_r` are the nodes.
        """
        self._tessellation, self.camera, self.window = tessellation, camera, window
        height, width = (FINER * n for n in window.shape)
        left, _, _, high = window.box
        scale = FINER * window.scale
        places = camera(tessellation.at_points(r))
        # drawn pixels: x to the right, y downwards, centres at whole numbers
        places[:, 0] = (places[:, 0] - left) * scale - 0.5
        places[:, 1] = (high - places[:, 1]) * scale - 0.5
        self._index = np.empty((height, width), np.int32)
        self._depth = np.empty((height, width), np.float32)
        self._places, self._r = np.ascontiguousarray(places), r
        corners = _pointers(self._places, tessellation.triangles)
        pixels = _pointers(self._index, self._depth)
        _, lib = library()
        lib.rasterise(*corners, len(tessellation.triangles), width, height, *pixels)

    @cached_property
    def _light(self) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
        """Cosines (points,) of normals with the eye and with the lamp, and the one of full light.

        The last number is a cosine with the lamp: a place with that cosine has the same colours as
        the bar beside the picture, neither lighter nor darker. It is that of a surface that faces
        the eye. If no place has so large a cosine, it is the largest one of all places. So a plate
        that is turned away from the lamp still has the colours of the bar.
        """
        normals = self.camera(self._tessellation.normals(self._r))
        lamp = np.array(LAMP) / np.linalg.norm(LAMP)
        eye, to_lamp = (
            np.ascontiguousarray(values, np.float32) for values in (normals[:, 2], normals @ lamp)
        )
        # normals that point away from the eye are turned around: both sides are drawn alike
        best = float(np.where(eye < 0, -to_lamp, to_lamp).max(initial=-1.0))
        return eye, to_lamp, min(float(lamp[2]), best)

    @staticmethod
    def from_surface(surface: Surface, camera: Camera, window: Window) -> "RenderedSurface":
        """Return the deformed surface rendered in a window."""
        return RenderedSurface(tessellate(surface), surface.r0 + surface.u, camera, window)

    @property
    def coverage(self) -> Array:
        """Fraction of each pixel of the picture (height, width) that the surface covers."""
        return in_pixels(self.depth > -np.inf)

    @property
    def depth(self) -> NDArray[np.float32]:
        """Depth, growing towards the eye, of the surface in front at each drawn pixel.

        -inf where there is no surface.
        """
        return self._depth

    def depth_around(self, places: Array) -> Array:
        """Return the largest depth (n,) at drawn pixels around places (n, 2) of the projection."""
        left, _, _, high = self.window.box
        height, width = self._depth.shape
        # from the upper left corner, to the right and downwards
        from_corner = np.nan_to_num((places - [left, high]) * [1, -1])
        x, y = (from_corner * FINER * self.window.scale).astype(int).T
        pixels = [
            (np.clip(y + j, 0, height - 1), np.clip(x + i, 0, width - 1))
            for i, j in product(NEIGHBOURS, NEIGHBOURS)
        ]
        return np.asarray(np.max([self._depth[pixel] for pixel in pixels], axis=0), np.float64)

    def coloured(self, values: Array, limits: tuple[float, float], colours: "Colormap") -> Image:
        """Return the image (height, width, 4) of values (n,) at nodes.

        It is grey where values are nan, and transparent beside the surface. `limits` are the values
        at the ends of the colours.
        """
        table = colours(np.arange(colours.N))[:, :3]
        values_at_points = self._tessellation.at_points(values)
        is_absent = np.isnan(values_at_points)
        image = self.painted(np.where(is_absent, limits[0], values_at_points), limits, table)
        if not is_absent.any():
            return image
        # another image, which is white where values are absent and black elsewhere, says which
        # pixels become grey
        black_and_white = np.repeat([[0.0], [1.0]], 3, axis=1)
        absence = self.painted(is_absent * 1.0, (0.0, 1.0), black_and_white)
        is_grey = absence[..., :1] > MIN_WHITE
        return np.where(is_grey, self.grey_image(NO_VALUE), image)

    def grey_image(self, grey: float) -> Image:
        """Return the image of the surface in one grey."""
        return self.painted(np.zeros(len(self._places)), (0.0, 1.0), np.full((1, 3), grey))

    def painted(self, values: Array, limits: tuple[float, float], table: Array) -> Image:
        """Return the image (height, width, 4) of values (m,) at the points of the tessellation.

        Parameters
        ----------
        limits
            Values at the ends of the colours.
        table
            (n, 3) colours from 0 to 1.
        """
        height, width = self.window.shape
        image = np.empty((height, width, 4), np.uint8)
        numbers, colours = values.astype(np.float32), table.astype(np.float32)
        *cosines, full_light = self._light  # with the eye and with the lamp
        # groups of arguments of the C function `paint`, in their order
        triangles = _pointers(self._places, self._tessellation.triangles, self._index)
        sizes = (width, height, FINER)
        values_and_cosines = _pointers(numbers, *cosines)
        light_and_limits = (full_light, RELIEF, RIM, *limits)
        colours_and_image = (*_pointers(colours), len(colours), *_pointers(image))
        _, lib = library()
        lib.paint(*triangles, *sizes, *values_and_cosines, *light_and_limits, *colours_and_image)
        return image

    def shows(self, places: Array, tolerance: float) -> NDArray[np.bool_]:
        """Whether places (n, 3) are visible up to a depth `tolerance`; True outside the window."""
        projected = self.camera(places)
        left, _, _, high = self.window.box
        height, width = self._index.shape
        x = np.floor((projected[:, 0] - left) * FINER * self.window.scale).astype(int)
        y = np.floor((high - projected[:, 1]) * FINER * self.window.scale).astype(int)
        is_inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        # depth of what is in front at each place, which hides it if it is nearer to the eye
        front = np.full(len(places), -np.inf)
        front[is_inside] = self._depth[y[is_inside], x[is_inside]]
        return np.asarray(projected[:, 2] > front - tolerance)


def in_pixels(drawn: NDArray[np.bool_]) -> Array:
    """Return the fraction of each pixel of the picture that a set of drawn pixels covers."""
    covered = drawn.view(np.uint8)
    count = sum(covered[i::FINER, j::FINER] for i in range(FINER) for j in range(FINER))
    return np.asarray(count / FINER**2)


@cache
def library() -> tuple[Any, Any]:
    """Return the cffi objects (ffi, lib) of raster.c, compiled on first use."""
    return load_native(Path(__file__).with_name("raster.c"), FUNCTIONS, MPI.COMM_SELF)


def _pointers(*arrays: NDArray[Any]) -> list[Any]:
    """Return C pointers to the data of arrays."""
    kinds = {
        "float64": "double[]",
        "float32": "float[]",
        "int32": "int32_t[]",
        "uint8": "uint8_t[]",
    }
    ffi, _ = library()
    return [ffi.from_buffer(kinds[array.dtype.name], array) for array in arrays]


def axes_on_screen(direction: Array) -> Array:
    """Return components (3, 2) of e1, e2, e3 to the right and up, seen from `direction` (3,)."""
    return Camera(direction).axes[:2].T


TURNS = (-0.8, -1.1, 0.8, 1.1)  # rad, from a place, that still leave it visible
MIN_GAIN = 1.15  # of the part of the picture that the shell fills, for another camera
MIN_RADIUS = 0.1  # over R: distance from e3 of a place that has an azimuth
DEFAULT_AZIMUTH = -0.5  # rad, of other places


def run_camera(surface: Surface, style: OutputSection) -> Camera:
    """Return the camera of all pictures of a run.

    It is that of the section `output`. Without one it is chosen so that the largest displacement of
    `surface` is seen: the shell at the point that the run is about.
    """
    if style.camera is None:
        return _best_camera(surface)
    polar, azimuth = np.radians([style.camera.polar, style.camera.azimuth])
    x, y = np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)
    return Camera(np.array([x, y, np.cos(polar)]))


def _best_camera(surface: Surface) -> Camera:
    """Return a camera from which the largest displacement of the shell is visible.

    A dome that has snapped through is seen from lower, so that it hangs below its rim. If there are
    sources or bodies nearby, the camera is turned to where the shell fills more of the picture.
    """
    place, height = deflected_place(surface), LOW_EYE if has_snapped(surface) else HIGH_EYE
    default, outlines = Camera(viewing_direction(place, height=height)), near_outlines(surface)
    if not outlines:
        return default
    tessellation, r = tessellate(surface), surface.r0 + surface.u
    corners = tessellation.at_points(r)[tessellation.triangles]
    places = np.concatenate([surface.r0, r, *outlines])

    def filled_fraction(camera: Camera) -> float:
        """Return the fraction of the picture that the shell's triangles fill, hidden ones too."""
        a, b, c = np.moveaxis(camera(corners)[..., :2], 1, 0)
        left, right, low, high = Window.around(camera(places), 1).box
        # x and y of two sides of each triangle, whose cross product is twice its area
        x, y = np.moveaxis(np.stack([b - a, c - a]), -1, 0)
        area = np.abs(x[0] * y[1] - x[1] * y[0]).sum() / 2
        return float(area / ((right - left) * (high - low)))

    turned = (Camera(viewing_direction(place, turn, height)) for turn in TURNS)
    best = max(turned, key=filled_fraction)
    return best if filled_fraction(best) > MIN_GAIN * filled_fraction(default) else default


HIGH_EYE, LOW_EYE = 33.2, 18.0  # degrees above the horizon
MIN_RISE = 0.05  # over the shell's extent: height of a dome above its lowest place


def viewing_direction(place: Array, turn: float = -0.5, height: float = HIGH_EYE) -> Array:
    """Return a camera direction (3,) from which a place (3,) of a shell is visible.

    It is from above and from the side; its length does not count.

    Parameters
    ----------
    place
        Undeformed place, over R.
    turn
        Azimuth (rad), measured from that of the place.
    height
        Angle (degrees) above the horizon.
    """
    has_azimuth = np.hypot(*place[:2]) > MIN_RADIUS
    heading = (np.arctan2(place[1], place[0]) if has_azimuth else DEFAULT_AZIMUTH) + turn
    rise = np.tan(np.radians(height))
    return 4.2 * np.array([np.cos(heading), np.sin(heading), rise])


def deflected_place(surface: Surface) -> Array:
    """Return the middle (3,) of the nodes with the largest normal displacement, undeformed.

    For a ring-shaped dimple that is on the axis, whichever node has the largest displacement.
    """
    return np.asarray(surface.r0[_most_deflected(surface)].mean(axis=0))


def _most_deflected(surface: Surface) -> NDArray[np.bool_]:
    """Return the mask (n,) of the nodes with the largest normal displacement."""
    size = np.abs(surface.w)
    return np.asarray(size >= LARGEST_FRACTION * size.max())


def has_snapped(surface: Surface) -> bool:
    """Whether the nodes that move most have gone below all of the undeformed shell."""
    lowest, nodes = surface.r0[:, 2].min(), _most_deflected(surface)
    min_rise = MIN_RISE * np.ptp(surface.r0, axis=0).max()
    height, deformed_height = (
        r[nodes, 2].mean() - lowest for r in (surface.r0, surface.r0 + surface.u)
    )
    return bool(height > min_rise and deformed_height < 0)


LARGEST_FRACTION = 0.999  # of the largest displacement: larger ones count as the largest
NO_VALUE = 0.86  # grey of nan
MIN_WHITE = 60  # brightness of 255 of what is white in any light
MAX_DISTANCE = 2.8  # of drawn sources from the shell's middle, over the shell's extent
MEETING_TOLERANCE = 1e-3  # over that distance: lines as near as this meet


def near_outlines(surface: Surface) -> tuple[Array, ...]:
    """Return the outlines (n, 3) of sources and bodies that are near enough to be drawn.

    If one line of a source or body is too far, all of its lines are left out.
    """
    middle, reach = _middle_and_reach(surface)
    numbers = _object_numbers(surface.outlines, MEETING_TOLERANCE * reach)
    far_numbers = {
        number
        for line, number in zip(surface.outlines, numbers, strict=True)
        if _farthest(line, middle) > reach
    }
    return tuple(
        line
        for line, number in zip(surface.outlines, numbers, strict=True)
        if number not in far_numbers
    )


def near_solids(surface: Surface) -> tuple[Solid, ...]:
    """Return the faces of sources and bodies that are near enough to be drawn."""
    middle, reach = _middle_and_reach(surface)
    return tuple(solid for solid in surface.solids if _farthest(solid.points, middle) <= reach)


def _middle_and_reach(surface: Surface) -> tuple[Array, float]:
    """Return the middle (3,) of a deformed shell, and the distance of what is near to it.

    The extent of the shell is that of its deformed or undeformed places, whichever is larger.
    """
    r = surface.r0 + surface.u
    extent = max(float(np.ptp(places, axis=0).max()) for places in (surface.r0, r))
    return r.mean(axis=0), MAX_DISTANCE * extent


def _farthest(line: Array, middle: Array) -> float:
    """Return the largest distance of points (n, 3) from a place (3,)."""
    return float(np.linalg.norm(line - middle, axis=1).max())


def _object_numbers(lines: Sequence[Array], tolerance: float) -> list[int]:
    """Return a number for each line (n, 3), the same for lines that meet.

    Lines that meet belong to one source or body.

    Parameters
    ----------
    tolerance
        Largest distance, over R, of lines that meet.
    """
    numbers = list(range(len(lines)))
    for i, line in enumerate(lines):
        for earlier, earlier_line in enumerate(lines[:i]):
            if _end_distance(line, earlier_line) < tolerance:
                # both are of one object: all lines with the number of this line get the other one's
                numbers = [
                    numbers[earlier] if number == numbers[i] else number for number in numbers
                ]
    return numbers


def _end_distance(line: Array, earlier_line: Array) -> float:
    """Return the least distance of an end of one line (n, 3) from the places of the other line."""
    ends = np.concatenate([line[[0, -1]], earlier_line[[0, -1]]])
    places = np.concatenate([earlier_line, line])
    distances = np.linalg.norm(ends[:, None] - places[None], axis=2)
    # the distances of a line's ends from its own places do not count
    count = len(earlier_line)
    distances[:2, count:] = distances[2:, :count] = np.inf
    return float(distances.min())
