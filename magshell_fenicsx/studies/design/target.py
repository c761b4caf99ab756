"""Wanted shapes as functions of the undeformed place."""

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.design import ShapeSection
from magshell_fenicsx.case.expressions import formula
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.simulate.results import Target

Array = NDArray[np.float64]
FINE = 4001  # points by which the length of a spline is measured
AT_ROOT = 1e-6


def target_of(section: ShapeSection, case: Case) -> Target:
    """Undeformed places (n, 3) over R -> wanted places.

    Raises
    ------
    CaseError
        If a curve is wanted of another shell than a strip, or begins elsewhere than at its root.
    """
    if section.components:
        along = [formula(text) for text in section.components]
        return lambda x: np.stack([f(*x.T) for f in along], axis=-1)
    if case.shell.geometry != "strip":
        raise CaseError("design.objective.shape.curve: is of a strip; give components")
    points = np.array(section.curve)
    if np.abs(points[0]).max() > AT_ROOT:
        raise CaseError(
            f"design.objective.shape.curve: begins at {points[0].tolist()}, but the strip's root is at 0, 0, 0"
        )
    return Curve(points)


class Curve:
    """The spline through points, of length one; the strip's places keep their distance to its middle line along y."""

    def __init__(self, points: Array) -> None:
        chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        spline = scipy.interpolate.CubicSpline(chord, points)
        fine = spline(np.linspace(0.0, chord[-1], FINE))
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
        self._at = scipy.interpolate.CubicSpline(length / length[-1], fine / length[-1])

    def __call__(self, x: Array) -> Array:
        return np.asarray(self._at(x[:, 0])) + x[:, 1:2] * [0.0, 1.0, 0.0]
