"""A ring magnet as a field."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.sources.ring import RingSection
from magshell_fenicsx.parts.magnetism.sources.cylinder import to_box
from magshell_fenicsx.parts.magnetism.sources.harmonic import Harmonic
from magshell_fenicsx.parts.magnetism.sources.known import Known, magpylib
from magshell_fenicsx.shape.lines import upright

Array = NDArray[np.float64]


def ring(section: RingSection, case: Case, key: str) -> Known:
    """See `Known`."""
    inner, outer, h = section.inner_diameter / 2, section.diameter / 2, section.height
    made = magpylib(key).magnet.CylinderSegment
    magnet = made(dimension=(inner, outer, h, 0, 360), polarization=section.vector)

    def distance(x: Array) -> Array:
        off_middle = np.abs(np.hypot(x[:, 0], x[:, 1]) - (inner + outer) / 2)
        return to_box(np.column_stack([off_middle - (outer - inner) / 2, np.abs(x[:, 2]) - h / 2]))

    return Known(Harmonic(magnet.getB, distance), [*upright(inner, h), *upright(outer, h)], "inside")
