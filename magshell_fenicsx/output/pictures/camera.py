"""The camera of all pictures of a run."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.output import OutputSection
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.sources import near_outlines
from magshell_fenicsx.output.pictures.tessellation import tessellated
from magshell_fenicsx.output.pictures.view import Camera, Window

Array = NDArray[np.float64]
ASIDE = (-0.8, -1.1, 0.8, 1.1)  # turns from a place that still leave it visible
LARGER = 1.15  # the shell must fill so much more of the picture


def run_camera(surface: Surface, style: OutputSection) -> Camera:
    """The camera of all pictures of a run, from the shell at the point that the run is about."""
    if style.camera is None:
        return _best(surface, deflected_place(surface))
    polar, azimuth = np.radians([style.camera.polar, style.camera.azimuth])
    return Camera(np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]))


def _best(surface: Surface, place: Array) -> Camera:
    """The camera from which a place is visible; beside sources or bodies turned to where the shell fills more."""
    usual, near = Camera(towards(place)), near_outlines(surface)
    if not near:
        return usual
    pieces, r = tessellated(surface), surface.r0 + surface.u
    corners, everything = pieces.at(r)[pieces.triangles], np.concatenate([surface.r0, r, *near])

    def size(camera: Camera) -> float:
        """The part of the picture that the shell covers."""
        (a, b, c), box = np.moveaxis(camera(corners)[..., :2], 1, 0), Window.around(camera(everything), 1).box
        x, y = np.moveaxis(np.stack([b - a, c - a]), -1, 0)
        return float(np.abs(x[0] * y[1] - x[1] * y[0]).sum() / 2 / ((box[1] - box[0]) * (box[3] - box[2])))

    best = max((Camera(towards(place, aside)) for aside in ASIDE), key=size)
    return best if size(best) > LARGER * size(usual) else usual


def towards(place: Array, aside: float = -0.5) -> Array:
    """A camera direction (3,) from which a point (3,) of a shell is visible: from above and from the side."""
    heading = (np.arctan2(place[1], place[0]) if np.hypot(*place[:2]) > 0.1 else -0.5) + aside
    return np.array([4.2 * np.cos(heading), 4.2 * np.sin(heading), 2.75])


def deflected_place(surface: Surface) -> Array:
    """The point (3,) of the largest normal displacement."""
    return np.asarray(surface.r0[np.argmax(np.abs(surface.w))])
