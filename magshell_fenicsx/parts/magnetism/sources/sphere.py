"""A sphere magnet as a field."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.sources.sphere import SphereSection
from magshell_fenicsx.parts.magnetism.sources.harmonic import Harmonic
from magshell_fenicsx.parts.magnetism.sources.known import Known, magpylib
from magshell_fenicsx.shape.lines import ball

Array = NDArray[np.float64]


def sphere(section: SphereSection, case: Case, key: str) -> Known:
    """See `Known`."""
    r = section.diameter / 2
    magnet = magpylib(key).magnet.Sphere(diameter=2 * r, polarization=section.vector)

    def distance(x: Array) -> Array:
        return np.asarray(np.linalg.norm(x, axis=1) - r)

    return Known(Harmonic(magnet.getB, distance), ball(r), "inside")
