"""What is seen of a surface: a parallel projection, the triangle in front at each pixel, colours,
shade.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.tessellation import Tessellation, tessellated
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
    void paint(const double *, const int32_t *, const int32_t *, int32_t, int32_t, int32_t, const float *,
               const float *, const float *, float, float, float, float, float, const float *, int32_t, uint8_t *);
"""
FINER = 2  # drawn pixels along each side of a pixel of the picture
LAMP = (-0.45, 0.55, 0.7)  # the way to the lamp: to the right, up, towards the eye
RELIEF = 0.5  # of the light comes from the lamp, and falls on slopes alone
RIM = 0.12  # loss of light where the surface is seen edgewise
NEXT = (-2, -1, 0, 1, 2)  # drawn pixels around one
AROUND = 0.02  # margin around what is drawn, over its largest side


@dataclass(frozen=True)
class Camera:
    """A parallel projection along a direction (3,), from the shell to the eye; e3 is up on the
    picture.
    """

    direction: Array

    @cached_property
    def axes(self) -> Array:
        """(3, 3): to the right, up, towards the eye."""
        towards = self.direction / np.linalg.norm(self.direction)
        right = np.cross([0.0, 0.0, 1.0], towards)
        right /= np.linalg.norm(right)
        return np.array([right, np.cross(towards, right), towards])

    def __call__(self, r: Array) -> Array:
        """Places or vectors (..., 3) to the right, up and towards the eye."""
        return np.asarray(r @ self.axes.T)


@dataclass(frozen=True)
class Window:
    """The drawn part of the projection: (left, right, low, high) over R, and pixels per R."""

    box: tuple[float, float, float, float]
    scale: float

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        left, right, low, high = self.box
        return max(round((high - low) * self.scale), 1), max(round((right - left) * self.scale), 1)

    @staticmethod
    def around(places: Array, width: int, tallest: float = 1.3) -> "Window":
        """The window, so many pixels wide, in which all projected places (n, 2 or 3) are; at most
        so tall over wide.
        """
        low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
        margin = AROUND * max(high - low)
        low, high = low - margin, high + margin
        wide, tall = high - low
        spare = max(tall / tallest - wide, 0.0) / 2
        return Window(
            (low[0] - spare, high[0] + spare, low[1], high[1]), width / (wide + 2 * spare)
        )


