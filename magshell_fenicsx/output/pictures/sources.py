"""Outlines of sources and bodies that are drawn beside a shell."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface

Array = NDArray[np.float64]
FAR = 2.5  # of the shell's extent, from its middle: sources farther away are not drawn
SAME = 1e-3  # of that reach: lines as near as this meet


def near_outlines(surface: Surface) -> tuple[Array, ...]:
    """The outlines of sources and bodies that leave the shell large enough to be seen."""
    r = surface.r0 + surface.u
    middle, reach = r.mean(axis=0), FAR * float(np.ptp(r, axis=0).max())
    whole = _joined(surface.outlines, SAME * reach)
    far = {number for line, number in zip(surface.outlines, whole, strict=True) if _farthest(line, middle) > reach}
    return tuple(line for line, number in zip(surface.outlines, whole, strict=True) if number not in far)


def _farthest(line: Array, middle: Array) -> float:
    return float(np.linalg.norm(line - middle, axis=1).max())


def _joined(lines: Sequence[Array], within: float) -> list[int]:
    """A number for each line, the same of lines that meet: they are of one source or body."""
    numbers = list(range(len(lines)))
    for i, line in enumerate(lines):
        for k, other in enumerate(lines[:i]):
            ends = np.concatenate([line[[0, -1]], other[[0, -1]]])
            apart = np.linalg.norm(ends[:, None] - np.concatenate([other, line])[None], axis=2)
            apart[:2, len(other) :] = apart[2:, : len(other)] = np.inf  # of a line from itself
            if apart.min() < within:
                numbers = [numbers[k] if n == numbers[i] else n for n in numbers]
    return numbers
