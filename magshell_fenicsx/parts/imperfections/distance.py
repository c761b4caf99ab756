"""Distances from a place of the perfect surface: angles, lengths of the meridian from a pole, or straight ones."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.imperfections.flaw import Distance
from magshell_fenicsx.parts.imperfections.place import At
from magshell_fenicsx.shape.outline import Outline, refuse_beside
from magshell_fenicsx.shape.sections import CapSurface, MeshSurface

Array = NDArray[np.float64]
ON_AXIS = 1e-9  # over R


@dataclass(frozen=True)
class Angle:
    """The angle (rad) from a unit vector (3,)."""

    axis: Array

    def __call__(self, places: Array) -> Array:
        (a, b, c), (x, y, z) = self.axis, places.T
        across = np.sqrt((b * z - c * y) ** 2 + (c * x - a * z) ** 2 + (a * y - b * x) ** 2)  # np.cross takes thrice
        return np.asarray(np.arctan2(across, places @ self.axis))


@dataclass(frozen=True)
class Straight:
    """The distance in space from a place (3,)."""

    place: Array

    def __call__(self, places: Array) -> Array:
        return np.asarray(np.linalg.norm(places - self.place, axis=1))


def located(case: Case, drawn: Outline, at: At, key: str) -> tuple[Array, Distance]:
    """The place (3,) over R of a local imperfection on the perfect surface, and the distance from there.

    Raises
    ------
    CaseError
        If it does not lie on the surface, or a direction does not say where it is.
    """
    spherical = case.shell.geometry in ("hemisphere", "cap")
    if at.point is not None:
        place = np.array(at.point) / case.shell.reference
        if not isinstance(case.shell, MeshSurface):
            refuse_beside(f"shell.{key}.at.point", place, drawn, case.shell)
    elif spherical:
        place = at.vector()
        edge = case.shell.polar if isinstance(case.shell, CapSurface) else 90.0
        if not 0 <= at.polar <= 180 or np.linalg.norm(drawn.perfect(drawn.inverse(place)[None])[0] - place) > 1e-6:
            raise CaseError(f"shell.{key}.at.polar: {at.polar:g}: is not on the shell: allowed 0 to {edge:g}")
    elif at.polar or drawn.highest is None or not (drawn.disc or case.shell.geometry == "strip"):
        raise CaseError(f"shell.{key}.at: on a {case.shell.geometry} give its place, at: {{point: [x, y, z]}}")
    else:
        place = drawn.perfect(drawn.highest[None])[0]
    if spherical:
        return place, Angle(place / np.linalg.norm(place))
    if drawn.from_pole and np.hypot(*place[:2]) < ON_AXIS:
        return place, drawn.from_pole
    return place, Straight(place)