class InView:
    """A deformed surface as it is seen in a window.

    Parameters
    ----------
    r
        (n, 3) deformed places of the nodes.
    """

    def __init__(self, pieces: Tessellation, r: Array, camera: Camera, window: Window) -> None:
        self._pieces, self.camera, self.window = pieces, camera, window
        height, width = (FINER * n for n in window.shape)
        left, _, _, high = window.box
        scale = FINER * window.scale
        places = camera(pieces.at(r))
        places[:, 0], places[:, 1] = (
            (places[:, 0] - left) * scale - 0.5,
            (high - places[:, 1]) * scale - 0.5,
        )
        self._index = np.empty((height, width), np.int32)
        self._depth = np.empty((height, width), np.float32)
        self._places, self._r = np.ascontiguousarray(places), r
        corners, pixels = (
            _pointers(self._places, pieces.triangles),
            _pointers(self._index, self._depth),
        )
        library()[1].rasterise(*corners, len(pieces.triangles), width, height, *pixels)

    @cached_property
    def _lit(self) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
        """At points the cosines between normals and the ways to the eye and to the lamp, and the
        cosine of full light.

        Full light has what faces the eye. If nothing faces the lamp as well as that, what faces it
        best has full light: so a plate that is turned away from the lamp has the colours of the bar
        too.
        """
        normals, lamp = (
            self.camera(self._pieces.normals(self._r)),
            np.array(LAMP) / np.linalg.norm(LAMP),
        )
        eye, to_lamp = (
            np.ascontiguousarray(values, np.float32) for values in (normals[:, 2], normals @ lamp)
        )
        best = float(np.where(eye < 0, -to_lamp, to_lamp).max(initial=-1.0))
        return eye, to_lamp, min(float(lamp[2]), best)

    @staticmethod
    def of(surface: Surface, camera: Camera, window: Window) -> "InView":
        return InView(tessellated(surface), surface.r0 + surface.u, camera, window)

    @property
    def share(self) -> Array:
        """How much of each pixel of the picture the surface covers."""
        return in_pixels(self.depth > -np.inf)

    @property
    def depth(self) -> NDArray[np.float32]:
        """Of what is in front, towards the eye, at FINER drawn pixels for each; -inf where the
        surface is not.
        """
        return self._depth

    def depth_around(self, places: Array) -> Array:
        """The largest depth (n,) of what is drawn at or next to places (n, 2) of the projection."""
        left, _, _, high = self.window.box
        height, width = self._depth.shape
        x, y = (
            (np.nan_to_num((places - [left, high]) * [1, -1]) * FINER * self.window.scale)
            .astype(int)
            .T
        )
        around = [
            (np.clip(y + j, 0, height - 1), np.clip(x + i, 0, width - 1))
            for i in NEXT
            for j in NEXT
        ]
        return np.asarray(np.max([self._depth[at] for at in around], axis=0), np.float64)

    def coloured(self, values: Array, limits: tuple[float, float], colours: "Colormap") -> Image:
        """The image (height, width, 4) of values (n,) at nodes, grey where they are nan;
        transparent around.
        """
        table, at = colours(np.arange(colours.N))[:, :3], self._pieces.at(values)
        nowhere = np.isnan(at)
        image = self.painted(np.where(nowhere, limits[0], at), limits, table)
        if not nowhere.any():
            return image
        bright = (
            self.painted(nowhere * 1.0, (0.0, 1.0), np.repeat([[0.0], [1.0]], 3, axis=1))[..., :1]
            > NONE_HERE
        )
        return np.where(bright, self.plain(NO_VALUE), image)

    def plain(self, grey: float) -> Image:
        """The image of a surface in one grey."""
        return self.painted(np.zeros(len(self._places)), (0.0, 1.0), np.full((1, 3), grey))

    def painted(self, values: Array, limits: tuple[float, float], table: Array) -> Image:
        """The image of values at the points, in the colours (n, 3) of a table."""
        height, width = self.window.shape
        image = np.empty((height, width, 4), np.uint8)
        numbers, colours = values.astype(np.float32), table.astype(np.float32)
        *lit, one = self._lit
        library()[1].paint(
            *_pointers(self._places, self._pieces.triangles, self._index),
            *(width, height, FINER, *_pointers(numbers, *lit), one, RELIEF, RIM, *limits),
            *(*_pointers(colours), len(colours), *_pointers(image)),
        )
        return image

    def shows(self, places: Array, within: float) -> NDArray[np.bool_]:
        """Whether places (n, 3) are not hidden, up to a depth `within`; True outside the window."""
        at = self.camera(places)
        left, _, _, high = self.window.box
        height, width = self._index.shape
        x = np.floor((at[:, 0] - left) * FINER * self.window.scale).astype(int)
        y = np.floor((high - at[:, 1]) * FINER * self.window.scale).astype(int)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        front = np.full(len(places), -np.inf)
        front[inside] = self._depth[y[inside], x[inside]]
        return np.asarray(at[:, 2] > front - within)


def in_pixels(drawn: NDArray[np.bool_]) -> Array:
    """How much of each pixel of the picture a part of the drawn pixels covers."""
    covered = drawn.view(np.uint8)
    count = sum(covered[i::FINER, j::FINER] for i in range(FINER) for j in range(FINER))
    return np.asarray(count / FINER**2)


@cache
def library() -> tuple[Any, Any]:
    """The cffi objects of raster.c, compiled on first use."""
    return load_native(Path(__file__).with_name("raster.c"), FUNCTIONS, MPI.COMM_SELF)


def _pointers(*arrays: NDArray[Any]) -> list[Any]:
    kinds = {
        "float64": "double[]",
        "float32": "float[]",
        "int32": "int32_t[]",
        "uint8": "uint8_t[]",
    }
    return [library()[0].from_buffer(kinds[array.dtype.name], array) for array in arrays]


def axes_on_screen(direction: Array) -> Array:
    """The components (3, 2) of e1, e2, e3 to the right and up on the screen, seen from a direction."""
    return Camera(direction).axes[:2].T


