"""A cuboid magnet as a field."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.sources.cuboid import CuboidSection
from magshell_fenicsx.parts.magnetism.sources.cylinder import to_box
from magshell_fenicsx.parts.magnetism.sources.harmonic import Harmonic
from magshell_fenicsx.parts.magnetism.sources.known import Known, magpylib
from magshell_fenicsx.shape.lines import edges

Array = NDArray[np.float64]


def cuboid(section: CuboidSection, case: Case, key: str) -> Known:
    """See `Known`."""
    half = np.array(section.dimension) / 2
    magnet = magpylib(key).magnet.Cuboid(dimension=2 * half, polarization=section.vector)
    return Known(Harmonic(magnet.getB, lambda x: to_box(np.abs(x) - half)), edges(-half, half), "inside")
