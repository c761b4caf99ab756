"""A current in a thin wire as a field."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.sources.coil import CoilSection
from magshell_fenicsx.parts.magnetism.sources.harmonic import Harmonic
from magshell_fenicsx.parts.magnetism.sources.known import Known, magpylib
from magshell_fenicsx.shape.lines import circle

Array = NDArray[np.float64]


def coil(section: CoilSection, case: Case, key: str) -> Known:
    """See `Known`."""
    current, made = section.turns * section.current, magpylib(key).current
    if section.vertices is not None:
        corners = np.array(section.vertices)
        wire = made.Polyline(current=current, vertices=corners)
        return Known(Harmonic(wire.getB, lambda x: to_polygon(x, corners)), [corners], "on the wire of")
    assert section.diameter
    r = section.diameter / 2
    loop = made.Circle(current=current, diameter=2 * r)

    def distance(x: Array) -> Array:
        return np.hypot(np.hypot(x[:, 0], x[:, 1]) - r, x[:, 2])

    return Known(Harmonic(loop.getB, distance), [circle(r)], "on the wire of")


def to_polygon(x: Array, corners: Array) -> Array:
    """The distance (n,) of places (n, 3) from the nearest of the lines between corners (m, 3)."""
    found = np.full(len(x), np.inf)
    for a, way in zip(corners, np.diff(corners, axis=0), strict=False):
        along = np.clip((x - a) @ way / np.sum(way**2), 0.0, 1.0)
        found = np.minimum(found, np.linalg.norm(x - a - along[:, None] * way, axis=1))
    return found