ASIDE = (-0.8, -1.1, 0.8, 1.1)  # turns from a place that still leave it visible
LARGER = 1.15  # the shell must fill so much more of the picture


def run_camera(surface: Surface, style: OutputSection) -> Camera:
    """The camera of all pictures of a run, from the shell at the point that the run is about."""
    if style.camera is None:
        return _best(surface, deflected_place(surface))
    polar, azimuth = np.radians([style.camera.polar, style.camera.azimuth])
    return Camera(
        np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    )


def _best(surface: Surface, place: Array) -> Camera:
    """The camera from which a place is visible; beside sources or bodies turned to where the shell
    fills more.
    """
    usual, near = Camera(towards(place)), near_outlines(surface)
    if not near:
        return usual
    pieces, r = tessellated(surface), surface.r0 + surface.u
    corners, everything = pieces.at(r)[pieces.triangles], np.concatenate([surface.r0, r, *near])

    def size(camera: Camera) -> float:
        """The part of the picture that the shell covers."""
        (a, b, c), box = (
            np.moveaxis(camera(corners)[..., :2], 1, 0),
            Window.around(camera(everything), 1).box,
        )
        x, y = np.moveaxis(np.stack([b - a, c - a]), -1, 0)
        return float(
            np.abs(x[0] * y[1] - x[1] * y[0]).sum() / 2 / ((box[1] - box[0]) * (box[3] - box[2]))
        )

    best = max((Camera(towards(place, aside)) for aside in ASIDE), key=size)
    return best if size(best) > LARGER * size(usual) else usual


def towards(place: Array, aside: float = -0.5) -> Array:
    """A camera direction (3,) from which a point (3,) of a shell is visible: from above and from
    the side.
    """
    heading = (np.arctan2(place[1], place[0]) if np.hypot(*place[:2]) > 0.1 else -0.5) + aside
    return np.array([4.2 * np.cos(heading), 4.2 * np.sin(heading), 2.75])


def deflected_place(surface: Surface) -> Array:
    """The middle (3,) of where the normal displacement is largest: of a ring its axis, whatever
    node is ahead.
    """
    size = np.abs(surface.w)
    return np.asarray(surface.r0[size >= ALIKE * size.max()].mean(axis=0))


ALIKE = 0.999  # of the largest displacement: what is larger is that
NO_VALUE = 0.86  # the grey of what has none
NONE_HERE = 60  # brightness of 255 of what is white in any light
FAR = 2.5  # of the shell's extent, from its middle: sources farther away are not drawn
SAME = 1e-3  # of that reach: lines as near as this meet


def near_outlines(surface: Surface) -> tuple[Array, ...]:
    """The outlines of sources and bodies that leave the shell large enough to be seen."""
    r = surface.r0 + surface.u
    middle, reach = r.mean(axis=0), FAR * float(np.ptp(r, axis=0).max())
    whole = _joined(surface.outlines, SAME * reach)
    far = {
        number
        for line, number in zip(surface.outlines, whole, strict=True)
        if _farthest(line, middle) > reach
    }
    return tuple(
        line for line, number in zip(surface.outlines, whole, strict=True) if number not in far
    )


def near_solids(surface: Surface) -> tuple[Solid, ...]:
    """The same of their faces."""
    r = surface.r0 + surface.u
    middle, reach = r.mean(axis=0), FAR * float(np.ptp(r, axis=0).max())
    return tuple(solid for solid in surface.solids if _farthest(solid.points, middle) <= reach)


def _farthest(line: Array, middle: Array) -> float:
    return float(np.linalg.norm(line - middle, axis=1).max())


def _joined(lines: Sequence[Array], within: float) -> list[int]:
    """A number for each line, the same of lines that meet: they are of one source or body."""
    numbers = list(range(len(lines)))
    for i, line in enumerate(lines):
        for k, other in enumerate(lines[:i]):
            ends = np.concatenate([line[[0, -1]], other[[0, -1]]])
            apart = np.linalg.norm(ends[:, None] - np.concatenate([other, line])[None], axis=2)
            apart[:2, len(other) :] = apart[2:, : len(other)] = np.inf  # of a line from itself
            if apart.min() < within:
                numbers = [numbers[k] if n == numbers[i] else n for n in numbers]
    return numbers
