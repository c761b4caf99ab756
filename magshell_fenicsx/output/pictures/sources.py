"""Outlines of sources and bodies that are drawn beside a shell."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface

Array = NDArray[np.float64]
FAR = 2.0  # of the shell's extent, from its middle: sources farther away are not drawn


def near_outlines(surface: Surface) -> tuple[Array, ...]:
    """The outlines of sources and bodies that leave the shell large enough to be seen."""
    r = surface.r0 + surface.u
    middle, reach = r.mean(axis=0), FAR * float(np.ptp(r, axis=0).max())
    return tuple(line for line in surface.outlines if np.linalg.norm(line - middle, axis=1).max() < reach)
