"""The camera of all pictures of a run."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.output import OutputSection
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.view import Camera

Array = NDArray[np.float64]


def run_camera(surface: Surface, style: OutputSection) -> Camera:
    """The camera of all pictures of a run, from the shell at its last point."""
    if style.camera is None:
        return Camera(towards(deflected_place(surface)))
    polar, azimuth = np.radians([style.camera.polar, style.camera.azimuth])
    return Camera(np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]))


def towards(place: Array) -> Array:
    """A camera direction (3,) from which a point (3,) of a shell is visible: from above and from the side."""
    heading = np.arctan2(place[1], place[0]) if np.hypot(*place[:2]) > 0.1 else -0.5
    return np.array([4.2 * np.cos(heading - 0.5), 4.2 * np.sin(heading - 0.5), 2.75])


def deflected_place(surface: Surface) -> Array:
    """The point (3,) of the largest normal displacement."""
    return np.asarray(surface.r0[np.argmax(np.abs(surface.w))])
