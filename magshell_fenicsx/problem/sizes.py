"""Element sizes: what dimple, loads and edges need, in units of the shell's own length sqrt(Rh)."""

from collections.abc import Sequence
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.mesh.grading import Disc, Feature, Grading, Line, Ring
from magshell_fenicsx.parts.course import Fit
from magshell_fenicsx.parts.imperfections.rims import Spot, images
from magshell_fenicsx.parts.step import Step
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.sections import MeshSurface

Array = NDArray[np.float64]
RING = 0.35  # of sqrt(Rh): elements that show the ring of a contact
Pressed = tuple[Array, float, float]  # place in the chart, how far from there the body presses, its size; over R
Loaded = tuple[Array, Sequence[Step]]  # place in the chart, and the loads there


def grading(
    case: Case,
    outline: Outline,
    h: float,
    spots: Sequence[Spot],
    everywhere: float,
    loaded: Sequence[Loaded],
    pressed: Sequence[Pressed] = (),
    varying: Sequence[Feature] = (),
) -> Grading:
    """Sizes for 1e-4 in k_d and 1e-3 in F at degree 4; the case's own size is everywhere the same.

    Parameters
    ----------
    spots, everywhere
        The local imperfections, and the largest size that shows the others.
    loaded
        The concentrated loads.
    pressed
        Where bodies press.
    varying
        Where formulas vary.
    """
    if case.mesh.size is not None or isinstance(case.shell, MeshSurface):
        return Grading([], _uniform(case, h))
    fit = Fit(h, case.mesh.refinement, case.model == "solid", bool(spots))
    features = [*_rim(case, outline, fit), *_imperfections(case, outline, fit, spots)]
    for place, loads in loaded:
        for kind in {type(load): None for load in loads}:
            features += kind.around([load for load in loads if type(load) is kind], place, fit)
    features += [*(feature for one in pressed for feature in _contact(case, fit, *one)), *varying]
    return Grading(features, min(_largest(case, outline, fit), everywhere) / case.mesh.refinement)


def _uniform(case: Case, h: float) -> float:
    """By default twice sqrt(Rh), within reason."""
    size = case.mesh.size / case.shell.reference if case.mesh.size else min(2 * sqrt(h), 0.35)
    return size / case.mesh.refinement


def _largest(case: Case, outline: Outline, fit: Fit) -> float:
    if outline.grid:
        return min(2 * sqrt(fit.h), 0.35)
    if not outline.disc or case.shell.geometry == "disc":
        return min(0.25, 0.5 * (case.width or 1.0))
    return min((size for step in case.programme if (size := step.load.largest(fit)) is not None), default=0.35)


def _growth(case: Case, fit: Fit) -> float:
    return max((step.load.growth(fit) for step in case.programme), default=0.4)


def _rim(case: Case, outline: Outline, fit: Fit) -> list[Feature]:
    """Smaller elements along the edge of a curved surface."""
    h = fit.h
    if grid := outline.grid:
        size, held = 1.2 * sqrt(h) / case.mesh.refinement, case.boundary.conditions()
        ends = ((axis, end[axis]) for axis in range(2) for end in (grid.low, grid.high))
        sides = zip(ends, grid.sides, grid.glued[:1] * 2 + grid.glued[1:] * 2, strict=True)
        fixed = (at for at, name, glued in sides if not glued and held.get(name, "free") not in ("free", "symmetry"))
        return [Line(axis, place, size, _growth(case, fit)) for axis, place in fixed]
    if not outline.disc or case.shell.geometry == "disc":
        return []
    size = max((step.load.rim(fit) for step in case.programme), default=1.4)
    return [Ring(outline.edge, size * sqrt(h) / case.mesh.refinement, _growth(case, fit))]


def _imperfections(case: Case, outline: Outline, fit: Fit, spots: Sequence[Spot]) -> list[Feature]:
    """Small elements on each and a little around it."""
    return [
        Disc((float(x), float(y)), spot.radius + 0.7 * sqrt(fit.h), spot.size / fit.refinement, _growth(case, fit))
        for spot in spots
        for x, y in images(spot, outline)
    ]


def travel(h: float, approach: float, size: float) -> float:
    """How far from the first contact a body presses: a plane in a ring up to sqrt(2 R a), others on their front."""
    return min(1.1 * sqrt(2 * (approach or 10.0) * h) + 0.5 * sqrt(h), size + sqrt(h))


def _contact(case: Case, fit: Fit, place: Array, reach: float, size: float) -> list[Feature]:
    h, (x, y) = fit.h, map(float, place)
    centre, finer = (x, y), sqrt(h) / case.mesh.refinement
    small = [Disc(centre, 1.5 * size, max(size / 3, 0.1 * h), 0.4)] if size < sqrt(h) else []
    return [Disc(centre, reach, RING * finer, _growth(case, fit)), *small]
