"""A cylinder magnet as a field."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.sources.cylinder import CylinderSection
from magshell_fenicsx.parts.magnetism.sources.harmonic import Harmonic
from magshell_fenicsx.parts.magnetism.sources.known import Known, magpylib
from magshell_fenicsx.shape.lines import upright

Array = NDArray[np.float64]


def cylinder(section: CylinderSection, case: Case, key: str) -> Known:
    """See `Known`."""
    r, h = section.diameter / 2, section.height
    magnet = magpylib(key).magnet.Cylinder(dimension=(2 * r, h), polarization=section.vector)

    def distance(x: Array) -> Array:
        return to_box(np.column_stack([np.hypot(x[:, 0], x[:, 1]) - r, np.abs(x[:, 2]) - h / 2]))

    return Known(Harmonic(magnet.getB, distance), upright(r, h), "inside")


def to_box(beyond: Array) -> Array:
    """The distance (n,) from how far places are beyond the faces in each direction (n, m); negative inside."""
    return np.asarray(np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0))
