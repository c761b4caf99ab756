"""What is seen of a surface: a parallel projection, the triangle in front at each pixel, colours, shade."""

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.tessellation import Tessellation, tessellated
from magshell_fenicsx.platform.native import native

if TYPE_CHECKING:  # takes long to import
    from matplotlib.colors import Colormap

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
FUNCTIONS = """
    void rasterise(const double *, const int32_t *, int64_t, int32_t, int32_t, int32_t *, float *);
    void paint(const double *, const int32_t *, const int32_t *, int32_t, int32_t, int32_t, const float *,
               const float *, float, float, float, const float *, int32_t, uint8_t *);
"""
FINER = 2  # drawn pixels along each side of a pixel of the picture
DARKEST = 0.45  # loss of light where the surface is seen edgewise; none where it faces the eye
AROUND = 0.02  # margin around what is drawn, over its largest side


@dataclass(frozen=True)
class Camera:
    """A parallel projection along a direction (3,), from the shell to the eye; e3 is up on the picture."""

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
        """The window, so many pixels wide, in which all projected places (n, 2 or 3) are; at most so tall over wide."""
        low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
        margin = AROUND * max(high - low)
        low, high = low - margin, high + margin
        wide, tall = high - low
        spare = max(tall / tallest - wide, 0.0) / 2
        return Window((low[0] - spare, high[0] + spare, low[1], high[1]), width / (wide + 2 * spare))


class Seen:
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
        places[:, 0], places[:, 1] = (places[:, 0] - left) * scale - 0.5, (high - places[:, 1]) * scale - 0.5
        self._index = np.empty((height, width), np.int32)
        self._depth = np.empty((height, width), np.float32)
        self._places, self._r = np.ascontiguousarray(places), r
        corners, pixels = _pointers(self._places, pieces.triangles), _pointers(self._index, self._depth)
        library()[1].rasterise(*corners, len(pieces.triangles), width, height, *pixels)

    @cached_property
    def _facing(self) -> NDArray[np.float32]:
        """Cosines between normals and the direction to the eye, at points."""
        return np.asarray(np.abs(self._pieces.normals(self._r) @ self.camera.axes[2]), np.float32)

    @staticmethod
    def of(surface: Surface, camera: Camera, window: Window) -> "Seen":
        return Seen(tessellated(surface), surface.r0 + surface.u, camera, window)

    @property
    def share(self) -> Array:
        """How much of each pixel of the picture the surface covers."""
        covered = (self._index >= 0).view(np.uint8)
        found = sum(covered[i::FINER, j::FINER] for i in range(FINER) for j in range(FINER))
        return np.asarray(found / FINER**2)

    def coloured(self, values: Array, limits: tuple[float, float], colours: "Colormap") -> Image:
        """The image (height, width, 4) of values (n,) at nodes; transparent around the surface."""
        return self._painted(self._pieces.at(values), limits, colours(np.arange(colours.N))[:, :3])

    def plain(self, grey: float) -> Image:
        """The image of a surface in one grey."""
        return self._painted(np.zeros(len(self._places)), (0.0, 1.0), np.full((1, 3), grey))

    def _painted(self, values: Array, limits: tuple[float, float], table: Array) -> Image:
        height, width = self.window.shape
        image = np.empty((height, width, 4), np.uint8)
        numbers, colours = values.astype(np.float32), table.astype(np.float32)
        library()[1].paint(
            *_pointers(self._places, self._pieces.triangles, self._index),
            *(width, height, FINER, *_pointers(numbers, self._facing), DARKEST, *limits),
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


@cache
def library() -> tuple[Any, Any]:
    """The cffi objects of raster.c, compiled on first use."""
    return native(Path(__file__).with_name("raster.c"), FUNCTIONS, MPI.COMM_SELF)


def _pointers(*arrays: NDArray[Any]) -> list[Any]:
    kinds = {"float64": "double[]", "float32": "float[]", "int32": "int32_t[]", "uint8": "uint8_t[]"}
    return [library()[0].from_buffer(kinds[array.dtype.name], array) for array in arrays]


def axes_on_screen(direction: Array) -> Array:
    """The components (3, 2) of e1, e2, e3 to the right and up on the screen, seen from a direction."""
    return Camera(direction).axes[:2].T
