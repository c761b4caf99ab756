"""A cuboid magnet as a field."""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.sources.cuboid import CuboidSection
from magshell_fenicsx.plan.sources.cylinder import to_box
from magshell_fenicsx.plan.sources.harmonic import Harmonic
from magshell_fenicsx.plan.sources.known import Known, magpylib

Array = NDArray[np.float64]


def cuboid(section: CuboidSection, case: Case, key: str) -> Known:
    """See `Known`."""
    half = np.array(section.dimension) / 2
    magnet = magpylib(key).magnet.Cuboid(dimension=2 * half, polarization=section.vector)
    return Known(Harmonic(magnet.getB, lambda x: to_box(np.abs(x) - half)), edges(-half, half), "inside")


def edges(low: Array, high: Array) -> list[Array]:
    """The twelve edges of a box between two corners (3,)."""
    corners = np.array([*product((0, 1), repeat=3)])
    pairs = [(a, b) for a in corners for b in corners if (b - a).sum() == 1 and (b >= a).all()]
    return [low + np.array(pair) * (high - low) for pair in pairs]
