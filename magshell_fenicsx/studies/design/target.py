"""Wanted shapes as functions of the undeformed place."""

import itertools

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.design import ShapeSection
from magshell_fenicsx.input.expressions import formula
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.simulate.results import Target

Array = NDArray[np.float64]
FINE = 4001  # points by which the length of a spline is measured
AT_ROOT = 1e-6


def target_of(section: ShapeSection, case: Case, bent: float = 1.0) -> Target:
    """Undeformed places (n, 3) over R -> wanted places; of a curve with a part of its curvature.

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
    return Curve(points, bent)


class Curve:
    """The spline through points, of length one; the strip's places keep their distance to its middle line along y."""

    def __init__(self, points: Array, bent: float = 1.0) -> None:
        chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        spline = scipy.interpolate.CubicSpline(chord, points)
        fine = spline(np.linspace(0.0, chord[-1], FINE))
        fine = fine if bent == 1.0 else _bent(fine, bent)
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
        self._at = scipy.interpolate.CubicSpline(length / length[-1], fine / length[-1])

    def __call__(self, x: Array) -> Array:
        return np.asarray(self._at(x[:, 0])) + x[:, 1:2] * [0.0, 1.0, 0.0]


def _bent(points: Array, part: float) -> Array:
    """The curve with the same first tangent and lengths, and a part of its curvature, in a frame without twist."""
    steps = np.diff(points, axis=0)
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    tangents = steps / length
    found, turned = [tangents[0]], np.eye(3)  # from the frame of the curve to that of the bent one
    for before, after in itertools.pairwise(tangents):
        turn = np.cross(before, after)
        angle = np.arctan2(np.linalg.norm(turn), before @ after)
        axis = turn * (angle / max(float(np.linalg.norm(turn)), 1e-300))
        back = scipy.spatial.transform.Rotation.from_rotvec(-axis).as_matrix()
        turned = turned @ scipy.spatial.transform.Rotation.from_rotvec(part * axis).as_matrix() @ back
        found.append(turned @ after)
    return np.vstack([points[:1], points[0] + np.cumsum(length * np.array(found), axis=0)])
